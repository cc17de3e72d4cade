"""What corners that err together do to the place of their camera: sigmas allow for it, for no more than is there."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from jaxcal import Calibration, Detections, calibrate_camera_imu, calibrate_cameras
from jaxcal.calibration import outcome
from jaxcal.calibration.assemble import CameraFrames
from jaxcal.calibration.left_out import Wandering, wandering
from jaxcal.calibration.robust import RobustFit
from jaxcal.calibration.score_noise import ScoreNoise
from jaxcal.simulation import SimulatedRig, paper_rig, simulate_detections, simulate_imu

NOISE_PX = 0.05


def two_cameras(seed: int, duration_s: float = 4.0) -> SimulatedRig:
    rig = paper_rig(duration_s=duration_s, seed=seed)
    return replace(rig, cameras=tuple(replace(c, timeshift_cam_imu=0.0, phase_s=0.0) for c in rig.cameras[1:3]))


def wobbling(detections: Detections, rng: np.random.Generator, size_px: float, kept: float) -> Detections:
    """The corners displaced by a smooth field over the image that keeps the share `kept` from image to image."""
    middle = np.array(detections.image_size) / 2
    x, y = ((detections.pixels - middle) / middle[0]).T
    terms = np.stack([np.ones_like(x), x, y, x * y, x * x - y * y], axis=1)
    fields = rng.standard_normal((len(detections.timestamps_ns), terms.shape[1], 2))
    for k in range(1, len(fields)):
        fields[k] = kept * fields[k - 1] + np.sqrt(1.0 - kept**2) * fields[k]
    moved = size_px * np.einsum("mt,mtk->mk", terms, fields[detections.frame])
    return replace(detections, pixels=detections.pixels + moved)


def calibrated(rig: SimulatedRig, corners: list[Detections], *, with_imu: bool) -> Calibration:
    if with_imu:
        return calibrate_camera_imu(corners, simulate_imu(rig), rig.target)
    return calibrate_cameras(corners, rig.target, "pinhole-radtan")


def off_by(rig: SimulatedRig, found: Calibration) -> np.ndarray:
    """Errors of the second camera's translation from the first, in stated sigmas (3,)."""
    first, second = (camera.T_cam_imu for camera in rig.cameras)
    truth = second @ np.linalg.inv(first)
    pose = found.cameras[1].T_cn_cnm1
    assert pose is not None
    return (pose[:3, 3] - truth[:3, 3]) / found.std("cam1.T_cn_cnm1")[3:]


@pytest.mark.slow
@pytest.mark.parametrize("with_imu", [True, False])
def test_a_camera_whose_images_err_as_a_whole_is_as_far_off_as_its_sigma_says(with_imu: bool) -> None:
    off = []
    for seed in range(4 if with_imu else 6):
        rig, rng = two_cameras(seed), np.random.default_rng([seed, 77])
        steady, shaking = (simulate_detections(rig, c, NOISE_PX) for c in range(2))
        off.append(off_by(rig, calibrated(rig, [steady, wobbling(shaking, rng, 0.1, 0.6)], with_imu=with_imu)))
    # 12 or 18 errors, of which some hang together: their root mean square scatters by a quarter.
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_what_independent_corners_do_is_what_the_information_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean over many directions is one, within chance, were the camera looked at all the same."""
    looked: list[Wandering | None] = []

    def look(
        fit: RobustFit, cameras: Sequence[CameraFrames], noises: Sequence[ScoreNoise | None]
    ) -> list[Wandering | None]:
        looked.extend(wandering(fit, cameras, c) for c in range(2))
        return [None] * len(noises)

    monkeypatch.setattr(outcome, "_wanderings", look)
    rig = two_cameras(0)
    found = calibrated(rig, [simulate_detections(rig, c, NOISE_PX) for c in range(2)], with_imu=False)
    assert len(looked) == 2
    for one in looked:
        assert one is not None
        # Twelve stretches in some 14 directions each.
        assert one.variance.mean() == pytest.approx(1.0, abs=0.35)
        # Together, the cameras' errors are all that there is: each tells no more than the whole.
        sigma = np.concatenate([found.std("cam0.intrinsics"), found.std("cam0.distortion")])
        assert (np.linalg.norm(one.directions, axis=1)[:8] <= 1.001 * sigma).all()


def test_more_than_the_mean_is_added_where_it_is_seen_and_nothing_is_taken_away() -> None:
    found = Wandering(effect=2.0, directions=np.diag([1.0, 10.0]), variance=np.array([5.0, 0.5]))
    np.testing.assert_allclose(found.beyond(1.0), np.diag([4.0, 100.0]))
    np.testing.assert_allclose(found.beyond(3.0), np.diag([2.0, 0.0]))
