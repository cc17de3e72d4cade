"""How a board is seen: a homography and radial distortion, fitted to corners of which some may be wrong."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

_SOFT_PX = 0.5  # residuals beyond this count by their length, not by its square
_MAX_FITS = 60
_POOR_PX = 0.3  # where a corner is further from the view, another kind of lens is tried
# 1-sigma of what few corners cannot tell: radial distortion at the grid's farthest corner, and the centre of
# distortion as a fraction of that corner's distance. A deviation of one sigma counts as much as a pixel.
_PRIOR_SIGMAS = np.array([0.5, 0.5, 0.2, 0.2])
_STEP = 1e-4  # of the board's size, for second derivatives


@dataclass(frozen=True)
class BoardView:
    """Pixels of places on the board: a homography, two radial coefficients and a centre of distortion of its own.

    A homography alone is wrong by several pixels across the image of a common lens. `parameters` (12,) are in units
    of the board (`middle` (2,) m, `size` m) and of the image (`centre` (2,) px, `reach` px). Radii are a polynomial
    of those of the homography, or follow from a `division` (Fitzgibbon 2001), as those of the widest lenses do.
    """

    parameters: np.ndarray
    middle: np.ndarray
    size: float
    centre: np.ndarray
    reach: float
    division: bool

    def pixels(self, board: np.ndarray) -> np.ndarray:
        """Pixels (..., N, 2) of places (..., N, 2) on the board, m."""
        unit = (board - self.middle) / self.size
        unit = np.concatenate([unit, np.ones_like(unit[..., :1])], axis=-1)
        return _seen(self.parameters, unit, self.division) * self.reach + self.centre

    def derivatives(self, board: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First derivatives (N, 2, 2), px / m, and second ones (N, 2, 3), px / m^2: by xx, xy, yy, at places (N, 2)."""
        h = _STEP * self.size
        steps = h * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]])
        at, right, left, up, down, *corners = self.pixels(board + steps[:, None])
        mixed = (corners[0] + corners[1] - corners[2] - corners[3]) / 4.0
        first = np.stack([right - left, up - down], axis=-1) / (2.0 * h)
        return first, np.stack([right - 2.0 * at + left, mixed, up - 2.0 * at + down], axis=-1) / h**2


def fit_view(board: np.ndarray, pixels: np.ndarray, image_size: tuple[int, int]) -> BoardView | None:
    """The view that corners at `board` (N, 2), m, and `pixels` (N, 2) show, N >= 8; None where they are no view of a
    plane. Fitted with a loss that grows linearly, so that corners out of place do not bend it."""
    middle, centre = board.mean(axis=0), np.array(image_size) / 2.0 - 0.5
    size = max(float(np.abs(board - middle).max()), 1e-12)
    unit = np.column_stack([(board - middle) / size, np.ones(len(board))])
    reach = float(np.linalg.norm(pixels - centre, axis=1).max())
    seen = (pixels - centre) / reach
    homography, _ = cv2.findHomography(unit[:, :2], seen, cv2.LMEDS)
    if homography is None or abs(homography[2, 2]) < 1e-9:
        return None
    start = np.concatenate([(homography / homography[2, 2]).ravel()[:8], np.zeros(4)])
    cost, parameters, far = _fitted(start, unit, seen, reach, division=False)
    division = False
    if far > _POOR_PX:
        other, bent, _ = _fitted(start, unit, seen, reach, division=True)
        division = other < cost
        parameters = bent if division else parameters
    return BoardView(parameters, middle, size, centre, reach, division)


def _fitted(
    start: np.ndarray, unit: np.ndarray, seen: np.ndarray, reach: float, division: bool
) -> tuple[float, np.ndarray, float]:
    """Cost and parameters of the best view of one kind, and how far the corners are from it at most, px."""

    def misfit(parameters: np.ndarray) -> np.ndarray:
        error = (_seen(parameters, unit, division) - seen) * reach
        return np.concatenate([error.reshape(*parameters.shape[:-1], -1), parameters[..., 8:] / _PRIOR_SIGMAS], axis=-1)

    def jacobian(parameters: np.ndarray) -> np.ndarray:
        step = 1e-20  # by complex step: exact, and all columns at once
        return np.imag(misfit(parameters + 1j * step * np.eye(len(parameters)))).T / step

    derivatives: Any = jacobian  # scipy's stubs know only the names of its own methods
    fit = least_squares(
        misfit, start, derivatives, loss="soft_l1", f_scale=_SOFT_PX, x_scale="jac", ftol=1e-5, max_nfev=_MAX_FITS
    )
    distance = np.linalg.norm(misfit(fit.x)[:-4].reshape(-1, 2), axis=1)
    return float(fit.cost), fit.x, float(distance.max())


def _seen(parameters: np.ndarray, unit: np.ndarray, division: bool) -> np.ndarray:
    """Image points (..., N, 2) of homogeneous board points (..., N, 3).

    `parameters` (..., 12): the homography but for its last entry, which is 1; two radial coefficients; the centre of
    distortion.
    """
    homography = np.concatenate([parameters[..., :8], np.ones_like(parameters[..., :1])], axis=-1)
    mapped = unit @ np.swapaxes(homography.reshape(*parameters.shape[:-1], 3, 3), -1, -2)
    k1, k2 = parameters[..., 8, None, None], parameters[..., 9, None, None]
    centre = parameters[..., None, 10:12]
    ideal = mapped[..., :2] / mapped[..., 2:] - centre
    square = np.sum(ideal * ideal, axis=-1, keepdims=True)
    if not division:
        return centre + ideal * (1.0 + square * (k1 + square * k2))
    # Where division would draw out it has an end, and is not asked.
    inwards = (k1 * square).real < 0.0
    drawn = 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * np.where(inwards, k1 * square, 0.0)))
    ideal = ideal * np.where(inwards, drawn, 1.0 + k1 * square)
    return centre + ideal * (1.0 + k2 * np.sum(ideal * ideal, axis=-1, keepdims=True) ** 2)
