"""Smooth six-degree-of-freedom motion of a rig, as an analytic function of time."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxcal.programs import stored_jit

_SHORTEST = 256


class Motion(eqx.Module):
    """Sums of sinusoids in translation and rotation vector about a nominal pose in front of the target.

    The rig's body frame (x right, y down, z forward) turns about a pivot, a point fixed in the body that lies near
    the board, so that the board stays in view while the rig swings around it:

        R_target_body(t) = R_target_body0 Exp(r(t)),     pivot_target(t) = pivot_target0 + R_target_body0 w(t),
        p_target_body(t) = pivot_target(t) - R_target_body(t) pivot_body,

    where channels 0..2 are w (m) and 3..5 are r (rad), each sum_k a_k sin(2 pi f_k t + phi_k). It is no spline, so it
    is a fair truth for estimators that use one. Time `t` is in seconds on the IMU's clock since the rig's origin.

    `amplitude`, `frequency_hz`, `phase` (6, K); `R_target_body0` (3, 3); `pivot_target0`, `pivot_body` (3,) m;
    `T_body_imu` (4, 4).
    """

    amplitude: Float[Array, "6 k"]
    frequency_hz: Float[Array, "6 k"]
    phase: Float[Array, "6 k"]
    R_target_body0: Float[Array, "3 3"]
    pivot_target0: Float[Array, "3"]
    pivot_body: Float[Array, "3"]
    T_body_imu: Float[Array, "4 4"]

    def pose(self, t: Float[ArrayLike, ""]) -> Float[Array, "4 4"]:
        """T_target_imu at time `t` (s)."""
        channels = jnp.sum(self.amplitude * jnp.sin(2.0 * jnp.pi * self.frequency_hz * t + self.phase), axis=1)
        R_target_body = self.R_target_body0 @ jaxlie.SO3.exp(channels[3:]).as_matrix()
        pivot = self.pivot_target0 + self.R_target_body0 @ channels[:3]
        p_target_body = pivot - R_target_body @ self.pivot_body
        T_target_body = jnp.eye(4).at[:3, :3].set(R_target_body).at[:3, 3].set(p_target_body)
        return T_target_body @ self.T_body_imu

    def velocity(self, t: Float[ArrayLike, ""]) -> Float[Array, "3"]:
        """Velocity of the IMU's origin in the target frame, m/s."""
        return _derivative(lambda s: self.pose(s)[:3, 3], t)

    def acceleration(self, t: Float[ArrayLike, ""]) -> Float[Array, "3"]:
        """Acceleration of the IMU's origin in the target frame, m/s^2, without gravity."""
        return _derivative(self.velocity, t)

    def angular_velocity(self, t: Float[ArrayLike, ""]) -> Float[Array, "3"]:
        """Angular velocity of the IMU with respect to the target, in the IMU's frame, rad/s: vee(R^T dR/dt)."""
        rate = self.pose(t)[:3, :3].T @ _derivative(lambda s: self.pose(s)[:3, :3], t)
        return jnp.stack([rate[2, 1], rate[0, 2], rate[1, 0]])


def _derivative(function: Callable[[Array], Array], t: Float[ArrayLike, ""]) -> Array:
    at = jnp.asarray(t, dtype=jnp.float64)
    return jax.jvp(function, (at,), (jnp.ones_like(at),))[1]


@stored_jit
def poses(motion: Motion, times_s: Float[Array, " n"]) -> Float[Array, "n 4 4"]:
    """T_target_imu at each of `times_s` (n,) seconds."""
    return jax.vmap(motion.pose)(times_s)


def poses_at(motion: Motion, times_s: np.ndarray) -> np.ndarray:
    """`poses` of a numpy array of times (n,), compiled for few lengths only."""
    length = _SHORTEST
    while length < len(times_s):
        length *= 4
    padded = np.pad(np.asarray(times_s, dtype=np.float64), (0, length - len(times_s)))
    return np.asarray(poses(motion, jnp.asarray(padded)))[: len(times_s)]


@stored_jit
def rates(motion: Motion, times_s: Float[Array, " n"]) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Angular velocity (IMU frame, rad/s) and acceleration (target frame, m/s^2) at each of `times_s` (n,)."""
    return jax.vmap(motion.angular_velocity)(times_s), jax.vmap(motion.acceleration)(times_s)


@stored_jit
def angular_accelerations(motion: Motion, times_s: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """Derivative of the angular velocity (IMU frame, rad/s^2) at each of `times_s` (n,)."""
    return jax.vmap(lambda t: _derivative(motion.angular_velocity, t))(times_s)
