"""Views of a rig: frames of different cameras taken at the same time, and the boards that each frame shows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal.calibration.assemble import MIN_CORNERS, CameraFrames
from jaxcal.targets import Target


def associate(cameras: Sequence[CameraFrames], tolerance_ns: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Group frames of different cameras into views taken at the same time, within `tolerance_ns`.

    Returns the view index (F,) of every camera's frames, and the views' times (V,). A view holds at most one frame of
    each camera: frames are visited in order of time, and a frame opens a new view when it lies further than the
    tolerance from the open view's first frame or when its camera is already in it.
    """
    times = np.concatenate([c.time_ns for c in cameras])
    owner = np.concatenate([np.full(len(c.time_ns), i) for i, c in enumerate(cameras)])
    view = np.empty(len(times), dtype=np.int64)
    starts: list[int] = []
    inside: set[int] = set()
    for k in np.lexsort((owner, times)):
        if not starts or times[k] - starts[-1] > tolerance_ns or owner[k] in inside:
            starts.append(int(times[k]))
            inside = set()
        inside.add(int(owner[k]))
        view[k] = len(starts) - 1
    return [view[owner == i] for i in range(len(cameras))], np.array(starts)


@dataclass(frozen=True)
class BoardFrames:
    """Frames of one camera taken apart by board, so that each shows one rigid board: `frames` (S of them, corners of
    all points as before), `row` (S,) the frame that each was part of, `board` (S,) the board it shows."""

    frames: CameraFrames
    row: np.ndarray
    board: np.ndarray


def split_boards(frames: CameraFrames, target: Target) -> BoardFrames:
    """One frame per board and picture; boards of which hardly a corner is seen are left out."""
    of_point = np.asarray(target.board_of_point)
    count = int(of_point.max()) + 1
    if count == 1:
        rows = np.arange(len(frames.frames))
        return BoardFrames(frames, rows, np.zeros(len(rows), dtype=np.int64))
    enough = np.stack([(frames.seen & (of_point == b)).sum(axis=1) >= MIN_CORNERS for b in range(count)], axis=1)
    row, board = np.nonzero(enough)
    part = frames.take(row)
    seen = part.seen & (of_point[None] == board[:, None])
    return BoardFrames(CameraFrames(part.detections, part.frames, part.time_ns, part.pixels, seen), row, board)
