"""`calibrate_camera_imu`: cameras and an IMU jointly, on a continuous-time trajectory."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
import numpy as np

from jaxcal.calibration import extra_imus, imu_results, inertial_noise, initial_imu, solving, spline_setup
from jaxcal.calibration.assemble import CameraFrames, camera_frames, vision_data
from jaxcal.calibration.checks import resolve_models, resolve_names
from jaxcal.calibration.extra_imus import OtherImu
from jaxcal.calibration.inertial import InertialData
from jaxcal.calibration.initial_imu import Alignment, CameraTrack
from jaxcal.calibration.initial_lens import initial_lens
from jaxcal.calibration.lens_basis import own_parameters
from jaxcal.calibration.lens_poses import board_poses
from jaxcal.calibration.outcome import calibration_from, chain_covariance_and_sentences
from jaxcal.calibration.problem import LensPrior, RigProblem
from jaxcal.calibration.robust import robust_fit
from jaxcal.calibration.rolling import row_intervals, shutters_of
from jaxcal.calibration.spline_setup import BinnedImu, SplineGrid
from jaxcal.calibration.state import RigState, SharedLayout, block_count, flat_target, free_blocks, layout_of
from jaxcal.calibration.target_shape import TargetGeometry, geometry_of
from jaxcal.calibration.uncertainty import stamp_sigmas_of, with_common_delay
from jaxcal.cameras import CameraModel, model_name
from jaxcal.errors import CalibrationError
from jaxcal.estimation import LOSSES, Loss, on_device
from jaxcal.imu import imu_model
from jaxcal.observations import Detections, ImuRecording
from jaxcal.progress import Progress, no_progress, track
from jaxcal.results import Calibration
from jaxcal.targets import Target

# The spline reaches this far beyond the first and last frame, so that time offsets have room to move (s).
_MARGIN_S = 0.1
# Frames nearer than this to the spline's ends are left out (s).
_EDGE_S = 0.01
# Tracks thin frames out to this spacing (s) when those of several cameras are merged.
_TRACK_STEP_S = 0.004


def calibrate_camera_imu(
    detections: Sequence[Detections],
    imu: ImuRecording | Sequence[ImuRecording],
    target: Target,
    models: Sequence[str | type[CameraModel]] | None = None,
    *,
    imu_models: str | Sequence[str] = "calibrated",
    gravity_magnitude: bool = False,
    rolling_shutter: bool | Sequence[bool] = False,
    cameras: Calibration | None = None,
    names: Sequence[str] | None = None,
    intrinsics: Literal["free", "prior", "held"] = "free",
    imu_noise: Literal["at least given", "given", "estimated"] = "at least given",
    board_warp: bool = False,
    point_offset_sigma_m: float | None = None,
    loss: Loss = "huber",
    spline_order: int = spline_setup.SPLINE_ORDER,
    knot_rate_hz: float | None = None,
    stamp_sigma_s: float | Sequence[float] = 0.0,
    max_steps: int = 60,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate cameras and IMUs jointly: lenses, T_cam_imu, time offsets, gravity, biases and trajectory.

    No initial guess is needed, and cameras need not be synchronised or see the board together. Model: Furgale, Rehder
    and Siegwart, "Unified temporal and spatial calibration for multi-sensor systems", IROS 2013.

    `detections` one per camera, `models` as for `calibrate_cameras`; `imu` one recording or several: the first one's
    frame and clock are the rig's, of each further one T_imu_imu0 and a time offset are estimated. `imu_models` for all
    or one each: 'calibrated', 'scale-misalignment', 'scale-misalignment-size-effect' (`jaxcal.imu`).
    `gravity_magnitude` estimates the strength of gravity too, rather than its direction alone. `rolling_shutter`, for
    all cameras or one each: rows are seen one after another, and the delay of a row is estimated; a frame's time is
    that of its first row. `cameras` an earlier calibration of the same cameras to start from. `intrinsics`: estimate
    the lenses freely, under the prior of `cameras`, or hold them. `imu_noise`: 'given' trusts the noise densities; 'at
    least given' raises them where the residuals are larger, so that sigmas stay honest; 'estimated' takes what the
    residuals show, larger or smaller. `board_warp`, `point_offset_sigma_m`: how the board is bent, and where its points
    are, as for `calibrate_cameras` (offsets of all points are three unknowns each: slow). `loss`: the robust loss under
    which outlying corners are found, as for `calibrate_cameras`; they are left out of the final least squares.
    `spline_order` 4 to 6 and `knot_rate_hz`, chosen from the first IMU's own spectrum by default. `stamp_sigma_s`, for
    all cameras or one each: 1-sigma of a delay that all time stamps of the camera share and no measurement shows, such
    as the lag of frames made of events; it goes into the sigma of the time offset.

    Raises CalibrationError when frames and IMU do not overlap or do not move together, and as `calibrate_cameras`.
    """
    _check_options(target, spline_order, loss, intrinsics, cameras)
    names = resolve_names(detections, names)
    frames = [camera_frames(d, target, name) for d, name in zip(detections, names, strict=True)]
    lenses = _first_lenses(names, detections, models, cameras, frames, target, progress)

    imus = [imu] if isinstance(imu, ImuRecording) else list(imu)
    imu_names = _imu_models(imu_models, len(imus))
    stamp_sigmas = stamp_sigmas_of(stamp_sigma_s, len(names))
    first = imus[0]
    imu_time = (first.timestamps_ns - first.timestamps_ns[0]) * 1e-9
    start = _align_all(names, lenses, frames, target, first, imu_time)
    others = extra_imus.align_others(start.tracks[start.reference], start.alignments[start.reference], imus)
    grid = _grid(start, imu_time, first, spline_order, knot_rate_hz)
    usable = _usable_frames(names, start, grid)
    binned = extra_imus.bin_all(grid, imus, [place.shift_s for place in others])
    shutters = shutters_of(rolling_shutter, len(names))
    layout = layout_of(
        list(lenses),
        imus=extra_imus.places_of(imu_names),
        warp=board_warp,
        offsets=len(target.points) if point_offset_sigma_m is not None else 0,
        gravity_size=3 if gravity_magnitude else 2,
        rolling=shutters,
    )
    geometry = geometry_of(target, point_offset_sigma_m)
    problem = _problem(lenses, frames, geometry, start, binned, grid, cameras, names, intrinsics, layout, loss)
    state = _first_state(lenses, layout, start, others, grid, first, imu_time)

    noise = inertial_noise.NoiseModel(binned, grid, imu_noise)
    fit = robust_fit(
        problem,
        state,
        frames,
        usable,
        first_sigmas=start.sigmas,
        pose_parameters=[0.0] * len(names),
        max_steps=max_steps,
        progress=progress,
        reweigh=noise.reweigh,
    )
    excesses = noise.excesses(fit.problem, fit.state)
    covariance, chain, sentences = chain_covariance_and_sentences(fit, names, lenses, frames, excesses)
    results = imu_results.imu_calibrations(fit, imus, noise, chain, grid)
    settings = {
        "job": "calibrate_camera_imu",
        "models": [model_name(lens) for lens in lenses],
        "imu_models": imu_names,
        "gravity_magnitude": gravity_magnitude,
        "rolling_shutter": shutters,
        "intrinsics": intrinsics,
        "imu_noise": imu_noise,
        "board_warp": board_warp,
        "point_offset_sigma_m": point_offset_sigma_m,
        "loss": loss,
        "spline_order": spline_order,
        "knot_rate_hz": 1.0 / grid.dt,
        "stamp_sigma_s": stamp_sigmas,
        "max_steps": max_steps,
    }
    return calibration_from(
        fit,
        names,
        frames,
        usable,
        target,
        covariance=with_common_delay(covariance, layout, stamp_sigmas, to_first_camera=False),
        imus=results,
        warnings=[*sentences, *noise.warnings(fit, excesses)],
        settings=settings,
    )


