"""Results: the `Calibration`, its files and its report."""

from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration

__all__ = ["Calibration", "CameraCalibration", "ImuCalibration"]
