"""Are the stated sigmas true? Many simulated calibrations of the same views with new corner noise each time.

    python experiments/validate_uncertainty.py --runs 200 --full-runs 10

First the optimum alone, with known corner noise and from the true parameters, through one compiled problem; then
`calibrate_cameras` as users call it: no guess, corner noise estimated, outliers rejected. For each it prints every
parameter's scatter over its stated sigma (1 if the covariance is right; one standard error beside it), the normalised
error squared (NEES) with its 95 % bounds, the corner noise estimated from the residuals over the true one, and how the
projections scatter over the image against the projection uncertainty stated there.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tqdm import trange

from jaxcal import Calibration, CameraModel, Detections, Target, calibrate_cameras
from jaxcal.calibration import outliers, solving, uncertainty
from jaxcal.calibration.assemble import CameraFrames, camera_frames, split_groups, stack_groups
from jaxcal.calibration.problem import RigProblem
from jaxcal.calibration.robust import corner_errors, estimated_parameters
from jaxcal.calibration.state import RigState, camera_model_of
from jaxcal.estimation import solve
from jaxcal.results import CameraCalibration
from jaxcal.results.projection_uncertainty import projection_covariance
from jaxcal.simulation import SimulatedRig, paper_rig, simulate_detections
from jaxcal.simulation.measurements import T_cam_target


@dataclasses.dataclass(frozen=True)
class Truth:
    """A camera rig that stands still before a board held in many places: lenses, poses, and the corners without noise.

    `poses[c]` (F, 4, 4) T_cam_target of the frames of camera c; all cameras see all views.
    """

    models: list[CameraModel]
    target: Target
    frames: list[CameraFrames]
    poses: list[np.ndarray]

    @property
    def T_cam_cam0(self) -> list[np.ndarray]:
        """Poses (4, 4) of the cameras against the first one."""
        return [pose[0] @ np.linalg.inv(self.poses[0][0]) for pose in self.poses]


@dataclasses.dataclass(frozen=True)
class Scatter:
    """What many calibrations gave. `labels` (P,) the parameters; per run (R, ...): `errors` (R, P) estimate minus
    truth, `sigmas` (R, P) as stated, `nees` (R,), `noise` (R, C) the corner noise found (px), and `lenses[r][c]`.
    `first` is the calibration of the first run."""

    labels: list[str]
    errors: np.ndarray
    sigmas: np.ndarray
    nees: np.ndarray
    noise: np.ndarray
    lenses: list[list[CameraModel]]
    first: Calibration

    @property
    def ratio(self) -> np.ndarray:
        """Observed over stated sigma (P,); about the truth, so that a bias would raise it."""
        return np.sqrt(np.mean(self.errors**2, axis=0) / np.mean(self.sigmas**2, axis=0))

    @property
    def nees_bounds(self) -> tuple[float, float]:
        """95 % bounds of the mean NEES per degree of freedom, if the covariance is right."""
        freedom = len(self.nees) * len(self.labels)
        low, high = chi2.ppf([0.025, 0.975], freedom) / freedom
        return float(low), float(high)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200, help="calibrations with known corner noise")
    parser.add_argument("--full-runs", type=int, default=10, help="calibrations by calibrate_cameras")
    parser.add_argument("--cameras", type=int, nargs="+", default=[1, 2], help="cameras of the built-in rig, of 0 to 3")
    parser.add_argument("--views", type=int, default=32)
    parser.add_argument("--noise", type=float, default=0.2, help="corner noise, px")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--range", type=float, default=None, help="metres, of projected points (default: infinity)")
    arguments = parser.parse_args()
    truth = make_truth(arguments.cameras, arguments.views, arguments.seed)
    for title, scatter in (
        ("known corner noise, from the truth", known_noise(truth, arguments.runs, arguments.noise, arguments.seed)),
        ("calibrate_cameras", full_calibrations(truth, arguments.full_runs, arguments.noise, arguments.seed)),
    ):
        if scatter is None:
            continue
        print(f"\n## {title}: {len(scatter.errors)} runs\n")
        print(parameter_table(scatter, arguments.noise))
        for c in range(len(truth.models)):
            print(projection_table(truth, scatter, c, arguments.range))
    return 0


# --- the truth -------------------------------------------------------------------------------------------------------


def make_truth(cameras: Sequence[int], views: int, seed: int, target: Target | None = None) -> Truth:
    """Cameras of the built-in rig, made to take pictures at the same times; views that all of them see."""
    rig = paper_rig(duration_s=2.0 * views, seed=seed, target=target)
    chosen = [
        dataclasses.replace(rig.cameras[c], timeshift_cam_imu=0.0, phase_s=0.0, rate_hz=2.0, name=f"cam{i}")
        for i, c in enumerate(cameras)
    ]
    rig = dataclasses.replace(rig, cameras=tuple(chosen))
    seen = [simulate_detections(rig, c, noise_px=0.0) for c in range(len(chosen))]
    common = seen[0].seen_frames
    for detections in seen[1:]:
        common = np.intersect1d(common, detections.seen_frames)
    frames = [_frames(detections, common[:views], rig) for detections in seen]
    times = [rig.motion_time(camera, f.time_ns) for camera, f in zip(chosen, frames, strict=True)]
    return Truth(
        models=[camera.model for camera in chosen],
        target=rig.target,
        frames=frames,
        poses=[T_cam_target(rig, camera, time) for camera, time in zip(chosen, times, strict=True)],
    )


def _frames(detections: Detections, keep: np.ndarray, rig: SimulatedRig) -> CameraFrames:
    """The views `keep` alone, listed as the detections' only frames."""
    rows = np.isin(detections.frame, keep)
    only = Detections(
        detections.timestamps_ns[keep],
        np.searchsorted(keep, detections.frame[rows]),
        detections.point[rows],
        detections.pixels[rows],
        detections.image_size,
    )
    return camera_frames(only, rig.target, "camera", min_corners=4)


