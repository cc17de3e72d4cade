"""`discover`: what sensors recorded below a folder or in a bag, told by content and by the usual layouts."""

import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import yaml

from jaxcal.errors import CalibrationError
from jaxcal.recording.bag_images import IMAGE_TYPES
from jaxcal.recording.bags import Bag, is_bag
from jaxcal.recording.events import EventFile
from jaxcal.recording.formats.rosbag import EVENT_TYPES
from jaxcal.recording.images import IMAGE_SUFFIXES
from jaxcal.targets import load_target

_EVENT_SUFFIXES = (".raw", ".dat", ".aedat4", ".h5", ".hdf5", ".evt2", ".evt3")
_DEPTH = 3
_MIN_IMAGES = 3
# Folders of results and caches, which hold images and tables that no sensor recorded.
_RESULTS = ("calibration.npz", "camchain.yaml")


@dataclass(frozen=True)
class FoundCamera:
    """A camera: `place` as rig.yaml names it (absolute); `resolution` where rig.yaml has to say it and it is known;
    `facts` in words; `prefix` of a corner table's columns; `unknown`: rig.yaml has to say a resolution that is not."""

    name: str
    kind: Literal["frames", "events", "detections"]
    place: str
    facts: str
    prefix: str = ""
    unknown_resolution: bool = False


@dataclass(frozen=True)
class FoundImu:
    """An IMU: `place` as rig.yaml names it, `facts` in words."""

    place: str
    facts: str


@dataclass
class Found:
    """All that was found: sensors, files that describe targets and IMUs' noise, and remarks on what was passed over."""

    cameras: list[FoundCamera] = field(default_factory=list)
    imus: list[FoundImu] = field(default_factory=list)
    targets: list[Path] = field(default_factory=list)
    noises: list[Path] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)


def discover(path: str | Path) -> Found:
    """Look at a folder, three levels deep, or at a bag. Cameras are named cam0, cam1, ... unless their folders are.

    Raises CalibrationError when the path does not exist or is a file that is no bag.
    """
    path = Path(path).resolve()
    if not path.exists():
        raise CalibrationError(f"{path}: no such folder or bag.")
    found = Found()
    if is_bag(path):
        _bag(path, found)
        _yaml_files(path.parent, found)
    elif path.is_dir():
        _folder(path, found, _DEPTH)
    else:
        raise CalibrationError(f"{path}: neither a folder nor a bag. Name the folder that holds the recording.")
    found.cameras = _with_names(found.cameras)
    return found


def _rows(table: Path) -> int:
    """Rows of a csv below its heading."""
    with table.open(errors="replace") as lines:
        return sum(1 for line in lines if line[:1].isdigit())


def _folder(folder: Path, found: Found, depth: int) -> None:
    if any((folder / name).exists() for name in _RESULTS):
        found.remarks.append(f"{folder}: results of a calibration, passed over")
        return
    _yaml_files(folder, found)
    if (folder / "data.csv").is_file() and (folder / "data").is_dir():
        _euroc_images(folder, found)
        return
    _files(folder, found)
    if depth:
        for inner in sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith(".")):
            if is_bag(inner):
                _bag(inner, found)
            else:
                _folder(inner, found, depth - 1)


def _euroc_images(folder: Path, found: Found) -> None:
    count = sum(1 for entry in (folder / "data").iterdir() if entry.suffix.lower() in IMAGE_SUFFIXES)
    if count:
        found.cameras.append(FoundCamera(folder.name, "frames", str(folder), f"{count} images, EuRoC/ASL"))


def _files(folder: Path, found: Found) -> None:
    images: dict[str, list[Path]] = defaultdict(list)
    for file in sorted(entry for entry in folder.iterdir() if entry.is_file()):
        suffix = file.suffix.lower()
        if suffix in IMAGE_SUFFIXES:
            images[re.sub(r"\d+(?!.*\d)", "*", file.stem) + file.suffix].append(file)
        elif suffix in _EVENT_SUFFIXES:
            _events(file, found)
        elif suffix == ".npz":
            _table(file, found)
        elif suffix == ".csv" and _is_imu_csv(file):
            name = f"{file.parent.name}/{file.name}" if file.name == "data.csv" else file.name
            found.imus.append(FoundImu(str(file), f"{name}, {_rows(file)} measurements"))
        elif is_bag(file):
            _bag(file, found)
    numbered = {pattern: files for pattern, files in images.items() if "*" in pattern and len(files) >= _MIN_IMAGES}
    for pattern, files in numbered.items():
        whole = pattern.startswith("*.") and len(numbered) == 1  # named by time, or by a number, and nothing else
        times = whole and all(len(file.stem) > 12 for file in files)
        place = folder if times else folder / pattern
        name = folder.name if whole else re.sub(r"\W+", "", pattern.split("*")[0]) or folder.name
        found.cameras.append(FoundCamera(name, "frames", str(place), f"{len(files)} images"))


