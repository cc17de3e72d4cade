"""Calibrations in the files of other tools: Kalibr, OpenVINS, VINS-Fusion, Basalt, ROS, OpenCV, COLMAP."""

from jaxcal.results.interchange.bare import bare_calibration, calibration_of_file
from jaxcal.results.interchange.formats import (
    FORMATS,
    Written,
    load_calibration_or_rig,
    read_calibration,
    write_calibration,
)
from jaxcal.results.interchange.kalibr_text import KalibrCameraResult, KalibrResults, read_kalibr_results
from jaxcal.results.interchange.rig import CalibratedRig, RigImu, rig_of

__all__ = [
    "FORMATS",
    "CalibratedRig",
    "KalibrCameraResult",
    "KalibrResults",
    "RigImu",
    "Written",
    "bare_calibration",
    "calibration_of_file",
    "load_calibration_or_rig",
    "read_calibration",
    "read_kalibr_results",
    "rig_of",
    "write_calibration",
]
