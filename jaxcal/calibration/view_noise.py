"""How noisy the corners of one view are beside those of the others: motion blur, defocus and distance differ by view.

A view's noise is what is left of its residuals when a smooth displacement over the board is taken out, since that is
the model's error (a lean lens, a bent board, a wrong pose) and no noise: the views at the image's rim, where models
err most, must not count less for it.
"""

from collections.abc import Sequence

import numpy as np

# Smooth displacements: polynomials of this many terms (second degree) in the places on the board, for u and for v.
_TERMS = 6
# Views whose noise differs by less than this (standard deviation of the logarithm of the variance) are all alike.
_ALIKE = 0.15
_LARGEST_RATIO = 4.0


def view_noise(errors: np.ndarray, kept: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Noise (F,) of the views of one camera, relative to the usual one's.

    `errors` (F, N, 2) of the corners in units of what the detector claims, `kept` (F, N) the inliers, `places` (N, 2)
    of the points on the board. Empirical Bayes: the logarithms of the variances scatter because few residuals tell
    each, by 2 / freedom, and because views differ, by the rest; each is drawn to their mean by the share of the
    former (Efron and Morris 1975, eq. 1.5, on log variances). Views that are alike all get exactly one.
    """
    count = len(errors)
    freedom = 2.0 * (kept.sum(axis=1) - _TERMS)
    told = freedom >= 2 * _TERMS
    if told.sum() < 10:
        return np.ones(count)
    smooth = _smooth_terms(places)
    power = np.array([_rest(errors[f][kept[f]], smooth[kept[f]]) if told[f] else 1.0 for f in range(count)])
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


def _rest(errors: np.ndarray, smooth: np.ndarray) -> float:
    """Sum of squares of errors (n, 2) less what smooth terms (n, t) explain of them."""
    q, _ = np.linalg.qr(smooth)
    return float(np.sum(errors**2) - np.sum((q.T @ errors) ** 2))
