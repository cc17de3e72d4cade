"""Corners of black and white squares, placed where the board's own pattern fits the image best."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import erf

from jaxcal.detection.board_view import BoardView, fit_view
from jaxcal.detection.outliers import FEWEST, agreeing_with
from jaxcal.detection.refine import inside

_NEIGHBOURS = 14  # corners, itself among them, that a quadratic function around one is fitted to
_THEREABOUTS = 6  # of which so many tell whether it is a good one
# Half a window, px: beyond, it tells of the lens's curvature more than of the corner; below, of too little.
_LARGEST_HALF, _SMALLEST_HALF = 10.0, 1.5
_BLURS = (0.7, 1.4, 2.8)  # 1-sigma of an edge, px; one for the whole image,
_ASKED = 24  # which so many of its corners tell
_ROUNDS, _SETTLED_PX = 6, 2e-3
# Of the grey levels' variance in a window, what the pattern alone has to explain; and how far a corner may go.
_LEAST_EXPLAINED, _LONGEST_WAY_PX = 0.3, 2.0
_MOST = 0.8  # of the corners, where the pattern counts as seen
_LOOKS = 2  # more, where corners were out of place
_DOUBTFUL_PX = 1.0  # so far from where the others expect it, a corner is looked for there, too


@dataclass(frozen=True)
class _Views:
    """How the board is seen around each corner: p = corner + A u + Q (u1^2 / 2, u1 u2, u2^2 / 2), u on the board.

    `expected` (N, 2) px, where the others say that it is; `linear` (N, 2, 2) px / m; `inverse` of it; `quadratic`
    (N, 2, 3) px / m^2.
    """

    expected: np.ndarray
    linear: np.ndarray
    inverse: np.ndarray
    quadratic: np.ndarray

    def take(self, rows: np.ndarray) -> "_Views":
        return _Views(self.expected[rows], self.linear[rows], self.inverse[rows], self.quadratic[rows])

    def offsets(self, along: np.ndarray, up: np.ndarray) -> np.ndarray:
        """Pixels (N, S, 2) from the corner for places (N, S) on the board."""
        squares = np.stack([0.5 * along**2, along * up, 0.5 * up**2], axis=-1)
        linear, quadratic = self.linear.astype(along.dtype), self.quadratic.astype(along.dtype)
        return np.stack([along, up], axis=-1) @ _turned(linear) + squares @ _turned(quadratic)


def fitted_corners(
    image: np.ndarray, board: np.ndarray, pixels: np.ndarray, reach: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Corners (N, 2) as `fit_pattern` places them, px, and which of them (N,) lie where the others say they should.

    Where the pattern is seen at most corners, it has to be at every one: those without it are looked for anew where
    the view of the others has them. And where some were far out of place, which bent the view of all and what their
    neighbours were expected to look like, all are placed anew.

    Fewer than 8, which do not tell how the board is seen, stay where they are and are all kept.
    """
    if len(board) < FEWEST:
        return pixels, np.ones(len(board), bool)
    size = (image.shape[1], image.shape[0])
    view = fit_view(board, pixels, size)
    if view is None:
        return pixels, agreeing_with(view, board, pixels)
    moved, share = fit_pattern(image, board, pixels, reach, view)
    seen = share != 0.0
    if np.mean(seen) < _MOST:
        return moved, inside(moved, size) & agreeing_with(view, board, moved)
    start = pixels
    for _ in range(_LOOKS):
        stayed = np.linalg.norm(moved - start, axis=1) <= _DOUBTFUL_PX
        if (seen & stayed).all() or seen.sum() < FEWEST:
            break
        of_others = fit_view(board[seen], moved[seen], size)
        if of_others is None:
            break
        view, start = of_others, np.where(seen[:, None], moved, of_others.pixels(board))
        moved, share = fit_pattern(image, board, start, reach, view)
        seen = np.where(seen, share != 0.0, share > 0.0)
    return moved, seen & inside(moved, size) & agreeing_with(view, board, moved)


