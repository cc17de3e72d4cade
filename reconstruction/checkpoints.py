"""Network weights in files: our safetensors, and the official `.pth.tar`, read without executing anything in it."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from jaxcal.errors import CalibrationError
from reconstruction.networks import ARCHITECTURES, ReconstructionNetwork
from reconstruction.official import read_official

DEFAULT_NETWORK = "patterns_v6"

# `models/` lies beside this package, in a checkout as well as in an installed wheel; found from here, not by the
# import system, since a user's own folder called "models" would win there.
MODELS_FOLDER = Path(__file__).resolve().parent.parent / "models"

_FORMAT = "jaxcal-reconstruction-1"


def load_network(path_or_name: str | os.PathLike[str] | None = None) -> ReconstructionNetwork:
    """A network ready for inference (eval mode, float32, CPU).

    `path_or_name`: None for the network that jaxcal ships; the name of a file in `models/` (without suffix); or a
    path to one of ours (`.safetensors`) or to a checkpoint of E2VID, FireNet, E2VID+ or FireNet+ as their authors
    write them (`.pth.tar`, `.pth`, `.pt`; see `reconstruction.official`). Nothing in the file is executed.

    Raises CalibrationError when the file is missing, truncated, of another kind, or needs code to be loaded.
    """
    path = _locate(DEFAULT_NETWORK if path_or_name is None else path_or_name)
    if path.suffix == ".safetensors":
        architecture, settings, tensors = _read_safetensors(path)
    else:
        architecture, settings, tensors = read_official(path)
    return _build(path, architecture, settings, tensors)


def save_network(network: ReconstructionNetwork, path: str | os.PathLike[str], **metadata: str) -> None:
    """Write `network` as float16 safetensors, atomically, with its architecture, settings and `metadata` inside."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {
        name: (value.half() if value.is_floating_point() else value).contiguous().cpu()
        for name, value in network.state_dict().items()
    }
    header = metadata | {
        "format": _FORMAT,
        "arch": type(network).__name__,
        "model": json.dumps(network.settings, sort_keys=True),
    }
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".part")
    os.close(handle)
    try:
        save_file(tensors, temporary, metadata=header)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_metadata(path: str | os.PathLike[str]) -> dict[str, str]:
    """The text fields inside one of our safetensors files."""
    with _opened_safetensors(Path(path)) as file:
        return dict(file.metadata() or {})


def _locate(path_or_name: str | os.PathLike[str]) -> Path:
    path = Path(path_or_name)
    if path.is_file():
        return path
    shipped = MODELS_FOLDER / f"{path.name}.safetensors"
    if path.parent == Path() and shipped.is_file():
        return shipped
    known = sorted(file.stem for file in MODELS_FOLDER.glob("*.safetensors"))
    raise CalibrationError(
        f"{path}: no such reconstruction network. Give a path to a .safetensors or .pth.tar file, or one of the "
        f"networks in {MODELS_FOLDER}: {', '.join(known) or 'none there, the installation is incomplete'}."
    )


def _opened_safetensors(path: Path) -> Any:
    try:
        return safe_open(path, framework="pt")
    except (SafetensorError, OSError) as error:
        raise CalibrationError(
            f"{path}: not a safetensors file, or truncated ({error}). Copy or download it again."
        ) from error


def _read_safetensors(path: Path) -> tuple[str, dict[str, Any], dict[str, torch.Tensor]]:
    with _opened_safetensors(path) as file:
        metadata = file.metadata() or {}
        if metadata.get("format") != _FORMAT:
            raise CalibrationError(
                f"{path}: its metadata says format {metadata.get('format')!r}, expected {_FORMAT!r}. This is not a "
                "reconstruction network of jaxcal; official E2VID checkpoints are .pth.tar files."
            )
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    try:
        settings = json.loads(metadata["model"])
    except (KeyError, json.JSONDecodeError) as error:
        raise CalibrationError(f"{path}: the network's settings in its metadata are unreadable ({error}).") from error
    return metadata.get("arch", ""), settings, tensors


def _build(
    path: Path, architecture: str, settings: dict[str, Any], tensors: dict[str, torch.Tensor]
) -> ReconstructionNetwork:
    if architecture not in ARCHITECTURES:
        raise CalibrationError(
            f"{path}: unknown architecture {architecture!r}; known ones are {', '.join(ARCHITECTURES)}."
        )
    try:
        network = ARCHITECTURES[architecture](**settings)
        network.load_state_dict(tensors)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
    except (RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise CalibrationError(
            f"{path}: its weights do not fit the architecture {architecture} with the settings it states ({error})."
        ) from error
    broken = [name for name, value in network.state_dict().items() if not torch.isfinite(value).all()]
    if broken:
        raise CalibrationError(f"{path}: weights {', '.join(broken[:3])} are not finite; the file is damaged.")
    return network.eval().requires_grad_(False)
