"""A first lens and first board poses from the views of one camera alone, with no guess from the user."""

import logging
from collections.abc import Sequence

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.calibration import solving
from jaxcal.calibration.assemble import CameraFrames
from jaxcal.calibration.redundancy import view_features
from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.targets import Target

logger = logging.getLogger(__name__)

# Focal lengths tried besides the homographies' own, as fractions of the image's longer side: 112 to 20 degrees of view.
_FOCAL_FRACTIONS = (0.35, 0.55, 0.8, 1.2, 1.9, 3.0)
_SWEEP_VIEWS = 24
_SWEEP_STEPS = 40


def homography_focal(frames: CameraFrames, target: Target) -> float | None:
    """Focal length (px) that best explains the views' homographies, principal point at the centre, square pixels.

    Zhang 2000, eq. 3 and 4, with the image of the absolute conic reduced to one unknown, 1/f^2. None when the views
    do not tell (all frontal).
    """
    width, height = frames.detections.image_size
    centre = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
    board = target.points[:, :2] / np.ptp(target.points[:, :2], axis=0).max()
    rows, sides = [], []
    for pixels, seen in zip(frames.pixels, frames.seen, strict=True):
        homography, _ = cv2.findHomography(board[seen], (pixels[seen] - centre) / width)
        if homography is None:
            continue
        h1, h2 = homography[:, 0] / np.linalg.norm(homography), homography[:, 1] / np.linalg.norm(homography)
        rows += [h1[0] * h2[0] + h1[1] * h2[1], (h1[0] ** 2 + h1[1] ** 2) - (h2[0] ** 2 + h2[1] ** 2)]
        sides += [-h1[2] * h2[2], h2[2] ** 2 - h1[2] ** 2]
    inverse = float(np.dot(rows, sides) / max(np.dot(rows, rows), 1e-300)) if rows else -1.0
    if inverse <= 0 or not np.isfinite(inverse):
        return None
    focal = width / np.sqrt(inverse)
    return float(focal) if 0.1 * width < focal < 20.0 * width else None


@eqx.filter_jit
def _unproject(model: CameraModel, pixels: jax.Array) -> jax.Array:
    return model.unproject(pixels)


@eqx.filter_jit
def _project(model: CameraModel, rotations: jax.Array, translations: jax.Array, points: jax.Array) -> jax.Array:
    return model.project(jnp.einsum("fij,nj->fni", rotations, points) + translations[:, None])


