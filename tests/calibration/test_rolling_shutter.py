"""A rolling-shutter camera with an IMU: the line delay and everything else are recovered within their sigmas."""

import dataclasses

import numpy as np
import pytest
from simulated_truth import errors_in_sigmas

from jaxcal import Calibration, CalibrationError, calibrate_camera_imu, calibrate_cameras
from jaxcal.calibration.rolling import check_readout
from jaxcal.simulation import SimulatedRig, paper_rig, simulate_detections, simulate_imu

LINE_DELAY_S = 35e-6


@pytest.fixture(scope="module")
def rig() -> SimulatedRig:
    rig = paper_rig(duration_s=8.0, seed=5)
    camera = dataclasses.replace(rig.cameras[1], name="cam0", rate_hz=20.0)
    return dataclasses.replace(rig, cameras=(camera,))


@pytest.fixture(scope="module")
def calibrated(rig: SimulatedRig) -> Calibration:
    detections = simulate_detections(rig, 0, 0.15, line_delay_s=LINE_DELAY_S)
    return calibrate_camera_imu([detections], simulate_imu(rig), rig.target, rolling_shutter=True, knot_rate_hz=20.0)


@pytest.mark.slow
def test_the_line_delay_is_recovered(calibrated: Calibration) -> None:
    camera = calibrated.cameras[0]
    assert calibrated.converged
    assert camera.line_delay_s is not None
    sigma = calibrated.std("cam0.line_delay")[0]
    assert abs(camera.line_delay_s - LINE_DELAY_S) < 3.5 * sigma
    assert sigma < 1e-6
    assert camera.corner_sigma_px == pytest.approx(0.15, rel=0.05)


@pytest.mark.slow
def test_everything_else_is_recovered_too(rig: SimulatedRig, calibrated: Calibration) -> None:
    assert np.mean(np.abs(errors_in_sigmas(calibrated, rig)) < 3.5) >= 0.97


@pytest.mark.slow
def test_without_an_imu_too(rig: SimulatedRig) -> None:
    camera = dataclasses.replace(rig.cameras[0], rate_hz=30.0)
    rig = dataclasses.replace(rig, cameras=(camera,))
    found = calibrate_cameras(
        [simulate_detections(rig, 0, 0.15, line_delay_s=LINE_DELAY_S)], rig.target, rolling_shutter=True
    ).cameras[0]
    assert found.line_delay_s == pytest.approx(LINE_DELAY_S, abs=1.5e-6)
    np.testing.assert_allclose(found.model.intrinsics, camera.model.intrinsics, rtol=3e-3)


def test_as_many_shutters_as_cameras_are_asked_for(rig: SimulatedRig) -> None:
    detections = simulate_detections(rig, 0)
    with pytest.raises(CalibrationError, match="`rolling_shutter` has 2 entries for 1 cameras"):
        calibrate_camera_imu([detections], simulate_imu(rig), rig.target, rolling_shutter=[True, False])


def test_a_readout_longer_than_there_is_room_for_is_refused() -> None:
    check_readout("cam0", -30e-6, 480)
    with pytest.raises(CalibrationError, match=r"cam0: the line delay comes out as 100.0 us.*take 48 ms"):
        check_readout("cam0", 100e-6, 480)
