"""Uniform cumulative B-splines on SO(3) x R^3, with velocity, acceleration and closed-form Jacobians."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.trajectory import so3


@functools.cache
def basis_matrix(order: int) -> np.ndarray:
    """M (order, order): basis functions of a uniform B-spline on one interval, B_j(u) = sum_n M[j, n] u^n, u in [0, 1).

    Qin 2000, "General matrix representations for B-splines", eq. 8.
    """
    k = order
    matrix = np.zeros((k, k))
    for s in range(k):  # basis function of control point s
        for n in range(k):  # power of u
            total = sum((-1) ** (l - s) * math.comb(k, l - s) * float(k - 1 - l) ** (k - 1 - n) for l in range(s, k))
            matrix[s, n] = math.comb(k - 1, n) * total / math.factorial(k - 1)
    return matrix


@functools.cache
def cumulative_basis_matrix(order: int) -> np.ndarray:
    """Cumulative basis: row j is the sum of rows j .. order - 1 of `basis_matrix`, so that row 0 is the constant 1."""
    return np.cumsum(basis_matrix(order)[::-1], axis=0)[::-1].copy()


def weights(
    matrix: np.ndarray, u: Float[Array, "*T"], dt: float | Float[Array, ""], derivative: int
) -> Float[Array, "k *T"]:
    """Derivative in time of the (cumulative) basis functions at `u` in an interval of `dt` seconds."""
    k = matrix.shape[0]
    factors = [float(math.perm(n, derivative)) for n in range(k)]
    powers = jnp.stack([u ** max(n - derivative, 0) * factors[n] for n in range(k)])
    return jnp.tensordot(jnp.asarray(matrix), powers, axes=1) / dt**derivative


class RotationPoint(eqx.Module):
    """The rotation spline at one time, with derivatives by the window's control points.

    `rotation` R (3, 3); `velocity` body-frame angular velocity (3,), rad/s; `rotation_jacobian` (3, k, 3): right
    perturbation of R by right perturbations of the k control rotations; `velocity_jacobian` (3, k, 3) likewise.
    """

    rotation: Float[Array, "3 3"]
    velocity: Float[Array, "3"]
    rotation_jacobian: Float[Array, "3 k 3"]
    velocity_jacobian: Float[Array, "3 k 3"]


class Increments(eqx.Module):
    """d_j = Log(R_j^T R_j+1) of neighbouring control rotations, and its Jacobians by their right perturbations."""

    vector: Float[Array, "K1 3"]
    by_left: Float[Array, "K1 3 3"]
    by_right: Float[Array, "K1 3 3"]


def increments(rotations: Float[Array, "K 3 3"]) -> Increments:
    """Increments between consecutive control rotations; one pass over the chain, shared by all measurements."""

    def one(left: Array, right: Array) -> tuple[Array, Array, Array]:
        relative = left.T @ right
        vector = so3.log(relative)
        by_right = so3.right_jacobian_inverse(vector)
        return vector, -by_right @ relative.T, by_right

    return Increments(*jax.vmap(one)(rotations[:-1], rotations[1:]))


def rotation_at(
    first: Float[Array, "3 3"], window: Increments, u: Float[Array, ""], dt: float | Float[Array, ""], order: int
) -> RotationPoint:
    """Rotation spline at fraction `u` of an interval with first control rotation `first` and k - 1 increments.

    R = R_0 prod_j Exp(lambda_j(u) d_j); velocity by the recursion of Sommer et al. 2020 ("Efficient derivative
    computation for cumulative B-splines on Lie groups", eq. 30), Jacobians by the chain rule over the same recursion.
    """
    matrix = cumulative_basis_matrix(order)
    value, rate = weights(matrix, u, dt, 0)[1:], weights(matrix, u, dt, 1)[1:]
    scaled = value[:, None] * window.vector
    turn, stretch = jax.vmap(so3.exp_with_right_jacobian)(scaled)
    stretch = stretch * value[:, None, None]

    # after[j]: the turns that follow increment j, as one rotation; carried[j]: the velocity so far, after turn j.
    after = [jnp.eye(3)]
    for j in range(order - 2, -1, -1):
        after.insert(0, turn[j] @ after[0])
    velocity, carried = jnp.zeros(3), []
    for j in range(order - 1):
        carried.append(turn[j].T @ velocity)
        velocity = carried[-1] + rate[j] * window.vector[j]
    rotation = first @ after[0]

    # By each increment, right after it; then carried through the turns that follow.
    following = jnp.stack(after[1:]).swapaxes(-1, -2)
    by_velocity = jax.vmap(so3.hat)(jnp.stack(carried)) @ stretch + rate[:, None, None] * jnp.eye(3)
    by_increment = jnp.concatenate([following @ stretch, following @ by_velocity], axis=1)  # (k - 1, 6, 3)
    jacobian = jnp.pad(by_increment @ window.by_left, [(0, 1), (0, 0), (0, 0)])
    jacobian = jacobian + jnp.pad(by_increment @ window.by_right, [(1, 0), (0, 0), (0, 0)])
    jacobian = jacobian.at[0, :3].add(after[0].T).swapaxes(0, 1)
    return RotationPoint(rotation, velocity, jacobian[:3], jacobian[3:])


class PoseSpline(eqx.Module):
    """A trajectory T_target_imu(t) as a uniform cumulative B-spline.

    `rotations` (K, 3, 3) and `positions` (K, 3) are control points; interval i spans `start` + [i, i + 1) * `dt`
    seconds and depends on control points i .. i + order - 1, so that there are K - order + 1 intervals.
    """

    rotations: Float[Array, "K 3 3"]
    positions: Float[Array, "K 3"]
    start: Float[Array, ""]
    dt: Float[Array, ""]
    order: int = eqx.field(static=True)

    @property
    def num_intervals(self) -> int:
        """Knot intervals in which the spline is defined."""
        return self.rotations.shape[0] - self.order + 1

    def locate(self, t: Float[Array, "*n"]) -> tuple[Array, Array]:
        """Interval index and fraction of times `t` (s), clipped to the spline's ends."""
        position = (t - self.start) / self.dt
        index = jnp.clip(jnp.floor(position), 0, self.num_intervals - 1).astype(int)
        return index, jnp.clip(position - index, 0.0, 1.0)

    def evaluate(self, t: Float[Array, " n"]) -> tuple[Array, ...]:
        """R (n, 3, 3), p, body angular velocity, velocity and acceleration, each (n, 3), at times (n,)."""
        index, u = self.locate(t)
        chain = increments(self.rotations)
        matrix = basis_matrix(self.order)

        def one(i: Array, fraction: Array) -> tuple[Array, ...]:
            window = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, i, self.order - 1), chain)
            point = rotation_at(self.rotations[i], window, fraction, self.dt, self.order)
            control = jax.lax.dynamic_slice_in_dim(self.positions, i, self.order)
            p, v, a = (weights(matrix, fraction, self.dt, n) @ control for n in range(3))
            return point.rotation, p, point.velocity, v, a

        return jax.vmap(one)(index, u)
