"""Readings of an IMU that lies still, checked for what would pass for noise: motion, wrong units, gaps."""

from dataclasses import dataclass

import numpy as np

from jaxcal.errors import CalibrationError

GRAVITY = 9.80665
_SHORTEST_S = 60.0
# A step this many times the usual one is a gap. Single samples lost do no harm to an Allan variance.
_GAP = 1.5
_LONGEST_GAP_S = 1.0
_LARGEST_SHARE_MISSING = 1e-3
# A still accelerometer, bias and scale error of a poor part included, reads between these (m/s^2).
_GRAVITY_RANGE = (8.8, 10.8)
# No gyroscope at rest is off by more (rad/s, 29 deg/s), and none scatters more (rad/s/sqrt(Hz), 0.09 deg/s/sqrt(Hz)).
_LARGEST_GYRO_BIAS = 0.5
_LARGEST_GYRO_DENSITY = 1.5e-3
# Readings are judged in blocks of a second. Where the mean jumps from one to the next, both are moved; where the
# scatter grows, that one: by so many times what is usual in the recording, and by more than these (rad/s, m/s^2).
_BLOCK_S = 1.0
_JUMP, _SCATTER = 8.0, 3.0
_LEAST_JUMP = {"gyroscope": 1e-3, "accelerometer": 1e-2}
_LEAST_SCATTER = {"gyroscope": 3e-3, "accelerometer": 3e-2}
# Means of a second that usually jump by more are motion, not noise of any sensor.
_LARGEST_USUAL_JUMP = {"gyroscope": 1e-2, "accelerometer": 0.1}


@dataclass(frozen=True)
class StillRecording:
    """Evenly spaced readings at rest: `gyro_rad_s` and `accel_m_s2` (3, N), `rate_hz`; `missing` samples were lost,
    the others closed up."""

    rate_hz: float
    gyro_rad_s: np.ndarray
    accel_m_s2: np.ndarray
    missing: int

    @property
    def duration_s(self) -> float:
        """Length of the recording, s."""
        return self.gyro_rad_s.shape[1] / self.rate_hz


def still_recording(
    timestamps_ns: np.ndarray, gyro_rad_s: np.ndarray, accel_m_s2: np.ndarray, origin_s: float = 0.0
) -> StillRecording:
    """Check readings of an IMU at rest: `timestamps_ns` (N,) increasing, gyroscope and accelerometer (N, 3).

    `origin_s` is how errors count the first sample's time (s), where the readings were cut from a longer recording.

    Raises CalibrationError when they are too short, have gaps, are in other units, do not vary, or were not at rest;
    each with what to do about it.
    """
    rate, missing = _rate(np.asarray(timestamps_ns, dtype=np.int64), origin_s)
    gyro, accel = (np.ascontiguousarray(np.asarray(v, dtype=np.float64).T) for v in (gyro_rad_s, accel_m_s2))
    for sensor, values in (("gyroscope", gyro), ("accelerometer", accel)):
        _check_alive(sensor, values)
    _check_accelerometer_unit(accel)
    _check_gyroscope_unit(gyro, rate)
    _check_rest({"gyroscope": gyro, "accelerometer": accel}, rate, origin_s)
    return StillRecording(rate, gyro, accel, missing)


def _rate(times: np.ndarray, origin: float) -> tuple[float, int]:
    """Samples per second, and how many were lost."""
    steps = np.diff(times)
    if len(steps) == 0 or np.any(steps <= 0):
        place = int(np.argmax(steps <= 0)) + 1 if len(steps) else 0
        raise CalibrationError(
            f"sample {place}: its time does not come after the one before. Sort the recording and drop duplicates."
        )
    span = (times[-1] - times[0]) * 1e-9
    if span < _SHORTEST_S:
        raise CalibrationError(
            f"the recording lasts {span:.1f} s, which is too short for an Allan variance. Record for 10 minutes at "
            "least, and for 3 hours if the random walk is wanted as well."
        )
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > _GAP * usual)
    missing = int(np.sum(np.round(steps[gaps] / usual) - 1))
    longest = steps.max() * 1e-9
    if longest > _LONGEST_GAP_S or missing > _LARGEST_SHARE_MISSING * len(times):
        ends = (times[np.concatenate([[0], gaps + 1])], times[np.concatenate([gaps, [len(times) - 1]])])
        best = int(np.argmax(ends[1] - ends[0]))
        start, stop = (origin + (end[best] - times[0]) * 1e-9 for end in ends)
        worst = origin + (times[int(np.argmax(steps))] - times[0]) * 1e-9
        raise CalibrationError(
            f"{len(gaps)} gaps in time, {missing} samples are missing; the longest lasts {longest:.3f} s, from second "
            f"{worst:.3f} on. An Allan variance needs even spacing: {_keep(start, stop)}"
        )
    return 1e9 / float(np.mean(steps[steps <= _GAP * usual])), missing


