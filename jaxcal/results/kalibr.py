"""Kalibr's yaml results: camchain and imu files, written as Kalibr writes them, and camchains read back."""

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from jaxcal.cameras import CameraModel, camera_model, model_name
from jaxcal.errors import CalibrationError
from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration

_OWN_DISTORTION = "custom"  # stands where the distortion is part of a 'module:Class' model
# Kalibr's files spell this distortion out; its command line, and so the names of models here, shorten it.
_SPELT_OUT = {"equi": "equidistant"}
_CAMERA_KEYS = (
    "T_cam_imu",
    "T_cn_cnm1",
    "cam_overlaps",
    "camera_model",
    "distortion_coeffs",
    "distortion_model",
    "intrinsics",
    "resolution",
    "rostopic",
    "timeshift_cam_imu",
)
_NEEDED_KEYS = ("camera_model", "distortion_coeffs", "distortion_model", "intrinsics", "resolution")


@dataclass(frozen=True)
class CamchainCamera:
    """One camera of a Kalibr camchain; transforms (4, 4) and the time offset (s) are None where the file has none."""

    name: str
    model: CameraModel
    image_size: tuple[int, int]
    T_cn_cnm1: np.ndarray | None
    T_cam_imu: np.ndarray | None
    timeshift_cam_imu: float | None
    overlaps: tuple[int, ...]
    rostopic: str | None = None


def camchain(calibration: Calibration) -> dict[str, Any]:
    """The content of `camchain.yaml` (without an IMU) or `camchain-imucam.yaml`: 'cam0' .. 'camN' to their entries."""
    return chain_content(camchain_cameras(calibration))


def camchain_cameras(calibration: Calibration) -> tuple[CamchainCamera, ...]:
    """The cameras of a calibration as a camchain describes them."""
    overlaps = camera_overlaps(calibration.cameras)
    return tuple(
        CamchainCamera(
            name=camera.name,
            model=camera.model,
            image_size=camera.image_size,
            T_cn_cnm1=camera.T_cn_cnm1,
            T_cam_imu=camera.T_cam_imu,
            timeshift_cam_imu=camera.timeshift_cam_imu,
            overlaps=tuple(overlaps[k]),
        )
        for k, camera in enumerate(calibration.cameras)
    )


def chain_content(cameras: tuple[CamchainCamera, ...]) -> dict[str, Any]:
    """The content of a camchain: 'cam0' .. 'camN' to their entries."""
    return {f"cam{k}": _camera_entry(camera) for k, camera in enumerate(cameras)}


def model_entry(model: CameraModel) -> dict[str, Any]:
    """A lens in a camchain: 'pinhole' and 'radtan', say, by Kalibr's names where it has them, or 'module:Class'."""
    projection, _, distortion = model_name(model).partition("-")
    if ":" in model_name(model):  # may have hyphens in its own name
        projection, distortion = model_name(model), _OWN_DISTORTION
    return {
        "camera_model": projection,
        "distortion_coeffs": np.asarray(model.distortion).tolist(),
        "distortion_model": _SPELT_OUT.get(distortion, distortion),
        "intrinsics": np.asarray(model.intrinsics).tolist(),
    }


def imu_entries(imus: Sequence[ImuCalibration]) -> dict[str, Any]:
    """The content of Kalibr's resulting `imu.yaml` for all IMUs: 'imu0' .. 'imuN', each by its model."""
    return {f"imu{k}": _imu_content(imu, k) for k, imu in enumerate(imus)}


def _imu_content(imu: ImuCalibration, number: int) -> dict[str, Any]:
    entry = dict(imu_entry(imu)["imu0"])
    found = {name: np.asarray(value).tolist() for name, value in imu.parameters.items()}
    entry |= {"model": imu.model, "rostopic": f"/imu{number}"}
    if imu.T_imu_imu0 is not None:
        entry |= {"T_i_b": np.asarray(imu.T_imu_imu0).tolist(), "time_offset": float(imu.timeshift_imu_imu0 or 0.0)}
    if found:
        entry["accelerometers"] = {"M": found["M_accel"]}
        entry["gyroscopes"] = {"A": found["A_gyro"], "C_gyro_i": found["C_gyro_i"], "M": found["M_gyro"]}
    if "r_y" in found:
        # The x axis' accelerometer defines the IMU's origin.
        entry["accelerometers"] |= {"rx_i": [0.0, 0.0, 0.0], "ry_i": found["r_y"], "rz_i": found["r_z"]}
    return dict(sorted(entry.items()))


