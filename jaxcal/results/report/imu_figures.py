"""The figures of the IMU: what it measured against the estimated motion, its residuals and its biases."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal.results.calibration import ImuCalibration
from jaxcal.results.report.drawing import (
    AXIS_COLOURS,
    INK,
    MUTED,
    Picture,
    label,
    legend,
    normal_density,
    note,
    nothing_to_show,
    panel,
    to_svg,
)
from jaxcal.results.whiteness import ResidualStatistics, autocorrelation, residual_statistics

_TALL = (4.4, 4.0)
_ENVELOPE_BINS = 450
_ZOOM_SAMPLES = 300
_FIT_BINS = 80
_LAGS = 100  # samples


@dataclass(frozen=True)
class _Sensor:
    """One of the IMU's two sensors: measured, predicted and bias are (N, 3), in `unit`."""

    title: str
    unit: str
    measured: np.ndarray
    predicted: np.ndarray
    sigma: float
    bias: np.ndarray
    bias_std: np.ndarray | None
    random_walk: float | None


def imu_pictures(imu: ImuCalibration, prefix: str) -> list[Picture]:
    """The motion and the residuals of gyroscope and accelerometer, then their biases and their fit over time."""
    gyro = _Sensor(
        "Gyroscope", "rad/s", imu.gyro_rad_s, imu.gyro_predicted, imu.gyro_sigma, imu.gyro_bias, imu.gyro_bias_std,
        imu.noise.get("gyroscope_random_walk"),
    )  # fmt: skip
    accel = _Sensor(
        "Accelerometer", "m/s²", imu.accel_m_s2, imu.accel_predicted, imu.accel_sigma, imu.accel_bias,
        imu.accel_bias_std, imu.noise.get("accelerometer_random_walk"),
    )  # fmt: skip
    zoom = _liveliest(imu)
    pictures = []
    for name, sensor in (("gyro", gyro), ("accel", accel)):
        pictures += [
            _whole_picture(sensor, imu.t_s, zoom, f"{prefix}-{name}-whole"),
            _zoom_picture(sensor, imu.t_s, zoom, f"{prefix}-{name}-zoom"),
            _histogram_picture(sensor, f"{prefix}-{name}-histogram"),
        ]
    return [
        *pictures,
        _bias_picture(gyro, imu.t_s, f"{prefix}-gyro-bias"),
        _bias_picture(accel, imu.t_s, f"{prefix}-accel-bias"),
        _fit_picture((gyro, accel), imu.t_s, f"{prefix}-fit"),
        _whiteness_picture((gyro, accel), imu.t_s, residual_statistics(imu), f"{prefix}-whiteness"),
    ]


def _liveliest(imu: ImuCalibration) -> slice:
    """The stretch of samples in which the gyroscope's reading changes most."""
    count = len(imu.t_s)
    length = min(count, _ZOOM_SAMPLES)
    change = np.nan_to_num(np.linalg.norm(np.diff(imu.gyro_predicted, axis=0), axis=1))
    total = np.concatenate([[0.0], np.cumsum(change)])
    windows = total[length - 1 :] - total[: len(total) - length + 1]
    start = int(np.argmax(windows)) if len(windows) else 0
    return slice(start, start + length)


