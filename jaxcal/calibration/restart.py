"""Is it the optimum? The solution is left on purpose and has to be found again."""

import dataclasses
import logging
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.linalg import solveh_banded

from jaxcal.calibration.assemble import CameraFrames, split_groups
from jaxcal.calibration.poles import pole_sentences
from jaxcal.calibration.problem import RigProblem, corner_errors
from jaxcal.calibration.robust import RobustFit
from jaxcal.calibration.state import RigState
from jaxcal.calibration.uncertainty import shared_information
from jaxcal.calibration.valleys import (
    AS_GOOD,
    ENOUGH_TO_WALK,
    HOLD,
    RIVAL_SIGMAS,
    SAME_COST,
    across_the_fold,
    along_the_valley,
    lens_covariance,
    lens_of,
    weakest,
    with_prior,
)
from jaxcal.cameras import CameraModel
from jaxcal.estimation import BlockArrow, SolveResult, on_device, solve
from jaxcal.programs import stored_jit

logger = logging.getLogger(__name__)

# How far restarts are from the optimum, in sigmas along every direction of the shared parameters: the first, and those
# that follow in turn where that one met another optimum or strongly bent ground.
_RESTART_SIGMAS = 10.0
_MORE_SIGMAS = (3.0, 1.0, 10.0)
_MOST_RESTARTS = 13
# So many restarts have to come back: the first, and more on bent ground.
_ENOUGH, _ENOUGH_BENT = 1, 4
_MOST_WALKS = 4
_AMBIGUOUS = (
    "Two lenses explain the corners equally well: the optimum has a rival, many sigmas away in the parameters and "
    "nearly the same in its projections. Do not read the lens' single parameters; record more views, nearer to the rim."
)
# How far parameters that nearly cancel may be from zero on the way to an optimum, in terms of their usual spread.
_PLAIN = 0.3
# So far may the cost at the restart exceed what the quadratic model promises; beyond, the start is nonsense (a lens
# with a pole in the image, say) and moves nearer.
_BELIEVABLE = 3.0
_HALVINGS = 6


def confirm_optimum(
    fit: RobustFit,
    cameras: Sequence[CameraFrames],
    rivals: Sequence[Sequence[CameraModel]] = (),
    *,
    max_steps: int,
) -> tuple[RobustFit, list[str]]:
    """Solve again from ten sigmas away; a lower optimum found on the way is taken, and tried in turn.

    Before that from each camera's `rivals`, lenses that looked nearly as good at first. Where the first restart comes
    back, that is all. Where not, or where the cost is far from quadratic between, more follow, near and far, and walks
    along the lenses' weakest directions. Returns the fit to use, and sentences where restarts do not agree, another
    optimum is as good, or a lens has a pole on a corner. Deterministic.
    """
    rng = np.random.default_rng(0)
    agreed, bent, worse = 0, False, None
    fit, ambiguous = _best_of_rivals(fit, rivals, max_steps)
    for attempt in range(_MOST_RESTARTS):
        sigmas = _RESTART_SIGMAS if attempt == 0 else _MORE_SIGMAS[attempt % len(_MORE_SIGMAS)]
        step = _displacement(fit, sigmas, rng)
        if step is None:
            return fit, []
        start, halved = _left(fit, *step, sigmas)
        result = solve(fit.problem, start, max_steps=max_steps)
        before, after = float(fit.result.equations.cost), float(result.equations.cost)
        logger.info("restart %d: cost %.9g, from %.9g", attempt, after, before)
        if after < before * (1.0 - SAME_COST):
            fit = dataclasses.replace(fit, result=result)
            agreed, bent, worse = 0, True, None
        elif after <= before * (1.0 + SAME_COST):
            agreed += 1
        else:
            bent, worse = True, after
        bent = bent or halved
        if agreed >= (_ENOUGH_BENT if bent else _ENOUGH):
            break
    sentences = [_AMBIGUOUS] if ambiguous else []
    for walk in range(_MOST_WALKS if bent else 0):
        lower, rivalled = along_the_valley(fit, max_steps)
        sentences = [_AMBIGUOUS] if ambiguous or rivalled else []
        if lower is None:
            break
        logger.info(
            "walk %d: cost %.9g, from %.9g", walk, float(lower.equations.cost), float(fit.result.equations.cost)
        )
        fit = dataclasses.replace(fit, result=lower)
    errors = [np.asarray(e) for e in corner_errors(fit.problem, fit.state)]
    fit = dataclasses.replace(fit, errors=split_groups(fit.problem.layout, cameras, errors))
    sentences += pole_sentences(fit, cameras)
    if agreed or not bool(fit.result.converged):
        return fit, sentences
    return fit, [_uncertain(float(fit.result.equations.cost), worse), *sentences]


