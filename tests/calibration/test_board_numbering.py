"""Wrong numberings are told from the corners alone, under any lens; symmetric boards get one numbering for all."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxcal import AprilGrid, CalibrationError, Checkerboard, Detections
from jaxcal.calibration.assemble import CameraFrames, camera_frames
from jaxcal.calibration.board_checks import check_board
from jaxcal.calibration.board_turns import symmetry_sentences, unify_turns
from jaxcal.targets import BoardSet, CircleGrid, Target

SIZE = (640, 480)
BOARDS = [
    Checkerboard(6, 9, 0.05),
    AprilGrid(5, 6, 0.05, 0.3),
    CircleGrid(8, 4, 0.04, asymmetric=True),
    CircleGrid(5, 7, 0.05),
]
IDS = ["checkerboard", "aprilgrid", "asymmetric circles", "circles"]


def poses(target: Target, count: int, seed: int, distance: float = 0.6) -> np.ndarray:
    """Poses (F, 4, 4) of a board that is turned, tilted and moved about before the camera, T_cam_target."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    for pose in T:
        tilt = Rotation.from_rotvec([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-3.1, 3.1)]).as_matrix()
        pose[:3, :3] = tilt @ np.diag([1.0, -1.0, -1.0])
        shift = np.array([*rng.uniform(-0.1, 0.1, 2), distance * rng.uniform(0.9, 1.3)])
        pose[:3, 3] = shift - pose[:3, :3] @ target.points.mean(axis=0)
    return T


def seen_by(target: Target, T_cam_target: np.ndarray, fisheye: bool, noise: float = 0.2) -> np.ndarray:
    """Pixels (F, N, 2) by a pinhole, or by an equidistant lens of short focal length."""
    rng = np.random.default_rng(7)
    points = np.einsum("fij,nj->fni", T_cam_target[:, :3, :3], target.points) + T_cam_target[:, None, :3, 3]
    radius = np.linalg.norm(points[..., :2], axis=-1)
    angle = np.arctan2(radius, points[..., 2])
    scale = 190.0 * angle if fisheye else 420.0 * np.tan(angle)
    pixels = points[..., :2] * (scale / np.maximum(radius, 1e-12))[..., None] + np.array([319.5, 239.5])
    return pixels + noise * rng.standard_normal(pixels.shape)


def frames_of(target: Target, pixels: np.ndarray, number: np.ndarray | None = None) -> CameraFrames:
    """Frames in which point i was given the number `number[i]` (N,) or `number[f, i]` (F, N)."""
    count = len(pixels)
    number = np.arange(pixels.shape[1]) if number is None else number
    inside = ((pixels > 0) & (pixels < np.array(SIZE) - 1)).all(axis=-1)
    frame, point = np.nonzero(inside)
    given = np.broadcast_to(number, inside.shape)[frame, point]
    detections = Detections(np.arange(count) * 100_000_000, frame, given, pixels[frame, point], SIZE)
    return camera_frames(detections, target, "cam0")


@pytest.mark.parametrize("board", BOARDS, ids=IDS)
@settings(deadline=None, max_examples=10)
@given(fisheye=st.booleans(), seed=st.integers(0, 1000))
def test_right_numbers_pass_in_silence(board: Target, fisheye: bool, seed: int) -> None:
    distance = 0.25 if fisheye else 0.6
    pixels = seen_by(board, poses(board, 12, seed, distance), fisheye)
    assert check_board("cam0", frames_of(board, pixels), board) == []


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("board", BOARDS, ids=IDS)
def test_points_numbered_from_the_top_are_a_mirrored_board(board: Target, fisheye: bool) -> None:
    pixels = seen_by(board, poses(board, 12, 1), fisheye)
    flipped = pixels * [1, -1] + [0, SIZE[1]]
    (sentence,) = check_board("left", frames_of(board, flipped), board)
    assert sentence.startswith("left: the corners are those of a MIRRORED board")
    assert "lower LEFT" in sentence


