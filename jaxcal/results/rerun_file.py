"""`write_rerun`: a calibration as a log for the Rerun viewer (rerun.io), which is installed for this alone."""

import importlib
import os
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.results.calibration import Calibration
from jaxcal.results.motion_log import FrameCorners, Lens, MotionLog, motion_log

_USED, _REJECTED, _ARROW = (79, 143, 217), (226, 87, 76), (226, 140, 60)
_ARROW_SCALE = 20.0  # a residual of 1 px is drawn this long
_TIMELINE = "time"


def require_rerun(path: str | Path) -> Any:
    """Rerun's module, to write `path` with; asked for before a calibration, so that nobody waits in vain.

    Raises CalibrationError where rerun-sdk is not installed.
    """
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise CalibrationError(
            f'{path}: writing it needs rerun-sdk, which is not installed. Run: pip install "jaxcal[rerun]".'
        ) from error


def write_rerun(calibration: Calibration, path: str | Path) -> None:
    """Write an .rrd file, atomically: target, cameras and IMU in motion, corners with residuals (drawn twenty times as
    long as they are), readings of the IMU beside the estimate. `rerun FILE.rrd` shows it.

    Raises CalibrationError where rerun-sdk is not installed.
    """
    rr = require_rerun(path)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    log = motion_log(calibration)
    try:
        with rr.RecordingStream("jaxcal") as recording:
            recording.save(part)
            _log_static(rr, recording, log)
            _log_tracks(rr, recording, log)
            for frame in log.corners:
                _log_corners(rr, recording, frame, _place(log, frame.camera))
            for series in log.series:
                columns = rr.Scalars.columns(scalars=series.values)
                rr.send_columns(series.name, _times(rr, series.time_s), columns, recording=recording)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _times(rr: Any, time_s: np.ndarray) -> list[Any]:
    return [rr.TimeColumn(_TIMELINE, duration=time_s)]


def _place(log: MotionLog, camera: str) -> str:
    """Where a camera hangs in the tree of entities: below the IMU that carries it, or by itself."""
    lens = next(lens for lens in log.lenses if lens.name == camera)
    return f"world/imu0/{camera}" if lens.T_imu_cam is not None else f"world/{camera}"


def _log_static(rr: Any, recording: Any, log: MotionLog) -> None:
    recording.log("world/target", rr.Points3D(log.target_points, radii=0.002, colors=_USED), static=True)
    for track in log.tracks:
        path = rr.LineStrips3D([track.poses[:, :3, 3]], radii=0.001)
        recording.log(f"world/path/{track.name}", path, static=True)
        # The axes of whatever moves.
        axes = rr.Arrows3D(vectors=0.05 * np.eye(3), colors=[(226, 87, 76), (47, 143, 78), (46, 111, 228)])
        recording.log(f"world/{track.name}/axes", axes, static=True)
    for series in log.series:
        recording.log(series.name, rr.SeriesLines(names=list(series.labels)), static=True)
    for lens in log.lenses:
        _log_lens(rr, recording, lens, _place(log, lens.name))


def _log_lens(rr: Any, recording: Any, lens: Lens, place: str) -> None:
    if lens.T_imu_cam is not None:
        recording.log(place, _transform(rr, lens.T_imu_cam), static=True)
    pinhole = rr.Pinhole(
        focal_length=lens.focal_px, principal_point=lens.centre_px, resolution=lens.image_size, image_plane_distance=0.1
    )
    recording.log(f"{place}/image", pinhole, static=True)


def _transform(rr: Any, T: np.ndarray) -> Any:
    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


def _log_tracks(rr: Any, recording: Any, log: MotionLog) -> None:
    for track in log.tracks:
        columns = rr.Transform3D.columns(translation=track.poses[:, :3, 3], mat3x3=track.poses[:, :3, :3])
        rr.send_columns(f"world/{track.name}", _times(rr, track.time_s), columns, recording=recording)


def _log_corners(rr: Any, recording: Any, frame: FrameCorners, place: str) -> None:
    recording.set_time(_TIMELINE, duration=frame.time_s)
    colours = np.where(frame.used[:, None], _USED, _REJECTED)
    recording.log(f"{place}/image/corners", rr.Points2D(frame.pixels, colors=colours, radii=1.5))
    arrows = _ARROW_SCALE * frame.residuals_px[frame.used]
    recording.log(
        f"{place}/image/residuals", rr.Arrows2D(origins=frame.pixels[frame.used], vectors=arrows, colors=_ARROW)
    )
    if np.isfinite(frame.rms_px):
        recording.log(f"residuals/{frame.camera}", rr.Scalars(frame.rms_px))
