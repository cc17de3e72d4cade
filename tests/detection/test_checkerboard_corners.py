"""Checkerboard corners: numbered the same way at every roll, in the right place, never mirrored."""

import cv2
import numpy as np
import pytest
from drawn_boards import View, board_to_pixel, draw_checkerboard
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import Checkerboard
from jaxcal.detection import find_corners
from jaxcal.detection.checkerboard import _colours_alternate

SIZE = (320, 240)
BOARD = Checkerboard(rows=4, cols=5, spacing=0.06)
ANGLES = st.floats(-np.pi, np.pi)
TILTS = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))


def view(board: Checkerboard, roll: float, tilt: tuple[float, float] = (0.0, 0.0), noise: float = 0) -> View:
    centre = (board.points[:, 0].mean(), board.points[:, 1].mean())
    return draw_checkerboard(board, board_to_pixel(centre, 1.05, roll, tilt, SIZE), SIZE, noise)


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


@given(roll=ANGLES, tilt=TILTS, shape=st.sampled_from([(4, 5), (5, 4), (3, 6), (6, 3)]))
@settings(deadline=None, max_examples=40)
def test_one_corner_has_one_number_at_any_roll(roll: float, tilt: tuple[float, float], shape: tuple[int, int]) -> None:
    board = Checkerboard(*shape, spacing=0.06)
    drawn = view(board, roll, tilt)
    point, pixels = find_corners(drawn.image, board)
    assert len(point) == len(board.points)
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.1


@given(roll=st.floats(-1.4, 1.4), tilt=TILTS, shape=st.sampled_from([(4, 6), (6, 4), (5, 5)]))
@settings(deadline=None, max_examples=25)
def test_boards_that_look_the_same_upside_down_are_numbered_nearest_to_upright(
    roll: float, tilt: tuple[float, float], shape: tuple[int, int]
) -> None:
    board = Checkerboard(*shape, spacing=0.06)
    # 5 x 5 is told from itself a quarter turn further by colour. An uneven view moves the direction in which a board
    # "stands" a little: 1.4 leaves a margin round 90 degrees.
    drawn = view(board, roll, (0.5 * tilt[0], 0.5 * tilt[1]))
    point, pixels = find_corners(drawn.image, board)
    assert len(point) == len(board.points)
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.1
    _, upside_down = find_corners(np.ascontiguousarray(drawn.image[::-1, ::-1]), board)
    turned = np.array(SIZE) - 1.0 - upside_down
    assert np.abs(turned[::-1] - pixels).max() < 0.1


@pytest.mark.parametrize("roll", [0.0, 0.7, -0.7])
def test_a_board_that_looks_the_same_at_each_quarter_turn(roll: float) -> None:
    board = Checkerboard(4, 4, spacing=0.06)
    drawn = view(board, roll)
    point, pixels = find_corners(drawn.image, board)
    assert len(point) == 16
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.1


@given(roll=st.floats(-1.4, 1.4), tilt=TILTS, cols=st.integers(3, 6))
@settings(deadline=None, max_examples=40)
def test_boards_of_three_rows_are_found_in_the_right_place_or_not_at_all(
    roll: float, tilt: tuple[float, float], cols: int
) -> None:
    board = Checkerboard(3, cols, spacing=0.06)
    drawn = view(board, roll, (0.5 * tilt[0], 0.5 * tilt[1]))
    point, pixels = find_corners(drawn.image, board)
    assert len(point) in (0, 3 * cols)
    assert np.all(np.abs(pixels - drawn.pixels[point]) < 0.1)


@pytest.mark.parametrize(("noise", "limit"), [(0, 0.02), (4, 0.03), (8, 0.04)])
def test_accuracy(noise: float, limit: float) -> None:
    errors, count = [], 0
    for k in range(8):
        drawn = view(BOARD, 0.8 * k, (0.1 * k - 0.4, 0.3 - 0.08 * k), noise)
        point, pixels = find_corners(drawn.image, BOARD)
        errors.append(pixels - drawn.pixels[point])
        count += len(point)
    assert count == 8 * len(BOARD.points)
    assert rms(np.concatenate(errors)) < limit
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.3 * limit


def test_refinement_stays_clear_of_neighbours_in_small_boards() -> None:
    board = Checkerboard(6, 9, spacing=0.02)
    centre = (board.points[:, 0].mean(), board.points[:, 1].mean())
    drawn = draw_checkerboard(board, board_to_pixel(centre, 1.0, 0.3, (0.2, 0.1), SIZE), SIZE)
    point, pixels = find_corners(drawn.image, board)
    assert len(point) == 54
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.1


def test_dim_blurred_and_uneven_light() -> None:
    drawn = view(BOARD, 0.2, (0.3, 0.0))
    shade = np.linspace(0.15, 0.5, SIZE[0])
    dim = np.clip(cv2.GaussianBlur(drawn.image, (0, 0), 1.5) * shade + 5, 0, 255).astype(np.uint8)
    point, pixels = find_corners(dim, BOARD)
    assert len(point) == len(BOARD.points)
    assert rms(pixels - drawn.pixels[point]) < 0.15  # black and white are 30 to 100 grey levels apart


@pytest.mark.parametrize("noise", [0, 20])
def test_no_board_no_corners(noise: float) -> None:
    rng = np.random.default_rng(2)
    blank = np.clip(rng.normal(120, noise, (SIZE[1], SIZE[0])), 0, 255).astype(np.uint8)
    point, pixels = find_corners(blank, BOARD)
    assert point.shape == (0,)
    assert pixels.shape == (0, 2)


def test_a_board_of_another_size_is_not_taken_for_this_one() -> None:
    point, _ = find_corners(view(BOARD, 0.0).image, Checkerboard(7, 8, spacing=0.06))
    assert len(point) == 0


@pytest.mark.parametrize("shift", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_grid_one_row_off_is_refused_however_noisy_the_white_margin(shift: tuple[int, int]) -> None:
    """As in event frames of boards partly out of view: the outline's corners in place of the missing row's.

    There the margin is a little darker than the white squares, and never quite even.
    """
    board = BOARD.points[:, :2]
    low, high = board.min(axis=0) - BOARD.spacing, board.max(axis=0) + BOARD.spacing
    outline = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])[:, None]
    for roll in np.linspace(-1.0, 1.0, 8):
        drawn = view(BOARD, roll, (0.2, -0.3), noise=6)
        to_pixel, _ = cv2.findHomography(board, drawn.pixels)
        inside = np.zeros_like(drawn.image)
        cv2.fillConvexPoly(inside, np.round(cv2.perspectiveTransform(outline, to_pixel)).astype(np.int32), 1)
        image = np.where(inside > 0, drawn.image, (0.9 * drawn.image).astype(np.uint8))
        for offset, expected in ((np.zeros(2), True), (BOARD.spacing * np.array(shift), False)):
            moved = cv2.perspectiveTransform((board + offset)[:, None], to_pixel)
            grid = np.asarray(moved).reshape(BOARD.rows, BOARD.cols, 2)
            assert _colours_alternate(image, grid) == expected
