"""Event recordings of any format: opened by content, read lazily in windows of time, checked on the way."""

import logging
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Events
from jaxcal.recording.formats import open_reader
from jaxcal.recording.formats.contract import EventColumns, EventReader, Triggers, unsorted
from jaxcal.recording.places import split_place

_log = logging.getLogger(__name__)


class EventFile:
    """An event recording, in any of the formats of `jaxcal.recording.formats`.

    `path` is a file, or `FILE:PLACE` with the topic of a bag or the group of an HDF5 file where there are several. The
    format is found by content. `width`, `height` of the sensor in pixels may be left out where the file tells them, and
    must agree with it where both are given. Nothing but the windows asked for is kept: the memory in use does not
    depend on the recording's length. Every event that is read is checked: in order of time, and on the sensor.

    Times are nanoseconds on the camera's clock (for bags: ROS time). Formats that can only be decoded from front to
    back are read through once when `first_ns`, `last_ns` or `len()` is asked for the first time. Use it as a context
    manager, or call `close()`.

    Raises CalibrationError when the file is missing, damaged, of no known format, or holds no events; while reading,
    when time runs backwards or an event lies outside the sensor.
    """

    def __init__(self, path: str | Path, width: int | None = None, height: int | None = None) -> None:
        self.path, self._place = split_place(path)
        self._reader = open_reader(self.path, self._place)
        try:
            given = None if width is None or height is None else (int(width), int(height))
            self._size = _size(self._reader, given)
            self._span: tuple[int, int] | None = None
        except BaseException:
            self._reader.close()
            raise

    def __len__(self) -> int:
        return self._reader.count()

    def __enter__(self) -> "EventFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; windows cannot be read afterwards."""
        self._reader.close()

    @property
    def format(self) -> str:
        """A short name of the format, for people."""
        return self._reader.format

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the sensor in pixels, given or read from the file; None when neither tells it."""
        return self._size

    @property
    def width(self) -> int:
        """Columns of the sensor."""
        return self._known_size()[0]

    @property
    def height(self) -> int:
        """Rows of the sensor."""
        return self._known_size()[1]

    @property
    def first_ns(self) -> int:
        """Time of the first event."""
        return self.span()[0]

    @property
    def last_ns(self) -> int:
        """Time of the last event."""
        return self.span()[1]

    def span(self) -> tuple[int, int]:
        """Time of the first and the last event, in nanoseconds."""
        if self._span is None:
            self._span = self._reader.span()
        return self._span

    def rough_count(self) -> int:
        """About how many events there are, without reading the file."""
        return self._reader.rough_count()

    def triggers(self) -> Triggers:
        """Edges on the external trigger inputs; none where the format has no triggers."""
        return self._reader.triggers()

    def remarks(self) -> list[str]:
        """What was odd in the part that has been read so far, and how it was handled; sentences for people."""
        return self._reader.remarks()

    def fingerprint(self) -> tuple[str, int, int]:
        """Name, size and time of modification (ns): what changes when the recording does. Opens nothing."""
        files = sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]
        facts = [os.stat(file) for file in files]
        name = self.path.name if self._place is None else f"{self.path.name}:{self._place}"
        return name, sum(fact.st_size for fact in facts), max(fact.st_mtime_ns for fact in facts)

    # --- events ------------------------------------------------------------------------------------------------------

    def columns(self, t0_ns: int | None = None, t1_ns: int | None = None) -> Iterator[EventColumns]:
        """The events with t0_ns <= t < t1_ns in pieces as the file has them, in order of time.

        The sensor's size need not be known; where it is, events are checked to lie on it.
        """
        latest = None
        for piece in self._reader.read(t0_ns, t1_ns):
            _check_order(self.path, piece, latest)
            latest = int(piece.t_ns[-1])
            piece = _between(piece, t0_ns, t1_ns)
            if len(piece):
                yield from self.checked_pixels([piece])

    def unchecked_columns(self) -> Iterator[EventColumns]:
        """All events in pieces as the file has them, in the file's order, whatever that is."""
        return self._reader.read(None, None)

    def checked_pixels(self, pieces: Iterable[EventColumns]) -> Iterator[EventColumns]:
        """The same pieces; raises CalibrationError at an event off the sensor, where its size is known."""
        for piece in pieces:
            if self._size is not None:
                _check_inside(self.path, piece, self._size)
            yield piece

    def chunks(self, t0_ns: int | None = None, t1_ns: int | None = None) -> Iterator[Events]:
        """The events with t0_ns <= t < t1_ns in chunks of bounded size, none of them empty."""
        self._known_size()
        return (self._events([piece]) for piece in self.columns(t0_ns, t1_ns))

    def window(self, t0_ns: int, t1_ns: int) -> Events:
        """The events with t0_ns <= t < t1_ns, in order."""
        self._known_size()
        return self._events(list(self.columns(t0_ns, t1_ns)) if t1_ns > t0_ns else [])

    def windows(self, window_ns: int, start_ns: int | None = None) -> Iterator[tuple[int, Events]]:
        """Consecutive windows of `window_ns` nanoseconds from `start_ns` (default: the first event), as (end, events).

        `end` is exclusive, so each event falls in exactly one window; the last window may end after the last event.
        Windows without events are given too: time passes in them.
        """
        if window_ns <= 0:
            raise CalibrationError(f"{self.path}: windows of {window_ns} ns; expected a positive length.")
        start = self.first_ns if start_ns is None else int(start_ns)
        yield from self.windows_ending(range(start + window_ns, self.last_ns + window_ns + 1, window_ns), start)

    def windows_ending(self, ends_ns: Iterable[int], start_ns: int | None = None) -> Iterator[tuple[int, Events]]:
        """Consecutive windows that end (exclusively) at the given increasing times, as (end, events).

        The first one starts at `start_ns`, by default at the first event. At the end, the reader's remarks are logged
        as warnings.
        """
        self._known_size()
        # From the file's very start where that is meant, so that each event there is passes the check of its order.
        from_start = start_ns is None or start_ns <= self.first_ns
        pieces = self.columns(None if from_start else int(start_ns or 0))
        waiting: list[EventColumns] = []  # events read, but behind the windows so far
        end = None
        for end in ends_ns:
            while not waiting or int(waiting[-1].t_ns[-1]) < end:
                piece = next(pieces, None)
                if piece is None:
                    break
                waiting.append(piece)
            inside, waiting = _cut(waiting, int(end))
            yield int(end), self._events(inside)
        if end is not None and end > self.last_ns:  # then there is nothing left, if time is in order
            left = waiting[0] if waiting else next(pieces, None)
            if left is not None:
                raise unsorted(self.path, left.start)
        for remark in self.remarks():
            _log.warning("%s: %s", self.path, remark)

    def windows_of(
        self, number: int, t0_ns: int | None = None, t1_ns: int | None = None
    ) -> Iterator[tuple[int, Events]]:
        """Consecutive windows of `number` events each of t0_ns <= t < t1_ns, as (end, events); the last one has what is
        left.

        Events of one time stay together, so that a window may hold more. A window ends (exclusively) 1 ns after its
        last event. At the end, the reader's remarks are logged as warnings.
        """
        if number < 1:
            raise CalibrationError(f"{self.path}: windows of {number} events; expected at least one.")
        self._known_size()
        waiting: list[EventColumns] = []
        for piece in self.columns(t0_ns, t1_ns):
            waiting.append(piece)
            # A window is complete when an event that is later than its last one has been read.
            while (last := _time_of(waiting, number - 1)) is not None and last < int(piece.t_ns[-1]):
                inside, waiting = _cut(waiting, last + 1)
                yield last + 1, self._events(inside)
        if waiting:
            yield int(waiting[-1].t_ns[-1]) + 1, self._events(waiting)
        for remark in self.remarks():
            _log.warning("%s: %s", self.path, remark)

    def _events(self, pieces: list[EventColumns]) -> Events:
        width, height = self._known_size()
        if not pieces:
            nothing = np.empty(0, np.uint16)
            return Events(np.empty(0, np.int64), nothing, nothing, np.empty(0, bool), width, height)
        t_ns, x, y, p = (
            np.concatenate([getattr(piece, name) for piece in pieces]) if len(pieces) > 1 else getattr(pieces[0], name)
            for name in ("t_ns", "x", "y", "p")
        )
        return Events(t_ns, x.astype(np.uint16, copy=False), y.astype(np.uint16, copy=False), p, width, height)

    def _known_size(self) -> tuple[int, int]:
        if self._size is None:
            raise CalibrationError(
                f"{self.path}: the file ({self.format}) does not tell the sensor's size. Give the resolution: width "
                "and height in pixels."
            )
        return self._size


