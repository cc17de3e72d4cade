"""Knots of the trajectory spline: how dense, where, and with which first values; IMU samples binned between them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array
from scipy.interpolate import CubicSpline, PchipInterpolator, make_lsq_spline
from scipy.spatial.transform import Rotation, Slerp

from jaxcal.calibration.assemble import round_up
from jaxcal.calibration.inertial import INTERVAL_BATCH, ImuSamples
from jaxcal.estimation import on_device
from jaxcal.observations import ImuNoise, ImuRecording

SPLINE_ORDER = 6  # unless one is asked for
_RATES_HZ = (10.0, 15.0, 20.0, 30.0, 45.0, 70.0, 100.0)
# Event frames are not made more often than this for a spline: shorter windows hold too little, and between them the IMU
# says more.
_MOST_FRAMES_HZ = 50.0
# A knot rate is dense enough when a denser one lowers the IMU's residual by less than this share.
_ENOUGH = 1.05


@dataclass(frozen=True)
class SplineGrid:
    """A uniform spline of `order` with `intervals` intervals of `dt` s from `start` s on the IMU's clock; the last
    `intervals - used` only round the size up."""

    start: float
    dt: float
    order: int
    used: int
    intervals: int

    @property
    def stop(self) -> float:
        """The end of the part that is used, s."""
        return self.start + self.used * self.dt

    @property
    def control_times(self) -> np.ndarray:
        """Centre of each control point's influence (Greville abscissae), s."""
        count = self.intervals + self.order - 1
        return self.start + (np.arange(count) - 0.5 * (self.order - 2)) * self.dt


def make_grid(start: float, stop: float, order: int, knot_rate_hz: float) -> SplineGrid:
    """A grid that covers [start, stop]."""
    dt = 1.0 / knot_rate_hz
    used = max(int(np.ceil((stop - start) / dt)), 1)
    return SplineGrid(start, dt, order, used, round_up(used, INTERVAL_BATCH))


def choose_knot_rate(time_s: np.ndarray, gyro: np.ndarray, accel: np.ndarray, order: int) -> float:
    """The sparsest knot rate (Hz) whose spline follows the IMU as well as denser ones do.

    Least-squares splines of the degrees that angular velocity and acceleration have are fitted to the readings at
    rising knot rates, on the even samples, and judged on the odd ones: while the held-back residual still falls, the
    sparser spline was missing motion rather than noise.
    """
    rate_limit = 0.4 / np.median(np.diff(time_s))
    rates = [rate for rate in _RATES_HZ if rate <= rate_limit] or [_RATES_HZ[0]]
    scores = []
    for rate in rates:
        errors = [
            _held_back_error(time_s, values, rate, degree)
            for values, degree in ((gyro, order - 2), (accel, max(order - 3, 1)))
        ]
        scores.append(errors)
    table = np.array(scores)
    # Each sensor asks for its own sparsest sufficient rate; the spline has to serve both.
    dense_enough = table <= _ENOUGH * table.min(axis=0)
    return float(rates[int(np.max(np.argmax(dense_enough, axis=0)))])


