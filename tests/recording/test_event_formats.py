"""Event formats: what is written is read, whatever the size of the blocks it is read in."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from event_encoders import (
    ENCODERS,
    HEIGHT,
    WIDTH,
    Stream,
    aedat4,
    stream,
    streams,
    write_dat,
    write_npz,
    write_raw,
    write_text,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxcal import CalibrationError
from jaxcal.recording import EventFile
from jaxcal.recording.formats import aedat4 as aedat4_module
from jaxcal.recording.formats import event_formats, npz, prophesee_dat, prophesee_raw, text

TWO_SECONDS = 2_000_000
quick = settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("formats")


def assert_reads(path: Path, events: Stream) -> None:
    """All of it in one pass, again in windows, and any stretch of time on its own."""
    with EventFile(path, WIDTH, HEIGHT) as file:
        pieces = list(file.columns())
        assert np.array_equal(np.concatenate([piece.t_ns for piece in pieces]), events.t * 1000)
        for name in ("x", "y", "p"):
            assert np.array_equal(np.concatenate([getattr(piece, name) for piece in pieces]), getattr(events, name))
        assert [piece.start for piece in pieces] == list(np.cumsum([0, *map(len, pieces)])[:-1])
    with EventFile(path, WIDTH, HEIGHT) as file:  # a new one: nothing is known of it yet
        middle = int(events.t[len(events.t) // 2]) * 1000
        inside = (events.t * 1000 >= middle) & (events.t * 1000 < middle + 50_000_000)
        assert np.array_equal(file.window(middle, middle + 50_000_000).x, events.x[inside])
        assert (len(file), file.span()) == (len(events.t), (events.t[0] * 1000, events.t[-1] * 1000))
        before = events.t * 1000 < middle
        assert np.array_equal(file.window(0, middle).y, events.y[before])
        length = max(1, (file.last_ns - file.first_ns) // 7)
        windows = list(file.windows(length))
        assert np.array_equal(np.concatenate([part.t_ns for _, part in windows]), events.t * 1000)
        assert all(np.all((part.t_ns >= end - length) & (part.t_ns < end)) for end, part in windows)


@pytest.mark.parametrize("encoding", ENCODERS)
@given(
    data=st.data(),
    block=st.integers(1, 40),
)
@quick
def test_raw_round_trip(folder: Path, encoding: str, data: st.DataObject, block: int) -> None:
    # EVT3 wraps after 2**24 us, EVT2 and EVT2.1 after 2**34 us; steps stay below the former.
    late = st.integers((1 << 34) - 3_000_000, (1 << 34) - 1) if encoding != "evt3" else st.integers(0, (1 << 24) - 1)
    events = data.draw(streams(st.one_of(st.integers(0, 100_000), late), (1 << 24) - 70_000))
    path = write_raw(folder / "file.raw", encoding, events)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prophesee_raw, "BLOCK_BYTES", 8 * block)
        assert_reads(path, events)


@pytest.mark.parametrize("block", [1, 7, 60])
@given(events=streams(st.integers((1 << 32) - 3_000_000, (1 << 32) + 3_000_000), TWO_SECONDS))
@settings(quick, max_examples=25)
def test_dat_round_trip(folder: Path, events: Stream, block: int) -> None:
    # The 32 bits of a file's first time are all that is known of it.
    events = Stream(events.t - (events.t[0] >> 32 << 32), events.x, events.y, events.p)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prophesee_dat, "_RECORDS_PER_BLOCK", block)
        assert_reads(write_dat(folder / "file.dat", events), events)


def test_dat_disorder_around_the_wrap_is_a_step_back_of_microseconds(folder: Path) -> None:
    late = Stream(*(values[[0, 2, 1, 3]] for values in vars(stream((1 << 32) + np.arange(-2, 2))).values()))
    with EventFile(write_dat(folder / "wrap.dat", late), WIDTH, HEIGHT) as file:
        times = np.concatenate([piece.t_ns for piece in file.unchecked_columns()])
        assert np.array_equal(times, late.t * 1000)
        with pytest.raises(CalibrationError, match="time runs backwards near event 2"):
            list(file.chunks())


@pytest.mark.parametrize("style", ["seconds", "us", "named", "savetxt"])
@given(events=streams(st.integers(0, 2_000_000_000_000_000), TWO_SECONDS), block=st.integers(30, 3000))
@settings(quick, max_examples=20)
def test_text_round_trip(folder: Path, events: Stream, style: str, block: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "BLOCK_BYTES", block)
        assert_reads(write_text(folder / "file.txt", events, style), events)


def test_a_text_read_in_parts_has_the_same_blocks(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pass that went on where another had stopped once cut its blocks elsewhere: events were given twice."""
    events = stream(np.arange(300) * 997)
    path = write_text(folder / "file.txt", events, "seconds")
    for block in (30, 100, 257, 1000):
        monkeypatch.setattr(text, "BLOCK_BYTES", block)
        for middle in range(0, 300_000, 39_000):
            with EventFile(path, WIDTH, HEIGHT) as file:
                file.window(middle * 1000, (middle + 20_000) * 1000)
                assert len(file) == 300
                windows = [part.t_ns for _, part in file.windows(50_000_000)]
                assert np.array_equal(np.concatenate(windows), events.t * 1000)


