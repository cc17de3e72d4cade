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
_FINE_STEP_S = 0.001
# The gyroscope's integral is sampled so many times per coarse step.
_GRID_PER_STEP = 4
_LARGEST_SHIFT_S = 5.0
_TRIM = 0.8
_LEAST_CORRELATION = 0.4
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
        return np.stack([np.interp(time_s, self._time, self._integral[:, a]) for a in range(3)], axis=1)

    def mean_rate(self, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
        """Mean angular velocity (n, 3) over spans; NaN where a span leaves the recording."""
        rate = (self._at(stop) - self._at(start)) / (stop - start)[:, None]
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


def align(track: CameraTrack, imu_time_s: np.ndarray, gyro: np.ndarray, name: str) -> Alignment:
    """Align a camera's turning with the gyroscope's.

    The offset is the peak of the correlation of the rates' magnitudes, refined below the grid by the residual of the
    best rotation (Kabsch 1976) over neighbouring offsets. Raises CalibrationError when the two do not move together or
    hardly turn.
    """
    start, stop, rate = _camera_rates(track, name)
    integral = TurnIntegral(imu_time_s, gyro)
    # The camera's rates are noisy, the gyroscope's biased: who does not turn is told by either.
    turning = min(_median_norm(rate), _median_norm(gyro - np.median(gyro, axis=0)))
    if turning < _LEAST_TURNING:
        raise CalibrationError(
            f"{name}: the camera hardly turns (median {np.degrees(turning):.1f} deg/s), so that its rotation and time "
            "offset to the IMU are not determined. Record with rotations about all three axes."
        )
    coarse, correlation = _coarse_shift(start, stop, rate, integral)
    if correlation < _LEAST_CORRELATION:
        _check_clock(start, stop, rate, integral, name)
        raise CalibrationError(
            f"{name}: its turning does not match the IMU's (correlation {correlation:.2f} at best, within "
            f"{_LARGEST_SHIFT_S:g} s). Are camera and IMU from the same recording, on clocks less than "
            f"{_LARGEST_SHIFT_S:g} s apart, and is the gyroscope in rad/s?"
        )
    _check_scale(rate, integral.mean_rate(start + coarse, stop + coarse), name)
    shift, unexplained = _fine_shift(start, stop, rate, integral, coarse)
    _check_clock(start, stop, rate, integral, name, unexplained)
    if unexplained > _LARGEST_UNEXPLAINED:
        raise CalibrationError(
            f"{name}: its turning does not match the IMU's: the best time offset ({shift:.3f} s) and rotation leave "
            f"{100 * unexplained:.0f} % of the gyroscope's variance unexplained. Are camera and IMU from the same "
            "recording, and are the frames' corners and times right?"
        )
    R_imu_cam, bias, _, spread = _rotation(start + shift, stop + shift, rate, integral)
    return Alignment(shift, R_imu_cam.T, bias, correlation, spread)


def _fine_shift(
    start: np.ndarray, stop: np.ndarray, rate: np.ndarray, integral: TurnIntegral, coarse: float
) -> tuple[float, float]:
    """The offset near `coarse` at which the best rotation leaves least, and the share of the gyroscope's variance that
    it leaves."""
    grid = coarse + np.arange(-15, 16) * _FINE_STEP_S
    costs = np.array([_rotation(start + s, stop + s, rate, integral)[2] for s in grid])
    best = int(np.clip(np.argmin(costs), 1, len(grid) - 2))
    left, middle, right = costs[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    shift = float(grid[best] + (0.5 * (left - right) / bend if bend > 0 else 0.0) * _FINE_STEP_S)
    cost = _rotation(start + shift, stop + shift, rate, integral)[2]
    measured = integral.mean_rate(start + shift, stop + shift)
    return shift, cost / float(np.nansum(np.nanvar(measured, axis=0)))


def _check_clock(
    start: np.ndarray, stop: np.ndarray, rate: np.ndarray, integral: TurnIntegral, name: str, left: float = np.inf
) -> None:
    """Raise CalibrationError when the offset that serves the first half of the recording is not that of the second, and
    one offset for both leaves clearly more unexplained (`left`) than two do."""
    middle = len(rate) // 2
    if middle < _LEAST_HALF:
        return
    shifts = []
    for half in (slice(None, middle), slice(middle, None)):
        coarse, correlation = _coarse_shift(start[half], stop[half], rate[half], integral)
        if correlation < _LEAST_CORRELATION:
            return  # a half that tells nothing by itself
        shift, unexplained = _fine_shift(start[half], stop[half], rate[half], integral, coarse)
        if unexplained > min(_CLEARLY_EXPLAINED, _WORTH_TWO * left):
            return
        shifts.append(shift)
    if abs(shifts[1] - shifts[0]) > _LARGEST_JUMP_S:
        raise CalibrationError(
            f"{name}: its clock and the IMU's do not run together: the time offset is {shifts[0]:.4f} s in the first "
            f"half of the frames (up to {start[middle]:.1f} s after the IMU's first sample) and {shifts[1]:.4f} s in "
            "the second. A clock jumped or drifts, or samples were lost and the others numbered on. Take the time "
            "stamps from the sensors' own clocks, or calibrate from the part of the recording before the jump."
        )


def turning(track: CameraTrack, name: str) -> tuple[np.ndarray, np.ndarray]:
    """A camera's rate of turn, as a gyroscope would have it: times (n,) between its frames, and rad/s (n, 3)."""
    start, stop, rate = _camera_rates(track, name)
    return 0.5 * (start + stop), rate


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


def _camera_rates(track: CameraTrack, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spans between consecutive frames (start, stop) and the mean rate of turn in each, camera frame."""
    step = np.diff(track.time_s)
    near = step < _LONGEST_STEP_S
    if near.sum() < 10:
        raise CalibrationError(
            f"{name}: only {near.sum()} pairs of frames with the board lie closer than {_LONGEST_STEP_S:g} s; the "
            "motion cannot be followed. Record at 10 Hz or more and keep the board in view."
        )
    relative = track.rotation[:-1].swapaxes(-1, -2) @ track.rotation[1:]
    rate = Rotation.from_matrix(relative[near]).as_rotvec() / step[near, None]
    return track.time_s[:-1][near], track.time_s[1:][near], rate


def _coarse_shift(start: np.ndarray, stop: np.ndarray, rate: np.ndarray, integral: TurnIntegral) -> tuple[float, float]:
    """Offset with the largest correlation of rate magnitudes over at least half of the spans.

    The gyroscope's turning is laid out once on a grid finer than the offsets tried, for each length of span that there
    is, so that to try an offset is to look up.
    """
    magnitude = np.minimum(np.linalg.norm(rate, axis=1), 20.0)
    fine = _COARSE_STEP_S / _GRID_PER_STEP
    spans, which = np.unique(np.maximum(np.round((stop - start) / fine).astype(np.int64), 1), return_inverse=True)
    turning = integral.turning_on_grid(fine, spans)
    size = turning.shape[1]
    place = np.round((start - integral.start_s) / fine).astype(np.int64)
    best = (0.0, -1.0)
    most = round(_LARGEST_SHIFT_S / _COARSE_STEP_S)
    for k in range(-most, most + 1):
        at = place + k * _GRID_PER_STEP
        within = (at >= 0) & (at < size)
        other = np.where(within, turning[which, np.where(within, at, 0)], np.nan)
        inside = np.isfinite(other)
        count = np.count_nonzero(inside)
        if count < 0.5 * len(magnitude):
            continue
        a, b = (magnitude, other) if count == len(other) else (magnitude[inside], other[inside])
        a, b = a - a.sum() / count, b - b.sum() / count
        spread = np.sqrt((a @ a) * (b @ b))
        correlation = float(a @ b / spread) if spread > 0 else 0.0
        # Among equals the smaller offset is the likelier.
        if correlation > best[1] + 1e-9:
            best = (k * _COARSE_STEP_S, correlation)
    return best


def _rotation(
    start: np.ndarray, stop: np.ndarray, rate: np.ndarray, integral: TurnIntegral
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """R_imu_cam, gyro bias, trimmed cost and excitation of the best rotation between rates, worst fifth left out."""
    measured = integral.mean_rate(start, stop)
    inside = np.isfinite(measured[:, 0])
    camera, imu = rate[inside], measured[inside]
    kept = np.ones(len(camera), dtype=bool)
    R, bias, error, values = np.eye(3), np.zeros(3), np.zeros(len(camera)), np.zeros(3)
    for _ in range(4):
        mean_camera, mean_imu = camera[kept].mean(axis=0), imu[kept].mean(axis=0)
        covariance = (imu[kept] - mean_imu).T @ (camera[kept] - mean_camera)
        u, values, vt = np.linalg.svd(covariance)
        R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        bias = mean_imu - R @ mean_camera
        error = np.sum((imu - camera @ R.T - bias) ** 2, axis=1)
        kept = error <= np.quantile(error, _TRIM)
    return R, bias, float(np.mean(error[kept])), np.sqrt(values / max(kept.sum(), 1))


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
