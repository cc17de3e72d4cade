"""An IMU of Kalibr's model `calibrated` at the rig's origin: its samples, reduced interval by interval.

The most usual case, in closed form and laid out for speed: intervals run along the last axis, and derivatives are taken
by the rotation spline's increments; what these make of the control points is one matrix for an interval.
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
    inverse_sigma: Float[Array, "6"],
    gravity: Float[Array, "3"],
    gravity_basis: Float[Array, "3 g"],
    dt: Float[Array, ""],
) -> _Sums:
    """Sums over the samples of each interval: of rows times rows, rows times biases, biases times biases.

    `samples`: fraction, readings, present, as `ImuSamples`; rows are those of whitened readings, gyro then accel, by
    the window's k control points (6 coordinates each: rotation, position) and gravity, residual last; m = 6 k + g + 1.
    The biases at the interval's ends enter each reading by the weights 1 - u and u. Furgale et al. 2013, eq. 11 and 12.
    """
    order = control.shape[1]
    u, readings, present = (leaf.T for leaf in samples)  # (S, B), (6, S, B), (S, B)
    whiten = present * inverse_sigma[:, None, None]
    ends = jnp.stack([1.0 - u, u])
    window = (first, increments.vector, control, bias)
    gyro, accel = _rows(u, readings, whiten, window, gravity, gravity_basis, dt)
    gram, by_bias, bias_bias = _sums(gyro, accel, ends, whiten, order)

    by_control = _by_control(increments)
    turns, rest = jnp.split(gram, [3 * order], axis=1)
    gram = jnp.concatenate([by_control.swapaxes(1, 2) @ turns, rest], axis=1)
    turns, rest = jnp.split(gram, [3 * order], axis=2)
    gram = jnp.concatenate([turns @ by_control, rest], axis=2)
    turns, rest = jnp.split(by_bias, [3 * order], axis=3)
    by_bias = jnp.concatenate([jnp.einsum("beir,brc->beic", turns, by_control), rest], axis=3)
    return _interleaved(_interleaved(gram, 1, order), 2, order), _interleaved(by_bias, 3, order), bias_bias


def _by_control(increments: Increments) -> Float[Array, "B r r"]:
    """First control rotation and increments by the control rotations of the window."""
    batch, steps = increments.vector.shape[:2]
    matrix = jnp.zeros((batch, steps + 1, 3, steps + 1, 3)).at[:, 0, :, 0].set(jnp.eye(3))
    for j in range(steps):
        matrix = matrix.at[:, j + 1, :, j].set(increments.by_left[:, j])
        matrix = matrix.at[:, j + 1, :, j + 1].set(increments.by_right[:, j])
    return matrix.reshape(batch, 3 * (steps + 1), -1)


def _interleaved(values: Array, axis: int, order: int) -> Array:
    """From all rotations, then all positions, to rotation and position of one control point after the other."""
    window, rest = jnp.split(values, [6 * order], axis=axis)
    shape = window.shape
    window = window.reshape(*shape[:axis], 2, order, 3, *shape[axis + 1 :]).swapaxes(axis, axis + 1).reshape(shape)
    return jnp.concatenate([window, rest], axis=axis)


def _rows(
    u: Float[Array, "S B"],
    readings: Float[Array, "6 S B"],
    whiten: Float[Array, "6 S B"],
    window: tuple[Array, Array, Array, Array],
    gravity: Float[Array, "3"],
    gravity_basis: Float[Array, "3 g"],
    dt: Float[Array, ""],
) -> tuple[Float[Array, "n 3 S B"], Float[Array, "m 3 S B"]]:
    """Rows of gyroscope and accelerometer, columns first.

    Columns are the first control rotation, the increments, the positions, gravity, and the residual; the gyroscope's
    are those of the increments, on which alone its readings depend, and the residual.
    """
    first, increments, control, bias = (jnp.moveaxis(leaf, 0, -1)[..., None, :] for leaf in window)
    order = control.shape[0]
    at = rotations_at(first, increments, u, dt, order)
    second = weights(basis_matrix(order), u, dt, 2)
    acceleration = jnp.sum(second[:, None] * control, axis=0) - gravity[:, None, None]
    force = so3.product(at.rotation.swapaxes(0, 1), acceleration)
    error = jnp.concatenate([at.velocity, force]) + (1.0 - u) * bias[0] + u * bias[1] - readings
    cross = so3.hat(force)
    gyro = [at.velocity_by.swapaxes(1, 2), error[None, :3]]
    accel = [
        so3.product(cross, at.from_first.swapaxes(0, 1)).swapaxes(0, 1),
        jax.lax.map(lambda by: so3.product(cross, by).swapaxes(0, 1), at.rotation_by),
        second[:, None, None] * at.rotation,
        -jnp.tensordot(gravity_basis.T, at.rotation, axes=1),
        error[None, 3:],
    ]
    return _whitened(gyro, whiten[:3]), _whitened(accel, whiten[3:])


def _whitened(parts: list[Array], whiten: Float[Array, "3 S B"]) -> Float[Array, "m 3 S B"]:
    return jnp.concatenate([(part * whiten).reshape(-1, *whiten.shape) for part in parts])


def _sums(
    gyro: Float[Array, "n 3 S B"],
    accel: Float[Array, "m 3 S B"],
    ends: Float[Array, "2 S B"],
    whiten: Float[Array, "6 S B"],
    order: int,
) -> _Sums:
    """Over the samples of each interval, of rows times rows, rows times biases, biases times biases."""
    turns = slice(3, 3 * order)  # the increments, among the columns of the accelerometer
    own = _gram(gyro)
    gram = _gram(accel).at[:, turns, turns].add(own[:, :-1, :-1])
    gram = gram.at[:, turns, -1].add(own[:, :-1, -1]).at[:, -1, turns].add(own[:, -1, :-1])
    gram = gram.at[:, -1, -1].add(own[:, -1, -1])

    gyro_bias, accel_bias = (
        jax.lax.map(lambda end, rows=rows, own=own: jnp.sum(rows * (end * own), axis=2), ends)
        for rows, own in ((gyro, whiten[:3]), (accel, whiten[3:]))
    )  # (2, columns, 3, B) each
    by_bias = jnp.zeros_like(accel_bias).at[:, turns].set(gyro_bias[:, :-1]).at[:, -1].set(gyro_bias[:, -1])
    by_bias = jnp.concatenate([by_bias, accel_bias], axis=2)
    bias_bias = jax.lax.map(lambda end: jnp.sum((end * ends)[:, None] * whiten**2, axis=2), ends)
    return gram, by_bias.transpose(3, 0, 2, 1), bias_bias.transpose(3, 0, 1, 2)


def _gram(rows: Float[Array, "m a S B"]) -> Float[Array, "B m m"]:
    flat = rows.reshape(-1, rows.shape[-1]).T.reshape(rows.shape[-1], rows.shape[0], -1)
    return jnp.einsum("bmi,bni->bmn", flat, flat)
