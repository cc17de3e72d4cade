"""Recordings that leave something open, simulated: views of a board in chosen tilts, distances and places."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal import CameraModel, Checkerboard, Detections
from jaxcal.cameras import PinholeRadtan

BOARD = Checkerboard(rows=6, cols=9, spacing=0.04)
SIZE = (640, 480)
LENS = PinholeRadtan.create([440.0, 441.0, 316.0, 243.0], [-0.28, 0.08, -0.0004, 0.0003])
VIEWS = 32


def views_of_board(
    count: int = VIEWS,
    *,
    largest_tilt_deg: float = 40.0,
    distances_m: tuple[float, float] = (0.45, 0.8),
    region: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0),
    roll_deg: float = 90.0,
    points: np.ndarray | None = None,
    noise_px: float = 0.1,
    lens: CameraModel = LENS,
    seed: int = 0,
) -> Detections:
    """Corners of `count` views, the board facing the image plane up to a tilt, all of it in the image.

    `region` (left, top, right, bottom), in shares of the image, is where all corners lie; `points` the points of the
    board that are found (default all).
    """
    rng = np.random.default_rng(seed)
    scale = np.array(SIZE) - 1.0
    low, high = np.array(region[:2]) * scale, np.array(region[2:]) * scale
    centred = BOARD.points - BOARD.points.mean(axis=0)
    kept: list[np.ndarray] = []
    for _ in range(20_000):
        if len(kept) == count:
            break
        turn = _random_turn(rng, largest_tilt_deg, roll_deg)
        distance = rng.uniform(*distances_m)
        middle = rng.uniform(low, high)
        sight = np.asarray(lens.unproject(jnp.asarray(middle)))
        seen = centred @ turn.T + sight * (distance / sight[2])
        pixels = np.asarray(lens.project(jnp.asarray(seen)))
        if np.all((pixels > low + 2.0) & (pixels < high - 2.0)):
            kept.append(pixels)
    assert len(kept) == count, "the board does not fit the region"
    found = np.arange(len(BOARD.points)) if points is None else points
    pixels = np.stack(kept)[:, found] + noise_px * rng.standard_normal((count, len(found), 2))
    return Detections(
        100_000_000 * np.arange(count),
        np.repeat(np.arange(count), len(found)),
        np.tile(found, count),
        pixels.reshape(-1, 2),
        SIZE,
    )


def _random_turn(rng: np.random.Generator, tilt_deg: float, roll_deg: float) -> np.ndarray:
    """R_cam_target of a board tilted by up to `tilt_deg` about an axis in its plane, and rolled."""
    way = rng.uniform(0.0, 2.0 * np.pi)
    tilt = np.deg2rad(rng.uniform(0.0, tilt_deg)) * np.array([np.cos(way), np.sin(way), 0.0])
    roll = np.deg2rad(rng.uniform(-roll_deg, roll_deg)) * np.array([0.0, 0.0, 1.0])
    return Rotation.from_rotvec(tilt).as_matrix() @ Rotation.from_rotvec(roll).as_matrix() @ np.diag([1.0, -1.0, -1.0])
