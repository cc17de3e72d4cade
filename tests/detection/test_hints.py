"""A target that is never found: the error says what is there instead."""

import cv2
import numpy as np
import pytest
from drawn_boards import board_to_pixel, draw_aprilgrid, draw_charuco, draw_checkerboard, draw_circle_grid

from jaxcal import AprilGrid, CalibrationError, Checkerboard, Frames, detect
from jaxcal.targets import Charuco, CircleGrid, Target

SIZE = (320, 240)
DRAW = {
    AprilGrid: draw_aprilgrid,
    Charuco: draw_charuco,
    Checkerboard: draw_checkerboard,
    CircleGrid: draw_circle_grid,
}


def frames_of(board: Target) -> Frames:
    centre = tuple(board.points[:, :2].mean(axis=0).tolist())
    images = [
        DRAW[type(board)](board, board_to_pixel(centre, 0.95, 0.1 * k, (0.1 * k, 0.2), SIZE), SIZE).image
        for k in range(3)
    ]
    return Frames(np.arange(3), images, SIZE)


@pytest.mark.parametrize(
    ("shown", "stated", "said"),
    [
        (
            Checkerboard(4, 5, 0.06),
            Checkerboard(5, 6, 0.06),
            "a checkerboard of 4 x 5 inner corners is there, in 3 of 3",
        ),
        (Checkerboard(5, 6, 0.05), Checkerboard(5, 7, 0.05), "a checkerboard of 5 x 6 inner corners is there"),
        (
            CircleGrid(7, 3, 0.05, asymmetric=True),
            CircleGrid(3, 7, 0.05, asymmetric=True),
            "an asymmetric grid of 7 rows x 3 columns of circles is there",
        ),
        (CircleGrid(4, 5, 0.06), CircleGrid(4, 5, 0.06, asymmetric=True), "a symmetric grid of 4 rows x 5 columns"),
        (
            AprilGrid(3, 3, 0.08, 0.3, first_id=20),
            AprilGrid(3, 3, 0.08, 0.3),
            "tags with ids 20 to 28 are there; the target has ids 0 to 8",
        ),
        (
            Charuco(6, 5, 0.05, 0.04, "DICT_4X4_50", legacy=True),
            Charuco(6, 5, 0.05, 0.04, "DICT_4X4_50"),
            "the board with the legacy pattern is there",
        ),
    ],
)
def test_what_is_there_instead_is_said(shown: Target, stated: Target, said: str) -> None:
    with pytest.raises(CalibrationError, match=r"left: .* was found in none of 3 frames") as caught:
        detect(frames_of(shown), stated, workers=1, name="left")
    assert said in str(caught.value)


def test_a_part_of_a_larger_board_is_refused() -> None:
    """OpenCV does find parts of boards where they have three rows."""
    with pytest.raises(CalibrationError, match=r"left: the board has more .* at least 4 x 5 were found in each of 3"):
        detect(frames_of(Checkerboard(4, 5, 0.06)), Checkerboard(3, 5, 0.06), workers=1, name="left")


def test_tags_with_a_narrow_border_are_named() -> None:
    image = np.full((240, 320), 235, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number, (x, y) in enumerate([(30, 30), (180, 30), (30, 140), (180, 140)], start=36):
        image[y : y + 80, x : x + 80] = cv2.aruco.generateImageMarker(dictionary, number, 80, None, 1)
    frames = Frames(np.arange(2), [image, image], SIZE)
    with pytest.raises(CalibrationError, match=r"ids 36 to 39 with a ONE-bit border, which is not Kalibr's"):
        detect(frames, AprilGrid(2, 2, 0.08, 0.3, first_id=36), workers=1)


def test_where_nothing_is_there_nothing_is_claimed() -> None:
    frames = Frames(np.arange(2), [np.full((240, 320), 110, np.uint8)] * 2, SIZE)
    for target in (Checkerboard(4, 5, 0.1), AprilGrid(2, 2, 0.1, 0.3), CircleGrid(4, 5, 0.1)):
        with pytest.raises(CalibrationError, match=r"was found in none of 2 frames\. Check the target"):
            detect(frames, target, workers=1)
