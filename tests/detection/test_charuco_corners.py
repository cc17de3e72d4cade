"""ChArUco corners: the right numbers at any roll and in parts of the board, with every way to print it."""

import cv2
import numpy as np
import pytest
from drawn_boards import View, board_to_pixel, draw_charuco
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.detection import find_corners
from jaxcal.targets import Charuco
from jaxcal.targets.charuco import DICTIONARIES

SIZE = (480, 360)
BOARDS = [
    Charuco(5, 7, 0.06, 0.045, "DICT_4X4_50"),
    Charuco(6, 5, 0.06, 0.042, "DICT_5X5_100", legacy=True, first_id=7),
    Charuco(6, 5, 0.06, 0.045, "DICT_6X6_250", first_id=100),
    Charuco(4, 6, 0.06, 0.045, "DICT_APRILTAG_36h11"),
]


def view(board: Charuco, roll: float, tilt: tuple[float, float] = (0.0, 0.0), noise: float = 0) -> View:
    centre = tuple(board.points[:, :2].mean(axis=0).tolist())
    return draw_charuco(board, board_to_pixel(centre, 0.85, roll, tilt, SIZE), SIZE, noise)


@given(
    roll=st.floats(-np.pi, np.pi),
    tilt=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    board=st.sampled_from(BOARDS),
)
@settings(deadline=None, max_examples=30)
def test_one_corner_has_one_number_at_any_roll(roll: float, tilt: tuple[float, float], board: Charuco) -> None:
    drawn = view(board, roll, tilt)
    point, pixels = find_corners(drawn.image, board)
    inside = ((drawn.pixels > 20) & (drawn.pixels < np.array(SIZE) - 21)).all(axis=1)
    assert len(point) >= 0.7 * inside.sum()
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.25


@pytest.mark.parametrize(("noise", "limit"), [(0, 0.02), (4, 0.03), (8, 0.05)])
def test_accuracy(noise: float, limit: float) -> None:
    errors = []
    for k, board in enumerate(BOARDS * 2):
        drawn = view(board, 0.8 * k, (0.1 * k - 0.4, 0.3 - 0.08 * k), noise)
        point, pixels = find_corners(drawn.image, board)
        assert len(point) >= 0.8 * len(board.points)
        errors.append(pixels - drawn.pixels[point])
    together = np.concatenate(errors)
    assert np.sqrt(np.mean(np.sum(together**2, axis=1))) < limit
    assert np.abs(together.mean(axis=0)).max() < 0.5 * limit


def test_parts_of_a_board_keep_their_numbers() -> None:
    drawn = view(BOARDS[0], 0.3)
    half = drawn.image.copy()
    half[:, : SIZE[0] // 2] = 110
    point, pixels = find_corners(half, BOARDS[0])
    assert 6 <= len(point) < len(BOARDS[0].points)
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.25


def test_another_range_of_ids_is_another_board() -> None:
    other = Charuco(5, 7, 0.06, 0.045, "DICT_4X4_50", first_id=25)
    assert len(find_corners(view(BOARDS[0], 0.3).image, other)[0]) < 4
    assert len(find_corners(view(other, 0.3).image, other)[0]) == len(other.points)


def test_no_board_no_corners() -> None:
    point, pixels = find_corners(np.full((SIZE[1], SIZE[0]), 120, np.uint8), BOARDS[0])
    assert point.shape == (0,)
    assert pixels.shape == (0, 2)


@pytest.mark.parametrize("name", sorted(DICTIONARIES))
def test_dictionaries_are_what_opencv_has(name: str) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    assert DICTIONARIES[name] == (dictionary.markerSize, len(dictionary.bytesList))


@pytest.mark.parametrize("board", BOARDS, ids=[board.dictionary for board in BOARDS])
def test_corners_and_markers_are_where_opencv_has_them(board: Charuco) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    theirs = cv2.aruco.CharucoBoard(
        (board.cols, board.rows), board.square_size, board.marker_size, dictionary, np.array(board.ids, np.int32)
    )
    theirs.setLegacyPattern(board.legacy)
    assert list(np.ravel(theirs.getIds())) == list(board.ids)
    corners = np.reshape(theirs.getChessboardCorners(), (-1, 3)).astype(np.float64)
    # OpenCV's x runs right and y down from the board's outer corner.
    from_lower_left = (corners * [1, -1, 1] + [0, board.rows * board.square_size, 0]) - board.square_size * np.array(
        [1, 1, 0]
    )
    ours = board.points.reshape(*board.grid_shape, 3)[::-1].reshape(-1, 3)
    np.testing.assert_allclose(from_lower_left, ours, atol=1e-6)
    centres = np.array([np.reshape(marker, (4, 3)).mean(axis=0)[:2] for marker in theirs.getObjPoints()])
    squares = np.floor(centres / board.square_size).astype(int)
    np.testing.assert_array_equal(squares[:, ::-1], np.argwhere(board.white_squares))
