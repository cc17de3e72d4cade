"""TwoScaleMemoryNet, of patterns_v3: TwoScaleNet with a second memory, at half of the resolution."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from reconstruction.networks.base import ReconstructionNetwork, State
from reconstruction.networks.blocks import ConvLayer
from reconstruction.networks.firenet import FireBody


class TwoScaleMemoryNet(ReconstructionNetwork):
    """A head on 2 x 2 blocks of pixels, FireNet's body on 4 x 4 blocks, and a tail that sees both.

    The body remembers `channels` numbers for sixteen pixels. What the tail makes of a window, `detail` numbers for four
    pixels, is kept as well, each as far as a gate lets it, and body and tail see it in the next window: where nothing
    moves the image stays. The output is not squashed: about 0.05 for the pattern's black and 0.95 for its white.
    """

    reduced_precision = True
    multiple = 4

    def __init__(
        self,
        *,
        num_bins: int = 8,
        channels: int = 32,
        detail: int = 16,
        scaling: str = "running+scale",
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
        self.body = FireBody(
            8 * detail, 4 * detail, channels=int(channels), num_residual_blocks=2, recurrent_residual=[]
        )
        self.tail = ConvLayer(3 * detail, detail, 3)
        self.gate = nn.Conv2d(3 * detail, detail, 3, padding=1)
        nn.init.constant_(self.gate.bias, 2.0)  # pyright: ignore[reportArgumentType]  # starts by remembering little
        self.pred = ConvLayer(detail, 4, 3, relu=False)

    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        """Images (B, 1, H, W) of voxel grids (B, planes, H, W), and the state: the body's, and what the tail keeps."""
        bins, scale = voxels[:, : self.num_bins], voxels[:, self.num_bins :, ::2, ::2]
        head = self.head(torch.cat([F.pixel_unshuffle(bins, 2), scale], dim=1))
        kept = torch.zeros_like(head) if state is None else state[1]
        seen = torch.cat([head, kept.to(head.dtype)], dim=1)
        coarse, after = self.body(F.pixel_unshuffle(seen, 2), None if state is None else state[:1])
        both = torch.cat([head, F.pixel_shuffle(coarse, 2).to(head.dtype), kept.to(head.dtype)], dim=1)
        # In float32: what changes slowly does so by less than bfloat16's eight bits.
        kept = torch.lerp(kept.float(), self.tail(both).float(), torch.sigmoid(self.gate(both)).float())
        with torch.autocast(kept.device.type, enabled=False):
            return F.pixel_shuffle(self.pred(kept), 2), [*after, kept]
