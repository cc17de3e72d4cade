"""`jaxcal convert`: a calibrated lens in the form of another model, an event recording in another format."""

from pathlib import Path

import click

from jaxcal.cli.sizes import Size


@click.group()
def convert() -> None:
    """Convert results and recordings into other forms."""


@convert.command()
@click.argument("source", metavar="CALIBRATION", type=click.Path(path_type=Path))
@click.option("--to", "model", required=True, help="The model wanted: a name such as ds-none, or module:Class.")
@click.option("--camera", "cameras", multiple=True, help="Only this camera, such as cam0; may be repeated (all).")
@click.option(
    "--out",
    "--output",
    "-o",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Camchain to write; without it, only the residuals.",
)
def camera(source: Path, model: str, cameras: tuple[str, ...], out: Path | None) -> None:
    """Fit another lens model to calibrated ones, over the whole image, and say how far apart they are.

    \b
    jaxcal convert camera camchain.yaml --to ds-none --out new.yaml
    jaxcal convert camera result/ --to pinhole-equi --camera cam1

    CALIBRATION is a result of jaxcal's or a file of any tool that `jaxcal convert calibration` reads; what --out names
    is a camchain, which that command takes further. The residual is the new model's projection minus the old one's at
    a grid of pixels. Poses between cameras stay as they are. Give uncertainties their due: a calibration with the new
    model itself is better where the residual is not small against the corner noise.
    """
    from jaxcal.atomic import write_bytes
    from jaxcal.cameras import model_name
    from jaxcal.cameras.refit import refit
    from jaxcal.errors import CalibrationError
    from jaxcal.results.interchange import read_calibration
    from jaxcal.results.kalibr import chain_content, model_entry, to_yaml

    chain = read_calibration(source).cameras
    unknown = [name for name in cameras if name not in {entry.name for entry in chain}]
    if unknown:
        known = ", ".join(entry.name for entry in chain)
        raise CalibrationError(f"{source}: there is no camera '{unknown[0]}'; it has {known}.")
    content = chain_content(chain)
    for entry, changed in zip(chain, content.values(), strict=True):
        if cameras and entry.name not in cameras:
            continue
        fitted = refit(entry.model, model, entry.image_size)
        changed |= model_entry(fitted.model)
        note = "" if fitted.share > 0.999 else f" over {100 * fitted.share:.0f} % of the image"
        click.echo(
            f"{entry.name}: {model_name(entry.model)} -> {model_name(fitted.model)}: {fitted.rms_px:.4f} px rms, "
            f"{fitted.max_px:.4f} px at most{note}"
        )
    if out is not None:
        write_bytes(out, to_yaml(content).encode())
        click.echo(f"{out}: written")


@convert.command()
@click.argument("source", metavar="IN")
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--resolution", type=Size(), help="Size of the sensor, where the file does not tell it.")
@click.option("--sort", "most_late", type=float, help="Sort events that come up to so much too late; ms.")
def events(source: str, out: Path, resolution: tuple[int, int] | None, most_late: float | None) -> None:
    """Write an event recording in another format, in little memory however long it is.

    \b
    jaxcal convert events recording.raw events.h5
    jaxcal convert events drive.bag:/dvs/events events.h5 --resolution 346x260
    jaxcal convert events events.h5 events.txt
    jaxcal convert events shuffled.csv sorted.h5 --sort 100

    IN is any event recording that `jaxcal info` knows. OUT is told by its suffix: .h5 (e2calib's layout: x, y, p and t
    in microseconds; external triggers are kept), .npz, .txt or .csv (t x y p, t in whole microseconds).

    Events out of order or off the sensor are errors. --sort puts them in order: events of a few milliseconds are held
    back and sorted by time.
    """
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.errors import CalibrationError
    from jaxcal.recording import EventFile
    from jaxcal.recording.event_writers import convert_events

    with ProgressBars() as bars, EventFile(source, *(resolution or (None, None))) as recording:
        if out.exists() and out.samefile(recording.path):
            raise CalibrationError(f"{out}: is the recording itself; name another file.")
        most_late_ns = None if most_late is None else round(most_late * 1e6)
        count = convert_events(recording, out, most_late_ns=most_late_ns, progress=bars)
        triggers = 0 if out.suffix.lower() in (".h5", ".hdf5") else len(recording.triggers())
        remarks = recording.remarks()
    click.echo(f"{out}: {count:,} events written")
    for remark in remarks:
        click.echo(f"note: {remark}")
    if triggers:
        click.echo(f"note: {triggers:,} external triggers are not kept in this format; .h5 keeps them")
