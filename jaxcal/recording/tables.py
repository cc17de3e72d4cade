"""Corners that another program detected: npz tables, and jaxcal's own detections files, as `Detections`."""

from pathlib import Path

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections
from jaxcal.recording.yaml_files import located
from jaxcal.targets import AprilGrid, Target

# Corner tables that give board coordinates must agree with the target to this distance, metres.
_BOARD_TOLERANCE_M = 1e-6


def load_detections(path: str | Path, target: Target, image_size: tuple[int, int] | None, prefix: str) -> Detections:
    """Read corners from jaxcal's own detections file, or from a table of another program.

    A table is an npz with, for each of M corners, `<prefix>_ns` (M,) the time of its frame, `<prefix>_uv` (M, 2) its
    pixel (centre of the top-left pixel at (0, 0)) and which corner it is: `<prefix>_point` (M,) index into
    `target.points`, or `<prefix>_tag_corner` (M, 2) AprilGrid tag id and corner id, anticlockwise from the tag's lower
    left. Optional: `<prefix>_frame_ns` (F,) the times of all frames, with or without corners; `<prefix>_board_xy_m`
    (M, 2) the corner on the board, which is compared with the target. `image_size` (width, height) is needed for a
    table; jaxcal's own file holds it.

    Raises CalibrationError when the file is missing, damaged, of another kind, or does not fit the target.
    """
    path = Path(path)
    table = _read(path)
    if "timestamps_ns" in table:
        detections = Detections.load(path)
        if image_size is not None and detections.image_size != image_size:
            raise CalibrationError(
                f"{path}: corners of {detections.image_size[0]}x{detections.image_size[1]} images, but the rig says "
                f"{image_size[0]}x{image_size[1]}. Correct the resolution, or leave it out."
            )
    else:
        if image_size is None:
            raise CalibrationError(
                f"{path}: a corner table does not tell the image size; give 'resolution' in the rig."
            )
        detections = _from_table(path, table, target, image_size, prefix)
    num_points = len(target.points)
    if len(detections) and detections.point.max() >= num_points:
        raise CalibrationError(
            f"{path}: corner {detections.point.max()} is named, but the target has {num_points} corners. Is it the "
            "target that was in front of the camera?"
        )
    return detections


def _read(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise CalibrationError(f"{path}: no such detections file.")
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception as error:  # numpy and zipfile report a damaged archive in many ways
        raise CalibrationError(f"{path}: not a readable npz file ({error}). Copy it again.") from error


def _from_table(
    path: Path, table: dict[str, np.ndarray], target: Target, image_size: tuple[int, int], prefix: str
) -> Detections:
    times, pixels = (_column(path, table, f"{prefix}_{name}") for name in ("ns", "uv"))
    if times.dtype.kind not in "iu":
        raise CalibrationError(f"{path}: '{prefix}_ns' has type {times.dtype}; expected int64 nanoseconds.")
    point = _points(path, table, target, prefix)
    if pixels.shape != (len(times), 2) or len(point) != len(times):
        raise CalibrationError(
            f"{path}: '{prefix}_ns' has {len(times)} rows, '{prefix}_uv' shape {pixels.shape} and {len(point)} corner "
            "names; expected one row per corner in each."
        )
    _check_inside(path, pixels, image_size, prefix)
    frame_times = np.union1d(times, table.get(f"{prefix}_frame_ns", times)).astype(np.int64)
    with located(str(path)):
        return Detections(frame_times, np.searchsorted(frame_times, times), point, pixels, image_size)


def _points(path: Path, table: dict[str, np.ndarray], target: Target, prefix: str) -> np.ndarray:
    """Index into `target.points` of each row, compared with the board coordinates where the table has them."""
    if f"{prefix}_point" in table:
        point = table[f"{prefix}_point"].astype(np.int64)
    else:
        point = _tag_corner_points(path, _column(path, table, f"{prefix}_tag_corner", f"{prefix}_point"), target)
    num_points = len(target.points)
    if len(point) and not 0 <= point.min() <= point.max() < num_points:
        raise CalibrationError(
            f"{path}: corners {point.min()} to {point.max()} are named, but the target has 0 to {num_points - 1}. Is "
            "it the target that was in front of the camera?"
        )
    board = table.get(f"{prefix}_board_xy_m")
    if board is not None and board.shape == (len(point), 2) and len(point):
        error = np.abs(target.points[point, :2] - board).max(axis=1)
        worst = int(np.argmax(error))
        if error[worst] > _BOARD_TOLERANCE_M:
            raise CalibrationError(
                f"{path}: row {worst} puts corner {point[worst]} at {board[worst]} m on the board, the target at "
                f"{target.points[point[worst], :2]} m. Correct the target's sizes, or the table's corner order."
            )
    return point


def _tag_corner_points(path: Path, tag_corner: np.ndarray, target: Target) -> np.ndarray:
    if not isinstance(target, AprilGrid):
        raise CalibrationError(f"{path}: the table names tags, but the target is a {type(target).__name__}.")
    first, last = target.ids[0], target.ids[-1]
    tags, corners = np.moveaxis(tag_corner.astype(np.int64).reshape(-1, 2), 1, 0)
    bad = (tags < first) | (tags > last) | (corners < 0) | (corners > 3)
    if bad.any():
        row = int(np.argmax(bad))
        raise CalibrationError(
            f"{path}: row {row} names tag {tags[row]}, corner {corners[row]}; the target has tags {first} to {last} "
            "with corners 0 to 3."
        )
    by_tag = np.stack([target.tag_points(tag) for tag in target.ids])
    return by_tag[tags - first, corners]


def _column(path: Path, table: dict[str, np.ndarray], name: str, alternative: str | None = None) -> np.ndarray:
    if name not in table:
        wanted = f"'{name}'" + (f" or '{alternative}'" if alternative else "")
        raise CalibrationError(
            f"{path}: {wanted} is missing; the file holds {', '.join(table)}. Check 'prefix' in the rig, or write the "
            "column."
        )
    return table[name]


def _check_inside(path: Path, pixels: np.ndarray, image_size: tuple[int, int], prefix: str) -> None:
    width, height = image_size
    outside = ((pixels < -0.5) | (pixels > np.array([width, height]) - 0.5)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise CalibrationError(
            f"{path}: '{prefix}_uv' row {row} is at {pixels[row]}, outside the {width}x{height} image. Check the "
            "resolution given for this camera."
        )
