"""Errors that belong to target points are told from noise, whatever the roll of the frames."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic_calibration import make_calibration

from jaxcal.cameras import Pinhole
from jaxcal.observations import Detections
from jaxcal.results import CameraCalibration
from jaxcal.results.target_bias import target_bias
from jaxcal.targets import Checkerboard

BOARD = Checkerboard(rows=6, cols=9, spacing=0.05)


def seen_at_rolls(rolls: list[float], error: np.ndarray, noise_px: float, seed: int) -> CameraCalibration:
    """A head-on camera at 1 m, focal length 400 px; residuals are `error` (N, 2), m on the board, plus noise."""
    random = np.random.default_rng(seed)
    count = len(BOARD.points)
    pixels, residuals = [], []
    for roll in rolls:
        turn = (np.diag([1.0, -1.0, -1.0]) @ Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix())[:2, :2]
        pixels.append(320.0 + 400.0 * BOARD.points[:, :2] @ turn.T)
        residuals.append(400.0 * error @ turn.T + random.normal(0.0, noise_px, (count, 2)))
    frames = len(rolls)
    base = make_calibration(1, False, frames=4).cameras[0]
    return dataclasses.replace(
        base,
        model=Pinhole.from_focal(400.0, (640, 640)),
        image_size=(640, 640),
        detections=Detections(
            np.arange(frames), np.repeat(np.arange(frames), count), np.tile(np.arange(count), frames),
            np.concatenate(pixels), (640, 640),
        ),
        residuals_px=np.concatenate(residuals),
        inlier=np.ones(frames * count, dtype=bool),
        corner_sigma_px=noise_px,
    )  # fmt: skip


@settings(deadline=None, max_examples=20)
@given(rolls=st.lists(st.floats(-3.1, 3.1), min_size=5, max_size=12), seed=st.integers(0, 10_000))
def test_an_error_of_the_board_is_found_at_any_roll(rolls: list[float], seed: int) -> None:
    error = np.random.default_rng(seed).normal(0.0, 5e-4, (len(BOARD.points), 2))
    bias = target_bias(seen_at_rolls(rolls, error, 1e-9, seed), BOARD)
    np.testing.assert_array_equal(bias.point, np.arange(len(BOARD.points)))
    np.testing.assert_allclose(bias.mean_px, 400.0 * error, atol=1e-6)
    np.testing.assert_allclose(bias.rms_px, 400.0 * np.sqrt(np.mean(np.sum(error**2, axis=1))), rtol=1e-6)


@pytest.mark.parametrize("frames", [5, 40])
def test_noise_alone_is_no_error_of_the_board(frames: int) -> None:
    rolls = list(np.linspace(0.0, 1.0, frames))
    nothing = np.zeros((len(BOARD.points), 2))
    found = [target_bias(seen_at_rolls(rolls, nothing, 0.2, seed), BOARD).rms_px for seed in range(20)]
    # The means themselves would have an rms of 0.2 sqrt(2 / frames).
    assert np.mean(found) < 0.4 * 0.2 * np.sqrt(2.0 / frames)


def test_points_and_frames_seen_too_little_are_left_out() -> None:
    camera = seen_at_rolls([0.0] * 6, np.zeros((len(BOARD.points), 2)), 0.1, 0)
    inlier = camera.inlier.copy()
    inlier[camera.detections.point == 7] = False
    inlier[(camera.detections.frame == 0) & (camera.detections.point > 3)] = False
    bias = target_bias(dataclasses.replace(camera, inlier=inlier), BOARD)
    assert 7 not in bias.point
    assert len(bias.point) == len(BOARD.points) - 1  # five frames remain, which is enough for a mean
    inlier[camera.detections.frame < 2] = False
    bias = target_bias(dataclasses.replace(camera, inlier=inlier), BOARD)
    assert len(bias.point) == 0
    assert np.isnan(bias.rms_px)


def test_a_frame_that_shows_one_row_only_tells_nothing() -> None:
    camera = seen_at_rolls([0.0] * 8, np.full((len(BOARD.points), 2), 1e-3), 0.1, 0)
    bias = target_bias(dataclasses.replace(camera, inlier=camera.detections.point < 9), BOARD)
    assert len(bias.point) == 0
