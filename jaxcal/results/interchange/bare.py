"""A calibration from a file of another tool: lenses and poses, with no measurements and no uncertainty."""

from pathlib import Path

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections
from jaxcal.results.calibration import Calibration, CameraCalibration
from jaxcal.results.interchange.formats import load_calibration_or_rig
from jaxcal.results.interchange.rig import CalibratedRig
from jaxcal.targets import Target


def calibration_of_file(path: str | Path, target: Target) -> Calibration:
    """A calibration of ours with all it knows, or what a file of another tool says of one.

    The latter was made with whatever board; `target` is the one that it is to be used with. Raises CalibrationError as
    `read_calibration`, and when the file describes no camera.
    """
    found = load_calibration_or_rig(path)
    if isinstance(found, Calibration):
        return found
    if not found.cameras:
        raise CalibrationError(f"{path}: there is no camera in it. Name the camchain, not the IMU's file.")
    return bare_calibration(found, target)


def bare_calibration(rig: CalibratedRig, target: Target) -> Calibration:
    """A calibration without measurements, whose corner noise is not known (NaN) and whose covariance is empty."""
    cameras = tuple(
        CameraCalibration(
            name=camera.name,
            model=camera.model,
            image_size=camera.image_size,
            T_cn_cnm1=camera.T_cn_cnm1,
            T_cam_imu=camera.T_cam_imu,
            timeshift_cam_imu=camera.timeshift_cam_imu,
            detections=_nothing_seen(camera.image_size),
            residuals_px=np.empty((0, 2)),
            inlier=np.empty(0, bool),
            corner_sigma_px=float("nan"),
        )
        for camera in rig.cameras
    )
    return Calibration(
        cameras=cameras,
        target=target,
        gravity=None,
        imu=None,
        blocks=(),
        covariance=np.empty((0, 0)),
        convergence=np.empty(0),
    )


def _nothing_seen(image_size: tuple[int, int]) -> Detections:
    none = np.empty(0, np.int64)
    return Detections(none, none, none, np.empty((0, 2)), image_size)
