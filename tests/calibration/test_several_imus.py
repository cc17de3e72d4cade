"""IMUs with scale errors and misalignment, and several IMUs on one rig: parameters, places and clocks are recovered."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_truth import errors_in_sigmas

from jaxcal import Calibration, CalibrationError, calibrate_camera_imu
from jaxcal.imu import imu_model
from jaxcal.simulation import ImuTruth, SimulatedRig, paper_rig, simulate_detections, simulate_imu
from jaxcal.studies.truth import errors, in_sigmas

SECOND = np.eye(4)
SECOND[:3, :3] = Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix()
SECOND[:3, 3] = [0.06, -0.11, 0.04]
SHIFT_S = 0.0173


@pytest.fixture(scope="module")
def rig() -> SimulatedRig:
    rig = paper_rig(duration_s=12.0, seed=3)
    camera = dataclasses.replace(rig.cameras[1], name="cam0", rate_hz=20.0)
    return dataclasses.replace(rig, cameras=(camera,))


def unusual(model: str) -> np.ndarray:
    """Parameters as far from nominal as parts on the market are."""
    rng = np.random.default_rng(5)
    return np.array(imu_model(model).nominal) + 0.2 * np.array(imu_model(model).spread) * rng.standard_normal(
        imu_model(model).size
    )


@pytest.fixture(scope="module")
def truths() -> tuple[ImuTruth, ImuTruth]:
    return (
        ImuTruth("scale-misalignment", unusual("scale-misalignment")),
        ImuTruth("calibrated", None, SECOND, SHIFT_S, number=1),
    )


@pytest.fixture(scope="module")
def calibrated(rig: SimulatedRig, truths: tuple[ImuTruth, ImuTruth]) -> Calibration:
    recordings = [simulate_imu(rig, truth=truth) for truth in truths]
    return calibrate_camera_imu(
        [simulate_detections(rig, 0, 0.15)],
        recordings,
        rig.target,
        imu_models=[truth.model for truth in truths],
        knot_rate_hz=20.0,
    )


@pytest.mark.slow
def test_parameters_places_and_clocks_are_recovered_within_their_sigmas(
    rig: SimulatedRig, truths: tuple[ImuTruth, ImuTruth], calibrated: Calibration
) -> None:
    assert calibrated.converged
    found = errors(calibrated, rig, truths)
    imu = in_sigmas(calibrated, {name: error for name, error in found.items() if name.startswith("imu")})
    assert np.mean(np.abs(imu) < 3.5) >= 0.97, imu
    assert 0.5 < np.sqrt(np.mean(imu**2)) < 1.6
    first, second = calibrated.imus
    assert first.T_imu_imu0 is None
    assert second.parameters == {}
    # Worth having: millimetres and tens of microseconds between the IMUs, parts in a thousand of scale.
    assert calibrated.std("imu1.T_imu_imu0")[3:].max() < 3e-3
    assert calibrated.std("imu1.timeshift_imu_imu0").max() < 1e-4
    assert calibrated.std("imu0.M_gyro").max() < 3e-3


@pytest.mark.slow
def test_the_camera_is_as_right_as_with_one_ideal_imu(rig: SimulatedRig, calibrated: Calibration) -> None:
    assert np.mean(np.abs(errors_in_sigmas(calibrated, rig)) < 3.5) >= 0.95


@pytest.mark.slow
def test_every_imu_reports_its_own_residuals_and_noise(calibrated: Calibration, rig: SimulatedRig) -> None:
    for imu in calibrated.imus:
        gyro = (imu.gyro_rad_s - imu.gyro_predicted) / imu.gyro_sigma
        accel = (imu.accel_m_s2 - imu.accel_predicted) / imu.accel_sigma
        assert np.mean(gyro**2) == pytest.approx(1.0, abs=0.25)
        assert np.mean(accel**2) == pytest.approx(1.0, abs=0.25)
        assert imu.noise_ratio is not None
        assert imu.noise_ratio == pytest.approx((1.0, 1.0), abs=0.3)


def test_models_that_do_not_exist_or_do_not_fit_the_imus_are_refused(rig: SimulatedRig) -> None:
    detections = [simulate_detections(rig, 0, 0.15)]
    imu = simulate_imu(rig)
    with pytest.raises(CalibrationError, match="IMU model 'scale' is unknown; known: calibrated, scale-misalignment"):
        calibrate_camera_imu(detections, imu, rig.target, cameras=None, imu_models="scale")
    with pytest.raises(CalibrationError, match="`imu_models` names 2 models for 1 IMUs"):
        calibrate_camera_imu(detections, imu, rig.target, imu_models=["calibrated", "calibrated"])
