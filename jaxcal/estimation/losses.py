"""Robust losses on squared, noise-normalised residuals."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def huber(squared: Float[Array, "*shape"], width: Float[Array, ""] | float) -> tuple[Array, Array]:
    """Huber's loss (Huber 1964) of s = r'r: (rho, weight); rho = s inside `width`, 2 width sqrt(s) - width^2 beyond.

    `weight` is drho/ds, the factor of iteratively re-weighted least squares; an infinite `width` is plain least
    squares.
    """
    root = jnp.sqrt(jnp.maximum(squared, 1e-24))
    inside = root <= width
    finite = jnp.where(inside, 1.0, width)  # keeps inf * 0 out of the branch not taken
    return (
        jnp.where(inside, squared, 2.0 * finite * root - finite**2),
        jnp.where(inside, 1.0, finite / root),
    )
