"""target.yaml: Kalibr's kinds of targets, and ours in the same manner."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from jaxcal.errors import CalibrationError
from jaxcal.targets.base import Target
from jaxcal.targets.boards import BoardSet
from jaxcal.targets.charuco import Charuco
from jaxcal.targets.circles import CircleGrid
from jaxcal.targets.grids import AprilGrid, Checkerboard


def load_target(path: str | Path) -> Target:
    """Read a `target.yaml`: Kalibr's `aprilgrid`, `checkerboard` and `circlegrid`, and `charuco` and `boards`.

    Beyond Kalibr's keys: an aprilgrid may have `firstTagId`, a circlegrid `circleDiameterMeters`; a charuco has
    `squareRows`, `squareCols`, `squareSize`, `markerSize`, `dictionary` and may have `legacyPattern` and
    `firstMarkerId`; `boards` has a list `boards` of targets. Raises CalibrationError when the file is missing, is not
    yaml, has an unknown or missing key or a value of the wrong kind.
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
    if not isinstance(kind, str) or kind not in _FORMATS:
        raise CalibrationError(f"{where}: target_type is {kind!r}; known: {', '.join(_FORMATS)}.")
    form = _FORMATS[kind]
    known = [*form.keys, *form.optional]
    for key in content:
        if key not in (*known, "target_type"):
            close = difflib.get_close_matches(str(key), known, n=1)
            hint = f" Did you mean '{close[0]}'?" if close else ""
            raise CalibrationError(f"{where}: unknown key '{key}'.{hint} {_having(kind)}")
    missing = [key for key in form.keys if key not in content]
    if missing:
        raise CalibrationError(f"{where}: '{missing[0]}' is missing. {_having(kind)}")
    readers = form.keys | form.optional
    fields = {
        readers[key][0]: readers[key][1](f"{where}: '{key}'", value)
        for key, value in content.items()
        if key != "target_type"
    }
    try:
        return form.make(**fields)
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def _having(kind: str) -> str:
    form = _FORMATS[kind]
    optional = f", and may have {', '.join(form.optional)}" if form.optional else ""
    return f"A {kind} has {', '.join(form.keys)}{optional}."


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


def _truth(place: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise CalibrationError(f"{place} is {value!r}; expected true or false.")
    return value


def _text(place: str, value: Any) -> str:
    if not isinstance(value, str):
        raise CalibrationError(f"{place} is {value!r}; expected a name.")
    return value


def _boards(place: str, value: Any) -> tuple[Target, ...]:
    if not isinstance(value, list):
        raise CalibrationError(f"{place} is {value!r}; expected a list of targets.")
    return tuple(target_from_yaml(content, f"{place}: board {number}") for number, content in enumerate(value))


# yaml key -> (field of the class, reader of its value).
_Keys = dict[str, tuple[str, Callable[[str, Any], Any]]]


@dataclass(frozen=True)
class _Format:
    """How a kind of target is written: the class it makes, the keys it needs and those it may have."""

    make: Callable[..., Target]
    keys: _Keys
    optional: _Keys


_FORMATS: dict[str, _Format] = {
    "aprilgrid": _Format(
        AprilGrid,
        {
            "tagRows": ("rows", _whole),
            "tagCols": ("cols", _whole),
            "tagSize": ("tag_size", _number),
            "tagSpacing": ("tag_spacing", _number),
        },
        {"firstTagId": ("first_id", _whole)},
    ),
    "checkerboard": _Format(
        Checkerboard,
        {
            "targetRows": ("rows", _whole),
            "targetCols": ("cols", _whole),
            "rowSpacingMeters": ("spacing", _number),
            "colSpacingMeters": ("col_spacing", _number),
        },
        {},
    ),
    "circlegrid": _Format(
        CircleGrid,
        {
            "targetRows": ("rows", _whole),
            "targetCols": ("cols", _whole),
            "spacingMeters": ("spacing", _number),
            "asymmetricGrid": ("asymmetric", _truth),
        },
        {"circleDiameterMeters": ("diameter", _number)},
    ),
    "charuco": _Format(
        Charuco,
        {
            "squareRows": ("rows", _whole),
            "squareCols": ("cols", _whole),
            "squareSize": ("square_size", _number),
            "markerSize": ("marker_size", _number),
            "dictionary": ("dictionary", _text),
        },
        {"legacyPattern": ("legacy", _truth), "firstMarkerId": ("first_id", _whole)},
    ),
    "boards": _Format(BoardSet, {"boards": ("boards", _boards)}, {}),
}
