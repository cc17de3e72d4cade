"""Calibrations in the files of other tools: Kalibr, OpenVINS, VINS-Fusion, Basalt, ROS, OpenCV, COLMAP."""

from jaxcal.results.interchange.formats import FORMATS, Written, read_calibration, write_calibration
from jaxcal.results.interchange.rig import CalibratedRig, RigImu, rig_of

__all__ = ["FORMATS", "CalibratedRig", "RigImu", "Written", "read_calibration", "rig_of", "write_calibration"]
