"""`jaxcal calibrate`: a rig.yaml in, verdict and exit code out; killed at any moment, it goes on where it stopped."""

import json
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result

import jaxcal.pipeline
import jaxcal.recording
from jaxcal import CalibrationError, Checkerboard, Detections, load_calibration
from jaxcal.cli import main
from jaxcal.results import Calibration

BOARD = Checkerboard(rows=5, cols=8, spacing=0.05)
SIZE = (320, 240)
FOCAL = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
FRAMES = 40


def places(seed: int) -> list[np.ndarray]:
    """(3, 4) projections, each putting the whole board into the image."""
    rng = np.random.default_rng(seed)
    found: list[np.ndarray] = []
    while len(found) < FRAMES:
        turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0] @ np.diag([1.0, -1.0, -1.0])
        middle = np.array([*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.5, 0.8)])
        pose = np.column_stack([turn, middle - turn @ BOARD.points.mean(axis=0)])
        pixels = seen_at(FOCAL @ pose)
        if (pixels > 8).all() and (pixels < np.array(SIZE) - 9).all():
            found.append(FOCAL @ pose)
    return found


def seen_at(projection: np.ndarray) -> np.ndarray:
    homogeneous = BOARD.points @ projection[:, :3].T + projection[:, 3]
    return homogeneous[:, :2] / homogeneous[:, 2:]


def write_images(folder: Path, projections: list[np.ndarray]) -> None:
    """What the camera sees of a board drawn with 20 pixels a square and a margin of one square."""
    rows, cols = BOARD.rows + 1, BOARD.cols + 1
    squares = (np.add.outer(np.arange(rows), np.arange(cols)) % 2 * 255).astype(np.uint8)
    drawing = np.kron(np.pad(squares, 1, constant_values=255), np.ones((20, 20), np.uint8))
    # Pixel of the drawing -> point of the board, whose y axis points the other way or not: any way is a board.
    scale = BOARD.spacing / 20.0
    to_board = np.array([[scale, 0.0, -39.5 * scale], [0.0, scale, -39.5 * scale], [0.0, 0.0, 1.0]])
    folder.mkdir()
    for number, projection in enumerate(projections):
        homography = projection[:, [0, 1, 3]] @ to_board
        image = cv2.warpPerspective(drawing, homography, SIZE, flags=cv2.INTER_AREA, borderValue=(110.0,))
        cv2.imwrite(str(folder / f"{number * 100_000_000}.png"), image)


def write_rig(folder: Path) -> Path:
    """A camera with images and one whose corners are known already."""
    folder.mkdir(parents=True)
    projections = places(5)
    write_images(folder / "left", projections)
    shift = np.column_stack([np.zeros((3, 3)), FOCAL @ [-0.02, 0.0, 0.0]])
    pixels = np.concatenate([seen_at(projection + shift) for projection in projections])
    pixels += np.random.default_rng(2).normal(0.0, 0.05, pixels.shape)
    frame, point = np.divmod(np.arange(len(pixels)), len(BOARD.points))
    Detections(np.arange(FRAMES) * 100_000_000, frame, point, pixels, SIZE).save(folder / "right.npz")
    cameras = [
        {"name": "left", "model": "pinhole-none", "frames": "left"},
        {"name": "right", "model": "pinhole-none", "detections": "right.npz"},
    ]
    (folder / "rig.yaml").write_text(yaml.safe_dump({"target": BOARD.to_yaml(), "cameras": cameras}))
    return folder / "rig.yaml"


