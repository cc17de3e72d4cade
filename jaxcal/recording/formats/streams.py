"""A reader for recordings that can only be decoded from front to back: blocks, and where decoding may resume."""

import bisect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxcal.recording.formats.contract import NO_TRIGGERS, EventColumns, Triggers, empty, joined_triggers


@dataclass(frozen=True)
class Block:
    """Some events decoded in one go; `resume` is what the decoder needs to go on behind them.

    Events count from 0 in each block: the reader, which knows the blocks before, numbers them.
    """

    events: EventColumns
    resume: Any
    triggers: Triggers = NO_TRIGGERS


# Decodes a recording from its start (None), or from behind a block (that block's `resume`).
Decode = Callable[[Any], Iterator[Block]]


@dataclass
class _Index:
    """Where the blocks with events lie, as far as the file has been read."""

    resumes: list[Any] = field(default_factory=list)  # what decoding starts from, for each block
    starts: list[int] = field(default_factory=list)  # index of each block's first event
    latest_ns: list[int] = field(default_factory=list)  # the latest time up to and in each block
    triggers: list[Triggers] = field(default_factory=list)
    first_ns: int = 0
    last_ns: int = 0
    count: int = 0
    frontier: Any = None  # decoding resumes here to go on with what has not been read
    complete: bool = False

    def add(self, block: Block) -> int:
        """Note the next block, and return the index of its first event."""
        start = self.count
        if len(block.events):
            if not self.count:
                self.first_ns = int(block.events.t_ns[0])
            self.last_ns = int(block.events.t_ns[-1])
            self.resumes.append(self.frontier)
            self.starts.append(start)
            self.latest_ns.append(max(int(block.events.t_ns.max()), self.latest_ns[-1] if self.latest_ns else -(2**62)))
            self.count += len(block.events)
        if len(block.triggers):
            self.triggers.append(block.triggers)
        self.frontier = block.resume
        return start


class StreamReader:
    """An `EventReader` of a format that gives its blocks from front to back.

    What has been decoded is remembered as (time, place) per block, so that a stretch of time is decoded from the block
    that it starts in. `span`, `count` and `triggers` decode what has not been read yet, once.
    """

    def __init__(
        self,
        path: Path,
        format: str,
        sensor: tuple[int, int] | None,
        decode: Decode,
        rough_count: int,
        remarks: Callable[[Any], list[str]] = lambda resume: [],
        close: Callable[[], None] = lambda: None,
    ) -> None:
        """`rough_count`: about how many events there are; `remarks` gets the `resume` of the last block that was read;
        `close` frees what `decode` holds."""
        self.path, self.format, self.sensor = path, format, sensor
        self._decode, self._remarks, self._close = decode, remarks, close
        self._rough_count = rough_count
        self._index = _Index()

    def span(self) -> tuple[int, int]:
        """Time of the first and the last event, in nanoseconds."""
        self._complete()
        return self._index.first_ns, self._index.last_ns

    def count(self) -> int:
        """The number of events."""
        self._complete()
        return self._index.count

    def rough_count(self) -> int:
        """About how many events there are."""
        return max(1, self._index.count if self._index.complete else self._rough_count)

    def triggers(self) -> Triggers:
        """All external triggers."""
        self._complete()
        return joined_triggers(self._index.triggers)

    def remarks(self) -> list[str]:
        """What was odd in the part that has been read."""
        return self._remarks(self._index.frontier)

    def close(self) -> None:
        """Close the file."""
        self._close()

    def read(self, t0_ns: int | None, t1_ns: int | None) -> Iterator[EventColumns]:
        """The blocks from the one in which t0_ns falls to the one in which t1_ns does."""
        for piece in self._blocks(t0_ns):
            yield piece
            if t1_ns is not None and int(piece.t_ns[-1]) >= t1_ns:
                return

    def _complete(self) -> None:
        while not self._index.complete:
            for _ in self._new_blocks():
                pass
        if not self._index.count:
            raise empty(self.path)

    def _blocks(self, t0_ns: int | None) -> Iterator[EventColumns]:
        """Blocks with events from the first one that may hold t0_ns: known ones again, then new ones."""
        index = self._index
        position = 0 if t0_ns is None else bisect.bisect_left(index.latest_ns, t0_ns)
        while True:
            if position < len(index.resumes):
                known = len(index.resumes)
                for block in self._decode(index.resumes[position]):
                    if not len(block.events):
                        continue
                    yield _numbered(block.events, index.starts[position])
                    position += 1
                    if position >= known:
                        break
            elif index.complete:
                if not index.count:
                    raise empty(self.path)
                return
            else:
                for piece in self._new_blocks():
                    position += 1
                    if t0_ns is None or index.latest_ns[position - 1] >= t0_ns:
                        yield piece

    def _new_blocks(self) -> Iterator[EventColumns]:
        """Blocks that nobody has read before, which go into the index; ends where another pass has overtaken it."""
        index = self._index
        expected = index.frontier
        for block in self._decode(expected):
            if index.frontier is not expected:
                return  # somebody else has read on since: the caller looks the blocks up in the index
            start = index.add(block)
            expected = index.frontier
            if len(block.events):
                yield _numbered(block.events, start)
                if index.frontier is not expected:
                    return
        if index.frontier is expected:
            index.complete = True


def _numbered(events: EventColumns, start: int) -> EventColumns:
    return EventColumns(start, events.t_ns, events.x, events.y, events.p)
