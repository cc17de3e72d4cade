"""rig.yaml: which cameras and IMU were recorded, where their files are, and what stood in front of them."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections, Frames, ImuNoise, ImuRecording
from jaxcal.recording.events import EventFile
from jaxcal.recording.images import load_frames
from jaxcal.recording.imu import load_imu, load_noise, noise_from_yaml
from jaxcal.recording.places import split_place
from jaxcal.recording.tables import load_detections
from jaxcal.recording.yaml_files import as_mapping, as_positive, as_text, check_keys, read_mapping
from jaxcal.targets import Target, load_target, target_from_yaml

_SOURCES = ("events", "frames", "detections")
_CAMERA_KEYS = ("name", "model", *_SOURCES, "resolution", "prefix")


@dataclass(frozen=True)
class RigCamera:
    """One camera of a rig.

    `model` is a camera model's name; exactly one of `events` (a file of any event format), `frames` (a folder, or a
    topic of a bag) and `detections` (npz) is set; `prefix` names the columns of a corner table; `resolution` (width,
    height) in pixels where rig.yaml gives it. Event files of some formats tell it themselves.
    """

    name: str
    model: str
    events: Path | None = None
    frames: Path | None = None
    detections: Path | None = None
    resolution: tuple[int, int] | None = None
    prefix: str = ""

    def open_events(self) -> EventFile:
        """The camera's event recording."""
        if self.events is None:
            raise CalibrationError(f"camera '{self.name}' has no event recording.")
        events = EventFile(self.events, *(self.resolution or (None, None)))
        if events.size is None:
            events.close()
            raise CalibrationError(
                f"{self.events}: the file ({events.format}) does not tell the sensor's size. Give 'resolution: [width, "
                f"height]' for '{self.name}' in the rig."
            )
        return events

    def load_frames(self) -> Frames:
        """The camera's images, read lazily."""
        if self.frames is None:
            raise CalibrationError(f"camera '{self.name}' has no images.")
        frames = load_frames(self.frames)
        if self.resolution is not None and frames.image_size != self.resolution:
            raise CalibrationError(
                f"{self.frames}: the images are {frames.image_size[0]}x{frames.image_size[1]}, but the rig says "
                f"{self.resolution[0]}x{self.resolution[1]} for '{self.name}'. Correct the resolution, or leave it out."
            )
        return frames

    def load_detections(self, target: Target) -> Detections:
        """The camera's corners, from its detections file or corner table."""
        if self.detections is None:
            raise CalibrationError(f"camera '{self.name}' has no detections file.")
        return load_detections(self.detections, target, self.resolution, self.prefix or self.name)


@dataclass(frozen=True)
class RigImu:
    """The IMU of a rig: `data` is an EuRoC csv, an npz table or a topic of a bag, `noise` its noise model."""

    data: Path
    noise: ImuNoise

    def load(self) -> ImuRecording:
        """What the IMU recorded."""
        return load_imu(self.noise, self.data)


@dataclass(frozen=True)
class RigReconstruction:
    """How frames are made from events: `window_ms` length of a window, `network` weights; None: the default."""

    window_ms: float | None = None
    network: Path | None = None


@dataclass(frozen=True)
class Rig:
    """A recorded rig: the file it was read from, the target, the cameras and an IMU or None."""

    path: Path
    target: Target
    cameras: tuple[RigCamera, ...]
    imu: RigImu | None = None
    reconstruction: RigReconstruction = RigReconstruction()


def load_rig(path: str | Path) -> Rig:
    """Read a rig.yaml. Paths in it are relative to its folder; every file that it names must exist.

    Raises CalibrationError, with the key's path, for unknown or missing keys, values of the wrong kind, no cameras,
    two cameras of one name, and missing files.
    """
    path = Path(path)
    content = read_mapping(path, "rig")
    where = str(path)
    check_keys(content, ("target", "cameras", "imu", "reconstruction"), where, required=("target", "cameras"))
    folder = path.resolve().parent
    imu, reconstruction = content.get("imu"), content.get("reconstruction")
    return Rig(
        path=path,
        target=_target(content["target"], folder, f"{where}: target"),
        cameras=_cameras(content["cameras"], folder, f"{where}: cameras"),
        imu=None if imu is None else _imu(as_mapping(imu, f"{where}: imu"), folder, f"{where}: imu"),
        reconstruction=_reconstruction(reconstruction or {}, folder, f"{where}: reconstruction"),
    )