def _envelope(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line of at most 2 points per bin through each bin's extremes, which looks as the full line would."""
    step = math.ceil(len(t) / _ENVELOPE_BINS)
    if step <= 2:
        return t, values
    starts = np.arange(0, len(t), step)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    middle = t[np.minimum(starts + step // 2, len(t) - 1)]
    return np.repeat(middle, 2), np.stack([low, high], axis=1).ravel()


def _whole_picture(sensor: _Sensor, t: np.ndarray, zoom: slice, prefix: str) -> Picture:
    figure, rows = panel(3, _TALL)
    for axis, (axes, colour) in enumerate(zip(rows, AXIS_COLOURS, strict=True)):
        axes.axvspan(t[zoom][0], t[zoom][-1], color=MUTED, alpha=0.15, linewidth=0.0)
        axes.plot(*_envelope(t, sensor.measured[:, axis]), color=colour, linewidth=1.8, alpha=0.55, label="measured")
        axes.plot(*_envelope(t, sensor.predicted[:, axis]), color=INK, linewidth=0.7, label="spline")
        label(axes, "", f"{'xyz'[axis]} [{sensor.unit}]")
        axes.margins(x=0.01)
    legend(rows[0], loc="upper right", ncols=2)
    label(rows[2], "time [s]", f"z [{sensor.unit}]")
    return Picture(
        f"{sensor.title}, whole recording",
        to_svg(figure, prefix),
        "Measured (coloured) and predicted from the spline and the biases (thin). The shaded part is enlarged beside.",
        "the thin line inside the coloured one throughout, with motion about all three axes.",
        "an axis that stays still leaves parameters undetermined: record motion along and about it.",
    )


def _zoom_picture(sensor: _Sensor, t: np.ndarray, zoom: slice, prefix: str) -> Picture:
    figure, rows = panel(3, _TALL)
    for axis, (axes, colour) in enumerate(zip(rows, AXIS_COLOURS, strict=True)):
        axes.plot(t[zoom], sensor.measured[zoom, axis], ".", color=colour, markersize=3.0, label="measured")
        axes.plot(t[zoom], sensor.predicted[zoom, axis], color=INK, linewidth=1.0, label="spline")
        label(axes, "", f"{'xyz'[axis]} [{sensor.unit}]")
        axes.margins(x=0.01)
    label(rows[2], "time [s]", f"z [{sensor.unit}]")
    return Picture(
        f"{sensor.title}, liveliest part",
        to_svg(figure, prefix),
        f"The {t[zoom][-1] - t[zoom][0]:.1f} s in which the rotation changes most: samples (dots), spline (line).",
        "the line through the middle of the dots, also at the peaks.",
        "a line that cuts the peaks needs more knots per second; one that runs ahead or behind, a look at the clocks.",
    )


def _histogram_picture(sensor: _Sensor, prefix: str) -> Picture:
    figure, (axes,) = panel(1, _TALL)
    normalised = (sensor.measured - sensor.predicted) / sensor.sigma
    rms = np.sqrt(np.nanmean(normalised**2, axis=0))
    edges = np.linspace(-5.0, 5.0, 51)
    centres = (edges[1:] + edges[:-1]) / 2.0
    for axis, colour in enumerate(AXIS_COLOURS):
        values = normalised[np.isfinite(normalised[:, axis]), axis]
        if len(values):
            density = np.histogram(values, edges)[0] / (len(values) * 0.2)
            axes.step(
                centres, density, where="mid", color=colour, linewidth=1.2, label=f"{'xyz'[axis]}: rms {rms[axis]:.2f}"
            )
    axes.plot(centres, normal_density(centres), "--", color=INK, linewidth=1.0, label="N(0, 1)")
    axes.set_ylim(bottom=0.0)
    legend(axes, loc="upper right")
    beyond = float(np.mean(np.abs(normalised) > 5.0))
    if beyond > 0:
        note(axes, f"{100 * beyond:.2g} % beyond 5 sigma", x=0.02)
    label(axes, "residual / assumed noise", "density")
    return Picture(
        f"{sensor.title}, residuals",
        to_svg(figure, prefix),
        f"Residuals over the noise assumed ({sensor.sigma:.3g} {sensor.unit}), against the normal curve.",
        "all three near the dashed line; narrower only means that the stated noise is cautious.",
        "wider means vibration, too few knots or a noise figure that is too small: raise the noise in imu.yaml.",
    )


def _bias_picture(sensor: _Sensor, t: np.ndarray, prefix: str) -> Picture:
    figure, rows = panel(3, _TALL)
    for axis, (axes, colour) in enumerate(zip(rows, AXIS_COLOURS, strict=True)):
        bias = sensor.bias[:, axis]
        finite = np.isfinite(bias)
        if not finite.any():
            nothing_to_show(axes, "no bias estimated")
            continue
        if sensor.bias_std is not None:
            std = sensor.bias_std[:, axis]
            step = max(1, len(t) // _ENVELOPE_BINS)
            for factor in (3.0, 1.0):
                low, high = bias - factor * std, bias + factor * std
                axes.fill_between(t[::step], low[::step], high[::step], color=colour, alpha=0.16, linewidth=0.0)
        axes.plot(*_envelope(t, bias), color=colour, linewidth=1.2)
        if sensor.random_walk:
            # What a random walk of the stated strength may do in the time since the start, 3 sigma.
            start = bias[finite][0]
            reach = 3.0 * sensor.random_walk * np.sqrt(np.maximum(t - t[0], 0.0))
            step = max(1, len(t) // 100)
            for sign in (-1.0, 1.0):
                axes.plot(t[::step], start + sign * reach[::step], "--", color=MUTED, linewidth=0.9)
        label(axes, "", f"{'xyz'[axis]} [{sensor.unit}]")
        axes.margins(x=0.01)
    label(rows[2], "time [s]", f"z [{sensor.unit}]")
    bands = "Bands: 1 and 3 sigma of the estimate. " if sensor.bias_std is not None else ""
    return Picture(
        f"{sensor.title}, bias",
        to_svg(figure, prefix),
        f"Estimated bias over time. {bands}Dashed: how far the stated random walk reaches from the start (3 sigma).",
        "slow lines that stay between the dashed ones.",
        "a bias that swings with the motion hides another error: noise figures, time offset, or the target's size.",
    )


def _whiteness_picture(
    sensors: tuple[_Sensor, _Sensor], t: np.ndarray, statistics: Sequence[ResidualStatistics], prefix: str
) -> Picture:
    figure, rows = panel(2, _TALL)
    lags = max(1, min(_LAGS, len(t) // 4))
    seconds = np.arange(1, lags + 1) * float(np.median(np.diff(t)))
    largest = []
    for axes, sensor in zip(rows, sensors, strict=True):
        residuals = sensor.measured - sensor.predicted
        # What independent residuals give by chance, 2 sigma.
        bound = 2.0 / np.sqrt(len(t))
        axes.axhspan(-bound, bound, color=MUTED, alpha=0.2, linewidth=0.0)
        for axis, colour in enumerate(AXIS_COLOURS):
            correlation = autocorrelation(residuals[:, axis], lags)
            largest.append(float(np.abs(correlation).max()))
            axes.plot(seconds, correlation, color=colour, linewidth=1.0, label="xyz"[axis])
        axes.axhline(0.0, color=INK, linewidth=0.6)
        axes.set_ylim(min(-0.3, axes.get_ylim()[0]), max(0.5, axes.get_ylim()[1]))
        label(axes, "", sensor.title)
        axes.margins(x=0.01)
    legend(rows[0], loc="upper right", ncols=3)
    label(rows[1], "later by [s]", sensors[1].title)
    return Picture(
        "Residuals, whiteness",
        to_svg(figure, prefix),
        "Correlation of the residuals with themselves a little later; the band is what chance gives (2 sigma). "
        f"The largest is {max(largest):.2f}. " + "; ".join(one.sentence() for one in statistics) + ".",
        "lines inside the band but for a few: the residuals are noise, and the sigmas can be believed.",
        "lines well above it are motion that the spline cannot follow (more knots per second), vibration, or a wrong "
        "clock: sigmas are then too small unless the noise was raised.",
    )


def _fit_picture(sensors: tuple[_Sensor, _Sensor], t: np.ndarray, prefix: str) -> Picture:
    figure, rows = panel(2, _TALL)
    starts = np.arange(0, len(t), math.ceil(len(t) / _FIT_BINS))
    lengths = np.diff(np.append(starts, len(t)))
    for axes, sensor in zip(rows, sensors, strict=True):
        squares = ((sensor.measured - sensor.predicted) / sensor.sigma) ** 2
        for axis, colour in enumerate(AXIS_COLOURS):
            rms = np.sqrt(np.add.reduceat(squares[:, axis], starts) / lengths)
            axes.plot(t[starts], rms, color=colour, linewidth=1.0, label="xyz"[axis])
        axes.axhline(1.0, color=INK, linestyle="--", linewidth=1.0)
        axes.set_ylim(bottom=0.0)
        label(axes, "", sensor.title)
        axes.margins(x=0.01)
    legend(rows[0], loc="lower right", ncols=3)
    label(rows[1], "time [s]", sensors[1].title)
    return Picture(
        "Residuals over time",
        to_svg(figure, prefix),
        "Root mean square of residual over noise, in short stretches; dashed: 1, what the stated noise explains.",
        "level lines about one, or below.",
        "peaks with the motion ask for more knots per second; a single peak is a knock: cut that part out.",
    )
