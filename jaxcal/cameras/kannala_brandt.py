"""Kannala-Brandt fisheye (Kalibr's `pinhole-equi`): the radius is a polynomial of the angle, on the whole sphere."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.numerics import constant, first_pinhole, length, rises_until


class PinholeEquidistant(CameraModel):
    """`pinhole-equi`: fx, fy, cx, cy; k1..k4 (Kannala & Brandt 2006, eq. 6, as in Kalibr and OpenCV's fisheye module).

    u = fx x' + cx, v = fy y' + cy with (x', y') = d(theta) (x, y) / |(x, y)|, theta the angle from the optical axis
    (0 to pi) and d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8). In front of the camera these are
    the numbers of Kalibr and OpenCV; they reach theta through x/z and so end at 90 degrees, this goes on.
    """

    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    coefficients: Float[Array, "4"]

    name: ClassVar[str] = "pinhole-equi"
    distortion_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4")

    def _radius(self, theta: Float[Array, ""]) -> Float[Array, ""]:
        k1, k2, k3, k4 = self.coefficients
        t2 = theta * theta
        return theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Pixel (2,) of a point (3,) in the camera frame, metres."""
        off_axis = length(point[:2])
        theta = jnp.arctan2(off_axis, point[2])
        return self.focal * (self._radius(theta) / off_axis) * point[:2] + self.centre

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Whether the polynomial rises up to the angle of the point (3,); the antipode of the axis has no pixel."""
        return rises_until(self._radius, jnp.arctan2(length(point[:2]), point[2]), limit=jnp.pi - 1e-6)

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        return cls(*first_pinhole(focal, image_size), coefficients=constant(np.zeros(4)))
