"""Measurements without images: projected corners with pixel noise, and IMU samples with noise and biases."""

import functools
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.imu import imu_model, respond
from jaxcal.observations import Detections, ImuRecording
from jaxcal.programs import stored_jit
from jaxcal.simulation.motion import angular_accelerations, poses_at, rates
from jaxcal.simulation.rig import SimulatedCamera, SimulatedRig
from jaxcal.targets import AprilGrid, Charuco

# Purposes of the rig's random generators.
_IMU, _DETECTIONS = 11, 12


def T_cam_target(rig: SimulatedRig, camera: SimulatedCamera, motion_time_s: np.ndarray) -> np.ndarray:
    """Poses (F, 4, 4) of the target in the camera's frame at motion times (F,), seconds on the IMU's clock."""
    return camera.T_cam_imu @ np.linalg.inv(poses_at(rig.motion, motion_time_s))


@stored_jit
def project_points(
    model: CameraModel, T: Float[Array, "f 4 4"], points: Float[Array, "n 3"]
) -> tuple[Float[Array, "f n 2"], Bool[Array, "f n"]]:
    """Pixels (F, N, 2) of target points (N, 3) seen from poses T_cam_target (F, 4, 4), and whether they are real.

    A projection is real when the point lies in the model's domain, on a branch of the lens that unprojection leads
    back to (a strongly distorted polynomial folds over outside the field of view), and the board's front is seen.
    """
    in_camera = jnp.einsum("fij,nj->fni", T[:, :3, :3], points) + T[:, None, :3, 3]
    pixels = model.project(in_camera)
    back = model.unproject(pixels)
    same_ray = jnp.sum(back * in_camera, axis=-1) > (1.0 - 1e-9) * jnp.linalg.norm(in_camera, axis=-1)
    valid = jax.vmap(jax.vmap(model.is_valid))(in_camera)
    camera_height = -jnp.einsum("fi,fi->f", T[:, :3, 2], T[:, :3, 3])
    return pixels, valid & same_ray & (camera_height > 0)[:, None]


def simulate_detections(
    rig: SimulatedRig,
    index: int,
    noise_px: float = 0.1,
    outlier_fraction: float = 0.0,
    outlier_px: float = 10.0,
    border_px: float = 3.0,
    line_delay_s: float = 0.0,
) -> Detections:
    """Corners that a perfect detector with Gaussian noise would give for camera `index` of the rig.

    `noise_px` is the standard deviation of each coordinate. Corners closer than `border_px` to the image's edge, or
    not seen at all, are dropped: for a checkerboard or circle grid the whole frame, for an AprilGrid the tag. A
    fraction `outlier_fraction` of the corners is displaced by Gaussian noise of `outlier_px` per coordinate. With
    `line_delay_s` the shutter rolls: row v is seen that many seconds times v after the frame's time.
    """
    camera = rig.cameras[index]
    times_ns = rig.frame_times_ns(camera)
    T = T_cam_target(rig, camera, rig.motion_time(camera, times_ns))
    projected, real = project_points(camera.model, jnp.asarray(T), jnp.asarray(rig.target.points))
    pixels, seen = np.asarray(projected), np.asarray(real)
    if line_delay_s:
        pixels = _rolled(rig, camera, rig.motion_time(camera, times_ns), pixels, line_delay_s)
    limit = np.array(camera.image_size) - 1.0 - border_px
    seen = seen & np.all((pixels >= border_px) & (pixels <= limit), axis=-1)
    seen = _whole_features(rig, seen)

    frame, point = np.nonzero(seen)
    noise = rig.generator(_DETECTIONS, index)
    measured = pixels[frame, point] + noise_px * noise.standard_normal((len(frame), 2))
    outlier = noise.random(len(frame)) < outlier_fraction
    measured = measured + outlier[:, None] * outlier_px * noise.standard_normal((len(frame), 2))
    return Detections(times_ns, frame, point, measured, camera.image_size)


def _rolled(
    rig: SimulatedRig, camera: SimulatedCamera, time_s: np.ndarray, pixels: np.ndarray, line_delay_s: float
) -> np.ndarray:
    """Pixels (F, N, 2) of points each seen when its own row is: the row settles in a few rounds."""
    frames, count = pixels.shape[:2]
    points = np.concatenate([rig.target.points, np.ones((count, 1))], axis=1)
    for _ in range(4):
        rows = np.clip(np.nan_to_num(pixels[..., 1]), 0.0, camera.image_size[1] - 1.0)
        T = T_cam_target(rig, camera, (time_s[:, None] + line_delay_s * rows).ravel()).reshape(frames, count, 4, 4)
        pixels = np.asarray(camera.model.project(np.einsum("fnij,nj->fni", T, points)[..., :3]))
    return pixels


