"""Poses of a flat board through a lens that is given, the better of the two that such a board allows."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from jaxcal.calibration import generic_lens
from jaxcal.calibration.assemble import CameraFrames
from jaxcal.calibration.first_fit import (
    Fit,
    Lens,
    Views,
    compact_views,
    fit_lenses,
    fit_poses,
    hopeless,
    squared_errors,
)
from jaxcal.calibration.generic_lens import GenericLens
from jaxcal.calibration.initial_poses import mirrored_poses, planar_poses
from jaxcal.calibration.model_lens import ModelLens
from jaxcal.cameras import CameraModel
from jaxcal.child import usable_cores
from jaxcal.estimation.threads import single_threaded_blas
from jaxcal.targets import Target

# Corner errors (px) up to which they count in full.
HUBER_PX = 3.0
# Corner noise (px) taken for granted until it is known, in the scale of priors alone.
FIRST_NOISE_PX = 0.1
_POSE_STEPS = 12
_POSE_CORNERS = 32_300  # corners at once: they just fill a large piece of `ModelLens`


def board_poses(model: CameraModel, frames: CameraFrames, target: Target) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_cam_target of every frame through a known lens, the better of the two poses that a flat board allows.

    It takes all corners to tell which is the better one through a narrow lens; a third of them was not enough.

    Returns rotations (F, 3, 3), translations (F, 3) and the root mean square error (F,), px, of each.
    """
    lens = ModelLens(model)
    parameters = np.asarray(model.parameters)[None]
    far = float(max(frames.detections.image_size))
    chunk = max(_POSE_CORNERS // len(target.points), 1)

    def posed(first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        part = slice(first, first + chunk)
        views = compact_views(target.points, frames.pixels[part], frames.seen[part])
        fit = poses_from_rays(lens, parameters, *generic_lens.unproject(generic, views.pixels), views, far)
        squared = squared_errors(lens, fit, views, far=1e6)[0]
        error = np.sqrt(np.sum(squared * views.weight, axis=1) / views.weight.sum(axis=1))
        return fit.rotation[0], views.to_target(fit.rotation[0], fit.translation[0]), error

    with single_threaded_blas():
        generic = generic_of(model, frames.detections.image_size)
        # Numpy and jax let go of the interpreter while they compute.
        with ThreadPoolExecutor(max_workers=usable_cores()) as threads:
            parts = list(threads.map(posed, range(0, len(frames.frames), chunk)))
    rotation, translation, error = (np.concatenate(values) for values in zip(*parts, strict=True))
    return rotation, translation, error


def generic_of(model: CameraModel, image_size: tuple[int, int]) -> np.ndarray:
    """The generic lens (1, 6) nearest to a model over its image: good enough to start poses from, with no unprojection
    of the model's own to compile or to iterate."""
    far = float(max(image_size))
    angle = np.deg2rad(np.geomspace(0.2, 125.0, 30))
    around = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rays = np.stack(
        [
            np.sin(angle)[:, None] * np.cos(around),
            np.sin(angle)[:, None] * np.sin(around),
            np.tile(np.cos(angle)[:, None], (1, len(around))),
        ],
        axis=-1,
    )
    seen = ModelLens(model).project(
        np.asarray(model.parameters)[None], rays.reshape(1, 1, -1, 3).swapaxes(-1, -2), False
    )
    pixels = seen.pixels[0, 0].T.reshape(*rays.shape[:-1], 2)
    # Outwards until the lens ends or folds back.
    radius = np.linalg.norm(pixels - pixels[0].mean(axis=0), axis=-1)
    outwards = np.diff(radius, axis=0, prepend=0.0) > 0.0
    inside = np.all((pixels > -0.05 * far) & (pixels < np.array(image_size) + 0.05 * far), axis=-1)
    real = np.cumprod(outwards & seen.valid[0, 0].reshape(radius.shape), axis=0) * inside
    views = Views(
        rays.reshape(1, -1, 3), pixels.reshape(1, -1, 2), real.reshape(1, -1).astype(np.float64), np.zeros(3), 1.0
    )
    parameters = generic_lens.hypotheses(pixels[real > 0], image_size, None)
    count = len(parameters)
    start = Fit(parameters, np.tile(np.eye(3), (count, 1, 1, 1)), np.zeros((count, 1, 3)), np.full(count, np.inf))
    prior = generic_lens.weak_prior(image_size, FIRST_NOISE_PX)
    fit = fit_lenses(GenericLens(), start, views, steps=20, width=HUBER_PX, cap=far, prior=prior, hold_poses=True)
    return fit.parameters[[int(np.argmin(fit.cost))]]


def poses_from_rays(
    lens: Lens, parameters: np.ndarray, rays: np.ndarray, valid: np.ndarray, views: Views, size: float
) -> Fit:
    """Poses of all views for lenses (B, n) from rays (B, F, N, 3), `valid` (B, F, N): the better of both."""
    weight = views.weight * valid
    weight = np.where(weight.sum(axis=-1, keepdims=True) >= 6, weight, views.weight)
    rotation, translation = planar_poses(views.points, rays, weight)
    fit = Fit(parameters, rotation, translation, np.full(len(parameters), np.inf))
    fit, cost = fit_poses(lens, fit, views, steps=_POSE_STEPS, width=HUBER_PX, cap=0.25 * size)
    return better_of_mirrored(lens, fit, cost, views, size)[0]


def better_of_mirrored(lens: Lens, fit: Fit, cost: np.ndarray, views: Views, size: float) -> tuple[Fit, np.ndarray]:
    """The fit with every pose that its mirror image beats replaced, and which ones were (B, F)."""
    middle = (
        np.sum(views.points * views.weight[..., None], axis=-2) / np.maximum(views.weight.sum(axis=-1), 1.0)[:, None]
    )
    rotation, translation = mirrored_poses(fit.rotation, fit.translation, middle)
    other = Fit(fit.parameters, rotation, translation, fit.cost)
    limits = {"width": HUBER_PX, "cap": 0.25 * size}
    rivals = np.flatnonzero(~hopeless(lens, other, fit, views, **limits))
    swap = np.zeros(cost.shape, dtype=bool)
    if len(rivals) == 0:
        return dataclasses.replace(fit, cost=cost.sum(axis=-1)), swap
    before = cost[:, rivals]
    other, found = fit_poses(
        lens, other.take_views(rivals), views.take(rivals), steps=_POSE_STEPS, beat=before, **limits
    )
    swap[:, rivals] = better = found < before - 1e-9 * np.abs(before)
    rotation, translation, cost = fit.rotation.copy(), fit.translation.copy(), cost.copy()
    rotation[:, rivals] = np.where(better[..., None, None], other.rotation, rotation[:, rivals])
    translation[:, rivals] = np.where(better[..., None], other.translation, translation[:, rivals])
    cost[:, rivals] = np.where(better, found, before)
    return Fit(fit.parameters, rotation, translation, cost.sum(axis=-1)), swap


def swap_mirrored(lens: Lens, fit: Fit, views: Views, far: float) -> tuple[Fit, bool]:
    """The fit, its poses adapted, with every pose that its mirror image beats replaced; and whether any was."""
    fit, cost = fit_poses(lens, fit, views, steps=3, width=HUBER_PX, cap=0.25 * far)
    fit, swap = better_of_mirrored(lens, fit, cost, views, far)
    return fit, bool(swap.any())
