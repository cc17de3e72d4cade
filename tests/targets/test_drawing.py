"""Printed pages: true to size, found by our own detectors where they are drawn, and refused where they do not fit."""

import re
from pathlib import Path

import numpy as np
import pypdfium2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.detection import find_corners
from jaxcal.errors import CalibrationError
from jaxcal.targets import AprilGrid, BoardSet, Charuco, Checkerboard, CircleGrid, Target
from jaxcal.targets.drawing import PAGES, Sheet, draw_target
from jaxcal.targets.outline import outlines

DPI = 127.0  # 5 pixels per millimetre
PX_PER_MM = DPI / 25.4
MATRIX = {
    "aprilgrid": AprilGrid(4, 5, 0.024, 0.3),
    "aprilgrid from 100": AprilGrid(3, 3, 0.03, 0.25, first_id=100),
    "checkerboard": Checkerboard(6, 9, 0.02),
    "checkerboard of rectangles": Checkerboard(4, 5, 0.025, 0.03),
    "circles": CircleGrid(6, 7, 0.02),
    "asymmetric circles": CircleGrid(11, 4, 0.018, asymmetric=True),
    "charuco": Charuco(5, 7, 0.03, 0.022, "DICT_5X5_100"),
    "legacy charuco": Charuco(6, 5, 0.03, 0.022, "DICT_4X4_50", legacy=True, first_id=9),
}


def rasterised(path: Path, sheet: Sheet) -> np.ndarray:
    """The page as pixels; its true size in the file is the sheet's."""
    with pypdfium2.PdfDocument(path) as document:
        assert len(document) == 1
        points = document[0].get_size()
        np.testing.assert_allclose(np.array(points) * 25.4 / 72.0, [sheet.width_mm, sheet.height_mm], atol=1e-3)
        page = document[0].render(scale=DPI / 72.0, grayscale=True).to_numpy()
    return np.ascontiguousarray(page.reshape(page.shape[:2]))


