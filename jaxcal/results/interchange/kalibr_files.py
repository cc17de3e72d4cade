"""Kalibr's camchain.yaml, camchain-imucam.yaml and imu.yaml, and OpenVINS' files, which are nearly the same."""

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from jaxcal.cameras import model_name
from jaxcal.errors import CalibrationError
from jaxcal.observations import ImuNoise
from jaxcal.results.interchange.documents import Document, value_of
from jaxcal.results.interchange.rig import CalibratedRig, RigImu, chained, rate_of
from jaxcal.results.kalibr import (
    CamchainCamera,
    cameras_of_content,
    chain_content,
    noise_content,
    rigid_transform,
    to_yaml,
)

# ConfigReader.py of Kalibr: what it can load again.
KALIBR_MODELS = (
    "pinhole-radtan",
    "pinhole-equi",
    "pinhole-fov",
    "pinhole-none",
    "omni-radtan",
    "omni-none",
    "eucm-none",
    "ds-none",
)
OPENVINS_MODELS = ("pinhole-radtan", "pinhole-equi", "pinhole-none")

_DENSITIES = (
    "gyroscope_noise_density",
    "gyroscope_random_walk",
    "accelerometer_noise_density",
    "accelerometer_random_walk",
)


def is_camchain(content: Any) -> bool:
    """Whether the content is that of a camchain, of Kalibr or of OpenVINS."""
    if not isinstance(content, Mapping) or not content:
        return False
    return all(
        re.fullmatch(r"cam\d+", str(key)) and isinstance(entry, Mapping) and "camera_model" in entry
        for key, entry in content.items()
    )


def is_imu(content: Any) -> bool:
    """Whether the content is that of an imu.yaml, given to Kalibr or written by it."""
    return isinstance(content, Mapping) and ("imu0" in content or "accelerometer_noise_density" in content)


def recognises_kalibr(document: Document) -> bool:
    """Whether a file is Kalibr's."""
    return not document.by_opencv and (is_camchain(document.content) or is_imu(document.content))


def recognises_openvins(document: Document) -> bool:
    """Whether a file is one that OpenVINS reads, with OpenCV's FileStorage."""
    return document.by_opencv and (is_camchain(document.content) or is_imu(document.content))


def write_kalibr(rig: CalibratedRig) -> tuple[dict[str, str], tuple[str, ...]]:
    """camchain.yaml, or camchain-imucam.yaml, imu.yaml as Kalibr writes it and imu0.yaml as Kalibr's --imu reads it.

    Kalibr cannot read its own resulting imu.yaml: its ConfigReader wants the keys without 'imu0' above them.
    """
    chain = to_yaml(chain_content(rig.cameras))
    if rig.imu is None:
        return {"camchain.yaml": chain}, ()
    noise = _noise(rig.imu)
    given = {key: noise["imu0"][key] for key in (*_DENSITIES, "rostopic", "update_rate")}
    flat = yaml.safe_dump(given, default_flow_style=False)
    return {"camchain-imucam.yaml": chain, "imu.yaml": to_yaml(noise), "imu0.yaml": flat}, ()


def write_openvins(rig: CalibratedRig) -> tuple[dict[str, str], tuple[str, ...]]:
    """kalibr_imucam_chain.yaml with `T_imu_cam`, and kalibr_imu_chain.yaml, as OpenVINS' configurations name them.

    Raises CalibrationError when a camera has no pose to the IMU.
    """
    if any(camera.T_cam_imu is None for camera in rig.cameras):
        raise CalibrationError("OpenVINS needs each camera's pose to an IMU: calibrate the cameras with the IMU.")
    entries = {}
    for k, camera in enumerate(rig.cameras):
        entry = dict(chain_content((camera,))["cam0"])
        if model_name(camera.model) == "pinhole-none":
            entry |= {"distortion_model": "radtan", "distortion_coeffs": [0.0] * 4}
        entry.pop("T_cam_imu")
        entry.pop("T_cn_cnm1", None)
        entries[f"cam{k}"] = {"T_imu_cam": rig.T_body_cam(k).tolist()} | entry
    files = {"kalibr_imucam_chain.yaml": _for_opencv(entries)}
    if rig.imu is None:
        return files, ("the IMU's noise is not known, and its file not written",)
    imu = dict(_noise(rig.imu)["imu0"])
    # OpenVINS' names of an IMU without intrinsics: unit matrices, no g-sensitivity.
    one, zero = np.eye(3).tolist(), np.zeros((3, 3)).tolist()
    imu |= {"model": "kalibr", "Tw": one, "R_IMUtoGYRO": one, "Ta": one, "R_IMUtoACC": one, "Tg": zero}
    return files | {"kalibr_imu_chain.yaml": _for_opencv({"imu0": imu})}, ()


