"""The inner loops of the decoders of EVT2, EVT2.1 and EVT3: words to events, with the state that runs on between them.

All that is compiled stands in this one file, because numba keeps compiled programs until their own file changes.
"""

from typing import no_type_check

import numba
import numpy as np

# Places in the state, an int64 array that the numba kernels read and write.
HIGH = 0  # last TIME_HIGH, -1 before the first
LOW = 1  # last TIME_LOW (EVT3)
LOOPS_US = 2  # what the wraps of TIME_HIGH add up to, us
NOW_US = 3  # time of the last event or time word, us, never decreasing but for long steps; -1 before the first
Y = 4  # last row (EVT3)
BASE_X = 5  # column of the next vector (EVT3)
POLARITY = 6  # of vectors (EVT3)
IS_CD = 7  # whether the last row was of change-detection events (EVT3)
STEPS_BACK = 8  # how often time stepped back a little
LARGEST_STEP_BACK_US = 9
UNTIMED = 10  # words of events and triggers before the first time
UNKNOWN = 11  # words of types that the format does not have
SIZE = 12

# A sensor's arbiter lets time step back a little now and then; it then stands still until it has caught up, as
# in faery. A longer step is left as it is, and reported as time running backwards.
LONGEST_STEP_BACK_US = 10_000

_CD_ON, _TIME_HIGH, _TRIGGER = 1, 8, 10
# The 34-bit time of EVT2 and EVT2.1 wraps after 4.8 h. TIME_HIGH (steps of 64 us) that goes down by up to so much (1 s)
# has stepped back rather than wrapped nearly all the way round.
_BACK_STEPS_2 = 15_625

_ADDR_Y, _ADDR_X, _VECT_BASE_X, _VECT_12, _VECT_8, _TIME_LOW = 0, 2, 3, 4, 5, 6
# The 24-bit time of EVT3 wraps after 16.8 s; its TIME_HIGH has steps of 4.1 ms.
_BACK_STEPS_3 = 16


def initial_state() -> np.ndarray:
    """The state at a recording's start."""
    state = np.zeros(SIZE, np.int64)
    state[[HIGH, NOW_US]] = -1
    state[IS_CD] = 1
    return state


def state_remarks(state: np.ndarray) -> list[str]:
    """What was odd so far, in sentences."""
    remarks = []
    if state[STEPS_BACK]:
        remarks.append(
            f"time stepped back {state[STEPS_BACK]} times, by {state[LARGEST_STEP_BACK_US]} us at most; "
            "those events got the time before the step"
        )
    if state[UNTIMED]:
        remarks.append(f"{state[UNTIMED]} words of events or triggers came before the first time and were left out")
    if state[UNKNOWN]:
        remarks.append(f"{state[UNKNOWN]} words are of no known type and were passed over")
    return remarks


# `no_type_check`: a runtime type checker would wrap the loops in code that numba cannot compile.
@numba.njit(cache=True)
@no_type_check
def wrapped(before, now, bits, most_back):
    """How many times a counter of so many bits has wrapped from one value to the next: 0, 1, or -1.

    A value that is up to `most_back` before the last one, perhaps across a wrap, has stepped back; every other one has
    gone forward. `before` -1: there is no value before.
    """
    if before < 0 or now == before:
        return 0
    if (before - now) & ((1 << bits) - 1) <= most_back:
        return -1 if now > before else 0
    return 1 if now < before else 0


@numba.njit(cache=True)
@no_type_check
def held(time, now, counted, state):
    """The time that follows `now`: the new one, or `now` where that has stepped back a little, which may be counted."""
    if time >= now or now - time > LONGEST_STEP_BACK_US:
        return time
    if counted:
        state[STEPS_BACK] += 1
        state[LARGEST_STEP_BACK_US] = max(state[LARGEST_STEP_BACK_US], now - time)
    return now


# --- EVT2, EVT2.1 ----------------------------------------------------------------------------------------------------


@numba.njit(cache=True)
@no_type_check
def count_2(words, valid):
    """How many events and triggers the words hold; `valid` marks a word's events (EVT2: all ones, for one event)."""
    events, triggers = 0, 0
    for index in range(len(words)):
        kind = words[index] >> 28
        if kind <= _CD_ON:
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
def decode_2(words, valid, state, t_ns, x, y, p, trigger_ns, channel, rising):
    """Decode words into the arrays, which hold what `count_2` says; gives the numbers of events and triggers.

    `words` (N,) uint32: EVT2, or the upper halves of EVT2.1, which have the same layout; `valid` (N,) uint32: the lower
    halves of EVT2.1, one bit per column from x on; none (0,) for EVT2. `state` (see above) is carried on from
    block to block. Source: Prophesee, "EVT 2.0 format" and "EVT 2.1 format", and the decoders of OpenEB.
    """
    events, triggers = 0, 0
    high, loops, now = state[HIGH], state[LOOPS_US], state[NOW_US]
    for index in range(len(words)):
        word = np.int64(words[index])
        kind = word >> 28
        if kind <= _CD_ON or kind == _TRIGGER:
            if high < 0:
                state[UNTIMED] += 1
                continue
            time = loops + (high << 6) + ((word >> 22) & 0x3F)
            now = held(time, now, True, state)
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
            loops += wrapped(high, content, 28, _BACK_STEPS_2) << 34
            high = content
        elif kind not in (14, 15):
            state[UNKNOWN] += 1
    state[HIGH], state[LOOPS_US], state[NOW_US] = high, loops, now
    return events, triggers


# --- EVT3 ------------------------------------------------------------------------------------------------------------


@numba.njit(cache=True)
@no_type_check
def count_3(words):
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
def decode_3(words, state, t_ns, x, y, p, trigger_ns, channel, rising):
    """Decode words into the arrays, which hold what `count_3` says; gives the numbers of events and triggers.

    `state` (see above) is carried on from block to block. Source: Prophesee, "EVT 3.0 format", and the decoder of
    OpenEB.
    """
    events, triggers = 0, 0
    high, low, loops, now = state[HIGH], state[LOW], state[LOOPS_US], state[NOW_US]
    row, base, polarity, is_cd = state[Y], state[BASE_X], state[POLARITY], state[IS_CD]
    for raw in words:
        word = np.int64(raw)
        kind, content = word >> 12, word & 0xFFF
        if kind in (_VECT_12, _VECT_8, _ADDR_X):
            if kind == _ADDR_X:
                bits, column, rise = 1, content & 0x7FF, content >> 11
            else:
                bits, column, rise = content & (0xFFF if kind == _VECT_12 else 0xFF), base, polarity
                base += 12 if kind == _VECT_12 else 8
            if now < 0:
                state[UNTIMED] += 1
                continue
            while bits and is_cd:
                if bits & 1:
                    t_ns[events] = now * 1000
                    x[events] = column
                    y[events] = row
                    p[events] = rise
                    events += 1
                bits >>= 1
                column += 1
        elif kind == _ADDR_Y:
            row = content & 0x7FF
            is_cd = 1
        elif kind in (_TIME_LOW, _TIME_HIGH):
            if kind == _TIME_LOW:
                low = content
            elif content != high:
                loops += wrapped(high, content, 12, _BACK_STEPS_3) << 24
                high, low = content, 0  # the TIME_LOW that belongs to it comes next
            # The first time is known when both parts are: a TIME_HIGH alone may be 4 ms early.
            if high >= 0 and (now >= 0 or kind == _TIME_LOW):
                now = held(loops + (high << 12) + low, now, kind == _TIME_LOW, state)
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
