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
from jaxcal.calibration.problem import LensPrior, RigProblem, corner_errors
from jaxcal.calibration.robust import RobustFit
from jaxcal.calibration.state import RigState, SharedLayout
from jaxcal.calibration.uncertainty import shared_information
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
# Costs that differ by less than this share are one optimum.
_SAME_COST = 1e-8
# On bent ground the weakest direction of each lens is walked along, to so many sigmas on both sides, with all else
# following: two optima of nearly equal cost lie at the ends of a curved valley that no straight step stays in.
_WALK_SIGMAS = (10.0, 30.0)
_MOST_WALKS = 4
# A walk need not be exact; it ends where the cost rises by more than this share of what a quadratic would.
_ENOUGH_TO_WALK = 1e-5
_STEEP = 0.5
# An optimum so many sigmas away is another one; it is as good within three sigmas when it costs no more than this
# (half of 3 squared) beside.
_RIVAL_SIGMAS = 3.0
_AS_GOOD = 4.5
_AMBIGUOUS = (
    "Two lenses explain the corners equally well: the optimum has a rival, many sigmas away in the parameters and "
    "nearly the same in its projections. Do not read the lens' single parameters; record more views, nearer to the rim."
)
# How firmly a lens is held on the way, beside what the corners say of it.
_HOLD = 1e4
# And how far parameters that nearly cancel may be from zero on the way, in terms of their usual spread.
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
    along the lenses' weakest directions. Returns the fit to use, and a sentence where restarts do not agree, or where
    another optimum is as good. Deterministic.
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
        if after < before * (1.0 - _SAME_COST):
            fit = dataclasses.replace(fit, result=result)
            agreed, bent, worse = 0, True, None
        elif after <= before * (1.0 + _SAME_COST):
            agreed += 1
        else:
            bent, worse = True, after
        bent = bent or halved
        if agreed >= (_ENOUGH_BENT if bent else _ENOUGH):
            break
    sentences = [_AMBIGUOUS] if ambiguous else []
    for walk in range(_MOST_WALKS if bent else 0):
        lower, rivalled = _along_the_valley(fit, max_steps)
        sentences = [_AMBIGUOUS] if ambiguous or rivalled else []
        if lower is None:
            break
        logger.info(
            "walk %d: cost %.9g, from %.9g", walk, float(lower.equations.cost), float(fit.result.equations.cost)
        )
        fit = dataclasses.replace(fit, result=lower)
    errors = [np.asarray(e) for e in corner_errors(fit.problem, fit.state)]
    fit = dataclasses.replace(fit, errors=split_groups(fit.problem.layout, cameras, errors))
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
    if not reached:
        return fit, False
    lowest = min([fit.result, *reached], key=lambda result: float(result.equations.cost))
    before, after = float(fit.result.equations.cost), float(lowest.equations.cost)
    logger.info("rivals: cost %.9g, from %.9g", after, before)
    best = fit if after >= before * (1.0 - _SAME_COST) else dataclasses.replace(fit, result=lowest)
    others = [result for result in [fit.result, *reached] if result is not best.result]
    cameras = {camera for camera, _ in lenses}
    return best, any(_is_rival(best, other, camera) for other in others for camera in cameras)


def _from_rival(fit: RobustFit, camera: int, lens: CameraModel, max_steps: int) -> SolveResult | None:
    """Where the optimisation ends from another lens of a camera, to which all else is adapted first; None where lenses
    are held in part, or the end is no optimum."""
    covariance = _lens_covariance(fit, camera)
    if covariance is None or fit.problem.basis[fit.problem.layout.place(camera)[0]] is not None:
        return None
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    hold = np.where(sigma > 0, _HOLD / np.where(sigma > 0, sigma, 1.0) ** 2, 0.0)
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
    held = _with_prior(fit.problem, camera, parameters, np.diag(hold))
    adapted = solve(held, start, max_steps=max_steps, rtol=_ENOUGH_TO_WALK)
    result = solve(fit.problem, adapted.state, max_steps=max_steps)
    settled = bool(result.converged) and np.isfinite(float(result.equations.cost))
    return result if settled else None


def _is_rival(best: RobustFit, other: SolveResult, camera: int) -> bool:
    """Whether another optimum is as good as the best, and its lens another one."""
    covariance = _lens_covariance(best, camera)
    functional = None if covariance is None else _weakest(covariance)
    if functional is None:
        return False
    layout = best.problem.layout
    away = functional @ (_lens(layout, other.state, camera) - _lens(layout, best.state, camera))
    above = float(other.equations.cost) - float(best.result.equations.cost)
    return bool(abs(away) > _RIVAL_SIGMAS and abs(above) < _AS_GOOD)


