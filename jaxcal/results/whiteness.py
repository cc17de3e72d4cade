"""Whether an IMU's residuals are what its noise says: their size, their tails, and whether they are white."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from jaxcal.results.calibration import ImuCalibration

_LAGS = 20
# Correlations below this change a sigma by less than a twentieth, whatever a test of many samples says of them.
_NEGLIGIBLE = 0.05
_SIGNIFICANT = 0.01


@dataclass(frozen=True)
class ResidualStatistics:
    """Residuals of one sensor ('gyroscope' or 'accelerometer') in units of the noise assumed.

    `rms` (1 where the noise is right; slightly below, since the trajectory follows the samples), `excess_kurtosis` (0
    for Gaussian noise), `correlation` the largest autocorrelation in absolute value at lags of 1 to 20 samples over the
    three axes, `p_white` the probability of correlations as large by chance (Ljung and Box 1978, "On a measure of lack
    of fit in time series models", eq. 1.3; over three axes).
    """

    sensor: str
    rms: float
    excess_kurtosis: float
    correlation: float
    p_white: float

    @property
    def white(self) -> bool:
        """Whether nothing worth mentioning speaks against independent residuals."""
        return self.p_white > _SIGNIFICANT or self.correlation < _NEGLIGIBLE

    def sentence(self) -> str:
        """The same in words."""
        colour = "white" if self.white else "NOT white"
        return (
            f"{self.sensor}: {self.rms:.3f} sigma rms, excess kurtosis {self.excess_kurtosis:.2f}, {colour} (largest "
            f"autocorrelation {self.correlation:.3f}, Ljung-Box p {self.p_white:.2g})"
        )


def residual_statistics(imu: ImuCalibration) -> tuple[ResidualStatistics, ResidualStatistics]:
    """Of the gyroscope and of the accelerometer."""
    return (
        _statistics("gyroscope", (imu.gyro_rad_s - imu.gyro_predicted) / imu.gyro_sigma),
        _statistics("accelerometer", (imu.accel_m_s2 - imu.accel_predicted) / imu.accel_sigma),
    )


def _statistics(sensor: str, residuals: np.ndarray) -> ResidualStatistics:
    known = residuals[np.isfinite(residuals)]
    lags = max(1, min(_LAGS, len(residuals) // 4))
    correlations = np.stack([autocorrelation(axis, lags) for axis in residuals.T])
    counts = np.isfinite(residuals).sum(axis=0)
    p = [ljung_box(row, int(count)) for row, count in zip(correlations, counts, strict=True)]
    centred = known - known.mean() if len(known) else known
    variance = float(np.mean(centred**2)) if len(known) else np.nan
    return ResidualStatistics(
        sensor=sensor,
        rms=float(np.sqrt(np.mean(known**2))) if len(known) else np.nan,
        excess_kurtosis=float(np.mean(centred**4) / variance**2 - 3.0) if variance > 0 else np.nan,
        correlation=float(np.abs(correlations).max()),
        p_white=min(1.0, len(p) * min(p)),  # Bonferroni's correction
    )


def autocorrelation(values: np.ndarray, lags: int) -> np.ndarray:
    """Correlation (lags,) of a series (N,) with itself 1 .. lags samples later; NaN entries take no part."""
    known = np.isfinite(values)
    centred = np.where(known, values - np.mean(values[known]) if known.any() else 0.0, 0.0)
    variance = np.sum(centred**2) / max(int(known.sum()), 1)
    pairs = np.array([np.sum(known[k:] & known[: len(known) - k]) for k in range(1, lags + 1)])
    products = np.array([centred[k:] @ centred[: len(centred) - k] for k in range(1, lags + 1)])
    return products / np.maximum(pairs, 1) / max(variance, np.finfo(np.float64).tiny)


def ljung_box(correlation: np.ndarray, count: int) -> float:
    """Probability that a white series of `count` samples shows autocorrelations (L,) at lags 1 .. L as large."""
    remaining = np.maximum(count - np.arange(1, len(correlation) + 1), 1)
    # The upper tail of chi-squared; scipy.stats says the same, and takes half a second to import.
    return float(chdtrc(len(correlation), count * (count + 2.0) * np.sum(correlation**2 / remaining)))
