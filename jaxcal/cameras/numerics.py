"""Square roots and quotients whose values and gradients stay finite everywhere, and the test for a fold."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# Added under roots of squared metres: without effect on points more than a micrometre away, finite gradients at zero.
_TINY = 1e-24
_FOLD_SAMPLES = 32


def constant(values: Any) -> Float[Array, "..."]:
    """Known numbers as an array of the device, in double precision.

    `jnp.full` and its like compile a program for each shape, in every process anew: half a second in all.
    """
    return jax.device_put(np.asarray(values, dtype=np.float64))


def first_pinhole(focal: float, image_size: tuple[int, int]) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Focal lengths (2,) in pixels, equal, and the image's centre (2,): pixel centres have whole numbers."""
    width, height = image_size
    return constant([focal, focal]), constant([(width - 1) / 2.0, (height - 1) / 2.0])


def root(value: Float[Array, ""]) -> Float[Array, ""]:
    """Square root of a scalar, as if it were at least 1e-24; the gradient below that is zero."""
    return jnp.sqrt(jnp.maximum(value, _TINY))


def length(vector: Float[Array, " n"]) -> Float[Array, ""]:
    """Euclidean length of a vector, with a finite gradient (zero) at the origin."""
    return jnp.sqrt(vector @ vector + _TINY)


def at_least(value: Float[Array, ""], floor: Float[Array, ""] | float) -> Float[Array, ""]:
    """The value where it exceeds `floor`, else `floor`: a denominator that cannot vanish."""
    return jnp.where(value > floor, value, floor)


def rises_until(
    profile: Callable[[Float[Array, ""]], Float[Array, ""]], angle: Float[Array, ""], limit: float | None = None
) -> Bool[Array, ""]:
    """Whether a radial profile (a function of the angle from the axis, rad) rises from 0 to `angle`, not folding back.

    A polynomial distortion reaches a largest radius where its derivative vanishes; points further out come back into
    the image, where other points already are. The derivative is looked at in 32 places between the axis and the angle,
    which is one of them. With `limit` (rad) the angle must also lie below it.
    """
    inside = jnp.asarray(True) if limit is None else angle < limit
    places = jnp.where(inside, angle, 0.0) * jnp.arange(1, _FOLD_SAMPLES + 1) / _FOLD_SAMPLES
    values, slopes = jax.vmap(lambda place: jax.jvp(profile, (place,), (jnp.ones_like(place),)))(places)
    return inside & jnp.all((slopes > 0.0) & (values >= 0.0))


def keeps_orientation(
    image: Callable[[Float[Array, "2"]], Float[Array, "2"]], plane: Float[Array, "2"]
) -> Bool[Array, ""]:
    """Whether a map of the plane does not mirror the neighbourhood of a point: a fold lies where it begins to."""
    (a, b), (c, d) = jax.jacfwd(image)(plane)
    return a * d - b * c > 0.0
