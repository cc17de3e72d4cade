"""From a fit to the `Calibration` that users get."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from jaxcal.calibration import observability, outliers, uncertainty
from jaxcal.calibration.assemble import CameraFrames, split_groups
from jaxcal.calibration.checks import versions
from jaxcal.calibration.left_out import Wandering, corner_weights, equations_with, wandering
from jaxcal.calibration.lens_basis import to_parameters
from jaxcal.calibration.problem import camera_poses
from jaxcal.calibration.redundancy import Redundancy
from jaxcal.calibration.robust import RobustFit
from jaxcal.calibration.rolling import check_readout
from jaxcal.calibration.score_noise import ScoreNoise, score_noise
from jaxcal.calibration.state import RigState, SharedLayout, camera_model_of, transform
from jaxcal.calibration.target_shape import target_points
from jaxcal.calibration.view_noise import LEAN, share_of_place
from jaxcal.cameras import CameraModel, model_name
from jaxcal.errors import CalibrationError
from jaxcal.estimation import BlockArrow, on_device
from jaxcal.results import Calibration, CameraCalibration, ImuCalibration, TargetShape
from jaxcal.targets import Target

# Corners of any video, and of frames made of events, hang together somewhat, and sigmas allow for it. Where they are
# more than five times as large for it, something is amiss.
_WORTH_SAYING = 25.0


def chain_covariance_and_sentences(
    fit: RobustFit,
    names: Sequence[str],
    models: Sequence[CameraModel],
    cameras: Sequence[CameraFrames],
    imu_effects: Sequence[np.ndarray] = (),
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Covariance of shared parameters, marginal covariance of the chain, sentences on what is unobserved.

    Corners that hang together, and IMUs whose gyro and accel err with the motion by `imu_effects` (2,) each (factors of
    their variance), tell less than least squares took from them: covariances allow for that.
    """
    layout = fit.problem.layout
    basis = to_parameters(fit.problem.basis, layout)
    known_as = (np.asarray(fit.problem.free), uncertainty.labels_of(names, models, layout), basis)
    noises = _score_noises(fit, cameras)
    # Views that repeat each other's errors got relative weights, which claim too much by `inflation` in any case.
    effects = [
        max(1.0 if noise is None else noise.effect, known.inflation)
        for noise, known in zip(noises, fit.redundancy, strict=True)
    ]
    equations = _equations_of_less(fit, cameras, effects, imu_effects)
    covariance, chain, sentences = uncertainty.shared_covariance(equations, *known_as)
    astray = _wanderings(fit, cameras, noises)
    to_named = np.eye(layout.size) if basis is None else basis
    for found, effect in zip(astray, effects, strict=True):
        if found is not None:
            covariance = covariance + to_named @ found.beyond(effect) @ to_named.T
    lenses = [None if found is not None else noise for noise, found in zip(noises, astray, strict=True)]
    if any(noise is not None for noise in lenses):
        # How the optimum answers to a score is a matter of the weights that it was found with.
        response = uncertainty.shared_covariance(fit.result.equations, *known_as)[0]
        covariance = covariance + _beyond_the_mean(response, layout, lenses, effects)
    of_all = [max(e, 1.0 if found is None else found.effect) for e, found in zip(effects, astray, strict=True)]
    sentences += sentences_on_errors(names, fit.redundancy, of_all)
    return covariance, chain, sentences


def _wanderings(
    fit: RobustFit, cameras: Sequence[CameraFrames], noises: Sequence[ScoreNoise | None]
) -> list[Wandering | None]:
    """What those cameras do to the others whose corners hang together. A camera by itself has its poses from its own
    corners: its lens is all that they lead astray, and the score of that says how far."""
    if fit.problem.layout.num_cameras == 1 and fit.problem.imu is None:
        return [None]
    return [None if noise is None else wandering(fit, cameras, c) for c, noise in enumerate(noises)]


def _beyond_the_mean(
    response: np.ndarray, layout: SharedLayout, noises: Sequence[ScoreNoise | None], effects: Sequence[float]
) -> np.ndarray:
    """Covariance (P, P) from the directions of each lens whose score scatters by more than the camera's `effects`;
    `response` (P, P) is how the shared parameters answer to scores."""
    total = np.zeros_like(response)
    for c, (noise, effect) in enumerate(zip(noises, effects, strict=True)):
        if noise is not None:
            by_score = response[:, layout.lens(c)]
            total += by_score @ noise.beyond(effect) @ by_score.T
    return total


def sentences_on_errors(
    names: Sequence[str], redundancies: Sequence[Redundancy], effects: Sequence[float]
) -> list[str]:
    """Sentences about cameras whose errors are no independent noise: `effects` (C,), factors of their variance."""
    sentences = []
    for name, redundancy, effect in zip(names, redundancies, effects, strict=True):
        if redundancy.inflation > 1.0:
            what = (
                f"the errors of views that look alike agree (correlation {redundancy.correlation:.2f}), so they are no "
                "noise: the lens model is too lean, the board not flat, or the detector biased. Such views count less"
            )
        elif effect > _WORTH_SAYING:
            what = "the errors of corners hang together, within a view or from one view to the next"
        else:
            continue
        sentences.append(
            f"{name}: {what}, and sigmas of this camera are {np.sqrt(effect):.1f} times what independent errors of the "
            "same size would make them."
        )
    return sentences


