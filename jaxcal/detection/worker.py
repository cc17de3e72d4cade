"""One detector process: chunks of images come in on a pipe, corners go out on another."""

import pickle
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from typing import BinaryIO

import cv2
import numpy as np

from jaxcal.child import pipes
from jaxcal.detection.corners import find_corners
from jaxcal.errors import CalibrationError
from jaxcal.observations import ImageSequence
from jaxcal.targets import Target


@dataclass(frozen=True)
class Chunk:
    """Frames for one worker: `images[index]` for each of `indices`, whose numbers in the recording are `frames`."""

    frames: tuple[int, ...]
    images: Sequence[np.ndarray] | ImageSequence
    indices: tuple[int, ...]
    target: Target


@dataclass(frozen=True)
class Corners:
    """Corners of some frames: `frame` (M,) number in the recording, `point` (M,), `pixels` (M, 2)."""

    frame: np.ndarray
    point: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True)
class Failure:
    """Why a chunk could not be done; `expected` for a CalibrationError, whose message is for the user."""

    message: str
    expected: bool


def detect_chunk(chunk: Chunk) -> Corners:
    """Corners in all images of a chunk."""
    found = [find_corners(np.asarray(chunk.images[index]), chunk.target) for index in chunk.indices]
    counts = [len(point) for point, _ in found]
    return Corners(
        frame=np.repeat(np.array(chunk.frames, np.int64), counts),
        point=np.concatenate([np.empty(0, np.int64), *(point for point, _ in found)]),
        pixels=np.concatenate([np.empty((0, 2)), *(pixels for _, pixels in found)]),
    )


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer pickled chunks with pickled corners or failures, until the requests end."""
    cv2.setNumThreads(1)  # there is a process for each core
    while True:
        try:
            chunk = pickle.load(requests)
        except EOFError:
            return
        try:
            answer: Corners | Failure = detect_chunk(chunk)
        except CalibrationError as error:
            answer = Failure(str(error), expected=True)
        except Exception:
            answer = Failure(traceback.format_exc(), expected=False)
        pickle.dump(answer, answers)
        answers.flush()


def main() -> None:
    """Serve on standard input and output."""
    serve(*pipes())
