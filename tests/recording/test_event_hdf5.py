"""HDF5 layouts of other programs, and the plugins they are compressed with."""

import logging
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest
from event_encoders import Stream, stream

from jaxcal import CalibrationError
from jaxcal.recording import EventFile
from jaxcal.recording.formats import columns as columns_module

OFFSET_US = 49_599_300_523


@pytest.fixture
def events() -> Stream:
    rng = np.random.default_rng(5)
    return stream(np.sort(rng.integers(1_500, 90_000, 3_000)))


def write_group(group: h5py.Group, events: Stream, **options: object) -> None:
    for name, dtype in (("x", np.uint16), ("y", np.uint16), ("p", np.uint8), ("t", np.uint32)):
        group.create_dataset(name, data=getattr(events, name).astype(dtype), chunks=(500,), **options)


def milliseconds(events: Stream) -> np.ndarray:
    return np.searchsorted(events.t, np.arange(0, events.t[-1] // 1000 + 1) * 1000)


def write_dsec(path: Path, events: Stream, table: np.ndarray) -> Path:
    with h5py.File(path, "w") as file:
        write_group(file.create_group("events"), events, **hdf5plugin.Blosc(cname="zstd"))
        file["ms_to_idx"] = table.astype(np.uint64)
        file["t_offset"] = np.int64(OFFSET_US)
    return path


def assert_windows(
    path: Path | str, events: Stream, offset_us: int = 0, size: tuple[int, int] | None = (64, 48)
) -> None:
    t_ns = (events.t + offset_us) * 1000
    with EventFile(path, *(size or (None, None))) as file:
        assert (len(file), file.span()) == (len(events.t), (t_ns[0], t_ns[-1]))
        for low, high in ((0, 10_000), (10_500, 20_000), (33_333, 33_334), (89_000, 10**6), (500_000, 600_000)):
            low_ns, high_ns = (low + offset_us) * 1000, (high + offset_us) * 1000
            inside = (t_ns >= low_ns) & (t_ns < high_ns)
            found = file.window(low_ns, high_ns)
            assert np.array_equal(found.t_ns, t_ns[inside])
            assert np.array_equal(found.x, events.x[inside])
            assert np.array_equal(found.p, events.p[inside])
        assert np.array_equal(np.concatenate([part.y for part in file.chunks()]), events.y)


@pytest.mark.parametrize("block", [1, 100, 65_536])
def test_dsec(
    tmp_path: Path, events: Stream, block: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(columns_module, "BLOCK", block)
    assert_windows(write_dsec(tmp_path / "events.h5", events, milliseconds(events)), events, OFFSET_US)
    assert caplog.text == ""  # its table of milliseconds has been used


def test_table_of_milliseconds_that_is_wrong_leads_nobody_astray(
    tmp_path: Path, events: Stream, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(columns_module, "BLOCK", 20)
    wrong = np.minimum(milliseconds(events) + 500, len(events.t))
    with caplog.at_level(logging.WARNING):
        assert_windows(write_dsec(tmp_path / "events.h5", events, wrong), events, OFFSET_US)
    assert "table of milliseconds is wrong" in caplog.text


def test_m3ed(tmp_path: Path, events: Stream) -> None:
    path = tmp_path / "calib.h5"
    other = stream(events.t[:2_000] + 7, seed=9)
    with h5py.File(path, "w") as file:
        for side, content in (("left", events), ("right", other)):
            group = file.create_group(f"prophesee/{side}")
            write_group(group, content)
            group["ms_map_idx"] = milliseconds(content)
            group["calib/resolution"] = np.array([64, 48])
        file["ovc/ts"] = np.arange(5)
    assert_windows(f"{path}:/prophesee/left", events, size=None)
    assert_windows(f"{path}:prophesee/right", other, size=None)
    with pytest.raises(CalibrationError, match=r"2 groups with events. Say which: .*:/prophesee/left or .*/right"):
        EventFile(path)
    with pytest.raises(CalibrationError, match=r"no events in '/ovc'. Groups with events: /prophesee/left, /pro"):
        EventFile(f"{path}:/ovc")


def write_prophesee(path: Path, events: Stream) -> Path:
    table = np.empty(len(events.t), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name in ("x", "y", "p", "t"):
        table[name] = getattr(events, name)
    edges = np.array([(1, 2000, 6), (0, 2500, 6)], [("p", "<i2"), ("t", "<i8"), ("id", "<i2")])
    with h5py.File(path, "w") as file:
        file.attrs["geometry"] = "64x48"
        file.create_dataset("CD/events", data=table, chunks=(500,))
        file.create_dataset("CD/indexes", data=np.zeros(3, [("id", "<u8"), ("ts", "<i8")]))
        file.create_dataset("EXT_TRIGGER/events", data=edges)
    return path


def test_prophesee(tmp_path: Path, events: Stream) -> None:
    path = write_prophesee(tmp_path / "recording.hdf5", events)
    assert_windows(path, events, size=None)
    with EventFile(path) as file:
        edges = file.triggers()
    assert (edges.t_ns.tolist(), edges.channel.tolist()) == ([2_000_000, 2_500_000], [6, 6])
    assert edges.rising.tolist() == [True, False]


def test_codecs_that_are_not_installed_are_named(
    tmp_path: Path, events: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    compressed = write_dsec(tmp_path / "dsec.h5", events, milliseconds(events))
    prophesee = write_prophesee(tmp_path / "ecf.hdf5", events)
    present = h5py.h5z.filter_avail
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: code not in (32001, 0x8ECF) and present(code))
    with pytest.raises(CalibrationError, match=r"dsec.h5: .* compressed with blosc, .* pip install 'jaxcal\[hdf5\]'"):
        EventFile(compressed, 64, 48)
    from jaxcal.recording.formats import hdf5

    monkeypatch.setattr(hdf5, "_filters", lambda dataset: [0x8ECF])
    with pytest.raises(CalibrationError, match=r"ecf.hdf5: .* ECF codec.* HDF5_PLUGIN_PATH"):
        EventFile(prophesee)
