"""The picture of an Allan deviation: the curves of both sensors' axes, and the noise models fitted to them."""

import io
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxcal.atomic import write_bytes
from jaxcal.imu.noise import AXES, SensorNoise, StillNoise

_COLOURS = ("tab:red", "tab:green", "tab:blue")


def write_allan_figure(noise: StillNoise, path: str | Path) -> None:
    """Write a .png (or .svg, .pdf) with one panel per sensor, atomically.

    Dots are measured, lines fitted; the slanted grey lines are what imu.yaml says: noise density (read at 1 s) and
    random walk (read at 3 s; dotted where it is an upper limit).
    """
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    figure.suptitle(f"Allan deviation, {noise.duration_s:.0f} s at {noise.rate_hz:.6g} Hz", fontsize=11.0)
    for axes, sensor in zip(figure.subplots(1, 2), (noise.gyroscope, noise.accelerometer), strict=True):
        _draw(axes, sensor)
    content, path = io.BytesIO(), Path(path)
    figure.savefig(content, format=path.suffix.lstrip(".") or "png", dpi=130)
    write_bytes(path, content.getvalue())


def _draw(axes: Axes, sensor: SensorNoise) -> None:
    tau = sensor.tau_s
    axes.set_xscale("log")
    axes.set_yscale("log")
    for k, (axis, colour) in enumerate(zip(AXES, _COLOURS, strict=True)):
        axes.plot(tau, sensor.deviation[k], ".", color=colour, markersize=4.0, label=axis)
        axes.plot(tau, sensor.modelled[k], "-", color=colour, linewidth=1.0)
    low, high = sensor.deviation.min(), sensor.deviation.max()
    white, walk = sensor.density.value / tau**0.5, sensor.walk.value * (tau / 3.0) ** 0.5
    label = f"noise density {sensor.density.value:.2e} {sensor.unit}/sqrt(Hz)"
    axes.plot(tau, white, "--", color="0.5", linewidth=1.0, label=label)
    label = f"random walk {'' if sensor.walk.seen else '< '}{sensor.walk.value:.2e} {sensor.walk_unit}"
    axes.plot(tau, walk, "--" if sensor.walk.seen else ":", color="0.5", linewidth=1.0, label=label)
    axes.set_ylim(0.5 * low, 2.0 * high)
    axes.set_xlabel("cluster time τ, s")
    axes.set_ylabel(f"Allan deviation, {sensor.unit}")
    axes.set_title(sensor.name, fontsize=10.0)
    axes.grid(which="both", alpha=0.25)
    axes.legend(fontsize=8.0)
