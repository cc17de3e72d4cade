"""The move of a camera that explains most of the difference between two of its calibrations, and what then remains.

Two lenses that differ by what a turn or a shift of the camera undoes are the same lens (mrcal, "Differencing",
https://mrcal.secretsauce.net/differencing.html). So points are put where the first calibration sees them, at several
ranges; the rigid move is found that brings their projections by the second closest to their pixels; and the difference
is what is left.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras import CameraModel
from jaxcal.programs import stored_jit
from jaxcal.results.rays import rays_through

# Differences beyond this multiple of their median count less: where a lens was not seen it may be anywhere.
_SOFT = 3.0


@dataclass(frozen=True)
class ImpliedDifference:
    """`pose` (4, 4) maps points from the first calibration's camera frame to the second's; `difference_px` (R, K, 2) is
    the second's projection minus the first's, per range and pixel, NaN where either lens has no answer."""

    pose: np.ndarray
    difference_px: np.ndarray


def implied_difference(
    first: CameraModel,
    second: CameraModel,
    pixels: np.ndarray,
    ranges_m: tuple[float, ...],
    weight: np.ndarray,
) -> ImpliedDifference:
    """Fit the move over `pixels` (K, 2) and the ranges (m; inf: directions), and tell what remains.

    `weight` (R, K) multiplies differences, 1 / sigma, 0 or NaN: not to be fitted. With directions alone the move is a
    turn. Ranges of weight zero take no part in the fit but are told.
    """
    rays, valid = rays_through(first, pixels)
    inverse = np.array([0.0 if np.isinf(r) else 1.0 / r for r in ranges_m])
    weight = np.where(valid & np.isfinite(weight), weight, 0.0)
    fitted = weight.any(axis=1)
    free = np.arange(6) < (6 if inverse[fitted].any() else 3)

    def moved_by(vector: np.ndarray, k: int) -> tuple[np.ndarray, ...]:
        return tuple(
            np.asarray(part) for part in _moved(second, jnp.asarray(rays), jnp.asarray(inverse[k]), jnp.asarray(vector))
        )

    def at(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted residuals (N,) and Jacobian (N, 6) of the ranges that are fitted."""
        residuals, jacobians = [], []
        for k in np.flatnonzero(fitted).tolist():
            moved, jacobian, seen = moved_by(vector, k)
            w = np.where(seen, weight[k], 0.0)[:, None]
            residuals.append((np.where(w > 0, moved - pixels, 0.0) * w).ravel())
            jacobians.append((np.where(w[..., None] > 0, jacobian, 0.0) * w[..., None]).reshape(-1, 6))
        return np.concatenate(residuals), np.concatenate(jacobians)

    vector = np.zeros(6)
    if fitted.any():
        vector = _fit(at, free)
    parts = []
    for k in range(len(ranges_m)):
        moved, _, seen = moved_by(vector, k)
        parts.append(np.where((seen & valid)[:, None], moved - pixels, np.nan))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.asarray(jaxlie.SO3.exp(jnp.asarray(vector[:3])).as_matrix()), vector[3:]
    return ImpliedDifference(pose, np.stack(parts))


def _fit(at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], free: np.ndarray) -> np.ndarray:
    """The move (6,) of least squares, then of least softened squares, over the entries that are `free`."""
    from scipy.optimize import least_squares  # 0.2 s, which results that nobody compares can do without

    def whole(part: np.ndarray) -> np.ndarray:
        vector = np.zeros(6)
        vector[free] = part
        return vector

    def residuals(part: np.ndarray) -> np.ndarray:
        return at(whole(part))[0]

    def derivative(part: np.ndarray) -> np.ndarray:
        return at(whole(part))[1][:, free]

    jacobian: Any = derivative  # scipy's annotations know of names only

    first = least_squares(residuals, np.zeros(int(free.sum())), jacobian, x_scale="jac").x
    sizes = np.abs(at(whole(first))[0])
    used = sizes[sizes > 0]
    if not len(used):
        return whole(first)
    scale = _SOFT * float(np.median(used))
    return whole(least_squares(residuals, first, jacobian, x_scale="jac", loss="soft_l1", f_scale=scale).x)


@stored_jit
def _moved(
    model: CameraModel, rays: Float[Array, "K 3"], inverse_range: Float[Array, ""], vector: Float[Array, "6"]
) -> tuple[Array, Array, Array]:
    """Pixels (K, 2) of points on rays after a move (rotation vector, translation), their derivatives (K, 2, 6) by the
    move, and whether the lens has them (K,)."""

    def place(vector: Array, ray: Array) -> Array:
        return jaxlie.SO3.exp(vector[:3]) @ ray + inverse_range * vector[3:]

    def project(vector: Array, ray: Array) -> Array:
        return model.project(place(vector, ray))

    pixels = jax.vmap(project, in_axes=(None, 0))(vector, rays)
    jacobian = jax.vmap(jax.jacfwd(project), in_axes=(None, 0))(vector, rays)
    return pixels, jacobian, jax.vmap(lambda ray: model.is_valid(place(vector, ray)))(rays)
