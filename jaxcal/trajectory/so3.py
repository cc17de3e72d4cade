"""Jacobians of SO(3)'s exponential that `jaxlie` does not offer."""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float


def exp(rotation_vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a rotation vector (rad)."""
    return jaxlie.SO3.exp(rotation_vector).as_matrix()


def log(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Rotation vector (rad, norm at most pi) of a rotation matrix."""
    return jaxlie.SO3.from_matrix(rotation).log()


def hat(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix of the cross product: hat(a) @ b = a x b."""
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


def right_jacobian(rotation_vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Jr with Exp(v + d) = Exp(v) Exp(Jr(v) d) to first order (Chirikjian 2012, eq. 10.86; Sola 2018, eq. 143)."""
    squared = rotation_vector @ rotation_vector
    small = squared < 1e-6
    safe = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(safe)
    first = jnp.where(small, 0.5 - squared / 24.0, (1.0 - jnp.cos(angle)) / safe)
    second = jnp.where(small, 1.0 / 6.0 - squared / 120.0, (angle - jnp.sin(angle)) / (safe * angle))
    cross = hat(rotation_vector)
    return jnp.eye(3) - first * cross + second * cross @ cross


def right_jacobian_inverse(rotation_vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Inverse of `right_jacobian`: Log(Exp(v) Exp(d)) = v + Jr^-1(v) d to first order (Sola 2018, eq. 144)."""
    squared = rotation_vector @ rotation_vector
    small = squared < 1e-6
    safe = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(safe)
    half = 0.5 * angle
    factor = jnp.where(small, 1.0 / 12.0 + squared / 720.0, (1.0 - half / jnp.tan(half)) / safe)
    cross = hat(rotation_vector)
    return jnp.eye(3) + 0.5 * cross + factor * cross @ cross
