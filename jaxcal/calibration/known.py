"""A calibration's problem again, at its optimum: for studies that solve it many times with other corners or weights."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np

from jaxcal.calibration import solving
from jaxcal.calibration.assemble import CameraFrames, camera_frames, split_groups, stack_groups, stack_weights
from jaxcal.calibration.held_back import known_graph, known_target
from jaxcal.calibration.lens_basis import told_apart
from jaxcal.calibration.poses import Poses
from jaxcal.calibration.problem import RigProblem, corner_errors
from jaxcal.calibration.redundancy import measure_redundancy
from jaxcal.calibration.state import RigState, SharedLayout, layout_of
from jaxcal.calibration.target_shape import geometry_of
from jaxcal.calibration.view_noise import weigh_views
from jaxcal.calibration.views import associate
from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.estimation import SolveResult, on_device, solve
from jaxcal.results import Calibration


@dataclass(frozen=True)
class KnownProblem:
    """Plain least squares over the corners that a calibration kept, from its solution.

    `views[c]` (F,) is the view of each frame of camera c, `times_s` (V,) their times since the first; `kept[c]` (F, N)
    marks the corners that take part, with `weights[c]` (F, N), px^-2, and `noise_px[c]` (F, N) of a coordinate.
    `inflation` is what the covariance of these weights is too small by (`redundancy`). `tied`: the cameras' poses among
    each other are estimated, from views that they share; else each frame is a view of its own and those poses are held.
    """

    calibration: Calibration
    cameras: list[CameraFrames]
    views: list[np.ndarray]
    times_s: np.ndarray
    kept: list[np.ndarray]
    weights: list[np.ndarray]
    noise_px: list[np.ndarray]
    inflation: float
    tied: bool
    problem: RigProblem
    state: RigState

    @property
    def layout(self) -> SharedLayout:
        """Where each camera's parameters stand among the shared coordinates."""
        return self.problem.layout

    @property
    def num_views(self) -> int:
        """How many poses of the rig there are."""
        return len(self.times_s)

    @property
    def free(self) -> np.ndarray:
        """(P,) the shared coordinates that are estimated."""
        return np.asarray(self.problem.free)

    @property
    def halved_alone(self) -> list[np.ndarray]:
        """Groups of views (V_g,) to be halved each by itself: all in one, or each camera's where views are one camera's
        own. Taken together, halves of two that see at the same instants might hold one camera each."""
        return [np.arange(self.num_views)] if self.tied else self.views

    def in_turns(self) -> np.ndarray:
        """(V,) every other view."""
        first = np.zeros(self.num_views, dtype=bool)
        for own in self.halved_alone:
            first[own] = rank_of(self.times_s[own]) % 2 == 0
        return first

    def errors(self, state: RigState) -> list[np.ndarray]:
        """Projection minus measurement (F, N, 2), px, of each camera."""
        return split_groups(self.layout, self.cameras, [np.asarray(e) for e in corner_errors(self.problem, state)])

    def with_pixels(self, pixels: Sequence[np.ndarray]) -> "KnownProblem":
        """The problem with other corners (F, N, 2) per camera, at its optimum."""
        cameras = [
            dataclasses.replace(frames, pixels=values) for frames, values in zip(self.cameras, pixels, strict=True)
        ]
        stacked = stack_groups(self.layout, [values.swapaxes(1, 2) for values in pixels])
        problem = eqx.tree_at(lambda p: [data.pixels for data in p.corners], self.problem, list(stacked))
        moved = dataclasses.replace(self, cameras=cameras, problem=problem)
        return dataclasses.replace(moved, state=moved.solve().state)

    def solve(self, of_view: np.ndarray | None = None, max_steps: int = 100) -> SolveResult:
        """The optimum, with the weight of every view (V,) multiplied by `of_view`; views of weight 0 are left out."""
        problem = self.problem if of_view is None else self.weighted(of_view)
        result = solve(problem, self.state, max_steps=max_steps)
        basis = told_apart(problem.basis, result.equations, self.free, self.layout)
        if all(columns is None for columns in basis):
            return result
        # Lenses whose parameters nearly cancel: once more, in coordinates in which they do not.
        problem = eqx.tree_at(lambda p: p.basis, problem, basis, is_leaf=lambda leaf: leaf is None)
        return solve(problem, result.state, max_steps=max_steps)

    def weighted(self, of_view: np.ndarray) -> RigProblem:
        """The problem with views weighted anew."""
        weights = [w * of_view[view][:, None] for w, view in zip(self.weights, self.views, strict=True)]
        taken = np.zeros(len(self.problem.free_chain), dtype=bool)
        taken[: self.num_views] = of_view > 0
        return eqx.tree_at(
            lambda p: [*[data.weight for data in p.corners], p.free_chain],
            self.problem,
            [*stack_weights(self.layout, self.cameras, weights), self.problem.free_chain & taken[:, None]],
        )


