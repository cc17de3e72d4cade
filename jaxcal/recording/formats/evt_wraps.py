"""When the time counters of EVT2, EVT2.1 and EVT3 have wrapped, and when they have only stepped back."""

from typing import no_type_check

import numba


# `no_type_check`: a runtime type checker would wrap the code in what numba cannot compile.
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
