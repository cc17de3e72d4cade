"""IMU samples, the biases' random walk, and the weak motion prior that keeps unobserved knots defined."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.calibration.inertial_calibrated import reduce_batch
from jaxcal.calibration.state import RigState, SharedLayout
from jaxcal.estimation import on_device
from jaxcal.imu import imu_model, respond
from jaxcal.trajectory import Increments, basis_matrix, increments, rotation_at, so3, weights

# Knot intervals are reduced in batches of this many.
INTERVAL_BATCH = 32
# Weak priors; orders of magnitude beyond what a hand moves or a MEMS part drifts, so that they only matter where
# nothing was measured: angular rate, acceleration, biases at switch-on (gyro, accel).
RATE_SIGMA = 50.0
ACCELERATION_SIGMA = 200.0
_BIAS_SIGMA = (0.3, 2.0)


class ImuSamples(eqx.Module):
    """Samples of one IMU binned by knot interval, padded to S per interval.

    `fraction` (I, S) place in the interval when the IMU's clock is `shift` s behind the rig's; `readings` (I, S, 6)
    gyro then accel; `present` (I, S) 1 or 0; `inverse_sigma` (6,) of one sample; `walk_sigma` (6,) of the biases over
    one knot interval.
    """

    fraction: Float[Array, "I S"]
    readings: Float[Array, "I S 6"]
    present: Float[Array, "I S"]
    inverse_sigma: Float[Array, "6"]
    walk_sigma: Float[Array, "6"]
    shift: Float[Array, ""]


class InertialData(eqx.Module):
    """The time grid of the trajectory (`start`, `dt`, s), the samples of every IMU, and the weak motion prior:
    `rate_sigma` rad/s and `acceleration_sigma` m/s^2."""

    samples: tuple[ImuSamples, ...]
    start: Float[Array, ""]
    dt: Float[Array, ""]
    rate_sigma: Float[Array, ""] = eqx.field(default_factory=lambda: on_device(RATE_SIGMA))
    acceleration_sigma: Float[Array, ""] = eqx.field(default_factory=lambda: on_device(ACCELERATION_SIGMA))

    @property
    def walk_sigma(self) -> Float[Array, " b"]:
        """Of the biases of all IMUs over one knot interval."""
        return jnp.concatenate([jnp.zeros(0), *(s.walk_sigma for s in self.samples)])


class IntervalEquations(eqx.Module):
    """What one IMU says in each knot interval: of a window of k poses (6 coordinates each), of its biases at the two
    ends of the interval's block of k - 1, and of s shared coordinates: the IMU's own (parameters, place, time shift),
    and gravity.

    `bias_pose` and `bias_cross` are the biases' products with poses and shared coordinates; those of the biases with
    each other are diagonal.
    """

    window: Float[Array, "I k 6 k 6"]
    cross: Float[Array, "I k 6 s"]
    gradient: Float[Array, "I k 6"]
    bias_pose: Float[Array, "I 2 6 k 6"]
    bias_cross: Float[Array, "I 2 6 s"]
    bias_bias: Float[Array, "I 2 2 6"]
    gradient_bias: Float[Array, "I 2 6"]
    shared: Float[Array, "s s"]
    gradient_shared: Float[Array, " s"]
    cost: Float[Array, ""]


def _windows(chain: Array, intervals: int, length: int) -> Array:
    """Stack of sliding windows (I, length, ...) over the chain."""
    return jnp.stack([chain[j : j + intervals] for j in range(length)], axis=1)


class _Window(eqx.Module):
    """The chain around one knot interval; the biases at both ends of its block of `per` intervals, of which it is
    number `place`."""

    first: Float[Array, "*I 3 3"]
    increments: Increments
    control: Float[Array, "*I k 3"]
    bias: Float[Array, "*I 2 6"]
    place: Float[Array, "*I"]
    per: int = eqx.field(static=True)

    def bias_weights(self, u: Array) -> Float[Array, "2 *S"]:
        """How much each of the two biases counts at places u in the interval."""
        share = (self.place + u) / self.per
        return jnp.stack([1.0 - share, share])


def _chain_windows(state: RigState, intervals: int, order: int, imu: int) -> _Window:
    chain = increments(state.rotations)
    biases = state.biases[:, 6 * imu : 6 * imu + 6]
    block, place = np.divmod(np.arange(intervals), order - 1)
    return _Window(
        state.rotations[:intervals],
        jax.tree.map(lambda leaf: _windows(leaf, intervals, order - 1), chain),
        _windows(state.positions, intervals, order),
        jnp.stack([biases[block], biases[block + 1]], axis=1),
        jnp.asarray(place, dtype=float),
        order - 1,
    )


class _Motion(eqx.Module):
    """Angular velocity and acceleration, and specific force at the rig's origin, stacked (9,), in the rig's frame; and
    their derivative (9, k, 6) by the window's rotations (right perturbation) and positions."""

    value: Float[Array, "9"]
    by_window: Float[Array, "9 k 6"]
    rotation: Float[Array, "3 3"]


