"""Corners of the target: reprojection residuals, reduced frame by frame before the chain sees them."""

import functools
from collections.abc import Callable
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.calibration.pixel_derivatives import pixel_derivatives
from jaxcal.calibration.state import RigState
from jaxcal.cameras import CameraModel
from jaxcal.trajectory import PoseSpline, basis_matrix, increments, rotation_at, so3, weights

# Frames are reduced in batches of this many: large enough to vectorise, small enough to stay in the cache.
FRAME_BATCH = 8
# A point that every lens sees, off the axis, where a careless model may have no derivative (m).
_HARMLESS = (0.1, 0.1, 1.0)


class VisionData(eqx.Module):
    """Detections of a group of cameras of equal model, padded to all points of the target.

    `camera` (F,) place in the group; `rig_camera` (F,) index in the rig; `view` (F,) index into the chain of poses
    (discrete problems); `time` (F,) s on the camera's clock (continuous ones); `pixels` (F, 2, N); `weight` (F, N) 1 /
    sigma^2 in px^-2, 0 where the corner is absent. Every FRAME_BATCH frames on end are of one camera.
    """

    camera: Int[Array, " F"]
    rig_camera: Int[Array, " F"]
    view: Int[Array, " F"]
    time: Float[Array, " F"]
    pixels: Float[Array, "F 2 N"]
    weight: Float[Array, "F N"]


class FramePoses(eqx.Module):
    """T_target_rig at each frame with Jacobians by a window of k chain blocks that starts at `start`.

    `by_rotation` (F, 3, k, 3) right perturbation of R; `basis` (F, k) weights of the positions; `omega`, `velocity`
    (F, 3) derivatives by time (body frame; target frame).
    """

    start: Int[Array, "*F"]
    rotation: Float[Array, "*F 3 3"]
    position: Float[Array, "*F 3"]
    by_rotation: Float[Array, "*F 3 k 3"]
    basis: Float[Array, "*F k"]
    omega: Float[Array, "*F 3"]
    velocity: Float[Array, "*F 3"]


class PoseSource(Protocol):
    """Where the pose of a frame comes from."""

    def poses(self, state: RigState, data: VisionData) -> FramePoses:
        """The poses of the frames of `data`, and what they are made of."""
        ...


def view_poses(state: RigState, data: VisionData) -> FramePoses:
    """Discrete poses: a frame's pose is the chain block that it names."""
    frames = data.view.shape[0]
    zero = jnp.zeros((frames, 3))
    return FramePoses(
        start=data.view,
        rotation=state.rotations[data.view],
        position=state.positions[data.view],
        by_rotation=jnp.tile(jnp.eye(3)[None, :, None, :], (frames, 1, 1, 1)),
        basis=jnp.ones((frames, 1)),
        omega=zero,
        velocity=zero,
    )


def spline_poses(state: RigState, data: VisionData, start: Array, dt: Array, order: int) -> FramePoses:
    """Continuous time: the spline at the frame's time plus the camera's shift, looked up anew at every iteration."""
    spline = PoseSpline(state.rotations, state.positions, start, dt, order)
    chain = increments(state.rotations)
    matrix = basis_matrix(order)
    index, fraction = spline.locate(data.time + state.shift[data.rig_camera])

    def one(i: Array, u: Array) -> FramePoses:
        window = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, i, order - 1), chain)
        point = rotation_at(state.rotations[i], window, u, dt, order)
        control = jax.lax.dynamic_slice_in_dim(state.positions, i, order)
        basis = weights(matrix, u, dt, 0)
        velocity = weights(matrix, u, dt, 1) @ control
        return FramePoses(i, point.rotation, basis @ control, point.rotation_jacobian, basis, point.velocity, velocity)

    return jax.vmap(one)(index, fraction)


class FrameEquations(eqx.Module):
    """Gauss-Newton contributions of frames, or parts of frames, to a window of k chain blocks (6 coordinates each) from
    `start` on and to q shared coordinates (extrinsics, time shift, lens, line delay of a rolling shutter, target); and
    what those of each camera of the group add up to."""

    start: Int[Array, " F"]
    camera: Int[Array, " F"]
    window: Float[Array, "F k 6 k 6"]
    cross: Float[Array, "F k 6 q"]
    gradient_window: Float[Array, "F k 6"]
    shared: Float[Array, "C q q"]
    gradient_shared: Float[Array, "C q"]
    cost: Float[Array, ""]


