"""Many calibrations of cameras in one compiled call: the same views with other noise, or with other weights.

The problem is the calibration's own, at its optimum (`jaxcal.calibration.known`); runs differ in pixels and in the
weight of each view, so that they share shapes and one program, and follow each other in `lax.map`. Corners that the
calibration had rejected stay out; noise and weights are those that it had found.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.calibration.assemble import stack_groups, stack_weights
from jaxcal.calibration.known import KnownProblem, known_problem
from jaxcal.calibration.lens_basis import to_parameters
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.score_noise import design_effect
from jaxcal.calibration.state import RigState
from jaxcal.calibration.uncertainty import named_jacobian
from jaxcal.estimation import factorise, single_threaded_blas, solve_inside
from jaxcal.programs import stored_jit
from jaxcal.results import Calibration

_MAX_STEPS = 60


@dataclass(frozen=True)
class ManyFits:
    """What R runs gave: `states` (leaves with a leading axis R), `converged` (R,), `sigmas` (R, C) the corner noise of
    each camera, px, and `std` (R, P) the 1-sigma of the parameters in the order of the calibration's blocks."""

    states: RigState
    converged: np.ndarray
    sigmas: np.ndarray
    std: np.ndarray


@dataclass(frozen=True)
class Batch:
    """A calibration's problem made ready for many runs; `effects` (C,): how much less than their weights say the
    measured corners of each camera tell."""

    known: KnownProblem
    fitted: list[np.ndarray]
    noise_px: list[np.ndarray]
    effects: list[float]

    @property
    def num_views(self) -> int:
        """Views of the calibration that the runs draw from."""
        return self.known.num_views


def batch_of(calibration: Calibration) -> Batch:
    """The fit's own corners (F, N, 2) per camera, what the lens and the poses say without noise, and the noise of each
    corner (F, N), px. Raises CalibrationError as `known_problem` does."""
    known = known_problem(calibration)
    errors = known.errors(known.state)
    fitted = [frames.pixels + error for frames, error in zip(known.cameras, errors, strict=True)]
    return Batch(known, fitted, known.noise_px, _design_effects(known, errors))


def run_batch(batch: Batch, pixels: list[list[np.ndarray]] | None, of_view: np.ndarray) -> ManyFits:
    """Solve R runs. `pixels[r][c]` (F, N, 2) are the corners of run r (None: as measured), `of_view` (R, V) the views'
    weights. One program serves all calls with equal R."""
    known = batch.known
    weights = [
        stack_weights(
            known.layout,
            known.cameras,
            [w * factor[view][:, None] for w, view in zip(known.weights, known.views, strict=True)],
        )
        for factor in of_view
    ]
    taken = np.zeros((len(of_view), len(known.problem.free_chain)), dtype=bool)
    taken[:, : known.num_views] = of_view > 0
    measured = pixels if pixels is not None else [[frames.pixels for frames in known.cameras]] * len(of_view)
    stacked = [stack_groups(known.layout, [values.swapaxes(1, 2) for values in run]) for run in measured]
    groups = range(len(known.layout.groups))
    runs = (
        tuple(jnp.stack([run[g] for run in stacked]) for g in groups),
        tuple(jnp.stack([run[g] for run in weights]) for g in groups),
        jnp.asarray(taken),
    )
    with single_threaded_blas():
        states, converged, squares, schur = jax.block_until_ready(_many(known.problem, known.state, *runs))
    fits = _judged(batch, states, np.asarray(converged), np.asarray(squares), np.asarray(schur), of_view)
    if pixels is not None:
        return fits  # noise that was made is independent
    return replace(fits, std=fits.std * np.sqrt(_of_blocks(known, batch.effects)))


