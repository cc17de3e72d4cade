"""Window plans: every event up to the last window's end is in exactly one window, whatever the plan."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import CalibrationError
from jaxcal.recording import EventFile, FrameTimes
from jaxcal.recording.formats.contract import NO_TRIGGERS, EventColumns, Triggers
from jaxcal.recording.windows import (
    CountedWindows,
    TimedWindows,
    Window,
    WindowPlan,
    at_times,
    periodic,
    read_timestamps,
    trigger_times,
)

ORIGIN_NS = 1_600_000_000_000_000_000


class Reader:
    """Events in memory, in pieces of a given length."""

    path, format, sensor = Path("memory"), "memory", (640, 480)

    def __init__(self, t_ns: np.ndarray, piece: int) -> None:
        self.t_ns, self.piece = t_ns, piece

    def span(self) -> tuple[int, int]:
        return int(self.t_ns[0]), int(self.t_ns[-1])

    def count(self) -> int:
        return len(self.t_ns)

    rough_count = count

    def read(self, t0_ns: int | None, t1_ns: int | None):
        for start in range(0, len(self.t_ns), self.piece):
            part = self.t_ns[start : start + self.piece]
            number = np.arange(start, start + len(part))
            yield EventColumns(start, part, number % 640, number // 640, np.ones(len(part), bool))

    def triggers(self) -> Triggers:
        return NO_TRIGGERS

    def remarks(self) -> list[str]:
        return []

    def close(self) -> None:
        pass


def event_file(t_ns: np.ndarray, piece: int = 7) -> EventFile:
    events = EventFile.__new__(EventFile)
    events.path, events._place, events._reader = Path("memory"), None, Reader(t_ns, piece)
    events._size, events._span = (640, 480), None
    return events


@st.composite
def recordings(draw: st.DrawFn) -> EventFile:
    """Up to 200 events, many of them at the same time, from some origin on."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    length_ns = draw(st.sampled_from([100, 50_000, 5_000_000]))
    tick = draw(st.sampled_from([1, 1000]))
    t = np.sort(rng.integers(0, length_ns, draw(st.integers(2, 200)))) // tick * tick
    t[-1] = max(t[-1], t[0] + 60 * tick)
    return event_file(draw(st.sampled_from([0, ORIGIN_NS])) + t, draw(st.integers(1, 50)))


