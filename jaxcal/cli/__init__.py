"""The `jaxcal` command: one file per subcommand, heavy imports inside them so that help comes at once."""

import atexit
import difflib
import gc
from typing import Any

import click

from jaxcal.cli.calibrate import calibrate
from jaxcal.cli.calibrate_cameras import calibrate_cameras
from jaxcal.cli.calibrate_imu_camera import calibrate_imu_camera
from jaxcal.cli.compare import compare
from jaxcal.cli.convert import convert
from jaxcal.cli.convert_calibration import convert_calibration
from jaxcal.cli.cross_validate import cross_validate
from jaxcal.cli.detect import detect
from jaxcal.cli.imu_noise import imu_noise
from jaxcal.cli.info import info
from jaxcal.cli.init import init
from jaxcal.cli.outcome import EXIT_CODES, IMPOSSIBLE
from jaxcal.cli.reconstruct import reconstruct
from jaxcal.cli.report import report
from jaxcal.cli.study import study
from jaxcal.cli.target import target
from jaxcal.cli.validate import validate
from jaxcal.errors import CalibrationError

_HELP = """Calibrate cameras, event cameras and IMUs; no initial guess is needed.

\b
1. Print a board (board.pdf, and board.yaml that describes it), and measure it:
    jaxcal target --type aprilgrid --rows 6 --cols 6 --size 0.03 --spacing 0.3 --out board.pdf

\b
2. Record it from many sides, near and far, up to the image's corners; see what was recorded:
    jaxcal info recording.raw
    jaxcal detect cam0/ --target board.yaml --out cam0.npz --plot cam0.png
    jaxcal reconstruct recording.raw --output frames/

\b
3. With an IMU: learn its noise from a recording of it lying still:
    jaxcal imu-noise still.csv --out imu.yaml --plot allan.png

\b
4. Let the rig be described by what is in the folder, and calibrate it:
    jaxcal init recording/
    jaxcal calibrate recording/rig.yaml --output result/

\b
   or cameras alone, without a rig.yaml; or as you did it with Kalibr:
    jaxcal calibrate-cameras left/ right/ --target board.yaml --models pinhole-radtan --out result/
    jaxcal calibrate-imu-camera --bag imucam.bag --cam camchain.yaml --imu imu.yaml --target board.yaml

\b
5. Read result/report.html, which opens with a verdict; write it anew with other pictures:
    jaxcal report result/ --images cam0=left/

\b
6. Later: does it still hold? Is it last month's?
    jaxcal validate result/ today/left/ today/right/
    jaxcal compare result/ last_month/ --plot difference.png

\b
7. Hand it to another tool, or use another lens model and see what that costs:
    jaxcal convert calibration result/ basalt.json --format basalt
    jaxcal convert camera result/camchain.yaml --to ds-none --out double_sphere.yaml

Lengths are metres. Every command says more with --help. Progress is shown on terminals only; --json is for scripts.
"""


class _Commands(click.Group):
    """A group of commands that ends in a message, not in a traceback, when the input makes a calibration impossible."""

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """As click's, with the nearest command's name where one is mistyped."""
        name = args[0] if args else ""
        if name and not name.startswith("-") and self.get_command(ctx, name) is None:
            close = difflib.get_close_matches(name, self.list_commands(ctx), n=1)
            hint = f" Did you mean '{close[0]}'?" if close else ""
            raise click.UsageError(f"No such command '{name}'.{hint}", ctx)
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; a CalibrationError becomes one line on stderr and exit code 1."""
        try:
            return super().invoke(ctx)
        except CalibrationError as error:
            click.echo(f"error: {error}", err=True)
            ctx.exit(IMPOSSIBLE)


@click.group(cls=_Commands, help=_HELP, epilog=EXIT_CODES, context_settings={"max_content_width": 110})
@click.version_option(package_name="jaxcal")
def main() -> None:
    """The command line."""
    # At its end Python looks for cycles in all that jax and the others have brought: half a second after the result.
    atexit.register(gc.freeze)


main.add_command(target)
convert.add_command(convert_calibration)
main.add_command(convert)
main.add_command(info)
main.add_command(imu_noise)
main.add_command(init)
main.add_command(detect)
main.add_command(calibrate)
main.add_command(calibrate_cameras)
main.add_command(calibrate_imu_camera)
main.add_command(validate)
main.add_command(compare)
main.add_command(reconstruct)
main.add_command(cross_validate)
main.add_command(report)
main.add_command(study)
