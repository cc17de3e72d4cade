"""Voxel grids on a GPU, by torch's scatter-add; on the CPU `reconstruction.voxel` is several times as fast."""

import numpy as np
import torch
from jaxtyping import Float

from reconstruction.voxel import check_events

# Weights are added as whole multiples of 2^-32: sums are exact, whatever the order in which a GPU adds, so that equal
# events always give an equal grid, and what cancels leaves nothing.
_UNIT = float(2**32)


def accumulate(
    x: np.ndarray,
    y: np.ndarray,
    t_us: np.ndarray,
    p: np.ndarray,
    *,
    width: int,
    height: int,
    num_bins: int,
    device: torch.device | str,
    span: tuple[float, float] | None = None,
) -> Float[torch.Tensor, "bins height width"]:
    """As `reconstruction.voxel.accumulate`, on a device that has float64 and int64; the same to about 1e-7."""
    columns, rows, times, polarity = check_events(x, y, t_us, p, width, height, num_bins)
    grid = torch.zeros(num_bins * height * width, dtype=torch.int64, device=device)
    if len(times):
        first, last = (times.min(), times.max()) if span is None else span
        since = torch.from_numpy((times - first).astype(np.float64)).to(device)
        cell = torch.from_numpy(rows.astype(np.int32)).to(device).long() * width
        cell += torch.from_numpy(columns.astype(np.int32)).to(device)
        sign = torch.from_numpy(polarity > 0).to(device).double() * (2 * _UNIT) - _UNIT
        position = (num_bins - 1) * since / (float(last - first) or 1.0)
        lower = position.long().clamp_(max=max(num_bins - 2, 0))
        cell += lower * (height * width)
        above = (sign * (position - lower)).round_().long()
        grid.index_add_(0, cell, sign.long() - above)
        if num_bins > 1:
            grid.index_add_(0, cell + height * width, above)
    return (grid.double() / _UNIT).float().reshape(num_bins, height, width)


def normalise(grid: Float[torch.Tensor, "bins height width"]) -> Float[torch.Tensor, "bins height width"]:
    """As `reconstruction.voxel.normalise`."""
    filled = grid != 0
    count = filled.sum()
    mean = grid.double().sum() / count.clamp(min=1)
    variance = (torch.where(filled, grid.double() - mean, 0.0) ** 2).sum() / count.clamp(min=1)
    scaled = torch.where(filled, (grid.double() - mean) / variance.sqrt().clamp(min=1e-300), 0.0)
    return torch.where(variance > 0, scaled.float(), grid)
