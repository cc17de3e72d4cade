"""AEDAT4 files of iniVation's cameras, by the `aedat` package."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.recording.formats.contract import (
    NO_TRIGGERS,
    EventColumns,
    EventFormat,
    EventReader,
    Triggers,
    joined_triggers,
)
from jaxcal.recording.formats.streams import Block, StreamReader

_SIGNATURE = b"#!AER-DAT4.0"
# Packets hold a few thousand events; so many are handed on at a time.
_EVENTS_PER_BLOCK = 1 << 19
_BYTES_PER_EVENT = 8  # roughly, compressed
# Values of a trigger's source: edges and pulses of the external signal.
_RISING, _FALLING, _PULSE = 1, 2, 3
# What the package says where a packet ends behind the end of the file.
_BROKEN_OFF = "failed to fill whole buffer"


def open_aedat4(path: Path, topic: str | None) -> EventReader:
    """Open an AEDAT4 file; `topic` is the number of the event stream where there are several.

    Raises CalibrationError when the `aedat` package is not installed, the file is damaged or has no event stream.
    """
    streams = _decoder(path).id_to_stream()
    sensors = {key: (facts["width"], facts["height"]) for key, facts in streams.items() if facts["type"] == "events"}
    stream = _stream(path, topic, sensors, streams)

    rough = path.stat().st_size // _BYTES_PER_EVENT

    def remarks(resume: Any) -> list[str]:
        broken_off = resume is not None and resume[1]
        return ["the file breaks off in the middle of a packet: what comes before it is read"] if broken_off else []

    return StreamReader(path, "AEDAT4", sensors[stream], lambda resume: _blocks(path, stream, resume), rough, remarks)


def _stream(path: Path, wanted: str | None, sensors: Mapping[int, Any], streams: Mapping[int, Any]) -> int:
    names = ", ".join(f"{key} ({facts['type']})" for key, facts in streams.items())
    if wanted is not None:
        if not wanted.isdigit() or int(wanted) not in sensors:
            raise CalibrationError(f"{path}: '{wanted}' is no stream of events; the file has the streams {names}.")
        return int(wanted)
    if len(sensors) != 1:
        remedy = " Say which: " + " or ".join(f"{path}:{key}" for key in sensors) + "." if sensors else ""
        raise CalibrationError(f"{path}: expected one stream of events; the file has the streams {names}.{remedy}")
    return next(iter(sensors))


def _blocks(path: Path, stream: int, resume: Any) -> Iterator[Block]:
    done = 0 if resume is None else resume[0]
    packets = enumerate(_packets(path), start=1)
    waiting: list[np.ndarray] = []
    triggers: list[Triggers] = []
    number, broken_off = 0, False
    for number, packet in packets:
        if packet is None:
            broken_off = True
            break
        if number <= done:
            continue
        if "triggers" in packet:
            triggers.append(_edges(packet["triggers"]))
        if packet.get("stream_id") == stream and "events" in packet:
            waiting.append(packet["events"])
            if sum(map(len, waiting)) >= _EVENTS_PER_BLOCK:
                yield Block(_columns(waiting), (number, False), joined_triggers(triggers))
                waiting, triggers = [], []
    if waiting or triggers or broken_off:
        yield Block(_columns(waiting), (number, broken_off), joined_triggers(triggers) if triggers else NO_TRIGGERS)


def _packets(path: Path) -> Iterator[Mapping[str, Any] | None]:
    """The file's packets; at last None where the file breaks off."""
    decoder = iter(_decoder(path))
    while True:
        try:
            packet = next(decoder)
        except StopIteration:
            return
        except RuntimeError as error:
            if _BROKEN_OFF not in str(error):
                raise _damaged(path, error) from error
            yield None
            return
        yield packet


def _columns(packets: list[np.ndarray]) -> EventColumns:
    if not packets:
        nothing = np.empty(0, np.uint16)
        return EventColumns(0, np.empty(0, np.int64), nothing, nothing, np.empty(0, bool))
    t, x, y, p = (np.concatenate([packet[name] for packet in packets]) for name in ("t", "x", "y", "on"))
    return EventColumns(0, t.astype(np.int64) * 1000, x, y, p)


def _edges(packet: np.ndarray) -> Triggers:
    source = packet["source"]
    edges = np.isin(source, (_RISING, _FALLING, _PULSE))
    t_ns = packet["t"][edges].astype(np.int64) * 1000
    return Triggers(t_ns, np.zeros(len(t_ns), np.int64), source[edges] != _FALLING)


def _decoder(path: Path) -> Any:
    try:
        import aedat
    except ImportError as error:
        raise CalibrationError(
            f"{path}: AEDAT4 files need the package 'aedat': pip install 'jaxcal[aedat4]'."
        ) from error
    try:
        return aedat.Decoder(path)
    except (RuntimeError, OSError) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> CalibrationError:
    return CalibrationError(f"{path}: the AEDAT4 file cannot be read ({error}). It is damaged: copy it again.")


FORMAT = EventFormat("AEDAT4", (".aedat4", ".aedat"), lambda path, head: head.startswith(_SIGNATURE), open_aedat4)
