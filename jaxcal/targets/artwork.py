"""What is printed on a target: rectangles and discs, black on white, in the target frame."""

from dataclasses import dataclass

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.targets.base import Target
from jaxcal.targets.charuco import DICTIONARIES, Charuco
from jaxcal.targets.circles import CircleGrid
from jaxcal.targets.grids import AprilGrid, Checkerboard

# Kalibr prints 36h11 tags of 6 x 6 bits within a black border of two.
_TAG_BITS, _BORDER_BITS = 6, 2
_CELLS_PER_TAG = _TAG_BITS + 2 * _BORDER_BITS
_MARKER_BORDER_BITS = 1  # of ChArUco markers, as OpenCV prints and expects them


@dataclass(frozen=True)
class DiscLattice:
    """Equal discs on a rectangular lattice: lowest left centre (x, y), pitch along x and y, numbers along x and y."""

    origin: tuple[float, float]
    pitch: tuple[float, float]
    count: tuple[int, int]
    radius: float

    @property
    def centres(self) -> np.ndarray:
        """Centres (count_x * count_y, 2), metres."""
        x, y = (o + p * np.arange(n) for o, p, n in zip(self.origin, self.pitch, self.count, strict=True))
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Artwork:
    """Print on the target's plane, white where nothing is said, with a white quiet margin around it.

    `x_lines` (n + 1,), `y_lines` (m + 1,) increasing, metres, target frame; `black` (m, n), row 0 lowest: which of
    the rectangles between the lines are black; `discs` black discs on white.
    """

    x_lines: np.ndarray
    y_lines: np.ndarray
    black: np.ndarray
    discs: tuple[DiscLattice, ...] = ()


def artwork_of(target: Target) -> Artwork:
    """The print of one board. Raises CalibrationError for several boards and for an unknown kind."""
    if isinstance(target, Checkerboard):
        return _checkerboard(target)
    if isinstance(target, AprilGrid):
        return _aprilgrid(target)
    if isinstance(target, CircleGrid):
        return _circle_grid(target)
    if isinstance(target, Charuco):
        return _charuco(target)
    if len(target.boards) > 1:
        raise CalibrationError("cannot draw several boards as one; draw each of its `boards`.")
    raise CalibrationError(
        f"cannot draw a {type(target).__name__}: known are Checkerboard, AprilGrid, CircleGrid and Charuco. Teach "
        "jaxcal.targets.artwork.artwork_of how its surface looks."
    )


def _checkerboard(board: Checkerboard) -> Artwork:
    """Cells black and white in turn; the lower left one is black, as in OpenCV's printed board."""
    dx, dy = board.col_spacing or board.spacing, board.spacing
    rows, cols = np.mgrid[: board.rows + 1, : board.cols + 1]
    x = np.arange(-1, board.cols + 1) * dx
    y = np.arange(-1, board.rows + 1) * dy
    return _with_margin(x, y, (rows + cols) % 2 == 0, 0.6 * min(dx, dy))


def _aprilgrid(grid: AprilGrid) -> Artwork:
    """Kalibr's print: tags, and a black square in each gap that touches tags' corners."""
    gap = grid.tag_spacing * grid.tag_size
    x, y = (_aprilgrid_lines(count, grid.tag_size, gap) for count in (grid.cols, grid.rows))
    black = np.zeros((len(y) - 1, len(x) - 1), bool)
    stride = _CELLS_PER_TAG + 1
    black[::stride, ::stride] = True
    for number, tag in enumerate(grid.ids):
        row, col = divmod(number, grid.cols)
        marker = _marker("DICT_APRILTAG_36h11", tag, _BORDER_BITS)
        low, left = 1 + stride * row, 1 + stride * col
        # OpenCV's marker stands on its head on Kalibr's board, and our rows count upwards: only columns turn around.
        black[low : low + _CELLS_PER_TAG, left : left + _CELLS_PER_TAG] = marker[:, ::-1]
    return _with_margin(x, y, black, 0.15 * grid.tag_size)


def _aprilgrid_lines(count: int, tag_size: float, gap: float) -> np.ndarray:
    """Lines between bits and gaps along one axis, starting and ending with a gap."""
    within = np.arange(_CELLS_PER_TAG + 1) / _CELLS_PER_TAG * tag_size
    tags = [k * (tag_size + gap) + within for k in range(count)]
    return np.concatenate([[-gap], *tags, [tags[-1][-1] + gap]])


def _charuco(board: Charuco) -> Artwork:
    """Black squares, and in each white one its marker, upright."""
    bits = DICTIONARIES[board.dictionary][0] + 2 * _MARKER_BORDER_BITS
    rim = (board.square_size - board.marker_size) / 2.0
    within = np.concatenate([[0.0], rim + np.arange(bits) / bits * board.marker_size, [board.square_size - rim]])
    x, y = (
        np.append(np.add.outer(np.arange(count) - 1, within / board.square_size).ravel(), count - 1) * board.square_size
        for count in (board.cols, board.rows)
    )
    stride = bits + 2
    black = np.zeros((board.rows * stride, board.cols * stride), bool)  # row 0 at the top, as OpenCV counts
    ids = iter(board.ids)
    for (row, col), white in np.ndenumerate(board.white_squares):
        top, left = stride * row, stride * col
        if white:
            marker = _marker(board.dictionary, next(ids), _MARKER_BORDER_BITS)
            black[top + 1 : top + 1 + bits, left + 1 : left + 1 + bits] = marker
        else:
            black[top : top + stride, left : left + stride] = True
    return _with_margin(x, y, black[::-1], 0.6 * board.square_size)


def _circle_grid(grid: CircleGrid) -> Artwork:
    """Discs on white; a margin of one spacing beyond the outer centres, and more where circles are large."""
    s, radius = grid.spacing, grid.circle_diameter / 2.0
    if grid.asymmetric:
        even, odd = -(-grid.rows // 2), grid.rows // 2
        discs = (
            DiscLattice((0.0, 0.0), (2.0 * s, 2.0 * s), (grid.cols, even), radius),
            DiscLattice((s, s), (2.0 * s, 2.0 * s), (grid.cols, odd), radius),
        )
    else:
        discs = (DiscLattice((0.0, 0.0), (s, s), (grid.cols, grid.rows), radius),)
    reach = grid.points[:, :2].max(axis=0)
    margin = max(s, radius + 0.5 * s)
    x, y = (np.array([-margin, end + margin]) for end in reach)
    return Artwork(x, y, np.zeros((1, 1), bool), discs)


def _marker(dictionary: str, number: int, border_bits: int) -> np.ndarray:
    """Which cells of a marker are black, border included, as OpenCV draws it (row 0 at the top)."""
    import cv2  # only for drawing: targets themselves are light

    codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    cells = DICTIONARIES[dictionary][0] + 2 * border_bits
    return np.asarray(cv2.aruco.generateImageMarker(codes, number, cells, borderBits=border_bits)) == 0


def _with_margin(x: np.ndarray, y: np.ndarray, black: np.ndarray, margin: float) -> Artwork:
    x = np.concatenate([[x[0] - margin], x, [x[-1] + margin]])
    y = np.concatenate([[y[0] - margin], y, [y[-1] + margin]])
    return Artwork(x, y, np.pad(black, 1))
