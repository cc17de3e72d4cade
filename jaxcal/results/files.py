"""A calibration on disk: what `Calibration.save` writes and `load_calibration` reads.

A folder holds, each written atomically:

- `camchain.yaml`, or `camchain-imucam.yaml` with an IMU: Kalibr's layout (`jaxcal.results.kalibr`);
- `imu.yaml` with an IMU: Kalibr's layout;
- `results.txt`: for people (`jaxcal.results.text`);
- `calibration.npz`: everything, without loss; the only one that `load_calibration` reads.

`calibration.npz`, version 4, holds no pickles. `meta` is the UTF-8 of a JSON object (as uint8): `format`, `version`,
`cameras` (per camera `name`, `model`, `image_size`, `timeshift_cam_imu`, `corner_sigma_px`), `target` (as in Kalibr's
`target.yaml`), `blocks`, `converged`, `warnings`, `settings`, `versions`, and `imu` (the scalars of `ImuCalibration`)
or null. The arrays are `covariance`, `convergence`, `gravity`; for camera k `cam<k>.parameters`, `.T_cn_cnm1`,
`.T_cam_imu`, `.residuals_px`, `.inlier` and `.detections.timestamps_ns`, `.frame`, `.point`, `.pixels`,
`.image_size`; and `imu.<field>` for every array of `ImuCalibration`. What is None is absent. Version 2 added
`cam<k>.T_cam_target` and `.detections.precision`, `timeshift_cam_cam0` (in `meta`), and `target_shape.T_target_board`,
`.warp_m`, `.offsets_m`. Version 3 added `line_delay_s` of cameras, and
further IMUs: `extra_imus` in `meta`, a list like `imu`, and their arrays `imu1.<field>` and so on. Version 4 added the
whole recording of each IMU, `imu.recording.timestamps_ns`, `.gyro_rad_s`, `.accel_m_s2`, so that a calibration can be
repeated from its file alone (`jaxcal.resolve`). Versions 1 to 3 are read as well.
"""

import dataclasses
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.atomic import write_bytes, write_text
from jaxcal.cameras import camera_model, model_name
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections, ImuNoise, ImuRecording
from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration, TargetShape
from jaxcal.results.kalibr import camchain, imu_entries, to_yaml
from jaxcal.results.text import results_text
from jaxcal.targets import target_from_yaml

FILE_NAME = "calibration.npz"
_FORMAT = "jaxcal-calibration"
_VERSION = 4
_READABLE = (1, 2, 3, 4)
_DETECTION_ARRAYS = ("timestamps_ns", "frame", "point", "pixels")
_RECORDING_ARRAYS = ("timestamps_ns", "gyro_rad_s", "accel_m_s2")
_IMU_SCALARS = (
    "origin_ns",
    "gyro_sigma",
    "accel_sigma",
    "noise",
    "knot_rate_hz",
    "spline_order",
    "model",
    "parameters",
    "timeshift_imu_imu0",
    "noise_ratio",
)


