"""Event files: windows tile the recording, and damage is named."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxcal import CalibrationError
from jaxcal.recording import EventFile
from jaxcal.recording.formats import columns as columns_module

WIDTH, HEIGHT = 20, 10


def write(path: Path, t_us: np.ndarray, **columns: np.ndarray) -> Path:
    rng = np.random.default_rng(len(t_us))
    content = {
        "x": rng.integers(0, WIDTH, len(t_us)).astype(np.uint16),
        "y": rng.integers(0, HEIGHT, len(t_us)).astype(np.uint16),
        "p": rng.integers(0, 2, len(t_us)).astype(np.uint8),
        "t": np.asarray(t_us, dtype=np.int64),
    } | columns
    with h5py.File(path, "w") as file:
        for name, values in content.items():
            file.create_dataset(name, data=values, chunks=True)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("events")


@given(
    steps=st.lists(st.integers(0, 300), min_size=1, max_size=200),
    start=st.integers(0, 10**15),
    window_ns=st.integers(1_000, 400_000),
    block=st.integers(1, 50),
)
@settings(deadline=None, max_examples=60)
def test_windows_hold_every_event_once_in_its_window(
    folder: Path, steps: list[int], start: int, window_ns: int, block: int
) -> None:
    t_us = start + np.cumsum(steps)
    path = write(folder / "property.h5", t_us)
    with pytest.MonkeyPatch.context() as patch, EventFile(path, WIDTH, HEIGHT) as file:
        patch.setattr(columns_module, "BLOCK", block)
        patch.setattr(columns_module, "PIECE", 3 * block)
        windows = list(file.windows(window_ns))
    assert np.array_equal(np.concatenate([events.t_ns for _, events in windows]), t_us * 1000)
    for end, events in windows:
        assert np.all((events.t_ns >= end - window_ns) & (events.t_ns < end))
    assert np.all(np.diff([end for end, _ in windows]) == window_ns)
    with h5py.File(path) as raw:
        x, p = np.asarray(raw["x"]), np.asarray(raw["p"])
    assert np.array_equal(np.concatenate([events.x for _, events in windows]), x)
    assert np.array_equal(np.concatenate([events.p for _, events in windows]), p.astype(bool))


@given(
    steps=st.lists(st.integers(0, 5), min_size=1, max_size=60),
    t0=st.integers(-5_000, 300_000),
    length=st.integers(0, 200_000),
)
@settings(deadline=None, max_examples=60)
def test_a_window_is_what_a_scan_of_all_events_finds(folder: Path, steps: list[int], t0: int, length: int) -> None:
    t_us = np.cumsum(steps)
    path = write(folder / "scan.h5", t_us)
    with EventFile(path, WIDTH, HEIGHT) as file:
        found = file.window(t0, t0 + length).t_ns
    assert np.array_equal(found, [t for t in t_us * 1000 if t0 <= t < t0 + length])


def test_facts_of_the_file(folder: Path) -> None:
    path = write(folder / "facts.h5", np.array([5, 7, 7, 90]), p=np.array([-1, 1, -1, 1], np.int8))
    with EventFile(path, WIDTH, HEIGHT) as file:
        assert (len(file), file.first_ns, file.last_ns) == (4, 5_000, 90_000)
        assert (file.width, file.height) == (WIDTH, HEIGHT)
        assert file.window(0, 10**9).p.tolist() == [False, True, False, True]


def test_only_the_window_is_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(folder / "lazy.h5", np.arange(2_000_000))
    read = []
    original = h5py.Dataset.__getitem__

    def counted(data: h5py.Dataset, part: slice) -> np.ndarray:
        read.append(part.stop - part.start)
        return original(data, part)

    monkeypatch.setattr(h5py.Dataset, "__getitem__", counted)
    with EventFile(path, WIDTH, HEIGHT) as file:
        assert len(file.window(1_000_000_000, 1_000_500_000)) == 500
    assert 4 * 500 < sum(read) < 200_000


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x": np.array([0, 1, WIDTH], np.uint16)}, r"event 2 at \(x, y\) = \(20, .*20x10 sensor"),
        ({"y": np.array([0, -1, 3], np.int16)}, "event 1 .* outside the 20x10 sensor"),
        ({"t": np.array([10, 30, 20])}, "time runs backwards near event [12]"),
    ],
)
def test_bad_events_are_named(folder: Path, columns: dict[str, np.ndarray], message: str) -> None:
    path = write(folder / "bad.h5", np.array([10, 20, 30]), **columns)
    with EventFile(path, WIDTH, HEIGHT) as file, pytest.raises(CalibrationError, match=message):
        list(file.windows(1_000))


@example([10, 50, 20])  # in pieces that are each in order, the last of them behind the windows
@given(st.lists(st.integers(0, 50), min_size=2, max_size=80).filter(lambda t: t != sorted(t)))
@settings(deadline=None, max_examples=60)
def test_unsorted_time_never_passes_unseen(folder: Path, t_us: list[int]) -> None:
    path = write(folder / "unsorted.h5", np.array(t_us))

    def read_all() -> None:
        with EventFile(path, WIDTH, HEIGHT) as file:
            list(file.windows(7_000))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns_module, "BLOCK", 4)
        patch.setattr(columns_module, "PIECE", 2)
        with pytest.raises(CalibrationError, match="time runs backwards"):
            read_all()


def test_files_that_are_no_recording(folder: Path) -> None:
    whole = write(folder / "whole.h5", np.arange(100_000))
    truncated = folder / "truncated.h5"
    truncated.write_bytes(whole.read_bytes()[:-5000])
    (folder / "text.h5").write_text("x y p t\n")
    with pytest.raises(CalibrationError, match=r"truncated\.h5: .*truncated"):
        EventFile(truncated, WIDTH, HEIGHT)
    with pytest.raises(CalibrationError, match=r"text\.h5: .*no HDF5 file"):
        EventFile(folder / "text.h5", WIDTH, HEIGHT)
    with pytest.raises(CalibrationError, match="no such event file"):
        EventFile(folder / "absent.h5", WIDTH, HEIGHT)
    with pytest.raises(CalibrationError, match="there are no events"):
        EventFile(write(folder / "empty.h5", np.empty(0)), WIDTH, HEIGHT)
    with pytest.raises(CalibrationError, match="one entry per event"):
        EventFile(write(folder / "short.h5", np.arange(5), x=np.zeros(4, np.uint16)), WIDTH, HEIGHT)
    with pytest.raises(CalibrationError, match="has type float64"):
        EventFile(write(folder / "float.h5", np.arange(5), t=np.arange(5.0)), WIDTH, HEIGHT)
    with h5py.File(folder / "missing.h5", "w") as file:
        file["x"] = np.zeros(3)
    with pytest.raises(CalibrationError, match="dataset 'y' is missing; the file holds x"):
        EventFile(folder / "missing.h5", WIDTH, HEIGHT)
