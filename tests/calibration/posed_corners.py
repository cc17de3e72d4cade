"""Corners of a board in random poses before cameras of known lenses and places, made with numpy alone."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal import Calibration, Checkerboard, Detections
from jaxcal.cameras import CameraModel, PinholeRadtan
from jaxcal.targets import Target

SIZE = (752, 480)
FACING = np.diag([1.0, -1.0, -1.0])
BOARD = Checkerboard(rows=7, cols=8, spacing=0.05)
LENS = PinholeRadtan.create([458.0, 457.0, 367.0, 248.0], [-0.28, 0.074, 0.0002, 0.00002])


@dataclass(frozen=True)
class Rig:
    """Lenses and T_cam_cam0 (C, 4, 4)."""

    lenses: tuple[CameraModel, ...]
    T_cam_rig: np.ndarray


def matrix(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    out = np.zeros((*np.shape(translation)[:-1], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, translation, 1.0
    return out


def side_by_side(cameras: int, lens: CameraModel = LENS, spacing_m: float = 0.06, turn_rad: float = 0.02) -> Rig:
    """Cameras along a line, each turned a little from the one before."""
    turns = Rotation.from_rotvec(np.arange(cameras)[:, None] * [0.0, turn_rad, 0.3 * turn_rad]).as_matrix()
    places = -np.arange(cameras)[:, None] * np.array([spacing_m, 0.2 * spacing_m, 0.0])
    return Rig((lens,) * cameras, matrix(turns, places))


def board_poses(
    rng: np.random.Generator,
    count: int,
    board: Target,
    tilt_rad: float = 0.5,
    distance_m: tuple[float, float] = (0.5, 1.0),
) -> np.ndarray:
    """T_cam0_target (count, 4, 4) of a board, tilted about random axes and turned in its plane, all over the image."""
    axis = rng.uniform(0.0, 2 * np.pi, count)
    tilt = tilt_rad * np.sqrt(rng.uniform(0.0, 1.0, count))
    tilts = Rotation.from_rotvec(np.stack([tilt * np.cos(axis), tilt * np.sin(axis), 0 * tilt], axis=1))
    spins = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (count, 1)) * [0.0, 0.0, 1.0])
    rotations = (tilts * spins).as_matrix() @ FACING
    distance = rng.uniform(*distance_m, count)
    place = np.stack([rng.uniform(-0.4, 0.4, count), rng.uniform(-0.25, 0.25, count), np.ones(count)], axis=1)
    middle = board.points.mean(axis=0)
    return matrix(rotations, distance[:, None] * place - rotations @ middle)


def seen(
    lens: CameraModel,
    T_cam_target: np.ndarray,
    points: np.ndarray,
    noise: np.ndarray | float,
    rng: np.random.Generator,
    *,
    times_ns: np.ndarray | None = None,
    size: tuple[int, int] = SIZE,
) -> Detections:
    """Detections of points (N, 3) or (F, N, 3) in poses (F, 4, 4), with Gaussian noise (px, may be (F, N, 1))."""
    at = np.einsum("fij,...nj->fni", T_cam_target[:, :3, :3], points) if points.ndim == 2 else None
    if at is None:
        at = np.einsum("fij,fnj->fni", T_cam_target[:, :3, :3], points)
    at = at + T_cam_target[:, None, :3, 3]
    pixels = np.asarray(lens.project(at)) + noise * rng.standard_normal((*at.shape[:2], 2))
    inside = np.all((pixels > 0) & (pixels < np.array(size) - 1), axis=-1) & (at[..., 2] > 0.05)
    frame, point = np.nonzero(inside)
    times = np.arange(len(at)) * 100_000_000 if times_ns is None else times_ns
    return Detections(times, frame, point, pixels[frame, point], size)


def lens_errors_in_sigmas(calibration: Calibration, lenses: Sequence[CameraModel]) -> np.ndarray:
    """Every lens parameter of every camera, less the truth, over its sigma."""
    errors = []
    for camera, lens in zip(calibration.cameras, lenses, strict=True):
        sigma = np.concatenate([calibration.std(f"{camera.name}.{part}") for part in ("intrinsics", "distortion")])
        errors.append((np.asarray(camera.model.parameters) - np.asarray(lens.parameters)) / sigma)
    return np.concatenate(errors)


def pose_errors_in_sigmas(estimate: np.ndarray, truth: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Rotation on the left and translation (6,) between two transforms (4, 4), over their sigmas."""
    turn = Rotation.from_matrix(estimate[:3, :3] @ truth[:3, :3].T).as_rotvec()
    return np.concatenate([turn, estimate[:3, 3] - truth[:3, 3]]) / sigma
