"""Parameters with their sigmas, and `results.txt`."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic_calibration import APRIL_GRID, make_calibration

from jaxcal.results import results_text
from jaxcal.results.parameters import (
    camera_estimates,
    format_estimate,
    parameter_names,
    sigma_of,
    timeshift_estimate,
    transform_estimates,
)

BASE = make_calibration(2, True, frames=8)

angles = st.floats(-1.8, 1.8)


@settings(deadline=None, max_examples=30)
@given(vector=st.tuples(angles, angles, angles), seed=st.integers(0, 1000))
def test_rotation_sigmas_agree_with_samples_of_the_left_perturbation(
    vector: tuple[float, float, float], seed: int
) -> None:
    random = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(vector)
    if rotation.magnitude() > 3.0:  # near half a turn the rotation vector jumps to its opposite
        return
    mix = random.normal(size=(6, 6)) * 1e-5
    covariance = mix @ mix.T
    transform = np.eye(4)
    transform[:3, :3] = rotation.as_matrix()
    block = BASE._slice("cam0.T_cam_imu")
    whole = np.zeros_like(BASE.covariance)
    whole[block, block] = covariance
    made = dataclasses.replace(BASE, covariance=whole)
    sigmas = [e.sigma for e in transform_estimates(made, transform, "cam0.T_cam_imu")]

    # Exact for the linear map: the columns of a square root, by central differences.
    step = 1e-6
    columns = []
    for axis in np.eye(3) * step:
        plus, minus = ((Rotation.from_rotvec(s * axis) * rotation).as_rotvec() for s in (1.0, -1.0))
        columns.append((plus - minus) / (2.0 * step))
    jacobian = np.stack(columns, axis=1)
    expected = np.degrees(np.sqrt(np.diag(jacobian @ covariance[:3, :3] @ jacobian.T)))
    np.testing.assert_allclose(np.array(sigmas[3:], dtype=float), expected, rtol=1e-5)
    np.testing.assert_allclose(np.array(sigmas[:3], dtype=float), 1e3 * np.sqrt(np.diag(covariance)[3:]), rtol=1e-9)


@settings(deadline=None, max_examples=200)
@given(value=st.floats(-1e6, 1e6), exponent=st.floats(-9.0, 3.0))
def test_a_printed_value_is_within_a_tenth_of_its_sigma(value: float, exponent: float) -> None:
    sigma = 10.0**exponent
    shown, shown_sigma = format_estimate(value, sigma)
    assert abs(float(shown) - value) <= max(0.1 * sigma, 0.5)
    if sigma < 1.0:
        assert abs(float(shown) - value) <= 0.1 * sigma
        assert abs(float(shown_sigma) - sigma) <= 0.06 * sigma


def test_held_and_unknown_parameters_say_so() -> None:
    assert format_estimate(458.123456789, 0.0) == ("458.123", "held")
    assert format_estimate(458.123456789, None) == ("458.123", "unknown")
    assert format_estimate(458.1, math.nan) == ("458.1", "unknown")
    assert format_estimate(math.nan, 0.1) == ("nan", "unknown")


def test_parameters_carry_kalibrs_names_and_their_sigmas() -> None:
    assert parameter_names(BASE.cameras[0].model) == (("fx", "fy", "cx", "cy"), ("k1", "k2", "p1", "p2"))
    estimates = camera_estimates(BASE, 0)
    assert [e.name for e in estimates] == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"]
    np.testing.assert_array_equal([e.value for e in estimates], np.asarray(BASE.cameras[0].model.parameters))
    expected = np.concatenate([BASE.std("cam0.intrinsics"), BASE.std("cam0.distortion")])
    np.testing.assert_array_equal(np.array([e.sigma for e in estimates], dtype=float), expected)


def test_the_time_offset_is_told_in_milliseconds() -> None:
    estimate = timeshift_estimate(BASE, 1)
    assert estimate is not None
    assert estimate.value == pytest.approx(5.0)
    assert estimate.sigma == pytest.approx(BASE.std("cam1.timeshift_cam_imu")[0] * 1e3)
    assert timeshift_estimate(make_calibration(1, False, frames=4), 0) is None


def test_a_block_that_was_not_estimated_has_no_sigma() -> None:
    assert sigma_of(BASE, "cam7.intrinsics") is None
    without = dataclasses.replace(BASE, blocks=(("gravity", 3),), covariance=np.eye(3))
    assert all(e.sigma is None for e in camera_estimates(without, 0))
    assert "unknown" in results_text(without)


def test_the_text_states_the_residuals_of_the_corners_used() -> None:
    made = make_calibration(1, True, frames=8, unused=0.2, rejected=0.1)
    camera = made.cameras[0]
    norms = np.linalg.norm(camera.residuals_px[camera.inlier & np.isfinite(camera.residuals_px[:, 0])], axis=1)
    line = next(line for line in results_text(made).splitlines() if line.startswith("Reprojection error (cam0) [px]"))
    numbers = [float(word.rstrip(",")) for word in line.split() if word[0].isdigit()]
    np.testing.assert_allclose(numbers, [norms.mean(), np.median(norms), norms.std()], rtol=1e-6)
    assert camera.reprojection_rms_px == pytest.approx(np.sqrt(np.mean(norms**2)))


def test_the_text_reads_as_kalibrs_does() -> None:
    text = results_text(BASE)
    headings = [
        "Calibration results\n===================",
        "Normalized Residuals\n",
        "Residuals\n",
        "baseline T_1_0:",
        "Transformation (cam0):",
        "T_ci:  (imu0 to cam0): ",
        "T_ic:  (cam0 to imu0): ",
        "timeshift cam0 to imu0: [s] (t_imu = t_cam + shift)",
        "Transformation (cam1):",
        "Gravity vector in target coords: [m/s^2]",
        "Calibration configuration\n",
        "IMU0\n",
    ]
    places = [text.index(heading) for heading in headings]
    assert places == sorted(places)
    assert f"{BASE.cameras[0].timeshift_cam_imu!r} +- " in text


def test_the_text_without_an_imu_speaks_of_none() -> None:
    made = make_calibration(2, False, frames=8, target=APRIL_GRID)
    text = results_text(dataclasses.replace(made, warnings=("cam1 saw little.",)))
    for word in ("imu0", "Gravity", "Transformation", "timeshift"):
        assert word not in text
    assert "baseline T_1_0:" in text
    assert "Type: aprilgrid" in text
    assert "- cam1 saw little." in text


def test_a_calibration_without_a_used_corner_can_be_told() -> None:
    text = results_text(make_calibration(1, False, frames=6, unused=1.0))
    assert "none used" in text
