"""The unknowns of a rig: cameras, extrinsics, time offsets, gravity, and the chain of poses and biases."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras import CameraModel
from jaxcal.trajectory import so3


@dataclass(frozen=True)
class SharedLayout:
    """Where each camera's parameters stand in the tangent vector of the shared parameters.

    Cameras are gathered in groups of equal model, so that one compiled projection serves a group; `groups[g]` lists
    its cameras, `sizes[c]` the number of lens parameters of camera c. The vector holds, camera by camera, the lens
    parameters, T_cam_rig (rotation, translation), the time shift; and at last the direction of gravity (2).
    """

    groups: tuple[tuple[int, ...], ...]
    sizes: tuple[int, ...]

    @property
    def num_cameras(self) -> int:
        return len(self.sizes)

    @property
    def size(self) -> int:
        return sum(self.sizes) + 7 * self.num_cameras + 2

    def start(self, camera: int) -> int:
        return sum(self.sizes[:camera]) + 7 * camera

    def lens(self, camera: int) -> slice:
        return slice(self.start(camera), self.start(camera) + self.sizes[camera])

    def rotation(self, camera: int) -> slice:
        first = self.lens(camera).stop
        return slice(first, first + 3)

    def pose(self, camera: int) -> slice:
        first = self.lens(camera).stop
        return slice(first, first + 6)

    def shift(self, camera: int) -> int:
        return self.lens(camera).stop + 6

    @property
    def gravity(self) -> slice:
        return slice(self.size - 2, self.size)

    def place(self, camera: int) -> tuple[int, int]:
        """(group, place in the group) of a camera."""
        for g, members in enumerate(self.groups):
            if camera in members:
                return g, members.index(camera)
        raise IndexError(camera)


def layout_of(models: list[CameraModel]) -> SharedLayout:
    """Group cameras by their model class."""
    classes = list(dict.fromkeys(type(model) for model in models))
    groups = tuple(tuple(c for c, model in enumerate(models) if type(model) is cls) for cls in classes)
    return SharedLayout(groups, tuple(model.num_parameters for model in models))


class RigState(eqx.Module):
    """All unknowns. The rig's frame is the IMU's where there is one, else that of cam0.

    `lenses[g]` (C_g, n_g) lens parameters of the cameras of group g; `R_cam_rig` (C, 3, 3), `t_cam_rig` (C, 3);
    `shift` (C,) s, rig time = camera time + shift; `gravity` (3,) m/s^2 in the target frame; chain: `rotations`
    (K, 3, 3) and `positions` (K, 3) of T_target_rig (poses of views, or control points), `biases` (K, 6) gyro then
    accel (K, 0 without IMU).
    """

    lenses: tuple[Float[Array, "_ _"], ...]
    R_cam_rig: Float[Array, "C 3 3"]
    t_cam_rig: Float[Array, "C 3"]
    shift: Float[Array, " C"]
    gravity: Float[Array, "3"]
    rotations: Float[Array, "K 3 3"]
    positions: Float[Array, "K 3"]
    biases: Float[Array, "K b"]

    def retract(self, layout: SharedLayout, chain: Float[Array, "K B"], shared: Float[Array, " P"]) -> "RigState":
        """Move along a tangent step: rotations of the chain on the right, those of the cameras on the left."""
        lenses = tuple(
            values + jnp.stack([shared[layout.lens(c)] for c in members])
            for values, members in zip(self.lenses, layout.groups, strict=True)
        )
        cameras = range(layout.num_cameras)
        poses = jnp.stack([shared[layout.pose(c)] for c in cameras])
        shifts = jnp.stack([shared[layout.shift(c)] for c in cameras])
        exp = jax.vmap(so3.exp)
        gravity = self.gravity + tangent_basis(self.gravity) @ shared[layout.gravity]
        return RigState(
            lenses=lenses,
            R_cam_rig=exp(poses[:, :3]) @ self.R_cam_rig,
            t_cam_rig=self.t_cam_rig + poses[:, 3:],
            shift=self.shift + shifts,
            gravity=gravity * (jnp.linalg.norm(self.gravity) / jnp.linalg.norm(gravity)),
            rotations=self.rotations @ exp(chain[:, :3]),
            positions=self.positions + chain[:, 3:6],
            biases=self.biases + chain[:, 6:],
        )


def tangent_basis(vector: Float[Array, "3"]) -> Float[Array, "3 2"]:
    """Two orthonormal directions across `vector`, smooth in it except at one pole (Duff et al. 2017, listing 3)."""
    x, y, z = vector / jnp.linalg.norm(vector)
    sign = jnp.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    second = jnp.stack([b, sign + y * y * a, -y])
    return jnp.stack([first, second], axis=1)


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
    return templates[group].with_parameters(state.lenses[group][place])