def _keep(start: float, stop: float) -> str:
    """What to do when only a part of the recording is good; what is told of that part lies within it."""
    start, stop = np.ceil(10.0 * start - 1e-6) / 10.0, np.floor(10.0 * stop + 1e-6) / 10.0
    if stop - start < _SHORTEST_S:
        return f"record again (the longest good part lasts {max(stop - start, 0.0):.0f} s)."
    return (
        f"record again, or keep the longest good part, seconds {start:.1f} to {stop:.1f} (--start {start:.1f} "
        f"--stop {stop:.1f})."
    )


def _check_alive(sensor: str, values: np.ndarray) -> None:
    for axis, row in zip("xyz", values, strict=True):
        if np.ptp(row) == 0.0:
            raise CalibrationError(
                f"{sensor} {axis}: all {len(row)} readings are {row[0]:g}; it is dead, switched off or rounded. Record "
                "raw readings, at the sensor's full resolution."
            )


def _check_accelerometer_unit(accel: np.ndarray) -> None:
    size = float(np.linalg.norm(np.median(accel, axis=1)))
    low, high = _GRAVITY_RANGE
    if low < size < high:
        return
    problem = f"the accelerometer reads {size:.4g} at rest; gravity is {GRAVITY:.4g} m/s^2."
    for unit, factor in (("g", GRAVITY), ("mg", 1e-3 * GRAVITY), ("cm/s^2", 1e-2)):
        if low < size * factor < high:
            raise CalibrationError(f"{problem} It is in {unit}: multiply its columns by {factor:.6g}.")
    if size < 0.5:
        raise CalibrationError(f"{problem} Is this linear acceleration, gravity taken off? Record the raw readings.")
    raise CalibrationError(f"{problem} Convert its columns to m/s^2, and have it lie still.")


def _check_gyroscope_unit(gyro: np.ndarray, rate: float) -> None:
    bias = float(np.max(np.abs(np.median(gyro, axis=1))))
    # Differences of neighbours: motion, which is smooth, hardly adds to them.
    density = float(np.max(np.sqrt(0.5 * np.median(np.diff(gyro, axis=1) ** 2, axis=1) / 0.455 / rate)))
    if bias > _LARGEST_GYRO_BIAS or density > _LARGEST_GYRO_DENSITY:
        raise CalibrationError(
            f"the gyroscope is off by {bias:.3g} and scatters by {density:.2g} per sqrt(Hz); none does by more than "
            f"{_LARGEST_GYRO_BIAS:g} rad/s and {_LARGEST_GYRO_DENSITY:g} rad/s/sqrt(Hz) at rest. If it is in deg/s, "
            f"multiply its columns by {np.pi / 180.0:.6f}; if it turned or shook, record it at rest."
        )


def _check_rest(sensors: dict[str, np.ndarray], rate: float, origin: float) -> None:
    length = max(round(_BLOCK_S * rate), 8)
    count = next(iter(sensors.values())).shape[1] // length
    moved, culprits = np.zeros(count, dtype=bool), []
    for sensor, values in sensors.items():
        blocks = values[:, : count * length].reshape(3, count, length)
        jump = np.abs(np.diff(blocks.mean(axis=2), axis=1))
        usual = 1.4826 * np.median(jump, axis=1, keepdims=True)
        if usual.max() > _LARGEST_USUAL_JUMP[sensor]:
            unit = "rad/s" if sensor == "gyroscope" else "m/s^2"
            raise CalibrationError(
                f"the IMU moves throughout: the {sensor}'s mean over a second changes by {usual.max():.2g} {unit} from "
                "one to the next. A still recording is needed: lay it on a solid table, and let nobody touch it."
            )
        jumped = np.any(jump > np.maximum(_JUMP * usual, _LEAST_JUMP[sensor]), axis=0)
        scatter = blocks.std(axis=2)
        limit = np.maximum(_SCATTER * np.median(scatter, axis=1, keepdims=True), _LEAST_SCATTER[sensor])
        own = np.any(scatter > limit, axis=0)
        own[1:] |= jumped
        own[:-1] |= jumped
        culprits += [sensor] * bool(own.any())
        moved |= own
    if not moved.any():
        return
    runs = np.flatnonzero(np.diff(np.concatenate([[True], moved, [True]]).astype(int))).reshape(-1, 2)
    best = runs[np.argmax(runs[:, 1] - runs[:, 0])] if len(runs) else np.zeros(2)
    first = int(np.argmax(moved))
    last = first + int(np.argmin(np.concatenate([moved[first:], [False]])))
    first_s, last_s, start, stop = origin + np.array([first, last, *best]) * length / rate
    raise CalibrationError(
        f"the IMU was moved or knocked in {int(moved.sum())} of {count} seconds ({' and '.join(culprits)}), the first "
        f"time from second {first_s:.0f} to {last_s:.0f}. A still recording is needed: {_keep(start, stop)}"
    )
