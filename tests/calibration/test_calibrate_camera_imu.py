"""Cameras and IMU are recovered from simulated measurements within the sigmas stated; no sync, no guess."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_truth import (
    assert_within_sigmas,
    errors_in_sigmas,
    mean_square_distance,
    only_frames,
    perturbed,
)

from jaxcal import (
    Calibration,
    CalibrationError,
    Detections,
    ImuNoise,
    ImuRecording,
    calibrate_camera_imu,
    load_calibration,
)
from jaxcal.calibration import initial_imu
from jaxcal.simulation import SimulatedRig, paper_rig, simulate_detections, simulate_imu
from jaxcal.studies.truth import errors, perturbation

Recording = tuple[list[Detections], ImuRecording]

NOISE_PX = 0.15
# Fixed, so that all tests here share their compiled programs.
KNOT_RATE_HZ = 20.0


def hand_held_rig(seed: int, more_shift_s: float = 0.0) -> SimulatedRig:
    """The two frame cameras of the built-in rig, at 30 Hz and 20 Hz and on clocks of their own, for 8 s."""
    rig = paper_rig(duration_s=8.0, seed=seed)
    cameras = [
        dataclasses.replace(
            rig.cameras[place],
            name=f"cam{index}",
            rate_hz=rate,
            timeshift_cam_imu=rig.cameras[place].timeshift_cam_imu + more_shift_s,
        )
        for index, (place, rate) in enumerate(((1, 30.0), (2, 20.0)))
    ]
    return dataclasses.replace(rig, cameras=tuple(cameras))


def measured(rig: SimulatedRig) -> tuple[list[Detections], ImuRecording]:
    return [simulate_detections(rig, c, NOISE_PX) for c in range(len(rig.cameras))], simulate_imu(rig)


def shifted(imu: ImuRecording, seconds: float) -> ImuRecording:
    return dataclasses.replace(imu, timestamps_ns=imu.timestamps_ns + round(seconds * 1e9))


@pytest.fixture(scope="module")
def rig() -> SimulatedRig:
    return hand_held_rig(seed=0)


@pytest.fixture(scope="module")
def recording(rig: SimulatedRig) -> tuple[list[Detections], ImuRecording]:
    return measured(rig)


@pytest.fixture(scope="module")
def calibrated(rig: SimulatedRig, recording: tuple[list[Detections], ImuRecording]) -> Calibration:
    detections, imu = recording
    return calibrate_camera_imu(detections, imu, rig.target, knot_rate_hz=KNOT_RATE_HZ)


# --- recovery --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_everything_is_recovered_within_its_sigmas(rig: SimulatedRig, calibrated: Calibration) -> None:
    assert calibrated.converged
    assert calibrated.warnings == ()
    assert_within_sigmas(calibrated, rig)
    assert 0.3 < mean_square_distance(calibrated, rig) < 2.5
    for camera in calibrated.cameras:
        assert camera.corner_sigma_px == pytest.approx(NOISE_PX, rel=0.05)
        # Sigmas are worth having only if they are small: 8 s of this motion give this much.
        pose, shift = calibrated.std(f"{camera.name}.T_cam_imu"), calibrated.std(f"{camera.name}.timeshift_cam_imu")
        assert np.degrees(pose[:3]).max() < 0.03
        assert pose[3:].max() < 2e-3
        assert shift[0] < 2e-4


@pytest.mark.slow
def test_the_trajectory_and_the_biases_are_those_of_the_rig(rig: SimulatedRig, calibrated: Calibration) -> None:
    imu = calibrated.imu
    assert imu is not None
    truth = np.stack([np.asarray(rig.motion.pose(t)) for t in imu.t_s[::100]])
    np.testing.assert_allclose(imu.position_m[::100], truth[:, :3, 3], atol=3e-3)
    turn = imu.rotation[::100] @ truth[:, :3, :3].swapaxes(1, 2)
    assert np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))).max() < 0.1
    # The whitened innovations are white with the densities given.
    gyro = (imu.gyro_rad_s - imu.gyro_predicted) / imu.gyro_sigma
    accel = (imu.accel_m_s2 - imu.accel_predicted) / imu.accel_sigma
    assert np.mean(gyro**2) == pytest.approx(1.0, abs=0.25)
    assert np.mean(accel**2) == pytest.approx(1.0, abs=0.25)
    assert imu.gyro_sigma == pytest.approx(rig.imu_noise.gyro_noise_density * np.sqrt(200.0), rel=0.15)
    assert imu.gyro_bias_std is not None
    assert imu.accel_bias_std is not None
    assert np.all(np.abs(imu.gyro_bias[0] - rig.gyro_bias) < 4.0 * imu.gyro_bias_std[0] + 1e-5)
    assert np.all(np.abs(imu.accel_bias[0] - rig.accel_bias) < 4.0 * imu.accel_bias_std[0] + 1e-3)


@pytest.mark.slow
def test_gaps_and_lost_frames_cost_precision_not_truth(rig: SimulatedRig, recording: Recording) -> None:
    """The IMU is silent for half a second, a camera for another, and every third of its frames is lost."""
    detections, imu = recording
    seconds = (imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9
    heard = (seconds < 3.0) | (seconds > 3.5)
    silent = ImuRecording(imu.timestamps_ns[heard], imu.gyro_rad_s[heard], imu.accel_m_s2[heard], imu.noise)
    first = detections[0]
    keep = np.arange(len(first.timestamps_ns))
    since = (first.timestamps_ns - first.timestamps_ns[0]) * 1e-9
    keep = keep[(keep % 3 != 0) & ((since < 5.0) | (since > 5.5))]
    found = calibrate_camera_imu(
        [only_frames(first, keep), detections[1]], silent, rig.target, knot_rate_hz=KNOT_RATE_HZ
    )
    assert found.converged
    assert_within_sigmas(found, rig)


@pytest.mark.slow
def test_a_time_offset_of_most_of_a_second_is_found_and_a_dense_cubic_spline_serves() -> None:
    rig = hand_held_rig(seed=4, more_shift_s=0.8)
    detections, imu = measured(rig)
    calibration = calibrate_camera_imu(detections, imu, rig.target, spline_order=4)
    assert calibration.cameras[0].timeshift_cam_imu == pytest.approx(0.8 - 0.0031, abs=5e-4)
    assert calibration.imu is not None
    assert calibration.imu.spline_order == 4
    assert calibration.converged
    assert_within_sigmas(calibration, rig)


# --- starting from a calibration of the cameras ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def second() -> tuple[SimulatedRig, list[Detections], ImuRecording]:
    """The same rig in another motion with other noise."""
    rig = hand_held_rig(seed=1)
    return rig, *measured(rig)


@pytest.mark.slow
def test_held_lenses_stay_and_have_no_variance(
    calibrated: Calibration, second: tuple[SimulatedRig, list[Detections], ImuRecording]
) -> None:
    rig, detections, imu = second
    held = calibrate_camera_imu(
        detections, imu, rig.target, cameras=calibrated, intrinsics="held", knot_rate_hz=KNOT_RATE_HZ
    )
    for before, after in zip(calibrated.cameras, held.cameras, strict=True):
        np.testing.assert_array_equal(before.model.parameters, after.model.parameters)
        assert not held.std(f"{after.name}.intrinsics").any()
        assert not held.std(f"{after.name}.distortion").any()
        assert np.all(held.std(f"{after.name}.T_cam_imu") > 0)
        assert after.T_cam_imu is not None
        # The lenses' own errors are not in these sigmas, hence absolute figures: 0.1 deg and 5 mm.
        error = np.abs(errors(held, rig)[f"{after.name}.T_cam_imu"])
        assert error[:3].max() < np.radians(0.1)
        assert error[3:].max() < 5e-3


@pytest.mark.slow
def test_a_prior_adds_what_is_known_to_what_is_seen(
    calibrated: Calibration, second: tuple[SimulatedRig, list[Detections], ImuRecording]
) -> None:
    rig, detections, imu = second
    with_prior = calibrate_camera_imu(
        detections, imu, rig.target, cameras=calibrated, intrinsics="prior", knot_rate_hz=KNOT_RATE_HZ
    )
    assert_within_sigmas(with_prior, rig)
    for camera in with_prior.cameras:
        for block in (f"{camera.name}.intrinsics", f"{camera.name}.distortion"):
            assert np.all(with_prior.std(block) < calibrated.std(block))
            # Two recordings of one kind: about root two better than either.
            assert np.all(with_prior.std(block) > 0.4 * calibrated.std(block))


def test_held_lenses_need_a_calibration_of_the_same_cameras(
    rig: SimulatedRig, recording: tuple[list[Detections], ImuRecording]
) -> None:
    detections, imu = recording
    with pytest.raises(CalibrationError, match="intrinsics='held' needs `cameras`"):
        calibrate_camera_imu(detections, imu, rig.target, intrinsics="held")


@pytest.mark.slow
def test_a_calibration_of_another_number_of_cameras_is_refused(
    rig: SimulatedRig, recording: tuple[list[Detections], ImuRecording], calibrated: Calibration
) -> None:
    detections, imu = recording
    with pytest.raises(CalibrationError, match="holds 2 cameras, but there are detections of 1"):
        calibrate_camera_imu(detections[:1], imu, rig.target, cameras=calibrated)


# --- noise -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_imu_noise_given_too_small_is_raised_and_told(
    rig: SimulatedRig, recording: tuple[list[Detections], ImuRecording]
) -> None:
    detections, imu = recording
    true = rig.imu_noise
    small = ImuNoise(
        gyro_noise_density=true.gyro_noise_density / 10.0,
        gyro_random_walk=true.gyro_random_walk,
        accel_noise_density=true.accel_noise_density / 10.0,
        accel_random_walk=true.accel_random_walk,
        update_rate=true.update_rate,
    )
    imu = dataclasses.replace(imu, noise=small)
    calibration = calibrate_camera_imu(detections, imu, rig.target, knot_rate_hz=KNOT_RATE_HZ)
    assert calibration.imu is not None
    assert calibration.imu.gyro_sigma == pytest.approx(true.gyro_noise_density * np.sqrt(200.0), rel=0.15)
    assert calibration.imu.accel_sigma == pytest.approx(true.accel_noise_density * np.sqrt(200.0), rel=0.15)
    for sensor in ("gyroscope", "accelerometer"):
        assert any(sensor in warning and "scatter" in warning for warning in calibration.warnings)
    assert_within_sigmas(calibration, rig)

    trusting = calibrate_camera_imu(detections, imu, rig.target, imu_noise="given", knot_rate_hz=KNOT_RATE_HZ)
    assert trusting.imu is not None
    assert trusting.imu.gyro_sigma == pytest.approx(small.gyro_noise_density * np.sqrt(200.0))
    assert np.mean(errors_in_sigmas(trusting, rig) ** 2) > np.mean(errors_in_sigmas(calibration, rig) ** 2)


# --- the result ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_blocks_and_sigmas_by_name(calibrated: Calibration) -> None:
    sizes = {"intrinsics": 4, "distortion": 4, "T_cam_imu": 6, "timeshift_cam_imu": 1}
    expected = {f"{name}.{block}": size for name in ("cam0", "cam1") for block, size in sizes.items()}
    assert dict(calibrated.blocks) == {**expected, "cam1.T_cn_cnm1": 6, "gravity": 3}
    for name, size in calibrated.blocks:
        assert calibrated.std(name).shape == (size,)
        assert np.all(calibrated.std(name) > 0)
    first, second = calibrated.cameras
    assert first.T_cam_imu is not None
    assert second.T_cam_imu is not None
    assert second.T_cn_cnm1 is not None
    np.testing.assert_allclose(second.T_cn_cnm1 @ first.T_cam_imu, second.T_cam_imu, atol=1e-12)


@pytest.mark.slow
def test_the_covariance_of_relative_poses_follows_from_that_of_the_poses(calibrated: Calibration) -> None:
    """By differences: T_cn_cnm1 = T_cam1_imu T_cam0_imu^-1, each pose perturbed as `Calibration` says."""
    first, second = calibrated.cameras
    assert first.T_cam_imu is not None
    assert second.T_cam_imu is not None
    assert second.T_cn_cnm1 is not None
    h = 1e-6
    jacobian = np.empty((6, 12))
    for k in range(12):
        step = h * np.eye(12)[k]
        moved = perturbed(second.T_cam_imu, step[6:]) @ np.linalg.inv(perturbed(first.T_cam_imu, step[:6]))
        jacobian[:, k] = perturbation(moved, second.T_cn_cnm1) / h
    expected = jacobian @ calibrated.covariance_of("cam0.T_cam_imu", "cam1.T_cam_imu") @ jacobian.T
    sigma = calibrated.std("cam1.T_cn_cnm1")
    actual = calibrated.covariance_of("cam1.T_cn_cnm1")
    np.testing.assert_allclose(actual / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-4)


@pytest.mark.slow
def test_saved_and_loaded_results_are_equal(calibrated: Calibration, tmp_path: Path) -> None:
    calibrated.save(tmp_path)
    loaded = load_calibration(tmp_path)
    assert loaded.blocks == calibrated.blocks
    assert loaded.warnings == calibrated.warnings
    assert dict(loaded.settings) == dict(calibrated.settings)
    np.testing.assert_array_equal(loaded.covariance, calibrated.covariance)
    np.testing.assert_array_equal(loaded.gravity, calibrated.gravity)
    for before, after in zip(calibrated.cameras, loaded.cameras, strict=True):
        np.testing.assert_array_equal(after.model.parameters, before.model.parameters)
        np.testing.assert_array_equal(after.T_cam_imu, before.T_cam_imu)
        np.testing.assert_array_equal(after.residuals_px, before.residuals_px)
        assert after.timeshift_cam_imu == before.timeshift_cam_imu
        assert after.reprojection_rms_px == before.reprojection_rms_px
    assert loaded.imu is not None
    assert calibrated.imu is not None
    assert_fields_equal(loaded.imu, calibrated.imu)


def assert_fields_equal(one: Any, other: Any) -> None:
    """All fields of two data classes, of those within them too."""
    for field in dataclasses.fields(one):
        mine, theirs = getattr(one, field.name), getattr(other, field.name)
        if dataclasses.is_dataclass(mine):
            assert_fields_equal(mine, theirs)
        else:
            np.testing.assert_array_equal(mine, theirs)


# --- what cannot be calibrated ---------------------------------------------------------------------------------------


def test_an_imu_recorded_at_another_time_is_refused(rig: SimulatedRig, recording: Recording) -> None:
    detections, imu = recording
    with pytest.raises(CalibrationError, match="clock"):
        calibrate_camera_imu(detections, shifted(imu, 3600.0), rig.target)


@pytest.mark.parametrize("seed", [2, 7, 9])
def test_an_unrelated_imu_is_refused(rig: SimulatedRig, recording: Recording, seed: int) -> None:
    """Its rates of turn correlate by up to 0.84 with the camera's at some offset: motions of one kind are alike."""
    detections, _ = recording
    other = simulate_imu(hand_held_rig(seed=seed))
    with pytest.raises(CalibrationError, match="does not match the IMU's"):
        calibrate_camera_imu(detections, other, rig.target)


