"""Simulated recordings of one or two cameras with one error of the model each, and with none."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxcal import Detections
from jaxcal.cameras import CameraModel, PinholeEquidistant, PinholeRadtan
from jaxcal.simulation import SimulatedRig, paper_rig, simulate_detections
from jaxcal.simulation.measurements import T_cam_target, project_points

NOISE_PX = 0.1
VIEWS = 64
# What a radtan lens does not follow.
RICH_LENS = PinholeEquidistant.create([280.0, 281.0, 322.0, 237.0], [0.06, -0.012, 0.006, -0.002])


def rig_for(seed: int, cameras: int = 1, rate_hz: float = 8.0) -> SimulatedRig:
    """Frame cameras of the built-in rig on one clock."""
    rig = paper_rig(duration_s=24.0, seed=seed)
    chosen = tuple(
        dataclasses.replace(rig.cameras[1 + c], name=f"cam{c}", rate_hz=rate_hz, timeshift_cam_imu=0.0, phase_s=0.0)
        for c in range(cameras)
    )
    return dataclasses.replace(rig, cameras=chosen)


def corners(
    rig: SimulatedRig,
    *,
    lens: CameraModel | None = None,
    line_delay_s: float = 0.0,
    bend_m: float = 0.0,
    late_lens: CameraModel | None = None,
    late_shift_m: float = 0.0,
    noise_px: float = NOISE_PX,
) -> list[Detections]:
    """Corners in the first VIEWS frames in which all cameras see the board.

    `lens` in place of each camera's own; `late_lens` that of the first camera in the second half of the views;
    `late_shift_m` by which the last camera is moved along x then; `bend_m` the board's height in its middle.
    """
    if lens is not None:
        moved = tuple(dataclasses.replace(camera, model=lens) for camera in rig.cameras)
        rig = dataclasses.replace(rig, cameras=moved)
    seen = [simulate_detections(rig, c, noise_px, line_delay_s=line_delay_s) for c in range(len(rig.cameras))]
    common = seen[0].seen_frames
    for detections in seen[1:]:
        common = np.intersect1d(common, detections.seen_frames)
    common = common[:VIEWS]
    rng = np.random.default_rng([rig.seed, 77])
    return [
        _of_camera(rig, c, detections, common, bend_m, late_lens if c == 0 else None, late_shift_m * c, noise_px, rng)
        for c, detections in enumerate(seen)
    ]


def _of_camera(
    rig: SimulatedRig,
    c: int,
    detections: Detections,
    frames: np.ndarray,
    bend_m: float,
    late_lens: CameraModel | None,
    shift_m: float,
    noise_px: float,
    rng: np.random.Generator,
) -> Detections:
    rows = np.isin(detections.frame, frames)
    frame, point = detections.frame[rows], detections.point[rows]
    pixels = detections.pixels[rows]
    if bend_m or late_lens is not None or shift_m:
        camera, points = rig.cameras[c], rig.target.points.copy()
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        across = (2.0 * points[:, :2] - low - high) / (high - low)
        points[:, 2] += bend_m * (1.0 - across[:, 0] ** 2)
        T = T_cam_target(rig, camera, rig.motion_time(camera, detections.timestamps_ns[frames]))
        late = np.arange(len(frames)) >= len(frames) // 2
        T[late, 0, 3] += shift_m
        own = np.array(project_points(camera.model, jnp.asarray(T), jnp.asarray(points))[0])
        if late_lens is not None:
            own[late] = np.asarray(project_points(late_lens, jnp.asarray(T[late]), jnp.asarray(points))[0])
        pixels = own[np.searchsorted(frames, frame), point]
        pixels = pixels + noise_px * rng.standard_normal(pixels.shape)
    return Detections(detections.timestamps_ns, frame, point, pixels, detections.image_size)


def refocused(lens: PinholeRadtan, share: float) -> PinholeRadtan:
    """The lens with its focal lengths changed by a share."""
    return PinholeRadtan.create(np.asarray(lens.intrinsics) * [1 + share, 1 + share, 1, 1], np.asarray(lens.distortion))
