"""jaxcal: calibrate event cameras, frame cameras and IMUs jointly. Every public name is reachable from here."""

import importlib.metadata
from typing import TYPE_CHECKING, Any

from jaxcal.imports import attribute_of
from jaxcal.jax_settings import configure_jax

configure_jax()

# name -> module that defines it; imported when first asked for, so that `import jaxcal` stays quick.
_EXPORTS = {
    "CalibrationError": "jaxcal.errors",
    "Detections": "jaxcal.observations",
    "Events": "jaxcal.observations",
    "Frames": "jaxcal.observations",
    "ImuNoise": "jaxcal.observations",
    "ImuRecording": "jaxcal.observations",
    "AprilGrid": "jaxcal.targets",
    "BoardSet": "jaxcal.targets",
    "Charuco": "jaxcal.targets",
    "Checkerboard": "jaxcal.targets",
    "CircleGrid": "jaxcal.targets",
    "Target": "jaxcal.targets",
    "load_target": "jaxcal.targets",
    "CameraModel": "jaxcal.cameras",
    "camera_model": "jaxcal.cameras",
    "load_imu": "jaxcal.recording",
    "load_rig": "jaxcal.recording",
    "detect": "jaxcal.detection",
    "calibrate_cameras": "jaxcal.calibration",
    "calibrate_camera_imu": "jaxcal.calibration",
    "cross_validate": "jaxcal.calibration",
    "resolve": "jaxcal.calibration",
    "Calibration": "jaxcal.results",
    "load_calibration": "jaxcal.results",
    "compare": "jaxcal.results.compare",
    "read_calibration": "jaxcal.results.interchange",
    "write_calibration": "jaxcal.results.interchange",
    "run_pipeline": "jaxcal.pipeline",
}

__all__ = [*sorted(_EXPORTS), "__version__"]  # pyright: ignore[reportUnsupportedDunderAll]

if TYPE_CHECKING:
    from jaxcal.calibration import calibrate_camera_imu, calibrate_cameras, cross_validate, resolve
    from jaxcal.cameras import CameraModel, camera_model
    from jaxcal.detection import detect
    from jaxcal.errors import CalibrationError
    from jaxcal.observations import Detections, Events, Frames, ImuNoise, ImuRecording
    from jaxcal.pipeline import run_pipeline
    from jaxcal.recording import load_imu, load_rig
    from jaxcal.results import Calibration, load_calibration
    from jaxcal.results.compare import compare
    from jaxcal.results.interchange import read_calibration, write_calibration
    from jaxcal.targets import AprilGrid, BoardSet, Charuco, Checkerboard, CircleGrid, Target, load_target


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.metadata.version("jaxcal")
    if name in _EXPORTS:
        value = attribute_of(_EXPORTS[name], name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'jaxcal' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
