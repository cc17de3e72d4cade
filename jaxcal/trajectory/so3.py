"""SO(3) on matrices: the exponential with its Jacobians, which `jaxlie` does not offer, and its logarithm."""

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

# _LEVI_CIVITA[i, j, k]: a x b = sum_jk eps[i, j, k] b_j a_k, so that hat(a) = eps @ a.
_LEVI_CIVITA = np.zeros((3, 3, 3))
for _i, _j, _k in [(0, 1, 2), (1, 2, 0), (2, 0, 1)]:
    _LEVI_CIVITA[_i, _k, _j], _LEVI_CIVITA[_i, _j, _k] = 1.0, -1.0


def exp(rotation_vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a rotation vector (rad), by Rodrigues' formula.

    `jaxlie` goes by a quaternion; that takes twice as long to compile, in every program that moves a pose.
    """
    return exp_with_right_jacobian(rotation_vector)[0]


def log(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Rotation vector (rad, norm at most pi) of a rotation matrix."""
    return jaxlie.SO3.from_matrix(rotation).log()


def hat(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix of the cross product: hat(a) @ b = a x b."""
    return jnp.asarray(_LEVI_CIVITA) @ vector


def exp_with_right_jacobian(rotation_vector: Float[Array, "3"]) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
    """Exp(v) by Rodrigues' formula, and Jr with Exp(v + d) = Exp(v) Exp(Jr(v) d) to first order.

    Chirikjian 2012, eq. 10.86; Sola et al. 2018, eq. 143. Together, because they share all that is costly.
    """
    squared = rotation_vector @ rotation_vector
    small = squared < 1e-6
    safe = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(safe)
    sine = jnp.where(small, 1.0 - squared / 6.0, jnp.sin(angle) / angle)
    first = jnp.where(small, 0.5 - squared / 24.0, (1.0 - jnp.cos(angle)) / safe)
    second = jnp.where(small, 1.0 / 6.0 - squared / 120.0, (angle - jnp.sin(angle)) / (safe * angle))
    cross = hat(rotation_vector)
    square = cross @ cross
    identity = jnp.eye(3)
    return identity + sine * cross + first * square, identity - first * cross + second * square


def right_jacobian_inverse(rotation_vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Inverse of the right Jacobian: Log(Exp(v) Exp(d)) = v + Jr^-1(v) d to first order (Sola 2018, eq. 144)."""
    squared = rotation_vector @ rotation_vector
    small = squared < 1e-6
    safe = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(safe)
    half = 0.5 * angle
    factor = jnp.where(small, 1.0 / 12.0 + squared / 720.0, (1.0 - half / jnp.tan(half)) / safe)
    cross = hat(rotation_vector)
    return jnp.eye(3) + 0.5 * cross + factor * cross @ cross
