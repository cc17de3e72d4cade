"""`validate`: whether a calibration still holds on a recording that it was not made from, in words."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.calibration.assemble import camera_frames
from jaxcal.calibration.held_back import held_back_residuals
from jaxcal.calibration.lens_poses import board_poses
from jaxcal.calibration.views import associate, split_boards
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections
from jaxcal.results import Calibration, CameraCalibration

# Limits beyond which a calibration is not good for a recording. Rules of thumb, in one place.
_RMS_OVER_OWN = 1.5  # error here over that in the calibration itself
_RMS_PX = 1.0  # where the calibration does not tell its own; for images up to 2000 px wide, in proportion beyond
_TOGETHER_OVER_ALONE = 1.3  # error with the cameras' poses held over that with each camera by itself
_OUTLIERS = 0.1
# A corner this many robust sigmas off is an outlier, as in a calibration.
_OUTLIER_SIGMAS = 4.5
_RAYLEIGH_MEDIAN = 1.1774  # the median length of a 2-D error whose coordinates have sigma 1
_MIN_SHARED_VIEWS = 3


@dataclass(frozen=True)
class CameraValidation:
    """One camera on the new recording.

    `alone_px` rms of the 2-D error with the board's pose fitted to this camera alone; `together_px` with one pose of
    the board for all cameras of a view, their poses to each other held; `own_px` in its own calibration (None: not
    known). `outliers` is the share of corners left out of these.
    """

    name: str
    frames: int
    corners: int
    alone_px: float
    together_px: float
    own_px: float | None
    outliers: float


@dataclass(frozen=True)
class PoseValidation:
    """Where a camera stands to the one before, against the calibration: the angle and distance between the two poses,
    median over `views` with its standard error."""

    name: str
    views: int
    turn_deg: float
    turn_error_deg: float
    shift_m: float
    shift_error_m: float


@dataclass(frozen=True)
class Validation:
    """Whether a calibration holds on a recording: figures, and `findings`, sentences on what does not hold."""

    cameras: tuple[CameraValidation, ...]
    poses: tuple[PoseValidation, ...]
    findings: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether nothing was found to be wrong."""
        return not self.findings

    @property
    def headline(self) -> str:
        """The verdict in words."""
        if self.findings:
            more = len(self.findings) - 1
            rest = f" (and {more} more finding{'s' if more > 1 else ''})" if more else ""
            return f"Not good: {self.findings[0]}{rest}"
        worst = max(camera.together_px for camera in self.cameras)
        poses = " and their poses to each other hold" if self.poses else ""
        return f"Good. The corners are met to {worst:.2f} px{poses}."


def validate(
    calibration: Calibration, detections: Sequence[Detections], *, sync_tolerance_s: float = 0.002
) -> Validation:
    """Project the board of a new recording through a calibration whose lenses and camera poses are held.

    Only where the board stood in each view is estimated: for all cameras together, and for each camera by itself. A
    lens that has changed shows in the second, cameras that have moved against each other in the difference. Times of
    cameras are brought to one clock by the calibration's time offsets; `sync_tolerance_s` as in `calibrate_cameras`.

    Raises CalibrationError when the number of cameras or an image size differs, the target is another one, or a camera
    has hardly a usable frame.
    """
    _check(calibration, detections)
    detections = [_on_one_clock(c, d) for c, d in zip(calibration.cameras, detections, strict=True)]
    calibration = _with_noise(calibration, detections)
    singles = [_alone(calibration, k) for k in range(len(detections))]
    alone = [held_back_residuals(single, [d])[0] for single, d in zip(singles, detections, strict=True)]
    tied = len(detections) > 1 and all(camera.T_cn_cnm1 is not None for camera in calibration.cameras[1:])
    together = held_back_residuals(calibration, detections, sync_tolerance_s=sync_tolerance_s) if tied else alone
    cameras = tuple(
        _camera(camera, d, a, t)
        for camera, d, a, t in zip(calibration.cameras, detections, alone, together, strict=True)
    )
    poses = _poses(calibration, detections, sync_tolerance_s) if tied else ()
    return Validation(cameras, poses, tuple(_findings(calibration, cameras, poses)))


def _check(calibration: Calibration, detections: Sequence[Detections]) -> None:
    if len(detections) != len(calibration.cameras):
        raise CalibrationError(
            f"recordings of {len(detections)} cameras for a calibration of {len(calibration.cameras)}; give one each."
        )
    for camera, seen in zip(calibration.cameras, detections, strict=True):
        if seen.image_size != camera.image_size:
            raise CalibrationError(
                f"{camera.name}: the images are {seen.image_size[0]}x{seen.image_size[1]}, but it was calibrated with "
                f"{camera.image_size[0]}x{camera.image_size[1]}. A lens calibration holds for one image size only."
            )


def _on_one_clock(camera: CameraCalibration, detections: Detections) -> Detections:
    shift_s = camera.timeshift_cam_imu or camera.timeshift_cam_cam0 or 0.0
    return replace(detections, timestamps_ns=detections.timestamps_ns + round(shift_s * 1e9))


def _alone(calibration: Calibration, index: int) -> Calibration:
    return replace(calibration, cameras=(replace(calibration.cameras[index], T_cn_cnm1=None),))


