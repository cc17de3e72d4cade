"""The noise model of an IMU from a still recording, as numbers, in words, and as Kalibr's imu.yaml."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxcal.imu.allan import (
    SIGNIFICANT,
    ClusterStatistics,
    Fit,
    allan_variance,
    cluster_lengths,
    expected_covariance,
    fit_model,
    interval,
    largest_walk,
    model_terms,
)
from jaxcal.imu.still import StillRecording
from jaxcal.progress import Progress, no_progress

AXES = ("x", "y", "z")
# Curves are drawn with so many points per octave.
_CURVE_POINTS = 4
# A fit that is this much worse than chance, and a scatter of single samples this far from the model's, are told.
_LARGE_MISFIT = 3.0
_SAMPLE_RATIO = 1.5
_UNEVEN_AXES = 2.0
_DAY_S = 86_400.0


@dataclass(frozen=True)
class Estimate:
    """A density: its `value`, and bounds that hold it with 95 %. Where it is not `seen`, `value` is an upper limit."""

    value: float
    low: float
    high: float
    seen: bool


@dataclass(frozen=True)
class SensorNoise:
    """Noise of a gyroscope (unit rad/s) or an accelerometer (m/s^2).

    `density` unit/sqrt(Hz), `walk` unit/s/sqrt(Hz) and `floor` (the bias instability B) unit, each of the whole sensor
    (root mean square of the axes) and then per axis. `tau_s` (T,) and `deviation` (3, T) are the Allan deviation,
    `modelled` (3, T) the fits.
    """

    name: str
    unit: str
    density: Estimate
    walk: Estimate
    floor: Estimate
    density_axes: tuple[Estimate, ...]
    walk_axes: tuple[Estimate, ...]
    floor_axes: tuple[Estimate, ...]
    tau_s: np.ndarray
    deviation: np.ndarray
    modelled: np.ndarray
    notes: tuple[str, ...]

    @property
    def walk_unit(self) -> str:
        """Unit of the random walk."""
        return walk_unit(self.unit)


@dataclass(frozen=True)
class StillNoise:
    """What a still recording of `duration_s` s at `rate_hz` Hz says about the noise of an IMU."""

    duration_s: float
    rate_hz: float
    gyroscope: SensorNoise
    accelerometer: SensorNoise
    notes: tuple[str, ...]

    def densities(self, inflate: float = 1.0) -> dict[str, float]:
        """The keys and values of Kalibr's imu.yaml, densities times `inflate`, rounded to five digits."""
        values = {}
        for sensor in (self.accelerometer, self.gyroscope):
            values[f"{sensor.name}_noise_density"] = sensor.density.value * inflate
            values[f"{sensor.name}_random_walk"] = sensor.walk.value * inflate
        return {key: float(f"{value:.4e}") for key, value in values.items()} | {"update_rate": round(self.rate_hz, 3)}

    def to_json(self, inflate: float = 1.0) -> dict[str, Any]:
        """Everything but the curves, as plain values."""
        out: dict[str, Any] = {"duration_s": self.duration_s, "inflate": inflate, "imu_yaml": self.densities(inflate)}
        for sensor in (self.gyroscope, self.accelerometer):
            out[sensor.name] = {
                "unit": sensor.unit,
                **{
                    name: vars(whole) | {"axes": [vars(axis) for axis in axes]}
                    for name, whole, axes in _quantities(sensor)
                },
            }
        return out | {"notes": list(self.notes)}

    def imu_yaml(self, source: str, rostopic: str, inflate: float = 1.0) -> str:
        """The text of Kalibr's imu.yaml, with the axes' own values and all doubts in comments."""
        lines = [
            f"# Noise of a still IMU by Allan variance (jaxcal imu-noise): {source}, {self.duration_s:.0f} s at "
            f"{self.rate_hz:.6g} Hz.",
            "# Values are root mean squares of the axes; ranges hold the true value with 95 %.",
            *([f"# All densities below are {inflate:g} times what was measured."] if inflate != 1.0 else []),
            *(f"# {note}" for note in self.notes),
        ]
        values = self.densities(inflate)
        for sensor in (self.accelerometer, self.gyroscope):
            for name, key, unit in _keys(sensor):
                whole, axes = getattr(sensor, name), getattr(sensor, f"{name}_axes")
                limit = "" if whole.seen else "; a safe upper limit, not a measurement"
                own = ", ".join(f"{axis} {in_words(e)}" for axis, e in zip(AXES, axes, strict=True))
                own += f"; together {in_words(whole)}"
                lines += [f"{key}: {values[key]:.4e}  # {unit}{limit}", f"#   measured: {own}"]
            own = ", ".join(f"{axis} {in_words(e)}" for axis, e in zip(AXES, sensor.floor_axes, strict=True))
            lines.append(f"#   {sensor.name} bias instability (Kalibr does not use it), {sensor.unit}: {own}")
        return "\n".join([*lines, f"rostopic: {rostopic}", f"update_rate: {values['update_rate']}"]) + "\n"


