"""ChArUco corners in one image: OpenCV's detector finds and numbers them, our refinement places them."""

import functools

import cv2
import numpy as np

from jaxcal.detection.homography import apply_homography, fit_homography
from jaxcal.detection.pattern_fit import fitted_corners
from jaxcal.detection.refine import refine_corners
from jaxcal.targets import Charuco

_REACH = 1.0  # of the way from a corner to the nearest marker: errors were a quarter larger with 0.8
_MAX_HALF_WINDOW = 9
_FEWEST = 4


def find_charuco(image: np.ndarray, target: Charuco) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the board in a grey uint8 image: (K,) indices into `target.points`, (K, 2) pixels; K may be 0.

    Boards may be seen in part: a corner is found where the markers beside it are (`cv2.aruco.CharucoDetector`), and
    its number follows from their ids. Corners are refined in windows that end before the nearest marker.
    """
    corners, ids, *_ = _detector(target).detectBoard(image)
    if ids is None or len(np.ravel(ids)) < _FEWEST:
        return np.empty(0, np.int64), np.empty((0, 2))
    rough = np.asarray(corners, np.float64).reshape(-1, 2)
    # OpenCV numbers the corners row by row from the top left.
    from_top, column = np.divmod(np.ravel(ids).astype(np.int64), target.cols - 1)
    point = (target.rows - 2 - from_top) * (target.cols - 1) + column
    refined, trusted = refine_corners(image, rough, _half_windows(rough, point, target))
    point = point[trusted]
    board, rim = target.points[point, :2], 0.5 * (target.square_size - target.marker_size)
    pixels, keep = fitted_corners(image, board, refined[trusted], (rim, rim))
    return point[keep], pixels[keep]


@functools.lru_cache(maxsize=8)
def _detector(target: Charuco) -> cv2.aruco.CharucoDetector:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    ids = np.array(target.ids, np.int32)
    size = (target.cols, target.rows)
    board = cv2.aruco.CharucoBoard(size, target.square_size, target.marker_size, dictionary, ids)
    board.setLegacyPattern(bool(target.legacy))
    charuco = cv2.aruco.CharucoParameters()
    charuco.tryRefineMarkers = True
    return cv2.aruco.CharucoDetector(board, charuco)


def _half_windows(pixels: np.ndarray, point: np.ndarray, target: Charuco) -> np.ndarray:
    """Half-width (K,) of the refinement windows: short of the nearest marker's corner."""
    board = target.points[point, :2]
    if np.linalg.matrix_rank(board - board[0]) < 2:
        return np.full(len(point), 2)  # all in one row: no homography, and no room to be sure of
    homography = fit_homography(board, pixels)
    rim = 0.5 * (target.square_size - target.marker_size)
    centre = apply_homography(homography, board)
    steps = [
        apply_homography(homography, board + step) - centre for step in (np.array([rim, 0.0]), np.array([0.0, rim]))
    ]
    shortest = np.minimum(*(np.linalg.norm(step, axis=1) for step in steps))
    return np.clip(np.floor(_REACH * shortest), 2, _MAX_HALF_WINDOW).astype(np.int64)
