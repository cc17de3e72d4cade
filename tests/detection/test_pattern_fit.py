"""Corners by the board's pattern: better than gradients in a window, in any view, light and blur; never led astray."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from drawn_boards import View, board_to_pixel, draw_aprilgrid, draw_charuco, draw_checkerboard
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxcal import AprilGrid, CameraModel, Checkerboard
from jaxcal.cameras import PinholeEquidistant, PinholeRadtan
from jaxcal.detection import find_corners
from jaxcal.detection.board_view import fit_view
from jaxcal.detection.pattern_fit import _views, fitted_corners
from jaxcal.detection.refine import refine_corners
from jaxcal.targets import Charuco, Target

SIZE = (480, 360)
CHECKERBOARD = Checkerboard(rows=6, cols=7, spacing=0.05)
APRILGRID = AprilGrid(4, 5, 0.055, 0.3)
CHARUCO = Charuco(6, 7, 0.06, 0.045, "DICT_4X4_50")
RADTAN = PinholeRadtan.create((300.0, 300.0, 239.5, 179.5), (-0.3, 0.1, 0.0, 0.0))
FISHEYE = PinholeEquidistant.create((150.0, 150.0, 239.5, 179.5), (-0.05, 0.04, -0.08, 0.05))
DRAW: dict[type, Callable[..., View]] = {
    Checkerboard: draw_checkerboard,
    AprilGrid: draw_aprilgrid,
    Charuco: draw_charuco,
}


def view(board: Target, roll: float, tilt: tuple[float, float], noise: float, distance: float = 0.75) -> View:
    centre = tuple(board.points[:, :2].mean(axis=0).tolist())
    return DRAW[type(board)](board, board_to_pixel(centre, distance, roll, tilt, SIZE), SIZE, noise)


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def fit_pattern(image: np.ndarray, board: np.ndarray, pixels: np.ndarray, reach: tuple[float, float]) -> np.ndarray:
    return fitted_corners(image, board, pixels, reach)[0]


def grid(drawn: View, board: Target, reach: float = 0.02) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Corners well inside the image: their places on the board, their true pixels, and a reach."""
    inside = ((drawn.pixels > 15) & (drawn.pixels < np.array(SIZE) - 16)).all(axis=1)
    return board.points[inside, :2], drawn.pixels[inside], (reach, reach)


@given(
    board=st.sampled_from([CHECKERBOARD, APRILGRID, CHARUCO]),
    roll=st.floats(-1.2, 1.2),
    tilt=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    noise=st.floats(5, 20),
)
@settings(deadline=None, max_examples=30)
def test_errors_are_half_of_those_of_gradients_in_a_window(
    board: Target, roll: float, tilt: tuple[float, float], noise: float
) -> None:
    drawn = view(board, roll, tilt, noise)
    point, pixels = find_corners(drawn.image, board)
    assert len(point) >= 0.7 * len(grid(drawn, board)[0])
    true = drawn.pixels[point]
    spacing = np.linalg.norm(true[:, None] - true, axis=2)
    np.fill_diagonal(spacing, np.inf)
    half = np.clip(np.floor(0.4 * spacing.min(axis=1)), 2, 9).astype(np.int64)
    gradients, _ = refine_corners(drawn.image, true, half)
    assert rms(pixels - true) < 0.65 * rms(gradients - true) + 0.005
    assert np.abs(pixels - true).max() < 0.02 * noise + 0.05


@pytest.mark.parametrize("board", [CHECKERBOARD, APRILGRID, CHARUCO], ids=["checkerboard", "AprilGrid", "ChArUco"])
@pytest.mark.parametrize("light", ["from one side", "added from one side", "dim", "gamma", "blurred", "negative"])
def test_light_and_blur_move_no_corner(board: Target, light: str) -> None:
    drawn = view(board, 0.3, (0.3, -0.2), noise=0)
    known, true, _ = grid(drawn, board)
    reach = 0.4 * CHECKERBOARD.spacing if board is CHECKERBOARD else 0.0075
    ramp = np.linspace(0.2, 1.0, SIZE[0])
    grey = drawn.image.astype(np.float64)
    lit = {
        "from one side": grey * ramp,
        "added from one side": 0.5 * grey + 120 * ramp,
        "dim": 0.1 * grey + 10,
        "gamma": 255 * (grey / 255) ** 0.4,
        "blurred": cv2.GaussianBlur(grey, (0, 0), 1.5),
        "negative": 255 - grey,
    }[light]
    image = np.clip(np.round(lit), 0, 255).astype(np.uint8)
    found = fit_pattern(image, known, true + np.array([0.4, -0.3]), (reach, reach))
    # Light falls off across an edge: that shifts it by design of the image, not of the fit, by a tenth of a pixel.
    assert rms(found - true) < 0.06
    assert np.abs((found - true).mean(axis=0)).max() < 0.03


