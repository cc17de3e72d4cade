"""Prophesee EVT3: 16-bit words, with rows, times and polarities that hold until they change."""

from typing import no_type_check

import numba
import numpy as np

from jaxcal.recording.formats.evt_state import (
    BASE_X,
    HIGH,
    IS_CD,
    LARGEST_STEP_BACK_US,
    LONGEST_STEP_BACK_US,
    LOOPS_US,
    LOW,
    NOW_US,
    POLARITY,
    STEPS_BACK,
    UNKNOWN,
    UNTIMED,
    Y,
)
from jaxcal.recording.formats.evt_wraps import wrapped

WORD = np.dtype("<u2")

_ADDR_Y, _ADDR_X, _VECT_BASE_X, _VECT_12, _VECT_8, _TIME_LOW, _TIME_HIGH, _TRIGGER = 0, 2, 3, 4, 5, 6, 8, 10
# The 24-bit time wraps after 16.8 s. TIME_HIGH (steps of 4.1 ms) that goes down by up to so much has stepped back
# rather than wrapped nearly all the way round.
_BACK_STEPS = 16


# `no_type_check`: a runtime type checker would wrap the loops in code that numba cannot compile.
@numba.njit(cache=True)
@no_type_check
def count(words):
    """How many events and triggers the words hold at most."""
    events, triggers = 0, 0
    for word in words:
        kind = word >> 12
        if kind == _ADDR_X:
            events += 1
        elif kind in (_VECT_12, _VECT_8):
            valid = word & (0xFFF if kind == _VECT_12 else 0xFF)
            while valid:
                valid &= valid - 1
                events += 1
        elif kind == _TRIGGER:
            triggers += 1
    return events, triggers


@numba.njit(cache=True)
@no_type_check
def decode(words, state, t_ns, x, y, p, trigger_ns, channel, rising):
    """Decode words into the arrays, which hold what `count` says; gives the numbers of events and triggers.

    `state` (see `evt_state`) is carried on from block to block. Source: Prophesee, "EVT 3.0 format", and the decoder of
    OpenEB.
    """
    events, triggers = 0, 0
    high, low, loops, now = state[HIGH], state[LOW], state[LOOPS_US], state[NOW_US]
    row, base, polarity, is_cd = state[Y], state[BASE_X], state[POLARITY], state[IS_CD]
    for raw in words:
        word = np.int64(raw)
        kind, content = word >> 12, word & 0xFFF
        if kind in (_VECT_12, _VECT_8):
            width = 12 if kind == _VECT_12 else 8
            if now >= 0 and is_cd:
                for bit in range(width):
                    if (content >> bit) & 1:
                        t_ns[events] = now * 1000
                        x[events] = base + bit
                        y[events] = row
                        p[events] = polarity
                        events += 1
            elif now < 0:
                state[UNTIMED] += 1
            base += width
        elif kind == _ADDR_X:
            if now >= 0 and is_cd:
                t_ns[events] = now * 1000
                x[events] = content & 0x7FF
                y[events] = row
                p[events] = content >> 11
                events += 1
            elif now < 0:
                state[UNTIMED] += 1
        elif kind == _ADDR_Y:
            row = content & 0x7FF
            is_cd = 1
        elif kind in (_TIME_LOW, _TIME_HIGH):
            if kind == _TIME_LOW:
                low = content
            elif content != high:
                loops += wrapped(high, content, 12, _BACK_STEPS) << 24
                high, low = content, 0  # the TIME_LOW that belongs to it comes next
            # The first time is known when both parts are: a TIME_HIGH alone may be 4 ms early.
            if high >= 0 and (now >= 0 or kind == _TIME_LOW):
                time = loops + (high << 12) + low
                if time < now and now - time <= LONGEST_STEP_BACK_US:
                    if kind == _TIME_LOW:
                        state[STEPS_BACK] += 1
                        state[LARGEST_STEP_BACK_US] = max(state[LARGEST_STEP_BACK_US], now - time)
                else:
                    now = time
        elif kind == _VECT_BASE_X:
            base, polarity = content & 0x7FF, content >> 11
        elif kind == _TRIGGER:
            if now >= 0:
                trigger_ns[triggers] = now * 1000
                channel[triggers] = content >> 8
                rising[triggers] = content & 1
                triggers += 1
            else:
                state[UNTIMED] += 1
        elif kind == 1:  # a row of exposure measurement (ATIS): the columns behind it are no change-detection events
            is_cd = 0
        elif kind in (9, 11, 12, 13):
            state[UNKNOWN] += 1
    state[HIGH], state[LOW], state[LOOPS_US], state[NOW_US] = high, low, loops, now
    state[Y], state[BASE_X], state[POLARITY], state[IS_CD] = row, base, polarity, is_cd
    return events, triggers