def _target(content: Any, folder: Path, where: str) -> Target:
    if isinstance(content, Mapping):
        return target_from_yaml(content, where)
    return load_target(_existing(content, folder, where))


def _cameras(content: Any, folder: Path, where: str) -> tuple[RigCamera, ...]:
    if not isinstance(content, Sequence) or isinstance(content, str) or not content:
        raise CalibrationError(f"{where}: expected a list of cameras, at least one, each starting with '- name: ...'.")
    cameras = tuple(_camera(entry, folder, f"{where}[{index}]") for index, entry in enumerate(content))
    names = [camera.name for camera in cameras]
    for index, name in enumerate(names):
        if name in names[:index]:
            raise CalibrationError(
                f"{where}[{index}].name: '{name}' is the name of cameras[{names.index(name)}] too; each camera needs "
                "a name of its own."
            )
    return cameras


def _camera(content: Any, folder: Path, where: str) -> RigCamera:
    content = as_mapping(content, where)
    check_keys(content, _CAMERA_KEYS, where, required=("name", "model"))
    sources = [key for key in _SOURCES if content.get(key) is not None]
    if len(sources) != 1:
        found = " and ".join(sources) or "none"
        raise CalibrationError(f"{where}: give exactly one of events, frames and detections; found {found}.")
    source = sources[0]
    resolution = content.get("resolution")
    if "prefix" in content and source != "detections":
        raise CalibrationError(f"{where}.prefix: only a camera with 'detections' has a prefix.")
    name = as_text(content["name"], f"{where}.name")
    if any(character in name for character in "/\\") or name in (".", ".."):
        raise CalibrationError(f"{where}.name: '{name}' cannot name files; leave out slashes.")
    return RigCamera(
        name=name,
        model=as_text(content["model"], f"{where}.model"),
        resolution=None if resolution is None else _resolution(resolution, f"{where}.resolution"),
        prefix=as_text(content["prefix"], f"{where}.prefix") if "prefix" in content else "",
        **{source: _existing(content[source], folder, f"{where}.{source}")},
    )


def _imu(content: Mapping[str, Any], folder: Path, where: str) -> RigImu:
    check_keys(content, ("data", "noise"), where, required=("data", "noise"))
    noise = content["noise"]
    if isinstance(noise, Mapping):
        model = noise_from_yaml(noise, f"{where}.noise")
    else:
        model = load_noise(_existing(noise, folder, f"{where}.noise"))
    return RigImu(data=_existing(content["data"], folder, f"{where}.data"), noise=model)


def _reconstruction(content: Any, folder: Path, where: str) -> RigReconstruction:
    content = as_mapping(content, where)
    check_keys(content, ("window_ms", "network"), where)
    window, network = content.get("window_ms"), content.get("network")
    return RigReconstruction(
        window_ms=None if window is None else as_positive(window, f"{where}.window_ms"),
        network=None if network is None else _existing(network, folder, f"{where}.network"),
    )


def _existing(content: Any, folder: Path, where: str) -> Path:
    path = folder / Path(os.path.expandvars(as_text(content, where))).expanduser()
    if not split_place(path)[0].exists():
        raise CalibrationError(f"{where}: {path} does not exist. Paths are relative to the rig file's folder.")
    return path


def _resolution(content: Any, where: str) -> tuple[int, int]:
    values = list(content) if isinstance(content, (list, tuple)) else []
    if len(values) != 2 or not all(type(value) is int and value > 0 for value in values):
        raise CalibrationError(f"{where}: expected [width, height] in pixels, found {content!r}.")
    return (values[0], values[1])
