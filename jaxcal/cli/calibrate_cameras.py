"""`jaxcal calibrate-cameras`: images, a bag or corner tables in, a calibration and its report out."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jaxcal.cli.kalibr_arguments import SHARED_NOT_NEEDED, VERBOSE, KalibrCommand, Many, all_of, not_needed
from jaxcal.cli.outcome import EXIT_CODES
from jaxcal.cli.sizes import Size

if TYPE_CHECKING:
    from jaxcal.recording import Rig, RigCamera

# Kalibr's tolerance for frames of one moment, where cameras are given its way; s.
_KALIBR_SYNC_S = 0.02

_NOT_NEEDED = all_of(
    SHARED_NOT_NEEDED,
    not_needed("--qr-tol", "no view is judged by a rank; what the views leave open is said in words.", float),
    not_needed("--mi-tol", "all views are used, which is quick; --views N begins with those that tell most.", float),
    not_needed("--no-shuffle", "all views are solved at once: there is no order to shuffle."),
    not_needed("--no-outliers-removal", "corners that disagree are always left out; the report counts them."),
    not_needed("--no-final-filtering", "outliers are found with all views in the solution, not view by view."),
    not_needed("--min-views-outlier", "outliers are found with all views in the solution, not view by view.", int),
    not_needed("--plot-outliers", "the report draws the corners that were left out."),
    not_needed("--plot", "the report draws everything when it is finished."),
)


@click.command("calibrate-cameras", cls=KalibrCommand, epilog=EXIT_CODES)
@click.argument("sources", nargs=-1, metavar="[CAMERA...]")
@click.option(
    "--target", "target_file", required=True, type=click.Path(dir_okay=False, path_type=Path), help="target.yaml"
)
@click.option("--models", cls=Many, help="Lens models; one for all cameras, or one each (pinhole-radtan).")
@click.option("--bag", type=click.Path(path_type=Path), help="Bag, or EuRoC folder, that holds all cameras.")
@click.option("--topics", cls=Many, help="With --bag: the topic of each camera.")
@click.option("--bag-from-to", nargs=2, type=float, metavar="START END", help="Use this part only; s after the start.")
@click.option("--bag-freq", type=float, help="Use at most so many images a second.")
@click.option("--approx-sync", type=float, help="Frames this close are one view; s (with --bag: 0.02).")
@click.option("--sync-tolerance", type=float, help="Frames this close are one view; ms (without --bag: 2).")
@click.option(
    "--views",
    type=int,
    help="Begin with so many views, those that tell most; all others join once the optimum is found. As precise as "
    "without, and quicker where a rich lens takes many steps.",
)
@click.option("--board-warp", is_flag=True, help="Estimate how the board is bent.")
@click.option("--point-offsets", type=float, help="Let each point of the board be off its place by about so much; mm.")
@click.option(
    "--time-offsets", is_flag=True, help="Cameras are not synchronised: estimate a time offset each (moving pictures)."
)
@click.option(
    "--rolling-shutter", is_flag=True, help="Rows are seen one after another: estimate the delay (moving pictures)."
)
@click.option("--loss", default="huber", show_default=True, help="Robust loss under which outliers are found.")
@click.option("--use-blakezisserman", is_flag=True, help="Kalibr's harder loss: as --loss geman-mcclure.")
@click.option("--resolution", type=Size(), help="Image size of corner tables that do not hold it.")
@click.option("--export-poses", is_flag=True, help="Write where the camera stood in each view, as a csv.")
@click.option("--workers", type=int, help="Processes for detection (one per core).")
@click.option(
    "--out",
    "--output",
    "-o",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for the results (with --bag: BAG-jaxcal).",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@VERBOSE
@_NOT_NEEDED
@click.pass_context
def calibrate_cameras(ctx: click.Context, sources: tuple[str, ...], out: Path | None, **given: Any) -> None:
    """Calibrate cameras from what each of them saw of a board.

    \b
    A CAMERA is one of
        a folder of images        EuRoC/ASL (data.csv and data/), <time in ns>.png, or numbered: left01.jpg
        a pattern of file names   'both/left*.jpg', quoted, where a folder holds several cameras' images
        a topic of a bag          drive.bag:/cam0/image_raw
        corners.npz               what jaxcal detected, or a corner table: corners.npz:cam0 takes its columns cam0_*

    \b
    jaxcal calibrate-cameras left/ right/ --target board.yaml --models pinhole-radtan --out result
    jaxcal calibrate-cameras 'calib/left*.jpg' 'calib/right*.jpg' --target board.yaml --out result
    jaxcal calibrate-cameras corners.npz:cam0 --resolution 752x480 --target board.yaml --views 50 --out result

    \b
    Kalibr's own command works with the program's name changed; bags may be of ROS 1, ROS 2 or mcap:
    jaxcal calibrate-cameras --target april.yaml --models pinhole-radtan omni-radtan \\
        --bag cams.bag --topics /cam0/image_raw /cam1/image_raw --bag-from-to 5 60 --dont-show-report

    The folder gets camchain.yaml (Kalibr's format), report.html and everything needed to look closer, and, with --bag,
    Kalibr's files by Kalibr's names (cams-camchain.yaml, cams-results-cam.txt). Detections are kept there, so that a
    second run is quick.
    """
    from jaxcal.cli.kalibr_output import bag_tag, output_folder, write_kalibr_files
    from jaxcal.cli.outcome import show_calibration
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.pipeline import PipelineSettings, run_pipeline

    bag, topics = given["bag"], given["topics"]
    _check_usage(ctx, sources, out, given)
    rig = _rig(sources, given)
    out = out or output_folder(bag)
    settings = PipelineSettings(cache=out / "cache", cameras=_options(given))
    with ProgressBars() as bars:
        calibration = run_pipeline(rig, out, settings=settings, workers=given["workers"], progress=bars)
    files = {}
    if bag is not None:
        files = write_kalibr_files(calibration, out, bag_tag(bag), topics, poses=given["export_poses"])
    elif given["export_poses"]:
        files = write_kalibr_files(calibration, out, "all", [None] * len(rig.cameras), poses=True)
    ctx.exit(show_calibration(calibration, out, as_json=given["as_json"], files=files))


def _check_usage(ctx: click.Context, sources: tuple[str, ...], out: Path | None, given: dict[str, Any]) -> None:
    bag, topics, models = given["bag"], given["topics"], given["models"]
    if (bag is None) != (not topics):
        raise click.UsageError("--bag and --topics belong together: name a topic for each camera.", ctx)
    if bool(sources) == (bag is not None):
        raise click.UsageError("name the cameras, or --bag with --topics, one way or the other.", ctx)
    if bag is None and out is None:
        raise click.UsageError("missing --out, a folder for the results.", ctx)
    count = len(sources) or len(topics)
    if models and len(models) not in (1, count):
        raise click.UsageError(f"{len(models)} --models for {count} cameras; give one for all, or one each.", ctx)
    if given["approx_sync"] is not None and given["sync_tolerance"] is not None:
        raise click.UsageError("--approx-sync (s) and --sync-tolerance (ms) say the same; give one.", ctx)


def _options(given: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `jaxcal.calibrate_cameras`."""
    if given["approx_sync"] is not None:
        tolerance = given["approx_sync"]
    elif given["sync_tolerance"] is not None:
        tolerance = 1e-3 * given["sync_tolerance"]
    else:
        tolerance = 0.002 if given["bag"] is None else _KALIBR_SYNC_S
    offsets = given["point_offsets"]
    return {
        "sync_tolerance_s": tolerance,
        "views": given["views"],
        "board_warp": given["board_warp"],
        "point_offset_sigma_m": None if offsets is None else 1e-3 * offsets,
        "time_offsets": given["time_offsets"],
        "loss": "geman-mcclure" if given["use_blakezisserman"] else given["loss"],
    }


def _rig(sources: tuple[str, ...], given: dict[str, Any]) -> "Rig":
    """What the arguments name, as a rig.yaml would; an unknown model is reported now, not after the files are read."""
    from jaxcal import camera_model, load_target
    from jaxcal.recording import Rig, RigCamera
    from jaxcal.recording.sources import camera_source

    target = load_target(given["target_file"])
    count = len(sources) or len(given["topics"])
    models = list(given["models"] or ["pinhole-radtan"])
    models = models * count if len(models) == 1 else models
    for model in models:
        camera_model(model)
    cameras = []
    for number, model in enumerate(models):
        common: dict[str, Any] = {
            "name": f"cam{number}",
            "model": model,
            "rolling_shutter": given["rolling_shutter"],
        }
        if sources:
            cameras.append(named_camera(sources[number], given["resolution"], common))
        else:
            source = camera_source(given["bag"], given["topics"][number])
            place: dict[str, Any] = {source.kind: source.place}
            cameras.append(RigCamera(**common, **place))
    return Rig(
        path=given["target_file"],
        target=target,
        cameras=tuple(cameras),
        from_to=given["bag_from_to"],
        frame_rate_hz=given["bag_freq"],
    )


def named_camera(source: str, resolution: tuple[int, int] | None, common: dict[str, Any]) -> "RigCamera":
    """A camera by what the command line names: images, or a table of corners with the columns to take."""
    from jaxcal.recording import RigCamera

    table = re.fullmatch(r"(.*\.npz)(?::(\w+))?", source)
    if table is None:
        return RigCamera(**common, frames=Path(source))
    return RigCamera(**common, detections=Path(table[1]), prefix=table[2] or common["name"], resolution=resolution)
