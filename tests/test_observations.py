"""The data types that travel between rooms: what they refuse, and the file of detections."""

import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from jaxcal import Detections, Events, Frames, ImuNoise, ImuRecording
from jaxcal.errors import CalibrationError

NOISE = ImuNoise(1e-3, 1e-5, 1e-2, 1e-4)


# --- events ----------------------------------------------------------------------------------------------------------


def events(**changes: Any) -> Events:
    fields: dict[str, Any] = {
        "t_ns": np.array([5, 5, 9], dtype=np.int64),
        "x": np.array([0, 639, 3], dtype=np.uint16),
        "y": np.array([479, 0, 3], dtype=np.uint16),
        "p": np.array([True, False, True]),
        "width": 640,
        "height": 480,
    }
    return Events(**(fields | changes))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(-1000, 1000), min_size=0, max_size=20))
def test_events_are_taken_exactly_when_time_does_not_run_backwards(times: list[int]) -> None:
    zeros = np.zeros(len(times), dtype=np.uint16)
    arrays = {"t_ns": np.array(times, dtype=np.int64), "x": zeros, "y": zeros, "p": zeros.astype(bool)}
    if times == sorted(times):
        assert len(events(**arrays)) == len(times)
    else:
        place = next(i for i in range(1, len(times)) if times[i] < times[i - 1])
        with pytest.raises(CalibrationError, match=f"time runs backwards at event {place} "):
            events(**arrays)


def test_events_outside_the_sensor_name_the_first() -> None:
    with pytest.raises(CalibrationError, match=r"event 1 at \(x, y\) = \(640, 0\) lies outside the 640x480 sensor"):
        events(x=np.array([0, 640, 700], dtype=np.uint16))
    with pytest.raises(CalibrationError, match=r"event 0 at \(x, y\) = \(0, 480\)"):
        events(y=np.array([480, 0, 3], dtype=np.uint16))


def test_event_arrays_of_different_lengths_are_refused() -> None:
    with pytest.raises(CalibrationError, match="have 3, 3, 3, 2 entries"):
        events(p=np.array([True, False]))


# --- frames ----------------------------------------------------------------------------------------------------------

IMAGES = [np.zeros((4, 6), dtype=np.uint8)] * 3


def test_frames_take_increasing_times_and_refuse_others() -> None:
    assert len(Frames(np.array([1, 2, 5]), IMAGES, (6, 4))) == 3
    with pytest.raises(CalibrationError, match=r"Frames: timestamp 2 \(2 ns\) is duplicate"):
        Frames(np.array([1, 2, 2]), IMAGES, (6, 4))
    with pytest.raises(CalibrationError, match=r"Frames: timestamp 1 \(1 ns\) is out of order .* is 5 ns"):
        Frames(np.array([5, 1, 7]), IMAGES, (6, 4))
    with pytest.raises(CalibrationError, match="2 timestamps for 3 images"):
        Frames(np.array([1, 2]), IMAGES, (6, 4))


# --- IMU -------------------------------------------------------------------------------------------------------------


def test_kalibrs_names_build_the_same_noise() -> None:
    kalibr = ImuNoise(
        gyroscope_noise_density=1e-3,
        gyroscope_random_walk=1e-5,
        accelerometer_noise_density=1e-2,
        accelerometer_random_walk=1e-4,
        update_rate=200.0,
    )
    assert kalibr == ImuNoise(1e-3, 1e-5, 1e-2, 1e-4, 200.0)


@pytest.mark.parametrize("name", ["gyro_noise_density", "gyro_random_walk", "accel_noise_density", "accel_random_walk"])
@pytest.mark.parametrize("value", [0.0, -1e-3, float("nan"), float("inf"), None])
def test_densities_must_be_positive(name: str, value: float | None) -> None:
    fields: dict[str, Any] = {"gyro_noise_density": 1e-3, "gyro_random_walk": 1e-5}
    fields |= {"accel_noise_density": 1e-2, "accel_random_walk": 1e-4}
    fields[name] = value
    with pytest.raises(CalibrationError, match=f"ImuNoise: {name} is {value}; a positive density is needed"):
        ImuNoise(**fields)


def test_other_mistakes_in_the_noise() -> None:
    with pytest.raises(CalibrationError, match=r"unknown field 'gyro_noise'. Known fields: gyro_noise_density"):
        ImuNoise(1e-3, 1e-5, 1e-2, 1e-4, gyro_noise=1.0)
    for rate in (0.0, -200.0, float("nan")):
        with pytest.raises(CalibrationError, match=f"update_rate is {rate}; give the sample rate in Hz"):
            ImuNoise(1e-3, 1e-5, 1e-2, 1e-4, rate)


