"""Real images: as many boards as others find, and corners that a stock calibration fits well."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxcal import Checkerboard, Detections, Frames, Target, detect, load_target
from jaxcal.recording import load_frames

pytestmark = pytest.mark.real_data


@pytest.fixture
def workers() -> int:
    return min(2, os.cpu_count() or 1)


def stock_rms(found: Detections, target: Target, flags: int) -> tuple[float, np.ndarray]:
    """RMS of the 2-D error and camera matrix that OpenCV's own calibration reaches on these corners."""
    rows = [np.flatnonzero(found.frame == frame) for frame in found.seen_frames]
    rows = [row for row in rows if len(row) >= 12]
    board = [target.points[found.point[row]].astype(np.float32) for row in rows]
    pixels = [found.pixels[row].astype(np.float32) for row in rows]
    rms, camera, *_ = cv2.calibrateCamera(board, pixels, found.image_size, None, None, flags=flags)  # pyright: ignore
    return rms, camera


@pytest.mark.parametrize(("side", "boards"), [("left", 13), ("right", 13)])
def test_opencv_stereo(data_folder: Path, workers: int, side: str, boards: int) -> None:
    board = Checkerboard(rows=6, cols=9, spacing=1.0)
    paths = sorted((data_folder / "opencv_stereo").glob(f"{side}*.jpg"))
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
    found = detect(Frames(np.arange(len(images)), images, (640, 480)), board, workers=workers)
    assert len(found.seen_frames) == len(paths) == boards
    assert len(found) > 0.98 * 54 * boards
    rms, camera = stock_rms(found, board, 0)
    assert rms < 0.22  # OpenCV publishes 0.393
    if side == "left":
        assert camera[0, 0] == pytest.approx(535.916, rel=0.01)


@pytest.mark.slow
def test_real_event_frames_of_an_aprilgrid(data_folder: Path, workers: int) -> None:
    recording = data_folder / "dvxplorer_aprilgrid"
    frames, target = load_frames(recording / "mav0" / "cam0"), load_target(recording / "target.yaml")
    every_fourth = range(0, len(frames), 4)
    chosen = Frames(frames.timestamps_ns[::4], [frames.images[i] for i in every_fourth], frames.image_size)
    found = detect(chosen, target, workers=workers)
    assert len(found.seen_frames) == len(chosen)  # a stock detector finds tags in 92 % of the frames
    assert len(found) > 0.95 * 144 * len(chosen)
    rms, camera = stock_rms(found, target, cv2.CALIB_FIX_K3)
    assert rms < 0.4
    assert camera[0, 0] == pytest.approx(630.1, rel=0.02)
