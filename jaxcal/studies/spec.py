"""`Study`: what to repeat and how often; read from a study.yaml or made in Python."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from jaxcal.calibration.resolving import settings_of
from jaxcal.cameras import camera_model
from jaxcal.errors import CalibrationError

KINDS = ("monte-carlo", "bootstrap", "leave-one-out", "recordings", "sweep")
BY = ("views", "segments")
RESAMPLING = ("monte-carlo", "bootstrap", "leave-one-out")
_KEYS = (
    "kind",
    "calibration",
    "rig",
    "recordings",
    "target",
    "runs",
    "by",
    "segments",
    "seed",
    "settings",
    "sweep",
    "reference",
    "full",
)
# Settings of a study beside those of the calibrations themselves.
OWN_SETTINGS = ("camera_model", "corner_noise_px", "window_ms")


@dataclass(frozen=True)
class Study:
    """Many calibrations of one kind.

    `kind`: 'monte-carlo' (the fit's own corners and IMU readings with fresh noise of the size found), 'bootstrap'
    (views, or segments of time, drawn anew with replacement), 'leave-one-out' (each view or segment left out in turn),
    'recordings' (each of a list), 'sweep' (one calibration per combination of settings).

    `source`: a saved calibration or a rig.yaml; `recordings` the list of those (or of detections files, one or a tuple
    of one per camera, with `target`). `runs` of monte-carlo and bootstrap; `by`, `segments` what is drawn or left out.
    `settings` are done otherwise in all runs, `sweep` (name -> values) in every combination; names are arguments of the
    calibration's job, or `camera_model`, `corner_noise_px` (monte-carlo), `window_ms` (a rig's events). `reference` is
    what the results are held against. `full`: calibrations as users make them, from no guess, also where a compiled
    batch would do. All random numbers follow from `seed` and a run's index alone.
    """

    kind: str
    source: Path | None = None
    recordings: tuple[Path | tuple[Path, ...], ...] = ()
    target: Path | None = None
    runs: int = 100
    by: str = "views"
    segments: int = 20
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)
    sweep: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    reference: Path | None = None
    full: bool = False

    def __post_init__(self) -> None:
        _check(self)

    @property
    def combinations(self) -> list[dict[str, Any]]:
        """The settings of every combination of the sweep; one empty one without a sweep."""
        return [dict(zip(self.sweep, values, strict=True)) for values in itertools.product(*self.sweep.values())]


def load_study(path: str | Path) -> Study:
    """Read a study.yaml. Paths in it are relative to its folder.

    Raises CalibrationError, with the key's path and the nearest known one, for mistakes.
    """
    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: no such study file.") from error
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not a readable yaml file: {error}") from error
    if not isinstance(content, Mapping):
        raise CalibrationError(f"{path}: expected 'key: value' lines, such as 'kind: bootstrap'.")
    for key in content:
        if key not in _KEYS:
            raise CalibrationError(
                f"{path}: unknown key '{key}'.{_nearest(str(key), _KEYS)} Known: {', '.join(_KEYS)}."
            )
    folder = path.resolve().parent
    sources = [key for key in ("calibration", "rig") if content.get(key) is not None]
    if len(sources) == 2:
        raise CalibrationError(f"{path}: both calibration and rig are given; give one of them.")
    fields: dict[str, Any] = {
        key: content[key] for key in ("kind", "runs", "by", "segments", "seed", "full") if key in content
    }
    if sources:
        fields["source"] = _path(content[sources[0]], folder, f"{path}: {sources[0]}")
    for key in ("target", "reference"):
        if content.get(key) is not None:
            fields[key] = _path(content[key], folder, f"{path}: {key}")
    if content.get("recordings") is not None:
        fields["recordings"] = _recordings(content["recordings"], folder, f"{path}: recordings")
    for key in ("settings", "sweep"):
        if content.get(key) is not None:
            if not isinstance(content[key], Mapping):
                raise CalibrationError(f"{path}: {key}: expected 'name: value' lines.")
            fields[key] = dict(content[key])
    if "sweep" in fields:
        fields["sweep"] = {name: tuple(v) if isinstance(v, list) else (v,) for name, v in fields["sweep"].items()}
    if "kind" not in fields:
        raise CalibrationError(f"{path}: 'kind' is missing; it is one of {', '.join(KINDS)}.")
    try:
        return Study(**fields)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def _check(study: Study) -> None:
    if study.kind not in KINDS:
        raise CalibrationError(f"kind '{study.kind}' is unknown.{_nearest(str(study.kind), KINDS)} {_known(KINDS)}")
    if study.by not in BY:
        raise CalibrationError(f"by '{study.by}' is unknown.{_nearest(str(study.by), BY)} views or segments.")
    for name, least in (("runs", 1), ("segments", 3), ("seed", 0)):
        value = getattr(study, name)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise CalibrationError(f"{name} is {value!r}; expected a whole number, {least} or more.")
    if study.kind == "recordings" and len(study.recordings) < 2:
        raise CalibrationError("recordings: a list of 2 or more is needed (rig.yaml, saved calibrations, detections).")
    if study.kind != "recordings" and study.recordings:
        raise CalibrationError(f"recordings are for 'kind: recordings'; this is {study.kind}.")
    names = (*OWN_SETTINGS, *settings_of("calibrate_cameras"), *settings_of("calibrate_camera_imu"))
    known = tuple(dict.fromkeys(name for name in names if name not in ("cameras", "names")))
    for place, mapping in (("settings", study.settings), ("sweep", study.sweep)):
        for name in mapping:
            if name not in known:
                raise CalibrationError(f"{place}: '{name}' is no setting.{_nearest(str(name), known)} {_known(known)}")
    for name, values in study.sweep.items():
        if not isinstance(values, Sequence) or isinstance(values, str) or not values:
            raise CalibrationError(f"sweep: {name}: expected a list of values.")
    if study.kind == "sweep" and not study.sweep:
        raise CalibrationError("a sweep needs 'sweep': settings with lists of values, such as knot_rate_hz: [20, 50].")
    if "corner_noise_px" in (*study.sweep, *study.settings) and study.kind != "monte-carlo":
        raise CalibrationError("corner_noise_px is for 'kind: monte-carlo', which makes the noise.")
    for model in (*study.sweep.get("camera_model", ()), *([study.settings.get("camera_model")])):
        if model is not None:
            camera_model(str(model))


def _nearest(name: str, known: Sequence[str]) -> str:
    import difflib

    close = difflib.get_close_matches(name, known, n=1)
    return f" Did you mean '{close[0]}'?" if close else ""


def _known(known: Sequence[str]) -> str:
    return f"Known: {', '.join(known)}."


def _recordings(content: Any, folder: Path, where: str) -> tuple[Path | tuple[Path, ...], ...]:
    if not isinstance(content, list):
        raise CalibrationError(f"{where}: expected a list of rig.yaml files, calibrations or detections files.")
    return tuple(
        tuple(_path(part, folder, f"{where}[{k}]") for part in entry)
        if isinstance(entry, list)
        else _path(entry, folder, f"{where}[{k}]")
        for k, entry in enumerate(content)
    )


def _path(content: Any, folder: Path, where: str) -> Path:
    if not isinstance(content, str) or not content.strip():
        raise CalibrationError(f"{where}: expected a path, found {content!r}.")
    path = folder / Path(content).expanduser()
    if not path.exists():
        raise CalibrationError(f"{where}: {path} does not exist. Paths are relative to the study file's folder.")
    return path
