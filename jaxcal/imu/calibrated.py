"""Kalibr's IMU model `calibrated`: a gyroscope and an accelerometer with slowly varying biases, at one point."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.trajectory import RotationPoint, so3


def predict(
    rotation: Float[Array, "3 3"],
    angular_velocity: Float[Array, "3"],
    acceleration: Float[Array, "3"],
    gravity: Float[Array, "3"],
    bias: Float[Array, "6"],
) -> Float[Array, "6"]:
    """Gyroscope (rad/s) and accelerometer (m/s^2) readings, stacked, of an IMU with pose R = R_target_imu.

    gyro = omega + b_g, accel = R' (a - g) + b_a: `angular_velocity` in the IMU's frame, `acceleration` and `gravity`
    (free fall, pointing down) in the target's frame, `bias` = (b_g, b_a). Furgale et al. 2013, eq. 11 and 12.
    """
    return jnp.concatenate([angular_velocity, rotation.T @ (acceleration - gravity)]) + bias


def predict_with_jacobian(
    point: RotationPoint,
    acceleration: Float[Array, "3"],
    acceleration_weights: Float[Array, " k"],
    gravity: Float[Array, "3"],
    gravity_basis: Float[Array, "3 g"],
    bias: Float[Array, "6"],
) -> tuple[Float[Array, "6"], Float[Array, "6 k 6"], Float[Array, "6 g"]]:
    """Readings as `predict`, and their Jacobians by the window of k control points and by gravity along its basis.

    Each control point has 6 tangent coordinates: rotation (right perturbation), position. `acceleration_weights` are
    the second derivatives of the position basis. By `bias` the derivative is the identity.
    """
    order = acceleration_weights.shape[0]
    readings = predict(point.rotation, point.velocity, acceleration, gravity, bias)
    force = readings[3:] - bias[3:]
    zero = jnp.zeros((3, order, 3))
    by_rotation = jnp.concatenate(
        [point.velocity_jacobian, jnp.einsum("ij,jkl->ikl", so3.hat(force), point.rotation_jacobian)]
    )
    by_position = jnp.concatenate([zero, point.rotation.T[:, None, :] * acceleration_weights[None, :, None]])
    by_gravity = jnp.concatenate([jnp.zeros((3, gravity_basis.shape[1])), -point.rotation.T @ gravity_basis])
    return readings, jnp.concatenate([by_rotation, by_position], axis=2), by_gravity
