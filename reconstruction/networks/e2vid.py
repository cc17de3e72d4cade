"""E2VID: the UNets of Rebecq et al. (CVPR 2019, TPAMI 2020), in the layout of the official checkpoints."""

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
    norm_name,
    one_of,
)

_ACTIVATIONS = {"sigmoid": torch.sigmoid, "tanh": torch.tanh, "relu": torch.relu, "none": nn.Identity()}


class UNet(nn.Module):
    """Head, encoders (with recurrent cells, if any), residual blocks, decoders with skip connections, prediction.

    `recurrent_block_type` None: plain convolutions encode. `channel_multiplier`: how much wider each level is.
    """

    def __init__(
        self,
        *,
        num_bins: int,
        skip_type: str,
        recurrent_block_type: str | None,
        num_encoders: int,
        base_num_channels: int,
        num_residual_blocks: int,
        norm: str | None,
        use_upsample_conv: bool,
        kernel_size: int,
        channel_multiplier: float,
        final_activation: str,
    ):
        super().__init__()
        self.skip_type, self.recurrent = skip_type, recurrent_block_type is not None
        self.final_activation = _ACTIVATIONS[final_activation]
        widths = [int(base_num_channels * channel_multiplier**level) for level in range(num_encoders + 1)]
        fan_in = 2 if skip_type == "concat" else 1
        up = UpsampleConvLayer if use_upsample_conv else TransposedConvLayer
        self.head = ConvLayer(num_bins, widths[0], kernel_size)
        self.encoders = nn.ModuleList(
            ConvLayer(widths[level], widths[level + 1], kernel_size, stride=2, norm=norm)
            if recurrent_block_type is None
            else RecurrentConvLayer(
                widths[level],
                widths[level + 1],
                kernel_size,
                stride=2,
                recurrent_block_type=recurrent_block_type,
                norm=norm,
            )
            for level in range(num_encoders)
        )
        self.resblocks = nn.ModuleList(ResidualBlock(widths[-1], norm=norm) for _ in range(num_residual_blocks))
        self.decoders = nn.ModuleList(
            up(fan_in * widths[level + 1], widths[level], kernel_size, norm=norm)
            for level in reversed(range(num_encoders))
        )
        self.pred = ConvLayer(fan_in * widths[0], 1, 1, relu=False, norm=norm)

    def _skip(self, x: torch.Tensor, earlier: torch.Tensor) -> torch.Tensor:
        if self.skip_type == "concat":
            return torch.cat([x, earlier], dim=1)
        return x + earlier if self.skip_type == "sum" else x

    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        head = self.head(voxels)
        before = state or [None] * len(self.encoders)
        x, encoded, after = head, [], []
        for encoder, remembered in zip(self.encoders, before, strict=True):
            if self.recurrent:
                x, remembered = encoder(x, remembered)
                after.append(remembered)
            else:
                x = encoder(x)
            encoded.append(x)
        for block in self.resblocks:
            x = block(x)
        for decoder, earlier in zip(self.decoders, reversed(encoded), strict=True):
            x = decoder(self._skip(x, earlier))
        return self.final_activation(self.pred(self._skip(x, head))), after


class E2VIDRecurrent(ReconstructionNetwork):
    """The official E2VID architecture, with every switch its checkpoints may set; E2VID+ is one setting of it.

    `skip_type` 'sum', 'concat' or 'no_skip'; `recurrent_block_type` 'convlstm' or 'convgru'; `norm` 'BN', 'IN' or
    None; `use_upsample_conv` False for transposed convolutions. Defaults are the reference implementation's. Settings
    it does not know are ignored, as there. What Stoffregen et al. (ECCV 2020) do otherwise in E2VID+ can be set, too:
    `final_activation` 'none', `normalise` False (raw voxel grids), `padding` 'zeros', `kernel_size`,
    `channel_multiplier`.
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
        kernel_size: int = 5,
        channel_multiplier: float = 2.0,
        final_activation: str = "sigmoid",
        normalise: bool = True,
        padding: str = "reflect",
        **_ignored: Any,
    ):
        super().__init__()
        self.num_bins = int(num_bins)
        self.multiple = 2 ** int(num_encoders)
        self.scaling = "window" if normalise else "none"
        self.padding = one_of("padding", padding, ("reflect", "zeros"))
        structure = {
            "num_bins": self.num_bins,
            "skip_type": one_of("skip_type", skip_type, ("sum", "concat", "no_skip")),
            "recurrent_block_type": one_of("recurrent_block_type", recurrent_block_type, tuple(RECURRENT_BLOCKS)),
            "num_encoders": int(num_encoders),
            "base_num_channels": int(base_num_channels),
            "num_residual_blocks": int(num_residual_blocks),
            "norm": norm_name(norm),
            "use_upsample_conv": bool(use_upsample_conv),
            "kernel_size": int(kernel_size),
            "channel_multiplier": float(channel_multiplier),
            "final_activation": one_of("final_activation", final_activation or "none", tuple(_ACTIVATIONS)),
        }
        self.settings = structure | {"normalise": bool(normalise), "padding": self.padding}
        self.unetrecurrent = UNet(**structure)

    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        return self.unetrecurrent(voxels, state)


class E2VID(ReconstructionNetwork):
    """The UNet without memory that the official code has beside E2VIDRecurrent; the same switches."""

    def __init__(
        self,
        *,
        num_bins: int = 5,
        skip_type: str = "sum",
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
            "skip_type": one_of("skip_type", skip_type, ("sum", "concat", "no_skip")),
            "num_encoders": int(num_encoders),
            "base_num_channels": int(base_num_channels),
            "num_residual_blocks": int(num_residual_blocks),
            "norm": norm_name(norm),
            "use_upsample_conv": bool(use_upsample_conv),
        }
        self.unet = UNet(
            **self.settings,
            recurrent_block_type=None,
            kernel_size=5,
            channel_multiplier=2.0,
            final_activation="sigmoid",
        )

    def forward(self, voxels: torch.Tensor, state: State | None) -> tuple[torch.Tensor, State]:
        return self.unet(voxels, state)
