"""`jaxcal convert calibration`: from any format to any other, with what is lost said and what cannot be refused."""

import json
from pathlib import Path

import numpy as np
import yaml
from click.testing import CliRunner, Result

from jaxcal.cli import main
from jaxcal.results import load_camchain

NOISE = {
    "accelerometer_noise_density": 2.0e-3,
    "accelerometer_random_walk": 3.0e-3,
    "gyroscope_noise_density": 1.6968e-4,
    "gyroscope_random_walk": 1.9393e-5,
    "update_rate": 200.0,
}


def convert(*arguments: str | Path) -> Result:
    command = ["convert", "calibration", *(str(argument) for argument in arguments)]
    return CliRunner().invoke(main, command, catch_exceptions=False)


def camchain(folder: Path, distortion: str = "equidistant") -> Path:
    pose = np.eye(4)
    pose[:3, 3] = [0.01, -0.02, 0.03]
    entry = {
        "camera_model": "pinhole",
        "distortion_model": distortion,
        "intrinsics": [458.654, 457.296, 367.215, 248.375],
        "distortion_coeffs": [-0.02, 0.01, 0.001, -0.002],
        "resolution": [752, 480],
        "T_cam_imu": pose.tolist(),
        "timeshift_cam_imu": 0.004,
    }
    path = folder / "camchain-imucam.yaml"
    path.write_text(yaml.safe_dump({"cam0": entry}))
    return path


def test_kalibr_to_basalt_and_back(tmp_path: Path) -> None:
    source, noise = camchain(tmp_path), tmp_path / "noise.yaml"
    noise.write_text(yaml.safe_dump(NOISE))
    result = convert(source, tmp_path / "basalt.json", "--format", "basalt", "--imu", noise)
    assert result.exit_code == 0
    assert "kalibr, 1 camera and an IMU" in result.output
    content = json.loads((tmp_path / "basalt.json").read_text())["value0"]
    assert content["intrinsics"][0]["camera_type"] == "kb4"
    assert content["gyro_noise_std"] == [1.6968e-4] * 3
    back = tmp_path / "back.yaml"
    assert convert(tmp_path / "basalt.json", back, "--format", "kalibr").exit_code == 0
    (first,), (second,) = load_camchain(source), load_camchain(back)
    np.testing.assert_array_equal(first.model.parameters, second.model.parameters)
    assert first.T_cam_imu is not None
    assert second.T_cam_imu is not None
    np.testing.assert_allclose(first.T_cam_imu, second.T_cam_imu, atol=1e-15)
    assert second.timeshift_cam_imu == 0.004


def test_what_is_lost_is_said(tmp_path: Path) -> None:
    result = convert(camchain(tmp_path), tmp_path / "cameras.txt", "--format", "colmap")
    assert result.exit_code == 0
    assert "note: files for COLMAP do not hold poses to the IMU, time offsets" in result.output


def test_a_lens_that_does_not_fit_is_refused_with_a_way_out(tmp_path: Path) -> None:
    result = convert(camchain(tmp_path, "radtan"), tmp_path / "out.json", "--format", "basalt")
    assert result.exit_code == 0  # as a rational lens whose last numbers are zero
    assert "pinhole-radtan8" in result.output
    chain = yaml.safe_load(camchain(tmp_path).read_text())
    chain["cam0"] |= {"distortion_model": "fov", "distortion_coeffs": [0.9]}
    (tmp_path / "fov.yaml").write_text(yaml.safe_dump(chain))
    result = convert(tmp_path / "fov.yaml", tmp_path / "fov.json", "--format", "basalt")
    assert result.exit_code == 1
    assert "jaxcal convert camera" in result.output
    assert not (tmp_path / "fov.json").exists()


def test_an_imu_file_without_imu_is_refused(tmp_path: Path) -> None:
    source = camchain(tmp_path)
    result = convert(source, tmp_path / "out.json", "--format", "basalt", "--imu", source)
    assert result.exit_code == 1
    assert "describes no IMU" in result.output
