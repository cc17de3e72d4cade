"""Distortions of the normalised image plane, each one function of a point (2,) and its coefficients."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def no_distortion(plane: Float[Array, "2"]) -> Float[Array, "2"]:
    """A perfect lens."""
    return plane


def radtan(plane: Float[Array, "2"], coefficients: Float[Array, "4"]) -> Float[Array, "2"]:
    """Radial-tangential distortion k1, k2, p1, p2 (Brown 1966; OpenCV's calib3d documentation, first four terms)."""
    k1, k2, p1, p2 = coefficients
    x, y = plane
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + k2 * r2)
    return jnp.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    )


def equidistant(plane: Float[Array, "2"], coefficients: Float[Array, "4"]) -> Float[Array, "2"]:
    """Equidistant k1..k4: theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8) (Kannala & Brandt 2006, eq. 6)."""
    k1, k2, k3, k4 = coefficients
    r = jnp.sqrt(plane @ plane + 1e-24)  # the constant keeps the gradient at the centre finite
    theta = jnp.arctan(r)
    t2 = theta * theta
    return plane * (theta / r * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))))
