"""The verdict changes when, and only when, something is wrong, and says what."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_calibration import make_calibration

from jaxcal.observations import Detections
from jaxcal.results import Calibration, judge
from jaxcal.results.coverage import CELLS_ACROSS, CELLS_DOWN, corner_counts, coverage

GOOD = make_calibration(2, True, frames=60)


def with_camera(index: int, **changes: Any) -> Calibration:
    cameras = list(GOOD.cameras)
    cameras[index] = dataclasses.replace(cameras[index], **changes)
    return dataclasses.replace(GOOD, cameras=tuple(cameras))


def with_imu(**changes: Any) -> Calibration:
    assert GOOD.imu is not None
    return dataclasses.replace(GOOD, imu=dataclasses.replace(GOOD.imu, **changes))


def with_sigma(block: str, factor: float) -> Calibration:
    scale = np.ones(len(GOOD.covariance))
    scale[GOOD._slice(block)] = factor
    return dataclasses.replace(GOOD, covariance=GOOD.covariance * np.outer(scale, scale))


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 10_000), cameras=st.integers(1, 3), imu=st.booleans())
def test_a_good_recording_is_called_good(seed: int, cameras: int, imu: bool) -> None:
    verdict = judge(make_calibration(cameras, imu, seed, frames=40))
    assert verdict.failed == ()
    assert verdict.level == "good"
    assert verdict.headline.startswith("Good.")


NO_SPOILING = ["corners kept, worst place", "target points' own error"]
RESIDUALS = GOOD.cameras[1].residuals_px
MODEL = GOOD.cameras[1].model
DEFECTS: dict[str, tuple[Callable[[float], Calibration], float, float, str]] = {
    # name: what makes it so, a size that weakens, a size that spoils, a word of the headline
    "reprojection error": (
        lambda f: with_camera(1, residuals_px=f * RESIDUALS, corner_sigma_px=f * 0.12), 10.0, 40.0, "misses"),
    "error over corner noise": (lambda f: with_camera(1, corner_sigma_px=0.12 / f), 2.0, 6.0, "noise"),
    "target points' own error": (
        lambda f: with_camera(1, residuals_px=RESIDUALS + shifts(f)), 0.15, 0.15, "target.yaml"),
    "corners kept": (lambda f: with_camera(1, inlier=every_other(1.0 - f)), 0.2, 0.7, "rejected"),
    "corners kept, worst place": (lambda f: with_camera(1, inlier=within(f)), 200.0, 200.0, "in one part of its"),
    "frames used": (lambda f: with_camera(1, residuals_px=first_frames(int(f))), 6, 2, "frames"),
    "image covered": (lambda f: with_camera(1, detections=shrunk(f)), 0.5, 0.01, "visited only"),
    "focal length 1-sigma": (lambda f: with_sigma("cam1.intrinsics", f), 20.0, 200.0, "focal length"),
    "projection 1-sigma, worst place": (lambda f: with_sigma("cam1.distortion", f), 20.0, 80.0, "projections"),
    "principal point": (lambda f: with_camera(1, model=shifted(f)), 400.0, 400.0, "principal point"),
    "pose to previous camera, 1-sigma": (lambda f: with_sigma("cam1.T_cn_cnm1", f), 50.0, 5000.0, "pose to previous"),
    "pose to IMU, 1-sigma": (lambda f: with_sigma("cam1.T_cam_imu", f), 40.0, 1000.0, "pose to IMU"),
    "time offset 1-sigma": (lambda f: with_sigma("cam1.timeshift_cam_imu", f), 300.0, 3000.0, "time offset"),
    "gyroscope error over noise": (lambda f: with_imu(gyro_sigma=2.4e-3 / f), 4.0, 30.0, "gyroscope"),
    "accelerometer error over noise": (lambda f: with_imu(accel_sigma=2.83e-2 / f), 4.0, 30.0, "accelerometer"),
    "gyroscope bias": (lambda f: with_imu(gyro_bias=np.full((3, 3), f)), 0.5, 2.0, "bias"),
    "accelerometer bias": (lambda f: with_imu(accel_bias=np.full((3, 3), -f)), 3.0, 8.0, "bias"),
    "size": (lambda f: dataclasses.replace(GOOD, gravity=np.array([0.0, -f, 0.0])), 9.6, 8.0, "gravity"),
    "convergence": (lambda f: dataclasses.replace(GOOD, converged=False), 1, 1, "before it converged"),
    "numbers": (lambda f: dataclasses.replace(GOOD, covariance=np.full_like(GOOD.covariance, np.nan)), 1, 1, "finite"),
}  # fmt: skip


def within(radius: float) -> np.ndarray:
    """Reject also the corners beyond a radius about the image's centre."""
    arm = GOOD.cameras[1].detections.pixels - np.array([319.5, 239.5])
    return GOOD.cameras[1].inlier & np.asarray(np.linalg.norm(arm, axis=1) < radius)


def every_other(keep: float) -> np.ndarray:
    return np.random.default_rng(0).random(len(RESIDUALS)) < keep


