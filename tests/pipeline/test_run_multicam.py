"""The main job as a person starts it: from a shell."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from jaxcal import Checkerboard, Detections, load_calibration

SCRIPT = Path(__file__).resolve().parents[2] / "experiments" / "run_multicam.py"
FOCAL, CENTRE, SIZE = 300.0, np.array([159.5, 119.5]), (320, 240)


def run(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)


def write_recording(folder: Path) -> Path:
    """One ideal camera that saw a board 25 times, as a rig with its ground truth."""
    board = Checkerboard(rows=5, cols=8, spacing=0.04)
    rng = np.random.default_rng(4)
    pixels = []
    while len(pixels) < 25:
        turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0] @ np.diag([1.0, -1.0, -1.0])
        seen = (board.points - board.points.mean(axis=0)) @ turn.T + [0.0, 0.0, rng.uniform(0.5, 0.8)]
        projected = FOCAL * seen[:, :2] / seen[:, 2:] + CENTRE + rng.normal(0.0, 0.05, (40, 2))
        if ((projected > 0) & (projected < np.array(SIZE) - 1)).all():
            pixels.append(projected)
    frame, point = np.repeat(np.arange(25), 40), np.tile(np.arange(40), 25)
    Detections(np.arange(25) * 10**8, frame, point, np.concatenate(pixels), SIZE).save(folder / "corners.npz")
    truth = {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": [FOCAL, FOCAL, *CENTRE.tolist()],
            "distortion_model": "none",
            "distortion_coeffs": [],
            "T_cam_imu": np.eye(4).tolist(),
            "timeshift_cam_imu": 0.0,
        }
    }
    (folder / "ground_truth.yaml").write_text(yaml.safe_dump(truth))
    cameras = [{"name": "cam0", "model": "pinhole-none", "detections": "corners.npz"}]
    (folder / "rig.yaml").write_text(yaml.safe_dump({"target": board.to_yaml(), "cameras": cameras}))
    return folder / "rig.yaml"


@pytest.mark.slow
def test_a_rig_is_calibrated_and_compared_with_its_truth(tmp_path: Path) -> None:
    done = run("--rig", write_recording(tmp_path), "--output", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no bars where nobody watches
    assert "error/sigma over 4 numbers" in done.stdout
    assert str(tmp_path / "out" / "report.html") in done.stdout
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
    focal = np.asarray(load_calibration(tmp_path / "out").cameras[0].model.intrinsics)[0]
    assert focal == pytest.approx(FOCAL, abs=1.0)


def test_mistakes_end_in_one_clear_line(tmp_path: Path) -> None:
    done = run("--rig", tmp_path / "rig.yaml", "--output", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr == f"error: {tmp_path / 'rig.yaml'}: no such rig file.\n"


def test_help_teaches_the_format() -> None:
    done = run("--help")
    assert done.returncode == 0
    for word in ("--rig", "--output", "events:", "frames:", "detections:", "resolution:", "noise: imu.yaml", "INNER"):
        assert word in done.stdout
