"""Cameras that are synchronised: their views of the target as one joint problem, and the few views to begin with."""

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxcal.calibration import rig_graph, solving
from jaxcal.calibration.assemble import CameraFrames
from jaxcal.calibration.board_turns import symmetry_sentences, unify_turns
from jaxcal.calibration.poses import Poses
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.rig_graph import RigGraph, Sightings
from jaxcal.calibration.robust import RobustFit, with_sigmas
from jaxcal.calibration.state import RigState, SharedLayout
from jaxcal.calibration.views import BoardFrames, associate
from jaxcal.cameras import CameraModel
from jaxcal.estimation import Loss, on_device, solve
from jaxcal.targets import Target

logger = logging.getLogger(__name__)

# Poses of views that are about to be solved for again, with the lens: a thousandth of the cost.
_ENOUGH_FOR_POSES = 1e-3


@dataclass(frozen=True)
class Synchronous:
    """Views of a rig, tied together: the cameras' frames, the view (F,) that each of them is part of, places of cameras
    and boards, T_target_rig of every view; and what the problem made of them is to estimate."""

    lenses: Sequence[CameraModel]
    cameras: Sequence[CameraFrames]
    views: Sequence[np.ndarray]
    graph: RigGraph
    T_target_rig: Poses
    target: Target
    layout: SharedLayout
    offset_sigma_m: float | None
    loss: Loss

    @property
    def count(self) -> int:
        """How many views there are."""
        return len(self.T_target_rig[0])

    def take(self, chosen: np.ndarray) -> "Synchronous":
        """Some of the views (M,), increasing."""
        number = np.full(self.count, -1)
        number[chosen] = np.arange(len(chosen))
        kept = [number[view] >= 0 for view in self.views]
        return dataclasses.replace(
            self,
            cameras=[frames.take(np.flatnonzero(k)) for frames, k in zip(self.cameras, kept, strict=True)],
            views=[number[view[k]] for view, k in zip(self.views, kept, strict=True)],
            T_target_rig=(self.T_target_rig[0][chosen], self.T_target_rig[1][chosen]),
        )

    def problem(self) -> tuple[RigProblem, RigState]:
        """The joint problem and its start."""
        return solving.camera_problem(
            self.lenses,
            self.cameras,
            self.target,
            views=self.views,
            weights=[np.ones(frames.seen.shape) for frames in self.cameras],
            T_cam_rig=self.graph.T_cam_rig,
            T_target_rig=self.T_target_rig,
            loss_width=1.0,
            layout=self.layout,
            boards=(self.graph.T_target_board[0][1:], self.graph.T_target_board[1][1:]),
            offset_sigma_m=self.offset_sigma_m,
            loss=self.loss,
        )

    def usable(self) -> list[np.ndarray]:
        """Every frame (F,) of each camera may take part."""
        return [np.ones(len(frames.frames), dtype=bool) for frames in self.cameras]

    def pose_parameters(self) -> list[float]:
        """Pose parameters per camera: a view's six, shared among the cameras that see it."""
        cameras_per_view = np.bincount(np.concatenate(self.views), minlength=self.count)
        return [float(np.sum(6.0 / cameras_per_view[view])) for view in self.views]


def tie_cameras(
    names: Sequence[str],
    lenses: Sequence[CameraModel],
    cameras: Sequence[CameraFrames],
    boards: Sequence[BoardFrames],
    poses: Sequence[Poses],
    errors: Sequence[np.ndarray],
    target: Target,
    *,
    tolerance_ns: int,
    layout: SharedLayout,
    offset_sigma_m: float | None,
    loss: Loss,
) -> tuple[Synchronous, list[str]]:
    """Cameras whose frames within `tolerance_ns` are one view, placed by what they see together; and sentences about
    boards that look the same when turned.

    `poses[c]`, `errors[c]` are T_cam_board and its error, px, of each of `boards[c]`. Raises CalibrationError when
    nothing connects the cameras.
    """
    views, times = associate(cameras, tolerance_ns)
    sentences: list[str] = []
    if len(target.turns) > 1:
        unified = unify_turns(names, cameras, views, poses, target)
        cameras, poses = unified.cameras, unified.poses
        sentences = [*symmetry_sentences(target, len(names)), *unified.sentences]
    sightings = [
        Sightings(view[b.row], b.board, pose, error)
        for view, b, pose, error in zip(views, boards, poses, errors, strict=True)
    ]
    graph = rig_graph.solve_graph(names, sightings, len(target.boards), tolerance_ns)
    T_target_rig = rig_graph.rig_poses(graph, sightings, len(times))
    return Synchronous(lenses, cameras, views, graph, T_target_rig, target, layout, offset_sigma_m, loss), sentences


def joined_by_others(
    tied: Synchronous, problem: RigProblem, start: RigState, chosen: np.ndarray, few: RobustFit, max_steps: int
) -> RigState:
    """A state of the `problem` of all views near its optimum, from the optimum of `few` of them (`chosen`).

    From there all views together need but a step or two: one step of Newton's from an estimate whose error goes with
    the root of the number of views already has the precision of all (Le Cam 1956; van der Vaart, Asymptotic
    Statistics, theorem 5.45). Here the poses of the other views are found (from `start`), the lenses held.
    """
    logger.info("%d of %d views solved: corner noise %s px", len(chosen), tied.count, few.sigmas)
    rotations, positions = np.array(start.rotations), np.array(start.positions)
    rotations[chosen] = np.asarray(few.state.rotations)[: len(chosen)]
    positions[chosen] = np.asarray(few.state.positions)[: len(chosen)]
    state = eqx.tree_at(
        lambda s: (s.rotations, s.positions, s.biases),
        few.state,
        (on_device(rotations), on_device(positions), start.biases),
    )
    problem = with_sigmas(problem, tied.cameras, few.sigmas)
    held = eqx.tree_at(lambda p: p.free, problem, jnp.zeros_like(problem.free))
    return solve(held, state, max_steps=max_steps, rtol=_ENOUGH_FOR_POSES).state
