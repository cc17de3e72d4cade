"""The `jaxcal` command: what it writes, what it says, and the exit codes 0, 1 (impossible input) and 2 (usage)."""

import subprocess
import sys
from pathlib import Path

import click
import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result

from jaxcal import AprilGrid, Checkerboard, Detections, load_target
from jaxcal.cli import main
from jaxcal.results import load_calibration, load_camchain
from jaxcal.results.interchange import calibration_of_file
from jaxcal.targets import BoardSet, Charuco, CircleGrid

CAMCHAIN = {
    f"cam{k}": {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "intrinsics": [458.654 + k, 457.296, 367.215, 248.375],
        "distortion_coeffs": [-0.28340811, 0.07395907, 0.00019359, 1.76187e-05],
        "resolution": [752, 480],
        "cam_overlaps": [1 - k],
        "rostopic": f"/cam{k}/image_raw",
    }
    for k in range(2)
}
CAMCHAIN["cam1"]["T_cn_cnm1"] = [[1.0, 0.0, 0.0, -0.11], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0, 0, 0, 1.0]]


def jaxcal(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)


COMMANDS = [[], ["convert", "camera"], *([name] for name in main.list_commands(click.Context(main)))]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: list[str]) -> None:
    result = jaxcal(*command, "--help")
    assert result.exit_code == 0
    assert "Usage: " in result.output
    if command != ["convert"]:
        assert f"jaxcal {' '.join(command)}" in result.output  # an example


def test_a_command_that_is_misspelt() -> None:
    result = jaxcal("calibrat", "rig.yaml")
    assert result.exit_code == 2
    assert "No such command 'calibrat'. Did you mean 'calibrate'?" in result.stderr