def save_calibration(calibration: Calibration, folder: Path) -> None:
    """Write the files that this module describes into `folder`, made where it is missing.

    Settings that JSON cannot hold are kept as their text. Raises OSError when the disk refuses.
    """
    folder = Path(folder)
    chain = "camchain.yaml" if calibration.imu is None else "camchain-imucam.yaml"
    write_text(folder / chain, to_yaml(camchain(calibration)))
    if calibration.imu is not None:
        write_text(folder / "imu.yaml", to_yaml(imu_entries(calibration.imus)))
    write_text(folder / "results.txt", results_text(calibration))
    content = io.BytesIO()
    np.savez_compressed(content, **_arrays(calibration))  # pyright: ignore[reportArgumentType]
    write_bytes(folder / FILE_NAME, content.getvalue())


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration from the folder it was saved to, or from its `calibration.npz`.

    Raises CalibrationError when the file is missing, damaged, of another kind or of a version this jaxcal cannot read.
    """
    file = _find(Path(path))
    arrays = _read_arrays(file)
    meta = _read_meta(file, arrays)
    try:
        return _decode(meta, arrays)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from error
    except (KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
        raise CalibrationError(
            f"{file}: the content is damaged ({type(error).__name__}: {error}). Calibrate and save again."
        ) from error


# --- writing ---------------------------------------------------------------------------------------------------------


def _arrays(calibration: Calibration) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray | None] = {
        "covariance": np.asarray(calibration.covariance),
        "convergence": np.asarray(calibration.convergence),
        "gravity": calibration.gravity,
    }
    for k, camera in enumerate(calibration.cameras):
        arrays |= {f"cam{k}.{name}": value for name, value in _camera_arrays(camera).items()}
    if calibration.target_shape is not None:
        shape = calibration.target_shape
        arrays |= {f"target_shape.{field.name}": getattr(shape, field.name) for field in dataclasses.fields(shape)}
    for k, imu in enumerate(calibration.imus):
        arrays |= {f"{_imu_key(k)}.{name}": getattr(imu, name) for name in _imu_arrays()}
        if imu.recording is not None:
            of_recording = {name: getattr(imu.recording, name) for name in _RECORDING_ARRAYS}
            arrays |= {f"{_imu_key(k)}.recording.{name}": value for name, value in of_recording.items()}
    text = json.dumps(_meta(calibration), default=_plain)
    present = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
    for name, value in present.items():
        if value.dtype.hasobject:
            raise CalibrationError(f"saving a calibration: {name} holds Python objects; expected an array of numbers.")
    return {"meta": np.frombuffer(text.encode(), dtype=np.uint8), **present}


def _camera_arrays(camera: CameraCalibration) -> dict[str, np.ndarray | None]:
    detections = camera.detections
    return {
        "parameters": np.asarray(camera.model.parameters),
        "T_cn_cnm1": camera.T_cn_cnm1,
        "T_cam_imu": camera.T_cam_imu,
        "residuals_px": camera.residuals_px,
        "inlier": camera.inlier,
        "T_cam_target": camera.T_cam_target,
        **{f"detections.{name}": getattr(detections, name) for name in _DETECTION_ARRAYS},
        "detections.image_size": np.array(detections.image_size),
        "detections.precision": detections.precision,
    }


def _meta(calibration: Calibration) -> dict[str, Any]:
    imu = calibration.imu
    return {
        "format": _FORMAT,
        "version": _VERSION,
        "cameras": [
            {
                "name": camera.name,
                "model": model_name(camera.model),
                "image_size": list(camera.image_size),
                "timeshift_cam_imu": camera.timeshift_cam_imu,
                "timeshift_cam_cam0": camera.timeshift_cam_cam0,
                "line_delay_s": camera.line_delay_s,
                "corner_sigma_px": camera.corner_sigma_px,
            }
            for camera in calibration.cameras
        ],
        "target": calibration.target.to_yaml(),
        "imu": None if imu is None else _imu_scalars(imu),
        "extra_imus": [_imu_scalars(extra) for extra in calibration.extra_imus],
        "blocks": [[name, size] for name, size in calibration.blocks],
        "converged": calibration.converged,
        "warnings": list(calibration.warnings),
        "settings": _plain_mapping(calibration.settings),
        "versions": _plain_mapping(calibration.versions),
    }


def _plain(value: Any) -> Any:
    """What JSON cannot hold, as the nearest that it can."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, set | frozenset):
        return sorted(value, key=str)
    return str(value)


def _imu_scalars(imu: ImuCalibration) -> dict[str, Any]:
    scalars = {name: _plain_mapping(getattr(imu, name)) for name in _IMU_SCALARS}
    return scalars | {"parameters": {name: np.asarray(value).tolist() for name, value in imu.parameters.items()}}