def _events(file: Path, found: Found) -> None:
    try:
        with EventFile(file) as events:
            size = events.size
            told = f"{size[0]}x{size[1]}" if size else "sensor not told"
            facts = f"{events.format}, {told}"
    except CalibrationError as error:
        found.remarks.append(f"{file}: passed over ({error})")
        return
    found.cameras.append(FoundCamera(file.stem, "events", str(file), facts, unknown_resolution=size is None))


def _table(file: Path, found: Found) -> None:
    """An npz: corners of jaxcal's, or columns of corners and of an IMU."""
    try:
        with np.load(file, allow_pickle=False) as table:
            names = set(table.files)
    except Exception as error:  # numpy and zipfile report a damaged archive in many ways
        found.remarks.append(f"{file}: passed over ({error})")
        return
    if {"timestamps_ns", "frame", "point", "pixels"} <= names:
        found.cameras.append(FoundCamera(file.stem.split(".")[0], "detections", str(file), "corners detected"))
    for prefix in sorted(name[:-3] for name in names if name.endswith("_ns") and f"{name[:-3]}_uv" in names):
        facts = f"a table of corners, columns {prefix}_*"
        found.cameras.append(FoundCamera(prefix, "detections", str(file), facts, prefix, unknown_resolution=True))
    if {"imu_ns", "gyro_rad_s", "acc_m_s2"} <= names:
        found.imus.append(FoundImu(str(file), f"a table in {file.name}"))


def _bag(path: Path, found: Found) -> None:
    try:
        with Bag(path) as bag:
            topics = bag.topics()
    except CalibrationError as error:
        found.remarks.append(f"{path}: passed over ({error})")
        return
    for topic in topics:
        place = f"{path}:{topic.name}"
        name = topic.name.strip("/").split("/")[0] or "camera"
        if topic.kind in IMAGE_TYPES and topic.count:
            found.cameras.append(FoundCamera(name, "frames", place, f"{topic.count} images"))
        elif topic.kind in EVENT_TYPES and topic.count:
            found.cameras.append(FoundCamera(name, "events", place, f"{topic.count} messages of events"))
        elif topic.kind == "sensor_msgs/msg/Imu" and topic.count:
            found.imus.append(FoundImu(place, f"{topic.count} measurements"))
        else:
            found.remarks.append(f"{place}: passed over ({topic.kind}, {topic.count} messages)")


def _is_imu_csv(file: Path) -> bool:
    """Whether the first row of numbers is a time in whole nanoseconds and six values."""
    for line in _first_lines(file):
        cells = [cell.strip() for cell in line.split(",")]
        if not cells[0].isdigit():
            continue
        try:
            return len(cells) == 7 and all(np.isfinite(float(cell)) for cell in cells[1:])
        except ValueError:
            return False
    return False


def _first_lines(file: Path) -> Iterator[str]:
    with file.open("rb") as stream:
        for raw in stream.read(4096).splitlines()[:5]:
            yield raw.decode("utf-8", "replace").strip()


def _yaml_files(folder: Path, found: Found) -> None:
    for file in sorted((*folder.glob("*.yaml"), *folder.glob("*.yml"))):
        try:
            content = yaml.safe_load(file.read_text(encoding="utf-8"))
        except (OSError, yaml.YAMLError, UnicodeDecodeError):
            continue  # some other program's
        if not isinstance(content, dict):
            continue
        if "target_type" in content:
            try:
                load_target(file)
                found.targets.append(file)
            except CalibrationError as error:
                found.remarks.append(f"passed over: {error}")
        elif "accelerometer_noise_density" in content.get("imu0", content):
            found.noises.append(file)


def _with_names(cameras: list[FoundCamera]) -> list[FoundCamera]:
    """Names of their own for all: those of their folders or topics where they differ and can be names."""
    names = [re.sub(r"\W+", "_", camera.name).strip("_") for camera in cameras]
    if len(set(names)) < len(names) or not all(names):
        names = [f"cam{number}" for number in range(len(cameras))]
    return [FoundCamera(**{**vars(camera), "name": name}) for camera, name in zip(cameras, names, strict=True)]
