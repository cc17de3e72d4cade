"""Derivatives of an optimum by the data, against finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.estimation import BlockArrow, GaussNewtonAdjoint, solve


class Decay(eqx.Module):
    """Chain of amplitudes a_k, a shared rate r: measurements a_k exp(-r t), plus a smoothness term along the chain."""

    measured: Float[Array, "K T"]
    times: Float[Array, " T"]

    def residuals(self, state: tuple) -> Array:
        amplitude, rate = state
        fit = amplitude[:, None] * jnp.exp(-rate[0] * self.times) - self.measured
        return jnp.concatenate([fit.ravel(), 0.3 * jnp.diff(amplitude)])

    def retract(self, state: tuple, chain: Array, shared: Array) -> tuple:
        return state[0] + chain[:, 0], state[1] + shared

    def linearise(self, state: tuple) -> BlockArrow:
        amplitude, rate = state
        decay = jnp.exp(-rate[0] * self.times)
        fit = amplitude[:, None] * decay - self.measured
        by_rate = -amplitude[:, None] * self.times * decay
        count = len(amplitude)
        neighbours = jnp.zeros(count).at[:-1].add(0.09).at[1:].add(0.09)
        band = jnp.zeros((count, 2, 1, 1)).at[:, 0, 0, 0].set(decay @ decay + neighbours)
        smooth = 0.09 * jnp.diff(amplitude)
        gradient = (fit @ decay).at[1:].add(smooth).at[:-1].add(-smooth)
        return BlockArrow(
            band=band.at[:-1, 1, 0, 0].set(-0.09),
            border=(by_rate @ decay)[:, None, None],
            corner=jnp.sum(by_rate**2)[None, None],
            gradient_chain=gradient[:, None],
            gradient_shared=jnp.sum(fit * by_rate)[None],
            cost=0.5 * jnp.sum(self.residuals(state) ** 2),
        )


def test_derivative_of_the_optimum_by_the_data() -> None:
    times = jnp.linspace(0.0, 2.0, 6)
    truth = jnp.full(4, 1.1)  # residuals vanish at the optimum, where Gauss-Newton derivatives are exact
    measured = truth[:, None] * jnp.exp(-0.7 * times) + 1e-5 * jnp.sin(jnp.arange(24.0).reshape(4, 6))
    start = (jnp.ones(4), jnp.array([0.3]))

    @eqx.filter_jit
    def optimal_rate(measured: Array) -> Array:
        return solve(Decay(measured, times), start, adjoint=GaussNewtonAdjoint()).state[1][0]

    backward = jax.grad(optimal_rate)(measured)
    direction = jnp.asarray(np.random.default_rng(0).normal(size=(4, 6)))
    step = 1e-5
    difference = (optimal_rate(measured + step * direction) - optimal_rate(measured - step * direction)) / (2 * step)
    np.testing.assert_allclose(jnp.sum(backward * direction), difference, rtol=1e-3)
    forward = jax.jvp(optimal_rate, (measured,), (direction,))[1]
    np.testing.assert_allclose(forward, jnp.sum(backward * direction), rtol=1e-9)


def test_the_value_is_that_of_the_plain_solve() -> None:
    times = jnp.linspace(0.0, 2.0, 6)
    problem = Decay(jnp.full(4, 1.1)[:, None] * jnp.exp(-0.7 * times), times)
    start = (jnp.ones(4), jnp.array([0.3]))
    plain, derived = solve(problem, start), solve(problem, start, adjoint=GaussNewtonAdjoint())
    assert bool(plain.converged)
    np.testing.assert_allclose(derived.state[0], plain.state[0], atol=1e-7)
    np.testing.assert_allclose(plain.state[1], 0.7, atol=1e-6)
