"""Which corners of a planar grid lie where all the others say they should."""

from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

_SIGMAS = 4.0
_SOFT_PX = 0.5  # residuals beyond this count by their length, not by its square
_MAX_FITS = 60
# 1-sigma of what few corners cannot tell: radial distortion at the grid's farthest corner, and the centre of
# distortion as a fraction of that corner's distance. A deviation of one sigma counts as much as a pixel.
_PRIOR_SIGMAS = np.array([0.5, 0.5, 0.2, 0.2])


def agreeing_corners(
    board: np.ndarray, pixels: np.ndarray, image_size: tuple[int, int], floor_px: float = 1.0
) -> np.ndarray:
    """Mask (N,) of corners whose `pixels` (N, 2) fit one view of the board with coordinates `board` (N, 2).

    The view is a homography followed by radial distortion (two coefficients and a centre of its own): a homography
    alone is wrong by several pixels across the image of a common lens. It is fitted to all corners with a loss that
    grows linearly, and a corner is rejected when its residual exceeds both four robust standard deviations of all and
    `floor_px` (a sharp image would lose good corners to its small spread). With fewer than 8 corners, too few to
    tell, all are kept.
    """
    if len(board) < 8:
        return np.ones(len(board), bool)
    size = _residuals(board, pixels, np.array(image_size) / 2.0 - 0.5)
    spread = float(np.median(size)) / 1.1774  # of one coordinate: the median of a Rayleigh distribution
    return size <= max(floor_px, _SIGMAS * spread)


def _residuals(board: np.ndarray, pixels: np.ndarray, image_centre: np.ndarray) -> np.ndarray:
    """Distance (N,) of each corner from the fitted view, pixels."""
    centred = board - board.mean(axis=0)
    unit = np.column_stack([centred / np.abs(centred).max(), np.ones(len(board))])
    reach = float(np.linalg.norm(pixels - image_centre, axis=1).max())
    seen = (pixels - image_centre) / reach
    homography, _ = cv2.findHomography(unit[:, :2], seen, cv2.LMEDS)
    if homography is None or abs(homography[2, 2]) < 1e-9:
        return np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1)  # no view of a plane: all in one place
    start = np.concatenate([(homography / homography[2, 2]).ravel()[:8], np.zeros(4)])

    def misfit(parameters: np.ndarray) -> np.ndarray:
        error = (_view(parameters, unit) - seen) * reach
        return np.concatenate([error.reshape(*parameters.shape[:-1], -1), parameters[..., 8:] / _PRIOR_SIGMAS], axis=-1)

    def jacobian(parameters: np.ndarray) -> np.ndarray:
        step = 1e-20  # by complex step: exact, and all columns at once
        return np.imag(misfit(parameters + 1j * step * np.eye(len(parameters)))).T / step

    derivatives: Any = jacobian  # scipy's stubs know only the names of its own methods
    fit = least_squares(
        misfit, start, derivatives, loss="soft_l1", f_scale=_SOFT_PX, x_scale="jac", ftol=1e-5, max_nfev=_MAX_FITS
    )
    return np.linalg.norm(misfit(fit.x)[:-4].reshape(-1, 2), axis=1)


def _view(parameters: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Image points (..., N, 2) of homogeneous board points (N, 3).

    `parameters` (..., 12): the homography but for its last entry, which is 1; k1, k2; the centre of distortion.
    """
    homography = np.concatenate([parameters[..., :8], np.ones_like(parameters[..., :1])], axis=-1)
    mapped = unit @ np.swapaxes(homography.reshape(*parameters.shape[:-1], 3, 3), -1, -2)
    centre = parameters[..., None, 10:12]
    ideal = mapped[..., :2] / mapped[..., 2:] - centre
    radius = np.sum(ideal * ideal, axis=-1, keepdims=True)
    k1, k2 = parameters[..., 8, None, None], parameters[..., 9, None, None]
    return centre + ideal * (1.0 + radius * (k1 + radius * k2))
