"""Events of one window as a voxel grid: the input of every reconstruction network."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float

from jaxcal.errors import CalibrationError

_FADING = 0.99  # of the running scale, from window to window
_GAIN = 2.0  # brings running-scaled grids to about the deviation of normalised ones


def voxel_grid(
    x: np.ndarray,
    y: np.ndarray,
    t_us: np.ndarray,
    p: np.ndarray,
    *,
    width: int,
    height: int,
    num_bins: int = 5,
) -> Float[np.ndarray, "bins height width"]:
    """The normalised voxel grid of one window, float32 (num_bins, height, width).

    `x`, `y` (N,) pixel column and row; `t_us` (N,) times in microseconds (any origin); `p` (N,) polarity: a rise in
    brightness where positive (True, 1), a fall elsewhere (False, 0, -1). Each event adds its sign to the two time bins
    around it, bilinearly; time runs from the first event (bin 0) to the last EVENT (last bin), not over the window.
    Then the non-zero cells are brought to mean 0 and standard deviation 1. No events give zeros; events all at one
    time lie in bin 0. Rebecq et al., "High Speed and High Dynamic Range Video with an Event Camera", eq. 1.

    Raises CalibrationError when the arrays differ in length, or an event lies outside the sensor.
    """
    return normalise(accumulate(x, y, t_us, p, width=width, height=height, num_bins=num_bins))


def accumulate(
    x: np.ndarray,
    y: np.ndarray,
    t_us: np.ndarray,
    p: np.ndarray,
    *,
    width: int,
    height: int,
    num_bins: int = 5,
    span: tuple[float, float] | None = None,
    threads: int = 1,
) -> Float[np.ndarray, "bins height width"]:
    """As `voxel_grid`, before normalisation: the sum over all cells is the number of rises minus that of falls.

    `span`: the times of the first and the last bin, in place of those of the first and the last event. With more
    `threads` the result is the same to the bit.
    """
    columns, rows, times, polarity = check_events(x, y, t_us, p, width, height, num_bins)
    grid = np.empty((num_bins, height * width), dtype=np.float32)
    if not len(times):
        grid[:] = 0.0
    else:
        # Subtracted before the change of type: microseconds since 1970 need all bits of an integer.
        first, last = (times.min(), times.max()) if span is None else span
        since_first = (times - first).astype(np.float64, copy=False)
        cell = rows.astype(np.int32) * np.int32(width) + columns.astype(np.int32)
        rising, length = polarity > 0, float(last - first) or 1.0
        if np.any(since_first[1:] < since_first[:-1]):
            order = np.argsort(_bin_below(since_first, length, num_bins), kind="stable")
            since_first, cell, rising = since_first[order], cell[order], rising[order]
        starts = _bin_starts(since_first, length, num_bins)
        _each(lambda k: _add_to_bin(grid[k], k, starts, cell, since_first, rising, length, num_bins), num_bins, threads)
    return grid.reshape(num_bins, height, width)


def window_time(
    t_us: np.ndarray, span_us: tuple[float, float, float], shown_at: float
) -> tuple[np.ndarray, tuple[float, float] | None]:
    """The times of events for a network whose image shows the moment `shown_at` of a window, and the bins' span.

    `span_us` the window's start, the moment that is to be shown, and its end. The parts before and behind that moment
    are stretched, so that it comes to lie at `shown_at` of the bins wherever in the window it is: frames may be wanted
    at times that are not evenly spaced. Networks that show the end get times as they are, and bins from the first event
    to the last one, as E2VID's.
    """
    if shown_at == 1.0:
        return t_us, None
    start, shown, end = span_us
    return _stretched(np.asarray(t_us), float(start), float(shown), float(end), shown_at), (0.0, 1.0)


def normalise(grid: Float[np.ndarray, "bins height width"]) -> Float[np.ndarray, "bins height width"]:
    """Non-zero cells brought to mean 0 and standard deviation 1 (of the population), float32; zero cells stay zero.

    A grid whose non-zero cells are all equal has no deviation to divide by and is returned as it is, as e2calib does.
    """
    scaled = np.array(grid, dtype=np.float32, order="C")
    _scale_filled(scaled.reshape(-1))
    return scaled


class RunningScale:
    """Voxel grids in units of the events that a pixel fires when a whole edge passes: called window after window.

    `normalise` brings every window to the same deviation, whether edges crept by a third of a pixel or ran across
    many: what a count means for the intensity changes from window to window. Here the unit is one for the recording: of
    all net events (rises minus falls, per pixel) half lie in pixels with no more than this many of them; single noise
    events weigh little, and a few hot pixels move a median little. Of slow windows, in which no edge passes as a
    whole, it says too little: the largest recent value counts, which fades slowly.
    """

    def __init__(self) -> None:
        self.events = 1.0

    def __call__(
        self, grid: Float[np.ndarray, "bins height width"], out: np.ndarray | None = None
    ) -> Float[np.ndarray, "bins height width"]:
        net = _net_events(np.ascontiguousarray(grid).reshape(len(grid), -1))
        weight = np.cumsum(np.bincount(net) * np.arange(net.max(initial=0) + 1))
        median = float(np.searchsorted(weight, 0.5 * weight[-1])) if weight[-1] else 0.0
        self.events = max(median, _FADING * self.events, 1.0)
        return np.multiply(grid, np.float32(_GAIN / self.events), out=out, dtype=np.float32)


class RunningAndScale:
    """Voxel grids as of `RunningScale`, and one more plane: half the logarithm of its unit.

    A scaled grid does not tell how many events an edge makes, and so not the contrast threshold; but edges that move
    appear behind their places by an amount that grows with it.
    """

    def __init__(self) -> None:
        self._scale = RunningScale()

    def __call__(self, grid: Float[np.ndarray, "bins height width"]) -> Float[np.ndarray, "planes height width"]:
        planes = np.empty((len(grid) + 1, *grid.shape[1:]), dtype=np.float32)
        self._scale(grid, out=planes[:-1])
        planes[-1] = self._plane()
        return planes

    def beside(self, grid: Float[np.ndarray, "bins height width"]) -> Float[np.ndarray, "planes height width"]:
        """A grid and the plane as of the last call."""
        return np.concatenate([grid, np.full((1, *grid.shape[1:]), self._plane(), dtype=np.float32)])

    def _plane(self) -> float:
        return 0.5 * float(np.log(self._scale.events))


def scaler(scaling: str) -> Callable[[np.ndarray], np.ndarray]:
    """What scales the voxel grids of one recording, called window after window; `scaling` of a network."""
    return {"running": RunningScale, "running+scale": RunningAndScale}.get(scaling, lambda: normalise)()


def check_events(
    x: np.ndarray, y: np.ndarray, t_us: np.ndarray, p: np.ndarray, width: int, height: int, num_bins: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The events as arrays; raises CalibrationError when they differ in length, or one lies outside the sensor."""
    if num_bins < 1:
        raise CalibrationError(f"Voxel grid: num_bins is {num_bins}; at least one time bin is needed.")
    columns, rows, times, polarity = (np.asarray(values) for values in (x, y, t_us, p))
    n = len(times)
    if not len(columns) == len(rows) == len(polarity) == n:
        raise CalibrationError(
            f"Voxel grid: x, y, t_us, p have {len(columns)}, {len(rows)}, {n}, {len(polarity)} entries; "
            "there must be one of each per event."
        )
    # By extremes first, which is quicker than by each.
    if n and not (columns.min() >= 0 and columns.max() < width and rows.min() >= 0 and rows.max() < height):
        outside = (columns < 0) | (columns >= width) | (rows < 0) | (rows >= height)
        place = int(np.argmax(outside))
        raise CalibrationError(
            f"Voxel grid: event {place} at (x, y) = ({columns[place]}, {rows[place]}) lies outside the "
            f"{width}x{height} sensor. Check the width and height given for this camera."
        )
    return columns, rows, times, polarity