def fit_pattern(
    image: np.ndarray, board: np.ndarray, pixels: np.ndarray, reach: tuple[float, float], view: BoardView
) -> tuple[np.ndarray, np.ndarray]:
    """Corners (N, 2), px, moved to where the black and white squares that meet there fit the grey image best, and the
    share (N,) of the grey levels' variance that the pattern explains there: 0 where that is too little, not a number
    where the pattern is too small in the image, or too near to its edge, to tell.

    `board` (N, 2), m, are their places on the board; `pixels` (N, 2) in the image, right within a pixel or so. The
    pattern is known as far as `reach` (m; along and up the board) from a corner, and seen as `view` and the corners
    around it say. A corner whose window the pattern does not explain, or that would go far, stays where it is.

    `cv2.cornerSubPix` weighs every gradient in a round window, noise included. This compares the image with the
    gradients that are expected, along the whole of the edges, as the neighbouring corners say that they are seen
    (perspective and the lens's curvature). Method: alignment with a template by the template's own gradients
    (Baker & Matthews 2004, "Lucas-Kanade 20 years on", section 3.2: inverse compositional), jointly with contrast,
    brightness, and a gradient of the light.
    """
    views = _views(board, pixels, view)
    along, up, half_px = _half_windows(image, views, pixels, reach)
    rows = np.flatnonzero(np.isfinite(views.inverse).all(axis=(1, 2)) & (half_px >= _SMALLEST_HALF))
    shares = np.full(len(pixels), np.nan)
    if not len(rows):
        return pixels, shares
    views, start, half_px = views.take(rows), pixels[rows], half_px[rows]
    line = np.linspace(-1.0, 1.0, 2 * int(np.ceil(np.median(half_px))) + 1)  # about a sample in a pixel
    places = along[rows, None] * line, up[rows, None] * line
    grey = image.astype(np.float32)
    template = _Template.of(views, *places, _blur(grey, start, views, *places))
    limit = np.minimum(_LONGEST_WAY_PX, half_px)
    moved, share = _aligned(template, grey, start, limit)
    doubtful = np.flatnonzero((share <= 0.0) | (np.linalg.norm(views.expected - start, axis=1) > _DOUBTFUL_PX))
    if len(doubtful):
        again, better = _aligned(template.take(doubtful), grey, views.expected[doubtful], limit[doubtful])
        chosen = better > share[doubtful]
        moved[doubtful[chosen]], share[doubtful[chosen]] = again[chosen], better[chosen]
    out = pixels.copy()
    out[rows[share > 0.0]] = moved[share > 0.0]
    shares[rows] = share
    return out, shares


def _blur(grey: np.ndarray, corners: np.ndarray, views: _Views, along: np.ndarray, up: np.ndarray) -> float:
    """The blur of edges, px, that explains some of the corners best. A wrong one costs precision, and moves nothing."""
    some = np.unique(np.linspace(0, len(corners) - 1, _ASKED).astype(np.int64))

    def explained(blur: float) -> float:
        template = _Template.of(views.take(some), along[some], up[some], blur)
        return float(np.median(template.align(grey, corners[some], rounds=1)[1]))

    return max(_BLURS, key=explained)


