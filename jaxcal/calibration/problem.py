"""The calibration of a rig as one block-arrow least-squares problem, with or without IMU."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.calibration import inertial, vision
from jaxcal.calibration.equations import PoseEquations, of_poses, with_imus
from jaxcal.calibration.inertial import InertialData
from jaxcal.calibration.lens_basis import LensBasis
from jaxcal.calibration.rolling import linearise_rolling, rolling_errors
from jaxcal.calibration.state import RigState, SharedLayout
from jaxcal.calibration.target_shape import TargetGeometry, points_by_target, target_points
from jaxcal.calibration.vision import FrameEquations, FramePoses, VisionData
from jaxcal.cameras import CameraModel
from jaxcal.estimation import BlockArrow, robust_loss, scattered_band, scattered_chain
from jaxcal.programs import stored_jit
from jaxcal.trajectory import PoseSpline


class LensPrior(eqx.Module):
    """What is known of the lenses beforehand, per group: `mean` (C_g, n) and `information` (C_g, n, n)."""

    mean: tuple[Float[Array, "_ _"], ...]
    information: tuple[Float[Array, "_ _ _"], ...]


class RigProblem(eqx.Module):
    """Corners of all cameras, and IMU samples where there are any, on one trajectory of the rig.

    Without `imu` the chain holds one pose per view (band width zero), or the control points of a spline; with it,
    blocks of control points and biases (`free_blocks`).
    `free_chain` (B,) and `free` (P,) say which coordinates are estimated; the others are held. `loss_width` is the
    scale of the robust loss in sigmas of a corner; infinity for plain least squares. `basis` are the directions along
    which steps of the lenses are counted. `row_intervals` is how many knot intervals the rows of a rolling-shutter
    image may span.
    """

    templates: tuple[CameraModel, ...]
    corners: tuple[VisionData, ...]
    geometry: TargetGeometry
    imu: InertialData | None
    prior: LensPrior
    free_chain: Bool[Array, "K B"]
    free: Bool[Array, " P"]
    loss_width: Float[Array, ""]
    basis: LensBasis
    layout: SharedLayout = eqx.field(static=True)
    order: int = eqx.field(static=True)
    loss: str = eqx.field(static=True, default="huber")
    row_intervals: int = eqx.field(static=True, default=1)

    # --- the engine's protocol ---------------------------------------------------------------------------------------

    def linearise(self, state: RigState) -> BlockArrow:
        """Cost and normal equations at `state`."""
        corners = self._vision(state)
        if self.imu is None:
            equations = of_poses(corners, self.layout)
        else:
            equations = with_imus(corners, state, self.imu, self.order, self.layout)
        equations = self._add_lens_prior(equations, state)
        equations = self._add_target_prior(equations, state)
        return equations.hold(self.free_chain, self.free)

    def retract(self, state: RigState, chain: Float[Array, "K B"], shared: Float[Array, " P"]) -> RigState:
        """Move along a tangent step."""
        for columns, members in zip(self.basis, self.layout.groups, strict=True):
            if columns is not None:
                for place, camera in enumerate(members):
                    lens = self.layout.lens(camera)
                    shared = shared.at[lens].set(columns[place] @ shared[lens])
        return state.retract(self.layout, chain, shared)

    def residuals(self, state: RigState) -> Float[Array, " R"]:
        """All whitened residuals (without the robust loss), as one vector."""
        parts = []
        for group, (data, errors) in enumerate(zip(self.corners, self.corner_errors(state), strict=True)):
            parts.append(jnp.ravel(errors * jnp.sqrt(data.weight)[..., None]))
            parts.append(jnp.ravel(self._whitened_lens_error(state, group)))
        parts.append(jnp.ravel(state.target.offsets / self.geometry.offset_sigma))
        if self.imu is not None:
            for i in range(len(self.layout.imus)):
                parts.append(jnp.ravel(inertial.imu_residuals(state, self.imu, self.order, self.layout, i)))
                parts.append(inertial.model_prior_residuals(state, self.layout, i))
            parts.append(inertial.prior_residuals(state, self.imu, self.order))
        return jnp.concatenate(parts)

    # --- parts -------------------------------------------------------------------------------------------------------

    def poses(self, state: RigState, data: VisionData) -> FramePoses:
        """T_target_rig at every frame."""
        if self.imu is None:
            return vision.view_poses(state, data)
        return vision.spline_poses(state, data, self.imu.start, self.imu.dt, self.order)

    def points(self, state: RigState) -> Float[Array, "3 N"]:
        """The target's points, m."""
        return target_points(self.geometry, state.target).T

    def target_arrays(self, state: RigState) -> tuple[Float[Array, "3 N"], Float[Array, "T 3 N"]]:
        """The target's points, m, and their derivative by the target's unknowns."""
        return self.points(state), points_by_target(self.geometry, state.target, self.layout)

    def robust(self, squared: Array) -> tuple[Array, Array]:
        """The robust loss of squared whitened residuals and its weight."""
        return robust_loss(self.loss, squared, self.loss_width)

    def corner_errors(self, state: RigState) -> tuple[Float[Array, "_ N 2"], ...]:
        """Projection minus measurement of every corner, px, per group."""
        points = self.points(state)
        return tuple(
            rolling_errors(self.templates[g], state, data, self._spline(state), g, points)
            if self.layout.is_rolling(self.layout.groups[g][0])
            else vision.frame_residuals(self.templates[g], state, data, self.poses(state, data), g, points)
            for g, data in enumerate(self.corners)
        )

    def camera_poses(self, state: RigState) -> tuple[Float[Array, "_ 4 4"], ...]:
        """T_cam_target of every frame, per group."""
        return tuple(vision.frame_transforms(state, data, self.poses(state, data)) for data in self.corners)

    def _vision(self, state: RigState) -> PoseEquations:
        points, by_target = self.target_arrays(state)
        blocks, targets = state.positions.shape[0], self.layout.target_size
        band = jnp.zeros((blocks, self.order, 6, 6))
        chain = jnp.zeros((blocks, 6))
        border_target = jnp.zeros((blocks, 6, targets))
        shared = jnp.zeros((self.layout.size, self.layout.size))
        gradient = jnp.zeros(self.layout.size)
        borders: dict[int, Array] = {}
        delays: list[Array] = []
        cost = jnp.zeros(())
        for group in range(len(self.corners)):
            frames = self._frames(state, group, points, by_target)
            band = band + scattered_band(frames.start, frames.window, blocks)
            chain = chain + scattered_chain(frames.start, frames.gradient_window, blocks)
            cost = cost + frames.cost
            lens = state.lenses[group].shape[1]
            members = self.layout.groups[group]
            # The chains of the group's cameras end to end, so that each frame is put down once.
            rows = scattered_chain(frames.camera * blocks + frames.start, frames.cross, len(members) * blocks)
            for place, camera in enumerate(members):
                border = rows[place * blocks : (place + 1) * blocks]
                borders[camera] = jnp.concatenate([border[..., 7 : 7 + lens], border[..., :7]], axis=-1)
                if self.layout.is_rolling(camera):
                    delays.append(border[..., 7 + lens : 8 + lens])
                border_target = border_target + border[..., border.shape[-1] - targets :]
                columns = self.columns(camera)
                shared = shared.at[columns[:, None], columns].add(frames.shared[place])
                gradient = gradient.at[columns].add(frames.gradient_shared[place])
        return PoseEquations(
            band=band,
            cameras=jnp.concatenate([borders[c] for c in range(self.layout.num_cameras)], axis=-1),
            others=jnp.concatenate([*delays, border_target], axis=-1),
            gradient=chain,
            corner=shared,
            gradient_shared=gradient,
            cost=cost,
        )

    def _frames(
        self, state: RigState, group: int, points: Float[Array, "3 N"], by_target: Float[Array, "T 3 N"]
    ) -> FrameEquations:
        """Equations of the frames of one group, by their kind of shutter."""
        data, template, basis = self.corners[group], self.templates[group], self.basis[group]
        known = (template, state, data)
        target = (group, points, by_target, self.robust, basis)
        if self.layout.is_rolling(self.layout.groups[group][0]):
            return linearise_rolling(*known, self._spline(state), *target, self.row_intervals)
        return vision.linearise_frames(*known, self.poses(state, data), *target)

    def _spline(self, state: RigState) -> PoseSpline:
        assert self.imu is not None, "a rolling shutter needs a trajectory"
        return PoseSpline(state.rotations, state.positions, self.imu.start, self.imu.dt, self.order)

    def columns(self, camera: int) -> np.ndarray:
        """Where the shared coordinates of a frame's equations stand: extrinsics, shift, lens, line delay, target."""
        layout = self.layout
        lens, target, shift = layout.lens(camera), layout.target, layout.shift(camera)
        delay = [layout.line_delay(camera)] if layout.is_rolling(camera) else []
        return np.r_[layout.pose(camera), shift, lens, np.array(delay, dtype=int), target]

    def _add_target_prior(self, equations: BlockArrow, state: RigState) -> BlockArrow:
        """Points are likely near where they are stated to be."""
        if not self.layout.offsets:
            return equations
        stop = self.layout.size
        rows = slice(stop - 3 * self.layout.offsets, stop)
        information = 1.0 / self.geometry.offset_sigma**2
        offsets = state.target.offsets.ravel()
        corner = equations.corner.at[rows, rows].add(information * jnp.eye(3 * self.layout.offsets))
        gradient = equations.gradient_shared.at[rows].add(information * offsets)
        cost = equations.cost + 0.5 * information * jnp.sum(offsets**2)
        return eqx.tree_at(lambda e: (e.corner, e.gradient_shared, e.cost), equations, (corner, gradient, cost))

    def _whitened_lens_error(self, state: RigState, group: int) -> Array:
        error = state.lenses[group] - self.prior.mean[group]
        information = self.prior.information[group]
        # A zero information matrix (no prior) has the zero matrix as its root.
        values, vectors = jnp.linalg.eigh(information)
        root = jnp.sqrt(jnp.maximum(values, 0.0))[:, :, None] * vectors.swapaxes(-1, -2)
        return jnp.einsum("cij,cj->ci", root, error)

    def _add_lens_prior(self, equations: BlockArrow, state: RigState) -> BlockArrow:
        corner, gradient, cost = equations.corner, equations.gradient_shared, equations.cost
        for group, members in enumerate(self.layout.groups):
            error = state.lenses[group] - self.prior.mean[group]
            information = self.prior.information[group]
            force = jnp.einsum("cij,cj->ci", information, error)
            cost = cost + 0.5 * jnp.sum(error * force)
            columns = self.basis[group]
            if columns is not None:
                information = columns.swapaxes(-1, -2) @ information @ columns
                force = jnp.einsum("cij,ci->cj", columns, force)
            for place, camera in enumerate(members):
                rows = self.layout.lens(camera)
                corner = corner.at[rows, rows].add(information[place])
                gradient = gradient.at[rows].add(force[place])
        return eqx.tree_at(lambda e: (e.corner, e.gradient_shared, e.cost), equations, (corner, gradient, cost))


@stored_jit
def corner_errors(problem: RigProblem, state: RigState) -> tuple:
    """Projection minus measurement, px, per group."""
    return problem.corner_errors(state)


@stored_jit
def camera_poses(problem: RigProblem, state: RigState) -> tuple:
    """T_cam_target (F, 4, 4) of every frame, per group."""
    return problem.camera_poses(state)