@pytest.mark.parametrize("kind", ["npz", "npz compressed", "aedat4"])
@given(events=streams(st.integers(0, 2_000_000_000_000_000), TWO_SECONDS), block=st.integers(1, 60))
@settings(quick, max_examples=20)
def test_npz_and_aedat4_round_trip(folder: Path, events: Stream, kind: str, block: int) -> None:
    path = folder / "file.any"  # formats are told by content
    if kind == "aedat4":
        path.write_bytes(aedat4(events, packet=block))
    else:
        write_npz(folder / "file.npz", events, compressed=kind != "npz").replace(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(npz, "_EVENTS_PER_BLOCK", block)
        patch.setattr(aedat4_module, "_EVENTS_PER_BLOCK", 2 * block)
        assert_reads(path, events)


def test_two_passes_at_once_do_not_disturb_each_other(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events = stream(np.arange(2_000) * 37)
    monkeypatch.setattr(prophesee_raw, "BLOCK_BYTES", 256)
    with EventFile(write_raw(folder / "file.raw", "evt3", events)) as file:
        slow, fast = file.columns(), file.columns()
        found: list[int] = [len(next(slow))]
        half = [len(next(fast)) for _ in range(20)]
        found += [len(next(slow)) for _ in range(40)]
        half += [len(piece) for piece in fast]
        found += [len(piece) for piece in slow]
        assert found == half
        assert sum(found) == len(file) == 2_000


# --- clocks of EVT ---------------------------------------------------------------------------------------------------


def decoded_times(path: Path, words: list[int]) -> tuple[list[int], list[str]]:
    path.write_bytes(b"% evt 3.0\n% geometry 64x48\n% end\n" + np.array(words, "<u2").tobytes())
    with EventFile(path) as file:
        times = np.concatenate([piece.t_ns for piece in file.unchecked_columns()]) // 1000
        return times.tolist(), file.remarks()


HIGH, LOW, X = 0x8000, 0x6000, 0x2001


def test_evt3_time_low_that_wraps_before_time_high_stands_still(folder: Path) -> None:
    words = [HIGH | 5, LOW | 4094, X, LOW | 1, X, HIGH | 6, LOW | 2, X]
    times, remarks = decoded_times(folder / "low.raw", words)
    base = 5 << 12
    assert times == [base + 4094, base + 4094, base + 4096 + 2]
    assert "stepped back 1 times, by 4093 us" in remarks[0]


def test_evt3_time_high_that_flickers_around_its_wrap_wraps_once(folder: Path) -> None:
    words = [HIGH | 4095, LOW | 7, X, HIGH, LOW | 1, X, HIGH | 4095, LOW | 4000, X, HIGH, LOW | 9, X]
    times, remarks = decoded_times(folder / "high.raw", words)
    wrap = 1 << 24
    assert times == [wrap - 4096 + 7, wrap + 1, wrap + 1, wrap + 9]
    assert "by 97 us at most" in remarks[0]


def test_evt3_vectors_follow_one_another(folder: Path) -> None:
    path = folder / "vectors.raw"
    vectors = [HIGH, LOW | 1, 5, 0x3802, 0x5081, 0x4801, 0x5001, 0x4001]  # base 2: 8, 12, 8, 12 columns
    decoded_times(path, vectors)
    with EventFile(path) as file:
        found = file.window(0, 10**9)
    assert found.x.tolist() == [2, 2 + 7, 2 + 8, 2 + 8 + 11, 2 + 20, 2 + 28]
    assert found.y.tolist() == [5] * 6
    assert found.p.all()


def test_evt3_repeated_time_high_keeps_time_low(folder: Path) -> None:
    words = [HIGH | 3, LOW | 100, X, HIGH | 3, X, HIGH | 4, LOW | 0, X]
    assert decoded_times(folder / "same.raw", words)[0] == [(3 << 12) + 100, (3 << 12) + 100, 4 << 12]


def test_evt3_long_step_back_is_time_running_backwards(folder: Path) -> None:
    words = [HIGH | 300, LOW | 100, X, HIGH | 290, LOW | 100, X]
    decoded_times(folder / "back.raw", words)
    with EventFile(folder / "back.raw") as file, pytest.raises(CalibrationError, match="time runs backwards near eve"):
        list(file.chunks())


def test_evt3_events_before_the_first_time_are_left_out_and_said(folder: Path) -> None:
    times, remarks = decoded_times(folder / "early.raw", [X, HIGH | 3, X, LOW | 1, X])
    assert times == [(3 << 12) + 1]
    assert "2 words of events or triggers came before the first time" in remarks[0]


@pytest.mark.parametrize(("encoding", "word"), [("evt2", "<u4"), ("evt21", "<u8"), ("evt3", "<u2")])
def test_external_triggers(folder: Path, encoding: str, word: str) -> None:
    events = stream(np.array([100, 100, 5000, 9000]))
    content = np.frombuffer(ENCODERS[encoding][0](events), word)
    shift = 32 if encoding == "evt21" else 0
    edge = (0xA << 12 | 6 << 8 | 1) if encoding == "evt3" else (0xA << 28 | 41 << 22 | 6 << 8 | 1) << shift
    path = folder / "edges.raw"
    path.write_bytes(f"{ENCODERS[encoding][1]}% geometry 64x48\n% end\n".encode())
    with path.open("ab") as file:
        file.write(np.append(content, np.array([edge, edge - (1 << shift)], word)).tobytes())
    with EventFile(path) as recording:
        edges = recording.triggers()
        assert len(recording) == 4
    at_us = 9000 if encoding == "evt3" else (9000 >> 6 << 6) + 41
    assert edges.t_ns.tolist() == [at_us * 1000, at_us * 1000]
    assert edges.channel.tolist() == [6, 6]
    assert edges.rising.tolist() == [True, False]


def test_sensors_of_old_headers(folder: Path) -> None:
    path = folder / "old.raw"
    path.write_bytes(b"% system_ID 48\n" + ENCODERS["evt3"][0](stream(np.arange(9))))
    with EventFile(path) as file:
        assert (file.size, len(file)) == ((1280, 720), 9)


# --- damage ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("write", "cut", "remark"),
    [
        (lambda path, events: write_raw(path, "evt2", events), 1, "the last word is cut short .3 of 4 bytes"),
        (lambda path, events: write_raw(path, "evt21", events), 3, "the last word is cut short .5 of 8 bytes"),
        (lambda path, events: write_raw(path, "evt3", events), 1, "the last word is cut short .1 of 2 bytes"),
        (write_dat, 5, "the last record is cut short .3 of 8 bytes"),
        (lambda path, events: write_text(path, events, "us"), 4, "line 101, the last one, is cut short"),
    ],
)
def test_what_was_cut_short_is_read_up_to_there_and_said(
    folder: Path,
    write: Callable[[Path, Stream], Path],
    cut: int,
    remark: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    events = stream(np.arange(100) * 1000)
    path = write(folder / "cut.any", events)
    path.write_bytes(path.read_bytes()[:-cut])
    with EventFile(path, WIDTH, HEIGHT) as file:
        times = np.concatenate([part.t_ns for part in file.chunks()])
        assert np.array_equal(times, events.t[:99] * 1000)
        assert re.search(remark, " ".join(file.remarks()))
        list(file.windows(10_000_000))
    assert re.search(f"cut.any: {remark}", caplog.text)


def test_broken_off_aedat4_is_read_up_to_there_and_said(folder: Path) -> None:
    events = stream(np.arange(100) * 1000)
    path = folder / "cut.aedat4"
    path.write_bytes(aedat4(events, packet=40)[:-100])
    with EventFile(path) as file:
        assert len(file) == 80
        assert "breaks off in the middle of a packet" in file.remarks()[0]
    path.write_bytes(aedat4(events)[:30])
    with pytest.raises(CalibrationError, match=r"cut.aedat4: the AEDAT4 file cannot be read .* damaged"):
        EventFile(path)


BAD_LINES = {
    "1.5 2 3 1\n0.5 2 1\n1.6 2 3 1\n": r"line 2 is '0.5 2 1'. Expected lines of 't x y p'",
    "1.5 2 3 1\n1.6 2.5 3 1\n1.7 2 3 1\n": "line 2 is '1.6 2.5 3 1'",
    "1.5 2 3 1\n1.6 2 3 7\n1.7 2 3 1\n": "line 2 is '1.6 2 3 7'",
    "1.5 2 3 1\n1.6 -2 3 1\n1.7 2 3 1\n": "line 2 is '1.6 -2 3 1'",
    "1.5 2 3 1\nx y\n1.7 2 3 1\n": "line 2 is 'x y'",
    "1.5 2 3\n": "line 1 has 3 columns, not 4",
    "# nothing\n": "there are no events",
    "1.5 2 3 1\n1.4 2 3 1\n": "time runs backwards near event 1.*--sort",
    "1.5 2 3 1\n1.6 64 3 1\n": r"event 1 at \(x, y\) = \(64, 3\) lies outside the 64x48 sensor",
}


@pytest.mark.parametrize("content", BAD_LINES)
def test_bad_lines_are_named(folder: Path, content: str) -> None:
    path = folder / "bad.txt"
    path.write_text(content)
    with pytest.raises(CalibrationError, match=f"bad.txt: .*{BAD_LINES[content]}"), EventFile(path, 64, 48) as file:
        list(file.chunks())


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.raw", b"% evt 4.0\n% end\n\0\0", "the header says '4.0' where the encoding .*expected a line '% evt 2.0'"),
        ("a.raw", b"% geometry 64x48\n\0\0", "the header says nothing about it where the encoding"),
        ("a.raw", b"\x00\x01\x02\x03", "named like Prophesee RAW.* but its content is not"),
        ("a.raw", b"% evt 3.0\n% end\n", "there are no events in the file"),
        ("a.raw", b"", "the file is empty"),
        ("a.dat", b"% Height 48\n\x0e\x08", "type 14, 8 bytes each; .*external triggers; the events are in the other"),
        ("a.dat", b"% Height 48\n", "behind the header there is nothing"),
        ("a.npz", b"PK\x03\x04junk", "not a readable npz file"),
        ("a.zst", b"\x28\xb5\x2f\xfd", "no event recording that is known here. Known formats: HDF5"),
    ],
)
def test_files_that_are_no_recording(folder: Path, name: str, content: bytes, message: str) -> None:
    (folder / name).write_bytes(content)
    with pytest.raises(CalibrationError, match=f"{name}: .*{message}"), EventFile(folder / name, 64, 48) as file:
        len(file)


