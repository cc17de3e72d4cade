"""How much further a lens is off than it would be if the errors of corners were independent of each other.

Corners of one view that err together (a lens model too lean, a board that is not flat, a network that makes frames of
events), and views that err like the ones before them, tell less than their number says. What counts for the lens is
its score, the gradient of the cost by its parameters: over all views, scores of independent corners scatter as the
information matrix says. Here the scatter is measured, view by view and over neighbours in time (the "sandwich" of
White 1980 with the weights over lags of Newey and West 1987, "A simple, positive semi-definite, heteroskedasticity and
autocorrelation consistent covariance matrix", eq. 5), and compared with that matrix.
"""

from collections.abc import Callable

import numpy as np

from jaxcal.cameras import CameraModel

# Lags up to this share of the views are looked at.
_LAGS = 0.05
# A scatter larger than independent corners show by so many of its own standard deviations is no chance.
_BEYOND_CHANCE = 5.0
# Of lenses with very many parameters so many are looked at, evenly chosen.
_MOST_PARAMETERS = 24
_FEWEST_VIEWS = 8
_FEWEST_CORNERS = 6
_AT_ONCE = 500  # views, for memory
_STEP = 1e-6


def design_effect(
    model: CameraModel, points: np.ndarray, poses: np.ndarray, errors: np.ndarray, weights: np.ndarray
) -> float:
    """By what factor the covariance of a lens is larger than its information says; 1 where corners are independent.

    `points` (N, 3) of the target, m; `poses` (F, 4, 4) T_cam_target in the order of time; `errors` (F, N, 2) projection
    minus measurement, px; `weights` (F, N) of the least squares, px^-2, zero for corners that take no part. The poses
    are taken for free. The factor is the mean over the directions of the lens (Kish's design effect).
    """
    taken = np.flatnonzero((weights > 0).sum(axis=1) >= _FEWEST_CORNERS)
    if len(taken) < _FEWEST_VIEWS:
        return 1.0
    parts = [
        _scores(model, points, poses[some], errors[some], weights[some])
        for some in np.array_split(taken, -(-len(taken) // _AT_ONCE))
    ]
    scores, of_views = (np.concatenate(part) for part in zip(*parts, strict=True))
    # Steps may leave the lens' domain where a corner lies on its border.
    fine = np.isfinite(scores).all(axis=1) & np.isfinite(of_views).all(axis=(1, 2))
    if fine.sum() < _FEWEST_VIEWS:
        return 1.0
    scores, of_views = scores[fine], of_views[fine]
    information = of_views.sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    told = values > 1e-10 * values[-1]  # directions that nothing is known of say nothing here
    whitened = vectors[:, told] / np.sqrt(values[told]) / scale[:, None]
    return _scatter(scores @ whitened, whitened.T @ of_views @ whitened)


def _scores(
    model: CameraModel, points: np.ndarray, poses: np.ndarray, errors: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The score (F, P) of the lens in each view, with the view's pose free, and its covariance (F, P, P) were errors
    independent. Arguments as for `design_effect`."""
    root = np.sqrt(weights)[..., None]
    seen = np.where(root > 0, np.einsum("fij,nj->fni", poses[:, :3, :3], points) + poses[:, None, :3, 3], 1.0)
    by_lens, by_pose = _derivatives(model, seen)
    by_lens, by_pose, error = (
        (np.where(root[..., None] > 0, part, 0.0) * root[..., None]).reshape(len(poses), -1, part.shape[-1])
        for part in (by_lens, by_pose, errors[..., None])
    )
    basis, _ = np.linalg.qr(by_pose)
    by_lens, error = (part - basis @ (basis.swapaxes(1, 2) @ part) for part in (by_lens, error))
    return (by_lens.swapaxes(1, 2) @ error)[..., 0], by_lens.swapaxes(1, 2) @ by_lens


def _scatter(scores: np.ndarray, expected: np.ndarray) -> float:
    """The variance of the sum of scores (V, P), mean over the directions, in each of which it would be one were the
    scores independent with covariances `expected` (V, P, P); 1 where it is so but for chance."""
    views, directions = scores.shape
    lags = int(np.ceil(_LAGS * views))
    total, by_chance = np.sum(scores**2), 2.0 * np.sum(expected**2)
    for lag in range(1, lags + 1):
        weight = 1.0 - lag / (lags + 1.0)
        total += 2.0 * weight * np.sum(scores[lag:] * scores[:-lag])
        by_chance += 4.0 * weight**2 * np.sum(expected[lag:] * expected[:-lag])
    found = float(total / directions)
    return found if found > 1.0 + _BEYOND_CHANCE * np.sqrt(by_chance) / directions else 1.0


def _derivatives(model: CameraModel, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the pixels of points (F, N, 3) in the camera's frame by the lens (F, N, 2, P) and by the pose
    (F, N, 2, 6), by differences: exact ones would need a program for every lens and number of views."""
    parameters = np.asarray(model.parameters)
    chosen = np.linspace(0, len(parameters) - 1, min(len(parameters), _MOST_PARAMETERS)).astype(int).tolist()

    def of_lens(k: int, step: float) -> np.ndarray:
        changed = parameters.copy()
        changed[k] += step
        return np.asarray(model.with_parameters(changed).project(seen))

    def of_pose(k: int, step: float) -> np.ndarray:
        axis = np.eye(3)[k % 3]
        return np.asarray(model.project(seen + step * (np.cross(axis, seen) if k < 3 else axis)))

    def slope(value: Callable[[int, float], np.ndarray], k: int, step: float) -> np.ndarray:
        return (value(k, step) - value(k, -step)) / (2.0 * step)

    by_lens = [slope(of_lens, k, _STEP * max(1.0, float(abs(parameters[k])))) for k in chosen]
    return np.stack(by_lens, axis=-1), np.stack([slope(of_pose, k, _STEP) for k in range(6)], axis=-1)
