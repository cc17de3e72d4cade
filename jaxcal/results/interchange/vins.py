"""VINS-Fusion's configuration, and its camera files, which are CamOdoCal's (also VINS-Mono's lenses)."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxcal.cameras import CameraModel, camera_model, model_name
from jaxcal.errors import CalibrationError
from jaxcal.observations import ImuNoise
from jaxcal.results.interchange.documents import Document, read_document, value_of
from jaxcal.results.interchange.lenses import coefficients_of, core_of, planar
from jaxcal.results.interchange.rig import CalibratedRig, RigImu, camera_alone, chained, shared_timeshift
from jaxcal.results.kalibr import CamchainCamera, numbers, rigid_transform

_RADTAN = ("k1", "k2", "p1", "p2")
_FULL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_CORE = ("fx", "fy", "cx", "cy")
_MEI_CORE = ("gamma1", "gamma2", "u0", "v0")
_KANNALA = ("k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0")
_KINDS = {
    "pinhole-radtan": "PINHOLE",
    "pinhole-none": "PINHOLE",
    "pinhole-radtan5": "PINHOLE_FULL",
    "pinhole-rational8": "PINHOLE_FULL",
    "pinhole-equi": "KANNALA_BRANDT",
    "omni-radtan": "MEI",
    "omni-none": "MEI",
}
MODELS = tuple(_KINDS)
_MOST_CAMERAS = 2
# Tuning that VINS-Fusion cannot start without: the values of its own configuration for EuRoC.
_TUNING = """
# tracking and optimisation: VINS-Fusion's own values for EuRoC, not from the calibration
multiple_thread: 1
max_cnt: 150
min_dist: 30
freq: 10
F_threshold: 1.0
show_track: 1
flow_back: 1
max_solver_time: 0.04
max_num_iterations: 8
keyframe_parallax: 10.0
load_previous_pose_graph: 0
pose_graph_save_path: "~/output/pose_graph/"
save_image: 1
"""


def recognises(document: Document) -> bool:
    """Whether a file is a camera or a configuration of VINS-Fusion."""
    return document.has("model_type") or document.has("cam0_calib")


def write(rig: CalibratedRig) -> tuple[dict[str, str], tuple[str, ...]]:
    """vins_config.yaml and cam0.yaml, cam1.yaml, and what they do not say.

    The noise is written as Kalibr's continuous densities. Raises CalibrationError on more than two cameras.
    """
    if len(rig.cameras) > _MOST_CAMERAS:
        raise CalibrationError(f"VINS-Fusion takes one or two cameras; this rig has {len(rig.cameras)}.")
    if rig.imu is None and rig.cameras[0].T_cam_imu is not None:
        raise CalibrationError("VINS-Fusion needs the IMU's noise: name its imu.yaml too, or the folder with both.")
    shift, notes = shared_timeshift(rig)
    files = {"vins_config.yaml": _config(rig, shift)}
    files |= {f"cam{k}.yaml": _camera_text(camera, f"cam{k}") for k, camera in enumerate(rig.cameras)}
    return files, (*notes, "thresholds of tracking and optimisation are VINS-Fusion's own for EuRoC: tune them")


def read(documents: list[Document]) -> CalibratedRig:
    """The rig of a configuration and the camera files that it names, or of camera files alone."""
    configurations = [document for document in documents if document.has("cam0_calib")]
    if len(configurations) > 1:
        names = ", ".join(document.path.name for document in configurations)
        raise CalibrationError(f"{configurations[0].path.parent}: several configurations ({names}). Name one.")
    if configurations:
        return _rig_of_config(configurations[0])
    return CalibratedRig(tuple(_read_camera(document, document.path.stem) for document in documents), format="vins")


def _rig_of_config(config: Document) -> CalibratedRig:
    where = str(config.path)
    with_imu = bool(config.content.get("imu", 1))
    shift = (_number(config, "td") if "td" in config.content else 0.0) if with_imu else None
    count = int(config.content.get("num_of_cam", 1))
    T_body_cam = [
        rigid_transform(config[f"body_T_cam{k}"], f"{where}: body_T_cam{k}")
        if f"body_T_cam{k}" in config.content
        else np.eye(4)
        for k in range(count)
    ]
    cameras = []
    for k in range(count):
        file = config.path.parent / str(config[f"cam{k}_calib"])
        tied = k > 0 and not with_imu
        cameras.append(
            _read_camera(
                read_document(file),
                f"cam{k}",
                T_cam_imu=np.linalg.inv(T_body_cam[k]) if with_imu else None,
                T_cn_cnm1=np.linalg.inv(T_body_cam[k]) @ T_body_cam[k - 1] if tied else None,
                timeshift_cam_imu=shift,
                rostopic=config.content.get(f"image{k}_topic"),
            )
        )
    if not with_imu:
        return CalibratedRig(tuple(cameras), format="vins")
    densities = [_number(config, key) for key in ("gyr_n", "gyr_w", "acc_n", "acc_w")]
    gravity = _number(config, "g_norm") if "g_norm" in config.content else None
    imu = RigImu(ImuNoise(*densities))
    return CalibratedRig(chained(cameras), imu, gravity, "vins")


def _number(document: Document, key: str) -> float:
    return float(numbers(document[key], (), f"{document.path}: {key}"))


# --- configuration ---------------------------------------------------------------------------------------------------


def _config(rig: CalibratedRig, shift: float) -> str:
    width, height = rig.cameras[0].image_size
    lines = ["%YAML:1.0", "", f"imu: {int(rig.imu is not None)}", f"num_of_cam: {len(rig.cameras)}", ""]
    if rig.imu is not None:
        lines.append('imu_topic: "/imu0"')
    for k, camera in enumerate(rig.cameras):
        lines.append(f'image{k}_topic: "{camera.rostopic or f"/{camera.name}/image_raw"}"')
    lines += ['output_path: "~/output/"', ""]
    lines += [f'cam{k}_calib: "cam{k}.yaml"' for k in range(len(rig.cameras))]
    lines += [f"image_width: {width}", f"image_height: {height}", "", "estimate_extrinsic: 0", ""]
    for k in range(len(rig.cameras)):
        lines += _matrix(f"body_T_cam{k}", rig.T_body_cam(k))
    if rig.imu is not None:
        noise = rig.imu.noise
        lines += [
            f"acc_n: {noise.accel_noise_density!r}",
            f"gyr_n: {noise.gyro_noise_density!r}",
            f"acc_w: {noise.accel_random_walk!r}",
            f"gyr_w: {noise.gyro_random_walk!r}",
            f"g_norm: {rig.gravity_m_s2 or 9.81007!r}",
            "",
        ]
    # readed image clock + td = real image clock (IMU clock), says VINS-Fusion: as t_imu = t_cam + shift.
    return "\n".join([*lines, "estimate_td: 0", f"td: {shift!r}"]) + "\n" + _TUNING


def _matrix(name: str, matrix: np.ndarray) -> list[str]:
    rows = [", ".join(repr(float(value)) for value in row) for row in matrix]
    data = ",\n          ".join(rows)
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {matrix.shape[0]}",
        f"   cols: {matrix.shape[1]}",
        "   dt: d",
        f"   data: [{data}]",
        "",
    ]


# --- cameras ---------------------------------------------------------------------------------------------------------


def _camera_text(camera: CamchainCamera, name: str) -> str:
    width, height = camera.image_size
    kind = _KINDS[model_name(camera.model)]
    lines = ["%YAML:1.0", "---", f"model_type: {kind}", f"camera_name: {name}"]
    lines += [f"image_width: {width}", f"image_height: {height}"]
    for group, values in _groups(camera.model, kind).items():
        lines += [f"{group}:", *(f"   {key}: {float(value)!r}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def _groups(model: CameraModel, kind: str) -> dict[str, dict[Any, float]]:
    core = core_of(model)
    if kind == "KANNALA_BRANDT":
        return {"projection_parameters": dict(zip(_KANNALA, [*np.asarray(model.distortion), *core], strict=True))}
    names = _FULL if kind == "PINHOLE_FULL" else _RADTAN
    groups = {"distortion_parameters": dict(zip(names, coefficients_of(model, len(names)), strict=True))}
    if kind == "MEI":
        mirror = {"mirror_parameters": {"xi": float(np.asarray(model.intrinsics)[0])}}
        return mirror | groups | {"projection_parameters": dict(zip(_MEI_CORE, core, strict=True))}
    return groups | {"projection_parameters": dict(zip(_CORE, core, strict=True))}


def _read_camera(document: Document, name: str, **known: Any) -> CamchainCamera:
    where = str(document.path)
    size = numbers([document["image_width"], document["image_height"]], (2,), f"{where}: image size")
    return camera_alone(name, _model(document.content, where), (int(size[0]), int(size[1])), **known)


def _model(content: Mapping[str, Any], where: str) -> CameraModel:
    kind = str(value_of(content, "model_type", where)).upper()
    if kind not in _KINDS.values():
        known = ", ".join(dict.fromkeys(_KINDS.values()))
        raise CalibrationError(f"{where}: model_type '{kind}' is not known here. Known: {known}.")

    def group(key: str, names: tuple[str, ...]) -> np.ndarray:
        values = [value_of(value_of(content, key, where), name, f"{where}: {key}") for name in names]
        return numbers(values, (len(names),), f"{where}: {key}")

    if kind == "KANNALA_BRANDT":
        values = group("projection_parameters", _KANNALA)
        return camera_model("pinhole-equi").create(values[4:], values[:4])
    if kind == "MEI":
        xi = group("mirror_parameters", ("xi",))
        core, distortion = group("projection_parameters", _MEI_CORE), group("distortion_parameters", _RADTAN)
        name = "omni-radtan" if distortion.any() else "omni-none"
        return camera_model(name).create([*xi, *core], distortion if distortion.any() else ())
    names = _FULL if kind == "PINHOLE_FULL" else _RADTAN
    return planar(group("projection_parameters", _CORE), group("distortion_parameters", names), where)