def test_npz_that_is_no_recording(folder: Path) -> None:
    columns = {name: np.arange(3) for name in "xypt"}
    bad = {
        "'p' is missing; the file holds x, y, t": {name: columns[name] for name in "xyt"},
        "must have one entry per event": columns | {"x": np.arange(4)},
        "'t' has type float64; expected whole microseconds": columns | {"t": np.arange(3.0)},
        "'x' has type float64; expected whole pixels": columns | {"x": np.arange(3.0)},
        "there are no events": {name: np.arange(0) for name in "xypt"},
    }
    for message, content in bad.items():
        np.savez(folder / "bad.npz", **content)
        with pytest.raises(CalibrationError, match=f"bad.npz: .*{message}"):
            EventFile(folder / "bad.npz", 64, 48)


def test_size_of_the_sensor(folder: Path) -> None:
    events = stream(np.arange(100))
    told, untold = write_dat(folder / "told.dat", events), write_npz(folder / "untold.npz", events)
    with EventFile(told) as file:
        assert (file.width, file.height) == (WIDTH, HEIGHT)
        assert len(file.window(0, 10**9)) == 100
    with pytest.raises(CalibrationError, match=r"the sensor has 64x48 pixels, but 640x480 was given"):
        EventFile(told, 640, 480)
    with EventFile(untold) as file:
        assert file.size is None
        assert sum(map(len, file.columns())) == 100
        with pytest.raises(CalibrationError, match="does not tell the sensor's size"):
            file.window(0, 1)
    with pytest.raises(CalibrationError, match="'/dvs' names a place inside, but an npz file has none"):
        EventFile(f"{untold}:/dvs", 64, 48)


def test_every_format_is_listed() -> None:
    suffixes = [suffix for candidate in event_formats() for suffix in candidate.suffixes]
    assert len(set(suffixes)) == len(suffixes)
    assert {".raw", ".dat", ".h5", ".aedat4", ".npz", ".bag", ".mcap", ".db3", ".txt", ".csv"} <= set(suffixes)
