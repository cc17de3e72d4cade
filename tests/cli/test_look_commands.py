"""`jaxcal detect`, `jaxcal init` and `jaxcal validate`: what they find, write and say."""

import json
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result
from scipy.spatial.transform import Rotation

from jaxcal import AprilGrid, Checkerboard, Detections, load_rig
from jaxcal.cli import main

BOARD = Checkerboard(rows=5, cols=8, spacing=0.05)
SIZE = (640, 480)
FOCAL, CENTRE = np.array([450.0, 452.0]), np.array([318.0, 242.0])
K1 = -0.2
BASELINE = np.array([-0.1, 0.0, 0.0])
NOISE = {
    "accelerometer_noise_density": 1.4e-3,
    "accelerometer_random_walk": 8.6e-5,
    "gyroscope_noise_density": 8.0e-5,
    "gyroscope_random_walk": 2.2e-6,
}


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)


# --- jaxcal validate -------------------------------------------------------------------------------------------------


def project(points: np.ndarray) -> np.ndarray:
    plane = points[:, :2] / points[:, 2:]
    return FOCAL * plane * (1.0 + K1 * np.sum(plane**2, axis=1, keepdims=True)) + CENTRE


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """A folder with what two cameras saw of the board, cam0.npz and cam1.npz, and the camchain that is true."""
    rng = np.random.default_rng(7)
    seen: list[list[np.ndarray]] = [[], []]
    while len(seen[0]) < 20:
        turn = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        middle = np.array([*rng.uniform(-0.15, 0.25, 2), rng.uniform(0.6, 0.9)])
        points = (BOARD.points - BOARD.points.mean(axis=0)) @ turn.T + middle
        both = [project(points), project(points + BASELINE)]
        if all((pixels > 0).all() and (pixels < np.array(SIZE) - 1).all() for pixels in both):
            for k, pixels in enumerate(both):
                seen[k].append(pixels + rng.normal(0.0, 0.1, pixels.shape))
    frame, point = np.divmod(np.arange(20 * len(BOARD.points)), len(BOARD.points))
    for k, views in enumerate(seen):
        times = np.arange(20) * 10**8
        Detections(times, frame, point, np.concatenate(views), SIZE).save(tmp_path / f"cam{k}.npz")
    camera = {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "intrinsics": [*FOCAL.tolist(), *CENTRE.tolist()],
        "distortion_coeffs": [K1, 0.0, 0.0, 0.0],
        "resolution": list(SIZE),
    }
    shift = np.eye(4)
    shift[:3, 3] = BASELINE
    chain: dict[str, Any] = {"cam0": camera, "cam1": camera | {"T_cn_cnm1": shift.tolist()}}
    (tmp_path / "chain.yaml").write_text(yaml.safe_dump(chain))
    (tmp_path / "board.yaml").write_text(yaml.safe_dump(BOARD.to_yaml()))
    return tmp_path


def validated(folder: Path) -> tuple[int, dict[str, Any]]:
    sources = [folder / f"cam{k}.npz" for k in range(2)]
    result = run("validate", folder / "chain.yaml", *sources, "--target", folder / "board.yaml", "--json")
    return result.exit_code, json.loads(result.stdout)


@pytest.mark.slow
def test_a_calibration_that_holds_and_two_that_do_not(recorded: Path) -> None:
    chain = yaml.safe_load((recorded / "chain.yaml").read_text())
    code, good = validated(recorded)
    assert (code, good["good"], good["findings"]) == (0, True, [])
    for camera in good["cameras"]:
        assert camera["alone_px"] == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
        assert camera["together_px"] == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    (pose,) = good["poses"]
    assert pose["views"] == 20
    assert pose["turn_deg"] < 4.0 * pose["turn_error_deg"]
    assert pose["shift_m"] < 4.0 * pose["shift_error_m"]

    knocked = np.eye(4)
    knocked[:3, :3] = Rotation.from_rotvec([0.0, 0.3, 0.0], degrees=True).as_matrix()
    pose_now = knocked @ np.array(chain["cam1"]["T_cn_cnm1"])
    moved = chain | {"cam1": chain["cam1"] | {"T_cn_cnm1": pose_now.tolist()}}
    (recorded / "chain.yaml").write_text(yaml.safe_dump(moved))
    code, bad = validated(recorded)
    assert (code, bad["good"]) == (3, False)
    assert "cam0 and cam1 no longer fit together" in bad["findings"][0]
    assert bad["poses"][0]["turn_deg"] == pytest.approx(0.3, abs=0.03)

    touched = chain | {"cam0": chain["cam0"] | {"intrinsics": [500.0, 450.0, *CENTRE.tolist()]}}
    (recorded / "chain.yaml").write_text(yaml.safe_dump(touched))
    code, bad = validated(recorded)
    assert code == 3
    assert bad["findings"][0].startswith("cam0 misses the corners by")


def test_validations_that_cannot_be(recorded: Path) -> None:
    chain, board, corners = (recorded / name for name in ("chain.yaml", "board.yaml", "cam0.npz"))
    for arguments, code, said in (
        ([corners, corners], 2, "give --target board.yaml"),
        ([corners, "--target", board], 2, "1 recordings for 2 cameras"),
        ([corners, recorded / "absent.npz", "--target", board], 1, "absent.npz: no such detections file"),
    ):
        result = run("validate", chain, *arguments)
        assert (result.exit_code, said in result.stderr) == (code, True), result.output


# --- jaxcal init -----------------------------------------------------------------------------------------------------


