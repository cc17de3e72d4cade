"""`calibrate_cameras`: intrinsics and extrinsics of any number of cameras from views of a target."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal.calibration.assemble import CameraFrames, camera_frames
from jaxcal.calibration.board_checks import check_board
from jaxcal.calibration.checks import resolve_models, resolve_names
from jaxcal.calibration.initial_lens import initial_lens_and_rivals
from jaxcal.calibration.lens_poses import board_poses
from jaxcal.calibration.outcome import calibration_from, chain_covariance_and_sentences
from jaxcal.calibration.poses import Poses
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.restart import confirm_optimum
from jaxcal.calibration.robust import RobustFit, robust_fit
from jaxcal.calibration.rolling import shutters_of
from jaxcal.calibration.selection import most_informative_views
from jaxcal.calibration.state import RigState, SharedLayout, layout_of
from jaxcal.calibration.synchronous import Synchronous, joined_by_others, tie_cameras
from jaxcal.calibration.uncertainty import stamp_sigmas_of, with_common_delay
from jaxcal.calibration.views import BoardFrames, split_boards
from jaxcal.cameras import CameraModel, model_name
from jaxcal.errors import CalibrationError
from jaxcal.estimation import LOSSES, Loss
from jaxcal.observations import Detections
from jaxcal.progress import Progress, no_progress, track
from jaxcal.results import Calibration
from jaxcal.targets import Target

_FEWEST_VIEWS = 3  # of a camera


def calibrate_cameras(
    detections: Sequence[Detections],
    target: Target,
    models: Sequence[str | type[CameraModel]] | None = None,
    *,
    names: Sequence[str] | None = None,
    sync_tolerance_s: float = 0.002,
    time_offsets: bool = False,
    rolling_shutter: bool | Sequence[bool] = False,
    views: int | None = None,
    board_warp: bool = False,
    point_offset_sigma_m: float | None = None,
    loss: Loss = "huber",
    stamp_sigma_s: float | Sequence[float] = 0.0,
    max_steps: int = 300,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate cameras jointly from their views of a target; no initial guess is needed.

    `detections` one per camera; `models` names or classes (default 'pinhole-radtan' for all); `sync_tolerance_s`:
    frames of different cameras closer in time than this are one view of the rig. The target may be a `BoardSet`: the
    boards' mutual poses are found. Cameras that never see a board together are tied by the rig's motion where each
    sees a board of its own.

    `time_offsets`: for cameras that are not synchronised (video of a moving rig or board): no frames need coincide; the
    rig moves on a continuous-time spline and a time offset is estimated for each camera (`timeshift_cam_cam0`).
    `rolling_shutter`, for all cameras or one each: video of a camera whose rows are seen one after another; the delay
    of a row is estimated on the spline as well (and the offsets with it), a frame's time is that of its first row.
    `views`: the optimum and the outliers are looked for with that many views alone, chosen so that they tell most
    (`selection`), and the others join once it is found: quicker for long recordings, and as precise. `board_warp`
    estimates how the board is bent (two numbers); `point_offset_sigma_m` lets every point of the target move, under a
    prior of that 1-sigma in metres. `loss`: the robust loss under which outliers are found; they are left out of the
    final least squares. `stamp_sigma_s`: as for `calibrate_camera_imu`, for the sigmas of `time_offsets`. The corner
    noise of each camera is estimated from its residuals. The optimum is confirmed by a restart from ten sigmas away.

    Raises CalibrationError when a camera has too few views, when no lens explains them, or when nothing connects the
    cameras (it names them, and the recording that would).
    """
    classes = resolve_models(detections, models)
    names = resolve_names(detections, names)
    shutters = shutters_of(rolling_shutter, len(detections))
    time_offsets = time_offsets or any(shutters)
    stamp_sigmas = stamp_sigmas_of(stamp_sigma_s, len(detections))
    _check_options(target, time_offsets, views, loss)
    cameras = [camera_frames(d, target, name) for d, name in zip(detections, names, strict=True)]
    look = _first_look(names, classes, cameras, target, progress)
    layout = layout_of(
        look.lenses,
        extra_boards=len(target.boards) - 1,
        warp=board_warp,
        offsets=len(target.points) if point_offset_sigma_m is not None else 0,
        rolling=shutters,
    )
    shape = _Shape(layout, point_offset_sigma_m, loss)
    search = _Search(look.rivals, max_steps, progress)
    if time_offsets:
        joint = _continuous(names, look, target, shape)
        fit, restart = search.optimum(joint)
    else:
        tied, sentences = _tied(names, look, target, shape, round(sync_tolerance_s * 1e9))
        joint = _of_views(tied, sentences)
        fit, restart = search.optimum(joint) if views is None else search.by_few(tied, joint, views)
    covariance, _, sentences = chain_covariance_and_sentences(fit, names, look.lenses, joint.cameras)
    settings = {
        "job": "calibrate_cameras",
        "models": [model_name(cls) for cls in classes],
        "sync_tolerance_s": sync_tolerance_s,
        "time_offsets": time_offsets,
        "rolling_shutter": shutters,
        "views": views,
        "board_warp": board_warp,
        "point_offset_sigma_m": point_offset_sigma_m,
        "loss": loss,
        "stamp_sigma_s": stamp_sigmas,
        "max_steps": max_steps,
    }
    return calibration_from(
        fit,
        names,
        joint.cameras,
        joint.usable,
        target,
        covariance=with_common_delay(covariance, layout, stamp_sigmas, to_first_camera=True),
        warnings=[*look.sentences, *joint.sentences, *restart, *sentences],
        settings=settings,
        with_time=time_offsets,
    )


