"""The whiteness test against series whose colour is known."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_calibration import make_calibration

from jaxcal.results import ImuCalibration, residual_statistics
from jaxcal.results.whiteness import autocorrelation, ljung_box

COUNT = 2000


@pytest.fixture(scope="module")
def imu() -> ImuCalibration:
    found = make_calibration().imu
    assert found is not None
    return found


def with_residuals(imu: ImuCalibration, gyro: np.ndarray, accel: np.ndarray) -> ImuCalibration:
    """The IMU with these residuals (N, 3), in units of its noise."""
    zero = np.zeros_like(gyro)
    return dataclasses.replace(
        imu,
        t_s=np.arange(len(gyro)) / 200.0,
        gyro_rad_s=gyro * imu.gyro_sigma,
        gyro_predicted=zero,
        accel_m_s2=accel * imu.accel_sigma,
        accel_predicted=zero,
    )


def coloured(rng: np.random.Generator, memory: float) -> np.ndarray:
    """First-order autoregressive noise (N, 3) of unit variance."""
    out = rng.standard_normal((COUNT, 3))
    for k in range(1, COUNT):
        out[k] = memory * out[k - 1] + np.sqrt(1.0 - memory**2) * out[k]
    return out


def test_p_values_of_white_noise_are_uniform() -> None:
    rng = np.random.default_rng(0)
    p = np.sort([ljung_box(autocorrelation(rng.standard_normal(COUNT), 20), COUNT) for _ in range(400)])
    # Kolmogorov's bound at 1 in 10000.
    assert np.abs(p - (np.arange(400) + 0.5) / 400).max() < 2.23 / np.sqrt(400)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31), memory=st.floats(0.2, 0.9))
def test_noise_with_a_memory_is_told_from_noise_without(imu: ImuCalibration, seed: int, memory: float) -> None:
    rng = np.random.default_rng(seed)
    gyro, accel = residual_statistics(with_residuals(imu, coloured(rng, memory), rng.standard_normal((COUNT, 3))))
    assert not gyro.white
    assert gyro.correlation == pytest.approx(memory, abs=0.15)
    assert accel.correlation < 0.13
    assert "NOT white" in gyro.sentence()


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31), scale=st.floats(0.1, 10.0))
def test_size_and_tails(imu: ImuCalibration, seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    uniform = rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), (COUNT, 3))
    gyro, accel = residual_statistics(with_residuals(imu, scale * rng.standard_normal((COUNT, 3)), uniform))
    assert gyro.rms == pytest.approx(scale, rel=0.07)
    assert gyro.excess_kurtosis == pytest.approx(0.0, abs=0.4)
    assert accel.excess_kurtosis == pytest.approx(-1.2, abs=0.1)


def test_gaps_take_no_part(imu: ImuCalibration) -> None:
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((COUNT, 3))
    noise[500:700] = np.nan
    gyro, _ = residual_statistics(with_residuals(imu, noise, noise))
    assert np.isfinite([gyro.rms, gyro.excess_kurtosis, gyro.correlation, gyro.p_white]).all()
    assert gyro.white
