"""Block-arrow algebra against dense algebra."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.estimation import (
    BlockArrow,
    band_from_windows,
    chain_from_windows,
    factorise,
    gathered_band,
    gathered_chain,
)


def random_equations(num_blocks: int, width: int, size: int, shared: int, seed: int) -> tuple[BlockArrow, np.ndarray]:
    """Equations of random residuals, each touching one window and all shared parameters; and the dense H."""
    rng = np.random.default_rng(seed)
    intervals = num_blocks - width + 1
    rows = 2 * width * size + shared
    window = rng.normal(size=(intervals, rows, width, size))
    border = rng.normal(size=(intervals, rows, shared))
    residual = rng.normal(size=(intervals, rows))
    dense_jacobian = np.zeros((intervals * rows, num_blocks * size + shared))
    for i in range(intervals):
        block = slice(i * rows, (i + 1) * rows)
        dense_jacobian[block, i * size : (i + width) * size] = window[i].reshape(rows, -1)
        dense_jacobian[block, num_blocks * size :] = border[i]
    equations = BlockArrow(
        band=band_from_windows(jnp.einsum("irab,ircd->iabcd", window, window)),
        border=chain_from_windows(jnp.einsum("irab,irp->iabp", window, border)),
        corner=jnp.einsum("irp,irq->pq", border, border),
        gradient_chain=chain_from_windows(jnp.einsum("irab,ir->iab", window, residual)),
        gradient_shared=jnp.einsum("irp,ir->p", border, residual),
        cost=jnp.asarray(0.5 * np.sum(residual**2)),
    )
    return equations, dense_jacobian.T @ dense_jacobian


# (width, block size, shared, blocks): a handful, because every shape is compiled.
SHAPES = [(1, 3, 2, 4), (2, 2, 1, 5), (3, 2, 3, 7), (4, 3, 2, 4), (4, 2, 3, 9)]


@eqx.filter_jit
def solve_and_invert(equations: BlockArrow, damping: tuple, rhs: tuple) -> tuple:
    factor = factorise(equations, *damping)
    return equations.dense(), factor.solve(*rhs), factor.shared_covariance(), factor.chain_covariance()


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(SHAPES), st.integers(0, 2**31))
def test_assembly_solve_and_covariance_equal_dense_algebra(shape: tuple[int, int, int, int], seed: int) -> None:
    width, size, shared, num_blocks = shape
    equations, dense = random_equations(num_blocks, width, size, shared, seed)
    rng = np.random.default_rng(seed)
    split = num_blocks * size
    damping, rhs = rng.uniform(0.1, 1.0, size=split + shared), rng.normal(size=split + shared)

    def parts(vector: np.ndarray) -> tuple:
        return jnp.asarray(vector[:split].reshape(num_blocks, size)), jnp.asarray(vector[split:])

    assembled, solution, shared_covariance, blocks = solve_and_invert(equations, parts(damping), parts(rhs))
    np.testing.assert_allclose(assembled, dense, atol=1e-9)
    damped = dense + np.diag(damping)
    expected = np.linalg.solve(damped, rhs)
    np.testing.assert_allclose(np.concatenate([np.ravel(part) for part in solution]), expected, rtol=1e-6, atol=1e-9)

    inverse = np.linalg.inv(damped)
    np.testing.assert_allclose(shared_covariance, inverse[split:, split:], rtol=1e-6, atol=1e-9)
    for k in range(num_blocks):
        rows = slice(k * size, (k + 1) * size)
        np.testing.assert_allclose(blocks[k], inverse[rows, rows], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("width", "per", "blocks"), [(2, 1, 5), (3, 2, 6), (3, 2, 7), (4, 5, 8)])
def test_gathered_blocks_are_the_same_equations_and_the_identity_where_the_last_is_not_full(
    width: int, per: int, blocks: int
) -> None:
    equations, dense = random_equations(blocks, width, 2, 3, seed=0)
    gathered = BlockArrow(
        band=gathered_band(equations.band, per),
        border=gathered_chain(equations.border, per),
        corner=equations.corner,
        gradient_chain=gathered_chain(equations.gradient_chain, per),
        gradient_shared=equations.gradient_shared,
        cost=equations.cost,
    )
    added = 2 * (-blocks % per)
    order = np.r_[np.arange(2 * blocks), np.arange(2 * blocks + added, len(dense) + added)]
    expected = np.eye(len(dense) + added)
    expected[np.ix_(order, order)] = dense
    np.testing.assert_allclose(gathered.dense(), expected, atol=1e-9)
    np.testing.assert_array_equal(np.ravel(gathered.gradient_chain)[: 2 * blocks], np.ravel(equations.gradient_chain))
    assert not np.ravel(gathered.gradient_chain)[2 * blocks :].any()


@pytest.mark.parametrize("width", [1, 3])
def test_held_parameters_do_not_move_and_do_not_touch_the_others(width: int) -> None:
    equations, dense = random_equations(7, width, 2, 3, seed=0)
    rng = np.random.default_rng(1)
    free_chain, free_shared = rng.random((7, 2)) < 0.7, np.array([True, False, True])
    free = np.concatenate([free_chain.ravel(), free_shared])
    held = equations.hold(jnp.asarray(free_chain), jnp.asarray(free_shared))
    factor = factorise(held, jnp.zeros((7, 2)), jnp.zeros(3))
    chain, shared = factor.solve(held.gradient_chain, held.gradient_shared)
    gradient = np.concatenate([np.ravel(equations.gradient_chain), equations.gradient_shared])
    expected = np.zeros(len(free))
    expected[free] = np.linalg.solve(dense[np.ix_(free, free)], gradient[free])
    np.testing.assert_allclose(np.concatenate([np.ravel(chain), shared]), expected, atol=1e-9)


def test_an_indefinite_matrix_gives_nan_rather_than_a_wrong_answer() -> None:
    equations, _ = random_equations(6, 2, 2, 2, seed=0)
    factor = factorise(jax.tree.map(lambda leaf: -leaf, equations), jnp.zeros((6, 2)), jnp.zeros(2))
    chain, shared = factor.solve(equations.gradient_chain, equations.gradient_shared)
    assert not np.isfinite(np.asarray(chain)).all()
    assert not np.isfinite(np.asarray(shared)).all()
