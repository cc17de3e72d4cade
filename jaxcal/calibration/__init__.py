"""The two jobs: calibrate cameras, and cameras with an IMU."""

from typing import TYPE_CHECKING, Any

from jaxcal.imports import attribute_of

# name -> module that defines it; imported when first asked for: cameras alone need no IMU. No module is called as one
# of these names is: importing it would put it in the place of what is meant.
_EXPORTS = {
    "calibrate_camera_imu": "jaxcal.calibration.camera_imu",
    "calibrate_cameras": "jaxcal.calibration.cameras",
    "cross_validate": "jaxcal.calibration.cross_validation",
    "frame_rate_for_spline": "jaxcal.calibration.spline_setup",
    "held_back_residuals": "jaxcal.calibration.held_back",
    "resolve": "jaxcal.calibration.resolving",
}

__all__ = [
    "calibrate_camera_imu",
    "calibrate_cameras",
    "cross_validate",
    "frame_rate_for_spline",
    "held_back_residuals",
    "resolve",
]

if TYPE_CHECKING:
    from jaxcal.calibration.camera_imu import calibrate_camera_imu
    from jaxcal.calibration.cameras import calibrate_cameras
    from jaxcal.calibration.cross_validation import cross_validate
    from jaxcal.calibration.held_back import held_back_residuals
    from jaxcal.calibration.resolving import resolve
    from jaxcal.calibration.spline_setup import frame_rate_for_spline


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        value = attribute_of(_EXPORTS[name], name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'jaxcal.calibration' has no attribute '{name}'")
