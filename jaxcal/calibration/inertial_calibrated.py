"""An IMU of Kalibr's model `calibrated` at the rig's origin: its samples, reduced interval by interval.

The most usual case, in closed form and laid out for speed: intervals run along the last axis.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.trajectory import Increments, basis_matrix, rotations_at, so3, weights

_Samples = tuple[Float[Array, "B S"], Float[Array, "B S 6"], Float[Array, "B S"]]
_Sums = tuple[Float[Array, "B m m"], Float[Array, "B 2 6 m"], Float[Array, "B 2 2 6"]]


def reduce_batch(
    samples: _Samples,
    first: Float[Array, "B 3 3"],
    increments: Increments,
    control: Float[Array, "B k 3"],
    bias: Float[Array, "B 2 6"],
    ends: Float[Array, "2 S B"],
    inverse_sigma: Float[Array, "6"],
    gravity: Float[Array, "3"],
    gravity_basis: Float[Array, "3 g"],
    dt: Float[Array, ""],
) -> _Sums:
    """Sums over the samples of each interval: of rows times rows, rows times biases, biases times biases.

    `samples`: fraction, readings, present, as `ImuSamples`; rows are those of whitened readings, gyro then accel, by
    the window's k control points (6 coordinates each: rotation, position) and gravity, residual last; m = 6 k + g + 1.
    The interval's two biases enter each reading by the weights `ends`. Furgale et al. 2013, eq. 11 and 12.
    """
    u, readings, present = (leaf.T for leaf in samples)  # (S, B), (6, S, B), (S, B)
    whiten = present * inverse_sigma[:, None, None]
    readings = readings - jnp.einsum("esb,bei->isb", ends, bias)
    gyro, accel = _rows(u, readings, whiten, (first, increments, control), gravity, gravity_basis, dt)
    return _sums(gyro, accel, ends, whiten)


def _rows(
    u: Float[Array, "S B"],
    readings: Float[Array, "6 S B"],
    whiten: Float[Array, "6 S B"],
    window: tuple[Array, Increments, Array],
    gravity: Float[Array, "3"],
    gravity_basis: Float[Array, "3 g"],
    dt: Float[Array, ""],
) -> tuple[Float[Array, "n 3 S B"], Float[Array, "m 3 S B"]]:
    """Rows of gyroscope and accelerometer, columns first.

    Columns are rotation and position of one control point after the other, gravity, and the residual; the gyroscope's
    are those of the rotations, on which alone its readings depend, and the residual.
    """
    first, increments, control = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1)[..., None, :], window)
    order = control.shape[0]
    at = rotations_at(first, increments.vector, u, dt, order)
    second = weights(basis_matrix(order), u, dt, 2)
    acceleration = jnp.sum(second[:, None] * control, axis=0) - gravity[:, None, None]
    force = so3.product(at.rotation.swapaxes(0, 1), acceleration)
    error = jnp.concatenate([at.velocity, force]) - readings
    cross = so3.hat(force)
    # The first control rotation turns all that follows; every other one acts through the increments beside it.
    tilted = _by_control(at.rotation_by, increments).at[0].add(at.from_first.swapaxes(0, 1))
    tilted = jax.lax.map(lambda by: so3.product(cross, by), tilted)
    by_poses = jnp.stack([tilted.swapaxes(1, 2), second[:, None, None] * at.rotation], axis=1)
    gyro = [_by_control(at.velocity_by, increments).swapaxes(1, 2), error[None, :3]]
    accel = [by_poses, -jnp.tensordot(gravity_basis.T, at.rotation, axes=1), error[None, 3:]]
    return _whitened(gyro, whiten[:3]), _whitened(accel, whiten[3:])


def _by_control(by_increment: Float[Array, "n 3 3 S B"], increments: Increments) -> Float[Array, "k 3 3 S B"]:
    """From derivatives by the increments to those by the control rotations, each at both ends of an increment."""

    def by_both_ends(parts: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        by, left, right = parts
        return so3.product(by, left), so3.product(by, right)

    by_left, by_right = jax.lax.map(by_both_ends, (by_increment, increments.by_left, increments.by_right))
    control = jnp.zeros((len(by_increment) + 1, *by_increment.shape[1:]))
    return control.at[:-1].add(by_left).at[1:].add(by_right)


def _whitened(parts: list[Array], whiten: Float[Array, "3 S B"]) -> Float[Array, "m 3 S B"]:
    return jnp.concatenate([(part * whiten).reshape(-1, *whiten.shape) for part in parts])


def _sums(
    gyro: Float[Array, "n 3 S B"],
    accel: Float[Array, "m 3 S B"],
    ends: Float[Array, "2 S B"],
    whiten: Float[Array, "6 S B"],
) -> _Sums:
    """Over the samples of each interval, of rows times rows, rows times biases, biases times biases."""
    order = len(gyro) // 3
    gram = _spread(_spread(_gram(gyro), 1, order, len(accel)), 2, order, len(accel)) + _gram(accel)
    gyro_bias, accel_bias = (
        jax.lax.map(lambda end, rows=rows, own=own: jnp.sum(rows * (end * own), axis=2), ends)
        for rows, own in ((gyro, whiten[:3]), (accel, whiten[3:]))
    )  # (2, columns, 3, B) each
    by_bias = jnp.concatenate([_spread(gyro_bias, 1, order, len(accel)), accel_bias], axis=2)
    bias_bias = jax.lax.map(lambda end: jnp.sum((end * ends)[:, None] * whiten**2, axis=2), ends)
    return gram, by_bias.transpose(3, 0, 2, 1), bias_bias.transpose(3, 0, 1, 2)


def _spread(values: Array, axis: int, order: int, columns: int) -> Array:
    """From the gyroscope's columns along an axis (rotations, residual) to the accelerometer's; zero where it has
    none."""
    turns, residual = jnp.split(values, [3 * order], axis=axis)
    turns = turns.reshape(*turns.shape[:axis], order, 3, *turns.shape[axis + 1 :])
    padded = [(0, 0)] * turns.ndim
    padded[axis + 1] = (0, 3)
    turns = jnp.pad(turns, padded).reshape(*values.shape[:axis], 6 * order, *values.shape[axis + 1 :])
    padded = [(0, 0)] * values.ndim
    padded[axis] = (columns - 6 * order - 1, 0)
    return jnp.concatenate([turns, jnp.pad(residual, padded)], axis=axis)


def _gram(rows: Float[Array, "m a S B"]) -> Float[Array, "B m m"]:
    flat = rows.reshape(-1, rows.shape[-1]).T.reshape(rows.shape[-1], rows.shape[0], -1)
    return jnp.einsum("bmi,bni->bmn", flat, flat)
