"""Basalt's calibration json (serialised by its headers_serialization.h): cameras, poses to the IMU, its noise."""

import json
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.cameras import CameraModel, model_name
from jaxcal.errors import CalibrationError
from jaxcal.observations import ImuNoise
from jaxcal.results.interchange.documents import Document, value_of
from jaxcal.results.interchange.lenses import coefficients_of, core_of, model_of, omni_of, planar, unified_of
from jaxcal.results.interchange.rig import (
    CalibratedRig,
    RigImu,
    camera_alone,
    chained,
    rate_of,
    shared_timeshift,
)
from jaxcal.results.kalibr import CamchainCamera, numbers

_CORE = ("fx", "fy", "cx", "cy")
_RADTAN8 = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_POSE = ("px", "py", "pz", "qx", "qy", "qz", "qw")
# Our name, Basalt's name, and the numbers in Basalt's order; what is in rational form comes last.
_TYPES = {
    "ds-none": ("ds", (*_CORE, "xi", "alpha")),
    "eucm-none": ("eucm", (*_CORE, "alpha", "beta")),
    "pinhole-equi": ("kb4", (*_CORE, "k1", "k2", "k3", "k4")),
    "omni-none": ("ucm", (*_CORE, "alpha")),
    "pinhole-none": ("pinhole", _CORE),
    "pinhole-radtan": ("pinhole-radtan8", (*_CORE, *_RADTAN8)),
    "pinhole-radtan5": ("pinhole-radtan8", (*_CORE, *_RADTAN8)),
    "pinhole-rational8": ("pinhole-radtan8", (*_CORE, *_RADTAN8)),
}
MODELS = tuple(_TYPES)
# What Basalt itself assumes of an IMU that nobody described (calibration.hpp).
_DEFAULT_NOISE = ImuNoise(0.000282, 0.0001, 0.016, 0.001, 200.0)


def recognises(document: Document) -> bool:
    """Whether a file is a calibration of Basalt."""
    return document.has("value0") and isinstance(document["value0"], dict) and "T_imu_cam" in document["value0"]


def write(rig: CalibratedRig) -> tuple[dict[str, str], tuple[str, ...]]:
    """calibration.json, and what it does not say of the rig. Without an IMU the body is the first camera."""
    imu = rig.imu or RigImu(_DEFAULT_NOISE)
    shift, notes = shared_timeshift(rig)
    if rig.imu is None:
        notes = (*notes, "the IMU's noise is not known: Basalt's own default is written")
    if rig.cameras[0].T_cam_imu is None:
        notes = (*notes, "without poses to an IMU, the first camera stands for it")
    if any(_TYPES[model_name(camera.model)][0] == "pinhole-radtan8" for camera in rig.cameras):
        notes = (*notes, "'pinhole-radtan8' is read by newer Basalt and by Monado's, not by older releases")
    noise = imu.noise
    content = {
        "T_imu_cam": [_pose(rig.T_body_cam(k)) for k in range(len(rig.cameras))],
        "intrinsics": [_intrinsics(camera.model) for camera in rig.cameras],
        "resolution": [list(camera.image_size) for camera in rig.cameras],
        "calib_accel_bias": _bias(imu.accel_bias, 9),
        "calib_gyro_bias": _bias(imu.gyro_bias, 12),
        "imu_update_rate": rate_of(imu),
        "accel_noise_std": [noise.accel_noise_density] * 3,
        "gyro_noise_std": [noise.gyro_noise_density] * 3,
        "accel_bias_std": [noise.accel_random_walk] * 3,
        "gyro_bias_std": [noise.gyro_random_walk] * 3,
        "cam_time_offset_ns": round(shift * 1e9),
        "vignette": [],
    }
    return {"calibration.json": json.dumps({"value0": content}, indent=4) + "\n"}, notes


def read(documents: list[Document]) -> CalibratedRig:
    """The rig that a calibration.json describes. Noise that differs by axis becomes its largest."""
    if len(documents) > 1:
        names = ", ".join(document.path.name for document in documents)
        raise CalibrationError(f"{documents[0].path.parent}: several calibrations of Basalt ({names}). Name one.")
    where = str(documents[0].path)
    content = documents[0]["value0"]
    shift = float(content.get("cam_time_offset_ns", 0)) * 1e-9
    poses, lenses = value_of(content, "T_imu_cam", where), value_of(content, "intrinsics", where)
    sizes = value_of(content, "resolution", where)
    if not len(poses) == len(lenses) == len(sizes):
        raise CalibrationError(
            f"{where}: {len(poses)} poses, {len(lenses)} lenses and {len(sizes)} resolutions; expected one per camera."
        )
    cameras = [
        _camera(k, *entry, shift, f"{where}: camera {k}")
        for k, entry in enumerate(zip(poses, lenses, sizes, strict=True))
    ]
    return CalibratedRig(chained(cameras), _read_imu(content, where), None, "basalt")