def board_poses(model: CameraModel, frames: CameraFrames, target: Target) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_cam_target of every frame by planar pose estimation (IPPE, Collins & Bartoli 2014).

    Returns rotations (F, 3, 3), translations (F, 3) and the root mean square error (F,), px, of each. Of IPPE's two
    solutions the one with the smaller reprojection error through the whole lens is taken.
    """
    points = target.points
    padded = -(-len(frames.frames) // 64) * 64 - len(frames.frames)  # few shapes to compile
    pixels = np.pad(frames.pixels, [(0, padded), (0, 0), (0, 0)])
    rays = np.asarray(_unproject(model, jnp.asarray(pixels)))[: len(frames.frames)]
    candidates = np.tile(np.eye(4)[:3], (2, len(pixels), 1, 1))
    for f, seen in enumerate(frames.seen):
        ahead = seen & (rays[f, :, 2] > 0.05)
        if ahead.sum() < 4:
            ahead = seen
        plane = rays[f, ahead, :2] / np.maximum(rays[f, ahead, 2:], 0.05)
        solutions = _planar_poses(points[ahead], plane)
        for s in range(2):
            candidates[s, f] = solutions[min(s, len(solutions) - 1)]
    errors = np.full((2, len(frames.frames)), np.inf)
    for s in range(2):
        projected = np.asarray(
            _project(
                model, jnp.asarray(candidates[s, :, :, :3]), jnp.asarray(candidates[s, :, :, 3]), jnp.asarray(points)
            )
        )[: len(frames.frames)]
        squared = np.sum((projected - frames.pixels) ** 2, axis=-1)
        squared = np.where(np.isfinite(squared), np.minimum(squared, 1e12), 1e12)
        errors[s] = np.sqrt(np.sum(squared * frames.seen, axis=1) / frames.seen.sum(axis=1))
    best = np.argmin(errors, axis=0)
    chosen = candidates[best, np.arange(len(best))]
    return chosen[:, :, :3], chosen[:, :, 3], errors[best, np.arange(len(best))]


def _planar_poses(points: np.ndarray, plane: np.ndarray) -> list[np.ndarray]:
    """Up to two poses (3, 4) of planar points (n, 3) from their normalised image (n, 2)."""
    count, rotations, translations, _ = cv2.solvePnPGeneric(
        points, np.ascontiguousarray(plane), np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
    )
    poses = []
    for s in range(count):
        rotation, _ = cv2.Rodrigues(rotations[s])
        poses.append(np.concatenate([rotation, np.asarray(translations[s]).reshape(3, 1)], axis=1))
    if not poses or not all(np.isfinite(pose).all() for pose in poses):
        depth = np.ptp(points[:, :2], axis=0).max() / max(np.ptp(plane, axis=0).max(), 1e-3)
        facing = np.diag([1.0, -1.0, -1.0])
        centre = np.append(plane.mean(axis=0), 1.0) * depth
        return [np.concatenate([facing, (centre - facing @ points.mean(axis=0))[:, None]], axis=1)]
    return poses


def spread_views(frames: CameraFrames, count: int) -> np.ndarray:
    """Indices of up to `count` views, far apart in the board's place, size and shape in the image (greedy, exact ties
    by index, so that it is deterministic)."""
    if len(frames.frames) <= count:
        return np.arange(len(frames.frames))
    features = view_features(frames)
    chosen = [int(np.argmax(frames.seen.sum(axis=1)))]
    distance = np.full(len(features), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.sort(np.array(chosen))


def initial_lens(name: str, model: type[CameraModel], frames: CameraFrames, target: Target) -> CameraModel:
    """The best lens over a sweep of focal lengths, each refined on some well-spread views.

    Raises CalibrationError when none explains the views.
    """
    width, height = frames.detections.image_size
    subset = frames.take(spread_views(frames, _SWEEP_VIEWS))
    own = homography_focal(subset, target)
    focals = ([own] if own else []) + [fraction * max(width, height) for fraction in _FOCAL_FRACTIONS]
    best: tuple[float, CameraModel] | None = None
    for focal in focals:
        start = model.from_focal(focal, (width, height))
        rotations, translations, _ = board_poses(start, subset, target)
        refined, cost = solving.refine_single(start, subset, target, rotations, translations, max_steps=_SWEEP_STEPS)
        plausible = np.isfinite(cost) and np.all(np.asarray(refined.intrinsics[:2]) > 0.05 * width)
        logger.debug("%s: focal %.0f px -> cost %.4g, intrinsics %s", name, focal, cost, refined.intrinsics)
        if plausible and (best is None or cost < best[0] * (1 - 1e-6)):
            best = (cost, refined)
        # Most views well under a pixel: another focal length cannot explain them much better.
        if best is not None and best[0] < 0.5 * 2 * subset.seen.sum() * 0.5**2:
            break
    if best is None:
        raise CalibrationError(
            f"{name}: no focal length between {min(focals):.0f} and {max(focals):.0f} px explains the views of the "
            "board. Check the target's size and layout, and the camera model (a fisheye needs 'pinhole-equi')."
        )
    return best[1]


def initial_lenses(
    names: Sequence[str], models: Sequence[type[CameraModel]], cameras: Sequence[CameraFrames], target: Target
) -> list[CameraModel]:
    """`initial_lens` for each camera."""
    return [initial_lens(n, m, f, target) for n, m, f in zip(names, models, cameras, strict=True)]
