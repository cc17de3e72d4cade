"""Simulated rigs with known truth, and how far a calibration is from it in units of its own sigmas."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal import Calibration, Detections
from jaxcal.cameras import CameraModel, PinholeEquidistant
from jaxcal.simulation import SimulatedCamera, SimulatedRig, paper_rig, simulate_detections

# Every camera-only test uses this many frames per camera, so that few programs are compiled.
FRAMES = 32
FISHEYE = PinholeEquidistant.create([402.0, 404.0, 322.0, 237.0], [0.03, -0.012, 0.006, -0.002])


def synchronised(rig: SimulatedRig, cameras: Sequence[int], rate_hz: float = 2.0) -> SimulatedRig:
    """The rig with some of its cameras only, all taking frames at the same times on one clock."""
    chosen = [
        dataclasses.replace(rig.cameras[c], timeshift_cam_imu=0.0, phase_s=0.0, rate_hz=rate_hz, name=f"cam{i}")
        for i, c in enumerate(cameras)
    ]
    return dataclasses.replace(rig, cameras=tuple(chosen))


def with_lens(rig: SimulatedRig, camera: int, lens: CameraModel) -> SimulatedRig:
    cameras = list(rig.cameras)
    cameras[camera] = dataclasses.replace(cameras[camera], model=lens)
    return dataclasses.replace(rig, cameras=tuple(cameras))


def still_rig(cameras: Sequence[int], seed: int = 0, fisheyes: Sequence[int] = ()) -> SimulatedRig:
    """Cameras of the built-in rig (indices into it) in 60 poses; `fisheyes` are places in the new rig."""
    rig = synchronised(paper_rig(duration_s=30.0, seed=seed), cameras)
    for place in fisheyes:
        rig = with_lens(rig, place, FISHEYE)
    return rig


def seen_by(rig: SimulatedRig, noise_px: float = 0.1, frames: int = FRAMES) -> list[Detections]:
    """Detections of every camera, in its first `frames` frames that hold the board."""
    return [first_frames(simulate_detections(rig, c, noise_px), frames) for c in range(len(rig.cameras))]


def only_frames(detections: Detections, keep: np.ndarray) -> Detections:
    """The corners of some frames (indices); the frames themselves stay listed."""
    rows = np.isin(detections.frame, keep)
    return dataclasses.replace(
        detections, frame=detections.frame[rows], point=detections.point[rows], pixels=detections.pixels[rows]
    )


def first_frames(detections: Detections, count: int) -> Detections:
    return only_frames(detections, detections.seen_frames[:count])


def perturbation(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(6,) rotation vector on the left and translation that take a transform `truth` to `estimate`."""
    turn = Rotation.from_matrix(estimate[:3, :3] @ truth[:3, :3].T).as_rotvec()
    return np.concatenate([turn, estimate[:3, 3] - truth[:3, 3]])


def perturbed(transform: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The transform moved by (6,) a rotation vector on the left and a translation; `perturbation` undoes it."""
    moved = transform.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ transform[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def errors(calibration: Calibration, rig: SimulatedRig) -> dict[str, np.ndarray]:
    """Estimate minus truth of every block of the calibration's covariance, in that block's coordinates; of cameras and
    gravity alone."""
    found: dict[str, np.ndarray] = {}
    previous: SimulatedCamera | None = None
    for camera, truth in zip(calibration.cameras, rig.cameras, strict=True):
        found[f"{camera.name}.intrinsics"] = np.asarray(camera.model.intrinsics - truth.model.intrinsics)
        found[f"{camera.name}.distortion"] = np.asarray(camera.model.distortion - truth.model.distortion)
        if previous is not None and camera.T_cn_cnm1 is not None:
            relative = truth.T_cam_imu @ np.linalg.inv(previous.T_cam_imu)
            found[f"{camera.name}.T_cn_cnm1"] = perturbation(camera.T_cn_cnm1, relative)
        if camera.T_cam_imu is not None and camera.timeshift_cam_imu is not None:
            found[f"{camera.name}.T_cam_imu"] = perturbation(camera.T_cam_imu, truth.T_cam_imu)
            shift = camera.timeshift_cam_imu - truth.timeshift_cam_imu
            found[f"{camera.name}.timeshift_cam_imu"] = np.array([shift])
        previous = truth
    if calibration.gravity is not None:
        found["gravity"] = calibration.gravity - rig.gravity
    return {
        name: found[name]
        for name, _ in calibration.blocks
        if not name.startswith("imu") and not name.endswith("line_delay")
    }


def errors_in_sigmas(calibration: Calibration, rig: SimulatedRig) -> np.ndarray:
    """Every estimated number's error over its 1-sigma."""
    found = errors(calibration, rig)
    return np.concatenate([error / calibration.std(name) for name, error in found.items()])


def mean_square_distance(calibration: Calibration, rig: SimulatedRig) -> float:
    """Mahalanobis distance of the truth squared, per degree of freedom: 1 on average if the covariance is right."""
    found = errors(calibration, rig)
    error, covariance = np.concatenate(list(found.values())), calibration.covariance_of(*found)
    sigma = np.sqrt(np.diag(covariance))
    free = sigma > 0
    values, vectors = np.linalg.eigh((covariance / np.outer(sigma, sigma))[np.ix_(free, free)])
    # Left out: relative poses of cameras repeat what T_cam_imu says, and gravity's length is known.
    known = values > 1e-8 * values.max()
    return float(np.mean((vectors.T @ (error[free] / sigma[free]))[known] ** 2 / values[known]))


def assert_within_sigmas(calibration: Calibration, rig: SimulatedRig) -> None:
    """At least 99 % of the numbers lie within 3.5 sigma of the truth."""
    ratios = {name: error / calibration.std(name) for name, error in errors(calibration, rig).items()}
    together = np.abs(np.concatenate(list(ratios.values())))
    assert np.isfinite(together).all(), ratios
    assert np.mean(together < 3.5) >= 0.99, ratios