def imu_entry(imu: ImuCalibration) -> dict[str, Any]:
    """The content of Kalibr's resulting `imu.yaml`, with the noise densities that the calibration used."""
    rate = imu.noise.get("update_rate")
    if rate is None:
        rate = 1.0 / float(np.median(np.diff(imu.t_s)))
    densities = {name: value for name, value in imu.noise.items() if name != "update_rate"}
    return noise_content(densities, rate)


def noise_content(densities: Mapping[str, float], rate: float) -> dict[str, Any]:
    """The content of Kalibr's resulting `imu.yaml` for densities by Kalibr's names and a sample rate in Hz."""
    entry = {
        "T_i_b": np.eye(4).tolist(),
        "accelerometer_noise_density": float(densities["accelerometer_noise_density"]),
        "accelerometer_random_walk": float(densities["accelerometer_random_walk"]),
        "gyroscope_noise_density": float(densities["gyroscope_noise_density"]),
        "gyroscope_random_walk": float(densities["gyroscope_random_walk"]),
        "model": "calibrated",
        "rostopic": "/imu0",
        "time_offset": 0.0,
        "update_rate": float(rate),
    }
    return {"imu0": entry}


def name_of(projection: str, distortion: str) -> str:
    """The name of the model that a camchain calls `projection` and `distortion`, such as 'pinhole' and 'radtan'."""
    if ":" in projection:
        return projection
    return f"{projection}-{next((short for short, long in _SPELT_OUT.items() if long == distortion), distortion)}"


def to_yaml(content: Mapping[str, Any]) -> str:
    """Yaml text laid out as Kalibr's: keys in order of the alphabet, one matrix row a line, floats to the last bit."""
    return yaml.safe_dump(dict(content), default_flow_style=None, width=math.inf, sort_keys=True)


def camera_overlaps(cameras: tuple[CameraCalibration, ...]) -> list[list[int]]:
    """For each camera the indices of the others that saw a target point at the same time (Kalibr's `cam_overlaps`).

    Frames count as simultaneous within half of the longer frame interval of the two, on a common clock.
    """
    overlaps: list[list[int]] = [[] for _ in cameras]
    for a in range(len(cameras)):
        for b in range(a + 1, len(cameras)):
            if _see_together(cameras[a], cameras[b]):
                overlaps[a].append(b)
                overlaps[b].append(a)
    return overlaps


def load_camchain(path: str | Path) -> tuple[CamchainCamera, ...]:
    """Read a Kalibr `camchain.yaml` or `camchain-imucam.yaml`, in order of the cameras' numbers.

    Raises CalibrationError when the file is missing, is not yaml, lacks a key or has an unknown one, or holds a
    transform that is not rigid.
    """
    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text())
    except FileNotFoundError as error:
        raise CalibrationError(
            f"{path}: no such camchain file. Kalibr and jaxcal write one per calibration."
        ) from error
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not a yaml file that can be read: {error}") from error
    return cameras_of_content(content, str(path))


def cameras_of_content(content: Any, where: str) -> tuple[CamchainCamera, ...]:
    """The cameras that the content of a camchain describes; `where` names the file in errors, as `load_camchain`'s."""
    if not isinstance(content, Mapping) or not content:
        raise CalibrationError(f"{where}: expected a camchain, with a key 'cam0' and one for each further camera.")
    for key in content:
        if not re.fullmatch(r"cam\d+", str(key)):
            raise CalibrationError(f"{where}: unknown key '{key}'. A camchain has the keys cam0, cam1, ... only.")
    ordered = sorted(content, key=lambda key: int(key[3:]))
    return tuple(_read_camera(str(key), content[key], f"{where}: {key}") for key in ordered)


# --- writing ---------------------------------------------------------------------------------------------------------


def _camera_entry(camera: CamchainCamera) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "cam_overlaps": list(camera.overlaps),
        **model_entry(camera.model),
        "resolution": [int(size) for size in camera.image_size],
        "rostopic": camera.rostopic or f"/{camera.name}/image_raw",
    }
    if camera.T_cam_imu is not None:
        entry["T_cam_imu"] = np.asarray(camera.T_cam_imu).tolist()
    if camera.T_cn_cnm1 is not None:
        entry["T_cn_cnm1"] = np.asarray(camera.T_cn_cnm1).tolist()
    if camera.timeshift_cam_imu is not None:
        entry["timeshift_cam_imu"] = float(camera.timeshift_cam_imu)
    return entry


