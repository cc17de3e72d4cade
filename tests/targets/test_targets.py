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
from jaxcal.targets import (
    AprilGrid,
    BoardSet,
    Charuco,
    Checkerboard,
    CircleGrid,
    Target,
    artwork_of,
    load_target,
    target_from_yaml,
)

lengths = st.floats(1e-3, 10.0)
checkerboards = st.builds(
    Checkerboard,
    rows=st.integers(2, 12),
    cols=st.integers(2, 12),
    spacing=lengths,
    col_spacing=st.one_of(st.none(), lengths),
)
april_grids = st.builds(
    AprilGrid,
    rows=st.integers(1, 12),
    cols=st.integers(1, 12),
    tag_size=lengths,
    tag_spacing=st.floats(0.05, 1.0),
    first_id=st.sampled_from([0, 17]),
)
circle_grids = st.builds(
    lambda rows, cols, spacing, asymmetric, fill: CircleGrid(
        rows, cols, spacing, asymmetric, None if fill is None else fill * spacing
    ),
    rows=st.integers(2, 12),
    cols=st.integers(2, 12),
    spacing=lengths,
    asymmetric=st.booleans(),
    fill=st.one_of(st.none(), st.floats(0.1, 0.95)),
)
charucos = st.builds(
    lambda rows, cols, size, fill, legacy, first: Charuco(
        rows, cols, size, fill * size, "DICT_5X5_1000", legacy, first
    ),
    rows=st.integers(3, 12),
    cols=st.integers(3, 12),
    size=lengths,
    fill=st.floats(0.5, 0.95),
    legacy=st.booleans(),
    first=st.sampled_from([0, 30]),
)
single_boards = st.one_of(checkerboards, april_grids, circle_grids, charucos)
# Tags and markers are of different families, so that these are always told apart.
sets_of_boards = st.tuples(checkerboards, april_grids, circle_grids, charucos)

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
@given(single_boards)
def test_points_are_a_grid_row_by_row_from_the_lower_left(target: Target) -> None:
    rows, cols = target.grid_shape
    assert target.points.shape == (rows * cols, 3)
    grid = target.points.reshape(rows, cols, 3)
    np.testing.assert_array_equal(grid[0, 0], 0.0)
    np.testing.assert_array_equal(grid[..., 2], 0.0)
    assert (np.diff(grid[..., 0], axis=1) > 0).all()
    assert (np.diff(grid[..., 1], axis=0) > 0).all()
    if isinstance(target, CircleGrid) and target.asymmetric:
        shift = np.where(np.arange(rows) % 2 == 1, target.spacing, 0.0)
        np.testing.assert_allclose(grid[..., 0] - shift[:, None], np.broadcast_to(grid[0, :, 0], (rows, cols)))
        return
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
    for number, tag in enumerate(grid.ids):
        corners = grid.points[grid.tag_points(tag)]
        place = np.array([number % grid.cols, number // grid.cols, 0.0]) * pitch
        square = grid.tag_size * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        np.testing.assert_allclose(corners, place + square, atol=1e-12 + 1e-12 * pitch)
    every = np.concatenate([grid.tag_points(tag) for tag in grid.ids])
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
        (lambda: AprilGrid(6, 6, 0.1, 0.3, first_id=-1), "AprilGrid: first_id is -1"),
        (lambda: AprilGrid(6, 6, 0.1, 0.3, first_id=560), "ids 560 to 595; the family 36h11 ends at 586"),
        (lambda: CircleGrid(1, 5, 0.1), "at least 2 x 2 circles"),
        (lambda: CircleGrid(4, 5, 0.0), "spacing is 0.0"),
        (lambda: CircleGrid(4, 5, 0.1, diameter=0.1), "run into each other"),
        (lambda: CircleGrid(4, 5, 0.1, asymmetric=True, diameter=0.15), "run into each other"),
        (lambda: Charuco(2, 5, 0.1, 0.07, "DICT_4X4_50"), "3 x 3 squares"),
        (lambda: Charuco(5, 7, 0.1, 0.1, "DICT_4X4_50"), "does not fit into a square"),
        (lambda: Charuco(5, 7, 0.1, 0.07, "DICT_4X4"), "dictionary is 'DICT_4X4'; known: DICT_4X4_100"),
        (lambda: Charuco(12, 12, 0.1, 0.07, "DICT_4X4_50"), "72 markers, ids 0 to 71; DICT_4X4_50 has 50"),
        (lambda: BoardSet([Checkerboard(6, 9, 0.1)]), "1 boards; a set has at least 2"),
        (lambda: BoardSet([AprilGrid(2, 2, 0.1, 0.3)] * 2), "0 and 1 cannot be told apart.*ids 0 to 3"),
        (
            lambda: BoardSet([AprilGrid(2, 2, 0.1, 0.3), Charuco(4, 4, 0.1, 0.07, "DICT_APRILTAG_36h11", first_id=3)]),
            "DICT_APRILTAG_36h11 ids 3 to 3",
        ),
        (lambda: BoardSet([Checkerboard(6, 9, 0.1), Checkerboard(4, 5, 0.1)]), "a part of the larger one looks like"),
        (
            lambda: BoardSet([BoardSet([AprilGrid(2, 2, 0.1, 0.3), Checkerboard(6, 9, 0.1)]), CircleGrid(4, 5, 0.1)]),
            "cannot hold another set",
        ),
        (lambda: AprilGrid(rows=25, cols=25, tag_size=0.1, tag_spacing=0.3), "625 tags; the family 36h11 has 587"),
    ],
)
def test_impossible_boards_are_refused(made: Any, said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        made()


# --- turns and sets of boards ----------------------------------------------------------------------------------------


def black_at(board: Target, places: np.ndarray) -> np.ndarray:
    """Whether the print is black at places (M, 2)."""
    artwork = artwork_of(board)
    column = np.searchsorted(artwork.x_lines, places[:, 0]) - 1
    row = np.searchsorted(artwork.y_lines, places[:, 1]) - 1
    inside = (column >= 0) & (column < artwork.black.shape[1]) & (row >= 0) & (row < artwork.black.shape[0])
    black = np.zeros(len(places), bool)
    black[inside] = artwork.black[row[inside], column[inside]]
    for discs in artwork.discs:
        black |= (np.linalg.norm(places[:, None] - discs.centres[None], axis=-1) < discs.radius).any(axis=1)
    return black


@settings(max_examples=40, deadline=None)
@given(single_boards, st.integers(0, 100))
def test_turns_are_exactly_those_that_the_print_allows(board: Target, seed: int) -> None:
    """Every half and quarter turn about the middle of the points is in `turns` if and only if the print agrees."""
    middle = 0.5 * (board.points.min(axis=0) + board.points.max(axis=0))[:2]
    artwork = artwork_of(board)
    reach = max(np.ptp(artwork.x_lines), np.ptp(artwork.y_lines))
    places = middle + np.random.default_rng(seed).uniform(-0.5, 0.5, (2000, 2)) * reach
    seen = {tuple(turn) for turn in board.turns.tolist()}
    assert tuple(range(len(board.points))) in seen
    count = 1
    for quarters in (1, 2, 3):
        c, s = [(0, 1), (-1, 0), (0, -1)][quarters - 1]
        turn = np.array([[c, -s], [s, c]])
        moved = (board.points[:, :2] - middle) @ turn.T + middle
        distance = np.linalg.norm(moved[:, None] - board.points[None, :, :2], axis=-1)
        same_print = np.array_equal(black_at(board, places), black_at(board, (places - middle) @ turn.T + middle))
        if distance.min(axis=1).max() < 1e-9 * reach and same_print:
            assert tuple(distance.argmin(axis=1).tolist()) in seen
            count += 1
    assert count == len(seen)
    assert board.is_half_turn_symmetric is (count > 1)


@settings(max_examples=10, deadline=None)
@given(sets_of_boards)
def test_a_set_lists_its_boards_points_one_after_the_other(members: tuple[Target, ...]) -> None:
    boards = BoardSet(members)
    assert boards.boards == members
    np.testing.assert_array_equal(boards.points, np.concatenate([board.points for board in boards.boards]))
    for number, board in enumerate(boards.boards):
        np.testing.assert_array_equal(boards.points[boards.board_of_point == number], board.points)
        assert board.boards == (board,)
        np.testing.assert_array_equal(board.board_of_point, np.zeros(len(board.points)))
    with pytest.raises(CalibrationError, match="ask each of its `boards`"):
        _ = boards.grid_shape


def test_kalibrs_asymmetric_grid() -> None:
    # GridCalibrationTargetCirclegrid.cpp: ((2 c + r % 2) spacing, r spacing).
    points = CircleGrid(11, 4, 0.02, asymmetric=True).points
    np.testing.assert_allclose(points[4 * 3 + 2], [0.02 * 5, 0.06, 0.0])
    np.testing.assert_allclose(points[4 * 4 + 2], [0.02 * 4, 0.08, 0.0])


# --- target.yaml -----------------------------------------------------------------------------------------------------


def written(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "target.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@settings(max_examples=50, deadline=None)
@given(st.one_of(single_boards, sets_of_boards))
def test_yaml_round_trip(one_or_several: Target | tuple[Target, ...]) -> None:
    target = BoardSet(one_or_several) if isinstance(one_or_several, tuple) else one_or_several
    again = target_from_yaml(yaml.safe_load(yaml.safe_dump(target.to_yaml())), "target.yaml")
    assert again == target
    np.testing.assert_array_equal(again.points, target.points)


def test_kalibrs_files_are_read(tmp_path: Path) -> None:
    assert load_target(written(tmp_path, APRILGRID_YAML)) == AprilGrid(rows=5, cols=6, tag_size=0.088, tag_spacing=0.3)
    assert load_target(written(tmp_path, CHECKERBOARD_YAML)) == Checkerboard(
        rows=6, cols=9, spacing=0.06, col_spacing=0.05
    )


def test_kalibrs_circle_grid_and_our_own_kinds_are_read(tmp_path: Path) -> None:
    kalibr = {
        "target_type": "circlegrid",
        "targetCols": 4,
        "targetRows": 11,
        "spacingMeters": 0.02,
        "asymmetricGrid": True,
    }
    grid = CircleGrid(11, 4, 0.02, asymmetric=True)
    assert load_target(written(tmp_path, kalibr)) == grid
    charuco = {
        "target_type": "charuco",
        "squareRows": 5,
        "squareCols": 7,
        "squareSize": 0.03,
        "markerSize": 0.022,
        "dictionary": "DICT_5X5_100",
    }
    board = Charuco(5, 7, 0.03, 0.022, "DICT_5X5_100")
    assert load_target(written(tmp_path, charuco)) == board
    both = load_target(written(tmp_path, {"target_type": "boards", "boards": [kalibr, charuco]}))
    assert both == BoardSet([grid, board])
    second = APRILGRID_YAML | {"firstTagId": 40}
    assert load_target(written(tmp_path, second)) == AprilGrid(5, 6, 0.088, 0.3, first_id=40)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"target_type": "boards", "boards": APRILGRID_YAML}, "'boards' is .*expected a list of targets"),
        ({"target_type": "boards", "boards": [APRILGRID_YAML, {}]}, "'boards': board 1: target_type is None"),
        (
            {"target_type": "boards", "boards": [APRILGRID_YAML, APRILGRID_YAML]},
            "target.yaml: BoardSet: boards 0 and 1 cannot be told apart",
        ),
        (
            CircleGrid(4, 5, 0.1).to_yaml() | {"asymmetricGrid": "no"},
            "'asymmetricGrid' is 'no'; expected true or false",
        ),
        (Charuco(4, 5, 0.1, 0.07, "DICT_4X4_50").to_yaml() | {"dictionary": 4}, "'dictionary' is 4; expected a name"),
        (CircleGrid(4, 5, 0.1).to_yaml() | {"diameter": 4}, "unknown key 'diameter'.*may have circleDiameterMeters"),
    ],
)
def test_wrong_values_of_the_new_kinds_are_named(tmp_path: Path, content: dict[str, Any], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        load_target(written(tmp_path, content))


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
