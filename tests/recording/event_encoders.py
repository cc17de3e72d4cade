"""Small encoders of event formats, written from the formats' descriptions, to read back what they write."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

WIDTH, HEIGHT = 64, 48


@dataclass(frozen=True)
class Stream:
    """Events: time in microseconds, column, row, polarity."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray

    def rows(self) -> list[tuple[int, int, int, int]]:
        return [tuple(int(value) for value in row) for row in zip(self.t, self.x, self.y, self.p, strict=True)]


def stream(t: np.ndarray, seed: int = 0) -> Stream:
    """Events at the given times, in runs along rows as sensors that read out rows give them."""
    rng = np.random.default_rng([seed, len(t)])
    n = len(t)
    y = rng.integers(0, HEIGHT, n)
    x = rng.integers(0, WIDTH, n)
    p = rng.integers(0, 2, n)
    for k in range(1, n):
        if t[k] == t[k - 1] and rng.random() < 0.7 and x[k - 1] + 1 < WIDTH:
            y[k], p[k], x[k] = y[k - 1], p[k - 1], min(WIDTH - 1, x[k - 1] + rng.integers(1, 9))
    return Stream(np.asarray(t, np.int64), x, y, p.astype(bool))


def streams(start: st.SearchStrategy[int], longest_step: int) -> st.SearchStrategy[Stream]:
    """Streams of up to 80 events: bursts of one time, small steps, and steps as long as the format can tell."""
    step = st.one_of(st.just(0), st.just(0), st.integers(1, 80), st.integers(1, 9_000), st.integers(1, longest_step))
    return st.builds(
        lambda first, steps, seed: stream(first + np.cumsum([0, *steps]), seed),
        start,
        st.lists(step, max_size=80),
        st.integers(0, 1000),
    )


# --- Prophesee RAW ---------------------------------------------------------------------------------------------------


def evt2(events: Stream) -> bytes:
    words, high = [], None
    for t, x, y, p in events.rows():
        if t >> 6 != high:
            high = t >> 6
            words.append(0x8 << 28 | high & 0xFFFFFFF)
        words.append(p << 28 | (t & 0x3F) << 22 | x << 11 | y)
    return np.array(words, "<u4").tobytes()


def evt21(events: Stream, legacy: bool = False) -> bytes:
    pairs, high = [], None  # (upper half, lower half)
    runs = _runs(events, 32)
    for t, x, y, p in runs:
        if t >> 6 != high:
            high = t >> 6
            pairs.append((0x8 << 28 | high & 0xFFFFFFF, 0))
        valid = sum(1 << column - x[0] for column in x)
        pairs.append((p << 28 | (t & 0x3F) << 22 | x[0] << 11 | y, valid))
    order = [0, 1] if legacy else [1, 0]
    return np.array(pairs, "<u4").reshape(-1, 2)[:, order].tobytes()


def evt3(events: Stream, seed: int = 0) -> bytes:
    """Vectors for most runs along a row, single columns for others; TIME_HIGH repeated now and then as sensors do."""
    rng = np.random.default_rng(seed)
    words, high, low, row = [], None, None, None
    for t, x, y, p in _runs(events, 31):
        if (t >> 12 & 0xFFF) != high or rng.random() < 0.1:
            low = None if (t >> 12 & 0xFFF) != high else low
            high = t >> 12 & 0xFFF
            words.append(0x8000 | high)
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(0x6000 | low)
        if y != row or rng.random() < 0.2:
            row = y
            words.append(y)
        if len(x) == 1 or rng.random() < 0.3:
            words += [0x2000 | p << 11 | column for column in x]
        else:
            words.append(0x3000 | p << 11 | x[0])
            valid = sum(1 << column - x[0] for column in x)
            words += [0x4000 | valid & 0xFFF, 0x4000 | valid >> 12 & 0xFFF, 0x5000 | valid >> 24 & 0xFF]
        if rng.random() < 0.1:
            words += [0xE014, 0xF123, 0x7001]  # what monitors report, which is no event
    return np.array(words, "<u2").tobytes()


def _runs(events: Stream, longest: int) -> list[tuple[int, list[int], int, int]]:
    """(t, columns, row, polarity) of consecutive events that a vector may hold."""
    runs: list[tuple[int, list[int], int, int]] = []
    for t, x, y, p in events.rows():
        if runs and (t, y, p) == (runs[-1][0], *runs[-1][2:]) and runs[-1][1][-1] < x < runs[-1][1][0] + longest:
            runs[-1][1].append(x)
        else:
            runs.append((t, [x], y, p))
    return runs


def libcaer_cmp(events: Stream) -> bytes:
    """One packet of iniVation's encoding in event_camera_msgs, its time base the first time; runs along columns."""
    words: list[int] = []
    rows, k = events.rows(), 0
    while k < len(rows):
        t, x, y, p = rows[k]
        same = [k]
        while same[-1] + 1 < len(rows) and same[-1] - k < 15:
            t1, x1, y1, p1 = rows[same[-1] + 1]
            if (t1, x1, p1) != (t, x, p) or not rows[same[-1]][2] < y1 < y + 16:
                break
            same.append(same[-1] + 1)
        since = t - rows[0][0]
        words += [since >> 12, 0x1000 | since & 0xFFF, 0x2000 | x]
        if len(same) == 1:
            words.append(0x3000 | p << 11 | y)
        else:
            valid = sum(1 << rows[n][2] - y for n in same)
            words += [0x4000 | p << 11 | y, 0x5000 | valid & 0xFF, 0x5000 | valid >> 8]
        k = same[-1] + 1
    return np.array(words, "<u2").tobytes()


