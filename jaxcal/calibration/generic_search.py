"""A sweep over lenses of all kinds for the one that a camera's views were taken through, with no guess."""

import dataclasses

import cv2
import numpy as np

from jaxcal.calibration import generic_lens
from jaxcal.calibration.assemble import CameraFrames
from jaxcal.calibration.first_fit import Fit, Lens, Views, compact_views, fit_lenses, squared_errors
from jaxcal.calibration.generic_lens import GenericLens
from jaxcal.calibration.lens_poses import FIRST_NOISE_PX, HUBER_PX, poses_from_rays, swap_mirrored
from jaxcal.calibration.redundancy import view_features
from jaxcal.targets import Target

# Views and corners per view: of the sweep, and of the refinement of its best hypotheses.
_SWEEP_VIEWS, _SWEEP_CORNERS = 10, 40
_GENERIC_VIEWS = 24
_MOST_FINALISTS = 3


@dataclasses.dataclass(frozen=True)
class Found:
    """A generic lens with poses of all the views it was judged by, and which of these views it explains (F,).

    `cost`, px^2, of these views and of the prior.
    """

    fit: Fit
    good: np.ndarray
    rms_px: float
    cost: float


def generic_candidates(frames: CameraFrames, target: Target, views: Views, size: tuple[int, int]) -> list[Found]:
    """Generic lenses with the poses of `views`, the best first."""
    lens = GenericLens()
    prior = generic_lens.weak_prior(size, FIRST_NOISE_PX)
    far = float(max(size))
    swept = spread_views(frames, _SWEEP_VIEWS)
    thin = compact_views(target.points, frames.pixels, frames.seen, _SWEEP_CORNERS)
    few = thin.take(swept)
    parameters = generic_lens.hypotheses(few.pixels[few.weight > 0], size, homography_focal(frames.take(swept), target))
    fit = poses_from_rays(lens, parameters, *generic_lens.unproject(parameters, few.pixels), few, far)
    for share, steps in ((0.6, 8), (0.6, 12)):
        width = _loss_width(lens, fit, few, share, far)
        fit = fit_lenses(lens, fit, few, steps=steps, width=width, cap=0.25 * far, prior=prior, rtol=1e-3)

    more = thin.take(spread_views(frames, _GENERIC_VIEWS))
    order = np.argsort(_score(lens, fit, few, far), kind="stable")[: 2 * _MOST_FINALISTS]
    fit = poses_from_rays(
        lens, fit.parameters[order], *generic_lens.unproject(fit.parameters[order], more.pixels), more, far
    )
    order = _finalists(_score(lens, fit, more, far), fit.parameters)
    fit = fit.take(order)
    fit = fit_lenses(
        lens, fit, more, steps=30, width=_loss_width(lens, fit, more, 0.6, far), cap=0.25 * far, prior=prior
    )
    order = _finalists(_score(lens, fit, more, far), fit.parameters)  # some have met
    found = [_extended(lens, fit.parameters[b : b + 1], views, size) for b in order]
    # Where several explain the views equally well, the prior in their costs decides.
    return sorted(found, key=lambda f: (f.rms_px > 1.5 * min(g.rms_px for g in found), f.cost))


def _extended(lens: Lens, parameters: np.ndarray, views: Views, size: tuple[int, int]) -> Found:
    """One hypothesis on all views: poses, which views it explains, and the lens refined on these."""
    far = float(max(size))
    fit = poses_from_rays(lens, parameters, *generic_lens.unproject(parameters, views.pixels), views, far)
    for _ in range(3):
        good = _explained(lens, fit, views, far)
        kept = views.with_weight(views.weight * good[:, None])
        rms_px = trimmed_rms(lens, fit, kept, far)
        prior = generic_lens.weak_prior(size, max(rms_px, 0.05))
        fit = fit_lenses(lens, fit, kept, steps=15, width=HUBER_PX, cap=0.25 * far, prior=prior)
        found = Found(fit, good, rms_px, float(fit.cost[0]))
        fit, swapped = swap_mirrored(lens, fit, views, far)
        if not swapped:
            break
    return dataclasses.replace(found, fit=fit, rms_px=trimmed_rms(lens, fit, kept, far))


