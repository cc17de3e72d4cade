"""The unknowns of a rig: cameras, extrinsics, time offsets, gravity, the target, and the chain of poses and biases."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras import CameraModel
from jaxcal.estimation import on_device
from jaxcal.trajectory import so3

_Array = TypeVar("_Array", Array, np.ndarray)


@dataclass(frozen=True)
class ImuPlace:
    """What is shared of one IMU: the number of its model's parameters, and, where it is not the rig's own frame, its
    place T_imu_rig and its time shift."""

    model: str
    parameters: int
    placed: bool

    @property
    def size(self) -> int:
        """How many shared coordinates are its own."""
        return self.parameters + 7 * self.placed


@dataclass(frozen=True)
class SharedLayout:
    """Where each camera's parameters stand in the tangent vector of the shared parameters.

    Cameras are gathered in groups of equal model and shutter, so that one compiled projection serves a group;
    `groups[g]` lists its cameras, `sizes[c]` the number of lens parameters of camera c. The vector holds, camera by
    camera, the lens parameters, T_cam_rig (rotation, translation), the time shift; then, IMU by IMU, the parameters of
    its model and, of all but the first, T_imu_rig and the time shift; then the direction of gravity (2), or all of it
    (3); then the line delays of the cameras with a rolling shutter; then the target: T_target_board of every board but
    the first (6 each), the warp (2 where it is estimated), and the offsets of the points (3 each, where they are).
    """

    groups: tuple[tuple[int, ...], ...]
    sizes: tuple[int, ...]
    extra_boards: int = 0
    warp: bool = False
    offsets: int = 0
    imus: tuple[ImuPlace, ...] = ()
    gravity_size: int = 2
    rolling: tuple[bool, ...] = ()

    @property
    def num_cameras(self) -> int:
        """How many cameras there are."""
        return len(self.sizes)

    @property
    def size(self) -> int:
        """How many shared coordinates there are."""
        inertial = sum(imu.size for imu in self.imus) + self.gravity_size
        return sum(self.sizes) + 7 * self.num_cameras + inertial + sum(self.rolling) + self.target_size

    @property
    def target_size(self) -> int:
        """How many of them are the target's."""
        return 6 * self.extra_boards + 2 * self.warp + 3 * self.offsets

    def start(self, camera: int) -> int:
        """Where the coordinates of a camera begin."""
        return sum(self.sizes[:camera]) + 7 * camera

    def lens(self, camera: int) -> slice:
        """A camera's lens parameters."""
        return slice(self.start(camera), self.start(camera) + self.sizes[camera])

    def rotation(self, camera: int) -> slice:
        """The rotation of T_cam_rig of a camera (3)."""
        first = self.lens(camera).stop
        return slice(first, first + 3)

    def pose(self, camera: int) -> slice:
        """T_cam_rig of a camera: rotation, translation (6)."""
        first = self.lens(camera).stop
        return slice(first, first + 6)

    def shift(self, camera: int) -> int:
        """Where the time shift of a camera stands."""
        return self.lens(camera).stop + 6

    def imu(self, number: int) -> slice:
        """The parameters, place and time shift of one IMU."""
        first = self.start(self.num_cameras) + sum(imu.size for imu in self.imus[:number])
        return slice(first, first + self.imus[number].size)

    @property
    def inertial(self) -> slice:
        """All IMUs, and gravity."""
        return slice(self.start(self.num_cameras), self.gravity.stop)

    @property
    def gravity(self) -> slice:
        """The direction of gravity (2), or all of it (3)."""
        stop = self.size - self.target_size - sum(self.rolling)
        return slice(stop - self.gravity_size, stop)

    def is_rolling(self, camera: int) -> bool:
        """Whether a camera has a rolling shutter, whose line delay is estimated."""
        return bool(self.rolling) and self.rolling[camera]

    def line_delay(self, camera: int) -> int:
        """Where the line delay of a camera with a rolling shutter stands."""
        return self.gravity.stop + sum(self.rolling[:camera])

    def gravity_basis(self, gravity: Float[Array, "3"]) -> Float[Array, "3 g"]:
        """Directions in which gravity may move: two across it, or all three."""
        return tangent_basis(gravity) if self.gravity_size == 2 else jnp.eye(3)

    @property
    def target(self) -> slice:
        """The target: boards' places, warp, offsets of points."""
        return slice(self.size - self.target_size, self.size)

    def place(self, camera: int) -> tuple[int, int]:
        """(group, place in the group) of a camera."""
        for g, members in enumerate(self.groups):
            if camera in members:
                return g, members.index(camera)
        raise IndexError(camera)


