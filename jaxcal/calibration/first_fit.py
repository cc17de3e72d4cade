"""Small bundle adjustments in plain numpy: many lens hypotheses, or many views, side by side and without compilation.

The engine in `estimation` solves the real problem; this one is for the start, where hypotheses come and go by the
dozen. Levenberg-Marquardt with the poses eliminated (Schur complement), Huber's loss cut off at a cap, so that what a
lens cannot show does not steer it.

Arrays run over B hypotheses, F views, N corners. Poses map a board whose points are centred and of unit size
(`Views.points`) into the camera.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from jaxcal.calibration.generic_lens import Projection
from jaxcal.calibration.initial_poses import rotations

_FIRST_DAMPING = 1e-3
# Damping that holds nothing back: of the first step, where the optimum is near.
FREE_DAMPING = 1e-9
_LARGEST_DAMPING = 1e10
# Poses by themselves: settled when the cost falls by less than this share, or after some failures on end (the damping's
# factor doubles with each); compared with a rival after some steps, and given up where they are far above it.
_POSE_RTOL = 1e-5
_FAILED = 10.0
_FAIR_STEPS = 3
_HOPELESS = 9.0
# Corners of a view that a rival has to do well on first.
_FIRST_CORNERS = 24
# Keeps what no corner determines from making a matrix singular.
_ROUNDING = 1e-13


@runtime_checkable
class Lens(Protocol):
    """A kind of lens: parameters (B, n) to pixels and Jacobians."""

    def project(self, parameters: np.ndarray, points: np.ndarray, with_lens: bool) -> Projection:
        """Project points (B, F, 3, N), camera frame, through lenses (B, n)."""
        ...


@dataclass(frozen=True)
class Views:
    """Corners of some views, without gaps where few of the target's points are seen.

    `points` (F, N, 3) of the board, less `middle` (3,) and divided by `size`; `pixels` (F, N, 2); `weight` (F, N), 0
    where there is no corner.
    """

    points: np.ndarray
    pixels: np.ndarray
    weight: np.ndarray
    middle: np.ndarray
    size: float

    def take(self, index: np.ndarray) -> "Views":
        """Some of the views."""
        return Views(self.points[index], self.pixels[index], self.weight[index], self.middle, self.size)

    def with_weight(self, weight: np.ndarray) -> "Views":
        """The same views with other weights (F, N)."""
        return Views(self.points, self.pixels, weight, self.middle, self.size)

    def thinned(self, most: int) -> "Views":
        """The same views with at most `most` of the corners of each."""
        index, taken = _spread_corners(self.weight > 0, most)
        at = index[..., None]
        weight = np.where(taken, np.take_along_axis(self.weight, index, axis=1), 0.0)
        return Views(
            np.take_along_axis(self.points, at, axis=1),
            np.take_along_axis(self.pixels, at, axis=1),
            weight,
            self.middle,
            self.size,
        )

    def to_target(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """t_cam_target (..., 3), metres, of poses of the centred board."""
        return self.size * translation - rotation @ self.middle

    def from_target(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """Undoes `to_target`."""
        return (translation + rotation @ self.middle) / self.size


def compact_views(points: np.ndarray, pixels: np.ndarray, seen: np.ndarray, most: int | None = None) -> Views:
    """Views of target points (N, 3) seen at pixels (F, N, 2) where `seen` (F, N); at most `most` corners of each."""
    middle = points.mean(axis=0)
    size = float(np.ptp(points[:, :2], axis=0).max())
    index, taken = _spread_corners(seen, most)
    chosen = np.take_along_axis(pixels, index[..., None], axis=1)
    points = (points[index] - middle) / size
    return Views(points, np.where(taken[..., None], chosen, 0.0), taken.astype(np.float64), middle, size)


def _spread_corners(seen: np.ndarray, most: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Places (F, M) of the corners that are `seen` (F, N), at most `most` of each view, and which of them count."""
    count = seen.sum(axis=1)
    width = int(count.max()) if most is None else int(min(count.max(), most))
    order = np.argsort(~seen, axis=1, kind="stable")  # the seen ones first, in order
    taken = np.minimum(count, width)
    # Evenly over the seen ones, which run row by row over the board.
    step = np.maximum(count, 1) / np.maximum(taken, 1)
    place = np.minimum(
        (np.arange(width) * step[:, None] + 0.5 * (step[:, None] - 1.0)).round().astype(int), seen.shape[1] - 1
    )
    return np.take_along_axis(order, place, axis=1), np.arange(width) < taken[:, None]