@st.composite
def plans(draw: st.DrawFn, events: EventFile) -> WindowPlan:
    rate = draw(st.integers(1, 5))
    span = events.last_ns - events.first_ns
    if draw(st.booleans()):  # only a part of the recording
        part = (events.first_ns + span // 5, events.last_ns - span // 7)
        chosen = draw(st.sampled_from(["periodic", "times", "count"]))
        if chosen == "count":
            return CountedWindows(draw(st.integers(1, 60)), rate, part)
        if chosen == "times":
            return at_times(events, part[0] + np.arange(-3, 9) * (span // 11), "x", span_ns=part, upsample_rate=rate)
        return periodic(events, span // draw(st.integers(4, 12)), span_ns=part, upsample_rate=rate)
    kind = draw(st.sampled_from(["periodic", "rate", "first event", "times", "count"]))
    if kind == "count":
        return CountedWindows(draw(st.integers(1, 60)), rate)
    if kind == "times":
        inside = draw(st.lists(st.integers(1, span), min_size=1, max_size=20, unique=True))
        outside = draw(st.lists(st.integers(-span - 2, 0), max_size=3, unique=True))
        times = events.first_ns + np.sort(np.array(inside + outside + [span + 3 + number for number in range(2)]))
        return at_times(events, times, "the test", upsample_rate=rate)
    period = draw(st.integers(1, 60))
    if kind == "rate":
        return periodic(events, Fraction(max(span // 70, 1) * period, 3), upsample_rate=rate)
    origin = events.first_ns if kind == "first event" else 0
    # Multiples of the period must fall in the recording.
    period = min(max(span // 200, 1) * period, max(span // 3, 1))
    try:
        return periodic(events, period, origin_ns=origin, upsample_rate=rate)
    except CalibrationError:
        return periodic(events, 1 + span // 300, upsample_rate=rate)


@settings(deadline=None, max_examples=120)
@given(st.data())
def test_each_event_is_in_exactly_one_window(data: st.DataObject) -> None:
    events = data.draw(recordings())
    plan = data.draw(plans(events)).showing(data.draw(st.sampled_from([1.0, 0.75, 0.5])))
    windows = list(plan.windows(events))
    all_t = events._reader.t_ns  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(plan, CountedWindows) and plan.span_ns is not None and not windows:
        assert not np.any((all_t >= plan.span_ns[0]) & (all_t < plan.span_ns[1]))
        return
    ends = [window.t_end_ns for window in windows]
    assert np.all(np.diff(ends) > 0)
    seen = np.concatenate([window.events.y.astype(int) * 640 + window.events.x for window in windows])
    start = events.first_ns
    if isinstance(plan, CountedWindows) and plan.span_ns is not None:
        start = plan.span_ns[0]
    elif isinstance(plan, TimedWindows) and plan.start_ns is not None:
        start = plan.start_ns
    assert np.array_equal(
        seen, np.flatnonzero((all_t >= start) & (all_t < ends[-1]))
    )  # in order, none missing or twice
    for window, begin in zip(windows, [start, *ends[:-1]], strict=True):
        assert np.all((window.events.t_ns >= begin) & (window.events.t_ns < window.t_end_ns))
    assert windows[-1].wanted
    if isinstance(plan, CountedWindows):
        stop = events.last_ns + 1 if plan.span_ns is None else plan.span_ns[1]
        assert len(seen) == np.count_nonzero((all_t >= start) & (all_t < stop))
    else:
        assert plan.count(events) == len(windows)


@settings(deadline=None, max_examples=80)
@given(st.data(), st.sampled_from([0.5, 0.75]))
def test_windows_reach_beyond_the_moments_they_show(data: st.DataObject, shown_at: float) -> None:
    """The images are of the same times as without, but for a last one behind which nothing comes."""
    events = data.draw(recordings())
    plain = data.draw(plans(events))
    before = [window for window in plain.windows(events) if window.wanted]
    windows = list(plain.showing(shown_at).windows(events))
    ends = [window.t_end_ns for window in windows]
    shown = [window.t_shown_ns for window in windows]
    assert all(window.t_shown_ns == window.t_end_ns for window in before)
    assert all(moment < end for moment, end in zip(shown, ends, strict=True) if not isinstance(plain, CountedWindows))
    assert all(begin <= moment for begin, moment in zip(ends[:-1], shown[1:], strict=True))
    wanted = [window.t_shown_ns for window in windows if window.wanted]
    if isinstance(plain, CountedWindows):
        assert len(wanted) == len(before)
        assert all(moment <= window.t_end_ns for moment, window in zip(wanted, before, strict=True))
    else:
        assert wanted in ([w.t_end_ns for w in before], [w.t_end_ns for w in before[:-1]])


def test_an_evenly_timed_image_is_of_the_middle_of_its_window() -> None:
    events = event_file(np.arange(0, 1_000_000, 1000))
    windows = list(periodic(events, 100_000).showing(0.5).windows(events))
    assert [window.t_shown_ns for window in windows] == [100_000 * number for number in range(1, 10)]
    assert [window.t_end_ns for window in windows] == [100_000 * number + 50_000 for number in range(1, 10)]


def test_images_at_given_times_are_not_lost_at_the_end_of_the_recording() -> None:
    events = event_file(np.arange(0, 1_000_000, 1000))
    times = np.array([200_000, 400_000, 999_000])
    plan = at_times(events, times, "the test").showing(0.5)
    assert [window.t_shown_ns for window in plan.windows(events) if window.wanted] == times.tolist()


@settings(deadline=None, max_examples=30)
@given(recordings(), st.integers(1, 6))
def test_upsampling_adds_windows_and_keeps_the_frames(events: EventFile, rate: int) -> None:
    """As e2calib: the images between are made, and not kept; the wanted ones keep their times."""
    period = (events.last_ns - events.first_ns) // 3
    plain = periodic(events, period, origin_ns=events.first_ns)
    finer = periodic(events, period, origin_ns=events.first_ns, upsample_rate=rate)
    assert np.array_equal(finer.ends_ns[finer.wanted], plain.ends_ns)
    if period >= rate:
        assert len(finer.ends_ns) == rate * len(plain.ends_ns)
        steps = np.diff(finer.ends_ns, prepend=events.first_ns)
        assert steps.max() - steps.min() <= 1  # of equal length, to the nanosecond


@settings(deadline=None, max_examples=30)
@given(recordings(), st.integers(1, 60))
def test_counted_windows_hold_so_many_events_and_their_companions(events: EventFile, number: int) -> None:
    windows: list[Window] = list(CountedWindows(number).windows(events))
    for window in windows[:-1]:
        t = window.events.t_ns
        assert len(t) >= number
        assert np.all(t[number - 1 :] == t[number - 1])  # more only where they are of one time
        assert window.t_end_ns == t[-1] + 1


def test_a_rate_that_is_no_whole_number_of_nanoseconds_does_not_drift() -> None:
    events = event_file(ORIGIN_NS + np.arange(0, 100_000_000_000, 10_000_000))
    plan = FrameTimes(rate_hz=30.0).plan(events)
    assert isinstance(plan, TimedWindows)
    assert len(plan.ends_ns) > 2990
    assert not (plan.ends_ns[29::30] % 1_000_000_000).any()
    steps = np.diff(plan.ends_ns)
    assert set(steps.tolist()) == {33_333_333, 33_333_334}


def test_long_windows_between_given_times_are_divided() -> None:
    events = event_file(np.arange(0, 10_000_000_000, 5_000_000))
    times = np.concatenate([np.arange(5_000, 6_000, 20), np.arange(8_000, 9_000, 20)]) * 1_000_000
    plan = at_times(events, times, "the test")
    assert np.diff(plan.ends_ns, prepend=events.first_ns).max() <= 20_000_000
    assert np.array_equal(plan.ends_ns[plan.wanted], times)


# --- times -----------------------------------------------------------------------------------------------------------


def test_timestamps_are_microseconds_as_e2calib_writes_them(tmp_path: Path) -> None:
    times = np.array([1_600_000_000_000_123, 1_600_000_000_050_000])
    np.savetxt(tmp_path / "e2calib.txt", times, "%i")
    assert read_timestamps(tmp_path / "e2calib.txt").tolist() == (times * 1000).tolist()
    (tmp_path / "finer.txt").write_text("# us\n1600000000000000.125\n\n1600000000000001  # the second\n")
    assert read_timestamps(tmp_path / "finer.txt").tolist() == [1_600_000_000_000_000_125, 1_600_000_000_000_001_000]


@pytest.mark.parametrize(
    ("text", "words"),
    [("1\ntwo\n", r"line 2 is 'two'"), ("# nothing\n", "no time stamps"), ("1 2\n", "line 1 is '1 2'")],
)
def test_a_timestamp_file_with_a_mistake_is_named(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(CalibrationError, match=rf"times\.txt: .*{words}"):
        read_timestamps(tmp_path / "times.txt")
    with pytest.raises(CalibrationError, match=r"absent\.txt: time stamps unreadable"):
        read_timestamps(tmp_path / "absent.txt")


def test_times_that_do_not_fit_are_refused() -> None:
    events = event_file(ORIGIN_NS + np.arange(100) * 1_000_000)
    with pytest.raises(CalibrationError, match=r"list: no time falls in the recording .* microseconds"):
        at_times(events, np.array([5, 10]), "list")
    with pytest.raises(CalibrationError, match=r"list: time 3 \(10 ns\) is not after"):
        at_times(events, np.array([5, 10, 10]), "list")


EDGES = Triggers(
    np.array([5, 10, 20, 30, 40, 50, 60, 70]),
    np.array([6, 6, 6, 6, 6, 6, 6, 6]),
    np.array([False, True, False, True, True, False, False, True]),
)


@pytest.mark.parametrize(
    ("edge", "expected"), [("rising", [10, 30, 40, 70]), ("falling", [5, 20, 50, 60]), ("middle", [15, 45])]
)
def test_trigger_edges(edge: str, expected: list[int]) -> None:
    assert trigger_times(EDGES, edge, None, "file").tolist() == expected


def test_triggers_of_several_channels_need_a_choice() -> None:
    both = replace(EDGES, channel=np.array([6, 0, 0, 6, 6, 6, 6, 6]))
    assert trigger_times(both, "middle", 0, "file").tolist() == [15]
    with pytest.raises(CalibrationError, match="channels 0, 6"):
        trigger_times(both, "rising", None, "file")
    with pytest.raises(CalibrationError, match="no external triggers"):
        trigger_times(NO_TRIGGERS, "rising", None, "file")
    with pytest.raises(CalibrationError, match="no rising edges on trigger channel 5"):
        trigger_times(both, "rising", 5, "file")


def test_frames_at_the_triggers_of_a_file(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "events.h5", "w") as file:
        file["t"], file["p"] = np.arange(0, 100_000, 10), np.ones(10_000)
        file["x"], file["y"] = np.zeros(10_000, np.uint16), np.zeros(10_000, np.uint16)
        file["triggers/t"], file["triggers/channel"] = np.arange(5_000, 100_000, 5_000), np.zeros(19, np.int64)
        file["triggers/rising"] = np.arange(19) % 2 == 0
    with EventFile(tmp_path / "events.h5", 4, 4) as events:
        plan = FrameTimes(triggers="middle", time_offset_ms=0.5).plan(events)
        assert isinstance(plan, TimedWindows)
        wanted = plan.ends_ns[plan.wanted]
    assert wanted.tolist() == [8_000_000 + 10_000_000 * number for number in range(9)]


def test_exactly_one_thing_says_when() -> None:
    events = event_file(np.arange(100) * 1_000_000)
    with pytest.raises(CalibrationError, match="found none"):
        FrameTimes().plan(events)
    with pytest.raises(CalibrationError, match="found window_ms and rate_hz"):
        FrameTimes(window_ms=3.0, rate_hz=3.0).plan(events)
    with pytest.raises(CalibrationError, match="rate_hz is -3"):
        FrameTimes(rate_hz=-3.0).plan(events)
