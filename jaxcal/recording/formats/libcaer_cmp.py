"""The compressed encoding of iniVation cameras in event_camera_msgs: 16-bit words, vectors along columns."""

import numpy as np

from jaxcal.recording.formats.contract import EventColumns

_TIME_HIGH, _TIME_LOW, _ADDR_X, _ADDR_Y, _VECT_BASE_Y, _VECT_8 = range(6)


def decode_packet(content: bytes | memoryview, time_base_ns: int) -> EventColumns:
    """The events of one packet; each packet stands for itself.

    Times are whole microseconds from `time_base_ns` on. Source: event_camera_codecs, libcaer_cmp_decoder.h.
    """
    words = np.frombuffer(content, "<u2", len(content) // 2).astype(np.int64)
    kind, value = words >> 12, words & 0xFFF
    since_us = (_held(value, kind == _TIME_HIGH) << 12) + _held(value, kind == _TIME_LOW)
    x = _held(value, kind == _ADDR_X) & 0x7FF
    is_base, is_vector = kind == _VECT_BASE_Y, kind == _VECT_8
    base = _held(value, is_base)
    # Each vector goes on 8 rows behind the one before it.
    vectors = np.cumsum(is_vector)
    before = vectors - is_vector - _held(vectors, is_base)
    single = kind == _ADDR_Y
    row = np.where(single, value & 0x7FF, (base & 0x7FF) + 8 * before)
    polarity = np.where(single, value >> 11, base >> 11)
    valid = np.where(single, 1, np.where(is_vector, value & 0xFF, 0))
    word, bit = np.nonzero(valid[:, None] >> np.arange(8) & 1)
    return EventColumns(
        0,
        since_us[word] * 1000 + time_base_ns,
        x[word].astype(np.uint16),
        (row[word] + bit).astype(np.uint16),
        polarity[word].astype(bool),
    )


def _held(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """At each place the last of the values so far that is marked; 0 before the first."""
    last = np.maximum.accumulate(np.where(where, np.arange(len(values)), -1)) if len(values) else values
    return np.where(last >= 0, values[last], 0)