def _score_noises(fit: RobustFit, cameras: Sequence[CameraFrames]) -> list[ScoreNoise | None]:
    """How the scores of each camera's lens scatter; None where they do as its corners' weights say."""
    problem, state, layout = fit.problem, fit.state, fit.problem.layout
    poses = split_groups(layout, cameras, [np.asarray(part) for part in camera_poses(problem, state)])
    points = np.asarray(target_points(problem.geometry, state.target))
    models = [camera_model_of(state, layout, problem.templates, c) for c in range(layout.num_cameras)]
    parts = zip(models, poses, fit.errors, corner_weights(fit, cameras), strict=True)
    return [score_noise(model, points, *own) for model, *own in parts]


def _equations_of_less(
    fit: RobustFit, cameras: Sequence[CameraFrames], effects: Sequence[float], imu_effects: Sequence[np.ndarray]
) -> BlockArrow:
    """The equations at the optimum with each camera's corners and each IMU's samples counting as much as they tell."""
    if max(effects) == 1.0 and all((effect == 1.0).all() for effect in imu_effects):
        return fit.result.equations
    if fit.problem.imu is not None and fit.problem.imu.samples:  # a trajectory may be of cameras alone
        samples = zip(fit.problem.imu.samples, imu_effects, strict=True)
        inverse = [own.inverse_sigma / on_device(np.sqrt(np.repeat(effect, 3))) for own, effect in samples]
        problem = eqx.tree_at(lambda p: [own.inverse_sigma for own in p.imu.samples], fit.problem, inverse)
        fit = dataclasses.replace(fit, problem=problem)
    weights = [own / effect for own, effect in zip(corner_weights(fit, cameras), effects, strict=True)]
    return equations_with(fit, cameras, weights)


# What to try where a lens is too lean for its corners.
_RICHER = {
    "pinhole-none": "pinhole-radtan",
    "pinhole-radtan": "pinhole-radtan5, pinhole-rational8 or, for a wide lens, pinhole-equi",
    "pinhole-radtan5": "pinhole-rational8",
    "pinhole-fov": "pinhole-equi or ds-none",
    "pinhole-division": "pinhole-radtan or pinhole-equi",
    "omni-none": "omni-radtan",
    "ds-none": "pinhole-equi or omni-radtan",
    "eucm-none": "pinhole-equi or omni-radtan",
}


def lens_sentences(
    fit: RobustFit, names: Sequence[str], models: Sequence[CameraModel], cameras: Sequence[CameraFrames]
) -> list[str]:
    """Sentences about lenses that the corners say more of than their models can."""
    sentences = []
    for name, model, frames, errors, kept in zip(names, models, cameras, fit.errors, fit.kept, strict=True):
        share = share_of_place(frames, errors * frames.precision[..., None], kept)
        if share > LEAN:
            richer = _RICHER.get(model_name(model), "a splined one (splined-3-12-9-FOV)")
            sentences.append(
                f"{name}: {100 * share:.0f} % of its squared errors go by the place in the image, which noise does "
                f"not: {model_name(model)} is too lean for this lens. Try {richer}."
            )
    return sentences


def calibration_from(
    fit: RobustFit,
    names: Sequence[str],
    cameras: Sequence[CameraFrames],
    usable: Sequence[np.ndarray],
    target: Target,
    *,
    covariance: np.ndarray,
    imus: Sequence[ImuCalibration] = (),
    warnings: Sequence[str],
    settings: Mapping[str, Any],
    with_time: bool = True,
) -> Calibration:
    """Assemble the result; `covariance` (P, P) is that of the shared tangent vector, `with_time` whether time shifts
    were estimated. Raises CalibrationError when the recording leaves a lens open and no optimum was found."""
    state, layout = fit.state, fit.problem.layout
    models = [camera_model_of(state, layout, fit.problem.templates, c) for c in range(layout.num_cameras)]
    num_intrinsics = [model.num_intrinsics for model in models]
    blocks, named = uncertainty.named_covariance(
        names, layout, state, covariance, num_intrinsics, with_imu=bool(imus), with_time=with_time
    )
    poses = split_groups(layout, cameras, [np.asarray(part) for part in camera_poses(fit.problem, state)])
    seen = [frames.seen & ok[:, None] for frames, ok in zip(cameras, usable, strict=True)]
    shape = _target_shape(state, layout)
    points = target.points if shape is None else shape.points(target)
    left_open = _left_open(fit, names, models, covariance, cameras, poses, points)
    results = [
        _camera_result(fit, c, name, models[c], cameras[c], seen[c], _per_timestamp(poses[c], cameras[c], usable[c]))
        for c, name in enumerate(names)
    ]
    lean = lens_sentences(fit, names, models, cameras)
    sentences = [*left_open, *warnings, *lean, *outliers.rejection_warnings(names, seen, fit.kept)]
    if not bool(fit.result.converged):
        reason = ", because the recording leaves parameters open" if left_open else ""
        sentences.insert(0, f"The optimisation stopped before it converged{reason}. Do not use this result.")
    history = np.asarray(fit.result.history)
    return Calibration(
        cameras=tuple(_placed(results, state, with_imu=bool(imus), with_time=with_time)),
        target=target,
        gravity=np.asarray(state.gravity) if imus else None,
        imu=imus[0] if imus else None,
        extra_imus=tuple(imus[1:]),
        blocks=blocks,
        covariance=named,
        convergence=history[np.isfinite(history)],
        warnings=tuple(sentences),
        settings=dict(settings),
        versions=versions(),
        converged=bool(fit.result.converged),
        target_shape=shape,
    )


