"""Which windows of events become frames: at a rate, at given times, at triggers, by the number of events."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Events
from jaxcal.recording.events import EventFile
from jaxcal.recording.formats.contract import Triggers

_log = logging.getLogger(__name__)

TRIGGER_EDGES = ("rising", "falling", "middle")
BY_SPLINE = "auto"  # as `rate_hz`
_MAX_WINDOWS = 500_000
# Where frames are asked for at given times, a window longer than so many usual ones is divided; and how long windows
# are where one time tells of no usual length.
_LONGEST, _USUAL_NS = 1.5, 50_000_000


class Window(NamedTuple):
    """Events since the end of the window before, whether its image is `wanted`, and the moment that the image shows (as
    a rule the window's end); `t_end_ns` is exclusive.

    Images that are not wanted are computed all the same: the network then sees shorter windows.
    """

    t_end_ns: int
    events: Events
    wanted: bool
    t_shown_ns: int


@runtime_checkable
class WindowPlan(Protocol):
    """Windows [t0, t1) that follow each other without a gap, from the first event or the plan's own start on."""

    def count(self, events: EventFile) -> int:
        """How many windows there will be; about, where only the whole recording could tell."""
        ...

    def windows(self, events: EventFile) -> Iterator[Window]:
        """The windows, read lazily. Each event from the start to the end of the last one is in exactly one of them."""
        ...

    def showing(self, shown_at: float) -> "WindowPlan":
        """The plan for a network whose images show another moment of their windows than the end (1), down to the
        start (0). Plans show the end until they are asked this, once."""
        ...

    def key(self) -> bytes:
        """What identifies the plan, for the events of one recording."""
        ...


@dataclass(frozen=True)
class TimedWindows:
    """Windows that end at known times: `ends_ns` (W,) int64, increasing; `wanted` (W,) bool; the first one begins at
    `start_ns` (None: at the first event). `shown_ns` (W,) the moments that the images show (None: the ends). No window
    is to end behind `last_ns` (None: the last ones may reach beyond the recording)."""

    ends_ns: np.ndarray
    wanted: np.ndarray
    start_ns: int | None = None
    shown_ns: np.ndarray | None = None
    last_ns: int | None = None

    def count(self, events: EventFile) -> int:
        return len(self.ends_ns)

    def windows(self, events: EventFile) -> Iterator[Window]:
        windows = events.windows_ending(self.ends_ns.tolist(), self.start_ns)
        shown = self.ends_ns if self.shown_ns is None else self.shown_ns
        for (t_end_ns, inside), wanted, t_shown_ns in zip(windows, self.wanted.tolist(), shown.tolist(), strict=True):
            yield Window(t_end_ns, inside, wanted, t_shown_ns)

    def showing(self, shown_at: float) -> "TimedWindows":
        """The same images, of the same times, from windows that meet between these: in the middle for 0.5."""
        if shown_at == 1.0:
            return self
        shown = self.ends_ns
        steps = np.diff(shown)
        alone = _USUAL_NS if self.start_ns is None else int(shown[0]) - self.start_ns
        usual = int(steps[-1]) if len(steps) else alone
        ends = shown + np.maximum(1, (1.0 - shown_at) * np.append(steps, usual)).astype(np.int64)
        kept = np.full(len(ends), True) if self.last_ns is None else ends <= self.last_ns
        count = np.flatnonzero(kept & self.wanted)[-1] + 1 if np.any(kept & self.wanted) else len(ends)
        return replace(self, ends_ns=ends[:count], wanted=self.wanted[:count], shown_ns=shown[:count])

    def key(self) -> bytes:
        return f"{self.start_ns}".encode() + self.ends_ns.astype(np.int64).tobytes() + self.wanted.tobytes()


@dataclass(frozen=True)
class CountedWindows:
    """Windows of `number` events each, in `parts` (each of which is a window of its own, the last one wanted), from
    the events of `span_ns` (None: all).

    Events of one time stay together, so a window may hold more; the last one may hold fewer. A window ends 1 ns after
    its last event.
    """

    number: int
    parts: int = 1
    span_ns: tuple[int, int] | None = None
    shown_at: float = 1.0

    @property
    def _part(self) -> int:
        """Events of a part."""
        return -(-self.number // self.parts)

    def count(self, events: EventFile) -> int:
        return max(1, events.rough_count() // self._part)

    def windows(self, events: EventFile) -> Iterator[Window]:
        waiting: Window | None = None  # held back: the last window is wanted, wherever it falls
        start = None
        for index, (end, inside) in enumerate(events.windows_of(self._part, *(self.span_ns or (None, None)))):
            if waiting is not None:
                yield waiting
            start = int(inside.t_ns[0]) if start is None else start
            shown = end - round((1.0 - self.shown_at) * (end - start))
            waiting, start = Window(end, inside, (index + 1) % self.parts == 0, shown), end
        if waiting is not None:
            yield waiting._replace(wanted=True)

    def showing(self, shown_at: float) -> "CountedWindows":
        """The same windows, whose images show another of their moments."""
        return replace(self, shown_at=shown_at)

    def key(self) -> bytes:
        return f"{self.number} events in {self.parts} of {self.span_ns}".encode()


@dataclass(frozen=True)
class FrameTimes:
    """When frames of an event camera are wanted; at most one of the first six says so.

    `window_ms`: windows of this length, ending at whole multiples of it, so that cameras on one clock share their
    times. `rate_hz`: the same by their number per second; 'auto': one for each knot interval of the spline on which
    cameras are calibrated with an IMU, as `calibration.frame_rate_for_spline` tells. `timestamps`: a text file with a
    time in microseconds per line (e2calib's `--timestamps_file`). `triggers`: at the 'rising' or 'falling' edges of the
    event file's external trigger, or in the 'middle' between a rising one and the falling one behind it (mid-exposure,
    where a frame camera signals its exposure); `trigger_channel` where there are several. `stamps_of`: at the frames of
    this camera of the rig. `events_per_window`: whenever so many events have come.

    `time_offset_ms` is added to times that were given (a camera that stamps the start of its exposure: half of that).
    `upsample_rate`: so many windows, of equal length, for each frame, of which the last one's is kept (as e2calib's).
    """

    window_ms: float | None = None
    rate_hz: float | str | None = None
    timestamps: Path | None = None
    triggers: str | None = None
    stamps_of: str | None = None
    events_per_window: int | None = None
    trigger_channel: int | None = None
    time_offset_ms: float = 0.0
    upsample_rate: int = 1

    def chosen(self) -> list[str]:
        """The names of those of the first six that are set."""
        names = ("window_ms", "rate_hz", "timestamps", "triggers", "stamps_of", "events_per_window")
        return [name for name in names if getattr(self, name) is not None]

    def or_windows_of(self, window_ms: float) -> "FrameTimes":
        """The same, with windows of this length where nothing says when frames are wanted."""
        return self if self.chosen() else replace(self, window_ms=window_ms)

    def plan(
        self, events: EventFile, stamps_ns: np.ndarray | None = None, span_ns: tuple[int, int] | None = None
    ) -> WindowPlan:
        """The windows of one recording, or of the part of it that lies in `span_ns` (first, last; None: all).

        `stamps_ns` the times of the frames of the camera `stamps_of`.

        Raises CalibrationError when not exactly one thing says when frames are wanted, or none falls in the recording,
        or when nobody has put a number in the place of 'auto'.
        """
        chosen = self.chosen()
        if len(chosen) != 1:
            raise CalibrationError(
                f"Frame times: give exactly one of window_ms, rate_hz, timestamps, triggers, stamps_of and "
                f"events_per_window; found {' and '.join(chosen) or 'none'}."
            )
        if self.upsample_rate < 1:
            raise CalibrationError(f"Frame times: upsample_rate is {self.upsample_rate}; expected a whole number >= 1.")
        if self.events_per_window is not None:
            if self.events_per_window < 1:
                raise CalibrationError(
                    f"Frame times: events_per_window is {self.events_per_window}; expected 1 or more."
                )
            return CountedWindows(self.events_per_window, self.upsample_rate, span_ns)
        if self.window_ms is not None:
            return periodic(events, round(self.window_ms * 1e6), span_ns=span_ns, upsample_rate=self.upsample_rate)
        if isinstance(self.rate_hz, str):
            raise CalibrationError(
                f"Frame times: rate_hz is '{self.rate_hz}'; without an IMU there is no spline that wants frames. "
                "Give a number of frames per second."
            )
        if self.rate_hz is not None:
            return periodic(events, _period(self.rate_hz), span_ns=span_ns, upsample_rate=self.upsample_rate)
        if self.timestamps is not None:
            times, where = read_timestamps(self.timestamps), f"{self.timestamps}"
        elif self.triggers is not None:
            times = trigger_times(events.triggers(), self.triggers, self.trigger_channel, str(events.path))
            where = f"{events.path}: triggers"
        else:
            assert stamps_ns is not None, "who sets stamps_of gives the stamps"
            times, where = np.asarray(stamps_ns, np.int64), f"the frames of {self.stamps_of}"
        times = times + round(self.time_offset_ms * 1e6)
        return at_times(events, times, where, span_ns=span_ns, upsample_rate=self.upsample_rate)


# --- plans -----------------------------------------------------------------------------------------------------------


def periodic(
    events: EventFile,
    period_ns: int | Fraction,
    *,
    origin_ns: int = 0,
    span_ns: tuple[int, int] | None = None,
    upsample_rate: int = 1,
) -> TimedWindows:
    """Windows that end at whole multiples of a period from `origin_ns` on, none after the last event or the span.

    From 0, the frames of several event cameras are simultaneous, as far as their clocks agree; e2calib counts from the
    first event. Raises CalibrationError when the period is not positive, longer than the recording, or there would be
    endlessly many windows.
    """
    if period_ns <= 0:
        raise CalibrationError(f"{events.path}: windows of {float(period_ns) * 1e-6:g} ms; expected a positive length.")
    start, stop = _span(events, span_ns)
    first, last = (start - origin_ns) // period_ns + 1, (stop - origin_ns) // period_ns
    if (last - first) * upsample_rate > _MAX_WINDOWS:
        raise CalibrationError(
            f"{events.path}: the events span {(stop - start) * 1e-9:.0f} s, which is "
            f"{last - first} windows of {float(period_ns) * 1e-6:g} ms. Are the time stamps in microseconds and free "
            "of jumps?"
        )
    # In exact numbers: nanoseconds since 1970 leave no room for multiplication in 64 bits.
    ends = np.array([origin_ns + int(number * period_ns) for number in range(first, last + 1)], dtype=np.int64)
    ends = ends[(ends > start) & (ends <= stop)]
    if not len(ends):
        raise CalibrationError(
            f"{events.path}: the recording is {(stop - start) * 1e-6:.1f} ms long, shorter than "
            f"one window of {float(period_ns) * 1e-6:g} ms. Record for longer: 20 s and more make a good calibration."
        )
    return replace(_divided(ends, np.full(len(ends), upsample_rate), start, span_ns), last_ns=stop + 1)


def at_times(
    events: EventFile,
    times_ns: np.ndarray,
    where: str,
    *,
    span_ns: tuple[int, int] | None = None,
    upsample_rate: int = 1,
) -> TimedWindows:
    """Windows that end at given times, as far as these lie behind the first event and not behind the last.

    A window much longer than the usual step between the times, such as the one before the first time, is divided, so
    that neither the network nor the memory gets more events at once. `where` says in messages whence the times come.
    Raises CalibrationError when no time falls in the recording, or they do not increase.
    """
    times = np.asarray(times_ns, np.int64)
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if len(backwards):
        place = int(backwards[0]) + 1
        raise CalibrationError(
            f"{where}: time {place + 1} ({times[place]} ns) is not after the one before ({times[place - 1]} ns). Sort "
            "the times, and remove those that occur twice."
        )
    start, stop = _span(events, span_ns)
    ends = times[(times > start) & (times <= stop)]
    if not len(ends):
        span = f"{times[0] * 1e-9:.6f} to {times[-1] * 1e-9:.6f} s" if len(times) else "none at all"
        raise CalibrationError(
            f"{where}: no time falls in the recording {events.path}, which spans {start * 1e-9:.6f} to "
            f"{stop * 1e-9:.6f} s; the times are {span}. Are both on one clock, and the times in the unit "
            "that is expected (text files: microseconds)?"
        )
    if len(ends) < len(times):
        _log.info("%s: %d of %d times lie outside the recording", where, len(times) - len(ends), len(times))
    usual_ns = int(np.median(np.diff(times))) if len(times) > 1 else _USUAL_NS
    lengths = np.diff(ends, prepend=start)
    parts = np.where(lengths > _LONGEST * usual_ns, np.ceil(lengths / usual_ns), 1).astype(np.int64)
    if (parts * upsample_rate).sum() > _MAX_WINDOWS:
        raise CalibrationError(f"{where}: more than {_MAX_WINDOWS} windows would be needed. Are the times right?")
    return _divided(ends, parts * upsample_rate, start, span_ns)


def _span(events: EventFile, span_ns: tuple[int, int] | None) -> tuple[int, int]:
    """First and last time of the part of a recording that is used."""
    first, last = span_ns or (events.first_ns, events.last_ns)
    return max(first, events.first_ns), min(last, events.last_ns)


def _divided(ends_ns: np.ndarray, parts: np.ndarray, first_ns: int, span_ns: tuple[int, int] | None) -> TimedWindows:
    """Each window in so many of equal length, in whole nanoseconds; none of them empty of time."""
    starts = np.concatenate([[first_ns], ends_ns[:-1]])
    window = np.repeat(np.arange(len(ends_ns)), parts)
    number = np.arange(len(window)) - np.repeat(np.cumsum(parts) - parts, parts) + 1
    lengths = (ends_ns - starts)[window]
    all_ends = starts[window] + lengths // parts[window] * number + lengths % parts[window] * number // parts[window]
    wanted = number == parts[window]
    kept = np.diff(all_ends, prepend=first_ns) > 0
    return TimedWindows(all_ends[kept], wanted[kept], None if span_ns is None else first_ns)


def _period(rate_hz: float) -> Fraction:
    if not 0 < rate_hz < 1e6:
        raise CalibrationError(f"Frame times: rate_hz is {rate_hz}; expected a positive number, below a million.")
    return 1_000_000_000 / Fraction(rate_hz).limit_denominator(1_000_000)


# --- times -----------------------------------------------------------------------------------------------------------


def read_timestamps(path: Path) -> np.ndarray:
    """The times in a text file, one in microseconds per line as e2calib takes them, as (T,) int64 nanoseconds.

    Fractions are kept to the nanosecond; empty lines and what follows '#' do not count. Raises CalibrationError when
    the file is missing, empty, or a line is no number.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: time stamps unreadable ({error}); expected a text file.") from error
    times = []
    for number, line in enumerate(lines, start=1):
        text = line.split("#")[0].strip()
        if text:
            try:
                times.append(int(Decimal(text) * 1000))
            except (InvalidOperation, ValueError, OverflowError) as error:
                raise CalibrationError(
                    f"{path}: line {number} is '{text}'; expected one time in microseconds per line."
                ) from error
    if not times:
        raise CalibrationError(f"{path}: there are no time stamps; expected one in microseconds per line.")
    return np.array(times, dtype=np.int64)


def trigger_times(triggers: Triggers, edge: str, channel: int | None, where: str) -> np.ndarray:
    """The times (T,) int64 ns of one kind of trigger edge: 'rising', 'falling', or 'middle' between the two.

    For 'middle', each rising edge that a falling one follows counts; others are left out, which is logged. Raises
    CalibrationError when there are no such edges, or `channel` is None and there are several.
    """
    if edge not in TRIGGER_EDGES:
        raise CalibrationError(f"{where}: triggers '{edge}'; known are {', '.join(TRIGGER_EDGES)}.")
    channels = np.unique(triggers.channel)
    if not len(channels):
        raise CalibrationError(f"{where}: the recording has no external triggers. `jaxcal info` lists what it holds.")
    if channel is None:
        if len(channels) > 1:
            listed = ", ".join(str(number) for number in channels)
            raise CalibrationError(f"{where}: triggers came on channels {listed}. Say which: trigger_channel.")
        channel = int(channels[0])
    chosen = triggers.channel == channel
    times, rising = triggers.t_ns[chosen], triggers.rising[chosen]
    order = np.argsort(times, kind="stable")
    times, rising = times[order], rising[order]
    if edge == "middle":
        starts = np.flatnonzero(rising[:-1] & ~rising[1:])
        if (left := len(times) - 2 * len(starts)) > 0:
            _log.warning("%s: %d trigger edges have no partner and are left out", where, left)
        found = times[starts] + (times[starts + 1] - times[starts]) // 2
    else:
        found = times[rising == (edge == "rising")]
    if not len(found):
        raise CalibrationError(
            f"{where}: no {edge} edges on trigger channel {channel}, but {int(rising.sum())} rising and "
            f"{int((~rising).sum())} falling ones."
        )
    return found
