"""Time offset, rotation to the IMU and gyro bias from turning alone; gravity and a first trajectory."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from jaxcal.errors import CalibrationError
from jaxcal.observations import ImuRecording

STANDARD_GRAVITY = 9.80665
# Frames further apart than this do not give a rate of turn.
_LONGEST_STEP_S = 0.2
_COARSE_STEP_S = 0.01
# Offsets are refined within a coarse step, in two rounds of ever smaller steps.
_FINE_STEPS_S = (0.005, 0.001)
# The gyroscope's integral is sampled so many times per coarse step.
_GRID_PER_STEP = 4
_LARGEST_SHIFT_S = 5.0
# Offsets tried at once: few enough for their table to stay in the cache.
_SHIFTS_AT_ONCE = 64
_TRIM = 0.8
_LEAST_CORRELATION = 0.4
# Relative rounding of rates of turn, in single precision, and more.
_ROUNDING = 1e-6
_LEAST_TURNING = 0.05
# Offsets of the halves of a recording further apart than this are two offsets, where each half has so many frames and
# its turning leaves so little unexplained, by itself and beside what one offset leaves (s; frames; shares).
_LARGEST_JUMP_S = 0.01
_LEAST_HALF = 40
_CLEARLY_EXPLAINED = 0.05
_WORTH_TWO = 0.5
# How many times faster than the camera the gyroscope may seem to turn, or slower.
_LARGEST_SCALE = 2.0
# The share of the gyroscope's variance that the camera's turning may leave unexplained. Real and simulated recordings
# leave 0.0001 to 0.003; an unrelated IMU 0.23 to 0.41, although a short one correlates by up to 0.84 at some offset.
_LARGEST_UNEXPLAINED = 0.15


@dataclass(frozen=True)
class CameraTrack:
    """Board poses of one camera over time: `time_s` (F,) camera clock, T_target_cam as `rotation` and `position`."""

    time_s: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


@dataclass(frozen=True)
class Alignment:
    """Camera against IMU: `shift_s` (t_imu = t_cam + shift), `R_cam_imu` (3, 3), `gyro_bias` (3,) rad/s, `correlation`
    of the rates of turn, and how strongly the turning spans three dimensions (`excitation` (3,), rad/s)."""

    shift_s: float
    R_cam_imu: np.ndarray
    gyro_bias: np.ndarray
    correlation: float
    excitation: np.ndarray


class TurnIntegral:
    """Integral of the gyroscope over time, so that mean rates over any span are two look-ups."""

    def __init__(self, time_s: np.ndarray, gyro: np.ndarray):
        step = np.diff(time_s)[:, None]
        self._time = time_s
        self._integral = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * step * (gyro[1:] + gyro[:-1]), axis=0)])

    def _at(self, time_s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(time_s, self._time, self._integral[:, a]) for a in range(3)], axis=-1)

    def mean_rate(self, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
        """Mean angular velocity (..., 3) over spans; NaN where a span leaves the recording."""
        rate = (self._at(stop) - self._at(start)) / (stop - start)[..., None]
        outside = (start < self._time[0]) | (stop > self._time[-1])
        rate[outside] = np.nan
        return rate

    def turning_on_grid(self, fine_s: float, spans: np.ndarray) -> np.ndarray:
        """Magnitude (S, G) of the mean angular velocity over spans of these lengths (S,), counted in steps of a grid of
        time that begins with the recording; NaN where a span leaves it."""
        values = self._at(np.arange(self._time[0], self._time[-1], fine_s))
        out = np.full((len(spans), len(values)), np.nan, dtype=np.float32)
        for row, span in zip(out, spans, strict=True):
            turn = values[span:] - values[: max(len(values) - span, 0)]
            row[: len(turn)] = np.sqrt(np.einsum("na,na->n", turn, turn)) / (span * fine_s)
        return out

    @property
    def start_s(self) -> float:
        """The time of the first sample."""
        return float(self._time[0])


@dataclass(frozen=True)
class _Turning:
    """A camera's mean rate of turn `rate` (n, 3), camera frame, from `start` to `stop` (n,), s."""

    start: np.ndarray
    stop: np.ndarray
    rate: np.ndarray

    def part(self, which: slice) -> "_Turning":
        return _Turning(self.start[which], self.stop[which], self.rate[which])


