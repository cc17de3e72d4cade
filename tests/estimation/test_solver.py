"""The Levenberg-Marquardt solver against stock optimistix and scipy, and Huber's loss against its definition."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float

from jaxcal.estimation import (
    BlockArrow,
    BlockArrowLevenbergMarquardt,
    BlockArrowProblem,
    SolveResult,
    band_from_windows,
    chain_from_windows,
    huber,
    solve,
)

LENGTH, RANGE, ROUGH, SMOOTH = 12, 0.05, 0.1, 0.3  # number of points; standard deviations


class Lighthouses(eqx.Module):
    """A walk of points in the plane, seen as ranges from two places that are unknown, and as rough positions.

    State: `walk` (K, 2), the chain, and `places` (4,), shared. Residuals per step between neighbours touch two chain
    blocks (band width two); those of ranges also the shared places.
    """

    ranges: Float[Array, "K 2"]
    rough: Float[Array, "K 2"]

    def of_window(self, pair: Array, places: Array, ranges: Array, rough: Array) -> Array:
        """Residuals (6,) of one pair of neighbours (2, 2): ranges and rough position of the first, and the step."""
        distance = jnp.linalg.norm(pair[0] - places.reshape(2, 2), axis=1)
        step = pair[1] - pair[0]
        return jnp.concatenate([(distance - ranges) / RANGE, (pair[0] - rough) / ROUGH, (step + step**3) / SMOOTH])

    def of_windows(self, walk: Array, places: Array) -> Array:
        pairs = jnp.stack([walk[:-1], walk[1:]], axis=1)
        return jax.vmap(self.of_window, in_axes=(0, None, 0, 0))(pairs, places, self.ranges[:-1], self.rough[:-1])

    def residuals(self, state: tuple[Array, Array]) -> Float[Array, " R"]:
        return self.of_windows(*state).ravel()

    def linearise(self, state: tuple[Array, Array]) -> BlockArrow:
        walk, places = state
        pairs = jnp.stack([walk[:-1], walk[1:]], axis=1)
        by_pair, by_places = jax.vmap(jax.jacfwd(self.of_window, argnums=(0, 1)), in_axes=(0, None, 0, 0))(
            pairs, places, self.ranges[:-1], self.rough[:-1]
        )
        residual = self.of_windows(walk, places)
        return BlockArrow(
            band=band_from_windows(jnp.einsum("irab,ircd->iabcd", by_pair, by_pair)),
            border=chain_from_windows(jnp.einsum("irab,irp->iabp", by_pair, by_places)),
            corner=jnp.einsum("irp,irq->pq", by_places, by_places),
            gradient_chain=chain_from_windows(jnp.einsum("irab,ir->iab", by_pair, residual)),
            gradient_shared=jnp.einsum("irp,ir->p", by_places, residual),
            cost=0.5 * jnp.sum(residual**2),
        )

    def retract(self, state: tuple[Array, Array], chain: Array, shared: Array) -> tuple[Array, Array]:
        return state[0] + chain, state[1] + shared


def made_from(seed: int) -> tuple[Lighthouses, tuple[Array, Array]]:
    """A problem, and a start that is off by a good part of the distances."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(scale=0.2, size=(LENGTH, 2)), axis=0)
    places = np.array([[3.0, 1.0], [-2.0, 2.5]])
    ranges = np.linalg.norm(walk[:, None] - places, axis=2) + RANGE * rng.normal(size=(LENGTH, 2))
    rough = walk + ROUGH * rng.normal(size=(LENGTH, 2))
    start = jnp.asarray(rough + rng.normal(size=rough.shape)), jnp.asarray((places + rng.normal(size=(2, 2))).ravel())
    return Lighthouses(jnp.asarray(ranges), jnp.asarray(rough)), start


@eqx.filter_jit
def by_optimistix(problem: Lighthouses, start: tuple[Array, Array]) -> tuple[Array, Array]:
    solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
    return optx.least_squares(lambda y, _: problem.residuals(y), solver, start, max_steps=500, throw=False).value


def by_scipy(problem: Lighthouses, start: tuple[Array, Array]) -> np.ndarray:
    residuals = eqx.filter_jit(lambda vector: problem.residuals(state_of(vector)))
    jacobian = eqx.filter_jit(jax.jacfwd(lambda vector: problem.residuals(state_of(vector))))
    found = scipy.optimize.least_squares(
        lambda x: np.asarray(residuals(jnp.asarray(x))),
        vector_of(start),
        jac=lambda x: np.asarray(jacobian(jnp.asarray(x))),  # pyright: ignore[reportArgumentType]
        method="lm",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    return found.x


def vector_of(state: tuple[Array, Array]) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in state])


