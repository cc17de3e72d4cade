"""The `jaxcal` command: one file per subcommand, heavy imports inside them so that help comes at once."""

from typing import Any

import click

from jaxcal.cli.calibrate import calibrate
from jaxcal.cli.calibrate_cameras import calibrate_cameras
from jaxcal.cli.compare import compare
from jaxcal.cli.convert import convert
from jaxcal.cli.convert_calibration import convert_calibration
from jaxcal.cli.imu_noise import imu_noise
from jaxcal.cli.info import info
from jaxcal.cli.reconstruct import reconstruct
from jaxcal.cli.report import report
from jaxcal.cli.target import target
from jaxcal.errors import CalibrationError

_HELP = """Calibrate cameras, event cameras and IMUs; no initial guess is needed.

\b
Print a board (board.pdf, and board.yaml that describes it):
    jaxcal target --type aprilgrid --rows 6 --cols 6 --size 0.03 --spacing 0.3 --out board.pdf

\b
Record it from many sides, near and far, up to the image's corners; then calibrate two cameras at once:
    jaxcal calibrate-cameras left/ right/ --target board.yaml --models pinhole-radtan --out result

\b
Learn an IMU's noise from a recording of it lying still:
    jaxcal imu-noise still.csv --out imu.yaml --plot allan.png

\b
See what an event recording or a bag holds, and bring it into another format:
    jaxcal info recording.raw
    jaxcal convert events recording.raw events.h5

\b
Make frames from events, in which boards are found as in any camera's:
    jaxcal reconstruct recording.raw --output frames/

\b
Use another lens model afterwards, and see what that costs:
    jaxcal convert camera result/camchain.yaml --to ds-none --out double_sphere.yaml

\b
Hold it against last month's, and hand it to another tool:
    jaxcal compare result/ last_month/ --plot difference.png
    jaxcal convert calibration result/ basalt.json --format basalt

Lengths are metres. Every command says more with --help.
"""


class _Commands(click.Group):
    """A group of commands that ends in a message, not in a traceback, when the input makes a calibration impossible."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except CalibrationError as error:
            click.echo(f"error: {error}", err=True)
            ctx.exit(1)


@click.group(cls=_Commands, help=_HELP, context_settings={"max_content_width": 110})
@click.version_option(package_name="jaxcal")
def main() -> None:
    """The command line."""


main.add_command(target)
convert.add_command(convert_calibration)
main.add_command(convert)
main.add_command(info)
main.add_command(imu_noise)
main.add_command(calibrate)
main.add_command(calibrate_cameras)
main.add_command(compare)
main.add_command(reconstruct)
main.add_command(report)
