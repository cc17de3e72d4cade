"""Which corners of a planar grid lie where all the others say they should."""

import cv2
import numpy as np

from jaxcal.detection.homography import apply_homography

_ROUNDS = 8
_SIGMAS = 4.0


def agreeing_corners(board: np.ndarray, pixels: np.ndarray, floor_px: float = 1.0) -> np.ndarray:
    """Mask (N,) of corners whose `pixels` (N, 2) fit a smooth map of their `board` coordinates (N, 2).

    The map is a homography, for the perspective, plus a polynomial, for the lens: a homography alone is wrong by
    several pixels across a distorted image. It is fitted to all corners, first by least absolute deviations and then
    with Tukey's biweight, and a corner is rejected when its studentised residual exceeds both four robust standard
    deviations of all and `floor_px` (a sharp image would lose good corners to its small spread). With fewer than 8
    corners, too few to tell, all are kept.
    """
    count = len(board)
    if count < 8:
        return np.ones(count, bool)
    centred = board - board.mean(axis=0)
    unit = centred / np.maximum(np.abs(centred).max(), 1e-12)
    homography, _ = cv2.findHomography(unit, pixels, cv2.LMEDS)
    if homography is None:
        return np.ones(count, bool)
    residual = pixels - apply_homography(homography, unit)
    basis = _polynomials(unit, _degree(count))
    size = _fitted(basis, residual, np.ones(count))
    for _ in range(_ROUNDS):
        size = _fitted(basis, residual, 1.0 / np.maximum(size, floor_px / 4.0))
    for _ in range(_ROUNDS):
        size = _fitted(basis, residual, _biweight(size, floor_px / 4.0))
    return size <= max(floor_px, _SIGMAS * _spread(size))


def _degree(count: int) -> int:
    """Degree of the polynomial, so that corners outnumber its coefficients by four."""
    return max(degree for degree in range(1, 5) if degree == 1 or 4 * (degree + 1) * (degree + 2) // 2 <= count)


def _polynomials(unit: np.ndarray, degree: int) -> np.ndarray:
    x, y = unit.T
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


def _fitted(basis: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Lengths (N,) of what a weighted fit of `basis` leaves of `values` (N, 2), studentised.

    A corner at the rim pulls the fit towards itself, and one without weight is extrapolated to: residuals are divided
    by the standard deviation that this gives them.
    """
    weight = weight / weight.max()
    normal = basis.T @ (basis * weight[:, None])
    inverse = np.linalg.pinv(normal, hermitian=True)
    left = values - basis @ (inverse @ (basis.T @ (values * weight[:, None])))
    leverage = np.einsum("ni,ij,nj->n", basis, inverse, basis)
    variance = 1.0 + leverage * (1.0 - 2.0 * weight)  # 1 - h for full weight, 1 + h for none
    return np.linalg.norm(left, axis=1) / np.sqrt(np.maximum(variance, 0.1))


def _spread(size: np.ndarray) -> float:
    """Robust standard deviation per axis of 2-D residuals from their lengths (median of a Rayleigh distribution)."""
    return float(np.median(size)) / 1.1774


def _biweight(size: np.ndarray, floor: float) -> np.ndarray:
    """Tukey's weights; zero beyond 4.7 robust standard deviations."""
    limit = 4.685 * max(_spread(size), floor)
    return np.where(size < limit, (1.0 - np.minimum(size / limit, 1.0) ** 2) ** 2, 0.0)
