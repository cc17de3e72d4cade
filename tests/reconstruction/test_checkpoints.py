"""Network files: what is written is read back; what is wrong with a file is said; nothing in it is executed."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import reconstruction
from jaxcal.errors import CalibrationError
from reconstruction.checkpoints import read_metadata, save_network
from reconstruction.networks import E2VIDRecurrent, FireNet, FoldedFireNet, ReconstructionNetwork

E2VID_SETTINGS: dict[str, Any] = {
    "num_bins": 5,
    "skip_type": "sum",
    "recurrent_block_type": "convlstm",
    "num_encoders": 2,
    "base_num_channels": 4,
    "num_residual_blocks": 1,
    "norm": "none",
    "use_upsample_conv": True,
}


def _official(network: ReconstructionNetwork, settings: dict[str, Any]) -> dict[str, Any]:
    return {"arch": type(network).__name__, "model": settings, "state_dict": network.state_dict()}


def _same_image(a: ReconstructionNetwork, b: ReconstructionNetwork, **tolerance: float) -> None:
    voxels = torch.randn(1, 5, 32, 32, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        np.testing.assert_allclose(a.eval()(voxels, None)[0], b(voxels, None)[0], **tolerance)


@pytest.mark.parametrize("network", [E2VIDRecurrent(**E2VID_SETTINGS), FireNet(base_num_channels=4, kernel_size=3)])
def test_official_checkpoint_is_read(network: ReconstructionNetwork, tmp_path: Path):
    path = tmp_path / "official.pth.tar"
    torch.save(_official(network, network.settings), path)
    loaded = reconstruction.load_network(path)
    assert not loaded.training
    _same_image(network, loaded, atol=0)


def test_official_checkpoint_with_settings_under_config_is_read(tmp_path: Path):
    network = E2VIDRecurrent(**E2VID_SETTINGS)
    path = tmp_path / "training.pth"
    torch.save(
        {"arch": "E2VIDRecurrent", "config": {"model": E2VID_SETTINGS}, "state_dict": network.state_dict()}, path
    )
    _same_image(network, reconstruction.load_network(path), atol=0)


def test_our_file_gives_the_network_back_to_half_precision(tmp_path: Path):
    network = FoldedFireNet(channels=4)
    path = tmp_path / "ours.safetensors"
    save_network(network, path, licence="Apache-2.0")
    loaded = reconstruction.load_network(path)
    assert loaded.settings == network.settings
    _same_image(network, loaded, atol=2e-3)
    assert read_metadata(path)["licence"] == "Apache-2.0"
    assert [file.name for file in tmp_path.iterdir()] == ["ours.safetensors"]


class _Attack:
    def __init__(self, witness: Path):
        self.witness = witness

    def __reduce__(self):
        return Path.touch, (self.witness,)


def test_a_file_that_would_run_code_is_refused_and_does_not_run_it(tmp_path: Path):
    witness, path = tmp_path / "witness", tmp_path / "attack.pth.tar"
    checkpoint = _official(E2VIDRecurrent(**E2VID_SETTINGS), E2VID_SETTINGS)
    torch.save(checkpoint | {"logger": _Attack(witness)}, path)
    with pytest.raises(CalibrationError, match=r"attack\.pth\.tar: refused, because it holds Python objects"):
        reconstruction.load_network(path)
    assert not witness.exists()
    torch.load(path, weights_only=False)
    assert witness.exists()  # so the file was indeed armed


def test_a_bare_pickle_is_refused_and_does_not_run(tmp_path: Path):
    witness, path = tmp_path / "witness", tmp_path / "bare.pth"
    path.write_bytes(pickle.dumps(_Attack(witness)))
    with pytest.raises(CalibrationError, match=r"bare\.pth"):
        reconstruction.load_network(path)
    assert not witness.exists()


def _broken_files(folder: Path) -> dict[str, tuple[Path, str]]:
    """Name of the fault -> (file, words that the message must have)."""
    network = E2VIDRecurrent(**E2VID_SETTINGS)
    whole = folder / "whole.pth.tar"
    torch.save(_official(network, E2VID_SETTINGS), whole)
    ours = folder / "ours.safetensors"
    save_network(FoldedFireNet(channels=4), ours)
    faults: dict[str, tuple[Path, str]] = {}

    def add(name: str, content: bytes | dict[str, Any], words: str, suffix: str = ".pth.tar") -> None:
        path = folder / f"{name}{suffix}"
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            torch.save(content, path)
        faults[name] = (path, words)

    add("truncated", whole.read_bytes()[:2000], "truncated")
    add("empty", b"", "not a torch checkpoint")
    add("picture", b"\x89PNG\r\n" + bytes(100), "")
    add("other_keys", {"weights": torch.zeros(3)}, "not an E2VID checkpoint")
    add("no_settings", {"arch": "E2VIDRecurrent", "state_dict": network.state_dict()}, "no network settings")
    add("unknown", _official(network, E2VID_SETTINGS) | {"arch": "os.system"}, "unknown architecture 'os.system'")
    add("misfit", _official(network, E2VID_SETTINGS | {"base_num_channels": 8}), "do not fit the architecture")
    add("switch", _official(network, E2VID_SETTINGS | {"skip_type": "leap"}), "skip_type is 'leap'")
    weights = {name: torch.full_like(value, torch.nan) for name, value in network.state_dict().items()}
    add("nan", _official(network, E2VID_SETTINGS) | {"state_dict": weights}, "not finite")
    add("ours_truncated", ours.read_bytes()[:-50], "truncated", ".safetensors")
    add("ours_garbage", b"no tensors here, only text", "not a safetensors file", ".safetensors")
    tensors = load_file(ours)
    for name, metadata, words in (
        ("no_metadata", None, "format None"),
        ("bad_settings", {"format": "jaxcal-reconstruction-1", "arch": "FoldedFireNet", "model": "{"}, "unreadable"),
        (
            "other_size",
            {"format": "jaxcal-reconstruction-1", "arch": "FoldedFireNet", "model": json.dumps({"channels": 8})},
            "do not fit",
        ),
    ):
        path = folder / f"{name}.safetensors"
        save_file(tensors, path, metadata=metadata)
        faults[name] = (path, words)
    return faults


def test_every_fault_is_named_with_the_file(tmp_path: Path):
    faults = _broken_files(tmp_path)
    assert len(faults) == 14
    for name, (path, words) in faults.items():
        with pytest.raises(CalibrationError) as caught:
            reconstruction.load_network(path)
        assert str(path) in str(caught.value), name
        assert words in str(caught.value), name


def test_missing_file_lists_what_is_shipped():
    with pytest.raises(CalibrationError, match=r"nowhere.*no such reconstruction network.*patterns_v1"):
        reconstruction.load_network("nowhere")
