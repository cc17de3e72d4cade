"""From `Detections` to the padded arrays of a problem, and back to one residual per corner."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from jaxcal.calibration.state import SharedLayout
from jaxcal.calibration.vision import FRAME_BATCH, VisionData
from jaxcal.errors import CalibrationError
from jaxcal.estimation import on_device
from jaxcal.observations import Detections
from jaxcal.targets import Target

# Frames with fewer corners fix no pose well enough to be worth their parameters.
MIN_CORNERS = 8


@dataclass(frozen=True)
class CameraFrames:
    """Frames of one camera that take part, dense over the target's points.

    `frames` (F,) indices into the detections' timestamps; `time_ns` (F,); `pixels` (F, N, 2); `seen` (F, N) bool.
    """

    detections: Detections
    frames: np.ndarray
    time_ns: np.ndarray
    pixels: np.ndarray
    seen: np.ndarray

    def take(self, index: np.ndarray) -> "CameraFrames":
        """A subset of the frames."""
        return CameraFrames(
            self.detections, self.frames[index], self.time_ns[index], self.pixels[index], self.seen[index]
        )

    @property
    def precision(self) -> np.ndarray:
        """Relative 1 / sigma (F, N) of the corners, 1 where the detector does not tell."""
        dense = np.ones((len(self.detections.timestamps_ns), self.seen.shape[1]))
        if self.detections.precision is not None:
            dense[self.detections.frame, self.detections.point] = self.detections.precision
        return dense[self.frames]

    def per_corner(self, dense: np.ndarray, fill: float | bool) -> np.ndarray:
        """Values (F, N, ...) at the frames that take part, as one row per corner of the detections."""
        out = np.full((len(self.detections), *dense.shape[2:]), fill, dtype=dense.dtype)
        row_of = np.full(len(self.detections.timestamps_ns), -1)
        row_of[self.frames] = np.arange(len(self.frames))
        row = row_of[self.detections.frame]
        used = row >= 0
        out[used] = dense[row[used], self.detections.point[used]]
        return out


def camera_frames(detections: Detections, target: Target, name: str, min_corners: int = MIN_CORNERS) -> CameraFrames:
    """Spread a camera's corners over (frames, points). Raises CalibrationError when hardly any frame is usable."""
    count = len(target.points)
    if len(detections) and detections.point.max() >= count:
        raise CalibrationError(
            f"{name}: a corner has point index {detections.point.max()}, but the target has {count} points. "
            "Were these detections made with another target?"
        )
    width, height = detections.image_size
    x, y = detections.pixels[:, 0], detections.pixels[:, 1]
    outside = (x < -1) | (y < -1) | (x > width) | (y > height)
    if outside.any():
        place = int(np.argmax(outside))
        raise CalibrationError(
            f"{name}: corner {place} (frame {detections.frame[place]}) lies at ({x[place]:.1f}, {y[place]:.1f}) px, "
            f"outside the {width}x{height} image. Is image_size (width, height) right?"
        )
    corners_per_frame = np.bincount(detections.frame, minlength=len(detections.timestamps_ns))
    frames = np.flatnonzero(corners_per_frame >= min(min_corners, count))
    row_of = np.full(len(corners_per_frame), -1)
    row_of[frames] = np.arange(len(frames))
    row = row_of[detections.frame]
    used = row >= 0
    pixels = np.zeros((len(frames), count, 2))
    seen = np.zeros((len(frames), count), dtype=bool)
    pixels[row[used], detections.point[used]] = detections.pixels[used]
    seen[row[used], detections.point[used]] = True
    in_line = _in_line(target.points, seen)
    if np.sum(~in_line) < 3:
        raise CalibrationError(_too_few_frames(name, int(np.sum(~in_line)), int(in_line.sum()), min_corners))
    dense = CameraFrames(detections, frames, detections.timestamps_ns[frames], pixels, seen)
    return dense.take(np.flatnonzero(~in_line)) if in_line.any() else dense


