"""Checkpoints of other people's code (`.pth.tar`, `.pth`), read without executing anything in them."""

import contextlib
import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from jaxcal.errors import CalibrationError

Checkpoint = tuple[str, dict[str, Any], dict[str, torch.Tensor]]

# FireNet+ names the same layers otherwise than FireNet.
_FIRENET_PLUS = {
    "head.conv2d.": "net.head.conv.conv2d.",
    "G1.": "net.head.recurrent_block.",
    "R1.": "net.resblocks.0.conv.",
    "G2.": "net.resblocks.0.recurrent_block.",
    "R2.": "net.resblocks.1.",
    "pred.": "net.pred.",
}


class _StandIn:
    """Takes the place of an object in a file: keeps the state that the file gives it, and does nothing."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.state: Any = None

    def __new__(cls, *_: Any, **__: Any) -> "_StandIn":
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        self.state = state


# What training by Stoffregen et al.'s code leaves in its files beside tensors. None of it is needed but ConfigParser's
# dict; none of it runs, because the names lead to stand-ins.
_STAND_INS = [
    type(name.rpartition(".")[2], (_StandIn,), {"__module__": name.rpartition(".")[0]})
    for name in (
        "parse_config.ConfigParser",
        "pathlib.PosixPath",
        "pathlib.WindowsPath",
        "pathlib._local.PosixPath",
        "pathlib._local.WindowsPath",
        "numpy.core.multiarray.scalar",
        "numpy._core.multiarray.scalar",
        "numpy.dtype",
        "_codecs.encode",
    )
]


@contextlib.contextmanager
def _stand_ins_known() -> Iterator[None]:
    """Let torch's safe unpickler put stand-ins where a file names their models; what it knew before is kept."""
    known = torch.serialization.get_safe_globals()
    torch.serialization.add_safe_globals(_STAND_INS)
    try:
        yield
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(known)


def read_official(path: Path) -> Checkpoint:
    """Architecture, settings and tensors of a checkpoint, in our names.

    Two layouts are known: that of E2VID and FireNet (a dict with `arch`, `model`, `state_dict`; the settings may lie in
    `config`), and that of E2VID+ and FireNet+ (Stoffregen et al. 2020: `config` is an object that holds the training's
    whole configuration, or a dict of the same content). Raises CalibrationError when the file is truncated, of another
    kind, or needs code to be loaded.
    """
    try:
        with _stand_ins_known():
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CalibrationError(
            f"{path}: refused, because it holds Python objects other than tensors and plain values, and loading those "
            f"could execute code ({str(error).splitlines()[0]}). If you trust its origin, load it yourself and save a "
            "dict with only the keys arch, model and state_dict."
        ) from error
    except Exception as error:
        raise CalibrationError(
            f"{path}: not a torch checkpoint, or truncated ({error}). Expected a file in the official E2VID format or "
            "one of our .safetensors; copy or download it again."
        ) from error
    if not isinstance(checkpoint, Mapping) or not {"arch", "state_dict"} <= set(checkpoint):
        raise CalibrationError(
            f"{path}: a torch file, but not an E2VID checkpoint: expected a dict with the keys arch, model, state_dict."
        )
    config = checkpoint.get("config")
    if isinstance(config, _StandIn) and isinstance(config.state, Mapping):
        config = config.state.get("_config")
    if isinstance(config, Mapping) and isinstance(config.get("arch"), Mapping):
        return _plus(path, config["arch"], checkpoint["state_dict"])
    # As the reference: files written during training keep the settings under "config".
    settings = checkpoint.get("model", config.get("model") if isinstance(config, Mapping) else None)
    if not isinstance(settings, Mapping):
        raise CalibrationError(f"{path}: no network settings under the key 'model' (found {type(settings).__name__}).")
    return str(checkpoint["arch"]), dict(settings), dict(checkpoint["state_dict"])


def _plus(path: Path, arch: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> Checkpoint:
    """E2VID+ or FireNet+: they take raw voxel grids, pad with zeros, and do not squash their output by default."""
    name, arguments = str(arch.get("type")), arch.get("args") or {}
    if not isinstance(arguments, Mapping):
        raise CalibrationError(f"{path}: no network settings in its configuration (arch.args).")
    settings = dict(arguments.get("unet_kwargs") or arguments)
    settings |= {"normalise": False, "padding": "zeros"}
    # Training on several GPUs puts a word before each name.
    renamed = {key.removeprefix("module."): value for key, value in tensors.items()}
    if name == "E2VIDRecurrent":
        settings["final_activation"] = settings.get("final_activation") or "none"
    elif name == "FireNet":
        settings = {"base_num_channels": 16, "kernel_size": 3} | settings
        settings |= {"num_encoders": 0, "skip_type": "no_skip", "norm": None, "recurrent_block_type": "convgru"}
        settings |= {"num_residual_blocks": 2, "recurrent_blocks": {"resblock": [0]}}
        settings["recurrent_kernel_size"] = settings["kernel_size"]
        renamed = {_renamed(key): value for key, value in renamed.items()}
    else:
        raise CalibrationError(
            f"{path}: unknown architecture {name!r}; of this kind of checkpoint E2VIDRecurrent and FireNet are known."
        )
    return name, settings, renamed


def _renamed(key: str) -> str:
    for theirs, ours in _FIRENET_PLUS.items():
        if key.startswith(theirs):
            return ours + key.removeprefix(theirs)
    return key
