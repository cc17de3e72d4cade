"""`FILE:PLACE`: which part is the file."""

from pathlib import Path

import pytest

from jaxcal.recording.places import split_place


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    (tmp_path / "drive.bag").touch()
    return tmp_path / "drive.bag"


def test_a_topic_is_split_off(bag: Path) -> None:
    assert split_place(bag) == (bag, None)
    assert split_place(f"{bag}:/cam0/image_raw") == (bag, "/cam0/image_raw")
    assert split_place(f"{bag}:imu") == (bag, "imu")
    assert split_place(bag.parent / "drive.bag:/cam0/image_raw") == (bag, "/cam0/image_raw")


def test_colons_in_names_do_no_harm(tmp_path: Path) -> None:
    (tmp_path / "10:30:00.raw").touch()
    assert split_place(tmp_path / "10:30:00.raw") == (tmp_path / "10:30:00.raw", None)
    assert split_place(f"{tmp_path / '10:30:00.raw'}:/left") == (tmp_path / "10:30:00.raw", "/left")
    assert split_place(tmp_path / "absent 10:30.raw") == (tmp_path / "absent 10:30.raw", None)


def test_a_missing_file_is_named_without_its_topic(tmp_path: Path) -> None:
    assert split_place(f"{tmp_path}/absent.bag:/cam0/image_raw") == (tmp_path / "absent.bag", "/cam0/image_raw")
