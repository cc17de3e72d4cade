"""The structured normal equations are those of the residuals, as automatic differentiation gives them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array
from small_problems import camera_only, with_imu, with_unknown_target

from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.state import RigState, tangent_basis
from jaxcal.estimation import BlockArrow

seeds = st.integers(0, 2**31 - 1)
# Each program runs a few times on a second's data: it is compiled in half the time where it need not be quick.
_OPTIONS: dict[str, Any] = {
    "compiler_options": {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
}
hardly_optimised = eqx.filter_jit(**_OPTIONS)


@hardly_optimised
def linearise(problem: RigProblem, state: RigState) -> BlockArrow:
    return problem.linearise(state)


@hardly_optimised
def move(problem: RigProblem, state: RigState, chain: Array, shared: Array) -> RigState:
    return problem.retract(state, chain, shared)


@hardly_optimised
def pushed(problem: RigProblem, state: RigState, vector: Array) -> tuple[Array, Array]:
    """Residuals r (R,) and J v (R,) by automatic differentiation; tangent vectors with the chain first."""

    def at(tangent: Array) -> Array:
        split = problem.free_chain.size
        chain, shared = tangent[:split].reshape(problem.free_chain.shape), tangent[split:]
        return problem.residuals(problem.retract(state, chain, shared))

    return jax.jvp(at, (jnp.zeros_like(vector),), (vector,))


@hardly_optimised
def structured(equations: BlockArrow, vector: Array) -> tuple[Array, Array, Array]:
    """Gradient, diagonal of H, and H v."""
    split = equations.gradient_chain.size
    product = equations.mv(vector[:split].reshape(equations.gradient_chain.shape), vector[split:])
    parts = ((equations.gradient_chain, equations.gradient_shared), equations.diagonal(), product)
    gradient, diagonal, product = (jnp.concatenate([jnp.ravel(chain), shared]) for chain, shared in parts)
    return gradient, diagonal, product


def assert_equations_match(problem: RigProblem, state: RigState, rng: np.random.Generator) -> None:
    """V'HV = (JV)'(JV), V'g = (JV)'r and cost = r'r / 2 on what is free; identity rows on what is held.

    V holds a few random vectors: symmetric matrices that agree on those are equal with probability one.
    """
    free = np.concatenate([np.ravel(problem.free_chain), np.asarray(problem.free)])
    equations = linearise(problem, state)
    gradient, diagonal, _ = (np.asarray(part) for part in structured(equations, jnp.zeros(free.shape)))
    # In units of each coordinate's own size, so that none drowns among the others: metres, radians and pixels mix.
    V = rng.standard_normal((4, len(free))) / np.sqrt(np.maximum(diagonal, 1e-12))
    HV = np.stack([np.asarray(structured(equations, jnp.asarray(v))[2]) for v in V])
    JV = [pushed(problem, state, jnp.asarray(v * free)) for v in V]
    residuals, moved = np.asarray(JV[0][0]), np.stack([np.asarray(m) for _, m in JV])
    held = (V * ~free) @ (V * ~free).T
    np.testing.assert_allclose(V @ HV.T, moved @ moved.T + held, atol=1e-10 * len(free))
    np.testing.assert_allclose(
        V @ gradient, moved @ residuals, atol=1e-11 * len(free) * float(np.linalg.norm(residuals))
    )
    np.testing.assert_array_equal(gradient[~free], 0.0)
    np.testing.assert_array_equal(diagonal[~free], 1.0)
    assert float(equations.cost) == pytest.approx(0.5 * float(residuals @ residuals), rel=1e-12)


@settings(deadline=None, max_examples=8)
@given(seed=seeds)
def test_equations_of_cameras_alone_are_those_of_autodiff(seed: int) -> None:
    assert_equations_match(*camera_only(seed), np.random.default_rng(seed))


@settings(deadline=None, max_examples=8)
@given(seed=seeds)
def test_equations_along_any_directions_of_the_lenses_are_those_of_autodiff(seed: int) -> None:
    problem, state = camera_only(seed)
    rng = np.random.default_rng(seed)
    basis = tuple(
        jnp.asarray(np.eye(lens.shape[1]) + 0.3 * rng.standard_normal((*lens.shape, lens.shape[1])))
        for lens in state.lenses
    )
    problem = eqx.tree_at(lambda p: p.basis, problem, basis, is_leaf=lambda leaf: leaf is None)
    assert_equations_match(problem, state, rng)


@settings(deadline=None, max_examples=8)
@given(seed=seeds)
def test_equations_with_an_unknown_target_are_those_of_autodiff(seed: int) -> None:
    assert_equations_match(*with_unknown_target(seed), np.random.default_rng(seed))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "models", "gravity_size", "rolling"),
    [
        (6, ["calibrated"], 2, True),
        (4, ["scale-misalignment", "scale-misalignment-size-effect"], 3, False),
    ],
)
def test_equations_of_cameras_and_imus_are_those_of_autodiff(
    order: int, models: list[str], gravity_size: int, rolling: bool
) -> None:
    @settings(deadline=None, max_examples=3)
    @given(seed=seeds)
    def check(seed: int) -> None:
        assert_equations_match(*with_imu(seed, order, models, gravity_size, rolling), np.random.default_rng(seed))

    check()


@settings(deadline=None, max_examples=8)
@given(seed=seeds)
def test_held_parameters_are_left_alone(seed: int) -> None:
    problem, state = camera_only(seed)
    rng = np.random.default_rng(seed)
    problem = eqx.tree_at(
        lambda p: (p.free, p.free_chain),
        problem,
        (jnp.asarray(rng.random(problem.free.shape) < 0.5), jnp.asarray(rng.random(problem.free_chain.shape) < 0.5)),
    )
    assert_equations_match(problem, state, rng)


@settings(deadline=None, max_examples=8)
@given(seed=seeds, width=st.floats(0.5, 200.0))
def test_the_gradient_is_that_of_the_cost_under_hubers_loss(seed: int, width: float) -> None:
    problem, state = camera_only(seed)
    problem = eqx.tree_at(lambda p: p.loss_width, problem, jnp.asarray(width))
    rng = np.random.default_rng(seed)
    equations = linearise(problem, state)
    chain = rng.standard_normal(problem.free_chain.shape) * np.asarray(problem.free_chain)
    shared = rng.standard_normal(problem.free.shape) * np.asarray(problem.free)
    h = 1e-5
    costs = [float(linearise(problem, move(problem, state, s * h * chain, s * h * shared)).cost) for s in (-1.0, 1.0)]
    slope = np.sum(np.asarray(equations.gradient_chain) * chain) + np.asarray(equations.gradient_shared) @ shared
    # A corner that crosses the loss's bend within the step costs the difference a little accuracy.
    scale = np.sqrt(np.sum(np.asarray(equations.gradient_chain) ** 2)) + abs(slope)
    assert (costs[1] - costs[0]) / (2 * h) == pytest.approx(slope, abs=1e-5 * scale)


@settings(deadline=None, max_examples=8)
@given(seed=seeds)
def test_a_lens_prior_pulls_with_its_information(seed: int) -> None:
    problem, state = camera_only(seed)
    none = jax.tree.map(jnp.zeros_like, problem.prior.information)
    without = linearise(eqx.tree_at(lambda p: p.prior.information, problem, none), state)
    equations = linearise(problem, state)
    cost = 0.0
    for group, members in enumerate(problem.layout.groups):
        error = np.asarray(state.lenses[group] - problem.prior.mean[group])
        for place, camera in enumerate(members):
            rows = problem.layout.lens(camera)
            information = np.asarray(problem.prior.information[group][place])
            np.testing.assert_allclose((equations.corner - without.corner)[rows, rows], information, atol=1e-6)
            added = np.asarray((equations.gradient_shared - without.gradient_shared)[rows])
            np.testing.assert_allclose(added, information @ error[place], atol=1e-6)
            cost += 0.5 * error[place] @ information @ error[place]
    assert float(equations.cost - without.cost) == pytest.approx(cost, abs=1e-7 * float(equations.cost))
    np.testing.assert_array_equal(equations.border, without.border)


@settings(deadline=None, max_examples=30)
@given(st.tuples(*[st.floats(-10.0, 10.0) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_the_directions_of_gravity_are_orthonormal_and_across_it(vector: tuple[float, float, float]) -> None:
    basis = np.asarray(tangent_basis(jnp.asarray(vector)))
    np.testing.assert_allclose(basis.T @ basis, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(basis.T @ np.asarray(vector), 0.0, atol=1e-11)
