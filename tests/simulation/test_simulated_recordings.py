"""A simulated rig is written as ordinary recordings, whole or not at all, and read back as it was simulated."""

import dataclasses
import os
import time

import cv2
import h5py
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import jaxcal
from jaxcal.cameras import PinholeRadtan
from jaxcal.errors import CalibrationError
from jaxcal.progress import no_progress
from jaxcal.simulation import (
    EventSensorConfig,
    Imaging,
    paper_rig,
    simulate_detections,
    simulate_imu,
    write_recording,
)
from jaxcal.simulation.imaging import render_times, simulate_events
from jaxcal.simulation.measurements import T_cam_target, project_points
from jaxcal.simulation.pattern import pattern_of
from jaxcal.simulation.recordings import fingerprint
from jaxcal.simulation.render import blur_px, pixel_rays, plane_from_camera, render, surface_of
from jaxcal.simulation.worker_pool import run_jobs
from jaxcal.targets import Checkerboard

SIZE = (160, 120)


def _small_rig(duration_s=0.15, seed=0, **imaging):
    """One event camera and one frame camera with small images, close to a small board."""
    rig = paper_rig(duration_s=duration_s, seed=seed, target=Checkerboard(rows=4, cols=5, spacing=0.12))
    cameras = [
        dataclasses.replace(
            camera,
            model=PinholeRadtan.create([120.0, 121.0, 80.3, 58.9], [-0.3, 0.1, 0.001, -0.0005]),
            image_size=SIZE,
            rate_hz=40.0,
            timeshift_cam_imu=shift,
        )
        for camera, shift in zip(rig.cameras[:2], (0.0123, -0.0087), strict=True)
    ]
    return dataclasses.replace(rig, cameras=tuple(cameras), imaging=dataclasses.replace(Imaging(), **imaging))


@pytest.fixture(scope="module")
def rig():
    return _small_rig()


