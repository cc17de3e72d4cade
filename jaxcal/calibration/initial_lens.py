"""A first lens and first board poses from the views of one camera alone, with no guess from the user.

A sweep over lenses of all kinds (`generic_lens`) on a few views finds the field of view; the best of them are refined
on more views, and the model that was asked for is fitted to the winner and refined on the same views.
"""

import dataclasses
import logging
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from jaxcal.calibration import generic_lens
from jaxcal.calibration.assemble import CameraFrames
from jaxcal.calibration.first_fit import Fit, Lens, Views, compact_views, fit_lenses, fit_poses, squared_errors
from jaxcal.calibration.generic_lens import GenericLens
from jaxcal.calibration.initial_poses import mirrored_poses, planar_poses
from jaxcal.calibration.model_lens import ModelLens
from jaxcal.calibration.redundancy import view_features
from jaxcal.cameras import CameraModel
from jaxcal.cameras.refit import fit_rays
from jaxcal.errors import CalibrationError
from jaxcal.estimation.threads import single_threaded_blas
from jaxcal.targets import Target

logger = logging.getLogger(__name__)

# Views and corners per view: of the sweep, of the refinement of its best hypotheses, of the model's own.
_SWEEP_VIEWS, _SWEEP_CORNERS = 10, 40
_GENERIC_VIEWS, _GENERIC_CORNERS = 24, 80
_MODEL_VIEWS = 60
_MOST_FINALISTS = 3
# Corner errors (px) up to which they count in full.
_HUBER_PX = 3.0
# Corner noise (px) taken for granted until it is known, in the scale of priors alone.
_FIRST_NOISE_PX = 0.1
# The share of their usual spread that parameters have at the start.
_START_SPREAD = 0.3
# Information on parameters that are held: nothing that corners say comes near.
_HELD = 1e18
# Focal lengths tried for the requested model, relative to the one found.
_FOCAL_FACTORS = (0.6, 1.7)
# Fits of the requested model whose cost is not higher than so many times the best are its rivals (wrong corners make up
# most of the cost); parameters that differ by less, of themselves or absolutely, are one lens.
_RIVAL_COST, _SAME_LENS = 1.02, 1e-3
# The share of the corners that the requested model may lose against the generic lens.
_LOST = 0.005
# A view whose median error is this many times that of most views may stand in a wrong pose.
_SUSPECT = 1.6
_POSE_STEPS = 12
_POSE_CORNERS = 32_300  # corners at once: they just fill a large piece of `ModelLens`


@dataclasses.dataclass(frozen=True)
class _Found:
    """A generic lens with poses of all the views it was judged by, and which of these views it explains (F,).

    `cost`, px^2, of these views and of the prior.
    """

    fit: Fit
    good: np.ndarray
    rms_px: float
    cost: float


@dataclasses.dataclass(frozen=True)
class FirstLens:
    """The best lens found, and `rivals`: others of its kind that explain the corners nearly as well, so that only the
    joint optimisation can tell which is better."""

    lens: CameraModel
    rivals: tuple[CameraModel, ...] = ()


def initial_lens(name: str, model: type[CameraModel], frames: CameraFrames, target: Target) -> CameraModel:
    """The best lens of the requested kind that a search without a guess finds; raises as `initial_lens_and_rivals`."""
    return initial_lens_and_rivals(name, model, frames, target).lens


def initial_lens_and_rivals(name: str, model: type[CameraModel], frames: CameraFrames, target: Target) -> FirstLens:
    """The best lens of the requested kind that a search without a guess finds, and its rivals.

    Raises CalibrationError when no lens explains the views, or when the requested model is far from holding the lens
    that does.
    """
    size = frames.detections.image_size
    subset = frames.take(spread_views(frames, _MODEL_VIEWS))
    views = compact_views(target.points, subset.pixels, subset.seen)
    with single_threaded_blas():
        candidates = _generic_candidates(subset, target, views, size)
        best = candidates[0]
        logger.debug("%s: generic lenses %s", name, [(c.rms_px, c.fit.parameters[0]) for c in candidates])
        if not best.rms_px < 0.02 * max(size):
            raise CalibrationError(
                f"{name}: failed, because no lens explains the views of the board: the best one misses the corners by "
                f"{best.rms_px:.1f} px (root mean square) in {best.good.sum()} views. Check the target's size, layout "
                "and orientation, and that the corners' indices are those of this target."
            )
        first, rms_px = _requested(model, candidates, views, size)
    if rms_px > max(0.004 * max(size), 8.0 * best.rms_px):
        seen = generic_lens.half_field_of_view(
            best.fit.parameters[0], views.pixels[best.good][views.weight[best.good] > 0]
        )
        raise CalibrationError(
            f"{name}: failed, because {model.name or model.__name__} cannot hold this lens: it misses the corners by "
            f"{rms_px:.1f} px (root mean square), where a generic lens misses them by {best.rms_px:.2f} px. The "
            f"corners reach {seen:.0f} degrees from the axis: a field of view of {2 * seen:.0f}. {_advice(seen)}"
        )
    return first


