"""`jaxcal cross-validate`: is a calibration's error more than noise, and why?"""

import json
from pathlib import Path

import click

from jaxcal.cli.outcome import EXIT_CODES, NOT_GOOD


@click.command("cross-validate", epilog=EXIT_CODES)
@click.argument("result", type=click.Path(path_type=Path))
@click.option("--no-imu", is_flag=True, help="With an IMU: leave out calibrating both halves of the recording anew.")
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Draw it: out.png, .svg or .pdf.")
def cross_validate(result: Path, no_imu: bool, as_json: bool, plot: Path | None) -> None:
    """Tell errors of the model from noise, from a saved calibration alone, and name the likely cause.

    \b
    jaxcal cross-validate result/
    jaxcal cross-validate result/ --plot halves.png
    jaxcal cross-validate result/ --no-imu --json

    Cameras are calibrated from halves of the views (in turns, in time, near and far), and what the halves say of the
    image is compared with what the noise of the corners explains. Then each likely cause is tested on the residuals,
    and tried on views held back: a lens model too lean, a bent or misprinted board, a rolling shutter taken for global,
    a lens or a camera's place that changed on the way. The outcome is kept beside RESULT, and `jaxcal report RESULT`
    shows it with its map. The exit status is 3 when there is more than noise.
    """
    from jaxcal.calibration import cross_validate as validate
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.errors import CalibrationError
    from jaxcal.results import load_calibration, save_cross_validation

    if plot is not None and plot.suffix not in (".png", ".svg", ".pdf"):
        raise CalibrationError(f"{plot}: pictures end in .png, .svg or .pdf. Name it so.")
    with ProgressBars() as bars:
        found = validate(load_calibration(result), imu_halves=not no_imu, progress=bars)
    folder = result if result.is_dir() else result.parent
    kept = save_cross_validation(found, folder)
    if plot is not None:
        from jaxcal.results.compare_figure import write_comparison_figure

        # The halves that differ most.
        write_comparison_figure(min(found.halves, key=lambda half: half.p_value).difference, plot)
    click.echo(json.dumps(found.to_json(), indent=2) if as_json else found.text().rstrip("\n"))
    if plot is not None and not as_json:
        click.echo(f"{plot}: written")
    if not as_json:
        click.echo(f"{kept}: written; `jaxcal report {result}` shows it")
    if found.flagged:
        raise SystemExit(NOT_GOOD)