def align(track: CameraTrack, imu_time_s: np.ndarray, gyro: np.ndarray, name: str) -> Alignment:
    """Align a camera's turning with the gyroscope's.

    The offset is the peak of the correlation of the rates' magnitudes, refined below the grid by the residual of the
    best rotation (Kabsch 1976) over neighbouring offsets. Raises CalibrationError when the two do not move together or
    hardly turn.
    """
    camera = _turning(track, name)
    integral = TurnIntegral(imu_time_s, gyro)
    # The camera's rates are noisy, the gyroscope's biased: who does not turn is told by either.
    turning = min(_median_norm(camera.rate), _median_norm(gyro - np.median(gyro, axis=0)))
    if turning < _LEAST_TURNING:
        raise CalibrationError(
            f"{name}: the camera hardly turns (median {np.degrees(turning):.1f} deg/s), so that its rotation and time "
            "offset to the IMU are not determined. Record with rotations about all three axes."
        )
    middle = len(camera.rate) // 2
    halves = [slice(None, middle), slice(middle, None)] if middle >= _LEAST_HALF else []
    (coarse, correlation), *of_halves = _coarse_shifts(camera, integral, [slice(None), *halves])
    parts = [camera.part(half) for half in halves]
    if correlation < _LEAST_CORRELATION:
        _check_clock(parts, of_halves, integral, name)
        raise CalibrationError(
            f"{name}: its turning does not match the IMU's (correlation {correlation:.2f} at best, within "
            f"{_LARGEST_SHIFT_S:g} s). Are camera and IMU from the same recording, on clocks less than "
            f"{_LARGEST_SHIFT_S:g} s apart, and is the gyroscope in rad/s?"
        )
    _check_scale(camera.rate, integral.mean_rate(camera.start + coarse, camera.stop + coarse), name)
    shift, unexplained = _fine_shift(camera, integral, coarse)
    _check_clock(parts, of_halves, integral, name, unexplained)
    if unexplained > _LARGEST_UNEXPLAINED:
        raise CalibrationError(
            f"{name}: its turning does not match the IMU's: the best time offset ({shift:.3f} s) and rotation leave "
            f"{100 * unexplained:.0f} % of the gyroscope's variance unexplained. Are camera and IMU from the same "
            "recording, and are the frames' corners and times right?"
        )
    R_imu_cam, bias, _, spread = _rotations(camera, integral, np.array([shift]))
    return Alignment(shift, R_imu_cam[0].T, bias[0], correlation, spread[0])


def _fine_shift(camera: _Turning, integral: TurnIntegral, coarse: float) -> tuple[float, float]:
    """The offset near `coarse` at which the best rotation leaves least, and the share of the gyroscope's variance that
    it leaves."""
    shift, reach = coarse, _COARSE_STEP_S
    for step in _FINE_STEPS_S:
        steps = round(1.5 * reach / step)
        grid = shift + np.arange(-steps, steps + 1) * step
        costs = _rotations(camera, integral, grid)[2]
        best = int(np.clip(np.argmin(costs), 1, len(grid) - 2))
        left, middle, right = costs[best - 1 : best + 2]
        bend = left - 2.0 * middle + right
        shift = float(grid[best] + (np.clip(0.5 * (left - right) / bend, -1.0, 1.0) if bend > 0 else 0.0) * step)
        reach = step
    cost = float(_rotations(camera, integral, np.array([shift]))[2][0])
    measured = integral.mean_rate(camera.start + shift, camera.stop + shift)
    return shift, cost / float(np.nansum(np.nanvar(measured, axis=0)))


