"""The one exception family of jaxcal."""


class CalibrationError(Exception):
    """Something about the input or the problem makes a calibration impossible.

    The message names the file or array, the place in it, what was expected and what to do about it.
    """
