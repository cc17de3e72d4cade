"""How far a calibration of a simulated rig is from the truth: in its covariance's coordinates, and in its sigmas."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.imu import imu_model
from jaxcal.results import Calibration, ImuCalibration
from jaxcal.simulation import ImuTruth, SimulatedCamera, SimulatedRig


def perturbation(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(6,) rotation vector on the left (rad) and translation (m) that take a transform `truth` to `estimate`."""
    turn = Rotation.from_matrix(estimate[:3, :3] @ truth[:3, :3].T).as_rotvec()
    return np.concatenate([turn, estimate[:3, 3] - truth[:3, 3]])


def errors(
    calibration: Calibration,
    rig: SimulatedRig,
    imus: Sequence[ImuTruth] = (),
    line_delays_s: Sequence[float] | None = None,
) -> dict[str, np.ndarray]:
    """Estimate minus truth of the blocks of the calibration's covariance, each in its block's coordinates.

    Of cameras and gravity always; of IMUs where their truth is given, of line delays (one per camera) likewise.
    """
    found: dict[str, np.ndarray] = {}
    previous: SimulatedCamera | None = None
    for c, (camera, truth) in enumerate(zip(calibration.cameras, rig.cameras, strict=True)):
        found[f"{camera.name}.intrinsics"] = np.asarray(camera.model.intrinsics - truth.model.intrinsics)
        found[f"{camera.name}.distortion"] = np.asarray(camera.model.distortion - truth.model.distortion)
        if previous is not None and camera.T_cn_cnm1 is not None:
            relative = truth.T_cam_imu @ np.linalg.inv(previous.T_cam_imu)
            found[f"{camera.name}.T_cn_cnm1"] = perturbation(camera.T_cn_cnm1, relative)
        if camera.T_cam_imu is not None and camera.timeshift_cam_imu is not None:
            found[f"{camera.name}.T_cam_imu"] = perturbation(camera.T_cam_imu, truth.T_cam_imu)
            shift = camera.timeshift_cam_imu - truth.timeshift_cam_imu
            found[f"{camera.name}.timeshift_cam_imu"] = np.array([shift])
        if line_delays_s is not None and camera.line_delay_s is not None:
            found[f"{camera.name}.line_delay"] = np.array([camera.line_delay_s - line_delays_s[c]])
        previous = truth
    if calibration.gravity is not None:
        found["gravity"] = calibration.gravity - rig.gravity
    for number, (imu, truth) in enumerate(zip(calibration.imus, imus, strict=False)):
        found |= _imu_errors(imu, truth, number)
    return {name: found[name] for name, _ in calibration.blocks if name in found}


def _imu_errors(imu: ImuCalibration, truth: ImuTruth, number: int) -> dict[str, np.ndarray]:
    found = {}
    model = imu_model(truth.model)
    true = model.matrices(np.array(model.nominal if truth.parameters is None else truth.parameters))
    for block, _ in model.blocks:
        estimate, expected = imu.parameters[block], true[block]
        if block.startswith("M_"):
            found[f"imu{number}.{block}"] = (estimate - expected)[np.tril_indices(3)]
        elif block == "C_gyro_i":
            found[f"imu{number}.{block}"] = Rotation.from_matrix(estimate @ expected.T).as_rotvec()
        else:
            found[f"imu{number}.{block}"] = np.ravel(estimate - expected)
    if imu.T_imu_imu0 is not None and imu.timeshift_imu_imu0 is not None:
        found[f"imu{number}.T_imu_imu0"] = perturbation(imu.T_imu_imu0, truth.T_imu_imu0)
        found[f"imu{number}.timeshift_imu_imu0"] = np.array([imu.timeshift_imu_imu0 - truth.timeshift_imu_imu0])
    return found


def in_sigmas(calibration: Calibration, found: dict[str, np.ndarray]) -> np.ndarray:
    """Every number's error over its 1-sigma."""
    return np.concatenate([error / calibration.std(name) for name, error in found.items()])


def normalised_square(calibration: Calibration, found: dict[str, np.ndarray]) -> tuple[float, int]:
    """Mahalanobis distance squared of the truth, and its degrees of freedom: chi-squared if the covariance is right
    (normalised estimation error squared, NEES; Bar-Shalom, Li and Kirubarajan 2001, sec. 5.4)."""
    error, covariance = np.concatenate(list(found.values())), calibration.covariance_of(*found)
    sigma = np.sqrt(np.diag(covariance))
    free = sigma > 0
    values, vectors = np.linalg.eigh((covariance / np.outer(sigma, sigma))[np.ix_(free, free)])
    # Left out: relative poses of cameras repeat what T_cam_imu says, and gravity's length is known.
    known = values > 1e-8 * values.max()
    squares = (vectors.T @ (error[free] / sigma[free]))[known] ** 2 / values[known]
    return float(squares.sum()), int(known.sum())
