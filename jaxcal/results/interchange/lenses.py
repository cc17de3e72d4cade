"""Lenses as other tools write them down: OpenCV's coefficients, and models that are one another's in other numbers."""

from typing import Any

import numpy as np

from jaxcal.cameras import CameraModel, camera_model, model_name
from jaxcal.errors import CalibrationError

# OpenCV's distortion vector, by how many of its coefficients a model has.
BY_COUNT = {
    0: "pinhole-none",
    4: "pinhole-radtan",
    5: "pinhole-radtan5",
    8: "pinhole-rational8",
    12: "pinhole-thinprism12",
    14: "pinhole-tilted14",
}
PLANAR = tuple(BY_COUNT.values())


def core_of(model: CameraModel) -> np.ndarray:
    """fx, fy, cx, cy of a model that has them."""
    return np.asarray(model.parameters)[[model.projection_names.index(name) for name in ("fx", "fy", "cx", "cy")]]


def coefficients_of(model: CameraModel, count: int) -> np.ndarray:
    """The distortion (count,), its end filled with zeros: the same lens in a model with more coefficients."""
    distortion = np.asarray(model.distortion)
    return np.pad(distortion, (0, count - len(distortion)))


def lens(name: str, intrinsics: Any, distortion: Any, where: str) -> CameraModel:
    """A model by name from the numbers of a file; CalibrationError names the place where there are too few or many."""
    try:
        return camera_model(name).create(intrinsics, distortion)
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def planar(core: np.ndarray, coefficients: np.ndarray, where: str) -> CameraModel:
    """The smallest pinhole model for fx, fy, cx, cy (4,) and OpenCV's distortion vector.

    Coefficients that are zero at the end take no part. Raises CalibrationError when there are more than 14.
    """
    nonzero = np.flatnonzero(coefficients)
    needed = int(nonzero[-1]) + 1 if len(nonzero) else 0
    if needed > max(BY_COUNT):
        raise CalibrationError(f"{where}: {len(coefficients)} distortion coefficients; OpenCV knows 14 at most.")
    count = min(size for size in BY_COUNT if size >= needed)
    kept = np.pad(coefficients, (0, max(0, count - len(coefficients))))[:count]
    return camera_model(BY_COUNT[count]).create(core, kept)


def unified_of(model: CameraModel) -> np.ndarray:
    """fx, fy, cx, cy, alpha (5,) of an `omni-none` lens in Usenko's unified model.

    x / (z + xi d) is (1 / (1 + xi)) x / (alpha d + (1 - alpha) z) with alpha = xi / (1 + xi) (Usenko et al. 2018,
    section II-C).
    """
    xi, fx, fy, cx, cy = np.asarray(model.parameters)
    return np.array([fx / (1.0 + xi), fy / (1.0 + xi), cx, cy, xi / (1.0 + xi)])


def omni_of(unified: np.ndarray) -> CameraModel:
    """The inverse of `unified_of`."""
    fx, fy, cx, cy, alpha = unified
    xi = alpha / (1.0 - alpha)
    return camera_model("omni-none").create([xi, fx * (1.0 + xi), fy * (1.0 + xi), cx, cy])


def model_of(name: str, values: np.ndarray) -> CameraModel:
    """The model called `name` with the parameter vector `values`, in our order."""
    cls = camera_model(name)
    return cls.create(values[: cls.num_intrinsics], values[cls.num_intrinsics :])


def require_known(model: CameraModel, models: tuple[str, ...], format_title: str, camera: str) -> None:
    """Raise CalibrationError unless `models` has the model's name, saying which it has and how to get there."""
    name = model_name(model)
    if name in models:
        return
    raise CalibrationError(
        f"{camera}: files for {format_title} cannot hold the model '{name}'; they hold {', '.join(models)}. Re-fit "
        f"the lens first: `jaxcal convert camera CAMCHAIN --to {models[0]} --out OTHER.yaml` says what that costs."
    )
