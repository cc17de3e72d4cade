"""Events in bags: arrays of events (dvs_msgs, prophesee_event_msgs) and packets of encoded ones (event_camera_msgs)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.recording.bags import Bag, Fields, is_bag
from jaxcal.recording.formats.contract import (
    NO_TRIGGERS,
    EventColumns,
    EventFormat,
    EventReader,
    Triggers,
    joined_triggers,
)
from jaxcal.recording.formats.evt_decoder import WORD_BYTES, WordDecoder
from jaxcal.recording.formats.libcaer_cmp import decode_packet
from jaxcal.recording.formats.streams import Block, StreamReader

_ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
_PACKET = "event_camera_msgs/msg/EventPacket"
EVENT_TYPES = (*_ARRAYS, _PACKET)
# What an EventPacket may hold, of what its drivers write.
_EVT = ("evt2", "evt21", "evt3")
_MONO, _LIBCAER = "mono", "libcaer_cmp"

_BYTES_PER_EVENT = {True: 3, False: 13}  # of a packet, roughly; of an array
_EVENTS_PER_BLOCK = 1 << 19
_ROS1_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])


@dataclass
class _State:
    """Where decoding resumes, and what it must know there.

    `time_ns`, `seen`: that of the last message, and how many messages of that time have been read; `decoder` that of
    the packets; `offset_ns` from the sensor's clock to ROS time, None until the first event; `next_packet` the expected
    sequence number; `lost` how many packets are missing.
    """

    time_ns: int | None = None
    seen: int = 0
    decoder: WordDecoder | None = None
    offset_ns: int | None = None
    next_packet: int | None = None
    lost: int = 0
    cut: int = 0

    def copy(self) -> "_State":
        return replace(self, decoder=self.decoder and self.decoder.copy())


def open_bag(path: Path, topic: str | None) -> EventReader:
    """Open the events of a bag; `topic` is needed where several topics have events.

    Times are ROS time. The encoded packets of event_camera_msgs hold the sensor's own time: it is shifted, as a whole,
    so that the first event has the time in its packet's header, which keeps the intervals exact.

    Raises CalibrationError when the bag is damaged, or has no such topic or no events.
    """
    with Bag(path) as bag:
        chosen = bag.choose(topic, EVENT_TYPES, "events")
        content = next(content for _, content in bag.messages(chosen.name))
        fields = bag.fields(content)
        fields.header()
        height, width = fields.number("I"), fields.number("I")
    sensor = (width, height) if width and height else None
    name = f"ROS {'2' if bag.ros2 else '1'} bag, {chosen.kind.replace('/msg/', '/')}"
    rough = chosen.count * len(content) // _BYTES_PER_EVENT[chosen.kind == _PACKET]
    return StreamReader(
        path, name, sensor, lambda resume: _blocks(path, chosen.name, chosen.kind, resume), rough, _remarks
    )


def _remarks(resume: Any) -> list[str]:
    if resume is None:
        return []
    found = resume.decoder.remarks() if resume.decoder is not None else []
    if resume.lost:
        found.append(f"{resume.lost} packets of events are missing: they were lost while recording")
    if resume.cut:
        found.append(f"{resume.cut} packets end in the middle of a word, which was left out")
    return found


def _blocks(path: Path, topic: str, kind: str, resume: Any) -> Iterator[Block]:
    state = _State() if resume is None else resume.copy()
    events: list[EventColumns] = []
    triggers: list[Triggers] = []
    with Bag(path) as bag:
        skip = state.seen
        for time_ns, content in bag.messages(topic, state.time_ns):
            if skip:
                skip -= 1
                continue
            state.seen = state.seen + 1 if time_ns == state.time_ns else 1
            state.time_ns = time_ns
            fields = bag.fields(content)
            if kind == _PACKET:
                found, edges = _packet(path, fields, state)
                triggers.append(edges)
            else:
                found = _array(path, fields, bag.ros2)
            events.append(found)
            if sum(map(len, events)) >= _EVENTS_PER_BLOCK:
                yield Block(_joined(events), state.copy(), joined_triggers(triggers))
                events, triggers = [], []
    if events:
        yield Block(_joined(events), state.copy(), joined_triggers(triggers))


def _joined(parts: list[EventColumns]) -> EventColumns:
    return EventColumns(
        0, *(np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "x", "y", "p"))
    )


# --- arrays of events ------------------------------------------------------------------------------------------------


def _array(path: Path, fields: Fields, ros2: bool) -> EventColumns:
    """EventArray: header, height, width, and events of x, y, time (seconds, nanoseconds) and polarity."""
    fields.header()
    fields.numbers("I", 2)
    count = fields.number("I")
    records = _cdr_events(fields, count) if ros2 else _ros1_events(fields, count)
    if records is None:
        raise CalibrationError(f"{path}: an array of {count} events is cut short. The bag is damaged: copy it again.")
    t_ns = records["s"].astype(np.int64) * 1_000_000_000 + records["ns"]
    return EventColumns(0, t_ns, records["x"].astype(np.uint16), records["y"].astype(np.uint16), records["p"] > 0)


def _ros1_events(fields: Fields, count: int) -> np.ndarray | None:
    if fields.place + count * _ROS1_EVENT.itemsize > len(fields.content):
        return None
    return np.frombuffer(fields.content, _ROS1_EVENT, count, fields.place)


def _cdr_events(fields: Fields, count: int) -> np.ndarray | None:
    """CDR aligns times to 4 bytes: events are 16 bytes apart, x and y of all but the first 2 bytes before those."""
    order = fields.order
    record = np.dtype(
        {
            "names": ["y", "s", "ns", "p"],
            "formats": [f"{order}u2", f"{order}i4", f"{order}u4", "u1"],
            "offsets": [0, 4, 8, 12],
            "itemsize": 16,
        }
    )
    start, needed = fields.place, count * 16 - 3
    if count and start + needed > len(fields.content):
        return None
    padded = fields.content[start : start + needed] + bytes(3) if count else b""
    grid = np.frombuffer(padded, record)
    halves = np.frombuffer(padded, f"{order}u2").astype(np.uint16)
    records = np.empty(count, [("x", "u2"), ("y", "u2"), ("s", "i8"), ("ns", "i8"), ("p", "u1")])
    for name in ("y", "s", "ns", "p"):
        records[name] = grid[name]
    if count:
        records["x"][0], records["y"][0] = halves[0], halves[1]
        records["x"][1:] = halves[7:-1:8]  # 2 bytes before the 16 of its event
    return records


# --- encoded packets -------------------------------------------------------------------------------------------------


def _packet(path: Path, fields: Fields, state: _State) -> tuple[EventColumns, Triggers]:
    """EventPacket: header, height, width, sequence number, time base, encoding, byte order, encoded events."""
    stamp_ns = fields.header()
    fields.numbers("I", 2)
    sequence, time_base_ns = fields.number("Q"), fields.number("Q")
    encoding = fields.text()
    fields.number("B")
    content = fields.content_bytes()
    if state.next_packet is not None and sequence > state.next_packet:
        state.lost += sequence - state.next_packet
    state.next_packet = sequence + 1
    if encoding == _MONO:
        return _mono(content, time_base_ns), NO_TRIGGERS
    if encoding not in (*_EVT, _LIBCAER):
        raise CalibrationError(
            f"{path}: packets of events are encoded as '{encoding}'; known here: "
            f"{', '.join([*_EVT, _LIBCAER, _MONO])}. Convert them with event_camera_tools."
        )
    if encoding == _LIBCAER:
        events, triggers = decode_packet(content, time_base_ns), NO_TRIGGERS
    else:
        events, triggers = _decoded(content, encoding, state)
    if state.offset_ns is None and (len(events) or len(triggers)):
        first = min(int(part.t_ns[0]) for part in (events, triggers) if len(part))
        state.offset_ns = stamp_ns - first
    offset = state.offset_ns or 0
    return (
        EventColumns(0, events.t_ns + offset, events.x, events.y, events.p),
        Triggers(triggers.t_ns + offset, triggers.channel, triggers.rising),
    )


def _decoded(content: memoryview, encoding: str, state: _State) -> tuple[EventColumns, Triggers]:
    if state.decoder is None:
        state.decoder = WordDecoder(encoding)
    whole = len(content) // WORD_BYTES[encoding] * WORD_BYTES[encoding]
    state.cut += whole < len(content)
    return state.decoder.decode(content[:whole])


def _mono(content: memoryview, time_base_ns: int) -> EventColumns:
    """64 bits an event: nanoseconds since the time base (32), x (16), y (15), polarity (1)."""
    words = np.frombuffer(content, "<u8", len(content) // 8)
    t_ns = (words & 0xFFFFFFFF).astype(np.int64) + time_base_ns
    x, y = (words >> 32 & 0xFFFF).astype(np.uint16), (words >> 48 & 0x7FFF).astype(np.uint16)
    return EventColumns(0, t_ns, x, y, (words >> 63).astype(bool))


FORMAT = EventFormat(
    "bags of ROS 1, ROS 2 and mcap: dvs_msgs, prophesee_event_msgs, event_camera_msgs",
    (".bag", ".mcap", ".db3"),
    lambda path, head: is_bag(path),
    open_bag,
)
