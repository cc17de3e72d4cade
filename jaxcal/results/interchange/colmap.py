"""COLMAP's cameras.txt: the lenses of a rig, with COLMAP's (0.5, 0.5) for the centre of the top-left pixel."""

import re

import numpy as np

from jaxcal.cameras import CameraModel, camera_model, model_name
from jaxcal.errors import CalibrationError
from jaxcal.results.interchange.documents import Document
from jaxcal.results.interchange.lenses import coefficients_of, core_of, planar
from jaxcal.results.interchange.rig import CalibratedRig, camera_alone
from jaxcal.results.kalibr import CamchainCamera, numbers

# Our name, COLMAP's name and the number of coefficients after fx, fy, cx, cy (colmap/sensor/models.h).
_WRITTEN = {
    "pinhole-radtan": ("OPENCV", 4),
    "pinhole-none": ("PINHOLE", 0),
    "pinhole-radtan5": ("FULL_OPENCV", 8),
    "pinhole-rational8": ("FULL_OPENCV", 8),
    "pinhole-equi": ("OPENCV_FISHEYE", 4),
    "pinhole-fov": ("FOV", 1),
    "pinhole-division": ("DIVISION", 1),
    "eucm-none": ("EUCM", 2),
}
MODELS = tuple(_WRITTEN)
_SINCE_4 = ("DIVISION", "EUCM")
# Read as well: whether there is one focal length, the number of coefficients, and the model they belong to.
_READ = {
    "SIMPLE_PINHOLE": (True, 0, "planar"),
    "PINHOLE": (False, 0, "planar"),
    "SIMPLE_RADIAL": (True, 1, "planar"),
    "RADIAL": (True, 2, "planar"),
    "OPENCV": (False, 4, "planar"),
    "FULL_OPENCV": (False, 8, "planar"),
    "SIMPLE_FISHEYE": (True, 0, "pinhole-equi"),
    "FISHEYE": (False, 0, "pinhole-equi"),
    "SIMPLE_RADIAL_FISHEYE": (True, 1, "pinhole-equi"),
    "RADIAL_FISHEYE": (True, 2, "pinhole-equi"),
    "OPENCV_FISHEYE": (False, 4, "pinhole-equi"),
    "FOV": (False, 1, "pinhole-fov"),
    "SIMPLE_DIVISION": (True, 1, "pinhole-division"),
    "DIVISION": (False, 1, "pinhole-division"),
    "EUCM": (False, 2, "eucm-none"),
}
_HALF = np.array([0.0, 0.0, 0.5, 0.5])


def recognises(document: Document) -> bool:
    """Whether a text file is a cameras.txt."""
    lines = _lines(document)
    return bool(lines) and all(re.match(r"\d+ [A-Z_]+ \d+ \d+( |$)", line) for _, line in lines)


def write(rig: CalibratedRig) -> tuple[dict[str, str], tuple[str, ...]]:
    """cameras.txt, with one id per camera from 1."""
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines.append(f"# Number of cameras: {len(rig.cameras)}")
    kinds = set()
    for k, camera in enumerate(rig.cameras, start=1):
        kind, values = _values(camera.model)
        kinds.add(kind)
        width, height = camera.image_size
        lines.append(" ".join([str(k), kind, str(width), str(height), *(repr(float(value)) for value in values)]))
    new = sorted(kinds & set(_SINCE_4))
    notes = (f"{', '.join(new)} is known to recent releases of COLMAP only",) if new else ()
    return {"cameras.txt": "\n".join(lines) + "\n"}, notes


def read(documents: list[Document]) -> CalibratedRig:
    """A rig of the cameras listed, in order of their ids, named cam0, cam1, ...; only the lenses are known."""
    if len(documents) > 1:
        raise CalibrationError(f"{documents[0].path.parent}: several lists of cameras. Name one.")
    found = sorted(
        (_camera(line.split(), f"{documents[0].path}: line {number}") for number, line in _lines(documents[0])),
        key=lambda pair: pair[0],
    )
    cameras = tuple(camera_alone(f"cam{k}", c.model, c.image_size) for k, (_, c) in enumerate(found))
    return CalibratedRig(cameras, format="colmap")


def _lines(document: Document) -> list[tuple[int, str]]:
    text = document.content if isinstance(document.content, str) else ""
    numbered = enumerate((line.strip() for line in text.splitlines()), start=1)
    return [(number, line) for number, line in numbered if line and not line.startswith("#")]


def _values(model: CameraModel) -> tuple[str, np.ndarray]:
    kind, count = _WRITTEN[model_name(model)]
    core = core_of(model) + _HALF
    if kind == "EUCM":
        return kind, np.append(core, np.asarray(model.intrinsics)[:2])
    return kind, np.append(core, coefficients_of(model, count))


def _camera(words: list[str], where: str) -> tuple[int, CamchainCamera]:
    kind = words[1]
    if kind not in _READ:
        raise CalibrationError(f"{where}: COLMAP's model {kind} is not known here. Known: {', '.join(_READ)}.")
    one_focal, count, ours = _READ[kind]
    expected = count + (3 if one_focal else 4)
    try:
        values = numbers([float(word) for word in words[4:]], (expected,), where)
        number, width, height = (int(word) for word in (words[0], *words[2:4]))
    except ValueError as error:
        raise CalibrationError(f"{where}: {error}.") from error
    if one_focal:
        values = np.append(values[0], values)
    core, rest = values[:4] - _HALF, values[4:]
    return number, camera_alone(str(number), _model(ours, core, rest, where), (width, height))


def _model(ours: str, core: np.ndarray, rest: np.ndarray, where: str) -> CameraModel:
    if ours == "planar":
        return planar(core, rest, where)
    if ours == "eucm-none":
        return camera_model(ours).create([*rest, *core])
    count = 4 if ours == "pinhole-equi" else 1
    return camera_model(ours).create(core, np.pad(rest, (0, count - len(rest))))
