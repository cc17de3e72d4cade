"""Corner noise from the residuals, and which corners to leave out."""

from collections.abc import Sequence

import numpy as np

# A good corner errs by more than this many sigma (2-D) once in 25 000.
_REJECT_SIGMAS = 4.5
# How much noisier than its camera a frame may be, and still take part.
_LARGEST_FRAME_NOISE = 4.0
# Corner detectors are never better than this; keeps noise-free input from demanding the impossible (px).
_SMALLEST_SIGMA = 1e-4


def robust_sigma(error: np.ndarray, seen: np.ndarray) -> float:
    """Noise of one corner coordinate (px) from the median of the squared 2-D errors (F, N, 2), blind to outliers."""
    squared = np.sum(error[seen] ** 2, axis=-1)
    # The square of a 2-D Gaussian's length, over sigma^2, has median 2 ln 2.
    return max(float(np.sqrt(np.median(squared) / (2.0 * np.log(2.0)))), _SMALLEST_SIGMA) if len(squared) else 1.0


def rms_sigma(error: np.ndarray, inlier: np.ndarray, parameters: float) -> float:
    """Noise of one coordinate (px) from the inliers, with the degrees of freedom that `parameters` took."""
    count = 2 * int(inlier.sum())
    freedom = max(count - parameters, 0.5 * count, 1.0)
    return max(float(np.sqrt(np.sum(error[inlier] ** 2) / freedom)), _SMALLEST_SIGMA)


def inliers(error: np.ndarray, seen: np.ndarray, sigma: float) -> np.ndarray:
    """Corners (F, N) within the rejection threshold; a frame that loses most of its corners is left out whole.

    The noise is that of the frame, where it is larger than the camera's (up to a limit): corners of a steep or distant
    board are less sharp without being wrong, and leaving them out would take away the image's rim.
    """
    distance = np.linalg.norm(error, axis=-1)
    median = np.nanmedian(np.where(seen.any(axis=1, keepdims=True), np.where(seen, distance, np.nan), 0.0), axis=1)
    of_frame = median / np.sqrt(2.0 * np.log(2.0))
    local = np.clip(of_frame, sigma, _LARGEST_FRAME_NOISE * sigma)[:, None]
    good = seen & (distance < _REJECT_SIGMAS * local)
    lost = good.sum(axis=1) < 0.5 * seen.sum(axis=1)
    return good & ~lost[:, None]


def rejection_warnings(names: Sequence[str], seen: Sequence[np.ndarray], kept: Sequence[np.ndarray]) -> list[str]:
    """Sentences about cameras that lost many corners or whole frames."""
    sentences = []
    for name, s, k in zip(names, seen, kept, strict=True):
        share = 1.0 - k.sum() / max(s.sum(), 1)
        frames = int(np.sum((k.sum(axis=1) == 0) & (s.sum(axis=1) > 0)))
        if share > 0.05:
            sentences.append(
                f"{name}: {100 * share:.1f} % of the corners ({frames} whole frames) disagree with the model and were "
                "left out. Look at the detections; motion blur, a bent board or the wrong camera model do this."
            )
    return sentences
