"""The calibration that the tests of studies repeat: two cameras, 32 views, made without images."""

from typing import Any

import numpy as np

from jaxcal import Calibration, Checkerboard, Detections, calibrate_cameras
from jaxcal.cameras import PinholeRadtan

EXAMPLE: dict[str, Any] = {"kind": "bootstrap", "calibration": "base", "runs": 3}
BOARD = Checkerboard(rows=7, cols=8, spacing=0.05)
LENS = PinholeRadtan.create([458.0, 457.0, 367.0, 248.0], [-0.28, 0.074, 0.0002, 0.00002])
SIZE = (752, 480)


def base_calibration(seed: int = 0, views: int = 32, noise_px: float = 0.15) -> Calibration:
    """Calibrate a simulated stereo rig."""
    return calibrate_cameras(stereo_corners(seed, views, noise_px), BOARD, names=["left", "right"])


def stereo_corners(seed: int, views: int, noise_px: float) -> list[Detections]:
    """Corners of boards in random poses, seen by two cameras side by side."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(0.3 * rng.standard_normal((views, 3))).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    depth = rng.uniform(0.6, 1.0, (views, 1))
    place = np.concatenate([rng.uniform(-0.3, 0.3, (views, 1)), rng.uniform(-0.2, 0.2, (views, 1)), depth**0], axis=1)
    shift = depth * place - turn @ BOARD.points.mean(axis=0)
    times = np.arange(views) * 500_000_000
    found = []
    for baseline in (0.0, 0.06):
        points = np.einsum("fij,nj->fni", turn, BOARD.points) + shift[:, None] - [baseline, 0.0, 0.0]
        pixels = np.asarray(LENS.project(points)) + noise_px * rng.standard_normal((views, len(BOARD.points), 2))
        inside = np.all((pixels > 2) & (pixels < np.array(SIZE) - 3), axis=-1)
        frame, point = np.nonzero(inside & (inside.mean(axis=1, keepdims=True) > 0.4))
        found.append(Detections(times, frame, point, pixels[frame, point], SIZE))
    return found