def _motion(window: _Window, u: Array, dt: Array, gravity: Array, order: int) -> _Motion:
    def turning(u: Array) -> tuple[Array, Array]:
        point = rotation_at(window.first, window.increments, u, dt, order)
        return point.velocity, point.velocity_jacobian

    point = rotation_at(window.first, window.increments, u, dt, order)
    # Perturbations of control points do not depend on time, so that time derivatives and they change places.
    (omega, by_omega), (alpha, by_alpha) = jax.jvp(turning, (u,), (1.0 / dt,))
    second = weights(basis_matrix(order), u, dt, 2)
    back = point.rotation.T
    force = back @ (second @ window.control - gravity)
    by_rotation = jnp.concatenate(
        [by_omega, by_alpha, jnp.einsum("ij,jkl->ikl", so3.hat(force), point.rotation_jacobian)]
    )
    by_position = jnp.concatenate([jnp.zeros((6, order, 3)), back[:, None, :] * second[None, :, None]])
    value = jnp.concatenate([omega, alpha, force])
    return _Motion(value, jnp.concatenate([by_rotation, by_position], axis=2), point.rotation)


def _responses(state: RigState, layout: SharedLayout, imu: int, value: Array, step: Array) -> Float[Array, "6"]:
    """Readings without biases, the IMU's own shared coordinates moved by `step` (parameters, then its place)."""
    model = imu_model(layout.imus[imu].model)
    R, t = state.R_imu_rig[imu], state.t_imu_rig[imu]
    if layout.imus[imu].placed:
        turn, shift = step[model.size : model.size + 3], step[model.size + 3 : model.size + 6]
        R, t = so3.exp(turn) @ R, t + shift
    parameters = state.imu_parameters[imu] + step[: model.size]
    return respond(model, parameters, R, t, value[:3], value[3:6], value[6:])


def _sample_rows(
    state: RigState, layout: SharedLayout, imu: int, data: ImuSamples, dt: Array, order: int
) -> Callable[[Array, Array, _Window], tuple[Array, Array]]:
    """A function from one sample (fraction, reading, window) to its Jacobian rows (6, 6 k + s + 1), residual last, and
    the weights (2,) of the window's biases in all six."""
    own = layout.imus[imu]
    basis = layout.gravity_basis(state.gravity)

    def of_sample(u: Array, reading: Array, window: _Window) -> tuple[Array, Array]:
        u = u + (state.imu_shift[imu] - data.shift) / dt
        motion = _motion(window, u, dt, state.gravity, order)
        ends = window.bias_weights(u)

        def response(value: Array, step: Array) -> Array:
            return _responses(state, layout, imu, value, step)

        zero = jnp.zeros(own.size - own.placed)
        by_value, by_step = jax.jacrev(response, argnums=(0, 1))(motion.value, zero)
        by_window = jnp.einsum("ij,jkl->ikl", by_value, motion.by_window).reshape(6, -1)
        by_gravity = -by_value[:, 6:] @ motion.rotation.T @ basis
        columns = [by_window, by_step]
        if own.placed:

            def value_at(u: Array) -> Array:
                return _motion(window, u, dt, state.gravity, order).value

            _, rate = jax.jvp(value_at, (u,), (1.0 / dt,))
            columns.append((by_value @ rate + (window.bias[1] - window.bias[0]) / (window.per * dt))[:, None])
        predicted = response(motion.value, zero) + ends @ window.bias
        return jnp.concatenate([*columns, by_gravity, (predicted - reading)[:, None]], axis=1), ends

    return of_sample