def _in_line(points: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Frames (F,) whose seen (F, N) points of (N, 3) lie along one line: their second principal extent vanishes."""
    share = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
    middle = share @ points
    moments = np.einsum("fn,ni,nj->fij", share, points, points, optimize=True)
    extent = np.linalg.eigvalsh(moments - middle[:, :, None] * middle[:, None, :])
    return extent[:, 1] < 1e-6 * extent[:, 2]


def _too_few_frames(name: str, count: int, in_line: int, min_corners: int) -> str:
    if in_line:
        return (
            f"{name}: {count} frames with at least {min_corners} corners that do not lie along one line, and {in_line} "
            "whose corners do; 3 are the least. A line shows neither where the board is nor the lens: focal length, "
            "principal point and distortion stay open. Record views in which several rows and columns are found."
        )
    return (
        f"{name}: {count} frames with at least {min_corners} corners; 3 are the least, 20 or more are needed for a "
        "good calibration. Beyond its own pose a view of a flat board tells two numbers of the lens, so that focal "
        "length, principal point and distortion stay open. Is the target description right, and was the board in view?"
    )


def round_up(count: int, step: int) -> int:
    """Sizes are rounded so that few different programs are compiled: to `step`, and above 8 steps to eighths of 2^k."""
    count = max(count, 1)
    if count > 8 * step:
        step = max(step, step * 2 ** int(np.floor(np.log2(count / (8 * step)))))
    return -(-count // step) * step


def stack_groups(layout: SharedLayout, per_camera: Sequence[np.ndarray]) -> tuple[jnp.ndarray, ...]:
    """One array (F_c, ...) per camera to one array per group, padded to a size that is compiled often.

    Each camera fills whole batches; what pads its last one are copies of its last frame (to which no weight belongs).
    """
    stacked = []
    for members in layout.groups:
        joined = np.concatenate([_fill_batches(np.asarray(per_camera[c])) for c in members])
        stacked.append(on_device(_pad_to(joined, round_up(len(joined), FRAME_BATCH))))
    return tuple(stacked)


def _fill_batches(rows: np.ndarray) -> np.ndarray:
    return _pad_to(rows, -(-len(rows) // FRAME_BATCH) * FRAME_BATCH)


def _pad_to(rows: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])


def vision_data(
    layout: SharedLayout,
    cameras: Sequence[CameraFrames],
    *,
    weights: Sequence[np.ndarray],
    views: Sequence[np.ndarray] | None = None,
    times: Sequence[np.ndarray] | None = None,
) -> tuple[VisionData, ...]:
    """The frames of each group. `weights[c]` (F, N) 1/sigma^2; `views[c]` (F,) or `times[c]` (F,) s per camera."""
    counts = [len(frames.frames) for frames in cameras]
    fields = {
        "camera": [np.full(n, layout.place(c)[1]) for c, n in enumerate(counts)],
        "rig_camera": [np.full(n, c) for c, n in enumerate(counts)],
        "view": [np.zeros(n, dtype=np.int64) for n in counts] if views is None else views,
        "time": [np.zeros(n) for n in counts] if times is None else times,
        "pixels": [frames.pixels.swapaxes(1, 2) for frames in cameras],
    }
    stacked = {name: stack_groups(layout, values) for name, values in fields.items()}
    stacked["weight"] = stack_weights(layout, cameras, weights)
    return tuple(VisionData(**{name: values[g] for name, values in stacked.items()}) for g in range(len(layout.groups)))


def stack_weights(
    layout: SharedLayout, cameras: Sequence[CameraFrames], weights: Sequence[np.ndarray]
) -> tuple[jnp.ndarray, ...]:
    """Weights (F, N) of each camera's corners, zero where none was seen and in padding, per group."""
    stacked = []
    for members in layout.groups:
        rows = []
        for c in members:
            masked = np.where(cameras[c].seen, weights[c], 0.0)
            rows.append(np.pad(masked, [(0, -len(masked) % FRAME_BATCH), (0, 0)]))
        joined = np.concatenate(rows)
        stacked.append(on_device(np.pad(joined, [(0, round_up(len(joined), FRAME_BATCH) - len(joined)), (0, 0)])))
    return tuple(stacked)


def split_groups(
    layout: SharedLayout, cameras: Sequence[CameraFrames], grouped: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Undo the stacking of `vision_data`: one array (F, ...) per camera."""
    out: list[np.ndarray] = [np.empty(0)] * layout.num_cameras
    for members, values in zip(layout.groups, grouped, strict=True):
        start = 0
        for c in members:
            count = len(cameras[c].frames)
            out[c] = np.asarray(values)[start : start + count]
            start += -(-count // FRAME_BATCH) * FRAME_BATCH
    return out