def test_help_imports_nothing_heavy() -> None:
    code = """
import sys
from jaxcal.cli import main
try:
    main(["--help"])
except SystemExit as end:
    heavy = ("torch", "cv2", "matplotlib", "scipy", "h5py", "optimistix")
    print([name for name in heavy if name in sys.modules], end.code)
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[] 0"


# --- jaxcal target ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "board"),
    [
        ("--type aprilgrid --rows 4 --cols 5 --size 0.02 --spacing 0.3", AprilGrid(4, 5, 0.02, 0.3)),
        (
            "--type aprilgrid --rows 4 --cols 5 --size 0.02 --spacing 0.3 --first-id 20",
            AprilGrid(4, 5, 0.02, 0.3, first_id=20),
        ),
        ("--type checkerboard --rows 6 --cols 9 --size 0.02", Checkerboard(6, 9, 0.02)),
        ("--type checkerboard --rows 6 --cols 9 --size 0.02 --col-size 0.015", Checkerboard(6, 9, 0.02, 0.015)),
        ("--type circlegrid --rows 11 --cols 4 --size 0.015 --asymmetric", CircleGrid(11, 4, 0.015, True)),
        ("--type circlegrid --rows 5 --cols 4 --size 0.02 --diameter 0.015", CircleGrid(5, 4, 0.02, False, 0.015)),
        (
            "--type charuco --rows 5 --cols 7 --size 0.02 --dictionary DICT_5X5_100 --legacy --first-id 3",
            Charuco(5, 7, 0.02, 0.015, "DICT_5X5_100", legacy=True, first_id=3),
        ),
    ],
)
def test_a_board_is_drawn_and_described(arguments: str, board: object, tmp_path: Path) -> None:
    out = tmp_path / "board.pdf"
    result = jaxcal("target", *arguments.split(), "--out", out, "--out", tmp_path / "wall.svg")
    assert result.exit_code == 0
    assert "print at 100 %" in result.output
    assert out.read_bytes().startswith(b"%PDF")
    assert b"<svg" in (tmp_path / "wall.svg").read_bytes()
    assert load_target(tmp_path / "board.yaml") == board


def test_a_file_with_several_boards_is_drawn_board_by_board(tmp_path: Path) -> None:
    boards = BoardSet([AprilGrid(2, 3, 0.02, 0.3), Checkerboard(4, 5, 0.02)])
    source = tmp_path / "boards.yaml"
    source.write_text(yaml.safe_dump(boards.to_yaml()))
    assert jaxcal("target", "--from", source, "--out", tmp_path / "wall.pdf").exit_code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["boards.yaml", "wall-0.pdf", "wall-1.pdf"]


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ("--rows 4 --cols 5 --size 0.02", 2, "missing --type"),
        ("--type aprilgrid --rows 4 --size 0.02", 2, "missing --cols, --spacing"),
        ("--type charuco --rows 4 --cols 5 --size 0.02", 2, "missing --dictionary. OpenCV's name of it"),
        ("--type checkerboard --rows 4 --cols 5 --size 0.02 --spacing 0.3", 2, "a checkerboard has no --spacing"),
        ("--type checkers --rows 4 --cols 5 --size 0.02", 2, "'checkers' is not one of"),
        ("--type checkerboard --rows four --cols 5 --size 0.02", 2, "'four' is not a valid integer"),
        ("--from board.yaml --type checkerboard", 2, "leave out --type"),
        ("--from absent.yaml", 1, "absent.yaml: no such target file"),
        ("--type checkerboard --rows 1 --cols 5 --size 0.02", 1, "2 x 2 inner corners"),
        ("--type checkerboard --rows 4 --cols 5 --size 0.2 --page A4", 1, "does not fit on A4"),
    ],
)
def test_wrong_requests_say_what_is_wrong(arguments: str, code: int, said: str, tmp_path: Path) -> None:
    result = jaxcal("target", *arguments.split(), "--out", tmp_path / "board.pdf")
    assert result.exit_code == code
    assert said in result.stderr
    assert "Traceback" not in result.output
    assert not list(tmp_path.iterdir())


# --- jaxcal convert --------------------------------------------------------------------------------------------------


def written(folder: Path) -> Path:
    path = folder / "camchain.yaml"
    path.write_text(yaml.safe_dump(CAMCHAIN))
    return path


def test_a_lens_is_converted_and_everything_else_stays(tmp_path: Path) -> None:
    source, out = written(tmp_path), tmp_path / "new.yaml"
    result = jaxcal("convert", "camera", source, "--to", "pinhole-rational8", "--camera", "cam1", "--out", out)
    assert result.exit_code == 0
    assert "cam1: pinhole-radtan -> pinhole-rational8: 0.0" in result.output
    assert "cam0:" not in result.output
    before, after = load_camchain(source), load_camchain(out)
    assert after[0].model.name == "pinhole-radtan"
    assert after[1].model.name == "pinhole-rational8"
    np.testing.assert_array_equal(after[1].T_cn_cnm1, before[1].T_cn_cnm1)
    rays = np.array([[0.1, 0.2, 1.0], [-0.5, 0.2, 1.0], [0.6, -0.4, 1.0]])
    for ray in rays:
        np.testing.assert_allclose(after[1].model.project(ray), before[1].model.project(ray), atol=0.05)


def test_lenses_of_a_result_are_converted_by_its_folder(tmp_path: Path) -> None:
    calibration_of_file(written(tmp_path), AprilGrid(6, 6, 0.03, 0.3)).save(tmp_path / "result")
    result = jaxcal("convert", "camera", tmp_path / "result", "--to", "pinhole-rational8", "--out", tmp_path / "a.yaml")
    assert result.exit_code == 0, result.output
    before, after = load_calibration(tmp_path / "result"), load_camchain(tmp_path / "a.yaml")
    assert [camera.model.name for camera in after] == ["pinhole-rational8"] * 2
    np.testing.assert_array_equal(after[1].T_cn_cnm1, before.cameras[1].T_cn_cnm1)


def test_what_cannot_be_converted(tmp_path: Path) -> None:
    source = written(tmp_path)
    for arguments, said in (
        (["--to", "ds-nun"], "camera model 'ds-nun' is unknown. Did you mean 'ds-none'?"),
        (["--to", "ds-none", "--camera", "cam7"], "there is no camera 'cam7'; it has cam0, cam1"),
    ):
        result = jaxcal("convert", "camera", source, *arguments)
        assert result.exit_code == 1
        assert said in result.stderr
    assert jaxcal("convert", "camera", source).exit_code == 2


# --- jaxcal calibrate-cameras ----------------------------------------------------------------------------------------

BOARD = Checkerboard(6, 9, 0.05)
SIZE = (640, 480)


def views_of_the_board(count: int) -> list[np.ndarray]:
    """Pixels (N, 2) of the board's corners in views through a pinhole of focal length 450."""
    focal = np.array([[450.0, 0.0, 320.0], [0.0, 450.0, 240.0], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    views = []
    for _ in range(count):
        tilt = cv2.Rodrigues(np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.5, 0.5)]))[0]
        rotation = tilt @ np.diag([1.0, -1.0, -1.0])
        middle = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.55, 0.8)])
        points = (BOARD.points - BOARD.points.mean(axis=0)) @ rotation.T + middle
        homogeneous = points @ focal.T
        views.append(homogeneous[:, :2] / homogeneous[:, 2:] + 0.1 * rng.standard_normal((54, 2)))
    return views


