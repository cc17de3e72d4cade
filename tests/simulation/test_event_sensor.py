"""The event sensor counts, signs, times and orders events as its model says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.errors import CalibrationError
from jaxcal.simulation import EventSensor, EventSensorConfig

QUIET = EventSensorConfig(threshold_mismatch=0.0, refractory_ns=0, leak_rate_hz=0.0, shot_noise_rate_hz=0.0)
T0 = 1_600_000_000_000_000_000


def _image(value, shape=(3, 4)):
    return np.full(shape, value, dtype=np.float32)


def _quiet(**changes):
    return EventSensorConfig(**{**QUIET.__dict__, **changes})


@settings(deadline=None, max_examples=60)
@given(
    change=st.floats(-3.0, 3.0),
    contrast=st.floats(0.05, 0.6),
    steps=st.integers(1, 7),
    dt=st.integers(1_000, 10_000_000),
)
def test_a_ramp_gives_as_many_events_as_thresholds_it_crosses(change, contrast, steps, dt):
    sensor = EventSensor(4, 3, _quiet(contrast_on=contrast, contrast_off=contrast))
    assert len(sensor.feed(T0, _image(0.7))[0]) == 0
    times, signs = [], []
    for k in range(1, steps + 1):
        t, x, y, p = sensor.feed(T0 + k * dt, _image(0.7 + change * k / steps))
        assert np.all(np.diff(t) >= 0)
        assert np.all((t > T0 + (k - 1) * dt) & (t <= T0 + k * dt))
        at_first_pixel = (x == 0) & (y == 0)
        times.append(t[at_first_pixel])
        signs.append(p[at_first_pixel])
    t, p = np.concatenate(times), np.concatenate(signs)
    # Rounding in single precision may move an event across the end of the ramp.
    assert int((abs(change) - 1e-5) / contrast) <= len(t) <= int((abs(change) + 1e-5) / contrast)
    assert np.all(p == (change > 0))
    crossing = steps * dt * contrast * np.arange(1, len(t) + 1) / max(abs(change), 1e-9)
    np.testing.assert_allclose(t - T0, crossing, atol=2 + 1e-4 * steps * dt / max(abs(change), 0.05))


def test_the_reference_level_moves_with_the_events_and_forgets_nothing():
    sensor = EventSensor(4, 3, _quiet(contrast_on=0.2, contrast_off=0.3))
    sensor.feed(0, _image(0.0))
    assert len(sensor.feed(1000, _image(0.15))[0]) == 0
    t, x, y, p = sensor.feed(2000, _image(0.25))
    assert len(t) == 12
    assert p.all()
    np.testing.assert_array_equal(t, 1500)
    assert sorted(zip(x.tolist(), y.tolist(), strict=True)) == [(x, y) for x in range(4) for y in range(3)]
    assert len(sensor.feed(3000, _image(-0.05))[0]) == 0  # 0.25 below the last event's level of 0.2
    t, *_, p = sensor.feed(4000, _image(-0.15))
    assert len(t) == 12
    assert not p.any()
    np.testing.assert_allclose(t, 3500, atol=1)


def test_events_appear_where_the_image_changes():
    sensor = EventSensor(4, 3, QUIET)
    image = _image(0.0)
    sensor.feed(0, image)
    image[1, 3] = 1.1 * QUIET.contrast_on
    _, x, y, _ = sensor.feed(1000, image)
    assert (x.tolist(), y.tolist()) == ([3], [1])


@settings(deadline=None, max_examples=20)
@given(refractory=st.integers(1, 5_000_000), seed=st.integers(0, 100))
def test_no_pixel_fires_again_within_the_refractory_time(refractory, seed):
    config = EventSensorConfig(contrast_on=0.1, refractory_ns=refractory, shot_noise_rate_hz=200.0)
    sensor, random = EventSensor(6, 5, config, seed), np.random.default_rng(seed)
    parts = [sensor.feed(k * 3_000_000, random.normal(size=(5, 6)).astype(np.float32)) for k in range(20)]
    t, x, y, _ = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    assert len(t) > 30
    for pixel in range(30):
        own = t[(y.astype(int) * 6 + x) == pixel]
        assert np.all(np.diff(own) >= refractory)


def test_a_refractory_pixel_loses_events_but_not_its_level():
    sensor = EventSensor(4, 3, _quiet(contrast_on=0.1, refractory_ns=10**9))
    sensor.feed(0, _image(0.0))
    assert len(sensor.feed(1000, _image(0.55))[0]) == 12  # five crossings, one event
    assert len(sensor.feed(2 * 10**9, _image(0.58))[0]) == 0
    assert len(sensor.feed(3 * 10**9, _image(0.61))[0]) == 12


def test_noise_and_leak_come_at_their_rates():
    still = _image(0.0, (50, 60))
    for changes, rate, on_share in (
        ({"shot_noise_rate_hz": 2.0}, 2.0, 0.5),
        ({"leak_rate_hz": 1.5}, 1.5, 1.0),
        ({"hot_pixel_fraction": 0.1, "hot_pixel_rate_hz": 30.0}, 3.0, 0.5),
    ):
        sensor = EventSensor(60, 50, _quiet(**changes), seed=5)
        sensor.feed(T0, still)
        parts = [sensor.feed(T0 + k * 100_000_000, still) for k in range(1, 31)]
        t, _, _, p = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        assert len(t) / 3000 / 3.0 == pytest.approx(rate, rel=0.12)
        assert p.mean() == pytest.approx(on_share, abs=0.02)
        # Spread evenly over time, not in bursts.
        per_part = np.array([len(part[0]) for part in parts])
        assert per_part.min() > 0.7 * per_part.mean()


def test_thresholds_differ_between_pixels_as_much_as_asked_for():
    sensor = EventSensor(60, 50, _quiet(contrast_on=0.2, threshold_mismatch=0.05), seed=1)
    sensor.feed(0, _image(0.0, (50, 60)))
    t, *_ = sensor.feed(10**9, _image(0.29, (50, 60)))
    # A pixel's event comes at 1e9 * threshold / 0.29; none has room for a second one.
    first = t * 0.29e-9
    assert len(first) == 3000
    assert np.median(first) == pytest.approx(0.2, rel=0.02)
    assert np.subtract(*np.percentile(first, [84, 16])) / 2 == pytest.approx(0.01, rel=0.15)


def test_many_events_of_one_pixel_overflow_no_buffer():
    sensor = EventSensor(2, 1, _quiet(contrast_on=1e-5))
    sensor.feed(0, _image(0.0, (1, 2)))
    t, x, _, _ = sensor.feed(10**9, np.array([[1.0, 2.0]], dtype=np.float32))
    assert np.bincount(x) == pytest.approx([100_000, 200_000], rel=1e-3)
    assert np.all(np.diff(t) >= 0)


def test_the_same_seed_gives_the_same_events():
    def run(seed):
        sensor, random = EventSensor(8, 8, EventSensorConfig(shot_noise_rate_hz=50.0), seed), np.random.default_rng(0)
        parts = [sensor.feed(k * 10_000_000, random.normal(size=(8, 8)).astype(np.float32)) for k in range(10)]
        return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]

    for first, second in zip(run(3), run(3), strict=True):
        np.testing.assert_array_equal(first, second)
    assert len(run(3)[0]) != len(run(4)[0])


def test_bad_images_are_refused():
    sensor = EventSensor(4, 3, QUIET)
    with pytest.raises(CalibrationError, match="shape"):
        sensor.feed(0, _image(0.0, (4, 3)))
    with pytest.raises(CalibrationError, match="finite"):
        sensor.feed(0, _image(-np.inf))
    sensor.feed(10, _image(0.0))
    with pytest.raises(CalibrationError, match="follow"):
        sensor.feed(10, _image(0.0))
    with pytest.raises(CalibrationError, match="finite"):
        sensor.feed(20, _image(np.nan))
    with pytest.raises(CalibrationError, match="contrast"):
        EventSensorConfig(contrast_on=0.0)
    with pytest.raises(CalibrationError, match="leak_rate_hz"):
        EventSensorConfig(leak_rate_hz=-1.0)
