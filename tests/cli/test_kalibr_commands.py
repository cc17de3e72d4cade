"""Kalibr's command lines, with the program's name changed: what they mean here, and what they leave behind."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st

import jaxcal.pipeline
from jaxcal import AprilGrid
from jaxcal.cli import main
from jaxcal.cli.calibrate_cameras import calibrate_cameras
from jaxcal.cli.calibrate_imu_camera import calibrate_imu_camera
from jaxcal.cli.kalibr_arguments import KalibrCommand, Many, spread
from jaxcal.pipeline import PipelineSettings
from jaxcal.recording import Rig
from jaxcal.results import load_calibration, load_camchain

# Every option of kalibr_calibrate_cameras and kalibr_calibrate_imu_camera (its parsers, March 2024), with values.
OF_CAMERAS = """--models pinhole-radtan omni-radtan --bag BAG --topics /cam0/image_raw /cam1/image_raw --bag-from-to 0 5
--bag-freq 4.0 --target TARGET --approx-sync 0.04 --qr-tol 0.02 --mi-tol -1 --no-shuffle --no-outliers-removal
--no-final-filtering --min-views-outlier 20 --use-blakezisserman --plot-outliers --verbose --show-extraction --plot
--dont-show-report --export-poses"""
OF_IMU_CAMERA = """--bag BAG --bag-from-to 0 5 --bag-freq 4 --perform-synchronization --cams CHAIN
--recompute-camera-chain-extrinsics --reprojection-sigma 1.0 --imu IMU IMU --imu-delay-by-correlation
--imu-models calibrated scale-misalignment --target TARGET --no-time-calibration --max-iter 30 --recover-covariance
--timeoffset-padding 0.03 --show-extraction --extraction-stepping --verbose --dont-show-report --export-poses"""

NOISE = {
    "rostopic": "/imu0",
    "update_rate": 200.0,
    "accelerometer_noise_density": 1.4e-3,
    "accelerometer_random_walk": 8.6e-5,
    "gyroscope_noise_density": 8.0e-5,
    "gyroscope_random_walk": 2.2e-6,
}


def run(command: str, arguments: str, folder: Path) -> Result:
    places = {
        "BAG": "drive",
        "TARGET": "target.yaml",
        "CHAIN": "chain.yaml",
        "IMU": "imu.yaml",
        "OTHER_IMU": "other_imu.yaml",
    }
    words = [str(folder / places[word]) if word in places else word for word in arguments.split()]
    return CliRunner().invoke(main, [command, *words], catch_exceptions=False)


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A folder that stands for a bag, with the yaml files beside it."""
    for name in ("cam0", "cam1"):
        (tmp_path / "drive" / name).mkdir(parents=True)
        for t in (1, 2):
            cv2.imwrite(str(tmp_path / "drive" / name / f"{t}.png"), np.zeros((4, 6), np.uint8))
    (tmp_path / "drive" / "imu0.csv").write_text("1,0,0,0,0,0,9.8\n2,0,0,0,0,0,9.8\n")
    (tmp_path / "target.yaml").write_text(yaml.safe_dump(AprilGrid(6, 6, 0.088, 0.3).to_yaml()))
    (tmp_path / "imu.yaml").write_text(yaml.safe_dump(NOISE))
    (tmp_path / "other_imu.yaml").write_text(yaml.safe_dump(NOISE | {"rostopic": "/imu7"}))
    camera = {
        "camera_model": "pinhole",
        "distortion_model": "equidistant",
        "intrinsics": [4.0, 4.0, 3.0, 2.0],
        "distortion_coeffs": [0.1, 0.0, 0.0, 0.0],
        "resolution": [6, 4],
    }
    chain = {f"cam{k}": {**camera, "rostopic": f"/cam{k}/image_raw"} for k in range(2)}
    chain["cam1"]["T_cn_cnm1"] = np.eye(4).tolist()
    (tmp_path / "chain.yaml").write_text(yaml.safe_dump(chain))
    return tmp_path


class Reached(Exception):
    """Raised in place of the calibration."""


