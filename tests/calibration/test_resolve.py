"""A calibration can be repeated from its file alone: the same with the same settings, and otherwise with others."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from simulated_truth import FRAMES, errors_in_sigmas, only_frames, seen_by, still_rig

from jaxcal import Calibration, CalibrationError, calibrate_camera_imu, calibrate_cameras, load_calibration, resolve
from jaxcal.simulation import paper_rig, simulate_detections, simulate_imu


@pytest.fixture(scope="module")
def stereo() -> Calibration:
    rig = still_rig((1, 2), seed=3)
    return calibrate_cameras(seen_by(rig, noise_px=0.2), rig.target, names=["left", "right"])


@pytest.fixture(scope="module")
def with_imu() -> Calibration:
    rig = paper_rig(duration_s=5.0, seed=2)
    rig = dataclasses.replace(rig, cameras=(dataclasses.replace(rig.cameras[1], name="cam0"),))
    return calibrate_camera_imu(
        [simulate_detections(rig, 0, 0.15)], simulate_imu(rig), rig.target, knot_rate_hz=20.0, spline_order=4
    )


def saved_and_loaded(calibration: Calibration, folder: Path) -> Calibration:
    calibration.save(folder)
    return load_calibration(folder)


def assert_equal(first: Calibration, second: Calibration) -> None:
    """To 1e-9 of each number, or of its sigma where that is larger."""
    assert first.blocks == second.blocks
    sigma = np.sqrt(np.diag(first.covariance))
    np.testing.assert_allclose(first.covariance, second.covariance, rtol=1e-9, atol=1e-9 * sigma.max() ** 2)
    for a, b in zip(first.cameras, second.cameras, strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(a.model.parameters, b.model.parameters, rtol=1e-9)
        np.testing.assert_allclose(a.residuals_px, b.residuals_px, atol=1e-9)
        np.testing.assert_array_equal(a.inlier, b.inlier)
        for name in ("T_cn_cnm1", "T_cam_imu"):
            if getattr(a, name) is not None:
                np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-9)
        if a.timeshift_cam_imu is not None:
            assert b.timeshift_cam_imu == pytest.approx(a.timeshift_cam_imu, abs=1e-9)


def test_the_same_settings_give_the_same_cameras(stereo: Calibration, tmp_path: Path) -> None:
    again = resolve(saved_and_loaded(stereo, tmp_path))
    assert_equal(again, stereo)
    assert dict(again.settings) == dict(stereo.settings)


@pytest.mark.slow
def test_the_same_settings_give_the_same_camera_and_imu(with_imu: Calibration, tmp_path: Path) -> None:
    again = resolve(saved_and_loaded(with_imu, tmp_path))
    assert_equal(again, with_imu)


@pytest.mark.slow
def test_held_lenses_are_in_the_result_itself(with_imu: Calibration) -> None:
    held = resolve(with_imu, intrinsics="held")
    np.testing.assert_array_equal(held.cameras[0].model.parameters, with_imu.cameras[0].model.parameters)
    assert held.settings["intrinsics"] == "held"
    assert_equal(resolve(held), held)
    lagging = resolve(held, stamp_sigma_s=4e-4)
    (offset,), (more,) = (np.asarray(c.std("cam0.timeshift_cam_imu")) for c in (held, lagging))
    assert more == pytest.approx(np.hypot(offset, 4e-4), rel=1e-6)
    np.testing.assert_allclose(lagging.std("cam0.T_cam_imu"), held.std("cam0.T_cam_imu"), rtol=1e-6)


def test_other_settings_and_fewer_frames_are_taken(stereo: Calibration) -> None:
    half = [only_frames(camera.detections, camera.detections.seen_frames[::2]) for camera in stereo.cameras]
    other = resolve(stereo, detections=half, models=["pinhole-radtan", "pinhole-radtan5"], loss="cauchy")
    assert other.settings["loss"] == "cauchy"
    assert other.cameras[1].model.name == "pinhole-radtan5"
    assert [camera.name for camera in other.cameras] == ["left", "right"]
    assert len(other.cameras[0].detections.seen_frames) == FRAMES // 2
    assert np.median(np.abs(errors_in_sigmas(stereo, still_rig((1, 2), seed=3)))) < 2.0


def test_what_cannot_be_repeated_says_what_is_missing(stereo: Calibration, with_imu: Calibration) -> None:
    with pytest.raises(CalibrationError, match=r"'bord_warp' is no setting of calib.*Did you mean 'board_warp'"):
        resolve(stereo, bord_warp=True)
    with pytest.raises(CalibrationError, match="which job made it"):
        resolve(dataclasses.replace(stereo, settings={}))
    assert with_imu.imu is not None
    older = dataclasses.replace(with_imu, imu=dataclasses.replace(with_imu.imu, recording=None))
    with pytest.raises(CalibrationError, match="does not hold the whole recording of its IMU"):
        resolve(older)
    prior = dataclasses.replace(with_imu, settings={**with_imu.settings, "intrinsics": "prior"})
    with pytest.raises(CalibrationError, match="under the prior of another calibration"):
        resolve(prior)
