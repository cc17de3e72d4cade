"""Event formats, one per file; a new one is a module with a `FORMAT`, and its name in the list here."""

import importlib
from pathlib import Path

from jaxcal.errors import CalibrationError
from jaxcal.recording.formats.contract import EventFormat, EventReader

# Asked in this order; text, which nearly anything could be, comes last. A module is imported when it is first needed.
_MODULES = (
    "hdf5",
    "prophesee_raw",
    "prophesee_dat",
    "aedat4",
    "npz",
    "rosbag",
    "text",
)

_HEAD_BYTES = 4096


def event_formats() -> tuple[EventFormat, ...]:
    """All formats, in the order in which they are asked whether a file is theirs."""
    return tuple(importlib.import_module(f"{__name__}.{module}").FORMAT for module in _MODULES)


def open_reader(path: Path, topic: str | None = None) -> EventReader:
    """Open an event recording, of whatever format its content says.

    `topic` names the topic of a bag or the group of an HDF5 file, where there are several. Raises CalibrationError when
    the file is missing, of no known format or damaged.
    """
    formats = event_formats()
    if not path.exists():
        raise CalibrationError(f"{path}: no such event file. Known formats: {_listed(formats)}.")
    if path.is_dir():
        head = b""
    else:
        try:
            with path.open("rb") as file:
                head = file.read(_HEAD_BYTES)
        except OSError as error:
            raise CalibrationError(f"{path}: the file cannot be read ({error.strerror}). Copy it again.") from error
        if not head:
            raise CalibrationError(f"{path}: the file is empty. Record or copy it again.")
    for candidate in formats:
        if candidate.recognises(path, head):
            return candidate.open(path, topic)
    by_suffix = [candidate.name for candidate in formats if path.suffix.lower() in candidate.suffixes]
    if by_suffix:
        raise CalibrationError(
            f"{path}: named like {by_suffix[0]}, but its content is not ({head[:12]!r}...). It is damaged or has the "
            "wrong suffix: copy or convert it again."
        )
    raise CalibrationError(f"{path}: no event recording that is known here. Known formats: {_listed(formats)}.")


def _listed(formats: tuple[EventFormat, ...]) -> str:
    return ", ".join(f"{candidate.name} ({' '.join(candidate.suffixes)})" for candidate in formats)