@pytest.fixture
def walked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The rig, folder and settings that a command hands to the pipeline, which ends there."""
    got: dict[str, Any] = {}

    def remember(rig: Rig, output: Path, *, settings: PipelineSettings, **_: Any) -> None:
        got.update(rig=rig, output=output, settings=settings)
        raise Reached

    monkeypatch.setattr(jaxcal.pipeline, "run_pipeline", remember)
    return got


def test_every_option_of_kalibr_for_cameras(drive: Path, walked: dict[str, Any]) -> None:
    with pytest.raises(Reached):
        run("calibrate-cameras", OF_CAMERAS, drive)
    rig, options = walked["rig"], walked["settings"].cameras
    assert [camera.model for camera in rig.cameras] == ["pinhole-radtan", "omni-radtan"]
    assert [camera.frames for camera in rig.cameras] == [drive / "drive" / "cam0", drive / "drive" / "cam1"]
    assert (rig.from_to, rig.frame_rate_hz) == ((0.0, 5.0), 4.0)
    assert options["sync_tolerance_s"] == 0.04
    assert options["loss"] == "geman-mcclure"
    assert walked["output"] == drive / "drive-jaxcal"


def test_every_option_of_kalibr_for_imus(drive: Path, walked: dict[str, Any]) -> None:
    with pytest.raises(Reached):
        run("calibrate-imu-camera", OF_IMU_CAMERA, drive)
    rig, options = walked["rig"], walked["settings"].camera_imu
    assert [camera.model for camera in rig.cameras] == ["pinhole-equi", "pinhole-equi"]
    assert [imu.model for imu in rig.imus] == ["calibrated", "scale-misalignment"]
    assert {imu.data for imu in rig.imus} == {drive / "drive" / "imu0.csv"}
    assert (options["intrinsics"], options["max_steps"]) == ("held", 30)
    assert np.asarray(options["cameras"].cameras[1].model.intrinsics).tolist() == [4.0, 4.0, 3.0, 2.0]


def test_options_that_do_nothing_say_so_in_a_line(drive: Path) -> None:
    (drive / "drive" / "cam1" / "2.png").write_bytes(b"damaged")
    result = run("calibrate-cameras", OF_CAMERAS.replace("--verbose", ""), drive)
    assert result.exit_code == 1
    for option in ("--qr-tol", "--mi-tol", "--no-shuffle", "--plot-outliers", "--dont-show-report"):
        assert f"note: {option}: " in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.parametrize("words", ["--cam CHAIN --time-calibration", "--topics /cam0 /cam1 --models pinhole-equi"])
def test_older_and_shorter_ways(drive: Path, walked: dict[str, Any], words: str) -> None:
    with pytest.raises(Reached):
        run("calibrate-imu-camera", f"{words} --imu IMU --bag BAG --target TARGET --out OUT --dont-show", drive)
    assert [camera.model for camera in walked["rig"].cameras] == ["pinhole-equi", "pinhole-equi"]
    assert walked["output"] == Path("OUT")


@pytest.mark.parametrize(
    ("command", "arguments", "code", "said"),
    [
        ("calibrate-cameras", "--bag BAG --target TARGET", 2, "--bag and --topics belong together"),
        ("calibrate-cameras", "left --bag BAG --topics /cam0 --target TARGET", 2, "one way or the other"),
        ("calibrate-cameras", "left --target TARGET", 2, "missing --out"),
        ("calibrate-cameras", "--bag BAG --topics /cam7 --target TARGET", 1, "no folder of images for '/cam7'"),
        ("calibrate-cameras", "--bag BAG --topics --target TARGET", 2, "requires an argument"),
        ("calibrate-cameras", "--bag BAG --topic /cam0 --targt TARGET", 2, "No such option '--targt'"),
        ("calibrate-imu-camera", "--bag BAG --imu IMU --target TARGET", 2, "missing --cams"),
        ("calibrate-imu-camera", "--bag BAG --imu IMU --target TARGET --cam CHAIN --models a", 2, "--models come from"),
        ("calibrate-imu-camera", "--bag BAG --imu IMU --target TARGET --cam CHAIN --topics /cam0", 2, "has 2 cameras"),
        ("calibrate-imu-camera", "--bag BAG --imu IMU --target TARGET --cam absent.yaml", 1, "absent.yaml: no such"),
        ("calibrate-imu-camera", "--bag BAG --imu OTHER_IMU --target TARGET --cam CHAIN", 1, "other_imu.yaml: correct"),
        ("calibrate-imu-camera", "--bag nowhere --imu IMU --target TARGET --cam CHAIN", 1, "nowhere: no such bag or"),
    ],
)
def test_mistakes(drive: Path, command: str, arguments: str, code: int, said: str) -> None:
    result = run(command, arguments, drive)
    assert result.exit_code == code, result.output
    assert said in result.stderr


words = st.text("abc/._0123456789", min_size=1, max_size=6)


@given(st.lists(words, min_size=1, max_size=5), st.lists(words, max_size=3), st.booleans())
def test_values_in_a_row_are_values_repeated(topics: list[str], rest: list[str], flag: bool) -> None:
    options = [Many(["--topics"]), click.Option(["--plot"], is_flag=True), click.Option(["--span"], nargs=2)]
    tail = ["--plot"] if flag else ["--span", "1", "--topics"]  # a value that looks like an option stays one
    row = spread(["--topics", *topics, *tail, "--", *rest], options)
    assert row == [*(part for topic in topics for part in ("--topics", topic)), *tail, "--", *rest]


def test_cameras_may_follow_the_models(tmp_path: Path) -> None:
    (tmp_path / "left").mkdir()
    options = [Many(["--models"]), click.Option(["--out"])]
    given_words = ["--models", "ds-none", str(tmp_path / "left"), "right*.png", "--out=x"]
    assert spread(given_words, options) == given_words


@pytest.mark.parametrize("command", [calibrate_cameras, calibrate_imu_camera])
def test_options_that_are_not_needed_are_hidden_in_the_help(command: KalibrCommand) -> None:
    text = CliRunner().invoke(main, [str(command.name), "--help"]).output
    assert "--dont-show-report " not in text.partition("Options:")[2]
    assert "--topics" in text


@pytest.mark.real_data
@pytest.mark.slow
def test_an_event_camera_and_its_imu_by_kalibrs_command(data_folder: Path, tmp_path: Path) -> None:
    source = data_folder / "dvxplorer_aprilgrid"
    shutil.copytree(source / "mav0", tmp_path / "dvx")
    entry = {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "intrinsics": [642.19, 642.18, 291.91, 253.02],
        "distortion_coeffs": [-0.3726, 0.2323, 0.00048, -0.00253],
        "resolution": [640, 480],
        "rostopic": "/cam0/image_raw",
    }
    (tmp_path / "chain.yaml").write_text(yaml.safe_dump({"cam0": entry}))
    arguments = (
        f"--bag dvx --cam chain.yaml --imu {source / 'imu.yaml'} --target {source / 'target.yaml'} --bag-from-to 1 3 "
        "--bag-freq 10 --export-poses --dont-show-report --max-iter 8 --workers 1"
    )
    # A process of its own: what runs here is checked call by call, which takes three times as long.
    command = [sys.executable, "-m", "jaxcal.cli", "calibrate-imu-camera", *arguments.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode in (0, 3), done.stderr  # short as it is, the verdict may well be 'do not use'
    assert "verdict: " in done.stdout
    out = tmp_path / "dvx-jaxcal"
    (camera,) = load_camchain(out / "dvx-camchain-imucam.yaml")
    assert camera.rostopic == "/cam0/image_raw"
    assert np.asarray(camera.model.intrinsics).tolist() == entry["intrinsics"]  # held, as Kalibr does
    assert camera.T_cam_imu is not None
    np.testing.assert_allclose(camera.T_cam_imu[:3, :3], np.diag([-1.0, 1.0, -1.0]), atol=0.1)
    poses = np.loadtxt(out / "dvx-poses-imucam-imu0.csv", delimiter=",")
    imu = load_calibration(out).imu
    assert imu is not None
    np.testing.assert_allclose(poses[:, 1:4], imu.position_m, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(poses[:, 4:], axis=1), 1.0, atol=1e-5)
    assert {path.name for path in out.iterdir()} >= {"dvx-imu.yaml", "dvx-results-imucam.txt", "report.html"}
