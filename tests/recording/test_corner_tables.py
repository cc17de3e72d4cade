"""Corner tables of other programs become the same Detections, whichever way they name corners."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import AprilGrid, CalibrationError, Checkerboard, Detections
from jaxcal.recording import load_detections

GRID = AprilGrid(rows=3, cols=4, tag_size=0.05, tag_spacing=0.3)
SIZE = (640, 480)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tables")


def random_detections(seed: int, num_frames: int) -> Detections:
    rng = np.random.default_rng(seed)
    times = 1_600_000_000_000_000_000 + np.cumsum(rng.integers(1, 10**8, num_frames))
    seen = rng.random((num_frames, len(GRID.points))) < 0.5
    frame, point = np.nonzero(seen)
    return Detections(times, frame, point, rng.random((len(frame), 2)) * 470, SIZE)


def write_table(path: Path, detections: Detections, by_tag: bool, **changed: np.ndarray) -> Path:
    columns = {
        "cam3_ns": detections.timestamps_ns[detections.frame],
        "cam3_uv": detections.pixels,
        "cam3_frame_ns": detections.timestamps_ns,
        "cam3_board_xy_m": GRID.points[detections.point, :2],
    }
    if by_tag:
        lookup = {int(p): (tag, k) for tag in range(12) for k, p in enumerate(GRID.tag_points(tag))}
        columns["cam3_tag_corner"] = np.array([lookup[int(p)] for p in detections.point], np.int16).reshape(-1, 2)
    else:
        columns["cam3_point"] = detections.point.astype(np.int16)
    np.savez(path, **(columns | changed))
    return path


def same(a: Detections, b: Detections) -> bool:
    names = ("timestamps_ns", "frame", "point", "pixels")
    return a.image_size == b.image_size and all(np.array_equal(getattr(a, n), getattr(b, n)) for n in names)


@given(seed=st.integers(0, 10**6), num_frames=st.integers(1, 6), by_tag=st.booleans())
@settings(deadline=None, max_examples=40)
def test_tables_round_trip(folder: Path, seed: int, num_frames: int, by_tag: bool) -> None:
    truth = random_detections(seed, num_frames)
    assert same(load_detections(write_table(folder / "t.npz", truth, by_tag), GRID, SIZE, "cam3"), truth)


def test_own_files_need_no_resolution(folder: Path) -> None:
    truth = random_detections(1, 3)
    truth.save(folder / "own.npz")
    assert same(load_detections(folder / "own.npz", GRID, None, "cam0"), truth)
    with pytest.raises(CalibrationError, match="640x480 images, but the rig says 752x480"):
        load_detections(folder / "own.npz", GRID, (752, 480), "cam0")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"cam3_point": np.array([48])}, "corners 48 to 48 are named, but the target has 0 to 47"),
        ({"cam3_board_xy_m": np.array([[0.06, 0.0]])}, "row 0 puts corner 1 .* order"),
        ({"cam3_uv": np.array([[640.0, 3.0]])}, "row 0 is at .* outside the 640x480 image"),
        ({"cam3_uv": np.array([[np.nan, 3.0]])}, "finite"),
        ({"cam3_uv": np.zeros((2, 2))}, "one row per corner"),
        ({"cam3_ns": np.array([1.0])}, "has type float64"),
    ],
)
def test_table_errors(folder: Path, changed: dict[str, np.ndarray], message: str) -> None:
    one = Detections(np.array([7]), np.array([0]), np.array([1]), np.array([[5.0, 6.0]]), SIZE)
    path = write_table(folder / "bad.npz", one, False, **changed)
    with pytest.raises(CalibrationError, match=message) as caught:
        load_detections(path, GRID, SIZE, "cam3")
    assert str(path) in str(caught.value)


def test_wrong_questions(folder: Path) -> None:
    path = write_table(folder / "ok.npz", random_detections(3, 2), True)
    with pytest.raises(CalibrationError, match="'cam0_ns' is missing; the file holds cam3_ns"):
        load_detections(path, GRID, SIZE, "cam0")
    with pytest.raises(CalibrationError, match="give 'resolution'"):
        load_detections(path, GRID, None, "cam3")
    with pytest.raises(CalibrationError, match="names tags, but the target is a Checkerboard"):
        load_detections(path, Checkerboard(4, 5, 0.1), SIZE, "cam3")
    with pytest.raises(CalibrationError, match="order"):
        load_detections(path, AprilGrid(3, 4, 0.06, 0.3), SIZE, "cam3")
    with pytest.raises(CalibrationError, match="the target has tags 0 to 1"):
        load_detections(path, AprilGrid(1, 2, 0.05, 0.3), SIZE, "cam3")
    truncated = folder / "cut.npz"
    truncated.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CalibrationError, match=r"cut.npz: not a readable npz"):
        load_detections(truncated, GRID, SIZE, "cam3")


@pytest.mark.real_data
def test_euroc_and_kalibr_tables(data_folder: Path) -> None:
    grid = AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)
    for camera, corners in (("cam0", 116_888), ("cam1", 116_244)):
        found = load_detections(data_folder / "euroc_imu_april" / "observations.npz", grid, (752, 480), camera)
        assert (len(found), len(found.timestamps_ns)) == (corners, 901)
    kalibr = load_detections(data_folder / "kalibr_sim_mono_imu" / "kalibr_corners.npz", grid, SIZE, "cam0")
    assert (len(kalibr), len(kalibr.timestamps_ns)) == (110_432, 797)