def project_frame(
    template: CameraModel,
    lens: Float[Array, " n"],
    R_cam_target: Float[Array, "3 3"],
    t_cam_target: Float[Array, "3"],
    points: Float[Array, "3 N"],
) -> Float[Array, "2 N"]:
    """Pixels of target points in one frame."""
    model = template.with_parameters(lens)
    return jax.vmap(model.project, in_axes=1, out_axes=1)(R_cam_target @ points + t_cam_target[:, None])


def frame_residuals(
    template: CameraModel, state: RigState, data: VisionData, poses: FramePoses, group: int, points: Float[Array, "3 N"]
) -> Float[Array, "F N 2"]:
    """Projection minus measurement, px."""
    rotation, translation = _camera_poses(state, data, poses)
    project = jax.vmap(project_frame, in_axes=(None, 0, 0, 0, None))
    projected = project(template, state.lenses[group][data.camera], rotation, translation, points)
    return (projected - data.pixels).swapaxes(1, 2)


def _camera_poses(state: RigState, data: VisionData, poses: FramePoses) -> tuple[Array, Array]:
    """T_cam_target of each frame: rotations (F, 3, 3) and translations (F, 3)."""
    rotation = state.R_cam_rig[data.rig_camera] @ poses.rotation.swapaxes(-1, -2)
    translation = state.t_cam_rig[data.rig_camera] - jnp.einsum("fij,fj->fi", rotation, poses.position)
    return rotation, translation