def _plain_mapping(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else value


def _imu_key(number: int) -> str:
    """The first name of an IMU's arrays: that of the first one is older than the others."""
    return "imu" if number == 0 else f"imu{number}"


def _imu_arrays() -> list[str]:
    left = (*_IMU_SCALARS, "recording")
    return [field.name for field in dataclasses.fields(ImuCalibration) if field.name not in left]


# --- reading ---------------------------------------------------------------------------------------------------------


def _find(path: Path) -> Path:
    file = path / FILE_NAME if path.is_dir() else path
    if file.is_file():
        return file
    hint = "Give the folder that `calibration.save` wrote, or its calibration.npz."
    if path.is_dir() and any(path.glob("*camchain*.yaml")):
        hint += " The yaml there can be read with `jaxcal.results.load_camchain`, without its uncertainty."
    raise CalibrationError(f"{file}: no such calibration. {hint}")


def _read_arrays(file: Path) -> dict[str, np.ndarray]:
    if file.suffix.lower() in (".yaml", ".yml", ".json", ".txt"):
        raise CalibrationError(
            f"{file}: expected the folder that `calibration.save` wrote, or its calibration.npz. Files of other "
            "tools are read by `jaxcal.results.interchange.read_calibration` (without their uncertainty)."
        )
    try:
        # Opened here, because numpy leaves a file open that turns out to be damaged.
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except Exception as error:  # numpy and zipfile raise many kinds on damaged files; all mean the same here
        raise CalibrationError(
            f"{file}: not a calibration that can be read ({error}). The file is truncated, damaged or of another kind: "
            "copy it again from where it was made, or calibrate and save again."
        ) from error


def _read_meta(file: Path, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    if "meta" not in arrays:
        found = ", ".join(sorted(arrays)[:6])
        raise CalibrationError(f"{file}: not a calibration; it holds {found}. Expected what `calibration.save` wrote.")
    try:
        meta = json.loads(arrays["meta"].tobytes().decode())
        kind, version = meta["format"], meta["version"]
    except (ValueError, KeyError, TypeError) as error:
        raise CalibrationError(f"{file}: `meta` is damaged ({error}). Calibrate and save again.") from error
    if kind != _FORMAT:
        raise CalibrationError(f"{file}: format is {kind!r}; expected {_FORMAT!r}. This is another kind of file.")
    if version not in _READABLE:
        remedy = "upgrade jaxcal" if isinstance(version, int) and version > _VERSION else "calibrate and save again"
        raise CalibrationError(
            f"{file}: written in version {version!r} of the format; this jaxcal reads versions 1 to "
            f"{_VERSION}: {remedy}."
        )
    return meta


def _decode(meta: dict[str, Any], arrays: dict[str, np.ndarray]) -> Calibration:
    entries = [] if meta["imu"] is None else [meta["imu"], *meta.get("extra_imus", ())]
    imus = [_decode_imu(entry, _imu_key(k), arrays) for k, entry in enumerate(entries)]
    return Calibration(
        cameras=tuple(_decode_camera(entry, k, arrays) for k, entry in enumerate(meta["cameras"])),
        target=target_from_yaml(meta["target"], "target"),
        gravity=arrays.get("gravity"),
        imu=imus[0] if imus else None,
        extra_imus=tuple(imus[1:]),
        blocks=tuple((str(name), int(size)) for name, size in meta["blocks"]),
        covariance=arrays["covariance"],
        convergence=arrays["convergence"],
        warnings=tuple(meta["warnings"]),
        settings=meta["settings"],
        versions=meta["versions"],
        converged=meta["converged"],
        target_shape=_decode_shape(arrays),
    )


def _decode_imu(entry: dict[str, Any], key: str, arrays: dict[str, np.ndarray]) -> ImuCalibration:
    scalars = dict(entry)
    scalars["parameters"] = {name: np.asarray(value) for name, value in scalars.get("parameters", {}).items()}
    if scalars.get("noise_ratio") is not None:
        scalars["noise_ratio"] = tuple(scalars["noise_ratio"])
    scalars["recording"] = _decode_recording(entry, key, arrays)
    return ImuCalibration(**scalars, **{name: arrays.get(f"{key}.{name}") for name in _imu_arrays()})  # pyright: ignore[reportArgumentType]


def _decode_recording(entry: dict[str, Any], key: str, arrays: dict[str, np.ndarray]) -> ImuRecording | None:
    if f"{key}.recording.timestamps_ns" not in arrays:
        return None
    return ImuRecording(
        **{name: arrays[f"{key}.recording.{name}"] for name in _RECORDING_ARRAYS}, noise=ImuNoise(**entry["noise"])
    )


def _decode_shape(arrays: dict[str, np.ndarray]) -> TargetShape | None:
    mine = {name.partition(".")[2]: value for name, value in arrays.items() if name.startswith("target_shape.")}
    return TargetShape(**mine) if mine else None


def _decode_camera(entry: dict[str, Any], index: int, arrays: dict[str, np.ndarray]) -> CameraCalibration:
    mine = {name.partition(".")[2]: value for name, value in arrays.items() if name.startswith(f"cam{index}.")}
    width, height = (int(size) for size in entry["image_size"])
    seen_width, seen_height = (int(size) for size in mine["detections.image_size"])
    template = camera_model(entry["model"]).from_focal(1.0, (width, height))
    if template.num_parameters != len(mine["parameters"]):
        raise CalibrationError(
            f"camera {entry['name']}: {len(mine['parameters'])} parameters were saved, but {entry['model']} now has "
            f"{template.num_parameters}. Load it with the model it was made with."
        )
    return CameraCalibration(
        name=entry["name"],
        model=template.with_parameters(mine["parameters"]),
        image_size=(width, height),
        T_cn_cnm1=mine.get("T_cn_cnm1"),
        T_cam_imu=mine.get("T_cam_imu"),
        timeshift_cam_imu=entry["timeshift_cam_imu"],
        detections=Detections(
            **{name: mine[f"detections.{name}"] for name in _DETECTION_ARRAYS},
            image_size=(seen_width, seen_height),
            precision=mine.get("detections.precision"),
        ),
        residuals_px=mine["residuals_px"],
        inlier=mine["inlier"],
        corner_sigma_px=entry["corner_sigma_px"],
        T_cam_target=mine.get("T_cam_target"),
        timeshift_cam_cam0=entry.get("timeshift_cam_cam0"),
        line_delay_s=entry.get("line_delay_s"),
    )
