"""Calibrations in the files of other tools: Kalibr, OpenVINS, VINS-Fusion, Basalt, ROS, OpenCV, COLMAP."""

from jaxcal.results.interchange.formats import (
    FORMATS,
    Written,
    load_calibration_or_rig,
    read_calibration,
    write_calibration,
)
from jaxcal.results.interchange.rig import CalibratedRig, RigImu, rig_of

__all__ = [
    "FORMATS",
    "CalibratedRig",
    "RigImu",
    "Written",
    "load_calibration_or_rig",
    "read_calibration",
    "rig_of",
    "write_calibration",
]
