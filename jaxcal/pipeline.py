"""The corridor from a rig.yaml to a `Calibration`: frames from events, corners from frames, one joint estimate."""

import contextlib
import csv
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxcal.calibration import calibrate_camera_imu, calibrate_cameras
from jaxcal.cameras import camera_model
from jaxcal.detection import detect
from jaxcal.errors import CalibrationError
from jaxcal.job_options import job_options
from jaxcal.observations import Detections, Frames, ImuRecording
from jaxcal.progress import Progress, no_progress, track
from jaxcal.recording import EventFile, Rig, RigCamera, load_frames, load_rig
from jaxcal.recording.cut import cut_detections, cut_frames
from jaxcal.recording.yaml_files import located
from jaxcal.results import Calibration
from jaxcal.results.report import write_report

# Raised whenever the same events could give other frames than before, apart from the network and the options.
_FRAMES_VERSION = 1
_MAX_WINDOWS = 500_000


@dataclass(frozen=True)
class PipelineSettings:
    """How `run_pipeline` works; the defaults suit the recordings it was measured on.

    `window_ms`: length of the windows of events that become one frame each, when rig.yaml does not say. `cache`: the
    folder for reconstructed frames and detections; None: `.jaxcal` beside rig.yaml, or in the output folder where
    that cannot be written. `camera_imu`, `cameras`: arguments of `calibrate_camera_imu` and `calibrate_cameras`, which
    go before what rig.yaml says below `calibration`. `reconstructor`: options of `reconstruction.Reconstructor`.
    `report`: write report.html.
    """

    window_ms: float = 33.0
    cache: Path | None = None
    camera_imu: Mapping[str, Any] = field(default_factory=dict)
    cameras: Mapping[str, Any] = field(default_factory=dict)
    reconstructor: Mapping[str, Any] = field(default_factory=dict)
    report: bool = True


