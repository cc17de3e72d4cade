"""`jaxcal info` and `jaxcal convert events`."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from jaxcal.cli import main
from jaxcal.recording import EventFile

HEADER = b"% evt 2.0\n% geometry 64x48\n% end\n"


def jaxcal(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """A thousand events, one per 64 us; then a rising edge on channel 6, and half a word."""
    k = np.arange(1_000)
    words = np.stack([0x8 << 28 | k, (k % 2) << 28 | (k % 60) << 11 | k % 40], axis=1).ravel()
    path = tmp_path / "recording.raw"
    path.write_bytes(HEADER + np.append(words, 0xA << 28 | 6 << 8 | 1).astype("<u4").tobytes() + b"\1\2")
    return path


def test_help_has_examples() -> None:
    for command in ("info", "convert events"):
        result = jaxcal(*command.split(), "--help")
        assert result.exit_code == 0
        assert f"jaxcal {command} recording.raw" in result.output


def test_info_tells_what_matters(raw: Path) -> None:
    result = jaxcal("info", raw)
    assert result.exit_code == 0
    for text in (
        "Prophesee RAW EVT2, 64x48, 8.04 kB",
        "1,000 in 0.064 s; 50.0 % ON",
        "15.6 kevents/s on average",
        "gaps       none",
        "channel 6: 1 rising, 0 falling",
        "the last word is cut short (2 of 4 bytes)",
    ):
        assert text in result.output
    facts = json.loads(jaxcal("info", raw, "--json").output)["events"]
    assert (facts["count"], facts["sensor"], facts["triggers"]) == (1_000, [64, 48], {"6": {"rising": 1, "falling": 0}})


def test_info_of_a_bag_lists_its_topics(raw: Path, tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(tmp_path / "drive.bag") as writer:
        for topic, kind in (("/imu", "sensor_msgs/msg/Imu"), ("/cam0/image_raw", "sensor_msgs/msg/Image")):
            writer.add_connection(topic, kind, typestore=store)
        text = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        message = store.types["std_msgs/msg/String"](data="hello")
        writer.write(text, 5, store.serialize_ros1(message, "std_msgs/msg/String"))
    result = jaxcal("info", tmp_path / "drive.bag")
    assert result.exit_code == 0
    assert "1  std_msgs/msg/String" in result.output
    topics = json.loads(jaxcal("info", tmp_path / "drive.bag", "--json").output)["topics"]
    assert {"name": "/chatter", "kind": "std_msgs/msg/String", "count": 1} in topics
    failed = jaxcal("info", f"{tmp_path / 'drive.bag'}:/chatter")
    assert failed.exit_code == 1
    assert "expected dvs_msgs/msg/EventArray" in failed.output


def test_convert_there_and_back(raw: Path, tmp_path: Path) -> None:
    for source, out in (("recording.raw", "a.h5"), ("a.h5", "b.csv"), ("b.csv", "c.npz"), ("c.npz", "d.txt")):
        result = jaxcal("convert", "events", tmp_path / source, tmp_path / out)
        assert result.exit_code == 0
        assert f"{out}: 1,000 events written" in result.output
        if out == "a.h5":
            assert "note: the last word is cut short" in result.output
        if source == "a.h5":
            assert "note: 1 external triggers are not kept in this format; .h5 keeps them" in result.output
    with EventFile(raw) as first, EventFile(tmp_path / "d.txt", 64, 48) as last:
        one, other = first.window(0, 10**9), last.window(0, 10**9)
    for name in ("t_ns", "x", "y", "p"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


def test_convert_sorts_on_demand(tmp_path: Path) -> None:
    source = tmp_path / "shuffled.txt"
    source.write_text("0.010 1 2 1\n0.030 2 2 0\n0.020 3 2 1\n0.040 4 2 0\n")
    failed = jaxcal("convert", "events", source, tmp_path / "out.h5")
    assert failed.exit_code == 1
    assert "time runs backwards near event 2" in failed.output
    assert "--sort" in failed.output
    assert not (tmp_path / "out.h5").exists()
    assert jaxcal("convert", "events", source, tmp_path / "out.h5", "--sort", "10").exit_code == 0
    with EventFile(tmp_path / "out.h5", 64, 48) as file:
        assert file.window(0, 10**9).x.tolist() == [1, 3, 2, 4]
    assert "2 events/s" not in jaxcal("info", source).output
    assert "time runs backwards 1 times, by 10.000 ms at most" in jaxcal("info", source).output


def test_mistakes_on_the_command_line(raw: Path, tmp_path: Path) -> None:
    same = jaxcal("convert", "events", raw, raw)
    assert (same.exit_code, "is the recording itself" in same.output) == (1, True)
    assert jaxcal("convert", "events", raw, tmp_path / "a.h5", "--resolution", "64").exit_code == 2
    wrong = jaxcal("info", raw, "--resolution", "640x480")
    assert (wrong.exit_code, "64x48 pixels, but 640x480 was given" in wrong.output) == (1, True)
    assert "error: " in jaxcal("info", tmp_path / "absent.raw").output
    folder = jaxcal("info", tmp_path)
    assert (folder.exit_code, f"`jaxcal init {tmp_path}`" in folder.output) == (1, True)
