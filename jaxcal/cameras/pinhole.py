"""Pinhole projection, with a distortion applied on the normalised image plane: what lies in front of the camera."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras import distortions
from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.numerics import at_least, constant, first_pinhole, keeps_orientation, length, rises_until

# Closer to the image plane than this angle (rad) nothing is projected: pixels there are a million focal lengths out.
_RIM = 1e-6
# Numerator and denominator of a rational lens may nearly cancel, whatever their size.
_RATIONAL_SPREAD: Mapping[str, float] = dict.fromkeys(("k1", "k2", "k3", "k4", "k5", "k6"), 1.0)
_PRISM_SPREAD: Mapping[str, float] = dict.fromkeys(("s1", "s2", "s3", "s4"), 0.03)


class PinholeModel(CameraModel):
    """Pinhole camera: u = fx x' + cx, v = fy y' + cy with (x', y') the distorted (x/z, y/z)."""

    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    coefficients: Float[Array, " d"]

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        raise TypeError(f"{type(self).__name__} defines no distortion")  # the base is never built

    def _radial(self, r2: Float[Array, ""]) -> Float[Array, ""]:
        """The radial factor of the distortion at a squared radius."""
        return jnp.ones_like(r2)

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Pixel (2,) of a point (3,) in the camera frame, metres."""
        # Points at or behind the image plane get a finite, far value; `is_valid` masks them.
        return self.focal * self._distort(point[:2] / at_least(point[2], _RIM)) + self.centre

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Whether a point (3,) lies in front, nearer to the axis than where the distortion folds the image back.

        The radial part is looked at all the way from the axis, the whole distortion at the point itself.
        """
        angle = jnp.arctan2(length(point[:2]), point[2])

        def radius(angle: Float[Array, ""]) -> Float[Array, ""]:
            undistorted = jnp.tan(angle)
            return undistorted * self._radial(undistorted**2)

        plane = point[:2] / at_least(point[2], _RIM)
        return rises_until(radius, angle, limit=jnp.pi / 2.0 - _RIM) & keeps_orientation(self._distort, plane)

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        middle = first_pinhole(focal, image_size)
        return cls(*middle, coefficients=constant(np.zeros(len(cls.distortion_names))))


class Pinhole(PinholeModel):
    """`pinhole-none`: fx, fy, cx, cy."""

    name: ClassVar[str] = "pinhole-none"

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return distortions.no_distortion(plane)

    def unproject(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        """The ray (3,) of unit length through a pixel (2,)."""
        ray = jnp.append((pixel - self.centre) / self.focal, 1.0)
        return ray / jnp.linalg.norm(ray)


class PinholeRadtan(PinholeModel):
    """`pinhole-radtan`: fx, fy, cx, cy; k1, k2, p1, p2 (Brown 1966, as in OpenCV's first four coefficients)."""

    name: ClassVar[str] = "pinhole-radtan"
    distortion_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2")

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return distortions.radtan(plane, self.coefficients)

    def _radial(self, r2: Float[Array, ""]) -> Float[Array, ""]:
        return distortions.radtan_radial(r2, self.coefficients)


class PinholeRadtan5(PinholeModel):
    """`pinhole-radtan5`: fx, fy, cx, cy; k1, k2, p1, p2, k3 (OpenCV's first five coefficients)."""

    name: ClassVar[str] = "pinhole-radtan5"
    distortion_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2", "k3")

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return distortions.radtan5(plane, self.coefficients)

    def _radial(self, r2: Float[Array, ""]) -> Float[Array, ""]:
        return distortions.radtan5_radial(r2, self.coefficients)


class PinholeRational8(PinholeModel):
    """`pinhole-rational8`: fx, fy, cx, cy; k1, k2, p1, p2, k3, k4, k5, k6 (OpenCV's CALIB_RATIONAL_MODEL)."""

    name: ClassVar[str] = "pinhole-rational8"
    distortion_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    usual_spread: ClassVar[Mapping[str, float]] = _RATIONAL_SPREAD

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return distortions.rational8(plane, self.coefficients)

    def _radial(self, r2: Float[Array, ""]) -> Float[Array, ""]:
        return distortions.rational8_radial(r2, self.coefficients)


class PinholeThinPrism12(PinholeModel):
    """`pinhole-thinprism12`: as `pinhole-rational8`, then s1, s2, s3, s4 (OpenCV's CALIB_THIN_PRISM_MODEL)."""

    name: ClassVar[str] = "pinhole-thinprism12"
    distortion_names: ClassVar[tuple[str, ...]] = (*PinholeRational8.distortion_names, "s1", "s2", "s3", "s4")
    usual_spread: ClassVar[Mapping[str, float]] = {**_RATIONAL_SPREAD, **_PRISM_SPREAD}

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return distortions.thin_prism12(plane, self.coefficients)

    def _radial(self, r2: Float[Array, ""]) -> Float[Array, ""]:
        return distortions.rational8_radial(r2, self.coefficients)


class PinholeTilted14(PinholeModel):
    """`pinhole-tilted14`: as `pinhole-thinprism12`, then tau_x, tau_y (OpenCV's CALIB_TILTED_MODEL)."""

    name: ClassVar[str] = "pinhole-tilted14"
    distortion_names: ClassVar[tuple[str, ...]] = (*PinholeThinPrism12.distortion_names, "tau_x", "tau_y")
    usual_spread: ClassVar[Mapping[str, float]] = {**PinholeThinPrism12.usual_spread, "tau_x": 0.05, "tau_y": 0.05}
    two_fold: ClassVar[tuple[str, ...]] = ("tau_x", "tau_y")

    def _distort(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        return distortions.tilted14(plane, self.coefficients)

    def _radial(self, r2: Float[Array, ""]) -> Float[Array, ""]:
        return distortions.rational8_radial(r2, self.coefficients)
