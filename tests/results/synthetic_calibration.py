"""Calibrations made up from a seed: real projections with noise, a smooth motion and a plausible covariance."""

import cv2
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.cameras import PinholeRadtan
from jaxcal.observations import Detections, Frames
from jaxcal.results import Calibration, CameraCalibration, ImuCalibration, compare
from jaxcal.results.cross_validation import CrossValidation, Evidence, Halves
from jaxcal.targets import AprilGrid, Checkerboard, Target

SIGMAS = {
    "intrinsics": np.array([0.21, 0.20, 0.17, 0.18]),
    "distortion": np.array([9e-4, 1.8e-3, 1.1e-4, 1.2e-4]),
    "T_cn_cnm1": np.array([2e-4, 2e-4, 1e-4, 4e-5, 4e-5, 9e-5]),
    "T_cam_imu": np.array([1.5e-4, 1.4e-4, 1.1e-4, 4e-4, 4e-4, 6e-4]),
    "timeshift_cam_imu": np.array([8e-6]),
    "gravity": np.array([2e-3, 1e-4, 2e-3]),
}
IMAGE_SIZE = (640, 480)
ORIGIN_NS = 1_600_000_000_000_000_000
GYRO_SIGMA, ACCEL_SIGMA = 2.4e-3, 2.83e-2


def make_calibration(
    cameras: int = 2,
    with_imu: bool = True,
    seed: int = 0,
    frames: int = 60,
    noise_px: float = 0.12,
    unused: float = 0.02,
    rejected: float = 0.01,
    target: Target | None = None,
    duration_s: float = 12.0,
) -> Calibration:
    """A calibration as a good recording would give it.

    A fraction `unused` of the corners has NaN residuals, a fraction `rejected` is marked as outliers.
    """
    random = np.random.default_rng(seed)
    target = target or Checkerboard(rows=6, cols=9, spacing=0.06)
    times_s = (np.arange(frames) + 0.5) * duration_s / frames
    T_cam_imu = [_camera_to_imu(k, cameras, random) for k in range(cameras)]
    made = []
    for k in range(cameras):
        made.append(
            _camera(k, T_cam_imu, target, times_s, (noise_px, unused, rejected), with_imu, random),
        )
    blocks = _blocks(made, with_imu)
    return Calibration(
        cameras=tuple(made),
        target=target,
        gravity=np.array([0.158, -9.8028, -0.2196]) if with_imu else None,
        imu=_imu(duration_s, random) if with_imu else None,
        blocks=blocks,
        covariance=_covariance(blocks, random),
        convergence=np.array([9.1e5, 4.0e4, 2.2e3, 1.31e3, 1.302e3, 1.3019e3]),
        settings={"models": ["pinhole-radtan"] * cameras, "huber": 3.0, "knots_per_second": 20, "seed": seed},
        versions={"jaxcal": "0.1.0", "jax": "0.10.0"},
    )


def make_cross_validation(one: Calibration, other: Calibration) -> CrossValidation:
    """As if `one` had been split in turns without a difference, and in time into itself and `other`.

    Its evidence, a lean lens and a rolling shutter, is of the rig's first and last camera.
    """
    first, last = one.cameras[0].name, one.cameras[-1].name
    halves = (
        Halves("in turns", compare(one, one), 11.0, 10, 0.36),
        Halves("in time", compare(one, other), 60.0, 10, 3.6e-9),
    )
    evidence = (
        Evidence("lens", first, 3.0, 2, 0.22, -0.5),
        Evidence("rolling shutter", last, 99.0, 1, 2.5e-23, 90.0, step=0, value=1.2e-5),
    )
    return CrossValidation(halves, evidence, ("something was not tested",))


