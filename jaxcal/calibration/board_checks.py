"""Does the numbering of the corners fit the board? Told from the corners alone, before any lens is known."""

from dataclasses import dataclass

import numpy as np

from jaxcal.calibration.assemble import CameraFrames
from jaxcal.errors import CalibrationError
from jaxcal.targets import AprilGrid, CircleGrid, Target

_VIEWS = 200  # views that are looked at, evenly over all
_PLACES = 8  # neighbourhoods of a board in which a homography is fitted
_NEIGHBOURS = 12
_FEWEST = 8  # seen corners in a neighbourhood; a homography has 8 freedoms in 2 coordinates of each
# A view fits when the median neighbourhood's misfit is below this share of its size: noise of a pixel in a
# neighbourhood of 20, or the strongest lens, stays below; wrong numbers give a third and more.
_FITS = 0.06
_ROUNDS = 6
_GOOD_SHARE = 0.7  # of a neighbourhood's corners are taken to be in the right place
_NEARLY_ALL, _MOST = 0.9, 0.8
_CLEARLY_BETTER = 0.3  # what another layout's misfit has to be of the stated one's
_STRAY = 0.2  # so many views may be odd ones, which calibration leaves out


@dataclass(frozen=True)
class _Views:
    """What each view (F,) says about a layout: can it be judged, does it fit, is it seen from behind; the misfit."""

    judged: np.ndarray
    fits: np.ndarray
    mirrored: np.ndarray
    misfit: np.ndarray

    @property
    def share(self) -> float:
        """The share of the views that fit, among those that can be judged."""
        return float(self.fits.sum() / max(self.judged.sum(), 1))

    @property
    def typical(self) -> float:
        """The median misfit of the views that can be judged."""
        return float(np.median(self.misfit[self.judged])) if self.judged.any() else np.inf


def check_board(name: str, frames: CameraFrames, target: Target) -> list[str]:
    """Compare the numbering of one camera's corners with the board; sentences about what is odd.

    Homographies are fitted in small neighbourhoods, within which any lens is nearly a pinhole. Raises CalibrationError,
    with a remedy, where the corners can only be those of a board with rows and columns swapped or with rows of another
    length, or are numbered now one way, now another. A board mirrored in all views is said, but calibrates all the
    same: a plane seen from behind is a plane.
    """
    sentences = []
    for number, board in enumerate(target.boards):
        where = name if len(target.boards) == 1 else f"{name}, board {number}"
        own = target.board_of_point == number
        some = np.unique(np.linspace(0, len(frames.frames) - 1, min(_VIEWS, len(frames.frames))).round().astype(int))
        pixels, seen = frames.pixels[some][:, own], frames.seen[some][:, own]
        sentences += _check_one(where, frames.frames[some], pixels, seen, board)
    return sentences


def _check_one(where: str, frame: np.ndarray, pixels: np.ndarray, seen: np.ndarray, board: Target) -> list[str]:
    views = _judge(pixels, seen, board.points[:, :2])
    judged = int(views.judged.sum())
    if not judged:
        return []
    if views.share < 1.0 - _STRAY:
        _explain(where, pixels, seen, board, views.typical)
    mirrored = views.fits & views.mirrored
    if mirrored.sum() > _NEARLY_ALL * views.fits.sum() and views.share >= 0.5:
        return [
            f"{where}: the corners are those of a MIRRORED board: in all views, columns running right and rows running "
            "up would show it from behind. Where points are only numbered from the top, as OpenCV does, only the "
            "target's frame is turned over (its z axis points into the board); were the images themselves mirrored, "
            "undo that. Number the points row by row from the lower LEFT."
        ]
    if mirrored.sum() > _STRAY * views.fits.sum():
        raise CalibrationError(
            f"{where}: the corners are numbered differently from view to view: {mirrored.sum()} of {judged} views "
            f"show the board mirrored ({_frames(frame[mirrored])}), the others do not. A board numbers its points "
            "once and for all: row by row from the lower left, seen from the front."
        )
    sentences = []
    if mirrored.any():
        sentences.append(
            f"{where}: {mirrored.sum()} of {judged} views show the board mirrored ({_frames(frame[mirrored])}): their "
            "corners are numbered wrongly and are of no use."
        )
    odd = views.judged & ~views.fits
    if odd.any() and odd.sum() >= 0.02 * judged:
        sentences.append(
            f"{where}: in {odd.sum()} of {judged} views many corners are not where one view of the board would have "
            f"them ({_frames(frame[odd])}): they are numbered wrongly, or were not found on the board."
        )
    return sentences


