"""ROS camera_info yaml, as camera_calibration_parsers writes it: the lenses alone, one file per camera."""

import numpy as np
import yaml

from jaxcal.cameras import CameraModel, model_name
from jaxcal.errors import CalibrationError
from jaxcal.results.interchange.documents import Document, value_of
from jaxcal.results.interchange.lenses import coefficients_of, core_of, lens, planar
from jaxcal.results.interchange.rig import CalibratedRig, camera_alone, file_stems
from jaxcal.results.kalibr import CamchainCamera, numbers

# Our name, ROS's name, and how many coefficients ROS writes (sensor_msgs/distortion_models).
_KINDS = {
    "pinhole-radtan": ("plumb_bob", 5),
    "pinhole-none": ("plumb_bob", 5),
    "pinhole-radtan5": ("plumb_bob", 5),
    "pinhole-rational8": ("rational_polynomial", 8),
    "pinhole-equi": ("equidistant", 4),
}
MODELS = tuple(_KINDS)


def recognises(document: Document) -> bool:
    """Whether a file is a camera_info."""
    camera = document.has("camera_matrix", "distortion_coefficients")
    return camera and (document.has("distortion_model") or document.has("projection_matrix"))


def write(rig: CalibratedRig) -> tuple[dict[str, str], tuple[str, ...]]:
    """One file per camera, <name>.yaml. The projection matrix is that of the distorted image: nothing is rectified."""
    return {f"{stem}.yaml": _text(camera) for stem, camera in zip(file_stems(rig), rig.cameras, strict=True)}, ()


def read(documents: list[Document]) -> CalibratedRig:
    """A rig of one camera per file, of which only the lenses are known."""
    return CalibratedRig(tuple(_camera(document) for document in documents), format="ros")


def _text(camera: CamchainCamera) -> str:
    kind, count = _KINDS[model_name(camera.model)]
    width, height = camera.image_size
    fx, fy, cx, cy = core_of(camera.model).tolist()
    matrices = {
        "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "distortion_coefficients": [coefficients_of(camera.model, count).tolist()],
        "rectification_matrix": np.eye(3).tolist(),
        "projection_matrix": [[fx, 0.0, cx, 0.0], [0.0, fy, cy, 0.0], [0.0, 0.0, 1.0, 0.0]],
    }
    head = yaml.safe_dump({"camera_name": camera.name}, default_flow_style=False)
    lines = [f"image_width: {width}", f"image_height: {height}", head.strip()]
    for name, rows in matrices.items():
        if name == "distortion_coefficients":
            lines.append(f"distortion_model: {kind}")
        data = ", ".join(repr(value) for row in rows for value in row)
        lines += [f"{name}:", f"  rows: {len(rows)}", f"  cols: {len(rows[0])}", f"  data: [{data}]"]
    return "\n".join(lines) + "\n"


def _camera(document: Document) -> CamchainCamera:
    where = str(document.path)
    size = numbers([document["image_width"], document["image_height"]], (2,), f"{where}: image size")
    name = str(document.content.get("camera_name", document.path.stem))
    return camera_alone(name, _model(document, where), (int(size[0]), int(size[1])))


def _model(document: Document, where: str) -> CameraModel:
    matrix = _matrix(document, "camera_matrix", where).reshape(3, 3)
    distortion = _matrix(document, "distortion_coefficients", where)
    core = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    # Files without a model are from before there were others.
    kind = str(document.content.get("distortion_model", "plumb_bob"))
    if kind in ("equidistant", "fisheye"):
        return lens("pinhole-equi", core, distortion, where)
    if kind in ("plumb_bob", "rational_polynomial", "none", ""):
        return planar(core, distortion, where)
    raise CalibrationError(
        f"{where}: distortion_model '{kind}' is not known here. Known: plumb_bob, rational_polynomial, equidistant."
    )


def _matrix(document: Document, key: str, where: str) -> np.ndarray:
    data = value_of(document[key], "data", f"{where}: {key}")
    try:  # yaml 1.1 takes '1e-5' for text
        data = [float(value) for value in data]
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{where}: {key}: {error}.") from error
    values = numbers(data, (-1,), f"{where}: {key}")
    if key == "camera_matrix" and len(values) != 9:
        raise CalibrationError(f"{where}: {key} has {len(values)} numbers; expected 9.")
    return values
