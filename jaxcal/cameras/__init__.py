"""Camera models: projection of points to pixels, by Kalibr name."""

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.ds import DoubleSphere
from jaxcal.cameras.eucm import Eucm
from jaxcal.cameras.kannala_brandt import PinholeEquidistant
from jaxcal.cameras.omni import Omni, OmniRadtan
from jaxcal.cameras.pinhole import Pinhole, PinholeRadtan
from jaxcal.cameras.registry import camera_model, model_name, names

__all__ = [
    "CameraModel",
    "DoubleSphere",
    "Eucm",
    "Omni",
    "OmniRadtan",
    "Pinhole",
    "PinholeEquidistant",
    "PinholeRadtan",
    "camera_model",
    "model_name",
    "names",
]