def drawn_at(sheet: Sheet, board: Target, image: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of the board's points on the rasterised page; the first pixel's centre is at (0, 0)."""
    mm = 1000.0 * board.points[:, :2] + np.array(sheet.origin_mm)
    # The page is stretched to whole pixels.
    scale = np.array([image.shape[1] / sheet.width_mm, image.shape[0] / sheet.height_mm])
    return np.stack([mm[:, 0], sheet.height_mm - mm[:, 1]], axis=1) * scale - 0.5


@pytest.mark.parametrize("board", MATRIX.values(), ids=MATRIX)
def test_the_print_is_found_where_it_is_drawn(board: Target, tmp_path: Path) -> None:
    sheet = draw_target(board, tmp_path / "board.pdf")
    image = rasterised(tmp_path / "board.pdf", sheet)
    point, pixels = find_corners(image, board)
    np.testing.assert_array_equal(np.sort(point), np.arange(len(board.points)))
    error = pixels - drawn_at(sheet, board, image)[point]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.03


@pytest.mark.parametrize("board", MATRIX.values(), ids=MATRIX)
def test_the_svg_is_the_same_drawing(board: Target, tmp_path: Path) -> None:
    sheet = draw_target(board, tmp_path / "board.svg")
    text = (tmp_path / "board.svg").read_text()
    size = re.search(r'<svg[^>]* width="([\d.]+)pt" height="([\d.]+)pt"', text) or re.search(
        r'width="([\d.]+)pt" height="([\d.]+)pt"', text
    )
    assert size is not None
    np.testing.assert_allclose([float(v) * 25.4 / 72 for v in size.groups()], [sheet.width_mm, sheet.height_mm])
    # The first path is the page; the board's come next, the text and the ruler last.
    shapes = re.findall(r'<g id="patch_\d+">\s*<path d="([^"]+)"', text)[1:]
    corners = [np.array(re.findall(r"-?[\d.]+", shape), float).reshape(-1, 2) for shape in shapes]
    places = np.concatenate(corners) * 25.4 / 72
    ink = np.stack([places[:, 0], sheet.height_mm - places[:, 1]], axis=1) - np.array(sheet.origin_mm)
    if isinstance(board, CircleGrid):
        assert len(shapes) == len(board.points)
        reach = 500.0 * board.circle_diameter
        np.testing.assert_allclose(ink.min(axis=0), [-reach, -reach], atol=1e-3)
        np.testing.assert_allclose(ink.max(axis=0), 1000 * board.points[:, :2].max(axis=0) + reach, atol=1e-3)
    else:
        outer = {AprilGrid: "tag_size", Checkerboard: "spacing", Charuco: "square_size"}[type(board)]
        rim = 1000.0 * getattr(board, outer)
        if isinstance(board, AprilGrid):
            rim *= board.tag_spacing
        across = 1000.0 * (board.col_spacing or 0.0) if isinstance(board, Checkerboard) else rim
        np.testing.assert_allclose(ink[:, 1].min(), -rim, atol=1e-3)
        np.testing.assert_allclose(ink[:, 0].min(), -across, atol=1e-3)


@pytest.mark.parametrize("page", ["A4", "letter", "A3", "300x250"])
def test_the_ruler_is_100_mm_long_on_every_page(page: str, tmp_path: Path) -> None:
    sheet = draw_target(Checkerboard(4, 5, 0.02), tmp_path / "board.pdf", page)
    image = rasterised(tmp_path / "board.pdf", sheet)
    size = PAGES.get(page, (300.0, 250.0))
    assert sorted([sheet.width_mm, sheet.height_mm]) == sorted(size)
    # The marks at its ends are the highest dark columns beside the text, at the height of their upper half.
    px_per_mm = image.shape[1] / sheet.width_mm
    base = image.shape[0] - 10.0 * px_per_mm
    ends = image[round(base - 2.7 * px_per_mm) : round(base - 1.8 * px_per_mm)].mean(axis=0)
    dark = 255.0 - ends
    columns = np.arange(len(dark))
    left, right = (dark * (columns < len(dark) / 2), dark * (columns >= len(dark) / 2))
    length = np.average(columns, weights=right) - np.average(columns, weights=left)
    assert length / px_per_mm == pytest.approx(100.0, abs=0.1)


def test_pages_are_chosen_and_turned(tmp_path: Path) -> None:
    path = tmp_path / "board.pdf"
    assert draw_target(Checkerboard(4, 5, 0.02), path).page == "A4"
    assert draw_target(Checkerboard(4, 12, 0.02), path).width_mm == 297.0  # lying
    assert draw_target(Checkerboard(12, 4, 0.02), path).width_mm == 210.0
    assert draw_target(AprilGrid(6, 6, 0.03, 0.3), path).page == "A3"
    assert draw_target(AprilGrid(6, 6, 0.088, 0.3), path).page == "A0"
    assert draw_target(AprilGrid(6, 6, 0.15, 0.3), path, "1300x1400").page == "custom"


@pytest.mark.parametrize(
    ("board", "page", "said"),
    [
        (AprilGrid(6, 6, 0.03, 0.3), "A4", "does not fit on A4 .*; A3 would hold it"),
        (AprilGrid(6, 6, 0.2, 0.3), "auto", r"does not fit on A0; give a page of at least 1\d\d\dx1\d\d\d mm"),
        (AprilGrid(6, 6, 0.2, 0.3), "A0", "give a page of at least"),
        (Checkerboard(4, 5, 0.02), "100x100", "does not fit on 100x100 .*A4 would hold it"),
        (Checkerboard(4, 5, 0.02), "A9", "page 'A9' is unknown; give auto, letter, A4"),
        (BoardSet([AprilGrid(2, 2, 0.02, 0.3), Checkerboard(4, 5, 0.02)]), "auto", "draw each of its `boards`"),
    ],
)
def test_what_cannot_be_drawn_is_refused(board: Target, page: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=said):
        draw_target(board, tmp_path / "board.pdf", page)
    assert not (tmp_path / "board.pdf").exists()


def test_other_kinds_of_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"board\.png: the drawing's name must end in \.pdf or \.svg"):
        draw_target(Checkerboard(4, 5, 0.02), tmp_path / "board.png")


@pytest.mark.parametrize("kind", ["pdf", "svg"])
def test_the_same_board_gives_the_same_file(kind: str, tmp_path: Path) -> None:
    for name in ("a", "b"):
        draw_target(MATRIX["charuco"], tmp_path / f"{name}.{kind}")
    assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 7), st.integers(1, 7), st.integers(0, 2**31))
def test_outlines_enclose_the_black_cells_and_nothing_else(rows: int, cols: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    black = rng.random((rows, cols)) < 0.5
    x, y = np.cumsum(rng.uniform(0.1, 1.0, cols + 1)), np.cumsum(rng.uniform(0.1, 1.0, rows + 1))
    loops = outlines(x, y, black)
    middles = np.stack(np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2), axis=-1)
    winding = np.zeros((rows, cols), int)
    for loop in loops:
        following = np.roll(loop, -1, axis=0)
        assert np.all((loop == following).sum(axis=1) == 1)  # along the grid's lines, no point twice
        for (x0, y0), (_, y1) in zip(loop, following, strict=True):
            to_the_right = middles[..., 0] < x0
            winding += np.where(to_the_right & (middles[..., 1] > y0) & (middles[..., 1] < y1), 1, 0)
            winding -= np.where(to_the_right & (middles[..., 1] < y0) & (middles[..., 1] > y1), 1, 0)
    np.testing.assert_array_equal(winding, black.astype(int))
