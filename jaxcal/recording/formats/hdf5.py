"""HDF5 event files: e2calib, DSEC, M3ED and whatever else has x, y, p, t in one group, and Prophesee's own."""

import contextlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.recording.formats.columns import ColumnReader, Columns
from jaxcal.recording.formats.contract import NO_TRIGGERS, EventFormat, EventReader, Triggers, empty

_DATASETS = ("x", "y", "p", "t")
_LAYOUTS = "e2calib's layout: x, y, p and t (whole microseconds) at the root; or DSEC's, M3ED's or Prophesee's HDF5"
_NS_PER_US = 1000
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_PROPHESEE = "CD/events"
# Tables that tell the index of the first event of each millisecond (DSEC, TUM-VIE; M3ED).
_MILLISECOND_TABLES = ("ms_to_idx", "ms_map_idx")

_ECF = 0x8ECF
_PLUGIN_FILTERS = {32001: "blosc", 32004: "lz4", 32008: "bitshuffle", 32015: "zstd", 32026: "blosc2"}


def open_hdf5(path: Path, topic: str | None) -> EventReader:
    """Open an HDF5 event file; `topic` is the group of the events where there are several.

    Raises CalibrationError when the file is truncated, lacks a dataset, is compressed by a filter that is not
    installed, or holds no events.
    """
    with _damage_named(path):
        file = h5py.File(path, "r")
    try:
        with _damage_named(path):
            group = _group(file, path, topic)
            if group == _PROPHESEE:
                return _open_prophesee(file, path)
            return _open_columns(file, path, group)
    except BaseException:
        file.close()
        raise


@contextlib.contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """h5py reports a damaged file by OSError, RuntimeError or KeyError, depending on the place."""
    try:
        yield
    except (OSError, RuntimeError, KeyError) as error:
        raise CalibrationError(
            f"{path}: the HDF5 file cannot be read ({error}). It is truncated, damaged or no HDF5 file: copy or "
            "convert the recording again."
        ) from error


# --- which group -----------------------------------------------------------------------------------------------------


def _group(file: h5py.File, path: Path, wanted: str | None) -> str:
    """The group that holds the events; '' is the root."""
    found = _event_groups(file)
    if wanted is not None:
        name = wanted.strip("/")
        if name not in found:
            there = ", ".join(f"/{group}" for group in found) or "none"
            raise CalibrationError(f"{path}: there are no events in '{wanted}'. Groups with events: {there}.")
        return name
    if len(found) > 1:
        choices = " or ".join(f"{path}:/{group}" for group in found)
        raise CalibrationError(f"{path}: there are {len(found)} groups with events. Say which: {choices}.")
    return found[0] if found else ""  # at the root, what is missing is said


def _event_groups(file: h5py.File) -> list[str]:
    if all(isinstance(file.get(name), h5py.Dataset) for name in _DATASETS):
        return [""]
    found: list[str] = []

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Group) and all(isinstance(item.get(key), h5py.Dataset) for key in _DATASETS):
            found.append(name)
        if name == _PROPHESEE and isinstance(item, h5py.Dataset) and item.dtype.names is not None:
            found.append(name)

    file.visititems(visit)
    return found


# --- x, y, p, t in a group -------------------------------------------------------------------------------------------