def _each(work: Callable[[int], None], count: int, threads: int) -> None:
    """`work` of every number below `count`, by several threads where they do not hold Python's lock."""
    if min(threads, count) < 2:
        for number in range(count):
            work(number)
        return
    with ThreadPoolExecutor(min(threads, count)) as pool:
        list(pool.map(work, range(count)))  # raises what any of them raised


@numba.njit(cache=True)
@no_type_check  # the tests' runtime checks would wrap it in what numba cannot compile
def _stretched(times, start, shown, end, shown_at):
    # As numpy's interp, for parts that may have no length.
    before = shown_at / (shown - start) if shown > start else 0.0
    behind = (1.0 - shown_at) / (end - shown) if end > shown else 0.0
    out = np.empty(len(times))
    for i in range(len(times)):
        time = np.float64(times[i])
        if time >= end:
            out[i] = 1.0
        elif time >= shown:
            out[i] = behind * (time - shown) + shown_at
        elif time > start:
            out[i] = before * (time - start)
        else:
            out[i] = 0.0
    return out


@numba.njit(cache=True)
@no_type_check
def _bin_below(since_first, span, num_bins):
    out = np.empty(len(since_first), dtype=np.int32)
    for i in range(len(since_first)):
        out[i] = min(int((num_bins - 1) * since_first[i] / span), max(num_bins - 2, 0))
    return out