def _aligned(
    template: "_Template", grey: np.ndarray, start: np.ndarray, limit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corners (N, 2) and the share (N,) that their pattern explains: 0 where that is too little or too far away."""
    moved, share = template.align(grey, start, _ROUNDS)
    good = (share >= _LEAST_EXPLAINED) & (np.linalg.norm(moved - start, axis=1) <= limit)
    return moved, np.where(good, share, 0.0)


@dataclass(frozen=True)
class _Template:
    """What the windows of the corners should look like, and what tells how a corner has to move.

    `offsets` (N, S, 2) px of the samples; `design` (N, 6, S) the grey levels by contrast, brightness, the light's
    gradient, and a corner's way; `information` (N, 6, 6) of those six.
    """

    offsets: np.ndarray
    design: np.ndarray
    information: np.ndarray

    def take(self, rows: np.ndarray) -> "_Template":
        return _Template(self.offsets[rows], self.design[rows], self.information[rows])

    @staticmethod
    def of(views: _Views, along: np.ndarray, up: np.ndarray, blur: float) -> "_Template":
        """For samples at all pairs of places `along` (N, n) and `up` (N, n) the board, and edges with this blur."""
        # In single precision: half the time, and a thousandth of a pixel is far above its rounding.
        (value_a, slope_a), (value_b, slope_b) = (
            _edge(places, blur * np.linalg.norm(views.inverse[:, axis], axis=1)).astype(np.float32)
            for axis, places in enumerate((along, up))
        )
        along, up, inverse = (array.astype(np.float32) for array in (along, up, views.inverse))
        pattern = _pairs(value_a, value_b)
        by_board = np.stack([_pairs(slope_a, value_b), _pairs(value_a, slope_b)], axis=-1)
        a, b = _pairs(along, np.ones_like(up)), _pairs(np.ones_like(along), up)
        light = [a / along[:, -1:], b / up[:, -1:]]
        way = np.moveaxis(-(by_board @ inverse), -1, 0)
        design = np.stack([pattern, np.ones_like(pattern), *light, *way], axis=1)
        information = (design @ _turned(design)).astype(np.float64)
        information += 1e-9 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        return _Template(views.offsets(a, b), design, information)

    def align(self, grey: np.ndarray, start: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
        """Corners (N, 2) after some rounds, and the share (N,) of the variance that the pattern explains."""
        corners, inverse = start.copy(), np.linalg.inv(self.information)
        for _ in range(rounds):
            places = corners[:, None].astype(np.float32) + self.offsets
            # Linear interpolation moves sharp edges that run along the rows of pixels by up to 0.04 px.
            seen = cv2.remap(grey, places[..., 0], places[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            found = (inverse @ (self.design @ seen[..., None]))[..., 0]
            contrast = np.where(np.abs(found[:, :1]) < 1.0, 1.0, found[:, :1])
            step = np.clip(found[:, 4:] / contrast, -1.0, 1.0)
            corners = corners + step
            if np.abs(step).max() < _SETTLED_PX:
                break
        pattern = self.design[:, 0]
        return corners, found[:, 0] ** 2 * pattern.var(axis=1) / np.maximum(seen.var(axis=1), 1e-6)


def _views(board: np.ndarray, pixels: np.ndarray, view: BoardView) -> _Views:
    """The board as seen around each corner: a quadratic function of the neighbours alone, or `view` with one of what
    departs from it, whichever tells better where corners thereabouts are.

    At the rim of the board, where all neighbours are on one side, quadratic functions alone are off by a hundredth of
    a pixel, outwards all around; `view`, which bends as most lenses do, is off by more in the widest ones.
    """
    distance = np.linalg.norm(board[:, None] - board, axis=2)
    near = np.argsort(distance, axis=1, kind="stable")[:, :_NEIGHBOURS]
    unit = np.take_along_axis(distance, near, axis=1)[:, -1] * 1.05
    u = (board[near] - board[:, None]) / unit[:, None, None]
    weight = np.maximum(1.0 - np.sum(u**2, axis=2), 0.05)
    weight[:, 0] = 0.0  # the corner itself, which may be out of place
    x, y = u[..., 0], u[..., 1]
    terms = np.stack([np.ones_like(x), x, y, 0.5 * x**2, x * y, 0.5 * y**2], axis=-1)
    weighted = _turned(terms * weight[..., None])
    # Neighbours that all lie in two rows leave the curvature across them open: it is none then.
    ridge = np.diag([1e-12, 1e-12, 1e-12, 1e-4, 1e-4, 1e-4])
    normal = weighted @ terms + weight.sum(axis=1)[:, None, None] * ridge
    shown, (first, second) = view.pixels(board), view.derivatives(board)
    values = np.concatenate([pixels, pixels - shown], axis=1)
    fitted = _turned(np.linalg.solve(normal, weighted @ values[near])).reshape(len(board), 2, 2, 6)
    missed = np.sum((fitted[..., 0] - values.reshape(-1, 2, 2)) ** 2, axis=2)
    alone, with_view = np.median(missed[near[:, :_THEREABOUTS]], axis=1).T
    by_view = with_view <= alone
    fitted = np.where(by_view[:, None, None], fitted[:, 1], fitted[:, 0])
    shown, first, second = (np.where(by_view.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in (shown, first, second))
    linear = first + fitted[..., 1:3] / unit[:, None, None]
    flat = np.abs(np.linalg.det(linear)) < 1e-3 * np.sum(linear**2, axis=(1, 2))  # seen edge-on, or all in one row
    inverse = np.full_like(linear, np.nan)
    inverse[~flat] = np.linalg.inv(linear[~flat])
    return _Views(shown + fitted[..., 0], linear, inverse, second + fitted[..., 3:] / unit[:, None, None] ** 2)


def _half_windows(
    image: np.ndarray, views: _Views, pixels: np.ndarray, reach: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half a window along and up the board (N,), m, and its shorter one in the image (N,), px.

    As far as the pattern is known, but not further than the largest window, and within the image.
    """
    sides = views.linear * np.array(reach)  # columns: from the corner to the middle of the window's sides
    lengths = np.linalg.norm(sides, axis=1)
    height, width = image.shape
    room = np.minimum(pixels, np.array([width - 1.0, height - 1.0]) - pixels) - 1.0
    share = np.minimum(1.0, (room / np.maximum(np.abs(sides).sum(axis=2), 1e-9)).min(axis=1))
    share = np.maximum(share, 0.0)[:, None] * np.minimum(
        1.0, _LARGEST_HALF / np.maximum(lengths * share[:, None], 1e-9)
    )
    return reach[0] * share[:, 0], reach[1] * share[:, 1], (lengths * share).min(axis=1)


def _edge(places: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """A blurred step from -1 to 1 at 0, and its derivative, at places (N, n): (2, N, n)."""
    scaled = places / sigma[:, None]
    return np.stack([erf(scaled / np.sqrt(2.0)), np.sqrt(2.0 / np.pi) / sigma[:, None] * np.exp(-0.5 * scaled**2)])


def _pairs(along: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Products (N, n * n) of all pairs of values (N, n) along and up the board."""
    return (up[:, :, None] * along[:, None, :]).reshape(len(up), -1)


def _turned(matrices: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrices, -1, -2)
