"""`CalibratedRig`: what files of other tools can hold of a calibration, without its measurements and uncertainty."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.observations import ImuNoise
from jaxcal.results.calibration import Calibration, ImuCalibration
from jaxcal.results.kalibr import CamchainCamera, camchain_cameras


@dataclass(frozen=True)
class RigImu:
    """The IMU of a rig: its noise, and its mean biases (3,), rad/s and m/s^2, where they are known.

    A measurement is the true value plus the bias.
    """

    noise: ImuNoise
    gyro_bias: np.ndarray | None = None
    accel_bias: np.ndarray | None = None


@dataclass(frozen=True)
class CalibratedRig:
    """Cameras in order, with their poses, and an IMU where there is one.

    `gravity_m_s2` is the size of gravity (None: not known); `format` the name of the format that the rig was read from
    ('jaxcal' for a calibration of our own).
    """

    cameras: tuple[CamchainCamera, ...]
    imu: RigImu | None = None
    gravity_m_s2: float | None = None
    format: str = "jaxcal"

    @property
    def is_tied(self) -> bool:
        """Whether the poses of all cameras to each other are known."""
        return all(camera.T_cn_cnm1 is not None for camera in self.cameras[1:])

    def T_body_cam(self, index: int) -> np.ndarray:
        """(4, 4) from camera `index` to the body: the IMU, or the first camera where no pose to an IMU is known.

        Raises CalibrationError when the camera's pose is not known.
        """
        camera = self.cameras[index]
        if self.cameras[0].T_cam_imu is not None and camera.T_cam_imu is not None:
            return np.linalg.inv(camera.T_cam_imu)
        pose = np.eye(4)
        for earlier in self.cameras[1 : index + 1]:
            if earlier.T_cn_cnm1 is None:
                raise CalibrationError(
                    f"{earlier.name}: its pose to the camera before is not known, which this format needs. Calibrate "
                    "the cameras together, or write each by itself."
                )
            pose = pose @ np.linalg.inv(earlier.T_cn_cnm1)
        return pose


def rig_of(calibration: Calibration) -> CalibratedRig:
    """The part of a calibration that other tools' files can hold."""
    gravity = None if calibration.gravity is None else float(np.linalg.norm(calibration.gravity))
    imu = None if calibration.imu is None else _imu(calibration.imu)
    return CalibratedRig(camchain_cameras(calibration), imu, gravity)


def chained(cameras: Iterable[CamchainCamera]) -> tuple[CamchainCamera, ...]:
    """The same cameras; poses to the camera before and to the IMU follow from each other where one is missing."""
    made: list[CamchainCamera] = []
    for camera in cameras:
        before = made[-1].T_cam_imu if made else None
        if camera.T_cn_cnm1 is None and camera.T_cam_imu is not None and before is not None:
            camera = replace(camera, T_cn_cnm1=camera.T_cam_imu @ np.linalg.inv(before))
        elif camera.T_cam_imu is None and camera.T_cn_cnm1 is not None and before is not None:
            camera = replace(camera, T_cam_imu=camera.T_cn_cnm1 @ before)
        made.append(camera)
    return tuple(made)


def camera_alone(
    name: str,
    model: CameraModel,
    image_size: tuple[int, int],
    *,
    T_cn_cnm1: np.ndarray | None = None,
    T_cam_imu: np.ndarray | None = None,
    timeshift_cam_imu: float | None = None,
    rostopic: str | None = None,
) -> CamchainCamera:
    """A camera of which nothing but what is given is known."""
    return CamchainCamera(name, model, image_size, T_cn_cnm1, T_cam_imu, timeshift_cam_imu, (), rostopic)


def file_stems(rig: CalibratedRig) -> list[str]:
    """A file name, without its suffix, for each camera: its name where that can be one and is no other's."""
    stems = [re.sub(r"[^\w.-]+", "_", camera.name).strip("._") for camera in rig.cameras]
    unique = len(set(stems)) == len(stems) and all(stems)
    return stems if unique else [f"cam{k}" for k in range(len(stems))]


def shared_timeshift(rig: CalibratedRig) -> tuple[float, tuple[str, ...]]:
    """One time offset (s) for all cameras, their mean, and what to say where they differ."""
    shifts = [camera.timeshift_cam_imu for camera in rig.cameras if camera.timeshift_cam_imu is not None]
    if not shifts:
        return 0.0, ()
    mean, apart = float(np.mean(shifts)), max(shifts) - min(shifts)
    if apart <= 1e-6:
        return mean, ()
    return mean, (
        f"there is one time offset for all cameras: their mean, {1e3 * mean:.3f} ms, is written, "
        f"though they are up to {1e3 * apart:.3f} ms apart",
    )


def rate_of(imu: RigImu, default: float = 200.0) -> float:
    """Samples per second, Hz."""
    return imu.noise.update_rate or default


def _imu(imu: ImuCalibration) -> RigImu:
    fields = dict(imu.noise)
    fields.setdefault("update_rate", 1.0 / float(np.median(np.diff(imu.t_s))))
    return RigImu(ImuNoise(**fields), _mean(imu.gyro_bias), _mean(imu.accel_bias))


def _mean(bias: np.ndarray) -> np.ndarray | None:
    known = bias[np.isfinite(bias).all(axis=1)]
    return known.mean(axis=0) if len(known) else None
