"""`jaxcal validate`: whether a calibration still holds on a new recording."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jaxcal.cli.outcome import FINE, NOT_GOOD
from jaxcal.cli.sizes import Size

if TYPE_CHECKING:
    from jaxcal.calibration.validate import Validation
    from jaxcal.recording import Rig
    from jaxcal.results import Calibration
    from jaxcal.targets import Target


@click.command(epilog="Exit codes: 0 it holds; 1 it cannot be told, said on stderr; 2 wrong usage; 3 it does not hold.")
@click.argument("calibration", metavar="CALIBRATION", type=click.Path(path_type=Path))
@click.argument("recordings", metavar="RECORDING...", nargs=-1, required=True)
@click.option(
    "--target",
    "target_file",
    type=click.Path(dir_okay=False, path_type=Path),
    help="target.yaml of the board recorded, where it is not the calibration's own.",
)
@click.option(
    "--sync-tolerance", type=float, default=2.0, show_default=True, help="Frames this close are one view; ms."
)
@click.option("--resolution", type=Size(), help="Image size of corner tables that do not hold it.")
@click.option("--from-to", nargs=2, type=float, metavar="START END", help="Use this part only; s after the start.")
@click.option("--rate", type=float, help="Use at most so many images a second.")
@click.option("--workers", type=int, help="Processes for detection (one per core).")
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
@click.pass_context
def validate(
    ctx: click.Context, calibration: Path, recordings: tuple[str, ...], target_file: Path | None, **given: Any
) -> None:
    """Say whether a calibration still holds, on a recording that it was not made from.

    \b
    jaxcal validate result/ today/left/ today/right/
    jaxcal validate result/ today/rig.yaml --json
    jaxcal validate kalibr-camchain.yaml check.bag:/cam0/image_raw --target board.yaml --rate 4

    CALIBRATION is a folder of jaxcal's, or a file of any format that `jaxcal convert calibration` reads. RECORDINGs
    are one per camera, as for `jaxcal calibrate-cameras`, or one rig.yaml. Twenty views of the board all over the
    image will do.

    Lenses and the cameras' poses to each other are held; only where the board stood is estimated. Errors are compared
    with those of the calibration itself: a lens that was touched shows in each camera alone, a camera that was
    knocked in the cameras together.
    """
    import platformdirs

    from jaxcal import load_target
    from jaxcal.calibration.validate import validate as validate_calibration
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.pipeline import detect_rig

    stated = None if target_file is None else load_target(target_file)
    known = _calibration(ctx, calibration, recordings, stated)
    rig = _rig(ctx, known, recordings, stated, given)
    if rig.target != known.target:
        known = replace(known, target=rig.target, target_shape=None)
    cache = Path(platformdirs.user_cache_dir("jaxcal")) / "validate"
    with ProgressBars() as bars:
        detections, _ = detect_rig(rig, cache, workers=given["workers"], progress=bars)
    outcome = validate_calibration(known, detections, sync_tolerance_s=1e-3 * given["sync_tolerance"])
    if given["as_json"]:
        click.echo(json.dumps(asdict(outcome) | {"good": outcome.good, "headline": outcome.headline}, indent=2))
    else:
        click.echo("\n".join(_lines(outcome)))
    ctx.exit(FINE if outcome.good else NOT_GOOD)


def _calibration(ctx: click.Context, path: Path, recordings: tuple[str, ...], stated: "Target | None") -> "Calibration":
    """The calibration, for the board that was recorded."""
    from jaxcal.recording import load_rig
    from jaxcal.results import Calibration
    from jaxcal.results.interchange import bare_calibration, load_calibration_or_rig

    found = load_calibration_or_rig(path)
    if isinstance(found, Calibration):
        return found if stated is None else replace(found, target=stated, target_shape=None)
    if stated is None and _is_rig(recordings):
        stated = load_rig(recordings[0]).target
    if stated is None:
        raise click.UsageError(f"{path} does not say which board to look for; give --target board.yaml.", ctx)
    return bare_calibration(found, stated)


def _rig(
    ctx: click.Context,
    known: "Calibration",
    recordings: tuple[str, ...],
    stated: "Target | None",
    given: dict[str, Any],
) -> "Rig":
    """The recordings as a rig, whose cameras are named as the calibration's."""
    from jaxcal.cameras import model_name
    from jaxcal.cli.calibrate_cameras import named_camera
    from jaxcal.recording import Rig, load_rig

    part: dict[str, Any] = {"from_to": given["from_to"], "frame_rate_hz": given["rate"]}
    if _is_rig(recordings):
        rig = load_rig(recordings[0])
        changed = {key: value for key, value in part.items() if value is not None}
        return replace(rig, target=stated or rig.target, **changed)
    if len(recordings) != len(known.cameras):
        raise click.UsageError(
            f"{len(recordings)} recordings for {len(known.cameras)} cameras; give one each, or a rig.yaml.", ctx
        )
    cameras = tuple(
        named_camera(source, given["resolution"], {"name": camera.name, "model": model_name(camera.model)})
        for source, camera in zip(recordings, known.cameras, strict=True)
    )
    return Rig(path=Path(), target=known.target, cameras=cameras, **part)


def _is_rig(recordings: tuple[str, ...]) -> bool:
    return len(recordings) == 1 and Path(recordings[0]).suffix in (".yaml", ".yml")


def _lines(outcome: "Validation") -> list[str]:
    lines = []
    for camera in outcome.cameras:
        own = "" if camera.own_px is None else f" ({camera.own_px:.3f} in its own calibration)"
        together = f", {camera.together_px:.3f} with the others" if len(outcome.cameras) > 1 else ""
        lines.append(
            f"{camera.name}: {camera.alone_px:.3f} px rms by itself{together}{own}; {camera.corners:,} corners in "
            f"{camera.frames} frames, {100 * camera.outliers:.1f} % of them far off"
        )
    for pose in outcome.poses:
        lines.append(
            f"{pose.name}: {pose.turn_deg:.3f} +- {pose.turn_error_deg:.3f} deg and {1e3 * pose.shift_m:.2f} +- "
            f"{1e3 * pose.shift_error_m:.2f} mm from where it stood, in {pose.views} shared views"
        )
    if len(outcome.cameras) > 1 and not outcome.poses:
        lines.append("the cameras share too few views: whether they have moved cannot be told")
    return [*lines, *(f"finding: {text}" for text in outcome.findings), f"verdict: {outcome.headline}"]