@pytest.mark.parametrize(
    ("true", "stated"),
    [
        (Checkerboard(6, 9, 0.05), Checkerboard(9, 6, 0.05)),
        (CircleGrid(5, 7, 0.05), CircleGrid(7, 5, 0.05)),
        (AprilGrid(4, 6, 0.05, 0.3), AprilGrid(6, 4, 0.05, 0.3)),
    ],
    ids=["checkerboard", "circles", "aprilgrid"],
)
def test_swapped_rows_and_columns_are_named(true: Target, stated: Target) -> None:
    pixels = seen_by(true, poses(true, 12, 2), False)
    if isinstance(true, AprilGrid) and isinstance(stated, AprilGrid):
        # Tags keep their ids; what changes is where the target thinks they are.
        number = np.empty(len(true.points), np.int64)
        for tag in true.ids:
            number[true.tag_points(tag)] = stated.tag_points(tag)
    else:
        number = np.arange(len(true.points))
    with pytest.raises(CalibrationError, match=r"rows and columns are swapped.*Swap them in the target"):
        check_board("cam0", frames_of(stated, pixels, number), stated)


def test_rows_of_another_length_are_named() -> None:
    true, stated = Checkerboard(8, 6, 0.05), Checkerboard(4, 12, 0.05)
    pixels = seen_by(true, poses(true, 12, 3), False)
    with pytest.raises(CalibrationError, match="fits a board with 6 in a row"):
        check_board("cam0", frames_of(stated, pixels), stated)


def test_numbers_along_columns_are_named() -> None:
    board = Checkerboard(6, 9, 0.05)
    pixels = seen_by(board, poses(board, 12, 4), False)
    down_the_columns = np.arange(54).reshape(9, 6).T.ravel()
    with pytest.raises(CalibrationError, match="along the board's columns"):
        check_board("cam0", frames_of(board, pixels, down_the_columns), board)


def test_some_mirrored_views_are_odd_and_many_are_inconsistent() -> None:
    board = BOARDS[0]
    pixels = seen_by(board, poses(board, 20, 5), False)
    from_the_top = np.arange(54).reshape(6, 9)[::-1].ravel()
    number = np.tile(np.arange(54), (20, 1))
    number[[3, 8]] = from_the_top
    (sentence,) = check_board("cam0", frames_of(board, pixels, number), board)
    assert "2 of 20 views show the board mirrored (frames 3, 8)" in sentence
    number[::2] = from_the_top
    with pytest.raises(CalibrationError, match=r"numbered differently from view to view: 1[0-2] of 20"):
        check_board("cam0", frames_of(board, pixels, number), board)


def test_scrambled_views_are_counted() -> None:
    board = BOARDS[0]
    pixels = seen_by(board, poses(board, 20, 6), False)
    number = np.tile(np.arange(54), (20, 1))
    number[4] = np.random.default_rng(0).permutation(54)
    (sentence,) = check_board("cam0", frames_of(board, pixels, number), board)
    assert "in 1 of 20 views" in sentence
    assert "frame 4" in sentence


@pytest.mark.parametrize("board", BOARDS, ids=IDS)
def test_a_fifth_of_the_corners_in_wrong_places_are_no_wrong_numbers(board: Target) -> None:
    pixels = seen_by(board, poses(board, 20, 7), False)
    rng = np.random.default_rng(1)
    hit = rng.random(pixels.shape[:2]) < 0.2
    shifted = pixels + rng.uniform(-35.0, 35.0, pixels.shape) * hit[..., None]
    for sentence in check_board("cam0", frames_of(board, shifted), board):
        assert re.search(r"in [1-7] of 20 views many corners are not", sentence)  # by chance, more than elsewhere
    (sentence,) = check_board("cam0", frames_of(board, shifted * [1, -1] + [0, SIZE[1]]), board)
    assert "MIRRORED" in sentence


def test_each_board_of_a_set_is_checked() -> None:
    boards = [AprilGrid(3, 4, 0.05, 0.3), AprilGrid(3, 4, 0.05, 0.3, first_id=12)]
    pixels = seen_by(boards[0], poses(boards[0], 12, 8), False)
    both = np.concatenate([pixels, pixels * [1, -1] + [0, SIZE[1]]], axis=1)
    target = BoardSet(boards)
    (sentence,) = check_board("cam0", frames_of(target, both), target)
    assert sentence.startswith("cam0, board 1: the corners are those of a MIRRORED")


# --- symmetric boards ------------------------------------------------------------------------------------------------


