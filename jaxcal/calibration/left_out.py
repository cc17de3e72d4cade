"""How far a rig is off when the corners of one of its cameras err together, by leaving that camera out for a while.

What all corners of an image share, and of the images after it (a network that makes frames of events, a shutter that
lags), least squares cannot tell from a camera that sits elsewhere. Where other cameras or an IMU know the trajectory,
it can be told how much of it there is: by how far the optimum moves when the camera's corners of one stretch of the
recording after another are left out, beside how far it would with independent corners ("bias reduced linearization",
Bell and McCaffrey 2002, with stretches for clusters). The lens moves, and so do the camera's place in the rig, its time
offset and whatever else rests on it. One step of Gauss and Newton each, trajectory included.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.calibration.assemble import CameraFrames, split_groups, stack_weights
from jaxcal.calibration.robust import RobustFit
from jaxcal.calibration.score_noise import LEAST_LEFT, STRETCHES, of_few, usual_effect
from jaxcal.calibration.uncertainty import UNOBSERVED, shared_information
from jaxcal.estimation import BlockArrow, factorise, single_threaded_blas, solve
from jaxcal.programs import stored_jit

# Directions of which a camera tells less than this share are others' to tell.
_LEAST_SHARE = 0.1
# Of a camera's weights, to see how much it tells; and of the diagonal, which holds no determined direction back.
_LITTLE, _HARDLY_DAMPED = 1e-3, 1e-12


@dataclass(frozen=True)
class Wandering:
    """How far the errors of one camera's corners lead the shared parameters astray.

    `effect`: the usual variance of the directions that the camera tells, beside that of independent corners;
    `directions` (P, D), each of a length of one standard deviation were corners independent; `variance` (D,) beside
    that.
    """

    effect: float
    directions: np.ndarray
    variance: np.ndarray

    def beyond(self, allowed: float) -> np.ndarray:
        """Covariance (P, P) of the shared parameters to be added where corners count as if independent, of `allowed`
        times the variance. No direction is taken to be known better than is usual."""
        more = np.maximum(np.maximum(self.variance, self.effect) - allowed, 0.0)
        return (self.directions * more) @ self.directions.T


def wandering(fit: RobustFit, cameras: Sequence[CameraFrames], camera: int) -> Wandering | None:
    """How far the optimum goes astray with the corners of `camera`; None where hardly anything rests on them.

    In the coordinates of the fit's equations. Of the other sensors, noise is taken to be independent.
    """
    free = np.flatnonzero(np.asarray(fit.problem.free))
    known, directions = shared_information(fit.result.equations, np.asarray(fit.problem.free))
    told = known > UNOBSERVED
    whitened = directions[:, told] / np.sqrt(known[told])

    def without(part: slice | np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Information (D, D) and gradient (D,) with that share of the weights of the camera's frames `part` gone."""
        weights = [own.copy() for own in corner_weights(fit, cameras)]
        weights[camera][part] *= 1.0 - share
        schur, gradient = reduced(equations_with(fit, cameras, weights))
        return whitened.T @ schur[np.ix_(free, free)] @ whitened, whitened.T @ gradient[free]

    # How the information answers to the camera's weights is what the camera tells.
    share, axes = np.linalg.eigh((np.eye(whitened.shape[1]) - without(slice(None), _LITTLE)[0]) / _LITTLE)
    some = share > _LEAST_SHARE
    if not some.any():
        return None
    axes, root = axes[:, some], np.sqrt(share[some])
    moved, expected = [], np.zeros((len(root), len(root)))
    for stretch in np.array_split(np.arange(len(cameras[camera].frames)), STRETCHES):
        left, gradient = without(stretch, 1.0)
        values, vectors = np.linalg.eigh(left)
        along = axes.T @ vectors
        # With independent corners the gradient's covariance is left (1 - left). Over the root of what is left, it is
        # 1 - left: what the stretch tells.
        known_without = np.maximum(values, LEAST_LEFT)
        moved.append(along @ (vectors.T @ gradient / np.sqrt(known_without)))
        expected += (along * (np.maximum(values, 0.0) / known_without * (1.0 - values))) @ along.T
    usual, turned = np.linalg.eigh(expected)
    beside = np.stack(moved) @ (turned / np.sqrt(np.maximum(usual, 1e-6))) @ turned.T
    variance, turned = np.linalg.eigh(of_few(STRETCHES - 1.0) * beside.T @ beside)
    full = np.zeros((len(fit.problem.free), len(variance)))
    full[free] = whitened @ (axes * root) @ turned
    return Wandering(usual_effect(variance), full, variance)


def corner_weights(fit: RobustFit, cameras: Sequence[CameraFrames]) -> list[np.ndarray]:
    """Weights (F, N) of the last least squares, per camera, px^-2."""
    return split_groups(fit.problem.layout, cameras, [np.asarray(data.weight) for data in fit.problem.corners])


def equations_with(fit: RobustFit, cameras: Sequence[CameraFrames], weights: Sequence[np.ndarray]) -> BlockArrow:
    """The equations at the optimum were the corners' weights (F, N) others."""
    stacked = stack_weights(fit.problem.layout, cameras, weights)
    problem = eqx.tree_at(lambda p: [data.weight for data in p.corners], fit.problem, list(stacked))
    return solve(problem, fit.state, max_steps=1).equations  # those that the first step would solve


def reduced(equations: BlockArrow) -> tuple[np.ndarray, np.ndarray]:
    """Information (P, P) and gradient (P,) of the shared parameters with the chain at its best."""
    with single_threaded_blas():
        schur, step = (np.asarray(part) for part in _shared_step(equations))
    return schur, -schur @ step


@stored_jit
def _shared_step(equations: BlockArrow) -> tuple[Float[Array, "P P"], Float[Array, " P"]]:
    chain, shared = equations.diagonal()
    # A pose that no camera is left to see stays where it is.
    floor = 1e-6 * jnp.max(chain)
    factor = factorise(equations, _HARDLY_DAMPED * jnp.maximum(chain, floor), _HARDLY_DAMPED * shared)
    _, step = factor.solve(-equations.gradient_chain, -equations.gradient_shared)
    return factor.schur, step