def _size(reader: EventReader, given: tuple[int, int] | None) -> tuple[int, int] | None:
    told = reader.sensor
    if given is not None and told is not None and given != told:
        raise CalibrationError(
            f"{reader.path}: the file says that the sensor has {told[0]}x{told[1]} pixels, but {given[0]}x{given[1]} "
            "was given. Correct the resolution, or leave it out."
        )
    return given or told


def _check_order(path: Path, piece: EventColumns, latest: int | None) -> None:
    if latest is not None and len(piece) and int(piece.t_ns[0]) < latest:
        raise unsorted(path, piece.start)
    backwards = piece.t_ns[1:] < piece.t_ns[:-1]
    if backwards.any():
        raise unsorted(path, piece.start + int(np.argmax(backwards)) + 1)


def _check_inside(path: Path, piece: EventColumns, size: tuple[int, int]) -> None:
    width, height = size
    if _all_within(piece.x, width) and _all_within(piece.y, height):
        return
    place = int(np.argmax((piece.x < 0) | (piece.x >= width) | (piece.y < 0) | (piece.y >= height)))
    raise CalibrationError(
        f"{path}: event {piece.start + place} at (x, y) = ({piece.x[place]}, {piece.y[place]}) lies outside the "
        f"{width}x{height} sensor. Check the resolution given for this camera."
    )


def _all_within(values: np.ndarray, end: int) -> bool:
    """Whether all are from 0 to `end`, which does not count; by extremes, which is quicker than by each."""
    return not len(values) or bool(values.max() < end and (values.dtype.kind == "u" or values.min() >= 0))


def _between(piece: EventColumns, t0_ns: int | None, t1_ns: int | None) -> EventColumns:
    low = 0 if t0_ns is None else int(np.searchsorted(piece.t_ns, t0_ns, side="left"))
    high = len(piece) if t1_ns is None else int(np.searchsorted(piece.t_ns, t1_ns, side="left"))
    return piece if (low, high) == (0, len(piece)) else piece.part(low, max(low, high))


def _time_of(pieces: list[EventColumns], index: int) -> int | None:
    """The time of the event of that index in all pieces together; None behind their end."""
    for piece in pieces:
        if index < len(piece):
            return int(piece.t_ns[index])
        index -= len(piece)
    return None


def _cut(pieces: list[EventColumns], end_ns: int) -> tuple[list[EventColumns], list[EventColumns]]:
    """Pieces in order of time, parted into what lies before a time and what does not."""
    before, after = [], []
    for piece in pieces:
        place = int(np.searchsorted(piece.t_ns, end_ns, side="left"))
        before += [piece.part(0, place)] if place else []
        after += [piece.part(place, len(piece))] if place < len(piece) else []
    return before, after
