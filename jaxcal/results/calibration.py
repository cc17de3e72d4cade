"""`Calibration`: what came out of a calibration, with its uncertainty and everything needed to judge it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.cameras import CameraModel
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections, ImuRecording
from jaxcal.targets import Target


@dataclass(frozen=True)
class TargetShape:
    """What was found of the target itself.

    `T_target_board` (B, 4, 4) maps points of each board into the target's frame, that of the first board; `warp_m`
    (2,) the bend along columns and rows: a point is raised out of the board by w_x (1 - x^2) + w_y (1 - y^2), x and y
    from -1 to 1 across the board's points; `offsets_m` (N, 3) of the points from their stated places, in the board's
    frame. None where the target was taken as stated.
    """

    T_target_board: np.ndarray
    warp_m: np.ndarray | None = None
    offsets_m: np.ndarray | None = None

    def points(self, target: Target) -> np.ndarray:
        """Points (N, 3) of the target as it was found to be, m, in the target's frame."""
        points, board = target.points.copy(), target.board_of_point
        if self.warp_m is not None:
            for b in range(len(self.T_target_board)):
                plane = points[board == b, :2]
                low, high = plane.min(axis=0), plane.max(axis=0)
                across = (2.0 * plane - low - high) / np.maximum(high - low, 1e-12)
                points[board == b, 2] += (1.0 - across**2) @ self.warp_m
        if self.offsets_m is not None:
            points = points + self.offsets_m
        placed = self.T_target_board[board]
        return np.einsum("nij,nj->ni", placed[:, :3, :3], points) + placed[:, :3, 3]


@dataclass(frozen=True)
class CameraCalibration:
    """One calibrated camera.

    `T_cn_cnm1` (4, 4) maps points from the previous camera's frame (None for the first); `T_cam_imu` (4, 4) and
    `timeshift_cam_imu` (s, t_imu = t_cam + shift) are None without an IMU. `residuals_px` (M, 2) is projection minus
    measurement for each corner of `detections`, NaN where the corner took no part (frame outside the IMU's time,
    say); `inlier` (M,) is False for corners that were rejected. `corner_sigma_px` is the noise of one corner
    coordinate (of precision 1), estimated from the residuals; `reprojection_rms_px` the root mean square 2-D error of
    the inliers. `T_cam_target` (T, 4, 4) is the target's pose in the camera's frame for each of the detections'
    timestamps, NaN where it was not estimated. `timeshift_cam_cam0` (s, t_cam0 = t_cam + shift) where cameras without
    an IMU were calibrated with a time offset each. `line_delay_s` (s per row) of a rolling shutter: a frame's time is
    that of its first row.
    """

    name: str
    model: CameraModel
    image_size: tuple[int, int]
    T_cn_cnm1: np.ndarray | None
    T_cam_imu: np.ndarray | None
    timeshift_cam_imu: float | None
    detections: Detections
    residuals_px: np.ndarray
    inlier: np.ndarray
    corner_sigma_px: float
    T_cam_target: np.ndarray | None = None
    timeshift_cam_cam0: float | None = None
    line_delay_s: float | None = None

    @property
    def used(self) -> np.ndarray:
        """(M,) True for the corners that took part in the solution and were not rejected."""
        return self.inlier & np.isfinite(self.residuals_px).all(axis=1)

    @property
    def reprojection_rms_px(self) -> float:
        """Root mean square of the residuals' lengths (both coordinates together, as Kalibr counts), px, of the corners
        used; NaN without any."""
        kept = self.residuals_px[self.used]
        return float(np.sqrt(np.mean(np.sum(kept**2, axis=1)))) if len(kept) else float("nan")


