"""Which corners of a planar grid lie where all the others say they should."""

import numpy as np

from jaxcal.detection.board_view import BoardView, fit_view

_SIGMAS = 4.0
FEWEST = 8  # fewer are too few to tell


def agreeing_corners(
    board: np.ndarray, pixels: np.ndarray, image_size: tuple[int, int], floor_px: float = 1.0
) -> np.ndarray:
    """Mask (N,) of corners whose `pixels` (N, 2) fit one view of the board with coordinates `board` (N, 2).

    The view (`board_view`) is fitted to all corners; see `agreeing_with`. With fewer than 8 corners all are kept.
    """
    if len(board) < FEWEST:
        return np.ones(len(board), bool)
    return agreeing_with(fit_view(board, pixels, image_size), board, pixels, floor_px)


def agreeing_with(view: BoardView | None, board: np.ndarray, pixels: np.ndarray, floor_px: float = 1.0) -> np.ndarray:
    """Mask (N,) of corners whose `pixels` (N, 2) lie where the view shows their places on the `board` (N, 2).

    A corner is rejected when its residual exceeds both four robust standard deviations of all and `floor_px` (a sharp
    image would lose good corners to its small spread).
    """
    if view is None:
        expected = np.broadcast_to(np.median(pixels, axis=0), pixels.shape)  # no view of a plane: all in one place
    else:
        expected = view.pixels(board)
    size = np.linalg.norm(pixels - expected, axis=1)
    spread = float(np.median(size)) / 1.1774  # of one coordinate: the median of a Rayleigh distribution
    return size <= max(floor_px, _SIGMAS * spread)
