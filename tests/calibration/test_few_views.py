"""Few views that tell most, and all the others that join them: chosen well, and nothing of their precision lost."""

import dataclasses

import numpy as np
import pytest
from posed_corners import BOARD, LENS, board_poses, seen

from jaxcal import calibrate_cameras
from jaxcal.calibration.assemble import camera_frames
from jaxcal.calibration.selection import most_informative_views
from jaxcal.calibration.solving import camera_problem

VIEWS = 32
NOISE_PX = 0.1


def dull_and_telling_views(rng: np.random.Generator) -> np.ndarray:
    """Board poses (100, 4, 4): most are far and frontal and tell little; every tenth is close and tilted."""
    dull = board_poses(rng, 90, BOARD, tilt_rad=0.05, distance_m=(2.0, 2.5))
    telling = board_poses(rng, 10, BOARD, tilt_rad=0.6, distance_m=(0.5, 0.8))
    return np.concatenate([dull, telling])[np.argsort(rng.random(100))]


def test_views_are_chosen_by_what_they_tell() -> None:
    rng = np.random.default_rng(31)
    poses = dull_and_telling_views(rng)
    frames = camera_frames(seen(LENS, poses, BOARD.points, NOISE_PX, rng), BOARD, "cam0")
    back = poses[:, :3, :3].swapaxes(-1, -2)
    problem, state = camera_problem(
        [LENS],
        [frames],
        BOARD,
        views=[frames.frames],
        weights=[np.ones(frames.seen.shape)],
        T_cam_rig=(np.eye(3)[None], np.zeros((1, 3))),
        T_target_rig=(back, -np.einsum("fij,fj->fi", back, poses[:, :3, 3])),
        loss_width=1.0,
    )
    chosen = most_informative_views(problem, state, VIEWS)
    assert len(chosen) == VIEWS
    assert set(np.flatnonzero(poses[:, 2, 3] < 1.5)) <= set(chosen)
    np.testing.assert_array_equal(most_informative_views(problem, state, VIEWS), chosen)


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [1, 2])
def test_a_start_with_few_views_ends_where_all_views_lead(cameras: int) -> None:
    """Outliers included: a tenth of the corners lies elsewhere in every fifth view."""
    rng = np.random.default_rng(31)
    poses, detections = dull_and_telling_views(rng), []
    for c in range(cameras):
        beside = poses.copy()
        beside[:, 0, 3] -= 0.1 * c
        clean = seen(LENS, beside, BOARD.points, NOISE_PX, rng)
        wrong = (clean.frame % 5 == 0) & (rng.random(len(clean)) < 0.1)
        away = rng.uniform(5.0, 30.0, (len(clean), 2)) * rng.choice([-1.0, 1.0], (len(clean), 2))
        detections.append(dataclasses.replace(clean, pixels=clean.pixels + wrong[:, None] * away))
    few = calibrate_cameras(detections, BOARD, views=10)
    everything = calibrate_cameras(detections, BOARD)
    assert few.converged
    for c in range(cameras):
        of_few, of_all = few.cameras[c], everything.cameras[c]
        sigma = everything.std(f"cam{c}.intrinsics")
        np.testing.assert_allclose(few.std(f"cam{c}.intrinsics"), sigma, rtol=0.02)
        apart = np.asarray(of_few.model.intrinsics) - np.asarray(of_all.model.intrinsics)
        assert np.all(np.abs(apart) < 0.05 * sigma)
        assert np.mean(of_few.used == of_all.used) > 0.999
    again = calibrate_cameras(detections, BOARD, views=10)
    np.testing.assert_array_equal(again.cameras[0].model.parameters, few.cameras[0].model.parameters)


def test_where_few_views_leave_a_camera_out_all_are_solved_at_once() -> None:
    """Two cameras that hardly share a view: three views cannot make a calibration of both."""
    rng = np.random.default_rng(7)
    poses, detections = board_poses(rng, 24, BOARD), []
    for c in range(2):
        beside = poses.copy()
        beside[:, 0, 3] -= 0.1 * c
        both = seen(LENS, beside, BOARD.points, NOISE_PX, rng)
        rows = (both.frame < 2) | (both.frame % 2 == c)
        own = {"frame": both.frame[rows], "point": both.point[rows], "pixels": both.pixels[rows]}
        detections.append(dataclasses.replace(both, **own))
    few, everything = (calibrate_cameras(detections, BOARD, views=number) for number in (3, None))
    for one, other in zip(few.cameras, everything.cameras, strict=True):
        np.testing.assert_array_equal(one.model.parameters, other.model.parameters)
