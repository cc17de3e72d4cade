"""Camera models by name: Kalibr's names for the built-in ones, a dotted path for a user's own."""

import difflib
import importlib

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.division import PinholeDivision
from jaxcal.cameras.ds import DoubleSphere
from jaxcal.cameras.eucm import Eucm
from jaxcal.cameras.fov import PinholeFov
from jaxcal.cameras.kannala_brandt import PinholeEquidistant
from jaxcal.cameras.omni import Omni, OmniRadtan
from jaxcal.cameras.pinhole import (
    Pinhole,
    PinholeRadtan,
    PinholeRadtan5,
    PinholeRational8,
    PinholeThinPrism12,
    PinholeTilted14,
)
from jaxcal.cameras.splined import splined_from_name
from jaxcal.errors import CalibrationError

_BUILT_IN: tuple[type[CameraModel], ...] = (
    Pinhole,
    PinholeRadtan,
    PinholeRadtan5,
    PinholeRational8,
    PinholeThinPrism12,
    PinholeTilted14,
    PinholeEquidistant,
    PinholeFov,
    PinholeDivision,
    Omni,
    OmniRadtan,
    Eucm,
    DoubleSphere,
)
_MODELS: dict[str, type[CameraModel]] = {model.name: model for model in _BUILT_IN}


def names() -> list[str]:
    """The names of all built-in models."""
    return sorted(_MODELS)


def camera_model(name: str) -> type[CameraModel]:
    """The model class called `name`: a Kalibr name such as 'pinhole-radtan', or 'mypackage.mymodule:MyCamera'.

    `splined-3-16-12-120` is the flexible model with cubic patches, 16 x 12 knots, 120 degrees in x; mrcal's name for it
    (`LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=16_Ny=12_fov_x_deg=120`) is taken too.

    Raises CalibrationError when there is no such model.
    """
    if name in _MODELS:
        return _MODELS[name]
    splined = splined_from_name(name)
    if splined is not None:
        return splined
    if ":" in name:
        module_name, _, class_name = name.partition(":")
        try:
            found = getattr(importlib.import_module(module_name), class_name)
        except (ImportError, AttributeError) as error:
            raise CalibrationError(
                f"camera model '{name}': {error}. Expected 'module:Class' that Python can import from here."
            ) from error
        if not (isinstance(found, type) and issubclass(found, CameraModel)):
            raise CalibrationError(f"camera model '{name}': {class_name} is not a subclass of jaxcal.CameraModel.")
        return found
    close = difflib.get_close_matches(name, names(), n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    raise CalibrationError(
        f"camera model '{name}' is unknown.{hint} Known: {', '.join(names())}, "
        "splined-ORDER-NX-NY-FOV, or 'module:Class'."
    )


def model_name(model: CameraModel | type[CameraModel]) -> str:
    """The name under which `camera_model` finds this model again."""
    cls = model if isinstance(model, type) else type(model)
    built_in = _MODELS.get(cls.name) is cls or splined_from_name(cls.name) is cls
    return cls.name if built_in else f"{cls.__module__}:{cls.__qualname__}"