def write_images(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((4, 6), np.uint8))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """EuRoC's layout, with an event camera and an image camera of other layouts beside it."""
    folder = tmp_path / "recording"
    write_images(folder / "mav0" / "cam0" / "data", ["1.png", "2.png"])
    (folder / "mav0" / "cam0" / "data.csv").write_text("#time,name\n1,1.png\n2,2.png\n")
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text("sensor_type: camera\n")
    (folder / "mav0" / "imu0").mkdir()
    (folder / "mav0" / "imu0" / "data.csv").write_text("#t,w,w,w,a,a,a\n1,0,0,0,0,0,9.8\n2,0,0,0,0,0,9.8\n")
    write_images(folder / "fisheye", [f"{1_600_000_000_000_000_000 + k}.png" for k in range(4)])
    write_images(folder / "pairs", [f"{side}{k:02d}.jpg" for side in ("left", "right") for k in range(4)])
    with h5py.File(folder / "events.h5", "w") as file:
        for name in "xypt":
            file[name] = np.arange(4)
    (folder / "target.yaml").write_text(yaml.safe_dump(AprilGrid(6, 6, 0.088, 0.3).to_yaml()))
    (folder / "imu.yaml").write_text(yaml.safe_dump(NOISE))
    (folder / "other.yaml").write_text("- not\n- ours\n")
    return folder


def test_a_folder_becomes_a_rig(recording: Path) -> None:
    result = run("init", recording, "--model", "pinhole-equi")
    assert result.exit_code == 0
    text = (recording / "rig.yaml").read_text()
    assert "fill in before you calibrate" in result.output  # the size of the event camera, which its file does not tell
    assert text.count("FILL IN") == 1
    (recording / "rig.yaml").write_text(text.replace("[0, 0]", "[640, 480]"))
    rig = load_rig(recording / "rig.yaml")
    kinds = {camera.name: next(k for k in ("events", "frames") if getattr(camera, k)) for camera in rig.cameras}
    assert kinds == {"cam0": "frames", "events": "events", "fisheye": "frames", "left": "frames", "right": "frames"}
    assert {camera.name: len(camera.load_frames()) for camera in rig.cameras if camera.frames} == {
        "cam0": 2,
        "fisheye": 4,
        "left": 4,
        "right": 4,
    }
    assert {camera.model for camera in rig.cameras} == {"pinhole-equi"}
    assert rig.imu is not None
    assert len(rig.imu.load()) == 2
    assert not any(line.startswith("/") for line in text.split(": "))  # paths are relative
    assert run("init", recording).exit_code == 1  # it is there already
    assert run("init", recording, "--force").exit_code == 0


def test_what_is_not_found_is_said(tmp_path: Path, recording: Path) -> None:
    (recording / "target.yaml").unlink()
    (recording / "imu.yaml").unlink()
    (recording / "events.h5").unlink()
    result = run("init", recording, "--out", tmp_path / "rig.yaml")
    assert result.exit_code == 0
    assert "target: target.yaml    # FILL IN" in result.output
    assert "noise: imu.yaml    # FILL IN" in result.output
    yaml.safe_load((tmp_path / "rig.yaml").read_text())
    (tmp_path / "empty").mkdir()
    assert run("init", tmp_path / "empty").exit_code == 1
    assert "no such folder or bag" in run("init", tmp_path / "absent").stderr


def test_tables_of_corners_become_cameras(tmp_path: Path) -> None:
    corners = {f"left_{name}": np.zeros((1, 2)) for name in ("ns", "uv")}
    np.savez(tmp_path / "all.npz", imu_ns=np.zeros(1), gyro_rad_s=np.zeros(1), acc_m_s2=np.zeros(1), **corners)
    run("init", tmp_path)
    content = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    (camera,) = content["cameras"]
    assert (camera["name"], camera["detections"]) == ("left", "all.npz")
    assert content["imus"] == [{"data": "all.npz", "noise": "imu.yaml"}]


# --- jaxcal detect ---------------------------------------------------------------------------------------------------


@pytest.mark.real_data
def test_corners_of_real_images_with_a_picture(data_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "target.yaml").write_text(yaml.safe_dump(Checkerboard(6, 9, 0.025).to_yaml()))
    common = ["detect", data_folder / "opencv_stereo" / "left0*.jpg", "--target", tmp_path / "target.yaml"]
    common += ["--workers", "1", "--out", tmp_path / "left.npz"]
    result = run(*common, "--plot", tmp_path / "left.png", "--json")
    assert result.exit_code == 0, result.stderr
    facts = json.loads(result.stdout)
    found = Detections.load(tmp_path / "left.npz")
    assert (facts["frames"], facts["corners"], facts["corners_of_board"]) == (9, len(found), 54)
    assert facts["frames_with_board"] == len(found.seen_frames) == 9
    assert 0.5 < facts["image_covered"] < 0.9
    assert cv2.imread(str(tmp_path / "left.png")).shape[0] > 300
    result = run(*common, "--from-to", "0.1", "0.35")
    assert "the board in 3 of 3 frames" in result.output


def test_requests_that_detect_refuses(tmp_path: Path) -> None:
    (tmp_path / "target.yaml").write_text(yaml.safe_dump(BOARD.to_yaml()))
    write_images(tmp_path / "dark", ["1.png", "2.png"])
    common = ["detect", tmp_path / "dark", "--target", tmp_path / "target.yaml"]
    for arguments, said in (
        (["--out", tmp_path / "a.txt"], "a.txt: corners are written as .npz"),
        (["--out", tmp_path / "a.npz", "--plot", tmp_path / "a.doc"], "a.doc: pictures end in"),
        (["--out", tmp_path / "a.npz", "--from-to", "4", "5"], "no frame lies between 4.00 s and 5.00 s"),
    ):
        result = run(*common, *arguments)
        assert (result.exit_code, said in result.stderr) == (1, True), result.output
    assert not (tmp_path / "a.npz").exists()
