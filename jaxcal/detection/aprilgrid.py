"""AprilGrid corners in one image: find tags, decode them, complete the grid, refine and check every corner."""

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from jaxcal.detection.homography import apply_homography, fit_homography
from jaxcal.detection.outliers import agreeing_corners
from jaxcal.detection.pattern_fit import fitted_corners
from jaxcal.detection.refine import refine_corners
from jaxcal.targets import AprilGrid

# Kalibr's tags: 6 x 6 data bits of the family 36h11 within a black border of two bits.
_DATA, _BORDER = 6, 2
_CELLS = _DATA + 2 * _BORDER
_SAMPLES_PER_CELL = 3
# Codes of 36h11 differ in at least 11 of 36 bits, which is a correlation of at most 0.39 between two of them.
_MIN_DECODED = 0.75
_MIN_PREDICTED = 0.6  # enough where the place says which tag to expect
_MIN_CONTRAST = 12.0  # grey levels between black border and white bits
_MIN_EDGE_PX = 8.0
_ENOUGH_TAGS = 4
# An image is speckled where more than this share of pixels differs by so much from their neighbours' median.
_SPECKLE_GREY, _SPECKLE_SHARE = 50, 0.005
_MAX_ROUNDS = 12
_INTO_GAP, _INTO_BORDER = 0.6, 0.9  # how far from a tag's corner the pattern is fitted


@dataclass(frozen=True)
class _Tags:
    """Tags in an image: `ids` (T,), `corners` (T, 4, 2) pixels, anticlockwise from the lower left as Kalibr's.

    Ids count from 0 here, whatever the board's first one: they are places on the board.
    """

    ids: np.ndarray
    corners: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)


_NO_TAGS = _Tags(np.empty(0, np.int64), np.empty((0, 4, 2)))


@functools.lru_cache(maxsize=4)
def _board(target: AprilGrid) -> np.ndarray:
    """Board coordinates (T, 4, 2) of each tag's corners, metres."""
    points = target.points[:, :2]
    return np.stack([points[target.tag_points(tag)] for tag in target.ids])


def find_aprilgrid(image: np.ndarray, target: AprilGrid) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the grid in a grey uint8 image: (K,) indices into `target.points`, (K, 2) pixels; K may be 0.

    Tags are found as dark quadrilaterals and decoded against this grid's codes only. Tags that were missed are then
    looked for where their neighbours say they are, and taken when the image there shows their code. Corners are
    refined on the original image and kept when a homography of their neighbours agrees.
    """
    best = _NO_TAGS
    for readable, quads in _attempts(image):
        tags = _complete(readable, _decode(readable, quads, target), target)
        if len(tags) > len(best):
            best = tags
        if len(best) >= min(_ENOUGH_TAGS, target.rows * target.cols):
            break
    return _checked_corners(image, best, target)


# --- candidates ------------------------------------------------------------------------------------------------------


def _attempts(image: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(image to read codes from, candidate quadrilaterals (Q, 4, 2)), the most fruitful preparation first."""
    calm = cv2.medianBlur(image, 3)
    speckled = np.mean(cv2.absdiff(image, calm) > _SPECKLE_GREY) > _SPECKLE_SHARE  # event frames are
    first, second = (calm, image) if speckled else (image, calm)
    yield image, _parted_quads(first)
    double = cv2.resize(first, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
    yield image, (_parted_quads(double) + 0.5) / 2.0 - 0.5
    yield image, _parted_quads(second)
    yield 255 - image, _parted_quads(255 - first)


def _parted_quads(image: np.ndarray) -> np.ndarray:
    """Quadrilaterals of tags that black squares touch at their corners, as in Kalibr's grid.

    Growing the white parts them from the squares, and takes one pixel off each side.
    """
    grown = cv2.dilate(image, cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3)))
    return _widen(_quads(grown), 1.0)