def _camera(index: int, pose: Any, lens: Any, size: Any, shift: float, where: str) -> CamchainCamera:
    width, height = numbers(size, (2,), f"{where}: resolution")
    return camera_alone(
        f"cam{index}",
        _model(lens, where),
        (int(width), int(height)),
        T_cam_imu=np.linalg.inv(_transform(pose, f"{where}: T_imu_cam")),
        timeshift_cam_imu=shift,
    )


def _pose(transform: np.ndarray) -> dict[str, float]:
    values = np.concatenate([transform[:3, 3], Rotation.from_matrix(transform[:3, :3]).as_quat(canonical=True)])
    return dict(zip(_POSE, values.tolist(), strict=True))


def _transform(pose: Any, where: str) -> np.ndarray:
    values = numbers([value_of(pose, name, where) for name in _POSE], (7,), where)
    if not np.isclose(np.linalg.norm(values[3:]), 1.0, atol=1e-3):
        raise CalibrationError(f"{where}: the quaternion {values[3:].tolist()} (x, y, z, w) is not of unit length.")
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
    return transform


def _intrinsics(model: CameraModel) -> dict[str, Any]:
    kind, names = _TYPES[model_name(model)]
    if kind == "pinhole-radtan8":
        values = dict(zip(names, [*core_of(model), *coefficients_of(model, 8)], strict=True)) | {"rpmax": 0.0}
    elif kind == "ucm":
        values = dict(zip(names, unified_of(model), strict=True))
    else:
        own = dict(
            zip((*model.parameter_names[0], *model.parameter_names[1]), np.asarray(model.parameters), strict=True)
        )
        values = {name: own[name] for name in names}
    return {"camera_type": kind, "intrinsics": {name: float(value) for name, value in values.items()}}


def _model(lens: Any, where: str) -> CameraModel:
    kind, fields = value_of(lens, "camera_type", where), value_of(lens, "intrinsics", where)
    ours = next((name for name, (theirs, _) in _TYPES.items() if theirs == kind), None)
    if ours is None:
        known = ", ".join(dict.fromkeys(theirs for theirs, _ in _TYPES.values()))
        raise CalibrationError(f"{where}: camera_type '{kind}' is not known here. Known: {known}.")
    names = _TYPES[ours][1]
    values = numbers([value_of(fields, name, where) for name in names], (len(names),), f"{where}: intrinsics")
    if kind == "pinhole-radtan8":
        return planar(values[:4], values[4:], where)
    if kind == "ucm":
        return omni_of(values)
    # Basalt puts fx, fy, cx, cy first; in our order they follow xi, alpha and beta, and precede k1..k4.
    return model_of(ours, values if kind in ("pinhole", "kb4") else np.roll(values, 2))


def _bias(bias: np.ndarray | None, size: int) -> list[float]:
    """Basalt's bias and scale parameters: the bias, then zeros (no scale, no misalignment)."""
    return np.pad(np.zeros(3) if bias is None else bias, (0, size - 3)).tolist()


def _read_imu(content: dict[str, Any], where: str) -> RigImu:
    def largest(key: str) -> float:
        return float(numbers(value_of(content, key, where), (3,), f"{where}: {key}").max())

    biases = []
    for key, size in (("calib_gyro_bias", 12), ("calib_accel_bias", 9)):
        values = numbers(value_of(content, key, where), (size,), f"{where}: {key}")
        if values[3:].any():
            raise CalibrationError(
                f"{where}: {key} corrects scale or misalignment too, which no rig here can hold. Correct the IMU's "
                "data, then set all but the first three numbers to zero."
            )
        biases.append(values[:3])
    noise = ImuNoise(
        largest("gyro_noise_std"),
        largest("gyro_bias_std"),
        largest("accel_noise_std"),
        largest("accel_bias_std"),
        float(value_of(content, "imu_update_rate", where)),
    )
    return RigImu(noise, *biases)
