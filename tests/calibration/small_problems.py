"""Small calibration problems in random states near consistency, for comparison with dense linear algebra."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal import Checkerboard, Detections, ImuNoise
from jaxcal.calibration import solving
from jaxcal.calibration.assemble import CameraFrames, camera_frames, vision_data
from jaxcal.calibration.extra_imus import places_of
from jaxcal.calibration.inertial import InertialData
from jaxcal.calibration.lens_basis import own_parameters
from jaxcal.calibration.problem import LensPrior, RigProblem
from jaxcal.calibration.spline_setup import bin_imu, make_grid
from jaxcal.calibration.state import RigState, TargetState, block_count, flat_target, free_blocks, layout_of
from jaxcal.calibration.target_shape import geometry_of
from jaxcal.cameras import CameraModel, PinholeEquidistant, PinholeRadtan
from jaxcal.imu import imu_model

BOARD = Checkerboard(rows=3, cols=4, spacing=0.1)
SIZE = (640, 480)
# The equal models are not neighbours, so that the order of groups differs from that of cameras.
LENSES: tuple[CameraModel, ...] = (
    PinholeRadtan.create([430.0, 433.0, 321.0, 238.0], [-0.30, 0.10, 0.0007, -0.0005]),
    PinholeEquidistant.create([380.0, 378.0, 316.0, 243.0], [0.02, -0.01, 0.004, -0.001]),
    PinholeRadtan.create([445.0, 441.0, 325.0, 235.0], [-0.28, 0.08, -0.0004, 0.0003]),
)
CAMERAS = len(LENSES)


def near(rng: np.random.Generator, rotation: np.ndarray, angle: float) -> np.ndarray:
    """A rotation (3, 3) some `angle` (rad) away."""
    return Rotation.from_rotvec(angle * rng.standard_normal(3)).as_matrix() @ rotation


def random_frames(rng: np.random.Generator, count: int, missing: float) -> list[CameraFrames]:
    """`count` frames per camera with corners anywhere in the image; the residuals need not be small."""
    cameras = []
    for c in range(CAMERAS):
        seen = rng.random((count, len(BOARD.points))) >= missing
        seen[:, :4] |= seen.sum(axis=1, keepdims=True) < 4  # or the frame would be none
        frame, point = np.nonzero(seen)
        pixels = rng.uniform(100.0, 380.0, (len(frame), 2))
        detections = Detections(1000 * np.arange(count), frame, point, pixels, SIZE)
        cameras.append(camera_frames(detections, BOARD, f"cam{c}", min_corners=4))
    return cameras


def random_weights(rng: np.random.Generator, cameras: Sequence[CameraFrames]) -> list[np.ndarray]:
    return [rng.uniform(0.5, 4.0, frames.seen.shape) for frames in cameras]


def random_prior(rng: np.random.Generator, problem: RigProblem, state: RigState) -> RigProblem:
    """The problem with a lens prior of full information matrices, whose means differ from the state's lenses."""
    means, informations = [], []
    for lenses in state.lenses:
        root = rng.standard_normal((*lenses.shape, lenses.shape[1]))
        informations.append(jnp.asarray(root @ root.swapaxes(-1, -2)))
        means.append(lenses + jnp.asarray(0.1 * rng.standard_normal(lenses.shape)))
    return eqx.tree_at(lambda p: p.prior, problem, LensPrior(tuple(means), tuple(informations)))


