"""Cameras that are not synchronised, without an IMU: a time offset each, on a continuous-time trajectory of the rig."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal.calibration import initial_imu, solving, spline_setup
from jaxcal.calibration.assemble import CameraFrames, vision_data
from jaxcal.calibration.inertial import InertialData
from jaxcal.calibration.initial_imu import CameraTrack
from jaxcal.calibration.lens_basis import own_parameters
from jaxcal.calibration.poses import Poses, inverse
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.rolling import row_intervals
from jaxcal.calibration.spline_setup import SplineGrid
from jaxcal.calibration.state import RigState, SharedLayout, block_count, flat_target, free_blocks
from jaxcal.calibration.target_shape import geometry_of
from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.estimation import on_device
from jaxcal.targets import Target

_ORDER = 4
# Knots per frame of all cameras together: fewer than frames, so that they over-determine the trajectory.
_KNOTS_PER_FRAME = 0.6
# The rows of a rolling shutter see the motion between frames as well.
_KNOTS_PER_ROLLING_FRAME = 1.5
_KNOT_RATES_HZ = (8.0, 60.0)
# Room beyond the first and last frame for the offsets to move (s), and how near to it frames may lie.
_MARGIN_S = 0.1
_EDGE_S = 0.01
# What a rig in hands hardly exceeds; it matters only between frames.
_RATE_SIGMA = 10.0
_ACCELERATION_SIGMA = 30.0


@dataclass(frozen=True)
class Unsynchronised:
    """The joint problem and its start; which frames (F,) of each camera take part, and the spline's grid."""

    problem: RigProblem
    state: RigState
    usable: list[np.ndarray]
    grid: SplineGrid

    def pose_parameters(self, cameras: int) -> list[float]:
        """The spline's parameters, shared among the cameras, for the degrees of freedom."""
        return [6.0 * (self.grid.used + _ORDER - 1) / cameras] * cameras


def continuous_problem(
    names: Sequence[str],
    lenses: Sequence[CameraModel],
    cameras: Sequence[CameraFrames],
    poses: Sequence[Poses],
    errors: Sequence[np.ndarray],
    target: Target,
    layout: SharedLayout,
    *,
    offset_sigma_m: float | None,
    loss: str,
) -> Unsynchronised:
    """Cameras on a spline of the rig (the frame of cam0), each with a time offset to cam0's clock.

    `poses[c]`, `errors[c]` are T_cam_target and its error, px, of each frame. Offsets and rotations start from the
    correlation of the cameras' turning with cam0's, as those of cameras and IMU do.

    Raises CalibrationError where a camera's motion does not match cam0's.
    """
    origin = min(int(frames.time_ns[0]) for frames in cameras)
    tracks = []
    for frames, pose, error in zip(cameras, poses, errors, strict=True):
        good = error <= max(4.0 * float(np.median(error)), 0.2)
        rotation, position = inverse((pose[0][good], pose[1][good]))
        tracks.append(CameraTrack((frames.time_ns[good] - origin) * 1e-9, rotation, position))
    shift, rotation = _align_with_first(names, tracks)
    arms = initial_imu.lever_arms(tracks[0], tracks, shift, 0.0)
    arms[0] = np.zeros(3)
    grid = _grid(tracks, shift, layout)
    times = [(frames.time_ns - origin) * 1e-9 for frames in cameras]
    usable = [(t + s > grid.start + _EDGE_S) & (t + s < grid.stop - _EDGE_S) for t, s in zip(times, shift, strict=True)]

    free = solving.free_coordinates(lenses, layout)
    free[layout.pose(0)] = False
    free[layout.shift(0)] = False
    free[layout.gravity] = False
    knots = grid.intervals + _ORDER - 1
    problem = RigProblem(
        templates=solving.templates_of(lenses, layout),
        corners=vision_data(layout, cameras, weights=[np.ones(f.seen.shape) for f in cameras], times=times),
        geometry=geometry_of(target, offset_sigma_m),
        imu=_motion_prior(grid),
        prior=solving.lens_prior(lenses, layout, cameras),
        free_chain=on_device(free_blocks(knots, _ORDER, 0)),
        free=on_device(free),
        loss_width=on_device(1.0),
        basis=own_parameters(lenses, layout),
        layout=layout,
        order=_ORDER,
        loss=loss,
        row_intervals=row_intervals(layout, grid.dt),
    )
    time, R, p = _merged(tracks, shift, rotation, arms)
    rotations, positions = spline_setup.first_chain(grid, time, R, time, p)
    state = RigState(
        lenses=solving.stack_lenses(lenses, layout),
        R_cam_rig=on_device(np.stack(rotation)),
        t_cam_rig=on_device(np.stack(arms)),
        shift=on_device(shift),
        gravity=on_device([0.0, 0.0, -1.0]),
        rotations=on_device(rotations),
        positions=on_device(positions),
        biases=on_device(np.zeros((block_count(knots, _ORDER), 0))),
        target=flat_target(layout),
        line_delay=on_device(np.zeros(len(lenses) if layout.rolling else 0)),
    )
    return Unsynchronised(problem, state, usable, grid)


