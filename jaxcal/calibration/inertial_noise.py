"""The noise of IMUs as their residuals show it: re-estimated on the way, and judged against what was stated."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import numpy as np

from jaxcal.calibration import inertial
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.robust import RobustFit
from jaxcal.calibration.spline_setup import BinnedImu, SplineGrid
from jaxcal.calibration.state import RigState
from jaxcal.estimation import on_device
from jaxcal.programs import stored_jit

# Noise below this share of the stated one is not believed: the spline would have followed it.
_SMALLEST_RATIO = 0.02
# In-band noise is believed to be more than the samples' own from this many of its standard deviations on.
_CLEARLY_MORE = 3.0

_SENSORS = ("gyroscope", "accelerometer")

NoiseChoice = Literal["at least given", "given", "estimated"]


@stored_jit
def _whitened(problem: RigProblem, state: RigState, imu: int) -> jax.Array:
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

    def _stated_residuals(self, problem: RigProblem, state: RigState, imu: int) -> tuple[np.ndarray, float]:
        """Residuals (M, 6) in units of the stated noise, and the share of them that the spline leaves free."""
        assert problem.imu is not None
        samples = problem.imu.samples[imu]
        scale = np.asarray(self.binned[imu].samples.inverse_sigma) / np.asarray(samples.inverse_sigma)
        residuals = (np.asarray(_whitened(problem, state, imu)) * scale)[np.asarray(samples.present) > 0]
        # The spline's freedoms are shared by all IMUs that see it.
        count = sum(len(one.index) for one in self.binned)
        return residuals, max(1.0 - (self.grid.used + self.grid.order - 1) / count, 0.1)

    def reweigh(self, problem: RigProblem, state: RigState) -> RigProblem:
        """Noise as the residuals show it (never below the stated one unless that is asked for), and samples binned anew
        where the clocks have moved.

        Residuals that hang together over time are not held against the IMU here: with less of a say it would be left
        with the errors of the cameras' trajectory, which hang together for longer, and so on. See `excesses`.
        """
        assert problem.imu is not None
        samples = list(problem.imu.samples)
        for i in range(len(samples)):
            stated = self.binned[i].at_shift(self.grid, float(np.asarray(state.imu_shift)[i])).samples
            ratio = np.ones(2) if self.choice == "given" else self._ratio(problem, state, i)
            ratio = np.maximum(ratio, 1.0 if self.choice == "at least given" else _SMALLEST_RATIO)
            inverse = on_device(np.asarray(stated.inverse_sigma) / np.repeat(ratio, 3))
            samples[i] = eqx.tree_at(lambda s: s.inverse_sigma, stated, inverse)
        return eqx.tree_at(lambda p: p.imu.samples, problem, tuple(samples))

    def excesses(self, problem: RigProblem, state: RigState) -> list[np.ndarray]:
        """By which factor (2,) the variance of gyro and accel of each IMU is larger where the rig moves than the noise
        used says; 1 where it is not, or where it is to be trusted as given.

        What the cameras and an IMU disagree on (a scale error, axes out of square, corners that err with the motion)
        has the motion's own spectrum, and so does what a calibration learns from.
        """
        assert problem.imu is not None
        if self.choice == "given":
            return [np.ones(2) for _ in self.binned]
        found = []
        for i, samples in enumerate(problem.imu.samples):
            present = np.asarray(samples.present) > 0
            residuals = np.asarray(_whitened(problem, state, i))[present]
            readings = np.asarray(samples.readings)[present]
            found.append(np.array([in_band_excess(residuals[:, s], readings[:, s]) for s in (slice(3), slice(3, 6))]))
        return found

    def warnings(self, fit: RobustFit, excesses: Sequence[np.ndarray]) -> list[str]:
        """Sentences where the noise is clearly larger than stated, or errs with the motion (`excesses`)."""
        sentences = []
        for i, (ratio, excess) in enumerate(zip(self.ratios(fit.problem, fit.state), excesses, strict=True)):
            which = "" if len(self.binned) == 1 else f"imu{i}: "
            done = "the stated noise was used all the same" if self.choice == "given" else "the larger noise was used"
            sentences += [
                f"{which}The {sensor}'s readings scatter {factor:.1f} times more about the trajectory than imu.yaml's "
                f"{sensor}_noise_density allows; {done}. Vibration, a loose mount, a scale error of the sensor or a "
                "datasheet value do this."
                for sensor, factor in zip(_SENSORS, ratio, strict=True)
                if factor > 2.0
            ]
            sentences += [
                f"{which}Where the rig moves, the {sensor} and the cameras disagree by {np.sqrt(factor):.1f} times its "
                "noise; sigmas allow for that. An IMU whose axes are out of square or of scale (model "
                "scale-misalignment), or corners that err with the motion do this."
                for sensor, factor in zip(_SENSORS, excess, strict=True)
                if np.sqrt(factor) > 2.0
            ]
        return sentences


def in_band_excess(residuals: np.ndarray, signal: np.ndarray) -> float:
    """Variance of `residuals` (M, 3), of white noise of variance one if all is well, at the frequencies of `signal`
    (M, 3); 1 where it is not clearly more than that.

    For a regression on a signal with spectrum P_x the variance under errors of spectrum P_e is that under white ones
    times the mean of P_e weighted by P_x (Bartlett 1935 in the frequency domain).
    """
    errors, weight = _power(residuals), _power(signal)
    total = weight.sum()
    if total == 0.0:
        return 1.0
    excess = float(errors @ weight / total) / residuals.size
    independent = residuals.shape[1] * total**2 / (weight @ weight)  # bins that the mean is over
    return excess if excess > 1.0 + _CLEARLY_MORE / np.sqrt(independent) else 1.0


def _power(series: np.ndarray) -> np.ndarray:
    """Periodogram without the mean, summed over the axes (M, 3)."""
    return (np.abs(np.fft.rfft(series - series.mean(axis=0), axis=0))[1:] ** 2).sum(axis=1)
