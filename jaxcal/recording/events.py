"""Event recordings in e2calib's HDF5 layout, read lazily in windows of time."""

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import h5py
import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Events

_DATASETS = ("x", "y", "p", "t")
_NS_PER_US = 1000
# Events per block of the search index. A block is what one look-up reads, 0.5 MB of time stamps.
_BLOCK = 65_536


class EventFile:
    """An event recording: an HDF5 file with the datasets x, y, p and t (whole microseconds) at its root.

    The layout is that of e2calib (Muglikar et al. 2021, "How to calibrate your event camera"). Nothing but the
    windows asked for is read: the memory in use does not depend on the recording's length. Time is sorted within a
    valid file; every window that is read is checked, so that reading all windows checks the whole file.

    `path` of the file; `width`, `height` of the sensor in pixels; `first_ns`, `last_ns` time of the first and last
    event in nanoseconds, on the camera's clock. `len()` is the number of events. Use it as a context manager, or call
    `close()`.

    Raises CalibrationError when the file is missing, truncated, lacks a dataset, or holds no events; while reading,
    when time runs backwards or an event lies outside the sensor.
    """

    def __init__(self, path: str | Path, width: int, height: int) -> None:
        self.path = Path(path)
        self.width, self.height = int(width), int(height)
        self._file = _open(self.path)
        try:
            self._x, self._y, self._p, self._t = _datasets(self._file, self.path)
            self._length = len(self._t)
            self._block_starts: dict[int, int] = {}
            self.first_ns = int(self._read(self._t, 0, 1)[0]) * _NS_PER_US
            self.last_ns = int(self._read(self._t, self._length - 1, self._length)[0]) * _NS_PER_US
            if self.last_ns < self.first_ns:
                raise self._unsorted(self._length - 1)
        except BaseException:
            self._file.close()
            raise

    def __len__(self) -> int:
        return self._length

    def __enter__(self) -> "EventFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; windows cannot be read afterwards."""
        self._file.close()

    def window(self, t0_ns: int, t1_ns: int) -> Events:
        """The events with t0_ns <= t < t1_ns, in order."""
        return self._slice(self._first_at_or_after(t0_ns), self._first_at_or_after(t1_ns), t0_ns, t1_ns)

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

        The first one starts at `start_ns`, by default at the first event.
        """
        start = self.first_ns if start_ns is None else int(start_ns)
        low = 0 if start_ns is None or start <= self.first_ns else self._first_at_or_after(start)
        for end in ends_ns:
            high = max(low, self._first_at_or_after(end))
            yield end, self._slice(low, high, start, end)
            start, low = end, high
        if start > self.last_ns and low != self._length:
            raise self._unsorted(low)

    def _slice(self, low: int, high: int, t0_ns: int, t1_ns: int) -> Events:
        if high <= low:
            empty = np.empty(0, np.uint16)
            return Events(np.empty(0, np.int64), empty, empty, np.empty(0, bool), self.width, self.height)
        t_ns = self._read(self._t, low, high).astype(np.int64) * _NS_PER_US
        self._check_time(t_ns, low, t0_ns, t1_ns)
        x, y = self._read(self._x, low, high), self._read(self._y, low, high)
        outside = (x < 0) | (x >= self.width) | (y < 0) | (y >= self.height)
        if outside.any():
            place = int(np.argmax(outside))
            raise CalibrationError(
                f"{self.path}: event {low + place} at (x, y) = ({x[place]}, {y[place]}) lies outside the "
                f"{self.width}x{self.height} sensor. Check the resolution given for this camera."
            )
        p = self._read(self._p, low, high) > 0  # 0/1, -1/1 and bool are all in use
        return Events(t_ns, x.astype(np.uint16), y.astype(np.uint16), p, self.width, self.height)

    def _check_time(self, t_ns: np.ndarray, low: int, t0_ns: int, t1_ns: int) -> None:
        backwards = np.flatnonzero(np.diff(t_ns) < 0)
        outside = np.flatnonzero((t_ns < t0_ns) | (t_ns >= t1_ns))
        if len(backwards) or len(outside):
            place = low + int(backwards[0] + 1 if len(backwards) else outside[0])
            raise self._unsorted(place)

    def _unsorted(self, place: int) -> CalibrationError:
        return CalibrationError(
            f"{self.path}: time runs backwards near event {place}. Events must be sorted by time: sort the recording, "
            "or convert it again."
        )

    # --- search over blocks, so that finding a time reads a handful of them ------------------------------------------

    def _first_at_or_after(self, t_ns: int) -> int:
        """Index of the first event at or after a time; the number of events when there is none."""
        t_us = -(-int(t_ns) // _NS_PER_US)
        low, high = 0, -(-self._length // _BLOCK)
        while low < high:  # the first block that starts at or after t_us
            middle = (low + high) // 2
            if self._block_start(middle) < t_us:
                low = middle + 1
            else:
                high = middle
        if low == 0:
            return 0
        start = (low - 1) * _BLOCK
        block = self._read(self._t, start, min(start + _BLOCK, self._length)).astype(np.int64)
        return start + int(np.searchsorted(block, t_us, side="left"))

    def _block_start(self, block: int) -> int:
        if block not in self._block_starts:
            start = block * _BLOCK
            self._block_starts[block] = int(self._read(self._t, start, start + 1)[0])
        return self._block_starts[block]

    def _read(self, dataset: h5py.Dataset, low: int, high: int) -> np.ndarray:
        with _damage_named(self.path):
            return np.asarray(dataset[low:high])


@contextlib.contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """h5py reports a damaged file by OSError, RuntimeError or KeyError, depending on the place."""
    try:
        yield
    except (OSError, RuntimeError, KeyError) as error:
        raise CalibrationError(
            f"{path}: the HDF5 file cannot be read ({error}). It is truncated, damaged or no HDF5 file: copy or "
            "convert the recording again."
        ) from error


def _open(path: Path) -> h5py.File:
    if not path.is_file():
        raise CalibrationError(f"{path}: no such event file. Expected an HDF5 file with the datasets x, y, p and t.")
    with _damage_named(path):
        return h5py.File(path, "r")


def _datasets(file: h5py.File, path: Path) -> list[h5py.Dataset]:
    with _damage_named(path):
        found = {name: file[name] for name in _DATASETS if name in file}
        content = ", ".join(file) or "nothing"
    datasets = {name: item for name, item in found.items() if isinstance(item, h5py.Dataset)}
    for name in _DATASETS:
        if name not in datasets:
            raise CalibrationError(
                f"{path}: dataset '{name}' is missing; the file holds {content}. Expected e2calib's layout: x, y, p "
                "and t (whole microseconds) at the root."
            )
    shapes = {name: dataset.shape for name, dataset in datasets.items()}
    if len(set(shapes.values())) != 1 or len(shapes["t"]) != 1:
        raise CalibrationError(
            f"{path}: x, y, p and t must have one entry per event; their shapes are "
            f"{', '.join(f'{name} {shape}' for name, shape in shapes.items())}. Convert the recording again."
        )
    if shapes["t"][0] == 0:
        raise CalibrationError(f"{path}: there are no events in the file. Was the camera connected while recording?")
    if datasets["t"].dtype.kind not in "iu":
        raise CalibrationError(
            f"{path}: dataset 't' has type {datasets['t'].dtype}; expected whole microseconds (int64). Float seconds "
            "lose precision: multiply by 1e6, round, and write again."
        )
    return [datasets[name] for name in _DATASETS]