def noise_of_still(recording: StillRecording, progress: Progress = no_progress) -> StillNoise:
    """Noise density, bias instability and rate random walk of every axis of a still IMU, with confidence.

    A random walk that the recording is too short to show is not invented: a safe upper limit stands in for it, and a
    note says so, and which length would do. Raises CalibrationError when the recording is too short for any of it.
    """
    statistics = ClusterStatistics(recording.gyro_rad_s.shape[1], recording.rate_hz)
    sensors = []
    for name, unit, values in (
        ("gyroscope", "rad/s", recording.gyro_rad_s),
        ("accelerometer", "m/s^2", recording.accel_m_s2),
    ):
        progress("Allan variance", len(sensors), 2)
        sensors.append(_sensor_noise(name, unit, values, statistics))
    progress("Allan variance", 2, 2)
    gyroscope, accelerometer = sensors
    lost = [f"{recording.missing} samples are missing; the others were closed up."] if recording.missing else []
    notes = (*lost, *gyroscope.notes, *accelerometer.notes)
    return StillNoise(recording.duration_s, recording.rate_hz, gyroscope, accelerometer, notes)


def walk_unit(unit: str) -> str:
    """Unit of the random walk of readings in rad/s or m/s^2."""
    return {"rad/s": "rad/s^2/sqrt(Hz)", "m/s^2": "m/s^3/sqrt(Hz)"}[unit]


def in_words(estimate: Estimate) -> str:
    """`1.70e-04 (1.65e-04 to 1.75e-04)`, or `< 3.1e-05`."""
    if not estimate.seen:
        return f"< {estimate.value:.2e}"
    return f"{estimate.value:.2e} ({estimate.low:.2e} to {estimate.high:.2e})"


def _quantities(sensor: SensorNoise) -> list[tuple[str, Estimate, tuple[Estimate, ...]]]:
    return [
        ("noise_density", sensor.density, sensor.density_axes),
        ("random_walk", sensor.walk, sensor.walk_axes),
        ("bias_instability", sensor.floor, sensor.floor_axes),
    ]


def _keys(sensor: SensorNoise) -> list[tuple[str, str, str]]:
    return [
        ("density", f"{sensor.name}_noise_density", f"{sensor.unit}/sqrt(Hz)"),
        ("walk", f"{sensor.name}_random_walk", sensor.walk_unit),
    ]


def _sensor_noise(name: str, unit: str, values: np.ndarray, statistics: ClusterStatistics) -> SensorNoise:
    count, rate = statistics.count, statistics.rate_hz
    curve = cluster_lengths(count, rate, per_octave=_CURVE_POINTS)
    lengths = np.union1d(curve, statistics.clusters)
    variances = allan_variance(values, rate, lengths)
    fitted = variances[:, np.searchsorted(lengths, statistics.clusters)]
    fits = [fit_model(statistics, variance) for variance in fitted]
    walk_limits = [largest_walk(statistics, variance) for variance in fitted]
    floor_limits = [fit.parameters[1] + 2.0 * fit.sigma[1] for fit in fits]

    def estimates(place: int, limits: Sequence[float]) -> tuple[Estimate, tuple[Estimate, ...]]:
        """Of the whole sensor, and per axis."""
        own = [(fit.parameters[place], fit.sigma[place]) for fit in fits]
        mean, sigma = np.mean([v for v, _ in own]), np.sqrt(np.sum([s**2 for _, s in own])) / len(own)
        axes = tuple(_estimate(v, s, limit) for (v, s), limit in zip(own, limits, strict=True))
        return _estimate(float(mean), float(sigma), float(np.mean(limits))), axes

    density, density_axes = estimates(0, [fit.parameters[0] + 2.0 * fit.sigma[0] for fit in fits])
    floor, floor_axes = estimates(1, floor_limits)
    walk, walk_axes = estimates(2, walk_limits)
    tau = curve / rate
    deviation = np.sqrt(variances[:, np.searchsorted(lengths, curve)])
    modelled = np.sqrt(np.stack([model_terms(tau) @ fit.parameters for fit in fits]))
    notes = [
        *([] if walk.seen else [_walk_note(name, unit, fits, walk.value, statistics)]),
        *_fit_notes(name, fits, density_axes, deviation[:, 0] / modelled[:, 0], rate),
    ]
    return SensorNoise(
        name=name,
        unit=unit,
        density=density,
        walk=walk,
        floor=floor,
        density_axes=density_axes,
        walk_axes=walk_axes,
        floor_axes=floor_axes,
        tau_s=tau,
        deviation=deviation,
        modelled=modelled,
        notes=tuple(notes),
    )


