"""Noise of an IMU where the rig moves: that of the samples for white noise, more where errors go with the motion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxcal.calibration.inertial_noise import in_band_excess

RATE_HZ = 200.0


def moving(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) something like a hand's angular rate: smooth, some rad/s, below about 3 Hz."""
    t = np.arange(count)[:, None] / RATE_HZ
    waves = [rng.normal() * np.sin(2 * np.pi * f * t + rng.uniform(0, 6, 3)) for f in rng.uniform(0.1, 3.0, 12)]
    return np.sum(waves, axis=0)


@given(st.integers(0, 2**32 - 1), st.integers(2_000, 12_000))
def test_white_noise_says_no_more_where_the_rig_moves(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    signal = moving(rng, count)
    weight = (np.abs(np.fft.rfft(signal - signal.mean(axis=0), axis=0)[1:]) ** 2).sum(axis=1)
    one_sigma = np.sqrt((weight @ weight) / weight.sum() ** 2 / 3)
    excess = in_band_excess(rng.standard_normal(signal.shape), signal)
    assert excess == 1.0 or 3.0 < (excess - 1.0) / one_sigma < 8.0  # three sigma are passed now and then


@pytest.mark.parametrize("error", [0.5, 2.0])
def test_errors_that_go_with_the_motion_are_measured(error: float) -> None:
    """A misalignment, whose errors have the spectrum of the motion."""
    rng = np.random.default_rng(0)
    signal = moving(rng, 8_000)
    residuals = rng.standard_normal(signal.shape) + error * signal[:, [1, 2, 0]]
    weight = np.abs(np.fft.rfft(signal - signal.mean(axis=0), axis=0)[1:]) ** 2
    power = weight.sum(axis=1)
    expected = 1.0 + error**2 * (power @ power) / power.sum() / residuals.size
    assert in_band_excess(residuals, signal) == pytest.approx(expected, rel=0.1)


def test_errors_beside_the_motion_do_not_count() -> None:
    """Vibration at 40 Hz is not what T_cam_imu is learnt from; nor are readings that do not move at all."""
    rng = np.random.default_rng(1)
    signal = moving(rng, 8_000)
    vibration = 5.0 * np.sin(2 * np.pi * 40.0 * np.arange(len(signal))[:, None] / RATE_HZ + np.arange(3))
    assert in_band_excess(rng.standard_normal(signal.shape) + vibration, signal) == 1.0
    assert in_band_excess(vibration, np.ones_like(signal)) == 1.0
