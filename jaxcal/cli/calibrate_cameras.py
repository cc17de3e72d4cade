"""`jaxcal calibrate-cameras`: images or corner tables in, a calibration and its report out."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

if TYPE_CHECKING:
    from jaxcal.estimation import Loss
    from jaxcal.observations import Detections, Frames
    from jaxcal.progress import Progress
    from jaxcal.targets import Target

# Images that carry no time are taken this far apart.
_STEP_NS = 100_000_000


class _Size(click.ParamType):
    """An image size such as 752x480."""

    name = "WIDTHxHEIGHT"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        match = re.fullmatch(r"(\d+)x(\d+)", value)
        if match is None:
            self.fail(f"'{value}' is no size such as 752x480", param, ctx)
        return int(match[1]), int(match[2])


@click.command("calibrate-cameras")
@click.argument("sources", nargs=-1, required=True, metavar="CAMERA...")
@click.option(
    "--target", "target_file", required=True, type=click.Path(dir_okay=False, path_type=Path), help="target.yaml"
)
@click.option("--models", multiple=True, help="Lens model; once for all cameras, or once per camera (pinhole-radtan).")
@click.option("--views", type=int, help="Use only so many views, those that tell most.")
@click.option("--board-warp", is_flag=True, help="Estimate how the board is bent.")
@click.option("--point-offsets", type=float, help="Let each point of the board be off its place by about so much; mm.")
@click.option(
    "--time-offsets", is_flag=True, help="Cameras are not synchronised: estimate a time offset each (moving pictures)."
)
@click.option(
    "--rolling-shutter", is_flag=True, help="Rows are seen one after another: estimate the delay (moving pictures)."
)
@click.option("--loss", default="huber", show_default=True, help="Robust loss under which outliers are found.")
@click.option("--resolution", type=_Size(), help="Image size of corner tables that do not hold it.")
@click.option(
    "--sync-tolerance", type=float, default=2.0, show_default=True, help="Frames this close are one view; ms."
)
@click.option("--workers", type=int, help="Processes for detection (one per core).")
@click.option("--out", required=True, type=click.Path(file_okay=False, path_type=Path), help="Folder for the results.")
def calibrate_cameras(
    sources: tuple[str, ...],
    target_file: Path,
    models: tuple[str, ...],
    views: int | None,
    board_warp: bool,
    point_offsets: float | None,
    time_offsets: bool,
    rolling_shutter: bool,
    loss: str,
    resolution: tuple[int, int] | None,
    sync_tolerance: float,
    workers: int | None,
    out: Path,
) -> None:
    """Calibrate cameras from what each of them saw of a board.

    \b
    A CAMERA is one of
        a folder of images        EuRoC/ASL (data.csv and data/), or <time in ns>.png
        a pattern of file names   'left*.jpg', quoted; the number in each name stands for its time
        corners.npz               what jaxcal detected, or a corner table: corners.npz:cam0 takes its columns cam0_*

    \b
    jaxcal calibrate-cameras left/ right/ --target board.yaml --models pinhole-radtan --out result
    jaxcal calibrate-cameras 'calib/left*.jpg' 'calib/right*.jpg' --target board.yaml --out result
    jaxcal calibrate-cameras corners.npz:cam0 --resolution 752x480 --target board.yaml --views 50 --out result

    The folder gets camchain.yaml (Kalibr's format), report.html and everything needed to look closer; detections are
    kept there, so that a second run is quick.
    """
    import jaxcal
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.results import results_text, write_report

    if models and len(models) not in (1, len(sources)):
        raise click.UsageError(f"{len(models)} --models for {len(sources)} cameras; give one for all, or one each.")
    target = jaxcal.load_target(target_file)
    names = [f"cam{number}" for number in range(len(sources))]
    chosen = list(models) * len(sources) if len(models) == 1 else list(models) or ["pinhole-radtan"] * len(sources)
    for model in chosen:
        jaxcal.camera_model(model)  # an unknown name is reported now, not after minutes of detection
    with ProgressBars() as bars:
        images, corners = {}, []
        for name, source in zip(names, sources, strict=True):
            frames, detections = _camera(name, source, target, resolution, workers, out, bars)
            corners.append(detections)
            if frames is not None:
                images[name] = frames
        calibration = jaxcal.calibrate_cameras(
            corners,
            target,
            chosen,
            names=names,
            sync_tolerance_s=1e-3 * sync_tolerance,
            views=views,
            board_warp=board_warp,
            point_offset_sigma_m=None if point_offsets is None else 1e-3 * point_offsets,
            time_offsets=time_offsets,
            rolling_shutter=rolling_shutter,
            loss=cast("Loss", loss),
            progress=bars,
        )
        calibration.save(out)
        write_report(calibration, out / "report.html", images=images, progress=bars)
    click.echo(results_text(calibration))
    for warning in calibration.warnings:
        click.echo(f"warning: {warning}")
    click.echo(f"report: {(out / 'report.html').resolve()}")


def _camera(
    name: str,
    source: str,
    target: "Target",
    resolution: tuple[int, int] | None,
    workers: int | None,
    out: Path,
    progress: "Progress",
) -> "tuple[Frames | None, Detections]":
    """The corners of one camera, and its images where there are any."""
    from jaxcal import detect
    from jaxcal.recording import load_detections

    table = re.fullmatch(r"(.*\.npz)(?::(\w+))?", source)
    if table is not None:
        return None, load_detections(table[1], target, resolution, table[2] or name)
    frames = _frames(source)
    return frames, detect(frames, target, workers=workers, cache=out / "cache", progress=progress, name=name)


def _frames(source: str) -> "Frames":
    """The images of a folder, or of a pattern of file names with the number in each name for a time."""
    import glob

    import numpy as np

    from jaxcal.errors import CalibrationError
    from jaxcal.observations import Frames
    from jaxcal.recording import ImageFiles, load_frames
    from jaxcal.recording.images import read_grey

    if not glob.has_magic(source):
        return load_frames(source)
    numbered: dict[int, Path] = {}
    for path in sorted(Path(found) for found in glob.glob(source)):
        digits = re.findall(r"\d+", path.stem)
        if not digits:
            raise CalibrationError(f"{path}: no number in the name; images of one moment are matched by it. Rename it.")
        number = int(digits[-1])
        if number in numbered:
            raise CalibrationError(f"{path}: has the number of {numbered[number]}. Give a narrower pattern.")
        numbered[number] = path
    if not numbered:
        raise CalibrationError(f"{source}: no such images. Quote the pattern, and check the folder.")
    numbers = sorted(numbered)
    height, width = read_grey(numbered[numbers[0]]).shape
    paths = tuple(numbered[number] for number in numbers)
    # Numbers that are times in nanoseconds already stay what they are.
    step = 1 if numbers[-1] > 10**12 else _STEP_NS
    return Frames(np.array(numbers, np.int64) * step, ImageFiles(paths, (width, height)), (width, height))