def test_straight_edges_through_a_curving_lens() -> None:
    """They are not straight in such an image."""
    drawn = view(CHECKERBOARD, 0.2, (0.2, 0.2), noise=0)
    centre, strength = (np.array(SIZE) - 1) / 2, 0.45 / 300**2
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    from_centre = np.stack([x, y], axis=-1) - centre
    source = centre + from_centre * (1 + strength * np.sum(from_centre**2, axis=-1, keepdims=True))
    u, v = np.moveaxis(source.astype(np.float32), -1, 0)
    image = cv2.remap(drawn.image, u, v, cv2.INTER_CUBIC)
    bent = drawn.pixels.copy()
    for _ in range(100):
        bent = centre + (drawn.pixels - centre) / (1 + strength * np.sum((bent - centre) ** 2, axis=1, keepdims=True))
    found = fit_pattern(image, CHECKERBOARD.points[:, :2], bent + 0.3, (0.02, 0.02))
    assert rms(found - bent) < 0.03


@given(which=st.integers(0, len(CHECKERBOARD.points) - 1), angle=st.floats(0, 2 * np.pi), distance=st.floats(1.5, 5.0))
@settings(deadline=None, max_examples=30)
def test_a_corner_out_of_place_is_found_where_its_neighbours_say(which: int, angle: float, distance: float) -> None:
    drawn = view(CHECKERBOARD, 0.2, (0.2, 0.2), noise=4)
    known, true, reach = grid(drawn, CHECKERBOARD)
    start = true.copy()
    start[which] += distance * np.array([np.cos(angle), np.sin(angle)])
    assert np.abs(fit_pattern(drawn.image, known, start, reach) - true).max() < 0.1


@pytest.mark.parametrize("turn", [0.5, 2.0, 3.5, 5.0])
def test_the_outermost_corner_far_out_of_place_bends_nothing(turn: float) -> None:
    """At the rim of the board a wrong corner bends the view of all; where it was, no edges meet."""
    drawn = view(CHECKERBOARD, 0.2, (0.2, 0.2), noise=4)
    known, true, reach = grid(drawn, CHECKERBOARD)
    start = true.copy()
    start[0] = drawn.pixels[[0, 1, CHECKERBOARD.cols, CHECKERBOARD.cols + 1]].mean(axis=0)  # in the middle of a square
    start[0] += np.array([np.cos(turn), np.sin(turn)])
    found, kept = fitted_corners(drawn.image, known, start, reach)
    assert kept.all()
    assert np.abs(found - true).max() < 0.1


def test_a_corner_whose_pattern_is_hidden_is_left_out() -> None:
    drawn = view(CHECKERBOARD, 0.2, (0.2, 0.2), noise=4)
    known, true, reach = grid(drawn, CHECKERBOARD)
    hidden = drawn.image.copy()
    cv2.circle(hidden, tuple(np.round(true[0]).astype(int).tolist()), 14, 120, -1)
    found, kept = fitted_corners(hidden, known, true, reach)
    assert not kept[0]
    assert kept[1:].all()
    assert np.abs(found - true)[kept].max() < 0.1


def test_a_corner_that_lies_outside_the_image_is_left_out() -> None:
    drawn = view(CHECKERBOARD, 0.2, (0.2, 0.2), noise=4)
    known, true, reach = grid(drawn, CHECKERBOARD)
    leftmost = int(np.argmin(true[:, 0]))
    cut = int(np.ceil(true[leftmost, 0])) + 3
    start = true - [cut, 0]
    start[leftmost, 0] += 25.0
    found, kept = fitted_corners(np.ascontiguousarray(drawn.image[:, cut:]), known, start, reach)
    assert not kept[leftmost]
    assert np.abs(found - true + [cut, 0])[kept].max() < 0.1


def test_corners_at_the_edge_of_the_image_are_not_trusted() -> None:
    drawn = view(CHECKERBOARD, 0.0, (0.0, 0.0), 0)
    for edge, trusted in ((4.0, False), (7.0, True)):
        cut = int(np.floor(drawn.pixels[0, 0] - edge))
        pixels = drawn.pixels[:1] - [cut, 0]
        refined, kept = refine_corners(np.ascontiguousarray(drawn.image[:, cut:]), pixels, np.array([9]))
        assert kept[0] == trusted
        if trusted:
            assert np.abs(refined - pixels).max() < 0.2


