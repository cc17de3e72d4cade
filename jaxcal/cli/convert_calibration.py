"""`jaxcal convert calibration`: a result in the files of another tool, and theirs in ours."""

from pathlib import Path

import click

_FORMATS = ("kalibr", "openvins", "vins", "basalt", "ros", "opencv", "colmap")


@click.command("calibration")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.argument("out", metavar="OUT", type=click.Path(path_type=Path))
@click.option("--format", "format", required=True, type=click.Choice(_FORMATS), help="The format of OUT.")
@click.option("--imu", type=click.Path(path_type=Path), help="The IMU's noise, where IN has none: an imu.yaml.")
def convert_calibration(source: Path, out: Path, format: str, imu: Path | None) -> None:
    """Write a calibration in the files of another tool.

    \b
    jaxcal convert calibration result/ basalt.json --format basalt
    jaxcal convert calibration result/ ros/ --format ros
    jaxcal convert calibration calibration.json camchain-imucam.yaml --format kalibr
    jaxcal convert calibration camchain-imucam.yaml openvins/ --imu imu.yaml --format openvins

    IN is a folder of jaxcal's, or a file or folder of any of these formats; which one is found out from its content.
    OUT is a folder, or the file itself (.yaml, .yml, .json, .txt). What a format cannot hold is said; a lens that it
    cannot hold is refused: `jaxcal convert camera` re-fits it first. Of Kalibr's files, imu.yaml is what Kalibr writes
    and OpenVINS' users start from, imu0.yaml what Kalibr's own --imu reads.
    """
    from dataclasses import replace

    from jaxcal.errors import CalibrationError
    from jaxcal.results.interchange import (
        CalibratedRig,
        load_calibration_or_rig,
        read_calibration,
        rig_of,
        write_calibration,
    )

    found_here = load_calibration_or_rig(source)
    rig = found_here if isinstance(found_here, CalibratedRig) else rig_of(found_here)
    if imu is not None:
        found = read_calibration(imu).imu
        if found is None:
            raise CalibrationError(f"{imu}: describes no IMU. Give the imu.yaml that Kalibr reads or writes.")
        rig = replace(rig, imu=found)
    done = write_calibration(found_here if imu is None else rig, out, format)
    cameras = "1 camera" if len(rig.cameras) == 1 else f"{len(rig.cameras)} cameras"
    click.echo(f"{source}: {rig.format}, {cameras}{'' if rig.imu is None else ' and an IMU'}")
    for path in done.paths:
        click.echo(f"{path}: written")
    for note in done.notes:
        click.echo(f"note: {note}")
