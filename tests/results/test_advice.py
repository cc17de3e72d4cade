"""What to record next: each lack of a recording is told, and a recording that lacks nothing is praised."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_calibration import make_calibration

from jaxcal.observations import Detections
from jaxcal.results import Calibration
from jaxcal.results.advice import advice


@pytest.fixture(scope="module")
def made() -> Calibration:
    return make_calibration(1, True, frames=40)


def with_views(made: Calibration, tilt_deg: np.ndarray, distance_m: np.ndarray, reach: float = 1.0) -> Calibration:
    """The calibration with one corner per frame, all over the middle part `reach` of the image, and these poses.

    `tilt_deg` (F, 2) turns the board about the image's x and y.
    """
    camera, count = made.cameras[0], len(tilt_deg)
    random = np.random.default_rng(0)
    spread = 0.5 + reach * (random.random((count, 2)) - 0.5)
    frame = np.arange(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    turns = Rotation.from_rotvec(np.radians(np.column_stack([tilt_deg, np.zeros(count)])))
    poses[:, :3, :3] = turns.as_matrix() @ np.diag([1.0, -1.0, -1.0])
    poses[:, 2, 3] = distance_m
    detections = Detections(frame * 10**8, frame, np.zeros(count, int), spread * [639, 479], (640, 480))
    changed = dataclasses.replace(
        camera,
        detections=detections,
        residuals_px=np.zeros((count, 2)),
        inlier=np.ones(count, bool),
        T_cam_target=poses,
    )
    return dataclasses.replace(made, cameras=(changed,), imu=None)


def views(
    count: int = 900, tilt: Any = (20.0, 20.0), near: float = 0.4, far: float = 1.2
) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(1)
    return random.normal(0.0, tilt, (count, 2)), random.uniform(near, far, count)


def test_a_recording_that_lacks_nothing_is_praised(made: Calibration) -> None:
    (sentence,) = advice(with_views(made, *views()))
    assert sentence.startswith("Nothing is missing")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"tilt": (5.0, 5.0)}, "tilt the board more"),
        ({"tilt": (25.0, 1.0)}, "tilt the board left and right too"),
        ({"tilt": (1.0, 25.0)}, "tilt the board up and down too"),
        ({"near": 0.5, "far": 0.55}, "vary the distance"),
    ],
)
def test_each_lack_of_the_views_is_told(made: Calibration, change: dict[str, Any], told: str) -> None:
    (sentence,) = advice(with_views(made, *views(**change)))
    assert sentence.startswith("cam0: ")
    assert told in sentence


def test_empty_parts_of_the_image_are_named(made: Calibration) -> None:
    (sentence,) = advice(with_views(made, *views(), reach=0.3))
    for place in ("upper left", "middle right", "lower centre"):
        assert place in sentence
    assert "and lower right of" in sentence
    assert ", centre" not in sentence


def test_a_lazy_motion_is_told_axis_by_axis(made: Calibration) -> None:
    assert made.imu is not None
    assert not any(sentence.startswith("imu0") for sentence in advice(made))
    still = made.imu.gyro_bias.copy()
    still[:, 1] = made.imu.gyro_predicted[:, 1]
    force = made.imu.accel_bias + np.array([0.0, 9.81, 0.0])
    lazy = dataclasses.replace(made.imu, gyro_predicted=still, accel_predicted=force)
    told = [s for s in advice(dataclasses.replace(made, imu=lazy)) if s.startswith("imu0")]
    assert "about x and z:" in told[0]
    assert "along x, y and z:" in told[1]
