"""Coordinates in which a lens' parameters are told apart.

Numerator and denominator of a rational lens nearly cancel; normal equations in the parameters themselves lose what is
left in rounding.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.calibration.state import SharedLayout
from jaxcal.cameras import CameraModel
from jaxcal.estimation import BlockArrow, factorise, single_threaded_blas
from jaxcal.programs import stored_jit

# Per group: columns (C_g, n, n) along which a step moves the parameters; None where steps are of the parameters.
LensBasis = tuple[Float[Array, "_ _ _"] | None, ...]


def own_parameters(models: Sequence[CameraModel], layout: SharedLayout) -> LensBasis:
    """To begin with, steps along the parameters; None for models whose parameters are always told apart."""
    return tuple(
        jnp.tile(jnp.eye(models[members[0]].num_parameters), (len(members), 1, 1))
        if models[members[0]].usual_spread
        else None
        for members in layout.groups
    )


def told_apart(basis: LensBasis, equations: BlockArrow, free: np.ndarray, layout: SharedLayout) -> LensBasis:
    """The basis whose directions do not correlate in these equations, which are in terms of `basis`.

    Rows of a Jacobian taken along them hold small differences at full precision, where differences of large normal
    equations hold none.
    """
    if all(columns is None for columns in basis):
        return basis
    with single_threaded_blas():
        schur = np.asarray(_schur(equations))
    return tuple(
        columns
        if columns is None
        else jnp.stack([columns[i] @ _apart(schur, layout.lens(c), free) for i, c in enumerate(members)])
        for columns, members in zip(basis, layout.groups, strict=True)
    )


def to_parameters(basis: LensBasis, layout: SharedLayout) -> np.ndarray | None:
    """The matrix (P, P) from steps in terms of the basis to steps of the shared parameters; None for none."""
    if all(columns is None for columns in basis):
        return None
    matrix = np.eye(layout.size)
    for columns, members in zip(basis, layout.groups, strict=True):
        for i, c in enumerate(members if columns is not None else ()):
            matrix[layout.lens(c), layout.lens(c)] = np.asarray(columns)[i]
    return matrix


@stored_jit
def _schur(equations: BlockArrow) -> Array:
    chain, shared = equations.diagonal()
    return factorise(equations, 1e-13 * jnp.maximum(chain, 1e-6 * jnp.max(chain)), jnp.zeros_like(shared)).schur


def _apart(schur: np.ndarray, rows: slice, free: np.ndarray) -> np.ndarray:
    """Eigenvectors of a lens' information scaled to unit diagonal, in its own units; held ones stay by themselves."""
    free = free[rows]
    matrix = np.eye(len(free))
    information = schur[rows, rows][np.ix_(free, free)]
    if np.isfinite(information).all() and len(information):
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        _, vectors = np.linalg.eigh(information * scale[:, None] * scale)
        matrix[np.ix_(free, free)] = scale[:, None] * vectors
    return matrix