def _whole_features(rig: SimulatedRig, seen: np.ndarray) -> np.ndarray:
    """Keep of `seen` (F, N) what a detector could find: whole tags, single ChArUco corners, else whole boards."""
    if isinstance(rig.target, Charuco):
        return seen
    if not isinstance(rig.target, AprilGrid):
        return seen & seen.all(axis=1, keepdims=True)
    whole = np.zeros_like(seen)
    for tag in rig.target.ids:
        corners = rig.target.tag_points(tag)
        whole[:, corners] = seen[:, corners].all(axis=1, keepdims=True)
    return whole


@dataclass(frozen=True)
class ImuTruth:
    """An IMU that is not simply `calibrated` at the rig's origin: its `model` with `parameters` (m,) (nominal ones by
    default), its place T_imu_imu0 (4, 4) and clock (s, t_imu0 = t_imu + shift). `number` picks its noise."""

    model: str = "calibrated"
    parameters: np.ndarray | None = None
    T_imu_imu0: np.ndarray = field(default_factory=lambda: np.eye(4))
    timeshift_imu_imu0: float = 0.0
    number: int = 0


def simulate_imu(rig: SimulatedRig, noisy: bool = True, truth: ImuTruth | None = None) -> ImuRecording:
    """IMU samples over the rig's duration, timestamps on the IMU's clock.

    gyro = omega + b_g + n_g,  accel = R_imu_target (a - g) + b_a + n_a, or what `truth` says of another IMU, with white
    noise of standard deviation density * sqrt(rate) per sample and biases that walk by random_walk / sqrt(rate) per
    sample (the usual discretisation of the continuous-time densities, e.g. Kalibr's "IMU Noise Model"). With `noisy`
    False only the constant initial biases are added.
    """
    truth = truth or ImuTruth()
    rate = rig.imu_noise.update_rate
    if rate is None:
        raise CalibrationError("simulate_imu: the rig's imu_noise has no update_rate.")
    count = int(np.floor(rig.duration_s * rate)) + 1
    own_ns = np.round(np.arange(count) * 1e9 / rate).astype(np.int64)
    at = own_ns * 1e-9 + truth.timeshift_imu_imu0
    times = jnp.asarray(at)
    R_imu_target = np.swapaxes(poses_at(rig.motion, at)[:, :3, :3], 1, 2)
    omega, acceleration = (np.asarray(values) for values in rates(rig.motion, times))
    force = np.einsum("nij,nj->ni", R_imu_target, acceleration - rig.gravity)
    readings = _responses(truth, omega, np.asarray(angular_accelerations(rig.motion, times)), force)

    gyro_bias, gyro_noise, accel_bias, accel_noise = _imu_errors(rig, count, rate, noisy, truth.number)
    return ImuRecording(
        timestamps_ns=rig.t0_ns + own_ns,
        gyro_rad_s=readings[:, :3] + gyro_bias + gyro_noise,
        accel_m_s2=readings[:, 3:] + accel_bias + accel_noise,
        noise=rig.imu_noise,
    )


def _responses(truth: ImuTruth, omega: np.ndarray, alpha: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Readings (n, 6) without biases or noise, from the motion of the rig's origin (n, 3) each."""
    model = imu_model(truth.model)
    parameters = jnp.asarray(model.nominal if truth.parameters is None else truth.parameters, dtype=float)
    R, t = jnp.asarray(truth.T_imu_imu0[:3, :3]), jnp.asarray(truth.T_imu_imu0[:3, 3])
    one = functools.partial(respond, model, parameters, R, t)
    return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(omega), jnp.asarray(alpha), jnp.asarray(force)))


def _imu_errors(rig: SimulatedRig, count: int, rate: float, noisy: bool, number: int) -> tuple[np.ndarray, ...]:
    """Gyro bias, gyro noise, accelerometer bias and accelerometer noise, each (count, 3) or broadcastable to it."""
    generator = rig.generator(_IMU) if number == 0 else rig.generator(_IMU, number)
    errors: list[np.ndarray] = []
    noise = rig.imu_noise
    for initial, density, walk in (
        (rig.gyro_bias, noise.gyro_noise_density, noise.gyro_random_walk),
        (rig.accel_bias, noise.accel_noise_density, noise.accel_random_walk),
    ):
        white = density * np.sqrt(rate) * generator.standard_normal((count, 3))
        steps = walk / np.sqrt(rate) * generator.standard_normal((count, 3))
        steps[0] = 0.0
        drift = np.cumsum(steps, axis=0)
        errors += [initial + noisy * drift, noisy * white]
    return tuple(errors)
