"""The `reconstruction:` part of a rig.yaml: when frames are wanted, and how they are made from events."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxcal.errors import CalibrationError
from jaxcal.recording.windows import BY_SPLINE, TRIGGER_EDGES, FrameTimes
from jaxcal.recording.yaml_files import as_mapping, as_positive, as_text, check_keys, existing_path

PRECISIONS = ("auto", "float32", "bfloat16", "float16")


def _number(content: Any, where: str) -> float:
    if isinstance(content, bool) or not isinstance(content, int | float) or abs(content) == float("inf"):
        raise CalibrationError(f"{where}: expected a number, found {content!r}.")
    return float(content)


def _not_negative(content: Any, where: str) -> float:
    if (value := _number(content, where)) < 0:
        raise CalibrationError(f"{where}: expected a number that is not negative, found {content!r}.")
    return value


def _count(content: Any, where: str) -> int:
    if type(content) is not int or content < 1:
        raise CalibrationError(f"{where}: expected a whole number of at least 1, found {content!r}.")
    return content


def _channel(content: Any, where: str) -> int:
    if type(content) is not int or content < 0:
        raise CalibrationError(f"{where}: expected the number of a trigger channel, found {content!r}.")
    return content


def _yes_or_no(content: Any, where: str) -> bool:
    if not isinstance(content, bool):
        raise CalibrationError(f"{where}: expected true or false, found {content!r}.")
    return content


def _one_of(*known: str) -> Callable[[Any, str], str]:
    def check(content: Any, where: str) -> str:
        if content not in known:
            raise CalibrationError(f"{where}: expected one of {', '.join(known)}, found {content!r}.")
        return content

    return check


def _rate(content: Any, where: str) -> float | str:
    return content if content == BY_SPLINE else as_positive(content, where)


# Key -> how its value is read. Those in _PATHS are files instead, relative to the rig.
_TIMES: dict[str, Callable[[Any, str], Any]] = {
    "window_ms": as_positive,
    "rate_hz": _rate,
    "triggers": _one_of(*TRIGGER_EDGES),
    "stamps_of": as_text,
    "events_per_window": _count,
    "trigger_channel": _channel,
    "time_offset_ms": _number,
    "upsample_rate": _count,
}
_OPTIONS: dict[str, Callable[[Any, str], Any]] = {
    "unsharp_mask_amount": _not_negative,
    "unsharp_mask_sigma": as_positive,
    "bilateral_filter_sigma": _not_negative,
    "auto_hdr": _yes_or_no,
    "Imin": _number,
    "Imax": _number,
    "precision": _one_of(*PRECISIONS),
    "device": as_text,
}
_PATHS = ("timestamps", "hot_pixels")
_KEYS = ("window_ms", "network", "timestamps", "hot_pixels", *(key for key in _TIMES if key != "window_ms"), *_OPTIONS)


@dataclass(frozen=True)
class RigReconstruction:
    """How frames are made from events: `times` when they are wanted (nothing set: windows of the default length, or at
    the stamps of a frame camera), `network` weights, or the name of a network that is shipped (None: the default),
    `options` of `reconstruction.Reconstructor` that rig.yaml gives."""

    times: FrameTimes = field(default_factory=FrameTimes)
    network: Path | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def window_ms(self) -> float | None:
        """Length of the windows, where that is what rig.yaml gives."""
        return self.times.window_ms


def reconstruction_from_yaml(content: Any, folder: Path, where: str) -> RigReconstruction:
    """Read the mapping; paths are relative to `folder`. A key without a value counts as absent.

    Raises CalibrationError, with the key's path, for unknown keys, values of the wrong kind, missing files, and more
    than one way to say when frames are wanted.
    """
    content = as_mapping(content, where)
    check_keys(content, _KEYS, where)
    given = {key: value for key, value in content.items() if value is not None}

    def read(known: Mapping[str, Callable[[Any, str], Any]]) -> dict[str, Any]:
        return {key: check(given[key], f"{where}.{key}") for key, check in known.items() if key in given}

    automatic = given.get("hot_pixels") == "auto"
    paths = {
        key: existing_path(given[key], folder, f"{where}.{key}")
        for key in _PATHS
        if key in given and not (key == "hot_pixels" and automatic)
    }
    times = FrameTimes(timestamps=paths.get("timestamps"), **read(_TIMES))
    if len(times.chosen()) > 1:
        raise CalibrationError(
            f"{where}: {' and '.join(times.chosen())} each say when frames are wanted; give only one of them."
        )
    options = read(_OPTIONS)
    if "hot_pixels" in given:
        options["hot_pixels"] = "auto" if automatic else str(paths["hot_pixels"])
    network = _network(given["network"], folder, f"{where}.network") if "network" in given else None
    return RigReconstruction(times, network, options)


def _network(value: Any, folder: Path, where: str) -> Path:
    """A file of weights, or a bare name as it stands: whether there is such a network, `load_network` knows."""
    name = Path(as_text(value, where))
    if name.parent == Path() and not name.suffix and not (folder / name).exists():
        return name
    return existing_path(value, folder, where)