def _reduce_any(
    state: RigState, layout: SharedLayout, imu: int, data: ImuSamples, dt: Array, order: int, parts: tuple
) -> tuple[Array, Array, Array]:
    """Sums over the samples of each of some intervals: rows times rows, times biases, biases times biases."""
    rows_of = _sample_rows(state, layout, imu, data, dt, order)

    def interval(u: Array, reading: Array, present: Array, window: _Window) -> tuple[Array, Array, Array]:
        rows, ends = jax.vmap(rows_of, in_axes=(0, 0, None))(u, reading, window)
        whiten = present[:, None] * data.inverse_sigma  # (S, 6)
        rows, by_bias = rows * whiten[..., None], ends[:, :, None] * whiten[:, None, :]  # (S, 6, n + s + 1), (S, 2, 6)
        flat = rows.reshape(-1, rows.shape[-1])
        with_bias = jnp.einsum("sei,six->eix", by_bias, rows)
        return flat.T @ flat, with_bias, jnp.einsum("sei,sfi->efi", by_bias, by_bias)

    return jax.vmap(interval)(*parts)


def _reduce_calibrated(
    state: RigState, layout: SharedLayout, imu: int, data: ImuSamples, dt: Array, order: int, parts: tuple
) -> tuple[Array, Array, Array]:
    """As `_reduce_any`, of an IMU that has no shared coordinates of its own."""
    *samples, window = parts
    chain = (window.first, window.increments, window.control)
    biases = (window.bias, window.bias_weights(samples[0].T))
    basis = layout.gravity_basis(state.gravity)
    return reduce_batch(tuple(samples), *chain, *biases, data.inverse_sigma, state.gravity, basis, dt)


def linearise_imu(state: RigState, data: InertialData, order: int, layout: SharedLayout, imu: int) -> IntervalEquations:
    """Equations of all samples of one IMU."""
    samples = data.samples[imu]
    intervals = samples.fraction.shape[0]
    parts = (samples.fraction, samples.readings, samples.present, _chain_windows(state, intervals, order, imu))
    batches = jax.tree.map(lambda leaf: leaf.reshape(-1, INTERVAL_BATCH, *leaf.shape[1:]), parts)
    reduce = _reduce_any if layout.imus[imu].size else _reduce_calibrated

    # Taken apart where a batch is still at hand: all of these matrices would have to be moved once more.
    def of_batch(parts: tuple) -> IntervalEquations:
        return _taken_apart(*reduce(state, layout, imu, samples, data.dt, order, parts), order)

    by_batch = jax.lax.map(of_batch, batches)
    joined = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), by_batch)
    whole = tuple(leaf.sum(axis=0) for leaf in (by_batch.shared, by_batch.gradient_shared, by_batch.cost))
    return eqx.tree_at(lambda e: (e.shared, e.gradient_shared, e.cost), joined, whole)


def _taken_apart(gram: Array, with_bias: Array, bias_bias: Array, order: int) -> IntervalEquations:
    """The sums of some intervals (B, ...) by what they are about."""
    n, batch = 6 * order, len(gram)
    shared = gram[:, n:, n:].sum(axis=0)
    return IntervalEquations(
        window=gram[:, :n, :n].reshape(batch, order, 6, order, 6),
        cross=gram[:, :n, n:-1].reshape(batch, order, 6, -1),
        gradient=gram[:, :n, -1].reshape(batch, order, 6),
        bias_pose=with_bias[..., :n].reshape(batch, 2, 6, order, 6),
        bias_cross=with_bias[..., n:-1],
        bias_bias=bias_bias,
        gradient_bias=with_bias[..., -1],
        shared=shared[:-1, :-1],
        gradient_shared=shared[:-1, -1],
        cost=0.5 * shared[-1, -1],
    )


def imu_residuals(
    state: RigState, data: InertialData, order: int, layout: SharedLayout, imu: int
) -> Float[Array, "I S 6"]:
    """Whitened residuals of all samples of one IMU; zero where a sample is padding."""
    samples = data.samples[imu]
    readings = predict_samples(state, data, order, layout, imu)
    return (readings - samples.readings) * samples.present[..., None] * samples.inverse_sigma


def predict_samples(
    state: RigState, data: InertialData, order: int, layout: SharedLayout, imu: int
) -> Float[Array, "I S 6"]:
    """Readings that the trajectory and the biases predict at every sample of one IMU, in physical units."""
    samples = data.samples[imu]
    intervals = samples.fraction.shape[0]
    zero = jnp.zeros(layout.imus[imu].size)

    def sample(u: Array, window: _Window) -> Array:
        u = u + (state.imu_shift[imu] - samples.shift) / data.dt
        motion = _motion(window, u, data.dt, state.gravity, order)
        bias = window.bias_weights(u) @ window.bias
        return _responses(state, layout, imu, motion.value, zero) + bias

    windows = _chain_windows(state, intervals, order, imu)
    return jax.vmap(jax.vmap(sample, in_axes=(0, None)))(samples.fraction, windows)


