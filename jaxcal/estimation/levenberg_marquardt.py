"""Levenberg-Marquardt on block-arrow problems, as an optimistix least-squares solver.

Imported when a solve is traced: programs that lie on the disk do without optimistix, which takes a tenth of the time
that a process needs to start.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxcal.estimation.block_arrow import BlockArrow
from jaxcal.estimation.descent import FIRST_DAMPING, BlockStep, damped_step
from jaxcal.estimation.problem import BlockArrowProblem, State

_MAX_HISTORY = 256
_LARGEST_DAMPING = 1e14
# Damping that holds back no direction that is determined at all: what still promises little under it is an optimum.
_HARDLY_DAMPED = 1e-12
# So often such a step may lead uphill (out of a curved valley) before convergence is told by damped ones alone.
_MOST_REFUSALS = 3
_NO_LIMIT = 10**9


@eqx.filter_jit
def _linearise(problem: BlockArrowProblem, state: State) -> BlockArrow:
    """Jitted so that it is traced once, although the loop around it is traced several times."""
    return problem.linearise(state)


class _LoopState(eqx.Module):
    first: Bool[Array, ""]
    trial: State
    predicted: Float[Array, ""]
    equations: BlockArrow
    damping: Float[Array, ""]
    raise_by: Float[Array, ""]
    converged: Bool[Array, ""]
    stuck: Bool[Array, ""]
    probing: Bool[Array, ""]
    refusals: Int[Array, ""]
    iteration: Int[Array, ""]
    history: Float[Array, " history"]


class BlockArrowDescent(optx.AbstractDescent):
    """`optimistix` descent whose query state is the block-arrow normal equations and whose step size is 1/damping."""

    def init(self, y: Any, f_info_struct: Any) -> BlockArrow:
        return f_info_struct

    def query(self, y: Any, f_info: Any, state: BlockArrow) -> BlockArrow:
        return f_info

    def step(self, step_size: Float[Array, ""], state: BlockArrow) -> tuple[BlockStep, optx.RESULTS]:
        """The step for damping 1 / `step_size`."""
        return damped_step(state, 1.0 / step_size), optx.RESULTS.successful


class BlockArrowLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt with structured linear algebra and steps on a manifold.

    Called through `optimistix.least_squares` with `options={"problem": problem}`, `problem` a `BlockArrowProblem`;
    further options are `max_steps`, a coarser `rtol`, and the first `damping`.
    Damping after Nielsen (1999), scaled by the diagonal of H. It stops when the accepted state's next step, hardly
    damped, promises a decrease of the cost below `rtol * cost + atol`; the cost of noise-normalised residuals is half a
    chi-square, so that a promise of 1e-6 is a thousandth of a sigma.
    """

    rtol: float = 1e-11
    atol: float = 1e-12
    norm: Callable[[Any], Any] = optx.max_norm
    descent: BlockArrowDescent = BlockArrowDescent()

    def init(
        self, fn: Any, y: State, args: Any, options: dict[str, Any], f_struct: Any, aux_struct: Any, tags: Any
    ) -> _LoopState:
        problem: BlockArrowProblem = options["problem"]
        structure = eqx.filter_eval_shape(_linearise, problem, y)
        equations = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), structure)
        return _LoopState(
            first=jnp.array(True),
            trial=y,
            predicted=jnp.array(jnp.inf),
            equations=eqx.tree_at(lambda e: e.cost, equations, jnp.array(jnp.inf)),
            damping=jnp.asarray(options.get("damping", FIRST_DAMPING)),
            raise_by=jnp.array(2.0),
            converged=jnp.array(False),
            stuck=jnp.array(False),
            probing=jnp.array(False),
            refusals=jnp.array(0),
            iteration=jnp.array(0),
            history=jnp.full(_MAX_HISTORY, jnp.nan),
        )

    def step(
        self, fn: Any, y: State, args: Any, options: dict[str, Any], state: _LoopState, tags: Any
    ) -> tuple[State, _LoopState, Any]:
        problem: BlockArrowProblem = options["problem"]
        trial_equations = _linearise(problem, state.trial)
        decrease = state.equations.cost - trial_equations.cost
        accept = state.first | (jnp.isfinite(trial_equations.cost) & (decrease > 0))

        y = _select(accept, state.trial, y)
        equations = _select(accept, trial_equations, state.equations)
        ratio = jnp.where(jnp.isfinite(state.predicted), decrease / state.predicted, 1.0)
        damping, raise_by = _next_damping(accept, state.first, ratio, state.damping, state.raise_by)

        tolerance = jnp.maximum(self.rtol, options.get("rtol", 0.0)) * equations.cost + self.atol
        refusals = state.refusals + (state.probing & ~accept)
        probe = accept & (damping > _HARDLY_DAMPED) & (refusals < _MOST_REFUSALS)
        step, further = self._far_enough_step(damping, equations, tolerance, probe)
        damping = jnp.where(further, _HARDLY_DAMPED, damping)
        small = step.predicted < tolerance
        # A rejected step whose promise drowns in the rounding of the cost is as good as convergence.
        drowned = ~accept & (state.predicted < 1e-13 * equations.cost)

        new_state = _LoopState(
            first=jnp.array(False),
            trial=problem.retract(y, step.chain, step.shared),
            predicted=step.predicted,
            equations=equations,
            damping=damping,
            raise_by=raise_by,
            converged=(accept & small) | drowned,
            stuck=damping > _LARGEST_DAMPING,
            probing=further,
            refusals=refusals,
            iteration=state.iteration + 1,
            history=state.history.at[jnp.minimum(state.iteration, _MAX_HISTORY - 1)].set(equations.cost),
        )
        return y, new_state, None

    def _far_enough_step(
        self, damping: Float[Array, ""], equations: BlockArrow, tolerance: Float[Array, ""], probe: Bool[Array, ""]
    ) -> tuple[BlockStep, Bool[Array, ""]]:
        """The damped step; or the hardly damped one, where `probe` allows it, the damped one promises less than the
        tolerance and this more. And whether it is that one.

        A damped step promises little where a direction is weak, however far the optimum lies along it. A loop of one or
        two passes, since the linear algebra is compiled for each place where it stands in the program.
        """
        nothing = jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), eqx.filter_eval_shape(self._finite_step, damping, equations)
        )

        def ask(loop: tuple[Array, Array, BlockStep]) -> tuple[Array, Array, BlockStep]:
            asked, _, before = loop
            step = self._finite_step(jnp.where(asked == 0, damping, _HARDLY_DAMPED), equations)
            further = (asked > 0) & (step.predicted >= tolerance)
            return asked + 1, further, _select((asked == 0) | further, step, before)

        def again(loop: tuple[Array, Array, BlockStep]) -> Bool[Array, ""]:
            asked, _, step = loop
            return (asked == 0) | ((asked == 1) & probe & (step.predicted < tolerance))

        _, further, step = jax.lax.while_loop(again, ask, (jnp.array(0), jnp.array(False), nothing))
        return step, further

    def _finite_step(self, damping: Float[Array, ""], equations: BlockArrow) -> BlockStep:
        """The damped step; where the matrix is not positive definite none, of which nothing is promised."""
        step, _ = self.descent.step(1.0 / damping, equations)
        finite = jnp.isfinite(step.predicted)
        step = jax.tree.map(lambda leaf: jnp.where(finite, leaf, 0.0), step)
        return eqx.tree_at(lambda s: s.predicted, step, jnp.where(finite, step.predicted, jnp.nan))

    def terminate(
        self, fn: Any, y: State, args: Any, options: dict[str, Any], state: _LoopState, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        spent = state.iteration >= options.get("max_steps", _NO_LIMIT)
        result = optx.RESULTS.where(
            spent & ~state.converged, optx.RESULTS.nonlinear_max_steps_reached, optx.RESULTS.successful
        )
        result = optx.RESULTS.where(state.stuck & ~state.converged, optx.RESULTS.nonlinear_divergence, result)
        return state.converged | state.stuck | spent, result

    def postprocess(
        self,
        fn: Any,
        y: State,
        aux: Any,
        args: Any,
        options: dict[str, Any],
        state: _LoopState,
        tags: Any,
        result: optx.RESULTS,
    ) -> tuple[State, Any, dict[str, Any]]:
        stats = {
            "history": state.history,
            "iterations": state.iteration,
            "converged": state.converged,
            "equations": state.equations,
        }
        return y, aux, stats


def _select(condition: Bool[Array, ""], yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _next_damping(
    accept: Bool[Array, ""],
    first: Bool[Array, ""],
    ratio: Float[Array, ""],
    damping: Float[Array, ""],
    raise_by: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Nielsen's rule (IMM-REP-1999-05, eq. 2.4): shrink smoothly with the gain ratio, grow ever faster on failures."""
    shrink = jnp.clip(1.0 - (2.0 * ratio - 1.0) ** 3, 0.1, 2.0)
    lower = jnp.maximum(damping * shrink, 1e-14)
    new = jnp.where(first, damping, jnp.where(accept, lower, damping * raise_by))
    return new, jnp.where(accept, 2.0, jnp.minimum(2.0 * raise_by, 1e4))


class NoAdjoint(optx.AbstractAdjoint):
    """Run the loop, and offer no derivatives of it."""

    def apply(self, primal_fn: Callable[..., Any], rewrite_fn: Any, inputs: Any, tags: Any) -> Any:
        return primal_fn((*inputs, functools.partial(eqxi.while_loop, kind="lax")))