def start(rig: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "jaxcal.cli", "calibrate", str(rig), "--output", str(rig.parent / "out")]
    command += ["--workers", "1", "--json", "--no-report"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(rig: Path) -> dict[str, Any]:
    process = start(rig)
    out, err = process.communicate(timeout=400)
    assert process.returncode in (0, 3), err
    assert err == ""  # no bars where nobody watches
    return json.loads(out)


def parts(rig: Path) -> dict[str, int]:
    """Finished parts of the detection, and when each was written; a run at work may take them away meanwhile."""
    written: dict[str, int] = {}
    with suppress(FileNotFoundError):
        for path in (rig.parent / ".jaxcal").glob("*.parts/[0-9]*.npz"):
            written[path.name] = path.stat().st_mtime_ns
    return written


def corners(rig: Path) -> list[Path]:
    return list((rig.parent / ".jaxcal").glob("*.detections.npz"))


def kill_when(process: "subprocess.Popen[str]", reached: Any, delay_s: float) -> None:
    end = time.monotonic() + 300
    try:
        while process.poll() is None and not reached() and time.monotonic() < end:
            time.sleep(0.002)
        time.sleep(delay_s)
    finally:  # a process that outlives its test fails another one
        process.kill()
        process.communicate()


def nothing_is_half_written(rig: Path) -> None:
    """Every file under its final name is whole; what was being written is under another one."""
    for path in (rig.parent / ".jaxcal").rglob("[!.]*.npz"):
        with np.load(path) as content:
            assert all(content[name] is not None for name in content.files)
    if (rig.parent / "out" / "calibration.npz").exists():
        assert isinstance(load_calibration(rig.parent / "out"), Calibration)


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on_and_ends_the_same(tmp_path: Path) -> None:
    undisturbed = finish(write_rig(tmp_path / "undisturbed"))
    assert undisturbed["cameras"][0]["intrinsics"] == pytest.approx([300.0, 300.0, 159.5, 119.5], abs=2.0)
    rig = write_rig(tmp_path / "killed")
    rng = np.random.default_rng()
    kill_when(start(rig), lambda: len(parts(rig)) >= 1 or corners(rig), rng.uniform(0.0, 0.05))
    nothing_is_half_written(rig)
    kept, later = parts(rig), {}

    def detected() -> bool:
        later.update(parts(rig))
        return bool(corners(rig))

    kill_when(start(rig), detected, rng.uniform(0.0, 3.0))
    nothing_is_half_written(rig)
    assert {name: later.get(name, when) for name, when in kept.items()} == kept  # no part was made again
    (found,) = corners(rig)
    written = found.stat().st_mtime_ns
    result = finish(rig)
    assert found.stat().st_mtime_ns == written  # nor is a finished stage
    assert not parts(rig)
    for before, after in zip(undisturbed["cameras"], result["cameras"], strict=True):
        for name in ("intrinsics", "T_cn_cnm1", "reprojection_rms_px"):
            np.testing.assert_allclose(np.array(after[name], float), np.array(before[name], float), rtol=1e-9)


# --- without the work ------------------------------------------------------------------------------------------------


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["calibrate", *map(str, arguments)], catch_exceptions=False)


def test_impossible_input_is_one_line_and_exit_code_1(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    result = run(tmp_path / "rig.yaml")
    assert (result.exit_code, result.stderr) == (1, f"error: {tmp_path / 'rig.yaml'}: no such rig file.\n")

    def fail(*_: Any, **__: Any) -> None:
        raise CalibrationError("cam0: too dark.")

    monkeypatch.setattr(jaxcal.recording, "load_rig", lambda path: path)
    monkeypatch.setattr(jaxcal.pipeline, "run_pipeline", fail)
    result = run(tmp_path / "rig.yaml", "--json")
    assert (result.exit_code, result.stdout, result.stderr) == (1, "", "error: cam0: too dark.\n")
    assert run(tmp_path / "rig.yaml", "--jsn").exit_code == 2


@pytest.mark.parametrize(("sigma_px", "code"), [(0.1, 0), (30.0, 3)])
def test_the_verdict_is_the_exit_code(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, sigma_px: float, code: int
) -> None:
    from jaxcal.cameras import PinholeRadtan
    from jaxcal.observations import Detections
    from jaxcal.results import CameraCalibration

    rng = np.random.default_rng(0)
    projections = places(1)
    pixels = np.concatenate([seen_at(projection) for projection in projections])
    frame, point = np.divmod(np.arange(len(pixels)), len(BOARD.points))
    seen = Detections(np.arange(FRAMES), frame, point, pixels, SIZE)
    camera = CameraCalibration(
        name="cam0",
        model=PinholeRadtan.create([300.0, 300.0, 159.5, 119.5], np.zeros(4)),
        image_size=SIZE,
        T_cn_cnm1=None,
        T_cam_imu=None,
        timeshift_cam_imu=None,
        detections=seen,
        residuals_px=rng.normal(0.0, sigma_px, pixels.shape),
        inlier=np.ones(len(pixels), bool),
        corner_sigma_px=sigma_px,
    )
    calibration = Calibration(
        (camera,), BOARD, None, None, (("cam0.intrinsics", 4), ("cam0.distortion", 4)), 1e-8 * np.eye(8), np.ones(1)
    )
    monkeypatch.setattr(jaxcal.recording, "load_rig", lambda path: path)
    monkeypatch.setattr(jaxcal.pipeline, "run_pipeline", lambda *_, **__: calibration)
    result = run("rig.yaml", "--output", tmp_path, "--json")
    assert result.exit_code == code
    content = json.loads(result.stdout)
    assert content["verdict"]["level"] == ("bad" if code else content["verdict"]["level"])
    assert content["cameras"][0]["T_cn_cnm1"] is None
    assert content["cameras"][0]["intrinsics_sigma"] == pytest.approx([1e-4] * 4)
    words = run("rig.yaml", "--output", tmp_path)
    assert words.exit_code == code
    assert f"verdict: {content['verdict']['headline']}" in words.stdout