def _check_clock(
    parts: Sequence[_Turning],
    coarse: Sequence[tuple[float, float]],
    integral: TurnIntegral,
    name: str,
    left: float = np.inf,
) -> None:
    """Raise CalibrationError when the offset that serves the first half of the recording is not that of the second, and
    one offset for both leaves clearly more unexplained (`left`) than two do.

    `parts` are the halves, or nothing where they are too short; `coarse`, the `_coarse_shifts` of each.
    """
    shifts = []
    for part, (about, correlation) in zip(parts, coarse, strict=True):
        if correlation < _LEAST_CORRELATION:
            return  # a half that tells nothing by itself
        shift, unexplained = _fine_shift(part, integral, about)
        if unexplained > min(_CLEARLY_EXPLAINED, _WORTH_TWO * left):
            return
        shifts.append(shift)
    if shifts and abs(shifts[1] - shifts[0]) > _LARGEST_JUMP_S:
        raise CalibrationError(
            f"{name}: its clock and the IMU's do not run together: the time offset is {shifts[0]:.4f} s in the first "
            f"half of the frames (up to {parts[1].start[0]:.1f} s after the IMU's first sample) and {shifts[1]:.4f} s "
            "in the second. A clock jumped or drifts, or samples were lost and the others numbered on. Take the time "
            "stamps from the sensors' own clocks, or calibrate from the part of the recording before the jump."
        )


def turning(track: CameraTrack, name: str) -> tuple[np.ndarray, np.ndarray]:
    """A camera's rate of turn, as a gyroscope would have it: times (n,) between its frames, and rad/s (n, 3)."""
    camera = _turning(track, name)
    return 0.5 * (camera.start + camera.stop), camera.rate


def _median_norm(vectors: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(vectors, axis=1)))


def _check_scale(camera: np.ndarray, imu: np.ndarray, name: str) -> None:
    """Correlation is blind to units: compare the sizes of the rates of turn, too."""
    inside = np.isfinite(imu[:, 0])
    camera, imu = camera[inside] - camera[inside].mean(axis=0), imu[inside] - imu[inside].mean(axis=0)
    scale = _median_norm(imu) / max(_median_norm(camera), 1e-12)
    if not 1.0 / _LARGEST_SCALE < scale < _LARGEST_SCALE:
        raise CalibrationError(
            f"{name}: the gyroscope turns {scale:.3g} times as fast as the camera. Is the gyroscope in rad/s "
            "(57.3 times says degrees), and are the times of both in nanoseconds?"
        )


def _turning(track: CameraTrack, name: str) -> _Turning:
    """The mean rates of turn between consecutive frames."""
    step = np.diff(track.time_s)
    near = step < _LONGEST_STEP_S
    if near.sum() < 10:
        raise CalibrationError(
            f"{name}: only {near.sum()} pairs of frames with the board lie closer than {_LONGEST_STEP_S:g} s; the "
            "motion cannot be followed. Record at 10 Hz or more and keep the board in view."
        )
    relative = track.rotation[:-1].swapaxes(-1, -2) @ track.rotation[1:]
    rate = Rotation.from_matrix(relative[near]).as_rotvec() / step[near, None]
    return _Turning(track.time_s[:-1][near], track.time_s[1:][near], rate)


def _coarse_shifts(camera: _Turning, integral: TurnIntegral, parts: Sequence[slice]) -> list[tuple[float, float]]:
    """For each of `parts` of the spans, the offset with the largest correlation of rate magnitudes over at least half
    of them, and that correlation: (0, -1) where there is none.

    The gyroscope's turning is laid out once on a grid finer than the offsets tried, for each length of span that there
    is, so that to try an offset is to look up.
    """
    magnitude = _normalised(np.minimum(np.linalg.norm(camera.rate, axis=1), 20.0))
    fine = _COARSE_STEP_S / _GRID_PER_STEP
    spans, which = np.unique(
        np.maximum(np.round((camera.stop - camera.start) / fine).astype(np.int64), 1), return_inverse=True
    )
    turning = _normalised(integral.turning_on_grid(fine, spans))
    place = np.round((camera.start - integral.start_s) / fine).astype(np.int64)
    most = round(_LARGEST_SHIFT_S / _COARSE_STEP_S)
    steps = np.arange(-most, most + 1)
    correlations = np.concatenate(
        [
            _correlations(magnitude, turning, which, place + some[:, None] * _GRID_PER_STEP, parts)
            for some in np.array_split(steps, math.ceil(len(steps) / _SHIFTS_AT_ONCE))
        ],
        axis=1,
    )
    # Among equals the first offset.
    best = [int(np.argmax(row >= row.max() - 1e-9)) for row in correlations]
    return [
        (float(steps[k]) * _COARSE_STEP_S, float(row[k])) if row[k] > -1.0 else (0.0, -1.0)
        for k, row in zip(best, correlations, strict=True)
    ]


