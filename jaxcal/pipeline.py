"""The corridor from a rig.yaml to a `Calibration`: frames from events, corners from frames, one joint estimate."""

import contextlib
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from jaxcal.calibration import calibrate_camera_imu, calibrate_cameras, cross_validate, frame_rate_for_spline
from jaxcal.cameras import camera_model
from jaxcal.detection import detect
from jaxcal.event_frames import LAG_SIGMA_S, frames_key, write_event_frames
from jaxcal.job_options import job_options
from jaxcal.observations import Detections, Frames, ImuRecording
from jaxcal.progress import Progress, no_progress
from jaxcal.recording import EventFile, Rig, RigCamera, load_frames, load_rig
from jaxcal.recording.cut import cut_detections, cut_frames
from jaxcal.recording.windows import BY_SPLINE, WindowPlan
from jaxcal.recording.yaml_files import located
from jaxcal.results import Calibration, save_cross_validation
from jaxcal.results.report import write_report


@dataclass(frozen=True)
class PipelineSettings:
    """How `run_pipeline` works; the defaults suit the recordings it was measured on.

    `window_ms`: length of the windows of events that become one frame each, when rig.yaml does not say. `cache`: the
    folder for reconstructed frames and detections; None: `.jaxcal` beside rig.yaml, or in the output folder where
    that cannot be written. `camera_imu`, `cameras`: arguments of `calibrate_camera_imu` and `calibrate_cameras`, which
    go before what rig.yaml says below `calibration`. `reconstructor`: options of `reconstruction.Reconstructor`, which
    go before those below `reconstruction`. `report`: write report.html. `cross_validate`: cross-validate the result,
    too, and show that in the report (takes about as long again).
    """

    window_ms: float = 33.0
    cache: Path | None = None
    camera_imu: Mapping[str, Any] = field(default_factory=dict)
    cameras: Mapping[str, Any] = field(default_factory=dict)
    reconstructor: Mapping[str, Any] = field(default_factory=dict)
    report: bool = True
    cross_validate: bool = False


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

    Raises CalibrationError when the rig or its files have a mistake, no corners are found, the views do not determine
    the calibration, or (the result is saved by then) there are too few of them for the cross-validation asked for.
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
    detections, images = detect_rig(rig, cache, settings=settings, workers=workers, progress=progress)
    calibration = _calibrated(rig, detections, imus, options, progress)
    calibration.save(output)
    found = cross_validate(calibration, progress=progress) if settings.cross_validate else None
    if found is not None:
        save_cross_validation(found, output)
    if settings.report:
        write_report(calibration, output / "report.html", images=images, progress=progress, cross_validation=found)
    return calibration


def detect_rig(
    rig: Rig,
    cache: Path,
    *,
    settings: PipelineSettings | None = None,
    workers: int | None = None,
    progress: Progress = no_progress,
) -> tuple[list[Detections], dict[str, Frames]]:
    """The corners that each camera of a rig saw, and the images of the cameras that have any, by name.

    Frames and detections are cached in the folder `cache`. Raises CalibrationError as `run_pipeline`.
    """
    settings = settings or PipelineSettings()
    corners = {c.name: c.load_detections(rig.target) for c in rig.cameras if c.detections is not None}
    images, span_ns = _images(rig, corners, settings, cache, progress)
    detections = [
        cut_detections(corners[name], span_ns)
        if name in corners
        else detect(images[name], rig.target, workers=workers, cache=cache, progress=progress, name=name)
        for name in (camera.name for camera in rig.cameras)
    ]
    return detections, images


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
        "stamp_sigma_s": [0.0 if camera.events is None else LAG_SIGMA_S for camera in rig.cameras],
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
    times, source = rig.reconstruction.times, rig.reconstruction.times.stamps_of
    if set(times.chosen()) <= {"window_ms"} and not rig.imus and recorded:
        # Without an IMU, cameras are tied together by views at the same time: those of the frames, where there are any.
        source = next(iter(recorded))
        times = replace(times, window_ms=None, stamps_of=source)
    times = times.or_windows_of(settings.window_ms)
    if times.rate_hz == BY_SPLINE:
        times = replace(times, rate_hz=_rate_for_spline(rig, settings))
    stamps = None if source is None else recorded[source].timestamps_ns
    made = {}
    for camera in rig.cameras:
        if camera.events is None:
            continue
        events = opened[camera.name]
        plan = times.plan(events, stamps, span_ns)
        made[camera.name] = _reconstructed(rig, camera, events, plan, network, settings, cache, progress)
    return made


def _rate_for_spline(rig: Rig, settings: PipelineSettings) -> float:
    """Frames per second for the spline on which this rig will be calibrated."""
    names = {"spline_order": "order", "knot_rate_hz": "knot_rate_hz"}
    given = {names[key]: value for key, value in _options(rig, settings).items() if key in names}
    return frame_rate_for_spline(rig.imus[0].load(), **given)


def _reconstructed(
    rig: Rig,
    camera: RigCamera,
    events: EventFile,
    plan: WindowPlan,
    network: Any,
    settings: PipelineSettings,
    cache: Path,
    progress: Progress,
) -> Frames:
    """The frames of one event camera, in an EuRoC folder in `cache`; made unless they are there already."""
    options = {**rig.reconstruction.options, **settings.reconstructor}
    folder = cache / "frames" / f"{camera.name}-{frames_key(events, plan, network, options)[:16]}"
    stage = f"reconstruct {camera.name}"
    if folder.is_dir():
        progress(stage, plan.count(events), plan.count(events))
    else:
        write_event_frames(folder, events, plan, network, options, stage=stage, progress=progress)
        for old in folder.parent.glob(f"{camera.name}-{'[0-9a-f]' * 16}"):
            if old != folder:
                shutil.rmtree(old, ignore_errors=True)
    return load_frames(folder)
