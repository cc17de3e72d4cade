"""The two jobs: calibrate cameras, and cameras with an IMU."""

from jaxcal.calibration.camera_imu import calibrate_camera_imu
from jaxcal.calibration.cameras import calibrate_cameras

__all__ = ["calibrate_camera_imu", "calibrate_cameras"]
