"""Events in text: one a line, t x y p unless a first line names the columns."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.recording.formats.contract import EventColumns, EventFormat, EventReader, empty, no_topic
from jaxcal.recording.formats.streams import Block, StreamReader

# Bytes that are parsed at a time: some half a million events.
BLOCK_BYTES = 1 << 23

_ORDER = ("t", "x", "y", "p")
_COLUMN_NAMES = {
    **dict.fromkeys(("t", "ts", "time", "timestamp"), "t"),
    "x": "x",
    "y": "y",
    **dict.fromkeys(("p", "pol", "polarity", "on"), "p"),
}
_UNITS = {"ns": 0, "us": 3, "ms": 6, "s": 9}  # decimal exponent from the unit to nanoseconds
_UNIT_NAMES = {0: "nanoseconds", 3: "microseconds", 6: "milliseconds", 9: "seconds"}
# Whole numbers from here on are nanoseconds since 1970: as microseconds they would be the year 5138.
_SURELY_NS = 10**17
_HEAD_BYTES = 4096
_BYTES_PER_LINE = 20  # roughly
_EXPECTED = (
    "Expected lines of 't x y p' (t in seconds with a decimal point, or whole microseconds; p 0 or 1, or -1 and 1). "
    "Another order or unit is told by a first line such as 'x y p t_us'."
)


@dataclass(frozen=True)
class _Layout:
    """`columns` the name of each ('' to pass over); `exponent`: t * 10**exponent is ns, as a first line `told`, or by
    the looks of it; `body` where the lines start, which is line number `line` (from 1); `sensor` (width, height) where
    the first lines tell it."""

    columns: tuple[str, ...]
    exponent: int
    told: bool
    body: int
    line: int
    sensor: tuple[int, int] | None


def open_text(path: Path, topic: str | None) -> EventReader:
    """Open a text file of events. Raises CalibrationError when its first lines are no events."""
    no_topic(path, topic, "a text file")
    layout = _layout(path)

    rough = path.stat().st_size // _BYTES_PER_LINE

    def remarks(resume: Any) -> list[str]:
        found = [] if layout.told else [f"times are taken as {_UNIT_NAMES[layout.exponent]}"]
        if resume is not None and resume[2]:
            found.append(f"line {resume[1]}, the last one, is cut short and was left out")
        return found

    return StreamReader(path, "text", layout.sensor, lambda resume: _blocks(path, layout, resume), rough, remarks)


def _blocks(path: Path, layout: _Layout, resume: Any) -> Iterator[Block]:
    from jaxcal.recording.formats import text_lines  # numba takes its time to import

    named = {"t": text_lines.TIME, "x": text_lines.X, "y": text_lines.Y, "p": text_lines.POLARITY}
    roles = np.array([named.get(name, text_lines.IGNORED) for name in layout.columns], np.int64)
    offset, line, _ = (layout.body, layout.line, False) if resume is None else resume
    with path.open("rb") as file:
        while lines := _lines_from(file, offset):
            unterminated = not lines.endswith(b"\n")  # then they are the file's last
            lines += b"\n" if unterminated else b""
            events, count, bad = _parsed(text_lines.parse, lines, roles, layout.exponent)
            broken_off = bad >= 0 and unterminated and lines.count(b"\n", bad) == 1
            if bad >= 0 and not broken_off:
                found = lines[bad : bad + 80].split(b"\n")[0].decode("utf-8", "replace").strip()
                raise CalibrationError(f"{path}: line {line + count} is '{found}'. {_EXPECTED}")
            offset, line = offset + len(lines), line + count
            yield Block(events, (offset, line, broken_off))


def _lines_from(file: BinaryIO, offset: int) -> bytes:
    """The lines of the next block, which follow from where it starts alone: a pass that resumes there finds the same
    blocks as one that has come from the start. The file's last line may lack its end."""
    file.seek(offset)
    content = file.read(BLOCK_BYTES)
    if len(content) < BLOCK_BYTES:
        return content
    cut = content.rfind(b"\n") + 1
    return content[:cut] if cut else content + file.readline()


