"""Kalibr's results text: its own files come out of its own numbers, and what is written is read."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from scipy.spatial.transform import Rotation
from synthetic_calibration import APRIL_GRID, make_calibration

from jaxcal.cli import main
from jaxcal.errors import CalibrationError
from jaxcal.results import Calibration, load_camchain, read_calibration, write_calibration
from jaxcal.results.interchange import read_kalibr_results
from jaxcal.targets import AprilGrid


@pytest.fixture(scope="module")
def made() -> Calibration:
    return make_calibration(2, True, frames=8, target=APRIL_GRID)


def without_imu(made: Calibration) -> Calibration:
    cameras = tuple(dataclasses.replace(c, T_cam_imu=None, timeshift_cam_imu=None) for c in made.cameras)
    return dataclasses.replace(made, cameras=cameras, imu=None, gravity=None)


def masked(text: str) -> str:
    """The text without the numbers that follow from residuals."""
    text = re.sub(r"(mean|median|std:) [-+\d.e]+", r"\1 #", text)
    return re.sub(r"reprojection error: .*", "reprojection error: #", text)


def kalibrs_own(made: Calibration, folder: Path) -> Calibration:
    """The calibration with Kalibr's results in place of its own."""
    (read,) = load_camchain(folder / "kalibr_camchain-imucam.yaml")
    text = read_kalibr_results(folder / "kalibr_results-imucam.txt")
    stated: dict[str, Any] = yaml.safe_load((folder / "imu.yaml").read_text())
    noise = {name: value for name, value in stated.items() if name != "rostopic"}
    assert made.imu is not None
    camera = dataclasses.replace(
        made.cameras[0], model=read.model, T_cam_imu=read.T_cam_imu, timeshift_cam_imu=read.timeshift_cam_imu
    )
    grid = AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)
    imu = dataclasses.replace(made.imu, noise=noise)
    return dataclasses.replace(made, cameras=(camera,), target=grid, imu=imu, gravity=text.gravity)


@pytest.mark.real_data
def test_kalibrs_results_are_written_as_kalibr_did(made: Calibration, data_folder: Path, tmp_path: Path) -> None:
    folder = data_folder / "kalibr_sim_mono_imu"
    own = kalibrs_own(made, folder)
    write_calibration(own, tmp_path, "kalibr")
    theirs = masked((folder / "kalibr_results-imucam.txt").read_text())
    assert masked((tmp_path / "results-imucam.txt").read_text()) == theirs
    # Kalibr's sigmas, as a covariance.
    text = read_kalibr_results(folder / "kalibr_results-cam.txt")
    (camera,) = text.cameras
    assert camera.intrinsics_sigma is not None
    assert camera.distortion_sigma is not None
    sigma = np.concatenate([camera.intrinsics_sigma, camera.distortion_sigma])
    alone = dataclasses.replace(
        without_imu(own), blocks=(("cam0.intrinsics", 4), ("cam0.distortion", 4)), covariance=np.diag(sigma**2)
    )
    write_calibration(alone, tmp_path / "cam", "kalibr")
    theirs = masked((folder / "kalibr_results-cam.txt").read_text())
    assert masked((tmp_path / "cam" / "results-cam.txt").read_text()) == theirs


def test_what_is_written_with_an_imu_is_read(made: Calibration, tmp_path: Path) -> None:
    write_calibration(made, tmp_path, "kalibr")
    read = read_kalibr_results(tmp_path / "results-imucam.txt")
    assert made.imu is not None
    for camera, ours in zip(read.cameras, made.cameras, strict=True):
        np.testing.assert_array_equal(camera.intrinsics, ours.model.intrinsics)
        np.testing.assert_array_equal(camera.distortion, ours.model.distortion)
        np.testing.assert_allclose(np.asarray(camera.T_cam_imu), np.asarray(ours.T_cam_imu), atol=1e-8)
        assert camera.timeshift_cam_imu == ours.timeshift_cam_imu
        sizes = np.linalg.norm(ours.residuals_px[ours.used], axis=1)
        assert camera.reprojection_px == (sizes.mean(), np.median(sizes), sizes.std())
    np.testing.assert_allclose(np.asarray(read.gravity), np.asarray(made.gravity), atol=1e-8)
    gyro = np.linalg.norm(made.imu.gyro_rad_s - made.imu.gyro_predicted, axis=1)
    assert read.gyro_rad_s is not None
    assert read.gyro_rad_s[0] == gyro.mean()
    # The folder is a calibration of Kalibr's, text and all.
    assert read_calibration(tmp_path).format == "kalibr"


def test_what_is_written_without_an_imu_is_read(made: Calibration, tmp_path: Path) -> None:
    write_calibration(without_imu(made), tmp_path, "kalibr")
    text = (tmp_path / "results-cam.txt").read_text()
    for camera, ours in zip(read_kalibr_results(tmp_path / "results-cam.txt").cameras, made.cameras, strict=True):
        np.testing.assert_allclose(np.asarray(camera.intrinsics), np.asarray(ours.model.intrinsics), atol=1e-7)
        np.testing.assert_allclose(np.asarray(camera.distortion_sigma), made.std(f"{ours.name}.distortion"), atol=1e-7)
    match = re.search(r"baseline T_1_0:\n    q: \[(.*?)\]", text)
    assert match
    x, y, z, w = (float(word) for word in match[1].split())
    T = made.cameras[1].T_cn_cnm1
    assert T is not None
    np.testing.assert_allclose(Rotation.from_quat([-x, -y, -z, w]).as_matrix(), T[:3, :3], atol=1e-7)


def test_the_command_writes_the_text_too(made: Calibration, tmp_path: Path) -> None:
    cameras = tuple(dataclasses.replace(camera, T_cam_target=None) for camera in made.cameras)
    dataclasses.replace(made, cameras=cameras).save(tmp_path / "ours")
    command = ["convert", "calibration", str(tmp_path / "ours"), str(tmp_path / "theirs"), "--format", "kalibr"]
    assert CliRunner().invoke(main, command, catch_exceptions=False).exit_code == 0
    names = sorted(path.name for path in (tmp_path / "theirs").iterdir())
    assert names == ["camchain-imucam.yaml", "imu.yaml", "imu0.yaml", "results-imucam.txt"]


def test_other_texts_are_refused(made: Calibration, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("Calibration results\n")
    with pytest.raises(CalibrationError, match="not Kalibr's results"):
        read_kalibr_results(tmp_path / "a.txt")
    with pytest.raises(CalibrationError, match="can be read"):
        read_kalibr_results(tmp_path / "b.txt")
    write_calibration(without_imu(made), tmp_path, "kalibr")
    with pytest.raises(CalibrationError, match="does not say the image size"):
        read_calibration(tmp_path / "results-cam.txt")
