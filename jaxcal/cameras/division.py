"""The division model of Fitzgibbon (`pinhole-division`): one coefficient, both directions in closed form."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.numerics import at_least, constant, first_pinhole, length, root


class PinholeDivision(CameraModel):
    """`pinhole-division`: fx, fy, cx, cy; lambda (Fitzgibbon 2001, eq. 5), on the normalised image plane.

    A pixel at (x', y') on that plane, r' from the centre, is seen along (x', y', 1 + lambda r'^2): barrels have
    lambda < 0 and reach beyond 90 degrees (at lambda = -1/4 the lens is stereographic), pincushions lambda > 0.
    """

    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    bend: Float[Array, ""]

    name: ClassVar[str] = "pinhole-division"
    distortion_names: ClassVar[tuple[str, ...]] = ("lambda",)

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Pixel (2,) of a point (3,) in the camera frame, metres.

        The smaller root of lambda R r'^2 - z r' + R = 0, R = |(x, y)|.
        """
        off_axis, z = length(point[:2]), point[2]
        discriminant = z * z - 4.0 * self.bend * off_axis**2
        distance = root(discriminant)
        # Behind the camera z + distance cancels; the product of both roots does not. Only barrels see there.
        behind = at_least(-4.0 * self.bend, 1e-12) * off_axis**2 / at_least(distance - z, 1e-12)
        below = at_least(jnp.where(z > 0.0, z + distance, behind), 1e-6 * length(point))
        return self.focal * 2.0 * point[:2] / below + self.centre

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Whether a point (3,) has a pixel: within a pincushion's rim, anywhere but on a barrel's axis behind."""
        off_axis, z = length(point[:2]), point[2]
        angle = jnp.arctan2(off_axis, z)
        within = (z > 0.0) & (z * z > 4.0 * self.bend * off_axis**2)
        return jnp.where(self.bend < 0.0, angle < jnp.pi - 1e-6, within)

    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        """The ray (3,) of unit length through a pixel (2,)."""
        plane = (pixel - self.centre) / self.focal
        ray = jnp.append(plane, 1.0 + self.bend * (plane @ plane))
        return ray / jnp.linalg.norm(ray)

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        return cls(*first_pinhole(focal, image_size), constant(0.0))

    @classmethod
    def starts(cls, focal: float, image_size: tuple[int, int]) -> tuple["CameraModel", ...]:
        """A pinhole and a stereographic lens."""
        first = cls.from_focal(focal, image_size)
        return tuple(eqx.tree_at(lambda m: m.bend, first, constant(bend)) for bend in (0.0, -0.25))
