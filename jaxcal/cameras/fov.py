"""The field-of-view lens of Devernay and Faugeras (Kalibr's `pinhole-fov`), on the whole sphere."""

import math
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.numerics import constant, first_pinhole, length

# From pinholes (w towards 0) the model differs by w^2 / 12 at most: smaller angles cannot be told from this one.
_SMALLEST = 1e-4
_START = 0.5


class PinholeFov(CameraModel):
    """`pinhole-fov`: fx, fy, cx, cy; w (Devernay & Faugeras 2001, "Straight lines have to be straight", eq. 13).

    u = fx x' + cx, v = fy y' + cy with (x', y') of length atan(2 tan(w/2) r) / w, r = |(x, y)| / z, as in Kalibr. Here
    the arc tangent is taken of both numbers, so that the same curve goes on beyond 90 degrees. 0 < w < pi, rad.
    """

    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    w: Float[Array, ""]

    name: ClassVar[str] = "pinhole-fov"
    distortion_names: ClassVar[tuple[str, ...]] = ("w",)

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Pixel (2,) of a point (3,) in the camera frame, metres."""
        w = jnp.clip(jnp.where(jnp.abs(self.w) < _SMALLEST, _SMALLEST, self.w), -3.1, 3.1)
        off_axis = length(point[:2])
        radius = jnp.arctan2(2.0 * jnp.tan(w / 2.0) * off_axis, point[2]) / w
        return self.focal * (radius / off_axis) * point[:2] + self.centre

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Everything but the antipode of the axis has a pixel."""
        return jnp.arctan2(length(point[:2]), point[2]) < jnp.pi - 1e-6

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        """Focal length at the image's centre in pixels; w = 0.5, as nothing depends on w to first order at 0."""
        return _with_angle(focal, image_size, _START)

    @classmethod
    def starts(cls, focal: float, image_size: tuple[int, int]) -> tuple["CameraModel", ...]:
        """From nearly a pinhole to a strong fisheye."""
        return tuple(_with_angle(focal, image_size, w) for w in (_START, 1.0, 1.6))


def _with_angle(focal: float, image_size: tuple[int, int], w: float) -> PinholeFov:
    central = focal * w / (2.0 * math.tan(w / 2.0))
    return PinholeFov(*first_pinhole(central, image_size), constant(w))
