"""Solving with unknown corner noise, redundant views and outliers: robust loss, rejection, then plain least squares."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np

from jaxcal.calibration import outliers
from jaxcal.calibration.assemble import CameraFrames, split_groups, stack_weights
from jaxcal.calibration.lens_basis import told_apart
from jaxcal.calibration.mirrored import turn_mirrored
from jaxcal.calibration.problem import RigProblem, corner_errors
from jaxcal.calibration.redundancy import Redundancy, measure_redundancy
from jaxcal.calibration.state import RigState
from jaxcal.calibration.view_noise import all_alike, weigh_views
from jaxcal.errors import CalibrationError
from jaxcal.estimation import SolveResult, on_device, solve
from jaxcal.progress import Progress

logger = logging.getLogger(__name__)

_HUBER_SIGMAS = 2.5
ROUNDS = 5
# From this round on: plain least squares on the inliers.
_PLAIN = 3
# All rounds but the last only find the noise and the outliers: they end when a step promises less than this share of
# the cost, which is a hundredth of a sigma in each of a thousand parameters.
_ENOUGH_FOR_NOISE = 1e-5
# A first lens and its poses are near: the first step may be damped less than one from anywhere. That of a round that
# starts at the optimum of the one before is hardly damped; nor is any of a trajectory's: damping counts in units of the
# Hessian's diagonal, which for dense control points is that of one shaking against its neighbours, and holds back what
# they do together, which counts for far less.
START_DAMPING = 1e-6
_NEXT_DAMPING, _TRAJECTORY_DAMPING = 1e-7, 1e-10

# Adapts a problem to the residuals found so far (re-weights its IMU, say) before a round.
Reweigh = Callable[[RigProblem, RigState], RigProblem]


@dataclass(frozen=True)
class RobustFit:
    """The optimum with what was learnt on the way: per camera errors (F, N, 2) px, inliers (F, N), corner noise px (of
    all its views together).

    The equations in `result` count lenses in terms of `problem.basis`.
    """

    problem: RigProblem
    result: SolveResult
    errors: list[np.ndarray]
    kept: list[np.ndarray]
    sigmas: list[float]
    redundancy: list[Redundancy]

    @property
    def state(self) -> RigState:
        """The optimum."""
        return self.result.state


def robust_fit(
    problem: RigProblem,
    state: RigState,
    cameras: Sequence[CameraFrames],
    usable: Sequence[np.ndarray],
    *,
    first_sigmas: Sequence[float],
    pose_parameters: Sequence[float],
    max_steps: int,
    progress: Progress,
    reweigh: Reweigh | None = None,
    near: bool = False,
) -> RobustFit:
    """Solve, estimating the corner noise of each camera and leaving outliers out.

    Rounds: Huber's loss with `first_sigmas`; Huber's loss with the noise found (median); the same with each view
    weighted by what it adds (`redundancy`); plain least squares on the inliers, noisy views weighted down
    (`view_noise`); the same with the noise of the inliers (root mean square) and the inliers chosen anew. `usable[c]`
    (F,) are the frames that may take part; `pose_parameters[c]` how many parameters of the trajectory a camera's
    corners pay for, for the degrees of freedom. `near`: `state` lies near the optimum, with
    noise of `first_sigmas`, and the first round is left out.
    """
    seen = [frames.seen & ok[:, None] for frames, ok in zip(cameras, usable, strict=True)]
    parameters = estimated_parameters(problem, pose_parameters)
    known = _first_guess(seen, first_sigmas)
    result: SolveResult | None = None
    errors: list[np.ndarray] = []
    for stage in range(1 if near else 0, ROUNDS):
        progress("optimise", stage, ROUNDS)
        problem = _adapted(problem, cameras, known, stage, result, reweigh)
        result = solve(
            problem,
            state,
            max_steps=max_steps,
            rtol=0.0 if stage == ROUNDS - 1 else _ENOUGH_FOR_NOISE,
            damping=_first_damping(problem, stage),
        )
        # With the noise known and the lens near its optimum: before views and corners are judged by their errors.
        state = turn_mirrored(problem, result.state, max_steps) if stage == 1 else result.state
        if not np.isfinite(float(result.equations.cost)):
            raise CalibrationError(
                "the optimisation diverged: the residuals are not finite. Check for frames with a wrong board, and "
                "that the camera models suit the lenses."
            )
        errors = split_groups(problem.layout, cameras, [np.asarray(e) for e in corner_errors(problem, state)])
        known = _learnt(known, stage, errors, cameras, seen, parameters, np.asarray(problem.geometry.across))
        logger.info(
            "round %d: cost %.6g after %d iterations, corner noise %s px",
            stage,
            float(result.equations.cost),
            int(result.iterations),
            ", ".join(f"{sigma:.3f}" for sigma in known.sigmas),
        )
    progress("optimise", ROUNDS, ROUNDS)
    assert result is not None
    usual = _in_usual_units(errors, cameras, all_alike([len(s) for s in seen]))
    sigmas = [outliers.rms_sigma(e, k, p) for e, k, p in zip(usual, known.kept, parameters, strict=True)]
    return RobustFit(problem, result, errors, known.kept, sigmas, known.redundancy)


def _first_damping(problem: RigProblem, stage: int) -> float:
    if problem.imu is not None:
        return _TRAJECTORY_DAMPING
    return START_DAMPING if stage == 0 else _NEXT_DAMPING


@dataclass(frozen=True)
class _Known:
    """What the rounds have learnt so far, per camera: inliers (F, N), corner noise px, what views add, and how much
    noisier than the others each view is (F,)."""

    kept: list[np.ndarray]
    sigmas: list[float]
    redundancy: list[Redundancy]
    noise: list[np.ndarray]


def _first_guess(seen: Sequence[np.ndarray], sigmas: Sequence[float]) -> _Known:
    """Every corner is a good one, every view like any other."""
    alike = [Redundancy(np.ones(len(s)), 1.0, 0.0) for s in seen]
    return _Known(list(seen), list(sigmas), alike, all_alike([len(s) for s in seen]))


def with_sigmas(problem: RigProblem, cameras: Sequence[CameraFrames], sigmas: Sequence[float]) -> RigProblem:
    """The problem with corner noise known, px per camera, and Huber's loss in case of outliers."""
    return _with_weights(problem, cameras, _first_guess([frames.seen for frames in cameras], sigmas), _HUBER_SIGMAS)