def _best_of_rivals(fit: RobustFit, rivals: Sequence[Sequence[CameraModel]], max_steps: int) -> tuple[RobustFit, bool]:
    """The lowest of the fit and the optima reached from each camera's rivals, and whether another is as good."""
    layout = fit.problem.layout
    lenses = [(camera, model) for camera, models in enumerate(rivals) for model in models]
    reached = [_from_rival(fit, *pair, max_steps) for pair in lenses]
    cancelling = [c for c in range(layout.num_cameras) if fit.problem.templates[layout.place(c)[0]].usual_spread]
    reached = [r for r in [*reached, *(_from_plain(fit, c, max_steps) for c in cancelling)] if r is not None]
    folded = {camera: across_the_fold(fit, camera, max_steps) for camera in range(layout.num_cameras)}
    reached += [result for results in folded.values() for result in results]
    if not reached:
        return fit, False
    lowest = min([fit.result, *reached], key=lambda result: float(result.equations.cost))
    before, after = float(fit.result.equations.cost), float(lowest.equations.cost)
    logger.info("rivals: cost %.9g, from %.9g", after, before)
    best = fit if after >= before * (1.0 - SAME_COST) else dataclasses.replace(fit, result=lowest)
    others = [result for result in [fit.result, *reached] if result is not best.result]
    cameras = {camera for camera, _ in lenses} | {camera for camera, results in folded.items() if results}
    return best, any(_is_rival(best, other, camera) for other in others for camera in cameras)


def _from_rival(fit: RobustFit, camera: int, lens: CameraModel, max_steps: int) -> SolveResult | None:
    """Where the optimisation ends from another lens of a camera, to which all else is adapted first; None where lenses
    are held in part, or the end is no optimum."""
    covariance = lens_covariance(fit, camera)
    if covariance is None or fit.problem.basis[fit.problem.layout.place(camera)[0]] is not None:
        return None
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    hold = np.where(sigma > 0, HOLD / np.where(sigma > 0, sigma, 1.0) ** 2, 0.0)
    return _by_way_of(fit, camera, np.asarray(lens.parameters), hold, max_steps)


def _from_plain(fit: RobustFit, camera: int, max_steps: int) -> SolveResult | None:
    """Where the optimisation ends from a lens whose parameters of `usual_spread` are zero, and may spread but little at
    first: where they nearly cancel, a lens can end behind a pole of its denominator."""
    group, place = fit.problem.layout.place(camera)
    template, parameters = fit.problem.templates[group], np.array(fit.state.lenses[group])[place]
    hold = np.zeros(len(parameters))
    for index, name in enumerate(name for part in template.parameter_names for name in part):
        if name in template.usual_spread:
            parameters[index], hold[index] = 0.0, (_PLAIN * template.usual_spread[name]) ** -2
    return _by_way_of(fit, camera, parameters, hold, max_steps)


def _by_way_of(
    fit: RobustFit, camera: int, parameters: np.ndarray, hold: np.ndarray, max_steps: int
) -> SolveResult | None:
    """Where the optimisation ends from a lens (n,), to which all else is adapted first while information (n,) holds it;
    None where that end is no optimum."""
    group, place = fit.problem.layout.place(camera)
    lenses = list(fit.state.lenses)
    lenses[group] = lenses[group].at[place].set(on_device(parameters))
    start = eqx.tree_at(lambda s: s.lenses, fit.state, tuple(lenses))
    held = with_prior(fit.problem, camera, parameters, np.diag(hold))
    adapted = solve(held, start, max_steps=max_steps, rtol=ENOUGH_TO_WALK)
    result = solve(fit.problem, adapted.state, max_steps=max_steps)
    settled = bool(result.converged) and np.isfinite(float(result.equations.cost))
    return result if settled else None


