"""Allan variance and the noise it tells: against the definition, simulated noise, and what is no still recording."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from still_imu import flicker, noisy, still_imu

from jaxcal import CalibrationError
from jaxcal.imu.allan import (
    SIGNIFICANT,
    ClusterStatistics,
    allan_variance,
    cluster_lengths,
    fit_model,
    interval,
    largest_walk,
    model_terms,
)
from jaxcal.imu.noise import length_that_shows, noise_of_still
from jaxcal.imu.still import still_recording

# --- the variance ----------------------------------------------------------------------------------------------------


@given(count=st.integers(2, 60), seed=st.integers(0, 2**32 - 1), rate=st.floats(0.1, 1e3), shift=st.floats(-10, 10))
@settings(deadline=None, max_examples=40)
def test_it_is_half_the_mean_square_difference_of_neighbouring_cluster_means(
    count: int, seed: int, rate: float, shift: float
) -> None:
    values = np.random.default_rng(seed).normal(size=(2, count))
    lengths = np.arange(1, count // 2 + 1)
    found = allan_variance(values + shift, rate, lengths)
    for m, variance in zip(lengths, found.T, strict=True):
        means = np.stack([values[:, k : k + m].mean(axis=1) for k in range(count - m + 1)], axis=1)
        np.testing.assert_allclose(variance, 0.5 * np.mean((means[:, m:] - means[:, :-m]) ** 2, axis=1), rtol=1e-9)


def test_a_steady_drift_rises_with_the_cluster_time() -> None:
    rate, slope = 20.0, 0.3
    lengths = np.array([1, 5, 40])
    found = allan_variance(slope * np.arange(200) / rate, rate, lengths)
    np.testing.assert_allclose(found, 0.5 * (slope * lengths / rate) ** 2, rtol=1e-9)


def test_two_clusters_have_to_fit() -> None:
    with pytest.raises(CalibrationError, match="clusters of 1 to 6 samples, of 11; expected 1 to 5"):
        allan_variance(np.zeros(11), 1.0, np.array([1, 6]))
    with pytest.raises(CalibrationError, match="too short for a noise model"):
        ClusterStatistics(20, 10.0)


@pytest.mark.parametrize("model", [(1.0, 0.0, 0.0), (0.1, 0.0, 0.3), (0.0, 0.0, 1.0)])
def test_the_covariance_of_allan_variances_is_that_of_many_recordings(model: tuple[float, ...]) -> None:
    statistics = ClusterStatistics(1500, 10.0)
    rng = np.random.default_rng(0)
    many = allan_variance(
        noisy(rng, 1500, 10.0, np.sqrt(model[0]), np.sqrt(model[2]), axes=1500), 10.0, statistics.clusters
    )
    # The random walk of a sampled sensor is constant over a sample: that shows in the shortest clusters.
    np.testing.assert_allclose(many.mean(axis=0)[2:], (statistics.terms @ np.array(model))[2:], rtol=0.07)
    expected, found = statistics.covariance(np.array(model)), np.cov(many.T)
    scale = np.sqrt(np.diag(expected))
    assert np.abs(found / np.outer(scale, scale) - expected / np.outer(scale, scale))[2:, 2:].max() < 0.2


# --- the model -------------------------------------------------------------------------------------------------------


@given(
    density=st.floats(1e-6, 1e-1),
    crossing_s=st.floats(0.7, 3.0),
    rate=st.sampled_from([20.0, 60.0, 166.7]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(deadline=None, max_examples=15)
def test_white_noise_and_random_walk_are_recovered_within_their_bounds(
    density: float, crossing_s: float, rate: float, seed: int
) -> None:
    """`crossing_s`: where the curve's two slopes meet. The recording lasts 800 times that."""
    walk = np.sqrt(3.0) * density / crossing_s
    count = int(800.0 * crossing_s * rate)
    statistics = ClusterStatistics(count, rate)
    readings = noisy(np.random.default_rng(seed), count, rate, density, walk)
    for variance in allan_variance(readings, rate, statistics.clusters):
        fit = fit_model(statistics, variance)
        low, high = interval(fit.parameters[0], fit.sigma[0], 1.0 - 1e-5)
        assert low < density < high < 1.5 * low
        assert fit.parameters[2] > 2.0 * fit.sigma[2]
        low, high = interval(fit.parameters[2], fit.sigma[2], 1.0 - 1e-5)
        assert low < walk < high
        assert largest_walk(statistics, variance) > 0.8 * walk**2


