"""The motion is smooth and its derivatives are right; corners and IMU samples follow from it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.simulation import paper_rig, simulate_detections, simulate_imu
from jaxcal.simulation.measurements import T_cam_target
from jaxcal.simulation.motion import poses, rates
from jaxcal.targets import AprilGrid


@pytest.fixture(scope="module")
def rig():
    return paper_rig(seed=3)


@settings(deadline=None, max_examples=20)
@given(t=st.floats(0.0, 8.0))
def test_derivatives_of_the_motion_agree_with_finite_differences(rig, t):
    h = 1e-5
    before, at, after = np.asarray(poses(rig.motion, jnp.array([t - h, t, t + h])))
    omega, acceleration = (np.asarray(v)[0] for v in rates(rig.motion, jnp.array([t])))
    np.testing.assert_allclose(at[:3, :3] @ at[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose((after[:3, 3] - before[:3, 3]) / (2 * h), rig.motion.velocity(t), atol=1e-7)
    np.testing.assert_allclose((after - 2 * at + before)[:3, 3] / h**2, acceleration, atol=2e-4)
    turn = at[:3, :3].T @ (after - before)[:3, :3] / (2 * h)
    np.testing.assert_allclose([turn[2, 1], turn[0, 2], turn[1, 0]], omega, atol=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_built_in_rig_keeps_the_board_in_view_and_tilts_it(seed):
    rig = paper_rig(seed=seed)
    for index, camera in enumerate(rig.cameras):
        detections = simulate_detections(rig, index)
        assert len(detections.seen_frames) > 0.75 * len(detections.timestamps_ns)
        T = T_cam_target(rig, camera, np.arange(0.0, 8.0, 0.02))
        tilt = np.degrees(np.arccos(-T[:, 2, 2]))
        assert tilt.max() > 30.0


def test_perfect_detections_are_the_projection_at_the_shifted_time(rig):
    camera = rig.cameras[1]
    detections = simulate_detections(rig, 1, noise_px=0.0)
    seconds = (detections.timestamps_ns - rig.t0_ns) * 1e-9 + camera.timeshift_cam_imu
    T_target_imu = np.stack([rig.motion.pose(t) for t in seconds])
    corners = rig.target.points[detections.point]
    T = camera.T_cam_imu @ np.linalg.inv(T_target_imu[detections.frame])
    in_camera = np.einsum("mij,mj->mi", T[:, :3, :3], corners) + T[:, :3, 3]
    np.testing.assert_allclose(detections.pixels, camera.model.project(jnp.asarray(in_camera)), atol=1e-9)
    assert seconds.min() >= 0.0
    assert seconds.max() <= rig.duration_s


def test_pixel_noise_and_outliers_have_the_size_asked_for(rig):
    perfect = simulate_detections(rig, 2, noise_px=0.0)
    noisy = simulate_detections(rig, 2, noise_px=0.3)
    wild = simulate_detections(rig, 2, noise_px=0.3, outlier_fraction=0.1, outlier_px=20.0)
    assert np.std(noisy.pixels - perfect.pixels) == pytest.approx(0.3, rel=0.03)
    gone = np.linalg.norm(wild.pixels - perfect.pixels, axis=1) > 2.0
    assert np.mean(gone) == pytest.approx(0.1, rel=0.2)


def test_a_checkerboard_is_seen_whole_or_not_at_all_and_an_aprilgrid_by_tags(rig):
    # From close by the board does not fit into the image all the time.
    close = dataclasses.replace(rig.motion, pivot_body=jnp.array([0.0, 0.0, 0.6]))
    board = simulate_detections(dataclasses.replace(rig, motion=close), 0)
    counts = np.bincount(board.frame, minlength=len(board.timestamps_ns))
    assert set(counts) == {0, len(rig.target.points)}

    grid = AprilGrid(rows=5, cols=6, tag_size=0.09, tag_spacing=0.3)
    tags = simulate_detections(dataclasses.replace(rig, motion=close, target=grid), 0)
    counts = np.bincount(tags.frame, minlength=len(tags.timestamps_ns))
    assert np.all(counts % 4 == 0)
    assert len(set(counts)) > 3


def test_imu_without_noise_is_the_motion_plus_bias(rig):
    imu = simulate_imu(rig, noisy=False)
    index = 700
    t = (imu.timestamps_ns[index] - rig.t0_ns) * 1e-9
    R_target_imu = np.asarray(rig.motion.pose(t))[:3, :3]
    force = R_target_imu.T @ (np.asarray(rig.motion.acceleration(t)) - rig.gravity)
    np.testing.assert_allclose(imu.accel_m_s2[index], force + rig.accel_bias, atol=1e-9)
    np.testing.assert_allclose(imu.gyro_rad_s[index], rig.motion.angular_velocity(t) + rig.gyro_bias, atol=1e-9)
    assert np.linalg.norm(rig.gravity) == pytest.approx(9.80665)


def test_imu_noise_has_the_densities_asked_for(rig):
    rig = dataclasses.replace(rig, duration_s=100.0)
    noisy, clean = simulate_imu(rig), simulate_imu(rig, noisy=False)
    for error, density, walk in (
        (noisy.gyro_rad_s - clean.gyro_rad_s, rig.imu_noise.gyro_noise_density, rig.imu_noise.gyro_random_walk),
        (noisy.accel_m_s2 - clean.accel_m_s2, rig.imu_noise.accel_noise_density, rig.imu_noise.accel_random_walk),
    ):
        # Sample to sample the white noise dominates: the variance of differences is twice its own.
        assert np.std(np.diff(error, axis=0)) == pytest.approx(np.sqrt(2.0) * density * np.sqrt(200.0), rel=0.03)
        # Averages over 0.5 s, 2.5 s apart: walk^2 * 2.5 s from the walk, density^2 * 4 / s from the white noise.
        blocks = error[:20000].reshape(200, 100, 3).mean(axis=1)[::5]
        drift = np.var(np.diff(blocks, axis=0))
        assert drift == pytest.approx(walk**2 * 2.5 + 2 * density**2 / 0.5, rel=0.5)


def test_noise_follows_from_the_seed(rig):
    again = simulate_imu(paper_rig(seed=3))
    np.testing.assert_array_equal(simulate_imu(rig).gyro_rad_s, again.gyro_rad_s)
    assert not np.array_equal(simulate_detections(rig, 0).pixels, simulate_detections(paper_rig(seed=4), 0).pixels)
