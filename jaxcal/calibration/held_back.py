"""A calibration on views that it was not made from: all is held but where the target stood."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxcal.calibration import rig_graph, solving
from jaxcal.calibration.assemble import camera_frames, split_groups
from jaxcal.calibration.lens_poses import board_poses
from jaxcal.calibration.problem import corner_errors
from jaxcal.calibration.rig_graph import RigGraph, Sightings
from jaxcal.calibration.state import TargetState, layout_of
from jaxcal.calibration.views import associate, split_boards
from jaxcal.errors import CalibrationError
from jaxcal.estimation import on_device, solve
from jaxcal.observations import Detections
from jaxcal.results import Calibration

# Huber's width in sigmas of the calibration's own corner noise: a wrong corner must not turn a view.
_HUBER_SIGMAS = 2.5


def held_back_residuals(
    calibration: Calibration, detections: Sequence[Detections], *, sync_tolerance_s: float = 0.002, max_steps: int = 50
) -> list[np.ndarray]:
    """Projection minus measurement (M, 2), px, of new detections through a calibration, one array per camera.

    Lenses, the cameras' poses among each other and the target's shape are held; only the target's pose in each view
    is estimated (robustly). NaN where a frame has too few corners. That is what the calibration is worth on data it
    has not seen: a lens model with too many parameters is better than a leaner one on its own views, and worse here.

    Raises CalibrationError when the number of cameras differs, or a camera has hardly a usable frame.
    """
    names = [camera.name for camera in calibration.cameras]
    if len(detections) != len(names):
        raise CalibrationError(f"{len(detections)} cameras' detections for a calibration of {len(names)} cameras.")
    target, models = calibration.target, [camera.model for camera in calibration.cameras]
    frames = [camera_frames(d, target, name) for d, name in zip(detections, names, strict=True)]
    boards = [split_boards(f, target) for f in frames]
    views, times = associate(frames, round(sync_tolerance_s * 1e9))
    sightings = []
    for model, board, view in zip(models, boards, views, strict=True):
        rotation, translation, error = board_poses(model, board.frames, target)
        sightings.append(Sightings(view[board.row], board.board, (rotation, translation), error))
    graph = known_graph(calibration)
    shape = calibration.target_shape
    layout = layout_of(
        models,
        extra_boards=len(target.boards) - 1,
        warp=shape is not None and shape.warp_m is not None,
        offsets=len(target.points) if shape is not None and shape.offsets_m is not None else 0,
    )
    problem, state = solving.camera_problem(
        models,
        frames,
        target,
        views=views,
        weights=[
            np.ones(f.seen.shape) * (f.precision / camera.corner_sigma_px) ** 2
            for f, camera in zip(frames, calibration.cameras, strict=True)
        ],
        T_cam_rig=graph.T_cam_rig,
        T_target_rig=rig_graph.rig_poses(graph, sightings, len(times)),
        loss_width=_HUBER_SIGMAS,
        layout=layout,
    )
    problem = eqx.tree_at(lambda p: p.free, problem, on_device(np.zeros(layout.size, dtype=bool)))
    state = eqx.tree_at(lambda s: s.target, state, known_target(calibration))
    result = solve(problem, state, max_steps=max_steps)
    errors = split_groups(layout, frames, [np.asarray(e) for e in corner_errors(problem, result.state)])
    return [
        f.per_corner(np.where(f.seen[..., None], error, np.nan), np.nan)
        for f, error in zip(frames, errors, strict=True)
    ]


def known_graph(calibration: Calibration) -> RigGraph:
    """Places of cameras (T_cam_cam0) and boards (T_target_board) of a calibration."""
    places = [np.eye(4)]
    for camera in calibration.cameras[1:]:
        assert camera.T_cn_cnm1 is not None
        places.append(camera.T_cn_cnm1 @ places[-1])
    cameras = np.stack(places)
    boards = np.eye(4)[None] if calibration.target_shape is None else calibration.target_shape.T_target_board
    return RigGraph((cameras[:, :3, :3], cameras[:, :3, 3]), (boards[:, :3, :3], boards[:, :3, 3]))


def known_target(calibration: Calibration, warp: bool | None = None) -> TargetState:
    """The target as a calibration found it to be; `warp` asks for a place for the bend (flat, where none was found)."""
    shape = calibration.target_shape
    boards = np.zeros((0, 4, 4)) if shape is None else shape.T_target_board[1:]
    bend = None if shape is None else shape.warp_m
    if warp is not None:
        bend = (np.zeros(2) if bend is None else bend) if warp else None
    offsets = None if shape is None else shape.offsets_m
    return TargetState(
        R_target_board=on_device(boards[:, :3, :3]),
        t_target_board=on_device(boards[:, :3, 3]),
        warp=on_device(np.zeros(0)) if bend is None else on_device(bend),
        offsets=on_device(np.zeros((0, 3))) if offsets is None else on_device(offsets),
    )