ENCODERS = {
    "evt2": (evt2, "% evt 2.0\n"),
    "evt21": (evt21, "% format EVT21;height=48;width=64;endianness=little\n"),
    "evt21-legacy": (lambda events: evt21(events, legacy=True), "% evt 2.1\n% endianness legacy\n"),
    "evt3": (evt3, "% evt 3.0\n"),
}


def write_raw(path: Path, encoding: str, events: Stream) -> Path:
    encode, header = ENCODERS[encoding]
    path.write_bytes(f"% Date 2026-01-01 10:00:00\n% geometry 64x48\n{header}% end\n".encode() + encode(events))
    return path


# --- others ----------------------------------------------------------------------------------------------------------


def write_dat(path: Path, events: Stream) -> Path:
    records = np.empty((len(events.t), 2), "<u4")
    records[:, 0] = events.t & 0xFFFFFFFF
    records[:, 1] = events.p.astype(np.uint32) << 28 | events.y.astype(np.uint32) << 14 | events.x.astype(np.uint32)
    path.write_bytes(
        b"% Data file containing CD events\n% Height 48\n% Width 64\n" + bytes([12, 8]) + records.tobytes()
    )
    return path


def write_text(path: Path, events: Stream, style: str) -> Path:
    """One of: 'seconds' (with nine decimals), 'us', 'named' (x y p t_ns by name), 'savetxt' (all in exponents)."""
    lines = {
        "seconds": [f"{t // 10**6}.{t % 10**6:06d}000 {x} {y} {p}" for t, x, y, p in events.rows()],
        "us": ["# a comment", *(f"{t} {x} {y} {2 * p - 1}" for t, x, y, p in events.rows())],
        "named": ["x,y,polarity,t_ns", *(f"{x},{y},{p},{t * 1000}" for t, x, y, p in events.rows())],
        "savetxt": [f"{t:.18e} {x:.18e} {y:.18e} {p:.18e}" for t, x, y, p in events.rows()],
    }[style]
    if style == "savetxt":
        lines = ["t_us x y p", *lines]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_npz(path: Path, events: Stream, compressed: bool = False) -> Path:
    save = np.savez_compressed if compressed else np.savez
    save(
        path, t=events.t, x=events.x.astype(np.uint16), y=events.y.astype(np.int32), p=2 * events.p.astype(np.int8) - 1
    )
    return path


def aedat4(events: Stream, packet: int = 40) -> bytes:
    """AEDAT4 without compression: a flatbuffer with the description, then packets that are flatbuffers of events."""
    description = (
        b'<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/"><node name="0" path="/0/">'
        b'<attr key="compression" type="string">NONE</attr><attr key="typeIdentifier" type="string">EVTS</attr>'
        b'<node name="info" path="/0/info/"><attr key="sizeX" type="int">64</attr>'
        b'<attr key="sizeY" type="int">48</attr></node></node></node></dv>'
    )
    header = _header_buffer(description)
    content = b"#!AER-DAT4.0\r\n" + np.array(len(header), "<u4").tobytes() + header
    for start in range(0, len(events.t), packet):
        body = _packet_buffer(Stream(*(values[start : start + packet] for values in vars(events).values())))
        content += np.array([0, len(body) + 4, len(body)], "<i4").tobytes() + body
    return content


def _header_buffer(text: bytes) -> bytes:
    """Table IOHeader: compression (int32, 0), data_table_position (int64, -1), description (string)."""
    padded = text + b"\0" * (4 - len(text) % 4)
    # root offset, identifier, vtable (size 10, table of 24 bytes, fields at 4, 8 and 16), padding, table, string
    vtable = np.array([10, 24, 4, 8, 16], "<u2").tobytes()
    start = 4 + 4 + len(vtable) + 2  # of the table, a multiple of 4
    table = (
        np.array([start - 8, 0], "<i4").tobytes() + np.array([-1], "<i8").tobytes() + np.array([8, 0], "<u4").tobytes()
    )
    return np.array(start, "<u4").tobytes() + b"IOHE" + vtable + b"\0\0" + table + _sized(text, padded)


def _packet_buffer(events: Stream) -> bytes:
    """Table EventPacket: one vector of structs (int64 t, int16 x, int16 y, bool on, 3 bytes of padding)."""
    records = np.zeros(len(events.t), [("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("on", "u1"), ("pad", "V3")])
    records["t"], records["x"], records["y"], records["on"] = events.t, events.x, events.y, events.p
    vtable = np.array([6, 8, 4], "<u2").tobytes()
    start = 4 + 4 + len(vtable) + 2
    table = np.array([start - 8, 8], "<i4").tobytes()  # back to the vtable; forward to the vector, aligned to 8
    count = np.array([0, len(records)], "<u4").tobytes()
    return np.array(start, "<u4").tobytes() + b"EVTS" + vtable + b"\0\0" + table + count + records.tobytes()


def _sized(text: bytes, padded: bytes) -> bytes:
    return np.array(len(text), "<u4").tobytes() + padded
