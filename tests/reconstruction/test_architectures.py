"""Every switch of the official architectures computes what its equations say; all author's layouts are read."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plain_networks import firenet, unet

import reconstruction
from jaxcal.errors import CalibrationError
from reconstruction.networks import E2VID, E2VIDRecurrent, FireNet, ReconstructionNetwork

SMALL = {"base_num_channels": 4, "num_encoders": 2, "num_residual_blocks": 2}
UNETS = [
    (E2VIDRecurrent, SMALL | {"skip_type": skip, "recurrent_block_type": cell, "norm": norm, "use_upsample_conv": up})
    for skip, cell, norm, up in itertools.product(
        ("sum", "concat", "no_skip"), ("convlstm", "convgru"), ("BN", "IN", None), (True, False)
    )
]
UNETS += [(E2VIDRecurrent, SMALL | {"num_encoders": number}) for number in (1, 3, 4)]
UNETS += [(E2VID, SMALL | {"skip_type": skip, "norm": norm}) for skip, norm in (("sum", "BN"), ("concat", None))]
UNETS += [(E2VIDRecurrent, SMALL | {"kernel_size": 3, "channel_multiplier": 1.5, "final_activation": "none"})]
FIRENETS = [
    (FireNet, {"base_num_channels": 12, "recurrent_block_type": cell, "norm": norm, "skip_type": skip} | blocks)
    for cell, norm, skip, blocks in itertools.product(
        ("convlstm", "convgru"),
        ("BN", "IN", None),
        ("sum", "no_skip", "concat"),
        ({"recurrent_blocks": {"resblock": [0]}}, {"recurrent_blocks": {"resblock": [-1]}, "kernel_size": 5}),
    )
]


def with_random_weights(architecture: type[ReconstructionNetwork], settings: dict[str, Any]) -> ReconstructionNetwork:
    """Statistics and biases, too, which start as zeros and ones."""
    generator = torch.Generator().manual_seed(1)
    torch.manual_seed(1)
    network = architecture(**settings).eval().requires_grad_(False)
    for name, value in network.state_dict().items():
        if value.is_floating_point() and value.ndim == 1:
            lowest = 0.5 if name.endswith(("running_var", "weight")) else -0.3
            value.copy_(lowest + 0.6 * torch.rand(value.shape, generator=generator))
    return network


@pytest.mark.parametrize("case", range(len(UNETS) + len(FIRENETS)))
def test_the_network_computes_what_its_equations_say(case: int) -> None:
    architecture, settings = [*UNETS, *FIRENETS][case]
    network = with_random_weights(architecture, settings)
    plain = firenet if architecture is FireNet else unet
    tensors = dict(network.state_dict())
    generator = torch.Generator().manual_seed(2)
    state, states, images = None, [], []
    for _ in range(3):
        voxels = torch.randn(1, 5, 2 * network.multiple + 16, 3 * network.multiple + 16, generator=generator)
        voxels = voxels[..., : 16 * (voxels.shape[-2] // 16), : 16 * (voxels.shape[-1] // 16)]
        image, state = network(voxels, state)
        expected, states = plain(tensors, network.settings, voxels, states)
        np.testing.assert_allclose(image, expected, atol=1e-5)
        images.append(image)
    assert float(images[0].std()) > 1e-5  # it does show something


# --- the layout of Stoffregen et al.: E2VID+ and FireNet+ ---


class ConfigParser:
    """As the training code's class of this name: it holds the configuration, paths and log levels."""

    def __init__(self, content: dict[str, Any]) -> None:
        self._config, self.resume, self._save_dir, self.log_levels = content, None, Path("/models"), {0: 30}


ConfigParser.__module__ = "parse_config"


def save_plus(path: Path, network: ReconstructionNetwork, arch: str, arguments: dict[str, Any], **keys: str) -> None:
    """What the training code saves: an object for the configuration, a numpy number, the optimiser."""
    tensors = {keys.get("prefix", "") + name: value for name, value in network.state_dict().items()}
    if arch == "FireNet":
        names = {
            "net.head.conv.conv2d": "head.conv2d",
            "net.head.recurrent_block": "G1",
            "net.resblocks.0.conv": "R1",
            "net.resblocks.0.recurrent_block": "G2",
            "net.resblocks.1": "R2",
            "net.pred": "pred",
        }
        tensors = {
            next(new + key.removeprefix(old) for old, new in names.items() if key.startswith(old)): value
            for key, value in tensors.items()
        }
    content = {
        "arch": keys.get("stored_arch", arch),
        "epoch": 7,
        "state_dict": tensors,
        "optimizer": {"state": {}, "param_groups": []},
        "monitor_best": np.float64(0.25),
        "config": ConfigParser({"name": "x", "arch": {"type": arch, "args": arguments}}),
    }
    torch.save(content, path)


