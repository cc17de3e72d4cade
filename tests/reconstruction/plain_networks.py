"""E2VID's and FireNet's layers written out as plain functions of a checkpoint's tensors, to hold the networks against.

Nothing is shared with the package: what a layer does is told by the tensors' official names and the papers' equations
(Rebecq et al. 2020, Scheerlinck et al. 2020; Shi et al. 2015 for the LSTM, Ballas et al. 2016 for the GRU).
"""

from typing import Any

import torch
import torch.nn.functional as F

Tensors = dict[str, torch.Tensor]
EPSILON = 1e-5  # of batch and instance normalisation


class Plain:
    """The tensors below one name of a checkpoint."""

    def __init__(self, tensors: Tensors, name: str = "") -> None:
        self.tensors, self.name = tensors, name

    def __getitem__(self, name: str | int) -> "Plain":
        return Plain(self.tensors, f"{self.name}{name}.")

    def __contains__(self, name: str) -> bool:
        return any(key.startswith(f"{self.name}{name}.") for key in self.tensors)

    def get(self, name: str) -> torch.Tensor | None:
        return self.tensors.get(f"{self.name}{name}")

    def convolution(self, x: torch.Tensor, stride: int = 1) -> torch.Tensor:
        weight = self.get("weight")
        assert weight is not None
        return F.conv2d(x, weight, self.get("bias"), stride, padding=weight.shape[-1] // 2)

    def transposed(self, x: torch.Tensor) -> torch.Tensor:
        """Zeros between the pixels, then a convolution with the kernel turned round: twice the size."""
        weight = self.get("weight")
        assert weight is not None
        rows, columns = x.shape[-2:]
        spread = x.new_zeros(*x.shape[:2], 2 * rows, 2 * columns)
        spread[..., ::2, ::2] = x
        return F.conv2d(spread, weight.flip(2, 3).transpose(0, 1), self.get("bias"), padding=weight.shape[-1] // 2)

    def normalised(self, x: torch.Tensor, own_statistics: bool = False) -> torch.Tensor:
        """With the mean and variance in the checkpoint, or (`own_statistics`) with those of each channel of `x`."""
        mean, variance = self.get("running_mean"), self.get("running_var")
        if own_statistics:
            mean, variance = x.mean(dim=(2, 3)).flatten(), x.var(dim=(2, 3), correction=0).flatten()
        if mean is None or variance is None:
            return x
        x = (x - mean[:, None, None]) / torch.sqrt(variance[:, None, None] + EPSILON)
        weight, bias = self.get("weight"), self.get("bias")
        return x if weight is None or bias is None else weight[:, None, None] * x + bias[:, None, None]

    def layer(self, x: torch.Tensor, stride: int = 1, relu: bool = True) -> torch.Tensor:
        if "transposed_conv2d" in self:
            x = self["transposed_conv2d"].transposed(x)
        else:
            x = self["conv2d"].convolution(x, stride)
        x = self["norm_layer"].normalised(x)
        return x.clamp(min=0) if relu else x

    def residual(self, x: torch.Tensor, norm: str | None) -> torch.Tensor:
        inner = self["bn1"].normalised(self["conv1"].convolution(x), own_statistics=norm == "IN").clamp(min=0)
        inner = self["bn2"].normalised(self["conv2"].convolution(inner), own_statistics=norm == "IN")
        return (inner + x).clamp(min=0)

    def cell(self, x: torch.Tensor, state: Any) -> tuple[torch.Tensor, Any]:
        if "Gates" in self:
            hidden, memory = state or (torch.zeros_like(x), torch.zeros_like(x))
            gates = self["Gates"].convolution(torch.cat([x, hidden], dim=1))
            i, f, o, g = torch.split(gates, x.shape[1], dim=1)
            memory = torch.sigmoid(f) * memory + torch.sigmoid(i) * torch.tanh(g)
            hidden = torch.sigmoid(o) * torch.tanh(memory)
            return hidden, (hidden, memory)
        h = torch.zeros_like(x) if state is None else state
        z = torch.sigmoid(self["update_gate"].convolution(torch.cat([x, h], dim=1)))
        r = torch.sigmoid(self["reset_gate"].convolution(torch.cat([x, h], dim=1)))
        candidate = torch.tanh(self["out_gate"].convolution(torch.cat([x, r * h], dim=1)))
        h = (1 - z) * h + z * candidate
        return h, h


def unet(tensors: Tensors, settings: dict[str, Any], voxels: torch.Tensor, states: list) -> tuple[torch.Tensor, list]:
    """Image and states of E2VID (`unet.` in the names) or E2VIDRecurrent (`unetrecurrent.`)."""
    recurrent = any(key.startswith("unetrecurrent.") for key in tensors)
    net = Plain(tensors)["unetrecurrent" if recurrent else "unet"]
    norm, skip = settings["norm"], settings["skip_type"]

    def joined(x: torch.Tensor, earlier: torch.Tensor) -> torch.Tensor:
        return {"sum": lambda: x + earlier, "concat": lambda: torch.cat([x, earlier], 1), "no_skip": lambda: x}[skip]()

    skips = [net["head"].layer(voxels)]
    x, after = skips[0], []
    for level in range(settings["num_encoders"]):
        encoder = net["encoders"][level]
        if recurrent:
            x = encoder["conv"].layer(x, stride=2)
            x, state = encoder["recurrent_block"].cell(x, states[level] if states else None)
            after.append(state)
        else:
            x = encoder.layer(x, stride=2)
        skips.append(x)
    for index in range(settings["num_residual_blocks"]):
        x = net["resblocks"][index].residual(x, norm)
    for index in range(settings["num_encoders"]):
        x = joined(x, skips.pop())
        if settings["use_upsample_conv"]:
            x = doubled(x)
        x = net["decoders"][index].layer(x)
    x = net["pred"].layer(joined(x, skips.pop()), relu=False)
    return 1 / (1 + torch.exp(-x)) if settings.get("final_activation", "sigmoid") == "sigmoid" else x, after


def firenet(
    tensors: Tensors, settings: dict[str, Any], voxels: torch.Tensor, states: list
) -> tuple[torch.Tensor, list]:
    """Image and states of FireNet."""
    net, waiting, after = Plain(tensors)["net"], list(states), []

    def remembered(cell: Plain, x: torch.Tensor) -> torch.Tensor:
        x, state = cell.cell(x, waiting.pop(0) if waiting else None)
        after.append(state)
        return x

    head = x = remembered(net["head"]["recurrent_block"], net["head"]["conv"].layer(voxels))
    for index in range(settings["num_residual_blocks"]):
        block = net["resblocks"][index]
        if "recurrent_block" in block:
            x = remembered(block["recurrent_block"], block["conv"].residual(x, settings["norm"]))
        else:
            x = block.residual(x, settings["norm"])
    x = torch.cat([x, head], 1) if settings["skip_type"] == "concat" else x
    return net["pred"].layer(x, relu=False), after


def doubled(x: torch.Tensor) -> torch.Tensor:
    """Twice the size: each new pixel lies a quarter of the old step beside an old one, and takes 3/4 of it."""
    for dim in (2, 3):
        first, last = x.narrow(dim, 0, 1), x.narrow(dim, x.shape[dim] - 1, 1)
        before = torch.cat([first, x.narrow(dim, 0, x.shape[dim] - 1)], dim)
        behind = torch.cat([x.narrow(dim, 1, x.shape[dim] - 1), last], dim)
        x = torch.stack([0.75 * x + 0.25 * before, 0.75 * x + 0.25 * behind], dim + 1).flatten(dim, dim + 1)
    return x
