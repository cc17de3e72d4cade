"""rig.yaml: which cameras and IMUs were recorded, where their files are, and what stood in front of them."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections, Frames, ImuNoise, ImuRecording
from jaxcal.recording.events import EventFile
from jaxcal.recording.images import load_frames
from jaxcal.recording.imu import load_imu, load_noise, noise_from_yaml
from jaxcal.recording.rig_reconstruction import RigReconstruction, reconstruction_from_yaml
from jaxcal.recording.tables import load_detections
from jaxcal.recording.windows import BY_SPLINE
from jaxcal.recording.yaml_files import (
    as_bool,
    as_mapping,
    as_positive,
    as_span,
    as_text,
    check_keys,
    existing_path,
    read_mapping,
)
from jaxcal.targets import Target, load_target, target_from_yaml

_SOURCES = ("events", "frames", "detections")
_CAMERA_KEYS = ("name", "model", *_SOURCES, "resolution", "prefix", "rolling_shutter")
# Kalibr's names of how an IMU measures (`jaxcal.imu` has what they mean), the plain one first.
IMU_MODELS = ("calibrated", "scale-misalignment", "scale-misalignment-size-effect")
_RIG_KEYS = ("target", "cameras", "imu", "imus", "reconstruction", "from_to", "frame_rate_hz", "calibration")


@dataclass(frozen=True)
class RigCamera:
    """One camera of a rig.

    `model` is a camera model's name; exactly one of `events` (a file of any event format), `frames` (a folder, or a
    topic of a bag) and `detections` (npz) is set; `prefix` names the columns of a corner table; `resolution` (width,
    height) in pixels where rig.yaml gives it. Event files of some formats tell it themselves. `rolling_shutter`: its
    rows are seen one after another.
    """

    name: str
    model: str
    events: Path | None = None
    frames: Path | None = None
    detections: Path | None = None
    resolution: tuple[int, int] | None = None
    prefix: str = ""
    rolling_shutter: bool = False

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
    """An IMU of a rig: `data` is an EuRoC csv, an npz table or a topic of a bag, `noise` its noise model.

    `model`: Kalibr's name of the measurement model, such as 'scale-misalignment'.
    """

    data: Path
    noise: ImuNoise
    model: str = "calibrated"

    def load(self) -> ImuRecording:
        """What the IMU recorded."""
        return load_imu(self.noise, self.data)


@dataclass(frozen=True)
class Rig:
    """A recorded rig: the file it was read from, the target, the cameras and the IMUs, none or more.

    `from_to`: only this part of the recording is used, seconds after the first frame or event of any camera;
    `frame_rate_hz`: at most so many images a second. `calibration`: arguments of `calibrate_cameras` or
    `calibrate_camera_imu`, as they stand in the file; whoever calibrates checks them.
    """

    path: Path
    target: Target
    cameras: tuple[RigCamera, ...]
    imus: tuple[RigImu, ...] = ()
    reconstruction: RigReconstruction = field(default_factory=RigReconstruction)
    from_to: tuple[float, float] | None = None
    frame_rate_hz: float | None = None
    calibration: Mapping[str, Any] = field(default_factory=dict)

    @property
    def imu(self) -> RigImu | None:
        """The first IMU, whose frame and clock are the rig's."""
        return self.imus[0] if self.imus else None

    def span_ns(self, first_ns: Sequence[int]) -> tuple[int, int] | None:
        """First and last time of the part to use, for cameras whose recordings begin at `first_ns`; None: all."""
        if self.from_to is None:
            return None
        start = min(int(t) for t in first_ns)
        return start + round(self.from_to[0] * 1e9), start + round(self.from_to[1] * 1e9)