def make_images(calibration: Calibration) -> dict[str, Frames]:
    """Pictures in which the squares between detected corners are drawn, one per frame of each camera."""
    pictures = {}
    rows, cols = calibration.target.grid_shape
    for camera in calibration.cameras:
        width, height = camera.image_size
        images = []
        for frame in range(len(camera.detections.timestamps_ns)):
            image = np.full((height, width), 150, np.uint8)
            rows_of_frame = camera.detections.frame == frame
            found = dict(
                zip(
                    camera.detections.point[rows_of_frame].tolist(),
                    camera.detections.pixels[rows_of_frame],
                    strict=True,
                )
            )
            for i in range(rows - 1):
                for j in range(cols - 1):
                    ring = [i * cols + j, i * cols + j + 1, (i + 1) * cols + j + 1, (i + 1) * cols + j]
                    if all(point in found for point in ring):
                        polygon = np.array([found[point] for point in ring]).round().astype(np.int32)
                        cv2.fillPoly(image, [polygon], 30 if (i + j) % 2 else 230)
            images.append(image)
        pictures[camera.name] = Frames(camera.detections.timestamps_ns, images, camera.image_size)
    return pictures


def _pose_target_imu(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (N, 3, 3) and position (N, 3) of a body in front of the board, x right, y down, z forward."""
    angles = np.stack([0.5 * np.sin(1.9 * t), 0.55 * np.sin(1.4 * t + 1.0), 0.4 * np.sin(2.3 * t + 2.0)], axis=-1)
    upright = np.diag([1.0, -1.0, -1.0])
    rotation = upright @ Rotation.from_rotvec(angles).as_matrix()
    sway = [0.45 * np.sin(1.4 * t + 1.0), 0.30 * np.sin(1.9 * t), 0.15 * np.sin(0.9 * t)]
    # The sway counters the turn, so that the board stays in view.
    position = np.stack([0.24 - sway[0], 0.15 - sway[1], 0.75 + sway[2]], axis=-1)
    return rotation, position


def _camera_to_imu(index: int, count: int, random: np.random.Generator) -> np.ndarray:
    T_imu_cam = np.eye(4)
    T_imu_cam[:3, :3] = Rotation.from_rotvec(random.normal(0.0, 0.02, 3)).as_matrix()
    T_imu_cam[:3, 3] = [0.11 * (index - (count - 1) / 2.0), 0.01, 0.02]
    return np.linalg.inv(T_imu_cam)


def _camera(
    index: int,
    T_cam_imu: list[np.ndarray],
    target: Target,
    times_s: np.ndarray,
    flaws: tuple[float, float, float],
    with_imu: bool,
    random: np.random.Generator,
) -> CameraCalibration:
    noise_px, unused, rejected = flaws
    width, height = IMAGE_SIZE
    model = PinholeRadtan.create(
        [460 + random.normal(0, 5), 459 + random.normal(0, 5), 320 + random.normal(0, 4), 240 + random.normal(0, 4)],
        [-0.28, 0.07, 2e-4, -3e-4],
    )
    rotation, position = _pose_target_imu(times_s)
    T_target_imu = np.tile(np.eye(4), (len(times_s), 1, 1))
    T_target_imu[:, :3, :3], T_target_imu[:, :3, 3] = rotation, position
    T_cam_target = T_cam_imu[index] @ np.linalg.inv(T_target_imu)
    in_camera = np.einsum("fij,nj->fni", T_cam_target[:, :3, :3], target.points) + T_cam_target[:, None, :3, 3]
    exact = np.asarray(model.project(jnp.asarray(in_camera)))
    inside = (exact > 2).all(-1) & (exact < np.array([width - 3, height - 3])).all(-1) & (in_camera[..., 2] > 0.1)
    # A polynomial lens folds far outside its field of view; a detector would not see those points.
    inside &= np.hypot(in_camera[..., 0], in_camera[..., 1]) < 1.0 * in_camera[..., 2]
    frame, point = np.nonzero(inside)
    noise = random.normal(0.0, noise_px, (len(frame), 2))
    out = random.random(len(frame)) < rejected
    noise[out] += random.normal(0.0, 3.0, (int(out.sum()), 2))
    residuals = -noise
    residuals[random.random(len(frame)) < unused] = np.nan
    return CameraCalibration(
        name=f"cam{index}",
        model=model,
        image_size=IMAGE_SIZE,
        T_cn_cnm1=T_cam_imu[index] @ np.linalg.inv(T_cam_imu[index - 1]) if index else None,
        T_cam_imu=T_cam_imu[index] if with_imu else None,
        timeshift_cam_imu=0.008 - 0.003 * index if with_imu else None,
        detections=Detections(
            ORIGIN_NS + np.round(times_s * 1e9).astype(np.int64), frame, point, exact[inside] + noise, IMAGE_SIZE
        ),
        residuals_px=residuals,
        inlier=~out,
        corner_sigma_px=noise_px,
        T_cam_target=T_cam_target,
    )


def _imu(duration_s: float, random: np.random.Generator) -> ImuCalibration:
    t = np.arange(0.0, duration_s, 0.005)
    rotation, position = _pose_target_imu(t)
    turn = Rotation.from_matrix(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]).as_rotvec() / 0.005
    omega = np.vstack([turn, turn[-1:]])
    acceleration = np.gradient(np.gradient(position, t, axis=0), t, axis=0)
    force = np.einsum("nji,nj->ni", rotation, acceleration - np.array([0.158, -9.8028, -0.2196]))
    gyro_bias = np.array([0.012, -0.021, 0.007]) + np.cumsum(random.normal(0, 1e-5, (len(t), 3)), axis=0)
    accel_bias = np.array([0.08, -0.05, 0.12]) + np.cumsum(random.normal(0, 2e-4, (len(t), 3)), axis=0)
    return ImuCalibration(
        origin_ns=ORIGIN_NS,
        t_s=t,
        gyro_rad_s=omega + gyro_bias + random.normal(0, GYRO_SIGMA, (len(t), 3)),
        accel_m_s2=force + accel_bias + random.normal(0, ACCEL_SIGMA, (len(t), 3)),
        gyro_predicted=omega + gyro_bias,
        accel_predicted=force + accel_bias,
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
        gyro_sigma=GYRO_SIGMA,
        accel_sigma=ACCEL_SIGMA,
        position_m=position,
        rotation=rotation,
        noise={
            "gyroscope_noise_density": 1.6968e-4,
            "gyroscope_random_walk": 1.9393e-5,
            "accelerometer_noise_density": 2.0e-3,
            "accelerometer_random_walk": 3.0e-3,
            "update_rate": 200.0,
        },
        knot_rate_hz=20.0,
        spline_order=4,
        gyro_bias_std=np.full((len(t), 3), 4e-4),
        accel_bias_std=np.full((len(t), 3), 8e-3),
    )


def _blocks(cameras: list[CameraCalibration], with_imu: bool) -> tuple[tuple[str, int], ...]:
    blocks: list[tuple[str, int]] = []
    for camera in cameras:
        kinds = ["intrinsics", "distortion"]
        kinds += ["T_cn_cnm1"] if camera.T_cn_cnm1 is not None else []
        kinds += ["T_cam_imu", "timeshift_cam_imu"] if with_imu else []
        blocks += [(f"{camera.name}.{kind}", len(SIGMAS[kind])) for kind in kinds]
    return (*blocks, *([("gravity", 3)] if with_imu else []))


def _covariance(blocks: tuple[tuple[str, int], ...], random: np.random.Generator) -> np.ndarray:
    sigma = np.concatenate([SIGMAS[name.rpartition(".")[2]] for name, _ in blocks])
    mix = np.eye(len(sigma)) + 0.1 * random.normal(size=(len(sigma), len(sigma)))
    correlation = mix @ mix.T
    scale = sigma / np.sqrt(np.diag(correlation))
    return correlation * np.outer(scale, scale)


APRIL_GRID = AprilGrid(rows=6, cols=6, tag_size=0.07, tag_spacing=0.3)