class ChainPrior(eqx.Module):
    """Contributions of the weak motion prior to the poses (diagonal and sub-diagonal blocks, gradient), and of the
    random walk to the biases (`walk`: the diagonals of the blocks on the diagonal, and of those below it)."""

    band: Float[Array, "K 3 6 6"]
    gradient: Float[Array, "K 6"]
    walk: Float[Array, "M 2 b"]
    gradient_biases: Float[Array, "M b"]
    cost: Float[Array, ""]


def linearise_prior(state: RigState, data: InertialData, order: int) -> ChainPrior:
    """Bias random walk (Furgale et al. 2013, sec. III-C), switch-on biases, and the weak motion prior."""
    count = state.positions.shape[0]
    band = jnp.zeros((count, 3, 6, 6))
    gradient = jnp.zeros((count, 6))
    rotation_residual, position_residual, walk_residual, switch_on = _prior_residuals(state, data, order)

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

    sigma = _walk_sigma(data, order)
    information = 1.0 / sigma**2
    walk = jnp.zeros((len(state.biases), 2, len(sigma)))
    walk = walk.at[:-1, 0].add(information).at[1:, 0].add(information).at[:-1, 1].add(-information)
    step = walk_residual / sigma
    by_biases = jnp.zeros_like(state.biases).at[1:].add(step).at[:-1].add(-step)
    sigma = _switch_on_sigma(state)
    walk = walk.at[0, 0].add(1.0 / sigma**2)
    by_biases = by_biases.at[0].add(switch_on / sigma)

    parts = (rotation_residual, position_residual, walk_residual, switch_on)
    return ChainPrior(
        band, gradient, walk, by_biases, 0.5 * sum((jnp.sum(part**2) for part in parts), start=jnp.zeros(()))
    )


def prior_residuals(state: RigState, data: InertialData, order: int) -> Float[Array, " R"]:
    """Whitened residuals of the random walk and the weak priors, as one vector."""
    return jnp.concatenate([jnp.ravel(part) for part in _prior_residuals(state, data, order)])


def _prior_residuals(state: RigState, data: InertialData, order: int) -> tuple[Array, Array, Array, Array]:
    rotation = increments(state.rotations).vector / (data.rate_sigma * data.dt)
    p = state.positions
    position = (p[:-2] - 2.0 * p[1:-1] + p[2:]) / (data.acceleration_sigma * data.dt**2)
    walk = (state.biases[1:] - state.biases[:-1]) / _walk_sigma(data, order)
    return rotation, position, walk, state.biases[0] / _switch_on_sigma(state)


def _walk_sigma(data: InertialData, order: int) -> Float[Array, " b"]:
    """Of the biases from one of their places to the next: as many knot intervals on as a chain block holds."""
    return np.sqrt(order - 1) * data.walk_sigma


def _switch_on_sigma(state: RigState) -> Float[Array, " b"]:
    return jnp.asarray(np.tile(np.repeat(_BIAS_SIGMA, 3), state.biases.shape[1] // 6))


class ModelPrior(eqx.Module):
    """What is usual of an IMU's parameters and place: information (s, s), gradient and cost."""

    information: Float[Array, "s s"]
    gradient: Float[Array, " s"]
    cost: Float[Array, ""]


def linearise_model_prior(state: RigState, layout: SharedLayout, imu: int) -> ModelPrior:
    """Parameters are likely near their nominal values; of its place nothing is known."""
    own = layout.imus[imu]
    inverse = jnp.concatenate([_inverse_spread(layout, imu), jnp.zeros(own.size - own.parameters)])
    residual = model_prior_residuals(state, layout, imu)
    gradient = jnp.concatenate([residual * inverse[: own.parameters], jnp.zeros(own.size - own.parameters)])
    return ModelPrior(jnp.diag(inverse**2), gradient, 0.5 * jnp.sum(residual**2))


def model_prior_residuals(state: RigState, layout: SharedLayout, imu: int) -> Float[Array, " m"]:
    """Parameters of one IMU less their nominal values, in units of the usual spread."""
    nominal = jnp.asarray(imu_model(layout.imus[imu].model).nominal, dtype=float)
    return (state.imu_parameters[imu] - nominal) * _inverse_spread(layout, imu)


def _inverse_spread(layout: SharedLayout, imu: int) -> Float[Array, " m"]:
    return 1.0 / jnp.asarray(imu_model(layout.imus[imu].model).spread, dtype=float)