def _normalised(values: np.ndarray) -> np.ndarray:
    """Values less their mean, in units of their root mean square; NaN stay so."""
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return values
    return (values - known.mean()) / max(float(np.sqrt(np.mean(known**2))), 1e-30)


def _correlations(
    magnitude: np.ndarray, turning: np.ndarray, which: np.ndarray, at: np.ndarray, parts: Sequence[slice]
) -> np.ndarray:
    """Correlation (P, K) of each part of `magnitude` (n,) with what the table `turning` (S, G) holds in the rows
    `which` (n,) at the places `at` (K, n), both normalised; -1 where less than half of a part lies within the table."""
    within = (at >= 0) & (at < turning.shape[1])
    other = turning[which, np.where(within, at, 0)].astype(np.float64)
    inside = within & np.isfinite(other)
    other = np.where(inside, other, 0.0)
    out = np.full((len(parts), len(at)), -1.0)
    for row, part in zip(out, parts, strict=True):
        a, b, count = magnitude[part], other[:, part], np.count_nonzero(inside[:, part], axis=1)
        enough = (count >= 0.5 * len(a)) & (count > 0)
        b, seen, count = b[enough], inside[enough, part], count[enough]
        sum_a, sum_b = seen @ a, b.sum(axis=1)
        spread_a = seen @ a**2 - sum_a**2 / count
        spread_b = np.einsum("kn,kn->k", b, b) - sum_b**2 / count
        # What does not vary beyond rounding correlates with nothing.
        least = _ROUNDING**2 * count
        row[enough] = (b @ a - sum_a * sum_b / count) / np.sqrt(
            np.maximum(spread_a, least) * np.maximum(spread_b, least)
        )
    return out


