"""Readings of simulated IMUs at rest."""

import numpy as np

START_NS = 1_600_000_000_000_000_000


def noisy(
    rng: np.random.Generator, count: int, rate_hz: float, density: float, walk: float, axes: int = 3
) -> np.ndarray:
    """White noise and a random walk (axes, count), by the usual discretisation of continuous-time densities."""
    white = density * np.sqrt(rate_hz) * rng.standard_normal((axes, count))
    return white + np.cumsum(walk / np.sqrt(rate_hz) * rng.standard_normal((axes, count)), axis=1)


def flicker(rng: np.random.Generator, count: int, bias_instability: float) -> np.ndarray:
    """Noise (count,) of spectral density B^2 / (pi f), one-sided: its Allan variance is (2 ln 2 / pi) B^2."""
    frequency = np.fft.rfftfreq(2 * count)
    amplitude = np.zeros(len(frequency))
    amplitude[1:] = bias_instability * np.sqrt(2 * count / (2.0 * np.pi * frequency[1:]))
    phases = rng.standard_normal((2, len(frequency)))
    return np.fft.irfft(amplitude * (phases[0] + 1j * phases[1]) / np.sqrt(2.0))[:count]


def still_imu(
    seed: int,
    seconds: float,
    rate_hz: float = 50.0,
    gyro: tuple[float, float] = (1.7e-4, 2e-6),
    accel: tuple[float, float] = (2e-3, 3e-3),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (N,) ns, gyroscope and accelerometer (N, 3), with `gyro` and `accel` (density, random walk)."""
    rng = np.random.default_rng(seed)
    count = int(seconds * rate_hz)
    times = START_NS + np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    turning = np.array([0.012, -0.02, 0.005]) + noisy(rng, count, rate_hz, *gyro).T
    force = np.array([0.31, -0.22, 9.79]) + noisy(rng, count, rate_hz, *accel).T
    return times, turning, force