def initial_lenses(
    names: Sequence[str], models: Sequence[type[CameraModel]], cameras: Sequence[CameraFrames], target: Target
) -> list[CameraModel]:
    """`initial_lens` for each camera."""
    return [initial_lens(n, m, f, target) for n, m, f in zip(names, models, cameras, strict=True)]


def board_poses(model: CameraModel, frames: CameraFrames, target: Target) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_cam_target of every frame through a known lens, the better of the two poses that a flat board allows.

    It takes all corners to tell which is the better one through a narrow lens; a third of them was not enough.

    Returns rotations (F, 3, 3), translations (F, 3) and the root mean square error (F,), px, of each.
    """
    lens = ModelLens(model)
    parameters = np.asarray(model.parameters)[None]
    far = float(max(frames.detections.image_size))
    parts = []
    with single_threaded_blas():
        generic = generic_of(model, frames.detections.image_size)
        chunk = max(_POSE_CORNERS // len(target.points), 1)
        for first in range(0, len(frames.frames), chunk):
            part = slice(first, first + chunk)
            views = compact_views(target.points, frames.pixels[part], frames.seen[part])
            fit = _poses_from_rays(lens, parameters, *generic_lens.unproject(generic, views.pixels), views, far)
            squared = squared_errors(lens, fit, views, far=1e6)[0]
            error = np.sqrt(np.sum(squared * views.weight, axis=1) / views.weight.sum(axis=1))
            parts.append((fit.rotation[0], views.to_target(fit.rotation[0], fit.translation[0]), error))
    rotation, translation, error = (np.concatenate(values) for values in zip(*parts, strict=True))
    return rotation, translation, error


def generic_of(model: CameraModel, image_size: tuple[int, int]) -> np.ndarray:
    """The generic lens (1, 6) nearest to a model over its image: good enough to start poses from, with no unprojection
    of the model's own to compile or to iterate."""
    far = float(max(image_size))
    angle = np.deg2rad(np.geomspace(0.2, 125.0, 30))
    around = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rays = np.stack(
        [
            np.sin(angle)[:, None] * np.cos(around),
            np.sin(angle)[:, None] * np.sin(around),
            np.tile(np.cos(angle)[:, None], (1, len(around))),
        ],
        axis=-1,
    )
    seen = ModelLens(model).project(
        np.asarray(model.parameters)[None], rays.reshape(1, 1, -1, 3).swapaxes(-1, -2), False
    )
    pixels = seen.pixels[0, 0].T.reshape(*rays.shape[:-1], 2)
    # Outwards until the lens ends or folds back.
    radius = np.linalg.norm(pixels - pixels[0].mean(axis=0), axis=-1)
    outwards = np.diff(radius, axis=0, prepend=0.0) > 0.0
    inside = np.all((pixels > -0.05 * far) & (pixels < np.array(image_size) + 0.05 * far), axis=-1)
    real = np.cumprod(outwards & seen.valid[0, 0].reshape(radius.shape), axis=0) * inside
    views = Views(
        rays.reshape(1, -1, 3), pixels.reshape(1, -1, 2), real.reshape(1, -1).astype(np.float64), np.zeros(3), 1.0
    )
    parameters = generic_lens.hypotheses(pixels[real > 0], image_size, None)
    count = len(parameters)
    start = Fit(parameters, np.tile(np.eye(3), (count, 1, 1, 1)), np.zeros((count, 1, 3)), np.full(count, np.inf))
    prior = generic_lens.weak_prior(image_size, _FIRST_NOISE_PX)
    fit = fit_lenses(GenericLens(), start, views, steps=20, width=_HUBER_PX, cap=far, prior=prior, hold_poses=True)
    return fit.parameters[[int(np.argmin(fit.cost))]]


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


