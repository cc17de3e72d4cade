"""`jaxcal compare`: how far two calibrations are apart, in pixels and in sigmas."""

import json
from pathlib import Path

import click


@click.command()
@click.argument("first", metavar="A", type=click.Path(path_type=Path))
@click.argument("second", metavar="B", type=click.Path(path_type=Path))
@click.option(
    "--range",
    "ranges",
    multiple=True,
    type=float,
    help="Distance of the points projected, m (inf: directions); may be repeated. By default where corners were seen.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Draw it: out.png, .svg or .pdf.")
def compare(first: Path, second: Path, ranges: tuple[float, ...], as_json: bool, plot: Path | None) -> None:
    """Say whether two calibrations are the same, and by how much they are not.

    \b
    jaxcal compare monday/ tuesday/
    jaxcal compare result/ kalibr-camchain.yaml --plot difference.png
    jaxcal compare a/ b/ --range 0.5 --range 2 --range inf --json

    A and B are folders of jaxcal's, or files of any format that `jaxcal convert calibration` reads. Lenses are compared
    by what they do: the projections of one are compared with the other's over the image and over range, after the
    move of the camera that explains most of the difference is taken out, and held against what the noise of the
    corners explains. Parameters are compared in combined sigmas.
    """
    from jaxcal.errors import CalibrationError
    from jaxcal.results.compare import compare as compare_calibrations
    from jaxcal.results.interchange import load_calibration_or_rig

    if plot is not None and plot.suffix not in (".png", ".svg", ".pdf"):
        raise CalibrationError(f"{plot}: pictures end in .png, .svg or .pdf. Name it so.")
    one, other = load_calibration_or_rig(first), load_calibration_or_rig(second)
    difference = compare_calibrations(one, other, ranges_m=ranges or None)
    if plot is not None:
        from jaxcal.results.compare_figure import write_comparison_figure

        write_comparison_figure(difference, plot)
    if as_json:
        click.echo(json.dumps(difference.to_json(), indent=2))
        return
    click.echo(difference.text(), nl=False)
    if plot is not None:
        click.echo(f"{plot}: written")
