"""The printed surface of a target: reflectance on a grid of rectangles, and dark discs."""

from dataclasses import dataclass

import numpy as np

from jaxcal.targets import DiscLattice, Target, artwork_of

BLACK, WHITE, BACKGROUND = 0.05, 0.95, 0.25


@dataclass(frozen=True)
class Pattern:
    """Reflectance of the target's plane, constant on the rectangles between lines.

    `x_lines` (n + 1,), `y_lines` (m + 1,) increasing, metres, target frame; `reflectance` (m, n), row 0 lowest;
    `background` the reflectance outside of the lines; `discs` in black on white rectangles.
    """

    x_lines: np.ndarray
    y_lines: np.ndarray
    reflectance: np.ndarray
    background: float = BACKGROUND
    discs: tuple[DiscLattice, ...] = ()


def pattern_of(target: Target) -> Pattern:
    """The print of a board with a white quiet margin around it. Raises CalibrationError for what is no single board."""
    artwork = artwork_of(target)
    reflectance = np.where(artwork.black, BLACK, WHITE)
    return Pattern(artwork.x_lines, artwork.y_lines, reflectance, discs=artwork.discs)