@pytest.mark.parametrize("grey", [np.zeros, np.ones, None], ids=["black", "one grey", "noise"])
def test_where_there_is_no_pattern_corners_stay(grey: Callable[..., np.ndarray] | None) -> None:
    known, true, reach = grid(view(CHECKERBOARD, 0.2, (0.2, 0.2), 0), CHECKERBOARD)
    noise = np.random.default_rng(3).integers(0, 255, (SIZE[1], SIZE[0])).astype(np.uint8)
    image = noise if grey is None else (120 * grey((SIZE[1], SIZE[0]))).astype(np.uint8)
    np.testing.assert_array_equal(fit_pattern(image, known, true, reach), true)


def test_too_few_corners_or_all_in_a_row_stay() -> None:
    drawn = view(CHECKERBOARD, 0.2, (0.2, 0.2), 0)
    known, true, reach = grid(drawn, CHECKERBOARD)
    for some in (slice(0, 5), slice(0, 7)):  # five, and the lowest row
        np.testing.assert_array_equal(fit_pattern(drawn.image, known[some], true[some], reach), true[some])


@pytest.mark.parametrize("shift", [(-140, 0), (140, 0), (0, -110), (0, 110)])
def test_windows_end_at_the_edge_of_the_image(shift: tuple[int, int]) -> None:
    drawn = view(CHECKERBOARD, 0.0, (0.1, 0.1), 0)
    image = cv2.warpAffine(drawn.image, np.array([[1.0, 0, shift[0]], [0, 1, shift[1]]]), SIZE)
    pixels = drawn.pixels + shift
    inside = ((pixels >= 0) & (pixels <= np.array(SIZE) - 1)).all(axis=1)
    assert 10 < inside.sum() < len(pixels)
    found = fit_pattern(image, CHECKERBOARD.points[inside, :2], pixels[inside] + 0.2, (0.02, 0.02))
    edge = np.minimum(pixels[inside], np.array(SIZE) - 1 - pixels[inside]).min(axis=1)
    assert np.abs(found - pixels[inside])[edge > 4].max() < 0.08
    assert np.abs(found - pixels[inside]).max() < 1.0


def test_the_same_image_gives_the_same_corners_and_the_start_is_left_alone() -> None:
    drawn = view(APRILGRID, 0.3, (0.2, 0.1), 10)
    known, true, reach = grid(drawn, APRILGRID, 0.0099)
    start = true.copy()
    first = fit_pattern(drawn.image, known, start, reach)
    np.testing.assert_array_equal(start, true)
    np.testing.assert_array_equal(first, fit_pattern(drawn.image, known, start, reach))
    other = fit_pattern(drawn.image, known, true + np.array([0.3, -0.2]), reach)
    assert np.abs(first - other).max() < 0.02  # wherever the search begins


@given(
    lens=st.sampled_from([RADTAN, FISHEYE]),
    turn=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-1.0, 1.0)),
    place=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(0.25, 0.6)),
)
@settings(deadline=None, max_examples=40)
def test_edges_bend_as_the_lens_bends_them(
    lens: CameraModel, turn: tuple[float, float, float], place: tuple[float, float, float]
) -> None:
    """What would move a corner is a wrong bend, to the same side on either side of it; at the board's rim, too."""
    R = Rotation.from_rotvec(turn).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    board = CHECKERBOARD.points[:, :2]

    def seen(places: np.ndarray) -> np.ndarray:
        points = np.column_stack([places, np.zeros(len(places))]) - CHECKERBOARD.points.mean(axis=0)
        return np.asarray(lens.project(points @ R.T + np.array(place)))

    true = seen(board)
    view = fit_view(board, true, SIZE)
    assert view is not None
    views = _views(board, true, view)
    reach = 0.4 * CHECKERBOARD.spacing
    scale = np.minimum(1.0, 10.0 / (reach * np.linalg.norm(views.linear, axis=1).max(axis=1)))
    wrong = []
    for along, up in ((1, 0), (0, 1), (1, 1), (1, -1)):
        step = reach * scale[:, None] * np.array([along, up])
        bend = views.offsets(step[:, :1], step[:, 1:])[:, 0] + views.offsets(-step[:, :1], -step[:, 1:])[:, 0]
        wrong.append(np.linalg.norm(bend - (seen(board + step) + seen(board - step) - 2 * true), axis=1))
    # A corner moves by a sixth of it. Few corners, at the rim, in a lens that bends more and more, see more of it.
    assert np.max(wrong) < 0.06 or (lens is FISHEYE and np.median(wrong) < 0.06)
