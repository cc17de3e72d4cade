"""Poses of cameras and boards among each other, from who saw what together."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxcal import CalibrationError
from jaxcal.calibration.poses import Poses, inverse, product
from jaxcal.calibration.rig_graph import Sightings, hand_eye, rig_poses, solve_graph

seeds = st.integers(0, 2**31 - 1)
TOLERANCE_NS = 2_000_000


def random_poses(rng: np.random.Generator, count: int, turn: float = 1.0) -> Poses:
    return Rotation.from_rotvec(turn * rng.standard_normal((count, 3))).as_matrix(), rng.standard_normal((count, 3))


def pick(poses: Poses, index: np.ndarray) -> Poses:
    return poses[0][index], poses[1][index]


def rig(rng: np.random.Generator, cameras: int, boards: int, views: int, turn: float = 1.0) -> tuple[Poses, ...]:
    """T_cam_rig, T_target_board, T_target_rig; the first camera is the rig's frame, the first board the target's."""
    T_cam_rig, T_target_board = random_poses(rng, cameras), random_poses(rng, boards)
    for poses in (T_cam_rig, T_target_board):
        poses[0][0], poses[1][0] = np.eye(3), np.zeros(3)
    return T_cam_rig, T_target_board, random_poses(rng, views, turn)


def sighted(truth: tuple[Poses, ...], camera: int, view: np.ndarray, board: np.ndarray) -> Sightings:
    T_cam_rig, T_target_board, T_target_rig = truth
    pose = product(
        product(pick(T_cam_rig, np.array([camera])), inverse(pick(T_target_rig, view))), pick(T_target_board, board)
    )
    return Sightings(view, board, pose, np.full(len(view), 0.1))


def assert_found(truth: tuple[Poses, ...], sightings: list[Sightings], names: list[str]) -> None:
    T_cam_rig, T_target_board, T_target_rig = truth
    graph = solve_graph(names, sightings, len(T_target_board[0]), TOLERANCE_NS)
    for found, true in ((graph.T_cam_rig, T_cam_rig), (graph.T_target_board, T_target_board)):
        np.testing.assert_allclose(found[0], true[0], atol=1e-8)
        np.testing.assert_allclose(found[1], true[1], atol=1e-7)
    found = rig_poses(graph, sightings, len(T_target_rig[0]))
    seen = np.unique(np.concatenate([s.view for s in sightings]))
    np.testing.assert_allclose(found[0][seen], T_target_rig[0][seen], atol=1e-8)
    np.testing.assert_allclose(found[1][seen], T_target_rig[1][seen], atol=1e-7)


@settings(deadline=None, max_examples=20)
@given(seed=seeds)
def test_a_chain_of_cameras_that_share_views_in_pairs_is_found(seed: int) -> None:
    truth = rig(np.random.default_rng(seed), cameras=4, boards=1, views=30)
    views = [np.arange(0, 12), np.arange(20, 30), np.arange(8, 18), np.arange(15, 25)]
    sightings = [sighted(truth, c, view, np.zeros(len(view), dtype=int)) for c, view in enumerate(views)]
    assert_found(truth, sightings, ["left", "right", "up", "down"])


@settings(deadline=None, max_examples=20)
@given(seed=seeds)
def test_boards_that_one_camera_sees_together_tie_the_others(seed: int) -> None:
    """cam0 sees boards 0 and 1, cam1 boards 1 and 2 at times that overlap a little, and cam2 board 2."""
    truth = rig(np.random.default_rng(seed), cameras=3, boards=3, views=20)
    view = np.arange(10)
    sightings = [
        sighted(truth, 0, np.repeat(view, 2), np.tile([0, 1], 10)),
        sighted(truth, 1, np.repeat(np.arange(5, 15), 2), np.tile([1, 2], 10)),
        sighted(truth, 2, np.arange(10, 20), np.full(10, 2)),
    ]
    assert_found(truth, sightings, ["a", "b", "c"])


@settings(deadline=None, max_examples=20)
@given(seed=seeds)
def test_cameras_without_a_common_view_are_tied_by_the_rigs_motion(seed: int) -> None:
    truth = rig(np.random.default_rng(seed), cameras=2, boards=2, views=12)
    view = np.arange(12)
    sightings = [sighted(truth, c, view, np.full(12, c)) for c in range(2)]
    assert_found(truth, sightings, ["front", "back"])


@settings(deadline=None, max_examples=20)
@given(seed=seeds)
def test_hand_eye_says_when_the_rig_turned_about_one_axis_only(seed: int) -> None:
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    turns = Rotation.from_rotvec(rng.uniform(-1, 1, (15, 1)) * axis / np.linalg.norm(axis)).as_matrix()
    X, Z = random_poses(rng, 1), random_poses(rng, 1)
    first: Poses = (turns, rng.standard_normal((15, 3)))
    *_, clear = hand_eye(first, product(product(X, first), Z))
    assert clear < 1e-6
    first = random_poses(rng, 15)
    *_, clear = hand_eye(first, product(product(X, first), Z))
    assert clear > 0.02


def test_cameras_that_nothing_ties_are_named_with_the_recording_that_would() -> None:
    truth = rig(np.random.default_rng(0), cameras=3, boards=1, views=20)
    views = [np.arange(0, 10), np.arange(5, 12), np.arange(12, 20)]
    sightings = [sighted(truth, c, view, np.zeros(len(view), dtype=int)) for c, view in enumerate(views)]
    with pytest.raises(CalibrationError, match=r"rear never saw the board at the same time as left, right.*second"):
        solve_graph(["left", "right", "rear"], sightings, 1, TOLERANCE_NS)


def test_a_rig_that_hardly_turned_is_told_to_turn() -> None:
    truth = rig(np.random.default_rng(0), cameras=2, boards=2, views=20, turn=1e-3)
    sightings = [sighted(truth, c, np.arange(20), np.full(20, c)) for c in range(2)]
    with pytest.raises(CalibrationError, match=r"nothing ties back to front.*Turn it about two axes"):
        solve_graph(["front", "back"], sightings, 2, TOLERANCE_NS)


def test_a_board_that_is_never_seen_is_named() -> None:
    truth = rig(np.random.default_rng(0), cameras=1, boards=2, views=8)
    sightings = [sighted(truth, 0, np.arange(8), np.zeros(8, dtype=int))]
    with pytest.raises(CalibrationError, match="board 1 of the target was never seen"):
        solve_graph(["cam0"], sightings, 2, TOLERANCE_NS)


def test_boards_never_seen_together_are_named() -> None:
    truth = rig(np.random.default_rng(0), cameras=1, boards=2, views=8)
    sightings = [sighted(truth, 0, np.arange(8), np.arange(8) % 2)]
    with pytest.raises(CalibrationError, match="board 1 of the target was never seen together"):
        solve_graph(["cam0"], sightings, 2, TOLERANCE_NS)
