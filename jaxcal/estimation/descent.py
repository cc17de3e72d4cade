"""The damped Gauss-Newton step through the block-arrow factorisation, as an optimistix descent."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from jaxcal.estimation.block_arrow import BlockArrow, factorise

# A parameter that nothing constrains has a zero diagonal; it is damped by this fraction of the largest.
_SMALLEST_DIAGONAL = 1e-14


class BlockStep(eqx.Module):
    """A tangent step and the decrease of the cost that the quadratic model predicts for it."""

    chain: Float[Array, "K B"]
    shared: Float[Array, " P"]
    predicted: Float[Array, ""]


def damped_step(equations: BlockArrow, damping: Float[Array, ""]) -> BlockStep:
    """Solve (H + damping * diag(H)) step = -gradient (Marquardt 1963: scaled by the diagonal, units mix)."""
    chain_diagonal, shared_diagonal = equations.diagonal()
    floor = _SMALLEST_DIAGONAL * jnp.maximum(jnp.max(chain_diagonal), jnp.max(shared_diagonal))
    damping_chain = damping * jnp.maximum(chain_diagonal, floor)
    damping_shared = damping * jnp.maximum(shared_diagonal, floor)
    factor = factorise(equations, damping_chain, damping_shared)
    chain, shared = factor.solve(-equations.gradient_chain, -equations.gradient_shared)
    slope = jnp.sum(equations.gradient_chain * chain) + equations.gradient_shared @ shared
    damped = jnp.sum(damping_chain * chain**2) + damping_shared @ shared**2
    return BlockStep(chain, shared, -0.5 * slope + 0.5 * damped)


class BlockArrowDescent(optx.AbstractDescent):
    """`optimistix` descent whose query state is the block-arrow normal equations and whose step size is 1/damping."""

    def init(self, y: Any, f_info_struct: Any) -> BlockArrow:
        return f_info_struct

    def query(self, y: Any, f_info: Any, state: BlockArrow) -> BlockArrow:
        return f_info

    def step(self, step_size: Float[Array, ""], state: BlockArrow) -> tuple[BlockStep, optx.RESULTS]:
        """The step for damping 1 / `step_size`."""
        return damped_step(state, 1.0 / step_size), optx.RESULTS.successful
