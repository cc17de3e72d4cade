"""Is it the optimum? The solution is left on purpose and has to be found again."""

import dataclasses
import logging
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxcal.calibration.assemble import CameraFrames, split_groups
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.robust import RobustFit, corner_errors
from jaxcal.calibration.state import RigState
from jaxcal.calibration.uncertainty import shared_information
from jaxcal.estimation import solve

logger = logging.getLogger(__name__)

# How far the restart is from the optimum, in sigmas along every direction of the shared parameters.
_RESTART_SIGMAS = 10.0
# Costs that differ by less than this share are one optimum.
_SAME_COST = 1e-8
_RESTARTS = 3


def confirm_optimum(fit: RobustFit, cameras: Sequence[CameraFrames], *, max_steps: int) -> tuple[RobustFit, list[str]]:
    """Solve again from ten sigmas away; a lower optimum found on the way is taken, and tried in turn.

    Returns the fit to use, and sentences where no restart agreed with it. Deterministic.
    """
    rng = np.random.default_rng(0)
    for attempt in range(_RESTARTS):
        away = _displacement(fit, rng)
        if away is None:
            return fit, []
        start = _moved(fit.problem, fit.state, jnp.asarray(away))
        result = solve(fit.problem, start, max_steps=max_steps)
        before, after = float(fit.result.equations.cost), float(result.equations.cost)
        logger.info("restart %d: cost %.9g, from %.9g", attempt, after, before)
        if not np.isfinite(after) or after >= before * (1.0 - _SAME_COST):
            agrees = after <= before * (1.0 + _SAME_COST)
            return fit, [] if agrees or not bool(fit.result.converged) else [_another_optimum(before, after)]
        errors = [np.asarray(e) for e in corner_errors(fit.problem, result.state)]
        fit = dataclasses.replace(fit, result=result, errors=split_groups(fit.problem.layout, cameras, errors))
    return fit, [
        f"Each of {_RESTARTS} restarts found a better solution than the one before: the optimum is not certain. Record "
        "more views, with more varied tilt and distance."
    ]


@eqx.filter_jit
def _moved(problem: RigProblem, state: RigState, shared: Array) -> RigState:
    return problem.retract(state, jnp.zeros(problem.free_chain.shape), shared)


def _another_optimum(before: float, after: float) -> str:
    return (
        f"Started from ten sigmas away, the optimisation ends in another, worse place (cost {after:.6g} instead of "
        f"{before:.6g}): the recording determines the calibration weakly. Record more varied tilt and distance."
    )


def _displacement(fit: RobustFit, rng: np.random.Generator) -> np.ndarray | None:
    """A step of the shared parameters, some sigmas long in each direction; None where directions are not determined."""
    free = np.asarray(fit.problem.free)
    values, directions = shared_information(fit.result.equations, free)
    if not len(values) or values.min() <= 0:
        return None
    sigmas = _RESTART_SIGMAS * rng.choice([-1.0, 1.0], size=len(values)) / np.sqrt(values)
    step = np.zeros(len(free))
    step[free] = directions @ sigmas
    return step