# --- many calibrations -----------------------------------------------------------------------------------------------


def known_noise(truth: Truth, runs: int, noise_px: float, seed: int = 0) -> Scatter | None:
    """The optimum of `runs` re-noised problems, each with its covariance there."""
    if runs < 2:
        return None
    problem, state = _problem(truth, noise_px)
    clean = [frames.pixels for frames in truth.frames]
    rng = np.random.default_rng([seed, 1])
    free = np.asarray(problem.free)
    labels = [f"cam{i}" for i in range(len(truth.models))]
    names = np.asarray(uncertainty.labels_of(labels, truth.models, problem.layout))[free].tolist()
    errors, sigmas, nees, noise, lenses = [], [], [], [], []
    first: Calibration | None = None
    for _ in trange(runs, unit="calibration"):
        noisy = [pixels + noise_px * rng.standard_normal(pixels.shape) for pixels in clean]
        renewed = _with_pixels(problem, noisy)
        result = solve(renewed, state, max_steps=50)
        covariance, _, _ = uncertainty.shared_covariance(result.equations, free, names)
        known = covariance[np.ix_(free, free)]
        error = _difference(result.state, state, problem)[free]
        errors.append(error)
        sigmas.append(np.sqrt(np.diag(known)))
        nees.append(error @ np.linalg.solve(known, error) / len(error))
        noise.append(_estimated_noise(truth, renewed, result.state))
        lenses.append(_lenses(result.state, problem))
        if first is None:
            first = _calibration(truth, problem, result.state, covariance, noise_px)
    assert first is not None
    return Scatter(names, np.array(errors), np.array(sigmas), np.array(nees), np.array(noise), lenses, first)


def full_calibrations(truth: Truth, runs: int, noise_px: float, seed: int = 0) -> Scatter | None:
    """The same through `calibrate_cameras`: its own start, noise and rejection."""
    if runs < 2:
        return None
    rng = np.random.default_rng([seed, 2])
    results: list[Calibration] = []
    for _ in trange(runs, unit="calibration"):
        noisy = [
            dataclasses.replace(d, pixels=d.pixels + noise_px * rng.standard_normal(d.pixels.shape))
            for d in (frames.detections for frames in truth.frames)
        ]
        results.append(calibrate_cameras(noisy, truth.target, [type(model) for model in truth.models]))
    labels, errors = [], []
    for result in results:
        labels, error = _errors_by_block(result, truth)
        errors.append(error)
    errors, covariances = np.array(errors), [result.covariance for result in results]
    return Scatter(
        labels,
        errors,
        np.array([np.sqrt(np.diag(covariance)) for covariance in covariances]),
        np.array([e @ np.linalg.solve(c, e) / len(e) for e, c in zip(errors, covariances, strict=True)]),
        np.array([[camera.corner_sigma_px for camera in result.cameras] for result in results]),
        [[camera.model for camera in result.cameras] for result in results],
        results[0],
    )


def _problem(truth: Truth, noise_px: float) -> tuple[RigProblem, RigState]:
    count = len(truth.frames[0].frames)
    T_target_cam0 = np.linalg.inv(truth.poses[0])
    relative = np.stack(truth.T_cam_cam0)
    return solving.camera_problem(
        truth.models,
        truth.frames,
        truth.target,
        views=[np.arange(count) for _ in truth.frames],
        weights=[np.full(frames.seen.shape, noise_px**-2) for frames in truth.frames],
        T_cam_rig=(relative[:, :3, :3], relative[:, :3, 3]),
        T_target_rig=(T_target_cam0[:, :3, :3], T_target_cam0[:, :3, 3]),
        loss_width=np.inf,
    )


