"""Where a point appears through a lens, with the derivatives that every fit needs, and spends its time on."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.cameras import CameraModel
from jaxcal.estimation.scalars import written_out

# One coordinate of a pixel, its derivatives by the point's three coordinates, and those by the lens, in parts of any
# length: numbers where a model is a formula, a vector where it is a table.
Coordinate = tuple[Array, Sequence[Array], Sequence[Array]]


def pixel_derivatives(
    template: CameraModel, lens: Float[Array, " n"], camera_point: Float[Array, "3"]
) -> list[Coordinate]:
    """The coordinates u and v, px, of one point in the camera's frame.

    For many points, map it with their axis last: `jax.vmap(..., in_axes=1, out_axes=-1)`. Pulled back coordinate by
    coordinate: twice as fast as `jacrev`, which carries a batch of unit vectors along.
    """

    def project(camera_point: Array, lens: Array) -> Array:
        return template.with_parameters(lens).project(camera_point)

    by_numbers = written_out(project, (3, lens.shape[0]))
    if by_numbers is None:
        pixel, pull = jax.vjp(project, camera_point, lens)
        pulled = [pull(unit) for unit in (jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))]
        return [(value, list(by_point), [by_lens]) for value, (by_point, by_lens) in zip(pixel, pulled, strict=True)]

    def of(coordinate: int) -> Coordinate:
        value, pull = jax.vjp(lambda *numbers: by_numbers(numbers[:3], numbers[3:])[coordinate], *camera_point, *lens)
        by = pull(jnp.ones_like(value))
        return value, by[:3], by[3:]

    return [of(0), of(1)]
