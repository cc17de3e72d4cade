"""Building and solving camera-only problems: used by the initialisation and by the final joint estimate."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxcal.calibration.assemble import CameraFrames, round_up, vision_data
from jaxcal.calibration.lens_basis import own_parameters
from jaxcal.calibration.poses import Poses
from jaxcal.calibration.problem import LensPrior, RigProblem
from jaxcal.calibration.state import (
    RigState,
    SharedLayout,
    camera_model_of,
    flat_target,
    layout_of,
)
from jaxcal.calibration.target_shape import geometry_of
from jaxcal.cameras import CameraModel
from jaxcal.estimation import SolveResult, on_device, solve
from jaxcal.targets import Target

_VIEW_STEP = 16


def lens_prior(models: Sequence[CameraModel], layout: SharedLayout, cameras: Sequence[CameraFrames]) -> LensPrior:
    """What is known of any lens beforehand: next to nothing, but enough that nothing runs off to infinity.

    Focal lengths are somewhere about the image's longer side (1-sigma that length), the principal point about its
    middle (1-sigma half that length): a thousand times wider than what usable views say, and all there is where views
    tell nothing (all of them frontal). Further parameters as the models ask (`CameraModel.regularisation`, and
    `CameraModel.usual_spread`).
    """
    means, informations = {}, {}
    for c, model in enumerate(models):
        width, height = cameras[c].detections.image_size
        side = float(max(width, height))
        means[c] = np.asarray(type(model).from_focal(side, (width, height)).parameters)
        information = np.array(model.regularisation(), dtype=np.float64)
        for place, name in enumerate(name for part in model.parameter_names for name in part):
            if name in ("fx", "fy", "cx", "cy"):
                information[place] += (side if name[0] == "f" else 0.5 * side) ** -2
            if name in model.usual_spread:
                information[place] += model.usual_spread[name] ** -2
        informations[c] = np.diag(information)
    return LensPrior(
        mean=tuple(on_device(np.stack([means[c] for c in members])) for members in layout.groups),
        information=tuple(on_device(np.stack([informations[c] for c in members])) for members in layout.groups),
    )


def free_coordinates(models: Sequence[CameraModel], layout: SharedLayout) -> np.ndarray:
    """Which shared coordinates (P,) may be estimated: all but those that the models hold."""
    free = np.ones(layout.size, dtype=bool)
    for c, model in enumerate(models):
        free[layout.start(c) + np.asarray(model.held, dtype=int)] = False
    return free


def templates_of(models: Sequence[CameraModel], layout: SharedLayout) -> tuple[CameraModel, ...]:
    """One model per group, to be given parameters."""
    return tuple(models[members[0]] for members in layout.groups)


def stack_lenses(models: Sequence[CameraModel], layout: SharedLayout) -> tuple[jnp.ndarray, ...]:
    """Lens parameters (C_g, n) of each group."""
    return tuple(on_device(np.stack([np.asarray(models[c].parameters) for c in members])) for members in layout.groups)


def camera_problem(
    models: Sequence[CameraModel],
    cameras: Sequence[CameraFrames],
    target: Target,
    *,
    views: Sequence[np.ndarray],
    weights: Sequence[np.ndarray],
    T_cam_rig: tuple[np.ndarray, np.ndarray],
    T_target_rig: tuple[np.ndarray, np.ndarray],
    loss_width: float,
    layout: SharedLayout | None = None,
    boards: Poses | None = None,
    offset_sigma_m: float | None = None,
    loss: str = "huber",
) -> tuple[RigProblem, RigState]:
    """Problem and start of a camera-only calibration; cam0's pose in the rig, time shifts and gravity are held.

    `boards` are first poses T_target_board of all boards but the first; `offset_sigma_m` is for points that may move.
    """
    layout = layout or layout_of(list(models))
    free = free_coordinates(models, layout)
    free[layout.pose(0)] = False
    free[layout.gravity] = False
    free[[layout.shift(c) for c in range(layout.num_cameras)]] = False

    target_state = flat_target(layout)
    if boards is not None and len(boards[0]):
        placed = (on_device(boards[0]), on_device(boards[1]))
        target_state = eqx.tree_at(lambda t: (t.R_target_board, t.t_target_board), target_state, placed)
    count = len(T_target_rig[0])
    padding = round_up(count, _VIEW_STEP) - count
    free_chain = np.zeros((count + padding, 6), dtype=bool)
    for view, weight in zip(views, weights, strict=True):
        free_chain[np.asarray(view)[np.asarray(weight).sum(axis=1) > 0]] = True
    rotations = np.concatenate([T_target_rig[0], np.tile(np.eye(3), (padding, 1, 1))])
    positions = np.concatenate([T_target_rig[1], np.zeros((padding, 3))])
    problem = RigProblem(
        templates=templates_of(models, layout),
        corners=vision_data(layout, cameras, weights=weights, views=views),
        geometry=geometry_of(target, offset_sigma_m),
        imu=None,
        prior=lens_prior(models, layout, cameras),
        free_chain=on_device(free_chain),
        free=on_device(free),
        loss_width=on_device(float(loss_width)),
        basis=own_parameters(models, layout),
        layout=layout,
        order=1,
        loss=loss,
    )
    state = RigState(
        lenses=stack_lenses(models, layout),
        R_cam_rig=on_device(T_cam_rig[0]),
        t_cam_rig=on_device(T_cam_rig[1]),
        shift=on_device(np.zeros(layout.num_cameras)),
        gravity=on_device([0.0, 0.0, -1.0]),
        rotations=on_device(rotations),
        positions=on_device(positions),
        biases=on_device(np.zeros((len(positions), 0))),
        target=target_state,
    )
    return problem, state


def refine_single(
    model: CameraModel,
    frames: CameraFrames,
    target: Target,
    R_cam_target: np.ndarray,
    t_cam_target: np.ndarray,
    *,
    max_steps: int,
    huber_width: float = 3.0,
) -> tuple[CameraModel, float]:
    """Optimise one camera and its board poses; the refined model and the cost (half the robust squares, px^2)."""
    R_target_cam = R_cam_target.swapaxes(-1, -2)
    problem, state = camera_problem(
        [model],
        [frames],
        target,
        views=[np.arange(len(frames.frames))],
        weights=[np.ones(frames.seen.shape)],
        T_cam_rig=(np.eye(3)[None], np.zeros((1, 3))),
        T_target_rig=(R_target_cam, -np.einsum("fij,fj->fi", R_target_cam, t_cam_target)),
        loss_width=huber_width,
    )
    result: SolveResult = solve(problem, state, max_steps=max_steps)
    refined = camera_model_of(result.state, problem.layout, problem.templates, 0)
    return refined, float(result.equations.cost)
