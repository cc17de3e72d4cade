"""`solve`: a block-arrow problem to its optimum, in one compiled program per problem shape."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.estimation.arrays import on_device
from jaxcal.estimation.block_arrow import BlockArrow
from jaxcal.estimation.descent import FIRST_DAMPING
from jaxcal.estimation.problem import BlockArrowProblem, State
from jaxcal.estimation.threads import single_threaded_blas
from jaxcal.programs import stored_jit


class SolveResult(eqx.Module):
    """The optimum, and how it was reached."""

    state: State
    equations: BlockArrow
    history: Float[Array, " history"]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


def solve(
    problem: BlockArrowProblem,
    state: State,
    *,
    solver: eqx.Module | None = None,
    max_steps: int = 100,
    rtol: float = 0.0,
    damping: float = FIRST_DAMPING,
    adjoint: eqx.Module | None = None,
) -> SolveResult:
    """Minimise a block-arrow problem from `state`; one compiled program per problem shape.

    `rtol` above the solver's own ends the search sooner, where the optimum is a step on the way to another problem's;
    `damping` is the first step's, small where the start is known to be near. `solver` is a
    `BlockArrowLevenbergMarquardt` with other tolerances.

    With `adjoint=GaussNewtonAdjoint()` the optimum can be differentiated by the problem's arrays (its data).
    """
    with single_threaded_blas():
        # Limits are data of the program, so that calls with other ones need not compile another one.
        limits = {"max_steps": on_device(max_steps), "rtol": on_device(rtol), "damping": on_device(damping)}
        return jax.block_until_ready(_solve(problem, state, solver=solver, **limits, adjoint=adjoint))


def solve_inside(
    problem: BlockArrowProblem,
    state: State,
    *,
    solver: eqx.Module | None = None,
    max_steps: int | Int[Array, ""] = 100,
    rtol: float | Float[Array, ""] = 0.0,
    damping: float | Float[Array, ""] = FIRST_DAMPING,
    adjoint: eqx.Module | None = None,
) -> SolveResult:
    """`solve` as a part of a larger jitted computation: many small problems under `lax.map`, say.

    Run that computation under `single_threaded_blas`, as `solve` does by itself.
    """
    import optimistix as optx  # not needed by who finds the program on the disk

    from jaxcal.estimation.levenberg_marquardt import BlockArrowLevenbergMarquardt, NoAdjoint

    # Not typed: their classes are known from here on only.
    chosen: Any = solver or BlockArrowLevenbergMarquardt()
    derivatives: Any = adjoint or NoAdjoint()

    # optimistix traces the residual function, which this solver never evaluates: it works on normal equations.
    def untouched(y: State, args: Any) -> Array:
        return jnp.zeros(1)

    solution = optx.least_squares(
        untouched,
        chosen,
        state,
        options={"problem": problem, "max_steps": max_steps, "rtol": rtol, "damping": damping},
        max_steps=None,
        throw=False,
        adjoint=derivatives,
    )
    stats = solution.stats
    return SolveResult(solution.value, stats["equations"], stats["history"], stats["iterations"], stats["converged"])


_solve = stored_jit(solve_inside)
