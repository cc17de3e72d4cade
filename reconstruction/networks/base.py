"""What every reconstruction network offers to the reconstructor."""

import abc
from typing import Any

import torch
from torch import nn

# What a network remembers between windows: one entry per recurrent unit, a tensor or (LSTM) a pair of them.
State = list[Any]


class ReconstructionNetwork(nn.Module, abc.ABC):
    """Voxel grids in, images out, with a state carried from window to window.

    `num_bins` time bins of the voxel grid it reads; `multiple`: input height and width must be divisible by it;
    `settings`: the numbers and names it was built from, as they stand in a checkpoint; `reduced_precision`: whether
    it was trained to work in bfloat16; `channels_last_input`: whether it is quickest on that layout; `scaling` of the
    voxel grids that it was trained on: 'window' (each brought to mean 0 and deviation 1, as E2VID's), 'running'
    (`reconstruction.voxel.RunningScale`), 'running+scale' (with a further plane: `voxel.RunningAndScale`)
    or 'none'; `padding`: what surrounds an input that is too small, 'reflect' or 'zeros'; `shown_at`: which moment of
    the window the image shows, from 0 (its start) to 1 (its end, as E2VID's).
    """

    num_bins: int
    multiple: int
    settings: dict[str, Any]
    reduced_precision: bool = False
    channels_last_input: bool = False
    scaling: str = "window"
    padding: str = "reflect"
    shown_at: float = 1.0

    @abc.abstractmethod
    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        """Image (B, 1, H, W), dark 0 to bright 1, of the window's moment `shown_at`, and the state for the next window.

        `voxels` (B, num_bins, H, W) scaled voxel grids, with a plane more where the scaling is 'running+scale'; `state`
        None at the start of a recording.
        """
