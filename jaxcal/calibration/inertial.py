"""IMU samples, the biases' random walk, and the weak motion prior that keeps unobserved knots defined."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.calibration.state import RigState, tangent_basis
from jaxcal.imu import predict, predict_with_jacobian
from jaxcal.trajectory import basis_matrix, increments, rotation_at, weights

# Knot intervals are reduced in batches of this many.
INTERVAL_BATCH = 32
# Weak priors; orders of magnitude beyond what a hand moves or a MEMS part drifts, so that they only matter where
# nothing was measured: angular rate, acceleration, biases at switch-on (gyro, accel).
RATE_SIGMA = 50.0
ACCELERATION_SIGMA = 200.0
_BIAS_SIGMA = (0.3, 2.0)


class InertialData(eqx.Module):
    """IMU samples binned by knot interval, padded to S per interval.

    `fraction` (I, S) place in the interval; `readings` (I, S, 6) gyro then accel; `present` (I, S) 1 or 0;
    `inverse_sigma` (6,) of one sample; `walk_sigma` (6,) of the biases over one knot interval; `start`, `dt` of the
    spline, s; `rate_sigma` rad/s and `acceleration_sigma` m/s^2 of the weak motion prior.
    """

    fraction: Float[Array, "I S"]
    readings: Float[Array, "I S 6"]
    present: Float[Array, "I S"]
    inverse_sigma: Float[Array, "6"]
    walk_sigma: Float[Array, "6"]
    start: Float[Array, ""]
    dt: Float[Array, ""]
    rate_sigma: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(RATE_SIGMA))
    acceleration_sigma: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(ACCELERATION_SIGMA))


class IntervalEquations(eqx.Module):
    """Contributions of each knot interval: window of k chain blocks (12 coordinates each), and gravity's direction."""

    window: Float[Array, "I k 12 k 12"]
    cross: Float[Array, "I k 12 2"]
    shared: Float[Array, "2 2"]
    gradient_window: Float[Array, "I k 12"]
    gradient_shared: Float[Array, "2"]
    cost: Float[Array, ""]


def _windows(chain: Array, intervals: int, length: int) -> Array:
    """Stack of sliding windows (I, length, ...) over the chain."""
    return jnp.stack([chain[j : j + intervals] for j in range(length)], axis=1)


def linearise_imu(state: RigState, data: InertialData, order: int) -> IntervalEquations:
    """Equations of all IMU samples."""
    intervals = data.fraction.shape[0]
    chain = increments(state.rotations)
    gravity_basis = tangent_basis(state.gravity)
    matrix = basis_matrix(order)
    no_tail = jnp.zeros(order - 2)

    def sample(u: Array, reading: Array, present: Array, first: Array, window, control: Array, bias: Array) -> Array:
        point = rotation_at(first, window, u, data.dt, order)
        second = weights(matrix, u, data.dt, 2)
        bias_weights = jnp.concatenate([jnp.stack([1.0 - u, u]), no_tail])
        predicted, by_window, by_gravity = predict_with_jacobian(
            point, second @ control, second, state.gravity, gravity_basis, bias_weights @ bias, bias_weights
        )
        rows = jnp.concatenate([by_window.reshape(6, -1), by_gravity, (predicted - reading)[:, None]], axis=1)
        return rows * (present * data.inverse_sigma)[:, None]

    def interval(parts: tuple) -> Array:
        u, reading, present, first, window, control, bias = parts
        rows = jax.vmap(sample, in_axes=(0, 0, 0, None, None, None, None))(
            u, reading, present, first, window, control, bias
        )
        flat = rows.reshape(-1, rows.shape[-1])
        return flat.T @ flat

    parts = (
        data.fraction,
        data.readings,
        data.present,
        state.rotations[:intervals],
        jax.tree.map(lambda leaf: _windows(leaf, intervals, order - 1), chain),
        _windows(state.positions, intervals, order),
        _windows(state.biases, intervals, order),
    )
    batches = jax.tree.map(lambda leaf: leaf.reshape(-1, INTERVAL_BATCH, *leaf.shape[1:]), parts)
    gram = jax.lax.map(jax.vmap(interval), batches)
    gram = gram.reshape(intervals, *gram.shape[2:])
    n = 12 * order
    return IntervalEquations(
        window=gram[:, :n, :n].reshape(intervals, order, 12, order, 12),
        cross=gram[:, :n, n : n + 2].reshape(intervals, order, 12, 2),
        shared=gram[:, n : n + 2, n : n + 2].sum(axis=0),
        gradient_window=gram[:, :n, -1].reshape(intervals, order, 12),
        gradient_shared=gram[:, n : n + 2, -1].sum(axis=0),
        cost=0.5 * gram[:, -1, -1].sum(),
    )