def _see_together(a: CameraCalibration, b: CameraCalibration) -> bool:
    times_a, times_b = _common_clock_ns(a), _common_clock_ns(b)
    if not len(times_a) or not len(times_b):
        return False
    tolerance = max(_half_interval_ns(times_a), _half_interval_ns(times_b))
    points_a, points_b = _points_by_frame(a), _points_by_frame(b)
    for frame, points in points_a.items():
        after = int(np.searchsorted(times_b, times_a[frame]))
        for other in (after - 1, after):
            near = 0 <= other < len(times_b) and abs(int(times_b[other]) - int(times_a[frame])) <= tolerance
            if near and other in points_b and not points.isdisjoint(points_b[other]):
                return True
    return False


def _common_clock_ns(camera: CameraCalibration) -> np.ndarray:
    return camera.detections.timestamps_ns + round((camera.timeshift_cam_imu or 0.0) * 1e9)


def _half_interval_ns(times_ns: np.ndarray) -> float:
    return float(np.median(np.diff(times_ns))) / 2.0 if len(times_ns) > 1 else 0.0


def _points_by_frame(camera: CameraCalibration) -> dict[int, set[int]]:
    points: dict[int, set[int]] = {}
    for frame, point in zip(camera.detections.frame.tolist(), camera.detections.point.tolist(), strict=True):
        points.setdefault(frame, set()).add(point)
    return points


# --- reading ---------------------------------------------------------------------------------------------------------


def _read_camera(name: str, entry: Any, where: str) -> CamchainCamera:
    if not isinstance(entry, Mapping):
        raise CalibrationError(f"{where}: expected keys such as camera_model and intrinsics; found {entry!r}.")
    for key in entry:
        if key not in _CAMERA_KEYS:
            close = difflib.get_close_matches(str(key), _CAMERA_KEYS, n=1)
            hint = f" Did you mean '{close[0]}'?" if close else f" Known: {', '.join(_CAMERA_KEYS)}."
            raise CalibrationError(f"{where}: unknown key '{key}'.{hint}")
    missing = [key for key in _NEEDED_KEYS if key not in entry]
    if missing:
        raise CalibrationError(f"{where}: '{missing[0]}' is missing. A camera needs {', '.join(_NEEDED_KEYS)}.")
    width, height = numbers(entry["resolution"], (2,), f"{where}: resolution")
    shift = entry.get("timeshift_cam_imu")
    topic = entry.get("rostopic")
    return CamchainCamera(
        name=name,
        model=_read_model(entry, where),
        image_size=(int(width), int(height)),
        T_cn_cnm1=_transform(entry, "T_cn_cnm1", where),
        T_cam_imu=_transform(entry, "T_cam_imu", where),
        timeshift_cam_imu=None if shift is None else float(numbers(shift, (), f"{where}: timeshift_cam_imu")),
        overlaps=tuple(int(k) for k in entry.get("cam_overlaps") or ()),
        rostopic=None if topic is None else str(topic),
    )


def _read_model(entry: Mapping[str, Any], where: str) -> CameraModel:
    projection, distortion = str(entry["camera_model"]), str(entry["distortion_model"])
    intrinsics = numbers(entry["intrinsics"], (-1,), f"{where}: intrinsics")
    coefficients = numbers(entry["distortion_coeffs"], (-1,), f"{where}: distortion_coeffs")
    if distortion == "none" and ":" not in projection:
        coefficients = np.zeros(0)  # Kalibr writes zeros or an empty list here
    try:
        return camera_model(name_of(projection, distortion)).create(intrinsics, coefficients)
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def _transform(entry: Mapping[str, Any], key: str, where: str) -> np.ndarray | None:
    if key not in entry:
        return None
    return rigid_transform(entry[key], f"{where}: {key}")


def rigid_transform(value: Any, where: str) -> np.ndarray:
    """A (4, 4) matrix from nested lists. Raises CalibrationError unless it is a rotation and a translation."""
    matrix = numbers(value, (4, 4), where)
    rotation = matrix[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0
    if not rigid or not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise CalibrationError(
            f"{where} is not a rigid transform. Expected a rotation and a translation, with 0 0 0 1 as last row."
        )
    return matrix


def numbers(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """A float array of the shape given (-1: any length). Raises CalibrationError on other shapes and on what is no
    finite number; `where` names the value."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{where} is {value!r}; expected numbers.") from error
    fits = array.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        wanted = "x".join("n" if size < 0 else str(size) for size in shape) or "one"
        raise CalibrationError(f"{where} is {value!r}; expected {wanted} finite number(s).")
    return array