def _check_options(target: Target, spline_order: int, loss: str, intrinsics: str, cameras: Calibration | None) -> None:
    if spline_order not in (4, 5, 6):
        raise CalibrationError(f"spline_order is {spline_order}; expected 4, 5 or 6.")
    if loss not in LOSSES:
        raise CalibrationError(f"robust loss '{loss}' is unknown; known: {', '.join(LOSSES)}.")
    if len(target.boards) > 1:
        raise CalibrationError(f"the target has {len(target.boards)} boards; calibrate with one (with an IMU).")
    if intrinsics not in ("free", "prior", "held"):
        raise CalibrationError(f"intrinsics is '{intrinsics}'; expected free, prior or held.")
    if intrinsics != "free" and cameras is None:
        raise CalibrationError(f"intrinsics='{intrinsics}' needs `cameras`, the calibration that they come from.")


def _imu_models(models: str | Sequence[str], count: int) -> list[str]:
    names = [models] * count if isinstance(models, str) else list(models)
    if count == 0:
        raise CalibrationError("no IMU recording was given; use `calibrate_cameras` for cameras alone.")
    if len(names) != count:
        raise CalibrationError(
            f"`imu_models` names {len(names)} models for {count} IMUs; give one for all or one each."
        )
    return [imu_model(name).name for name in names]


