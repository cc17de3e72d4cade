"""Homographies: fitting them to points and applying them."""

import numpy as np


def fit_homography(source: np.ndarray, destination: np.ndarray) -> np.ndarray:
    """Homography (3, 3) that takes points (N, 2) to points (N, 2), N >= 4.

    Direct linear transform on normalised coordinates (Hartley & Zisserman, Multiple View Geometry, algorithm 4.2).
    """
    to_unit, back = _normaliser(source), _normaliser(destination)
    s = apply_homography(to_unit, source)
    d = apply_homography(back, destination)
    one, zero = np.ones(len(s)), np.zeros(len(s))
    x, y = s.T
    rows_u = np.stack([x, y, one, zero, zero, zero, -d[:, 0] * x, -d[:, 0] * y, -d[:, 0]], axis=1)
    rows_v = np.stack([zero, zero, zero, x, y, one, -d[:, 1] * x, -d[:, 1] * y, -d[:, 1]], axis=1)
    system = np.concatenate([rows_u, rows_v])
    _, vectors = np.linalg.eigh(system.T @ system)
    unit = vectors[:, 0].reshape(3, 3)
    return np.linalg.inv(back) @ unit @ to_unit


def apply_homography(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map points (..., 2). Points on the horizon come out far away, but finite."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    scale = mapped[..., 2:]
    return mapped[..., :2] / np.where(np.abs(scale) < 1e-12, 1e-12, scale)


def _normaliser(points: np.ndarray) -> np.ndarray:
    centre = points.mean(axis=0)
    scale = 1.0 / max(float(np.sqrt(np.mean((points - centre) ** 2))), 1e-12)
    return np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])
