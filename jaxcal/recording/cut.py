"""A part of a recording: the frames and corners between two times, and frames thinned out to a rate."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections, Frames, ImageSequence

# Of each slot of time the frame nearest to this share of it is kept. An odd share, so that it hardly ever lies half
# way between two frames, where the jitter of clocks would make simultaneous cameras keep different ones.
_PLACE_IN_SLOT = 0.382
_HARDLY_FASTER = 0.95


@dataclass(frozen=True)
class SomeImages:
    """Images by index, being those of `images` with the given `numbers`; as lazy, and as cheap to send around."""

    images: Sequence[np.ndarray] | ImageSequence
    numbers: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.images[self.numbers[index]]

    def fingerprint(self) -> str:
        """A text that changes when the images or the choice of them do."""
        return f"{self.images.fingerprint()}\n{self.numbers}"  # pyright: ignore[reportAttributeAccessIssue]


def cut_frames(frames: Frames, span_ns: tuple[int, int] | None = None, rate_hz: float | None = None) -> Frames:
    """The frames within `span_ns` (first, last; both included), and of those at most `rate_hz` a second, evenly.

    Cameras whose frames are simultaneous keep simultaneous ones; one that hardly takes more is left as it is. Raises
    CalibrationError when no frame is left.
    """
    times = np.asarray(frames.timestamps_ns)
    kept = np.ones(len(times), bool) if span_ns is None else (times >= span_ns[0]) & (times <= span_ns[1])
    numbers = np.flatnonzero(kept)
    if rate_hz is not None and len(numbers):
        numbers = numbers[_thinned(times[numbers], 1e9 / rate_hz)]
    if not len(numbers):
        raise _nothing_left(times, span_ns, "frame")
    if len(numbers) == len(times):
        return frames
    if hasattr(frames.images, "fingerprint"):
        images = SomeImages(frames.images, tuple(numbers.tolist()))
    else:
        images = [frames.images[number] for number in numbers.tolist()]
    return Frames(times[numbers], images, frames.image_size)


def cut_detections(detections: Detections, span_ns: tuple[int, int] | None = None) -> Detections:
    """The corners of the frames within `span_ns`. Raises CalibrationError when no frame is left."""
    times = detections.timestamps_ns
    if span_ns is None:
        return detections
    frames = np.flatnonzero((times >= span_ns[0]) & (times <= span_ns[1]))
    if not len(frames):
        raise _nothing_left(times, span_ns, "frame with corners")
    mine = (detections.frame >= frames[0]) & (detections.frame <= frames[-1])
    return Detections(
        times[frames],
        detections.frame[mine] - frames[0],
        detections.point[mine],
        detections.pixels[mine],
        detections.image_size,
        None if detections.precision is None else detections.precision[mine],
    )


def _thinned(times: np.ndarray, period_ns: float) -> np.ndarray:
    """Of each slot of `period_ns`, counted from time zero, the index of the frame nearest to a fixed place in it."""
    if len(times) > 1 and np.median(np.diff(times)) > _HARDLY_FASTER * period_ns:
        # Frames as far apart as slots are may lie on their borders, where rounding would put two into one.
        return np.arange(len(times))
    slot = np.floor(times / period_ns)
    off = np.abs(times - (slot + _PLACE_IN_SLOT) * period_ns)
    order = np.lexsort((off, slot))
    return np.sort(order[np.unique(slot[order], return_index=True)[1]])


def _nothing_left(times: np.ndarray, span_ns: tuple[int, int] | None, what: str) -> CalibrationError:
    if not len(times) or span_ns is None:
        return CalibrationError(f"there is no {what}.")
    start, stop = ((t - int(times[0])) * 1e-9 for t in span_ns)
    return CalibrationError(
        f"no {what} lies between {start:.2f} s and {stop:.2f} s after the first one; the recording is "
        f"{(int(times[-1]) - int(times[0])) * 1e-9:.2f} s long. Choose another part."
    )