def frame_transforms(state: RigState, data: VisionData, poses: FramePoses) -> Float[Array, "F 4 4"]:
    """T_cam_target of each frame."""
    rotation, translation = _camera_poses(state, data, poses)
    upper = jnp.concatenate([rotation, translation[..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), (len(upper), 1, 4))
    return jnp.concatenate([upper, last], axis=1)


def linearise_frames(
    template: CameraModel,
    state: RigState,
    data: VisionData,
    poses: FramePoses,
    group: int,
    points: Float[Array, "3 N"],
    by_target: Float[Array, "T 3 N"],
    loss: Callable[[Array], tuple[Array, Array]],
    basis: Float[Array, "C n n"] | None = None,
) -> FrameEquations:
    """Equations of all frames of one group, batch by batch; all frames of a batch are of one camera.

    `points` are the target's, `by_target` their derivative by the target's T unknowns; `loss` gives (rho, weight) of
    squared whitened residuals; `basis`, the directions of each lens along which its derivatives are taken.
    """
    rotation, translation = _camera_poses(state, data, poses)
    cameras, q = state.lenses[group].shape[0], state.lenses[group].shape[1] + 7 + by_target.shape[0]
    frames = (poses, rotation, translation, data.pixels, data.weight)
    batches = jax.tree.map(lambda leaf: leaf.reshape(-1, FRAME_BATCH, *leaf.shape[1:]), frames)
    camera = data.camera[::FRAME_BATCH]
    R_cam_rig = state.R_cam_rig[data.rig_camera[::FRAME_BATCH]]

    def batch(total: tuple[Array, Array, Array], parts: tuple) -> tuple[tuple[Array, Array, Array], tuple]:
        camera, R_cam_rig, (poses, rotation, translation, pixels, weight) = parts
        along = None if basis is None else basis[camera]
        reduce = functools.partial(
            _reduce_corners, template, state.lenses[group][camera], along, points, by_target, loss
        )
        gram, cost = jax.vmap(reduce)(rotation, translation, pixels, weight)
        chain, turned = jax.vmap(_lift, in_axes=(0, 0, 0, None))(gram, poses, rotation, R_cam_rig)
        shared, gradient = _shared_equations(gram.sum(axis=0), turned.sum(axis=0), state.lenses[group].shape[1])
        total = (total[0].at[camera].add(shared), total[1].at[camera].add(gradient), total[2] + jnp.sum(cost))
        return total, chain

    start = (jnp.zeros((cameras, q, q)), jnp.zeros((cameras, q)), jnp.zeros(()))
    (shared, gradient_shared, cost), chain = jax.lax.scan(batch, start, (camera, R_cam_rig, batches))
    window, cross, gradient_window = (leaf.reshape(-1, *leaf.shape[2:]) for leaf in chain)
    return FrameEquations(poses.start, data.camera, window, cross, gradient_window, shared, gradient_shared, cost)


def equations_of_each_frame(
    template: CameraModel,
    state: RigState,
    data: VisionData,
    poses: FramePoses,
    group: int,
    points: Float[Array, "3 N"],
    by_target: Float[Array, "T 3 N"],
    loss: Callable[[Array], tuple[Array, Array]],
) -> tuple[Float[Array, "F q q"], Float[Array, "F 6 q"], Float[Array, "F 6 6"]]:
    """What each frame with a pose of its own adds to the Hessian: shared coordinates, pose times shared, pose."""
    rotation, translation = _camera_poses(state, data, poses)

    def one(parts: tuple) -> tuple[Array, Array, Array]:
        lens, R_cam_rig, pose, R_cam_target, t_cam_target, pixels, weight = parts
        board = R_cam_target, t_cam_target, pixels, weight
        gram, _ = _reduce_corners(template, lens, None, points, by_target, loss, *board)
        (window, cross, _), turned = _lift(gram, pose, R_cam_target, R_cam_rig)
        shared, _ = _shared_equations(gram, turned, lens.shape[0])
        return shared, cross[0], window[0, :, 0]

    lenses, R_cam_rig = state.lenses[group][data.camera], state.R_cam_rig[data.rig_camera]
    frames = (lenses, R_cam_rig, poses, rotation, translation, data.pixels, data.weight)
    return jax.lax.map(one, frames, batch_size=FRAME_BATCH)


def pulled_back(
    template: CameraModel, lens: Float[Array, " n"], camera_point: Float[Array, "3"], seen: Bool[Array, ""]
) -> tuple[Float[Array, "2"], Float[Array, "2 3"], Float[Array, "2 n"]]:
    """The pixel of one point, with its derivatives by the point and by the lens."""
    # What is not seen may lie outside the lens's domain, where a projection may be anything; so it is put elsewhere.
    camera_point = jnp.where(seen, camera_point, jnp.array(_HARMLESS))
    pixel, by_point, by_lens = zip(*pixel_derivatives(template, lens, camera_point), strict=True)
    return (
        jnp.stack(pixel),
        jnp.stack([jnp.stack(row) for row in by_point]),
        jnp.stack([jnp.concatenate([jnp.atleast_1d(part) for part in row]) for row in by_lens]),
    )


def _reduce_corners(
    template: CameraModel,
    lens: Float[Array, " n"],
    along: Float[Array, "n n"] | None,
    points: Float[Array, "3 N"],
    by_target: Float[Array, "T 3 N"],
    loss: Callable[[Array], tuple[Array, Array]],
    R_cam_target: Float[Array, "3 3"],
    t_cam_target: Float[Array, "3"],
    pixels: Float[Array, "2 N"],
    weight: Float[Array, " N"],
) -> tuple[Float[Array, "m m"], Float[Array, ""]]:
    """Gram matrix of (rotation, translation, lens, target, residual) over a frame; the pose is perturbed on the left.

    Corners run along the last axis, which is the one that the compiler vectorises.
    """
    rotated = R_cam_target @ points
    seen = weight > 0
    # What is not seen may lie outside the lens's domain, where a projection may be anything; so it is put elsewhere.
    camera_points = jnp.where(seen, rotated + t_cam_target[:, None], jnp.array(_HARMLESS)[:, None])
    derivatives = functools.partial(pixel_derivatives, template, lens)
    coordinates = jax.vmap(derivatives, in_axes=1, out_axes=-1)(camera_points)
    # Barriers keep the compiler from computing a projection anew for every row that is made of it.
    coordinates = jax.lax.optimization_barrier(coordinates)
    errors = [value - measured for (value, _, _), measured in zip(coordinates, pixels, strict=True)]
    rho, robust_weight = loss(weight * (errors[0] ** 2 + errors[1] ** 2))
    root = jax.lax.optimization_barrier(jnp.sqrt(jnp.where(seen, weight * robust_weight, 0.0)))
    x, y, z = rotated
    gram = jnp.zeros(())
    for (_, by_point, by_lens), error in zip(coordinates, errors, strict=True):
        a, b, c = by_point
        by_rotation = [y * c - z * b, z * a - x * c, x * b - y * a]  # -by_point hat(rotated)
        if along is not None:
            by_lens = [along.T @ jnp.concatenate([jnp.atleast_2d(part) for part in by_lens])]
        by_shape = jnp.einsum("jn,tjn->tn", R_cam_target.T @ jnp.stack(by_point), by_target)
        parts = [*by_rotation, *by_point, *by_lens, *([by_shape] if len(by_target) else []), error]
        parts = [jnp.atleast_2d(part) * root for part in parts]
        rows = jax.lax.platform_dependent(*parts, cpu=_one_by_one, default=lambda *parts: jnp.concatenate(parts))
        gram = gram + rows @ rows.T
    return gram, 0.5 * jnp.sum(jnp.where(seen, rho, 0.0))


def _one_by_one(*parts: Float[Array, "_ N"]) -> Float[Array, "m N"]:
    """The parts one below the other. A CPU puts each in its place in a loop of its own; joined as one expression, it
    would ask for every number anew which part that is of."""
    rows = jnp.zeros((sum(map(len, parts)), parts[0].shape[1]))
    start = 0
    for part in parts:
        rows = jax.lax.dynamic_update_slice(rows, part, (start, 0))
        start += len(part)
    return rows


def _lift(
    gram: Float[Array, "m m"], pose: FramePoses, R_cam_target: Array, R_cam_rig: Array
) -> tuple[tuple[Array, Array, Array], Float[Array, "7 m+1"]]:
    """From the camera's pose to the window of the chain, the extrinsics and the time shift, by the chain rule.

    Returns the window's Hessian (k, 6, k, 6), its products with (lens, extrinsics, shift, target) (k, 6, q), its
    gradient (k, 6); and the rows of extrinsics and shift times (extrinsics, shift; lens, target, residual).
    """
    order = pose.basis.shape[0]
    lever = so3.hat(R_cam_target @ pose.position)
    identity = jnp.eye(3)

    by_rotation = -jnp.einsum("ij,jkl->ikl", R_cam_rig, pose.by_rotation)
    by_position = jnp.zeros((3, order, 3))
    upper = jnp.concatenate([by_rotation, by_position], axis=2)
    lower = jnp.concatenate(
        [
            jnp.einsum("ij,jkl->ikl", lever, by_rotation),
            -R_cam_target[:, None, :] * pose.basis[None, :, None],
        ],
        axis=2,
    )
    by_window = jnp.concatenate([upper, lower]).reshape(6, 6 * order)

    turn = -R_cam_rig @ pose.omega
    by_shift = jnp.concatenate([turn, lever @ turn - R_cam_target @ pose.velocity])[:, None]
    by_extrinsics = jnp.block([[identity, jnp.zeros((3, 3))], [lever, identity]])
    by_rig = jnp.concatenate([by_extrinsics, by_shift], axis=1)  # (6, 7)

    products = jnp.concatenate([gram[:6, :6] @ by_rig, gram[:6, 6:]], axis=1)  # (6, 7 + n + T + 1)
    cross = by_window.T @ products
    window = (by_window.T @ gram[:6, :6] @ by_window).reshape(order, 6, order, 6)
    return (window, cross[:, :-1].reshape(order, 6, -1), cross[:, -1].reshape(order, 6)), by_rig.T @ products


def _shared_equations(
    gram: Float[Array, "m m"], turned: Float[Array, "7 m+1"], lens: int
) -> tuple[Float[Array, "q q"], Float[Array, " q"]]:
    """Hessian and gradient of (extrinsics, shift, lens, target) from the sums over frames."""
    rest = gram[6:, 6:]
    upper = turned[:, :-1]
    hessian = jnp.block([[upper], [upper[:, 7:].T, rest[:-1, :-1]]])
    return hessian, jnp.concatenate([turned[:, -1], rest[:-1, -1]])