def _estimate(variance: float, sigma: float, limit: float) -> Estimate:
    """From the square of a density, its sigma, and the limit of that square where it is not clear."""
    if variance < SIGNIFICANT * sigma:
        return Estimate(float(np.sqrt(limit)), 0.0, float(np.sqrt(limit)), seen=False)
    low, high = interval(variance, sigma)
    return Estimate(float(np.sqrt(variance)), low, high, seen=True)


def _walk_note(name: str, unit: str, fits: Sequence[Fit], limit: float, statistics: ClusterStatistics) -> str:
    """That the recording is too short for the random walk, and which length would do."""
    found = float(np.sqrt(np.mean([fit.parameters[2] for fit in fits])))
    target = max(found, limit / 3.0)
    length = length_that_shows(target, np.mean([fit.parameters for fit in fits], axis=0), statistics)
    return (
        f"{name}: {statistics.count / statistics.rate_hz:.0f} s are too short to tell its random walk from white noise "
        f"and bias instability; {limit:.2e} {walk_unit(unit)}, which covers the latter, is a safe upper limit instead. "
        f"One of {target:.1e} would show in {_length(length)}."
    )


def length_that_shows(walk: float, parameters: np.ndarray, statistics: ClusterStatistics) -> float:
    """How long a still recording (s) of three alike axes must be to show a random walk K of `walk` clearly.

    `parameters` (3,) are N^2, B^2, K^2 as known so far; lengths are tried in steps of a factor sqrt(2) beyond that
    of `statistics`. Infinity for more than a day.
    """
    model = np.array([parameters[0], parameters[1], walk**2])
    # The fit leaves the shortest cluster times out, so that the rate does not matter: a low one is quick.
    rate = min(statistics.rate_hz, 10.0)
    first = statistics.count / statistics.rate_hz
    lengths = first * 2.0 ** (0.5 * np.arange(1, max(1, int(2.0 * np.log2(_DAY_S / first))) + 1))

    def shows(length: float) -> bool:
        sigma = np.sqrt(expected_covariance(ClusterStatistics(int(length * rate), rate), model)[2, 2] / 3.0)
        return bool(walk**2 > SIGNIFICANT * sigma)

    enough = bisect_left(range(len(lengths)), True, key=lambda k: shows(lengths[k]))
    return float(lengths[enough]) if enough < len(lengths) else np.inf


def _length(seconds: float) -> str:
    if not np.isfinite(seconds):
        return "more than a day"
    if seconds < 100 * 60:
        return f"about {np.ceil(seconds / 60):.0f} min"
    return f"about {np.ceil(seconds / 1800) / 2:g} h"


def _fit_notes(
    name: str, fits: Sequence[Fit], density: Sequence[Estimate], sample: np.ndarray, rate_hz: float
) -> list[str]:
    """Doubts about the model: its fit, single samples (`sample` (3,): their scatter over the model's), the axes."""
    notes = []
    misfit = max(fit.misfit for fit in fits)
    if misfit > _LARGE_MISFIT:
        notes.append(
            f"{name}: its curve is not that of white noise, floor and random walk (chi-square {misfit:.1f} per degree "
            "of freedom; the ranges were widened). Vibration, or a temperature that changes, do this: look at the plot."
        )
    ratio = float(np.exp(np.mean(np.log(sample))))
    if not 1.0 / _SAMPLE_RATIO < ratio < _SAMPLE_RATIO:
        reason = "it is filtered" if ratio < 1.0 else "vibration or coarse rounding does this"
        notes.append(
            f"{name}: one sample at {rate_hz:.6g} Hz scatters {ratio:.2g} times as much as its density says "
            f"({reason}); the density is that of slower changes."
        )
    values = [axis.value for axis in density]
    if max(values) > _UNEVEN_AXES * min(values):
        worst, best = AXES[int(np.argmax(values))], AXES[int(np.argmin(values))]
        notes.append(
            f"{name}: its axes differ, {worst} is {max(values) / min(values):.1f} times as noisy as {best}; one value "
            "stands for all."
        )
    return notes
