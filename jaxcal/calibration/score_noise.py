"""How much further a lens is off than it would be if the errors of corners were independent of each other.

Corners of one view that err together (a lens model too lean, a board that is not flat, a network that makes frames of
events), and views that err like the ones before them, tell less than their number says. What counts for the lens is
its score, the gradient of the cost by its parameters: over all views, scores of independent corners scatter as the
information matrix says. Whether they scatter more is tested view by view and over neighbours in time (the "sandwich" of
White 1980 with the weights over lags of Newey and West 1987, "A simple, positive semi-definite, heteroskedasticity and
autocorrelation consistent covariance matrix", eq. 5). Where they do, by how much, and in which directions, is what the
lens does when one stretch of the recording after another is left out (Kott 2001, "The delete-a-group jackknife"):
unlike the sandwich it sees errors that last as long as a stretch, and allows for the share of its own errors that the
lens has followed.
"""

from dataclasses import dataclass

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
# Stretches of the recording that are left out in turn. Of more and shorter ones each errs like its neighbours: errors
# of lenses from events were 1.34, 1.15 and 1.01 sigma with 24, 12 and 8 of 10 s. Fewer say little for sure.
STRETCHES = 8
_CUTS = 3
_MORE_FREEDOM = 1.5  # that these give, as overlapping blocks do
# A direction that one stretch alone tells is not known without it; its step is held to the inverse of this share.
LEAST_LEFT = 0.1
_FEWEST_CORNERS = 6
_AT_ONCE = 2_000_000  # derivatives, for memory
_SAME_POSE = 1e-12  # of the information on a pose: corners in a line leave a turn about it open


@dataclass(frozen=True)
class ScoreNoise:
    """How the score of a lens scatters.

    `effect`: the usual variance of a direction beside that of independent corners, 1 where these are so;
    `scatter` (D, D): its covariance in the coordinates in which that of independent corners is the identity;
    `directions` (P, D): from these coordinates to derivatives of the cost by the lens's parameters.
    """

    effect: float
    scatter: np.ndarray
    directions: np.ndarray

    def beyond(self, effect: float) -> np.ndarray:
        """Covariance (P, P) of the score where it scatters by more than `effect` times what independent corners show:
        in a few directions it may be far more than usual."""
        values, vectors = np.linalg.eigh(self.scatter)
        along = self.directions @ vectors
        return (along * np.maximum(values - effect, 0.0)) @ along.T


def design_effect(
    model: CameraModel, points: np.ndarray, poses: np.ndarray, errors: np.ndarray, weights: np.ndarray
) -> float:
    """By what factor the covariance of a lens is larger than its information says; 1 where corners are independent.

    The usual one of the directions of the lens (Kish's design effect). Arguments as for `score_noise`.
    """
    found = score_noise(model, points, poses, errors, weights)
    return 1.0 if found is None else found.effect


