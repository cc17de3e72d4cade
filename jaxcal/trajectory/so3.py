"""SO(3) on matrices: the exponential with its Jacobians, which `jaxlie` does not offer, and its logarithm.

Where shapes end in *T, many rotations may be given at once, along the last axes: loops over them are fast.
"""

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


def hat(vector: Float[Array, "3 *T"]) -> Float[Array, "3 3 *T"]:
    """The matrix of the cross product: hat(a) @ b = a x b."""
    return jnp.tensordot(jnp.asarray(_LEVI_CIVITA), vector, axes=1)


def product(left: Float[Array, "m 3 *T"], right: Float[Array, "3 *nT"]) -> Float[Array, "m ..."]:
    """left @ right, of two matrices or of a matrix and a vector, written out; either may be of length 1 along T."""
    columns = left[:, :, None] if right.ndim == left.ndim else left
    return columns[:, 0] * right[0] + columns[:, 1] * right[1] + columns[:, 2] * right[2]


def identity(like: Float[Array, "_ *T"]) -> Float[Array, "3 3 *ones"]:
    """The identity, to be added to matrices with the last axes of `like`; of length 1 along them."""
    return jnp.eye(3).reshape(3, 3, *(1 for _ in like.shape[1:]))


def exp_with_right_jacobian(
    rotation_vector: Float[Array, "3 *T"],
) -> tuple[Float[Array, "3 3 *T"], Float[Array, "3 3 *T"]]:
    """Exp(v) by Rodrigues' formula, and Jr with Exp(v + d) = Exp(v) Exp(Jr(v) d) to first order.

    Chirikjian 2012, eq. 10.86; Sola et al. 2018, eq. 143. Together, because they share all that is costly.
    """
    squared = rotation_vector[0] ** 2 + rotation_vector[1] ** 2 + rotation_vector[2] ** 2
    small = squared < 1e-6
    safe = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(safe)
    sine = jnp.where(small, 1.0 - squared / 6.0, jnp.sin(angle) / angle)
    first = jnp.where(small, 0.5 - squared / 24.0, (1.0 - jnp.cos(angle)) / safe)
    second = jnp.where(small, 1.0 / 6.0 - squared / 120.0, (angle - jnp.sin(angle)) / (safe * angle))
    cross = hat(rotation_vector)
    square = product(cross, cross)
    unmoved = identity(rotation_vector)
    return unmoved + sine * cross + first * square, unmoved - first * cross + second * square


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