def _align_with_first(names: Sequence[str], tracks: Sequence[CameraTrack]) -> tuple[list[float], list[np.ndarray]]:
    """Time shift to cam0's clock and R_cam_cam0 of every camera; cam0's turning serves as the gyroscope."""
    middle, rate = initial_imu.turning(tracks[0], names[0])
    shift, rotation = [0.0], [np.eye(3)]
    for name, track in zip(names[1:], tracks[1:], strict=True):
        try:
            found = initial_imu.align(track, middle, rate, name)
        except CalibrationError as error:
            raise CalibrationError(
                f"{name} and {names[0]}: their motions cannot be matched ({error}) Without an IMU, both cameras have "
                "to see the board during the same motion, at 10 Hz or more, turning about all three axes."
            ) from error
        shift.append(found.shift_s)
        rotation.append(found.R_cam_imu)
    return shift, rotation


def _grid(tracks: Sequence[CameraTrack], shift: Sequence[float], layout: SharedLayout) -> SplineGrid:
    first = min(t.time_s[0] + s for t, s in zip(tracks, shift, strict=True)) - _MARGIN_S
    last = max(t.time_s[-1] + s for t, s in zip(tracks, shift, strict=True)) + _MARGIN_S
    knots = sum(
        len(t.time_s) * (_KNOTS_PER_ROLLING_FRAME if layout.is_rolling(c) else _KNOTS_PER_FRAME)
        for c, t in enumerate(tracks)
    )
    rate = float(np.clip(knots / (last - first), *_KNOT_RATES_HZ))
    return spline_setup.make_grid(first, last, _ORDER, rate)


def _motion_prior(grid: SplineGrid) -> InertialData:
    """No IMU samples: only the weak prior that bridges the time between frames."""
    return InertialData(
        samples=(),
        start=on_device(grid.start),
        dt=on_device(grid.dt),
        rate_sigma=on_device(_RATE_SIGMA),
        acceleration_sigma=on_device(_ACCELERATION_SIGMA),
    )


def _merged(
    tracks: Sequence[CameraTrack], shift: Sequence[float], rotation: Sequence[np.ndarray], arms: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_target_rig from all cameras' frames, on cam0's clock, times increasing and a few milliseconds apart."""
    time = np.concatenate([t.time_s + s for t, s in zip(tracks, shift, strict=True)])
    R = np.concatenate([t.rotation @ r for t, r in zip(tracks, rotation, strict=True)])
    p = np.concatenate([t.position + t.rotation @ a for t, a in zip(tracks, arms, strict=True)])
    order = np.argsort(time, kind="stable")
    kept = [int(order[0])]
    for k in order[1:]:
        if time[k] - time[kept[-1]] > 0.002:
            kept.append(int(k))
    return time[kept], R[kept], p[kept]
