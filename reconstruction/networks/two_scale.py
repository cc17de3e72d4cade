"""TwoScaleNet: state and most of the work at a quarter of the resolution, edges at half of it."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from reconstruction.networks.base import ReconstructionNetwork, State
from reconstruction.networks.blocks import ConvLayer
from reconstruction.networks.firenet import FireBody


class TwoScaleNet(ReconstructionNetwork):
    """A head on 2 x 2 blocks of pixels, FireNet's body on 4 x 4 blocks, and a tail that sees both.

    The body costs a quarter of what it does on 2 x 2 blocks, and so does its memory: the sixteen pixels of a block
    share `channels` numbers. Where edges lie to a fraction of a pixel is in the events of this window, which reach the
    tail by `detail` channels of the head; where nothing moves for some windows, more is forgotten than by
    FoldedFireNet (see TwoScaleMemoryNet). The output is not squashed: about 0.05 for the pattern's black and 0.95 for
    its white.
    """

    reduced_precision = True
    multiple = 4
    remembers = False

    def __init__(
        self,
        *,
        num_bins: int = 8,
        channels: int = 32,
        detail: int = 16,
        scaling: str = "window",
        shown_at: float = 0.5,
        **_ignored: Any,
    ):
        super().__init__()
        self.num_bins, self.scaling, self.shown_at = int(num_bins), scaling, float(shown_at)
        self.settings = {
            "num_bins": self.num_bins,
            "channels": int(channels),
            "detail": int(detail),
            "scaling": scaling,
            "shown_at": self.shown_at,
        }
        self.head = ConvLayer(4 * self.num_bins + (scaling == "running+scale"), detail, 3)
        kept = int(detail) if self.remembers else 0
        self.body = FireBody(
            4 * (detail + kept), 4 * detail, channels=int(channels), num_residual_blocks=2, recurrent_residual=[]
        )
        self.tail = ConvLayer(2 * detail + kept, detail, 3)
        if self.remembers:
            self.gate = nn.Conv2d(3 * detail, detail, 3, padding=1)
            nn.init.constant_(self.gate.bias, 2.0)  # pyright: ignore[reportArgumentType]  # starts by remembering little
        self.pred = ConvLayer(detail, 4, 3, relu=False)

    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        """Images (B, 1, H, W) of voxel grids (B, planes, H, W), and the state: the body's, and what the tail keeps."""
        bins, scale = voxels[:, : self.num_bins], voxels[:, self.num_bins :, ::2, ::2]
        blocks = _in_blocks(bins)
        blocks = torch.cat([blocks, scale.to(blocks.dtype)], dim=1)
        head = self.head(blocks.contiguous(memory_format=torch.channels_last))
        before, kept = (None, torch.zeros_like(head)) if state is None else (state[:1], state[-1])
        seen = [kept.to(head.dtype)] if self.remembers else []
        coarse, after = self.body(F.pixel_unshuffle(torch.cat([head, *seen], dim=1), 2), before)
        both = torch.cat([head, F.pixel_shuffle(coarse, 2).to(head.dtype), *seen], dim=1)
        joined = self.tail(both)
        if self.remembers:
            # In float32: what changes slowly does so by less than bfloat16's eight bits.
            joined = torch.lerp(kept.float(), joined.float(), torch.sigmoid(self.gate(both)).float())
            after = [*after, joined]
        with torch.autocast(joined.device.type, enabled=False):  # grey levels need more than bfloat16's eight bits
            return F.pixel_shuffle(self.pred(joined.float()), 2), after


def _in_blocks(planes: torch.Tensor) -> torch.Tensor:
    """As `F.pixel_unshuffle` by 2, in a third of its time on a CPU, and in the precision that the next layer takes."""
    if torch.is_autocast_enabled(planes.device.type):
        planes = planes.to(torch.get_autocast_dtype(planes.device.type))
    return torch.stack([planes[..., i::2, j::2] for i in (0, 1) for j in (0, 1)], dim=2).flatten(1, 2)