def test_bounds_hold_as_often_as_they_say_and_limits_nearly_always() -> None:
    count, rate, density, walk = 8000, 20.0, 1e-3, 7e-4
    statistics = ClusterStatistics(count, rate)
    rng = np.random.default_rng(1)
    variances = allan_variance(noisy(rng, count, rate, density, walk, axes=200), rate, statistics.clusters)
    fits = [fit_model(statistics, variance) for variance in variances]
    for place, truth in ((0, density), (2, walk)):
        bounds = [interval(fit.parameters[place], fit.sigma[place]) for fit in fits]
        inside = np.mean([low < truth < high for low, high in bounds])
        assert inside >= 0.92
        assert np.median([high / low for low, high in bounds]) < (1.25 if place == 0 else 2.2)
    assert np.mean([largest_walk(statistics, variance) > walk**2 for variance in variances]) > 0.93


def test_a_floor_is_told_from_a_random_walk() -> None:
    count, rate, density, floor = 100_000, 20.0, 1e-3, 2e-3
    statistics = ClusterStatistics(count, rate)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        readings = noisy(rng, count, rate, density, 0.0, axes=1)[0] + flicker(rng, count, floor)
        fit = fit_model(statistics, allan_variance(readings, rate, statistics.clusters))
        assert np.sqrt(fit.parameters[:2]) == pytest.approx([density, floor], rel=0.2)
        assert fit.parameters[2] < SIGNIFICANT * fit.sigma[2]


def test_a_sensor_may_do_without_white_noise() -> None:
    statistics = ClusterStatistics(30_000, 100.0)
    readings = noisy(np.random.default_rng(7), 30_000, 100.0, 1e-9, 1e-4, axes=1)[0]
    fit = fit_model(statistics, allan_variance(readings, 100.0, statistics.clusters))
    assert np.sqrt(fit.parameters[2]) == pytest.approx(1e-4, rel=0.15)
    assert np.all(fit.parameters[:2] < SIGNIFICANT * fit.sigma[:2])


def test_cluster_lengths_are_even_in_the_logarithm() -> None:
    assert cluster_lengths(3000, 10.0).tolist() == [1, 2, 4, 8, 16, 32, 64, 128, 256, 512]
    assert cluster_lengths(3000, 100.0, shortest_s=0.1)[0] == 10
    np.testing.assert_allclose(model_terms(np.array([1.0, 3.0]))[:, ::2], [[1.0, 1 / 3], [1 / 3, 1.0]])


# --- a whole recording -----------------------------------------------------------------------------------------------


def test_a_short_recording_does_not_invent_a_random_walk_and_says_which_length_would_do() -> None:
    density, walk, rate = 2e-3, 2e-5, 5.0
    seen = []
    for seed in range(6):
        noise = noise_of_still(still_recording(*still_imu(seed, 200.0, rate, (1e-4, 1e-3), (density, walk))))
        seen.append(noise.accelerometer.walk.seen)
        assert noise.accelerometer.walk.value > walk
        assert noise.accelerometer.density.value == pytest.approx(density, rel=0.1)
    assert not any(seen)
    (note,) = [text for text in noise.notes if text.startswith("accelerometer")]
    assert "200 s are too short" in note
    assert "would show in about" in note

    statistics = ClusterStatistics(int(200.0 * rate), rate)
    length = length_that_shows(walk, np.array([density**2, 0.0, 0.0]), statistics)
    assert 1000.0 < length < 20_000.0
    for factor, expected in ((0.1, False), (1.5, True)):
        recordings = [still_imu(seed, factor * length, rate, (1e-4, 1e-3), (density, walk)) for seed in range(4)]
        found = [noise_of_still(still_recording(*r)).accelerometer.walk for r in recordings]
        assert sum(estimate.seen == expected for estimate in found) >= 3
    assert length_that_shows(1e-12, np.array([density**2, 0.0, 0.0]), statistics) == np.inf


def test_axes_and_sensors_are_kept_apart_and_the_rate_is_found() -> None:
    times, gyro, accel = still_imu(3, 600.0, 40.0, gyro=(1e-4, 1e-4), accel=(2e-3, 2e-3))
    accel[:, 2] += np.random.default_rng(9).normal(0.0, 1e-2 * np.sqrt(40.0), len(times))
    noise = noise_of_still(still_recording(times, gyro, accel))
    assert noise.rate_hz == pytest.approx(40.0, rel=1e-9)
    assert [axis.value for axis in noise.gyroscope.density_axes] == pytest.approx([1e-4] * 3, rel=0.15)
    assert noise.gyroscope.walk.seen
    assert noise.gyroscope.walk.value == pytest.approx(1e-4, rel=0.3)
    own = [axis.value for axis in noise.accelerometer.density_axes]
    assert own == pytest.approx([2e-3, 2e-3, 1.02e-2], rel=0.15)
    assert noise.accelerometer.density.value == pytest.approx(np.sqrt(np.mean(np.square(own))), rel=1e-6)
    assert any("accelerometer: its axes differ, z is" in note for note in noise.notes)


