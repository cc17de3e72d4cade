"""`cross_validate`: halves of a calibration's observations against each other, and the cause where they differ."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc  # scipy.stats says the same, and takes half a second to import

from jaxcal.calibration.assemble import split_groups
from jaxcal.calibration.known import KnownProblem, known_problem, rank_of
from jaxcal.calibration.lens_basis import to_parameters
from jaxcal.calibration.model_errors import find_model_errors, with_lag
from jaxcal.calibration.problem import camera_poses
from jaxcal.calibration.resolving import recordings_of, resolve
from jaxcal.calibration.state import RigState, camera_model_of
from jaxcal.calibration.uncertainty import labels_of, named_covariance, shared_covariance
from jaxcal.errors import CalibrationError
from jaxcal.estimation import SolveResult
from jaxcal.observations import Detections, ImuRecording
from jaxcal.progress import Progress, no_progress
from jaxcal.results import Calibration
from jaxcal.results.compare import compare
from jaxcal.results.cross_validation import CrossValidation, Halves

# Fewer views than this in a half make no calibration to be compared.
_FEWEST_VIEWS = 8
_FEWEST_OF_A_CAMERA = 4
# IMU samples are kept this far beyond the frames of a half (s).
_MARGIN_S = 0.2


def cross_validate(
    calibration: Calibration, *, imu_halves: bool = True, progress: Progress = no_progress
) -> CrossValidation:
    """Tell errors of the model from noise, from nothing but the calibration itself.

    Cameras are calibrated from two halves of the views, taken in turns, in time, and near and far; the projections of
    the halves are compared over the image, after the implied change of pose, and their parameters in combined sigmas.
    Then every likely cause is tested (`model_errors`): a lean lens model, a bent or misprinted board, a rolling shutter
    taken for global, a lens or a camera's place that changed. With an IMU, lenses and board are tested with the views'
    poses free; and, with `imu_halves`, the first and second half of the recording are calibrated anew, as a whole.

    False alarms are held to one in a hundred cross-validations (`FALSE_ALARMS`), where corners have independent noise.

    Raises CalibrationError when there are too few views, and as `known_problem` does.
    """
    splits = 3 + (calibration.imu is not None and imu_halves)
    progress("cross-validate", 0, splits + 1)
    known = known_problem(calibration)
    if known.num_views < 2 * _FEWEST_VIEWS:
        raise CalibrationError(
            f"cross-validation: {known.num_views} views; {2 * _FEWEST_VIEWS} are the least, so that half of them makes "
            "a calibration."
        )
    halves, notes = [], []
    for done, (name, first) in enumerate(_splits(known)):
        halves.append(_halves(known, name, first))
        progress("cross-validate", done + 1, splits + 1)
    if calibration.imu is not None and imu_halves:
        found = _imu_halves(calibration)
        halves.append(found)
        progress("cross-validate", splits, splits + 1)
    if not _moving_pictures(known):
        notes.append("frames are too far apart to tell velocities: whether a shutter rolls was not tested")
    lagging = [camera.name for camera, lags in zip(calibration.cameras, with_lag(calibration), strict=True) if lags]
    if lagging:
        notes.append(f"{', '.join(lagging)}: stamps may lag (`stamp_sigma_s`), so no rolling shutter was looked for")
    if known.inflation > 1.0:
        notes.append(
            "errors of views that look alike agree, so that these views count less and sigmas were raised: an error of "
            "the model by itself"
        )
    evidence = find_model_errors(known, len(halves))
    progress("cross-validate", splits + 1, splits + 1)
    return CrossValidation(tuple(halves), tuple(evidence), tuple(notes))


def _splits(known: KnownProblem) -> list[tuple[str, np.ndarray]]:
    """Which views (V,) are in the first half, for each way to take them apart."""
    distance = np.zeros(known.num_views)
    for c, view in enumerate(known.views):
        poses = known.calibration.cameras[c].T_cam_target
        assert poses is not None
        distance[view] = np.linalg.norm(poses[known.cameras[c].frames][:, :3, 3], axis=1)
    early, near = np.zeros((2, known.num_views), dtype=bool)
    for own in known.halved_alone:
        early[own] = rank_of(known.times_s[own]) < len(own) // 2
        near[own] = rank_of(distance[own]) < len(own) // 2
    splits = [("in turns", known.in_turns()), ("in time", early), ("near and far", near)]
    for name, part in splits:
        for camera, view in zip(known.calibration.cameras, known.views, strict=True):
            fewest = min(int(part[view].sum()), int((~part[view]).sum()))
            if fewest < _FEWEST_OF_A_CAMERA:
                raise CalibrationError(
                    f"cross-validation: {fewest} views of {camera.name} fall into one half ({name}); "
                    f"{_FEWEST_OF_A_CAMERA} are the least. Record more views with this camera."
                )
    return splits


def _moving_pictures(known: KnownProblem) -> bool:
    return any(np.median(np.diff(frames.time_ns)) < 0.25e9 for frames in known.cameras)


def _halves(known: KnownProblem, split: str, first: np.ndarray) -> Halves:
    results = [known.solve(part.astype(float)) for part in (first, ~first)]
    covariances = [_covariance(known, result) for result in results]
    apart = _difference(results[1].state, results[0].state, known)[known.free]
    together = (covariances[0] + covariances[1])[np.ix_(known.free, known.free)]
    gain, freedom = _mahalanobis(apart, together)
    made = [
        _calibration(known, result, covariance, part)
        for result, covariance, part in zip(results, covariances, (first, ~first), strict=True)
    ]
    difference = compare(made[0], made[1])
    return Halves(split, difference, gain, freedom, float(chdtrc(freedom, gain)))


def _mahalanobis(apart: np.ndarray, covariance: np.ndarray) -> tuple[float, int]:
    """Squared distance in sigmas, and in how many directions; those that are hardly known, or held, are left out."""
    sigma = np.sqrt(np.diag(covariance))
    free = sigma > 0
    scaled = covariance[np.ix_(free, free)] / np.outer(sigma[free], sigma[free])
    values, vectors = np.linalg.eigh(scaled)
    kept = values > 1e-10 * values.max()
    part = vectors[:, kept].T @ (apart[free] / sigma[free])
    return float(np.sum(part**2 / values[kept])), int(kept.sum())


def _covariance(known: KnownProblem, result: SolveResult) -> np.ndarray:
    """(P, P) of the shared parameters from half of the views."""
    names = [camera.name for camera in known.calibration.cameras]
    models = [camera.model for camera in known.calibration.cameras]
    labels = labels_of(names, models, known.layout)
    back = to_parameters(known.problem.basis, known.layout)
    covariance, _, _ = shared_covariance(result.equations, known.free, labels, back)
    return covariance * known.inflation


def _difference(estimate: RigState, other: RigState, known: KnownProblem) -> np.ndarray:
    """Tangent vector (P,) of the shared parameters from one state to another."""
    layout, out = known.layout, np.zeros(known.layout.size)
    for c in range(layout.num_cameras):
        group, place = layout.place(c)
        out[layout.lens(c)] = np.asarray(estimate.lenses[group])[place] - np.asarray(other.lenses[group])[place]
        turn = np.asarray(estimate.R_cam_rig[c]) @ np.asarray(other.R_cam_rig[c]).T
        out[layout.pose(c)] = np.r_[
            Rotation.from_matrix(turn).as_rotvec(), np.asarray(estimate.t_cam_rig[c] - other.t_cam_rig[c])
        ]
    boards = []
    for b in range(layout.extra_boards):
        turn = np.asarray(estimate.target.R_target_board[b]) @ np.asarray(other.target.R_target_board[b]).T
        shift = np.asarray(estimate.target.t_target_board[b] - other.target.t_target_board[b])
        boards += [Rotation.from_matrix(turn).as_rotvec(), shift]
    rest = [np.asarray(estimate.target.warp - other.target.warp)]
    rest.append(np.asarray(estimate.target.offsets - other.target.offsets).ravel())
    out[layout.target] = np.concatenate([*boards, *rest])
    return out


def _calibration(known: KnownProblem, result: SolveResult, covariance: np.ndarray, part: np.ndarray) -> Calibration:
    """What half of the views give, as far as it takes part in a comparison."""
    layout, whole = known.layout, known.calibration
    poses = split_groups(layout, known.cameras, [np.asarray(p) for p in camera_poses(known.problem, result.state)])
    intrinsics = [camera.model.num_intrinsics for camera in whole.cameras]
    names = [camera.name for camera in whole.cameras]
    blocks, named = named_covariance(
        names, layout, result.state, covariance, intrinsics, with_imu=False, with_time=False
    )
    R, t = np.asarray(result.state.R_cam_rig), np.asarray(result.state.t_cam_rig)
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, t
    cameras = []
    for c, camera in enumerate(whole.cameras):
        frames = known.cameras[c]
        taken = part[known.views[c]]
        T_cam_target = np.full((len(camera.detections.timestamps_ns), 4, 4), np.nan)
        T_cam_target[frames.frames[taken]] = poses[c][taken]
        dense = np.zeros((len(camera.detections.timestamps_ns), frames.seen.shape[1]), dtype=bool)
        dense[frames.frames[taken]] = known.kept[c][taken]
        cameras.append(
            dataclasses.replace(
                camera,
                model=camera_model_of(result.state, layout, known.problem.templates, c),
                T_cn_cnm1=None if c == 0 else T[c] @ np.linalg.inv(T[c - 1]),
                T_cam_imu=None,
                timeshift_cam_imu=None,
                T_cam_target=T_cam_target,
                inlier=dense[camera.detections.frame, camera.detections.point],
            )
        )
    return dataclasses.replace(whole, cameras=tuple(cameras), imu=None, blocks=blocks, covariance=named)


# --- with an IMU -----------------------------------------------------------------------------------------------------


def _imu_halves(calibration: Calibration) -> Halves:
    """The first and the second half of the recording, calibrated as a whole was."""
    times = np.concatenate([c.detections.timestamps_ns[c.detections.seen_frames] for c in calibration.cameras])
    middle = int(np.median(times))
    made = []
    for early in (True, False):
        corners = [_side(camera.detections, middle, early) for camera in calibration.cameras]
        imus = [_cut(imu, middle, early) for imu in recordings_of(calibration)]
        made.append(resolve(calibration, detections=corners, imu=imus))
    difference = compare(made[0], made[1])
    # Poses of cameras to each other say again what those to the IMU say; the target is the same one.
    rows = [p for p in difference.parameters if p.sigma and not p.group.endswith("T_cn_cnm1")]
    names = list(dict.fromkeys(p.group for p in rows))
    scale = {"deg": np.degrees(1.0), "mm": 1e3, "ms": 1e3}
    apart = np.array([p.difference / scale.get(p.unit, 1.0) for p in rows])
    covariance = made[0].covariance_of(*names) + made[1].covariance_of(*names)
    gain, freedom = _mahalanobis(apart, covariance)
    return Halves("in time, with the IMU", difference, gain, freedom, float(chdtrc(freedom, gain)))


def _side(detections: Detections, middle_ns: int, early: bool) -> Detections:
    return detections.of_frames((detections.timestamps_ns <= middle_ns) == early)


def _cut(imu: ImuRecording, middle_ns: int, early: bool) -> ImuRecording:
    margin = round(_MARGIN_S * 1e9)
    kept = imu.timestamps_ns <= middle_ns + margin if early else imu.timestamps_ns >= middle_ns - margin
    return ImuRecording(imu.timestamps_ns[kept], imu.gyro_rad_s[kept], imu.accel_m_s2[kept], imu.noise)
