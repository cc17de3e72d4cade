"""A calibration beside the truth that a simulation wrote down: estimate, 1-sigma, truth, error."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from jaxcal.cameras import model_name
from jaxcal.errors import CalibrationError
from jaxcal.results.calibration import Calibration, CameraCalibration
from jaxcal.results.kalibr import name_of
from jaxcal.results.parameters import parameter_names, sigma_of

_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Comparison:
    """One number of a calibration beside its true value, in `unit`; `sigma` is None where it is not known.

    For rotations `estimate` and `truth` are components of rotation vectors, and `error` is the rotation that takes
    one to the other, in the camera's frame: Log(R_estimate R_truth^T).
    """

    group: str
    name: str
    estimate: float
    sigma: float | None
    truth: float
    error: float
    unit: str

    @property
    def error_in_sigmas(self) -> float | None:
        """The error divided by its 1-sigma; None where there is no sigma, or the parameter was held."""
        return self.error / self.sigma if self.sigma else None


def compare_with_ground_truth(calibration: Calibration, path: str | Path) -> list[Comparison]:
    """Put every calibrated number beside its truth in a `ground_truth.yaml`.

    The file holds for each camera, under its name, `camera_model`, `intrinsics`, `distortion_model`,
    `distortion_coeffs`, `T_cam_imu` and `timeshift_cam_imu` (s); and `gravity_in_target` (m/s^2). Lengths are given in
    mm, rotations in degrees, times in ms. Lenses are compared where the calibrated model is the true one.

    Raises CalibrationError when the file is missing or malformed, or does not know a camera.
    """
    truth = _read(Path(path))
    comparisons: list[Comparison] = []
    previous: np.ndarray | None = None
    for index, camera in enumerate(calibration.cameras):
        if camera.name not in truth:
            raise CalibrationError(f"{path}: no camera '{camera.name}'; the file knows {', '.join(truth)}.")
        try:
            true_camera = truth[camera.name]
            T_cam_imu = np.array(true_camera["T_cam_imu"], np.float64).reshape(4, 4)
            comparisons += _camera(calibration, index, true_camera, T_cam_imu, previous)
        except (KeyError, TypeError, ValueError) as error:
            raise CalibrationError(
                f"{path}: '{camera.name}' is malformed ({type(error).__name__}: {error}). Expected camera_model, "
                "intrinsics, distortion_model, distortion_coeffs, T_cam_imu and timeshift_cam_imu."
            ) from error
        previous = T_cam_imu
    if calibration.gravity is not None and "gravity_in_target" in truth:
        gravity = np.asarray(truth["gravity_in_target"], np.float64)
        names = [f"g{axis}" for axis in _AXES]
        comparisons += _plain("gravity", names, calibration.gravity, sigma_of(calibration, "gravity"), gravity, "m/s^2")
    return comparisons


def comparison_table(comparisons: Sequence[Comparison]) -> str:
    """The comparisons as a text table, with the root mean square of all errors in sigmas below."""
    lines = [f"{'':28}{'estimate':>13}{'1-sigma':>12}{'truth':>13}{'error':>12}{'error/sigma':>13}"]
    group = None
    for row in comparisons:
        if row.group != group:
            group = row.group
            lines.append(group)
        sigma = "" if row.sigma is None else f"{row.sigma:12.5f}"
        ratio = "" if row.error_in_sigmas is None else f"{row.error_in_sigmas:13.2f}"
        label = f"  {row.name}" + (f" [{row.unit}]" if row.unit else "")
        lines.append(f"{label:28}{row.estimate:13.5f}{sigma:>12}{row.truth:13.5f}{row.error:12.5f}{ratio:>13}")
    ratios = np.array([row.error_in_sigmas for row in comparisons if row.error_in_sigmas is not None])
    if len(ratios):
        lines.append(
            f"error/sigma over {len(ratios)} numbers: rms {np.sqrt(np.mean(ratios**2)):.2f} (1 when the sigmas are "
            f"right), largest {np.abs(ratios).max():.2f}"
        )
    return "\n".join(lines)


def _camera(
    calibration: Calibration,
    index: int,
    truth: Mapping[str, Any],
    T_cam_imu: np.ndarray,
    previous_T_cam_imu: np.ndarray | None,
) -> Iterator[Comparison]:
    camera = calibration.cameras[index]
    yield from _lens(calibration, camera, truth)
    if camera.T_cn_cnm1 is not None and previous_T_cam_imu is not None:
        T_cn_cnm1 = T_cam_imu @ np.linalg.inv(previous_T_cam_imu)
        yield from _transform(calibration, f"{camera.name}.T_cn_cnm1", camera.T_cn_cnm1, T_cn_cnm1)
    if camera.T_cam_imu is not None:
        yield from _transform(calibration, f"{camera.name}.T_cam_imu", camera.T_cam_imu, T_cam_imu)
    if camera.timeshift_cam_imu is not None:
        sigma = sigma_of(calibration, f"{camera.name}.timeshift_cam_imu")
        values = (np.array([camera.timeshift_cam_imu]), np.array([float(truth["timeshift_cam_imu"])]))
        yield from _plain(camera.name, ["time offset"], values[0], sigma, values[1], "ms", scale=1e3)


def _lens(calibration: Calibration, camera: CameraCalibration, truth: Mapping[str, Any]) -> Iterator[Comparison]:
    if model_name(camera.model) != name_of(str(truth["camera_model"]), str(truth["distortion_model"])):
        return
    names = parameter_names(camera.model)
    parts = (
        ("intrinsics", camera.model.intrinsics, names[0], truth["intrinsics"], "px"),
        ("distortion", camera.model.distortion, names[1], truth["distortion_coeffs"], ""),
    )
    for block, values, labels, true_values, unit in parts:
        sigma = sigma_of(calibration, f"{camera.name}.{block}")
        yield from _plain(camera.name, labels, np.asarray(values), sigma, np.array(true_values, np.float64), unit)


def _transform(calibration: Calibration, block: str, estimate: np.ndarray, truth: np.ndarray) -> Iterator[Comparison]:
    sigma = sigma_of(calibration, block)
    sigmas = (None, None) if sigma is None else (sigma[:3], sigma[3:])
    rotation = Rotation.from_matrix(estimate[:3, :3])
    true_rotation = Rotation.from_matrix(truth[:3, :3])
    vector, true_vector = rotation.as_rotvec(), true_rotation.as_rotvec()
    if np.linalg.norm(vector - true_vector) > np.pi:  # the same turn, written the other way round
        true_vector = true_vector * (1.0 - 2.0 * np.pi / np.linalg.norm(true_vector))
    error = (rotation * true_rotation.inv()).as_rotvec()
    degrees = float(np.degrees(1.0))
    names = [f"rotation {axis}" for axis in _AXES]
    yield from _plain(block, names, vector, sigmas[0], true_vector, "deg", scale=degrees, error=error)
    names = [f"translation {axis}" for axis in _AXES]
    yield from _plain(block, names, estimate[:3, 3], sigmas[1], truth[:3, 3], "mm", scale=1e3)


def _plain(
    group: str,
    names: Sequence[str],
    estimate: np.ndarray,
    sigma: np.ndarray | None,
    truth: np.ndarray,
    unit: str,
    *,
    scale: float = 1.0,
    error: np.ndarray | None = None,
) -> list[Comparison]:
    error = estimate - truth if error is None else error
    sigmas = [None] * len(names) if sigma is None else [float(s) * scale for s in sigma]
    return [
        Comparison(group, name, float(e) * scale, s, float(t) * scale, float(d) * scale, unit)
        for name, e, s, t, d in zip(names, estimate, sigmas, truth, error, strict=True)
    ]


def _read(path: Path) -> Mapping[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: no such ground truth file.") from error
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not a readable yaml file: {error}") from error
    if not isinstance(content, Mapping):
        raise CalibrationError(f"{path}: expected camera names with their true parameters.")
    return content
