"""AprilGrid corners against drawn truth: all tags, any roll, noise, partial views, no false ones."""

import cv2
import numpy as np
import pytest
from drawn_boards import View, board_to_pixel, draw_aprilgrid
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import AprilGrid, CalibrationError
from jaxcal.detection import find_corners

SIZE = (480, 360)
GRID = AprilGrid(rows=3, cols=4, tag_size=0.088, tag_spacing=0.3)


def view(
    roll: float,
    tilt: tuple[float, float] = (0.0, 0.0),
    noise: float = 0,
    distance: float = 0.95,
    centre: tuple[float, float] = (0.23, 0.16),
) -> View:
    return draw_aprilgrid(GRID, board_to_pixel(centre, distance, roll, tilt, SIZE), SIZE, noise)


def inside(pixels: np.ndarray, margin: float) -> np.ndarray:
    return ((pixels > margin) & (pixels < np.array(SIZE) - 1 - margin)).all(axis=1)


@given(roll=st.floats(-np.pi, np.pi), tilt=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)))
@settings(deadline=None, max_examples=20)
def test_every_corner_at_any_roll(roll: float, tilt: tuple[float, float]) -> None:
    drawn = view(roll, tilt)
    point, pixels = find_corners(drawn.image, GRID)
    assert len(point) >= 0.9 * inside(drawn.pixels, 5.0).sum()
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.1


@pytest.mark.parametrize(("noise", "limit"), [(3, 0.02), (10, 0.05)])
def test_accuracy_in_noise(noise: float, limit: float) -> None:
    errors = []
    for k in range(6):
        drawn = view(k, (0.15 * k - 0.4, 0.3 - 0.1 * k), noise)
        point, pixels = find_corners(drawn.image, GRID)
        assert len(point) >= 0.95 * inside(drawn.pixels, 5.0).sum()
        errors.append(pixels - drawn.pixels[point])
    error = np.concatenate(errors)
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < limit
    assert np.abs(error.mean(axis=0)).max() < 0.3 * limit


def test_partial_views_give_the_tags_in_view() -> None:
    drawn = view(0.4, distance=0.6, centre=(0.05, 0.05))
    point, pixels = find_corners(drawn.image, GRID)
    whole = [tag for tag in range(12) if inside(drawn.pixels[GRID.tag_points(tag)], 6.0).all()]
    assert 2 <= len(whole) < 12
    assert set(np.concatenate([GRID.tag_points(tag) for tag in whole])) <= set(point)
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.1


def test_covered_tags_are_left_out_and_their_neighbours_kept() -> None:
    drawn = view(0.0)
    image = drawn.image.copy()
    corners = drawn.pixels[GRID.tag_points(5)]
    low, high = np.floor(corners.min(axis=0)).astype(int), np.ceil(corners.max(axis=0)).astype(int)
    image[low[1] + 3 : high[1] - 3, low[0] + 3 : high[0] - 3] = 20
    point, pixels = find_corners(image, GRID)
    assert not set(GRID.tag_points(5)) & set(point)
    assert len(point) == 44
    assert np.abs(pixels - drawn.pixels[point]).max() < 0.1


def test_speckle_as_in_event_frames() -> None:
    drawn = view(0.3, (0.3, -0.2))
    rng = np.random.default_rng(5)
    image = np.where(rng.random(drawn.image.shape) < 0.06, 255 - drawn.image, drawn.image)
    point, pixels = find_corners(image, GRID)
    assert len(point) >= 44
    error = np.linalg.norm(pixels - drawn.pixels[point], axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.4


def test_inverted_and_small_grids() -> None:
    inverted = view(0.1)
    point, pixels = find_corners(255 - inverted.image, GRID)
    assert len(point) == 48
    assert np.abs(pixels - inverted.pixels[point]).max() < 0.1
    small = view(0.1, distance=2.8)  # tags of 16 pixels
    point, pixels = find_corners(small.image, GRID)
    assert len(point) >= 40
    assert np.abs(pixels - small.pixels[point]).max() < 0.25


def test_distorted_lens_keeps_its_outer_corners() -> None:
    drawn = view(0.0, (0.2, 0.2), distance=0.7)
    camera = np.array([[500.0, 0, 239.5], [0, 500.0, 179.5], [0, 0, 1]])
    lens = np.array([-0.35, 0.15, 0.0, 0.0])
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    ideal = cv2.undistortPoints(np.stack([u, v], axis=-1).reshape(-1, 1, 2), camera, lens, P=camera)
    x, y = np.moveaxis(ideal.reshape(SIZE[1], SIZE[0], 2).astype(np.float32), -1, 0)
    image = cv2.remap(drawn.image, x, y, cv2.INTER_LINEAR, borderValue=110)
    rays = np.column_stack([(drawn.pixels - camera[:2, 2]) / 500.0, np.ones(48)])
    truth = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera, lens)[0].reshape(-1, 2)
    point, pixels = find_corners(image, GRID)
    assert len(point) >= 0.95 * inside(truth, 8.0).sum()
    assert np.abs(pixels - truth[point]).max() < 0.15


@pytest.mark.parametrize("kind", ["noise", "checkerboard", "other tags"])
def test_nothing_is_found_where_no_grid_is(kind: str) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (SIZE[1], SIZE[0])).astype(np.uint8)
    if kind == "checkerboard":
        squares = np.indices((12, 16)).sum(axis=0) % 2
        image = np.kron(squares * 215 + 20, np.ones((30, 30))).astype(np.uint8)
    elif kind == "other tags":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        image = np.full((SIZE[1], SIZE[0]), 235, np.uint8)
        for k in range(12):
            tag = cv2.aruco.generateImageMarker(dictionary, 400 + k, 70, None, 2)
            row, col = divmod(k, 4)
            image[20 + row * 110 :][:70, 20 + col * 110 : 90 + col * 110] = tag
    point, _ = find_corners(image, GRID)
    assert len(point) == 0


def test_images_of_another_kind_are_refused() -> None:
    for image in (np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32)):
        with pytest.raises(CalibrationError, match="expected grey uint8"):
            find_corners(image, GRID)
