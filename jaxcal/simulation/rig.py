"""The description of a simulated rig: sensors, target, motion; and the built-in hybrid rig."""

from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxcal.cameras import CameraModel, PinholeRadtan, model_name
from jaxcal.errors import CalibrationError
from jaxcal.observations import ImuNoise
from jaxcal.simulation.event_sensor import EventSensorConfig
from jaxcal.simulation.motion import Motion
from jaxcal.targets import Checkerboard, Target

CameraKind = Literal["events", "frames"]

STANDARD_GRAVITY = 9.80665


_SENSOR = EventSensorConfig(contrast_on=0.35, contrast_off=0.37)


@dataclass(frozen=True)
class SimulatedCamera:
    """One camera of a rig.

    `T_cam_imu` (4, 4) maps points from the IMU's frame; `timeshift_cam_imu` seconds, t_imu = t_cam + shift;
    `image_size` (width, height); `rate_hz` frames per second: of the recording for a frame camera, of simulated
    detections for either kind. `phase_s` is the time of the first frame on the camera's own clock.
    """

    name: str
    kind: CameraKind
    model: CameraModel
    image_size: tuple[int, int]
    T_cam_imu: np.ndarray
    timeshift_cam_imu: float
    rate_hz: float = 20.0
    phase_s: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in ("events", "frames"):
            raise CalibrationError(f"simulated camera {self.name}: kind is {self.kind!r}; it is 'events' or 'frames'.")
        if np.shape(self.T_cam_imu) != (4, 4):
            raise CalibrationError(f"simulated camera {self.name}: T_cam_imu has shape {np.shape(self.T_cam_imu)}.")
        if not self.rate_hz > 0:
            raise CalibrationError(f"simulated camera {self.name}: rate_hz is {self.rate_hz}; it must be positive.")


@dataclass(frozen=True)
class Imaging:
    """How images come about, for all cameras of a rig.

    `psf_sigma_px`: the lens' Gaussian blur. Frame cameras integrate over `exposure_s` (timestamps are its middle),
    drawn as `exposure_samples` sharp images, and add Gaussian noise of `grey_noise` grey levels. For event cameras
    images are rendered so often that nothing moves further than `step_px` between two, at least every `step_s`.
    """

    psf_sigma_px: float = 0.6
    exposure_s: float = 0.005
    exposure_samples: int = 4
    grey_noise: float = 1.5
    step_px: float = 1.0
    step_s: float = 0.01
    event_sensor: EventSensorConfig = _SENSOR


