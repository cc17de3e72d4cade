"""A reader for recordings whose events can be read by index: windows by search, in a handful of reads."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxcal.recording.formats.contract import NO_TRIGGERS, EventColumns, Triggers, empty, unsorted

_log = logging.getLogger(__name__)

# Events per block of the search index. A block is what one look-up reads, 0.5 MB of time stamps.
BLOCK = 65_536
# Events per piece that is read at a time: some 10 MB.
PIECE = 1_000_000


@dataclass(frozen=True)
class Columns:
    """Access to the columns of a recording by index.

    `length` number of events; `times(low, high)` gives int64 nanoseconds; `rest(low, high)` gives x, y and p (bool) as
    the file has them; `bracket(t_ns)` gives two indices between which the first event at or after t_ns lies (both
    inclusive), from an index that the file holds, or the whole range.
    """

    length: int
    times: Callable[[int, int], np.ndarray]
    rest: Callable[[int, int], tuple[np.ndarray, np.ndarray, np.ndarray]]
    bracket: Callable[[int], tuple[int, int]] | None = None


class ColumnReader:
    """An `EventReader` of columns in order of time."""

    def __init__(
        self,
        path: Path,
        format: str,
        sensor: tuple[int, int] | None,
        columns: Columns,
        close: Callable[[], None],
        triggers: Callable[[], Triggers] = lambda: NO_TRIGGERS,
    ) -> None:
        self.path, self.format, self.sensor = path, format, sensor
        self._columns, self._close, self._triggers = columns, close, triggers
        self._block_starts: dict[int, int] = {}
        if not columns.length:
            raise empty(path)

    def span(self) -> tuple[int, int]:
        """Time of the first and the last event, in nanoseconds."""
        last = self._columns.length - 1
        first_ns, last_ns = self._time(0), self._time(last)
        if last_ns < first_ns:
            raise unsorted(self.path, last)
        return first_ns, last_ns

    def count(self) -> int:
        """The number of events."""
        return self._columns.length

    def rough_count(self) -> int:
        """The number of events."""
        return self._columns.length

    def triggers(self) -> Triggers:
        """All external triggers."""
        return self._triggers()

    def remarks(self) -> list[str]:
        """Nothing: what is odd in columns is an error."""
        return []

    def close(self) -> None:
        """Close the file."""
        self._close()

    def read(self, t0_ns: int | None, t1_ns: int | None) -> Iterator[EventColumns]:
        """The events of [t0_ns, t1_ns) and no others, found by search."""
        low = 0 if t0_ns is None else self._first_at_or_after(t0_ns)
        high = self._columns.length if t1_ns is None else self._first_at_or_after(t1_ns)
        for start in range(low, high, PIECE):
            stop = min(start + PIECE, high)
            t_ns = self._columns.times(start, stop)
            early = t_ns < t0_ns if t0_ns is not None else np.zeros(len(t_ns), bool)
            late = t_ns >= t1_ns if t1_ns is not None else np.zeros(len(t_ns), bool)
            if early.any() or late.any():  # the search was led astray
                raise unsorted(self.path, start + int(np.argmax(early | late)))
            yield EventColumns(start, t_ns, *self._columns.rest(start, stop))

    def _time(self, index: int) -> int:
        return int(self._columns.times(index, index + 1)[0])

    # --- search over blocks, so that finding a time reads a handful of them ------------------------------------------

    def _first_at_or_after(self, t_ns: int) -> int:
        """Index of the first event at or after a time; the number of events when there is none."""
        length = self._columns.length
        if self._columns.bracket is not None:
            place = self._search(t_ns, *self._columns.bracket(t_ns))
            before = place == 0 or self._time(place - 1) < t_ns
            if before and (place == length or self._time(place) >= t_ns):
                return place
            _log.warning("%s: the file's table of milliseconds is wrong near %d ns; searched without", self.path, t_ns)
        return self._search(t_ns, 0, length)

    def _search(self, t_ns: int, first: int, last: int) -> int:
        """The same, where the result is known to be `first`, `last` or between them."""
        length = self._columns.length
        low, high = first // BLOCK, -(-last // BLOCK)
        while low < high:  # the first block that starts at or after t_ns
            middle = (low + high) // 2
            if self._block_start(middle) < t_ns:
                low = middle + 1
            else:
                high = middle
        if low == 0:
            return 0
        start = (low - 1) * BLOCK
        block = self._columns.times(start, min(start + BLOCK, length))
        return start + int(np.searchsorted(block, t_ns, side="left"))

    def _block_start(self, block: int) -> int:
        if block not in self._block_starts:
            self._block_starts[block] = self._time(block * BLOCK)
        return self._block_starts[block]
