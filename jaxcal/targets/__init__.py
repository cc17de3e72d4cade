"""Calibration targets: where their points are, and Kalibr's target.yaml."""

from jaxcal.targets.base import Target
from jaxcal.targets.grids import AprilGrid, Checkerboard
from jaxcal.targets.yaml import load_target, target_from_yaml

__all__ = ["AprilGrid", "Checkerboard", "Target", "load_target", "target_from_yaml"]
