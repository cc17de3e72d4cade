"""What a cross-validation found, on disk: `cross_validation.npz` beside the `calibration.npz` that it is about.

No pickles. `meta` is the UTF-8 of a JSON object (as uint8): `format`, `version`, `calibration` (the SHA-256 of the
`calibration.npz`), and everything but arrays. The arrays of camera c in the halves k are `half<k>.cam<c>.<field>` for
the array fields of `CameraDifference`; what is None is absent.
"""

import dataclasses
import hashlib
import io
import json
import logging
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.atomic import write_bytes
from jaxcal.errors import CalibrationError
from jaxcal.results.cross_validation import CrossValidation, Evidence, Halves
from jaxcal.results.difference import CameraDifference, ParameterDifference, RigDifference
from jaxcal.results.files import FILE_NAME as CALIBRATION_NAME

FILE_NAME = "cross_validation.npz"
_FORMAT, _VERSION = "jaxcal-cross-validation", 1
_ARRAYS = ("pixels", "difference_px", "covariance", "observed", "at_ranges", "T_second_first")

_log = logging.getLogger(__name__)


def save_cross_validation(found: CrossValidation, folder: str | Path) -> Path:
    """Write what was found beside the calibration saved in `folder`; returns the file.

    Raises CalibrationError when no calibration is there, OSError when the disk refuses.
    """
    folder = Path(folder)
    meta = {
        "format": _FORMAT,
        "version": _VERSION,
        "calibration": _checksum(folder),
        "halves": [_plain_halves(half) for half in found.halves],
        "evidence": [dataclasses.asdict(evidence) for evidence in found.evidence],
        "notes": list(found.notes),
    }
    arrays: dict[str, np.ndarray] = {"meta": np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8)}
    for k, half in enumerate(found.halves):
        for c, camera in enumerate(half.difference.cameras):
            values = {name: getattr(camera, name) for name in _ARRAYS}
            arrays |= {f"half{k}.cam{c}.{name}": value for name, value in values.items() if value is not None}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # pyright: ignore[reportArgumentType]
    write_bytes(folder / FILE_NAME, content.getvalue())
    return folder / FILE_NAME


def load_cross_validation(folder: str | Path) -> CrossValidation | None:
    """What was found about the calibration in `folder`.

    None where nothing is there, or where it is about another calibration than the one that is there now (the log says
    so). Raises CalibrationError when the file is damaged or of another version.
    """
    file = Path(folder) / FILE_NAME
    if not file.is_file():
        return None
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        meta = json.loads(arrays["meta"].tobytes().decode())
        if (meta["format"], meta["version"]) != (_FORMAT, _VERSION):
            raise CalibrationError(f"{file}: of another version of jaxcal. Run `jaxcal cross-validate` again.")
        if meta["calibration"] != _checksum(Path(folder)):
            _log.warning("%s is about an earlier calibration; run `jaxcal cross-validate` again.", file)
            return None
        halves = tuple(_halves(entry, k, arrays) for k, entry in enumerate(meta["halves"]))
        return CrossValidation(halves, tuple(Evidence(**entry) for entry in meta["evidence"]), tuple(meta["notes"]))
    except CalibrationError:
        raise
    except Exception as error:  # numpy and zipfile raise many kinds on damaged files; all mean the same here
        raise CalibrationError(
            f"{file}: damaged ({error}). Run `jaxcal cross-validate` again, or delete it."
        ) from error


def _checksum(folder: Path) -> str:
    file = folder / CALIBRATION_NAME
    if not file.is_file():
        raise CalibrationError(f"{file}: no such calibration; a cross-validation is kept beside the one it is about.")
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _plain_halves(half: Halves) -> dict[str, Any]:
    difference = half.difference
    return {
        "split": half.split,
        "gain": half.gain,
        "freedom": half.freedom,
        "p_value": half.p_value,
        "cameras": [
            {"name": camera.name, "models": camera.models, "ranges_m": camera.ranges_m} for camera in difference.cameras
        ],
        "parameters": [dataclasses.asdict(parameter) for parameter in difference.parameters],
        "notes": difference.notes,
    }


def _halves(entry: dict[str, Any], k: int, arrays: dict[str, np.ndarray]) -> Halves:
    cameras = []
    for c, camera in enumerate(entry["cameras"]):
        values: dict[str, Any] = {name: arrays.get(f"half{k}.cam{c}.{name}") for name in _ARRAYS}
        first, second = camera["models"]
        cameras.append(CameraDifference(camera["name"], (first, second), ranges_m=tuple(camera["ranges_m"]), **values))
    parameters = tuple(ParameterDifference(**parameter) for parameter in entry["parameters"])
    difference = RigDifference(tuple(cameras), parameters, tuple(entry["notes"]))
    return Halves(entry["split"], difference, entry["gain"], entry["freedom"], entry["p_value"])
