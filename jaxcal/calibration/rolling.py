"""Corners of rolling-shutter cameras: every image row has a time of its own, and so every corner a pose of its own.

Oth, Furgale, Kneip and Siegwart, "Rolling shutter camera calibration", CVPR 2013. A corner in row v was seen at the
frame's time + v * line delay; v is the measured row, which is as good as the true one (0.1 px of a 30 us row: 3 us).
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.calibration.state import RigState, SharedLayout
from jaxcal.calibration.vision import FrameEquations, VisionData, pulled_back
from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.trajectory import Increments, PoseSpline, basis_matrix, increments, rotation_at, so3, weights

# Frames are reduced in batches of this many: their rows are many and wide.
_BATCH = 8
# The longest time that an image is taken to be read out in, s.
_LONGEST_READOUT_S = 0.035


def shutters_of(rolling: bool | Sequence[bool], cameras: int) -> list[bool]:
    """Which cameras have a rolling shutter. Raises CalibrationError when there are not as many answers as cameras."""
    shutters = [rolling] * cameras if isinstance(rolling, bool) else [bool(one) for one in rolling]
    if len(shutters) != cameras:
        raise CalibrationError(
            f"`rolling_shutter` has {len(shutters)} entries for {cameras} cameras; give one for all or one each."
        )
    return shutters


def row_intervals(layout: SharedLayout, dt: float) -> int:
    """How many knot intervals of `dt` s the rows of an image may span."""
    return int(np.ceil(_LONGEST_READOUT_S / dt)) + 1 if layout.rolling else 1


def check_readout(name: str, line_delay_s: float, rows: int) -> None:
    """Raise CalibrationError where an image takes longer to be read out than `row_intervals` has room for: the corners
    of its last rows were left out of the equations."""
    if abs(line_delay_s) * rows > _LONGEST_READOUT_S:
        raise CalibrationError(
            f"{name}: the line delay comes out as {1e6 * line_delay_s:.1f} us, so that {rows} rows take "
            f"{1e3 * abs(line_delay_s) * rows:.0f} ms; there is room for {1e3 * _LONGEST_READOUT_S:.0f} ms. "
            "Is the shutter a rolling one, and is the frame's time that of its first row?"
        )


class _CornerPose(eqx.Module):
    """T_cam_target of one corner with Jacobians (perturbed on the left, 6 rows: rotation, translation) by the window of
    k chain blocks, the extrinsics and the time shift."""

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    by_window: Float[Array, "6 w"]
    by_extrinsics: Float[Array, "6 6"]
    by_shift: Float[Array, "6"]


def _corner_pose(
    spline: PoseSpline, chain: Increments, R_cam_rig: Array, t_cam_rig: Array, i: Array, u: Array
) -> _CornerPose:
    order = spline.order
    matrix = basis_matrix(order)
    window = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, i, order - 1), chain)
    point = rotation_at(spline.rotations[i], window, u, spline.dt, order)
    control = jax.lax.dynamic_slice_in_dim(spline.positions, i, order)
    basis = weights(matrix, u, spline.dt, 0)
    velocity = weights(matrix, u, spline.dt, 1) @ control
    rotation = R_cam_rig @ point.rotation.T
    in_camera = rotation @ (basis @ control)
    lever = so3.hat(in_camera)
    by_rotation = -jnp.einsum("ij,jkl->ikl", R_cam_rig, point.rotation_jacobian)
    upper = jnp.concatenate([by_rotation, jnp.zeros((3, order, 3))], axis=2)
    by_position = -rotation[:, None, :] * basis[None, :, None]
    lower = jnp.concatenate([jnp.einsum("ij,jkl->ikl", lever, by_rotation), by_position], axis=2)
    turn = -R_cam_rig @ point.velocity
    return _CornerPose(
        rotation=rotation,
        translation=t_cam_rig - in_camera,
        by_window=jnp.concatenate([upper, lower]).reshape(6, 6 * order),
        by_extrinsics=jnp.block([[jnp.eye(3), jnp.zeros((3, 3))], [lever, jnp.eye(3)]]),
        by_shift=jnp.concatenate([turn, lever @ turn - rotation @ velocity]),
    )


def rolling_errors(
    template: CameraModel,
    state: RigState,
    data: VisionData,
    spline: PoseSpline,
    group: int,
    points: Float[Array, "3 N"],
) -> Float[Array, "F N 2"]:
    """Projection minus measurement, px."""
    chain = increments(state.rotations)

    def frame(parts: tuple) -> Array:
        camera, rig_camera, time, pixels = parts
        lens = template.with_parameters(state.lenses[group][camera])
        R, t = state.R_cam_rig[rig_camera], state.t_cam_rig[rig_camera]
        index, u = spline.locate(time + state.shift[rig_camera] + state.line_delay[rig_camera] * pixels[1])

        def corner(i: Array, u: Array, point: Array, pixel: Array) -> Array:
            pose = _corner_pose(spline, chain, R, t, i, u)
            return lens.project(pose.rotation @ point + pose.translation) - pixel

        return jax.vmap(corner, in_axes=(0, 0, 1, 1))(index, u, points, pixels)

    return jax.lax.map(frame, (data.camera, data.rig_camera, data.time, data.pixels), batch_size=_BATCH)


def linearise_rolling(
    template: CameraModel,
    state: RigState,
    data: VisionData,
    spline: PoseSpline,
    group: int,
    points: Float[Array, "3 N"],
    by_target: Float[Array, "T 3 N"],
    loss: Callable[[Array], tuple[Array, Array]],
    basis: Float[Array, "C n n"] | None,
    intervals: int,
) -> FrameEquations:
    """Equations of all frames of one group, each in `intervals` parts, one for each knot interval that its rows span.

    Shared coordinates: extrinsics, time shift, lens, line delay, target.
    """
    chain = increments(state.rotations)
    order = spline.order
    last = spline.num_intervals - 1
    w = 6 * order

    def frame(parts: tuple) -> tuple:
        camera, rig_camera, time, pixels, weight = parts
        lens = state.lenses[group][camera]
        R, t = state.R_cam_rig[rig_camera], state.t_cam_rig[rig_camera]
        row = pixels[1]
        index, u = spline.locate(time + state.shift[rig_camera] + state.line_delay[rig_camera] * row)
        seen = weight > 0
        first = jnp.min(jnp.where(seen, index, last))
        along = None if basis is None else basis[camera]

        def corner(i: Array, u: Array, point: Array, by_shape: Array, pixel: Array, seen: Array, v: Array) -> Array:
            pose = _corner_pose(spline, chain, R, t, i, u)
            rotated = pose.rotation @ point
            projected, by_point, by_lens = pulled_back(template, lens, rotated + pose.translation, seen)
            by_lens = by_lens if along is None else by_lens @ along
            by_pose = jnp.concatenate([-by_point @ so3.hat(rotated), by_point], axis=1)  # (2, 6)
            by_shift = (by_pose @ pose.by_shift)[:, None]
            rows = [by_pose @ pose.by_window, by_pose @ pose.by_extrinsics, by_shift, by_lens, v * by_shift]
            return jnp.concatenate([*rows, by_point @ pose.rotation @ by_shape.T, (projected - pixel)[:, None]], axis=1)

        rows = jax.vmap(corner, in_axes=(0, 0, 1, 2, 1, 0, 0))(index, u, points, by_target, pixels, seen, row)
        rho, robust_weight = loss(weight * jnp.sum(rows[..., -1] ** 2, axis=1))
        rows = rows * jnp.sqrt(jnp.where(seen, weight * robust_weight, 0.0))[:, None, None]
        flat = rows.reshape(-1, rows.shape[-1])
        part = jnp.repeat(index - first, 2)
        grams = jnp.stack([(flat * (part == e)[:, None]).T @ flat for e in range(intervals)])
        start = jnp.minimum(first + jnp.arange(intervals), last)
        return start, grams, 0.5 * jnp.sum(jnp.where(seen, rho, 0.0))

    frames = (data.camera, data.rig_camera, data.time, data.pixels, data.weight)
    start, grams, cost = jax.lax.map(frame, frames, batch_size=_BATCH)
    cameras, q = state.lenses[group].shape[0], grams.shape[-1] - w - 1
    whole = jnp.zeros((cameras, *grams.shape[2:])).at[data.camera].add(grams.sum(axis=1))
    grams = grams.reshape(-1, *grams.shape[2:])
    return FrameEquations(
        start=start.reshape(-1),
        camera=jnp.repeat(data.camera, intervals),
        window=grams[:, :w, :w].reshape(-1, order, 6, order, 6),
        cross=grams[:, :w, w:-1].reshape(-1, order, 6, q),
        gradient_window=grams[:, :w, -1].reshape(-1, order, 6),
        shared=whole[:, w:-1, w:-1],
        gradient_shared=whole[:, w:-1, -1],
        cost=cost.sum(),
    )