def test_a_gyroscope_in_degrees_is_refused(rig: SimulatedRig, recording: Recording) -> None:
    detections, imu = recording
    degrees = dataclasses.replace(imu, gyro_rad_s=np.degrees(imu.gyro_rad_s))
    with pytest.raises(
        CalibrationError, match=r"gyroscope turns 5\d\.\d times as fast as the camera. Is the gyroscope in rad/s"
    ):
        calibrate_camera_imu(detections, degrees, rig.target)


@pytest.mark.parametrize("jump_s", [0.03, 0.4])
def test_a_clock_that_jumps_is_named(rig: SimulatedRig, recording: Recording, jump_s: float) -> None:
    detections, imu = recording
    times = imu.timestamps_ns.copy()
    times[len(times) // 2 :] += round(jump_s * 1e9)
    jumped = dataclasses.replace(imu, timestamps_ns=times)
    with pytest.raises(CalibrationError, match="cam0: its clock and the IMU's do not run together"):
        calibrate_camera_imu(detections, jumped, rig.target)


def test_a_camera_that_hardly_turns_is_refused(rig: SimulatedRig) -> None:
    """Nothing but translation leaves rotation and time offset to the IMU open."""
    motion = dataclasses.replace(rig.motion, amplitude=rig.motion.amplitude.at[3:].set(0.0))
    detections, imu = measured(dataclasses.replace(rig, motion=motion))
    with pytest.raises(CalibrationError, match="hardly turns"):
        calibrate_camera_imu(detections, imu, rig.target)


def test_duplicate_times_are_refused(recording: Recording) -> None:
    detections, imu = recording
    times = imu.timestamps_ns.copy()
    times[100] = times[99]
    with pytest.raises(CalibrationError, match=r"timestamp 100 .* is duplicate"):
        dataclasses.replace(imu, timestamps_ns=times)
    times = detections[0].timestamps_ns.copy()
    times[7] = times[6]
    with pytest.raises(CalibrationError, match=r"timestamp 7 .* is duplicate"):
        dataclasses.replace(detections[0], timestamps_ns=times)


def test_an_unknown_spline_order_is_refused(rig: SimulatedRig, recording: Recording) -> None:
    detections, imu = recording
    with pytest.raises(CalibrationError, match="spline_order is 3"):
        calibrate_camera_imu(detections, imu, rig.target, spline_order=3)


def test_an_imu_recording_shorter_than_a_frame_is_refused() -> None:
    time = 0.1 * np.arange(40)
    turn = 0.5 * np.stack([np.sin(3.0 * time), np.cos(2.0 * time), 0.0 * time], axis=1)
    track = initial_imu.CameraTrack(time, Rotation.from_rotvec(turn).as_matrix(), np.zeros((40, 3)))
    gyro = np.random.default_rng(0).normal(size=(8, 3))
    with pytest.raises(CalibrationError, match="does not match the IMU"):
        initial_imu.align(track, 0.005 * np.arange(8), gyro, "cam0")