@dataclass(frozen=True)
class SimulatedRig:
    """Cameras and an IMU, rigidly joined, that move in front of a target for `duration_s` seconds.

    `gyro_bias` (3,) rad/s and `accel_bias` (3,) m/s^2 at the start, both in the IMU's frame; `gravity` (3,) the
    acceleration of free fall in the target frame, m/s^2; `t0_ns` the IMU-clock time at which the motion's own time is
    zero. All noise follows from `seed`.
    """

    cameras: tuple[SimulatedCamera, ...]
    imu_noise: ImuNoise
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    gravity: np.ndarray
    target: Target
    motion: Motion
    duration_s: float
    seed: int = 0
    t0_ns: int = 1_600_000_000_000_000_000
    imaging: Imaging = Imaging()

    def __post_init__(self) -> None:
        if not self.duration_s > 0:
            raise CalibrationError(f"simulated rig: duration_s is {self.duration_s}; it must be positive.")
        if self.imu_noise.update_rate is None:
            raise CalibrationError("simulated rig: imu_noise needs an update_rate in Hz; none was given.")
        names = [camera.name for camera in self.cameras]
        if len(set(names)) != len(names):
            raise CalibrationError(f"simulated rig: camera names {names} must differ from each other.")

    def generator(self, *purpose: int) -> np.random.Generator:
        """A random generator for one purpose, independent of all others."""
        return np.random.default_rng([self.seed, *purpose])

    def frame_times_ns(self, camera: SimulatedCamera) -> np.ndarray:
        """Frame times (F,) int64 ns on the camera's own clock, those that fall within the rig's duration."""
        count = int(np.floor((self.duration_s - camera.phase_s) * camera.rate_hz)) + 2
        own = np.round((camera.phase_s + np.arange(count) / camera.rate_hz) * 1e9).astype(np.int64)
        motion_time = own * 1e-9 + camera.timeshift_cam_imu
        return self.t0_ns + own[(motion_time >= 0.0) & (motion_time <= self.duration_s)]

    def motion_time(self, camera: SimulatedCamera, times_ns: np.ndarray) -> np.ndarray:
        """Seconds of the motion's time (IMU clock, since `t0_ns`) at camera-clock times (F,) ns."""
        return (times_ns - self.t0_ns) * 1e-9 + camera.timeshift_cam_imu

    def camera_time_ns(self, camera: SimulatedCamera, motion_time_s: np.ndarray) -> np.ndarray:
        """Camera-clock times (F,) int64 ns at seconds of the motion's time: the inverse of `motion_time`."""
        return self.t0_ns + np.round((motion_time_s - camera.timeshift_cam_imu) * 1e9).astype(np.int64)

    def ground_truth(self) -> dict[str, Any]:
        """Everything a calibration estimates, as plain values ready for yaml."""
        truth: dict[str, Any] = {
            "seed": self.seed,
            "t0_ns": self.t0_ns,
            "duration_s": float(self.duration_s),
            "conventions": "T_a_b maps b to a; world = target; t_imu = t_cam + timeshift_cam_imu; "
            "pixel centres at integers",
            "gravity_in_target": _plain(self.gravity),
        }
        for camera in self.cameras:
            projection, _, distortion = model_name(camera.model).partition("-")
            truth[camera.name] = {
                "kind": camera.kind,
                "camera_model": projection,
                "intrinsics": _plain(camera.model.intrinsics),
                "distortion_model": distortion,
                "distortion_coeffs": _plain(camera.model.distortion),
                "resolution": list(camera.image_size),
                "T_cam_imu": _plain(camera.T_cam_imu),
                "timeshift_cam_imu": float(camera.timeshift_cam_imu),
            }
        noise = self.imu_noise
        truth["imu0"] = {
            "update_rate": noise.update_rate,
            "accelerometer_noise_density": noise.accel_noise_density,
            "accelerometer_random_walk": noise.accel_random_walk,
            "gyroscope_noise_density": noise.gyro_noise_density,
            "gyroscope_random_walk": noise.gyro_random_walk,
            "gyro_bias0": _plain(self.gyro_bias),
            "accel_bias0": _plain(self.accel_bias),
            "model": "calibrated",
        }
        return truth


def _plain(values: Any) -> Any:
    return np.asarray(values, dtype=np.float64).tolist()


def _transform(rotation_vector: Any, translation: Any) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = np.asarray(jaxlie.SO3.exp(jnp.asarray(rotation_vector, dtype=jnp.float64)).as_matrix())
    T[:3, 3] = translation
    return T


# One row per camera of the built-in rig: kind, x in the body (m), small rotation (rad), small shift in y and z (m),
# fx, fy, cx, cy, radtan k1, k2, p1, p2, time offset (s).
_PAPER_CAMERAS: tuple[tuple[CameraKind, float, *tuple[Any, ...]], ...] = (
    ("events", -0.350, (0.021, -0.012, 0.015), (0.006, -0.004),
     (432.7, 433.9, 323.8, 236.1), (-0.312, 0.101, 0.0007, -0.0005), 0.0042),
    ("frames", -0.255, (-0.017, 0.009, -0.024), (-0.003, 0.007),
     (441.3, 440.2, 315.6, 243.9), (-0.287, 0.083, -0.0004, 0.0003), -0.0031),
    ("frames", 0.255, (0.013, 0.016, 0.019), (0.004, 0.003),
     (438.9, 439.6, 325.1, 240.7), (-0.293, 0.088, 0.0003, 0.0006), 0.0057),
    ("events", 0.350, (-0.009, -0.019, -0.028), (-0.005, -0.006),
     (429.5, 428.1, 317.2, 233.4), (-0.305, 0.096, -0.0006, -0.0004), -0.0018),
)  # fmt: skip

_PAPER_DISTANCE_M = 1.1