def _is_rival(best: RobustFit, other: SolveResult, camera: int) -> bool:
    """Whether another optimum is as good as the best, and its lens another one."""
    covariance = lens_covariance(best, camera)
    functional = None if covariance is None else weakest(covariance)
    if functional is None:
        return False
    layout = best.problem.layout
    away = functional @ (lens_of(layout, other.state, camera) - lens_of(layout, best.state, camera))
    above = float(other.equations.cost) - float(best.result.equations.cost)
    return bool(abs(away) > RIVAL_SIGMAS and abs(above) < AS_GOOD)


def _uncertain(cost: float, worse: float | None) -> str:
    said = "each restart found a better solution than the one before"
    if worse is not None:
        said = f"none of the restarts came back to it (cost {worse:.10g} instead of {cost:.10g})"
    return (
        f"Whether this is the optimum is not certain: {said}. The recording determines the calibration weakly. Record "
        "more views, with more varied tilt and distance."
    )


def _left(fit: RobustFit, step: np.ndarray, chain: np.ndarray, sigmas: float) -> tuple[RigState, bool]:
    """The state that is away from the optimum by a step (P,) of the shared parameters, so many sigmas along each of
    their directions, and the chain's (K, B); or nearer where that is no place to start; and whether it had to be
    nearer."""
    before = float(fit.result.equations.cost)
    promised = 0.5 * sigmas**2 * int(np.sum(np.asarray(fit.problem.free)))
    for halving in range(_HALVINGS):
        share = 0.5**halving
        start, cost = _moved(fit.problem, fit.state, on_device(share * chain), on_device(share * step))
        if float(cost) - before <= _BELIEVABLE * share**2 * promised:
            break
    logger.info("restart from %g of the way, cost %.9g", share, float(cost))
    return start, halving > 0


@stored_jit
def _moved(problem: RigProblem, state: RigState, chain: Array, shared: Array) -> tuple[RigState, Array]:
    """The state after a step, and its cost without the robust loss."""
    moved = problem.retract(state, chain, shared)
    return moved, 0.5 * jnp.sum(problem.residuals(moved) ** 2)


def _following(equations: BlockArrow, shared: np.ndarray) -> np.ndarray:
    """The step (K, B) of the chain that makes the best of a step (P,) of the shared parameters, were the cost
    quadratic."""
    band = np.asarray(equations.band)
    blocks, width, size, _ = band.shape
    # LAPACK's lower band storage: row i + d of column i stands in row d.
    lower = np.zeros((width * size, blocks * size))
    for column in range(size):
        below = band[:, :, :, column].reshape(blocks, width * size)[:, column:]
        lower[: width * size - column, column::size] = below.T
    # As the covariance does: what nothing observes (knots in a gap) must not spoil the factor.
    lower[0] += 1e-13 * np.maximum(lower[0], 1e-6 * lower[0].max())
    force = -np.asarray(equations.border).reshape(blocks * size, -1) @ shared
    return solveh_banded(lower, force, lower=True).reshape(blocks, size)


def _displacement(fit: RobustFit, sigmas: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
    """A step of the shared parameters (P,), so many sigmas along each of their directions, to either side, and that of
    the chain (K, B) with it; None where directions, or poses, are not determined."""
    free = np.asarray(fit.problem.free)
    values, directions = shared_information(fit.result.equations, free)
    if not len(values) or values.min() <= 0:
        return None
    step = np.zeros(len(free))
    step[free] = directions @ (sigmas * rng.choice([-1.0, 1.0], size=len(values)) / np.sqrt(values))
    try:
        return step, _following(fit.result.equations, step)
    except np.linalg.LinAlgError:
        return None
