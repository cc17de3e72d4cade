"""`detect`: the corners of a target in all frames of a camera, in parallel and cached."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxcal.child import usable_cores
from jaxcal.detection.cache import DetectionCache, Fingerprinted, detection_key
from jaxcal.detection.hints import larger_board, nothing_found
from jaxcal.detection.pool import detect_in_processes
from jaxcal.detection.worker import Chunk, Corners, detect_chunk
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections, Frames
from jaxcal.progress import Progress, no_progress
from jaxcal.targets import Target

_CHUNK = 8
# Starting a process takes as long as detecting in this many frames.
_FEW_FRAMES = 16


def detect(
    frames: Frames,
    target: Target,
    *,
    workers: int | None = None,
    cache: str | Path | None = None,
    progress: Progress = no_progress,
    name: str = "cam0",
) -> Detections:
    """Find the target's corners in every frame of a camera.

    `workers` processes share the frames (None: one per core; 1, or few frames: no processes). With a `cache` folder
    the detections are kept there under the camera's `name` and found again while images, target and detector stay the
    same; an interrupted run continues where it stopped. All frames are listed in the result, also those without
    corners.

    Raises CalibrationError when no frame shows the target, when it is a part of a larger checkerboard, or when an
    image cannot be read.
    """
    if workers is not None and workers < 1:
        raise CalibrationError(f"detect: workers is {workers}; expected at least 1, or None for one per core.")
    store = None if cache is None else DetectionCache(Path(cache), name, detection_key(frames, target))
    detections = store.load() if store else None
    if detections is None:
        parts = _all_parts(frames, target, workers or usable_cores(), store, progress, f"detect {name}")
        detections = _merged(frames, parts)
        larger = larger_board(name, frames, detections.seen_frames, target) if len(detections) else ""
        if larger:
            raise CalibrationError(larger)
        if store:
            store.save(detections)
    else:
        progress(f"detect {name}", len(frames), len(frames))
    if not len(detections):
        raise CalibrationError(nothing_found(name, frames, target))
    return detections


def _all_parts(
    frames: Frames, target: Target, workers: int, store: DetectionCache | None, progress: Progress, stage: str
) -> list[Corners]:
    ranges = [tuple(range(i, min(i + _CHUNK, len(frames)))) for i in range(0, len(frames), _CHUNK)]
    kept = {numbers: store.load_part(numbers) for numbers in ranges} if store else {}
    parts = [part for part in kept.values() if part is not None]
    missing = [numbers for numbers in ranges if kept.get(numbers) is None]
    done = len(frames) - sum(map(len, missing))
    progress(stage, done, len(frames))
    for chunk, corners in _detected([_chunk(frames, target, numbers) for numbers in missing], workers):
        if store:
            store.save_part(chunk.frames, corners)
        parts.append(corners)
        done += len(chunk.frames)
        progress(stage, done, len(frames))
    return parts


def _chunk(frames: Frames, target: Target, numbers: tuple[int, ...]) -> Chunk:
    """Files travel to the workers as names, to be read there; arrays travel as they are, only the chunk's."""
    if isinstance(frames.images, Fingerprinted):
        return Chunk(numbers, frames.images, numbers, target)
    return Chunk(numbers, [frames.images[number] for number in numbers], tuple(range(len(numbers))), target)


def _detected(chunks: list[Chunk], workers: int) -> Iterator[tuple[Chunk, Corners]]:
    if workers == 1 or sum(len(chunk.frames) for chunk in chunks) <= _FEW_FRAMES:
        return ((chunk, detect_chunk(chunk)) for chunk in chunks)
    return detect_in_processes(chunks, min(workers, len(chunks)))


def _merged(frames: Frames, parts: list[Corners]) -> Detections:
    return Detections(
        timestamps_ns=frames.timestamps_ns,
        frame=np.concatenate([np.empty(0, np.int64), *(part.frame for part in parts)]),
        point=np.concatenate([np.empty(0, np.int64), *(part.point for part in parts)]),
        pixels=np.concatenate([np.empty((0, 2)), *(part.pixels for part in parts)]),
        image_size=frames.image_size,
    )
