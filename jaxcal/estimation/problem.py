"""What a least-squares problem has to offer to be solved by the block-arrow engine."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float

from jaxcal.estimation.block_arrow import BlockArrow

# The state of a problem (its rotations, translations, parameters) is any pytree of arrays.
State = Any


@runtime_checkable
class BlockArrowProblem(Protocol):
    """A nonlinear least-squares problem on a manifold with block-arrow normal equations.

    Implementations are `equinox.Module`s, so that their data are arrays of one compiled program.
    """

    def linearise(self, state: State) -> BlockArrow:
        """Cost and Gauss-Newton normal equations at `state`, with respect to the tangent of `retract`."""
        ...

    def retract(self, state: State, chain: Float[Array, "K B"], shared: Float[Array, " P"]) -> State:
        """Move `state` along a tangent step."""
        ...

    def residuals(self, state: State) -> Float[Array, " R"]:
        """All whitened residuals as one vector; the reference for tests and for stock optimistix solvers."""
        ...
