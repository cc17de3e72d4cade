"""The omnidirectional (unified) camera model of Mei (Kalibr's `omni-none` and `omni-radtan`)."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras import distortions
from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.numerics import at_least, constant, first_pinhole, keeps_orientation, length, rises_until, root


class OmniModel(CameraModel):
    """Mei's camera: u = fx x' + cx, v = fy y' + cy with (x', y') the distorted (x, y) / (z + xi |(x, y, z)|).

    Mei & Rives 2007, section II (their gamma is the focal length here). The centre of the image has the focal length
    fx / (1 + xi).
    """

    xi: Float[Array, ""]
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    coefficients: Float[Array, " d"]

    num_intrinsics: ClassVar[int] = 5
    projection_names: ClassVar[tuple[str, ...]] = ("xi", "fx", "fy", "cx", "cy")

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        raise TypeError(f"{type(self).__name__} defines no distortion")  # the base is never built

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Pixel (2,) of a point (3,) in the camera frame, metres."""
        return self.focal * self._distort(self._plane(point)) + self.centre

    def _plane(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        distance = length(point)
        return point[:2] / at_least(point[2] + self.xi * distance, 1e-6 * distance)

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Whether a point (3,) has a pixel of its own (Usenko et al. 2018, eq. 8 and 9, in terms of xi)."""
        edge = jnp.where(self.xi <= 1.0, self.xi, 1.0 / at_least(self.xi, 0.5))
        return point[2] > -edge * length(point)

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        """Focal length at the image's centre in pixels; xi = 1: a stereographic lens, so fx is twice that."""
        middle = first_pinhole(2.0 * focal, image_size)
        return cls(constant(1.0), *middle, coefficients=constant(np.zeros(len(cls.distortion_names))))

    @classmethod
    def starts(cls, focal: float, image_size: tuple[int, int]) -> tuple["CameraModel", ...]:
        """From nearly a pinhole (small xi) to the strongest barrel."""
        first = cls.from_focal(focal, image_size)
        return tuple(
            eqx.tree_at(lambda m: (m.xi, m.focal), first, (constant(xi), constant([focal * (1.0 + xi)] * 2)))
            for xi in (1.0, 0.3, 2.0)
        )


class Omni(OmniModel):
    """`omni-none`: xi, fx, fy, cx, cy."""

    name: ClassVar[str] = "omni-none"

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return distortions.no_distortion(plane)

    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        """The ray (3,) of unit length through a pixel (2,) (Mei & Rives 2007, eq. 5).

        Pixels outside the image of all points (xi > 1 has such) give a ray of its rim.
        """
        plane = (pixel - self.centre) / self.focal
        r2 = plane @ plane
        stretch = (self.xi + root(1.0 + (1.0 - self.xi**2) * r2)) / (1.0 + r2)
        ray = jnp.append(stretch * plane, stretch - self.xi)
        return ray / jnp.linalg.norm(ray)


class OmniRadtan(OmniModel):
    """`omni-radtan`: xi, fx, fy, cx, cy; k1, k2, p1, p2 (Mei & Rives 2007 with the first four terms, as in Kalibr)."""

    name: ClassVar[str] = "omni-radtan"
    distortion_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2")

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return distortions.radtan(plane, self.coefficients)

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """As without distortion, and nearer to the axis than where the distortion folds the image back."""

        def radius(angle: Float[Array, ""]) -> Float[Array, ""]:
            undistorted = jnp.sin(angle) / at_least(jnp.cos(angle) + self.xi, 1e-6)
            return undistorted * distortions.radtan_radial(undistorted**2, self.coefficients)

        rises = rises_until(radius, jnp.arctan2(length(point[:2]), point[2]))
        return super().is_valid(point) & rises & keeps_orientation(self._distort, self._plane(point))