@dataclass(frozen=True)
class Fit:
    """Lenses (B, n) and poses (B, F, 3, 3), (B, F, 3) of the centred board, with their cost (B,), px^2."""

    parameters: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    cost: np.ndarray

    def take(self, index: np.ndarray) -> "Fit":
        """Some of the hypotheses."""
        return Fit(self.parameters[index], self.rotation[index], self.translation[index], self.cost[index])

    def take_views(self, index: np.ndarray) -> "Fit":
        """The poses of some of the views."""
        return Fit(self.parameters, self.rotation[:, index], self.translation[:, index], self.cost)


def squared_errors(lens: Lens, fit: Fit, views: Views, far: float) -> np.ndarray:
    """Squared reprojection errors (B, F, N), px^2, far^2 where a point cannot be projected."""
    in_camera = _in_camera(fit.rotation, fit.translation, views)[1]
    seen = lens.project(fit.parameters, in_camera, False)
    squared = np.sum((seen.pixels - views.pixels.swapaxes(-1, -2)) ** 2, axis=-2)
    return np.where(seen.valid & np.isfinite(squared), np.minimum(squared, far**2), far**2)


def fit_poses(
    lens: Lens,
    start: Fit,
    views: Views,
    *,
    steps: int,
    width: float,
    cap: float,
    beat: np.ndarray | None = None,
) -> tuple[Fit, np.ndarray]:
    """Optimise every pose by itself with the lens as it is; the fit and the cost of each view (B, F).

    `width` of Huber's loss and `cap` on an error, px. `beat` (B, F): poses that are still far above this cost after
    some steps are given up. Views that have settled take no part in further steps.
    """
    rotation, translation = start.rotation.copy(), start.translation.copy()
    gram, cost = _linearise(lens, start.parameters, rotation, translation, views, width, cap, with_lens=False)
    damping = np.full(cost.shape, _FIRST_DAMPING)
    raise_by = np.full(cost.shape, 2.0)
    settled = np.zeros(cost.shape, dtype=bool)
    for number in range(steps):
        if beat is not None and number >= _FAIR_STEPS:
            settled |= cost > _HOPELESS * beat
        active = np.flatnonzero(~settled.all(axis=0))
        if len(active) == 0:
            break
        moved = _moved(rotation[:, active], translation[:, active], _pose_step(gram[:, active], damping[:, active]))
        trial, trial_cost = _linearise(lens, start.parameters, *moved, views.take(active), width, cap, with_lens=False)
        before = cost[:, active]
        better = trial_cost < before
        rotation[:, active] = np.where(better[..., None, None], moved[0], rotation[:, active])
        translation[:, active] = np.where(better[..., None], moved[1], translation[:, active])
        gram[:, active] = np.where(better[..., None, None], trial, gram[:, active])
        cost[:, active] = np.where(better, trial_cost, before)
        damping[:, active], raise_by[:, active] = _next_damping(better, damping[:, active], raise_by[:, active])
        small = before - trial_cost < _POSE_RTOL * before
        settled[:, active] = small & (better | (raise_by[:, active] > _FAILED))
    return Fit(start.parameters, rotation, translation, cost.sum(axis=-1)), cost