def _open_columns(file: h5py.File, path: Path, group: str) -> EventReader:
    datasets = _datasets(file, path, group)
    x, y, p, t = (datasets[name] for name in _DATASETS)
    _check_filters(path, [x, y, p, t])
    offset_us = _scalar(file, group, "t_offset")

    def times(low: int, high: int) -> np.ndarray:
        with _damage_named(path):
            return (np.asarray(t[low:high]).astype(np.int64) + offset_us) * _NS_PER_US

    def rest(low: int, high: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with _damage_named(path):
            # 0/1, -1/1 and bool are all in use.
            return np.asarray(x[low:high]), np.asarray(y[low:high]), np.asarray(p[low:high]) > 0

    def triggers() -> Triggers:  # as jaxcal writes them
        edges = [file.get(f"triggers/{name}") for name in ("t", "channel", "rising")]
        if group or not all(isinstance(edge, h5py.Dataset) for edge in edges):
            return NO_TRIGGERS
        with _damage_named(path):
            at_us, channel, rising = (np.asarray(edge) for edge in edges)
        return Triggers(at_us.astype(np.int64) * _NS_PER_US, channel.astype(np.int64), rising.astype(bool))

    columns = Columns(len(t), times, rest, _bracket(file, path, group, offset_us, len(t)))
    return ColumnReader(path, f"HDF5, events in /{group}", _sensor(file, group), columns, file.close, triggers)


def _datasets(file: h5py.File, path: Path, group: str) -> dict[str, h5py.Dataset]:
    inside = file[group] if group else file
    assert isinstance(inside, h5py.Group)
    datasets = {name: item for name in _DATASETS if isinstance(item := inside.get(name), h5py.Dataset)}
    for name in _DATASETS:
        if name not in datasets:
            raise CalibrationError(
                f"{path}: dataset '{name}' is missing; the file holds {', '.join(inside) or 'nothing'}. Expected "
                f"{_LAYOUTS}."
            )
    shapes = {name: dataset.shape for name, dataset in datasets.items()}
    if len(set(shapes.values())) != 1 or len(shapes["t"]) != 1:
        raise CalibrationError(
            f"{path}: x, y, p and t must have one entry per event; their shapes are "
            f"{', '.join(f'{name} {shape}' for name, shape in shapes.items())}. Convert the recording again."
        )
    if shapes["t"][0] == 0:
        raise empty(path)
    if datasets["t"].dtype.kind not in "iu":
        raise CalibrationError(
            f"{path}: dataset 't' has type {datasets['t'].dtype}; expected whole microseconds (int64). Float seconds "
            "lose precision: multiply by 1e6, round, and write again."
        )
    for name in ("x", "y"):
        if datasets[name].dtype.kind not in "iu":
            raise CalibrationError(
                f"{path}: dataset '{name}' has type {datasets[name].dtype}; expected whole pixels. Write it as uint16."
            )
    return datasets


def _above(file: h5py.File, group: str, name: str) -> h5py.Dataset | None:
    """A dataset in the group of the events, or else at the root (DSEC)."""
    for place in (f"{group}/{name}".lstrip("/"), name):
        item = file.get(place)
        if isinstance(item, h5py.Dataset):
            return item
    return None


def _scalar(file: h5py.File, group: str, name: str) -> int:
    dataset = _above(file, group, name)
    return 0 if dataset is None or dataset.size != 1 else int(np.asarray(dataset[()]).ravel()[0])


def _sensor(file: h5py.File, group: str) -> tuple[int, int] | None:
    """The sensor's size from M3ED's calibration, or from the attributes that jaxcal writes."""
    resolution = file.get(f"{group}/calib/resolution".lstrip("/"))
    if isinstance(resolution, h5py.Dataset) and resolution.size == 2:
        width, height = np.asarray(resolution[()]).ravel()
        return int(width), int(height)
    if "width" in file.attrs and "height" in file.attrs:
        return int(np.asarray(file.attrs["width"])), int(np.asarray(file.attrs["height"]))
    return None


def _bracket(
    file: h5py.File, path: Path, group: str, offset_us: int, length: int
) -> Callable[[int], tuple[int, int]] | None:
    found = [_above(file, group, name) for name in _MILLISECOND_TABLES]
    tables = [table for table in found if table is not None and table.ndim == 1]
    if not tables:
        return None
    table = tables[0]

    def bracket(t_ns: int) -> tuple[int, int]:
        millisecond = (t_ns // _NS_PER_US - offset_us) // 1000
        if millisecond < 0:
            return 0, 0
        with _damage_named(path):
            low, high = (int(table[k]) if k < len(table) else length for k in (millisecond, millisecond + 1))
        # A table made of another recording must not lead the search astray.
        return (low, high) if 0 <= low <= high <= length else (0, length)

    return bracket


# --- Prophesee's own -------------------------------------------------------------------------------------------------


def _open_prophesee(file: h5py.File, path: Path) -> EventReader:
    """Source: docs.prophesee.ai, "HDF5 event file format": tables of (x, y, p, t) and of triggers (p, t, id)."""
    table, edges = file[_PROPHESEE], file.get("EXT_TRIGGER/events")
    assert isinstance(table, h5py.Dataset)
    missing = [name for name in _DATASETS if name not in (table.dtype.names or ())]
    if missing:
        raise CalibrationError(f"{path}: /{_PROPHESEE} has no field '{missing[0]}'. Expected x, y, p and t.")
    _check_filters(path, [table])

    def times(low: int, high: int) -> np.ndarray:
        with _damage_named(path):
            return np.asarray(table[low:high])["t"].astype(np.int64) * _NS_PER_US

    def rest(low: int, high: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with _damage_named(path):
            rows = np.asarray(table[low:high])
        return rows["x"], rows["y"], rows["p"] > 0

    def triggers() -> Triggers:
        if not isinstance(edges, h5py.Dataset):
            return NO_TRIGGERS
        with _damage_named(path):
            rows = np.asarray(edges[()])
        return Triggers(rows["t"].astype(np.int64) * _NS_PER_US, rows["id"].astype(np.int64), rows["p"] > 0)

    match = re.fullmatch(r"(\d+)x(\d+)", _text(file.attrs.get("geometry")))
    sensor = (int(match[1]), int(match[2])) if match else None
    return ColumnReader(path, "Prophesee HDF5", sensor, Columns(len(table), times, rest), file.close, triggers)


def _text(value: object) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


# --- compression -----------------------------------------------------------------------------------------------------


def _check_filters(path: Path, datasets: list[h5py.Dataset]) -> None:
    """Load the plugins that the datasets are compressed with; raise CalibrationError with the remedy where they are
    not installed."""
    needed = {code for dataset in datasets for code in _filters(dataset)}
    absent = {code for code in needed if not h5py.h5z.filter_avail(code)}
    if absent - {_ECF}:
        with contextlib.suppress(ImportError):
            import hdf5plugin  # noqa: F401  # registers its filters

            absent = {code for code in needed if not h5py.h5z.filter_avail(code)}
    if _ECF in absent:
        raise CalibrationError(
            f"{path}: the events are compressed with Prophesee's ECF codec, which is not installed. Install hdf5_ecf "
            "(github.com/prophesee-ai/hdf5_ecf, or Metavision SDK) and set HDF5_PLUGIN_PATH to its folder; or convert "
            "the RAW file instead."
        )
    if absent:
        names = ", ".join(_PLUGIN_FILTERS.get(code, f"filter {code}") for code in sorted(absent))
        raise CalibrationError(
            f"{path}: the events are compressed with {names}, which is not installed: pip install 'jaxcal[hdf5]'."
        )


def _filters(dataset: h5py.Dataset) -> list[int]:
    plist = dataset.id.get_create_plist()
    return [plist.get_filter(index)[0] for index in range(plist.get_nfilters())]


def _recognises(path: Path, head: bytes) -> bool:
    # A file named so that is none is reported with what h5py says of it.
    return head.startswith(_SIGNATURE) or (bool(head) and path.suffix.lower() in FORMAT.suffixes)


FORMAT = EventFormat("HDF5: e2calib, DSEC, M3ED, Prophesee", (".h5", ".hdf5", ".hdf"), _recognises, open_hdf5)
