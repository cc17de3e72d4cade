"""Robust losses on squared, noise-normalised residuals."""

from typing import Literal, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.errors import CalibrationError

Loss = Literal["huber", "cauchy", "geman-mcclure", "barron"]
LOSSES: tuple[str, ...] = get_args(Loss)

# Barron's shape: between Cauchy (0) and Geman-McClure (-2).
_BARRON_SHAPE = -1.0


def robust_loss(
    kind: str, squared: Float[Array, "*shape"], width: Float[Array, ""] | float
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """The loss called `kind` of s = r'r, with its scale `width` in sigmas: (rho, weight).

    `weight` is drho/ds, the factor of iteratively re-weighted least squares. All losses are s itself for small s, and
    for an infinite `width` everywhere. 'barron' is the general loss with shape -1 (`barron`).

    Raises CalibrationError when there is no such loss.
    """
    if kind == "huber":
        return huber(squared, width)
    # Keeps inf * 0 out of the branch that is not taken.
    finite = jnp.where(jnp.isfinite(width), width, 1.0)
    ratio = squared / finite**2
    if kind == "cauchy":
        rho, weight = jnp.log1p(ratio), 1.0 / (1.0 + ratio)
    elif kind == "geman-mcclure":
        rho, weight = ratio / (1.0 + ratio), 1.0 / (1.0 + ratio) ** 2
    elif kind == "barron":
        return _plain_where_infinite(*barron(squared, finite, _BARRON_SHAPE), squared, width)
    else:
        raise CalibrationError(f"robust loss '{kind}' is unknown; known: {', '.join(LOSSES)}.")
    return _plain_where_infinite(rho * finite**2, weight, squared, width)


def _plain_where_infinite(rho: Array, weight: Array, squared: Array, width: Array | float) -> tuple[Array, Array]:
    plain = ~jnp.isfinite(width)
    return jnp.where(plain, squared, rho), jnp.where(plain, 1.0, weight)


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


def barron(
    squared: Float[Array, "*shape"], width: Float[Array, ""] | float, shape: float
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Barron's general loss of s = r'r (Barron, "A general and adaptive robust loss function", CVPR 2019, eq. 8 and
    10, times 2 width^2 so that it is s for small s): (rho, weight).

    `shape` (alpha) 2 is plain least squares, 1 Charbonnier, 0 Cauchy, -2 Geman-McClure, lower ever harder; `width` is
    finite.
    """
    ratio = squared / width**2
    if shape == 2.0:
        return squared, jnp.ones_like(squared)
    if shape == 0.0:
        return 2.0 * width**2 * jnp.log1p(0.5 * ratio), 1.0 / (1.0 + 0.5 * ratio)
    b = abs(shape - 2.0)
    # log1p and expm1: differences of powers near one would drown small residuals in rounding.
    logarithm = jnp.log1p(ratio / b)
    rho = 2.0 * width**2 * b / shape * jnp.expm1(0.5 * shape * logarithm)
    return rho, jnp.exp((0.5 * shape - 1.0) * logarithm)