def layout_of(
    models: list[CameraModel],
    *,
    extra_boards: int = 0,
    warp: bool = False,
    offsets: int = 0,
    imus: tuple[ImuPlace, ...] = (),
    gravity_size: int = 2,
    rolling: Sequence[bool] = (),
) -> SharedLayout:
    """Group cameras by their model class and shutter; `offsets` is the number of points that may move, or 0."""
    kinds = list(zip(map(type, models), rolling if any(rolling) else [False] * len(models), strict=True))
    groups = tuple(tuple(c for c, own in enumerate(kinds) if own == kind) for kind in dict.fromkeys(kinds))
    sizes = tuple(model.num_parameters for model in models)
    shutters = tuple(rolling) if any(rolling) else ()
    return SharedLayout(groups, sizes, extra_boards, warp, offsets, imus, gravity_size, shutters)


class TargetState(eqx.Module):
    """What is not known of the target: places of its boards, and its true shape.

    `R_target_board` (E, 3, 3), `t_target_board` (E, 3) of every board but the first, whose frame is the target's;
    `warp` (2,) m, the bend along columns and rows (`TargetGeometry`), empty where the board is taken for flat;
    `offsets` (N, 3) m of the points from their stated places, empty where those are taken as stated.
    """

    R_target_board: Float[Array, "E 3 3"]
    t_target_board: Float[Array, "E 3"]
    warp: Float[Array, " w"]
    offsets: Float[Array, "M 3"]

    def retract(self, layout: SharedLayout, step: Float[Array, " T"]) -> "TargetState":
        """Move along a tangent step; boards turn on the left."""
        boards = step[: 6 * layout.extra_boards].reshape(-1, 6)
        bend = step[6 * layout.extra_boards :][: len(self.warp)]
        moved = step[6 * layout.extra_boards + len(self.warp) :].reshape(-1, 3)
        return TargetState(
            R_target_board=jax.vmap(so3.exp)(boards[:, :3]) @ self.R_target_board,
            t_target_board=self.t_target_board + boards[:, 3:],
            warp=self.warp + bend,
            offsets=self.offsets + moved,
        )


def flat_target(layout: SharedLayout) -> TargetState:
    """A target as it was stated: flat, its boards in one place."""
    return TargetState(
        R_target_board=on_device(np.tile(np.eye(3), (layout.extra_boards, 1, 1))),
        t_target_board=on_device(np.zeros((layout.extra_boards, 3))),
        warp=on_device(np.zeros(2 * layout.warp)),
        offsets=on_device(np.zeros((layout.offsets, 3))),
    )