# --- poses -----------------------------------------------------------------------------------------------------------


def _poses_from_rays(
    lens: Lens, parameters: np.ndarray, rays: np.ndarray, valid: np.ndarray, views: Views, size: float
) -> Fit:
    """Poses of all views for lenses (B, n) from rays (B, F, N, 3), `valid` (B, F, N): the better of both."""
    weight = views.weight * valid
    weight = np.where(weight.sum(axis=-1, keepdims=True) >= 6, weight, views.weight)
    rotation, translation = planar_poses(views.points, rays, weight)
    fit = Fit(parameters, rotation, translation, np.full(len(parameters), np.inf))
    fit, cost = fit_poses(lens, fit, views, steps=_POSE_STEPS, width=_HUBER_PX, cap=0.25 * size)
    return _better_of_mirrored(lens, fit, cost, views, size)[0]


def _better_of_mirrored(lens: Lens, fit: Fit, cost: np.ndarray, views: Views, size: float) -> tuple[Fit, np.ndarray]:
    """The fit with every pose that its mirror image beats replaced, and which ones were (B, F)."""
    middle = (
        np.sum(views.points * views.weight[..., None], axis=-2) / np.maximum(views.weight.sum(axis=-1), 1.0)[:, None]
    )
    rotation, translation = mirrored_poses(fit.rotation, fit.translation, middle)
    other = Fit(fit.parameters, rotation, translation, fit.cost)
    other, other_cost = fit_poses(lens, other, views, steps=_POSE_STEPS, width=_HUBER_PX, cap=0.25 * size, beat=cost)
    swap = other_cost < cost - 1e-9 * np.abs(cost)
    merged = Fit(
        fit.parameters,
        np.where(swap[..., None, None], other.rotation, fit.rotation),
        np.where(swap[..., None], other.translation, fit.translation),
        np.where(swap, other_cost, cost).sum(axis=-1),
    )
    return merged, swap


# --- the generic lens ------------------------------------------------------------------------------------------------


