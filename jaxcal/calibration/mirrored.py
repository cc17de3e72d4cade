"""Views whose board stands the wrong way round: through a narrow lens a flat board and its mirror image look alike."""

import logging

import equinox as eqx
import numpy as np

from jaxcal.calibration.initial_poses import mirrored_poses
from jaxcal.calibration.problem import RigProblem, camera_poses, corner_errors
from jaxcal.calibration.state import RigState
from jaxcal.estimation import on_device, solve

logger = logging.getLogger(__name__)

# A mirror image is tried where it misses the corners by less than so many times as much (median), before its pose is
# adapted: where perspective tells them apart it is a hundred times and more.
_ALIKE = 10.0
# Poses by themselves need few steps; it is enough to see which of the two is better.
_STEPS = 30
_ENOUGH_TO_COMPARE = 1e-6
# Errors count in full up to so many sigmas.
_WIDTH_SIGMAS = 3.0
# A pose is turned over only for a cost lower by this share: mirror images that run back to the same pose are none.
_LOWER = 1e-4


def turn_mirrored(problem: RigProblem, state: RigState, max_steps: int) -> RigState:
    """The state with every view's pose turned over where the board's mirror image explains the corners better.

    First poses are told from their mirror images by a first lens, and what decides between them may be smaller than
    the errors of that lens; no step of the optimisation turns a board over afterwards. Here the lenses are held where
    the optimisation took them, and the mirrored views adapted.
    For problems of views alone, of one flat board: a trajectory says by itself which way a board turns.
    """
    if problem.imu is not None or problem.layout.extra_boards:
        return state
    held = eqx.tree_at(lambda p: p.free, problem, on_device(np.zeros(problem.free.shape, dtype=bool)))
    trial, alike = _likest_mirror_images(held, state)
    if not len(alike):
        return state
    trial = solve(held, trial, max_steps=min(max_steps, _STEPS), rtol=_ENOUGH_TO_COMPARE).state
    now, turned = (_costs(held, _errors(held, s))[alike] for s in (state, trial))
    better = alike[turned < now * (1.0 - _LOWER)]
    if len(better):
        logger.info("%d of %d views turned over", len(better), len(alike))
    return _merged(state, trial, better)


def _likest_mirror_images(problem: RigProblem, state: RigState) -> tuple[RigState, np.ndarray]:
    """The state with views turned over whose mirror image looks much like them, and which these are.

    A view that several cameras see is turned about the line of sight of the one whose mirror image fits all of them
    best: from there, those of the others would run to the same pose.
    """
    now = _errors(problem, state)
    trial, lowest, alike = state, np.full(len(state.rotations), np.inf), []
    for group, data in enumerate(problem.corners):
        rig_camera, seen = np.asarray(data.rig_camera), np.asarray(data.weight).sum(axis=1) > 0
        for camera in problem.layout.groups[group]:
            rows = np.flatnonzero((rig_camera == camera) & seen)
            candidate = _mirrored(problem, state, group, camera, rows)
            errors = _errors(problem, candidate)
            before, after = (np.nanmedian(e[group][rows], axis=1) for e in (now, errors))
            views, cost = np.asarray(data.view)[rows[after < _ALIKE * before]], _costs(problem, errors)
            alike.append(views)
            nearer = views[cost[views] < lowest[views]]
            lowest[nearer] = cost[nearer]
            trial = _merged(trial, candidate, nearer)
    return trial, np.unique(np.concatenate(alike))


def _mirrored(problem: RigProblem, state: RigState, group: int, camera: int, rows: np.ndarray) -> RigState:
    """The state with the views of some frames of a camera turned over about its lines of sight."""
    data = problem.corners[group]
    weight, views = np.asarray(data.weight)[rows], np.asarray(data.view)[rows]
    T_cam_target = np.asarray(camera_poses(problem, state)[group])[rows]
    middle = weight @ np.asarray(problem.geometry.points) / weight.sum(axis=1, keepdims=True)
    turned, moved = mirrored_poses(T_cam_target[:, :3, :3], T_cam_target[:, :3, 3], middle)
    R_cam_rig, t_cam_rig = np.asarray(state.R_cam_rig)[camera], np.asarray(state.t_cam_rig)[camera]
    rotations, positions = np.array(state.rotations), np.array(state.positions)
    rotations[views] = turned.swapaxes(-1, -2) @ R_cam_rig
    positions[views] = np.einsum("fji,fj->fi", turned, t_cam_rig - moved)
    return _with_poses(state, rotations, positions)


def _merged(state: RigState, other: RigState, views: np.ndarray) -> RigState:
    """The state with the poses of some views (M,) from another one."""
    rotations, positions = np.array(state.rotations), np.array(state.positions)
    rotations[views] = np.asarray(other.rotations)[views]
    positions[views] = np.asarray(other.positions)[views]
    return _with_poses(state, rotations, positions)


def _with_poses(state: RigState, rotations: np.ndarray, positions: np.ndarray) -> RigState:
    return eqx.tree_at(lambda s: (s.rotations, s.positions), state, (on_device(rotations), on_device(positions)))


def _errors(problem: RigProblem, state: RigState) -> list[np.ndarray]:
    """The error (F, N), sigmas, of every corner, per group; not a number where none takes part, infinite where a point
    cannot be projected."""
    out = []
    for data, errors in zip(problem.corners, corner_errors(problem, state), strict=True):
        weight = np.asarray(data.weight)
        distance = np.linalg.norm(np.asarray(errors), axis=-1) * np.sqrt(weight)
        out.append(np.where(weight > 0, np.where(np.isfinite(distance), distance, np.inf), np.nan))
    return out


def _costs(problem: RigProblem, errors: list[np.ndarray]) -> np.ndarray:
    """The cost (K,) of each view from the errors of its corners, by Huber's loss."""
    cost = np.zeros(problem.free_chain.shape[0])
    for data, error in zip(problem.corners, errors, strict=True):
        near = np.minimum(error, _WIDTH_SIGMAS)
        np.add.at(cost, np.asarray(data.view), np.nansum(near * (error - 0.5 * near), axis=1))
    return cost
