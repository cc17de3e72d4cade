"""A calibration over time, for a viewer: who is where when, the corners with their residuals, and the IMU's readings.

`motion_log` gathers it without a viewer's library; `jaxcal.results.rerun_file` writes it for Rerun.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration


@dataclass(frozen=True)
class Track:
    """Poses (T, 4, 4) of something in the target's frame (T_target_thing) at `time_s` (T,)."""

    name: str
    time_s: np.ndarray
    poses: np.ndarray


@dataclass(frozen=True)
class Lens:
    """A camera as a pyramid: its image's size, focal lengths and principal point near the axis, px; and its pose in the
    frame of the first IMU (T_imu_cam), which moves; None without an IMU, where the camera has a track of its own."""

    name: str
    image_size: tuple[int, int]
    focal_px: np.ndarray
    centre_px: np.ndarray
    T_imu_cam: np.ndarray | None


@dataclass(frozen=True)
class FrameCorners:
    """The corners of one frame: `pixels` (N, 2) as found, `residuals_px` (N, 2) projection minus measurement (NaN where
    a corner took no part), `used` (N,)."""

    camera: str
    time_s: float
    pixels: np.ndarray
    residuals_px: np.ndarray
    used: np.ndarray

    @property
    def rms_px(self) -> float:
        """Root mean square 2-D residual of the corners that were used; NaN without any."""
        kept = self.residuals_px[self.used]
        return float(np.sqrt(np.mean(np.sum(kept**2, axis=1)))) if len(kept) else float("nan")


@dataclass(frozen=True)
class Series:
    """Numbers (T, K) over `time_s` (T,), with a name for each of the K."""

    name: str
    time_s: np.ndarray
    values: np.ndarray
    labels: tuple[str, ...]


@dataclass(frozen=True)
class MotionLog:
    """Everything, on one clock: seconds after `origin_ns` of the first IMU's clock, or the first camera's without one.

    `target_points` (N, 3) m, target frame.
    """

    origin_ns: int
    target_points: np.ndarray
    lenses: tuple[Lens, ...]
    tracks: tuple[Track, ...]
    corners: tuple[FrameCorners, ...]
    series: tuple[Series, ...]


def motion_log(calibration: Calibration) -> MotionLog:
    """Gather the log of a calibration. Frames without a pose have no place on a track."""
    imu = calibration.imu
    first = [camera.detections.timestamps_ns for camera in calibration.cameras]
    origin = imu.origin_ns if imu is not None else min((int(t[0]) for t in first if len(t)), default=0)
    tracks = [_imu_track(imu)] if imu is not None else [_camera_track(c, origin) for c in calibration.cameras]
    return MotionLog(
        origin_ns=origin,
        target_points=calibration.target_points,
        lenses=tuple(_lens(camera) for camera in calibration.cameras),
        tracks=tuple(tracks),
        corners=tuple(frame for camera in calibration.cameras for frame in _frames(camera, origin)),
        series=tuple(_readings(calibration)),
    )


def _times_s(camera: CameraCalibration, origin_ns: int) -> np.ndarray:
    """(T,) times of a camera's frames on the log's clock."""
    shift = camera.timeshift_cam_imu if camera.timeshift_cam_imu is not None else camera.timeshift_cam_cam0 or 0.0
    return (camera.detections.timestamps_ns - origin_ns) * 1e-9 + shift


def _lens(camera: CameraCalibration) -> Lens:
    scale, centre = (np.asarray(part) for part in camera.model.paraxial())
    T = None if camera.T_cam_imu is None else np.linalg.inv(camera.T_cam_imu)
    return Lens(camera.name, camera.image_size, np.abs(np.diag(scale)), centre, T)


def _imu_track(imu: ImuCalibration) -> Track:
    poses = np.tile(np.eye(4), (len(imu.t_s), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = imu.rotation, imu.position_m
    return Track("imu0", imu.t_s, poses)


def _camera_track(camera: CameraCalibration, origin_ns: int) -> Track:
    times = _times_s(camera, origin_ns)
    if camera.T_cam_target is None:
        return Track(camera.name, times[:0], np.zeros((0, 4, 4)))
    known = np.isfinite(camera.T_cam_target).all(axis=(1, 2))
    return Track(camera.name, times[known], np.linalg.inv(camera.T_cam_target[known]))


def _frames(camera: CameraCalibration, origin_ns: int) -> Iterator[FrameCorners]:
    times, frame, used = _times_s(camera, origin_ns), camera.detections.frame, camera.used
    for number in camera.detections.seen_frames.tolist():
        mine = frame == number
        yield FrameCorners(
            camera.name, float(times[number]), camera.detections.pixels[mine], camera.residuals_px[mine], used[mine]
        )


def _readings(calibration: Calibration) -> Iterator[Series]:
    for number, imu in enumerate(calibration.imus):
        for sensor, measured, predicted in (
            ("gyroscope", imu.gyro_rad_s, imu.gyro_predicted),
            ("accelerometer", imu.accel_m_s2, imu.accel_predicted),
        ):
            yield Series(f"imu{number}/{sensor}/measured", imu.t_s, measured, ("x", "y", "z"))
            yield Series(f"imu{number}/{sensor}/estimated", imu.t_s, predicted, ("x", "y", "z"))