def _check_options(target: Target, time_offsets: bool, views: int | None, loss: str) -> None:
    if loss not in LOSSES:
        raise CalibrationError(f"robust loss '{loss}' is unknown; known: {', '.join(LOSSES)}.")
    if views is not None and views < _FEWEST_VIEWS:
        raise CalibrationError(
            f"views={views}: a calibration needs {_FEWEST_VIEWS} views at least; 20 or more make a good one."
        )
    if time_offsets and views is not None:
        raise CalibrationError("time_offsets and views: a trajectory needs all frames. Leave `views` out.")
    if time_offsets and len(target.boards) > 1:
        raise CalibrationError(
            "time_offsets with several boards: not supported. Use one board, or synchronised cameras with all boards."
        )


@dataclass(frozen=True)
class _Look:
    """Each camera by itself: first lens and its rivals, board poses T_cam_board with their errors, px; and
    sentences."""

    lenses: list[CameraModel]
    rivals: list[tuple[CameraModel, ...]]
    cameras: list[CameraFrames]
    boards: list[BoardFrames]
    poses: list[Poses]
    errors: list[np.ndarray]
    sentences: list[str]


@dataclass(frozen=True)
class _Shape:
    """What is estimated of the target, and the robust loss."""

    layout: SharedLayout
    offset_sigma_m: float | None
    loss: Loss


@dataclass(frozen=True)
class _Joint:
    """The joint problem with its start; frames that take part; sentences about how the cameras were tied."""

    problem: RigProblem
    state: RigState
    cameras: list[CameraFrames]
    usable: list[np.ndarray]
    pose_parameters: list[float]
    sentences: list[str]


def _first_look(
    names: Sequence[str],
    classes: Sequence[type[CameraModel]],
    cameras: Sequence[CameraFrames],
    target: Target,
    progress: Progress,
) -> _Look:
    sentences = [s for name, frames in zip(names, cameras, strict=True) for s in check_board(name, frames, target)]
    boards = [split_boards(frames, target) for frames in cameras]
    work = list(zip(names, classes, boards, strict=True))
    tracked = track(work, "initial lenses", len(work), progress)
    firsts = [initial_lens_and_rivals(n, m, b.frames, target) for n, m, b in tracked]
    lenses = [first.lens for first in firsts]
    found = [board_poses(lens, b.frames, target) for lens, b in zip(lenses, boards, strict=True)]
    poses = [(rotation, translation) for rotation, translation, _ in found]
    rivals = [first.rivals for first in firsts]
    return _Look(lenses, rivals, list(cameras), boards, poses, [error for *_, error in found], sentences)


@dataclass(frozen=True)
class _Search:
    """How the optimum is looked for."""

    rivals: Sequence[Sequence[CameraModel]]
    max_steps: int
    progress: Progress

    def optimum(self, joint: _Joint) -> tuple[RobustFit, list[str]]:
        """The optimum from a first start, confirmed by restarts; and sentences about these."""
        fit = self._robust_fit(joint, joint.state, [1.0] * len(joint.cameras), near=False)
        return confirm_optimum(fit, joint.cameras, self.rivals, max_steps=self.max_steps)

    def by_few(self, tied: Synchronous, joint: _Joint, count: int) -> tuple[RobustFit, list[str]]:
        """The optimum of all views from that of the `count` views that tell most; straight from all where so few
        views do not make a calibration of every camera."""
        chosen = most_informative_views(joint.problem, joint.state, count)
        part = tied.take(chosen)
        if len(chosen) == tied.count or min(len(frames.frames) for frames in part.cameras) < _FEWEST_VIEWS:
            return self.optimum(joint)
        few, sentences = self.optimum(_of_views(part, []))
        state = joined_by_others(tied, joint.problem, joint.state, chosen, few, self.max_steps)
        return self._robust_fit(joint, state, few.sigmas, near=True), sentences

    def _robust_fit(self, joint: _Joint, state: RigState, sigmas: Sequence[float], near: bool) -> RobustFit:
        return robust_fit(
            joint.problem,
            state,
            joint.cameras,
            joint.usable,
            first_sigmas=sigmas,
            pose_parameters=joint.pose_parameters,
            max_steps=self.max_steps,
            progress=self.progress,
            near=near,
        )


def _tied(
    names: Sequence[str], look: _Look, target: Target, shape: _Shape, tolerance_ns: int
) -> tuple[Synchronous, list[str]]:
    return tie_cameras(
        names,
        look.lenses,
        look.cameras,
        look.boards,
        look.poses,
        look.errors,
        target,
        tolerance_ns=tolerance_ns,
        layout=shape.layout,
        offset_sigma_m=shape.offset_sigma_m,
        loss=shape.loss,
    )


def _of_views(tied: Synchronous, sentences: Sequence[str]) -> _Joint:
    problem, state = tied.problem()
    return _Joint(problem, state, list(tied.cameras), tied.usable(), tied.pose_parameters(), list(sentences))


def _continuous(names: Sequence[str], look: _Look, target: Target, shape: _Shape) -> _Joint:
    from jaxcal.calibration.unsynchronised import continuous_problem  # brings scipy.interpolate: 0.1 s, seldom needed

    start = continuous_problem(
        names,
        look.lenses,
        look.cameras,
        look.poses,
        look.errors,
        target,
        shape.layout,
        offset_sigma_m=shape.offset_sigma_m,
        loss=shape.loss,
    )
    parameters = start.pose_parameters(len(names))
    return _Joint(start.problem, start.state, look.cameras, start.usable, parameters, [])
