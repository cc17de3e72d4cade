"""The IMU model: what still, falling and moving IMUs read."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxcal.imu import predict
from jaxcal.trajectory import PoseSpline

DT = 0.05
GRAVITY = jnp.array([0.3, -9.7, 1.1])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_an_imu_at_rest_reads_minus_gravity_in_its_own_frame_and_its_biases(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R_target_imu, bias = Rotation.from_rotvec(rng.normal(size=3)), rng.normal(size=6)
    still = jnp.zeros(3)
    readings = predict(jnp.asarray(R_target_imu.as_matrix()), still, still, GRAVITY, jnp.asarray(bias))
    np.testing.assert_allclose(readings[:3], bias[:3], atol=1e-12)
    np.testing.assert_allclose(readings[3:] - bias[3:], R_target_imu.inv().apply(-np.asarray(GRAVITY)), atol=1e-12)


def test_an_imu_lying_on_a_table_reads_up() -> None:
    down = jnp.array([0.0, 0.0, -9.81])
    readings = predict(jnp.eye(3), jnp.zeros(3), jnp.zeros(3), down, jnp.zeros(6))
    np.testing.assert_allclose(readings, [0, 0, 0, 0, 0, 9.81])


def test_a_falling_imu_reads_nothing() -> None:
    rotation = jnp.asarray(Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix())
    readings = predict(rotation, jnp.zeros(3), GRAVITY, GRAVITY, jnp.zeros(6))
    np.testing.assert_allclose(readings, 0.0, atol=1e-12)


def test_an_imu_on_a_circle_reads_its_centripetal_force() -> None:
    radius, rate, order = 0.4, 2.0, 6
    count = int(2.0 / DT) + order
    # Control points on a circle, each turned by the same angle: the spline is a circle of nearly this radius.
    angle = rate * DT * np.arange(count)
    rotations = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    positions = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    spline = PoseSpline(jnp.asarray(rotations), jnp.asarray(positions), jnp.array(0.0), jnp.array(DT), order)
    down = jnp.array([0.0, 0.0, -9.81])

    @jax.jit
    def read(time_s: jax.Array) -> jax.Array:
        rotation, _, velocity, _, acceleration = spline.evaluate(time_s)
        return jax.vmap(predict, in_axes=(0, 0, 0, None, None))(rotation, velocity, acceleration, down, jnp.zeros(6))

    # The spline's circle is smaller than that of its control points by (rate DT)^2 order / 24, a quarter of a percent.
    expected = np.array([0.0, 0.0, rate, -radius * rate**2, 0.0, 9.81])
    np.testing.assert_allclose(read(jnp.array([0.5, 1.23])), [expected, expected], atol=0.004 * radius * rate**2)
