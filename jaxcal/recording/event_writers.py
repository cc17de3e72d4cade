"""Event recordings written as a stream: e2calib's HDF5, npz, text."""

import contextlib
import functools
import os
import shutil
import tempfile
import uuid
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import h5py
import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.progress import Progress, no_progress
from jaxcal.recording.events import EventFile
from jaxcal.recording.formats.contract import EventColumns, Triggers

_NS_PER_US = 1000
_DTYPES = {"x": np.dtype(np.uint16), "y": np.dtype(np.uint16), "p": np.dtype(np.uint8), "t": np.dtype(np.int64)}
# Events per chunk of HDF5, and how many are written at a time at least: a chunk that is added to is written again.
_CHUNK, _AT_A_TIME = 1 << 16, 1 << 20


def write_events(
    path: Path,
    pieces: Iterable[EventColumns],
    sensor: tuple[int, int] | None = None,
    triggers: Callable[[], Triggers] | None = None,
) -> int:
    """Write events to `path` in the format that its suffix says, and return their number; memory stays bounded.

    .h5: x, y (uint16), p (uint8, 0 or 1) and t (int64 microseconds) at the root, as e2calib reads it; the sensor's size
    as attributes width and height, external triggers in the group `triggers` (t, channel, rising). .npz: the same
    arrays, and width and height. .txt: lines 't x y p' with t in whole microseconds; .csv: the same with commas. Times
    are cut to microseconds. `triggers` is called when all pieces have been read.

    The file appears when it is complete. Raises CalibrationError when the suffix is none of these, or the folder cannot
    be written.
    """
    writers = {
        ".h5": _write_hdf5,
        ".hdf5": _write_hdf5,
        ".npz": _write_npz,
        ".txt": functools.partial(_write_text, first_line="# t_us x y p", separator=" "),
        ".csv": functools.partial(_write_text, first_line="t_us,x,y,p", separator=","),
    }
    if path.suffix.lower() not in writers:
        raise CalibrationError(f"{path}: events are written as {', '.join(writers)}; name the file so.")
    with _part(path) as part:
        return writers[path.suffix.lower()](part, pieces, sensor, triggers)


def convert_events(
    recording: EventFile, out: Path, *, most_late_ns: int | None = None, progress: Progress = no_progress
) -> int:
    """Write a recording to `out` (see `write_events`), and return the number of events.

    `most_late_ns`: sort events that come up to so much too late; None: events out of order are an error. Raises
    CalibrationError also when an event lies off the sensor, where its size is known.
    """
    if most_late_ns is None:
        pieces = recording.columns()
    else:
        pieces = recording.checked_pixels(in_order(recording.unchecked_columns(), recording.path, most_late_ns))
    stage, rough = f"convert {recording.path.name}", recording.rough_count()

    def reported() -> Iterator[EventColumns]:
        done = 0
        progress(stage, 0, rough)
        for piece in pieces:
            yield piece
            done += len(piece)
            progress(stage, done, max(rough, done))
        progress(stage, done, done)

    return write_events(out, reported(), recording.size, recording.triggers)


def in_order(pieces: Iterable[EventColumns], path: Path, most_late_ns: int) -> Iterator[EventColumns]:
    """The same events sorted by time, where none comes more than `most_late_ns` after one that is later than it.

    Events of one time keep their order. Only so much of the recording is held as the lateness spans. Raises
    CalibrationError when an event is later than that.
    """
    waiting: list[EventColumns] = []
    written_ns, count = None, 0
    for piece in pieces:
        earliest = int(piece.t_ns.min())
        if written_ns is not None and earliest < written_ns:
            late_ms = (max(int(part.t_ns.max()) for part in [*waiting, piece]) - earliest) * 1e-6
            raise CalibrationError(
                f"{path}: near event {piece.start} time runs backwards by {late_ms:.3f} ms, more than --sort "
                f"{most_late_ns * 1e-6:g} allows. Give a larger value."
            )
        waiting.append(piece)
        newest = max(int(part.t_ns.max()) for part in waiting)
        ready, rest = _split_sorted(waiting, newest - most_late_ns)
        waiting = [rest] if len(rest) else []
        if len(ready):
            yield EventColumns(count, ready.t_ns, ready.x, ready.y, ready.p)
            written_ns, count = int(ready.t_ns[-1]), count + len(ready)
    if waiting:
        ready, _ = _split_sorted(waiting, 2**62)
        yield EventColumns(count, ready.t_ns, ready.x, ready.y, ready.p)