def _parsed(parse: Any, lines: bytes, roles: np.ndarray, exponent: int) -> tuple[EventColumns, int, int]:
    text = np.frombuffer(lines, np.uint8)
    size = int(np.count_nonzero(text == ord("\n")))
    t_ns, x, y, p = (np.empty(size, kind) for kind in (np.int64, np.uint16, np.uint16, np.bool_))
    events, count, bad = parse(text, roles, exponent, t_ns, x, y, p)
    return EventColumns(0, t_ns[:events], x[:events], y[:events], p[:events]), count, bad


# --- the first lines -------------------------------------------------------------------------------------------------


def _layout(path: Path) -> _Layout:
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    offset, columns, exponent, sensor = 0, None, None, None
    lines = head.splitlines(keepends=True)
    for number, raw in enumerate(lines, start=1):
        words = _words(raw)
        commented = raw.lstrip()[:1] in (b"#", b"%")
        names = _names(words)
        if names is not None:
            columns, exponent = names
            sensor = _sensor(words) or sensor
        elif words and not commented:
            if sensor is None and columns is None and len(words) == 2 and all(word.isdigit() for word in words):
                sensor = int(words[0]), int(words[1])  # as E2VID's text files start
            else:
                columns = columns or _ORDER
                guessed = _exponent(path, number, words, columns, exponent)
                return _Layout(columns, guessed, exponent is not None, offset, number, sensor)
        offset += len(raw)
    if len(head) < _HEAD_BYTES:
        raise empty(path)
    raise CalibrationError(f"{path}: there are no events in the first {len(lines)} lines. {_EXPECTED}")


def _words(line: bytes) -> list[str]:
    return re.findall(r"[^\s,;]+", line.decode("utf-8", "replace").strip().lstrip("#% "))


def _names(words: list[str]) -> tuple[tuple[str, ...], int | None] | None:
    """The columns, and the unit of time or None, if a line names them; else None."""
    names, exponent = [], None
    for word in words:
        match = re.fullmatch(r"(\w+?)(?:_(ns|us|ms|s)|[\[(](ns|us|ms|s)[\])]|@\d+)?", word.lower())
        name = _COLUMN_NAMES.get(match[1], "") if match else ""
        if name == "t" and match and (match[2] or match[3]):
            exponent = _UNITS[match[2] or match[3]]
        names.append(name)
    complete = all(names.count(name) == 1 for name in _ORDER)
    return (tuple(names), exponent) if complete else None


def _sensor(words: list[str]) -> tuple[int, int] | None:
    """The sensor's size where the names tell it, as in 't,x@640,y@480,on' (faery)."""
    told = {match[1]: match[2] for word in words if (match := re.fullmatch(r"([xy])@(\d+)", word))}
    return (int(told["x"]), int(told["y"])) if len(told) == 2 else None


def _exponent(path: Path, line: int, words: list[str], columns: tuple[str, ...], told: int | None) -> int:
    """Decimal exponent of the unit of time: as told, or by what the first time looks like."""
    if len(words) != len(columns):
        raise CalibrationError(
            f"{path}: line {line} has {len(words)} columns, not {len(columns)}: '{' '.join(words)[:80]}'. {_EXPECTED}"
        )
    if told is not None:
        return told
    time = words[columns.index("t")]
    if not re.fullmatch(r"[+-]?\d+", time):
        return _UNITS["s"]
    return _UNITS["ns"] if int(time) >= _SURELY_NS else _UNITS["us"]


def _recognises(path: Path, head: bytes) -> bool:
    if path.suffix.lower() in (".txt", ".csv"):
        return b"\0" not in head
    printable = all(32 <= byte < 127 or byte in b"\t\r\n" for byte in head)
    return bool(head) and printable and any(character in head for character in b"0123456789")


FORMAT = EventFormat("text: t x y p", (".txt", ".csv"), _recognises, open_text)
