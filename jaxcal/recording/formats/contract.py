"""What every event format gives: columns of events, triggers, and a reader that finds them by time."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from jaxcal.errors import CalibrationError


@dataclass(frozen=True)
class EventColumns:
    """Some consecutive events as the file has them, not yet checked.

    `start` index of the first one in the file; `t_ns` (N,) int64 nanoseconds; `x`, `y` (N,) of any integer type; `p`
    (N,) bool.
    """

    start: int
    t_ns: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray

    def __len__(self) -> int:
        return len(self.t_ns)

    def part(self, low: int, high: int) -> "EventColumns":
        """Events `low` to `high` (exclusive) of these."""
        return EventColumns(self.start + low, self.t_ns[low:high], self.x[low:high], self.y[low:high], self.p[low:high])


@dataclass(frozen=True)
class Triggers:
    """Edges on a sensor's external trigger inputs.

    `t_ns` (N,) int64 nanoseconds on the event camera's clock; `channel` (N,) int64; `rising` (N,) bool.
    """

    t_ns: np.ndarray
    channel: np.ndarray
    rising: np.ndarray

    def __len__(self) -> int:
        return len(self.t_ns)


NO_TRIGGERS = Triggers(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, bool))


def joined_triggers(parts: Sequence[Triggers]) -> Triggers:
    """All triggers of several stretches, in their order."""
    if not parts:
        return NO_TRIGGERS
    return Triggers(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "channel", "rising"))
    )


@runtime_checkable
class EventReader(Protocol):
    """One open recording in one format.

    `path` of the file, or of the folder of a ROS 2 bag; `format` a short name for people; `sensor` (width, height) in
    pixels where the file tells it, else None.
    """

    path: Path
    format: str
    sensor: tuple[int, int] | None

    def span(self) -> tuple[int, int]:
        """Time of the first and the last event, in nanoseconds. May read the whole file once."""
        ...

    def count(self) -> int:
        """The number of events. May read the whole file once."""
        ...

    def rough_count(self) -> int:
        """About how many events there are, without reading the file; at least 1."""
        ...

    def read(self, t0_ns: int | None, t1_ns: int | None) -> Iterator[EventColumns]:
        """The events from t0_ns (None: from the start) to t1_ns (None: to the end), in pieces of bounded size.

        All events of [t0_ns, t1_ns) are among them, in the file's order, none twice. There may be others around them.
        """
        ...

    def triggers(self) -> Triggers:
        """All external triggers. May read the whole file once."""
        ...

    def remarks(self) -> list[str]:
        """What was odd in the part of the file that has been read so far, and how it was handled; for people."""
        ...

    def close(self) -> None:
        """Close the file; nothing can be read afterwards."""
        ...


# Opens a recording: (path, topic or group inside the file, or None to take the only one there is).
OpenReader = Callable[[Path, str | None], EventReader]


def no_topic(path: Path, topic: str | None, kind: str) -> None:
    """Raise CalibrationError where a place inside the file is named, and files of this kind have no inside."""
    if topic is not None:
        raise CalibrationError(f"{path}: '{topic}' names a place inside, but {kind} has none. Leave out ':{topic}'.")


def empty(path: Path) -> CalibrationError:
    """The error for a recording without events."""
    return CalibrationError(f"{path}: there are no events in the file. Was the camera connected while recording?")


def unsorted(path: Path, place: int) -> CalibrationError:
    """The error for events that are not in order of time."""
    return CalibrationError(
        f"{path}: time runs backwards near event {place}. Events must be sorted by time: sort the recording (`jaxcal "
        "convert events IN OUT.h5 --sort 100` mends what is late by up to 100 ms), or convert it again."
    )


@dataclass(frozen=True)
class EventFormat:
    """One format: `name` for people; `suffixes` it usually has; `recognises(path, head)` says by the first bytes of a
    file (or by a folder's content, where `head` is empty) whether it is one; `open` opens it."""

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[Path, bytes], bool]
    open: OpenReader
