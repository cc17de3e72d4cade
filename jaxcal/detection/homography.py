"""Homographies: fitting them to points and applying them, one or a stack at once."""

import numpy as np


def fit_homography(source: np.ndarray, destination: np.ndarray) -> np.ndarray:
    """Homographies (..., 3, 3) that take points (..., N, 2) to points (..., N, 2), N >= 4.

    Direct linear transform on normalised coordinates (Hartley & Zisserman, Multiple View Geometry, algorithm 4.2).
    """
    to_unit, back = _normaliser(source), _normaliser(destination)
    s = apply_homography(to_unit, source)
    d = apply_homography(back, destination)
    s = np.concatenate([s, np.ones_like(s[..., :1])], axis=-1)
    rows_u = np.concatenate([s, np.zeros_like(s), -d[..., :1] * s], axis=-1)
    rows_v = np.concatenate([np.zeros_like(s), s, -d[..., 1:] * s], axis=-1)
    # Of the triangular factor, not of the normal equations: their squared condition costs half of the digits.
    triangle = np.linalg.qr(np.concatenate([rows_u, rows_v], axis=-2), mode="r")
    unit = np.linalg.svd(triangle)[2][..., -1, :]
    return np.linalg.inv(back) @ unit.reshape(*unit.shape[:-1], 3, 3) @ to_unit


def apply_homography(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map points (..., N, 2) by homographies (..., 3, 3). Points on the horizon come out far away, but finite."""
    mapped = points @ np.swapaxes(homography[..., :2], -1, -2) + homography[..., None, :, 2]
    scale = mapped[..., 2:]
    return mapped[..., :2] / np.where(np.abs(scale) < 1e-12, 1e-12, scale)


def _normaliser(points: np.ndarray) -> np.ndarray:
    """Similarities (..., 3, 3) that move points (..., N, 2) to the origin and to a spread of one."""
    centre = points.mean(axis=-2)
    spread = np.sqrt(np.mean((points - centre[..., None, :]) ** 2, axis=(-2, -1)))
    scale = 1.0 / np.maximum(spread, 1e-12)
    to_unit = np.zeros((*scale.shape, 3, 3))
    to_unit[..., 0, 0] = to_unit[..., 1, 1] = scale
    to_unit[..., :2, 2] = -scale[..., None] * centre
    to_unit[..., 2, 2] = 1.0
    return to_unit
