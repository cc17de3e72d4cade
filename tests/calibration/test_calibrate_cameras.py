"""Cameras are recovered from simulated corners within the sigmas that the calibration states, with no guess."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from simulated_truth import (
    FRAMES,
    assert_within_sigmas,
    errors_in_sigmas,
    mean_square_distance,
    only_frames,
    seen_by,
    still_rig,
)

from jaxcal import AprilGrid, Calibration, CalibrationError, Checkerboard, Detections, calibrate_cameras
from jaxcal.results.verdict import judge
from jaxcal.simulation import SimulatedRig, paper_rig, simulate_detections
from jaxcal.simulation.motion import Motion

# Places in the built-in rig of the cameras of each test rig, and which of them are fisheyes.
RIGS = {"mono": ((1,), ()), "stereo": ((1, 2), ()), "mixed": ((0, 1, 2, 3), (1, 2))}


def models_of(rig: SimulatedRig) -> list[str]:
    return [camera.model.name for camera in rig.cameras]


@pytest.mark.slow
@pytest.mark.parametrize("kind", RIGS)
def test_parameters_are_recovered_within_their_sigmas(kind: str) -> None:
    cameras, fisheyes = RIGS[kind]
    rig = still_rig(cameras, seed=3, fisheyes=fisheyes)
    calibration = calibrate_cameras(seen_by(rig, noise_px=0.2), rig.target, models_of(rig))
    assert calibration.converged
    assert calibration.warnings == ()
    assert_within_sigmas(calibration, rig)
    assert 0.3 < mean_square_distance(calibration, rig) < 2.5
    for camera in calibration.cameras:
        assert camera.corner_sigma_px == pytest.approx(0.2, rel=0.06)
        assert camera.inlier.mean() > 0.999


def test_names_shapes_and_blocks() -> None:
    rig = still_rig((1, 2))
    stages: set[str] = set()
    calibration = calibrate_cameras(
        seen_by(rig), rig.target, names=["left", "right"], progress=lambda stage, *_: stages.add(stage)
    )
    assert [camera.name for camera in calibration.cameras] == ["left", "right"]
    sizes = {
        "left.intrinsics": 4,
        "left.distortion": 4,
        "right.intrinsics": 4,
        "right.distortion": 4,
        "right.T_cn_cnm1": 6,
    }
    assert dict(calibration.blocks) == sizes
    assert calibration.covariance.shape == (22, 22)
    np.testing.assert_allclose(calibration.covariance, calibration.covariance.T, rtol=1e-9)
    assert np.linalg.eigvalsh(calibration.covariance).min() > 0
    assert calibration.cameras[0].T_cn_cnm1 is None
    assert calibration.gravity is None
    assert calibration.imu is None
    for camera, truth in zip(calibration.cameras, rig.cameras, strict=True):
        assert camera.residuals_px.shape == camera.detections.pixels.shape
        assert camera.image_size == truth.image_size
        assert camera.T_cam_imu is None
    assert np.all(np.diff(calibration.convergence) <= 0)
    assert stages == {"initial lenses", "optimise"}


def test_residuals_are_projection_minus_measurement() -> None:
    """An error put into one corner of noise-free detections shows in that corner's residual, with its sign."""
    rig = still_rig((1,))
    (perfect,) = seen_by(rig, noise_px=0.0)
    row = len(perfect) // 2
    pixels = perfect.pixels.copy()
    pixels[row] += [3.0, -2.0]
    (camera,) = calibrate_cameras([dataclasses.replace(perfect, pixels=pixels)], rig.target).cameras
    np.testing.assert_allclose(camera.residuals_px[row], [-3.0, 2.0], atol=1e-3)
    assert not camera.inlier[row]
    assert camera.inlier.sum() == len(perfect) - 1
    np.testing.assert_allclose(np.delete(camera.residuals_px, row, axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(camera.model.parameters, rig.cameras[0].model.parameters, rtol=1e-4, atol=1e-5)


def displaced(detections: Detections, rng: np.random.Generator, share: float, size_px: float) -> Detections:
    """A share of the corners moved by up to `size_px` in any direction, kept within the image."""
    bad = rng.random(len(detections)) < share
    move = rng.uniform(2.0, size_px, len(detections)) * bad
    angle = rng.uniform(0.0, 2.0 * np.pi, len(detections))
    pixels = detections.pixels + move[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return dataclasses.replace(detections, pixels=np.clip(pixels, 0.0, np.array(detections.image_size) - 1.0))


def scrambled(detections: Detections, frame: int, rng: np.random.Generator) -> Detections:
    """The corners of one frame bear each other's names."""
    rows = detections.frame == frame
    point = detections.point.copy()
    point[rows] = rng.permutation(point[rows])
    return dataclasses.replace(detections, point=point)


def one_column_off(detections: Detections, frame: int, columns: int) -> Detections:
    """One frame's board found a column too far to the right, its last column missed."""
    rows = detections.frame == frame
    keep = ~(rows & (detections.point % columns == columns - 1))
    point = detections.point + rows
    return dataclasses.replace(
        detections, frame=detections.frame[keep], point=point[keep], pixels=detections.pixels[keep]
    )


def test_outliers_and_mislabelled_views_do_not_harm() -> None:
    rig = still_rig((1, 2), seed=5)
    rng = np.random.default_rng(0)
    good = seen_by(rig, noise_px=0.2)
    bad = [displaced(d, rng, share=0.1, size_px=50.0) for d in good]
    far = [np.linalg.norm(g.pixels - b.pixels, axis=1) > 3.0 for g, b in zip(good, bad, strict=True)]
    scrambles = [good[0].seen_frames[4], good[1].seen_frames[9]]
    bad = [scrambled(d, frame, rng) for d, frame in zip(bad, scrambles, strict=True)]
    calibration = calibrate_cameras(bad, rig.target)
    assert_within_sigmas(calibration, rig)
    for camera, moved, frame in zip(calibration.cameras, far, scrambles, strict=True):
        wrong = camera.detections.frame == frame
        assert not camera.inlier[wrong].any()
        assert not camera.inlier[moved & ~wrong].any()
        assert camera.inlier[~moved & ~wrong].mean() > 0.99
        assert camera.corner_sigma_px == pytest.approx(0.2, rel=0.1)
        assert any(camera.name in warning and "left out" in warning for warning in calibration.warnings)


def test_a_board_found_one_column_off_in_one_camera_is_left_out() -> None:
    """By itself such a view is as good as any: only the other camera contradicts it."""
    rig = still_rig((1, 2), seed=5)
    left, right = seen_by(rig, noise_px=0.2)
    frame = int(np.intersect1d(left.seen_frames, right.seen_frames)[7])
    calibration = calibrate_cameras([left, one_column_off(right, frame, rig.target.grid_shape[1])], rig.target)
    assert_within_sigmas(calibration, rig)
    # Which of the two is wrong nobody can tell, but both cannot be right.
    shares = [camera.inlier[camera.detections.frame == frame].mean() for camera in calibration.cameras]
    assert min(shares) == 0.0


@pytest.mark.slow
def test_sigmas_agree_with_the_scatter_over_seeds() -> None:
    """Errors over sigmas of many independent calibrations have a mean square of one."""
    squares, distances = [], []
    for seed in range(8):
        rig = still_rig((1, 2), seed=seed)
        calibration = calibrate_cameras(seen_by(rig, noise_px=0.3), rig.target)
        squares.append(errors_in_sigmas(calibration, rig) ** 2)
        distances.append(mean_square_distance(calibration, rig))
    # 8 times 22 degrees of freedom: one standard deviation of their mean square is 0.11.
    assert 0.65 < np.mean(distances) < 1.4
    # Each parameter's own 8 errors: the 0.1 % quantiles of chi-square with 8 degrees of freedom are 0.11 and 3.3.
    each = np.mean(squares, axis=0)
    assert each.min() > 0.05
    assert each.max() < 3.8


def test_a_camera_that_misses_half_the_frames() -> None:
    ratios, distances = [], []
    for seed in range(4, 12):
        rig = still_rig((1, 2), seed=seed)
        left, right = seen_by(rig, noise_px=0.2)
        # One more than half, so that the sizes are those that are compiled already.
        right = only_frames(right, np.append(right.seen_frames[::2], right.seen_frames[-1]))
        assert len(right.seen_frames) == FRAMES // 2 + 1
        calibration = calibrate_cameras([left, right], rig.target)
        ratios.append(np.abs(errors_in_sigmas(calibration, rig)))
        distances.append(mean_square_distance(calibration, rig))
        assert np.all(calibration.std("cam1.intrinsics") > calibration.std("cam0.intrinsics"))
    assert np.mean(np.array(ratios) < 3.5) >= 0.99
    assert 0.65 < np.mean(distances) < 1.4


# --- what cannot be calibrated ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stereo() -> tuple[SimulatedRig, list[Detections]]:
    rig = still_rig((1, 2))
    return rig, seen_by(rig)


def test_cameras_without_common_views_are_named(stereo: tuple[SimulatedRig, list[Detections]]) -> None:
    rig, (left, right) = stereo
    late = dataclasses.replace(right, timestamps_ns=right.timestamps_ns + 3_600_000_000_000)
    with pytest.raises(CalibrationError, match=r"right never saw the board at the same time as left.*2 ms"):
        calibrate_cameras([left, late], rig.target, names=["left", "right"])


def test_too_few_frames_are_refused(stereo: tuple[SimulatedRig, list[Detections]]) -> None:
    rig, (left, _) = stereo
    with pytest.raises(CalibrationError, match="cam0: 2 frames with at least 8 corners; 3 are the least"):
        calibrate_cameras([only_frames(left, left.seen_frames[:2])], rig.target)


def test_no_corners_at_all_are_refused() -> None:
    nothing = Detections(np.arange(5), np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), (640, 480))
    with pytest.raises(CalibrationError, match="cam0: 0 frames"):
        calibrate_cameras([nothing], Checkerboard(5, 6, 0.1))


def test_corners_of_another_target_are_refused(stereo: tuple[SimulatedRig, list[Detections]]) -> None:
    _, (left, _) = stereo
    with pytest.raises(CalibrationError, match="point index 53, but the target has 30 points"):
        calibrate_cameras([left], Checkerboard(rows=5, cols=6, spacing=0.1))


def test_a_wrong_image_size_is_refused(stereo: tuple[SimulatedRig, list[Detections]]) -> None:
    rig, (left, _) = stereo
    with pytest.raises(CalibrationError, match="outside the 320x240 image"):
        calibrate_cameras([dataclasses.replace(left, image_size=(320, 240))], rig.target)


def test_models_and_names_must_fit_the_cameras(stereo: tuple[SimulatedRig, list[Detections]]) -> None:
    rig, both = stereo
    with pytest.raises(CalibrationError, match="1 camera models for 2 cameras"):
        calibrate_cameras(both, rig.target, ["pinhole-radtan"])
    with pytest.raises(CalibrationError, match="Did you mean 'pinhole-radtan'"):
        calibrate_cameras(both, rig.target, ["pinhole-radtan", "pinhole-ratdan"])
    with pytest.raises(CalibrationError, match="not 2 different camera names"):
        calibrate_cameras(both, rig.target, names=["cam", "cam"])
    with pytest.raises(CalibrationError, match="no cameras"):
        calibrate_cameras([], rig.target)


def assert_doubtful(calibration: Calibration, rig: SimulatedRig) -> None:
    """The result says itself that the focal length is not known, and its sigmas cover the error."""
    verdict = judge(calibration)
    assert verdict.level == "bad", verdict.headline
    told = " ".join([*calibration.warnings, *(check.sentence for check in verdict.failed if check.level == "bad")])
    assert "focal length is known to" in told or "does not determine a combination of: cam0 f" in told, told
    error = np.asarray(calibration.cameras[0].model.intrinsics - rig.cameras[0].model.intrinsics)
    assert np.all(np.abs(error) < 3.5 * calibration.std("cam0.intrinsics"))


def test_one_view_over_and_over_is_not_a_calibration(stereo: tuple[SimulatedRig, list[Detections]]) -> None:
    rig, (left, _) = stereo
    count = len(rig.target.points)
    rows = left.frame == left.seen_frames[3]
    rng = np.random.default_rng(0)
    same = Detections(
        1000 * np.arange(FRAMES),
        np.repeat(np.arange(FRAMES), count),
        np.tile(left.point[rows], FRAMES),
        np.tile(left.pixels[rows], (FRAMES, 1)) + 0.1 * rng.standard_normal((FRAMES * count, 2)),
        left.image_size,
    )
    try:
        calibration = calibrate_cameras([same], rig.target)
    except CalibrationError:
        return
    assert_doubtful(calibration, rig)


def test_frontal_views_alone_are_not_a_calibration() -> None:
    """A board that is only shifted across the image, never tilted, leaves focal length and distance undivided."""
    rig = still_rig((1,))
    translating = Motion(
        amplitude=rig.motion.amplitude.at[3:].set(0.0).at[2].set(0.0),
        frequency_hz=rig.motion.frequency_hz,
        phase=rig.motion.phase,
        R_target_body0=rig.motion.R_target_body0,
        pivot_target0=rig.motion.pivot_target0,
        pivot_body=jnp.array([0.0, 0.0, 1.5]),
        T_body_imu=jnp.eye(4),
    )
    facing = dataclasses.replace(rig.cameras[0], T_cam_imu=np.eye(4))
    rig = dataclasses.replace(rig, cameras=(facing,), motion=translating)
    try:
        calibration = calibrate_cameras(seen_by(rig), rig.target)
    except CalibrationError:
        return
    assert_doubtful(calibration, rig)


@pytest.mark.slow
def test_an_aprilgrid_seen_in_part() -> None:
    """Tags leave the image one by one; frames keep what they have."""
    grid = AprilGrid(rows=4, cols=5, tag_size=0.1, tag_spacing=0.3)
    rig = paper_rig(duration_s=30.0, seed=2, target=grid)
    close = dataclasses.replace(rig.cameras[1], phase_s=0.0, timeshift_cam_imu=0.0, rate_hz=1.0, name="cam0")
    motion = dataclasses.replace(rig.motion, pivot_body=jnp.array([0.0, 0.0, 0.7]))
    rig = dataclasses.replace(rig, cameras=(close,), motion=motion)
    detections = simulate_detections(rig, 0, noise_px=0.2)
    corners = np.bincount(detections.frame, minlength=len(detections.timestamps_ns))
    assert np.sum((corners > 0) & (corners < len(grid.points))) > 10
    calibration = calibrate_cameras([detections], grid)
    assert_within_sigmas(calibration, rig)
