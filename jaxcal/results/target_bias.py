"""Systematic residuals of single target points: a board that is not what target.yaml says, or a biased detector."""

import math
from dataclasses import dataclass

import numpy as np

from jaxcal.results.calibration import CameraCalibration
from jaxcal.targets import Target

_FEWEST_IN_FRAME = 6  # for the affine map of a frame
_FEWEST_FOR_MEAN = 5
_FLATTEST = 1e-6  # points of a frame that lie on a line tell no map: their spread across it over that along it


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
    _, row, count = np.unique(frame, return_inverse=True, return_counts=True)

    def sums(values: np.ndarray) -> np.ndarray:
        """Over the corners of each frame (F, ...), of values (M, ...)."""
        flat = values.reshape(len(values), math.prod(values.shape[1:]))
        added = [np.bincount(row, weights=column, minlength=len(count)) for column in flat.T]
        return np.stack(added, axis=-1).reshape(len(count), *values.shape[1:])

    means = count[:, None]
    ground = plane[point] - (sums(plane[point]) / means)[row]
    image = pixels - (sums(pixels) / means)[row]
    # Least squares of all frames at once, by their normal equations: pixels = affine @ ground.
    normal = sums(ground[:, :, None] * ground[:, None, :])
    spread = np.linalg.eigvalsh(normal)
    sound = (count >= _FEWEST_IN_FRAME) & (spread[:, 0] > _FLATTEST**2 * spread[:, 1])
    safe = np.where(sound[:, None, None], normal, np.eye(2))
    affine = np.linalg.solve(safe, sums(ground[:, :, None] * image[:, None, :])).swapaxes(1, 2)
    size = np.sqrt(np.abs(np.linalg.det(affine)))
    sound &= size > 1e-9
    kept = sound[row]
    safe = np.where(sound[:, None, None], affine, np.eye(2))[row[kept]]
    return size[row[kept], None] * np.linalg.solve(safe, residuals[kept, :, None])[..., 0], point[kept]