def _rotations(
    camera: _Turning, integral: TurnIntegral, shifts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """R_imu_cam (S, 3, 3), gyro bias (S, 3), trimmed cost (S,) and excitation (S, 3) of the best rotation between rates
    at each offset, the worst fifth left out."""
    measured = integral.mean_rate(camera.start + shifts[:, None], camera.stop + shifts[:, None])
    inside = np.isfinite(measured[..., 0])
    imu = np.where(inside[..., None], measured, 0.0)
    last = np.count_nonzero(inside, axis=1) - 1
    below = np.floor(_TRIM * last).astype(np.int64)
    rows, above, share = np.arange(len(shifts)), np.minimum(below + 1, last), _TRIM * last - below
    kept = inside
    R, bias = np.zeros((len(shifts), 3, 3)), np.zeros((len(shifts), 3))
    error, values = np.zeros(inside.shape), np.zeros((len(shifts), 3))
    for _ in range(4):
        weight = kept / np.count_nonzero(kept, axis=1)[:, None]
        mean_camera, mean_imu = weight @ camera.rate, np.einsum("sn,snj->sj", weight, imu)
        products = (imu * weight[..., None]).swapaxes(1, 2) @ camera.rate
        u, values, vt = np.linalg.svd(products - mean_imu[:, :, None] * mean_camera[:, None])
        u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
        R = u @ vt
        bias = mean_imu - np.einsum("sij,sj->si", R, mean_camera)
        difference = imu - camera.rate @ R.swapaxes(1, 2) - bias[:, None]
        error = np.where(inside, np.einsum("snj,snj->sn", difference, difference), np.inf)
        ordered = np.sort(error, axis=1)
        limit = ordered[rows, below] * (1.0 - share) + ordered[rows, above] * share
        kept = error <= limit[:, None]
    cost = np.where(kept, error, 0.0).sum(axis=1) / np.count_nonzero(kept, axis=1)
    return R, bias, cost, np.sqrt(values)


def orientation_track(time_s: np.ndarray, rotation: np.ndarray, imu_time_s: np.ndarray, gyro: np.ndarray) -> np.ndarray:
    """R_target_imu (N, 3, 3) at every IMU sample: the gyroscope's integral, bent to pass through the frames.

    `time_s` (F,) frames on the IMU's clock, increasing; `rotation` (F, 3, 3) R_target_imu there. Gaps between frames
    are carried by the gyroscope alone.
    """
    steps = Rotation.from_rotvec(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(imu_time_s)[:, None])
    integral = _running_product(steps)
    at_frames = Slerp(imu_time_s, integral)(np.clip(time_s, imu_time_s[0], imu_time_s[-1]))
    correction = Rotation.from_matrix(rotation) * at_frames.inv()
    smooth = Slerp(time_s, correction)(np.clip(imu_time_s, time_s[0], time_s[-1]))
    return (smooth * integral).as_matrix()


def _running_product(steps: Rotation) -> Rotation:
    """Identity, s0, s0 s1, s0 s1 s2, ...: within blocks side by side, then the blocks one after another."""
    count = len(steps) + 1
    length = math.isqrt(count - 1) + 1
    blocks = -(-count // length)
    identity = [0.0, 0.0, 0.0, 1.0]
    quaternions = np.tile(identity, (blocks * length, 1))
    quaternions[1:count] = steps.as_quat()
    factors = quaternions.reshape(blocks, length, 4)
    within = [Rotation.from_quat(factors[:, 0])]
    for place in range(1, length):
        within.append(within[-1] * Rotation.from_quat(factors[:, place]))
    before = [Rotation.from_quat(identity)]
    for block in range(blocks - 1):
        before.append(before[-1] * within[-1][block])
    inside = np.stack([r.as_quat() for r in within], axis=1).reshape(-1, 4)[:count]
    carried = np.repeat([r.as_quat() for r in before], length, axis=0)[:count]
    return Rotation.from_quat(carried) * Rotation.from_quat(inside)


def gravity_from(rotation: np.ndarray, accel: np.ndarray) -> np.ndarray:
    """Gravity (3,) in the target frame: accelerations average out over a recording that starts and ends at a similar
    speed, gravity does not. `rotation` (N, 3, 3) R_target_imu, `accel` (N, 3)."""
    mean = np.einsum("nij,nj->i", rotation, accel) / len(accel)
    return -mean * (STANDARD_GRAVITY / np.linalg.norm(mean))


def lever_arms(
    reference: CameraTrack, others: Sequence[CameraTrack], shifts: Sequence[float], reference_shift: float
) -> list[np.ndarray]:
    """Position (3,) of the reference camera in each other camera's frame, from positions at equal times.

    Tracks need not be synchronised: the reference is interpolated between frames closer than the longest step.
    """
    time = reference.time_s + reference_shift
    arms = []
    for track, shift in zip(others, shifts, strict=True):
        at = track.time_s + shift
        after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
        near = (at >= time[0]) & (at <= time[-1]) & (time[after] - time[after - 1] < _LONGEST_STEP_S)
        if near.sum() < 5:
            arms.append(np.zeros(3))
            continue
        position = np.stack([np.interp(at[near], time, reference.position[:, a]) for a in range(3)], axis=1)
        local = np.einsum("fji,fj->fi", track.rotation[near], position - track.position[near])
        arms.append(np.median(local, axis=0))
    return arms


def check_coverage(
    tracks: Sequence[CameraTrack], shifts: Sequence[float], imu: ImuRecording, imu_time_s: np.ndarray
) -> None:
    """Raise CalibrationError when frames and IMU hardly overlap in time."""
    spans = [(t.time_s[0] + s, t.time_s[-1] + s) for t, s in zip(tracks, shifts, strict=True)]
    first, last = max(min(a for a, _ in spans), imu_time_s[0]), min(max(b for _, b in spans), imu_time_s[-1])
    if last - first < 1.0:
        raise CalibrationError(
            f"the frames ({min(a for a, _ in spans):.1f} to {max(b for _, b in spans):.1f} s) and the IMU "
            f"({imu_time_s[0]:.1f} to {imu_time_s[-1]:.1f} s, {len(imu)} samples) share less than a second. "
            "Are both on the same clock?"
        )