def test_filtered_readings_and_wrong_models_are_told() -> None:
    times, gyro, accel = still_imu(4, 300.0, 100.0, accel=(2e-3, 1e-5))
    kernel = np.ones(5) / 5
    filtered = np.stack([np.convolve(axis, kernel, mode="same") for axis in accel.T - accel.mean(axis=0)[:, None]])
    hum = 0.02 * np.sin(2.0 * np.pi * 0.4 * np.arange(len(times)) / 100.0)[:, None]
    noise = noise_of_still(still_recording(times, gyro + 2e-4 * hum / 0.02, filtered.T + accel.mean(axis=0)))
    assert any("one sample at 100 Hz scatters" in note and "filtered" in note for note in noise.notes)
    assert noise.accelerometer.density.value == pytest.approx(2e-3, rel=0.1)
    assert any(note.startswith("gyroscope: its curve is not that of white noise") for note in noise.notes)


# --- what is no still recording --------------------------------------------------------------------------------------


def knocked(times: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, ...]:
    accel[500:520] += np.random.default_rng(0).normal(0.0, 0.5, (20, 3))
    return times, gyro, accel


def moved_at_the_ends(times: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, ...]:
    gyro[:300] += 0.1 * np.sin(np.arange(300) / 20.0)[:, None]
    accel[-200:, 0] += 0.3
    return times, gyro, accel


def carried(times: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, ...]:
    return times, gyro + 0.3 * np.sin(np.arange(len(times)) / 60.0)[:, None], accel


def without(first: int, last: int) -> Callable[..., tuple[np.ndarray, ...]]:
    return lambda *readings: tuple(np.delete(part, slice(first, last), axis=0) for part in readings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, g, a: (t, np.degrees(g), a), r"If it is in deg/s, multiply its columns by 0\.017453"),
        (lambda t, g, a: (t, g, a / 9.80665), r"accelerometer reads 0\.99.* It is in g: multiply its columns by 9\.80"),
        (lambda t, g, a: (t, g, a / 9.80665e-3), "It is in mg"),
        (lambda t, g, a: (t, g, a - a.mean(axis=0)), "gravity taken off"),
        (lambda t, g, a: (t, g, 2.0 * a), r"reads 19\.\d+ at rest.*Convert"),
        (lambda t, g, a: (t, np.concatenate([g[:, :2], 0.0 * g[:, 2:]], axis=1), a), "gyroscope z: all 8000 readings"),
        (knocked, r"in 3 of 160 seconds \(accelerometer\).* second 9 to 12.*--start 12\.0 --stop 160\.0"),
        (moved_at_the_ends, r"gyroscope and accelerometer.* second 0 to \d.* seconds [67]\.0 to 15[56]\.0"),
        (carried, "the IMU moves throughout: the gyroscope's mean"),
        (
            without(701, 900),
            r"1 gaps in time, 199 samples.* 4\.000 s, from second 14\.000 on.*--start 18\.0 --stop 159\.9",
        ),
        (without(2000, 5500), r"record again \(the longest good part lasts 50 s\)"),
        (without(2500, 8000), r"lasts 50\.0 s, which is too short.*10 minutes"),
        (lambda t, g, a: (np.minimum(t, t[-2]), g, a), "sample 7999: its time does not come after"),
    ],
)
def test_what_is_not_still_is_refused_with_a_remedy(
    change: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]], message: str
) -> None:
    readings = still_imu(5, 160.0, gyro=(2e-4, 2e-6))
    assert still_recording(*readings).missing == 0
    with pytest.raises(CalibrationError, match=message):
        still_recording(*change(*readings))


def test_times_in_errors_count_from_the_whole_recording() -> None:
    times, gyro, accel = knocked(*still_imu(5, 160.0))
    with pytest.raises(CalibrationError, match=r"second 109 to 112.*--start 112\.0 --stop 260\.0"):
        still_recording(times, gyro, accel, origin_s=100.0)


def test_single_samples_may_be_lost() -> None:
    readings = still_imu(6, 160.0)
    recording = still_recording(*without(4000, 4003)(*readings))
    assert recording.missing == 3
    assert recording.rate_hz == pytest.approx(50.0, rel=1e-9)
    assert "3 samples are missing" in noise_of_still(recording).notes[0]


@pytest.mark.real_data
def test_a_real_imu_in_motion_is_refused(data_folder: Path) -> None:
    with np.load(data_folder / "euroc_imu_april" / "observations.npz") as table:
        times, gyro, accel = table["imu_ns"], table["gyro_rad_s"], table["acc_m_s2"]
    twice = np.concatenate([times, times + (times[-1] - times[0]) + 5_000_000])
    with pytest.raises(CalibrationError, match="moves throughout"):
        still_recording(twice, np.concatenate([gyro, gyro]), np.concatenate([accel, accel]))