def _generic_candidates(frames: CameraFrames, target: Target, views: Views, size: tuple[int, int]) -> list[_Found]:
    """Generic lenses with the poses of `views`, the best first."""
    lens = GenericLens()
    prior = generic_lens.weak_prior(size, _FIRST_NOISE_PX)
    far = float(max(size))
    swept = spread_views(frames, _SWEEP_VIEWS)
    thin = compact_views(target.points, frames.pixels, frames.seen, _SWEEP_CORNERS)
    few = thin.take(swept)
    parameters = generic_lens.hypotheses(few.pixels[few.weight > 0], size, homography_focal(frames.take(swept), target))
    fit = _poses_from_rays(lens, parameters, *generic_lens.unproject(parameters, few.pixels), few, far)
    for share, steps in ((0.6, 8), (0.6, 12)):
        width = _loss_width(lens, fit, few, share, far)
        fit = fit_lenses(lens, fit, few, steps=steps, width=width, cap=0.25 * far, prior=prior, rtol=1e-3)

    more = thin.take(spread_views(frames, _GENERIC_VIEWS))
    order = np.argsort(_score(lens, fit, few, far), kind="stable")[: 2 * _MOST_FINALISTS]
    fit = _poses_from_rays(
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


def _extended(lens: Lens, parameters: np.ndarray, views: Views, size: tuple[int, int]) -> _Found:
    """One hypothesis on all views: poses, which views it explains, and the lens refined on these."""
    far = float(max(size))
    fit = _poses_from_rays(lens, parameters, *generic_lens.unproject(parameters, views.pixels), views, far)
    for _ in range(3):
        good = _explained(lens, fit, views, far)
        kept = views.with_weight(views.weight * good[:, None])
        rms_px = _trimmed_rms(lens, fit, kept, far)
        prior = generic_lens.weak_prior(size, max(rms_px, 0.05))
        fit = fit_lenses(lens, fit, kept, steps=15, width=_HUBER_PX, cap=0.25 * far, prior=prior)
        found = _Found(fit, good, rms_px, float(fit.cost[0]))
        fit, swapped = _swap_mirrored(lens, fit, views, far)
        if not swapped:
            break
    return dataclasses.replace(found, fit=fit, rms_px=_trimmed_rms(lens, fit, kept, far))


def _swap_mirrored(lens: Lens, fit: Fit, views: Views, far: float) -> tuple[Fit, bool]:
    fit, cost = fit_poses(lens, fit, views, steps=3, width=_HUBER_PX, cap=0.25 * far)
    fit, swap = _better_of_mirrored(lens, fit, cost, views, far)
    return fit, bool(swap.any())


def _loss_width(lens: Lens, fit: Fit, views: Views, share: float, far: float) -> np.ndarray:
    """Huber widths (B,) at which `share` of the corners count in full; a hypothesis far off is judged by most."""
    errors = np.sqrt(squared_errors(lens, fit, views, far))[:, views.weight > 0]
    return np.maximum(np.quantile(errors, share, axis=1), _HUBER_PX)


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


def _trimmed_rms(lens: Lens, fit: Fit, views: Views, far: float) -> float:
    """Root mean square error of the better nine tenths of the corners (their lengths), px."""
    squared = np.sort(squared_errors(lens, fit, views, far)[0][views.weight > 0])
    return float(np.sqrt(squared[: max(int(0.9 * len(squared)), 1)].mean())) if len(squared) else np.inf


# --- the requested model ---------------------------------------------------------------------------------------------


def _requested(
    model: type[CameraModel], candidates: Sequence[_Found], views: Views, size: tuple[int, int]
) -> tuple[FirstLens, float]:
    """The requested model fitted to the generic lens' views, from several starts while it is worse than that lens, with
    its rivals and its error, px."""
    far = float(max(size))
    best: tuple[Fit, Views, CameraModel] | None = None
    met: list[Fit] = []
    for found in candidates:
        kept = views.with_weight(views.weight * found.good[:, None])
        for starts in _starts(model, found, kept, size):
            # All that the model offers: some lenses (near-unified double spheres) have two nearly equal optima.
            for start in starts:
                fit = _fit_model(start, found.fit, kept, far)
                logger.debug("%s: cost %.6g, %s", model.name, fit.cost[0], fit.parameters[0])
                met.append(fit)
                if best is None or fit.cost[0] < best[0].cost[0]:
                    best = (fit, kept, start)
            if best is not None and _as_good(*best, found, far):
                return _with_rivals(*best, met, far)
    assert best is not None
    return _with_rivals(*best, met, far)


def _with_rivals(fit: Fit, views: Views, start: CameraModel, met: Sequence[Fit], far: float) -> tuple[FirstLens, float]:
    """The fit, sharpened, and those of the others met that cost hardly more; with the error, px."""
    lens, rms_px = _sharpened(fit, views, start, far)
    different = [fit.parameters[0]]
    for other in sorted(met, key=lambda f: float(f.cost[0])):
        same = [np.allclose(other.parameters[0], p, rtol=_SAME_LENS, atol=_SAME_LENS) for p in different]
        if other.cost[0] < _RIVAL_COST * fit.cost[0] and not any(same):
            different.append(other.parameters[0])
    return FirstLens(lens, tuple(start.with_parameters(p) for p in different[1:])), rms_px


def _starts(
    model: type[CameraModel], found: _Found, views: Views, size: tuple[int, int]
) -> Iterator[Sequence[CameraModel]]:
    """Lenses to start the requested model from: its own for the focal length found, one fitted to the generic lens
    itself, its own for other focal lengths."""
    focal = float(np.exp(found.fit.parameters[0, 0]))
    yield model.starts(focal, size)
    rays, exists = generic_lens.unproject(found.fit.parameters, views.pixels)
    used = (views.weight > 0) & exists[0]
    try:
        yield [fit_rays(model, rays[0][used], views.pixels[used], size)]
    except CalibrationError as error:
        logger.debug("%s: %s", model.name, error)
    for factor in _FOCAL_FACTORS:
        yield model.starts(focal * factor, size)


def _as_good(fit: Fit, views: Views, start: CameraModel, found: _Found, far: float) -> bool:
    """Whether a fitted model explains the corners as well as the generic lens does, at the image's rim too."""
    lens = ModelLens(start)
    if _trimmed_rms(lens, fit, views, far) >= 1.3 * found.rms_px + 0.05:
        return False
    seen = views.weight > 0
    limit = max(8.0 * found.rms_px, 0.004 * far) ** 2
    generic = squared_errors(GenericLens(), found.fit, views, far)[0]
    lost = seen & (generic < limit) & (squared_errors(lens, fit, views, far)[0] > limit)
    return bool(lost.sum() <= _LOST * seen.sum())


def _sharpened(fit: Fit, views: Views, start: CameraModel, far: float) -> tuple[CameraModel, float]:
    """The fit with a loss as narrow as the corners' own noise, so that wrong corners pull less; and its error, px."""
    lens = ModelLens(start)
    median = float(np.sqrt(np.median(squared_errors(lens, fit, views, far)[0][views.weight > 0])))
    width = float(np.clip(2.5 * median, 0.1, _HUBER_PX))
    fit = fit_lenses(lens, fit, views, steps=20, width=width, cap=far, prior=_model_prior(start))
    return start.with_parameters(fit.parameters[0]), _trimmed_rms(lens, fit, views, far)


def _model_prior(start: CameraModel) -> tuple[np.ndarray, np.ndarray]:
    """The model's own regularisation, what it holds, and what is usual, more strictly than in the end: of the lenses
    that do equally well the plainest is the best to start from."""
    mean, information = np.array(start.parameters), np.array(start.regularisation())
    for place, name in enumerate(name for part in start.parameter_names for name in part):
        if name in start.usual_spread:
            mean[place], information[place] = 0.0, (_START_SPREAD * start.usual_spread[name]) ** -2
    information[list(start.held)] = _HELD
    return mean, information


def _fit_model(start: CameraModel, generic: Fit, views: Views, far: float) -> Fit:
    """The lens alone on the generic lens' poses, ever more of the image with it, then everything together."""
    lens = ModelLens(start)
    prior = _model_prior(start)
    fit = Fit(np.asarray(start.parameters)[None], generic.rotation, generic.translation, np.array([np.inf]))
    for cap in (0.05 * far, 0.25 * far, far):
        fit = fit_lenses(lens, fit, views, steps=15, width=0.02 * far, cap=cap, prior=prior, hold_poses=True, rtol=1e-2)
    fit = _joint_fit(lens, fit, views, prior, far)
    for _ in range(2):
        better = _without_suspects(lens, fit, views, prior, far)
        if better is None:
            break
        fit = better
    return fit


def _joint_fit(lens: Lens, fit: Fit, views: Views, prior: tuple[np.ndarray, np.ndarray], far: float) -> Fit:
    """Lens and poses together, until no pose is better mirrored."""
    for _ in range(3):
        best = fit_lenses(lens, fit, views, steps=40, width=_HUBER_PX, cap=far, prior=prior)
        fit, swapped = _swap_mirrored(lens, best, views, far)
        if not swapped:
            return best
    return fit_lenses(lens, fit, views, steps=40, width=_HUBER_PX, cap=far, prior=prior)


def _without_suspects(
    lens: Lens, fit: Fit, views: Views, prior: tuple[np.ndarray, np.ndarray], far: float
) -> Fit | None:
    """A better fit that leaves out, for a while, the views it explains worst; None where there is none.

    A lens can bend itself to the wrong one of a view's two poses, which then is the better one for that lens.
    """
    errors = np.sqrt(squared_errors(lens, fit, views, far)[0])
    seen = views.weight.sum(axis=1) > 0
    median = np.array([np.median(e[w > 0]) if w.any() else 0.0 for e, w in zip(errors, views.weight, strict=True)])
    suspect = seen & (median > max(_SUSPECT * float(np.median(median[seen])), float(np.quantile(median[seen], 0.8))))
    if not suspect.any():
        return None
    trial = fit_lenses(
        lens, fit, views.with_weight(views.weight * ~suspect[:, None]), steps=20, width=_HUBER_PX, cap=far, prior=prior
    )
    trial, _ = _swap_mirrored(lens, trial, views, far)
    trial = _joint_fit(lens, trial, views, prior, far)
    return trial if trial.cost[0] < fit.cost[0] * (1.0 - 1e-4) else None


def _advice(half_degrees: float) -> str:
    """What to do about a lens of this field of view, which the model asked for cannot hold."""
    if half_degrees > 60.0:
        return "Use 'pinhole-equi', 'ds-none', 'eucm-none' or 'omni-radtan', which are made for such lenses."
    return "Use a model with distortion ('pinhole-radtan', or 'pinhole-equi' for a fisheye)."