def read(documents: list[Document]) -> CalibratedRig:
    """The rig that a camchain and an imu.yaml describe, either of which may be missing."""
    chains = [document for document in documents if is_camchain(document.content)]
    imus = [document for document in documents if is_imu(document.content)]
    # Kalibr leaves both beside each other; the second holds all that the first does.
    with_imu = [d for d in chains if any("T_cam_imu" in e or "T_imu_cam" in e for e in d.content.values())]
    chains, imus = with_imu or chains, [d for d in imus if "imu0" in d.content] or imus
    for kind, found in (("camchains", chains), ("imu files", imus)):
        if len(found) > 1:
            names = ", ".join(document.path.name for document in found)
            raise CalibrationError(f"{found[0].path.parent}: several {kind} ({names}). Name one.")
    cameras = () if not chains else chained(_cameras(chains[0]))
    return CalibratedRig(
        cameras,
        _read_imu(imus[0]) if imus else None,
        None,
        "openvins" if documents[0].by_opencv else "kalibr",
    )


def _cameras(document: Document) -> tuple[CamchainCamera, ...]:
    content = {key: _with_T_cam_imu(entry, f"{document.path}: {key}") for key, entry in document.content.items()}
    return cameras_of_content(content, str(document.path))


def _with_T_cam_imu(entry: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The entry with Kalibr's direction of the pose, where OpenVINS gives the other."""
    if "T_imu_cam" not in entry:
        return dict(entry)
    inverse = np.linalg.inv(rigid_transform(entry["T_imu_cam"], f"{where}: T_imu_cam"))
    return {key: value for key, value in entry.items() if key != "T_imu_cam"} | {"T_cam_imu": inverse.tolist()}


def _noise(imu: RigImu) -> dict[str, Any]:
    noise = imu.noise
    values = (noise.gyro_noise_density, noise.gyro_random_walk, noise.accel_noise_density, noise.accel_random_walk)
    return noise_content(dict(zip(_DENSITIES, values, strict=True)), rate_of(imu))


def _read_imu(document: Document) -> RigImu:
    content, where = document.content, str(document.path)
    if "imu0" in content:
        content, where = content["imu0"], f"{where}: imu0"
    others = [key for key in document.content if re.fullmatch(r"imu[1-9]\d*", str(key))]
    if others:
        raise CalibrationError(f"{where}: there is '{others[0]}' too; rigs with one IMU are read. Take it out.")
    if content.get("model", "calibrated") not in ("calibrated", "kalibr", "rpng") or "gyroscopes" in content:
        raise CalibrationError(
            f"{where}: model '{content.get('model')}' corrects scale and misalignment, which no rig here can hold. "
            "Calibrate the IMU with the model 'calibrated'."
        )
    try:
        densities = {name: float(value_of(content, name, where)) for name in _DENSITIES}
        rate = content.get("update_rate")
        return RigImu(ImuNoise(**densities, update_rate=None if rate is None else float(rate)))
    except (TypeError, ValueError, CalibrationError) as error:
        raise CalibrationError(f"{where}: a density or the rate cannot be used ({error}).") from error


class _Dumper(yaml.SafeDumper):
    """Yaml with lists indented below their key, without which OpenCV cannot read it."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _for_opencv(content: Mapping[str, Any]) -> str:
    """Yaml text that OpenCV's FileStorage can read."""
    text = yaml.dump(dict(content), Dumper=_Dumper, default_flow_style=None, width=math.inf, sort_keys=False)
    return "%YAML:1.0\n\n" + text
