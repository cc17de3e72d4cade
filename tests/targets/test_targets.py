"""Where a target's points are, Kalibr's numbering, and target.yaml."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from jaxcal.errors import CalibrationError
from jaxcal.targets import AprilGrid, Checkerboard, Target, load_target, target_from_yaml

lengths = st.floats(1e-3, 10.0)
checkerboards = st.builds(
    Checkerboard,
    rows=st.integers(2, 12),
    cols=st.integers(2, 12),
    spacing=lengths,
    col_spacing=st.one_of(st.none(), lengths),
)
april_grids = st.builds(
    AprilGrid, rows=st.integers(1, 12), cols=st.integers(1, 12), tag_size=lengths, tag_spacing=st.floats(0.05, 1.0)
)

APRILGRID_YAML = {"target_type": "aprilgrid", "tagCols": 6, "tagRows": 5, "tagSize": 0.088, "tagSpacing": 0.3}
CHECKERBOARD_YAML = {
    "target_type": "checkerboard",
    "targetCols": 9,
    "targetRows": 6,
    "rowSpacingMeters": 0.06,
    "colSpacingMeters": 0.05,
}


# --- points ----------------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.one_of(checkerboards, april_grids))
def test_points_are_a_grid_row_by_row_from_the_lower_left(target: Target) -> None:
    rows, cols = target.grid_shape
    assert target.points.shape == (rows * cols, 3)
    grid = target.points.reshape(rows, cols, 3)
    np.testing.assert_array_equal(grid[0, 0], 0.0)
    np.testing.assert_array_equal(grid[..., 2], 0.0)
    assert (np.diff(grid[..., 0], axis=1) > 0).all()
    assert (np.diff(grid[..., 1], axis=0) > 0).all()
    np.testing.assert_array_equal(grid[..., 0], np.broadcast_to(grid[0, :, 0], (rows, cols)))
    np.testing.assert_array_equal(grid[..., 1], np.broadcast_to(grid[:, 0, 1][:, None], (rows, cols)))


def test_checkerboard_points() -> None:
    points = Checkerboard(rows=3, cols=4, spacing=0.06, col_spacing=0.05).points
    np.testing.assert_allclose(points[5], [0.05, 0.06, 0.0])  # second row from below, second column
    np.testing.assert_allclose(points[-1], [0.15, 0.12, 0.0])
    np.testing.assert_allclose(Checkerboard(rows=3, cols=4, spacing=0.06).points[-1], [0.18, 0.12, 0.0])


@pytest.mark.parametrize(("rows", "cols", "symmetric"), [(6, 9, False), (7, 8, False), (6, 8, True), (5, 7, True)])
def test_a_board_with_equal_ends_looks_the_same_after_half_a_turn(rows: int, cols: int, symmetric: bool) -> None:
    board = Checkerboard(rows=rows, cols=cols, spacing=0.03)
    # (rows + 1) x (cols + 1) squares, black where row + column is even; half a turn reverses both.
    colours = np.add.outer(np.arange(rows + 1), np.arange(cols + 1)) % 2
    assert np.array_equal(colours, colours[::-1, ::-1]) is symmetric
    assert board.is_half_turn_symmetric is symmetric


@settings(max_examples=30, deadline=None)
@given(april_grids)
def test_a_tags_points_are_a_square_anticlockwise_from_its_lower_left(grid: AprilGrid) -> None:
    pitch = grid.tag_size * (1.0 + grid.tag_spacing)
    for tag in range(grid.rows * grid.cols):
        corners = grid.points[grid.tag_points(tag)]
        place = np.array([tag % grid.cols, tag // grid.cols, 0.0]) * pitch
        square = grid.tag_size * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        np.testing.assert_allclose(corners, place + square, atol=1e-12 + 1e-12 * pitch)
    every = np.concatenate([grid.tag_points(tag) for tag in range(grid.rows * grid.cols)])
    np.testing.assert_array_equal(np.sort(every), np.arange(len(grid.points)))


def test_kalibrs_numbering_of_a_6x6_grid() -> None:
    # Kalibr's documentation of the AprilGrid: corners are counted along a row of corners, 12 to a row.
    grid = jaxcal.AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)
    np.testing.assert_array_equal(grid.tag_points(0), [0, 1, 13, 12])
    np.testing.assert_array_equal(grid.tag_points(1), [2, 3, 15, 14])
    np.testing.assert_array_equal(grid.tag_points(6), [24, 25, 37, 36])
    np.testing.assert_array_equal(grid.tag_points(35), [130, 131, 143, 142])
    np.testing.assert_allclose(grid.points[2], [1.3 * 0.088, 0.0, 0.0])
    np.testing.assert_allclose(grid.points[143], [6 * 0.088 + 5 * 0.0264] * 2 + [0.0])


@pytest.mark.parametrize("tag", [-1, 30])
def test_a_tag_that_the_board_lacks(tag: int) -> None:
    with pytest.raises(CalibrationError, match=f"tag {tag} is not among its 30 tags"):
        AprilGrid(rows=5, cols=6, tag_size=0.088, tag_spacing=0.3).tag_points(tag)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Checkerboard(rows=0, cols=9, spacing=0.1), "Checkerboard: rows is 0; expected a whole number"),
        (lambda: Checkerboard(rows=6, cols=1, spacing=0.1), "2 x 2 inner corners"),
        (lambda: Checkerboard(rows=6, cols=9, spacing=0.0), "spacing is 0.0; expected a positive length"),
        (lambda: Checkerboard(rows=6, cols=9, spacing=float("nan")), "spacing is nan"),
        (lambda: Checkerboard(rows=6, cols=9, spacing=0.1, col_spacing=-0.1), "col_spacing is -0.1"),
        (lambda: Checkerboard(rows=6, cols=9, spacing=0.1, col_spacing=0.0), "col_spacing is 0.0"),
        (lambda: AprilGrid(rows=6, cols=-6, tag_size=0.1, tag_spacing=0.3), "AprilGrid: cols is -6"),
        (lambda: AprilGrid(rows=6, cols=6, tag_size=float("inf"), tag_spacing=0.3), "tag_size is inf"),
        (lambda: AprilGrid(rows=6, cols=6, tag_size=0.1, tag_spacing=0.0), "tag_spacing is 0.0"),
        (lambda: AprilGrid(rows=25, cols=25, tag_size=0.1, tag_spacing=0.3), "625 tags; the family 36h11 has 587"),
    ],
)
def test_impossible_boards_are_refused(made: Any, said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        made()


# --- target.yaml -----------------------------------------------------------------------------------------------------


def written(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "target.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@settings(max_examples=50, deadline=None)
@given(st.one_of(checkerboards, april_grids))
def test_yaml_round_trip(target: Target) -> None:
    again = target_from_yaml(yaml.safe_load(yaml.safe_dump(target.to_yaml())), "target.yaml")
    assert again == target
    np.testing.assert_array_equal(again.points, target.points)


def test_kalibrs_files_are_read(tmp_path: Path) -> None:
    assert load_target(written(tmp_path, APRILGRID_YAML)) == AprilGrid(rows=5, cols=6, tag_size=0.088, tag_spacing=0.3)
    assert load_target(written(tmp_path, CHECKERBOARD_YAML)) == Checkerboard(
        rows=6, cols=9, spacing=0.06, col_spacing=0.05
    )


def test_powers_of_ten_without_a_point_are_numbers(tmp_path: Path) -> None:
    path = tmp_path / "target.yaml"
    path.write_text("target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 88e-3\ntagSpacing: 3e-1\n")
    assert load_target(path) == AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)


@pytest.mark.parametrize("content", [APRILGRID_YAML, CHECKERBOARD_YAML], ids=["aprilgrid", "checkerboard"])
def test_every_missing_and_every_unreadable_value_is_named(tmp_path: Path, content: dict[str, Any]) -> None:
    for key in content:
        if key == "target_type":
            continue
        with pytest.raises(CalibrationError, match=f"target.yaml: '{key}' is missing"):
            load_target(written(tmp_path, {k: v for k, v in content.items() if k != key}))
        for value in ("six", None, [1, 2]):
            with pytest.raises(CalibrationError, match=f"target.yaml: '{key}' is .*expected a number"):
                load_target(written(tmp_path, content | {key: value}))


@pytest.mark.parametrize("count", [5.5, float("nan"), float("inf"), "5.5"])
def test_half_a_tag_is_not_rounded_away(tmp_path: Path, count: float | str) -> None:
    with pytest.raises(CalibrationError, match=r"'tagRows' is .*; expected a whole number"):
        load_target(written(tmp_path, APRILGRID_YAML | {"tagRows": count}))


def test_impossible_values_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"target.yaml: AprilGrid: tag_size is -0.088"):
        load_target(written(tmp_path, APRILGRID_YAML | {"tagSize": -0.088}))


def test_a_misspelt_key_gets_a_suggestion(tmp_path: Path) -> None:
    content = {("tagColls" if key == "tagCols" else key): value for key, value in APRILGRID_YAML.items()}
    with pytest.raises(CalibrationError, match=r"unknown key 'tagColls'. Did you mean 'tagCols'"):
        load_target(written(tmp_path, content))


@pytest.mark.parametrize("kind", ["dots", None])
def test_an_unknown_kind_of_target(tmp_path: Path, kind: str | None) -> None:
    with pytest.raises(CalibrationError, match=r"target_type is .*; known: aprilgrid, checkerboard"):
        load_target(written(tmp_path, APRILGRID_YAML | {"target_type": kind}))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"target_type: [aprilgrid", "not a yaml file"),
        (b"\xff\xfe\x00 not text", "not a yaml file"),
        (b"- a\n- b\n", "expected keys such as 'target_type: aprilgrid'"),
        (b"", "expected keys such as 'target_type: aprilgrid'"),
    ],
)
def test_files_that_are_no_target(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "target.yaml"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match=said) as caught:
        load_target(path)
    assert str(path) in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"absent.yaml: no such target file"):
        load_target(tmp_path / "absent.yaml")
