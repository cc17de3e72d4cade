"""The double sphere camera model (Kalibr's `ds-none`): fisheyes beyond 180 degrees, with a closed inverse."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.eucm import edge_ratio
from jaxcal.cameras.numerics import at_least, constant, first_pinhole, length, root


class DoubleSphere(CameraModel):
    """`ds-none`: xi, alpha, fx, fy, cx, cy (Usenko, Demmel & Cremers 2018, "The double sphere camera model").

    u = fx x / (alpha d2 + (1 - alpha) (xi d1 + z)) + cx with d1 = |(x, y, z)| and d2 = |(x, y, xi d1 + z)| (eq. 40 to
    42). The centre of the image has the focal length fx / (1 + xi).
    """

    xi: Float[Array, ""]
    alpha: Float[Array, ""]
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]

    name: ClassVar[str] = "ds-none"
    num_intrinsics: ClassVar[int] = 6
    projection_names: ClassVar[tuple[str, ...]] = ("xi", "alpha", "fx", "fy", "cx", "cy")

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Pixel (2,) of a point (3,) in the camera frame, metres."""
        distance = length(point)
        depth = self.xi * distance + point[2]
        below = self.alpha * length(jnp.append(point[:2], depth)) + (1.0 - self.alpha) * depth
        return self.focal * point[:2] / at_least(below, 1e-6 * distance) + self.centre

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Whether a point (3,) has a pixel of its own (Usenko et al. 2018, eq. 43 to 45)."""
        w1 = edge_ratio(self.alpha)
        w2 = (w1 + self.xi) / root(2.0 * w1 * self.xi + self.xi**2 + 1.0)
        return point[2] > -w2 * length(point)

    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        """The ray (3,) of unit length through a pixel (2,) (Usenko et al. 2018, eq. 46 to 50).

        Pixels outside the image of all points (alpha > 1/2 has such) give a ray of its rim.
        """
        plane = (pixel - self.centre) / self.focal
        r2 = plane @ plane
        inside = 1.0 - (2.0 * self.alpha - 1.0) * r2
        depth = (1.0 - self.alpha**2 * r2) / at_least(self.alpha * root(inside) + 1.0 - self.alpha, 1e-9)
        stretch = self.xi * depth + root(depth**2 + (1.0 - self.xi**2) * r2)
        ray = stretch / (depth**2 + r2) * jnp.append(plane, depth) - jnp.array([0.0, 0.0, 1.0]) * self.xi
        return ray / jnp.linalg.norm(ray)

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        """Focal length at the image's centre in pixels; xi = 0, alpha = 1/2: a stereographic lens."""
        return cls(constant(0.0), constant(0.5), *first_pinhole(focal, image_size))

    @classmethod
    def starts(cls, focal: float, image_size: tuple[int, int]) -> tuple["CameraModel", ...]:
        """A stereographic lens, a weaker barrel, the middle of the lenses in the paper's table 2, and its
        opposite: most lenses have two optima, on either side of xi = 0."""
        first = cls.from_focal(focal, image_size)
        return tuple(
            eqx.tree_at(
                lambda m: (m.xi, m.alpha, m.focal),
                first,
                (constant(xi), constant(alpha), constant([focal * (1.0 + xi)] * 2)),
            )
            for xi, alpha in ((0.0, 0.5), (0.0, 0.2), (-0.2, 0.6), (0.25, 0.6))
        )
