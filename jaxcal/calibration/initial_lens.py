"""A first lens from the views of one camera alone, with no guess from the user.

A sweep over lenses of all kinds (`generic_lens`) on a few views finds the field of view; the best of them are refined
on more views, and the model that was asked for is fitted to the winner and refined on the same views.
"""

import dataclasses
import logging
from collections.abc import Iterator, Sequence

import numpy as np

from jaxcal.calibration import generic_lens
from jaxcal.calibration.assemble import CameraFrames
from jaxcal.calibration.first_fit import FREE_DAMPING, Fit, Lens, Views, compact_views, fit_lenses, squared_errors
from jaxcal.calibration.generic_lens import GenericLens
from jaxcal.calibration.generic_search import Found, generic_candidates, spread_views, trimmed_rms
from jaxcal.calibration.lens_poses import HUBER_PX, swap_mirrored
from jaxcal.calibration.model_lens import ModelLens
from jaxcal.cameras import CameraModel
from jaxcal.cameras.refit import fit_rays
from jaxcal.errors import CalibrationError
from jaxcal.estimation.threads import single_threaded_blas
from jaxcal.targets import Target

logger = logging.getLogger(__name__)

# Views that the requested model is fitted to.
_MODEL_VIEWS = 60
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
        candidates = generic_candidates(subset, target, views, size)
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


def _requested(
    model: type[CameraModel], candidates: Sequence[Found], views: Views, size: tuple[int, int]
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
    model: type[CameraModel], found: Found, views: Views, size: tuple[int, int]
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


def _as_good(fit: Fit, views: Views, start: CameraModel, found: Found, far: float) -> bool:
    """Whether a fitted model explains the corners as well as the generic lens does, at the image's rim too."""
    lens = ModelLens(start)
    if trimmed_rms(lens, fit, views, far) >= 1.3 * found.rms_px + 0.05:
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
    width = float(np.clip(2.5 * median, 0.1, HUBER_PX))
    # From one optimum to another nearby.
    fit = fit_lenses(lens, fit, views, steps=20, width=width, cap=far, prior=_model_prior(start), damping=FREE_DAMPING)
    return start.with_parameters(fit.parameters[0]), trimmed_rms(lens, fit, views, far)


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
        best = fit_lenses(lens, fit, views, steps=40, width=HUBER_PX, cap=far, prior=prior)
        fit, swapped = swap_mirrored(lens, best, views, far)
        if not swapped:
            return best
    return fit_lenses(lens, fit, views, steps=40, width=HUBER_PX, cap=far, prior=prior)


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
        lens, fit, views.with_weight(views.weight * ~suspect[:, None]), steps=20, width=HUBER_PX, cap=far, prior=prior
    )
    trial, _ = swap_mirrored(lens, trial, views, far)
    trial = _joint_fit(lens, trial, views, prior, far)
    return trial if trial.cost[0] < fit.cost[0] * (1.0 - 1e-4) else None


def _advice(half_degrees: float) -> str:
    """What to do about a lens of this field of view, which the model asked for cannot hold."""
    if half_degrees > 60.0:
        return "Use 'pinhole-equi', 'ds-none', 'eucm-none' or 'omni-radtan', which are made for such lenses."
    return "Use a model with distortion ('pinhole-radtan', or 'pinhole-equi' for a fisheye)."
