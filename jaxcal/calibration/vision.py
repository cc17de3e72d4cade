"""Corners of the target: reprojection residuals, reduced frame by frame before the chain sees them."""

from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxcal.calibration.state import RigState
from jaxcal.cameras import CameraModel
from jaxcal.estimation import huber
from jaxcal.trajectory import PoseSpline, basis_matrix, increments, rotation_at, so3, weights

# Frames are reduced in batches of this many: large enough to vectorise, small enough to stay in the cache.
FRAME_BATCH = 16


class VisionData(eqx.Module):
    """Detections of a group of cameras of equal model, padded to all points of the target.

    `camera` (F,) place in the group; `rig_camera` (F,) index in the rig; `view` (F,) index into the chain of poses
    (discrete problems); `time` (F,) s on the camera's clock (continuous ones); `pixels` (F, N, 2); `weight` (F, N) 1 /
    sigma^2 in px^-2, 0 where the corner is absent; `points` (N, 3) in the target frame, m.
    """

    camera: Int[Array, " F"]
    rig_camera: Int[Array, " F"]
    view: Int[Array, " F"]
    time: Float[Array, " F"]
    pixels: Float[Array, "F N 2"]
    weight: Float[Array, "F N"]
    points: Float[Array, "N 3"]


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

    def poses(self, state: RigState, data: VisionData) -> FramePoses: ...


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
    """Gauss-Newton contributions of frames, before they are added up: window (k x 6), and shared (q = n + 7) parts."""

    window: Float[Array, "*F k 6 k 6"]
    cross: Float[Array, "*F k 6 q"]
    shared: Float[Array, "*F q q"]
    gradient_window: Float[Array, "*F k 6"]
    gradient_shared: Float[Array, "*F q"]
    cost: Float[Array, "*F"]


def project_frame(
    template: CameraModel,
    lens: Float[Array, " n"],
    R_cam_target: Float[Array, "3 3"],
    t_cam_target: Float[Array, "3"],
    points: Float[Array, "N 3"],
) -> Float[Array, "N 2"]:
    """Pixels (N, 2) of target points in one frame."""
    model = template.with_parameters(lens)
    return jax.vmap(lambda point: model.project(R_cam_target @ point + t_cam_target))(points)


def frame_residuals(template: CameraModel, state: RigState, data: VisionData, poses: FramePoses, group: int) -> Array:
    """Projection minus measurement (F, N, 2), px."""
    rotation, translation = _camera_poses(state, data, poses)
    project = jax.vmap(project_frame, in_axes=(None, 0, 0, 0, None))
    return project(template, state.lenses[group][data.camera], rotation, translation, data.points) - data.pixels


def _camera_poses(state: RigState, data: VisionData, poses: FramePoses) -> tuple[Array, Array]:
    """T_cam_target of each frame: rotations (F, 3, 3) and translations (F, 3)."""
    rotation = state.R_cam_rig[data.rig_camera] @ poses.rotation.swapaxes(-1, -2)
    translation = state.t_cam_rig[data.rig_camera] - jnp.einsum("fij,fj->fi", rotation, poses.position)
    return rotation, translation


def linearise_frames(
    template: CameraModel, state: RigState, data: VisionData, poses: FramePoses, group: int, huber_width: Array
) -> FrameEquations:
    """Equations of all frames of one group, in batches."""
    rotation, translation = _camera_poses(state, data, poses)
    lens = state.lenses[group][data.camera]
    R_cam_rig = state.R_cam_rig[data.rig_camera]

    def one(frame: tuple) -> FrameEquations:
        pose, lens, R_cam_target, t_cam_target, R_cam_rig, pixels, weight = frame
        gram, cost = _reduce_corners(
            template, lens, R_cam_target, t_cam_target, data.points, pixels, weight, huber_width
        )
        return _lift(gram, cost, pose, R_cam_target, R_cam_rig)

    frames = (poses, lens, rotation, translation, R_cam_rig, data.pixels, data.weight)
    batches = jax.tree.map(lambda leaf: leaf.reshape(-1, FRAME_BATCH, *leaf.shape[1:]), frames)
    reduced = jax.lax.map(jax.vmap(one), batches)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), reduced)


def _reduce_corners(
    template: CameraModel,
    lens: Float[Array, " n"],
    R_cam_target: Float[Array, "3 3"],
    t_cam_target: Float[Array, "3"],
    points: Float[Array, "N 3"],
    pixels: Float[Array, "N 2"],
    weight: Float[Array, " N"],
    huber_width: Array,
) -> tuple[Float[Array, "m m"], Float[Array, ""]]:
    """Gram matrix of (rotation, translation, lens, residual) over a frame's corners; pose perturbed on the left."""

    def corner(point: Array, pixel: Array) -> Array:
        rotated = R_cam_target @ point

        def project(camera_point: Array, lens: Array) -> Array:
            return template.with_parameters(lens).project(camera_point)

        camera_point = rotated + t_cam_target
        by_point, by_lens = jax.jacrev(project, argnums=(0, 1))(camera_point, lens)
        residual = project(camera_point, lens) - pixel
        by_rotation = -by_point @ so3.hat(rotated)
        return jnp.concatenate([by_rotation, by_point, by_lens, residual[:, None]], axis=1)

    rows = jax.vmap(corner)(points, pixels)  # (N, 2, 6 + n + 1)
    squared = weight * jnp.sum(rows[:, :, -1] ** 2, axis=1)
    rho, robust_weight = huber(squared, huber_width)
    seen = weight > 0
    total = jnp.where(seen, weight * robust_weight, 0.0)
    rows = jnp.where(seen[:, None, None], rows, 0.0)
    flat = rows.reshape(-1, rows.shape[-1])
    return (flat * jnp.repeat(total, 2)[:, None]).T @ flat, 0.5 * jnp.sum(jnp.where(seen, rho, 0.0))


def _lift(
    gram: Float[Array, "m m"], cost: Array, pose: FramePoses, R_cam_target: Array, R_cam_rig: Array
) -> FrameEquations:
    """From (camera pose, lens) to (window of the chain, lens, extrinsics, time shift) by the chain rule."""
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

    pose_pose, pose_lens, pose_residual = gram[:6, :6], gram[:6, 6:-1], gram[:6, -1]
    lens_lens, lens_residual = gram[6:-1, 6:-1], gram[6:-1, -1]
    weighted = by_window.T @ pose_pose
    lens_rig = pose_lens.T @ by_rig
    return FrameEquations(
        window=(weighted @ by_window).reshape(order, 6, order, 6),
        cross=jnp.concatenate([by_window.T @ pose_lens, weighted @ by_rig], axis=1).reshape(order, 6, -1),
        shared=jnp.block([[lens_lens, lens_rig], [lens_rig.T, by_rig.T @ pose_pose @ by_rig]]),
        gradient_window=(by_window.T @ pose_residual).reshape(order, 6),
        gradient_shared=jnp.concatenate([lens_residual, by_rig.T @ pose_residual]),
        cost=cost,
    )
