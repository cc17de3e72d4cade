"""Overlapping Allan variance of an inertial sensor's readings, and the noise model that it shows, with confidence.

The model of IEEE Std 952-1997 (annex C) for the Allan variance at cluster time tau:

    sigma^2(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3

N white noise density (the curve's slope -1/2, read at 1 s), B bias instability (its floor over 0.664), K rate random
walk (slope +1/2, read at 3 s). N^2, B^2 and K^2 are fitted by generalised least squares under the covariance that the
Allan variances have if the model is true: a point that rests on few independent clusters says little, and neighbouring
points that rest on the same clusters do not count twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls
from scipy.special import chdtri, xlogy

from jaxcal.errors import CalibrationError

# The fit starts here: below, filters in the sensor, quantisation and vibration shape the curve (s).
_SHORTEST_S = 0.1
# The longest cluster is this share of the recording: three clusters, end to end.
_LONGEST_SHARE = 1.0 / 3.0
# How well the model describes any real sensor: one sigma of the Allan variance, relative.
_MODEL_ERROR = 0.03
# A variance (N^2, B^2, K^2) this many times its sigma is there; a smaller one may be none.
SIGNIFICANT = 3.0
_FLOOR = 2.0 * np.log(2.0) / np.pi
_ITERATIONS = 50
_CONVERGED = 1e-6
# Samples of a covariance function over the shorter of two cluster times, and over the longer.
_FINE, _COARSE = 16, 48


def allan_variance(values: np.ndarray, rate_hz: float, clusters: np.ndarray) -> np.ndarray:
    """Overlapping Allan variance (..., T) of readings (..., N) at cluster lengths (T,) samples.

    Mean over k of (x[k + 2m] - 2 x[k + m] + x[k])^2 / (2 tau^2), where x is the running integral of the readings and
    tau = m / rate (IEEE Std 1139-2008, annex A: fully overlapped). The unit is the readings' squared; one pass over
    the readings per cluster length. Raises CalibrationError when two clusters do not fit into the readings.
    """
    values = np.asarray(values, dtype=np.float64)
    count = values.shape[-1]
    clusters = np.asarray(clusters)
    if clusters.min() < 1 or 2 * clusters.max() > count:
        raise CalibrationError(
            f"Allan variance: clusters of {clusters.min()} to {clusters.max()} samples, of {count}; expected 1 to "
            f"{count // 2}, so that two fit in. Record for longer."
        )
    # Without the mean, which the second difference is blind to, the running sum keeps its digits.
    centred = values - values.mean(axis=-1, keepdims=True)
    integral = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(centred, axis=-1)], axis=-1) / rate_hz
    variances = []
    for m in clusters:
        difference = integral[..., 2 * m :] - 2.0 * integral[..., m:-m] + integral[..., : -2 * m]
        variances.append(np.mean(np.square(difference, out=difference), axis=-1) / (2.0 * (m / rate_hz) ** 2))
    return np.stack(variances, axis=-1)


def cluster_lengths(count: int, rate_hz: float, per_octave: int = 1, shortest_s: float = 0.0) -> np.ndarray:
    """Cluster lengths (T,) in samples, spaced evenly in the logarithm, from `shortest_s` to a third of `count`."""
    first = max(1.0, np.ceil(shortest_s * rate_hz))
    octaves = np.log2(max(count * _LONGEST_SHARE / first, 1.0))
    return np.unique(np.round(first * 2.0 ** (np.arange(int(octaves * per_octave) + 1) / per_octave)).astype(int))


def model_terms(tau_s: np.ndarray) -> np.ndarray:
    """What N^2, B^2 and K^2 are multiplied by (T, 3) in the Allan variance at cluster times (T,) s."""
    return np.stack([1.0 / tau_s, np.full(len(tau_s), _FLOOR), tau_s / 3.0], axis=1)


class ClusterStatistics:
    """What is known of the Allan variances of `count` readings at `rate_hz` before they are read: their covariance.

    An Allan variance is a mean of squares of second differences of the integrated readings. For Gaussian noise the
    covariance of two such means is 2 / (M1 M2) times the sum over all pairs of their terms of the squared covariance
    of the terms, and that follows from the noise's generalised autocovariance s(t), for each part of the model
    (C. A. Greenhall, "Recipes for degrees of freedom of frequency stability estimators", IEEE Trans. Instrum. Meas.
    40, 1991): -N^2 |t| / 2, B^2 t^2 ln|t| / (2 pi), K^2 |t|^3 / 12.
    """

    def __init__(self, count: int, rate_hz: float):
        self.count = count
        self.rate_hz = rate_hz
        self.clusters = cluster_lengths(count, rate_hz, shortest_s=_SHORTEST_S)
        self.tau_s = self.clusters / rate_hz
        self.terms = model_terms(self.tau_s)
        if len(self.clusters) < 5:
            raise CalibrationError(
                f"Allan variance: {count} samples at {rate_hz:.4g} Hz ({count / rate_hz:.3g} s) are too short for a "
                "noise model. Record for 10 minutes at least."
            )

    @cached_property
    def _pairs(self) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
        """All pairs of clusters (P,), and end to end what `_pair` says of each, and where each begins (P,)."""
        pairs = np.triu_indices(len(self.clusters))
        parts = [self._pair(int(self.clusters[i]), int(self.clusters[j])) for i, j in zip(*pairs, strict=True)]
        begins = np.concatenate([[0], np.cumsum([len(weights) for _, weights in parts])[:-1]])
        return pairs, np.concatenate([c for c, _ in parts]), np.concatenate([w for _, w in parts]), begins

    def _pair(self, short: int, long: int) -> tuple[np.ndarray, np.ndarray]:
        """Covariances (L, 3) of the terms of two cluster lengths for unit N^2, B^2, K^2, and their weights (L,)."""
        lags = _lags(short, long)
        covariance = np.zeros((len(lags), 3))
        for a, weight_a in enumerate((1.0, -2.0, 1.0)):
            for b, weight_b in enumerate((1.0, -2.0, 1.0)):
                t = np.abs(lags + b * long - a * short) / self.rate_hz
                parts = [-0.5 * t, xlogy(t**2, t) / (2.0 * np.pi), t**3 / 12.0]
                covariance += weight_a * weight_b * np.stack(parts, axis=1)
        covariance /= 2.0 * short * long / self.rate_hz**2
        # So many pairs of terms lie `lag` apart; the lags in between are stood for by their neighbours.
        terms_short, terms_long = self.count + 1 - 2 * short, self.count + 1 - 2 * long
        pairs = np.minimum(terms_short, terms_long - lags) - np.maximum(0, -lags)
        steps = np.diff(lags)
        stands_for = 0.5 * (np.concatenate([[1], steps]) + np.concatenate([steps, [1]]))
        return covariance, 2.0 * np.maximum(pairs, 0) * stands_for / (float(terms_short) * float(terms_long))

    def covariance(self, parameters: np.ndarray) -> np.ndarray:
        """Covariance (T, T) of the Allan variances for a model (3,): N^2, B^2, K^2."""
        (i, j), terms, weights, begins = self._pairs
        out = np.zeros((len(self.clusters),) * 2)
        out[i, j] = out[j, i] = np.add.reduceat(weights * (terms @ parameters) ** 2, begins)
        return out


def _lags(short: int, long: int) -> np.ndarray:
    """Whole lags between terms of two cluster lengths: all that matter, dense where the covariance bends."""
    fine, coarse = max(1, short // _FINE), max(1, long // _COARSE)
    parts = [np.arange(-3 * long, 3 * short + long, coarse)]
    parts += [np.arange(-b * long - short, -b * long + 3 * short + 1, fine) for b in range(3)]
    return np.unique(np.concatenate(parts))


@dataclass(frozen=True)
class Fit:
    """The noise model of one axis: `parameters` (3,) N^2, B^2, K^2, all >= 0, and their `covariance` (3, 3).

    `misfit` is chi-square per degree of freedom; where it is above 1, the covariance was raised by it.
    """

    parameters: np.ndarray
    covariance: np.ndarray
    misfit: float

    @property
    def sigma(self) -> np.ndarray:
        """One sigma (3,) of the parameters."""
        return np.sqrt(np.diag(self.covariance))


def fit_model(statistics: ClusterStatistics, variance: np.ndarray, *, floor: bool = True) -> Fit:
    """Fit N^2, B^2 and K^2 to Allan variances (T,) at the clusters of `statistics`; without `floor` B is zero.

    Weights come from the model, not from the points, and are iterated: points that are low by chance would otherwise
    weigh more than those that are high.
    """
    used = [0, 1, 2] if floor else [0, 2]
    terms = statistics.terms[:, used]
    # To start, each point is as good as the number of clusters it rests on.
    relative = np.sqrt(statistics.clusters / statistics.count)
    solution, misfit = nnls(terms / (variance * relative)[:, None], 1.0 / relative)[0], 1.0
    for _ in range(_ITERATIONS):
        previous = terms @ solution
        rows, whitened = _whiten(statistics, _spread(solution, used), terms, variance)
        scale = np.linalg.norm(rows, axis=0)
        solution, distance = nnls(rows / scale, whitened)
        solution /= scale
        misfit = float(distance**2 / (len(variance) - len(used)))
        if np.all(np.abs(terms @ solution - previous) <= _CONVERGED * previous):
            break
    parameters = _spread(solution, used)
    covariance = np.zeros((3, 3))
    covariance[np.ix_(used, used)] = expected_covariance(statistics, parameters, used) * max(misfit, 1.0)
    return Fit(parameters, covariance, misfit)


def largest_walk(statistics: ClusterStatistics, variance: np.ndarray) -> float:
    """K^2 that Allan variances (T,) hardly exceed (two sigma above the estimate): a safe value where K is not seen.

    All that rises above white noise is laid to the random walk, none to the floor; and the sigma is the one that the
    estimate would have if the walk were as large as said.
    """
    fit = fit_model(statistics, variance, floor=False)
    parameters = fit.parameters.copy()
    for _ in range(_ITERATIONS):
        sigma = np.sqrt(expected_covariance(statistics, parameters, (0, 2))[1, 1] * max(fit.misfit, 1.0))
        previous, parameters[2] = parameters[2], fit.parameters[2] + 2.0 * sigma
        if abs(parameters[2] - previous) <= 1e-3 * parameters[2]:
            break
    return float(parameters[2])


def _spread(solution: np.ndarray, used: Sequence[int]) -> np.ndarray:
    parameters = np.zeros(3)
    parameters[list(used)] = solution
    return parameters


def _whiten(statistics: ClusterStatistics, parameters: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    """Columns over the Allan variances, divided by the root of the covariance that these have under the model."""
    covariance = statistics.covariance(parameters)
    covariance += np.diag((_MODEL_ERROR * (statistics.terms @ parameters)) ** 2)
    lower = np.linalg.cholesky(covariance)
    return [solve_triangular(lower, column, lower=True) for column in columns]


def expected_covariance(
    statistics: ClusterStatistics, parameters: np.ndarray, used: Sequence[int] = (0, 1, 2)
) -> np.ndarray:
    """Covariance of the estimates of those of N^2, B^2, K^2 that are `used`, if the model is `parameters` (3,)."""
    (rows,) = _whiten(statistics, parameters, statistics.terms[:, list(used)])
    scale = np.linalg.norm(rows, axis=0)
    rows = rows / scale
    return np.linalg.inv(rows.T @ rows) / np.outer(scale, scale)


def interval(variance: float, sigma: float, confidence: float = 0.95) -> tuple[float, float]:
    """Bounds of a density: the roots of those of its square, of which `variance` is a clear estimate with one `sigma`.

    The estimate is taken for chi-square distributed with the degrees of freedom that its sigma stands for, as is usual
    for Allan variances (IEEE Std 1139-2008, annex B). For one below `SIGNIFICANT` sigmas only an upper limit makes
    sense: `largest_walk`.
    """
    freedom = 2.0 * (variance / sigma) ** 2
    tail = 0.5 * (1.0 - confidence)
    lower, upper = np.sqrt(variance * freedom / chdtri(freedom, np.array([tail, 1.0 - tail])))
    return float(lower), float(upper)
