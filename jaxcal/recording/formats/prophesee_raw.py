"""Prophesee RAW files: a header in text, then EVT2, EVT2.1 or EVT3 words."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxcal.errors import CalibrationError
from jaxcal.recording.formats.contract import EventFormat, EventReader, no_topic
from jaxcal.recording.formats.evt_decoder import WORD_BYTES, WordDecoder
from jaxcal.recording.formats.streams import Block, StreamReader

# Bytes that are decoded at a time: some ten million events at most.
BLOCK_BYTES = 1 << 21

# What an event takes on average, roughly; rates and scenes differ.
_BYTES_PER_EVENT = {"evt2": 4, "evt21": 3, "evt21-legacy": 3, "evt3": 3}

# Older files name only the system that recorded. Source: OpenEB, psee_raw_file_header.cpp and device_system_id.h.
_VGA, _HD = (640, 480), (1280, 720)
_SYSTEM_SENSORS = {
    **dict.fromkeys((0x15, 0x1C, 0x17, 0x19, 0x1D, 0x23, 0x21, 0x22, 0x29, 0x28), _VGA),
    **dict.fromkeys((0x97, 0x99, 0xA1, 0xA2), _VGA),
    **dict.fromkeys((0x1A, 0x1E, 0x2E, 0x1F, 0x27, 0x30, 0x32, 0x31), _HD),
}
_EVT3_SYSTEMS = {0x1E, 0x2E, 0x28, 0x30, 0x32, 0x31}
_FIRST_LITTLE_ENDIAN_SYSTEM = 0x37  # systems before it write the halves of an EVT2.1 word in the other order


@dataclass(frozen=True)
class RawHeader:
    """`encoding`: evt2, evt21, evt21-legacy or evt3; `sensor` (width, height) or None; `body` where the words start."""

    encoding: str
    sensor: tuple[int, int] | None
    body: int


def open_raw(path: Path, topic: str | None) -> EventReader:
    """Open a RAW file. Raises CalibrationError when the header does not say how the events are encoded."""
    no_topic(path, topic, "a RAW file")
    header = read_header(path)
    word = WORD_BYTES[header.encoding]
    cut = (path.stat().st_size - header.body) % word

    def remarks(resume: Any) -> list[str]:
        if resume is None:
            return []
        found = resume[1].remarks()
        if cut:
            found.append(f"the last word is cut short ({cut} of {word} bytes): the recording was broken off there")
        return found

    name = f"Prophesee RAW {header.encoding.upper()}"
    rough = round((path.stat().st_size - header.body) / _BYTES_PER_EVENT[header.encoding])
    return StreamReader(path, name, header.sensor, lambda resume: _blocks(path, header, resume), rough, remarks)


def _blocks(path: Path, header: RawHeader, resume: Any) -> Iterator[Block]:
    offset, decoder = (header.body, WordDecoder(header.encoding)) if resume is None else resume
    decoder = decoder.copy()
    word = WORD_BYTES[header.encoding]
    with path.open("rb") as file:
        file.seek(offset)
        while content := file.read(BLOCK_BYTES):
            whole = len(content) // word * word
            events, triggers = decoder.decode(content[:whole])
            offset += whole
            yield Block(events, (offset, decoder.copy()), triggers)
            if whole < len(content):
                return


# --- header ----------------------------------------------------------------------------------------------------------


def header_fields(path: Path) -> tuple[dict[str, str], int]:
    """The 'key value' pairs of a Prophesee file's header (lines '% key value'), and where the header ends."""
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        while True:
            start = file.tell()
            line = file.readline(4096)
            if not _is_header_line(line):
                return fields, start
            words = line[1:].decode("ascii").strip().split(maxsplit=1)
            if words == ["end"]:
                return fields, file.tell()
            if words:
                fields[words[0]] = words[1] if len(words) > 1 else ""


def _is_header_line(line: bytes) -> bool:
    return (
        line.startswith(b"%") and line.endswith(b"\n") and all(32 <= byte < 127 or byte in b"\t\r\n" for byte in line)
    )


def read_header(path: Path) -> RawHeader:
    """How the events of a RAW file are encoded. Raises CalibrationError when the header does not say it."""
    fields, body = header_fields(path)
    words = fields.get("format", "").split(";")
    options = dict(word.split("=", 1) for word in words[1:] if "=" in word)
    system = int(fields["system_ID"]) if fields.get("system_ID", "").isdigit() else None
    return RawHeader(_encoding(path, fields, words[0], options, system), _sensor(fields, options, system), body)


def _encoding(path: Path, fields: Mapping[str, str], name: str, options: Mapping[str, str], system: int | None) -> str:
    known = {"EVT2": "evt2", "EVT21": "evt21", "EVT3": "evt3", "2.0": "evt2", "2.1": "evt21", "3.0": "evt3"}
    text = name or fields.get("evt", "")
    if not text and system in _SYSTEM_SENSORS:
        text = "EVT3" if system in _EVT3_SYSTEMS else "EVT2"
    if text not in known:
        found = f"'{text}'" if text else "nothing about it"
        raise CalibrationError(
            f"{path}: the header says {found} where the encoding of the events should be; expected a line '% evt 2.0', "
            "'% evt 2.1' or '% evt 3.0', or '% format EVT3;...'. Add the line, or convert the file elsewhere."
        )
    encoding = known[text]
    if encoding == "evt21":
        order = options.get("endianness", fields.get("endianness", ""))
        early = not order and system is not None and 0 < system < _FIRST_LITTLE_ENDIAN_SYSTEM
        return "evt21-legacy" if order == "legacy" or early else "evt21"
    return encoding


def _sensor(fields: Mapping[str, str], options: Mapping[str, str], system: int | None) -> tuple[int, int] | None:
    match = re.fullmatch(r"(\d+)x(\d+)", fields.get("geometry", "").strip())
    if match:
        return int(match[1]), int(match[2])
    if options.get("width", "").isdigit() and options.get("height", "").isdigit():
        return int(options["width"]), int(options["height"])
    return _SYSTEM_SENSORS.get(system) if system is not None else None


def _recognises(path: Path, head: bytes) -> bool:
    if not head.startswith(b"%"):
        return False
    fields, _ = header_fields(path)
    return any(key in fields for key in ("evt", "format")) or (
        path.suffix.lower() == ".raw" and any(key in fields for key in ("system_ID", "integrator_name", "geometry"))
    )


FORMAT = EventFormat("Prophesee RAW: EVT2, EVT2.1, EVT3", (".raw",), _recognises, open_raw)
