"""The text decoder's inner loop: lines of numbers to columns of events, exactly, without floating point."""

from typing import no_type_check

import numba
import numpy as np

# Roles of a column of text.
TIME, X, Y, POLARITY, IGNORED = 0, 1, 2, 3, -1

_MINUS, _PLUS, _DOT, _NEWLINE, _E_LOWER, _E_UPPER = 45, 43, 46, 10, 101, 69
_SPACE, _TAB, _RETURN, _COMMA, _SEMICOLON, _HASH, _PERCENT = 32, 9, 13, 44, 59, 35, 37
_DIGITS = 18  # what fits int64 for sure


# `no_type_check`: a runtime type checker would wrap the loops in code that numba cannot compile.
@numba.njit(cache=True)
@no_type_check
def _number(text, place):
    """The number at a place: (value, decimal exponent, place behind it); the same place back where there is none."""
    start, sign = place, 1
    if text[place] in (_MINUS, _PLUS):
        sign = -1 if text[place] == _MINUS else 1
        place += 1
    mantissa, digits, exponent, fraction, any_digit = 0, 0, 0, False, False
    while 48 <= text[place] <= 57 or (text[place] == _DOT and not fraction):
        if text[place] == _DOT:
            fraction = True
        else:
            any_digit = True
            if digits < _DIGITS:
                mantissa = mantissa * 10 + np.int64(text[place] - 48)
                digits += 1 if mantissa else 0
                exponent -= 1 if fraction else 0
            elif not fraction:
                exponent += 1
        place += 1
    if not any_digit:
        return 0, 0, start
    if text[place] in (_E_LOWER, _E_UPPER):
        place += 1
        power, power_sign = 0, -1 if text[place] == _MINUS else 1
        if text[place] in (_MINUS, _PLUS):
            place += 1
        while 48 <= text[place] <= 57 and power < 1000:
            power = power * 10 + np.int64(text[place] - 48)
            place += 1
        exponent += power_sign * power
    return sign * mantissa, exponent, place


@numba.njit(cache=True)
@no_type_check
def _whole(value, exponent, rounded):
    """value * 10**exponent as a whole number, and whether it is one (or was rounded, which is allowed for times)."""
    sign, size = (-1, -value) if value < 0 else (1, value)
    while exponent < 0 and size:
        if size % 10 and not rounded:
            return 0, False
        size = (size + (5 if exponent == -1 else 0)) // 10
        exponent += 1
    while exponent > 0 and size:
        if size > 922_337_203_685_477_579:
            return 0, False
        size *= 10
        exponent -= 1
    return sign * size, True


@numba.njit(cache=True)
@no_type_check
def parse(text, roles, exponent, t_ns, x, y, p):
    """Parse whole lines into the arrays; gives (events, lines, place): `place` of the first bad line, or -1.

    `text` (N,) uint8, ending in a newline; `roles` (C,) of each line's columns; `exponent`: a time t means
    t * 10**exponent ns. Lines that are blank or start with # or % are passed over. Times are rounded to nanoseconds;
    fractions of a pixel and polarities other than 0, 1 and -1 are bad.
    """
    events, lines, place = 0, 0, 0
    while place < len(text):
        start = place
        while text[place] in (_SPACE, _TAB, _RETURN):
            place += 1
        if text[place] in (_NEWLINE, _HASH, _PERCENT):
            while text[place] != _NEWLINE:
                place += 1
            place, lines = place + 1, lines + 1
            continue
        column = 0
        while text[place] != _NEWLINE:
            value, power, behind = _number(text, place)
            if behind == place or column >= len(roles):
                return events, lines, start
            role, place = roles[column], behind
            value, good = _whole(value, power + (exponent if role == TIME else 0), role == TIME)
            if role == TIME:
                t_ns[events] = value
            elif role == X:
                x[events] = value
                good &= 0 <= value <= 65_535
            elif role == Y:
                y[events] = value
                good &= 0 <= value <= 65_535
            elif role == POLARITY:
                p[events] = value == 1
                good &= -1 <= value <= 1
            if not good and role != IGNORED:
                return events, lines, start
            column += 1
            behind = place
            while text[place] in (_SPACE, _TAB, _RETURN, _COMMA, _SEMICOLON):
                place += 1
            if place == behind and text[place] != _NEWLINE:
                return events, lines, start
        if column != len(roles):
            return events, lines, start
        events, lines, place = events + 1, lines + 1, place + 1
    return events, lines, -1