@dataclass(frozen=True)
class _Start:
    """What is known before the joint solve, per camera; times on the camera's clock, s since the IMU's first sample."""

    times: list[np.ndarray]
    tracks: list[CameraTrack]
    alignments: list[Alignment]
    t_cam_imu: list[np.ndarray]
    sigmas: list[float]
    reference: int


def _first_lenses(
    names: Sequence[str],
    detections: Sequence[Detections],
    models: Sequence[str | type[CameraModel]] | None,
    cameras: Calibration | None,
    frames: Sequence[CameraFrames],
    target: Target,
    progress: Progress,
) -> list[CameraModel]:
    if cameras is not None:
        if len(cameras.cameras) != len(detections):
            raise CalibrationError(
                f"`cameras` holds {len(cameras.cameras)} cameras, but there are detections of {len(detections)}."
            )
        return [camera.model for camera in cameras.cameras]
    work = list(zip(names, resolve_models(detections, models), frames, strict=True))
    return [initial_lens(n, m, f, target) for n, m, f in track(work, "initial lenses", len(work), progress)]


def _align_all(
    names: Sequence[str],
    lenses: Sequence[CameraModel],
    frames: Sequence[CameraFrames],
    target: Target,
    imu: ImuRecording,
    imu_time: np.ndarray,
) -> _Start:
    """Board poses of each camera, their alignment with the IMU, and the cameras' places relative to each other."""
    times, tracks, alignments, sigmas = [], [], [], []
    for name, lens, camera in zip(names, lenses, frames, strict=True):
        time = (camera.time_ns - imu.timestamps_ns[0]) * 1e-9
        R_cam_target, t_cam_target, error = board_poses(lens, camera, target)
        good = error <= max(4.0 * float(np.median(error)), 0.2)
        R_target_cam = R_cam_target[good].swapaxes(-1, -2)
        position = -np.einsum("fij,fj->fi", R_target_cam, t_cam_target[good])
        times.append(time)
        tracks.append(CameraTrack(time[good], R_target_cam, position))
        alignments.append(initial_imu.align(tracks[-1], imu_time, imu.gyro_rad_s, name))
        sigmas.append(max(float(np.median(error)) / np.sqrt(2.0), 1e-3))
    shifts = [a.shift_s for a in alignments]
    initial_imu.check_coverage(tracks, shifts, imu, imu_time)
    reference = int(np.argmax([len(t.time_s) for t in tracks]))
    arms = initial_imu.lever_arms(tracks[reference], tracks, shifts, shifts[reference])
    arms[reference] = np.zeros(3)
    return _Start(times, tracks, alignments, arms, sigmas, reference)


def _grid(start: _Start, imu_time: np.ndarray, imu: ImuRecording, order: int, knot_rate_hz: float | None) -> SplineGrid:
    first = min(t.time_s[0] + a.shift_s for t, a in zip(start.tracks, start.alignments, strict=True)) - _MARGIN_S
    last = max(t.time_s[-1] + a.shift_s for t, a in zip(start.tracks, start.alignments, strict=True)) + _MARGIN_S
    first, last = max(first, imu_time[0]), min(last, imu_time[-1])
    if knot_rate_hz is None:
        inside = (imu_time >= first) & (imu_time <= last)
        knot_rate_hz = spline_setup.choose_knot_rate(
            imu_time[inside], imu.gyro_rad_s[inside], imu.accel_m_s2[inside], order
        )
    return spline_setup.make_grid(first, last, order, knot_rate_hz)


def _usable_frames(names: Sequence[str], start: _Start, grid: SplineGrid) -> list[np.ndarray]:
    """Which frames (F,) of each camera lie on the trajectory."""
    usable = [
        (t + a.shift_s > grid.start + _EDGE_S) & (t + a.shift_s < grid.stop - _EDGE_S)
        for t, a in zip(start.times, start.alignments, strict=True)
    ]
    for name, ok in zip(names, usable, strict=True):
        if ok.sum() < 3:
            raise CalibrationError(f"{name}: {ok.sum()} frames lie within the IMU recording; at least 3 are needed.")
    return usable