def state_of(vector: Array) -> tuple[Array, Array]:
    return vector[: 2 * LENGTH].reshape(LENGTH, 2), vector[2 * LENGTH :]


def test_the_example_is_a_block_arrow_problem_with_the_right_equations() -> None:
    problem, start = made_from(0)
    assert isinstance(problem, BlockArrowProblem)
    equations = problem.linearise(start)
    jacobian = jax.jacfwd(lambda v: problem.residuals(state_of(v)))(jnp.asarray(vector_of(start)))
    residual = problem.residuals(start)
    np.testing.assert_allclose(equations.dense(), jacobian.T @ jacobian, atol=1e-8)
    gradient = vector_of((equations.gradient_chain, equations.gradient_shared))
    np.testing.assert_allclose(gradient, jacobian.T @ residual, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_it_finds_the_optimum_that_optimistix_and_scipy_find(seed: int) -> None:
    problem, start = made_from(seed)
    found = solve(problem, start, solver=BlockArrowLevenbergMarquardt(rtol=0.0, atol=1e-17))
    assert bool(found.converged)
    vector = vector_of(found.state)
    np.testing.assert_allclose(vector, by_scipy(problem, start), atol=1e-6)
    np.testing.assert_allclose(vector, vector_of(by_optimistix(problem, start)), atol=1e-6)
    cost = 0.5 * float(jnp.sum(problem.residuals(found.state) ** 2))
    assert float(found.equations.cost) == pytest.approx(cost, rel=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_it_stops_by_default_within_a_thousandth_of_a_sigma_of_the_optimum(seed: int) -> None:
    problem, start = made_from(seed)
    found = solve(problem, start)
    assert bool(found.converged)
    error = vector_of(found.state) - by_scipy(problem, start)
    # Whitened by the information matrix: the length of the error in sigmas, along whatever direction is worst.
    assert np.sqrt(error @ found.equations.dense() @ error) < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_the_cost_never_rises_and_starts_where_the_start_is(seed: int) -> None:
    problem, start = made_from(seed)
    found = solve(problem, start)
    history = np.asarray(found.history)[: int(found.iterations)]
    assert history[0] == pytest.approx(0.5 * float(jnp.sum(problem.residuals(start) ** 2)), rel=1e-12)
    assert (np.diff(history) <= 0).all()
    assert history[-1] == pytest.approx(float(found.equations.cost), rel=1e-12)
    assert history[-1] < 0.1 * history[0]


def test_a_start_at_the_optimum_stays() -> None:
    problem, start = made_from(1)
    optimum = solve(problem, start)
    again = solve(problem, optimum.state)
    assert bool(again.converged)
    assert int(again.iterations) <= 3
    np.testing.assert_allclose(vector_of(again.state), vector_of(optimum.state), atol=1e-7)


def test_too_few_steps_are_not_called_converged() -> None:
    problem, start = made_from(2)
    found: SolveResult = solve(problem, start, max_steps=2)
    assert not bool(found.converged)
    assert int(found.iterations) == 2


def test_residuals_that_are_no_numbers_are_not_called_converged() -> None:
    problem, start = made_from(3)
    broken = eqx.tree_at(lambda p: p.ranges, problem, problem.ranges.at[4, 0].set(jnp.nan))
    found = solve(broken, start)
    assert not bool(found.converged)


# --- Huber -----------------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(root=st.floats(0.0, 100.0), width=st.floats(0.1, 10.0))
def test_huber_is_its_definition(root: float, width: float) -> None:
    rho, weight = huber(jnp.asarray(root**2), width)
    inside = root <= width
    # Huber 1964: half of rho is r^2 / 2 inside, width (|r| - width / 2) outside; continuous with its first derivative.
    expected = root**2 if inside else 2.0 * width * (root - 0.5 * width)
    np.testing.assert_allclose(rho, expected, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(weight, 1.0 if inside else width / root, rtol=1e-9)


@settings(max_examples=40, deadline=None)
@given(squared=st.floats(0.0, 1e4), width=st.floats(0.1, 10.0))
def test_hubers_weight_is_the_derivative_of_the_loss(squared: float, width: float) -> None:
    derivative = jax.grad(lambda s: huber(s, width)[0])(jnp.asarray(squared))
    np.testing.assert_allclose(huber(jnp.asarray(squared), width)[1], derivative, rtol=1e-9)


def test_an_infinite_width_is_plain_least_squares() -> None:
    squared = jnp.array([0.0, 1.0, 1e6])
    rho, weight = huber(squared, jnp.inf)
    np.testing.assert_array_equal(rho, squared)
    np.testing.assert_array_equal(weight, 1.0)
    assert np.isfinite(jax.vmap(jax.grad(lambda s: huber(s, jnp.inf)[0]))(squared)).all()
