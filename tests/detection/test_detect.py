"""`detect`: processes give what one process gives; caches hit, miss and resume when they should."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_boards import board_to_pixel, draw_checkerboard

from jaxcal import CalibrationError, Checkerboard, Detections, Frames, detect
from jaxcal.detection import corners as corners_module
from jaxcal.detection import detect as detect_function
from jaxcal.detection import worker
from jaxcal.recording import load_frames
from jaxcal.targets import Target

BOARD = Checkerboard(rows=4, cols=5, spacing=0.06)
SIZE = (160, 120)
NUM = 24
FIRST_NS = 1_000_000_000
EMPTY = 7  # the frame without a board


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    drawn = []
    for k in range(NUM):
        to_pixel = board_to_pixel((0.12, 0.09), 1.1 + 0.01 * k, 0.02 * k, (0.01 * k, 0.2), (320, 240))
        half = np.diag([0.5, 0.5, 1.0])
        drawn.append(draw_checkerboard(BOARD, half @ to_pixel, SIZE).image)
    drawn[EMPTY] = np.full_like(drawn[EMPTY], 90)
    return drawn


@pytest.fixture
def folder(images: list[np.ndarray], tmp_path: Path) -> Path:
    data = tmp_path / "cam0"
    data.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(data / f"{FIRST_NS + k}.png"), image)
    return data


@pytest.fixture
def detector_calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts the images that are looked at in this process."""
    calls: list[int] = []

    def counted(image: np.ndarray, target: Target) -> tuple[np.ndarray, np.ndarray]:
        calls.append(1)
        return corners_module.find_corners(image, target)

    monkeypatch.setattr(worker, "find_corners", counted)
    return calls


def same(a: Detections, b: Detections) -> bool:
    names = ("timestamps_ns", "frame", "point", "pixels")
    return a.image_size == b.image_size and all(np.array_equal(getattr(a, n), getattr(b, n)) for n in names)


def in_memory(images: list[np.ndarray]) -> Frames:
    return Frames(np.arange(len(images)) + FIRST_NS, images, SIZE)


def test_all_frames_are_listed_and_the_empty_one_has_no_corners(images: list[np.ndarray]) -> None:
    found = detect(in_memory(images), BOARD, workers=1)
    assert found.timestamps_ns.tolist() == list(range(FIRST_NS, FIRST_NS + NUM))
    assert set(found.seen_frames) == set(range(NUM)) - {EMPTY}
    assert len(found) == (NUM - 1) * 20
    assert found.image_size == SIZE


def test_processes_files_and_memory_agree(images: list[np.ndarray], folder: Path) -> None:
    alone = detect(in_memory(images), BOARD, workers=1)
    assert same(detect(in_memory(images), BOARD, workers=2), alone)
    assert same(detect(load_frames(folder), BOARD, workers=2), alone)


def test_progress_counts_every_frame(images: list[np.ndarray]) -> None:
    reports: list[tuple[str, int, int]] = []
    detect(in_memory(images), BOARD, workers=1, name="left", progress=lambda *report: reports.append(report))
    assert reports[0] == ("detect left", 0, NUM)
    assert reports[-1] == ("detect left", NUM, NUM)
    assert [done for _, done, _ in reports] == sorted(done for _, done, _ in reports)


def test_a_second_run_looks_at_no_image(folder: Path, tmp_path: Path, detector_calls: list[int]) -> None:
    first = detect(load_frames(folder), BOARD, workers=1, cache=tmp_path / "cache")
    assert len(detector_calls) == NUM
    again = detect(load_frames(folder), BOARD, workers=1, cache=tmp_path / "cache")
    assert len(detector_calls) == NUM
    assert same(first, again)
    assert len(list((tmp_path / "cache").iterdir())) == 1