def _with_pixels(problem: RigProblem, pixels: Sequence[np.ndarray]) -> RigProblem:
    stacked = stack_groups(problem.layout, [values.swapaxes(1, 2) for values in pixels])
    return eqx.tree_at(lambda p: [data.pixels for data in p.corners], problem, list(stacked))


def _lenses(state: RigState, problem: RigProblem) -> list[CameraModel]:
    cameras = range(problem.layout.num_cameras)
    return [camera_model_of(state, problem.layout, problem.templates, c) for c in cameras]


def _difference(estimate: RigState, truth: RigState, problem: RigProblem) -> np.ndarray:
    """Tangent vector (P,) of the shared parameters from the truth to the estimate."""
    layout, out = problem.layout, np.zeros(problem.layout.size)
    for c, (found, true) in enumerate(zip(_lenses(estimate, problem), _lenses(truth, problem), strict=True)):
        out[layout.lens(c)] = np.asarray(found.parameters - true.parameters)
        turn = np.asarray(estimate.R_cam_rig[c]) @ np.asarray(truth.R_cam_rig[c]).T
        shift = np.asarray(estimate.t_cam_rig[c] - truth.t_cam_rig[c])
        out[layout.pose(c)] = np.concatenate([Rotation.from_matrix(turn).as_rotvec(), shift])
    return out


def _estimated_noise(truth: Truth, problem: RigProblem, state: RigState) -> list[float]:
    """Corner noise (px) of each camera from its residuals, as `calibrate_cameras` estimates it."""
    errors = split_groups(problem.layout, truth.frames, [np.asarray(e) for e in corner_errors(problem, state)])
    poses = 6.0 * len(truth.frames[0].frames) / len(truth.frames)
    parameters = estimated_parameters(problem, [poses] * len(truth.frames))
    return [
        outliers.rms_sigma(error, frames.seen, paid)
        for error, frames, paid in zip(errors, truth.frames, parameters, strict=True)
    ]


def _calibration(
    truth: Truth, problem: RigProblem, state: RigState, covariance: np.ndarray, noise_px: float
) -> Calibration:
    """A `Calibration` that holds what projection uncertainty needs."""
    names = [f"cam{c}" for c in range(len(truth.models))]
    lenses = _lenses(state, problem)
    blocks, named = uncertainty.named_covariance(
        names, problem.layout, state, covariance, [m.num_intrinsics for m in lenses], with_imu=False, with_time=False
    )
    cameras = [
        CameraCalibration(
            name=name,
            model=lens,
            image_size=frames.detections.image_size,
            T_cn_cnm1=None,
            T_cam_imu=None,
            timeshift_cam_imu=None,
            detections=frames.detections,
            residuals_px=np.zeros((len(frames.detections), 2)),
            inlier=np.ones(len(frames.detections), dtype=bool),
            corner_sigma_px=noise_px,
            T_cam_target=poses,
        )
        for name, lens, frames, poses in zip(names, lenses, truth.frames, truth.poses, strict=True)
    ]
    return Calibration(tuple(cameras), truth.target, None, None, blocks, named, np.zeros(1))


def _errors_by_block(result: Calibration, truth: Truth) -> tuple[list[str], np.ndarray]:
    """Labels and errors of all blocks of a calibration, in the order of its covariance."""
    labels, errors = [], []
    for c, (camera, model) in enumerate(zip(result.cameras, truth.models, strict=True)):
        lens = [name for part in model.parameter_names for name in part]
        labels += [f"{camera.name} {name}" for name in lens]
        errors.append(np.asarray(camera.model.parameters - model.parameters))
        if camera.T_cn_cnm1 is not None:
            true = truth.T_cam_cam0[c] @ np.linalg.inv(truth.T_cam_cam0[c - 1])
            turn = Rotation.from_matrix(camera.T_cn_cnm1[:3, :3] @ true[:3, :3].T).as_rotvec()
            errors += [turn, camera.T_cn_cnm1[:3, 3] - true[:3, 3]]
            labels += [f"{camera.name} {part} {axis}" for part in ("rotation", "translation") for axis in "xyz"]
    return labels, np.concatenate(errors)


# --- projections -----------------------------------------------------------------------------------------------------


def grid_over(frames: CameraFrames, count: int = 5) -> np.ndarray:
    """Pixels (K, 2) spread over where corners were seen."""
    seen = frames.pixels[frames.seen]
    low, high = np.quantile(seen, [0.03, 0.97], axis=0)
    across, down = np.meshgrid(np.linspace(low[0], high[0], count), np.linspace(low[1], high[1], count))
    return np.stack([across.ravel(), down.ravel()], axis=1)


