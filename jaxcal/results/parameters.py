"""Calibrated parameters as a person reads them: name, value, 1-sigma and unit, one scalar at a time."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.cameras import CameraModel
from jaxcal.results.calibration import Calibration


@dataclass(frozen=True)
class Estimate:
    """One number of the result. `sigma` is None where it is not known and 0 where the parameter was held."""

    name: str
    value: float
    sigma: float | None
    unit: str


def sigma_of(calibration: Calibration, block: str) -> np.ndarray | None:
    """1-sigma of a block of the covariance, or None where the calibration has no such block."""
    return calibration.std(block) if any(name == block for name, _ in calibration.blocks) else None


def parameter_names(model: CameraModel) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of a model's intrinsics and of its distortion coefficients, in the order of its parameters."""
    return model.parameter_names


def camera_estimates(calibration: Calibration, index: int) -> list[Estimate]:
    """Intrinsics (pixels for focal lengths and centre) and distortion of camera `index`."""
    camera = calibration.cameras[index]
    intrinsic_names, distortion_names = parameter_names(camera.model)
    groups = (
        (intrinsic_names, np.asarray(camera.model.intrinsics), "intrinsics"),
        (distortion_names, np.asarray(camera.model.distortion), "distortion"),
    )
    estimates = []
    for names, values, block in groups:
        sigmas = sigma_of(calibration, f"{camera.name}.{block}")
        for place, (name, value) in enumerate(zip(names, values, strict=True)):
            unit = "px" if name in ("fx", "fy", "cx", "cy") else ""
            estimates.append(Estimate(name, float(value), None if sigmas is None else float(sigmas[place]), unit))
    return estimates


def transform_estimates(calibration: Calibration, transform: np.ndarray, block: str) -> list[Estimate]:
    """Translation (mm) and rotation vector (deg) of a transform (4, 4) whose covariance block is `block`.

    The block holds a small rotation on the left, R = Exp(dr) R0; its covariance is carried to the rotation vector by
    the inverse left Jacobian of SO(3) (Sola, Deray & Atchuthan 2018, "A micro Lie theory", eq. 146).
    """
    vector = Rotation.from_matrix(transform[:3, :3]).as_rotvec()
    turn_sigma: np.ndarray | None = None
    shift_sigma: np.ndarray | None = None
    if sigma_of(calibration, block) is not None:
        covariance = calibration.covariance_of(block)
        jacobian = _inverse_left_jacobian(vector)
        turn_sigma = np.sqrt(np.maximum(np.diag(jacobian @ covariance[:3, :3] @ jacobian.T), 0.0))
        shift_sigma = np.sqrt(np.maximum(np.diag(covariance)[3:6], 0.0))
    return [
        *_three("t", transform[:3, 3] * 1e3, None if shift_sigma is None else shift_sigma * 1e3, "mm"),
        *_three("r", np.degrees(vector), None if turn_sigma is None else np.degrees(turn_sigma), "deg"),
    ]


def vector_estimates(calibration: Calibration, vector: np.ndarray, block: str, name: str, unit: str) -> list[Estimate]:
    """The three components of a vector (3,) such as gravity."""
    return _three(name, vector, sigma_of(calibration, block), unit)


def timeshift_estimate(calibration: Calibration, index: int) -> Estimate | None:
    """The time offset of camera `index` to the IMU in ms, or None without one."""
    camera = calibration.cameras[index]
    if camera.timeshift_cam_imu is None:
        return None
    sigma = sigma_of(calibration, f"{camera.name}.timeshift_cam_imu")
    return Estimate(
        "time offset", camera.timeshift_cam_imu * 1e3, None if sigma is None else float(sigma[0]) * 1e3, "ms"
    )


def format_estimate(value: float, sigma: float | None) -> tuple[str, str]:
    """Value and sigma as text, both to the second digit of sigma: (458.596, 0.0123) -> ('458.596', '0.012')."""
    if not math.isfinite(value):
        return str(value), "unknown"
    if sigma is None or not math.isfinite(sigma):
        return f"{value:.6g}", "unknown"
    if sigma == 0.0:
        return f"{value:.6g}", "held"
    decimals = min(max(1 - math.floor(math.log10(sigma)), 0), 12)
    return f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"


def _three(name: str, values: np.ndarray, sigmas: np.ndarray | None, unit: str) -> list[Estimate]:
    return [
        Estimate(f"{name} {axis}", float(values[k]), None if sigmas is None else float(sigmas[k]), unit)
        for k, axis in enumerate("xyz")
    ]


def _inverse_left_jacobian(vector: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-4:
        return np.eye(3) - cross / 2.0 + cross @ cross / 12.0
    weight = 1.0 / angle**2 - 1.0 / (2.0 * angle * math.tan(angle / 2.0))
    return np.eye(3) - cross / 2.0 + weight * cross @ cross
