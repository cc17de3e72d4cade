"""`jaxcal detect`: the corners of a board in the images of a camera."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    import numpy as np

    from jaxcal.observations import Detections
    from jaxcal.targets import Target


@click.command()
@click.argument("source", metavar="FRAMES")
@click.option(
    "--target", "target_file", required=True, type=click.Path(dir_okay=False, path_type=Path), help="target.yaml"
)
@click.option(
    "--out",
    "--output",
    "-o",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="File to write, .npz.",
)
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Draw it: out.png, .svg or .pdf.")
@click.option("--from-to", nargs=2, type=float, metavar="START END", help="Use this part only; s after the start.")
@click.option("--rate", type=float, help="Use at most so many images a second.")
@click.option("--workers", type=int, help="Processes (one per core).")
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
def detect(
    source: str,
    target_file: Path,
    out: Path,
    plot: Path | None,
    from_to: tuple[float, float] | None,
    rate: float | None,
    workers: int | None,
    as_json: bool,
) -> None:
    """Find the corners of a board in the images of one camera.

    \b
    jaxcal detect cam0/ --target board.yaml --out cam0.npz --plot cam0.png
    jaxcal detect drive.bag:/cam0/image_raw --target board.yaml --out cam0.npz --from-to 5 60 --rate 4
    jaxcal detect 'left*.jpg' --target board.yaml --out left.npz --json

    FRAMES is a folder (EuRoC/ASL, or <time in ns>.png), a topic of a bag, or a quoted pattern of file names with a
    number in each. The file goes to `jaxcal calibrate-cameras cam0.npz`, or into a rig.yaml as `detections: cam0.npz`.
    Look at --plot before you blame the calibration: corners have to sit on corners, all over the image.

    What was found is kept in .jaxcal/ beside the file: a run that was broken off goes on where it stopped.
    """
    from jaxcal import detect as find_corners
    from jaxcal import load_target
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.errors import CalibrationError
    from jaxcal.recording import load_frames
    from jaxcal.recording.cut import cut_frames

    if out.suffix != ".npz":
        raise CalibrationError(f"{out}: corners are written as .npz. Name it so.")
    if plot is not None and plot.suffix not in (".png", ".svg", ".pdf"):
        raise CalibrationError(f"{plot}: pictures end in .png, .svg or .pdf. Name it so.")
    target = load_target(target_file)
    frames = load_frames(source)
    start = int(frames.timestamps_ns[0])
    span = None if from_to is None else (start + round(from_to[0] * 1e9), start + round(from_to[1] * 1e9))
    frames = cut_frames(frames, span, rate)
    with ProgressBars() as bars:
        cache = out.resolve().parent / ".jaxcal"
        found = find_corners(frames, target, workers=workers, cache=cache, progress=bars, name=out.stem)
    found.save(out)
    if plot is not None:
        from jaxcal.cli.detection_figure import write_detection_figure

        write_detection_figure(found, frames, plot)
    facts = _facts(found, target)
    if as_json:
        files = {"detections": str(out.resolve())} | ({} if plot is None else {"plot": str(plot.resolve())})
        click.echo(json.dumps(facts | {"files": files}, indent=2))
        return
    click.echo(
        f"{out}: the board in {facts['frames_with_board']} of {facts['frames']} frames, "
        f"{facts['corners']:,} corners; {facts['corners_per_frame']:g} of {facts['corners_of_board']} in the middle one"
    )
    click.echo(f"{out}: corners in {100 * facts['image_covered']:.0f} % of the image's cells")
    if plot is not None:
        click.echo(f"{plot}: written")


def _facts(found: "Detections", target: "Target") -> dict[str, Any]:
    import numpy as np

    _, counts = np.unique(found.frame, return_counts=True)
    return {
        "image_size": list(found.image_size),
        "frames": len(found.timestamps_ns),
        "frames_with_board": len(counts),
        "corners": len(found),
        "corners_of_board": len(target.points),
        "corners_per_frame": float(np.median(counts)),
        "image_covered": _covered(found.pixels, found.image_size),
    }


def _covered(pixels: "np.ndarray", image_size: tuple[int, int]) -> float:
    """The share of the image's cells, 8 by 6, that hold a corner."""
    import numpy as np

    cells = np.floor((pixels + 0.5) / np.array(image_size) * [8, 6]).astype(int)
    cells = np.clip(cells, 0, [7, 5])
    return len({(x, y) for x, y in cells.tolist()}) / 48.0