def imu_residuals(state: RigState, data: InertialData, order: int) -> Float[Array, "I S 6"]:
    """Whitened residuals of all samples; zero where a sample is padding."""
    readings = predict_samples(state, data, order)
    return (readings - data.readings) * data.present[..., None] * data.inverse_sigma


def predict_samples(state: RigState, data: InertialData, order: int) -> Float[Array, "I S 6"]:
    """Readings that the trajectory and the biases predict at every sample, in physical units."""
    intervals = data.fraction.shape[0]
    chain = increments(state.rotations)
    matrix = basis_matrix(order)

    def sample(u: Array, first: Array, window, control: Array, bias: Array) -> Array:
        point = rotation_at(first, window, u, data.dt, order)
        acceleration = weights(matrix, u, data.dt, 2) @ control
        return predict(point.rotation, point.velocity, acceleration, state.gravity, (1.0 - u) * bias[0] + u * bias[1])

    per_interval = jax.vmap(sample, in_axes=(0, None, None, None, None))
    return jax.vmap(per_interval)(
        data.fraction,
        state.rotations[:intervals],
        jax.tree.map(lambda leaf: _windows(leaf, intervals, order - 1), chain),
        _windows(state.positions, intervals, order),
        _windows(state.biases, intervals, 2),
    )


class ChainPrior(eqx.Module):
    """Contributions of the random walk and the motion prior: diagonal and sub-diagonal blocks, and the gradient."""

    band: Float[Array, "K 3 12 12"]
    gradient: Float[Array, "K 12"]
    cost: Float[Array, ""]


def linearise_prior(state: RigState, data: InertialData) -> ChainPrior:
    """Bias random walk (Furgale et al. 2013, sec. III-C), switch-on biases, and the weak motion prior."""
    count = state.positions.shape[0]
    band = jnp.zeros((count, 3, 12, 12))
    gradient = jnp.zeros((count, 12))
    rotation_residual, position_residual, walk_residual, switch_on = _prior_residuals(state, data)

    chain = increments(state.rotations)
    scale = 1.0 / (data.rate_sigma * data.dt)
    left, right = chain.by_left * scale, chain.by_right * scale
    band = band.at[:-1, 0, :3, :3].add(jnp.einsum("kij,kil->kjl", left, left))
    band = band.at[1:, 0, :3, :3].add(jnp.einsum("kij,kil->kjl", right, right))
    band = band.at[:-1, 1, :3, :3].add(jnp.einsum("kij,kil->kjl", right, left))
    gradient = gradient.at[:-1, :3].add(jnp.einsum("kij,ki->kj", left, rotation_residual))
    gradient = gradient.at[1:, :3].add(jnp.einsum("kij,ki->kj", right, rotation_residual))

    stencil = jnp.array([1.0, -2.0, 1.0]) / (data.acceleration_sigma * data.dt**2)
    for a in range(3):
        gradient = gradient.at[a : count - 2 + a, 3:6].add(stencil[a] * position_residual)
        for d in range(3 - a):
            band = band.at[a : count - 2 + a, d, 3:6, 3:6].add(stencil[a] * stencil[a + d] * jnp.eye(3))

    information = jnp.diag(1.0 / data.walk_sigma**2)
    band = band.at[:-1, 0, 6:, 6:].add(information).at[1:, 0, 6:, 6:].add(information)
    band = band.at[:-1, 1, 6:, 6:].add(-information)
    step = walk_residual / data.walk_sigma
    gradient = gradient.at[1:, 6:].add(step).at[:-1, 6:].add(-step)
    sigma = _switch_on_sigma()
    band = band.at[0, 0, 6:, 6:].add(jnp.diag(1.0 / sigma**2))
    gradient = gradient.at[0, 6:].add(switch_on / sigma)

    parts = (rotation_residual, position_residual, walk_residual, switch_on)
    return ChainPrior(band, gradient, 0.5 * sum((jnp.sum(part**2) for part in parts), start=jnp.zeros(())))


def prior_residuals(state: RigState, data: InertialData) -> Float[Array, " R"]:
    """Whitened residuals of the random walk and the weak priors, as one vector."""
    return jnp.concatenate([jnp.ravel(part) for part in _prior_residuals(state, data)])


def _prior_residuals(state: RigState, data: InertialData) -> tuple[Array, Array, Array, Array]:
    rotation = increments(state.rotations).vector / (data.rate_sigma * data.dt)
    p = state.positions
    position = (p[:-2] - 2.0 * p[1:-1] + p[2:]) / (data.acceleration_sigma * data.dt**2)
    walk = (state.biases[1:] - state.biases[:-1]) / data.walk_sigma
    return rotation, position, walk, state.biases[0] / _switch_on_sigma()


def _switch_on_sigma() -> Float[Array, "6"]:
    return jnp.repeat(jnp.array(_BIAS_SIGMA), 3)