def _loss_width(lens: Lens, fit: Fit, views: Views, share: float, far: float) -> np.ndarray:
    """Huber widths (B,) at which `share` of the corners count in full; a hypothesis far off is judged by most."""
    errors = np.sqrt(squared_errors(lens, fit, views, far))[:, views.weight > 0]
    return np.maximum(np.quantile(errors, share, axis=1), HUBER_PX)


def _score(lens: Lens, fit: Fit, views: Views, far: float) -> np.ndarray:
    """What a hypothesis misses the corners by (B,), px: the mean over the better four fifths of the views' medians."""
    errors = np.sqrt(squared_errors(lens, fit, views, far))
    errors = np.where(views.weight > 0, errors, np.nan)
    medians = np.sort(np.nanmedian(errors, axis=-1), axis=1)
    return medians[:, : max(int(np.ceil(0.8 * medians.shape[1])), 1)].mean(axis=1)


def _finalists(score: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Hypotheses within reach of the best, different ones only."""
    chosen: list[int] = []
    for b in np.argsort(score, kind="stable"):
        if score[b] > 3.0 * score.min() + 0.3:
            break
        alike = [np.all(np.abs(parameters[b] - parameters[c])[[0, 4]] < (0.02, 0.05)) for c in chosen]
        if not any(alike):
            chosen.append(int(b))
    return np.array(chosen[:_MOST_FINALISTS])


def _explained(lens: Lens, fit: Fit, views: Views, far: float) -> np.ndarray:
    """Views (F,) whose median error is not far above that of most views."""
    errors = np.sqrt(squared_errors(lens, fit, views, far)[0])
    median = np.nanmedian(np.where(views.weight > 0, errors, np.nan), axis=-1)
    return median <= max(5.0 * float(np.median(median)), 0.003 * far)


def trimmed_rms(lens: Lens, fit: Fit, views: Views, far: float) -> float:
    """Root mean square error of the better nine tenths of the corners (their lengths), px."""
    squared = np.sort(squared_errors(lens, fit, views, far)[0][views.weight > 0])
    return float(np.sqrt(squared[: max(int(0.9 * len(squared)), 1)].mean())) if len(squared) else np.inf


def spread_views(frames: CameraFrames, count: int) -> np.ndarray:
    """Indices of up to `count` views, far apart in the board's place, size and shape in the image (greedy, exact ties
    by index, so that it is deterministic)."""
    if len(frames.frames) <= count:
        return np.arange(len(frames.frames))
    features = view_features(frames)
    chosen = [int(np.argmax(frames.seen.sum(axis=1)))]
    distance = np.full(len(features), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.sort(np.array(chosen))


def homography_focal(frames: CameraFrames, target: Target) -> float | None:
    """Focal length (px) that best explains the views' homographies, principal point at the centre, square pixels.

    Zhang 2000, eq. 3 and 4, with the image of the absolute conic reduced to one unknown, 1/f^2. None when the views
    do not tell (all frontal).
    """
    width, height = frames.detections.image_size
    centre = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
    board = target.points[:, :2] / np.ptp(target.points[:, :2], axis=0).max()
    rows, sides = [], []
    for pixels, seen in zip(frames.pixels, frames.seen, strict=True):
        homography, _ = cv2.findHomography(board[seen], (pixels[seen] - centre) / width)
        if homography is None:
            continue
        h1, h2 = homography[:, 0] / np.linalg.norm(homography), homography[:, 1] / np.linalg.norm(homography)
        rows += [h1[0] * h2[0] + h1[1] * h2[1], (h1[0] ** 2 + h1[1] ** 2) - (h2[0] ** 2 + h2[1] ** 2)]
        sides += [-h1[2] * h2[2], h2[2] ** 2 - h1[2] ** 2]
    inverse = float(np.dot(rows, sides) / max(np.dot(rows, rows), 1e-300)) if rows else -1.0
    if inverse <= 0 or not np.isfinite(inverse):
        return None
    focal = width / np.sqrt(inverse)
    return float(focal) if 0.1 * width < focal < 20.0 * width else None