def _adapted(
    problem: RigProblem,
    cameras: Sequence[CameraFrames],
    known: _Known,
    stage: int,
    result: SolveResult | None,
    reweigh: Reweigh | None,
) -> RigProblem:
    """The problem of a round: weights from what is known, and what the last round's `result` says of the rest."""
    problem = _with_weights(problem, cameras, known, _HUBER_SIGMAS if stage < _PLAIN else np.inf)
    if result is None:
        return problem
    if reweigh is not None:
        problem = reweigh(problem, result.state)
    basis = told_apart(problem.basis, result.equations, np.asarray(problem.free), problem.layout)
    return eqx.tree_at(lambda p: p.basis, problem, basis, is_leaf=lambda leaf: leaf is None)


def _learnt(
    known: _Known,
    stage: int,
    errors: Sequence[np.ndarray],
    cameras: Sequence[CameraFrames],
    seen: Sequence[np.ndarray],
    parameters: Sequence[float],
    places: np.ndarray,
) -> _Known:
    """What is known after a round, from the errors (F, N, 2) px of its solution; `places` (N, 2) on the board."""
    # In units of an ordinary corner: what a detector knows to be vague may err more.
    scaled = _in_usual_units(errors, cameras, known.noise)
    kept, sigmas, redundancy, noise = known.kept, known.sigmas, known.redundancy, known.noise
    if stage < _PLAIN:
        sigmas = [outliers.robust_sigma(e, s) for e, s in zip(scaled, kept, strict=True)]
    if stage == 1:
        redundancy = [measure_redundancy(*parts) for parts in zip(cameras, scaled, seen, sigmas, strict=True)]
    if stage == 2:
        kept = [outliers.inliers(e, s, sigma) for e, s, sigma in zip(scaled, seen, sigmas, strict=True)]
        views = zip(cameras, scaled, kept, redundancy, strict=True)
        weighed = [weigh_views(frames, e, k, places, r) for frames, e, k, r in views]
        redundancy, noise = [w for w, _ in weighed], [n for _, n in weighed]
        scaled = [e / n[:, None, None] for e, n in zip(scaled, noise, strict=True)]
        sigmas = [outliers.robust_sigma(e, k) for e, k in zip(scaled, kept, strict=True)]
    if stage >= _PLAIN:
        sigmas = [outliers.rms_sigma(e, k, p) for e, k, p in zip(scaled, kept, parameters, strict=True)]
    if stage == _PLAIN:
        # Good corners that outliers in the same view had pulled away are taken back.
        kept = [outliers.inliers(e, s, sigma) for e, s, sigma in zip(scaled, seen, sigmas, strict=True)]
    return _Known(kept, sigmas, redundancy, noise)


def estimated_parameters(problem: RigProblem, pose_parameters: Sequence[float]) -> list[float]:
    """How many parameters each camera's corners pay for: its lens (what of it is free), its place in the rig, its share
    of what is estimated of the target, and `pose_parameters` of the trajectory."""
    layout, free = problem.layout, np.asarray(problem.free)
    of_target = float(free[layout.target].sum()) / layout.num_cameras
    return [
        float(free[layout.lens(c)].sum() + free[layout.pose(c)].sum()) + of_target + of_poses
        for c, of_poses in enumerate(pose_parameters)
    ]


def _in_usual_units(
    errors: Sequence[np.ndarray], cameras: Sequence[CameraFrames], noise: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Errors (F, N, 2) as if each were of an ordinary corner in an ordinary view."""
    return [
        e * frames.precision[..., None] / n[:, None, None] for e, frames, n in zip(errors, cameras, noise, strict=True)
    ]


def _with_weights(problem: RigProblem, cameras: Sequence[CameraFrames], known: _Known, loss_width: float) -> RigProblem:
    parts = zip(known.kept, known.sigmas, known.redundancy, known.noise, cameras, strict=True)
    weights = [
        kept * (r.weights / noise**2)[:, None] * (frames.precision / sigma) ** 2
        for kept, sigma, r, noise, frames in parts
    ]
    return eqx.tree_at(
        lambda p: [*[data.weight for data in p.corners], p.loss_width],
        problem,
        [*stack_weights(problem.layout, cameras, weights), on_device(float(loss_width))],
    )