def imu(**changes: Any) -> ImuRecording:
    fields: dict[str, Any] = {
        "timestamps_ns": np.array([0, 5_000_000, 10_000_000, 30_000_000]),
        "gyro_rad_s": np.ones((4, 3)),
        "accel_m_s2": np.ones((4, 3)),
        "noise": NOISE,
    }
    return ImuRecording(**(fields | changes))


def test_the_rate_is_what_the_noise_says_or_the_median() -> None:
    assert imu().rate_hz == pytest.approx(200.0)  # one gap does not change it
    assert imu(noise=ImuNoise(1e-3, 1e-5, 1e-2, 1e-4, 195.0)).rate_hz == 195.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"timestamps_ns": np.array([0.0, 0.1, 0.2, 0.3])}, "timestamps have type float64; give int64 nanoseconds"),
        ({"timestamps_ns": np.array([0, 2, 2, 3])}, r"ImuRecording: timestamp 2 \(2 ns\) is duplicate"),
        ({"timestamps_ns": np.array([0, 2, 1, 3])}, r"ImuRecording: timestamp 2 \(1 ns\) is out of order"),
        ({"timestamps_ns": np.array([0])}, "1 samples; at least 2 are needed"),
        ({"gyro_rad_s": np.ones((3, 3))}, r"gyro_rad_s has shape \(3, 3\); expected \(4, 3\)"),
        ({"accel_m_s2": np.ones((4, 2))}, r"accel_m_s2 has shape \(4, 2\); expected \(4, 3\)"),
        ({"gyro_rad_s": np.where(np.eye(4, 3) > 0, np.nan, 1.0)}, r"gyro_rad_s: value at index \(0, 0\) is nan"),
        ({"accel_m_s2": np.full((4, 3), np.inf)}, r"accel_m_s2: value at index \(0, 0\) is inf"),
    ],
)
def test_broken_imu_recordings_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        imu(**changes)


# --- detections ------------------------------------------------------------------------------------------------------


@st.composite
def detections(draw: st.DrawFn) -> Detections:
    """Any set of (frame, point) pairs over a few frames, with any finite pixels, in any order."""
    times = sorted(draw(st.sets(st.integers(-(2**62), 2**62), max_size=6)))
    pairs = st.tuples(st.integers(0, max(len(times) - 1, 0)), st.integers(0, 9))
    seen = draw(st.lists(pairs, unique=True, max_size=20)) if times else []
    finite = st.floats(-1e6, 1e6)
    pixels = draw(st.lists(st.tuples(finite, finite), min_size=len(seen), max_size=len(seen)))
    frame, point = np.array(seen, dtype=np.int64).reshape(-1, 2).T
    size = draw(st.tuples(st.integers(1, 10_000), st.integers(1, 10_000)))
    return Detections(np.array(times, dtype=np.int64), frame, point, np.array(pixels).reshape(-1, 2), size)


