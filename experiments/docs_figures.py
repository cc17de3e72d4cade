"""Draw the figures of jaxcal/docs (and the README's) anew, from what the course's commands have made.

    JAXCAL_DATA=path/to/recordings python experiments/docs_outputs.py      # runs the course, minutes
    JAXCAL_DATA=path/to/recordings python experiments/docs_figures.py      # then this, seconds
    python experiments/docs_figures.py --only guide-views guide-motion     # the guide's drawings need no course

Pictures of the real recordings are not shown, only what was computed from them: their licence does not allow more.
"""

import argparse
import io
import re
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import platformdirs
from docs_drawings import ACCENT, INK, MUTED, drawings
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

import jaxcal
from jaxcal.atomic import write_bytes
from jaxcal.recording import load_frames
from jaxcal.results import projection_uncertainty
from jaxcal.results.report.camera_figures import camera_pictures, residual_pictures

FIGURES = Path(__file__).resolve().parent.parent / "jaxcal" / "docs" / "figures"
COURSE = Path(platformdirs.user_cache_dir("jaxcal")) / "course"
_DPI = 100
_COLOURS = 96  # of the palette that keeps pictures small
_MOST_BYTES = 100_000
# The report's colours on white paper.
_LIGHT = {
    "--ink": INK, "--muted": MUTED, "--line": "#d5d9e0", "--bad": "#c8402f", "--axis-x": "#c8402f",
    "--axis-y": "#2f8f4e", "--axis-z": ACCENT, "--accent": ACCENT, "--usable": "#d18a00", "--paper": "#ffffff",
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made = figures(COURSE)
    parser.add_argument("--only", nargs="+", choices=sorted(made), metavar="NAME", help=", ".join(made))
    parser.add_argument("--work", type=Path, default=COURSE, help="folder in which the course was run (%(default)s)")
    chosen = parser.parse_args()
    made = figures(chosen.work)
    try:
        for name in chosen.only or made:
            path = write_figure(made[name](), name)
            print(f"{path.relative_to(FIGURES.parents[2])}: {path.stat().st_size / 1e3:.0f} kB")
    except (jaxcal.CalibrationError, FileNotFoundError) as error:
        print(f"error: {error}\nRun experiments/docs_outputs.py first: it makes what is drawn here.", file=sys.stderr)
        return 1
    return 0


def figures(course: Path) -> dict[str, Callable[[], Figure | str]]:
    """What makes each figure, by the name of its file: matplotlib's, or SVG."""
    return {
        **drawings(),
        "result": partial(result, course),
        "reconstruction": partial(reconstruction, course),
        "corners": partial(corners, course),
        "residuals": partial(of_report, course, "Mean residual over the image"),
        "uncertainty": partial(of_report, course, "Projection uncertainty"),
        "gyroscope": partial(gyroscope, course),
    }


def write_figure(figure: Figure | str, name: str) -> Path:
    """Write a figure beside the pages: SVG as it is, matplotlib's as a PNG with a palette."""
    if isinstance(figure, str):
        path, content = FIGURES / f"{name}.svg", figure.encode()
    else:
        buffer, small = io.BytesIO(), io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI)
        Image.open(buffer).convert("RGB").quantize(_COLOURS).save(small, "png", optimize=True)
        path, content = FIGURES / f"{name}.png", small.getvalue()
    if len(content) > _MOST_BYTES:
        raise jaxcal.CalibrationError(f"{path}: {len(content)} bytes; figures are kept under {_MOST_BYTES}.")
    write_bytes(path, content)
    return path


# --- figures from the course -----------------------------------------------------------------------------------------


def result(course: Path) -> Figure:
    """What comes out, in three panels."""
    figure = Figure(figsize=(10.5, 3.1), layout="constrained")
    frame, lens, imu = figure.subplots(1, 3, width_ratios=(1.0, 1.12, 1.15))
    _frame_with_corners(frame, course, 0.75)
    frame.set_title("events to a frame, and its corners", fontsize=9, color=INK)
    calibration = jaxcal.load_calibration(course / "out")
    _uncertainty(lens, calibration)
    _gyroscope(imu, calibration)
    return figure


def reconstruction(course: Path) -> Figure:
    """The first frame, and later ones, with the corners found in them."""
    figure = Figure(figsize=(9.0, 2.5), layout="constrained")
    for axes, part in zip(figure.subplots(1, 3), (0.0, 0.4, 0.9), strict=True):
        _frame_with_corners(axes, course, part)
    return figure


