"""The two jobs: calibrate cameras, and cameras with an IMU."""

from jaxcal.calibration.cameras import calibrate_cameras

__all__ = ["calibrate_cameras"]
