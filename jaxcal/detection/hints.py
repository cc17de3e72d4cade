"""Is another target there than the one described: a row more or less, other tags, another pattern?"""

import dataclasses

import cv2
import numpy as np

from jaxcal.detection.corners import find_corners
from jaxcal.observations import Frames
from jaxcal.targets import AprilGrid, Charuco, Checkerboard, CircleGrid, Target

_LOOKED_AT = 8  # frames, evenly over the recording
_PROBES = 3  # frames in which a larger board is looked for
_ENOUGH_TAGS = 2  # in one frame; a single one may be a chance


def nothing_found(name: str, frames: Frames, target: Target) -> str:
    """The message for a target that no frame shows: what was looked for, what is there instead, what to check."""
    if isinstance(target, Checkerboard):
        wanted = f"a checkerboard of {target.rows} x {target.cols} inner corners"
        check = (
            "rows and columns are counted as INNER corners, one less than squares; the whole board with a white "
            "margin must be in view"
        )
    elif isinstance(target, AprilGrid):
        wanted = f"an AprilGrid of {target.rows} x {target.cols} tags (36h11, two-bit border)"
        check = (
            f"the grid must be Kalibr's (two-bit black border), with tag {target.first_id} at the lower left; tags "
            "need about 20 px"
        )
    elif isinstance(target, CircleGrid):
        wanted = _words(target)
        check = "circles must be black on white and all in view; of an asymmetric grid a row is the shorter direction"
    elif isinstance(target, Charuco):
        wanted = f"a ChArUco board of {target.rows} x {target.cols} squares with {target.dictionary}"
        check = "rows and columns are counted as SQUARES; dictionary, ids and legacy pattern must be the printed ones"
    else:
        wanted, check = f"a {type(target).__name__}", "is it the target that was recorded?"
    hint = _what_is_there(frames, target)
    return (
        f"{name}: {wanted} was found in none of {len(frames)} frames. {hint}Check the target file against the board "
        f"({check}), and look at a frame: is the board in it, sharp and lit?"
    )


def larger_board(name: str, frames: Frames, seen_frames: np.ndarray, target: Target) -> str:
    """The message for a checkerboard that was found as a part of a larger one; empty where it was not.

    Any part of the right size would do then, another in each frame, and the corners' numbers would mean nothing.
    """
    if not isinstance(target, Checkerboard):
        return ""
    chosen = np.unique(seen_frames[np.linspace(0, len(seen_frames) - 1, _PROBES).round().astype(int)])
    images = [frames.images[int(number)] for number in chosen]
    for rows, cols in ((target.rows + 1, target.cols), (target.rows, target.cols + 1)):
        larger = dataclasses.replace(target, rows=rows, cols=cols)
        if all(len(find_corners(image, larger)[0]) for image in images):
            return (
                f"{name}: the board has more inner corners than the target's {target.rows} x {target.cols}: at least "
                f"{rows} x {cols} were found in each of {len(images)} frames looked at. Correct the target; with too "
                "few rows or columns, another part of the board would be taken for it in each frame."
            )
    return ""


def _what_is_there(frames: Frames, target: Target) -> str:
    """A sentence about what a few frames show instead, with a space after it; empty where they show nothing known."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_LOOKED_AT, len(frames))).round().astype(int))
    images = [frames.images[int(number)] for number in chosen]
    if isinstance(target, AprilGrid):
        return _tags_there(images, target)
    for other, words in _alternatives(target):
        count = sum(len(find_corners(image, other)[0]) > 0 for image in images)
        if count:
            return f"But {words} is there, in {count} of {len(images)} frames looked at: correct the target. "
    return ""


def _alternatives(target: Target) -> list[tuple[Target, str]]:
    """Targets that are easily mistaken for this one, the largest first: smaller boards are found as parts of larger."""
    if isinstance(target, Checkerboard):
        shapes = _shapes(target.rows, target.cols)
        boards = [(dataclasses.replace(target, rows=rows, cols=cols), rows, cols) for rows, cols in shapes]
        return [(board, f"a checkerboard of {rows} x {cols} inner corners") for board, rows, cols in boards]
    if isinstance(target, CircleGrid):
        swapped = dataclasses.replace(target, rows=target.cols, cols=target.rows)
        other = dataclasses.replace(target, asymmetric=not target.asymmetric, diameter=0.5 * target.spacing)
        both = dataclasses.replace(other, rows=target.cols, cols=target.rows)
        shapes = _shapes(target.rows, target.cols)
        near = [dataclasses.replace(target, rows=rows, cols=cols) for rows, cols in shapes]
        return [(grid, _words(grid)) for grid in (swapped, other, both, *near)]
    if isinstance(target, Charuco):
        legacy = dataclasses.replace(target, legacy=not target.legacy)
        swapped = dataclasses.replace(target, rows=target.cols, cols=target.rows)
        return [
            (legacy, f"the board {'without' if target.legacy else 'with'} the legacy pattern"),
            (swapped, f"a board of {swapped.rows} x {swapped.cols} squares"),
        ]
    return []


def _words(grid: CircleGrid) -> str:
    kind = "an asymmetric" if grid.asymmetric else "a symmetric"
    return f"{kind} grid of {grid.rows} rows x {grid.cols} columns of circles"


def _shapes(rows: int, cols: int) -> list[tuple[int, int]]:
    """One row or column more or less, or both, the largest first."""
    near = {(rows + i, cols + j) for i in (-1, 0, 1) for j in (-1, 0, 1)} - {(rows, cols)}
    return sorted(((r, c) for r, c in near if min(r, c) >= 3), key=lambda shape: (-shape[0] * shape[1], shape))


def _tags_there(images: list[np.ndarray], target: AprilGrid) -> str:
    """Tags of the family that are not the target's, or have another border."""
    for border, remark in ((2, ""), (1, " with a ONE-bit border, which is not Kalibr's")):
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        seen: set[int] = set()
        for image in images:
            _, ids, _ = detector.detectMarkers(image)
            found = np.unique(ids) if ids is not None else np.empty(0)
            seen |= set(found.astype(int).tolist()) if len(found) >= _ENOUGH_TAGS else set()
        if seen:
            return (
                f"But tags with ids {min(seen)} to {max(seen)}{remark} are there; the target has ids "
                f"{target.ids[0]} to {target.ids[-1]}. "
            )
    return ""
