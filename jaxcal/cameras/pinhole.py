"""Pinhole projection, with a distortion applied on the normalised image plane."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.distortions import equidistant, no_distortion, radtan


class _Pinhole(CameraModel):
    """Pinhole camera: u = fx x' + cx, v = fy y' + cy with (x', y') the distorted (x/z, y/z)."""

    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    coefficients: Float[Array, " d"]

    num_coefficients: ClassVar[int] = 0

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        raise TypeError(f"{type(self).__name__} defines no distortion")  # the base is never built

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Pixel (2,) of a point (3,) in the camera frame, metres."""
        # Points at or behind the image plane get a finite, far value; `is_valid` masks them.
        depth = jnp.where(point[2] > 1e-6, point[2], 1e-6)
        return self.focal * self._distort(point[:2] / depth) + self.centre

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        width, height = image_size
        return cls(
            focal=jnp.full(2, float(focal)),
            centre=jnp.array([(width - 1) / 2.0, (height - 1) / 2.0]),
            coefficients=jnp.zeros(cls.num_coefficients),
        )


class Pinhole(_Pinhole):
    """`pinhole-none`: fx, fy, cx, cy."""

    name: ClassVar[str] = "pinhole-none"

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return no_distortion(plane)


class PinholeRadtan(_Pinhole):
    """`pinhole-radtan`: fx, fy, cx, cy; k1, k2, p1, p2 (Brown 1966, as in OpenCV's first four coefficients)."""

    name: ClassVar[str] = "pinhole-radtan"
    num_coefficients: ClassVar[int] = 4

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return radtan(plane, self.coefficients)


class PinholeEquidistant(_Pinhole):
    """`pinhole-equi`: fx, fy, cx, cy; k1..k4 (Kannala & Brandt 2006, as in OpenCV's fisheye module)."""

    name: ClassVar[str] = "pinhole-equi"
    num_coefficients: ClassVar[int] = 4

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return equidistant(plane, self.coefficients)


BUILT_IN: tuple[type[Any], ...] = (Pinhole, PinholeRadtan, PinholeEquidistant)
