"""The printed surface of a target: reflectance on a grid of rectangles."""

from dataclasses import dataclass

import cv2
import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.targets import AprilGrid, Checkerboard, Target

BLACK, WHITE, BACKGROUND = 0.05, 0.95, 0.25

# Kalibr prints 36h11 tags of 6 x 6 bits within a black border of two.
_TAG_BITS, _BORDER_BITS = 6, 2
_CELLS_PER_TAG = _TAG_BITS + 2 * _BORDER_BITS


@dataclass(frozen=True)
class Pattern:
    """Reflectance of the target's plane, constant on the rectangles between lines.

    `x_lines` (n + 1,), `y_lines` (m + 1,) increasing, metres, target frame; `reflectance` (m, n), row 0 lowest;
    `background` the reflectance outside of the lines.
    """

    x_lines: np.ndarray
    y_lines: np.ndarray
    reflectance: np.ndarray
    background: float = BACKGROUND


def pattern_of(target: Target) -> Pattern:
    """The print of a target with a white quiet margin around it. Raises CalibrationError for an unknown kind."""
    if isinstance(target, Checkerboard):
        return _checkerboard(target)
    if isinstance(target, AprilGrid):
        return _aprilgrid(target)
    raise CalibrationError(
        f"cannot draw a {type(target).__name__}: the simulator knows Checkerboard and AprilGrid. Teach "
        "jaxcal.simulation.pattern.pattern_of how its surface looks."
    )


def _checkerboard(board: Checkerboard) -> Pattern:
    """Cells black and white in turn; the lower left one is black, as in OpenCV's printed board."""
    dx, dy = board.col_spacing or board.spacing, board.spacing
    rows, cols = np.mgrid[: board.rows + 1, : board.cols + 1]
    cells = np.where((rows + cols) % 2 == 0, BLACK, WHITE)
    x = np.arange(-1, board.cols + 1) * dx
    y = np.arange(-1, board.rows + 1) * dy
    return _with_margin(x, y, cells, 0.6 * min(dx, dy))


def _aprilgrid(grid: AprilGrid) -> Pattern:
    """Kalibr's print: tags, and a black square in each gap that touches tags' corners."""
    gap = grid.tag_spacing * grid.tag_size
    x, y = (_aprilgrid_lines(count, grid.tag_size, gap) for count in (grid.cols, grid.rows))
    cells = np.full((len(y) - 1, len(x) - 1), WHITE)
    stride = _CELLS_PER_TAG + 1
    cells[::stride, ::stride] = BLACK
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for tag in range(grid.rows * grid.cols):
        row, col = divmod(tag, grid.cols)
        marker = cv2.aruco.generateImageMarker(dictionary, tag, _CELLS_PER_TAG, borderBits=_BORDER_BITS)
        # OpenCV's marker stands on its head on Kalibr's board, and our rows count upwards: only columns turn around.
        bits = np.where(np.asarray(marker)[:, ::-1] > 0, WHITE, BLACK)
        low, left = 1 + stride * row, 1 + stride * col
        cells[low : low + _CELLS_PER_TAG, left : left + _CELLS_PER_TAG] = bits
    return _with_margin(x, y, cells, 0.15 * grid.tag_size)


def _aprilgrid_lines(count: int, tag_size: float, gap: float) -> np.ndarray:
    """Lines between bits and gaps along one axis, starting and ending with a gap."""
    within = np.arange(_CELLS_PER_TAG + 1) / _CELLS_PER_TAG * tag_size
    tags = [k * (tag_size + gap) + within for k in range(count)]
    return np.concatenate([[-gap], *tags, [tags[-1][-1] + gap]])


def _with_margin(x: np.ndarray, y: np.ndarray, cells: np.ndarray, margin: float) -> Pattern:
    x = np.concatenate([[x[0] - margin], x, [x[-1] + margin]])
    y = np.concatenate([[y[0] - margin], y, [y[-1] + margin]])
    return Pattern(x, y, np.pad(cells, 1, constant_values=WHITE))
