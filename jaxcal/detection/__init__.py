"""Detection: frames and a target become corners."""

from jaxcal.detection.corners import find_corners
from jaxcal.detection.detect import detect

__all__ = ["detect", "find_corners"]
