"""Where the target's points really are: boards at unknown mutual poses, a bent board, points off their place."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxcal.calibration.state import SharedLayout, TargetState
from jaxcal.estimation import on_device
from jaxcal.targets import Target


class TargetGeometry(eqx.Module):
    """The target as stated: `points` (N, 3) m, each in its own board's frame; `board` (N,) the board of each point;
    `across` (N, 2) the place on the board, -1 to 1 from edge to edge of the points, for the warp; `offset_sigma` m,
    how far a point may plausibly be from its stated place."""

    points: Float[Array, "N 3"]
    board: Int[Array, " N"]
    across: Float[Array, "N 2"]
    offset_sigma: Float[Array, ""]


# How far a point may plausibly be from its place, where nobody said (m).
_OFFSET_SIGMA_M = 1e-3


def geometry_of(target: Target, offset_sigma_m: float | None = None) -> TargetGeometry:
    """The stated geometry of a target."""
    board = np.asarray(target.board_of_point)
    across = np.zeros((len(board), 2))
    for b in range(int(board.max()) + 1):
        plane = target.points[board == b, :2]
        low, high = plane.min(axis=0), plane.max(axis=0)
        across[board == b] = (2.0 * plane - low - high) / np.maximum(high - low, 1e-12)
    return TargetGeometry(
        points=on_device(target.points),
        board=on_device(board),
        across=on_device(across),
        offset_sigma=on_device(_OFFSET_SIGMA_M if offset_sigma_m is None else float(offset_sigma_m)),
    )


def target_points(geometry: TargetGeometry, target: TargetState) -> Float[Array, "N 3"]:
    """Points in the target's frame (that of its first board), m.

    A warped board bulges out of its plane by w_x (1 - x^2) + w_y (1 - y^2), x and y from -1 to 1 across the board, as
    in mrcal's board model (mrcal documentation, "Calibration object deformation").
    """
    points = geometry.points
    if len(target.warp):
        height = (1.0 - geometry.across**2) @ target.warp
        points = points + height[:, None] * jnp.array([0.0, 0.0, 1.0])
    if len(target.offsets):
        points = points + target.offsets
    if len(target.R_target_board):
        rotations = jnp.concatenate([jnp.eye(3)[None], target.R_target_board])
        translations = jnp.concatenate([jnp.zeros((1, 3)), target.t_target_board])
        points = jnp.einsum("nij,nj->ni", rotations[geometry.board], points) + translations[geometry.board]
    return points


def points_by_target(geometry: TargetGeometry, target: TargetState, layout: SharedLayout) -> Float[Array, "T 3 N"]:
    """Derivative of the points by the tangent of `target` (T coordinates)."""

    def moved(step: Array) -> Array:
        return target_points(geometry, target.retract(layout, step))

    jacobian = jax.jacfwd(moved)(jnp.zeros(layout.target_size))
    return jacobian.transpose(2, 1, 0)
