"""The state of the EVT decoders between blocks, and what it says about the stream; shared by EVT2, EVT2.1 and EVT3."""

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
# Prophesee's own tools and others do. A longer step is left as it is, and reported as time running backwards.
LONGEST_STEP_BACK_US = 10_000


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