def score_noise(
    model: CameraModel, points: np.ndarray, poses: np.ndarray, errors: np.ndarray, weights: np.ndarray
) -> ScoreNoise | None:
    """How the score of a lens scatters; None where it does so as with independent corners, or too little is seen.

    `points` (N, 3) of the target, m; `poses` (F, 4, 4) T_cam_target in the order of time; `errors` (F, N, 2) projection
    minus measurement, px; `weights` (F, N) of the least squares, px^-2, zero for corners that take no part. The poses
    are taken for free.
    """
    taken = np.flatnonzero((weights > 0).sum(axis=1) >= _FEWEST_CORNERS)
    if len(taken) < _FEWEST_VIEWS:
        return None
    chosen = _chosen(model)
    views = max(_AT_ONCE // (len(points) * len(np.asarray(model.parameters))), 1)
    parts = [
        _scores(model, chosen, points, poses[some], errors[some], weights[some])
        for some in np.array_split(taken, -(-len(taken) // views))
    ]
    scores, of_views = (np.concatenate(part) for part in zip(*parts, strict=True))
    fine = np.isfinite(scores).all(axis=1) & np.isfinite(of_views).all(axis=(1, 2))
    if fine.sum() < _FEWEST_VIEWS:
        return None
    scores, of_views = scores[fine], of_views[fine]
    information = of_views.sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    told = values > 1e-10 * values[-1]  # directions that nothing is known of say nothing here
    whitened = vectors[:, told] / np.sqrt(values[told]) / scale[:, None]
    scores, of_views = scores @ whitened, whitened.T @ of_views @ whitened
    if not _beyond_chance(scores, of_views):
        return None
    scatter = of_few(_MORE_FREEDOM * (STRETCHES - 1)) * _jackknife(scores, of_views)
    directions = np.zeros((len(np.asarray(model.parameters)), len(scatter)))
    directions[chosen] = information @ whitened
    return ScoreNoise(usual_effect(np.linalg.eigvalsh(scatter)), scatter, directions)


def of_few(freedom: float) -> float:
    """By how much a variance estimated with so many degrees of freedom has to be larger for it: Student's t."""
    return freedom / (freedom - 2.0)


def usual_effect(variances: np.ndarray) -> float:
    """The mean of variances in rising order, at least 1, without the largest: a direction in which the lens model does
    not fit may scatter by a hundred times as much as all others, and would be taken for what they do."""
    return max(float(np.mean(variances[:-1])), 1.0) if len(variances) > 1 else max(float(variances[0]), 1.0)


def _chosen(model: CameraModel) -> np.ndarray:
    """The parameters that are looked at."""
    count = len(np.asarray(model.parameters))
    return np.linspace(0, count - 1, min(count, _MOST_PARAMETERS)).astype(int)


def _scores(
    model: CameraModel,
    chosen: np.ndarray,
    points: np.ndarray,
    poses: np.ndarray,
    errors: np.ndarray,
    weights: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The score (F, P) of the lens's parameters `chosen` in each view, with the view's pose free, and its covariance
    (F, P, P) were errors independent. The other arguments as for `score_noise`."""
    root = np.sqrt(weights)
    seen = np.einsum("fij,nj->fin", poses[:, :3, :3], points) + poses[:, :3, 3, None]
    by_lens, by_pose = _derivatives(model, chosen, np.where(root[:, None] > 0, seen, 1.0))
    columns = np.concatenate([by_lens, errors.swapaxes(1, 2)[:, None], by_pose], axis=1)
    columns *= root[:, None, None]
    columns[np.broadcast_to(root[:, None, None] == 0, columns.shape)] = 0.0  # where nothing was seen may be anything
    columns = columns.reshape(*columns.shape[:2], -1)
    products = columns @ columns.swapaxes(1, 2)
    # The pose eliminated: what is left of lens and error is what no pose makes up for.
    size = columns.shape[1] - 6
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2)[:, size:], 1e-300))
    of_pose = products[:, size:, size:] * scale[:, :, None] * scale[:, None, :] + _SAME_POSE * np.eye(6)
    with_pose = products[:, :size, size:] * scale[:, None, :]
    left = products[:, :size, :size] - with_pose @ np.linalg.solve(of_pose, with_pose.swapaxes(1, 2))
    return left[:, :-1, -1], left[:, :-1, :-1]


def _beyond_chance(scores: np.ndarray, expected: np.ndarray) -> bool:
    """Whether the sum of scores (V, D) varies more than it would by chance were the scores independent with covariances
    `expected` (V, D, D), which add up to the identity."""
    views, directions = scores.shape
    lags = int(np.ceil(_LAGS * views))
    total, by_chance = np.sum(scores**2), 2.0 * np.sum(expected**2)
    for lag in range(1, lags + 1):
        weight = 1.0 - lag / (lags + 1.0)
        total += 2.0 * weight * np.sum(scores[lag:] * scores[:-lag])
        by_chance += 4.0 * weight**2 * np.sum(expected[lag:] * expected[:-lag])
    return bool(total / directions > 1.0 + _BEYOND_CHANCE * np.sqrt(by_chance) / directions)


def _jackknife(scores: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Covariance (D, D) of the sum of scores from how the optimum moves when stretches of the views are left out.

    The mean over three ways to cut the recording, as a ring, into stretches (overlapping blocks, Kuensch 1989): so few
    stretches would tell of fewer directions than a lens has.
    """
    count = min(STRETCHES, len(scores))
    views = np.arange(len(scores))
    starts = {len(scores) * cut // (_CUTS * count) for cut in range(_CUTS)}
    stretches = [part for start in starts for part in np.array_split(np.roll(views, -start), count)]
    left, vectors = np.linalg.eigh(np.eye(scores.shape[1]) - np.stack([expected[s].sum(axis=0) for s in stretches]))
    own = np.stack([scores[s].sum(axis=0) for s in stretches])
    turned = np.einsum("sij,si->sj", vectors, own) / np.maximum(left, LEAST_LEFT)
    moved = np.einsum("sij,sj->si", vectors, turned)
    return (1.0 - 1.0 / count) / len(starts) * moved.T @ moved


def _derivatives(model: CameraModel, chosen: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the pixels of points (F, 3, N) in the camera's frame by the lens (F, P, 2, N) and by the pose
    (F, 6, 2, N), rotation first; zeros where a point cannot be projected."""
    parameters = np.asarray(model.parameters)
    found = ModelLens(model).project(parameters[None], seen[None], True)
    assert found.by_lens is not None
    by_point = found.by_point[0].swapaxes(1, 2)
    x, y, z = seen[:, :, None].swapaxes(0, 1)
    by_x, by_y, by_z = by_point.swapaxes(0, 1)
    by_turn = [y * by_z - z * by_y, z * by_x - x * by_z, x * by_y - y * by_x]  # a turn w moves a point by w x point
    return found.by_lens[0][:, chosen], np.concatenate([np.stack(by_turn, axis=1), by_point], axis=1)
