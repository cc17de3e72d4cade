"""Kalibr's IMU model `calibrated`: a gyroscope and an accelerometer with slowly varying biases, at one point."""

import jax.numpy as jnp
from jaxtyping import Array, Float


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