def _quads(image: np.ndarray) -> np.ndarray:
    """Dark quadrilaterals (Q, 4, 2), clockwise as seen in the image: what OpenCV takes for a tag, decodable or not."""
    found, _, rejected = _quad_finder(max(image.shape[0] // 480, 1)).detectMarkers(image)
    return np.array([np.reshape(quad, (4, 2)) for quad in (*found, *rejected)], np.float64).reshape(-1, 4, 2)


@functools.cache
def _quad_finder(scale: int) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = _BORDER
    # OpenCV's smallest window (3) finds only speckle in event frames, and costs half of the time.
    parameters.adaptiveThreshWinSizeMin = 12 * scale + 1
    parameters.adaptiveThreshWinSizeMax = 22 * scale + 1
    parameters.adaptiveThreshWinSizeStep = 10 * scale
    return cv2.aruco.ArucoDetector(_dictionary(), parameters)


def _dictionary() -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)


def _widen(quads: np.ndarray, pixels: float) -> np.ndarray:
    """Move each corner outwards along the diagonal by `pixels` on either side of it."""
    if not len(quads):
        return quads
    outwards = quads - quads.mean(axis=1, keepdims=True)
    half_diagonal = np.linalg.norm(outwards, axis=2, keepdims=True)
    return quads + outwards / np.maximum(half_diagonal, 1e-9) * pixels * np.sqrt(2.0)


# --- codes -----------------------------------------------------------------------------------------------------------


@functools.cache
def _codes(ids: range) -> np.ndarray:
    """Data bits (T, 36) of tags, upright as Kalibr prints them, row by row from the top; mean 0, norm 1."""
    images = [cv2.aruco.generateImageMarker(_dictionary(), tag, _CELLS, None, _BORDER) for tag in ids]
    data = np.stack(images)[:, _BORDER:-_BORDER, _BORDER:-_BORDER]
    upright = np.rot90(data, 2, axes=(1, 2))  # OpenCV's tags of this family stand on their heads
    return _normalised(upright.reshape(len(ids), -1).astype(np.float64))


def _normalised(rows: np.ndarray) -> np.ndarray:
    centred = rows - rows.mean(axis=1, keepdims=True)
    return centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-9)


@functools.cache
def _cell_samples() -> np.ndarray:
    """Sample places (100 * 9, 2) in a unit tag, y up: cells row by row from the top, a few samples in each."""
    inside = (np.arange(_SAMPLES_PER_CELL) + 0.5) / _SAMPLES_PER_CELL * 0.6 + 0.2
    line = (np.arange(_CELLS)[:, None] + inside).ravel() / _CELLS
    y, x = np.meshgrid(1.0 - line, line, indexing="ij")
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def _read_cells(image: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Mean grey level (Q, 10, 10) of each cell of quadrilaterals (Q, 4, 2) given in Kalibr's order."""
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)
    maps = np.stack([cv2.getPerspectiveTransform(unit, quad) for quad in corners.astype(np.float32)])
    places = apply_homography(maps, _cell_samples())
    x, y = np.moveaxis(places.astype(np.float32), -1, 0)
    grey = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    cells = grey.reshape(len(corners), _CELLS, _SAMPLES_PER_CELL, _CELLS, _SAMPLES_PER_CELL)
    return cells.astype(np.float64).mean(axis=(2, 4))


def _agreement(cells: np.ndarray, ids: range) -> np.ndarray:
    """Correlation (Q, T) of the data bits with each code; -1 where the border is not dark or the contrast is low."""
    data = cells[:, _BORDER:-_BORDER, _BORDER:-_BORDER].reshape(len(cells), -1)
    border = np.ones((_CELLS, _CELLS), bool)
    border[_BORDER:-_BORDER, _BORDER:-_BORDER] = False
    rim = cells[:, border]
    white = np.percentile(data, 85, axis=1)
    dark = np.median(rim, axis=1) + _MIN_CONTRAST < white
    mostly_dark = np.mean(rim < ((np.median(rim, axis=1) + white) / 2.0)[:, None], axis=1) > 0.8
    scores = _normalised(data) @ _codes(ids).T
    return np.where((dark & mostly_dark)[:, None], scores, -1.0)


def _decode(image: np.ndarray, quads: np.ndarray, target: AprilGrid) -> _Tags:
    """The tags among candidate quadrilaterals, each id once (where its code agrees best)."""
    quads = quads[_edges(quads) >= _MIN_EDGE_PX]
    if not len(quads):
        return _NO_TAGS
    best: dict[int, tuple[float, np.ndarray]] = {}
    quads = quads[:, ::-1]  # the candidates run clockwise in the image, Kalibr's corners anticlockwise
    cells = _read_cells(image, quads)
    for turn in range(4):
        # Starting one corner later is the same as turning the tag clockwise.
        scores = _agreement(np.rot90(cells, -turn, axes=(1, 2)), target.ids)
        for quad, row in zip(np.roll(quads, -turn, axis=1), scores, strict=True):
            tag = int(np.argmax(row))
            if row[tag] >= _MIN_DECODED and row[tag] > best.get(tag, (0.0, quad))[0]:
                best[tag] = (float(row[tag]), quad)
    ids = np.array(sorted(best), np.int64)
    return _Tags(ids, np.array([best[tag][1] for tag in ids]).reshape(-1, 4, 2))


# --- the grid --------------------------------------------------------------------------------------------------------