def _lens_covariance(fit: RobustFit, camera: int) -> np.ndarray | None:
    """The covariance (n, n) of a camera's lens; None where directions are not determined."""
    free = np.asarray(fit.problem.free)
    values, directions = shared_information(fit.result.equations, free)
    if not len(values) or values.min() <= 0:
        return None
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(free, free)] = (directions / values) @ directions.T
    own = fit.problem.layout.lens(camera)
    return covariance[own, own]


def _along_the_valley(fit: RobustFit, max_steps: int) -> tuple[SolveResult | None, bool]:
    """The lowest optimum met from points of the lenses' weakest directions, None where none is below the fit's own; and
    whether another optimum is as good."""
    problem, layout = fit.problem, fit.problem.layout
    best, own_cost, rivalled = None, float(fit.result.equations.cost), False
    lowest = own_cost
    for camera in range(layout.num_cameras):
        covariance = _lens_covariance(fit, camera)
        functional = None if covariance is None else _weakest(covariance)
        # Lenses whose parameters nearly cancel have valleys without an end, and a prior that says where to stay.
        if functional is None or problem.basis[layout.place(camera)[0]] is not None:
            continue
        for side in (1.0, -1.0):
            state = fit.state
            for sigmas in _WALK_SIGMAS:
                held = _held_at(problem, fit.state, camera, functional, side * sigmas)
                there = solve(held, state, max_steps=max_steps, rtol=_ENOUGH_TO_WALK)
                state = there.state
                flat = float(there.equations.cost) - own_cost <= _STEEP * 0.5 * sigmas**2
                if not flat:  # or not a number
                    break
                released = solve(problem, state, max_steps=max_steps)
                cost = float(released.equations.cost)
                if not (bool(released.converged) and np.isfinite(cost)):
                    continue
                away = functional @ (_lens(layout, released.state, camera) - _lens(layout, fit.state, camera))
                rivalled = rivalled or bool(abs(away) > _RIVAL_SIGMAS and abs(cost - own_cost) < _AS_GOOD)
                if cost < lowest * (1.0 - _SAME_COST):
                    best, lowest = released, cost
    return best, rivalled


def _lens(layout: SharedLayout, state: RigState, camera: int) -> np.ndarray:
    group, place = layout.place(camera)
    return np.asarray(state.lenses[group])[place]


def _weakest(covariance: np.ndarray) -> np.ndarray | None:
    """The functional (n,) of a lens' parameters that is known worst for its size, in units of its sigma."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    moves = sigma > 0
    if moves.sum() < 2:
        return None
    scaled = covariance[np.ix_(moves, moves)] / np.outer(sigma[moves], sigma[moves])
    values, vectors = np.linalg.eigh(scaled)
    functional = np.zeros(len(sigma))
    functional[moves] = vectors[:, -1] / (np.sqrt(values[-1]) * sigma[moves])
    return functional


def _held_at(problem: RigProblem, state: RigState, camera: int, functional: np.ndarray, value: float) -> RigProblem:
    """The problem with a lens held where a functional of its parameters is off by `value` from those of `state`; said
    by its prior, so that no program is compiled anew."""
    group, place = problem.layout.place(camera)
    now = _lens(problem.layout, state, camera)
    information = np.asarray(problem.prior.information[group])[place]
    mean = np.asarray(problem.prior.mean[group])[place]
    hold = _HOLD * np.outer(functional, functional)
    # The sum of both quadratics is one about this mean (least squares: the information may be singular).
    wanted = information @ mean + _HOLD * functional * (functional @ now + value)
    middle = np.linalg.lstsq(information + hold, wanted, rcond=None)[0]
    return _with_prior(problem, camera, middle, information + hold)


def _with_prior(problem: RigProblem, camera: int, mean: np.ndarray, information: np.ndarray) -> RigProblem:
    """The problem with another prior (n,), (n, n) of one lens; no program is compiled anew for it."""
    group, place = problem.layout.place(camera)
    means, informations = list(problem.prior.mean), list(problem.prior.information)
    means[group] = means[group].at[place].set(on_device(mean))
    informations[group] = informations[group].at[place].set(on_device(information))
    return eqx.tree_at(lambda p: p.prior, problem, LensPrior(tuple(means), tuple(informations)))


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
