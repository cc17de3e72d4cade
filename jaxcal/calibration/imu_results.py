"""What each IMU measured against what the trajectory says, for the result."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jaxcal.calibration import inertial
from jaxcal.calibration.extra_imus import times_of
from jaxcal.calibration.inertial_noise import NoiseModel
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.robust import RobustFit
from jaxcal.calibration.spline_setup import SplineGrid
from jaxcal.calibration.state import RigState, transform
from jaxcal.imu import imu_model
from jaxcal.observations import ImuRecording
from jaxcal.programs import stored_jit
from jaxcal.results import ImuCalibration
from jaxcal.trajectory import PoseSpline


def imu_calibrations(
    fit: RobustFit, imus: Sequence[ImuRecording], noise: NoiseModel, chain_covariance: np.ndarray, grid: SplineGrid
) -> list[ImuCalibration]:
    """One result per IMU; `chain_covariance` (H, B, B) of the chain blocks."""
    ratios = noise.ratios(fit.problem, fit.state)
    return [_one(fit, imus, noise, tuple(ratio.tolist()), chain_covariance, grid, i) for i, ratio in enumerate(ratios)]


@stored_jit
def _predicted(problem: RigProblem, state: RigState, imu: int) -> tuple:
    """Readings (I, S, 6), and R (I, S, 3, 3), p (I, S, 3) of the rig at the samples."""
    data = problem.imu
    assert data is not None
    samples = data.samples[imu]
    shape = samples.fraction.shape
    times = data.start + (jnp.arange(shape[0])[:, None] + samples.fraction) * data.dt
    times = times + state.imu_shift[imu] - samples.shift
    spline = PoseSpline(state.rotations, state.positions, data.start, data.dt, problem.order)
    rotation, position, *_ = spline.evaluate(times.ravel())
    readings = inertial.predict_samples(state, data, problem.order, problem.layout, imu)
    return readings, rotation.reshape(*shape, 3, 3), position.reshape(*shape, 3)


def _one(
    fit: RobustFit,
    imus: Sequence[ImuRecording],
    noise: NoiseModel,
    ratio: tuple[float, ...],
    chain_covariance: np.ndarray,
    grid: SplineGrid,
    number: int,
) -> ImuCalibration:
    assert fit.problem.imu is not None
    imu, state = imus[number], fit.state
    binned = noise.binned[number].at_shift(grid, float(fit.problem.imu.samples[number].shift))
    at = (binned.slots[:, 0], binned.slots[:, 1])
    readings, rotation, position = (np.asarray(part)[at] for part in _predicted(fit.problem, state, number))
    biases = np.asarray(state.biases)[:, 6 * number : 6 * number + 6]
    own = slice(6 * (grid.order - 1) + 6 * number, 6 * grid.order + 6 * number)
    std = np.sqrt(np.maximum(np.diagonal(chain_covariance[:, own, own], axis1=1, axis2=2), 0.0))
    block, place = np.divmod(binned.slots[:, 0], grid.order - 1)
    share = ((place + np.asarray(binned.samples.fraction)[at]) / (grid.order - 1))[:, None]
    bias, bias_std = ((1.0 - share) * values[block] + share * values[block + 1] for values in (biases, std))
    sigma = 1.0 / np.asarray(fit.problem.imu.samples[number].inverse_sigma)
    stated, place = imu.noise, fit.problem.layout.imus[number]
    return ImuCalibration(
        origin_ns=int(imus[0].timestamps_ns[0]),
        t_s=times_of(imus)[number][binned.index],
        gyro_rad_s=imu.gyro_rad_s[binned.index],
        accel_m_s2=imu.accel_m_s2[binned.index],
        gyro_predicted=readings[:, :3],
        accel_predicted=readings[:, 3:],
        gyro_bias=bias[:, :3],
        accel_bias=bias[:, 3:],
        gyro_sigma=float(sigma[0]),
        accel_sigma=float(sigma[3]),
        position_m=position,
        rotation=rotation,
        noise={
            "gyroscope_noise_density": stated.gyro_noise_density,
            "gyroscope_random_walk": stated.gyro_random_walk,
            "accelerometer_noise_density": stated.accel_noise_density,
            "accelerometer_random_walk": stated.accel_random_walk,
            "update_rate": imu.rate_hz,
        },
        knot_rate_hz=1.0 / grid.dt,
        spline_order=grid.order,
        gyro_bias_std=bias_std[:, :3],
        accel_bias_std=bias_std[:, 3:],
        model=place.model,
        parameters=imu_model(place.model).matrices(np.asarray(state.imu_parameters[number])),
        T_imu_imu0=_placed(state, number) if place.placed else None,
        timeshift_imu_imu0=float(state.imu_shift[number]) if place.placed else None,
        noise_ratio=(ratio[0], ratio[1]),
        recording=imu,
    )


def _placed(state: RigState, number: int) -> np.ndarray:
    return transform(np.asarray(state.R_imu_rig)[number], np.asarray(state.t_imu_rig)[number])