# Axes of the IMU (x forward, y left, z up) in the body's (x right, y down, z forward).
_R_BODY_IMU0 = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def paper_rig(duration_s: float = 8.0, seed: int = 0, target: Target | None = None) -> SimulatedRig:
    """The hybrid rig: two 640x480 event cameras outside, two frame cameras 0.51 m apart between them, one IMU.

    All cameras stand in one row, lightly toed in towards the board about 1.1 m ahead. `seed` varies the noise and the
    phases of the motion; the rig's geometry is the same for all seeds. `target` is a checkerboard of 6 x 9 inner
    corners, 100 mm apart, unless given; another one should be of about that size (0.8 x 0.5 m).
    """
    target = target or Checkerboard(rows=6, cols=9, spacing=0.1)
    T_body_imu = _transform([0.03, -0.02, 0.05], [0.018, -0.032, -0.041])
    T_body_imu[:3, :3] = T_body_imu[:3, :3] @ _R_BODY_IMU0
    cameras = []
    for index, (kind, x, rotation, (dy, dz), intrinsics, distortion, shift) in enumerate(_PAPER_CAMERAS):
        toe_in = 0.85 * np.arctan2(-x, _PAPER_DISTANCE_M)
        T_body_cam = _transform([0.0, toe_in, 0.0], [x, dy, dz]) @ _transform(rotation, [0.0, 0.0, 0.0])
        cameras.append(
            SimulatedCamera(
                name=f"cam{index}",
                kind=kind,
                model=PinholeRadtan.create(intrinsics, distortion),
                image_size=(640, 480),
                T_cam_imu=np.linalg.inv(T_body_cam) @ T_body_imu,
                timeshift_cam_imu=shift,
                rate_hz=20.0,
                phase_s=0.011 + 0.003 * index,
            )
        )
    down = np.array([0.0161, -1.0, -0.0224])
    return SimulatedRig(
        cameras=tuple(cameras),
        imu_noise=ImuNoise(
            gyro_noise_density=1.7e-4,
            gyro_random_walk=2.0e-5,
            accel_noise_density=2.0e-3,
            accel_random_walk=3.0e-3,
            update_rate=200.0,
        ),
        gyro_bias=np.array([0.012, -0.021, 0.007]),
        accel_bias=np.array([0.08, -0.05, 0.12]),
        gravity=STANDARD_GRAVITY * down / np.linalg.norm(down),
        target=target,
        motion=swinging_motion(target, _PAPER_DISTANCE_M, T_body_imu, seed),
        duration_s=duration_s,
        seed=seed,
    )


# Amplitude and frequency (Hz) of the sinusoids of each channel: pivot x, y, z (m), rotation x, y, z (rad).
_SWING = (
    ((0.180, 0.29), (0.050, 0.73), (0.014, 1.57)),
    ((0.125, 0.35), (0.040, 0.83), (0.012, 1.71)),
    ((0.110, 0.29), (0.045, 0.67), (0.013, 1.49)),
    ((0.380, 0.27), (0.120, 0.61), (0.035, 1.43)),
    ((0.360, 0.23), (0.120, 0.57), (0.035, 1.37)),
    ((0.420, 0.33), (0.150, 0.71), (0.045, 1.63)),
)


def swinging_motion(target: Target, distance_m: float, T_body_imu: np.ndarray, seed: int = 0) -> Motion:
    """A hand-held sweep around a target: tilts beyond 30 degrees, rolls and translations, all axes at several speeds.

    `distance_m` from the rig's body origin to the board's centre; the phases of the sinusoids follow from `seed`.
    """
    swing = np.array(_SWING)
    centre = 0.5 * (target.points.min(axis=0) + target.points.max(axis=0))
    phase = np.random.default_rng([seed, 1]).uniform(0.0, 2.0 * np.pi, swing.shape[:2])
    return Motion(
        amplitude=jnp.asarray(swing[..., 0]),
        frequency_hz=jnp.asarray(swing[..., 1]),
        phase=jnp.asarray(phase),
        R_target_body0=jnp.diag(jnp.array([1.0, -1.0, -1.0])),
        pivot_target0=jnp.asarray(centre),
        pivot_body=jnp.array([0.0, 0.0, distance_m]),
        T_body_imu=jnp.asarray(T_body_imu),
    )
