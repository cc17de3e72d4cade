"""Systematic residuals of single target points: a board that is not what target.yaml says, or a biased detector."""

from dataclasses import dataclass

import numpy as np

from jaxcal.results.calibration import CameraCalibration
from jaxcal.targets import Target

_FEWEST_IN_FRAME = 6  # for the affine map of a frame
_FEWEST_FOR_MEAN = 5


@dataclass(frozen=True)
class TargetBias:
    """Mean residuals of the target points that were seen often enough.

    `point` (K,) indices into the target's points; `mean_px` (K, 2) mean residual, turned into the directions of the
    target's x and y, in pixels; `rms_px` the root mean square 2-D size of the means, less what the noise of the
    means explains (NaN where no point qualifies).
    """

    point: np.ndarray
    mean_px: np.ndarray
    rms_px: float


def target_bias(camera: CameraCalibration, target: Target) -> TargetBias:
    """Average each target point's residuals over all frames, in the target's own directions.

    Each frame's residuals are turned by its affine map from the target's plane to pixels, so that frames of any roll
    and slant can be averaged; the perspective within a frame is left out.
    """
    count = len(target.points)
    turned, point = _turned_residuals(camera, target.points[:, :2])
    counts = np.bincount(point, minlength=count)
    total = np.stack([np.bincount(point, weights=turned[:, k], minlength=count) for k in range(2)], axis=1)
    square = np.bincount(point, weights=np.sum(turned**2, axis=1), minlength=count)
    shown = np.flatnonzero(counts >= _FEWEST_FOR_MEAN)
    mean = total[shown] / counts[shown, None]
    scatter = square[shown] / counts[shown] - np.sum(mean**2, axis=1)
    noise = scatter / (counts[shown] - 1)
    rms = float(np.sqrt(max(np.mean(np.sum(mean**2, axis=1) - noise), 0.0))) if len(shown) else float("nan")
    return TargetBias(shown, mean, rms)


def _turned_residuals(camera: CameraCalibration, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (M, 2) in the target's directions, px, and the point (M,) of each, for frames that allow it."""
    used = camera.used
    frame, point = camera.detections.frame[used], camera.detections.point[used]
    pixels, residuals = camera.detections.pixels[used], camera.residuals_px[used]
    turned, points = [np.zeros((0, 2))], [np.zeros(0, dtype=np.int64)]
    starts = np.flatnonzero(np.diff(frame, prepend=-1))  # detections are in order of frames
    stops = np.append(starts, len(frame))[1:]
    for start, stop in zip(starts, stops, strict=True):
        rows = slice(start, stop)
        ground = plane[point[rows]] - plane[point[rows]].mean(axis=0)
        if stop - start < _FEWEST_IN_FRAME or np.linalg.matrix_rank(ground, tol=1e-9) < 2:
            continue
        affine = np.linalg.lstsq(ground, pixels[rows] - pixels[rows].mean(axis=0), rcond=None)[0].T
        size = np.sqrt(abs(np.linalg.det(affine)))
        if not size > 1e-9:
            continue
        turned.append(size * np.linalg.solve(affine, residuals[rows].T).T)
        points.append(point[rows])
    return np.concatenate(turned), np.concatenate(points)
