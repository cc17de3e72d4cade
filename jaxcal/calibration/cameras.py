"""`calibrate_cameras`: intrinsics and extrinsics of any number of cameras from views of a target."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal.calibration import rig_graph, selection, solving
from jaxcal.calibration.assemble import CameraFrames, camera_frames
from jaxcal.calibration.board_checks import check_board
from jaxcal.calibration.board_turns import symmetry_sentences, unify_turns
from jaxcal.calibration.checks import resolve_models, resolve_names
from jaxcal.calibration.initial_lens import board_poses, initial_lens
from jaxcal.calibration.outcome import calibration_from, chain_covariance_and_sentences
from jaxcal.calibration.poses import Poses
from jaxcal.calibration.restart import confirm_optimum
from jaxcal.calibration.rig_graph import RigGraph, Sightings
from jaxcal.calibration.robust import robust_fit
from jaxcal.calibration.state import SharedLayout, layout_of
from jaxcal.calibration.views import associate, split_boards
from jaxcal.cameras import CameraModel, model_name
from jaxcal.errors import CalibrationError
from jaxcal.estimation import LOSSES, Loss
from jaxcal.observations import Detections
from jaxcal.progress import Progress, no_progress, track
from jaxcal.results import Calibration
from jaxcal.targets import Target


def calibrate_cameras(
    detections: Sequence[Detections],
    target: Target,
    models: Sequence[str | type[CameraModel]] | None = None,
    *,
    names: Sequence[str] | None = None,
    sync_tolerance_s: float = 0.002,
    views: int | None = None,
    board_warp: bool = False,
    point_offset_sigma_m: float | None = None,
    loss: Loss = "huber",
    max_steps: int = 100,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate cameras jointly from their views of a target; no initial guess is needed.

    `detections` one per camera; `models` names or classes (default 'pinhole-radtan' for all); `sync_tolerance_s`:
    frames of different cameras closer in time than this are one view of the rig. The target may be a `BoardSet`: the
    boards' mutual poses are found. Cameras that never see a board together are tied by the rig's motion where each
    sees a board of its own.

    `views`: use only that many views, chosen so that they tell most (`selection`). `board_warp` estimates how the
    board is bent (two numbers); `point_offset_sigma_m` lets every point of the target move, under a prior of that
    1-sigma in metres. `loss`: the robust loss under which outliers are found; they are left out of the final least
    squares. The corner noise of each camera is estimated from its residuals.

    Raises CalibrationError when a camera has too few views, when no lens explains them, or when nothing connects the
    cameras (it names them, and the recording that would).
    """
    classes = resolve_models(detections, models)
    names = resolve_names(detections, names)
    if loss not in LOSSES:
        raise CalibrationError(f"robust loss '{loss}' is unknown; known: {', '.join(LOSSES)}.")
    cameras = [camera_frames(d, target, name) for d, name in zip(detections, names, strict=True)]
    start = _start(names, classes, cameras, target, round(sync_tolerance_s * 1e9), progress)
    layout = layout_of(
        start.lenses,
        extra_boards=len(target.boards) - 1,
        warp=board_warp,
        offsets=len(target.points) if point_offset_sigma_m is not None else 0,
    )
    if views is not None:
        start = _select(start, target, layout, views)
    problem, state = _problem(start, target, layout, point_offset_sigma_m, loss)
    usable = [np.ones(len(frames.frames), dtype=bool) for frames in start.cameras]
    fit = robust_fit(
        problem,
        state,
        start.cameras,
        usable,
        first_sigmas=[1.0] * len(cameras),
        pose_parameters=_pose_parameters(start.views, len(start.T_target_rig[0])),
        max_steps=max_steps,
        progress=progress,
    )
    fit, restart = confirm_optimum(fit, start.cameras, max_steps=max_steps)
    covariance, _, sentences = chain_covariance_and_sentences(fit, names, start.lenses)
    settings = {
        "job": "calibrate_cameras",
        "models": [model_name(cls) for cls in classes],
        "sync_tolerance_s": sync_tolerance_s,
        "views": views,
        "board_warp": board_warp,
        "point_offset_sigma_m": point_offset_sigma_m,
        "loss": loss,
        "max_steps": max_steps,
    }
    return calibration_from(
        fit,
        names,
        start.cameras,
        usable,
        target,
        covariance=covariance,
        imu=None,
        warnings=[*start.sentences, *restart, *sentences],
        settings=settings,
        with_time=False,
    )


