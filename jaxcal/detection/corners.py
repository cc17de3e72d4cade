"""Corners of any target in one image."""

import numpy as np

from jaxcal.detection.aprilgrid import find_aprilgrid
from jaxcal.detection.checkerboard import find_checkerboard
from jaxcal.errors import CalibrationError
from jaxcal.targets import AprilGrid, Checkerboard, Target

# Raised whenever the same image could give other corners than before: cached detections are then made anew.
DETECTOR_VERSION = 2


def find_corners(image: np.ndarray, target: Target) -> tuple[np.ndarray, np.ndarray]:
    """Corners in a grey uint8 image (H, W): (K,) indices into `target.points` and (K, 2) pixels; K may be 0.

    Raises CalibrationError for an image of another kind and for a target that no detector knows.
    """
    if image.dtype != np.uint8 or image.ndim != 2:
        raise CalibrationError(
            f"detection: an image has shape {image.shape} and type {image.dtype}; expected grey uint8 (height, width)."
        )
    if isinstance(target, AprilGrid):
        return find_aprilgrid(image, target)
    if isinstance(target, Checkerboard):
        return find_checkerboard(image, target)
    raise CalibrationError(f"detection: no detector for {type(target).__name__}; known: AprilGrid, Checkerboard.")
