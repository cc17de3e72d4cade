"""Circle grids: numbered the same way at every roll where they can be, and centres free of the ellipses' bias."""

import cv2
import numpy as np
import pytest
from drawn_boards import View, board_to_pixel, draw_circle_grid
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.detection import find_corners
from jaxcal.targets import CircleGrid

SIZE = (320, 240)
TILTS = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
DIRECTED = [CircleGrid(7, 3, 0.05, asymmetric=True), CircleGrid(5, 4, 0.045, asymmetric=True, diameter=0.036)]
SYMMETRIC = [CircleGrid(4, 5, 0.06), CircleGrid(5, 4, 0.06), CircleGrid(6, 3, 0.05, asymmetric=True)]


def view(grid: CircleGrid, roll: float, tilt: tuple[float, float] = (0.0, 0.0), noise: float = 0) -> View:
    centre = tuple(grid.points[:, :2].mean(axis=0).tolist())
    return draw_circle_grid(grid, board_to_pixel(centre, 0.95, roll, tilt, SIZE), SIZE, noise)


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


@given(roll=st.floats(-np.pi, np.pi), tilt=TILTS, grid=st.sampled_from(DIRECTED))
@settings(deadline=None, max_examples=25)
def test_one_circle_has_one_number_at_any_roll(roll: float, tilt: tuple[float, float], grid: CircleGrid) -> None:
    drawn = view(grid, roll, tilt)
    point, pixels = find_corners(drawn.image, grid)
    assert len(point) == len(grid.points)
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.03


@given(roll=st.floats(-1.4, 1.4), tilt=TILTS, grid=st.sampled_from(SYMMETRIC))
@settings(deadline=None, max_examples=25)
def test_grids_that_look_the_same_upside_down_are_numbered_nearest_to_upright(
    roll: float, tilt: tuple[float, float], grid: CircleGrid
) -> None:
    drawn = view(grid, roll, (0.5 * tilt[0], 0.5 * tilt[1]))
    point, pixels = find_corners(drawn.image, grid)
    assert len(point) == len(grid.points)
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.03


@pytest.mark.parametrize("roll", [0.0, 0.6, -0.6])
def test_a_grid_that_looks_the_same_at_each_quarter_turn(roll: float) -> None:
    grid = CircleGrid(4, 4, 0.06)
    drawn = view(grid, roll)
    point, pixels = find_corners(drawn.image, grid)
    assert len(point) == 16
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.03


@pytest.mark.parametrize(("noise", "limit"), [(0, 0.01), (4, 0.03), (8, 0.05)])
def test_accuracy(noise: float, limit: float) -> None:
    errors = []
    for k, grid in enumerate(DIRECTED * 4):
        drawn = view(grid, 0.8 * k, (0.1 * k - 0.4, 0.3 - 0.08 * k), noise)
        point, pixels = find_corners(drawn.image, grid)
        assert len(point) == len(grid.points)
        errors.append(pixels - drawn.pixels[point])
    assert rms(np.concatenate(errors)) < limit
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.3 * limit


def test_large_circles_seen_obliquely_are_not_biased() -> None:
    """There the ellipses' own centres are wrong by far more than what is measured."""
    grid = CircleGrid(3, 4, 0.12, diameter=0.1)
    size = (640, 480)
    centre = (0.18, 0.12)
    to_pixel = board_to_pixel(centre, 0.6, 0.2, (0.9, 0.3), size)
    drawn = draw_circle_grid(grid, to_pixel, size)
    inverse = np.linalg.inv(to_pixel)
    bias = []
    for x, y, _ in grid.points:
        circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - 0.05**2]])
        ellipse = inverse.T @ circle @ inverse
        own_centre = -np.linalg.solve(ellipse[:2, :2], ellipse[:2, 2])
        bias.append(own_centre - (to_pixel @ [x, y, 1.0])[:2] / (to_pixel @ [x, y, 1.0])[2])
    point, pixels = find_corners(drawn.image, grid)
    assert len(point) == 12
    assert rms(np.array(bias)) > 1.0
    assert rms(pixels - drawn.pixels[point]) < 0.03


def test_uneven_light_moves_no_centre() -> None:
    grid = DIRECTED[0]
    drawn = view(grid, 0.2, (0.3, 0.1))
    light = np.linspace(0.3, 1.0, SIZE[0])[None] * np.linspace(1.0, 0.7, SIZE[1])[:, None]
    point, pixels = find_corners(np.round(drawn.image * light).astype(np.uint8), grid)
    assert len(point) == len(grid.points)
    assert rms(pixels - drawn.pixels[point]) < 0.03


@pytest.mark.parametrize("noise", [0, 20])
def test_no_grid_no_centres(noise: float) -> None:
    rng = np.random.default_rng(2)
    blank = np.clip(rng.normal(120, noise, (SIZE[1], SIZE[0])), 0, 255).astype(np.uint8)
    point, pixels = find_corners(blank, DIRECTED[0])
    assert point.shape == (0,)
    assert pixels.shape == (0, 2)


def test_a_mirrored_image_of_a_directed_grid_with_even_rows_is_refused() -> None:
    """Half a turn takes this grid to itself, a mirror does not."""
    grid = SYMMETRIC[2]
    longer = CircleGrid(8, 3, 0.045, asymmetric=True)
    for board in (grid, longer):
        mirrored = np.ascontiguousarray(cv2.flip(view(board, 0.2).image, 1))
        point, pixels = find_corners(mirrored, board)
        # A lattice of equal length and width is its own mirror image at a quarter turn.
        if board is longer:
            assert len(point) == 0
        else:
            assert len(point) == len(pixels) == len(board.points)
