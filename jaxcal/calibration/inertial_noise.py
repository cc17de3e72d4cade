"""The noise of IMUs as their residuals show it: re-estimated on the way, and judged against what was stated."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxcal.calibration import inertial
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.robust import RobustFit
from jaxcal.calibration.spline_setup import BinnedImu, SplineGrid
from jaxcal.calibration.state import RigState
from jaxcal.programs import stored_jit

# Autocorrelations of IMU residuals below this are taken for noise.
_CLEARLY_CORRELATED = 0.05
# Noise below this share of the stated one is not believed: the spline would have followed it.
_SMALLEST_RATIO = 0.02
# The round of `robust_fit` from which correlations count: the third, which starts from a settled trajectory.
_CORRELATED = 2

NoiseChoice = Literal["at least given", "given", "estimated"]


@stored_jit
def _whitened(problem: RigProblem, state: RigState, imu: int) -> jnp.ndarray:
    assert problem.imu is not None
    return inertial.imu_residuals(state, problem.imu, problem.order, problem.layout, imu)


@dataclass(frozen=True)
class NoiseModel:
    """The stated noise of each IMU (in `binned`), and what to do about it."""

    binned: Sequence[BinnedImu]
    grid: SplineGrid
    choice: NoiseChoice

    def ratios(self, problem: RigProblem, state: RigState) -> list[np.ndarray]:
        """How much larger than stated the noise of gyro and accel (2,) of each IMU is."""
        return [self._ratio(problem, state, i) for i in range(len(self.binned))]

    def _ratio(self, problem: RigProblem, state: RigState, imu: int) -> np.ndarray:
        """Degrees of freedom of the spline accounted for."""
        residuals, freedom = self._stated_residuals(problem, state, imu)
        return np.sqrt(np.mean(residuals**2, axis=0).reshape(2, 3).mean(axis=1) / freedom)

    def _hanging_together(self, problem: RigProblem, state: RigState, imu: int) -> np.ndarray:
        """By how much (2,) noise is to be raised where residuals hang together over time (a scale error, vibration,
        jitter of the clock): they are worth fewer samples than they number, or would bend the lenses."""
        residuals, _ = self._stated_residuals(problem, state, imu)
        times = np.array([autocorrelation_time(axis) for axis in residuals.T])
        return np.sqrt(times.reshape(2, 3).mean(axis=1))

    def _stated_residuals(self, problem: RigProblem, state: RigState, imu: int) -> tuple[np.ndarray, float]:
        """Residuals (M, 6) in units of the stated noise, and the share of them that the spline leaves free."""
        assert problem.imu is not None
        samples = problem.imu.samples[imu]
        scale = np.asarray(self.binned[imu].samples.inverse_sigma / samples.inverse_sigma)
        residuals = (np.asarray(_whitened(problem, state, imu)) * scale)[np.asarray(samples.present) > 0]
        # The spline's freedoms are shared by all IMUs that see it.
        count = sum(len(one.index) for one in self.binned)
        return residuals, max(1.0 - (self.grid.used + self.grid.order - 1) / count, 0.1)

    def reweigh(self, problem: RigProblem, state: RigState, stage: int) -> RigProblem:
        """Noise as the residuals show it (never below the stated one unless that is asked for), and samples binned anew
        where the clocks have moved.

        How long residuals hang together is asked from round _CORRELATED on, when all has settled while the IMU had its
        full say. An IMU that counts for little too early is left with the errors of the cameras' trajectory, which hang
        together for longer, and comes to count for less and less.
        """
        assert problem.imu is not None
        samples = list(problem.imu.samples)
        for i in range(len(samples)):
            stated = self.binned[i].at_shift(self.grid, float(state.imu_shift[i])).samples
            if self.choice == "given":
                ratio = np.ones(2)
            else:
                ratio = self._ratio(problem, state, i)
                if stage >= _CORRELATED:
                    ratio = ratio * self._hanging_together(problem, state, i)
            ratio = np.maximum(ratio, 1.0 if self.choice == "at least given" else _SMALLEST_RATIO)
            inverse = stated.inverse_sigma / jnp.asarray(np.repeat(ratio, 3))
            samples[i] = eqx.tree_at(lambda s: s.inverse_sigma, stated, inverse)
        return eqx.tree_at(lambda p: p.imu.samples, problem, tuple(samples))

    def warnings(self, fit: RobustFit) -> list[str]:
        """Sentences where the noise is clearly larger than stated."""
        sentences = []
        for i, ratio in enumerate(self.ratios(fit.problem, fit.state)):
            which = "" if len(self.binned) == 1 else f"imu{i}: "
            done = "the stated noise was used all the same" if self.choice == "given" else "the larger noise was used"
            sentences += [
                f"{which}The {sensor}'s readings scatter {factor:.1f} times more about the trajectory, or hang together"
                f" over longer, than imu.yaml's {sensor}_noise_density allows; {done}. Vibration, a loose mount, a "
                "scale error of the sensor or a datasheet value do this."
                for sensor, factor in zip(("gyroscope", "accelerometer"), ratio, strict=True)
                if factor > 2.0
            ]
        return sentences


def autocorrelation_time(series: np.ndarray) -> float:
    """Integrated autocorrelation time, in samples: 1 for white noise (Sokal 1997, eq. 3.16, summed while it is
    clearly positive)."""
    series = series - series.mean()
    spectrum = np.abs(np.fft.rfft(series, 2 * len(series))) ** 2
    covariance = np.fft.irfft(spectrum)[: len(series) // 2]
    correlation = covariance[1:] / max(covariance[0], 1e-300)
    ends = np.flatnonzero(correlation < _CLEARLY_CORRELATED)
    return float(1.0 + 2.0 * np.sum(correlation[: ends[0] if len(ends) else len(correlation)]))
