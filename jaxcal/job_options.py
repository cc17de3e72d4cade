"""The `calibration:` section of a rig.yaml: arguments of the job, checked against the job's own signature.

What `calibrate_cameras` and `calibrate_camera_imu` take can be said in a rig.yaml by the same name, without a second
list of names that could fall behind.
"""

import difflib
import inspect
import math
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal

from jaxcal.calibration import calibrate_camera_imu, calibrate_cameras
from jaxcal.errors import CalibrationError
from jaxcal.recording.yaml_files import as_bool, as_text, check_keys
from jaxcal.results import Calibration
from jaxcal.results.interchange import calibration_of_file
from jaxcal.targets import Target

# Arguments that other places of a rig.yaml say, and where.
_ELSEWHERE = {
    "models": "'model' of each camera",
    "names": "'name' of each camera",
    "rolling_shutter": "'rolling_shutter: true' of each camera",
    "imu_models": "'model' of each IMU",
}
_JOBS: tuple[Callable, ...] = (calibrate_cameras, calibrate_camera_imu)


def job_options(job: Callable, content: Mapping[str, Any], where: str, folder: Path, target: Target) -> dict[str, Any]:
    """Keyword arguments for `job` from a mapping with the same names; `where` names the mapping in errors.

    An argument that is a `Calibration` is said as a path, relative to `folder`, to a calibration of any format. Raises
    CalibrationError for a name that the job does not have, with the nearest one that it has, and for a value of the
    wrong kind.
    """
    kinds = option_kinds(job)
    for key in content:
        if key in kinds:
            continue
        if key in _ELSEWHERE:
            raise CalibrationError(f"{where}: '{key}' is not said here, but by {_ELSEWHERE[key]}.")
        for other in _JOBS:
            if key in option_kinds(other):
                having = "with" if other is calibrate_camera_imu else "without"
                raise CalibrationError(
                    f"{where}: '{key}' is for cameras {having} an IMU. Leave it out; known here: {', '.join(kinds)}."
                )
    check_keys(content, list(kinds), where)
    return {key: _value(value, kinds[key], f"{where}.{key}", folder, target) for key, value in content.items()}


def option_kinds(job: Callable) -> dict[str, Any]:
    """The names that a job's section may have, with the kinds of their values."""
    hints = typing.get_type_hints(job)
    parameters = inspect.signature(job).parameters.values()
    named = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in (*_ELSEWHERE, "progress")]
    return {name: hints[name] for name in named}


def _value(value: Any, kind: Any, where: str, folder: Path, target: Target) -> Any:
    kinds = [k for k in _alternatives(kind) if k is not NoneType]
    if value is None and NoneType in _alternatives(kind):
        return None
    literals = [choice for k in kinds if typing.get_origin(k) is Literal for choice in typing.get_args(k)]
    if Calibration in kinds:
        return calibration_of_file(folder / Path(as_text(value, where)).expanduser(), target)
    if literals:
        if value not in literals:
            close = difflib.get_close_matches(str(value), literals, n=1)
            hint = f" Did you mean '{close[0]}'?" if close else ""
            raise CalibrationError(f"{where}: '{value}' is not known.{hint} Known: {', '.join(map(str, literals))}.")
        return value
    simple = {bool: as_bool, int: _as_whole, float: _as_number}
    if len(kinds) == 1 and kinds[0] in simple:
        return simple[kinds[0]](value, where)
    if float in kinds:  # one number for all cameras, or one each
        if isinstance(value, list):
            return [_as_number(one, f"{where}[{i}]") for i, one in enumerate(value)]
        return _as_number(value, where)
    return value  # of several kinds: the job itself says what it expects


def _alternatives(kind: Any) -> tuple[Any, ...]:
    return typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, UnionType) else (kind,)


def _as_whole(value: Any, where: str) -> int:
    if type(value) is not int:
        raise CalibrationError(f"{where}: expected a whole number, found {value!r}.")
    return value


def _as_number(value: Any, where: str) -> float:
    """A finite number. Yaml 1.1 reads '1e-3' as text, so text that is a number is taken too."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise CalibrationError(f"{where}: expected a number, found {value!r}.")
    return number