def corners(course: Path) -> Figure:
    """All corners of the real camera over its image, coloured by time."""
    found = jaxcal.Detections.load(course / "cam0.npz")
    width, height = found.image_size
    figure = Figure(figsize=(5.4, 3.9), layout="constrained")
    axes = figure.subplots()
    seconds = (found.timestamps_ns[found.frame] - found.timestamps_ns[0]) * 1e-9
    shown = axes.scatter(*found.pixels[::3].T, c=seconds[::3], s=1.5, cmap="viridis", linewidths=0)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u [px]", ylabel="v [px]")
    figure.colorbar(shown, ax=axes, label="time [s]", shrink=0.85)
    return figure


def gyroscope(course: Path) -> Figure:
    """The IMU's readings beside the estimated motion."""
    figure = Figure(figsize=(6.0, 3.0), layout="constrained")
    _gyroscope(figure.subplots(), jaxcal.load_calibration(course / "out"))
    return figure


def of_report(course: Path, title: str) -> str:
    """A figure of the report, on white paper."""
    calibration = jaxcal.load_calibration(course / "out")
    camera = calibration.cameras[0]
    projection = projection_uncertainty(calibration, camera.name)
    residuals = residual_pictures(camera, calibration.target, "docs")
    pictures = camera_pictures(camera, projection, residuals, "docs")
    found = {picture.title: picture.svg for picture in pictures}
    if title not in found:
        raise jaxcal.CalibrationError(f"the report has no figure '{title}'; it has {', '.join(found)}.")
    svg = re.sub(r"var\((--[a-z-]+)\)", lambda match: _LIGHT[match.group(1)], found[title])
    box = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)
    assert box is not None
    size = f'width="{4 * float(box[1]) / 3:.0f}" height="{4 * float(box[2]) / 3:.0f}" style="background: white"'
    return svg.replace("<svg", f"<svg {size}", 1)


# --- parts -----------------------------------------------------------------------------------------------------------


def _frame_with_corners(axes: Axes, course: Path, part: float) -> None:
    """A reconstructed frame at this part of the simulated recording."""
    frames, found = load_frames(course / "frames"), jaxcal.Detections.load(course / "frames.npz")
    number = round(part * (len(frames) - 1))
    mine = found.frame == np.searchsorted(found.timestamps_ns, frames.timestamps_ns[number])
    axes.imshow(frames.images[number], cmap="gray", vmin=0, vmax=255)
    axes.plot(*found.pixels[mine].T, "+", color="#ff6a3d", markersize=5.0, markeredgewidth=1.0)
    axes.set_axis_off()
    seconds = (frames.timestamps_ns[number] - frames.timestamps_ns[0]) * 1e-9
    axes.set_title(f"frame {number}, {seconds:.2f} s after the first: {int(mine.sum())} corners", fontsize=9, color=INK)


def _uncertainty(axes: Axes, calibration: jaxcal.Calibration) -> None:
    camera = calibration.cameras[0]
    found = projection_uncertainty(calibration, camera.name)
    width, height = camera.image_size
    top = float(np.quantile(found.sigma_px[np.isfinite(found.sigma_px)], 0.95))
    shown = axes.pcolormesh(
        found.pixels[0, :, 0], found.pixels[:, 0, 1], found.sigma_px, cmap="viridis", vmin=0.0, vmax=top
    )
    axes.contour(found.pixels[0, :, 0], found.pixels[:, 0, 1], found.observed.astype(float), [0.5], colors="white")
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xticks=[], yticks=[])
    axes.set_title("how far corner noise moves a projection", fontsize=9, color=INK)
    bar = axes.figure.colorbar(shown, ax=axes, shrink=0.75, extend="max")
    bar.set_label("1-sigma [px]", fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _gyroscope(axes: Axes, calibration: jaxcal.Calibration) -> None:
    imu = calibration.imu
    assert imu is not None
    middle = len(imu.t_s) // 2
    part = slice(middle - 200, middle + 200)
    for k, (name, colour) in enumerate(zip("xyz", ("#c8402f", "#2f8f4e", ACCENT), strict=True)):
        axes.plot(imu.t_s[part], imu.gyro_rad_s[part, k], ".", color=colour, markersize=1.8)
        axes.plot(imu.t_s[part], imu.gyro_predicted[part, k], color=colour, linewidth=0.9, label=name)
    axes.set_title("gyroscope (dots) and the estimated motion", fontsize=9, color=INK)
    axes.set_xlabel("time [s]", fontsize=8)
    axes.set_ylabel("rad/s", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7, frameon=False, ncols=3)


if __name__ == "__main__":
    sys.exit(main())
