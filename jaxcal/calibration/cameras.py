"""`calibrate_cameras`: intrinsics and extrinsics of any number of cameras from views of a target."""

from collections.abc import Sequence

import numpy as np

from jaxcal.calibration import extrinsics, solving
from jaxcal.calibration.assemble import camera_frames
from jaxcal.calibration.checks import resolve_models, resolve_names
from jaxcal.calibration.initial_lens import board_poses, initial_lens
from jaxcal.calibration.outcome import calibration_from, chain_covariance_and_sentences
from jaxcal.calibration.robust import robust_fit
from jaxcal.cameras import CameraModel, model_name
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
    max_steps: int = 100,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate cameras jointly from their views of a target; no initial guess is needed.

    `detections` one per camera; `models` names or classes (default 'pinhole-radtan' for all); `sync_tolerance_s`:
    frames of different cameras closer in time than this are one view of the rig. The corner noise of each camera is
    estimated from its residuals, and corners that disagree by more than 4.5 sigma are left out.

    Raises CalibrationError when a camera has too few views, when no focal length explains them, or when cameras never
    saw the board together.
    """
    classes = resolve_models(detections, models)
    names = resolve_names(detections, names)
    cameras = [camera_frames(d, target, name) for d, name in zip(detections, names, strict=True)]
    work = list(zip(names, classes, cameras, strict=True))
    lenses = [initial_lens(n, m, f, target) for n, m, f in track(work, "initial lenses", len(work), progress)]

    tolerance_ns = round(sync_tolerance_s * 1e9)
    views, view_times = extrinsics.associate(cameras, tolerance_ns)
    found = [board_poses(lens, frames, target) for lens, frames in zip(lenses, cameras, strict=True)]
    poses = [(rotation, translation) for rotation, translation, _ in found]
    T_cam_rig = extrinsics.chain_cameras(names, views, poses, tolerance_ns)
    T_target_rig = extrinsics.rig_poses(views, len(view_times), T_cam_rig, poses, [error for *_, error in found])

    problem, state = solving.camera_problem(
        lenses,
        cameras,
        target,
        views=views,
        weights=[np.ones(frames.seen.shape) for frames in cameras],
        T_cam_rig=T_cam_rig,
        T_target_rig=T_target_rig,
        loss_width=1.0,
    )
    usable = [np.ones(len(frames.frames), dtype=bool) for frames in cameras]
    fit = robust_fit(
        problem,
        state,
        cameras,
        usable,
        first_sigmas=[1.0] * len(cameras),
        pose_parameters=_pose_parameters(views, len(view_times)),
        max_steps=max_steps,
        progress=progress,
    )
    num_intrinsics = [cls.num_intrinsics for cls in classes]
    covariance, _, sentences = chain_covariance_and_sentences(fit, names, num_intrinsics)
    settings = {
        "job": "calibrate_cameras",
        "models": [model_name(cls) for cls in classes],
        "sync_tolerance_s": sync_tolerance_s,
        "max_steps": max_steps,
    }
    return calibration_from(
        fit, names, cameras, usable, target, covariance=covariance, imu=None, warnings=sentences, settings=settings
    )


def _pose_parameters(views: Sequence[np.ndarray], count: int) -> list[float]:
    """Pose parameters per camera: a view's six, shared among the cameras that see it."""
    cameras_per_view = np.bincount(np.concatenate(views), minlength=count)
    return [float(np.sum(6.0 / cameras_per_view[view])) for view in views]
