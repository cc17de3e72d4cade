"""`jaxcal imu-noise`: an imu.yaml from a recording of the IMU at rest."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from jaxcal.imu.noise import SensorNoise, StillNoise
    from jaxcal.imu.still import StillRecording

_PICTURES = (".png", ".svg", ".pdf")


@click.command("imu-noise")
@click.argument("still")
@click.option(
    "--out", "--output", "-o", type=click.Path(dir_okay=False, path_type=Path), help="Kalibr's imu.yaml to write."
)
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Draw it: allan.png, .svg or .pdf.")
@click.option(
    "--inflate",
    type=click.FloatRange(min=0.0, min_open=True),
    default=1.0,
    show_default=True,
    help="Multiply the densities written by this.",
)
@click.option("--start", type=float, help="Leave out what comes before; s after the first sample.")
@click.option("--stop", type=float, help="Leave out what comes after; s after the first sample.")
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
def imu_noise(
    still: str,
    out: Path | None,
    plot: Path | None,
    inflate: float,
    start: float | None,
    stop: float | None,
    as_json: bool,
) -> None:
    """Tell an IMU's noise from a recording of it at rest, by Allan variance.

    \b
    jaxcal imu-noise still.csv --out imu.yaml --plot allan.png
    jaxcal imu-noise still.bag:/imu0 --out imu.yaml --inflate 2
    jaxcal imu-noise still.csv --start 60 --json

    STILL is a csv as EuRoC's (time in whole ns, gyroscope x y z in rad/s, accelerometer x y z in m/s^2), an npz table,
    or a bag of ROS 1, ROS 2 or mcap (FILE:/topic).

    \b
    How to record:
      - Lay the IMU on something heavy (a stone floor, not a desk with a fan or a keyboard) and walk away. Traffic,
        people and cooling fans show as bumps between 0.01 and 1 s, knocks end in an error.
      - Have it run for half an hour first, away from sun and draught: while it warms up, its biases drift, which
        looks like a random walk that it does not have.
      - 10 minutes tell the noise densities to a few per cent. The random walk shows after much longer, 3 hours for
        most MEMS parts (overnight for good ones). A recording too short says so, and how long would do; the random
        walk in imu.yaml is then a safe upper limit.
      - Record as the calibration will be: same rate, same filters, same range.

    What is printed are noise density (the curve's slope -1/2, read at 1 s), random walk (slope +1/2, read at 3 s) and
    bias instability (its floor), with ranges that hold the truth with 95 %. Moving IMUs are noisier than still
    ones (scale errors, vibration), which is what --inflate is for; `jaxcal`'s own camera-IMU calibration raises the
    noise by itself where the residuals ask for it.
    """
    import json

    from jaxcal.atomic import write_text
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.errors import CalibrationError
    from jaxcal.imu.noise import noise_of_still
    from jaxcal.recording.places import split_place

    if plot is not None and plot.suffix not in _PICTURES:
        raise CalibrationError(f"{plot}: pictures end in .png, .svg or .pdf. Name it so.")
    recording = _read(still, start, stop)
    with ProgressBars() as bars:
        noise = noise_of_still(recording, bars)
    path, topic = split_place(still)
    if out is not None:
        write_text(out, noise.imu_yaml(path.name, topic or "/imu0", inflate))
    if plot is not None:
        from jaxcal.imu.allan_figure import write_allan_figure

        write_allan_figure(noise, plot)
    if as_json:
        click.echo(json.dumps(noise.to_json(inflate), indent=2))
        return
    click.echo("\n".join(_lines(still, noise, inflate)))
    for written in (out, plot):
        if written is not None:
            click.echo(f"{written}: written")


def _read(still: str, start: float | None, stop: float | None) -> "StillRecording":
    """Load, cut and check. Errors name the file."""
    from jaxcal.errors import CalibrationError
    from jaxcal.imu.still import still_recording
    from jaxcal.observations import ImuNoise
    from jaxcal.recording import load_imu

    # The reader wants a noise model, which is what this recording is to tell.
    imu = load_imu(ImuNoise(1.0, 1.0, 1.0, 1.0), still)
    time = (imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9
    kept = (time >= (0.0 if start is None else start)) & (time <= (time[-1] if stop is None else stop))
    if kept.sum() < 2:
        raise CalibrationError(f"{still}: nothing lies between --start and --stop; it lasts {time[-1]:.1f} s.")
    try:
        return still_recording(imu.timestamps_ns[kept], imu.gyro_rad_s[kept], imu.accel_m_s2[kept], time[kept][0])
    except CalibrationError as error:
        raise CalibrationError(f"{still}: {error}") from error


def _lines(still: str, noise: "StillNoise", inflate: float) -> list[str]:
    lines = [f"{still}: {noise.duration_s:.0f} s at {noise.rate_hz:.6g} Hz, still", ""]
    lines.append(f"{'':<19}{'x':>11}{'y':>11}{'z':>11}{'together':>12}  95 % of all together")
    for sensor in (noise.gyroscope, noise.accelerometer):
        lines += [f"{sensor.name}, {sensor.unit}", *_rows(sensor)]
    times = f", times {inflate:g}" if inflate != 1.0 else ""
    lines += ["", f"imu.yaml{times}:"]
    lines += [f"  {key}: {value:g}" for key, value in noise.densities(inflate).items()]
    return lines + [f"note: {text}" for text in noise.notes]


def _rows(sensor: "SensorNoise") -> list[str]:
    rows = []
    for label, whole, axes in (
        ("noise, /sqrt(Hz)", sensor.density, sensor.density_axes),
        ("walk, /s/sqrt(Hz)", sensor.walk, sensor.walk_axes),
        ("bias instability", sensor.floor, sensor.floor_axes),
    ):
        cells = [f"{'' if e.seen else '<'}{e.value:.2e}" for e in (*axes, whole)]
        bounds = f"{whole.low:.2e} to {whole.high:.2e}" if whole.seen else "upper limits: not seen"
        rows.append(f"  {label:<17}{cells[0]:>11}{cells[1]:>11}{cells[2]:>11}{cells[3]:>12}  {bounds}")
    return rows