@pytest.mark.parametrize("change", ["image", "target", "detector", "time"])
def test_whatever_detections_depend_on_makes_them_anew(
    images: list[np.ndarray], tmp_path: Path, detector_calls: list[int], monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    frames, board = in_memory(images[:4]), BOARD
    detect(frames, board, workers=1, cache=tmp_path)
    if change == "image":
        frames = in_memory([*images[:3], images[5]])
    elif change == "target":
        board = Checkerboard(rows=4, cols=5, spacing=0.061)
    elif change == "detector":
        monkeypatch.setattr("jaxcal.detection.cache.DETECTOR_VERSION", -1)
    else:
        frames = Frames(frames.timestamps_ns + 1, frames.images, SIZE)
    detect(frames, board, workers=1, cache=tmp_path)
    assert len(detector_calls) == 8
    assert len(list(tmp_path.iterdir())) == 1  # the old one is gone


def test_a_touched_file_is_looked_at_again(folder: Path, tmp_path: Path, detector_calls: list[int]) -> None:
    detect(load_frames(folder), BOARD, workers=1, cache=tmp_path / "cache")
    os.utime(folder / f"{FIRST_NS + 3}.png", ns=(1, 1))
    detect(load_frames(folder), BOARD, workers=1, cache=tmp_path / "cache")
    assert len(detector_calls) == 2 * NUM


def test_an_interrupted_run_continues(folder: Path, tmp_path: Path, detector_calls: list[int]) -> None:
    frames = load_frames(folder)

    def stop_halfway(_: str, done: int, __: int) -> None:
        if done >= 16:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        detect(frames, BOARD, workers=1, cache=tmp_path / "cache", progress=stop_halfway)
    assert len(detector_calls) == 16
    resumed = detect(frames, BOARD, workers=1, cache=tmp_path / "cache")
    assert len(detector_calls) == NUM
    assert same(resumed, detect(frames, BOARD, workers=1))


def test_damaged_caches_are_made_anew(folder: Path, tmp_path: Path) -> None:
    frames, cache = load_frames(folder), tmp_path / "cache"
    first = detect(frames, BOARD, workers=1, cache=cache)
    (kept,) = cache.iterdir()
    kept.write_bytes(kept.read_bytes()[:200])
    assert same(detect(frames, BOARD, workers=1, cache=cache), first)
    assert same(Detections.load(kept), first)


def test_cameras_share_a_cache_folder(folder: Path, tmp_path: Path, detector_calls: list[int]) -> None:
    for name in ("cam0", "cam1", "cam0", "cam1"):
        detect(load_frames(folder), BOARD, workers=1, cache=tmp_path / "cache", name=name)
    assert len(detector_calls) == 2 * NUM


def test_no_board_in_any_frame_says_what_was_looked_for() -> None:
    blank = [np.full((SIZE[1], SIZE[0]), 90, np.uint8)] * 3
    with pytest.raises(
        CalibrationError, match=r"left: a checkerboard of 4 x 5 inner corners .* none of 3 frames.*INNER"
    ):
        detect(in_memory(blank), BOARD, name="left")
    with pytest.raises(CalibrationError, match="workers is 0"):
        detect(in_memory(blank), BOARD, workers=0)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_damaged_image_is_named(folder: Path, workers: int) -> None:
    (folder / f"{FIRST_NS + 9}.png").write_bytes(b"not a png")
    with pytest.raises(CalibrationError, match=r"009\.png: not a readable image"):
        detect(load_frames(folder), BOARD, workers=workers)


def test_scripts_need_no_main_guard(folder: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import jaxcal\n"
        "from jaxcal.recording import load_frames\n"
        f"found = jaxcal.detect(load_frames({str(folder)!r}), jaxcal.Checkerboard(4, 5, 0.06), workers=2)\n"
        "print(len(found))\n"
    )
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False)
    assert run.stdout.split() == [str((NUM - 1) * 20)]
    assert run.stderr == ""


def test_the_public_name() -> None:
    assert detect is detect_function
