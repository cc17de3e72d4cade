"""Image folders: both layouts, read lazily, and damage is named."""

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxcal import CalibrationError
from jaxcal.recording import load_frames

TIMES = [1_600_000_000_000_000_000 + k * 50_000_000 for k in range(4)]


def image(k: int) -> np.ndarray:
    return np.full((12, 20), 10 * k, np.uint8)


def write_euroc(folder: Path) -> Path:
    (folder / "data").mkdir(parents=True)
    for k, t in enumerate(TIMES):
        cv2.imwrite(str(folder / "data" / f"{t}.png"), image(k))
    lines = [f"{t},{t}.png\n" for t in TIMES]
    (folder / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(lines))
    return folder


def test_euroc_folder(tmp_path: Path) -> None:
    frames = load_frames(write_euroc(tmp_path / "cam0"))
    assert frames.timestamps_ns.tolist() == TIMES
    assert frames.image_size == (20, 12)
    again = pickle.loads(pickle.dumps(frames))
    assert len(pickle.dumps(frames.images)) < 2_000
    for k in range(4):
        assert np.array_equal(again.images[k], image(k))


def test_bare_folder_is_sorted_by_time_not_by_name(tmp_path: Path) -> None:
    for k, t in enumerate([9_000_000, 10_000_000, 200_000_000]):
        cv2.imwrite(str(tmp_path / f"{t}.png"), image(k))
    frames = load_frames(tmp_path)
    assert frames.timestamps_ns.tolist() == [9_000_000, 10_000_000, 200_000_000]
    assert frames.images[2][0, 0] == 20


def test_colour_images_become_grey(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), np.full((4, 6, 3), 77, np.uint8))
    grey = load_frames(tmp_path).images[0]
    assert grey.shape == (4, 6)
    assert np.all(grey == 77)


def test_damage_is_named(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "cam0")
    broken = folder / "data" / f"{TIMES[2]}.png"
    broken.write_bytes(broken.read_bytes()[:20])
    with pytest.raises(CalibrationError, match=f"{TIMES[2]}.png: not a readable image"):
        load_frames(folder).images[2]
    broken.unlink()
    with pytest.raises(CalibrationError, match=rf"{TIMES[2]}.png: no such image, but line 4"):
        load_frames(folder)


def test_folders_that_are_no_recording(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="no such image folder"):
        load_frames(tmp_path / "absent")
    with pytest.raises(CalibrationError, match="no images in this folder"):
        load_frames(tmp_path)
    cv2.imwrite(str(tmp_path / "left.png"), image(1))
    with pytest.raises(CalibrationError, match=r"left.png: no number in the name"):
        load_frames(tmp_path)


@pytest.mark.parametrize("names", [["1.png", "02.png", "10.png"], ["b_1.png", "a_2.png", "a_10.png"]])
def test_numbered_images_in_a_folder_are_a_tenth_of_a_second_apart(tmp_path: Path, names: list[str]) -> None:
    for grey, name in enumerate(names):
        cv2.imwrite(str(tmp_path / name), np.full((4, 6), grey, np.uint8))
    frames = load_frames(tmp_path)
    np.testing.assert_array_equal(frames.timestamps_ns, [100_000_000, 200_000_000, 1_000_000_000])
    assert [int(frames.images[k][0, 0]) for k in range(3)] == [0, 1, 2]
    cv2.imwrite(str(tmp_path / "c_2.png"), image(1))
    with pytest.raises(CalibrationError, match=r"has the number of .*2.png. Give a pattern that names the images"):
        load_frames(tmp_path)


def test_names_that_are_times_may_begin_at_zero(tmp_path: Path) -> None:
    for time in (0, 33_000_000, 66_000_000):
        cv2.imwrite(str(tmp_path / f"{time}.png"), image(1))
    np.testing.assert_array_equal(load_frames(tmp_path).timestamps_ns, [0, 33_000_000, 66_000_000])


def test_listing_errors(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "cam0")
    listing = folder / "data.csv"
    good = listing.read_text()
    listing.write_text(good + "1.6e18,x.png\n")
    with pytest.raises(CalibrationError, match=r"line 6 is '1.6e18,x.png'"):
        load_frames(folder)
    listing.write_text(good + good.splitlines()[-1] + "\n")
    with pytest.raises(CalibrationError, match=r"cam0: Frames: timestamp 4 .* duplicate"):
        load_frames(folder)
    listing.write_text("#timestamp [ns],filename\n")
    with pytest.raises(CalibrationError, match="no images are listed"):
        load_frames(folder)


def test_all_images_have_one_size(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((4, 6), np.uint8))
    cv2.imwrite(str(tmp_path / "2.png"), np.zeros((6, 4), np.uint8))
    frames = load_frames(tmp_path)
    with pytest.raises(CalibrationError, match=r"2.png: the image is 4x6 .* 6x4"):
        frames.images[1]
