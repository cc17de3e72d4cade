"""Kalibr's way to name a sensor, a recording and a topic in it, for bags and for folders that stand for one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jaxcal.errors import CalibrationError
from jaxcal.recording.bag_images import IMAGE_TYPES
from jaxcal.recording.bags import Bag, is_bag
from jaxcal.recording.formats.rosbag import EVENT_TYPES

_CAMERA_TYPES = (*IMAGE_TYPES, *EVENT_TYPES)
_INSIDE = ("", "mav0")  # where an EuRoC recording keeps its sensors


@dataclass(frozen=True)
class CameraSource:
    """What a camera recorded: 'frames' or 'events', and where they are, as rig.yaml says it."""

    kind: Literal["frames", "events"]
    place: Path


def camera_source(recording: Path, topic: str) -> CameraSource:
    """A topic of images or events of a bag; in a folder, the folder of images that `topic` means.

    `/cam0/image_raw` is the topic of a bag, or the folder cam0 (or mav0/cam0) with its images. Raises CalibrationError
    when there is no such thing, with what there is.
    """
    if is_bag(recording):
        with Bag(recording) as bag:
            chosen = bag.choose(topic, _CAMERA_TYPES, "images or events")
        return CameraSource("events" if chosen.kind in EVENT_TYPES else "frames", Path(f"{recording}:{chosen.name}"))
    if not recording.is_dir():
        raise CalibrationError(f"{recording}: no such bag or folder.")
    tried = _candidates(recording, topic)
    for folder in tried:
        if folder.is_dir() and folder != recording:
            return CameraSource("frames", folder)
    raise CalibrationError(
        f"{recording}: no folder of images for '{topic}'; looked for {_listed(tried, recording)}. It holds "
        f"{_content(recording)}."
    )


def imu_source(recording: Path, topic: str | None) -> Path:
    """A topic of an IMU of a bag; in a folder, the csv that `topic` means, imu0/data.csv or imu0.csv for `/imu0`.

    Without a topic, the only IMU. Raises CalibrationError when there is none or more than one.
    """
    if is_bag(recording):
        with Bag(recording) as bag:
            return Path(f"{recording}:{bag.choose(topic, ('sensor_msgs/msg/Imu',), 'IMU measurements').name}")
    if not recording.is_dir():
        raise CalibrationError(f"{recording}: no such bag or folder.")
    if topic is not None:
        tried = [file for place in _candidates(recording, topic) for file in (place / "data.csv", _with_csv(place))]
        found = [file for file in tried if file.is_file()]
    else:
        found = imu_tables(recording)
        tried = [recording / "imu0" / "data.csv", recording / "imu0.csv"]
    if not found or (topic is None and len(found) > 1):
        what = f"{len(found)} IMUs" if found else "no IMU data"
        means = f" for '{topic}'" if topic is not None else "; name one by 'rostopic' in imu.yaml"
        raise CalibrationError(
            f"{recording}: {what}{means}; looked for {_listed(found or tried, recording)}. It holds "
            f"{_content(recording)}."
        )
    return found[0]


def imu_tables(folder: Path) -> list[Path]:
    """The csv files of IMUs in a folder of EuRoC's layout, or of Kalibr's bagcreater."""
    inside = [folder / name for name in _INSIDE]
    found = [path for place in inside for path in (*place.glob("imu*/data.csv"), *place.glob("imu*.csv"))]
    return sorted(set(found))


def _candidates(recording: Path, topic: str) -> list[Path]:
    parts = [part for part in topic.split("/") if part]
    names = ["/".join(parts), "/".join(parts[:-1]), parts[0], parts[-1]] if parts else []
    places = [recording / inside / name for inside in _INSIDE for name in dict.fromkeys(names) if name]
    return list(dict.fromkeys(places))


def _with_csv(path: Path) -> Path:
    return path.with_name(f"{path.name}.csv")


def _listed(paths: list[Path], folder: Path) -> str:
    return ", ".join(str(path.relative_to(folder)) for path in paths)


def _content(folder: Path) -> str:
    names = sorted(f"{path.name}/" if path.is_dir() else path.name for path in folder.iterdir())
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "") if names else "nothing"
