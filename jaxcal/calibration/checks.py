"""Checks of the arguments that both calibrations share."""

import importlib.metadata
import platform
from collections.abc import Sequence

from jaxcal.cameras import CameraModel, camera_model
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections


def resolve_models(
    detections: Sequence[Detections], models: Sequence[str | type[CameraModel]] | None
) -> list[type[CameraModel]]:
    """Model classes, one per camera; `pinhole-radtan` for all by default."""
    if not detections:
        raise CalibrationError("no cameras: give one `Detections` per camera.")
    if isinstance(models, str):
        models = [models] * len(detections)
    chosen = list(models) if models is not None else ["pinhole-radtan"] * len(detections)
    if len(chosen) != len(detections):
        raise CalibrationError(f"{len(chosen)} camera models for {len(detections)} cameras; give one each.")
    return [camera_model(model) if isinstance(model, str) else model for model in chosen]


def resolve_names(detections: Sequence[Detections], names: Sequence[str] | None) -> list[str]:
    """Camera names; Kalibr's cam0, cam1, ... by default."""
    chosen = list(names) if names is not None else [f"cam{i}" for i in range(len(detections))]
    if len(chosen) != len(detections) or len(set(chosen)) != len(chosen):
        raise CalibrationError(f"{chosen} are not {len(detections)} different camera names; give each camera its own.")
    return chosen


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    packages = ("jaxcal", "jax", "jaxlib", "optimistix", "numpy", "opencv-python-headless")
    found = {"python": platform.python_version()}
    for package in packages:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:  # run from a source tree
            found[package] = "not installed"
    return found
