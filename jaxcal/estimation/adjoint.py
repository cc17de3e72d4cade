"""Implicit derivatives of a block-arrow optimum: one Gauss-Newton step at the solution."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx

from jaxcal.estimation.block_arrow import factorise
from jaxcal.estimation.problem import BlockArrowProblem


class GaussNewtonAdjoint(optx.AbstractAdjoint):
    """Differentiate the optimum by the problem's data without differentiating the iterations.

    At the optimum the gradient g(y, data) vanishes, so that dy = -H^-1 dg (implicit function theorem), with the
    Gauss-Newton H that is factorised anyway. Exact for residuals that vanish or are linear in the state; off by the
    share of the Hessian that Gauss-Newton leaves out otherwise (0.4 % at 0.2 px of corner noise). The optimum itself
    moves by one such step, which is below the solver's tolerance.
    """

    def apply(self, primal_fn: Callable, rewrite_fn: Callable, inputs: Any, tags: frozenset[object]) -> Any:
        """Run the solver on constants, then take the step that carries the derivatives."""
        _, _, _, _, options, *_ = inputs
        problem: BlockArrowProblem = options["problem"]
        dynamic, static = eqx.partition(inputs, eqx.is_array)
        constants = eqx.combine(jax.lax.stop_gradient(dynamic), static)
        state, rest = primal_fn((*constants, functools.partial(eqxi.while_loop, kind="lax")))

        equations = problem.linearise(jax.lax.stop_gradient(state))
        frozen = jax.lax.stop_gradient(equations)
        factor = factorise(frozen, jnp.zeros_like(frozen.gradient_chain), jnp.zeros_like(frozen.gradient_shared))
        chain, shared = factor.solve(-equations.gradient_chain, -equations.gradient_shared)
        return problem.retract(jax.lax.stop_gradient(state), chain, shared), rest