@dataclass(frozen=True)
class ImuCalibration:
    """How the IMU agrees with the estimated motion.

    All arrays are at the IMU samples used, at `t_s` (N,) seconds since `origin_ns`.
    `gyro_rad_s`, `accel_m_s2` (N, 3) measured; `gyro_predicted`, `accel_predicted` (N, 3) from the spline, biases
    included; `gyro_bias`, `accel_bias` (N, 3) the biases there, `gyro_bias_std`, `accel_bias_std` (N, 3) their 1-sigma
    (or None); `gyro_sigma`, `accel_sigma` the discrete noise assumed, rad/s and m/s^2; `noise` the densities stated, by
    the names of Kalibr's `imu.yaml`. `position_m` (N, 3) and
    `rotation` (N, 3, 3) are the pose of the first IMU in the target frame (T_target_imu0).

    `model` is Kalibr's name of the IMU model and `parameters` its matrices by Kalibr's names. Of further IMUs also
    `T_imu_imu0` (4, 4), mapping points from the first one's frame, and `timeshift_imu_imu0` (s, t_imu0 = t_imu +
    shift). `noise_ratio` is the noise that the residuals show over the stated one (gyro, accel), whether or not used.
    `recording` is all that was given, samples that were not used included: what `jaxcal.resolve` starts from (None in
    results of earlier releases).
    """

    origin_ns: int
    t_s: np.ndarray
    gyro_rad_s: np.ndarray
    accel_m_s2: np.ndarray
    gyro_predicted: np.ndarray
    accel_predicted: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    gyro_sigma: float
    accel_sigma: float
    position_m: np.ndarray
    rotation: np.ndarray
    noise: Mapping[str, float]
    knot_rate_hz: float
    spline_order: int
    gyro_bias_std: np.ndarray | None = None
    accel_bias_std: np.ndarray | None = None
    model: str = "calibrated"
    parameters: Mapping[str, np.ndarray] = field(default_factory=dict)
    T_imu_imu0: np.ndarray | None = None
    timeshift_imu_imu0: float | None = None
    noise_ratio: tuple[float, float] | None = None
    recording: ImuRecording | None = None


@dataclass(frozen=True)
class Calibration:
    """A calibration of cameras, and of an IMU where there is one.

    `blocks` names the rows of `covariance` (P, P), in order, with their sizes: 'cam0.intrinsics',
    'cam0.distortion', 'cam1.T_cn_cnm1' (rotation x y z in rad, then translation x y z in m, both as a perturbation on
    the left: R = Exp(dr) R0, t = t0 + dt, in the frame of the camera), 'cam0.T_cam_imu' likewise,
    'cam0.timeshift_cam_imu' (s), 'cam1.timeshift_cam_cam0' (s), 'cam0.line_delay' (s per row), 'gravity' (m/s^2, target
    frame), 'imu0.M_accel' and other parameters of an IMU's model, 'imu1.T_imu_imu0' (as the other poses),
    'imu1.timeshift_imu_imu0' (s),
    'target.T_target_board1' (as the other poses), 'target.warp' (m), 'target.offsets' (m, x y z of each point). Held
    parameters have zero variance.

    `gravity` (3,) is the acceleration of free fall in the target frame (it points down), None without an IMU.
    `convergence` is the cost after each iteration of the last solve, `converged` whether that solve reached its
    tolerance; `warnings` are sentences for a person; `settings` and `versions` say how to get this result again.
    """

    cameras: tuple[CameraCalibration, ...]
    target: Target
    gravity: np.ndarray | None
    imu: ImuCalibration | None
    blocks: tuple[tuple[str, int], ...]
    covariance: np.ndarray
    convergence: np.ndarray
    warnings: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    converged: bool = True
    target_shape: TargetShape | None = None
    extra_imus: tuple[ImuCalibration, ...] = ()

    @property
    def imus(self) -> tuple[ImuCalibration, ...]:
        """All IMUs, the one that defines the rig's frame first."""
        return () if self.imu is None else (self.imu, *self.extra_imus)

    @property
    def target_points(self) -> np.ndarray:
        """Points (N, 3) of the target, m, as they were found to be where that was estimated."""
        return self.target.points if self.target_shape is None else self.target_shape.points(self.target)

    def _slice(self, name: str) -> slice:
        start = 0
        for block, size in self.blocks:
            if block == name:
                return slice(start, start + size)
            start += size
        known = ", ".join(block for block, _ in self.blocks)
        raise CalibrationError(f"no parameter is called '{name}'. This calibration has: {known}.")

    def std(self, name: str) -> np.ndarray:
        """1-sigma of a parameter block such as 'cam0.intrinsics', in the block's units (see the class)."""
        rows = self._slice(name)
        return np.sqrt(np.maximum(np.diag(self.covariance)[rows], 0.0))

    def covariance_of(self, *names: str) -> np.ndarray:
        """Joint covariance of the named blocks, in the order given."""
        index = np.concatenate([np.arange(*self._slice(name).indices(len(self.covariance))) for name in names])
        return self.covariance[np.ix_(index, index)]

    def save(self, folder: str | Path) -> None:
        """Write Kalibr-style yaml, `results.txt` and `calibration.npz` (everything; `load_calibration` reads it)."""
        from jaxcal.results.files import save_calibration

        save_calibration(self, Path(folder))
