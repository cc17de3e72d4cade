"""FireNet: the small recurrent network of Scheerlinck et al. (WACV 2020), in the layout of its official checkpoint."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn

from reconstruction.networks.base import ReconstructionNetwork, State
from reconstruction.networks.blocks import (
    RECURRENT_BLOCKS,
    ConvLayer,
    RecurrentConvLayer,
    RecurrentResidualLayer,
    ResidualBlock,
    norm_name,
    one_of,
)


class FireBody(nn.Module):
    """Recurrent head, residual blocks of which some are recurrent, prediction; all at the input's resolution.

    `recurrent_residual` lists the residual blocks that are followed by a recurrent cell (-1: all of them). `concat`:
    the prediction sees the head's output beside the last block's.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        channels: int,
        num_residual_blocks: int,
        recurrent_residual: Sequence[int],
        recurrent_block_type: str = "convgru",
        kernel_size: int = 3,
        recurrent_kernel_size: int = 3,
        norm: str | None = None,
        concat: bool = False,
    ):
        super().__init__()
        self.concat = concat
        cells: dict[str, Any] = {
            "recurrent_block_type": recurrent_block_type,
            "recurrent_kernel_size": recurrent_kernel_size,
        }
        self.head = RecurrentConvLayer(in_channels, channels, kernel_size, **cells, norm=norm)
        self.resblocks = nn.ModuleList(
            RecurrentResidualLayer(channels, **cells, norm=norm)
            if index in recurrent_residual or -1 in recurrent_residual
            else ResidualBlock(channels, norm=norm)
            for index in range(num_residual_blocks)
        )
        self.pred = ConvLayer((2 if concat else 1) * channels, out_channels, 1, relu=False)

    def forward(self, x: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        recurrent = [isinstance(block, RecurrentResidualLayer) for block in self.resblocks]
        before = iter([None] * (1 + sum(recurrent)) if state is None else state)
        x, remembered = self.head(x, next(before))
        head = x
        after = [remembered]
        for block, remembers in zip(self.resblocks, recurrent, strict=True):
            if remembers:
                x, remembered = block(x, next(before))
                after.append(remembered)
            else:
                x = block(x)
        if self.concat:
            x = torch.cat([x, head], dim=1)
        with torch.autocast(x.device.type, enabled=False):  # grey levels need more than bfloat16's eight bits
            return self.pred(x.float()), after


class FireNet(ReconstructionNetwork):
    """The official FireNet architecture. Defaults are the reference implementation's; unknown settings are ignored.

    The reference pads the input as for an encoder of `num_encoders` levels, though there is none; so does this.
    `skip_type` 'no_skip' and 'sum' are the same here: the reference's prediction never adds what it skips; 'concat'
    appends it. FireNet+ (Stoffregen et al., ECCV 2020) is one setting: `num_encoders` 0, `normalise` False, `padding`
    'zeros', and `recurrent_kernel_size` as `kernel_size`.
    """

    def __init__(
        self,
        *,
        num_bins: int = 5,
        skip_type: str = "sum",
        recurrent_block_type: str = "convgru",
        num_encoders: int = 4,
        base_num_channels: int = 32,
        num_residual_blocks: int = 2,
        norm: str | None = None,
        kernel_size: int = 3,
        recurrent_kernel_size: int = 3,
        recurrent_blocks: Mapping[str, Sequence[int]] | None = None,
        normalise: bool = True,
        padding: str = "reflect",
        **_ignored: Any,
    ):
        super().__init__()
        self.num_bins = int(num_bins)
        self.multiple = 2 ** int(num_encoders)
        self.scaling = "window" if normalise else "none"
        self.padding = one_of("padding", padding, ("reflect", "zeros"))
        recurrent_residual = [0] if recurrent_blocks is None else list(recurrent_blocks.get("resblock", []))
        self.settings = {
            "num_bins": self.num_bins,
            "skip_type": one_of("skip_type", skip_type, ("sum", "no_skip", "concat")),
            "recurrent_block_type": one_of("recurrent_block_type", recurrent_block_type, tuple(RECURRENT_BLOCKS)),
            "num_encoders": int(num_encoders),
            "base_num_channels": int(base_num_channels),
            "num_residual_blocks": int(num_residual_blocks),
            "norm": norm_name(norm),
            "kernel_size": int(kernel_size),
            "recurrent_kernel_size": int(recurrent_kernel_size),
            "recurrent_blocks": {"resblock": recurrent_residual},
            "normalise": bool(normalise),
            "padding": self.padding,
        }
        self.net = FireBody(
            self.num_bins,
            1,
            channels=self.settings["base_num_channels"],
            num_residual_blocks=self.settings["num_residual_blocks"],
            recurrent_residual=recurrent_residual,
            recurrent_block_type=self.settings["recurrent_block_type"],
            kernel_size=self.settings["kernel_size"],
            recurrent_kernel_size=self.settings["recurrent_kernel_size"],
            norm=self.settings["norm"],
            concat=skip_type == "concat",
        )

    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        return self.net(voxels, state)