def _with_noise(calibration: Calibration, detections: Sequence[Detections]) -> Calibration:
    """The calibration with the corner noise of each camera; where it is not known, what single views show of it."""
    cameras = []
    for camera, seen in zip(calibration.cameras, detections, strict=True):
        if not camera.corner_sigma_px > 0:
            frames = split_boards(camera_frames(seen, calibration.target, camera.name), calibration.target).frames
            error = board_poses(camera.model, frames, calibration.target)[2]
            camera = replace(camera, corner_sigma_px=max(float(np.median(error)) / np.sqrt(2.0), 1e-3))
        cameras.append(camera)
    return replace(calibration, cameras=tuple(cameras))


def _scale(residuals: np.ndarray) -> float:
    """The noise of one coordinate, px, from the median 2-D error of residuals (M, 2), one at least."""
    sizes = np.linalg.norm(residuals, axis=1)
    return max(float(np.median(sizes)) / _RAYLEIGH_MEDIAN, 1e-3)


def _camera(
    camera: CameraCalibration, detections: Detections, alone: np.ndarray, together: np.ndarray
) -> CameraValidation:
    used = np.isfinite(alone).all(axis=1) & np.isfinite(together).all(axis=1)
    if not used.any():
        raise CalibrationError(f"{camera.name}: no frame shows enough of the board to place it.")
    sizes = np.linalg.norm(alone[used], axis=1)
    kept = sizes <= _OUTLIER_SIGMAS * _scale(alone[used])
    own = camera.reprojection_rms_px
    return CameraValidation(
        name=camera.name,
        frames=len(np.unique(detections.frame[used])),
        corners=int(used.sum()),
        alone_px=float(np.sqrt(np.mean(sizes[kept] ** 2))),
        together_px=float(np.sqrt(np.mean(np.sum(together[used][kept] ** 2, axis=1)))),
        own_px=own if np.isfinite(own) else None,
        outliers=float(1.0 - kept.mean()),
    )


def _poses(
    calibration: Calibration, detections: Sequence[Detections], sync_tolerance_s: float
) -> tuple[PoseValidation, ...]:
    """Each camera's pose to the one before, from the views that both share, against the calibration's."""
    target = calibration.target
    if len(target.boards) > 1:
        return ()  # which boards two cameras share differs from view to view
    frames = [camera_frames(d, target, camera.name) for d, camera in zip(detections, calibration.cameras, strict=True)]
    views, _ = associate(frames, round(sync_tolerance_s * 1e9))
    placed = [board_poses(camera.model, f, target)[:2] for camera, f in zip(calibration.cameras, frames, strict=True)]
    found = []
    for k, camera in enumerate(calibration.cameras[1:], start=1):
        _, before, now = np.intersect1d(views[k - 1], views[k], return_indices=True)
        if len(now) < _MIN_SHARED_VIEWS or camera.T_cn_cnm1 is None:
            continue
        R_before, t_before = (part[before] for part in placed[k - 1])
        R_now, t_now = (part[now] for part in placed[k])
        turn = R_now @ R_before.swapaxes(-1, -2)
        shift = t_now - np.einsum("vij,vj->vi", turn, t_before)
        off = Rotation.from_matrix(turn @ camera.T_cn_cnm1[:3, :3].T).as_rotvec(degrees=True)
        moved = shift - camera.T_cn_cnm1[:3, 3]
        found.append(PoseValidation(camera.name, len(now), *_median(off), *_median(moved)))
    return tuple(found)


def _median(vectors: np.ndarray) -> tuple[float, float]:
    """The length of the median of vectors (V, 3), and its standard error, from their spread about it."""
    middle = np.median(vectors, axis=0)
    spread = 1.4826 * np.median(np.abs(vectors - middle), axis=0)
    return float(np.linalg.norm(middle)), float(1.2533 * np.linalg.norm(spread) / np.sqrt(len(vectors)))


def _findings(
    calibration: Calibration, cameras: Sequence[CameraValidation], poses: Sequence[PoseValidation]
) -> list[str]:
    findings = []
    for k, camera in enumerate(cameras):
        scale = max(1.0, calibration.cameras[k].image_size[0] / 2000.0)
        if camera.own_px is not None and camera.alone_px > _RMS_OVER_OWN * camera.own_px:
            findings.append(
                f"{camera.name} misses the corners by {camera.alone_px:.2f} px, {camera.alone_px / camera.own_px:.1f} "
                "times as much as in its own calibration. The lens was touched, or these pictures are worse: look for "
                "blur, and whether it is the same board; else calibrate again."
            )
        elif camera.own_px is None and camera.alone_px > _RMS_PX * scale:
            findings.append(
                f"{camera.name} misses the corners by {camera.alone_px:.2f} px. Calibrate it again, or look for blur "
                "and for another board."
            )
        if camera.outliers > _OUTLIERS:
            findings.append(
                f"{camera.name} has {100 * camera.outliers:.0f} % of its corners far off. Is it the same board, and do "
                "the detections sit on its corners?"
            )
    by_name = {pose.name: pose for pose in poses}
    for before, camera in pairwise(cameras):
        ratio = max(c.together_px / max(c.alone_px, 1e-9) for c in (before, camera))
        pose = by_name.get(camera.name)
        if ratio > _TOGETHER_OVER_ALONE and pose is not None:
            findings.append(
                f"{before.name} and {camera.name} no longer fit together: errors are {ratio:.1f} times as large as "
                f"with each by itself, as if {camera.name} had moved by {pose.turn_deg:.2f} deg and "
                f"{1e3 * pose.shift_m:.1f} mm. A camera was knocked, or a lens touched: calibrate again."
            )
    return findings
