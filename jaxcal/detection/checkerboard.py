"""Checkerboard corners in one image: find the board, number its corners the same way every time, refine them."""

from collections.abc import Iterator

import cv2
import numpy as np

from jaxcal.detection.pattern_fit import fitted_corners
from jaxcal.detection.refine import refine_corners
from jaxcal.targets import Checkerboard

# CALIB_CB_ACCURACY doubles the time and is undone by the refinement; CALIB_CB_EXHAUSTIVE takes a second for an image
# without a board and found no board more, in real images and in noise of 30 grey levels.
_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE
_MAX_HALF_WINDOW = 10
_ENOUGH_ALTERNATE, _ENOUGH_ON_A_SIDE = 0.8, 0.5
_CLEAR_GAP = 0.25  # between the two colours at a corner, of all contrast there
_REACH = 0.4  # of the distance to the nearest corner


def find_checkerboard(image: np.ndarray, target: Checkerboard) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the board in a grey uint8 image: (K,) indices into `target.points`, (K, 2) pixels; K may be 0.

    The board is found as a whole or not at all (`cv2.findChessboardCornersSB`: Duda & Frese 2018); each corner is then
    refined on the original image, and single ones that refinement or their neighbours contradict are left out.

    Numbering: as seen on the board, row by row from the lower left, never mirrored. Where the board's two ends differ
    in colour (rows + cols odd), "lower left" is where the outer square is black, so that a corner has one number in
    all cameras and at any roll. Other boards look the same upside down: of the two numberings, the one nearest to
    upright in the image is taken, and cameras must not be rolled by 90 degrees or more against each other.
    """
    grid = _find(image, target)
    if grid is None:
        return np.empty(0, np.int64), np.empty((0, 2))
    grid = _canonical(image, grid)
    corners = grid.reshape(-1, 2)
    refined, trusted = refine_corners(image, corners, _half_windows(grid).ravel())
    point = np.flatnonzero(trusted)
    board, reach = target.points[point, :2], (_REACH * (target.col_spacing or target.spacing), _REACH * target.spacing)
    pixels, keep = fitted_corners(image, board, refined[point], reach)
    return point[keep], pixels[keep]


def _find(image: np.ndarray, target: Checkerboard) -> np.ndarray | None:
    """The board's corners as a grid (rows, cols, 2), in any orientation; None where there is no board."""
    for prepared in _attempts(image):
        found, corners = cv2.findChessboardCornersSB(prepared, (target.cols, target.rows), flags=_FLAGS)
        if found:
            grid = np.asarray(corners, np.float64).reshape(target.rows, target.cols, 2)
            if _colours_alternate(prepared, grid):
                return grid
    return None


def _colours_alternate(image: np.ndarray, grid: np.ndarray) -> bool:
    """Whether opposite squares at a corner are alike and neighbours differ, at nearly all corners, along each side too.

    Boards of three rows are sometimes found one square off, and boards of one row less than asked for with a row too
    many: then the board's outline is among the corners.
    """
    along, up = np.gradient(grid, axis=1) * 0.3, np.gradient(grid, axis=0) * 0.3
    squares = np.stack([grid + along + up, grid - along - up, grid + along - up, grid - along + up])
    grey = _grey_at(image, squares)
    one, other = grey[:2], grey[2:]
    # On the outline only one square of four is black: by chance the noisy whites lie either way, but not far apart.
    gap = np.maximum(other.min(axis=0) - one.max(axis=0), one.min(axis=0) - other.max(axis=0))
    alternate = gap > _CLEAR_GAP * np.ptp(grey, axis=0)
    sides = (alternate[0], alternate[-1], alternate[:, 0], alternate[:, -1])
    return bool(alternate.mean() > _ENOUGH_ALTERNATE and min(side.mean() for side in sides) > _ENOUGH_ON_A_SIDE)


def _grey_at(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Grey levels (...) of a slightly blurred image at pixels (..., 2)."""
    u, v = np.moveaxis(places.reshape(-1, 1, 2).astype(np.float32), -1, 0)
    smooth = cv2.GaussianBlur(image, (0, 0), 1.5)
    grey = cv2.remap(smooth, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return grey.reshape(places.shape[:-1]).astype(np.float64)


def _attempts(image: np.ndarray) -> Iterator[np.ndarray]:
    """The image, prepared in several ways, the most fruitful first."""
    yield image
    yield cv2.createCLAHE(clipLimit=4.0, tileGridSize=(4, 4)).apply(cv2.GaussianBlur(image, (0, 0), 1.5))


def _canonical(image: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """The same grid, numbered from the lower left as `find_checkerboard` says."""
    rows, cols, _ = grid.shape
    turned = [grid, grid.transpose(1, 0, 2)] if rows == cols else [grid]
    variants = [variant[::up, ::right] for variant in turned for up in (1, -1) for right in (1, -1)]
    seen_from_front = [variant for variant in variants if _handedness(variant) < 0.0]
    return max(seen_from_front, key=lambda variant: (_lower_left_is_black(image, variant), _uprightness(variant)))


def _handedness(grid: np.ndarray) -> float:
    """Sign of the turn from columns to rows in the image, whose v axis points down: negative seen from the front."""
    along, up = _mean_directions(grid)
    return float(along[0] * up[1] - along[1] * up[0])


def _uprightness(grid: np.ndarray) -> float:
    """How far columns run to the right and rows upwards in the image: 2 when upright, -2 upside down."""
    along, up = _mean_directions(grid)
    return float(along[0] / np.linalg.norm(along) - up[1] / np.linalg.norm(up))


def _mean_directions(grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.diff(grid, axis=1).mean(axis=(0, 1)), np.diff(grid, axis=0).mean(axis=(0, 1))


def _lower_left_is_black(image: np.ndarray, grid: np.ndarray) -> bool:
    """Whether the square outside the first corner is black: all squares between the corners are asked."""
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4.0
    grey = _grey_at(image, centres)
    # The square between the first four corners touches the outer one at a corner, so it has the same colour.
    same = np.indices(grey.shape).sum(axis=0) % 2 == 0
    return bool(grey[same].mean() < grey[~same].mean())


def _half_windows(grid: np.ndarray) -> np.ndarray:
    """Half-width (rows, cols) of the refinement windows: well short of the nearest neighbour."""
    nearest = np.full(grid.shape[:2], np.inf)
    along = np.linalg.norm(np.diff(grid, axis=1), axis=2)
    up = np.linalg.norm(np.diff(grid, axis=0), axis=2)
    nearest[:, 1:] = np.minimum(nearest[:, 1:], along)
    nearest[:, :-1] = np.minimum(nearest[:, :-1], along)
    nearest[1:] = np.minimum(nearest[1:], up)
    nearest[:-1] = np.minimum(nearest[:-1], up)
    return np.clip(np.floor(nearest * _REACH), 2, _MAX_HALF_WINDOW).astype(np.int64)