def run_pipeline(
    rig: str | Path | Rig,
    output: str | Path,
    *,
    settings: PipelineSettings | None = None,
    workers: int | None = None,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate what a rig.yaml (its path, or the `Rig` read) names and write the results to the folder `output`.

    Frames are reconstructed for cameras that recorded events, corners are detected in frames, and all cameras are
    calibrated jointly, with the IMU where there is one. `output` gets `calibration.npz`, Kalibr-style yaml,
    `results.txt` and `report.html`. Frames and detections are cached (see `PipelineSettings.cache`): what is there
    for the same files and settings is not made again. `workers` processes detect corners (None: one per core).

    Raises CalibrationError when the rig or its files have a mistake, no corners are found, or the views do not
    determine the calibration.
    """
    settings = settings or PipelineSettings()
    rig = rig if isinstance(rig, Rig) else load_rig(rig)
    for camera in rig.cameras:
        camera_model(camera.model)  # an unknown model is reported now, not after minutes of detection
    options = _options(rig, settings)
    output = Path(output)
    output.mkdir(parents=True, exist_ok=True)
    cache = settings.cache or _cache_folder(rig.path.resolve().parent, output)
    imus = [imu.load() for imu in rig.imus]
    corners = {c.name: c.load_detections(rig.target) for c in rig.cameras if c.detections is not None}
    images, span_ns = _images(rig, corners, settings, cache, progress)
    detections = [
        cut_detections(corners[name], span_ns)
        if name in corners
        else detect(images[name], rig.target, workers=workers, cache=cache, progress=progress, name=name)
        for name in (camera.name for camera in rig.cameras)
    ]
    calibration = _calibrated(rig, detections, imus, options, progress)
    calibration.save(output)
    if settings.report:
        write_report(calibration, output / "report.html", images=images, progress=progress)
    return calibration


def _options(rig: Rig, settings: PipelineSettings) -> dict[str, Any]:
    """What rig.yaml and the settings say to the job."""
    job, more = (calibrate_camera_imu, settings.camera_imu) if rig.imus else (calibrate_cameras, settings.cameras)
    where, folder = f"{rig.path}: calibration", rig.path.resolve().parent
    return job_options(job, rig.calibration, where, folder, rig.target) | dict(more)


def _calibrated(
    rig: Rig,
    detections: Sequence[Detections],
    imus: Sequence[ImuRecording],
    options: Mapping[str, Any],
    progress: Progress,
) -> Calibration:
    more: dict[str, Any] = {
        "models": [camera.model for camera in rig.cameras],
        "names": [camera.name for camera in rig.cameras],
        "rolling_shutter": [camera.rolling_shutter for camera in rig.cameras],
        "progress": progress,
    }
    if not imus:
        return calibrate_cameras(detections, rig.target, **(more | dict(options)))
    more["imu_models"] = [imu.model for imu in rig.imus]
    return calibrate_camera_imu(detections, imus, rig.target, **(more | dict(options)))


def _cache_folder(beside: Path, output: Path) -> Path:
    folder = beside / ".jaxcal"
    try:
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return output / "cache"


# --- frames ----------------------------------------------------------------------------------------------------------


def _images(
    rig: Rig, corners: Mapping[str, Detections], settings: PipelineSettings, cache: Path, progress: Progress
) -> tuple[dict[str, Frames], tuple[int, int] | None]:
    """The frames of each camera that has any, by name, and the span (ns) of the part of the recording that is used.

    Frames of event cameras are reconstructed first.
    """
    recorded = {camera.name: camera.load_frames() for camera in rig.cameras if camera.frames is not None}
    with contextlib.ExitStack() as files:
        events = {c.name: files.enter_context(c.open_events()) for c in rig.cameras if c.events is not None}
        starts = [int(seen.timestamps_ns[0]) for seen in (*recorded.values(), *corners.values())]
        span_ns = rig.span_ns([*starts, *(opened.first_ns for opened in events.values())])
        for name, frames in recorded.items():
            with located(name):
                recorded[name] = cut_frames(frames, span_ns, rig.frame_rate_hz)
        if not events:
            return recorded, span_ns
        made = _from_events(rig, events, recorded, span_ns, settings, cache, progress)
    return {
        camera.name: (recorded | made)[camera.name] for camera in rig.cameras if camera.name not in corners
    }, span_ns


def _from_events(
    rig: Rig,
    opened: Mapping[str, EventFile],
    recorded: Mapping[str, Frames],
    span_ns: tuple[int, int] | None,
    settings: PipelineSettings,
    cache: Path,
    progress: Progress,
) -> dict[str, Frames]:
    """The reconstructed frames of the event cameras, by name."""
    import reconstruction  # imports torch, which takes seconds: only where there are events

    network = reconstruction.load_network(rig.reconstruction.network)
    window_ns = round((rig.reconstruction.window_ms or settings.window_ms) * 1e6)
    # Without an IMU, cameras are tied together by views at the same time: those of the frames, where there are any.
    shared = next(iter(recorded.values())).timestamps_ns if not rig.imus and recorded else None
    made = {}
    for camera in rig.cameras:
        if camera.events is None:
            continue
        events = opened[camera.name]
        ends = _window_ends(events, window_ns, shared)
        start_ns = None
        if span_ns is not None:
            start_ns = span_ns[0]
            ends = ends[(ends > start_ns) & (ends <= span_ns[1])]
        made[camera.name] = _reconstructed(camera, events, start_ns, ends, network, settings, cache, progress)
    return made


def _window_ends(events: EventFile, window_ns: int, shared: np.ndarray | None) -> np.ndarray:
    """When the windows of an event camera end: at shared times, or at whole multiples of the window's length.

    Multiples make the frames of several event cameras simultaneous, as far as their clocks agree.
    """
    if shared is not None:
        return shared[(shared > events.first_ns) & (shared <= events.last_ns)]
    first, last = events.first_ns // window_ns + 1, events.last_ns // window_ns
    if last - first > _MAX_WINDOWS:
        raise CalibrationError(
            f"{events.path}: the events span {(events.last_ns - events.first_ns) * 1e-9:.0f} s, which is "
            f"{last - first} windows of {window_ns * 1e-6:g} ms. Are the time stamps in microseconds and free of jumps?"
        )
    ends = np.arange(first, last + 1, dtype=np.int64) * window_ns
    if not len(ends):
        raise CalibrationError(
            f"{events.path}: the recording is {(events.last_ns - events.first_ns) * 1e-6:.1f} ms long, shorter than "
            f"one window of {window_ns * 1e-6:g} ms. Record for longer: 20 s and more make a good calibration."
        )
    return ends


def _reconstructed(
    camera: RigCamera,
    events: EventFile,
    start_ns: int | None,
    ends: np.ndarray,
    network: Any,
    settings: PipelineSettings,
    cache: Path,
    progress: Progress,
) -> Frames:
    """The frames of one event camera, in an EuRoC folder in `cache`; made unless they are there already.

    The first window begins at `start_ns`, by default at the first event.

    The folder appears when all frames are in it. An interrupted reconstruction starts again: the network's state
    depends on all events before.
    """
    key = _frames_key(events, start_ns, ends, network, settings)
    folder = cache / "frames" / f"{camera.name}-{key[:16]}"
    stage = f"reconstruct {camera.name}"
    if folder.is_dir():
        progress(stage, len(ends), len(ends))
    else:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f"{camera.name}-", suffix=".part") as name:
            part = Path(name) / "frames"
            _write_frames(part, events, start_ns, ends, network, settings, stage, progress)
            os.replace(part, folder)
        for old in folder.parent.glob(f"{camera.name}-{'[0-9a-f]' * 16}"):
            if old != folder:
                shutil.rmtree(old, ignore_errors=True)
    return load_frames(folder)


def _write_frames(
    folder: Path,
    events: EventFile,
    start_ns: int | None,
    ends: np.ndarray,
    network: Any,
    settings: PipelineSettings,
    stage: str,
    progress: Progress,
) -> None:
    import reconstruction

    (folder / "data").mkdir(parents=True)
    windows = events.windows_ending(ends.tolist(), start_ns)
    frames = reconstruction.reconstruct(
        windows, network, width=events.width, height=events.height, **settings.reconstructor
    )
    with (folder / "data.csv").open("w", newline="") as listing:
        table = csv.writer(listing, lineterminator="\n")
        table.writerow(["#timestamp [ns]", "filename"])
        for t_ns, image in track(frames, stage, len(ends), progress):
            path = folder / "data" / f"{t_ns}.png"
            if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
                raise CalibrationError(f"{path}: the frame could not be written. Is the disk full?")
            table.writerow([t_ns, path.name])


def _frames_key(
    events: EventFile, start_ns: int | None, ends: np.ndarray, network: Any, settings: PipelineSettings
) -> str:
    """A hash of all that the frames depend on: the event file, the windows, the network's weights and the options."""
    digest = hashlib.sha256()
    facts = [_FRAMES_VERSION, *events.fingerprint(), events.width, events.height]
    digest.update(json.dumps([*facts, type(network).__name__, dict(settings.reconstructor)], default=str).encode())
    digest.update(json.dumps(start_ns).encode() + ends.astype(np.int64).tobytes())
    for name, values in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(values.detach().cpu().numpy().tobytes())
    return digest.hexdigest()