def load_rig(path: str | Path) -> Rig:
    """Read a rig.yaml. Paths in it are relative to its folder; every file that it names must exist.

    Raises CalibrationError, with the key's path, for unknown or missing keys, values of the wrong kind, no cameras,
    two cameras of one name, and missing files. The arguments below `calibration` are checked where they are used.
    """
    path = Path(path)
    content = read_mapping(path, "rig")
    where = str(path)
    check_keys(content, _RIG_KEYS, where, required=("target", "cameras"))
    folder = path.resolve().parent
    reconstruction, rate = content.get("reconstruction"), content.get("frame_rate_hz")
    rig = Rig(
        path=path,
        target=_target(content["target"], folder, f"{where}: target"),
        cameras=_cameras(content["cameras"], folder, f"{where}: cameras"),
        imus=_imus(content, folder, where),
        reconstruction=reconstruction_from_yaml(reconstruction or {}, folder, f"{where}: reconstruction"),
        from_to=None if content.get("from_to") is None else as_span(content["from_to"], f"{where}: from_to"),
        frame_rate_hz=None if rate is None else as_positive(rate, f"{where}: frame_rate_hz"),
        calibration=as_mapping(content.get("calibration") or {}, f"{where}: calibration"),
    )
    _check_reconstruction(rig, f"{where}: reconstruction")
    return rig


def _check_reconstruction(rig: Rig, where: str) -> None:
    """What the reconstruction says must fit the cameras."""
    with_frames = [camera.name for camera in rig.cameras if camera.frames is not None]
    source = rig.reconstruction.times.stamps_of
    if source is not None and source not in with_frames:
        raise CalibrationError(
            f"{where}.stamps_of: '{source}' is no camera with 'frames'; those are {', '.join(with_frames) or 'none'}."
        )
    if rig.reconstruction.times.rate_hz == BY_SPLINE and not rig.imus:
        raise CalibrationError(
            f"{where}.rate_hz: '{BY_SPLINE}' takes the rate from the IMU's readings, and this rig has no 'imu'. Give a "
            "number of frames per second, or leave it out."
        )
    hot_pixels = rig.reconstruction.options.get("hot_pixels")
    if hot_pixels not in (None, "auto") and sum(camera.events is not None for camera in rig.cameras) > 1:
        raise CalibrationError(
            f"{where}.hot_pixels: one file cannot serve several event cameras. Give 'auto', which finds those of each."
        )


def _target(content: Any, folder: Path, where: str) -> Target:
    if isinstance(content, Mapping):
        return target_from_yaml(content, where)
    return load_target(existing_path(content, folder, where))


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
        rolling_shutter=as_bool(content.get("rolling_shutter", False), f"{where}.rolling_shutter"),
        **{source: existing_path(content[source], folder, f"{where}.{source}")},
    )


def _imus(content: Mapping[str, Any], folder: Path, where: str) -> tuple[RigImu, ...]:
    """What `imu`, a mapping or a list, or `imus` says."""
    if content.get("imu") is not None and content.get("imus") is not None:
        raise CalibrationError(f"{where}: give 'imu' or 'imus', not both.")
    key = "imu" if content.get("imu") is not None else "imus"
    found = content.get(key)
    if found is None:
        return ()
    if isinstance(found, Mapping):
        return (_imu(found, folder, f"{where}: {key}"),)
    if not isinstance(found, Sequence) or isinstance(found, str):
        raise CalibrationError(f"{where}: {key}: expected 'data:' and 'noise:', or a list of IMUs with them.")
    return tuple(_imu(entry, folder, f"{where}: {key}[{index}]") for index, entry in enumerate(found))


def _imu(content: Any, folder: Path, where: str) -> RigImu:
    content = as_mapping(content, where)
    check_keys(content, ("data", "noise", "model"), where, required=("data", "noise"))
    kind = content.get("model", IMU_MODELS[0])
    if kind not in IMU_MODELS:
        close = difflib.get_close_matches(str(kind), IMU_MODELS, n=1)
        hint = f" Did you mean '{close[0]}'?" if close else ""
        raise CalibrationError(f"{where}.model: '{kind}' is unknown.{hint} Known: {', '.join(IMU_MODELS)}.")
    noise = content["noise"]
    if isinstance(noise, Mapping):
        model = noise_from_yaml(noise, f"{where}.noise")
    else:
        model = load_noise(existing_path(noise, folder, f"{where}.noise"))
    return RigImu(data=existing_path(content["data"], folder, f"{where}.data"), noise=model, model=kind)


def _resolution(content: Any, where: str) -> tuple[int, int]:
    values = list(content) if isinstance(content, (list, tuple)) else []
    if len(values) != 2 or not all(type(value) is int and value > 0 for value in values):
        raise CalibrationError(f"{where}: expected [width, height] in pixels, found {content!r}.")
    return (values[0], values[1])
