"""How well corners are found in reconstructed images: held-out boards, against exact truth and against sharp frames."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from jaxcal.progress import Progress, no_progress, track
from reconstruction.networks import ReconstructionNetwork
from reconstruction.reconstructor import Reconstructor
from reconstruction.training.sequences import Scene, Window, evaluation_scene, windows

_EVALUATION_SEED = 77_000_000  # far from any training set's
_SETTLING_WINDOWS = 4  # the first images show only what has moved so far
_FOUND_WITHIN_PX = 3.0


@dataclass(frozen=True)
class CornerErrors:
    """Corners found in some images. `errors` (N, 2) found minus true, pixels; `velocity` (N, 2) pixels per second of
    the true corners; `window_s` (N,) length of each corner's window; `found` of `shown` boards were found."""

    errors: Float[np.ndarray, "n 2"]
    velocity: Float[np.ndarray, "n 2"]
    window_s: Float[np.ndarray, " n"]
    found: int
    shown: int

    @property
    def rms_px(self) -> float:
        """Root mean square of the length of the error."""
        return float(np.sqrt((self.errors**2).sum(axis=1).mean())) if len(self.errors) else float("nan")

    @property
    def latency_s(self) -> float:
        """Time by which the corners trail their true places: least squares of -error = latency * velocity."""
        power = (self.velocity**2).sum()
        return float(-(self.errors * self.velocity).sum() / power) if power > 0 else 0.0

    @property
    def bias_px(self) -> float:
        """Mean error along the direction of motion; negative where corners trail. Corners at rest are left out."""
        speed = np.linalg.norm(self.velocity, axis=1)
        moving = speed * self.window_s > 0.1
        if not moving.any():
            return 0.0
        along = (self.errors[moving] * self.velocity[moving]).sum(axis=1) / speed[moving]
        return float(along.mean())

    def moving(self, slowest: float, fastest: float) -> "CornerErrors":
        """Only the corners that move by `slowest` to `fastest` pixels per window; the board counts stay."""
        pixels = np.linalg.norm(self.velocity, axis=1) * self.window_s
        chosen = (pixels >= slowest) & (pixels < fastest)
        return CornerErrors(self.errors[chosen], self.velocity[chosen], self.window_s[chosen], self.found, self.shown)


@dataclass(frozen=True)
class Evaluation:
    """The same boards in reconstructed images and in sharp ones (the rendered truth)."""

    reconstructed: CornerErrors
    sharp: CornerErrors

    @property
    def detection_ratio(self) -> float:
        """Boards found in reconstructed images, over those found in sharp ones."""
        return self.reconstructed.found / max(self.sharp.found, 1)


def evaluate(
    network: ReconstructionNetwork,
    *,
    top_speeds: Sequence[float] = (1.5, 2.5, 4.0, 6.0, 9.0, 12.0, 15.0, 18.0, 21.0, 25.0),
    windows_each: int = 24,
    progress: Progress = no_progress,
    **options: object,
) -> Evaluation:
    """Corner errors over held-out scenes, one per top speed (pixels per window); `options` of the Reconstructor."""
    reconstructed, sharp = [], []
    for index, top_speed in enumerate(track(list(top_speeds), "evaluate", len(top_speeds), progress)):
        rng = np.random.default_rng([_EVALUATION_SEED, index])
        scene = evaluation_scene(rng, windows_each, top_speed, network.shown_at)
        for window, image in _images(scene, network, _EVALUATION_SEED + index, options):
            sharp.append(_measure(_eight_bits(window.target), window, scene))
            reconstructed.append(_measure(image, window, scene))
    return Evaluation(_together(reconstructed), _together(sharp))


def _images(
    scene: Scene, network: ReconstructionNetwork, seed: int, options: dict[str, object]
) -> Iterator[tuple[Window, np.ndarray]]:
    """The windows whose image can be expected to be complete and shows the whole board, each with its image."""
    reconstructor = Reconstructor(network, scene.view.width, scene.view.height, **options)  # pyright: ignore[reportArgumentType]
    highest = np.array([scene.view.width - 1, scene.view.height - 1]) - 4.0
    for index, window in enumerate(windows(scene, seed)):
        image = reconstructor(window.x, window.y, window.t_us, window.p, window.span_us)
        inside = (window.corners > 4.0).all() and (window.corners < highest).all()
        if index >= _SETTLING_WINDOWS and inside:
            yield window, image


def _eight_bits(target: Float[np.ndarray, "h w"]) -> np.ndarray:
    return np.round(255.0 * target).clip(0, 255).astype(np.uint8)


def find_corners(image: np.ndarray, size: tuple[int, int]) -> Float[np.ndarray, "n 2"] | None:
    """A checkerboard's corners: found by cv2's sector-based detector, placed by `cornerSubPix`; None if not found."""
    found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    start = np.asarray(corners, dtype=np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    return np.asarray(cv2.cornerSubPix(image, start, (5, 5), (-1, -1), criteria), dtype=np.float64).reshape(-1, 2)


def _measure(image: np.ndarray, window: Window, scene: Scene) -> CornerErrors:
    """The errors in one image; a board of which a corner is nowhere near a true one counts as not found."""
    assert scene.pattern.size is not None
    corners = find_corners(image, scene.pattern.size)
    nothing = np.zeros((0, 2))
    if corners is None:
        return CornerErrors(nothing, nothing, np.zeros(0), 0, 1)
    distance = np.linalg.norm(corners[:, None] - window.corners[None], axis=-1)
    nearest = distance.argmin(axis=1)  # the board's orientation in the detector's numbering does not matter
    if len(np.unique(nearest)) < len(nearest) or distance.min(axis=1).max() > _FOUND_WITHIN_PX:
        return CornerErrors(nothing, nothing, np.zeros(0), 0, 1)
    errors = corners - window.corners[nearest]
    return CornerErrors(errors, window.velocity[nearest], np.full(len(errors), window.duration_us * 1e-6), 1, 1)


def _together(parts: list[CornerErrors]) -> CornerErrors:
    return CornerErrors(
        np.concatenate([part.errors for part in parts]),
        np.concatenate([part.velocity for part in parts]),
        np.concatenate([part.window_s for part in parts]),
        sum(part.found for part in parts),
        sum(part.shown for part in parts),
    )
