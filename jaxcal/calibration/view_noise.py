"""How noisy the corners of one view are beside those of the others: motion blur, defocus and distance differ by view.

A view's noise is what is left of its residuals when a smooth displacement over the board is taken out, since that is
the model's error (a lean lens, a bent board, a wrong pose) and no noise: the views at the image's rim, where models
err most, must not count less for it. Where the lens is too lean for the corners, least squares with these weights
would choose the image's middle over its rim, since a camera that turns fast has noisy views at the rim; noisy views
then count less than views that look like them, but no place in the image counts less than another.
"""

from collections.abc import Sequence

import numpy as np

from jaxcal.calibration.assemble import CameraFrames
from jaxcal.calibration.redundancy import Redundancy, spread_over_look_alikes

# Smooth displacements: polynomials of this many terms (second degree) in the places on the board, for u and for v.
_TERMS = 6
# Views whose noise differs by less than this (standard deviation of the logarithm of the variance) are taken for alike:
# least squares that takes them so wastes less than exp(0.5^2) - 1 = 28 % of the variance, 13 % of a sigma, and gives
# what every other tool gives. (Real recordings at hand: 0.2 to 0.45, and 0.8 where motion blurs.)
_ALIKE = 0.5
_LARGEST_RATIO = 4.0
# A lens is too lean when more than this share of the squared residuals goes by the place in the image.
LEAN = 0.05
_CELLS = 12  # of the image's longer side
_FEWEST_IN_CELL = 30


def weigh_views(
    frames: CameraFrames, errors: np.ndarray, kept: np.ndarray, places: np.ndarray, redundancy: Redundancy
) -> tuple[Redundancy, np.ndarray]:
    """What the views of a camera are worth with their noise in view: weights, and the noise (F,) of each beside them.

    `errors` (F, N, 2) of the corners in units of what the detector claims, `kept` (F, N) the inliers, `places` (N, 2)
    of the points on the board.
    """
    noise = view_noise(errors, kept, places)
    if share_of_place(frames, errors, kept) < LEAN:
        return redundancy, noise
    return spread_over_look_alikes(frames, redundancy, noise), np.ones(len(noise))


def share_of_place(frames: CameraFrames, errors: np.ndarray, kept: np.ndarray) -> float:
    """The share of squared residuals (F, N, 2) that the place in the image explains, beyond chance: what is left of a
    lens that its model cannot say. What goes by the point of the board (a detector's bias) is taken out first."""
    if not kept.any():
        return 0.0
    point = np.broadcast_to(np.arange(kept.shape[1]), kept.shape)[kept]
    left = errors[kept] - _means(errors[kept], point)
    cell = (frames.pixels[kept] * (_CELLS / max(frames.detections.image_size))).astype(int).clip(0, _CELLS)
    cell = cell[:, 1] * (_CELLS + 1) + cell[:, 0]
    counts = np.bincount(cell)
    full = counts[cell] >= _FEWEST_IN_CELL
    left, cell = left[full], cell[full]
    total = float(np.sum(left**2))
    if total <= 0 or len(cell) < 2:
        return 0.0
    explained = float(np.sum(_means(left, cell) ** 2)) / total
    by_chance = len(np.unique(cell)) / len(cell)
    return (explained - by_chance) / (1.0 - by_chance)


def _means(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Mean (M, 2) over the group of each of the values (M, 2)."""
    count = np.maximum(np.bincount(group), 1)
    return np.stack([(np.bincount(group, values[:, k]) / count)[group] for k in (0, 1)], axis=1)


def view_noise(errors: np.ndarray, kept: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Noise (F,) of the views of one camera, relative to the usual one's. Arguments as for `weigh_views`.

    Empirical Bayes: the logarithms of the variances scatter because few residuals tell each, by 2 / freedom, and
    because views differ, by the rest; each is drawn to their mean by the share of the former (in the manner of Efron
    and Morris 1975, eq. 1.5, on log variances). Views that are alike all get exactly one.
    """
    count = len(errors)
    freedom = 2.0 * (kept.sum(axis=1) - _TERMS)
    told = freedom >= 2 * _TERMS
    if told.sum() < 10:
        return np.ones(count)
    power = _rest(errors, kept, _smooth_terms(places))
    told &= power > 0
    logs = np.log(power[told] / freedom[told])
    chance = 2.0 / freedom[told]
    spread = float(np.var(logs) - np.mean(chance))
    if spread < _ALIKE**2:
        return np.ones(count)
    ratio = np.ones(count)
    middle = np.median(logs)
    ratio[told] = np.exp(0.5 * spread / (spread + chance) * (logs - middle))
    return np.clip(ratio, 1.0 / _LARGEST_RATIO, _LARGEST_RATIO)


def all_alike(counts: Sequence[int]) -> list[np.ndarray]:
    """The noise of views of which nothing is known, per camera."""
    return [np.ones(count) for count in counts]


def _smooth_terms(places: np.ndarray) -> np.ndarray:
    """Polynomials (N, _TERMS) of places (N, 2)."""
    centred = places - places.mean(axis=0)
    x, y = (centred / np.maximum(np.abs(centred).max(), 1e-12)).T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _rest(errors: np.ndarray, kept: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    """Sums of squares (F,) of errors (F, N, 2) where they are kept, less what smooth terms (N, t) explain of each."""
    own = np.where(kept[..., None], errors, 0.0)
    products = (smooth[:, :, None] * smooth[:, None, :]).reshape(len(smooth), -1)
    gram = (kept @ products).reshape(-1, smooth.shape[1], smooth.shape[1])
    force = np.einsum("nt,fnk->ftk", smooth, own)
    # Few corners, or corners on a line, do not tell all terms apart.
    explained = np.einsum("ftk,ftk->f", force, np.linalg.pinv(gram, rcond=1e-9, hermitian=True) @ force)
    return np.sum(own**2, axis=(1, 2)) - explained