def projection_scatter(
    truth: Truth, scatter: Scatter, camera: int, pixels: np.ndarray, range_m: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Second moments (K, 2, 2), px^2, of the projections: observed over the runs, and stated by the first of them.

    The motion of the camera that each run's lens implies is found by non-linear least squares over all corners.
    """
    model, frames, poses = truth.models[camera], truth.frames[camera], truth.poses[camera]
    row, point = np.nonzero(frames.seen)
    T = poses[row]
    corners = np.einsum("mij,mj->mi", T[:, :3, :3], truth.target.points[point]) + T[:, :3, 3]
    rays = np.array(model.unproject(pixels))
    moves = []
    for lenses in scatter.lenses:
        R, t = implied_pose(model, lenses[camera], corners)
        there = rays @ R.T if range_m is None else range_m * rays @ R.T + t
        moves.append(np.asarray(_project(lenses[camera], jnp.asarray(there))) - pixels)
    observed = np.einsum("rki,rkj->kij", moves, moves) / len(moves)
    return observed, projection_covariance(scatter.first, camera, pixels, range_m)


def implied_pose(model: CameraModel, other: CameraModel, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motion R, t of points (M, 3) after which the lens `other` shows them where `model` did; by Gauss-Newton."""
    wanted = np.asarray(_project(model, jnp.asarray(points)))
    R, t = np.eye(3), np.zeros(3)
    for _ in range(5):
        moved = jnp.asarray(points @ R.T + t)
        by_turn = np.cross(np.eye(3)[None], np.asarray(moved)[:, None]).swapaxes(1, 2)
        by_motion = np.concatenate([by_turn, np.tile(np.eye(3), (len(points), 1, 1))], axis=2)
        slope = (np.asarray(_slopes(other, moved)) @ by_motion).reshape(-1, 6)
        error = (np.asarray(_project(other, moved)) - wanted).ravel()
        step = np.linalg.lstsq(slope, -error)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        R, t = turn @ R, turn @ t + step[3:]
    return R, t


@eqx.filter_jit
def _project(lens: CameraModel, points: Float[Array, "M 3"]) -> Float[Array, "M 2"]:
    return lens.project(points)


@eqx.filter_jit
def _slopes(lens: CameraModel, points: Float[Array, "M 3"]) -> Float[Array, "M 2 3"]:
    return jax.vmap(jax.jacrev(lens.project))(points)


# --- tables ----------------------------------------------------------------------------------------------------------


def parameter_table(scatter: Scatter, noise_px: float) -> str:
    """Observed over stated scatter of each parameter, as markdown."""
    error = 1.0 / np.sqrt(2.0 * len(scatter.errors))
    lines = ["| parameter | stated sigma | observed / stated | bias in sigmas |", "|---|---|---|---|"]
    bias = scatter.errors.mean(axis=0) / np.sqrt(np.mean(scatter.sigmas**2, axis=0))
    for label, sigma, ratio, off in zip(scatter.labels, scatter.sigmas.mean(axis=0), scatter.ratio, bias, strict=True):
        lines.append(f"| {label} | {sigma:.4g} | {ratio:.3f} +- {error:.3f} | {off:+.2f} |")
    low, high = scatter.nees_bounds
    together = float(np.sqrt(np.mean(scatter.ratio**2)))
    lines += [
        "",
        f"observed / stated: {scatter.ratio.min():.3f} to {scatter.ratio.max():.3f}, rms {together:.3f}",
        f"NEES per degree of freedom: {scatter.nees.mean():.3f} (95 % bounds {low:.3f} to {high:.3f})",
        f"corner noise found / true, mean per camera: {np.round(scatter.noise.mean(axis=0) / noise_px, 4).tolist()}",
    ]
    return "\n".join(lines)


def projection_table(truth: Truth, scatter: Scatter, camera: int, range_m: float | None) -> str:
    """The same for projections over the image of a camera."""
    pixels = grid_over(truth.frames[camera])
    observed, stated = projection_scatter(truth, scatter, camera, pixels, range_m)
    ratio = np.sqrt(np.trace(observed, axis1=1, axis2=2) / np.trace(stated, axis1=1, axis2=2))
    sigma = np.sqrt(np.trace(stated, axis1=1, axis2=2))
    side = int(np.sqrt(len(pixels)))
    return "\n".join(
        [
            f"\ncam{camera}, points at {'infinity' if range_m is None else f'{range_m:g} m'}: stated 2-D sigma (px)",
            str(np.round(sigma.reshape(side, side), 4)),
            f"observed / stated: mean {ratio.mean():.3f}",
            str(np.round(ratio.reshape(side, side), 3)),
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
