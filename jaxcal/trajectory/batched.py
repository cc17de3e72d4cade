"""The rotation spline at many times at once: the same formulas, laid out as a compiler of loops likes them.

Times run along the LAST axes. `rotation_at` under `vmap` multiplies matrices of 3 x 3 one by one, which is slower by
half; where there are ten thousand samples, that is most of an iteration. Loops over the increments are loops of the
program: what they make lies in memory, where otherwise it would be computed anew for every number made of it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.trajectory import so3
from jaxcal.trajectory.bspline import cumulative_basis_matrix, weights


class RotationsAt(eqx.Module):
    """The rotation spline at times along the last axes T, with derivatives by what it is made of.

    `rotation` R (3, 3, *T); `velocity` (3, *T) body-frame angular velocity, rad/s; `from_first` (3, 3, *T), R_0' R; its
    transpose is the right perturbation of R by that of R_0; `rotation_by` and `velocity_by` (k - 1, 3, 3, *T), right
    perturbation of R, and velocity, by each increment.
    """

    rotation: Float[Array, "3 3 *T"]
    velocity: Float[Array, "3 *T"]
    from_first: Float[Array, "3 3 *T"]
    rotation_by: Float[Array, "k1 3 3 *T"]
    velocity_by: Float[Array, "k1 3 3 *T"]


def rotations_at(
    first: Float[Array, "3 3 *#T"],
    increments: Float[Array, "k1 3 *#T"],
    u: Float[Array, "*#T"],
    dt: float | Float[Array, ""],
    order: int,
) -> RotationsAt:
    """As `rotation_at`; `first` and `increments`, those of the window of each time, may be of length 1 along T."""
    matrix = cumulative_basis_matrix(order)
    value, rate = weights(matrix, u, dt, 0)[1:], weights(matrix, u, dt, 1)[1:]

    def turning(parts: tuple[Array, Array]) -> tuple[Array, Array]:
        increment, value = parts
        turn, stretch = so3.exp_with_right_jacobian(value * increment)
        return turn, stretch * value

    turn, stretch = jax.lax.map(turning, (increments, value))
    none = jnp.zeros((3, *u.shape))
    identity = jnp.zeros((3, 3, *u.shape)) + so3.identity(none)

    # The turns that follow increment j, as one rotation; and the velocity so far, carried through turn j.
    from_first, following = jax.lax.scan(
        lambda after, turn: (so3.product(turn, after), after), identity, turn, reverse=True
    )

    def onward(velocity: Array, parts: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        turn, increment, rate = parts
        carried = so3.product(turn.swapaxes(0, 1), velocity)
        return carried + rate * increment, carried

    velocity, carried = jax.lax.scan(onward, none, (turn, increments, rate))

    def by_increment(parts: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        following, stretch, carried, rate = parts
        back = following.swapaxes(0, 1)
        by_velocity = so3.product(so3.hat(carried), stretch) + rate * so3.identity(carried)
        return so3.product(back, stretch), so3.product(back, by_velocity)

    rotation_by, velocity_by = jax.lax.map(by_increment, (following, stretch, carried, rate))
    return RotationsAt(so3.product(first, from_first), velocity, from_first, rotation_by, velocity_by)
