"""OpenCV's FileStorage: one file per camera, in the keys of OpenCV's own samples, and poses beside them."""

from typing import Any

import cv2
import numpy as np

from jaxcal.cameras import CameraModel, model_name
from jaxcal.errors import CalibrationError
from jaxcal.results.interchange.documents import Document
from jaxcal.results.interchange.lenses import PLANAR, core_of, lens, planar
from jaxcal.results.interchange.rig import CalibratedRig, camera_alone, chained, file_stems
from jaxcal.results.kalibr import CamchainCamera, numbers, rigid_transform

# cv2.projectPoints; cv2.fisheye; cv2.omnidir with its xi.
MODELS = (*PLANAR[1:], "pinhole-none", "pinhole-equi", "omni-radtan", "omni-none")
_POSES = ("T_cn_cnm1", "T_cam_imu")


def recognises(document: Document) -> bool:
    """Whether a file is a camera in OpenCV's samples' keys."""
    return document.has("camera_matrix", "distortion_coefficients") and not (
        document.has("distortion_model") or document.has("projection_matrix")
    )


def write(rig: CalibratedRig) -> tuple[dict[str, str], tuple[str, ...]]:
    """One file per camera, <name>.yml: camera_matrix and distortion_coefficients as cv2's functions take them.

    `fisheye_model` 1 stands for cv2.fisheye, a key `xi` for cv2.omnidir. Beside OpenCV's own keys stand Kalibr's
    `T_cn_cnm1`, `T_cam_imu` and `timeshift_cam_imu`, where they are known.
    """
    return {f"{stem}.yml": _text(camera) for stem, camera in zip(file_stems(rig), rig.cameras, strict=True)}, ()


def read(documents: list[Document]) -> CalibratedRig:
    """A rig of one camera per file."""
    return CalibratedRig(chained(_camera(document) for document in documents), format="opencv")


def _text(camera: CamchainCamera) -> str:
    name = model_name(camera.model)
    fx, fy, cx, cy = core_of(camera.model)
    distortion = np.asarray(camera.model.distortion)
    if not len(distortion):
        distortion = np.zeros(4 if name.startswith("omni") else 5)
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_name", camera.name)
    storage.write("image_width", int(camera.image_size[0]))
    storage.write("image_height", int(camera.image_size[1]))
    storage.write("fisheye_model", int(name == "pinhole-equi"))
    storage.write("camera_matrix", np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
    storage.write("distortion_coefficients", distortion.reshape(-1, 1).astype(np.float64))
    if name.startswith("omni"):
        storage.write("xi", float(np.asarray(camera.model.intrinsics)[0]))
    for key in _POSES:
        pose = getattr(camera, key)
        if pose is not None:
            storage.write(key, np.asarray(pose, np.float64))
    if camera.timeshift_cam_imu is not None:
        storage.write("timeshift_cam_imu", float(camera.timeshift_cam_imu))
    text = storage.releaseAndGetString()
    # OpenCV before 5 reads no other version.
    return text.replace("%YAML 1.2", "%YAML:1.0", 1)


def _camera(document: Document) -> CamchainCamera:
    where, content = str(document.path), document.content
    size = numbers([document["image_width"], document["image_height"]], (2,), f"{where}: image size")
    chain, imu = (rigid_transform(content[key], f"{where}: {key}") if key in content else None for key in _POSES)
    shift = content.get("timeshift_cam_imu")
    return camera_alone(
        str(content.get("camera_name", document.path.stem)),
        _model(document, where),
        (int(size[0]), int(size[1])),
        T_cn_cnm1=chain,
        T_cam_imu=imu,
        timeshift_cam_imu=None if shift is None else float(shift),
    )


def _model(document: Document, where: str) -> CameraModel:
    matrix = numbers(document["camera_matrix"], (3, 3), f"{where}: camera_matrix")
    distortion = _flat(document["distortion_coefficients"], f"{where}: distortion_coefficients")
    core = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    if abs(matrix[0, 1]) > 1e-9 * matrix[0, 0]:
        raise CalibrationError(f"{where}: the camera matrix is skewed; no model here is. Calibrate with skew fixed.")
    if document.content.get("fisheye_model"):
        return lens("pinhole-equi", core, distortion, where)
    if "xi" in document.content:
        xi = _flat(document["xi"], f"{where}: xi")
        name = "omni-radtan" if distortion.any() else "omni-none"
        return lens(name, [*xi, *core], distortion if distortion.any() else (), where)
    return planar(core, distortion, where)


def _flat(value: Any, where: str) -> np.ndarray:
    return numbers(np.ravel(value), (-1,), where)