def _edges(corners: np.ndarray) -> np.ndarray:
    """Shortest edge (T,) of each tag or quadrilateral (T, 4, 2), pixels."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(axis=1)


def _half_windows(corners: np.ndarray, target: AprilGrid) -> np.ndarray:
    """Half-width (T,) of the refinement window: it ends before the tag's bits and before the next tag's corner."""
    reach = min(0.14, 0.45 * target.tag_spacing)
    return np.clip(np.floor(_edges(corners) * reach), 2, 9).astype(np.int64)


def _refined(image: np.ndarray, tags: _Tags, target: AprilGrid) -> tuple[np.ndarray, np.ndarray]:
    """Corners (T, 4, 2) refined on `image`, and which of them (T, 4) stayed within their window."""
    half = np.repeat(_half_windows(tags.corners, target), 4)
    corners, stayed = refine_corners(image, tags.corners.reshape(-1, 2), half)
    return corners.reshape(-1, 4, 2), stayed.reshape(-1, 4)


def _complete(image: np.ndarray, tags: _Tags, target: AprilGrid) -> _Tags:
    """Add the tags that the image shows where the known ones predict them, growing outwards."""
    tags = _consistent(image, tags, target)
    refused: set[int] = set()
    for _ in range(_MAX_ROUNDS):
        missing = [tag for tag in _adjacent(tags.ids, target) if tag not in refused]
        if not missing:
            break
        guesses = np.stack([_predict(tag, tags, _board(target)) for tag in missing])
        height, width = image.shape
        inside = ((guesses > 1.0) & (guesses < np.array([width - 2.0, height - 2.0]))).all(axis=(1, 2))
        inside &= _edges(guesses) >= _MIN_EDGE_PX
        refined, _ = _refined(image, _Tags(np.array(missing), guesses), target)
        scores = np.full(len(missing), -1.0)
        for corners in (guesses, refined):
            agreement = _agreement(_read_cells(image, corners), target.ids)[np.arange(len(missing)), missing]
            scores = np.maximum(scores, agreement)
        seen = inside & (scores >= _MIN_PREDICTED)
        # Refused tags are tried again only from nearer neighbours, that is, when something new was found.
        refused = set() if seen.any() else set(missing)
        tags = _Tags(np.concatenate([tags.ids, np.array(missing)[seen]]), np.concatenate([tags.corners, refined[seen]]))
        if not seen.any():
            break
    return tags


def _adjacent(ids: np.ndarray, target: AprilGrid) -> list[int]:
    """Tags that are not in `ids` and touch one that is."""
    known = {divmod(int(tag), target.cols) for tag in ids}
    around = {(r + i, c + j) for r, c in known for i in (-1, 0, 1) for j in (-1, 0, 1)} - known
    return sorted(r * target.cols + c for r, c in around if 0 <= r < target.rows and 0 <= c < target.cols)


def _predict(tag: int, tags: _Tags, board: np.ndarray) -> np.ndarray:
    """Where a tag's corners (4, 2) should be, by the homography of the nearest known tags."""
    distance = np.linalg.norm(board[tags.ids, 0] - board[tag, 0], axis=1)
    near = np.argsort(distance, kind="stable")[:4]
    homography = fit_homography(board[tags.ids[near]].reshape(-1, 2), tags.corners[near].reshape(-1, 2))
    return apply_homography(homography, board[tag])


def _consistent(image: np.ndarray, tags: _Tags, target: AprilGrid) -> _Tags:
    """Refine the corners of decoded tags and drop tags that lie where the others do not expect them."""
    if not len(tags):
        return tags
    refined, stayed = _refined(image, tags, target)
    corners = np.where(stayed[..., None], refined, tags.corners)
    floor = 0.2 * float(np.median(_edges(corners)))
    board, size = _board(target)[tags.ids].reshape(-1, 2), (image.shape[1], image.shape[0])
    agrees = agreeing_corners(board, corners.reshape(-1, 2), size, floor_px=floor)
    kept = agrees.reshape(-1, 4).sum(axis=1) >= 3
    return _Tags(tags.ids[kept], corners[kept])


def _checked_corners(image: np.ndarray, tags: _Tags, target: AprilGrid) -> tuple[np.ndarray, np.ndarray]:
    """Indices (K,) and pixels (K, 2) of the corners that refinement and their neighbours confirm."""
    if not len(tags):
        return np.empty(0, np.int64), np.empty((0, 2))
    refined, stayed = _refined(image, tags, target)
    point = np.concatenate([target.tag_points(target.first_id + int(tag)) for tag in tags.ids])
    point, board = point[stayed.ravel()], _board(target)[tags.ids][stayed]
    reach = min(_INTO_GAP * target.tag_spacing, _INTO_BORDER * _BORDER / _CELLS) * target.tag_size
    pixels, keep = fitted_corners(image, board, refined[stayed], (reach, reach))
    return point[keep], pixels[keep]
