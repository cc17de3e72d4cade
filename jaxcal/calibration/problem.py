"""The calibration of a rig as one block-arrow least-squares problem, with or without IMU."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxcal.calibration import inertial, vision
from jaxcal.calibration.inertial import InertialData
from jaxcal.calibration.state import RigState, SharedLayout
from jaxcal.calibration.vision import FrameEquations, FramePoses, VisionData
from jaxcal.cameras import CameraModel
from jaxcal.estimation import BlockArrow, band_from_windows, chain_from_windows


class LensPrior(eqx.Module):
    """What is known of the lenses beforehand, per group: `mean` (C_g, n) and `information` (C_g, n, n)."""

    mean: tuple[Float[Array, "_ _"], ...]
    information: tuple[Float[Array, "_ _ _"], ...]


class RigProblem(eqx.Module):
    """Corners of all cameras, and IMU samples where there are any, on one trajectory of the rig.

    Without `imu` the chain holds one pose per view (band width zero); with it, spline control points and biases.
    `free_chain` (B,) and `free` (P,) say which coordinates are estimated; the others are held. `huber_width` is in
    sigmas of a corner; infinity for plain least squares.
    """

    templates: tuple[CameraModel, ...]
    corners: tuple[VisionData, ...]
    imu: InertialData | None
    prior: LensPrior
    free_chain: Bool[Array, "K B"]
    free: Bool[Array, " P"]
    huber_width: Float[Array, ""]
    layout: SharedLayout = eqx.field(static=True)
    order: int = eqx.field(static=True)

    # --- the engine's protocol ---------------------------------------------------------------------------------------

    def linearise(self, state: RigState) -> BlockArrow:
        """Cost and normal equations at `state`."""
        equations = self._vision(state)
        if self.imu is not None:
            equations = _add_imu(equations, state, self.imu, self.order, self.layout)
        equations = self._add_lens_prior(equations, state)
        return equations.hold(self.free_chain, self.free)

    def retract(self, state: RigState, chain: Float[Array, "K B"], shared: Float[Array, " P"]) -> RigState:
        """Move along a tangent step."""
        return state.retract(self.layout, chain, shared)

    def residuals(self, state: RigState) -> Float[Array, " R"]:
        """All whitened residuals (without the robust loss), as one vector."""
        parts = []
        for group, data in enumerate(self.corners):
            errors = vision.frame_residuals(self.templates[group], state, data, self.poses(state, data), group)
            parts.append(jnp.ravel(errors * jnp.sqrt(data.weight)[..., None]))
            parts.append(jnp.ravel(self._whitened_lens_error(state, group)))
        if self.imu is not None:
            parts.append(jnp.ravel(inertial.imu_residuals(state, self.imu, self.order)))
            parts.append(inertial.prior_residuals(state, self.imu))
        return jnp.concatenate(parts)

    # --- parts -------------------------------------------------------------------------------------------------------

    def poses(self, state: RigState, data: VisionData) -> FramePoses:
        """T_target_rig at every frame."""
        if self.imu is None:
            return vision.view_poses(state, data)
        return vision.spline_poses(state, data, self.imu.start, self.imu.dt, self.order)

    def corner_errors(self, state: RigState) -> tuple[Float[Array, "_ N 2"], ...]:
        """Projection minus measurement of every corner, px, per group."""
        return tuple(
            vision.frame_residuals(self.templates[g], state, data, self.poses(state, data), g)
            for g, data in enumerate(self.corners)
        )

    def _vision(self, state: RigState) -> BlockArrow:
        intervals = state.positions.shape[0] - self.order + 1
        size = self.free_chain.shape[1]
        window = jnp.zeros((intervals, self.order, 6, self.order, 6))
        gradient_window = jnp.zeros((intervals, self.order, 6))
        borders: dict[int, Array] = {}
        corners: dict[int, Array] = {}
        gradients: dict[int, Array] = {}
        cost = jnp.zeros(())
        for group, data in enumerate(self.corners):
            poses = self.poses(state, data)
            frames = vision.linearise_frames(self.templates[group], state, data, poses, group, self.huber_width)
            window = window.at[poses.start].add(frames.window)
            gradient_window = gradient_window.at[poses.start].add(frames.gradient_window)
            cost = cost + jnp.sum(frames.cost)
            members = self.layout.groups[group]
            by_camera = _sum_by_camera(frames, data, poses, intervals, len(members))
            for place, camera in enumerate(members):
                borders[camera], corners[camera], gradients[camera] = (part[place] for part in by_camera)

        cameras = range(self.layout.num_cameras)
        padding = [(0, 0), (0, 0), (0, size - 6)]
        border = jnp.concatenate([borders[c] for c in cameras], axis=-1)
        return BlockArrow(
            band=band_from_windows(jnp.pad(window, [*padding, (0, 0), (0, size - 6)])),
            border=jnp.pad(chain_from_windows(jnp.pad(border, [*padding, (0, 0)])), [(0, 0), (0, 0), (0, 2)]),
            corner=jax.scipy.linalg.block_diag(*[corners[c] for c in cameras], jnp.zeros((2, 2))),
            gradient_chain=chain_from_windows(jnp.pad(gradient_window, padding)),
            gradient_shared=jnp.concatenate([*[gradients[c] for c in cameras], jnp.zeros(2)]),
            cost=cost,
        )

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
            force = jnp.einsum("cij,cj->ci", self.prior.information[group], error)
            cost = cost + 0.5 * jnp.sum(error * force)
            for place, camera in enumerate(members):
                rows = self.layout.lens(camera)
                corner = corner.at[rows, rows].add(self.prior.information[group][place])
                gradient = gradient.at[rows].add(force[place])
        return eqx.tree_at(lambda e: (e.corner, e.gradient_shared, e.cost), equations, (corner, gradient, cost))


def _sum_by_camera(
    frames: FrameEquations, data: VisionData, poses: FramePoses, intervals: int, cameras: int
) -> tuple[Array, Array, Array]:
    """Border (C, I, k, 6, q), corner (C, q, q) and gradient (C, q) of each camera of a group."""
    order, q = frames.cross.shape[1], frames.cross.shape[-1]
    border = jnp.zeros((cameras, intervals, order, 6, q)).at[data.camera, poses.start].add(frames.cross)
    corner = jnp.zeros((cameras, q, q)).at[data.camera].add(frames.shared)
    gradient = jnp.zeros((cameras, q)).at[data.camera].add(frames.gradient_shared)
    return border, corner, gradient


def _add_imu(
    equations: BlockArrow, state: RigState, data: InertialData, order: int, layout: SharedLayout
) -> BlockArrow:
    samples = inertial.linearise_imu(state, data, order)
    prior = inertial.linearise_prior(state, data)
    width = equations.band.shape[1]
    band = equations.band + band_from_windows(samples.window)
    band = band.at[:, : min(3, width)].add(prior.band[:, : min(3, width)])
    gravity = layout.gravity
    return BlockArrow(
        band=band,
        border=equations.border.at[:, :, gravity].add(chain_from_windows(samples.cross)),
        corner=equations.corner.at[gravity, gravity].add(samples.shared),
        gradient_chain=equations.gradient_chain + chain_from_windows(samples.gradient_window) + prior.gradient,
        gradient_shared=equations.gradient_shared.at[gravity].add(samples.gradient_shared),
        cost=equations.cost + samples.cost + prior.cost,
    )
