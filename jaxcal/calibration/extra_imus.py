"""Several IMUs on one rig: how each is turned and timed against the first, and their samples on one grid."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal.calibration import initial_imu, spline_setup
from jaxcal.calibration.initial_imu import Alignment, CameraTrack
from jaxcal.calibration.spline_setup import BinnedImu, SplineGrid
from jaxcal.calibration.state import ImuPlace
from jaxcal.errors import CalibrationError
from jaxcal.imu import imu_model
from jaxcal.observations import ImuRecording


@dataclass(frozen=True)
class OtherImu:
    """First guess of an IMU's place: R_imu_imu0, its clock (s, t_imu0 = t_imu + shift, both counted from the first
    IMU's first sample), gyro bias (3,) rad/s."""

    R_imu_imu0: np.ndarray
    shift_s: float
    gyro_bias: np.ndarray


def places_of(models: Sequence[str]) -> tuple[ImuPlace, ...]:
    """The layout of IMUs of these models; the first is the rig's own frame."""
    return tuple(ImuPlace(name, imu_model(name).size, placed=i > 0) for i, name in enumerate(models))


def times_of(imus: Sequence[ImuRecording]) -> list[np.ndarray]:
    """Sample times of each, s since the first IMU's first sample, each on its own clock."""
    origin = imus[0].timestamps_ns[0]
    return [(imu.timestamps_ns - origin) * 1e-9 for imu in imus]


def align_others(track: CameraTrack, first: Alignment, imus: Sequence[ImuRecording]) -> list[OtherImu]:
    """Place each IMU against the first by the turning of one camera, which both are aligned with.

    Raises CalibrationError when an IMU does not turn as the camera does.
    """
    places = [OtherImu(np.eye(3), 0.0, first.gyro_bias)]
    for number, (imu, time) in enumerate(zip(imus[1:], times_of(imus)[1:], strict=True), start=1):
        try:
            found = initial_imu.align(track, time, imu.gyro_rad_s, f"imu{number}")
        except CalibrationError as error:
            raise CalibrationError(
                f"imu{number} cannot be placed against imu0 by the camera's turning: {error}"
            ) from error
        places.append(OtherImu(found.R_cam_imu.T @ first.R_cam_imu, first.shift_s - found.shift_s, found.gyro_bias))
    return places


def bin_all(grid: SplineGrid, imus: Sequence[ImuRecording], shifts: Sequence[float]) -> list[BinnedImu]:
    """Samples of every IMU on the grid. Raises CalibrationError where an IMU has next to none there."""
    binned = []
    for number, (imu, time, shift) in enumerate(zip(imus, times_of(imus), shifts, strict=True)):
        one = spline_setup.bin_imu(grid, time, imu.gyro_rad_s, imu.accel_m_s2, imu.noise, imu.rate_hz, shift)
        if len(one.index) < 10:
            raise CalibrationError(
                f"imu{number}: {len(one.index)} of its {len(time)} samples lie within the frames' time; record all "
                "sensors together."
            )
        binned.append(one)
    return binned