def _explain(where: str, pixels: np.ndarray, seen: np.ndarray, board: Target, stated_misfit: float) -> None:
    """Raise CalibrationError when rows of another length explain nearly all views, and far better than the stated."""
    best: tuple[float, int, _Views] | None = None
    few = slice(None, None, max(1, len(pixels) // 20))
    for cols in range(1, _count(board) + 1):
        if cols == _columns(board):
            continue
        views = _judge(pixels[few], seen[few], _layout(board, cols))
        if views.judged.any() and (best is None or views.share > best[0]):
            best = (views.share, cols, views)
    # In small or noisy images the right layout may miss the limit as well, and another meet it by chance.
    if best is None or best[0] < _MOST or best[2].typical > _CLEARLY_BETTER * stated_misfit:
        return
    _, cols, views = best
    mirrored = (views.fits & views.mirrored).sum() > 0.5 * views.fits.sum()
    rows, stated = _count(board) / cols, f"{_count(board) // _columns(board)} rows x {_columns(board)} columns"
    unit = "tags" if isinstance(board, AprilGrid) else "points"
    if mirrored:
        raise CalibrationError(
            f"{where}: the {unit} are numbered along the board's columns (or from the top, in rows of {cols}), not row "
            f"by row from the lower left as the target of {stated} says. Renumber them."
        )
    if rows == cols or rows != int(rows) or cols != _count(board) // _columns(board):
        raise CalibrationError(
            f"{where}: the numbering of the {unit} fits a board with {cols} in a row, not the target of {stated}. "
            "Correct the numbers of rows and columns in the target."
        )
    raise CalibrationError(
        f"{where}: rows and columns are swapped: the numbering of the {unit} fits a board of {int(rows)} rows x {cols} "
        f"columns, the target says {stated}. Swap them in the target (and their spacings)."
    )


def _frames(numbers: np.ndarray) -> str:
    shown = ", ".join(str(number) for number in numbers[:5])
    return f"frame {shown}" if len(numbers) == 1 else f"frames {shown}{' ...' if len(numbers) > 5 else ''}"


# --- layouts ---------------------------------------------------------------------------------------------------------


def _count(board: Target) -> int:
    """How many things are numbered: tags of an AprilGrid, else points."""
    return board.rows * board.cols if isinstance(board, AprilGrid) else len(board.points)


def _columns(board: Target) -> int:
    return board.cols if isinstance(board, AprilGrid) else board.grid_shape[1]


def _layout(board: Target, cols: int) -> np.ndarray:
    """Where the points (N, 2) would be if rows were `cols` long; in units of the spacing, which homographies ignore."""
    row, col = np.divmod(np.arange(_count(board)), cols)
    if isinstance(board, AprilGrid):
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        layout = np.empty((len(board.points), 2))
        for number, tag in enumerate(board.ids):
            place = np.array([col[number], row[number]]) * (1.0 + board.tag_spacing)
            layout[board.tag_points(tag)] = place + corners
        return layout
    if isinstance(board, CircleGrid) and board.asymmetric:
        return np.stack([2 * col + row % 2, row], axis=1).astype(np.float64)
    return np.stack([col, row], axis=1).astype(np.float64)


# --- homographies in neighbourhoods ----------------------------------------------------------------------------------


def _judge(pixels: np.ndarray, seen: np.ndarray, layout: np.ndarray) -> _Views:
    """Fit homographies from a layout (N, 2) to each view's pixels (F, N, 2) around a few places of the board."""
    middles = np.unique(np.linspace(0, len(layout) - 1, _PLACES + 2).round().astype(int)[1:-1])
    distance = np.linalg.norm(layout[middles, None] - layout[None], axis=-1)
    near = np.argsort(distance, axis=1, kind="stable")[:, : min(_NEIGHBOURS, len(layout))]
    misfit, mirrored = _fit(layout[near][None], pixels[:, near], seen[:, near], rounds=1)
    doubtful = _median(misfit) >= _FITS
    if doubtful.any():
        some = pixels[doubtful][:, near], seen[doubtful][:, near]
        misfit[doubtful], mirrored[doubtful] = _fit(layout[near][None], *some, rounds=_ROUNDS)
    usable = np.isfinite(misfit)
    judged = np.any(usable, axis=1, keepdims=True)[:, 0]
    typical = _median(misfit)
    votes = np.where(usable, np.where(mirrored, 1, -1), 0).sum(axis=1)
    return _Views(judged, judged & (typical < _FITS), votes > 0, typical)


def _median(misfit: np.ndarray) -> np.ndarray:
    """Median (F,) over the places of each view (F, P) that have a misfit; infinite where none has."""
    return np.ma.median(np.ma.masked_invalid(misfit), axis=1).filled(np.inf)


def _fit(board: np.ndarray, pixels: np.ndarray, seen: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Homographies from `board` (1, P, K, 2) to `pixels` (F, P, K, 2) where `seen` (F, P, K).

    Returns the misfit (F, P) of all but the worst corners as a share of the neighbourhood's size, NaN where too few are
    seen or they lie in a line, and whether the map turns right hands into left ones, that is, shows the board from
    behind (image y runs down, board y up). Direct linear transform, as in Hartley & Zisserman, algorithm 4.2; in
    further rounds with Cauchy weights, so that single corners in the wrong place do not count.
    """
    weight = seen.astype(np.float64)[..., None]
    count = np.maximum(weight.sum(axis=2, keepdims=True), 1.0)
    source, spread = _normalised(np.broadcast_to(board, pixels.shape), weight, count)
    target, _ = _normalised(pixels, weight, count)
    x, y = np.moveaxis(source, -1, 0)
    u, v = np.moveaxis(target, -1, 0)
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows_u = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=-1)
    rows_v = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=-1)
    system = np.einsum("fpki,fpkj->fpkij", rows_u, rows_u) + np.einsum("fpki,fpkj->fpkij", rows_v, rows_v)
    trust, homography, error = weight[..., 0], np.eye(3), weight[..., 0]
    for _ in range(rounds):
        _, vectors = np.linalg.eigh(np.einsum("fpk,fpkij->fpij", trust, system))
        homography = vectors[..., 0].reshape(*vectors.shape[:2], 3, 3)
        mapped = np.einsum("fpij,fpkj->fpki", homography, np.stack([x, y, one], axis=-1))
        depth = np.where(np.abs(mapped[..., 2:]) < 1e-9, 1e-9, mapped[..., 2:])
        error = np.linalg.norm(mapped[..., :2] / depth - target, axis=-1)
        size = _typical(error, seen)
        # The linear system weighs each corner by its depth as well; dividing by it leaves distances.
        trust = weight[..., 0] / depth[..., 0] ** 2 / (1.0 + (error / np.maximum(size, 1e-3)[..., None]) ** 2)
        trust = trust / np.maximum(trust.max(axis=2, keepdims=True), 1e-30)
    # The Jacobian's determinant of a homography is det(H) / depth^3; the neighbourhood's middle is at (0, 0).
    mirrored = np.linalg.det(homography) * homography[..., 2, 2] > 0.0
    enough = (seen.sum(axis=2) >= _FEWEST) & (spread > 0.1)
    return np.where(enough, _typical(error, seen), np.nan), mirrored


def _typical(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """What `_GOOD_SHARE` of the seen ones of values (F, P, K) do not exceed (F, P); infinite where none is seen."""
    ordered = np.sort(np.where(seen, values, np.inf), axis=-1)
    place = np.ceil(_GOOD_SHARE * seen.sum(axis=-1)).astype(int) - 1
    return np.take_along_axis(ordered, np.maximum(place, 0)[..., None], axis=-1)[..., 0]


def _normalised(points: np.ndarray, weight: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points about their middle with unit RMS radius, and the ratio (F, P) of their least to their largest spread."""
    centred = (points - (points * weight).sum(axis=2, keepdims=True) / count) * weight
    moments = np.einsum("fpki,fpkj->fpij", centred, centred) / count
    radius = np.sqrt(np.trace(moments, axis1=-2, axis2=-1))[..., None, None]
    least, largest = np.moveaxis(np.linalg.eigvalsh(moments), -1, 0)
    return centred / np.maximum(radius, 1e-12), np.sqrt(np.maximum(least, 0.0) / np.maximum(largest, 1e-24))
