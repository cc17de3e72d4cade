"""The damped Gauss-Newton step through the block-arrow factorisation."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.estimation.block_arrow import BlockArrow, factorise

# Of the first step, where it is not known how near the optimum is.
FIRST_DAMPING = 1e-4
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
