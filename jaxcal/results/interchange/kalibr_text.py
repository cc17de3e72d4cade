"""Kalibr's results text, results-cam.txt and results-imucam.txt: written as Kalibr prints it, and read.

It holds what the camchain does not (sigmas, residuals, gravity), to eight digits, and lacks what the camchain has (the
image size), so it is no calibration by itself.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.cameras import model_name
from jaxcal.errors import CalibrationError
from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration
from jaxcal.results.kalibr import model_entry
from jaxcal.results.parameters import sigma_of
from jaxcal.targets import AprilGrid, Checkerboard, Target

_CLASSES = {
    "pinhole-radtan": "DistortedPinhole",
    "pinhole-equi": "EquidistantDistortedPinhole",
    "pinhole-fov": "FovDistortedPinhole",
    "pinhole-none": "Pinhole",
    "omni-radtan": "DistortedOmni",
    "omni-none": "Omni",
    "eucm-none": "ExtendedUnified",
    "ds-none": "DoubleSphere",
}
# What Kalibr calls the numbers before the focal length.
_FIRST = {"omni": ("Omni xi",), "eucm": ("EUCM alpha", "EUCM beta"), "ds": ("DS xi", "DS alpha")}


@dataclass(frozen=True)
class KalibrCameraResult:
    """What the text says of a camera; None where it does not.

    `reprojection_px` is mean, median and standard deviation of the 2-D errors; sigmas are 1-sigma, of `intrinsics` and
    `distortion` in the order of the camchain; `T_cam_imu` (4, 4) has eight digits, `timeshift_cam_imu` is in seconds.
    """

    name: str
    intrinsics: np.ndarray | None = None
    intrinsics_sigma: np.ndarray | None = None
    distortion: np.ndarray | None = None
    distortion_sigma: np.ndarray | None = None
    reprojection_px: tuple[float, float, float] | None = None
    T_cam_imu: np.ndarray | None = None
    timeshift_cam_imu: float | None = None


@dataclass(frozen=True)
class KalibrResults:
    """What a results text says; gravity (3,), m/s^2, in the target's frame; errors as mean, median and deviation."""

    cameras: tuple[KalibrCameraResult, ...]
    gravity: np.ndarray | None
    gyro_rad_s: tuple[float, float, float] | None
    accel_m_s2: tuple[float, float, float] | None


def results_files(calibration: Calibration) -> dict[str, str]:
    """results-imucam.txt of a calibration with an IMU, results-cam.txt of one without, by name."""
    if calibration.imu is None:
        return {"results-cam.txt": _cameras_text(calibration)}
    return {"results-imucam.txt": _imucam_text(calibration, calibration.imu)}


def is_results_text(text: object) -> bool:
    """Whether a text is one of Kalibr's."""
    return isinstance(text, str) and text.startswith("Calibration results") and "configuration\n====" in text


