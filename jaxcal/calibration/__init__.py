"""The two jobs: calibrate cameras, and cameras with an IMU."""

from jaxcal.calibration.camera_imu import calibrate_camera_imu
from jaxcal.calibration.cameras import calibrate_cameras
from jaxcal.calibration.cross_validate import cross_validate
from jaxcal.calibration.held_back import held_back_residuals
from jaxcal.calibration.resolve import resolve
from jaxcal.calibration.spline_setup import frame_rate_for_spline

__all__ = [
    "calibrate_camera_imu",
    "calibrate_cameras",
    "cross_validate",
    "frame_rate_for_spline",
    "held_back_residuals",
    "resolve",
]
