"""FoldedFireNet, the default network: FireNet's layout on an input folded by space-to-depth, so that it is quick."""

from typing import Any

import torch
import torch.nn.functional as F

from reconstruction.networks.base import ReconstructionNetwork, State
from reconstruction.networks.firenet import FireBody


class FoldedFireNet(ReconstructionNetwork):
    """Each `fold` x `fold` block of pixels becomes channels; head, GRU, residual block, GRU, residual block, unfold.

    The output is not squashed: about 0.05 for the pattern's black and 0.95 for its white.
    """

    reduced_precision = True
    channels_last_input = True

    def __init__(
        self,
        *,
        num_bins: int = 5,
        channels: int = 32,
        fold: int = 2,
        scaling: str = "window",
        shown_at: float = 1.0,
        **_ignored: Any,
    ):
        super().__init__()
        self.num_bins = int(num_bins)
        self.multiple = int(fold)
        self.scaling, self.shown_at = scaling, float(shown_at)
        self.settings = {
            "num_bins": self.num_bins,
            "channels": int(channels),
            "fold": int(fold),
            "scaling": scaling,
            "shown_at": self.shown_at,
        }
        self.body = FireBody(
            self.num_bins * self.multiple**2,
            self.multiple**2,
            channels=int(channels),
            num_residual_blocks=2,
            recurrent_residual=[0],
        )

    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        folded, after = self.body(F.pixel_unshuffle(voxels, self.multiple), state)
        return F.pixel_shuffle(folded, self.multiple), after