def _split_sorted(parts: list[EventColumns], until_ns: int) -> tuple[EventColumns, EventColumns]:
    whole = _joined(parts)
    order = np.argsort(whole.t_ns, kind="stable")
    merged = EventColumns(0, whole.t_ns[order], whole.x[order], whole.y[order], whole.p[order])
    place = int(np.searchsorted(merged.t_ns, until_ns, side="right"))
    return merged.part(0, place), merged.part(place, len(merged))


def _large(pieces: Iterable[EventColumns]) -> Iterator[EventColumns]:
    """The same events in pieces of `_AT_A_TIME` or more, but for the last one."""
    waiting: list[EventColumns] = []
    for piece in pieces:
        waiting.append(piece)
        if sum(map(len, waiting)) >= _AT_A_TIME:
            yield _joined(waiting)
            waiting = []
    if waiting:
        yield _joined(waiting)


def _joined(parts: list[EventColumns]) -> EventColumns:
    columns = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "x", "y", "p"))
    return EventColumns(parts[0].start, *columns)


def _converted(piece: EventColumns) -> dict[str, np.ndarray]:
    columns = {"x": piece.x, "y": piece.y, "p": piece.p, "t": piece.t_ns // _NS_PER_US}
    return {name: values.astype(_DTYPES[name], copy=False) for name, values in columns.items()}


@contextlib.contextmanager
def _part(path: Path) -> Iterator[Path]:
    """A file beside `path` that takes its place at the end."""
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        os.replace(part, path)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written ({error}). Is the disk full, or the folder?") from error
    finally:
        part.unlink(missing_ok=True)


# --- formats ---------------------------------------------------------------------------------------------------------


def _write_hdf5(
    path: Path,
    pieces: Iterable[EventColumns],
    sensor: tuple[int, int] | None,
    triggers: Callable[[], Triggers] | None,
) -> int:
    count = 0
    with h5py.File(path, "w") as file:
        datasets = {
            name: file.create_dataset(name, shape=(0,), maxshape=(None,), dtype=dtype, chunks=(_CHUNK,))
            for name, dtype in _DTYPES.items()
        }
        for piece in _large(pieces):
            for name, values in _converted(piece).items():
                datasets[name].resize(count + len(piece), axis=0)
                datasets[name][count:] = values
            count += len(piece)
        if sensor is not None:
            file.attrs["width"], file.attrs["height"] = sensor
        edges = triggers() if triggers is not None else None
        if edges is not None and len(edges):
            file["triggers/t"] = edges.t_ns // _NS_PER_US
            file["triggers/channel"] = edges.channel
            file["triggers/rising"] = edges.rising
    return count


def _write_npz(
    path: Path,
    pieces: Iterable[EventColumns],
    sensor: tuple[int, int] | None,
    triggers: Callable[[], Triggers] | None,
) -> int:
    """The columns are collected in files of their own, because an npz holds one after the other."""
    count = 0
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".events-") as folder:
        with contextlib.ExitStack() as stack:
            files = {name: stack.enter_context((Path(folder) / name).open("wb")) for name in _DTYPES}
            for piece in pieces:
                for name, values in _converted(piece).items():
                    values.tofile(files[name])
                count += len(piece)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, dtype in _DTYPES.items():
                with (
                    archive.open(f"{name}.npy", "w", force_zip64=True) as member,
                    (Path(folder) / name).open("rb") as raw,
                ):
                    header = {"descr": dtype.str, "fortran_order": False, "shape": (count,)}
                    np.lib.format.write_array_header_1_0(member, header)
                    shutil.copyfileobj(raw, member, 1 << 22)
            for name, value in zip(("width", "height"), sensor or (), strict=False):
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.array(value, np.int64))
    return count


def _write_text(
    path: Path,
    pieces: Iterable[EventColumns],
    sensor: tuple[int, int] | None,
    triggers: Callable[[], Triggers] | None,
    *,
    first_line: str,
    separator: str,
) -> int:
    count = 0
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(f"{first_line}\n")
        for piece in pieces:
            columns = _converted(piece)
            rows = np.stack([columns[name].astype(np.int64) for name in ("t", "x", "y", "p")], axis=1)
            np.savetxt(file, rows, fmt="%d", delimiter=separator)
            count += len(piece)
    return count
