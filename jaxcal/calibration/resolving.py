"""`resolve`: a calibration again, from nothing but itself, with other settings or with other measurements."""

import difflib
import inspect
from collections.abc import Sequence
from typing import Any

from jaxcal.calibration.camera_imu import calibrate_camera_imu
from jaxcal.calibration.cameras import calibrate_cameras
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections, ImuRecording
from jaxcal.progress import Progress, no_progress
from jaxcal.results import Calibration

_JOBS = {"calibrate_cameras": calibrate_cameras, "calibrate_camera_imu": calibrate_camera_imu}
# Arguments of the jobs that are not settings: the measurements, and what `resolve` has arguments of its own for.
_NOT_SETTINGS = ("detections", "imu", "target", "progress")


def resolve(
    calibration: Calibration,
    *,
    detections: Sequence[Detections] | None = None,
    imu: ImuRecording | Sequence[ImuRecording] | None = None,
    progress: Progress = no_progress,
    **changes: Any,
) -> Calibration:
    """Repeat a calibration from its own corners, IMU recordings and settings; `changes` are settings to do otherwise.

        resolve(calibration)                                            # the same again, to rounding
        resolve(calibration, models=["pinhole-rational8"])              # another lens
        resolve(calibration, spline_order=5, imu_noise="given")         # settings of calibrate_camera_imu

    `changes` are arguments of the job that made it (`calibrate_cameras` or `calibrate_camera_imu`). `detections` (one
    per camera) and `imu` take the place of the recorded ones: a subset of the frames, say.

    Raises CalibrationError when a change is no setting of that job, and when the calibration lacks what is needed:
    results of earlier releases hold no whole IMU recording, and a prior on the lenses (`intrinsics="prior"`) comes from
    another calibration, to be given as `cameras`.
    """
    job = str(calibration.settings.get("job", ""))
    if job not in _JOBS:
        raise CalibrationError(
            "this calibration does not say which job made it (settings['job']), so it cannot be repeated. Calibrate "
            "again from its recordings."
        )
    check_changes(job, changes)
    settings = {name: value for name, value in calibration.settings.items() if name != "job"} | changes
    settings.setdefault("names", [camera.name for camera in calibration.cameras])
    corners = [camera.detections for camera in calibration.cameras] if detections is None else list(detections)
    if job == "calibrate_cameras":
        if imu is not None:
            raise CalibrationError("an IMU recording was given, but this calibration is of cameras alone.")
        return calibrate_cameras(corners, calibration.target, progress=progress, **settings)
    if settings.get("intrinsics", "free") != "free" and settings.get("cameras") is None:
        if settings["intrinsics"] == "prior":
            raise CalibrationError(
                "the lenses were estimated under the prior of another calibration, which is not kept in this one. "
                "Give it: resolve(calibration, cameras=that_one)."
            )
        settings["cameras"] = calibration  # held lenses are in the result itself
    recordings = recordings_of(calibration) if imu is None else imu
    return calibrate_camera_imu(corners, recordings, calibration.target, progress=progress, **settings)


def recordings_of(calibration: Calibration) -> list[ImuRecording]:
    """The recordings of a calibration's IMUs. Raises CalibrationError where a result holds none."""
    found = [imu.recording for imu in calibration.imus]
    if any(recording is None for recording in found):
        raise CalibrationError(
            "this calibration does not hold the whole recording of its IMU (files of earlier releases do not). "
            "Give it as `imu`, or calibrate again."
        )
    return [recording for recording in found if recording is not None]


def settings_of(job: str) -> tuple[str, ...]:
    """The names of the settings of a job."""
    return tuple(name for name in inspect.signature(_JOBS[job]).parameters if name not in _NOT_SETTINGS)


def check_changes(job: str, changes: dict[str, Any]) -> None:
    """Raise CalibrationError for a change that is no setting of `job`, with the nearest one that is."""
    known = settings_of(job)
    for name in changes:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f" Did you mean '{close[0]}'?" if close else ""
            raise CalibrationError(f"'{name}' is no setting of {job}.{hint} Known: {', '.join(known)}.")
