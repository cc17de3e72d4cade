"""Samples of a plain IMU, reduced in closed form, against rows by autodiff of what it reads along the spline."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxcal.calibration.inertial_calibrated import reduce_batch
from jaxcal.imu import predict
from jaxcal.trajectory import basis_matrix, increments, rotation_at, so3, weights

DT = 0.05
INTERVALS, SAMPLES = 3, 4
# Two directions across gravity that are no axes of the target frame, so that none is special.
GRAVITY = jnp.array([0.3, -9.7, 1.1])
BASIS = jnp.linalg.qr(jnp.stack([GRAVITY, jnp.array([1.0, 0.2, 0.1]), jnp.array([0.1, 0.3, 1.0])], axis=1))[0][:, 1:]


def random_windows(order: int, seed: int) -> tuple[jax.Array, ...]:
    """Control rotations (B, k, 3, 3) and positions (B, k, 3), biases at the ends (B, 2, 6), samples (B, S, ...), and
    inverse sigma (6,), in brisk motion."""
    rng = np.random.default_rng(seed)
    first = rng.normal(size=(INTERVALS, 1, 3))
    turns = np.concatenate([first, rng.normal(scale=0.2, size=(INTERVALS, order - 1, 3))], axis=1)
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(INTERVALS, order, 3, 3)
    for j in range(1, order):
        rotations[:, j] = rotations[:, j - 1] @ rotations[:, j]
    arrays = (
        rotations,
        rng.normal(scale=0.02, size=(INTERVALS, order, 3)),
        rng.normal(size=(INTERVALS, 2, 6)),
        rng.uniform(size=(INTERVALS, SAMPLES)),
        rng.normal(size=(INTERVALS, SAMPLES, 6)),
        (rng.uniform(size=(INTERVALS, SAMPLES)) < 0.8).astype(float),
        10.0 ** rng.uniform(-1, 1, 6),
    )
    return tuple(map(jnp.asarray, arrays))


@functools.partial(jax.jit, static_argnums=0)
def both_ways(order: int, rotations, positions, biases, u, readings, present, inverse_sigma) -> tuple:
    """The sums of the closed form, and those of rows that autodiff makes."""
    chain = jax.vmap(increments)(rotations)
    samples = (u, readings, present)
    ours = reduce_batch(
        samples,
        rotations[:, 0],
        chain,
        positions,
        biases,
        jnp.stack([1.0 - u.T, u.T]),
        inverse_sigma,
        GRAVITY,
        BASIS,
        jnp.asarray(DT),
    )

    def of_sample(rotations, positions, bias, u, reading, present) -> tuple:
        second, ends = weights(basis_matrix(order), u, DT, 2), jnp.stack([1.0 - u, u])

        def error(window: jax.Array, tilt: jax.Array) -> jax.Array:
            moved = jnp.einsum("kij,kjl->kil", rotations, jax.vmap(so3.exp)(window[:, :3]))
            at = rotation_at(moved[0], increments(moved), u, DT, order)
            acceleration = second @ (positions + window[:, 3:])
            readings = predict(at.rotation, at.velocity, acceleration, GRAVITY + BASIS @ tilt, ends @ bias)
            return (readings - reading) * present * inverse_sigma

        rest = (jnp.zeros((order, 6)), jnp.zeros(2))
        by_window, by_tilt = jax.jacfwd(error, argnums=(0, 1))(*rest)
        rows = jnp.concatenate([by_window.reshape(6, -1), by_tilt, error(*rest)[:, None]], axis=1)
        return rows, ends[:, None] * present * inverse_sigma

    of_interval = jax.vmap(of_sample, in_axes=(None, None, None, 0, 0, 0))
    rows, by_bias = jax.vmap(of_interval)(rotations, positions, biases, u, readings, present)
    expected = (
        jnp.einsum("bsim,bsin->bmn", rows, rows),
        jnp.einsum("bsei,bsim->beim", by_bias, rows),
        jnp.einsum("bsei,bsfi->befi", by_bias, by_bias),
    )
    return ours, expected


@pytest.mark.parametrize("order", [4, 6])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_sums_are_those_of_rows_by_autodiff(order: int, seed: int) -> None:
    ours, expected = both_ways(order, *random_windows(order, seed))
    for mine, theirs in zip(ours, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-9 * float(jnp.abs(theirs).max()))