def read_kalibr_results(path: str | Path) -> KalibrResults:
    """Read Kalibr's results-cam.txt or results-imucam.txt. Raises CalibrationError when it is missing or neither."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: no results text that can be read: {error}") from error
    names = list(dict.fromkeys(re.findall(r"^(?:cam\d+(?= \(|$)|(?<=Transformation \()cam\d+)", text, re.MULTILINE)))
    if not is_results_text(text) or not names:
        raise CalibrationError(f"{path}: not Kalibr's results. Expected its results-cam.txt or results-imucam.txt.")
    gravity = re.search(r"^Gravity vector in target coords: \[m/s\^2\]\n(\[.*?\])$", text, re.MULTILINE)
    return KalibrResults(
        tuple(_read_camera(text, name) for name in names),
        None if gravity is None else _vector(gravity[1]),
        _read_statistics(text, r"Gyroscope error \(imu0\) \[rad/s\]:"),
        _read_statistics(text, r"Accelerometer error \(imu0\) \[m/s\^2\]:"),
    )


# --- with an IMU -----------------------------------------------------------------------------------------------------


def _imucam_text(calibration: Calibration, imu: ImuCalibration) -> str:
    lines = ["Calibration results", "===================", *_residuals(calibration, imu)]
    for k, camera in enumerate(calibration.cameras):
        T = np.eye(4) if camera.T_cam_imu is None else camera.T_cam_imu
        lines += ["", f"Transformation (cam{k}):", "-----------------------"]
        lines += [
            f"T_ci:  (imu0 to cam{k}): ",
            _array(T),
            "",
            f"T_ic:  (cam{k} to imu0): ",
            _array(np.linalg.inv(T)),
            "",
        ]
        lines += [
            f"timeshift cam{k} to imu0: [s] (t_imu = t_cam + shift)",
            str(float(camera.timeshift_cam_imu or 0.0)),
            "",
        ]
    lines += _baselines(calibration)
    gravity = np.full(3, np.nan) if calibration.gravity is None else calibration.gravity
    lines += ["", "Gravity vector in target coords: [m/s^2]", _array(gravity), "", ""]
    lines += ["Calibration configuration", "=========================", ""]
    for k, camera in enumerate(calibration.cameras):
        lines += [f"cam{k}", "-----", *_camera_details(camera), *_target_details(calibration.target), ""]
    lines += ["", "", "IMU configuration", "=================", "", "IMU0:", " ----------------------------"]
    return "\n".join([*lines, *_imu_details(imu), ""]) + "\n"


def _residuals(calibration: Calibration, imu: ImuCalibration) -> list[str]:
    gyro = np.linalg.norm(imu.gyro_rad_s - imu.gyro_predicted, axis=1)
    accel = np.linalg.norm(imu.accel_m_s2 - imu.accel_predicted, axis=1)
    normalised, plain = ["Normalized Residuals", "-" * 28], ["", "Residuals", "-" * 28]
    for k, camera in enumerate(calibration.cameras):
        sizes = np.linalg.norm(camera.residuals_px[camera.used], axis=1)
        normalised.append(_statistics(f"Reprojection error (cam{k}):     ", sizes / camera.corner_sigma_px))
        plain.append(_statistics(f"Reprojection error (cam{k}) [px]:     ", sizes))
    normalised.append(_statistics("Gyroscope error (imu0):        ", gyro / imu.gyro_sigma))
    normalised.append(_statistics("Accelerometer error (imu0):    ", accel / imu.accel_sigma))
    plain.append(_statistics("Gyroscope error (imu0) [rad/s]:     ", gyro))
    plain.append(_statistics("Accelerometer error (imu0) [m/s^2]: ", accel))
    return [*normalised, *plain]


def _statistics(label: str, sizes: np.ndarray) -> str:
    sizes = sizes[np.isfinite(sizes)]
    if not len(sizes):
        return f"{label}no corners"
    return f"{label}mean {np.mean(sizes)}, median {np.median(sizes)}, std: {np.std(sizes)}"


def _baselines(calibration: Calibration) -> list[str]:
    tied = [(k, c.T_cn_cnm1) for k, c in enumerate(calibration.cameras) if c.T_cn_cnm1 is not None]
    lines = ["Baselines:", "----------"] if tied else []
    for k, T in tied:
        length = np.linalg.norm(T[:3, 3])
        lines += [f"Baseline (cam{k - 1} to cam{k}): ", _array(T), f"baseline norm:  {length} [m]", ""]
    return lines


def _camera_details(camera: CameraCalibration) -> list[str]:
    entry = model_entry(camera.model)
    kind, values = entry["camera_model"], entry["intrinsics"]
    first = _FIRST.get(kind, ())
    lines = [f"  Camera model: {kind}", f"  Focal length: {values[len(first) : len(first) + 2]}"]
    lines.append(f"  Principal point: {values[len(first) + 2 :]}")
    lines += [f"  {name}: {value}" for name, value in zip(first, values, strict=False)]
    lines.append(f"  Distortion model: {entry['distortion_model']}")
    return [*lines, f"  Distortion coefficients: {entry['distortion_coeffs']}"]


def _target_details(target: Target) -> list[str]:
    lines = [f"  Type: {target.to_yaml()['target_type']}"]
    if isinstance(target, AprilGrid):
        lines += [
            "  Tags: ",
            f"    Rows: {target.rows}",
            f"    Cols: {target.cols}",
            f"    Size: {target.tag_size} [m]",
        ]
        lines.append(f"    Spacing {target.tag_size * target.tag_spacing} [m]")
    elif isinstance(target, Checkerboard):
        fields = target.to_yaml()
        for name in ("row", "col"):
            lines += [f"  {name.title()}s", f"    Count: {fields[f'target{name.title()}s']}"]
            lines.append(f"    Distance: {fields[f'{name}SpacingMeters']} [m]")
    return lines


def _imu_details(imu: ImuCalibration) -> list[str]:
    rate = float(imu.noise.get("update_rate") or 1.0 / np.median(np.diff(imu.t_s)))
    lines = ["  Model: calibrated", f"  Update rate: {rate}"]
    for title, name, gap in (("Accelerometer", "accelerometer", " "), ("Gyroscope", "gyroscope", "")):
        density = float(imu.noise[f"{name}_noise_density"])
        discrete = density / np.sqrt(1.0 / rate)
        lines += [f"  {title}:", f"    Noise density: {density}{gap}", f"    Noise density (discrete): {discrete} "]
        lines.append(f"    Random walk: {float(imu.noise[f'{name}_random_walk'])}")
    unit = [f"    {line}" for line in _array(np.eye(4)).splitlines()]
    return [*lines, "  T_ib (imu0 to imu0)", *unit, "  time offset with respect to IMU0: 0.0 [s]"]


# --- cameras alone ---------------------------------------------------------------------------------------------------


def _cameras_text(calibration: Calibration) -> str:
    lines = ["Calibration results ", "====================", "Camera-system parameters:"]
    for k, camera in enumerate(calibration.cameras):
        kept = camera.residuals_px[camera.used]
        mean, spread = (kept.mean(axis=0), kept.std(axis=0)) if len(kept) else (np.zeros(2), np.zeros(2))
        lines += [
            f"cam{k} (/{camera.name}/image_raw):",
            f"    type: <class 'aslam_cv.libaslam_cv_python.{_CLASSES[model_name(camera.model)]}CameraGeometry'>",
            f"    distortion: {_with_sigma(calibration, camera, 'distortion')}",
            f"    projection: {_with_sigma(calibration, camera, 'intrinsics')}",
            "    reprojection error: [%f, %f] +- [%f, %f]" % (*mean, *spread),  # noqa: UP031 - as Kalibr
            "",
        ]
    for k, camera in enumerate(calibration.cameras):
        T = camera.T_cn_cnm1
        if T is None:
            continue
        # Kalibr's quaternions (x y z w) turn the other way than Hamilton's: quat2r of its quaternion_algebra.cpp.
        q = Rotation.from_matrix(T[:3, :3]).inv().as_quat(canonical=True)
        sigma = sigma_of(calibration, f"{camera.name}.T_cn_cnm1")
        sigma = np.full(6, np.nan) if sigma is None else sigma
        lines += [
            f"baseline T_{k}_{k - 1}:",
            f"    q: {_array(q)} +- {_array(sigma[:3])}",
            f"    t: {_array(T[:3, 3])} +- {_array(sigma[3:])}",
            "",
        ]
    lines += ["", "", "Target configuration", "====================", "", *_target_details(calibration.target)]
    return "\n".join(lines) + "\n"


def _with_sigma(calibration: Calibration, camera: CameraCalibration, block: str) -> str:
    values, sigma = np.asarray(getattr(camera.model, block)), sigma_of(calibration, f"{camera.name}.{block}")
    return f"{_array(values)} +- {_array(np.full(len(values), np.nan) if sigma is None else sigma)}"


def _array(values: np.ndarray) -> str:
    """As numpy prints with Kalibr's settings."""
    return np.array2string(values, max_line_width=75, precision=8, suppress_small=True)