@pytest.fixture
def training_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pickle looks a class up where it says it lives."""
    import sys
    from types import SimpleNamespace

    monkeypatch.setitem(sys.modules, "parse_config", SimpleNamespace(ConfigParser=ConfigParser))  # pyright: ignore


PLUS = {"normalise": False, "padding": "zeros"}


@pytest.mark.usefixtures("training_code")
@pytest.mark.parametrize("keys", [{}, {"prefix": "module.", "stored_arch": "DataParallel"}])
@pytest.mark.parametrize("activation", ["", "sigmoid"])
def test_e2vid_plus_is_read(tmp_path: Path, activation: str, keys: dict[str, str]) -> None:
    settings = {"num_bins": 5, "skip_type": "concat", "recurrent_block_type": "convlstm", "norm": "none", **SMALL}
    network = with_random_weights(
        E2VIDRecurrent, settings | PLUS | {"final_activation": activation, "use_upsample_conv": False}
    )
    arguments = {"unet_kwargs": settings | {"use_upsample_conv": False, "final_activation": activation}}
    save_plus(tmp_path / "plus.pth", network, "E2VIDRecurrent", arguments, **keys)
    loaded = reconstruction.load_network(tmp_path / "plus.pth")
    assert loaded.settings == network.settings
    assert (loaded.scaling, loaded.padding) == ("none", "zeros")
    voxels = torch.randn(1, 5, 16, 16)
    assert torch.equal(loaded(voxels, None)[0], network(voxels, None)[0])


@pytest.mark.usefixtures("training_code")
@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("kernel_size", [3, 5])
def test_firenet_plus_is_read(tmp_path: Path, kernel_size: int, older: bool) -> None:
    sizes = {"num_bins": 5, "base_num_channels": 6, "kernel_size": kernel_size}
    network = with_random_weights(FireNet, sizes | PLUS | {"num_encoders": 0, "recurrent_kernel_size": kernel_size})
    save_plus(tmp_path / "plus.pth", network, "FireNet", {"unet_kwargs": sizes} if older else sizes)
    loaded = reconstruction.load_network(tmp_path / "plus.pth")
    assert loaded.multiple == 1
    voxels = torch.randn(1, 5, 9, 11)
    assert torch.equal(loaded(voxels, None)[0], network(voxels, None)[0])


@pytest.mark.usefixtures("training_code")
def test_the_object_in_the_file_does_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names that are known lead to stand-ins; any other name is refused; torch knows no more than before."""
    import pickle

    network = with_random_weights(E2VIDRecurrent, SMALL)
    save_plus(tmp_path / "plus.pth", network, "E2VIDRecurrent", {"unet_kwargs": SMALL | {"num_bins": 5}})
    monkeypatch.setattr(ConfigParser, "__setstate__", lambda *_: pytest.fail("it ran"), raising=False)
    known = set(torch.serialization.get_safe_globals())
    reconstruction.load_network(tmp_path / "plus.pth")
    assert set(torch.serialization.get_safe_globals()) == known
    content = {"arch": "E2VIDRecurrent", "state_dict": {}, "config": pickle.Pickler}
    torch.save(content, tmp_path / "other.pth")
    with pytest.raises(CalibrationError, match=r"other\.pth: refused"):
        reconstruction.load_network(tmp_path / "other.pth")


@pytest.mark.usefixtures("training_code")
def test_other_networks_of_that_code_are_named(tmp_path: Path) -> None:
    save_plus(tmp_path / "flow.pth", with_random_weights(E2VIDRecurrent, SMALL), "FlowNet", {"unet_kwargs": SMALL})
    with pytest.raises(CalibrationError, match=r"flow\.pth: unknown architecture 'FlowNet'"):
        reconstruction.load_network(tmp_path / "flow.pth")
