"""Kalibr's target.yaml."""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from jaxcal.errors import CalibrationError
from jaxcal.targets.base import Target
from jaxcal.targets.grids import AprilGrid, Checkerboard

_KEYS = {
    "aprilgrid": ("tagRows", "tagCols", "tagSize", "tagSpacing"),
    "checkerboard": ("targetRows", "targetCols", "rowSpacingMeters", "colSpacingMeters"),
}


def load_target(path: str | Path) -> Target:
    """Read a Kalibr `target.yaml` (`aprilgrid` or `checkerboard`).

    Raises CalibrationError when the file is missing, is not yaml, has an unknown or missing key or a value that is
    not a number.
    """
    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text())
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: no such target file.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not a yaml file: {error}") from error
    return target_from_yaml(content, str(path))


def target_from_yaml(content: Any, where: str) -> Target:
    """Build the target that a mapping in `target.yaml` format describes; `where` names it in errors."""
    if not isinstance(content, Mapping):
        raise CalibrationError(f"{where}: expected keys such as 'target_type: aprilgrid'.")
    kind = content.get("target_type")
    if kind not in _KEYS:
        raise CalibrationError(f"{where}: target_type is {kind!r}; known: {', '.join(_KEYS)}.")
    keys = _KEYS[kind]
    for key in content:
        if key not in (*keys, "target_type"):
            close = difflib.get_close_matches(str(key), keys, n=1)
            hint = f" Did you mean '{close[0]}'?" if close else ""
            raise CalibrationError(f"{where}: unknown key '{key}'.{hint} A {kind} has {', '.join(keys)}.")
    missing = [key for key in keys if key not in content]
    if missing:
        raise CalibrationError(f"{where}: '{missing[0]}' is missing. A {kind} has {', '.join(keys)}.")
    rows, cols = (_whole(f"{where}: '{key}'", content[key]) for key in keys[:2])
    first, second = (_number(f"{where}: '{key}'", content[key]) for key in keys[2:])
    try:
        if kind == "aprilgrid":
            return AprilGrid(rows=rows, cols=cols, tag_size=first, tag_spacing=second)
        return Checkerboard(rows=rows, cols=cols, spacing=first, col_spacing=second)
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def _number(place: str, value: Any) -> float:
    try:
        return float(value)  # of text too: to yaml 1.1, '1e-2' is text
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{place} is {value!r}; expected a number.") from error


def _whole(place: str, value: Any) -> int:
    number = _number(place, value)
    if not number.is_integer():
        raise CalibrationError(f"{place} is {value!r}; expected a whole number.")
    return int(number)
