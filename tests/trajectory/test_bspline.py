"""Splines against scipy, finite differences and autodiff."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from jaxcal.trajectory import PoseSpline, basis_matrix, increments, rotation_at, rotations_at, so3, weights

ORDERS = [3, 4, 6]


@pytest.mark.parametrize("order", ORDERS)
def test_basis_equals_scipy_with_derivatives(order: int) -> None:
    rng = np.random.default_rng(order)
    control = rng.normal(size=(10, 3))
    dt, start = 0.3, -1.0
    knots = start + dt * (np.arange(10 + order) - (order - 1))
    reference = BSpline(knots, control, order - 1)
    for t in rng.uniform(start, start + dt * (10 - order + 1), size=8):
        i = int((t - start) // dt)
        u = jnp.asarray((t - start) / dt - i)
        for derivative in range(3):
            ours = weights(basis_matrix(order), u, dt, derivative) @ control[i : i + order]
            np.testing.assert_allclose(ours, reference(t, nu=derivative), atol=1e-10)


def random_spline(order: int, seed: int) -> PoseSpline:
    rng = np.random.default_rng(seed)
    steps = rng.normal(scale=0.3, size=(9, 3))
    rotations = [np.asarray(so3.exp(jnp.asarray(rng.normal(size=3))))]
    for step in steps:
        rotations.append(rotations[-1] @ np.asarray(so3.exp(jnp.asarray(step))))
    positions = rng.normal(size=(10, 3))
    return PoseSpline(jnp.asarray(np.stack(rotations)), jnp.asarray(positions), jnp.array(0.5), jnp.array(0.1), order)


@pytest.mark.parametrize("order", ORDERS)
def test_velocities_and_acceleration_are_time_derivatives(order: int) -> None:
    spline = random_spline(order, seed=1)
    times = jnp.asarray(np.random.default_rng(0).uniform(0.52, 0.5 + 0.1 * spline.num_intervals - 0.02, size=6))
    evaluate = jax.jit(lambda t: spline.evaluate(t))
    rotation, position, omega, velocity, acceleration = evaluate(times)
    tangent = jax.jvp(lambda t: evaluate(t)[:4], (times,), (jnp.ones_like(times),))[1]
    rate = jnp.einsum("nji,njk->nik", rotation, tangent[0])
    np.testing.assert_allclose(rate, jax.vmap(so3.hat)(omega), atol=1e-9)
    np.testing.assert_allclose(velocity, tangent[1], atol=1e-8)
    np.testing.assert_allclose(acceleration, tangent[3], atol=1e-6)
    assert position.shape == (6, 3)


@functools.partial(jax.jit, static_argnums=2)
def jacobians_both_ways(rotations: jax.Array, u: jax.Array, order: int) -> tuple:
    """The spline point with its closed-form Jacobians, and the same Jacobians by autodiff."""
    base = rotation_at(rotations[0], increments(rotations), u, 0.1, order)

    def perturbed(tangent: jax.Array) -> tuple[jax.Array, jax.Array]:
        moved = jnp.einsum("kij,kjl->kil", rotations, jax.vmap(so3.exp)(tangent))
        point = rotation_at(moved[0], increments(moved), u, 0.1, order)
        return so3.log(base.rotation.T @ point.rotation), point.velocity

    return base, jax.jacfwd(perturbed)(jnp.zeros((order, 3)))


@pytest.mark.parametrize("order", ORDERS)
@settings(max_examples=10, deadline=None)
@given(u=st.floats(0.0, 1.0), seed=st.integers(0, 1000))
def test_closed_form_jacobians_equal_autodiff(order: int, u: float, seed: int) -> None:
    point, expected = jacobians_both_ways(random_spline(order, seed).rotations[:order], jnp.asarray(u), order)
    np.testing.assert_allclose(point.rotation_jacobian, expected[0], atol=1e-8)
    np.testing.assert_allclose(point.velocity_jacobian, expected[1], atol=1e-7)


@functools.partial(jax.jit, static_argnums=2)
def one_by_one_and_at_once(rotations: jax.Array, u: jax.Array, order: int) -> tuple:
    """The spline of windows (B, k, 3, 3) at S times each: time after time, and all together."""
    chain = jax.vmap(increments)(rotations)
    alone = jax.vmap(
        lambda first, window, u: jax.vmap(lambda u: rotation_at(first, window, u, 0.1, order))(u), out_axes=0
    )(rotations[:, 0], chain, u.T)
    first = jnp.moveaxis(rotations[:, 0], 0, -1)[..., None, :]
    vectors = jnp.moveaxis(chain.vector, 0, -1)[..., None, :]
    return alone, rotations_at(first, vectors, u, 0.1, order), chain


@pytest.mark.parametrize("order", ORDERS)
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000))
def test_many_times_at_once_are_each_time_by_itself(order: int, seed: int) -> None:
    rotations = jnp.stack([random_spline(order, seed + i).rotations[:order] for i in range(3)])
    u = jnp.asarray(np.random.default_rng(seed).uniform(size=(5, 3)))
    alone, together, chain = one_by_one_and_at_once(rotations, u, order)
    np.testing.assert_allclose(jnp.moveaxis(together.rotation, (2, 3), (1, 0)), alone.rotation, atol=1e-12)
    np.testing.assert_allclose(jnp.moveaxis(together.velocity, (1, 2), (1, 0)), alone.velocity, atol=1e-10)
    # By control rotations: each increment depends on the two that it lies between.
    for by, expected, by_first in (
        (together.rotation_by, alone.rotation_jacobian, together.from_first),
        (together.velocity_by, alone.velocity_jacobian, jnp.zeros_like(together.from_first)),
    ):
        by_left = jnp.einsum("jacsb,bjcd->bsajd", by, chain.by_left)
        by_right = jnp.einsum("jacsb,bjcd->bsajd", by, chain.by_right)
        ours = jnp.pad(by_left, [(0, 0)] * 3 + [(0, 1), (0, 0)]) + jnp.pad(by_right, [(0, 0)] * 3 + [(1, 0), (0, 0)])
        ours = ours.at[:, :, :, 0].add(jnp.einsum("casb->bsac", by_first))
        np.testing.assert_allclose(ours, expected, atol=1e-10)


@jax.jit
def right_jacobians(vector: jax.Array) -> tuple:
    by_autodiff = jax.jacfwd(lambda d: so3.log(so3.exp(vector).T @ so3.exp(vector + d)))(jnp.zeros(3))
    rotation, jacobian = so3.exp_with_right_jacobian(vector)
    return jacobian, so3.right_jacobian_inverse(vector), by_autodiff, rotation - so3.exp(vector)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3), st.floats(1e-9, 1.0))
def test_right_jacobian_and_its_inverse(direction: list[float], scale: float) -> None:
    vector = jnp.asarray(direction) * scale
    closed, inverse, by_autodiff, difference = right_jacobians(vector)
    np.testing.assert_allclose(difference, 0.0, atol=1e-12)
    np.testing.assert_allclose(closed, by_autodiff, atol=1e-6)
    np.testing.assert_allclose(closed @ inverse, np.eye(3), atol=1e-9)


def test_times_outside_are_clipped_to_the_ends() -> None:
    spline = random_spline(4, seed=2)
    end = 0.5 + 0.1 * spline.num_intervals
    inside = spline.evaluate(jnp.array([0.5, end]))
    outside = spline.evaluate(jnp.array([-3.0, 99.0]))
    for a, b in zip(inside, outside, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