@numba.njit(cache=True)
@no_type_check
def _bin_starts(since_first, span, num_bins):
    # Where the events begin whose bin below is k, of ones sorted by it; `starts[k + 1]` is where they end.
    last_lower = max(num_bins - 2, 0)
    starts = np.full(num_bins + 1, len(since_first))
    for k in range(num_bins + 1):
        low, high = 0, len(since_first)
        while low < high:
            middle = (low + high) // 2
            if min(int((num_bins - 1) * since_first[middle] / span), last_lower) < k:
                low = middle + 1
            else:
                high = middle
        starts[k] = low
    return starts


@numba.njit(cache=True, nogil=True)
@no_type_check
def _add_to_bin(plane, k, starts, cell, since_first, rising, span, num_bins):
    # The reference sums in double precision but stores float32 after every event, first all shares of the bins below,
    # then all of those above; what that leaves where events cancel counts as non-zero in the normalisation. To agree
    # with it, so does this; hence a loop and not a bincount. Bin by bin, since one plane fits a cache and all do not.
    plane[:] = 0.0
    for i in range(starts[k], starts[k + 1]):
        share = 1.0 - ((num_bins - 1) * since_first[i] / span - k)
        plane[cell[i]] = np.float32(np.float64(plane[cell[i]]) + (share if rising[i] else -share))
    for i in range(starts[k - 1] if k > 0 else 0, starts[k] if k > 0 else 0):
        share = (num_bins - 1) * since_first[i] / span - (k - 1)
        plane[cell[i]] = np.float32(np.float64(plane[cell[i]]) + (share if rising[i] else -share))


@numba.njit(cache=True)
@no_type_check
def _net_events(grid):
    # Rises minus falls of every pixel without their sign, rounded: planes added in their order, as numpy does.
    net = grid[0].copy()
    for plane in grid[1:]:
        for i in range(len(net)):
            net[i] += plane[i]
    whole = np.empty(len(net), dtype=np.int32)
    for i in range(len(net)):
        whole[i] = np.int32(np.rint(abs(net[i])))
    return whole


@numba.njit(cache=True)
@no_type_check
def _scale_filled(grid):
    count, total = 0, 0.0
    for value in grid:
        if value != 0:
            count += 1
            total += value
    if count == 0:
        return
    mean, squares = total / count, 0.0
    for value in grid:
        if value != 0:
            squares += (value - mean) ** 2
    deviation = np.sqrt(squares / count)
    if deviation > 0:
        for i in range(len(grid)):
            if grid[i] != 0:
                grid[i] = np.float32((np.float64(grid[i]) - mean) / deviation)