def known_problem(
    calibration: Calibration,
    *,
    models: Sequence[CameraModel] | None = None,
    board_warp: bool | None = None,
) -> KnownProblem:
    """The problem of a calibration of global-shutter cameras, from its own corners and solution.

    `models` are lenses to take the place of its own (their start), `board_warp` whether to estimate how the board is
    bent; by default all is as it was. Cameras with an IMU or on a spline have their poses to each other held: their
    frames are views by themselves.

    Raises CalibrationError when a camera has a rolling shutter or no poses (results of earlier releases).
    """
    for camera in calibration.cameras:
        if camera.line_delay_s is not None:
            raise CalibrationError(f"{camera.name}: a rolling shutter has no one pose per frame, which this needs.")
        if camera.T_cam_target is None:
            raise CalibrationError(f"{camera.name}: this result holds no poses of the board. Calibrate again.")
    target, names = calibration.target, [camera.name for camera in calibration.cameras]
    cameras = []
    for camera in calibration.cameras:
        frames = camera_frames(camera.detections, target, camera.name)
        dense = _dense(frames, camera.used)
        cameras.append(frames.take(np.flatnonzero(dense.any(axis=1) & _posed(frames, camera.T_cam_target))))
    kept = [_dense(f, camera.used) for f, camera in zip(cameras, calibration.cameras, strict=True)]
    tied = calibration.imu is None and not calibration.settings.get("time_offsets", False)
    views, times = _views(cameras, calibration, tied)
    shape = calibration.target_shape
    warp = (shape is not None and shape.warp_m is not None) if board_warp is None else board_warp
    lenses = [camera.model for camera in calibration.cameras] if models is None else list(models)
    layout = layout_of(
        lenses,
        extra_boards=len(target.boards) - 1,
        warp=warp,
        offsets=len(target.points) if shape is not None and shape.offsets_m is not None else 0,
    )
    weights, noises, inflation = _weights(calibration, cameras, kept)
    graph = known_graph(calibration)
    problem, state = solving.camera_problem(
        lenses,
        cameras,
        target,
        views=views,
        weights=weights,
        T_cam_rig=graph.T_cam_rig,
        T_target_rig=_rig_poses(calibration, cameras, views, len(times), graph.T_cam_rig),
        loss_width=np.inf,
        layout=layout,
        boards=(graph.T_target_board[0][1:], graph.T_target_board[1][1:]),
        offset_sigma_m=calibration.settings.get("point_offset_sigma_m"),
    )
    state = eqx.tree_at(lambda s: s.target, state, known_target(calibration, warp=warp))
    if not tied:
        free = np.array(problem.free)
        for c in range(len(names)):
            free[layout.pose(c)] = False
        problem = eqx.tree_at(lambda p: p.free, problem, on_device(free))
    since = (times - times.min()) * 1e-9
    return KnownProblem(calibration, cameras, views, since, kept, weights, noises, inflation, tied, problem, state)


def rank_of(values: np.ndarray) -> np.ndarray:
    """The place (n,) of each value among all, the first of equal ones first."""
    return np.argsort(np.argsort(values, kind="stable"), kind="stable")


def _dense(frames: CameraFrames, per_corner: np.ndarray) -> np.ndarray:
    """(F, N) from one flag per corner of the detections."""
    detections = frames.detections
    dense = np.zeros((len(detections.timestamps_ns), frames.seen.shape[1]), dtype=bool)
    dense[detections.frame, detections.point] = per_corner
    return dense[frames.frames]


def _posed(frames: CameraFrames, T_cam_target: np.ndarray | None) -> np.ndarray:
    assert T_cam_target is not None
    return np.asarray(np.isfinite(T_cam_target[frames.frames]).all(axis=(1, 2)))


def _views(
    cameras: Sequence[CameraFrames], calibration: Calibration, tied: bool
) -> tuple[list[np.ndarray], np.ndarray]:
    if tied:
        return associate(cameras, round(float(calibration.settings.get("sync_tolerance_s", 0.002)) * 1e9))
    starts = np.cumsum([0, *(len(frames.frames) for frames in cameras)])
    views = [np.arange(len(frames.frames)) + start for frames, start in zip(cameras, starts[:-1], strict=True)]
    return views, np.concatenate([frames.time_ns for frames in cameras])


def _weights(
    calibration: Calibration, cameras: Sequence[CameraFrames], kept: Sequence[np.ndarray]
) -> tuple[list[np.ndarray], list[np.ndarray], float]:
    """1 / sigma^2 (F, N) of every corner kept, with views that repeat each other counting less, as there; the noise
    (F, N) of every corner, px; and by how much covariances are too small."""
    weights, noises, inflations = [], [], []
    places = np.asarray(geometry_of(calibration.target).across)
    for camera, frames, own in zip(calibration.cameras, cameras, kept, strict=True):
        whole = np.zeros((len(camera.detections.timestamps_ns), *own.shape[1:], 2))
        whole[camera.detections.frame, camera.detections.point] = np.nan_to_num(camera.residuals_px)
        errors = whole[frames.frames] * frames.precision[..., None]
        found = measure_redundancy(frames, errors, own, camera.corner_sigma_px)
        found, noise = weigh_views(frames, errors, own, places, found)
        of_view = noise[:, None]
        # The sigma that the result states is that of all views together.
        power = np.sum(errors[own] ** 2), np.sum((errors / of_view[..., None])[own] ** 2)
        usual = camera.corner_sigma_px * (np.sqrt(power[1] / power[0]) if power[0] > 0 else 1.0)
        noises.append(usual * of_view / frames.precision)
        weights.append(own * found.weights[:, None] / noises[-1] ** 2)
        inflations.append(found.inflation)
    return weights, noises, max(inflations)


def _rig_poses(
    calibration: Calibration,
    cameras: Sequence[CameraFrames],
    views: Sequence[np.ndarray],
    count: int,
    places: Poses,
) -> tuple[np.ndarray, np.ndarray]:
    """T_target_rig of every view, from the first camera that is in it."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for c in reversed(range(len(cameras))):
        T_cam_target = calibration.cameras[c].T_cam_target
        assert T_cam_target is not None
        T_cam_rig = np.eye(4)
        T_cam_rig[:3, :3], T_cam_rig[:3, 3] = places[0][c], places[1][c]
        poses[views[c]] = np.linalg.inv(T_cam_target[cameras[c].frames]) @ T_cam_rig
    return poses[:, :3, :3], poses[:, :3, 3]
