"""Folders of frames appear when they are complete, whatever happens to the process that writes them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxcal import CalibrationError
from jaxcal.recording import load_frames
from jaxcal.recording.frame_writers import write_frame_folder

FRAMES = [(5_000_000 * number, np.full((4, 6), number, np.uint8)) for number in range(1, 6)]

ENDLESS = """
import itertools, sys, numpy as np
from pathlib import Path
from jaxcal.recording.frame_writers import write_frame_folder
write_frame_folder(Path(sys.argv[1]), ((t, np.zeros((4, 6), np.uint8)) for t in itertools.count(1)))
"""


def test_frames_are_read_back(tmp_path: Path) -> None:
    assert write_frame_folder(tmp_path / "frames", FRAMES, notes=lambda: {"note.txt": "hello"}) == 5
    frames = load_frames(tmp_path / "frames")
    assert frames.timestamps_ns.tolist() == [t for t, _ in FRAMES]
    assert all(np.array_equal(image, made) for image, (_, made) in zip(frames.images, FRAMES, strict=True))
    assert (tmp_path / "frames" / "note.txt").read_text() == "hello"
    assert (tmp_path / "frames" / "data" / "0000000000005000000.png").is_file()


def test_a_killed_process_leaves_no_folder_and_the_next_run_cleans_up(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    process = subprocess.Popen([sys.executable, "-c", ENDLESS, str(folder)])
    try:
        while not list(tmp_path.glob(".frames.*.part/data/*.png")):
            assert process.poll() is None
            time.sleep(0.05)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not folder.exists()
    left = list(tmp_path.iterdir())
    assert len(left) == 1
    write_frame_folder(folder, FRAMES)  # what was left may still be somebody's
    assert sorted(tmp_path.iterdir()) == sorted([folder, *left])
    for path in (left[0], left[0] / "data"):
        os.utime(path, (0, 0))
    write_frame_folder(tmp_path / "frames", FRAMES, replace=True)
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
    assert len(load_frames(folder)) == 5


def test_an_error_on_the_way_leaves_what_was_there(tmp_path: Path) -> None:
    write_frame_folder(tmp_path / "frames", FRAMES)

    def broken():
        yield FRAMES[0]
        raise CalibrationError("the recording is damaged")

    with pytest.raises(CalibrationError, match="damaged"):
        write_frame_folder(tmp_path / "frames", broken(), replace=True)
    assert len(load_frames(tmp_path / "frames")) == 5
    with pytest.raises(CalibrationError, match=r"frames: exists already"):
        write_frame_folder(tmp_path / "frames", FRAMES)
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
