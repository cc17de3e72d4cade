"""The IMU model: closed-form Jacobians through the spline against autodiff, and what still and falling IMUs read."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxcal.imu import predict, predict_with_jacobian
from jaxcal.trajectory import PoseSpline, basis_matrix, increments, rotation_at, so3, weights

DT = 0.05
# Two directions across gravity that are no axes of the target frame, so that none is special.
GRAVITY = jnp.array([0.3, -9.7, 1.1])
BASIS = jnp.linalg.qr(jnp.stack([GRAVITY, jnp.array([1.0, 0.2, 0.1]), jnp.array([0.1, 0.3, 1.0])], axis=1))[0][:, 1:]


def random_window(order: int, seed: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Control rotations (k, 3, 3), positions (k, 3) and biases (k, 6) of one window, in brisk motion."""
    rng = np.random.default_rng(seed)
    turns = np.concatenate([rng.normal(size=(1, 3)), rng.normal(scale=0.2, size=(order - 1, 3))])
    rotations = [Rotation.from_rotvec(turns[0]).as_matrix()]
    for turn in turns[1:]:
        rotations.append(rotations[-1] @ Rotation.from_rotvec(turn).as_matrix())
    positions = rng.normal(scale=0.02, size=(order, 3))
    return jnp.asarray(np.stack(rotations)), jnp.asarray(positions), jnp.asarray(rng.normal(size=(order, 6)))


@functools.partial(jax.jit, static_argnums=4)
def closed_form_and_autodiff(rotations: jax.Array, positions: jax.Array, biases: jax.Array, u: jax.Array, order: int):
    """Readings (6,) and Jacobians (6, k, 6), (6, 2): as the model gives them, and by autodiff of `predict`."""
    second = weights(basis_matrix(order), u, DT, 2)
    linear = jnp.zeros(order).at[0].set(1.0 - u).at[1].set(u)
    point = rotation_at(rotations[0], increments(rotations), u, DT, order)
    ours = predict_with_jacobian(point, second @ positions, second, GRAVITY, BASIS, linear @ biases)

    def readings(window: jax.Array, tilt: jax.Array) -> jax.Array:
        moved = jnp.einsum("kij,kjl->kil", rotations, jax.vmap(so3.exp)(window[:, :3]))
        at = rotation_at(moved[0], increments(moved), u, DT, order)
        acceleration = second @ (positions + window[:, 3:6])
        return predict(at.rotation, at.velocity, acceleration, GRAVITY + BASIS @ tilt, linear @ biases)

    at_rest = (jnp.zeros((order, 6)), jnp.zeros(2))
    return ours, (readings(*at_rest), *jax.jacfwd(readings, argnums=(0, 1))(*at_rest))


@pytest.mark.parametrize("order", [4, 6])
@settings(max_examples=15, deadline=None)
@given(u=st.floats(0.0, 1.0), seed=st.integers(0, 2**31))
def test_jacobians_through_the_spline_equal_autodiff(order: int, u: float, seed: int) -> None:
    ours, expected = closed_form_and_autodiff(*random_window(order, seed), jnp.asarray(u), order)
    for mine, theirs in zip(ours, expected, strict=True):
        scale = float(jnp.abs(theirs).max())
        np.testing.assert_allclose(mine, theirs, atol=1e-8 * scale)


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
