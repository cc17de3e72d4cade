"""Several boards in one image: each found by its own detector, numbered one after the other."""

import numpy as np
from drawn_boards import board_to_pixel, draw_aprilgrid, draw_charuco, draw_checkerboard, draw_circle_grid

from jaxcal import AprilGrid, Checkerboard
from jaxcal.detection import find_corners
from jaxcal.targets import BoardSet, Charuco, CircleGrid, Target

SIZE = (320, 240)
DRAW = {
    AprilGrid: draw_aprilgrid,
    Charuco: draw_charuco,
    Checkerboard: draw_checkerboard,
    CircleGrid: draw_circle_grid,
}


def side_by_side(boards: list[Target]) -> tuple[np.ndarray, list[np.ndarray]]:
    """One image that shows all boards, and each board's pixels."""
    views = []
    for k, board in enumerate(boards):
        centre = tuple(board.points[:, :2].mean(axis=0).tolist())
        to_pixel = board_to_pixel(centre, 0.95, 0.15 * k - 0.2, (0.1 * k, 0.2), SIZE)
        views.append(DRAW[type(board)](board, to_pixel, SIZE))
    image = np.concatenate([view.image for view in views], axis=1)
    return image, [view.pixels + np.array([SIZE[0] * k, 0.0]) for k, view in enumerate(views)]


def test_boards_of_all_kinds_at_once() -> None:
    boards = [
        Checkerboard(4, 5, 0.06),
        AprilGrid(3, 3, 0.08, 0.3, first_id=40),
        CircleGrid(7, 3, 0.05, asymmetric=True),
        AprilGrid(3, 3, 0.08, 0.3),
        Charuco(5, 6, 0.06, 0.045, "DICT_4X4_50"),
    ]
    image, pixels = side_by_side(boards)
    target = BoardSet(boards)
    point, found = find_corners(image, target)
    assert len(np.unique(point)) == len(point)
    truth = np.concatenate(pixels)
    assert np.abs(found - truth[point]).max() < 0.25
    seen = np.bincount(target.board_of_point[point], minlength=5)
    assert np.all(seen >= 0.9 * np.bincount(target.board_of_point))


def test_a_board_out_of_view_is_left_out() -> None:
    boards = [AprilGrid(3, 3, 0.08, 0.3), AprilGrid(3, 3, 0.08, 0.3, first_id=9)]
    image, pixels = side_by_side(boards[1:])
    point, found = find_corners(image, BoardSet(boards))
    assert point.min() >= 36
    assert np.abs(found - pixels[0][point - 36]).max() < 0.25


def test_the_ids_of_a_grid_say_which_one_it_is() -> None:
    grid, other = AprilGrid(3, 3, 0.08, 0.3, first_id=100), AprilGrid(3, 3, 0.08, 0.3)
    image, (pixels,) = side_by_side([grid])
    point, found = find_corners(image, grid)
    assert len(point) == 36
    assert np.abs(found - pixels[point]).max() < 0.25
    assert len(find_corners(image, other)[0]) == 0
