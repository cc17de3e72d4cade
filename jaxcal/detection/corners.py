"""Corners of any target in one image."""

import cv2
import numpy as np

from jaxcal.detection.aprilgrid import find_aprilgrid
from jaxcal.detection.charuco import find_charuco
from jaxcal.detection.checkerboard import find_checkerboard
from jaxcal.detection.circles import find_circle_grid
from jaxcal.errors import CalibrationError
from jaxcal.targets import AprilGrid, BoardSet, Charuco, Checkerboard, CircleGrid, Target

# Raised whenever the same image could give other corners than before: cached detections are then made anew.
DETECTOR_VERSION = 6


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
    if isinstance(target, CircleGrid):
        return find_circle_grid(image, target)
    if isinstance(target, Charuco):
        return find_charuco(image, target)
    if isinstance(target, BoardSet):
        return _find_boards(image, target)
    raise CalibrationError(
        f"detection: no detector for {type(target).__name__}; known: AprilGrid, BoardSet, Charuco, Checkerboard, "
        "CircleGrid."
    )


def _find_boards(image: np.ndarray, target: BoardSet) -> tuple[np.ndarray, np.ndarray]:
    """Corners of each board of a set, numbered on after those of the boards before it."""
    # Boards with ids cannot be mistaken; painted over, they cannot be mistaken for one without.
    tagged = [isinstance(board, AprilGrid | Charuco) for board in target.boards]
    left = image.copy()
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for number in sorted(range(len(tagged)), key=lambda k: not tagged[k]):
        point, pixels = find_corners(left if not tagged[number] else image, target.boards[number])
        found[number] = (np.flatnonzero(target.board_of_point == number)[point], pixels)
        if len(pixels) >= 3:
            hull = cv2.convexHull(np.round(pixels).astype(np.int32))
            cv2.fillConvexPoly(left, hull, int(np.median(image)))
    points, places = zip(*(found[number] for number in range(len(tagged))), strict=True)
    return np.concatenate(points), np.concatenate(places)
