"""What to record next: what the views and the motion of a recording lack, in sentences for who holds the board."""

from collections.abc import Iterator

import numpy as np

from jaxcal.results.calibration import Calibration, CameraCalibration, ImuCalibration
from jaxcal.results.coverage import corner_counts

# Rules of thumb, in one place.
_TILT_DEG = 25.0  # a tenth of the views should be tilted by more
_TILT_SPREAD_DEG = 7.0  # 1-sigma of the tilt about either axis of the image
_DISTANCE_RATIO = 1.5  # of the furthest to the nearest views
_TURN_RAD_S = 0.25  # rms about each axis of the IMU
_SHAKE_M_S2 = 0.4  # rms along each axis of the IMU, gravity's swing included
_ROWS, _COLUMNS = ("upper", "middle", "lower"), ("left", "centre", "right")


def advice(calibration: Calibration) -> tuple[str, ...]:
    """Sentences about what the next recording should show that this one did not; one of praise if there is nothing."""
    sentences = [sentence for camera in calibration.cameras for sentence in _views(camera)]
    if calibration.imu is not None:
        sentences += list(_motion(calibration.imu))
    if sentences:
        return tuple(sentences)
    imu = ", and the rig turned and shook about every axis" if calibration.imu is not None else ""
    return (f"Nothing is missing: the board was seen all over the image, tilted and at several distances{imu}.",)


def _views(camera: CameraCalibration) -> Iterator[str]:
    empty = _empty_regions(camera)
    if empty:
        yield f"{camera.name}: show the board in the {_listed(empty)} of the image; hardly a corner was seen there."
    if camera.T_cam_target is None:
        return
    frames = np.unique(camera.detections.frame[camera.used])
    poses = camera.T_cam_target[frames]
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    if len(poses) < 2:
        return
    # The board's normal in the camera's frame is (0, 0, -1) where it is seen head-on.
    normals = poses[:, :3, 2]
    tilt = np.degrees(np.arccos(np.clip(-normals[:, 2], -1.0, 1.0)))
    if np.quantile(tilt, 0.9) < _TILT_DEG:
        yield (
            f"{camera.name}: tilt the board more, by 30 to 45 degrees: nine of ten views are tilted by less than "
            f"{np.quantile(tilt, 0.9):.0f} degrees, which leaves the focal length weak."
        )
    else:
        for axis, name in ((0, "left and right"), (1, "up and down")):
            spread = float(np.degrees(np.std(np.arcsin(np.clip(normals[:, axis], -1.0, 1.0)))))
            if spread < _TILT_SPREAD_DEG:
                yield f"{camera.name}: tilt the board {name} too: it varied by {spread:.0f} degrees only (1-sigma)."
    distance = np.linalg.norm(poses[:, :3, 3], axis=1)
    near, far = np.quantile(distance, [0.05, 0.95])
    if far < _DISTANCE_RATIO * near:
        yield f"{camera.name}: vary the distance: the board stayed between {near:.2f} and {far:.2f} m from the camera."


def _motion(imu: ImuCalibration) -> Iterator[str]:
    rates = np.sqrt(np.nanmean((imu.gyro_predicted - imu.gyro_bias) ** 2, axis=0))
    slow = [axis for axis, rate in zip("xyz", rates, strict=True) if rate < _TURN_RAD_S]
    if slow:
        shown = ", ".join(f"{rate:.2f}" for rate in rates)
        yield (
            f"imu0: turn the rig faster about {_listed(slow)}: it turned by {shown} rad/s (rms) about x, y and z. "
            "Rotation to the cameras, lever arm and time offset all follow from turns."
        )
    force = imu.accel_predicted - imu.accel_bias
    strength = np.nanstd(force, axis=0)
    weak = [axis for axis, value in zip("xyz", strength, strict=True) if value < _SHAKE_M_S2]
    if weak:
        yield f"imu0: move the rig briskly along {_listed(weak)}: the accelerometer saw next to no change there."


def _empty_regions(camera: CameraCalibration) -> list[str]:
    """Ninths of the image of which most cells hold no corner, by name."""
    counts = corner_counts(camera)
    names = []
    for row, lines in zip(_ROWS, np.array_split(counts, 3, axis=0), strict=True):
        for column, cells in zip(_COLUMNS, np.array_split(lines, 3, axis=1), strict=True):
            if np.mean(cells == 0) > 0.5:
                names.append("centre" if (row, column) == ("middle", "centre") else f"{row} {column}")
    return names


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