def frame_rate_for_spline(imu: ImuRecording, order: int = SPLINE_ORDER, knot_rate_hz: float | None = None) -> float:
    """How often (Hz) a camera should look for every knot interval of the spline to have a frame: the knot rate, given
    or chosen as `calibrate_camera_imu` does from this recording; 50 Hz at most."""
    if knot_rate_hz is None:
        time_s = (imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9
        knot_rate_hz = choose_knot_rate(time_s, imu.gyro_rad_s, imu.accel_m_s2, order)
    return min(knot_rate_hz, _MOST_FRAMES_HZ)


def _held_back_error(time_s: np.ndarray, values: np.ndarray, rate: float, degree: int) -> float:
    count = max(int((time_s[-1] - time_s[0]) * rate), 2)
    inner = np.linspace(time_s[0], time_s[-1], count + 1)
    train_t, train_v = time_s[::2], values[::2]
    filled = np.unique(np.searchsorted(inner, train_t, side="right"))
    if len(filled) < count:  # a gap in the recording: keep only knots with samples between them
        inner = inner[np.concatenate([[0], np.intersect1d(filled, np.arange(1, count)), [count]])]
    knots = np.concatenate([[inner[0]] * degree, inner, [inner[-1]] * degree])
    test = slice(1, None, 2)
    inside = time_s[test] <= train_t[-1]
    try:
        spline = make_lsq_spline(train_t, train_v, knots, k=degree)
    except (ValueError, np.linalg.LinAlgError):  # too few samples between some knots for this rate
        return np.inf
    return float(np.sqrt(np.mean((spline(time_s[test][inside]) - values[test][inside]) ** 2)))


def first_chain(
    grid: SplineGrid,
    orientation_time_s: np.ndarray,
    orientation: np.ndarray,
    position_time_s: np.ndarray,
    position: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """First control rotations (K, 3, 3) and positions (K, 3): the curves' values at the control times."""
    times = grid.control_times
    clipped = np.clip(times, orientation_time_s[0], orientation_time_s[-1])
    rotations = Slerp(orientation_time_s, Rotation.from_matrix(orientation))(clipped).as_matrix()
    clipped = np.clip(times, position_time_s[0], position_time_s[-1])
    gaps = np.max(np.diff(position_time_s), initial=0.0)
    # A cubic spline is smoother, but overshoots across gaps.
    curve = CubicSpline(position_time_s, position) if gaps < 0.3 else PchipInterpolator(position_time_s, position)
    return rotations, np.asarray(curve(clipped))


@dataclass(frozen=True)
class BinnedImu:
    """IMU samples by knot interval: the padded arrays, and for each sample used its (interval, slot), its index in the
    recording and its time on the IMU's own clock, s."""

    samples: ImuSamples
    slots: np.ndarray
    index: np.ndarray
    time_s: np.ndarray

    def at_shift(self, grid: SplineGrid, shift_s: float) -> "BinnedImu":
        """The same samples, with the IMU's clock `shift_s` behind the grid's."""
        if shift_s == float(self.samples.shift):
            return self
        old = self.samples
        readings = np.asarray(old.readings)[self.slots[:, 0], self.slots[:, 1]]
        fraction, placed, present, slots = _place(grid, self.time_s + shift_s, readings, old.present.shape[1])
        samples = ImuSamples(
            fraction, placed, present, old.inverse_sigma, old.walk_sigma, shift=on_device(float(shift_s))
        )
        return BinnedImu(samples, slots, self.index, self.time_s)


def bin_imu(
    grid: SplineGrid,
    time_s: np.ndarray,
    gyro: np.ndarray,
    accel: np.ndarray,
    noise: ImuNoise,
    rate_hz: float,
    shift_s: float = 0.0,
) -> BinnedImu:
    """Bin samples at `time_s` on the IMU's own clock, `shift_s` behind the grid's."""
    on_grid = time_s + shift_s
    inside = np.flatnonzero((on_grid >= grid.start) & (on_grid < grid.stop))
    readings = np.concatenate([gyro[inside], accel[inside]], axis=1)
    fraction, placed, present, slots = _place(grid, on_grid[inside], readings, 1)
    # A density becomes the noise of one sample by the root of the rate, a random walk's step by the root of the time.
    sample = np.sqrt(rate_hz)
    step = np.sqrt(grid.dt)
    samples = ImuSamples(
        fraction=fraction,
        readings=placed,
        present=present,
        inverse_sigma=on_device(
            np.repeat([1.0 / (noise.gyro_noise_density * sample), 1.0 / (noise.accel_noise_density * sample)], 3)
        ),
        walk_sigma=on_device(np.repeat([noise.gyro_random_walk * step, noise.accel_random_walk * step], 3)),
        shift=on_device(float(shift_s)),
    )
    return BinnedImu(samples, slots, inside, time_s[inside])


def _place(
    grid: SplineGrid, on_grid: np.ndarray, readings: np.ndarray, least: int
) -> tuple[Array, Array, Array, np.ndarray]:
    """Fractions (I, S), readings (I, S, 6) and presence (I, S) of samples, and their (interval, slot); S at least
    `least`."""
    place = (on_grid - grid.start) / grid.dt
    interval = np.clip(np.floor(place).astype(int), 0, grid.used - 1)
    first = np.searchsorted(interval, np.arange(grid.intervals))
    slot = np.arange(len(on_grid)) - first[interval]
    shape = (grid.intervals, max(round_up(int(slot.max(initial=0)) + 1, 2), least))
    fraction, placed, present = np.zeros(shape), np.zeros((*shape, 6)), np.zeros(shape)
    fraction[interval, slot] = place - interval
    placed[interval, slot] = readings
    present[interval, slot] = 1.0
    return on_device(fraction), on_device(placed), on_device(present), np.stack([interval, slot], axis=1)
