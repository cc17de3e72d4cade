"""How much further a lens is off than it would be if the errors of corners were independent of each other.

Corners of one view that err together (a lens model too lean, a board that is not flat, a network that makes frames of
events), and views that err like the ones before them, tell less than their number says. What counts for the lens is
its score, the gradient of the cost by its parameters: over all views, scores of independent corners scatter as the
information matrix says. Here the scatter is measured, view by view and over neighbours in time (the "sandwich" of
White 1980 with the weights over lags of Newey and West 1987, "A simple, positive semi-definite, heteroskedasticity and
autocorrelation consistent covariance matrix", eq. 5), and compared with that matrix.
"""

import numpy as np

from jaxcal.calibration.model_lens import ModelLens
from jaxcal.cameras import CameraModel

# Lags up to this share of the views are looked at.
_LAGS = 0.05
# A scatter larger than independent corners show by so many of its own standard deviations is no chance.
_BEYOND_CHANCE = 5.0
# Of lenses with very many parameters so many are looked at, evenly chosen.
_MOST_PARAMETERS = 24
_FEWEST_VIEWS = 8
_FEWEST_CORNERS = 6
_AT_ONCE = 2_000_000  # derivatives, for memory


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
    views = max(_AT_ONCE // (len(points) * len(np.asarray(model.parameters))), 1)
    parts = [
        _scores(model, points, poses[some], errors[some], weights[some])
        for some in np.array_split(taken, -(-len(taken) // views))
    ]
    scores, of_views = (np.concatenate(part) for part in zip(*parts, strict=True))
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
    (F, N, 2, 6), rotation first; zeros where a point cannot be projected."""
    parameters = np.asarray(model.parameters)
    chosen = np.linspace(0, len(parameters) - 1, min(len(parameters), _MOST_PARAMETERS)).astype(int)
    found = ModelLens(model).project(parameters[None], seen.swapaxes(-1, -2)[None], True)
    assert found.by_lens is not None
    by_lens = np.transpose(found.by_lens[0][:, chosen], (0, 3, 2, 1))
    by_point = np.transpose(found.by_point[0], (0, 3, 1, 2))
    by_turn = np.cross(seen[..., None, :], by_point)  # a turn w moves a point by w x point
    return by_lens, np.concatenate([by_turn, by_point], axis=-1)
