"""`jaxcal convert`: a calibrated lens in the form of another model."""

from pathlib import Path

import click


@click.group()
def convert() -> None:
    """Convert results into other forms."""


@convert.command()
@click.argument("camchain", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--to", "model", required=True, help="The model wanted: a name such as ds-none, or module:Class.")
@click.option("--camera", "cameras", multiple=True, help="Only this camera, such as cam0; may be repeated (all).")
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), help="Camchain to write; without it, only the residuals."
)
def camera(camchain: Path, model: str, cameras: tuple[str, ...], out: Path | None) -> None:
    """Fit another lens model to calibrated ones, over the whole image, and say how far apart they are.

    \b
    jaxcal convert camera camchain.yaml --to ds-none --out new.yaml
    jaxcal convert camera camchain.yaml --to pinhole-radtan --camera cam1

    The residual is the new model's projection minus the old one's at a grid of pixels. Poses between cameras stay as
    they are. Give uncertainties their due: a calibration with the new model itself is better where the residual is not
    small against the corner noise.
    """
    import yaml

    from jaxcal.atomic import write_bytes
    from jaxcal.cameras import model_name
    from jaxcal.cameras.refit import refit
    from jaxcal.errors import CalibrationError
    from jaxcal.results import load_camchain
    from jaxcal.results.kalibr import model_entry, to_yaml

    chain = load_camchain(camchain)
    unknown = [name for name in cameras if name not in {entry.name for entry in chain}]
    if unknown:
        known = ", ".join(entry.name for entry in chain)
        raise CalibrationError(f"{camchain}: there is no camera '{unknown[0]}'; it has {known}.")
    content = yaml.safe_load(camchain.read_text())
    for entry in chain:
        if cameras and entry.name not in cameras:
            continue
        fitted = refit(entry.model, model, entry.image_size)
        content[entry.name] |= model_entry(fitted.model)
        note = "" if fitted.share > 0.999 else f" over {100 * fitted.share:.0f} % of the image"
        click.echo(
            f"{entry.name}: {model_name(entry.model)} -> {model_name(fitted.model)}: {fitted.rms_px:.4f} px rms, "
            f"{fitted.max_px:.4f} px at most{note}"
        )
    if out is not None:
        write_bytes(out, to_yaml(content).encode())
        click.echo(f"{out}: written")