def assert_same(a: Detections, b: Detections) -> None:
    for name in ("timestamps_ns", "frame", "point", "pixels"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert getattr(a, name).dtype == getattr(b, name).dtype
    assert a.image_size == b.image_size


@settings(max_examples=40, deadline=None)
@given(detections())
def test_corners_come_ordered_by_frame_and_point(made: Detections) -> None:
    pairs = list(zip(made.frame.tolist(), made.point.tolist(), strict=True))
    assert pairs == sorted(pairs)
    np.testing.assert_array_equal(made.seen_frames, sorted({frame for frame, _ in pairs}))
    assert len(made) == len(pairs)


@settings(max_examples=30, deadline=None)
@given(made=detections())
def test_save_and_load(tmp_path_factory: pytest.TempPathFactory, made: Detections) -> None:
    path = tmp_path_factory.mktemp("detections") / "new folder" / "cam0.detections.npz"
    made.save(path)
    assert_same(jaxcal.Detections.load(path), made)
    made.save(str(path))  # over the old one
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def corners(**changes: Any) -> Detections:
    fields: dict[str, Any] = {
        "timestamps_ns": np.array([10, 20, 30]),
        "frame": np.array([2, 0, 0]),
        "point": np.array([4, 1, 0]),
        "pixels": np.array([[5.0, 6.0], [3.0, 4.0], [1.0, 2.0]]),
        "image_size": (640, 480),
    }
    return Detections(**(fields | changes))


def test_pixels_stay_with_their_corner_when_ordered() -> None:
    made = corners()
    np.testing.assert_array_equal(made.frame, [0, 0, 2])
    np.testing.assert_array_equal(made.point, [0, 1, 4])
    np.testing.assert_array_equal(made.pixels, [[1, 2], [3, 4], [5, 6]])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"timestamps_ns": np.array([0.1, 0.2, 0.3])}, "timestamps have type float64; give int64 nanoseconds"),
        ({"timestamps_ns": np.array([10, 10, 30])}, r"Detections: timestamp 1 \(10 ns\) is duplicate"),
        ({"frame": np.array([3, 0, 0])}, "`frame` must index the 3 timestamps"),
        ({"frame": np.array([-1, 0, 0])}, "`frame` must index the 3 timestamps"),
        ({"frame": np.array([2, 0])}, "have 2, 3 and 3 rows"),
        ({"point": np.array([4, -1, 0])}, "`point` must not be negative"),
        ({"point": np.array([4, 1, 1])}, r"point 1 appears twice in frame 0 \(10 ns\)"),
        ({"pixels": np.zeros((2, 2))}, "have 3, 3 and 2 rows"),
        ({"pixels": np.zeros((2, 3))}, r"pixels have shape \(2, 3\); expected \(3, 2\)"),
        ({"pixels": np.array([[0, 0], [0, np.nan], [0, 0]])}, r"Detections: pixels: value at index \(1, 1\) is nan"),
        ({"frame": np.array([2.5, 0.0, 0.0])}, "`frame` has type float64; expected whole numbers"),
        ({"point": np.array([0.5, 1.0, 0.0])}, "`point` has type float64; expected whole numbers"),
        ({"image_size": (0, 480)}, r"image_size is \(0, 480\); expected \(width, height\)"),
    ],
)
def test_broken_detections_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        corners(**changes)


def test_a_truncated_file_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    path = tmp_path / "cam0.detections.npz"
    corners().save(path)
    whole = path.read_bytes()
    for length in (0, 1, len(whole) // 3, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(CalibrationError, match="not a detections file") as caught:
            Detections.load(path)
        assert str(path) in str(caught.value)


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.npz"
    with pytest.raises(CalibrationError, match="no such detections file"):
        Detections.load(path)
    np.savez(path, pixels=np.zeros((3, 2)))
    with pytest.raises(CalibrationError, match="not a detections file"):
        Detections.load(path)
    path.write_text("timestamps_ns: []")
    with pytest.raises(CalibrationError, match="not a detections file"):
        Detections.load(path)


def test_a_file_whose_content_is_wrong_is_named(tmp_path: Path) -> None:
    path = tmp_path / "edited.npz"
    made = corners()
    fields: dict[str, Any] = {name: getattr(made, name) for name in ("timestamps_ns", "point", "pixels", "image_size")}
    np.savez(path, frame=np.array([0, 0, 7]), **fields)
    with pytest.raises(CalibrationError, match=r"edited.npz: .*`frame` must index the 3 timestamps"):
        Detections.load(path)
    fields["image_size"] = np.array([640, 480, 1])
    np.savez(path, frame=made.frame, **fields)
    with pytest.raises(CalibrationError, match=r"edited.npz: .*not a detections file"):
        Detections.load(path)


def test_the_file_has_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    path = tmp_path / "cam0.detections.npz"
    before = os.umask(0o022)
    try:
        corners().save(path)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_a_failed_save_leaves_the_old_file_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cam0.detections.npz"
    corners().save(path)

    def refuse(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(OSError, match="disk full"):
        corners(image_size=(1, 1)).save(path)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    assert_same(Detections.load(path), corners())


@given(data=detections(), seed=st.integers(0, 2**31))
def test_the_corners_of_some_frames_are_theirs_and_the_others_the_rest(data: Detections, seed: int) -> None:
    chosen = np.random.default_rng(seed).random(len(data.timestamps_ns)) < 0.5
    some, rest = data.of_frames(chosen), data.of_frames(~chosen)
    assert len(some) + len(rest) == len(data)
    assert chosen[some.frame].all()
    assert not chosen[rest.frame].any()
    np.testing.assert_array_equal(some.timestamps_ns, data.timestamps_ns)
    np.testing.assert_array_equal(some.pixels, data.pixels[chosen[data.frame]])
