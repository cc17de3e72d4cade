"""Events in a numpy archive: columns x, y, p and t, streamed out of the zip file."""

import contextlib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.recording.formats.contract import EventColumns, EventFormat, EventReader, empty, no_topic
from jaxcal.recording.formats.streams import Block, StreamReader

_EVENTS_PER_BLOCK = 1 << 20
# Names in use for each column.
_NAMES = {"x": ("x",), "y": ("y",), "p": ("p", "pol", "polarity", "on"), "t": ("t", "t_us", "t_ns", "ts", "timestamp")}


def open_npz(path: Path, topic: str | None) -> EventReader:
    """Open an npz with x, y, p and t (whole microseconds; t_ns: nanoseconds), and perhaps width and height.

    Raises CalibrationError when the file is damaged, lacks a column or holds no events.
    """
    no_topic(path, topic, "an npz file")
    with _damage_named(path), zipfile.ZipFile(path) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist()}
        names = {column: _name(path, members, column) for column in _NAMES}
        headers = {column: _header(archive, members[name]) for column, name in names.items()}
        sensor = _sensor(archive, members)
    lengths = {column: shape for column, (shape, _) in headers.items()}
    if len(set(lengths.values())) != 1 or len(lengths["t"]) != 1:
        raise CalibrationError(
            f"{path}: x, y, p and t must have one entry per event; their shapes are "
            f"{', '.join(f'{name} {shape}' for name, shape in lengths.items())}. Write the file again."
        )
    if not lengths["t"][0]:
        raise empty(path)
    if headers["t"][1].kind not in "iu":
        raise CalibrationError(
            f"{path}: '{names['t']}' has type {headers['t'][1]}; expected whole microseconds (int64). Float seconds "
            "lose precision: multiply by 1e6, round, and write again."
        )
    for column in ("x", "y"):
        if headers[column][1].kind not in "iu":
            raise CalibrationError(
                f"{path}: '{column}' has type {headers[column][1]}; expected whole pixels. Write it as uint16."
            )
    unit_ns = 1 if names["t"] == "t_ns" else 1000
    files = {column: members[name] for column, name in names.items()}
    return StreamReader(path, "npz", sensor, lambda resume: _blocks(path, files, unit_ns, resume), lengths["t"][0])


def _blocks(path: Path, members: dict[str, str], unit_ns: int, resume: Any) -> Iterator[Block]:
    start = resume or 0
    with contextlib.ExitStack() as stack:
        stack.enter_context(_damage_named(path))
        archive = stack.enter_context(zipfile.ZipFile(path))
        streams = {column: stack.enter_context(archive.open(name)) for column, name in members.items()}
        headers = {column: _read_header(stream) for column, stream in streams.items()}
        length = headers["t"][0][0]
        for column, stream in streams.items():
            _skip(stream, start * headers[column][1].itemsize)
        while start < length:
            count = min(_EVENTS_PER_BLOCK, length - start)
            column = {name: _values(stream, headers[name][1], count) for name, stream in streams.items()}
            start += count
            t_ns = column["t"].astype(np.int64) * unit_ns
            yield Block(EventColumns(0, t_ns, column["x"], column["y"], column["p"] > 0), start)


def _values(stream: Any, dtype: np.dtype, count: int) -> np.ndarray:
    return np.frombuffer(stream.read(count * dtype.itemsize), dtype, count)


def _skip(stream: Any, size: int) -> None:
    while size > 0:
        size -= len(stream.read(min(size, 1 << 22)))


def _name(path: Path, members: dict[str, str], column: str) -> str:
    for name in _NAMES[column]:
        if name in members:
            return name
    raise CalibrationError(
        f"{path}: '{column}' is missing; the file holds {', '.join(members) or 'nothing'}. Expected arrays x, y, p and "
        "t (whole microseconds)."
    )


def _header(archive: zipfile.ZipFile, member: str) -> tuple[tuple[int, ...], np.dtype]:
    with archive.open(member) as stream:
        return _read_header(stream)


def _read_header(stream: Any) -> tuple[tuple[int, ...], np.dtype]:
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    return shape, dtype


def _sensor(archive: zipfile.ZipFile, members: dict[str, str]) -> tuple[int, int] | None:
    if "width" not in members or "height" not in members:
        return None
    values = []
    for name in ("width", "height"):
        with archive.open(members[name]) as stream:
            values.append(int(np.lib.format.read_array(stream, allow_pickle=False)))
    return values[0], values[1]


@contextlib.contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile) as error:
        raise CalibrationError(f"{path}: not a readable npz file ({error}). Copy it again.") from error


FORMAT = EventFormat("npz", (".npz",), lambda path, head: head.startswith(b"PK\x03\x04"), open_npz)
