"""Colour event cameras: each colour of the Bayer filter reconstructed by itself, then merged, as E2VID's `--color`."""

from collections.abc import Mapping

import numpy as np

from jaxcal.errors import CalibrationError

BAYER_PATTERNS = ("rggb", "bggr", "grbg", "gbrg")


def bayer_places(pattern: str, width: int, height: int) -> dict[str, tuple[int, int]]:
    """The four colours of a filter, 'r', 'b' and twice green ('g', 'w'), each with its (row, column) of the 2x2 block.

    Raises CalibrationError when the pattern is unknown or the sensor's size is odd.
    """
    if pattern not in BAYER_PATTERNS:
        raise CalibrationError(f"Reconstructor: bayer is {pattern!r}; expected one of {', '.join(BAYER_PATTERNS)}.")
    if width % 2 or height % 2:
        raise CalibrationError(f"Reconstructor: a sensor of {width}x{height} pixels has no whole Bayer blocks.")
    second_green = pattern.rindex("g")
    letters = pattern[:second_green] + "w" + pattern[second_green + 1 :]
    return {letter: divmod(place, 2) for place, letter in enumerate(letters)}


def merged(grey: np.ndarray, planes: Mapping[str, tuple[np.ndarray, int, int]]) -> np.ndarray:
    """The colour image (H, W, 3), BGR: brightness of the image of all pixels, colour of the planes at half the size.

    `grey` uint8 (H, W); `planes` by colour ('r', 'g', 'w', 'b'): uint8 (H/2, W/2), and the row and column of its pixels
    in each block. Planes are interpolated linearly, each from where its pixels lie.
    """
    import cv2  # not needed otherwise

    height, width = grey.shape

    def spread(colour: str) -> np.ndarray:
        plane, row, column = planes[colour]
        # Where in the plane each pixel of the whole image lies.
        place = np.array([[0.5, 0.0, -0.5 * column], [0.0, 0.5, -0.5 * row]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(plane, place, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)

    green = cv2.addWeighted(spread("g"), 0.5, spread("w"), 0.5, 0.0)
    # In YCrCb, not in Lab as E2VID has it: read as a grey image again, it is then the one that came in.
    luma = cv2.cvtColor(np.dstack([spread("b"), green, spread("r")]), cv2.COLOR_BGR2YCrCb)
    luma[:, :, 0] = grey
    return np.asarray(cv2.cvtColor(luma, cv2.COLOR_YCrCb2BGR), dtype=np.uint8)