@pytest.mark.slow
def test_corners_in_a_calibration_out(tmp_path: Path) -> None:
    views = views_of_the_board(20)
    frame, point = np.divmod(np.arange(20 * 54), 54)
    corners = Detections(np.arange(20) * 10**8, frame, point, np.concatenate(views), SIZE)
    corners.save(tmp_path / "corners.npz")
    (tmp_path / "target.yaml").write_text(yaml.safe_dump(BOARD.to_yaml()))
    out = tmp_path / "result"
    result = jaxcal(
        "calibrate-cameras", tmp_path / "corners.npz", "--target", tmp_path / "target.yaml",
        "--models", "pinhole-radtan", "--views", "15", "--loss", "cauchy", "--out", out,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    calibration = load_calibration(out)
    np.testing.assert_allclose(np.asarray(calibration.cameras[0].model.intrinsics), [450, 450, 320, 240], atol=3.0)
    assert calibration.settings["views"] == 15
    assert calibration.settings["loss"] == "cauchy"
    assert (out / "report.html").exists()
    assert (out / "camchain.yaml").exists()
    assert "report.html" in result.output


def test_impossible_requests_fail_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "target.yaml").write_text(yaml.safe_dump(BOARD.to_yaml()))
    common = ["--target", str(tmp_path / "target.yaml"), "--out", str(tmp_path / "result")]
    for arguments, code, said in (
        (["left", "right", "--models", "a", "--models", "b", "--models", "c"], 2, "3 --models for 2 cameras"),
        (["left", "--models", "pinhole-radial"], 1, "camera model 'pinhole-radial' is unknown"),
        (["left"], 1, "left"),
        ([str(tmp_path / "left*.png")], 1, "no such images"),
        (["corners.npz", "--resolution", "640"], 2, "'640' is no size such as 640x480"),
        (["absent.npz"], 1, "absent.npz: no such detections file"),
    ):
        result = jaxcal("calibrate-cameras", *arguments, *common)
        assert result.exit_code == code, result.output
        assert said in result.stderr


@pytest.mark.real_data
@pytest.mark.slow
def test_images_of_a_real_stereo_pair(data_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "target.yaml").write_text(yaml.safe_dump(Checkerboard(6, 9, 0.025).to_yaml()))
    images = data_folder / "opencv_stereo"
    result = jaxcal(
        "calibrate-cameras", images / "left*.jpg", images / "right*.jpg",
        "--target", tmp_path / "target.yaml", "--workers", "1", "--out", tmp_path / "result",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    left, right = load_calibration(tmp_path / "result").cameras
    assert left.reprojection_rms_px < 0.3
    assert np.asarray(left.model.intrinsics)[0] == pytest.approx(535.9, abs=3.0)
    assert right.T_cn_cnm1 is not None
    assert right.T_cn_cnm1[0, 3] == pytest.approx(-3.34 * 0.025, abs=0.002)
