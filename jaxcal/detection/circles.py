"""Centres of a grid of circles in one image: find the blobs, number them, and measure each in the board's plane."""

import itertools
from collections.abc import Iterator

import cv2
import numpy as np

from jaxcal.detection.homography import apply_homography, fit_homography
from jaxcal.detection.outliers import agreeing_corners
from jaxcal.targets import CircleGrid

_MIN_AREA_PX = 12.0
_NEIGHBOURS = 12  # circles whose homography tells how the board lies around one of them
_PASSES = 3
_MAX_MISFIT = 0.3  # of the distance between circles
_WHITE_FROM = 0.8  # of the way to the middle between two circles: further out, paper is white
_MIN_CONTRAST = 10.0  # grey levels between paper and circle
_MARGIN_PX = 2.5  # what blur adds to a circle's radius
_MAX_SIDE = 64  # samples along the side of a patch


def find_circle_grid(image: np.ndarray, target: CircleGrid) -> tuple[np.ndarray, np.ndarray]:
    """Circle centres in a grey uint8 image: (K,) indices into `target.points`, (K, 2) pixels; K may be 0.

    The grid is found as a whole or not at all (`cv2.findCirclesGrid`). A circle seen at an angle is an ellipse whose
    centre is NOT the image of the circle's centre (Heikkila 2000, "Geometric camera calibration using circular control
    points"): by r^2 / 4 times the curvature of the map from board to image, some tenths of a pixel for large circles
    seen closely and obliquely. Here each circle's centre of darkness is taken in the board's plane, rectified by the
    homography of its neighbours, so that this bias is gone but for its change from one circle to the next; and it is
    taken relative to the light around the circle.

    Numbering: as seen on the board, row by row from the lower left, never mirrored. A grid that looks the same upside
    down (any symmetric one; an asymmetric one with an even number of rows) is numbered nearest to upright in the image,
    and cameras must not be rolled by 90 degrees (square symmetric grids: 45) or more against each other.
    """
    for prepared in _attempts(image):
        found = _found(prepared, target)
        if found is not None:
            numbered = _numbered(found, target)
            if numbered is None:
                continue
            centres, trusted = _measured(image, numbered, target)
            point = np.flatnonzero(trusted)
            keep = agreeing_corners(target.points[point, :2], centres[point], (image.shape[1], image.shape[0]))
            return point[keep], centres[point[keep]]
    return np.empty(0, np.int64), np.empty((0, 2))


def _attempts(image: np.ndarray) -> Iterator[np.ndarray]:
    """The image, prepared in several ways, the most fruitful first."""
    yield image
    yield cv2.GaussianBlur(cv2.medianBlur(image, 3), (0, 0), 1.5)


# --- finding ---------------------------------------------------------------------------------------------------------


def _found(image: np.ndarray, target: CircleGrid) -> np.ndarray | None:
    """Rough centres (rows, cols, 2) in an order that OpenCV chose; None where there is no grid."""
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if target.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    blobs = cv2.SimpleBlobDetector.create(_blob_parameters(image, len(target.points)))
    if len(blobs.detect(image)) < len(target.points):
        return None
    finder = cv2.CirclesGridFinderParameters()
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        try:
            found, centres = cv2.findCirclesGrid(image, (target.cols, target.rows), flags, blobs, finder)
        except cv2.error:  # its graph search throws on some clutter
            continue
        if found:
            return np.asarray(centres, np.float64).reshape(target.rows, target.cols, 2)
    return None


def _blob_parameters(image: np.ndarray, count: int) -> cv2.SimpleBlobDetector.Params:
    """Dark blobs of any size that `count` of them can have, at thresholds between the image's black and white."""
    black, white = (float(level) for level in np.percentile(image, (2, 98)))
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = _MIN_AREA_PX, image.size / count
    parameters.minDistBetweenBlobs = 4.0
    reach = max(white - black, 10.0)
    parameters.minThreshold, parameters.maxThreshold = black + 0.15 * reach, black + 0.9 * reach
    parameters.thresholdStep = reach / 12.0
    parameters.minInertiaRatio = 0.05  # (cosine of the tilt) squared
    parameters.minConvexity = 0.85  # small circles are ragged
    return parameters


