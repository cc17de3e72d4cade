"""From what corners and IMUs say of windows of the chain to the block-arrow normal equations of the whole rig.

Corners touch poses alone, an IMU's sample its own biases besides. Both are summed by themselves and brought
into the band last: windows padded to all coordinates of a chain block are ten times the memory, and moving that was
most of the time of an iteration.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.calibration.inertial import (
    InertialData,
    IntervalEquations,
    linearise_imu,
    linearise_model_prior,
    linearise_prior,
)
from jaxcal.calibration.state import RigState, SharedLayout
from jaxcal.estimation import BlockArrow, band_from_windows, chain_from_windows, sum_along_chain


class PoseEquations(eqx.Module):
    """What all corners say of the chain's poses, and of the shared parameters.

    `cameras` and `others` are the poses' products with the shared coordinates before those of IMUs and gravity, and
    after them.
    """

    band: Float[Array, "K w 6 6"]
    cameras: Float[Array, "K 6 c"]
    others: Float[Array, "K 6 o"]
    gradient: Float[Array, "K 6"]
    corner: Float[Array, "P P"]
    gradient_shared: Float[Array, " P"]
    cost: Float[Array, ""]


def of_poses(corners: PoseEquations, layout: SharedLayout) -> BlockArrow:
    """Equations of cameras alone: a chain of poses."""
    none = jnp.zeros((*corners.gradient.shape, layout.gravity_size))
    return BlockArrow(
        band=corners.band,
        border=jnp.concatenate([corners.cameras, none, corners.others], axis=-1),
        corner=corners.corner,
        gradient_chain=corners.gradient,
        gradient_shared=corners.gradient_shared,
        cost=corners.cost,
    )


def with_imus(
    corners: PoseEquations, state: RigState, data: InertialData, order: int, layout: SharedLayout
) -> BlockArrow:
    """Equations of cameras and IMUs: samples, the motion prior, the biases' random walk, and what is usual of an IMU's
    parameters."""
    imus = [linearise_imu(state, data, order, layout, i) for i in range(len(layout.imus))]
    prior = linearise_prior(state, data)
    poses, gradient, cost = corners.band, corners.gradient, corners.cost + prior.cost
    corner, gradient_shared = corners.corner, corners.gradient_shared
    for i, imu in enumerate(imus):
        usual = linearise_model_prior(state, layout, i)
        own, columns = layout.imu(i), np.r_[layout.imu(i), layout.gravity]
        poses, gradient = poses + band_from_windows(imu.window), gradient + chain_from_windows(imu.gradient)
        corner = corner.at[columns[:, None], columns].add(imu.shared).at[own, own].add(usual.information)
        gradient_shared = gradient_shared.at[columns].add(imu.gradient_shared).at[own].add(usual.gradient)
        cost = cost + imu.cost + usual.cost

    blocks = state.positions.shape[0]
    chains = [gradient, *(chain_from_windows(imu.gradient_bias, blocks) for imu in imus)]
    band = _band(poses, imus)
    return BlockArrow(
        band=band + jnp.pad(prior.band, [(0, 0), (0, order - prior.band.shape[1]), (0, 0), (0, 0)]),
        border=_border(corners, imus, layout, blocks),
        corner=corner,
        gradient_chain=jnp.concatenate(chains, axis=1) + prior.gradient,
        gradient_shared=gradient_shared,
        cost=cost,
    )


def _border(
    corners: PoseEquations, imus: Sequence[IntervalEquations], layout: SharedLayout, blocks: int
) -> Float[Array, "K B P"]:
    """Products of chain and shared coordinates."""
    gravity = layout.gravity_size
    crosses = [chain_from_windows(imu.cross) for imu in imus]
    # Without an IMU (a rolling shutter alone needs a trajectory, too) gravity is held.
    pulled = sum((cross[..., -gravity:] for cross in crosses), start=jnp.zeros((blocks, 6, gravity)))
    own = (cross[..., :-gravity] for cross in crosses)
    rows = [jnp.concatenate([corners.cameras, *own, pulled, corners.others], axis=-1)]
    for i, imu in enumerate(imus):
        place, others = layout.imu(i), layout.size - layout.gravity.stop
        columns = chain_from_windows(imu.bias_cross, blocks)
        before = jnp.pad(columns[..., :-gravity], [(0, 0), (0, 0), (place.start, layout.gravity.start - place.stop)])
        rows.append(jnp.concatenate([before, jnp.pad(columns[..., -gravity:], [(0, 0), (0, 0), (0, others)])], axis=-1))
    return jnp.concatenate(rows, axis=1)


def _band(poses: Float[Array, "K w 6 6"], imus: Sequence[IntervalEquations]) -> Float[Array, "K w B B"]:
    """The band of poses and biases: those of an IMU stand at both ends of an interval, and touch no other IMU's."""
    blocks, width = poses.shape[:2]
    diagonals = []
    for d in range(width):
        rows = [[poses[:, d], *(_pose_by_bias(imu, d, blocks) for imu in imus)]]
        for i, imu in enumerate(imus):
            own = [_bias_by_bias(imu, d, blocks) if i == j else None for j in range(len(imus))]
            rows.append([_bias_by_pose(imu, d, blocks), *own])
        zero = jnp.zeros((blocks, 6, 6))
        rows = [jnp.concatenate([zero if part is None else part for part in row], axis=2) for row in rows]
        diagonals.append(jnp.concatenate(rows, axis=1))
    return jnp.stack(diagonals, axis=1)


def _pose_by_bias(imu: IntervalEquations, d: int, blocks: int) -> Float[Array, "K 6 6"] | None:
    """Rows of poses, columns of the biases that stand `d` chain blocks before them."""
    order = imu.bias_pose.shape[3]
    parts = [(e, imu.bias_pose[:, e, :, e + d].swapaxes(1, 2)) for e in range(2) if e + d < order]
    return sum_along_chain(parts, blocks) if parts else None


def _bias_by_pose(imu: IntervalEquations, d: int, blocks: int) -> Float[Array, "K 6 6"] | None:
    """Rows of biases, columns of the poses that stand `d` chain blocks before them."""
    parts = [(e - d, imu.bias_pose[:, e, :, e - d]) for e in range(d, 2)]
    return sum_along_chain(parts, blocks) if parts else None


def _bias_by_bias(imu: IntervalEquations, d: int, blocks: int) -> Float[Array, "K 6 6"] | None:
    parts = [(e - d, imu.bias_bias[:, e, e - d, :, None] * jnp.eye(6)) for e in range(d, 2)]
    return sum_along_chain(parts, blocks) if parts else None
