"""Optima at the other end of a valley: a lens is walked along what its corners tell worst, and let go."""

import equinox as eqx
import numpy as np

from jaxcal.calibration.problem import LensPrior, RigProblem
from jaxcal.calibration.robust import RobustFit
from jaxcal.calibration.state import RigState, SharedLayout
from jaxcal.calibration.uncertainty import shared_information
from jaxcal.estimation import SolveResult, on_device, solve

# Costs that differ by less than this share are one optimum.
SAME_COST = 1e-8
# On bent ground the weakest direction of each lens is walked along, to so many sigmas on both sides, with all else
# following: two optima of nearly equal cost lie at the ends of a curved valley that no straight step stays in.
_WALK_SIGMAS = (10.0, 30.0)
# A walk need not be exact; it ends where the cost rises by more than this share of what a quadratic would.
ENOUGH_TO_WALK = 1e-5
_STEEP = 0.5
# Two-fold parameters are walked along to so many sigmas, however the cost rises: the other fold is five sigmas away
# where the ridge between is one sigma high, ten where it is two.
_FOLD_SIGMAS = (3.0, 10.0)
# An optimum so many sigmas away is another one; it is as good within three sigmas when it costs no more than this
# (half of 3 squared) beside.
RIVAL_SIGMAS = 3.0
AS_GOOD = 4.5
# How firmly a lens is held on the way, beside what the corners say of it.
HOLD = 1e4


def along_the_valley(fit: RobustFit, max_steps: int) -> tuple[SolveResult | None, bool]:
    """The lowest optimum met from points of the lenses' weakest directions, None where none is below the fit's own; and
    whether another optimum is as good."""
    problem, layout = fit.problem, fit.problem.layout
    best, own_cost, rivalled = None, float(fit.result.equations.cost), False
    lowest = own_cost
    for camera in range(layout.num_cameras):
        covariance = lens_covariance(fit, camera)
        functional = None if covariance is None else weakest(covariance)
        # Lenses whose parameters nearly cancel have valleys without an end, and a prior that says where to stay.
        if functional is None or problem.basis[layout.place(camera)[0]] is not None:
            continue
        for side in (1.0, -1.0):
            state = fit.state
            for sigmas in _WALK_SIGMAS:
                held = _held_at(problem, fit.state, camera, functional, side * sigmas)
                there = solve(held, state, max_steps=max_steps, rtol=ENOUGH_TO_WALK)
                state = there.state
                flat = float(there.equations.cost) - own_cost <= _STEEP * 0.5 * sigmas**2
                if not flat:  # or not a number
                    break
                released = solve(problem, state, max_steps=max_steps)
                cost = float(released.equations.cost)
                if not (bool(released.converged) and np.isfinite(cost)):
                    continue
                away = functional @ (lens_of(layout, released.state, camera) - lens_of(layout, fit.state, camera))
                rivalled = rivalled or bool(abs(away) > RIVAL_SIGMAS and abs(cost - own_cost) < AS_GOOD)
                if cost < lowest * (1.0 - SAME_COST):
                    best, lowest = released, cost
    return best, rivalled


def across_the_fold(fit: RobustFit, camera: int, max_steps: int) -> list[SolveResult]:
    """Optima reached from both sides along each direction of the lens' `two_fold` parameters: towards its mirror image
    an optimum need not be known worst."""
    problem = fit.problem
    template = problem.templates[problem.layout.place(camera)[0]]
    names = [name for part in template.parameter_names for name in part]
    places = [names.index(name) for name in template.two_fold]
    covariance = lens_covariance(fit, camera) if places else None
    if covariance is None:
        return []
    values, vectors = np.linalg.eigh(covariance[np.ix_(places, places)])
    reached = []
    for value, vector in zip(values, vectors.T, strict=True):
        functional = np.zeros(len(names))
        functional[places] = vector / np.sqrt(max(value, np.finfo(float).tiny))
        for side in (1.0, -1.0):
            state = fit.state
            for sigmas in _FOLD_SIGMAS:
                held = _held_at(problem, fit.state, camera, functional, side * sigmas)
                state = solve(held, state, max_steps=max_steps, rtol=ENOUGH_TO_WALK).state
                released = solve(problem, state, max_steps=max_steps)
                if bool(released.converged) and np.isfinite(float(released.equations.cost)):
                    reached.append(released)
    return reached


def lens_of(layout: SharedLayout, state: RigState, camera: int) -> np.ndarray:
    """The parameters (n,) of a camera's lens."""
    group, place = layout.place(camera)
    return np.asarray(state.lenses[group])[place]


def lens_covariance(fit: RobustFit, camera: int) -> np.ndarray | None:
    """The covariance (n, n) of a camera's lens; None where directions are not determined."""
    free = np.asarray(fit.problem.free)
    values, directions = shared_information(fit.result.equations, free)
    if not len(values) or values.min() <= 0:
        return None
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(free, free)] = (directions / values) @ directions.T
    own = fit.problem.layout.lens(camera)
    group, place = fit.problem.layout.place(camera)
    columns = fit.problem.basis[group]
    along = np.eye(own.stop - own.start) if columns is None else np.asarray(columns[place])
    return along @ covariance[own, own] @ along.T


def weakest(covariance: np.ndarray) -> np.ndarray | None:
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
    now = lens_of(problem.layout, state, camera)
    information = np.asarray(problem.prior.information[group])[place]
    mean = np.asarray(problem.prior.mean[group])[place]
    hold = HOLD * np.outer(functional, functional)
    # The sum of both quadratics is one about this mean (least squares: the information may be singular).
    wanted = information @ mean + HOLD * functional * (functional @ now + value)
    middle = np.linalg.lstsq(information + hold, wanted, rcond=None)[0]
    return with_prior(problem, camera, middle, information + hold)


def with_prior(problem: RigProblem, camera: int, mean: np.ndarray, information: np.ndarray) -> RigProblem:
    """The problem with another prior (n,), (n, n) of one lens; no program is compiled anew for it."""
    group, place = problem.layout.place(camera)
    means, informations = list(problem.prior.mean), list(problem.prior.information)
    means[group] = means[group].at[place].set(on_device(mean))
    informations[group] = informations[group].at[place].set(on_device(information))
    return eqx.tree_at(lambda p: p.prior, problem, LensPrior(tuple(means), tuple(informations)))
