"""`jaxcal report`: the report of a calibration that was saved, anew."""

import contextlib
import gc
from collections.abc import Iterator
from pathlib import Path

import click

from jaxcal.child import Child, python_child, usable_cores
from jaxcal.cli.outcome import RERUN_FILE


@click.command()
@click.argument("result", type=click.Path(path_type=Path))
@click.option(
    "--images",
    "sources",
    multiple=True,
    metavar="NAME=FOLDER",
    help="Pictures of a camera, to show its corners on: cam0=left/; may be repeated.",
)
@click.option(
    "--out",
    "--output",
    "-o",
    type=click.Path(dir_okay=False, path_type=Path),
    help="File to write (RESULT/report.html).",
)
@click.option("--rerun", type=RERUN_FILE, help="Write a log for the Rerun viewer, too: out.rrd (jaxcal[rerun]).")
def report(result: Path, sources: tuple[str, ...], out: Path | None, rerun: Path | None) -> None:
    """Write the report of a saved calibration, one HTML page that needs nothing else.

    \b
    jaxcal report result/
    jaxcal report result/ --images cam0=left/ --images cam1=right/ --out for_the_lab.html
    jaxcal report result/ --rerun result.rrd && rerun result.rrd

    RESULT is a folder of jaxcal's, or its calibration.npz. A calibration does not hold pictures: without --images the
    page shows none. What `jaxcal cross-validate RESULT` found is shown, too.
    """
    with _garbage_left(), _helper() as helper:
        _report(result, sources, out, rerun, helper)


@contextlib.contextmanager
def _garbage_left() -> Iterator[None]:
    """No search for garbage, which takes a second in ten through all that jax and the figures hold: not meanwhile, nor
    afterwards in what is here now. The process ends after one page."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


@contextlib.contextmanager
def _helper() -> Iterator[Child | None]:
    """A process to draw some of the figures, started first: its libraries load while ours do. None on one core."""
    with python_child("jaxcal.results.report.helper") if usable_cores() > 1 else contextlib.nullcontext() as helper:
        yield helper


def _report(result: Path, sources: tuple[str, ...], out: Path | None, rerun: Path | None, helper: Child | None) -> None:
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.errors import CalibrationError
    from jaxcal.recording import load_frames
    from jaxcal.results import load_calibration, load_cross_validation, write_report
    from jaxcal.results.rerun_file import require_rerun, write_rerun

    if rerun is not None:
        require_rerun(rerun)
    calibration = load_calibration(result)
    names = [camera.name for camera in calibration.cameras]
    images = {}
    for source in sources:
        name, separator, folder = source.partition("=")
        if not separator:
            raise click.UsageError(f"--images {source}: expected NAME=FOLDER, such as cam0=left/.")
        if name not in names:
            raise CalibrationError(f"--images {source}: there is no camera '{name}'; {result} has {', '.join(names)}.")
        images[name] = load_frames(folder)
    folder = result if result.is_dir() else result.parent
    path = out or folder / "report.html"
    with ProgressBars() as bars:
        found = load_cross_validation(folder)
        verdict = write_report(calibration, path, images=images, progress=bars, cross_validation=found, helper=helper)
    if rerun is not None:
        write_rerun(calibration, rerun)
    click.echo(verdict.headline)
    click.echo(f"report: {path.resolve()}")