def _problem(
    lenses: Sequence[CameraModel],
    frames: Sequence[CameraFrames],
    geometry: TargetGeometry,
    start: _Start,
    binned: Sequence[BinnedImu],
    grid: SplineGrid,
    cameras: Calibration | None,
    names: Sequence[str],
    intrinsics: str,
    layout: SharedLayout,
    loss: Loss,
) -> RigProblem:
    free = solving.free_coordinates(lenses, layout)
    if intrinsics == "held":
        for c in range(layout.num_cameras):
            free[layout.lens(c)] = False
    prior = solving.lens_prior(lenses, layout, frames)
    if intrinsics == "prior" and cameras is not None:
        prior = _lens_prior(cameras, layout)
    return RigProblem(
        templates=solving.templates_of(lenses, layout),
        corners=vision_data(layout, frames, weights=[np.ones(f.seen.shape) for f in frames], times=start.times),
        geometry=geometry,
        imu=InertialData(tuple(b.samples for b in binned), on_device(grid.start), on_device(grid.dt)),
        prior=prior,
        free_chain=on_device(free_blocks(grid.intervals + grid.order - 1, grid.order, len(binned))),
        free=on_device(free),
        loss_width=on_device(1.0),
        basis=own_parameters(lenses, layout),
        layout=layout,
        order=grid.order,
        loss=loss,
        row_intervals=row_intervals(layout, grid.dt),
    )


def _lens_prior(cameras: Calibration, layout: SharedLayout) -> LensPrior:
    """The camera-only calibration's lenses and the inverse of their covariance."""

    def information(c: int) -> np.ndarray:
        camera = cameras.cameras[c]
        blocks = [f"{camera.name}.intrinsics"] + ([f"{camera.name}.distortion"] if len(camera.model.distortion) else [])
        return np.linalg.inv(cameras.covariance_of(*blocks))

    return LensPrior(
        mean=tuple(jnp.stack([cameras.cameras[c].model.parameters for c in members]) for members in layout.groups),
        information=tuple(jnp.stack([on_device(information(c)) for c in members]) for members in layout.groups),
    )


def _first_state(
    lenses: Sequence[CameraModel],
    layout: SharedLayout,
    start: _Start,
    others: Sequence[OtherImu],
    grid: SplineGrid,
    imu: ImuRecording,
    imu_time: np.ndarray,
) -> RigState:
    time, rotation, position = _merged_track(start)
    bias = start.alignments[start.reference].gyro_bias
    inside = (imu_time >= grid.start) & (imu_time <= grid.stop)
    imu_time = imu_time[inside]
    orientation = initial_imu.orientation_track(time, rotation, imu_time, imu.gyro_rad_s[inside] - bias)
    rotations, positions = spline_setup.first_chain(grid, imu_time, orientation, time, position)
    biases = np.concatenate([[*b, 0.0, 0.0, 0.0] for b in (bias, *(place.gyro_bias for place in others[1:]))])
    return RigState(
        lenses=solving.stack_lenses(lenses, layout),
        R_cam_rig=on_device(np.stack([a.R_cam_imu for a in start.alignments])),
        t_cam_rig=on_device(np.stack(start.t_cam_imu)),
        shift=on_device([a.shift_s for a in start.alignments]),
        gravity=on_device(initial_imu.gravity_from(orientation, imu.accel_m_s2[inside])),
        rotations=on_device(rotations),
        positions=on_device(positions),
        biases=on_device(np.tile(biases, (block_count(len(positions), grid.order), 1))),
        target=flat_target(layout),
        imu_parameters=tuple(on_device(np.asarray(imu_model(imu.model).nominal, dtype=float)) for imu in layout.imus),
        R_imu_rig=on_device(np.stack([place.R_imu_imu0 for place in others])),
        t_imu_rig=on_device(np.zeros((len(others), 3))),
        imu_shift=on_device([place.shift_s for place in others]),
        line_delay=on_device(np.zeros(len(lenses) if layout.rolling else 0)),
    )


def _merged_track(start: _Start) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_target_imu from the frames of all cameras: times on the IMU's clock, increasing and spaced; R; p."""
    times, rotations, positions = [], [], []
    for c, (camera, a) in enumerate(zip(start.tracks, start.alignments, strict=True)):
        times.append(camera.time_s + a.shift_s)
        rotations.append(camera.rotation @ a.R_cam_imu)
        positions.append(camera.position + camera.rotation @ start.t_cam_imu[c])
    time = np.concatenate(times)
    # The reference camera comes first among frames of one instant.
    rank = np.concatenate([np.full(len(t), int(c != start.reference)) for c, t in enumerate(times)])
    order = np.lexsort((rank, np.round(time / _TRACK_STEP_S)))
    keep = []
    for k in order:
        if not keep or time[k] - time[keep[-1]] > _TRACK_STEP_S / 2:
            keep.append(k)
    return time[keep], np.concatenate(rotations)[keep], np.concatenate(positions)[keep]