def _left_open(
    fit: RobustFit,
    names: Sequence[str],
    models: Sequence[CameraModel],
    covariance: np.ndarray,
    cameras: Sequence[CameraFrames],
    poses: Sequence[np.ndarray],
    points: np.ndarray,
) -> tuple[str, ...]:
    """Sentences on what the recording leaves open; raises CalibrationError when that is a lens, and no optimum was
    found."""
    layout = fit.problem.layout
    views = split_groups(layout, cameras, [np.asarray(data.view) for data in fit.problem.corners])
    # Cameras that move along a spline take their pictures each for itself.
    of_rig = views if fit.problem.order == 1 else None
    free = np.asarray(fit.problem.free)
    found = observability.advice(names, models, layout, covariance, free, cameras, fit.kept, poses, points, of_rig)
    if found.lens_unknown and not bool(fit.result.converged):
        # The lens is on its way to infinity, say: neither it nor its sigmas mean anything.
        raise CalibrationError(
            "failed, because the recording does not determine the lens, and the optimisation finds no end. "
            + " ".join(found.sentences)
        )
    return found.sentences


def _camera_result(
    fit: RobustFit,
    c: int,
    name: str,
    model: CameraModel,
    frames: CameraFrames,
    seen: np.ndarray,
    T_cam_target: np.ndarray,
) -> CameraCalibration:
    """A camera by itself: lens, corners, line delay; not yet its place in the rig."""
    delay = None
    if fit.problem.layout.is_rolling(c):
        delay = float(np.asarray(fit.state.line_delay)[c])
        check_readout(name, delay, frames.detections.image_size[1])
    return CameraCalibration(
        name=name,
        model=model,
        image_size=frames.detections.image_size,
        T_cn_cnm1=None,
        T_cam_imu=None,
        timeshift_cam_imu=None,
        detections=frames.detections,
        residuals_px=frames.per_corner(np.where(seen[..., None], fit.errors[c], np.nan), np.nan),
        inlier=frames.per_corner(fit.kept[c], False),
        corner_sigma_px=fit.sigmas[c],
        T_cam_target=T_cam_target,
        line_delay_s=delay,
    )


def _placed(
    cameras: Sequence[CameraCalibration], state: RigState, *, with_imu: bool, with_time: bool
) -> Iterator[CameraCalibration]:
    """The cameras with their places in the rig and, where they were estimated, their time shifts."""
    T_cam_rig = [transform(R, t) for R, t in zip(np.asarray(state.R_cam_rig), np.asarray(state.t_cam_rig), strict=True)]
    for c, (camera, shift) in enumerate(zip(cameras, np.asarray(state.shift), strict=True)):
        yield dataclasses.replace(
            camera,
            T_cn_cnm1=None if c == 0 else T_cam_rig[c] @ np.linalg.inv(T_cam_rig[c - 1]),
            T_cam_imu=T_cam_rig[c] if with_imu else None,
            timeshift_cam_imu=float(shift) if with_imu else None,
            timeshift_cam_cam0=float(shift) if with_time and not with_imu else None,
        )


def _per_timestamp(poses: np.ndarray, frames: CameraFrames, usable: np.ndarray) -> np.ndarray:
    out = np.full((len(frames.detections.timestamps_ns), 4, 4), np.nan)
    out[frames.frames[usable]] = poses[usable]
    return out


def _target_shape(state: RigState, layout: SharedLayout) -> TargetShape | None:
    if not layout.target_size:
        return None
    found = state.target
    boards = [
        transform(np.asarray(R), np.asarray(t))
        for R, t in zip(*(found.R_target_board, found.t_target_board), strict=True)
    ]
    return TargetShape(
        T_target_board=np.stack([np.eye(4), *boards]),
        warp_m=np.asarray(found.warp) if layout.warp else None,
        offsets_m=np.asarray(found.offsets) if layout.offsets else None,
    )
