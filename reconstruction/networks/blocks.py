"""Building blocks of E2VID and FireNet; attribute names are those of the official checkpoints' tensors."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from jaxcal.errors import CalibrationError


def _normalisation(norm: str | None, channels: int, *, running_statistics: bool) -> nn.Module:
    if norm == "BN":
        return nn.BatchNorm2d(channels)
    if norm == "IN":
        return nn.InstanceNorm2d(channels, track_running_stats=running_statistics)
    return nn.Identity()


class ConvLayer(nn.Module):
    """Convolution, normalisation, activation. With batch normalisation the convolution has no bias of its own."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int,
        *,
        stride: int = 1,
        relu: bool = True,
        norm: str | None = None,
    ):
        super().__init__()
        padding = kernel_size // 2
        self.conv2d = nn.Conv2d(in_channels, out_channels, kernel_size, stride, padding, bias=norm != "BN")
        self.norm_layer = _normalisation(norm, out_channels, running_statistics=True)
        self.activation = nn.ReLU() if relu else nn.Identity()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.activation(self.norm_layer(self.conv2d(x)))


class UpsampleConvLayer(ConvLayer):
    """Bilinear upsampling by two, then a convolution: slower than a transposed one, without its grid pattern."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return super().forward(F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False))


class TransposedConvLayer(nn.Module):
    """Transposed convolution that doubles the size, normalisation, ReLU."""

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, *, norm: str | None = None):
        super().__init__()
        self.transposed_conv2d = nn.ConvTranspose2d(
            in_channels,
            out_channels,
            kernel_size,
            stride=2,
            padding=kernel_size // 2,
            output_padding=1,
            bias=norm != "BN",
        )
        self.norm_layer = _normalisation(norm, out_channels, running_statistics=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.norm_layer(self.transposed_conv2d(x)))


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions around which the input is added."""

    def __init__(self, channels: int, *, norm: str | None = None):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1, bias=norm != "BN")
        self.bn1 = _normalisation(norm, channels, running_statistics=False)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=norm != "BN")
        self.bn2 = _normalisation(norm, channels, running_statistics=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        inner = torch.relu(self.bn1(self.conv1(x)))
        return torch.relu(self.bn2(self.conv2(inner)) + x)


class ConvLSTM(nn.Module):
    """Convolutional LSTM cell (Shi et al. 2015, without peepholes); the state is (hidden, cell)."""

    def __init__(self, channels: int, kernel_size: int = 3):
        super().__init__()
        self.Gates = nn.Conv2d(2 * channels, 4 * channels, kernel_size, padding=kernel_size // 2)

    def forward(
        self, x: torch.Tensor, state: tuple[torch.Tensor, torch.Tensor] | None
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        hidden, cell = (torch.zeros_like(x), torch.zeros_like(x)) if state is None else state
        write, keep, show, content = self.Gates(torch.cat([x, hidden], dim=1)).chunk(4, dim=1)
        cell = torch.sigmoid(keep) * cell + torch.sigmoid(write) * torch.tanh(content)
        hidden = torch.sigmoid(show) * torch.tanh(cell)
        return hidden, (hidden, cell)


class ConvGRU(nn.Module):
    """Convolutional GRU cell (Ballas et al. 2016); the state is the output."""

    def __init__(self, channels: int, kernel_size: int = 3):
        super().__init__()
        self.reset_gate = nn.Conv2d(2 * channels, channels, kernel_size, padding=kernel_size // 2)
        self.update_gate = nn.Conv2d(2 * channels, channels, kernel_size, padding=kernel_size // 2)
        self.out_gate = nn.Conv2d(2 * channels, channels, kernel_size, padding=kernel_size // 2)
        for gate in (self.reset_gate, self.update_gate, self.out_gate):
            nn.init.orthogonal_(gate.weight)
            if gate.bias is not None:
                nn.init.zeros_(gate.bias)

    def forward(self, x: torch.Tensor, state: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        hidden = torch.zeros_like(x) if state is None else state
        both = torch.cat([x, hidden], dim=1)
        if not torch.is_grad_enabled():
            hidden = self._quickly(both, hidden)
            return hidden, hidden
        update = torch.sigmoid(self.update_gate(both))
        reset = torch.sigmoid(self.reset_gate(both))
        candidate = torch.tanh(self.out_gate(torch.cat([x, hidden * reset], dim=1)))
        hidden = hidden + update * (candidate - hidden)
        return hidden, hidden

    def _quickly(self, both: torch.Tensor, hidden: torch.Tensor) -> torch.Tensor:
        """The same where no gradient is asked for: one convolution for two gates, nothing copied that can be reused."""
        channels = hidden.shape[1]
        gates = (self.update_gate, self.reset_gate)
        weight = torch.cat([gate.weight for gate in gates])
        bias = None if gates[0].bias is None else torch.cat([gate.bias for gate in gates if gate.bias is not None])
        update, reset = F.conv2d(both, weight, bias, padding=gates[0].padding).sigmoid_().chunk(2, dim=1)
        torch.mul(hidden, reset, out=both[:, both.shape[1] - channels :])
        return torch.lerp(hidden, self.out_gate(both).tanh_().to(hidden.dtype), update.to(hidden.dtype))


RECURRENT_BLOCKS: dict[str, type[ConvLSTM] | type[ConvGRU]] = {"convlstm": ConvLSTM, "convgru": ConvGRU}


class RecurrentConvLayer(nn.Module):
    """A convolution layer followed by a recurrent cell."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int,
        *,
        stride: int = 1,
        recurrent_block_type: str = "convlstm",
        recurrent_kernel_size: int = 3,
        norm: str | None = None,
    ):
        super().__init__()
        self.conv = ConvLayer(in_channels, out_channels, kernel_size, stride=stride, norm=norm)
        self.recurrent_block = RECURRENT_BLOCKS[recurrent_block_type](out_channels, recurrent_kernel_size)

    def forward(self, x: torch.Tensor, state: Any) -> tuple[torch.Tensor, Any]:
        return self.recurrent_block(self.conv(x), state)


class RecurrentResidualLayer(nn.Module):
    """A residual block followed by a recurrent cell."""

    def __init__(
        self,
        channels: int,
        *,
        recurrent_block_type: str = "convgru",
        recurrent_kernel_size: int = 3,
        norm: str | None = None,
    ):
        super().__init__()
        self.conv = ResidualBlock(channels, norm=norm)
        self.recurrent_block = RECURRENT_BLOCKS[recurrent_block_type](channels, recurrent_kernel_size)

    def forward(self, x: torch.Tensor, state: Any) -> tuple[torch.Tensor, Any]:
        return self.recurrent_block(self.conv(x), state)


def norm_name(value: Any) -> str | None:
    """'BN', 'IN' or None: the reference turns a missing norm into the text 'None', and some files hold 'none'."""
    return one_of("norm", None if str(value).lower() == "none" else value, ("BN", "IN", None))


def one_of(settings_name: str, value: Any, allowed: tuple[Any, ...]) -> Any:
    """`value`, or a CalibrationError that lists what is allowed."""
    if value not in allowed:
        choices = ", ".join(repr(choice) for choice in allowed)
        raise CalibrationError(f"Network setting {settings_name} is {value!r}; known values are {choices}.")
    return value
