"""Camera models: projection of points to pixels, by Kalibr name."""

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.pinhole import Pinhole, PinholeEquidistant, PinholeRadtan
from jaxcal.cameras.registry import camera_model, model_name, names

__all__ = ["CameraModel", "Pinhole", "PinholeEquidistant", "PinholeRadtan", "camera_model", "model_name", "names"]