def _numbered(grid: np.ndarray, target: CircleGrid) -> np.ndarray | None:
    """The centres (N, 2) in the target's order; None where no order shows the board from its front."""
    # OpenCV sometimes starts an asymmetric grid with a shifted row, or takes each pair of rows in reverse.
    starts = [grid.reshape(-1, 2), grid[:, ::-1].reshape(-1, 2)]
    if target.rows % 2 == 0:
        pairs = grid.reshape(target.rows // 2, 2, target.cols, 2)[:, ::-1].reshape(grid.shape)
        starts += [pairs.reshape(-1, 2), pairs[:, ::-1].reshape(-1, 2)]
    lattices = [start for start in starts if _is_grid(start, target)]
    if not lattices:
        return None
    variants = [lattices[0][order] for order in _orders(target)]
    views = [(*_view(variant, target), variant) for variant in variants]
    from_front = [(upright, variant) for upright, front, variant in views if front]
    return max(from_front, key=lambda pair: pair[0])[1] if from_front else None


def _orders(target: CircleGrid) -> list[np.ndarray]:
    """All orders (N,) in which the points form the same lattice, turned or mirrored: OpenCV may choose any of them."""
    row, column = np.divmod(np.arange(len(target.points)), target.cols)
    lattice = np.stack([2 * column + row % 2 if target.asymmetric else column, row], axis=1)
    place = {(int(x), int(y)): number for number, (x, y) in enumerate(lattice)}
    orders = []
    for moved in (lattice, lattice[:, ::-1]):
        for sign in itertools.product((1, -1), repeat=2):
            turned = moved * np.array(sign)
            turned = turned - turned.min(axis=0)
            numbers = [place.get((int(x), int(y))) for x, y in turned]
            if None not in numbers:
                orders.append(np.array(numbers))
    return orders


def _is_grid(pixels: np.ndarray, target: CircleGrid) -> bool:
    """Whether one homography explains the centres to a fraction of their distance; lenses may bend the grid."""
    homography = fit_homography(target.points[:, :2], pixels)
    misfit = np.linalg.norm(apply_homography(homography, target.points[:, :2]) - pixels, axis=1)
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return bool(np.sqrt(np.mean(misfit**2)) < _MAX_MISFIT * np.median(apart.min(axis=1)))


def _view(pixels: np.ndarray, target: CircleGrid) -> tuple[float, bool]:
    """How upright the board is (2 where columns run right and rows up, -2 upside down), and if seen from its front."""
    board = target.points[:, :2]
    homography = fit_homography(board, pixels)
    steps = 0.5 * target.spacing * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    right, left, above, below = apply_homography(homography, board.mean(axis=0) + steps)
    along, up = right - left, above - below
    upright = along[0] / max(np.linalg.norm(along), 1e-9) - up[1] / max(np.linalg.norm(up), 1e-9)
    return float(upright), bool(along[0] * up[1] - along[1] * up[0] < 0.0)


# --- measuring -------------------------------------------------------------------------------------------------------


def _measured(image: np.ndarray, centres: np.ndarray, target: CircleGrid) -> tuple[np.ndarray, np.ndarray]:
    """Centres (N, 2) measured in the board's plane, and which of them (N,) can be trusted."""
    board = target.points[:, :2]
    reach = 0.5 * target.spacing * (np.sqrt(2.0) if target.asymmetric else 1.0)
    order = np.argsort(np.linalg.norm(board[:, None] - board[None], axis=-1), axis=1, kind="stable")
    near = order[:, : min(_NEIGHBOURS, len(board))]
    start, trusted = centres, np.ones(len(board), bool)
    for _ in range(_PASSES):
        maps = fit_homography(board[near], centres[near])
        place = apply_homography(np.linalg.inv(maps), centres[:, None])[:, 0]
        moved, trusted = _centres_of_darkness(image, maps, place, reach)
        centres = apply_homography(maps, moved[:, None])[:, 0]
    scale = np.linalg.norm(centres[near[:, 1]] - centres, axis=1)
    size = np.array([image.shape[1], image.shape[0]])
    inside = ((centres > 1.0) & (centres < size - 2.0)).all(axis=1)
    return centres, trusted & inside & (np.linalg.norm(centres - start, axis=1) < 0.25 * scale)


def _centres_of_darkness(
    image: np.ndarray, maps: np.ndarray, place: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (N, 2), metres, of the dark within `reach` of places (N, 2) on the board, and which are dark enough.

    `maps` (N, 3, 3) take the board to the image around each place.
    """
    px_per_m = _px_per_metre(maps, place)
    side = int(np.clip(np.ceil(4.0 * reach * float(np.median(px_per_m))), 16, _MAX_SIDE))
    line = (np.arange(side) + 0.5) / side * 2.0 - 1.0
    offset = reach * np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    pixels = apply_homography(maps, place[:, None] + offset)
    u, v = np.moveaxis(pixels.astype(np.float32), -1, 0)
    grey = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
    distance = np.linalg.norm(offset, axis=1)
    white = _paper(grey, offset, distance, reach)
    dark = 1.0 - grey / np.maximum(white, 1.0)
    core = np.median(dark[:, distance < 0.3 * reach], axis=1)
    cell = (2.0 * reach / side) ** 2
    within = (distance < reach)[None]
    area = np.sum(dark * within, axis=1) * cell / np.maximum(core, 1e-3)
    radius = np.sqrt(np.maximum(area, 0.0) / np.pi)
    within = within & (distance[None] < (radius + _MARGIN_PX / px_per_m)[:, None])
    weight = dark * within
    total = weight.sum(axis=1)
    centre = np.einsum("ns,sk->nk", weight, offset) / np.maximum(total, 1e-9)[:, None]
    enough = core * white.mean(axis=1) > _MIN_CONTRAST
    return place + np.where(enough[:, None], centre, 0.0), enough


def _px_per_metre(maps: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Pixels per metre (N,) around each place, the least over directions."""
    step = 1e-6
    steps = np.array([[0.0, 0.0], [step, 0.0], [0.0, step]])
    moved = apply_homography(maps, place[:, None] + steps)
    jacobian = (moved[:, 1:] - moved[:, :1]) / step
    return np.maximum(np.linalg.svd(jacobian, compute_uv=False)[:, -1], 1e-9)


def _paper(grey: np.ndarray, offset: np.ndarray, distance: np.ndarray, reach: float) -> np.ndarray:
    """Grey level (N, S) that the paper would have: a plane through what is white around each circle."""
    ring = (distance > _WHITE_FROM * reach) & (distance < reach)
    design = np.column_stack([offset / reach, np.ones(len(offset))])
    weight = np.ones((len(grey), int(ring.sum())))
    plane = np.zeros((len(grey), 3))
    for _ in range(2):
        normal = np.einsum("nr,ri,rj->nij", weight, design[ring], design[ring]) + 1e-9 * np.eye(3)
        plane = np.linalg.solve(normal, np.einsum("nr,ri,nr->ni", weight, design[ring], grey[:, ring])[..., None])[
            ..., 0
        ]
        # A circle that reaches into the ring, or an edge of the board, is darker than the plane.
        residual = grey[:, ring] - plane @ design[ring].T
        spread = np.maximum(np.std(residual, axis=1, keepdims=True), 1.0)
        weight = (residual > -spread).astype(np.float64)
    return plane @ design.T