def facing_board(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """T_target_rig of `count` poses about a metre before the board."""
    rotations = np.stack([near(rng, np.diag([1.0, -1.0, -1.0]), 0.2) for _ in range(count)])
    positions = np.array([0.15, 0.1, 1.0]) + 0.1 * rng.standard_normal((count, 3))
    return rotations, positions


def extrinsics(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    rotations = np.stack([near(rng, np.eye(3), 0.1) for _ in range(CAMERAS)])
    return rotations, 0.1 * rng.standard_normal((CAMERAS, 3))


def camera_only(seed: int) -> tuple[RigProblem, RigState]:
    """Five views, not every one seen by every camera; cam0's pose, time shifts and gravity are held."""
    rng = np.random.default_rng(seed)
    cameras = random_frames(rng, 4, missing=0.2)
    problem, state = solving.camera_problem(
        LENSES,
        cameras,
        BOARD,
        views=[np.array([0, 1, 2, 3]), np.array([1, 2, 3, 4]), np.array([0, 2, 3, 4])],
        weights=random_weights(rng, cameras),
        T_cam_rig=extrinsics(rng),
        T_target_rig=facing_board(rng, 5),
        loss_width=np.inf,
    )
    return random_prior(rng, problem, state), state


def with_unknown_target(seed: int) -> tuple[RigProblem, RigState]:
    """As `camera_only`, the target being two boards at an unknown mutual pose, bent, with every point off its place."""
    rng = np.random.default_rng(seed)
    problem, state = camera_only(seed)
    count = len(BOARD.points)
    layout = layout_of(list(LENSES), extra_boards=1, warp=True, offsets=count)
    free = np.concatenate([np.asarray(problem.free), np.ones(layout.target_size, dtype=bool)])
    target = TargetState(
        R_target_board=jnp.asarray(near(rng, np.eye(3), 0.2)[None]),
        t_target_board=jnp.asarray(0.1 * rng.standard_normal((1, 3))),
        warp=jnp.asarray(0.02 * rng.standard_normal(2)),
        offsets=jnp.asarray(0.002 * rng.standard_normal((count, 3))),
    )
    geometry = eqx.tree_at(lambda g: g.board, geometry_of(BOARD), jnp.arange(count) % 2)
    problem = eqx.tree_at(lambda p: (p.geometry, p.free), problem, (geometry, jnp.asarray(free)))
    problem = dataclasses.replace(problem, layout=layout)
    return problem, dataclasses.replace(state, target=target)


def with_imu(
    seed: int, order: int, models: Sequence[str] = ("calibrated",), gravity_size: int = 2, rolling: bool = False
) -> tuple[RigProblem, RigState]:
    """A spline of one second (20 knots) with samples of an IMU of each model and unsynchronised frames; everything is
    free."""
    rng = np.random.default_rng(seed)
    grid = make_grid(0.0, 1.0, order, 20.0)
    cameras = random_frames(rng, 4, missing=0.2)
    samples = []
    for shift in 0.03 * np.arange(len(models)):
        time = (np.arange(60) + rng.random(60)) / 60.0 * (1.0 - shift)
        gyro = rng.standard_normal((60, 3))
        accel = np.array([0.0, -9.8, 0.0]) + rng.standard_normal((60, 3))
        noise = ImuNoise(0.01, 0.02, 0.05, 0.1, update_rate=60.0)
        samples.append(bin_imu(grid, time, gyro, accel, noise, 60.0, shift).samples)
    shutters = [rolling and c == 0 for c in range(CAMERAS)]
    layout = layout_of(list(LENSES), imus=places_of(models), gravity_size=gravity_size, rolling=shutters)
    count = grid.intervals + order - 1
    problem = RigProblem(
        templates=solving.templates_of(LENSES, layout),
        corners=vision_data(
            layout,
            cameras,
            weights=random_weights(rng, cameras),
            times=[np.sort(rng.uniform(0.05, 0.95, len(frames.frames))) for frames in cameras],
        ),
        geometry=geometry_of(BOARD),
        imu=InertialData(tuple(samples), jnp.asarray(grid.start), jnp.asarray(grid.dt)),
        prior=solving.lens_prior(LENSES, layout, cameras),
        free_chain=jnp.asarray(free_blocks(count, order, len(models))),
        free=jnp.ones(layout.size, dtype=bool),
        loss_width=jnp.asarray(jnp.inf),
        basis=own_parameters(LENSES, layout),
        layout=layout,
        order=order,
        row_intervals=3,
    )
    turns = Rotation.from_rotvec(np.cumsum(0.1 * rng.standard_normal((count, 3)), axis=0)).as_matrix()
    R_cam_rig, t_cam_rig = extrinsics(rng)
    state = RigState(
        lenses=solving.stack_lenses(LENSES, layout),
        R_cam_rig=jnp.asarray(R_cam_rig),
        t_cam_rig=jnp.asarray(t_cam_rig),
        shift=jnp.asarray(rng.uniform(-0.02, 0.02, CAMERAS)),
        gravity=jnp.asarray([0.3, -9.7, 1.1]),
        rotations=jnp.asarray(np.diag([1.0, -1.0, -1.0]) @ turns),
        positions=jnp.asarray(np.array([0.15, 0.1, 1.0]) + 0.05 * rng.standard_normal((count, 3))),
        biases=jnp.asarray(0.1 * rng.standard_normal((block_count(count, order), 6 * len(models)))),
        target=flat_target(layout),
        imu_parameters=tuple(
            jnp.asarray(np.array(imu_model(name).nominal) + 0.1 * rng.standard_normal(imu_model(name).size))
            for name in models
        ),
        R_imu_rig=jnp.asarray(Rotation.random(len(models), rng).as_matrix()).at[0].set(jnp.eye(3)),
        t_imu_rig=jnp.asarray(0.1 * rng.standard_normal((len(models), 3))).at[0].set(0.0),
        imu_shift=jnp.asarray(0.03 * np.arange(len(models)) * 1.02),
        line_delay=jnp.asarray([1e-4 * s for s in shutters]) if rolling else jnp.zeros(0),
    )
    return random_prior(rng, problem, state), state
