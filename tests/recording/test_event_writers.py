"""Writing, sorting and describing event recordings."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from event_encoders import HEIGHT, WIDTH, Stream, stream, streams, write_npz, write_raw
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxcal import CalibrationError
from jaxcal.recording import EventFile, convert_events, event_facts
from jaxcal.recording.event_writers import in_order
from jaxcal.recording.formats import prophesee_raw
from jaxcal.recording.formats.contract import EventColumns

quick = settings(deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("writers")


def read(path: Path) -> Stream:
    with EventFile(path) as file:
        pieces = list(file.columns())
    t_ns, x, y, p = (np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("t_ns", "x", "y", "p"))
    return Stream(t_ns // 1000, x, y, p)


@pytest.mark.parametrize("suffix", [".h5", ".npz", ".txt", ".csv"])
@given(events=streams(st.integers(0, 2_000_000_000), 3_000_000))
@quick
def test_what_is_written_is_read(folder: Path, suffix: str, events: Stream) -> None:
    source, out = write_raw(folder / "in.raw", "evt2", events), folder / f"out{suffix}"
    with pytest.MonkeyPatch.context() as patch, EventFile(source) as file:
        patch.setattr(prophesee_raw, "BLOCK_BYTES", 64)
        assert convert_events(file, out) == len(events.t)
    assert read(out).rows() == events.rows()
    assert [path.name for path in folder.iterdir() if path.name.startswith(".")] == []
    if suffix in (".h5", ".npz"):
        with EventFile(out) as file:
            assert file.size == (WIDTH, HEIGHT)


def test_e2calib_finds_its_layout_and_triggers_are_kept(folder: Path) -> None:
    events = stream(np.arange(50) * 64)
    source, out = write_raw(folder / "edges.raw", "evt2", events), folder / "edges.h5"
    with source.open("ab") as file:
        file.write(np.array([0xA << 28 | 6 << 8 | 1], "<u4").tobytes())
    with EventFile(source) as file:
        convert_events(file, out)
        edges = file.triggers()
    with h5py.File(out) as file:
        assert {name: file[name].dtype.str for name in "xypt"} == {"x": "<u2", "y": "<u2", "p": "|u1", "t": "<i8"}
    with EventFile(out) as file:
        again = file.triggers()
    for name in ("t_ns", "channel", "rising"):
        assert np.array_equal(getattr(again, name), getattr(edges, name))
    assert len(again) == 1


def test_failure_leaves_the_file_that_was_there(folder: Path) -> None:
    out = folder / "kept.h5"
    out.write_text("old")
    np.savez(folder / "bad.npz", x=[0, WIDTH], y=[0, 0], p=[0, 1], t=[1, 2])
    with (
        EventFile(folder / "bad.npz", WIDTH, HEIGHT) as file,
        pytest.raises(CalibrationError, match=r"event 1 .* outs"),
    ):
        convert_events(file, out)
    assert out.read_text() == "old"
    with (
        EventFile(folder / "bad.npz") as file,
        pytest.raises(CalibrationError, match=r"out.xyz: events are"),
    ):
        convert_events(file, folder / "out.xyz")


# --- order -----------------------------------------------------------------------------------------------------------


@given(
    t=st.lists(st.integers(0, 5_000), min_size=1, max_size=150),
    late=st.integers(0, 500),
    piece=st.integers(1, 40),
)
@settings(deadline=None, max_examples=100)
def test_sorting_within_a_lateness(t: list[int], late: int, piece: int) -> None:
    """Events that were shuffled by less than the lateness come out sorted, those of one time in their order."""
    clock = np.sort(t)
    seen_at = clock + np.random.default_rng(0).integers(0, late + 1, len(t))
    order = np.argsort(seen_at, kind="stable")
    mark = np.arange(len(t))
    nothing = np.zeros(len(t), bool)
    pieces = [
        EventColumns(k, clock[order][k : k + piece], mark[k : k + piece], mark[k : k + piece], nothing[k : k + piece])
        for k in range(0, len(t), piece)
    ]
    found = list(in_order(pieces, Path("shuffled"), late))
    times = np.concatenate([part.t_ns for part in found])
    assert np.array_equal(times, clock)
    expected = np.argsort(clock[order], kind="stable")
    assert np.array_equal(np.concatenate([part.x for part in found]), expected)


def test_events_later_than_said_are_named() -> None:
    nothing, ms = np.zeros(2, bool), 1_000_000
    pieces = [EventColumns(2 * k, np.full(2, t * ms), nothing, nothing, nothing) for k, t in enumerate((1, 4, 9, 3))]
    assert [int(part.t_ns[-1]) // ms for part in in_order(pieces, Path("late"), 6 * ms)][-1] == 9
    with pytest.raises(
        CalibrationError, match=r"late: near event 6 time runs backwards by 6.000 ms, .* --sort 5 allows"
    ):
        list(in_order(pieces, Path("late"), 5 * ms))


# --- facts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("block", [64, 1 << 21])
def test_facts_do_not_depend_on_blocks(folder: Path, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prophesee_raw, "BLOCK_BYTES", block)
    rng = np.random.default_rng(1)
    t = np.sort(np.concatenate([rng.integers(0, 400_000, 8_000), rng.integers(700_000, 1_000_000, 8_000)]))
    t[0], t[-1] = 0, 1_000_000
    events = stream(t)
    hot = rng.choice(len(t), 900, replace=False)
    events.x[hot], events.y[hot] = 11, 7
    with EventFile(write_raw(folder / "facts.raw", "evt2", events)) as file:
        facts = event_facts(file)
    gap = np.diff(t).max()
    assert (facts.count, facts.span_s, facts.sensor) == (16_000, 1.0, (WIDTH, HEIGHT))
    assert facts.mean_rate == pytest.approx(16_000)
    assert facts.peak_rate == pytest.approx(np.bincount(t // 10_000).max() * 100)
    assert facts.on_share == pytest.approx(np.mean(events.p))
    assert [(pixel.x, pixel.y) for pixel in facts.hot_pixels] == [(11, 7)]
    assert facts.hot_pixels[0].count == np.count_nonzero((events.x == 11) & (events.y == 7))
    assert facts.gap_count == 1
    assert facts.gaps[0].length_s == pytest.approx(gap * 1e-6)
    assert facts.gaps[0].start_s == pytest.approx(t[np.argmax(np.diff(t))] * 1e-6)
    same = (np.diff(t) == 0) & (np.diff(events.x) == 0) & (np.diff(events.y) == 0)
    assert facts.repeated == np.count_nonzero(same)
    assert (facts.backwards, facts.outside, facts.triggers) == (0, 0, {})


def test_disorder_is_counted(folder: Path) -> None:
    events = Stream(np.array([10, 30, 20, 25, 5]), np.array([1, 2, 70, 3, 4]), np.zeros(5, int), np.ones(5, bool))
    with EventFile(write_npz(folder / "wild.npz", events), WIDTH, HEIGHT) as file:
        facts = event_facts(file)
    assert (facts.backwards, facts.largest_backwards_s) == (2, pytest.approx(20e-6))
    assert (facts.outside, facts.span_s, facts.reach) == (1, pytest.approx(25e-6), (4, 0))
