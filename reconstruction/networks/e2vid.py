"""E2VID: the recurrent UNet of Rebecq et al. (CVPR 2019, TPAMI 2020), in the layout of the official checkpoints."""

from typing import Any

import torch
from torch import nn

from reconstruction.networks.base import ReconstructionNetwork, State
from reconstruction.networks.blocks import (
    RECURRENT_BLOCKS,
    ConvLayer,
    RecurrentConvLayer,
    ResidualBlock,
    TransposedConvLayer,
    UpsampleConvLayer,
    one_of,
)


class RecurrentUNet(nn.Module):
    """Head, encoders with recurrent cells, residual blocks, decoders with skip connections, prediction."""

    def __init__(
        self,
        *,
        num_bins: int,
        skip_type: str,
        recurrent_block_type: str,
        num_encoders: int,
        base_num_channels: int,
        num_residual_blocks: int,
        norm: str | None,
        use_upsample_conv: bool,
    ):
        super().__init__()
        self.concatenates = skip_type == "concat"
        widths = [base_num_channels * 2**level for level in range(num_encoders + 1)]
        fan_in = 2 if self.concatenates else 1
        up = UpsampleConvLayer if use_upsample_conv else TransposedConvLayer
        self.head = ConvLayer(num_bins, widths[0], 5)
        self.encoders = nn.ModuleList(
            RecurrentConvLayer(
                widths[level],
                widths[level + 1],
                5,
                stride=2,
                recurrent_block_type=recurrent_block_type,
                norm=norm,
            )
            for level in range(num_encoders)
        )
        self.resblocks = nn.ModuleList(ResidualBlock(widths[-1], norm=norm) for _ in range(num_residual_blocks))
        self.decoders = nn.ModuleList(
            up(fan_in * widths[level + 1], widths[level], 5, norm=norm) for level in reversed(range(num_encoders))
        )
        self.pred = ConvLayer(fan_in * widths[0], 1, 1, relu=False, norm=norm)

    def _skip(self, x: torch.Tensor, earlier: torch.Tensor) -> torch.Tensor:
        return torch.cat([x, earlier], dim=1) if self.concatenates else x + earlier

    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        head = self.head(voxels)
        before = [None] * len(self.encoders) if state is None else state
        x, encoded, after = head, [], []
        for encoder, remembered in zip(self.encoders, before, strict=True):
            x, remembered = encoder(x, remembered)
            encoded.append(x)
            after.append(remembered)
        for block in self.resblocks:
            x = block(x)
        for decoder, earlier in zip(self.decoders, reversed(encoded), strict=True):
            x = decoder(self._skip(x, earlier))
        return torch.sigmoid(self.pred(self._skip(x, head))), after


class E2VIDRecurrent(ReconstructionNetwork):
    """The official E2VID architecture, with every switch its checkpoints may set.

    `skip_type` 'sum' or 'concat'; `recurrent_block_type` 'convlstm' or 'convgru'; `norm` 'BN', 'IN' or None;
    `use_upsample_conv` False for transposed convolutions. Defaults are the reference implementation's. Settings it
    does not know are ignored, as there.
    """

    def __init__(
        self,
        *,
        num_bins: int = 5,
        skip_type: str = "sum",
        recurrent_block_type: str = "convlstm",
        num_encoders: int = 4,
        base_num_channels: int = 32,
        num_residual_blocks: int = 2,
        norm: str | None = None,
        use_upsample_conv: bool = True,
        **_ignored: Any,
    ):
        super().__init__()
        self.num_bins = int(num_bins)
        self.multiple = 2 ** int(num_encoders)
        self.settings = {
            "num_bins": self.num_bins,
            "skip_type": one_of("skip_type", skip_type, ("sum", "concat")),
            "recurrent_block_type": one_of("recurrent_block_type", recurrent_block_type, tuple(RECURRENT_BLOCKS)),
            "num_encoders": int(num_encoders),
            "base_num_channels": int(base_num_channels),
            "num_residual_blocks": int(num_residual_blocks),
            # The reference turns a missing norm into the text 'None', and some files hold 'none'.
            "norm": one_of("norm", None if str(norm).lower() == "none" else norm, ("BN", "IN", None)),
            "use_upsample_conv": bool(use_upsample_conv),
        }
        self.unetrecurrent = RecurrentUNet(**self.settings)

    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        return self.unetrecurrent(voxels, state)