class RigState(eqx.Module):
    """All unknowns. The rig's frame is the IMU's where there is one, else that of cam0.

    `lenses[g]` (C_g, n_g) lens parameters of the cameras of group g; `R_cam_rig` (C, 3, 3), `t_cam_rig` (C, 3);
    `shift` (C,) s, rig time = camera time + shift; `gravity` (3,) m/s^2 in the target frame; chain: `rotations`
    (K, 3, 3) and `positions` (K, 3) of T_target_rig (poses of views, or control points), `biases` (H, 6 M) gyro then
    accel of each of the M IMUs, every k - 1 knot intervals from the first, k the spline's order; `target` what is not
    known of the target. Of each IMU its model's parameters, `R_imu_rig`, `t_imu_rig`, and `imu_shift` s, rig time =
    IMU time + shift; the first one's frame and clock are the rig's. `line_delay` (C,) s per row, zero for global
    shutters; empty where all are global.
    """

    lenses: tuple[Float[Array, "_ _"], ...]
    R_cam_rig: Float[Array, "C 3 3"]
    t_cam_rig: Float[Array, "C 3"]
    shift: Float[Array, " C"]
    gravity: Float[Array, "3"]
    rotations: Float[Array, "K 3 3"]
    positions: Float[Array, "K 3"]
    biases: Float[Array, "H b"]
    target: TargetState
    imu_parameters: tuple[Float[Array, "_"], ...] = ()
    R_imu_rig: Float[Array, "M 3 3"] = eqx.field(default_factory=lambda: on_device(np.zeros((0, 3, 3))))
    t_imu_rig: Float[Array, "M 3"] = eqx.field(default_factory=lambda: on_device(np.zeros((0, 3))))
    imu_shift: Float[Array, " M"] = eqx.field(default_factory=lambda: on_device(np.zeros(0)))
    line_delay: Float[Array, " D"] = eqx.field(default_factory=lambda: on_device(np.zeros(0)))

    def retract(self, layout: SharedLayout, chain: Float[Array, "K B"], shared: Float[Array, " P"]) -> "RigState":
        """Move along a tangent step: rotations of the chain on the right, those of the cameras on the left.

        `chain` row by row: six coordinates of each of some poses, as many as fill the row, then those of the biases;
        rows may hold more poses than there are.
        """
        chain, by_biases = jnp.split(chain, [chain.shape[1] - self.biases.shape[1]], axis=1)
        chain = chain.reshape(-1, 6)[: len(self.positions)]
        lenses = tuple(
            values + jnp.stack([shared[layout.lens(c)] for c in members])
            for values, members in zip(self.lenses, layout.groups, strict=True)
        )
        cameras = range(layout.num_cameras)
        poses = jnp.stack([shared[layout.pose(c)] for c in cameras])
        shifts = jnp.stack([shared[layout.shift(c)] for c in cameras])
        gravity = self.gravity + layout.gravity_basis(self.gravity) @ shared[layout.gravity]
        if layout.gravity_size == 2:
            gravity = gravity * (jnp.linalg.norm(self.gravity) / jnp.linalg.norm(gravity))
        steps = [shared[layout.imu(i)] for i in range(len(layout.imus))]
        places = [
            step[imu.parameters :] if imu.placed else jnp.zeros(7) for step, imu in zip(steps, layout.imus, strict=True)
        ]
        moved = jnp.stack(places) if places else jnp.zeros((0, 7))
        # One exponential of all turns: each by itself takes its time to compile.
        turns = jax.vmap(so3.exp)(jnp.concatenate([chain[:, :3], poses[:, :3], moved[:, :3]]))
        of_chain, of_cameras, of_imus = jnp.split(turns, [len(chain), len(chain) + len(poses)])
        return RigState(
            lenses=lenses,
            R_cam_rig=of_cameras @ self.R_cam_rig,
            t_cam_rig=self.t_cam_rig + poses[:, 3:],
            shift=self.shift + shifts,
            gravity=gravity,
            rotations=self.rotations @ of_chain,
            positions=self.positions + chain[:, 3:6],
            biases=self.biases + by_biases,
            target=self.target.retract(layout, shared[layout.target]) if layout.target_size else self.target,
            imu_parameters=tuple(
                values + step[: imu.parameters]
                for values, step, imu in zip(self.imu_parameters, steps, layout.imus, strict=True)
            ),
            R_imu_rig=of_imus @ self.R_imu_rig,
            t_imu_rig=self.t_imu_rig + moved[:, 3:6],
            imu_shift=self.imu_shift + moved[:, 6],
            line_delay=self.line_delay + self._delay_steps(layout, shared) if layout.rolling else self.line_delay,
        )

    @staticmethod
    def _delay_steps(layout: SharedLayout, shared: Float[Array, " P"]) -> Float[Array, " C"]:
        cameras = range(layout.num_cameras)
        zero = jnp.zeros(())
        return jnp.stack([shared[layout.line_delay(c)] if layout.is_rolling(c) else zero for c in cameras])


def block_count(poses: int, order: int) -> int:
    """Blocks of a chain of control points, each with those of k - 1 knot intervals (and one set of biases)."""
    return -(-poses // (order - 1))


def free_blocks(poses: int, order: int, imus: int) -> np.ndarray:
    """Which coordinates (H, 6 (k - 1) + 6 M) of a chain of control points and the biases of M IMUs there are: all but
    the control points that the last block has no more of."""
    per = order - 1
    count = block_count(poses, order)
    free = np.ones((count, 6 * per + 6 * imus), dtype=bool)
    free[:, : 6 * per] = np.arange(count * per * 6).reshape(count, -1) < 6 * poses
    return free


def tangent_basis(vector: Float[_Array, "3"]) -> Float[_Array, "3 2"]:
    """Two orthonormal directions across `vector`, smooth in it except at one pole (Duff et al. 2017, listing 3).

    By numpy for its arrays: jax would compile each operation by itself.
    """
    xp = vector.__array_namespace__()
    x, y, z = vector / xp.linalg.vector_norm(vector)
    sign = xp.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = xp.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    second = xp.stack([b, sign + y * y * a, -y])
    return xp.stack([first, second], axis=1)


def transform(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """A homogeneous (4, 4) transform."""
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = translation
    return out


def camera_model_of(
    state: RigState, layout: SharedLayout, templates: tuple[CameraModel, ...], camera: int
) -> CameraModel:
    """The camera model of one camera at this state."""
    group, place = layout.place(camera)
    return templates[group].with_parameters(np.asarray(state.lenses[group])[place])