# --- reading ---------------------------------------------------------------------------------------------------------

_LIST = r"(\[[^\]]*\])"


def _read_camera(text: str, name: str) -> KalibrCameraResult:
    summary = re.search(rf"^{name} \(.*\):\n((?: .*\n)+)", text, re.MULTILINE)
    details = re.search(rf"^{name}\n-----\n((?:  .*\n)+)", text, re.MULTILINE)
    found: dict[str, np.ndarray] = {}
    for label, block in (("distortion", "distortion"), ("projection", "intrinsics")):
        match = re.search(rf"{label}: {_LIST} \+- {_LIST}", summary[1]) if summary else None
        if match:
            found |= {block: _vector(match[1]), f"{block}_sigma": _vector(match[2])}
    if details:
        found |= _read_details(details[1])
    pose = re.search(rf"^T_ci:  \(imu0 to {name}\): \n(\[\[(?:.|\n)*?\]\])", text, re.MULTILINE)
    shift = re.search(rf"^timeshift {name} to imu0: .*\n(\S+)", text, re.MULTILINE)
    return KalibrCameraResult(
        name,
        **found,
        reprojection_px=_read_statistics(text, rf"Reprojection error \({name}\) \[px\]:"),
        T_cam_imu=None if pose is None else _vector(pose[1]).reshape(4, 4),
        timeshift_cam_imu=None if shift is None else float(shift[1]),
    )


def _read_details(text: str) -> dict[str, np.ndarray]:
    """Intrinsics and distortion to the last digit, from the configuration."""
    kind = re.search(r"Camera model: (\w+)", text)
    first = [re.search(rf"{name}: (\S+)", text) for name in _FIRST.get(kind[1] if kind else "", ())]
    parts = [re.search(rf"{name}: {_LIST}", text) for name in ("Focal length", "Principal point")]
    distortion = re.search(rf"Distortion coefficients: {_LIST}", text)
    if None in first or None in parts or distortion is None:
        return {}
    numbers = [float(match[1]) for match in first if match] + [v for match in parts if match for v in _vector(match[1])]
    return {"intrinsics": np.array(numbers), "distortion": _vector(distortion[1])}


def _read_statistics(text: str, label: str) -> tuple[float, float, float] | None:
    match = re.search(rf"^{label}\s+mean (\S+), median (\S+), std: (\S+)$", text, re.MULTILINE)
    return None if match is None else (float(match[1]), float(match[2]), float(match[3]))


def _vector(text: str) -> np.ndarray:
    """The numbers of a printed list or array, flat."""
    return np.array([float(word) for word in re.sub(r"[\[\],]", " ", text).split()])