def hopeless(lens: Lens, rival: Fit, fit: Fit, views: Views, *, width: float, cap: float) -> np.ndarray:
    """Views (F,) in which, by some of the corners, all poses of `rival` are far above those of `fit` after some steps.

    Much quicker than `fit_poses` with `beat`, and by the same measure.
    """
    few = views.thinned(_FIRST_CORNERS)
    cost = fit_poses(lens, fit, few, steps=0, width=width, cap=cap)[1]
    others = fit_poses(lens, rival, few, steps=_FAIR_STEPS, width=width, cap=cap)[1]
    return np.all(others > _HOPELESS * cost, axis=0)


def fit_lenses(
    lens: Lens,
    start: Fit,
    views: Views,
    *,
    steps: int,
    width: np.ndarray | float,
    cap: float,
    prior: tuple[np.ndarray, np.ndarray],
    hold_poses: bool = False,
    rtol: float = 1e-5,
    damping: float = _FIRST_DAMPING,
) -> Fit:
    """Optimise lenses and poses of all hypotheses, or with `hold_poses` the lenses alone.

    `width` of Huber's loss, px, one for all or one for each hypothesis (B,); `prior`: mean and diagonal information
    (n,) of the lens parameters. Stops when no hypothesis improves by more than `rtol` of its cost. `damping` is the
    first step's.
    """
    mean, information = prior
    parameters, rotation, translation = start.parameters, start.rotation, start.translation
    gram, cost = _linearise_all(lens, parameters, rotation, translation, views, width, cap, prior)
    dampings = np.full(cost.shape, damping)
    raise_by = np.full(cost.shape, 2.0)
    for _ in range(steps):
        force = information * (parameters - mean)
        lens_step, pose_step = _schur_step(gram, dampings, information, force, hold_poses)
        trial_parameters = parameters + lens_step
        trial_rotation, trial_translation = _moved(rotation, translation, pose_step)
        trial, trial_cost = _linearise_all(
            lens, trial_parameters, trial_rotation, trial_translation, views, width, cap, prior
        )
        better = trial_cost < cost
        gain = cost - trial_cost
        parameters = np.where(better[:, None], trial_parameters, parameters)
        rotation = np.where(better[:, None, None, None], trial_rotation, rotation)
        translation = np.where(better[:, None, None], trial_translation, translation)
        gram = np.where(better[:, None, None, None], trial, gram)
        cost = np.where(better, trial_cost, cost)
        dampings, raise_by = _next_damping(better, dampings, raise_by)
        # A small gain under strong damping says nothing: what is weakly determined has hardly moved yet. With the poses
        # held it had better not move: it would take up their errors.
        settled = better & (gain < rtol * cost) & (hold_poses | (dampings < FREE_DAMPING))
        if np.all(settled | (dampings > _LARGEST_DAMPING)):
            break
    return Fit(parameters, rotation, translation, cost)


def _in_camera(rotation: np.ndarray, translation: np.ndarray, views: Views) -> tuple[np.ndarray, np.ndarray]:
    """Points (B, F, 3, N) turned into the camera's axes, and moved into its frame."""
    turned = rotation @ views.points.swapaxes(-1, -2)
    return turned, turned + translation[..., None]


