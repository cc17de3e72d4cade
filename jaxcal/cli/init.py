"""`jaxcal init`: a rig.yaml for what a folder or a bag holds."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from jaxcal.recording.discover import Found, FoundCamera

_FILL_IN = "FILL IN"


@click.command()
@click.argument("recording", metavar="FOLDER|BAG", type=click.Path(path_type=Path))
@click.option("--target", type=click.Path(dir_okay=False, path_type=Path), help="target.yaml of the board recorded.")
@click.option("--imu", type=click.Path(dir_okay=False, path_type=Path), help="imu.yaml with the IMU's noise.")
@click.option("--model", default="pinhole-radtan", show_default=True, help="Lens model of the cameras.")
@click.option(
    "--out",
    "--output",
    "-o",
    type=click.Path(dir_okay=False, path_type=Path),
    help="File to write (rig.yaml in the folder).",
)
@click.option("--force", is_flag=True, help="Replace the file where it is there already.")
def init(recording: Path, target: Path | None, imu: Path | None, model: str, out: Path | None, force: bool) -> None:
    """Look at a recording and write the rig.yaml for it.

    \b
    jaxcal init recording/                                  recording/rig.yaml, board and imu.yaml found beside it
    jaxcal init drive.bag --target board.yaml --imu imu.yaml --out rig.yaml
    jaxcal init event_camera/ --model pinhole-equi

    Found are folders of images (EuRoC/ASL, or <time in ns>.png, or left01.jpg), event files, the topics of bags, IMU
    tables, corners already detected, and the yaml files of targets and of IMU noise. What cannot be known is a
    comment that says FILL IN. Look the file over, then run `jaxcal calibrate rig.yaml`.
    """
    from jaxcal import camera_model, load_rig
    from jaxcal.atomic import write_text
    from jaxcal.errors import CalibrationError
    from jaxcal.recording.bags import is_bag
    from jaxcal.recording.discover import discover

    camera_model(model)
    found = discover(recording)
    for given in (target, imu):
        if given is not None and not given.exists():
            raise CalibrationError(f"{given}: no such file.")
    if not found.cameras:
        seen = "\n".join(f"  {remark}" for remark in found.remarks)
        raise CalibrationError(f"{recording}: no images, events or corners were found.{seen and chr(10)}{seen}")
    path = out or (recording.parent if is_bag(recording) else recording) / "rig.yaml"
    if path.exists() and not force:
        raise CalibrationError(f"{path}: is there already. --force replaces it; --out names another.")
    targets = [target] if target is not None else found.targets
    noises = [imu] if imu is not None else found.noises
    text = rig_text(found, path.resolve().parent, targets, noises, model, recording)
    write_text(path, text)
    for camera in found.cameras:
        click.echo(f"{camera.name}: {camera.kind}, {camera.facts}")
    for sensor in found.imus:
        click.echo(f"imu: {sensor.facts}")
    for remark in found.remarks:
        click.echo(f"note: {remark}", err=True)
    open_places = [line.strip() for line in text.splitlines() if _FILL_IN in line and not line.startswith("#")]
    if open_places:
        click.echo(f"{path}: written; fill in before you calibrate:")
        for line in open_places:
            click.echo(f"  {line}")
        return
    load_rig(path)
    click.echo(f"{path}: written; look it over, then: jaxcal calibrate {path}")


def rig_text(found: "Found", folder: Path, targets: list[Path], noises: list[Path], model: str, recording: Path) -> str:
    """The rig.yaml, with comments, for what was found; paths are relative to `folder` where they lie near it."""
    lines = [f"# Written by `jaxcal init {recording}`. Look it over, then run: jaxcal calibrate rig.yaml", ""]
    if targets:
        lines.append(f"target: {_place(targets[0], folder)}")
        lines += [f"# target: {_place(other, folder)}    # found as well" for other in targets[1:]]
    else:
        lines.append(f"target: target.yaml    # {_FILL_IN}: the board; `jaxcal target` prints one and writes this file")
    lines += ["", "cameras:"]
    for camera in found.cameras:
        lines += _camera_lines(camera, folder, model)
    lines.append("# Lens models: pinhole-radtan, pinhole-equi (fisheye), omni-radtan, eucm-none, ds-none, and more.")
    lines += ["", *_imu_lines(found, folder, noises)]
    if any(camera.kind == "events" for camera in found.cameras):
        lines += ["", "reconstruction:", "  window_ms: 33    # events of so long a time make one frame"]
    lines += [
        "",
        "# from_to: [5, 60]       # use only this part; seconds after the first frame",
        "# frame_rate_hz: 10      # at most so many images a second",
        "# calibration:           # arguments of the job: `jaxcal calibrate --help` lists them",
    ]
    return "\n".join(lines) + "\n"


def _camera_lines(camera: "FoundCamera", folder: Path, model: str) -> list[str]:
    lines = [
        f"  - name: {camera.name}",
        f"    model: {model}",
        f"    {camera.kind}: {_place(camera.place, folder)}    # {camera.facts}",
    ]
    if camera.prefix and camera.prefix != camera.name:
        lines.append(f"    prefix: {camera.prefix}")
    if camera.unknown_resolution:
        lines.append(f"    resolution: [0, 0]    # {_FILL_IN}: width and height in pixels; the file does not tell")
    if camera.kind == "frames":
        lines.append("    # rolling_shutter: true    # where rows are seen one after another")
    return lines


def _imu_lines(found: "Found", folder: Path, noises: list[Path]) -> list[str]:
    if not found.imus:
        return ["# No IMU was found: the cameras are calibrated alone."]
    lines = ["imus:"]
    for number, sensor in enumerate(found.imus):
        lines.append(f"  - data: {_place(sensor.place, folder)}    # {sensor.facts}")
        if noises:
            lines.append(f"    noise: {_place(noises[min(number, len(noises) - 1)], folder)}")
        else:
            lines.append(
                f"    noise: imu.yaml    # {_FILL_IN}: its noise; `jaxcal imu-noise` makes it from a recording at rest"
            )
        lines.append("    # model: scale-misalignment    # where the IMU's own scales are to be found, too")
    return lines


def _place(path: str | Path, folder: Path) -> str:
    """A path as it stands in the yaml: relative where it lies below or beside the folder, quoted where yaml asks."""
    import json

    whole = os.fspath(path)
    text = os.path.relpath(Path(whole).resolve() if ":" not in whole else whole, folder)
    if text.startswith(os.path.join(os.pardir, os.pardir)):
        text = str(Path(whole).resolve()) if ":" not in whole else whole
    plain = text[:1].isalnum() or text[:1] in "/._"
    return text if plain and not any(mark in text for mark in ("#", ": ", "'", '"')) else json.dumps(text)