@pytest.fixture(scope="module")
def recording(rig, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    return write_recording(rig, folder, workers=1)


def test_recordings_come_back_through_the_ordinary_readers(rig, recording):
    read = jaxcal.load_rig(recording)
    assert [camera.name for camera in read.cameras] == ["cam0", "cam1"]
    assert {camera.model for camera in read.cameras} == {"pinhole-radtan"}
    np.testing.assert_array_equal(read.target.points, rig.target.points)

    with read.cameras[0].open_events() as events:
        assert len(events) > 1000
        shift = round(rig.cameras[0].timeshift_cam_imu * 1e9)
        assert rig.t0_ns - shift <= events.first_ns
        assert events.last_ns <= rig.t0_ns + round(rig.duration_s * 1e9) - shift

    frames = read.cameras[1].load_frames()
    np.testing.assert_array_equal(frames.timestamps_ns, rig.frame_times_ns(rig.cameras[1]))
    assert frames.image_size == SIZE
    assert len(frames) == pytest.approx(rig.duration_s * 40.0, abs=1)

    imu, truth = read.imu.load(), simulate_imu(rig)
    np.testing.assert_array_equal(imu.timestamps_ns, truth.timestamps_ns)
    np.testing.assert_allclose(imu.gyro_rad_s, truth.gyro_rad_s, atol=1e-10)
    np.testing.assert_allclose(imu.accel_m_s2, truth.accel_m_s2, atol=1e-9)
    assert dataclasses.asdict(imu.noise) == dataclasses.asdict(rig.imu_noise)


def test_event_files_have_the_layout_of_e2calib(rig, recording):
    with h5py.File(recording.parent / "cam0" / "events.h5") as file:
        assert (file.attrs["width"], file.attrs["height"]) == SIZE
        t = file["t"][:]
        assert t.dtype == np.int64
        assert np.all(np.diff(t) >= 0)
        assert t[0] == pytest.approx(rig.t0_ns / 1000, abs=1e6)
        assert set(np.unique(file["p"][:])) == {0, 1}
        assert len(file["x"]) == len(file["y"]) == len(file["p"]) == len(t)


def test_ground_truth_says_what_was_simulated(rig, recording):
    truth = yaml.safe_load((recording.parent / "ground_truth.yaml").read_text())
    for camera in rig.cameras:
        np.testing.assert_allclose(truth[camera.name]["intrinsics"], camera.model.intrinsics)
        np.testing.assert_allclose(truth[camera.name]["distortion_coeffs"], camera.model.distortion)
        np.testing.assert_array_equal(truth[camera.name]["T_cam_imu"], camera.T_cam_imu)
        assert truth[camera.name]["timeshift_cam_imu"] == camera.timeshift_cam_imu
        assert truth[camera.name]["camera_model"] == "pinhole"
        assert truth[camera.name]["distortion_model"] == "radtan"
    np.testing.assert_array_equal(truth["gravity_in_target"], rig.gravity)
    np.testing.assert_array_equal(truth["imu0"]["gyro_bias0"], rig.gyro_bias)


def test_corners_in_the_frames_lie_where_and_when_the_truth_says(rig, recording):
    frames = jaxcal.load_rig(recording).cameras[1].load_frames()
    truth = simulate_detections(rig, 1, noise_px=0.0)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    errors = []
    for frame in truth.seen_frames:
        expected = truth.pixels[truth.frame == frame].astype(np.float32)
        found = cv2.cornerSubPix(frames.images[int(frame)], expected.reshape(-1, 1, 2).copy(), (3, 3), (-1, -1), stop)
        errors.append(found.reshape(-1, 2) - expected)
    speed = np.linalg.norm(np.diff(truth.pixels.reshape(-1, 20, 2), axis=0), axis=-1) * 40.0
    error = np.concatenate(errors)
    # The noise of a corner, and no shift in time: 1 ms would move them by 0.1 px the same way.
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert speed.mean() * np.abs(1e-3) > 0.02
    assert np.all(np.abs(error.mean(axis=0)) < 0.02)


def test_events_sum_up_to_the_change_of_the_image():
    sensor = EventSensorConfig(
        contrast_on=0.2,
        contrast_off=0.3,
        threshold_mismatch=0.0,
        refractory_ns=0,
        leak_rate_hz=0.0,
        shot_noise_rate_hz=0.0,
    )
    rig = _small_rig(event_sensor=sensor)
    camera = rig.cameras[0]
    t, x, y, p = (np.concatenate(a) for a in zip(*(batch for _, batch in simulate_events(rig, 0)), strict=True))
    assert np.all(np.diff(t) >= 0)
    ends_s = np.array([0.0, 0.07, 0.15])
    matrices = plane_from_camera(T_cam_target(rig, camera, ends_s))
    surface, rays = surface_of(pattern_of(rig.target)), pixel_rays(camera.model, SIZE)
    logs = np.log(np.asarray(render(rays, jnp.asarray(matrices), surface, blur_px(rig.imaging.psf_sigma_px))))
    for k in (1, 2):
        before = t <= rig.t0_ns + (ends_s[k] - camera.timeshift_cam_imu) * 1e9
        step = np.where(p[before], sensor.contrast_on, -sensor.contrast_off)
        total = np.bincount(y[before] * SIZE[0] + x[before].astype(int), weights=step, minlength=SIZE[0] * SIZE[1])
        change = logs[k] - logs[0]
        assert np.mean(np.abs(change) > 0.5) > 0.02
        # What an event camera cannot tell is less than one threshold; rendering in steps adds a little.
        assert np.mean(np.abs(total - change) < 0.31) > 0.998


def test_nothing_moves_further_than_a_pixel_between_renderings(rig):
    for camera in rig.cameras:
        times = render_times(rig, camera)
        assert times[0] == 0.0
        assert times[-1] == pytest.approx(rig.duration_s)
        T = T_cam_target(rig, camera, times)
        pixels, _ = project_points(camera.model, jnp.asarray(T), jnp.asarray(rig.target.points))
        moved = np.linalg.norm(np.diff(np.asarray(pixels), axis=0), axis=-1)
        assert moved.max() <= rig.imaging.step_px
        assert moved.max() > 0.3 * rig.imaging.step_px
        assert np.diff(times).max() <= rig.imaging.step_s * 1.001


def _contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_complete_parts_are_kept_and_lost_or_broken_ones_are_made_again_alike(tmp_path):
    rig = _small_rig(duration_s=0.05)
    folder = write_recording(rig, tmp_path, workers=1).parent
    whole = _contents(folder)
    calls = []
    write_recording(rig, tmp_path, progress=lambda *call: calls.append(call), workers=1)
    assert calls == []

    # As a killed run leaves it: no listing of the frames yet, one image cut off, half an event file.
    (folder / "cam1" / "data.csv").unlink()
    image = next((folder / "cam1" / "data").iterdir())
    image.write_bytes(image.read_bytes()[:100])
    (folder / "cam0" / "events.h5").rename(folder / "cam0" / "events.h5.part")
    (folder / "imu0" / "data.csv").unlink()
    write_recording(rig, tmp_path, progress=lambda *call: calls.append(call), workers=1)
    assert {stage for stage, *_ in calls} == {"simulate cam0", "simulate cam1"}
    assert all(0 <= done <= total for _, done, total in calls)
    again = _contents(folder)
    assert again == whole


def test_a_changed_rig_is_simulated_anew(tmp_path):
    old = dataclasses.replace(_small_rig(duration_s=0.03), cameras=())
    assert fingerprint(old) == fingerprint(dataclasses.replace(_small_rig(duration_s=0.03), cameras=()))
    write_recording(old, tmp_path, workers=1)
    before = (tmp_path / "imu0" / "data.csv").read_text()
    new = dataclasses.replace(_small_rig(duration_s=0.03, seed=1), cameras=())
    assert fingerprint(old) != fingerprint(new)
    write_recording(new, tmp_path, workers=1)
    assert (tmp_path / "imu0" / "data.csv").read_text() != before


def test_settings_of_every_kind_change_the_fingerprint(rig):
    camera = dataclasses.replace(rig.cameras[0], timeshift_cam_imu=0.002)
    lens = rig.cameras[0].model.with_parameters(rig.cameras[0].model.parameters.at[0].add(1.0))
    sensor = dataclasses.replace(rig.imaging.event_sensor, contrast_on=0.21)
    others = [
        dataclasses.replace(rig, cameras=(camera, rig.cameras[1])),
        dataclasses.replace(rig, cameras=(dataclasses.replace(rig.cameras[0], model=lens), rig.cameras[1])),
        dataclasses.replace(rig, imaging=dataclasses.replace(rig.imaging, event_sensor=sensor)),
        dataclasses.replace(rig, target=Checkerboard(rows=4, cols=5, spacing=0.121)),
        dataclasses.replace(rig, motion=dataclasses.replace(rig.motion, phase=rig.motion.phase + 0.1)),
        dataclasses.replace(rig, gravity=rig.gravity * 1.01),
    ]
    assert len({fingerprint(rig), *(fingerprint(other) for other in others)}) == len(others) + 1


def test_a_folder_with_other_things_is_left_alone(rig, tmp_path):
    (tmp_path / "thesis.txt").write_text("all of it")
    with pytest.raises(CalibrationError, match="not empty"):
        write_recording(rig, tmp_path, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def _count_to(limit, report):
    for done in range(1, limit + 1):
        report(done, limit)


def _fail(message, report):
    report(0, 1)
    raise CalibrationError(message)


def _die(report):
    time.sleep(0.2)
    os._exit(1)


@pytest.mark.parametrize("workers", [1, 2])
def test_jobs_report_their_progress_and_their_errors(workers):
    calls = []
    jobs = [("a", _count_to, (3,)), ("b", _count_to, (2,))]
    run_jobs(jobs, lambda *call: calls.append(call), workers)
    for name, limit in (("a", 3), ("b", 2)):
        expected = [(f"simulate {name}", done, limit) for done in range(1, limit + 1)]
        assert [call for call in calls if call[0] == f"simulate {name}"] == expected
    with pytest.raises(CalibrationError, match="lens cap"):
        run_jobs([("a", _count_to, (1,)), ("b", _fail, ("lens cap",))], no_progress, workers)


def test_the_death_of_a_worker_is_told():
    with pytest.raises(CalibrationError, match="died"):
        run_jobs([("a", _die, ()), ("b", _count_to, (1,))], no_progress, 2)


def test_bad_settings_are_refused(rig):
    with pytest.raises(CalibrationError, match="workers"):
        run_jobs([], no_progress, 0)
    with pytest.raises(CalibrationError, match="differ"):
        dataclasses.replace(rig, cameras=(rig.cameras[0], rig.cameras[0]))
    with pytest.raises(CalibrationError, match="rate_hz"):
        dataclasses.replace(rig.cameras[0], rate_hz=0.0)
    with pytest.raises(CalibrationError, match="duration"):
        dataclasses.replace(rig, duration_s=0.0)