def _linearise_all(
    lens: Lens,
    parameters: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    views: Views,
    width: np.ndarray | float,
    cap: float,
    prior: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """As `_linearise` with the lens; the cost (B,) includes the prior's."""
    gram, cost = _linearise(lens, parameters, rotation, translation, views, width, cap, with_lens=True)
    mean, information = prior
    return gram, cost.sum(axis=-1) + 0.5 * np.sum(information * (parameters - mean) ** 2, axis=-1)


def _linearise(
    lens: Lens,
    parameters: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    views: Views,
    width: np.ndarray | float,
    cap: float,
    *,
    with_lens: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Gram matrices (B, F, m, m) of (rotation, translation, lens, residual) and the cost (B, F) of every view."""
    turned, in_camera = _in_camera(rotation, translation, views)
    seen = lens.project(parameters, in_camera, with_lens)
    n = 0 if seen.by_lens is None else seen.by_lens.shape[-3]
    rows = np.empty((*in_camera.shape[:-2], 7 + n, 2, in_camera.shape[-1]))
    by_point = seen.by_point
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):  # turned x by_point
        rows[..., i, :, :] = (
            turned[..., j, None, :] * by_point[..., k, :] - turned[..., k, None, :] * by_point[..., j, :]
        )
        rows[..., 3 + i, :, :] = by_point[..., i, :]
    if seen.by_lens is not None:
        rows[..., 6:-1, :, :] = seen.by_lens
    rows[..., -1, :, :] = seen.pixels - views.pixels.swapaxes(-1, -2)

    squared = np.sum(rows[..., -1, :, :] ** 2, axis=-2)
    inside = seen.valid & (squared < cap**2)
    length = np.sqrt(np.where(inside, squared, cap**2))
    width = np.asarray(width, dtype=np.float64).reshape(-1, 1, 1)
    huber = np.minimum(1.0, width / np.maximum(length, 1e-12))
    rho = np.where(length <= width, length**2, 2.0 * width * length - width**2)
    cost = 0.5 * np.sum(rho * views.weight, axis=-1)
    rows *= np.sqrt(np.where(inside, huber, 0.0) * views.weight)[..., None, None, :]
    if not inside.all():
        np.copyto(rows, 0.0, where=~inside[..., None, None, :])
    flat = rows.reshape(*rows.shape[:-2], -1)
    return flat @ flat.swapaxes(-1, -2), cost


def _damped(block: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """A normal matrix with its diagonal raised by a share of itself, and never singular.

    Each parameter by its own diagonal: their units differ by ten orders of magnitude.
    """
    diagonal = np.diagonal(block, axis1=-2, axis2=-1)
    added = np.where(diagonal > 0, (damping[..., None] + _ROUNDING) * diagonal, 1.0)
    return block + added[..., None] * np.eye(block.shape[-1])


def _pose_step(gram: np.ndarray, damping: np.ndarray) -> np.ndarray:
    return -np.linalg.solve(_damped(gram[..., :6, :6], damping), gram[..., :6, -1:])[..., 0]


def _schur_step(
    gram: np.ndarray, damping: np.ndarray, information: np.ndarray, force: np.ndarray, hold_poses: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the lenses (B, n) and the poses (B, F, 6)."""
    lens_lens = gram[..., 6:-1, 6:-1].sum(axis=1) + np.diag(information)
    gradient = gram[..., 6:-1, -1].sum(axis=1) + force
    corner = _damped(lens_lens, damping)
    if hold_poses:
        step = -np.linalg.solve(corner, gradient[..., None])[..., 0]
        return step, np.zeros((*gram.shape[:2], 6))
    pose = _damped(gram[..., :6, :6], np.broadcast_to(damping[:, None], gram.shape[:2]))
    eliminated = np.linalg.solve(pose, gram[..., :6, 6:])  # cross and gradient together
    cross = gram[..., :6, 6:-1]
    reduction = np.sum(cross.swapaxes(-1, -2) @ eliminated, axis=1)
    schur = corner - reduction[..., :-1]
    step = -np.linalg.solve(schur, (gradient - reduction[..., -1])[..., None])[..., 0]
    poses = -eliminated[..., -1] - np.einsum("bfij,bj->bfi", eliminated[..., :-1], step)
    return step, poses


def _moved(rotation: np.ndarray, translation: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses moved by (..., 6), a rotation on the left and a translation."""
    turn = step[..., :3]
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    turn = turn * np.minimum(1.0, 0.5 / np.maximum(angle, 1e-12))
    return rotations(turn) @ rotation, translation + step[..., 3:]


def _next_damping(better: np.ndarray, damping: np.ndarray, raise_by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Down by ten on success, up ever faster on failure."""
    new = np.where(better, np.maximum(damping * 0.1, 1e-12), np.minimum(damping * raise_by, 1e12))
    return new, np.where(better, 2.0, np.minimum(2.0 * raise_by, 1e4))
