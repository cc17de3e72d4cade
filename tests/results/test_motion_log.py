"""The log for a viewer: everything on one clock, and poses under which the corners are where they were found.

The file for Rerun itself is not written here: rerun-sdk weighs 170 MB. What is written is all in the log tested here.
"""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from synthetic_calibration import make_calibration

from jaxcal.cli import main
from jaxcal.results import Calibration
from jaxcal.results.motion_log import motion_log


@pytest.fixture(scope="module", params=[True, False], ids=["with an IMU", "cameras alone"])
def calibration(request: pytest.FixtureRequest) -> Calibration:
    return make_calibration(2, request.param, frames=12)


def test_every_frame_and_camera_is_there(calibration: Calibration) -> None:
    log = motion_log(calibration)
    assert [lens.name for lens in log.lenses] == ["cam0", "cam1"]
    for camera in calibration.cameras:
        mine = [frame for frame in log.corners if frame.camera == camera.name]
        assert len(mine) == len(camera.detections.seen_frames)
        assert sum(len(frame.pixels) for frame in mine) == len(camera.detections)
        assert sum(int(frame.used.sum()) for frame in mine) == camera.used.sum()
        squares = sum(frame.rms_px**2 * frame.used.sum() for frame in mine)
        assert np.sqrt(squares / camera.used.sum()) == pytest.approx(camera.reprojection_rms_px)


def test_lenses_are_pinholes_near_their_axis(calibration: Calibration) -> None:
    for lens, camera in zip(motion_log(calibration).lenses, calibration.cameras, strict=True):
        fx, fy, cx, cy = np.asarray(camera.model.intrinsics)
        np.testing.assert_allclose(lens.focal_px, [fx, fy])
        np.testing.assert_allclose(lens.centre_px, [cx, cy])


def test_the_board_seen_from_the_tracks_is_where_its_corners_were_found() -> None:
    """Of cameras alone: a track is that of a camera, and its frames are those with a pose."""
    made = make_calibration(2, False, frames=12)
    log = motion_log(made)
    seen = 0
    for track, camera in zip(log.tracks, made.cameras, strict=True):
        assert track.name == camera.name
        for time_s, T in zip(track.time_s, track.poses, strict=True):
            number = int(np.argmin(np.abs((camera.detections.timestamps_ns - log.origin_ns) * 1e-9 - time_s)))
            inside = np.linalg.inv(T) @ np.column_stack([log.target_points, np.ones(len(log.target_points))]).T
            mine = (camera.detections.frame == number) & camera.used
            found = camera.detections.pixels[mine] + camera.residuals_px[mine]
            projected = np.asarray(camera.model.project(jnp.asarray(inside[:3].T)))[camera.detections.point[mine]]
            np.testing.assert_allclose(projected, found, atol=1e-3)
            seen += int(mine.sum())
    assert seen > 100


def test_times_are_the_first_imus(calibration: Calibration) -> None:
    log = motion_log(calibration)
    assert [len(series.time_s) == len(series.values) for series in log.series] == [True] * len(log.series)
    assert len(log.series) == (4 if calibration.imu is not None else 0)
    for camera in calibration.cameras:
        shift = camera.timeshift_cam_imu or 0.0
        times = [frame.time_s for frame in log.corners if frame.camera == camera.name]
        stamps = camera.detections.timestamps_ns[camera.detections.seen_frames]
        np.testing.assert_allclose(times, (stamps - log.origin_ns) * 1e-9 + shift, atol=1e-9)


def test_cameras_ride_on_the_imu() -> None:
    made = make_calibration(2, True, frames=12)
    log = motion_log(made)
    (track,) = log.tracks
    assert track.name == "imu0"
    for lens, camera in zip(log.lenses, made.cameras, strict=True):
        assert lens.T_imu_cam is not None
        np.testing.assert_allclose(lens.T_imu_cam @ camera.T_cam_imu, np.eye(4), atol=1e-12)


def test_without_rerun_it_is_said_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    done = CliRunner().invoke(main, ["report", str(tmp_path / "nothing"), "--rerun", str(tmp_path / "a.rrd")])
    assert done.exit_code == 1
    assert 'pip install "jaxcal[rerun]"' in done.output
