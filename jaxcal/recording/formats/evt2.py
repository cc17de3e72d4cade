"""Prophesee EVT2 and EVT2.1: 32-bit words of one event, 64-bit words of up to 32 events of a row."""

from typing import no_type_check

import numba
import numpy as np

from jaxcal.recording.formats.evt_state import (
    HIGH,
    LARGEST_STEP_BACK_US,
    LONGEST_STEP_BACK_US,
    LOOPS_US,
    NOW_US,
    STEPS_BACK,
    UNKNOWN,
    UNTIMED,
)
from jaxcal.recording.formats.evt_wraps import wrapped

WORD_2 = np.dtype("<u4")
WORD_21 = np.dtype("<u8")

_OFF, _ON, _TIME_HIGH, _TRIGGER = 0, 1, 8, 10
# The 34-bit time wraps after 4.8 h. TIME_HIGH (steps of 64 us) that goes down by up to so much (1 s) has stepped back.
_BACK_STEPS = 15_625


# `no_type_check`: a runtime type checker would wrap the loops in code that numba cannot compile.
@numba.njit(cache=True)
@no_type_check
def count(words, valid):
    """How many events and triggers the words hold; `valid` marks a word's events (EVT2: all ones, for one event)."""
    events, triggers = 0, 0
    for index in range(len(words)):
        kind = words[index] >> 28
        if kind <= _ON:
            if len(valid):
                bits = valid[index]
                while bits:
                    bits &= bits - np.uint32(1)
                    events += 1
            else:
                events += 1
        elif kind == _TRIGGER:
            triggers += 1
    return events, triggers


@numba.njit(cache=True)
@no_type_check
def decode(words, valid, state, t_ns, x, y, p, trigger_ns, channel, rising):
    """Decode words into the arrays, which hold what `count` says; gives the numbers of events and triggers.

    `words` (N,) uint32: EVT2, or the upper halves of EVT2.1, which have the same layout; `valid` (N,) uint32: the lower
    halves of EVT2.1, one bit per column from x on; none (0,) for EVT2. `state` (see `evt_state`) is carried on from
    block to block. Source: Prophesee, "EVT 2.0 format" and "EVT 2.1 format", and the decoders of OpenEB.
    """
    events, triggers = 0, 0
    high, loops, now = state[HIGH], state[LOOPS_US], state[NOW_US]
    for index in range(len(words)):
        word = np.int64(words[index])
        kind = word >> 28
        if kind <= _ON or kind == _TRIGGER:
            if high < 0:
                state[UNTIMED] += 1
                continue
            time = loops + (high << 6) + ((word >> 22) & 0x3F)
            if time < now and now - time <= LONGEST_STEP_BACK_US:
                state[STEPS_BACK] += 1
                state[LARGEST_STEP_BACK_US] = max(state[LARGEST_STEP_BACK_US], now - time)
            else:
                now = time
            if kind == _TRIGGER:
                trigger_ns[triggers] = now * 1000
                channel[triggers] = (word >> 8) & 0x1F
                rising[triggers] = word & 1
                triggers += 1
                continue
            column = (word >> 11) & 0x7FF
            bits = np.int64(valid[index]) if len(valid) else np.int64(1)
            while bits:
                if bits & 1:
                    t_ns[events] = now * 1000
                    x[events] = column
                    y[events] = word & 0x7FF
                    p[events] = kind
                    events += 1
                bits >>= 1
                column += 1
        elif kind == _TIME_HIGH:
            content = word & 0xFFFFFFF
            loops += wrapped(high, content, 28, _BACK_STEPS) << 34
            high = content
        elif kind not in (14, 15):
            state[UNKNOWN] += 1
    state[HIGH], state[LOOPS_US], state[NOW_US] = high, loops, now
    return events, triggers
