"""Prophesee DAT files: a header in text, then 8-byte records of one event."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.recording.formats.contract import EventColumns, EventFormat, EventReader, no_topic
from jaxcal.recording.formats.prophesee_raw import header_fields
from jaxcal.recording.formats.streams import Block, StreamReader

_RECORD = np.dtype([("t", "<u4"), ("xyp", "<u4")])
_RECORDS_PER_BLOCK = 1 << 20
_HALF_TURN = 1 << 31
_EVENT_TYPES = (0, 12)  # Event2D of older tools, EventCD
_TRIGGER_TYPE = 14


def open_dat(path: Path, topic: str | None) -> EventReader:
    """Open a DAT file. Raises CalibrationError when it holds something else than events.

    Source: OpenEB, dat_tools.py: t 32 bits in microseconds, x 14 bits, y 14 bits, polarity 1 bit.
    """
    no_topic(path, topic, "a DAT file")
    fields, start = header_fields(path)
    with path.open("rb") as file:
        file.seek(start)
        kind = file.read(2)
    body = start + 2
    if len(kind) < 2 or kind[0] not in _EVENT_TYPES or kind[1] != _RECORD.itemsize:
        found = f"type {kind[0]}, {kind[1]} bytes each" if len(kind) == 2 else "nothing"
        hint = " These are the external triggers; the events are in the other file." if kind[:1] == b"\x0e" else ""
        raise CalibrationError(
            f"{path}: behind the header there is {found}; expected records of events (type 12, 8 bytes each).{hint} "
            "Convert the recording again."
        )
    cut = (path.stat().st_size - body) % _RECORD.itemsize

    def remarks(resume: Any) -> list[str]:
        message = f"the last record is cut short ({cut} of 8 bytes): the recording was broken off there"
        return [message] if cut and resume is not None else []

    sensor = None
    if fields.get("Width", "").isdigit() and fields.get("Height", "").isdigit():
        sensor = int(fields["Width"]), int(fields["Height"])
    count = (path.stat().st_size - body) // _RECORD.itemsize
    return StreamReader(path, "Prophesee DAT", sensor, lambda resume: _blocks(path, body, resume), count, remarks)


def _blocks(path: Path, body: int, resume: Any) -> Iterator[Block]:
    offset, last, loops = (body, None, 0) if resume is None else resume
    with path.open("rb") as file:
        file.seek(offset)
        while content := file.read(_RECORDS_PER_BLOCK * _RECORD.itemsize):
            records = np.frombuffer(content, _RECORD, count=len(content) // _RECORD.itemsize)
            if not len(records):
                return
            raw = records["t"].astype(np.int64)
            # The 32-bit time wraps after 71 min: then it falls by nearly all of its range. Where it rises by as much,
            # an event from before the wrap has come behind one from after it.
            steps = np.diff(raw, prepend=raw[0] if last is None else last)
            turns = loops + np.cumsum((steps < -_HALF_TURN).astype(np.int64) - (steps > _HALF_TURN))
            xyp = records["xyp"]
            x, y = (xyp & 0x3FFF).astype(np.uint16), (xyp >> 14 & 0x3FFF).astype(np.uint16)
            events = EventColumns(0, (raw + (turns << 32)) * 1000, x, y, (xyp >> 28 & 1).astype(bool))
            offset, last, loops = offset + len(records) * _RECORD.itemsize, int(raw[-1]), int(turns[-1])
            yield Block(events, (offset, last, loops))


def _recognises(path: Path, head: bytes) -> bool:
    if path.suffix.lower() != ".dat" and not head.startswith(b"% Data file"):
        return False
    if not head.startswith(b"% "):
        return False
    fields, _ = header_fields(path)
    return not any(key in fields for key in ("evt", "format"))


FORMAT = EventFormat("Prophesee DAT", (".dat",), _recognises, open_dat)
