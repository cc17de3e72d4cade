"""The extended unified camera model (Kalibr's `eucm-none`): fisheyes beyond 180 degrees, with a closed inverse."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.numerics import at_least, constant, first_pinhole, root


class Eucm(CameraModel):
    """`eucm-none`: alpha, beta, fx, fy, cx, cy (Khomutenko, Garcia & Martinet 2016; Usenko et al. 2018, section II-D).

    u = fx x / (alpha d + (1 - alpha) z) + cx with d = sqrt(beta (x^2 + y^2) + z^2); 0 <= alpha <= 1, beta > 0. The
    centre of the image has the focal length fx.
    """

    alpha: Float[Array, ""]
    beta: Float[Array, ""]
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]

    name: ClassVar[str] = "eucm-none"
    num_intrinsics: ClassVar[int] = 6
    projection_names: ClassVar[tuple[str, ...]] = ("alpha", "beta", "fx", "fy", "cx", "cy")

    def _distance(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        return root(self.beta * (point[:2] @ point[:2]) + point[2] ** 2)

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Pixel (2,) of a point (3,) in the camera frame, metres."""
        distance = self._distance(point)
        below = self.alpha * distance + (1.0 - self.alpha) * point[2]
        return self.focal * point[:2] / at_least(below, 1e-6 * distance) + self.centre

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Whether a point (3,) has a pixel of its own (Usenko et al. 2018, eq. 15 and 16)."""
        return point[2] > -edge_ratio(self.alpha) * self._distance(point)

    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        """The ray (3,) of unit length through a pixel (2,) (Usenko et al. 2018, eq. 17 to 20).

        Pixels outside the image of all points (alpha > 1/2 has such) give a ray of its rim.
        """
        plane = (pixel - self.centre) / self.focal
        r2 = self.beta * (plane @ plane)
        inside = 1.0 - (2.0 * self.alpha - 1.0) * r2
        depth = (1.0 - self.alpha**2 * r2) / at_least(self.alpha * root(inside) + 1.0 - self.alpha, 1e-9)
        ray = jnp.append(plane, depth)
        return ray / jnp.linalg.norm(ray)

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        """Focal length at the image's centre in pixels; alpha = 1/2, beta = 1: a stereographic lens."""
        return cls(constant(0.5), constant(1.0), *first_pinhole(focal, image_size))

    @classmethod
    def starts(cls, focal: float, image_size: tuple[int, int]) -> tuple["CameraModel", ...]:
        """A stereographic lens, a weaker barrel and a stronger one."""
        first = cls.from_focal(focal, image_size)
        return tuple(eqx.tree_at(lambda m: m.alpha, first, constant(alpha)) for alpha in (0.5, 0.2, 0.75))


def edge_ratio(alpha: Float[Array, ""]) -> Float[Array, ""]:
    """w of Usenko et al. 2018, eq. 9 and 16: alpha / (1 - alpha) up to alpha = 1/2, (1 - alpha) / alpha from there."""
    other = 1.0 - alpha
    return jnp.where(alpha <= 0.5, alpha / at_least(other, 0.25), other / at_least(alpha, 0.25))