@stored_jit
def _many(
    problem: RigProblem,
    state: RigState,
    pixels: tuple[Float[Array, "R F 2 N"], ...],
    weights: tuple[Float[Array, "R F N"], ...],
    taken: Bool[Array, "R K"],
) -> tuple[RigState, Array, Array, Array]:
    """States, convergence, weighted squared errors (R, C) of each camera and information (R, P, P), run by run."""

    def one(run: tuple) -> tuple[RigState, Array, Array, Array]:
        own_pixels, own_weights, own_views = run
        mine = eqx.tree_at(
            lambda p: [*[d.pixels for d in p.corners], *[d.weight for d in p.corners], p.free_chain],
            problem,
            [*own_pixels, *own_weights, problem.free_chain & own_views[:, None]],
        )
        result = solve_inside(mine, state, max_steps=_MAX_STEPS)
        errors = mine.corner_errors(result.state)
        squares = jnp.zeros(problem.layout.num_cameras)
        for data, error in zip(mine.corners, errors, strict=True):
            of_frame = jnp.sum(data.weight * jnp.sum(error**2, axis=-1), axis=-1)
            squares = squares.at[data.rig_camera].add(of_frame)
        chain, shared = result.equations.diagonal()
        ridge = 1e-13 * jnp.maximum(chain, 1e-6 * jnp.max(chain))
        factor = factorise(result.equations, ridge, jnp.zeros_like(shared))
        return result.state, result.converged, squares, factor.schur

    return jax.lax.map(one, (pixels, weights, taken))


def _judged(
    batch: Batch, states: RigState, converged: np.ndarray, squares: np.ndarray, schur: np.ndarray, of_view: np.ndarray
) -> ManyFits:
    """Corner noise with its degrees of freedom, and the sigmas that each run would have stated."""
    known, calibration = batch.known, batch.known.calibration
    layout, free = known.layout, known.free
    cameras_in_view = np.bincount(np.concatenate(known.views), minlength=known.num_views)
    own_parameters = [
        float(free[layout.lens(c)].sum() + free[layout.pose(c)].sum() + free[layout.target].sum() / layout.num_cameras)
        for c in range(layout.num_cameras)
    ]
    ratio = np.empty_like(squares)
    for c, (kept, view) in enumerate(zip(known.kept, known.views, strict=True)):
        corners = 2.0 * of_view[:, view] @ kept.sum(axis=1)
        poses = 6.0 * (of_view[:, view] > 0) @ (1.0 / cameras_in_view[view])
        ratio[:, c] = squares[:, c] / np.maximum(corners - poses - own_parameters[c], 1.0)
    sigma = np.array([camera.corner_sigma_px for camera in calibration.cameras])
    information = schur[:, free][:, :, free]
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-300))
    inverse = np.linalg.pinv(information * scale[:, :, None] * scale[:, None, :], hermitian=True)
    covariance = np.zeros_like(schur)
    covariance[:, free[:, None] & free] = (inverse * scale[:, :, None] * scale[:, None, :]).reshape(len(schur), -1)
    back = to_parameters(known.problem.basis, layout)
    if back is not None:
        covariance = back @ covariance @ back.T
    jacobian = _named_jacobian(known)
    variance = np.einsum("np,rpq,nq->rn", jacobian, covariance, jacobian, optimize=True)
    variance *= known.inflation * np.mean(ratio, axis=1)[:, None]
    return ManyFits(states, converged, sigma * np.sqrt(ratio), np.sqrt(np.maximum(variance, 0.0)))


def _design_effects(known: KnownProblem, errors: Sequence[np.ndarray]) -> list[float]:
    """By how much the corners of each camera tell less than their weights and `known.inflation` say."""
    points, effects = known.calibration.target_points, []
    for camera, frames, own, weights in zip(
        known.calibration.cameras, known.cameras, errors, known.weights, strict=True
    ):
        assert camera.T_cam_target is not None  # or there would be no known problem
        effect = design_effect(camera.model, points, camera.T_cam_target[frames.frames], own, weights)
        effects.append(max(effect / known.inflation, 1.0))
    return effects


def _of_blocks(known: KnownProblem, effects: Sequence[float]) -> np.ndarray:
    """(n,) the design effect of each parameter: its camera's, or that of the worst where several have part in it."""
    calibration = known.calibration
    own = {camera.name: effect for camera, effect in zip(calibration.cameras, effects, strict=True)}
    factors = [
        np.full(size, max(effects) if "T_cn" in block else own.get(block.partition(".")[0], max(effects)))
        for block, size in calibration.blocks
    ]
    return np.concatenate(factors)


def _named_jacobian(known: KnownProblem) -> np.ndarray:
    """(n, P) from the shared tangent vector to the parameters as the calibration's blocks name them."""
    cameras = known.calibration.cameras
    names, intrinsics = [camera.name for camera in cameras], [camera.model.num_intrinsics for camera in cameras]
    return named_jacobian(names, known.layout, known.state, intrinsics, with_imu=False, with_time=False)[1]
