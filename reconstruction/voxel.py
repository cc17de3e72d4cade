"""Events of one window as a voxel grid: the input of every reconstruction network."""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float

from jaxcal.errors import CalibrationError


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
) -> Float[np.ndarray, "bins height width"]:
    """As `voxel_grid`, before normalisation: the sum over all cells is the number of rises minus that of falls."""
    if num_bins < 1:
        raise CalibrationError(f"Voxel grid: num_bins is {num_bins}; at least one time bin is needed.")
    columns, rows, times, polarity = (np.asarray(values) for values in (x, y, t_us, p))
    _check(columns, rows, times, polarity, width, height)
    grid = np.zeros(num_bins * height * width, dtype=np.float32)
    if len(times):
        # Subtracted before the change of type: microseconds since 1970 need all bits of an integer.
        since_first = (times - times.min()).astype(np.float64)
        position = (num_bins - 1) * since_first / (since_first.max() or 1.0)
        lower_bin = np.minimum(position.astype(np.int64), max(num_bins - 2, 0))
        weight_above = position - lower_bin
        cell = (lower_bin * height + rows.astype(np.int64)) * width + columns.astype(np.int64)
        signs = np.where(polarity > 0, 1.0, -1.0)
        _add_each(grid, cell, signs * (1.0 - weight_above))
        if num_bins > 1:
            _add_each(grid, cell + height * width, signs * weight_above)
    return grid.reshape(num_bins, height, width)


def normalise(grid: Float[np.ndarray, "bins height width"]) -> Float[np.ndarray, "bins height width"]:
    """Non-zero cells brought to mean 0 and standard deviation 1 (of the population), float32; zero cells stay zero.

    A grid whose non-zero cells are all equal has no deviation to divide by and is returned as it is, as e2calib does.
    """
    scaled = grid.astype(np.float32)
    filled = grid != 0
    values = grid[filled].astype(np.float64)
    if len(values):
        deviation = values.std()
        if deviation > 0:
            scaled[filled] = (values - values.mean()) / deviation
    return scaled


def _check(
    columns: np.ndarray, rows: np.ndarray, times: np.ndarray, polarity: np.ndarray, width: int, height: int
) -> None:
    n = len(times)
    if not len(columns) == len(rows) == len(polarity) == n:
        raise CalibrationError(
            f"Voxel grid: x, y, t_us, p have {len(columns)}, {len(rows)}, {n}, {len(polarity)} entries; "
            "there must be one of each per event."
        )
    outside = (columns < 0) | (columns >= width) | (rows < 0) | (rows >= height)
    if outside.any():
        place = int(np.argmax(outside))
        raise CalibrationError(
            f"Voxel grid: event {place} at (x, y) = ({columns[place]}, {rows[place]}) lies outside the "
            f"{width}x{height} sensor. Check the width and height given for this camera."
        )


@numba.njit(cache=True)
@no_type_check  # the tests' runtime checks would wrap it in what numba cannot compile
def _add_each(grid, cells, values):
    # The reference sums in double precision but stores float32 after every event, and what that leaves where events
    # cancel counts as non-zero in the normalisation. To agree with it, so does this; hence a loop and not a bincount.
    for i in range(len(cells)):
        grid[cells[i]] = np.float32(np.float64(grid[cells[i]]) + values[i])
