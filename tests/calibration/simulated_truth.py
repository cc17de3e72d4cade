"""Simulated rigs with known truth, and how far a calibration is from it in units of its own sigmas."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal import Calibration, Detections
from jaxcal.cameras import CameraModel, PinholeEquidistant
from jaxcal.simulation import SimulatedRig, paper_rig, simulate_detections
from jaxcal.studies.truth import errors, in_sigmas, normalised_square

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
    return detections.of_frames(np.isin(np.arange(len(detections.timestamps_ns)), keep))


def first_frames(detections: Detections, count: int) -> Detections:
    return only_frames(detections, detections.seen_frames[:count])


def perturbed(transform: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The transform moved by (6,) a rotation vector on the left and a translation; `perturbation` undoes it."""
    moved = transform.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ transform[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def errors_in_sigmas(calibration: Calibration, rig: SimulatedRig) -> np.ndarray:
    """Every estimated number's error over its 1-sigma."""
    return in_sigmas(calibration, errors(calibration, rig))


def mean_square_distance(calibration: Calibration, rig: SimulatedRig) -> float:
    """Mahalanobis distance of the truth squared, per degree of freedom: 1 on average if the covariance is right."""
    square, freedom = normalised_square(calibration, errors(calibration, rig))
    return square / freedom


def assert_within_sigmas(calibration: Calibration, rig: SimulatedRig) -> None:
    """At least 99 % of the numbers lie within 3.5 sigma of the truth."""
    ratios = {name: error / calibration.std(name) for name, error in errors(calibration, rig).items()}
    together = np.abs(np.concatenate(list(ratios.values())))
    assert np.isfinite(together).all(), ratios
    assert np.mean(together < 3.5) >= 0.99, ratios