def shifts(pixels: float) -> np.ndarray:
    """An error of each target point that is the same in all frames."""
    angle = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(GOOD.target.points))
    return pixels * np.stack([np.cos(angle), np.sin(angle)], axis=1)[GOOD.cameras[1].detections.point]


def first_frames(count: int) -> np.ndarray:
    residuals = RESIDUALS.copy()
    residuals[GOOD.cameras[1].detections.frame >= count] = np.nan
    return residuals


def shrunk(factor: float) -> Detections:
    detections = GOOD.cameras[1].detections
    return dataclasses.replace(detections, pixels=300.0 + factor * (detections.pixels - 300.0))


def shifted(pixels: float) -> Any:
    parameters = MODEL.parameters
    return MODEL.with_parameters(parameters.at[2].add(pixels))


@pytest.mark.parametrize("title", sorted(set(DEFECTS) - {"principal point", "numbers", "convergence", *NO_SPOILING}))
def test_each_defect_weakens_and_then_spoils_the_result(title: str) -> None:
    make, weak, spoilt, word = DEFECTS[title]
    verdict = judge(make(weak))
    assert {check.title for check in verdict.failed} >= {title}
    assert verdict.level == "usable"
    assert verdict.headline.startswith("Usable, but ")
    verdict = judge(make(spoilt))
    assert verdict.level == "bad"
    assert verdict.headline.startswith("Do not use, because ")
    worst = [check for check in verdict.failed if check.level == "bad"]
    assert title in {check.title for check in worst}
    assert any(word in check.problem for check in worst)


@pytest.mark.parametrize("title", ["principal point", "numbers", "convergence"])
def test_some_defects_leave_no_middle(title: str) -> None:
    make, size, _, word = DEFECTS[title]
    verdict = judge(make(size))
    assert verdict.level == "bad"
    assert word in verdict.headline


@pytest.mark.parametrize("title", NO_SPOILING)
def test_some_defects_only_weaken_the_result(title: str) -> None:
    make, size, _, word = DEFECTS[title]
    verdict = judge(make(size))
    assert {check.title for check in verdict.failed} == {title}
    assert verdict.level == "usable"
    assert word in verdict.headline


def test_every_check_has_a_defect_that_fails_it() -> None:
    assert {check.title for check in judge(GOOD).checks} == set(DEFECTS)


def test_a_warning_alone_makes_it_usable_with_care() -> None:
    verdict = judge(dataclasses.replace(GOOD, warnings=("The rig hardly turned about x. Turn it.", "cam1 saw little.")))
    assert verdict.level == "usable"
    assert verdict.headline == "Usable, but the rig hardly turned about x, and 1 more finding below."
    alone = judge(dataclasses.replace(GOOD, warnings=("IMU samples are missing; 3 gaps.",)))
    assert alone.headline == "Usable, but IMU samples are missing."


def test_the_worst_finding_comes_first() -> None:
    both = dataclasses.replace(with_sigma("cam0.timeshift_cam_imu", 300.0), gravity=np.array([0.0, -3.0, 0.0]))
    verdict = judge(both)
    assert [check.level for check in verdict.failed] == ["bad", "usable"]
    assert "gravity comes out as 3.00" in verdict.headline
    assert verdict.failed[0].sentence == "The size of gravity comes out as 3.00 m/s²."
    assert verdict.failed[1].sentence.startswith("cam0's time offset")
    assert "1 more finding" in verdict.headline


def test_a_camera_without_corners_spoils_the_result() -> None:
    verdict = judge(make_calibration(1, False, frames=6, unused=1.0))
    assert verdict.level == "bad"


def test_a_large_sensor_is_judged_in_proportion() -> None:
    residuals = RESIDUALS * 1.6 / GOOD.cameras[1].reprojection_rms_px
    small = with_camera(1, residuals_px=residuals, corner_sigma_px=1.6 / np.sqrt(2))
    large = dataclasses.replace(small.cameras[1], image_size=(6000, 4000))
    titles = {check.title for check in judge(small).failed}
    assert "reprojection error" in titles
    large_titles = {check.title for check in judge(dataclasses.replace(small, cameras=(large,))).failed}
    assert "reprojection error" not in large_titles


def test_coverage_counts_the_cells_of_the_image() -> None:
    camera = GOOD.cameras[0]
    counts = corner_counts(camera)
    assert counts.shape == (CELLS_DOWN, CELLS_ACROSS)
    assert counts.sum() == camera.used.sum()
    corners = np.array([[0.0, 0.0], [639.0, 479.0], [-0.5, 479.5], [320.0, 1.0]])
    few = Detections(np.array([0]), np.zeros(4), np.arange(4), corners, (640, 480))
    made = dataclasses.replace(
        camera, detections=few, residuals_px=np.zeros((4, 2)), inlier=np.array([True, True, True, False])
    )
    counts = corner_counts(made)
    assert counts[0, 0] == counts[-1, -1] == counts[-1, 0] == 1
    assert counts.sum() == 3
    assert coverage(made) == pytest.approx(3 / (CELLS_ACROSS * CELLS_DOWN))
