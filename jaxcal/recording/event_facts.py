"""What an event recording is like: rate, span, polarity, hot pixels, gaps, triggers, and what is wrong with it."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from jaxcal.progress import Progress, no_progress
from jaxcal.recording.events import EventFile
from jaxcal.recording.formats.contract import EventColumns

_PEAK_WINDOW_NS = 10_000_000
# A pixel is hot when it fires so many times as often as the middle one of the 5x5 pixels around it, and as the mean of
# all pixels; edges that sweep over the sensor leave neighbours alike.
_HOT_TO_NEIGHBOURS, _HOT_TO_MEAN, _HOT_COUNT = 10, 5, 50
_GAPS_LISTED = 10


@dataclass(frozen=True)
class HotPixel:
    """A pixel that fires far more often than those around it, `count` times in the recording."""

    x: int
    y: int
    count: int


@dataclass(frozen=True)
class Gap:
    """No events for `length_s` seconds, from `start_s` seconds after the first event on."""

    start_s: float
    length_s: float


@dataclass(frozen=True)
class EventFacts:
    """Facts about an event recording.

    `sensor` (width, height) where it is known; `reach` (largest x, largest y) of all events; `span_s` from the first to
    the last event; `mean_rate`, `peak_rate` (over 10 ms) in events/s; `on_share` of the events, 0 to 1; `hot_pixels`,
    most active first; `gaps`, longest first, at most ten of `gap_count`; `triggers` number of (rising, falling) edges
    by channel; `backwards` how often time runs backwards, `largest_backwards_s` by how much at most; `outside` events
    that lie off the sensor; `repeated` events of the same time and pixel as the one before; `remarks` of the reader.
    """

    path: Path
    format: str
    file_bytes: int
    sensor: tuple[int, int] | None
    reach: tuple[int, int]
    count: int
    first_ns: int
    last_ns: int
    span_s: float
    mean_rate: float
    peak_rate: float
    on_share: float
    hot_pixels: tuple[HotPixel, ...]
    gaps: tuple[Gap, ...]
    gap_count: int
    triggers: dict[int, tuple[int, int]]
    backwards: int
    largest_backwards_s: float
    outside: int
    repeated: int
    remarks: tuple[str, ...]


@dataclass
class _Tally:
    """What is counted while the events pass by."""

    count: int = 0
    on: int = 0
    first_ns: int = 0
    earliest_ns: int = 0
    latest_ns: int = 0
    last: EventColumns | None = None  # the last event alone
    activity: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.int64))  # (height, width)
    outside: int = 0
    backwards: int = 0
    largest_backwards_ns: int = 0
    repeated: int = 0
    gaps: list[tuple[int, int]] = field(default_factory=list)  # (length, start)
    gap_count: int = 0
    window: int | None = None  # the window of the peak rate that is being counted
    window_count: int = 0
    peak_count: int = 0


def event_facts(events: EventFile, gap_s: float = 0.05, progress: Progress = no_progress) -> EventFacts:
    """Read a whole recording once, in bounded memory, and say what it is like.

    `gap_s`: how long nothing must happen to be listed as a gap. Disorder is counted, not an error.
    """
    tally = _Tally()
    stage, rough = f"read {events.path.name}", events.rough_count()
    progress(stage, 0, rough)
    for piece in events.unchecked_columns():
        _count(tally, piece, events.size, round(gap_s * 1e9))
        progress(stage, tally.count, max(rough, tally.count))
    progress(stage, tally.count, tally.count)
    return _facts(events, tally)


def find_hot_pixels(events: EventFile, progress: Progress = no_progress) -> tuple[HotPixel, ...]:
    """The pixels that fire far more often than those around them, most active first; reads the recording once."""
    tally = _Tally()
    stage, rough = f"hot pixels {events.path.name}", events.rough_count()
    progress(stage, 0, rough)
    done = 0
    for piece in events.columns():
        _count_pixels(tally, piece, events.size)
        done += len(piece)
        progress(stage, done, max(rough, done))
    progress(stage, done, done)
    return _hot_pixels(tally.activity)


def _count(tally: _Tally, piece: EventColumns, size: tuple[int, int] | None, gap_ns: int) -> None:
    if tally.last is None:
        tally.first_ns = tally.earliest_ns = tally.latest_ns = int(piece.t_ns[0])
        joined = piece
    else:
        joined = EventColumns(
            0, *(np.concatenate([getattr(tally.last, n), getattr(piece, n)]) for n in ("t_ns", "x", "y", "p"))
        )
    steps = np.diff(joined.t_ns)
    tally.backwards += int(np.count_nonzero(steps < 0))
    tally.largest_backwards_ns = max(tally.largest_backwards_ns, -int(steps.min(initial=0)))
    same = (steps == 0) & (joined.x[1:] == joined.x[:-1]) & (joined.y[1:] == joined.y[:-1])
    tally.repeated += int(np.count_nonzero(same))
    for place in np.flatnonzero(steps >= gap_ns):
        tally.gaps.append((int(steps[place]), int(joined.t_ns[place])))
        tally.gap_count += 1
    tally.gaps = sorted(tally.gaps, reverse=True)[:_GAPS_LISTED]
    tally.count += len(piece)
    tally.on += int(np.count_nonzero(piece.p))
    tally.earliest_ns = min(tally.earliest_ns, int(piece.t_ns.min()))
    tally.latest_ns = max(tally.latest_ns, int(piece.t_ns.max()))
    tally.last = joined.part(len(joined) - 1, len(joined))
    _count_pixels(tally, piece, size)
    _count_peak(tally, piece.t_ns)


def _count_pixels(tally: _Tally, piece: EventColumns, size: tuple[int, int] | None) -> None:
    x, y = piece.x.astype(np.int64), piece.y.astype(np.int64)
    good = (x >= 0) & (y >= 0)
    if size is not None:
        good &= (x < size[0]) & (y < size[1])
    tally.outside += len(good) - int(np.count_nonzero(good))
    x, y = x[good], y[good]
    if not len(x):
        return
    height, width = tally.activity.shape
    height, width = max(height, int(y.max()) + 1), max(width, int(x.max()) + 1)
    if (height, width) != tally.activity.shape:
        grown = np.zeros((height, width), np.int64)
        grown[: tally.activity.shape[0], : tally.activity.shape[1]] = tally.activity
        tally.activity = grown
    tally.activity += np.bincount(y * width + x, minlength=height * width).reshape(height, width)


def _count_peak(tally: _Tally, t_ns: np.ndarray) -> None:
    windows = t_ns // _PEAK_WINDOW_NS
    starts = np.flatnonzero(np.diff(windows, prepend=windows[0] - 1))
    for window, count in zip(windows[starts], np.diff(starts, append=len(windows)), strict=True):
        tally.window_count = int(count) + (tally.window_count if window == tally.window else 0)
        tally.window = int(window)
        tally.peak_count = max(tally.peak_count, tally.window_count)


def _facts(events: EventFile, tally: _Tally) -> EventFacts:
    span_s = (tally.latest_ns - tally.earliest_ns) * 1e-9
    mean_rate = tally.count / span_s if span_s else 0.0
    edges = events.triggers()
    channels = {int(channel): edges.rising[edges.channel == channel] for channel in np.unique(edges.channel)}
    reach = tuple(int(np.flatnonzero(tally.activity.any(axis=axis))[-1]) for axis in (0, 1)) if tally.count else (0, 0)
    return EventFacts(
        path=events.path,
        format=events.format,
        file_bytes=events.fingerprint()[1],
        sensor=events.size,
        reach=(reach[0], reach[1]),
        count=tally.count,
        first_ns=tally.earliest_ns,
        last_ns=tally.latest_ns,
        span_s=span_s,
        mean_rate=mean_rate,
        peak_rate=max(mean_rate, tally.peak_count / (_PEAK_WINDOW_NS * 1e-9)),
        on_share=tally.on / tally.count if tally.count else 0.0,
        hot_pixels=_hot_pixels(tally.activity),
        gaps=tuple(Gap((start - tally.first_ns) * 1e-9, length * 1e-9) for length, start in tally.gaps),
        gap_count=tally.gap_count,
        triggers={name: (int(rising.sum()), int((~rising).sum())) for name, rising in channels.items()},
        backwards=tally.backwards,
        largest_backwards_s=tally.largest_backwards_ns * 1e-9,
        outside=tally.outside,
        repeated=tally.repeated,
        remarks=tuple(events.remarks()),
    )


def _hot_pixels(activity: np.ndarray) -> tuple[HotPixel, ...]:
    if not activity.size:
        return ()
    from scipy.ndimage import median_filter  # takes long to import, and few need it

    around = median_filter(activity, size=5, mode="reflect")
    hot = (activity >= _HOT_COUNT) & (activity > _HOT_TO_NEIGHBOURS * around)
    hot &= activity > _HOT_TO_MEAN * activity.mean()
    found = [HotPixel(int(x), int(y), int(activity[y, x])) for y, x in np.argwhere(hot)]
    return tuple(sorted(found, key=lambda pixel: -pixel.count))
