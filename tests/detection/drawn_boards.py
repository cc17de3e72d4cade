"""Boards drawn for tests, with the true pixel of every corner: nothing here uses the code under test.

The board is drawn many times finer than the image, warped through a homography that includes the view, and reduced
by area averaging, as a sensor would.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from jaxcal import AprilGrid, Checkerboard
from jaxcal.targets import Charuco, CircleGrid

FINE = 6  # samples per pixel and axis


@dataclass(frozen=True)
class View:
    """A pinhole view of a board: the image (H, W) uint8 and where each of the target's points is (N, 2)."""

    image: np.ndarray
    pixels: np.ndarray


def board_to_pixel(
    centre: tuple[float, float], distance: float, roll: float, tilt: tuple[float, float], image_size: tuple[int, int]
) -> np.ndarray:
    """Homography from board metres to pixels of a camera of focal length 500 that looks at `centre` of the board.

    An upright board seen head-on (roll 0, tilt 0) appears upright: x right, y up. Angles in radians.
    """
    rotation = np.diag([1.0, -1.0, -1.0])
    for axis, angle in (((0, 0, 1), roll), ((1, 0, 0), tilt[0]), ((0, 1, 0), tilt[1])):
        rotation = cv2.Rodrigues(np.array(axis, np.float64) * angle)[0] @ rotation
    translation = np.array([0.0, 0.0, distance]) - rotation @ np.array([*centre, 0.0])
    focal = np.array([[500.0, 0.0, (image_size[0] - 1) / 2], [0.0, 500.0, (image_size[1] - 1) / 2], [0.0, 0.0, 1.0]])
    return focal @ np.column_stack([rotation[:, 0], rotation[:, 1], translation])


def apply(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    mapped = np.column_stack([points[:, :2], np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def render(
    drawing: np.ndarray, board_to_drawing: np.ndarray, to_pixel: np.ndarray, image_size: tuple[int, int], noise: float
) -> np.ndarray:
    """The image of a fine drawing (grey; `board_to_drawing` maps metres to its pixels) on a mid-grey background."""
    width, height = image_size
    finer = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    warp = finer @ to_pixel @ np.linalg.inv(board_to_drawing)
    fine = cv2.warpPerspective(drawing, warp, (width * FINE, height * FINE), flags=cv2.INTER_LINEAR, borderValue=110)
    image = cv2.resize(fine, image_size, interpolation=cv2.INTER_AREA).astype(np.float64)
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    image += np.random.default_rng(1).normal(0.0, noise, image.shape) if noise else 0.0
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def draw_checkerboard(board: Checkerboard, to_pixel: np.ndarray, image_size: tuple[int, int], noise: float = 0) -> View:
    """A checkerboard whose lower left square is black, with a white margin of one square."""
    cell = 60
    rows, cols = board.rows + 1, board.cols + 1
    squares = np.indices((rows, cols)).sum(axis=0) % 2  # row 0 is the lowest: 0 there is black
    drawing = np.full(((rows + 2) * cell, (cols + 2) * cell), 235, np.uint8)
    drawing[cell:-cell, cell:-cell] = np.kron(np.where(squares[::-1] == 0, 20, 235), np.ones((cell, cell)))
    scale = cell / board.spacing
    # The lower left INNER corner is the origin: two squares right and up of the drawing's lower left corner.
    to_drawing = np.array([[scale, 0, 2 * cell - 0.5], [0, -scale, (rows + 2) * cell - 2 * cell - 0.5], [0, 0, 1.0]])
    return View(render(drawing, to_drawing, to_pixel, image_size, noise), apply(to_pixel, board.points))


def draw_aprilgrid(grid: AprilGrid, to_pixel: np.ndarray, image_size: tuple[int, int], noise: float = 0) -> View:
    """Kalibr's AprilGrid, with its black squares where the gaps cross, on white paper."""
    bit = 10
    edge, gap = 10 * bit, round(10 * bit * grid.tag_spacing)
    pitch, margin = edge + gap, 2 * gap
    height, width = (grid.rows * pitch + gap + 2 * margin, grid.cols * pitch + gap + 2 * margin)
    drawing = np.full((height, width), 235, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for row in range(grid.rows + 1):
        for col in range(grid.cols + 1):
            x, y = margin + col * pitch, height - margin - row * pitch  # lower left of the crossing's black square
            drawing[y - gap : y, x : x + gap] = 20
            if row < grid.rows and col < grid.cols:
                number = grid.first_id + row * grid.cols + col
                tag = cv2.aruco.generateImageMarker(dictionary, number, edge, None, 2)
                upright = np.where(np.rot90(tag, 2) > 0, 235, 20)  # Kalibr prints them turned by half a turn
                drawing[y - gap - edge : y - gap, x + gap : x + gap + edge] = upright
    scale = edge / grid.tag_size
    to_drawing = np.array([[scale, 0, margin + gap - 0.5], [0, -scale, height - margin - gap - 0.5], [0, 0, 1.0]])
    return View(render(drawing, to_drawing, to_pixel, image_size, noise), apply(to_pixel, grid.points))


def draw_circle_grid(grid: CircleGrid, to_pixel: np.ndarray, image_size: tuple[int, int], noise: float = 0) -> View:
    """Black discs on white paper that reaches two spacings beyond the outer ones."""
    cell = 100
    scale = cell / grid.spacing
    reach = grid.points[:, :2].max(axis=0) * scale
    width, height = (int(np.ceil(length)) + 4 * cell for length in reach)
    drawing = np.full((height, width), 235, np.uint8)
    to_drawing = np.array([[scale, 0, 2 * cell], [0, -scale, height - 2 * cell], [0, 0, 1.0]])
    fraction_bits = 6
    radius = round(grid.circle_diameter / 2 * scale * 2**fraction_bits)
    for centre in apply(to_drawing, grid.points):
        at = tuple(int(v) for v in np.round(centre * 2**fraction_bits))
        cv2.circle(drawing, at, radius, (20,), -1, cv2.LINE_AA, fraction_bits)
    return View(render(drawing, to_drawing, to_pixel, image_size, noise), apply(to_pixel, grid.points))


def draw_charuco(board: Charuco, to_pixel: np.ndarray, image_size: tuple[int, int], noise: float = 0) -> View:
    """The board as OpenCV itself draws it, on white paper."""
    cell, margin = 80, 60
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    ids = np.array(board.ids, np.int32)
    size = (board.cols, board.rows)
    drawn = cv2.aruco.CharucoBoard(size, board.square_size, board.marker_size, dictionary, ids)
    drawn.setLegacyPattern(board.legacy)
    image = drawn.generateImage((board.cols * cell, board.rows * cell), None, 0, 1)
    drawing = np.pad(np.where(np.asarray(image) > 127, 235, 20).astype(np.uint8), margin, constant_values=235)
    scale = cell / board.square_size
    x, y = margin + cell - 0.5, margin + (board.rows - 1) * cell - 0.5  # of the lower left inner corner
    to_drawing = np.array([[scale, 0, x], [0, -scale, y], [0, 0, 1.0]])
    return View(render(drawing, to_drawing, to_pixel, image_size, noise), apply(to_pixel, board.points))
