"""From what corners and IMUs say of windows of the chain to the block-arrow normal equations of the whole rig.

Corners touch poses alone, an IMU's sample its own biases besides. Both are summed by themselves and brought
into the band last: windows padded to all coordinates of a chain block are ten times the memory, and moving that was
most of the time of an iteration. With IMUs a block of the chain holds the control points of k - 1 knot intervals, k the
spline's order, and one set of biases, for these hardly change in so short a time: with biases at every control point
the factorisation took three times as long.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.calibration.inertial import (
    ChainPrior,
    InertialData,
    IntervalEquations,
    linearise_imu,
    linearise_model_prior,
    linearise_prior,
)
from jaxcal.calibration.state import RigState, SharedLayout
from jaxcal.estimation import (
    BlockArrow,
    band_from_windows,
    chain_from_windows,
    gathered_band,
    gathered_chain,
    sum_along_chain,
)


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
    prior = linearise_prior(state, data, order)
    missing = [(0, 0), (0, order - prior.band.shape[1]), (0, 0), (0, 0)]
    poses, gradient = corners.band + jnp.pad(prior.band, missing), corners.gradient + prior.gradient
    corner, gradient_shared, cost = corners.corner, corners.gradient_shared, corners.cost + prior.cost
    for i, imu in enumerate(imus):
        usual = linearise_model_prior(state, layout, i)
        own, columns = layout.imu(i), np.r_[layout.imu(i), layout.gravity]
        poses, gradient = poses + band_from_windows(imu.window), gradient + chain_from_windows(imu.gradient)
        corner = corner.at[columns[:, None], columns].add(imu.shared).at[own, own].add(usual.information)
        gradient_shared = gradient_shared.at[columns].add(imu.gradient_shared).at[own].add(usual.gradient)
        cost = cost + imu.cost + usual.cost

    per = order - 1
    biases = [_of_blocks(imu, per) for imu in imus]
    by_biases = [
        prior.gradient_biases[:, 6 * i : 6 * i + 6] + chain_from_windows(b.gradient) for i, b in enumerate(biases)
    ]
    return BlockArrow(
        band=_band(gathered_band(poses, per), biases, prior),
        border=_border(corners, imus, biases, layout, per),
        corner=corner,
        gradient_chain=jnp.concatenate([gathered_chain(gradient, per), *by_biases], axis=1),
        gradient_shared=gradient_shared,
        cost=cost,
    )


class _BiasEquations(eqx.Module):
    """What one IMU says of its biases at both ends of a block of knot intervals: with the poses of the block and the
    next one (`poses`, n of each), with each other (diagonal), with shared coordinates; and the gradient."""

    poses: Float[Array, "J 2 6 2 n"]
    biases: Float[Array, "J 2 2 6"]
    cross: Float[Array, "J 2 6 s"]
    gradient: Float[Array, "J 2 6"]


def _of_blocks(imu: IntervalEquations, per: int) -> _BiasEquations:
    """Summed over the `per` knot intervals of each block."""
    intervals = imu.gradient.shape[0]
    count = -(-intervals // per)

    def of_blocks(leaf: Array) -> Array:
        padding = [(0, count * per - intervals)] + [(0, 0)] * (leaf.ndim - 1)
        return jnp.pad(leaf, padding).reshape(count, per, *leaf.shape[1:])

    with_poses = of_blocks(imu.bias_pose)
    poses = jnp.zeros((count, 2, 6, 2 * per, 6))
    for place in range(per):
        poses = poses.at[:, :, :, place : place + per + 1].add(with_poses[:, place])
    return _BiasEquations(
        poses=poses.reshape(count, 2, 6, 2, 6 * per),
        biases=of_blocks(imu.bias_bias).sum(axis=1),
        cross=of_blocks(imu.bias_cross).sum(axis=1),
        gradient=of_blocks(imu.gradient_bias).sum(axis=1),
    )


def _border(
    corners: PoseEquations,
    imus: Sequence[IntervalEquations],
    biases: Sequence[_BiasEquations],
    layout: SharedLayout,
    per: int,
) -> Float[Array, "M n P"]:
    """Products of chain and shared coordinates."""
    gravity = layout.gravity_size
    crosses = [chain_from_windows(imu.cross) for imu in imus]
    # Without an IMU (a rolling shutter alone needs a trajectory, too) gravity is held.
    pulled = sum((cross[..., -gravity:] for cross in crosses), start=jnp.zeros((*corners.gradient.shape, gravity)))
    own = (cross[..., :-gravity] for cross in crosses)
    rows = [gathered_chain(jnp.concatenate([corners.cameras, *own, pulled, corners.others], axis=-1), per)]
    for i, bias in enumerate(biases):
        place, others = layout.imu(i), layout.size - layout.gravity.stop
        columns = chain_from_windows(bias.cross)
        before = jnp.pad(columns[..., :-gravity], [(0, 0), (0, 0), (place.start, layout.gravity.start - place.stop)])
        rows.append(jnp.concatenate([before, jnp.pad(columns[..., -gravity:], [(0, 0), (0, 0), (0, others)])], axis=-1))
    return jnp.concatenate(rows, axis=1)


def _band(
    poses: Float[Array, "M 2 n n"], biases: Sequence[_BiasEquations], prior: ChainPrior
) -> Float[Array, "M 2 B B"]:
    """Blocks on the diagonal, and below it. The biases of an IMU touch no other IMU's."""
    blocks = poses.shape[0]
    after = [(0, 1), (0, 0), (0, 0)]  # nothing follows the last block
    own, below = [[poses[:, 0]]], [[poses[:, 1]]]
    for i, bias in enumerate(biases):
        here, there = bias.poses[:, :, :, 0], bias.poses[:, :, :, 1]
        by_pose = sum_along_chain([(0, here[:, 0]), (1, there[:, 1])], blocks)
        information = sum_along_chain([(0, bias.biases[:, 0, 0]), (1, bias.biases[:, 1, 1])], blocks)
        between = jnp.pad(bias.biases[:, 1, 0], after[:2])
        information, between = (
            _diagonal(part + walk[:, 6 * i : 6 * i + 6])
            for part, walk in zip((information, between), prior.walk.swapaxes(0, 1), strict=True)
        )
        none = [jnp.zeros((blocks, 6, 6))] * i
        for rows, column, row, block in (
            (own, by_pose.swapaxes(1, 2), by_pose, information),
            (below, jnp.pad(there[:, 0], after).swapaxes(1, 2), jnp.pad(here[:, 1], after), between),
        ):
            for parts, part in zip(rows, [column, *none], strict=True):
                parts.append(part)
            rows.append([row, *none, block])
    return jnp.stack([_joined(own), _joined(below)], axis=1)


def _joined(rows: Sequence[Sequence[Array]]) -> Float[Array, "M B B"]:
    return jnp.concatenate([jnp.concatenate(row, axis=2) for row in rows], axis=1)


def _diagonal(values: Float[Array, "M b"]) -> Float[Array, "M b b"]:
    return values[:, :, None] * jnp.eye(values.shape[1])