SYMMETRIC = [Checkerboard(6, 8, 0.05), Checkerboard(6, 6, 0.05), CircleGrid(8, 4, 0.04, asymmetric=True)]
T_CAM_REF = [
    np.eye(4),
    np.block(
        [[Rotation.from_rotvec([0.1, -0.3, 0.2]).as_matrix(), np.array([[-0.2], [0.02], [0.05]])], [np.eye(4)[3]]]
    ),
    # Rolled by half a turn: every one of its views is numbered upside down.
    np.block([[Rotation.from_rotvec([0.0, 0.1, 3.1]).as_matrix(), np.array([[0.1], [0.1], [0.0]])], [np.eye(4)[3]]]),
]


@pytest.mark.parametrize("board", SYMMETRIC, ids=["half turn", "quarter turns", "circles"])
@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 1000))
def test_cameras_agree_on_which_way_up_the_board_is(board: Target, seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = poses(board, 15, seed)
    shown = [np.arange(15), np.arange(2, 14), np.arange(4, 15)]
    cameras, found = [], []
    for T_cam_ref, frames in zip(T_CAM_REF, shown, strict=True):
        turn = rng.integers(0, len(board.turns), len(frames))
        number = board.turns[turn]
        true = T_cam_ref @ first[frames]
        # All corners count, also those that this camera would not see: only numbers matter here.
        pixels = seen_by(board, first[frames], False)
        cameras.append(frames_of(board, pixels, number))
        # The pose that explains the wrong numbers: points[number[i]] are where points[i] are.
        wrong = []
        for T, order in zip(true, number, strict=True):
            there = board.points @ T[:3, :3].T + T[:3, 3]
            centre, own = there.mean(axis=0), board.points[order]
            R = Rotation.align_vectors(there - centre, own - own.mean(axis=0))[0].as_matrix()
            normal = R if np.linalg.det(R) > 0 else -R
            wrong.append((normal, centre - normal @ own.mean(axis=0)))
        found.append((np.stack([R for R, _ in wrong]), np.stack([t for _, t in wrong])))
    result = unify_turns(["cam0", "cam1", "cam2"], cameras, shown, found, board)
    assert not result.sentences
    # Every camera now says the same of the board as camera 0 does, view by view.
    reference = {int(v): k for k, v in enumerate(shown[0])}
    for c in (1, 2):
        R0, t0 = result.poses[0]
        R, t = result.poses[c]
        for k, view in enumerate(shown[c]):
            j = reference[int(view)]
            np.testing.assert_allclose(R[k], T_CAM_REF[c][:3, :3] @ R0[j], atol=1e-6)
            np.testing.assert_allclose(t[k], T_CAM_REF[c][:3, :3] @ t0[j] + T_CAM_REF[c][:3, 3], atol=1e-6)
    # And the corners go with the poses: a turned view has its pixels under the new numbers.
    for before, after, turn in zip(cameras, result.cameras, result.turned, strict=True):
        for k in range(len(turn)):
            order = board.turns[turn[k]]
            np.testing.assert_array_equal(after.pixels[k, order], before.pixels[k])
            np.testing.assert_array_equal(after.seen[k, order], before.seen[k])
        again = camera_frames(after.detections, board, "cam0")
        np.testing.assert_array_equal(again.pixels, after.pixels)


def test_a_board_that_never_moves_leaves_a_guess() -> None:
    board = SYMMETRIC[0]
    first = np.repeat(poses(board, 1, 3), 8, axis=0)
    pixels = seen_by(board, first, False)
    cameras = [frames_of(board, pixels), frames_of(board, pixels)]
    found = [(T[:, :3, :3], T[:, :3, 3]) for T in (first, T_CAM_REF[1] @ first)]
    result = unify_turns(["left", "right"], cameras, [np.arange(8)] * 2, found, board)
    assert len(result.sentences) == 1
    assert "right: which way up it saw the board is a guess" in result.sentences[0]


def test_other_boards_are_left_alone() -> None:
    board = BOARDS[0]
    first = poses(board, 6, 3)
    cameras = [frames_of(board, seen_by(board, first, False))] * 2
    found = [(first[:, :3, :3], first[:, :3, 3])] * 2
    result = unify_turns(["left", "right"], cameras, [np.arange(6)] * 2, found, board)
    assert result.cameras == cameras
    assert result.sentences == []


def test_what_is_said_of_symmetric_boards() -> None:
    assert symmetry_sentences(SYMMETRIC[0], 1) == []
    assert symmetry_sentences(BOARDS[0], 2) == []
    (sentence,) = symmetry_sentences(SYMMETRIC[0], 2)
    assert "looks the same upside down" in sentence
