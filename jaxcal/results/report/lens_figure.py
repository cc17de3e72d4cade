"""The figure of a lens: the angle at which each pixel looks, and where a straight lens would have put it."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from jaxcal.results.calibration import CameraCalibration
from jaxcal.results.rays import look_through
from jaxcal.results.report.drawing import ACCENT, INK, MUTED, Picture, image_panel, note, nothing_to_show, to_svg

_GRID = (48, 36)
_ARROWS = (12, 9)
# Further from the axis a pinhole's image runs off to infinity, and arrows to it say nothing.
_WIDEST_ARROW_DEG = 60.0


def lens_picture(camera: CameraCalibration, prefix: str) -> Picture:
    """Contours of the angle off the axis every few degrees, and arrows of the distortion; `prefix` is unique."""
    figure, axes = image_panel(camera.image_size)
    pixels, angle, pinhole = _looked(camera)
    told = "The lens has no ray for any pixel."
    if np.isfinite(angle).any():
        shift = np.linalg.norm(pixels - pinhole, axis=-1)
        _draw_angles(axes, pixels, angle)
        rows = np.linspace(0, _GRID[1] - 1, _ARROWS[1]).round().astype(int)
        columns = np.linspace(0, _GRID[0] - 1, _ARROWS[0]).round().astype(int)
        at, start = pixels[np.ix_(rows, columns)], pinhole[np.ix_(rows, columns)]
        shown = np.degrees(angle[np.ix_(rows, columns)]) < _WIDEST_ARROW_DEG
        arrows = np.where(shown[..., None], at - start, 0.0)[shown]
        axes.quiver(
            start[shown][:, 0], start[shown][:, 1], arrows[:, 0], arrows[:, 1],
            angles="xy", scale_units="xy", scale=1.0, color=ACCENT, width=0.004,
        )  # fmt: skip
        finite = np.isfinite(angle)
        told = (
            f"Contours: degrees off the optical axis, {np.degrees(angle[finite].max()):.0f}° at most. Arrows: from "
            f"where a pinhole with the same centre would put a point to where this lens does"
        )
        near = shift[np.degrees(np.where(finite, angle, np.inf)) < _WIDEST_ARROW_DEG]
        told += f", up to {near.max():.1f} px within {_WIDEST_ARROW_DEG:.0f}°." if len(near) else "."
        if not finite.all():
            note(axes, f"{100.0 * np.mean(~finite):.0f} % of the image has no ray")
    else:
        nothing_to_show(axes, "no rays")
    return Picture(
        "Lens",
        to_svg(figure, prefix),
        told,
        "round, evenly spaced contours over the whole image, and arrows that grow smoothly towards the rim.",
        "contours that bend or bunch up in a corner follow from too few corners there: a polynomial that nothing held.",
    )


def _looked(camera: CameraCalibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (ny, nx, 2), the angle of their rays off the axis (ny, nx) in rad, NaN without a ray, and where a pinhole
    with the lens's central focal lengths would have them (ny, nx, 2)."""
    width, height = camera.image_size
    nx, ny = _GRID
    pixels = np.stack(np.meshgrid(np.linspace(0, width - 1.0, nx), np.linspace(0, height - 1.0, ny)), axis=-1)
    look = look_through(camera.model, pixels.reshape(-1, 2))
    rays, valid = look.rays, look.valid & np.isfinite(look.rays).all(axis=1)
    angle = np.where(valid, np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), np.nan)
    ahead = np.where((rays[:, 2] > 1e-3)[:, None], rays[:, :2] / np.maximum(rays[:, 2:], 1e-3), np.nan)
    return pixels, angle.reshape(ny, nx), (ahead @ look.scale.T + look.centre).reshape(ny, nx, 2)


def _draw_angles(axes: Axes, pixels: np.ndarray, angle: np.ndarray) -> None:
    degrees = np.ma.masked_invalid(np.degrees(angle))
    step = 5.0 if float(degrees.max()) < 35.0 else 10.0 if float(degrees.max()) < 90.0 else 20.0
    levels = np.arange(step, float(degrees.max()), step)
    if len(levels):
        x, y = pixels[0, :, 0], pixels[:, 0, 1]
        lines = axes.contour(x, y, degrees, levels=levels, colors=[MUTED], linewidths=0.9)
        axes.clabel(lines, fmt=FuncFormatter(lambda value, _: f"{value:g}°"), fontsize=7.5, colors=[INK])
