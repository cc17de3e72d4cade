"""Reading yaml files whose keys are known, with errors that name the file, the key and the nearest known key."""

import contextlib
import difflib
import glob
import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from jaxcal.errors import CalibrationError
from jaxcal.recording.places import split_place


def read_mapping(path: Path, kind: str) -> Mapping[str, Any]:
    """The top-level mapping of a yaml file; `kind` says in errors what the file should have been ("rig")."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: no such {kind} file.") from error
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not a readable yaml file: {error}") from error
    return as_mapping(content, str(path))


def as_mapping(content: Any, where: str) -> Mapping[str, Any]:
    """`content` if it is a mapping; else CalibrationError at `where`."""
    if not isinstance(content, Mapping):
        raise CalibrationError(f"{where}: expected 'key: value' lines, found {_short(content)}.")
    return content


def check_keys(
    content: Mapping[str, Any],
    known: Collection[str],
    where: str,
    required: Collection[str] = (),
    ignored: Collection[str] = (),
) -> None:
    """Raise CalibrationError for a key that is not known, with the nearest one that is, or for one that is missing.

    Keys in `ignored` are accepted, but not offered in errors.
    """
    for key in content:
        if key not in known and key not in ignored:
            close = difflib.get_close_matches(str(key), list(known), n=1)
            hint = f" Did you mean '{close[0]}'?" if close else ""
            raise CalibrationError(f"{where}: unknown key '{key}'.{hint} Known keys: {', '.join(known)}.")
    for key in required:
        if content.get(key) is None:
            raise CalibrationError(f"{where}: '{key}' is missing. Required: {', '.join(required)}.")


def as_text(content: Any, where: str) -> str:
    """`content` if it is a text that is not empty."""
    if not isinstance(content, str) or not content.strip():
        raise CalibrationError(f"{where}: expected a text, found {_short(content)}.")
    return content


def as_positive(content: Any, where: str) -> float:
    """`content` as a positive finite number. Yaml 1.1 reads '1e-3' as text, so text that is a number is taken too."""
    try:
        value = float(content)
    except (TypeError, ValueError):
        value = float("nan")
    if isinstance(content, bool) or not 0 < value < float("inf"):
        raise CalibrationError(f"{where}: expected a positive number, found {_short(content)}.")
    return value


def as_bool(content: Any, where: str) -> bool:
    """`content` if it is true or false."""
    if not isinstance(content, bool):
        raise CalibrationError(f"{where}: expected true or false, found {_short(content)}.")
    return content


def as_span(content: Any, where: str) -> tuple[float, float]:
    """`content` as a start and a later end, in seconds."""
    values = list(content) if isinstance(content, (list, tuple)) else []
    numbers = [float(v) for v in values if isinstance(v, (int, float)) and not isinstance(v, bool)]
    if len(values) != 2 or len(numbers) != 2 or not 0 <= numbers[0] < numbers[1] < float("inf"):
        raise CalibrationError(
            f"{where}: expected [start, end] in seconds after the first frame, found {_short(content)}."
        )
    return numbers[0], numbers[1]


def existing_path(content: Any, folder: Path, where: str) -> Path:
    """The path (or pattern of file names) that a rig names, relative to its folder, with ${VARIABLES} and ~ expanded.

    Raises CalibrationError where there is no such file or folder.
    """
    path = folder / Path(os.path.expandvars(as_text(content, where))).expanduser()
    if not split_place(path)[0].exists() and not glob.glob(str(path)):
        raise CalibrationError(f"{where}: {path} does not exist. Paths are relative to the rig file's folder.")
    return path


@contextlib.contextmanager
def located(where: str) -> Iterator[None]:
    """Put `where` in front of the message of any CalibrationError raised inside."""
    try:
        yield
    except CalibrationError as error:
        message = str(error)
        raise CalibrationError(message if message.startswith(where) else f"{where}: {message}") from error


def _short(content: Any) -> str:
    text = repr(content)
    return text if len(text) <= 60 else text[:57] + "..."
