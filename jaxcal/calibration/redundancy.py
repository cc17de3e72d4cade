"""How much a view repeats what other views have said already, judged by whether their residuals agree.

Corner noise is independent from view to view, and then every view counts in full. What the model cannot explain (a
lean lens model, a board that is not flat, a detector's bias) is the same in all views that look alike: a hundred of
them say hardly more than one, yet outvote the few views that reach the image's rim. So the correlation of residuals
in pairs of views that look alike is measured; where it is there, a view is weighted by the inverse of the number of
views that it stands for (the design effect of clustered samples, Kish 1965, sec. 8.2).
"""

from dataclasses import dataclass

import numpy as np

from jaxcal.calibration.assemble import CameraFrames

# Views closer than this look alike (see `view_features`: 0.12 is 77 px of shift in a 640 px image).
_ALIKE = 0.12
_PAIRS, _TRIED_PAIRS = 4000, 240_000
_MOST_VIEWS = 3000
# Correlations below this are taken for noise: independent corners in some thousand pairs stay well under it.
_NEGLIGIBLE = 0.08
# The share of views, the least repeated ones, that get weight one.
_FULL_WEIGHT_QUANTILE = 0.98
# Weights above that are let through up to here: the few views at the rim are all there is to tell of it.
_LARGEST_WEIGHT = 4.0


@dataclass(frozen=True)
class Redundancy:
    """What the views of one camera are worth.

    `weights` (F,) of the views, relative, about 1 for those that stand for themselves; `inflation` by which a
    covariance from these weights is too small; `correlation` of residuals in views that look alike.
    """

    weights: np.ndarray
    inflation: float
    correlation: float


def view_features(frames: CameraFrames) -> np.ndarray:
    """Where and how the board stands in each image (F, 6): centre, spread, shear in units of the image's longer side,
    and the share of the board that is seen."""
    scale = float(max(frames.detections.image_size))
    count = np.maximum(frames.seen.sum(axis=1), 2)[:, None]
    xy = np.where(frames.seen[..., None], frames.pixels / scale, 0.0)
    middle = xy.sum(axis=1) / count
    centred = np.where(frames.seen[..., None], xy - middle[:, None], 0.0)
    spread = np.sqrt(np.sum(centred**2, axis=1) / (count - 1))
    shear = np.sum(centred[..., 0] * centred[..., 1], axis=1, keepdims=True) / (count - 1)
    return np.concatenate([middle, spread, 10.0 * shear, frames.seen.mean(axis=1, keepdims=True)], axis=1)


def measure_redundancy(frames: CameraFrames, errors: np.ndarray, usable: np.ndarray, sigma: float) -> Redundancy:
    """Weights of the views of one camera from its reprojection errors (F, N, 2), px, with corner noise `sigma`.

    `usable` (F, N) marks corners that take part. Deterministic.
    """
    count = len(errors)
    even = Redundancy(np.ones(count), 1.0, 0.0)
    if count < 20:
        return even
    features = view_features(frames)
    # Outliers are shortened, so that they do not make up the correlation.
    length = np.linalg.norm(errors, axis=-1, keepdims=True)
    errors = np.where(usable[..., None], errors * np.minimum(1.0, 4.0 * sigma / np.maximum(length, 1e-12)), 0.0)
    correlation = _correlation_of_look_alikes(features, errors, usable)
    if correlation < _NEGLIGIBLE:
        return even
    weights, inflation = _shared_out(features, np.ones(count))
    return Redundancy(weights, inflation, correlation)


def spread_over_look_alikes(frames: CameraFrames, redundancy: Redundancy, noise: np.ndarray) -> Redundancy:
    """The same with noisy views (`noise` (F,), relative) counting less than those that look like them, but look-alikes
    together as much as before."""
    if redundancy.correlation < _NEGLIGIBLE:
        return redundancy
    weights, inflation = _shared_out(view_features(frames), 1.0 / noise**2)
    return Redundancy(weights, inflation, redundancy.correlation)


def _shared_out(features: np.ndarray, worth: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights (F,) that share out the worth of views among those that look alike, about 1 for views that stand for
    themselves; and how much too small a covariance from them is."""
    weights = worth / _stands_for(features, worth)
    full = float(np.quantile(weights, _FULL_WEIGHT_QUANTILE))
    return np.minimum(weights / full, _LARGEST_WEIGHT), 1.0 / full


def _correlation_of_look_alikes(features: np.ndarray, errors: np.ndarray, usable: np.ndarray) -> float:
    """Correlation of the residuals of equal corners over pairs of views that look alike."""
    rng = np.random.default_rng(0)
    if len(errors) * (len(errors) - 1) // 2 <= _TRIED_PAIRS:
        first, second = rng.permutation(np.column_stack(np.triu_indices(len(errors), 2))).T
    else:
        first, second = rng.integers(0, len(errors), size=(2, _TRIED_PAIRS))
    after = np.arange(len(errors) - 1)  # neighbours in time are often the most alike
    first, second = np.concatenate([after, first]), np.concatenate([after + 1, second])
    distance = np.linalg.norm(features[first] - features[second], axis=1)
    pairs = np.flatnonzero((distance < _ALIKE) & (first != second))[:_PAIRS]
    product, power = 0.0, 0.0
    for chunk in np.array_split(pairs, max(len(pairs) // 500, 1)):
        a, b = errors[first[chunk]], errors[second[chunk]]
        both = (usable[first[chunk]] & usable[second[chunk]])[..., None]
        product += float(np.sum(a * b * both))
        power += float(np.sum(0.5 * (a**2 + b**2) * both))
    return product / power if len(pairs) >= 10 and power > 0 else 0.0


def _stands_for(features: np.ndarray, worth: np.ndarray) -> np.ndarray:
    """The worth (F,) of each view and of its look-alikes together: these count by how alike they are."""
    step = max(1, len(features) // _MOST_VIEWS)
    others = features[::step]
    total = np.empty(len(features))
    for start in range(0, len(features), 500):
        rows = features[start : start + 500]
        distance = np.linalg.norm(rows[:, None] - others[None], axis=-1)
        total[start : start + 500] = (np.maximum(1.0 - distance / _ALIKE, 0.0) @ worth[::step]) * step
    return np.maximum(total, worth)