@dataclass(frozen=True)
class _Start:
    """What is known before the joint solve: frames, their views (V of them), first lenses and poses; and sentences."""

    lenses: list[CameraModel]
    cameras: list[CameraFrames]
    views: list[np.ndarray]
    graph: RigGraph
    T_target_rig: Poses
    sentences: list[str]


def _start(
    names: Sequence[str],
    classes: Sequence[type[CameraModel]],
    cameras: Sequence[CameraFrames],
    target: Target,
    tolerance_ns: int,
    progress: Progress,
) -> _Start:
    sentences = [s for name, frames in zip(names, cameras, strict=True) for s in check_board(name, frames, target)]
    boards = [split_boards(frames, target) for frames in cameras]
    work = list(zip(names, classes, boards, strict=True))
    lenses = [initial_lens(n, m, b.frames, target) for n, m, b in track(work, "initial lenses", len(work), progress)]
    views, times = associate(cameras, tolerance_ns)
    found = [board_poses(lens, b.frames, target) for lens, b in zip(lenses, boards, strict=True)]
    poses = [(rotation, translation) for rotation, translation, _ in found]
    if len(target.turns) > 1:
        unified = unify_turns(names, cameras, views, poses, target)
        cameras, poses = unified.cameras, unified.poses
        sentences += [*symmetry_sentences(target, len(names)), *unified.sentences]
    sightings = [
        Sightings(view[b.row], b.board, pose, error)
        for view, b, pose, (*_, error) in zip(views, boards, poses, found, strict=True)
    ]
    graph = rig_graph.solve_graph(names, sightings, len(target.boards), tolerance_ns)
    T_target_rig = rig_graph.rig_poses(graph, sightings, len(times))
    return _Start(lenses, list(cameras), views, graph, T_target_rig, sentences)


def _problem(start: _Start, target: Target, layout: SharedLayout, offset_sigma_m: float | None, loss: Loss):
    boards = start.graph.T_target_board
    return solving.camera_problem(
        start.lenses,
        start.cameras,
        target,
        views=start.views,
        weights=[np.ones(frames.seen.shape) for frames in start.cameras],
        T_cam_rig=start.graph.T_cam_rig,
        T_target_rig=start.T_target_rig,
        loss_width=1.0,
        layout=layout,
        boards=(boards[0][1:], boards[1][1:]),
        offset_sigma_m=offset_sigma_m,
        loss=loss,
    )


def _select(start: _Start, target: Target, layout: SharedLayout, count: int) -> _Start:
    """The same start with the `count` views that tell most."""
    if count < 3:
        raise CalibrationError(f"views={count}: a calibration needs 3 views at least; 20 or more make a good one.")
    problem, state = _problem(start, target, layout, 1e-3 if layout.offsets else None, "huber")
    chosen = selection.most_informative_views(problem, state, count)
    number = np.full(len(start.T_target_rig[0]), -1)
    number[chosen] = np.arange(len(chosen))
    kept = [number[view] >= 0 for view in start.views]
    return _Start(
        start.lenses,
        [frames.take(np.flatnonzero(k)) for frames, k in zip(start.cameras, kept, strict=True)],
        [number[view[k]] for view, k in zip(start.views, kept, strict=True)],
        start.graph,
        (start.T_target_rig[0][chosen], start.T_target_rig[1][chosen]),
        start.sentences,
    )


def _pose_parameters(views: Sequence[np.ndarray], count: int) -> list[float]:
    """Pose parameters per camera: a view's six, shared among the cameras that see it."""
    cameras_per_view = np.bincount(np.concatenate(views), minlength=count)
    return [float(np.sum(6.0 / cameras_per_view[view])) for view in views]
