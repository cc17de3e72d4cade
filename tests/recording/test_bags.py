"""Bags of ROS 1 and ROS 2 (sqlite and mcap), written by another library: events, images, IMU."""

import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from event_encoders import Stream, evt3, libcaer_cmp, stream
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from jaxcal import CalibrationError, ImuNoise, load_imu, load_rig
from jaxcal.recording import EventFile, RigCamera, load_frames
from jaxcal.recording.formats import rosbag as rosbag_module

KINDS = ("ros1", "sqlite", "mcap")
T0_NS = 1_700_000_000_123_456_000
NOISE = ImuNoise(1e-3, 1e-4, 1e-2, 1e-3)

EVENT_ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"
EVENT = "uint16 x\nuint16 y\ntime ts\nbool polarity\n"
PACKET = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""


def typestore(kind: str) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    stamp = EVENT if kind == "ros1" else EVENT.replace("time ts", "builtin_interfaces/Time ts")
    for text, name in (
        (stamp, "dvs_msgs/msg/Event"),
        (EVENT_ARRAY, "dvs_msgs/msg/EventArray"),
        (PACKET, "event_camera_msgs/msg/EventPacket"),
    ):
        store.register(get_types_from_msg(text, name))
    return store


class BagWriter:
    """Writes messages of either ROS; times are nanoseconds."""

    def __init__(self, kind: str, writer: Any) -> None:
        self.store, self._kind, self._writer = typestore(kind), kind, writer
        self._connections: dict[str, Any] = {}

    def make(self, name: str, **fields: Any) -> Any:
        return self.store.types[name](**fields)

    def stamp(self, t_ns: int) -> Any:
        return self.make("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)

    def header(self, t_ns: int) -> Any:
        extra = {"seq": 7} if self._kind == "ros1" else {}
        return self.make("std_msgs/msg/Header", stamp=self.stamp(t_ns), frame_id="cam", **extra)

    def write(self, topic: str, t_ns: int, message: Any) -> None:
        name = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self._kind == "ros1" else self.store.serialize_cdr
        self._writer.write(self._connections[topic], t_ns, serialize(message, name))


@contextmanager
def bag_writer(path: Path, kind: str) -> Iterator[BagWriter]:
    if kind == "ros1":
        with rosbag1.Writer(path) as writer:
            yield BagWriter(kind, writer)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
            yield BagWriter(kind, writer)


def bag_path(folder: Path, kind: str) -> Path:
    return folder / ("drive.bag" if kind == "ros1" else "drive")


def write_arrays(bag: BagWriter, events: Stream, sizes: list[int]) -> None:
    start = 0
    for size in sizes:
        part = events.rows()[start : start + size]
        listed = [
            bag.make("dvs_msgs/msg/Event", x=x, y=y, ts=bag.stamp(T0_NS + t * 1000 + 1), polarity=bool(p))
            for t, x, y, p in part
        ]
        at = T0_NS + (part[-1][0] * 1000 if part else 0)
        message = bag.make("dvs_msgs/msg/EventArray", header=bag.header(at), height=48, width=64, events=listed)
        bag.write("/dvs/events", at, message)
        start += size


def write_packets(bag: BagWriter, events: Stream, sequence: list[int], encoding: str = "evt3") -> None:
    content = np.frombuffer(evt3(events), np.uint8)
    cuts = np.arange(len(sequence) + 1) * (len(content) // 2 // len(sequence) * 2)
    cuts[-1] = len(content)
    for k, number in enumerate(sequence):
        message = bag.make(
            "event_camera_msgs/msg/EventPacket",
            header=bag.header(T0_NS + k * 1000),
            height=48,
            width=64,
            seq=number,
            time_base=0,
            encoding=encoding,
            is_bigendian=False,
            events=content[cuts[k] : cuts[k + 1]],
        )
        bag.write("/event_camera/events", T0_NS + k * 1000, message)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("block", [1, 10**6])
def test_arrays_of_events(tmp_path: Path, kind: str, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rosbag_module, "_EVENTS_PER_BLOCK", block)
    events = stream(np.sort(np.random.default_rng(3).integers(0, 50_000, 107)))
    path = bag_path(tmp_path, kind)
    with bag_writer(path, kind) as bag:
        write_arrays(bag, events, [1, 2, 0, 3, 1, 100])
    t_ns = T0_NS + events.t * 1000 + 1
    with EventFile(path) as file:
        assert file.size == (64, 48)
        pieces = list(file.chunks())
        for name, expected in (("t_ns", t_ns), ("x", events.x), ("y", events.y), ("p", events.p)):
            assert np.array_equal(np.concatenate([getattr(piece, name) for piece in pieces]), expected)
        middle = int(t_ns[60])
        assert np.array_equal(
            file.window(middle, middle + 10**7).x, events.x[(t_ns >= middle) & (t_ns < middle + 10**7)]
        )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("block", [1, 10**6])
def test_packets_of_encoded_events(tmp_path: Path, kind: str, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rosbag_module, "_EVENTS_PER_BLOCK", block)
    events = stream(np.sort(np.random.default_rng(4).integers(500, 50_000, 300)))
    path = bag_path(tmp_path, kind)
    with bag_writer(path, kind) as bag:
        write_packets(bag, events, [3, 4, 7, 8])
    with EventFile(f"{path}:/event_camera/events") as file:
        pieces = list(file.chunks())
        times = np.concatenate([piece.t_ns for piece in pieces])
        assert np.array_equal(times, T0_NS + (events.t - events.t[0]) * 1000)  # the first one at its packet's time
        assert np.array_equal(np.concatenate([piece.x for piece in pieces]), events.x)
        assert "2 packets of events are missing" in file.remarks()[-1]


@pytest.mark.parametrize("kind", KINDS)
def test_packets_of_inivation_cameras(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(6)
    rows = stream(np.sort(rng.integers(0, 90_000, 300)))
    events = Stream(rows.t, rows.y, rows.x, rows.p)  # runs along columns: a sensor of 48x64
    path = bag_path(tmp_path, kind)
    with bag_writer(path, kind) as bag:
        for k, part in enumerate((slice(0, 120), slice(120, 300))):
            some = Stream(events.t[part], events.x[part], events.y[part], events.p[part])
            at = T0_NS + int(some.t[0] - events.t[0]) * 1000
            content = np.frombuffer(libcaer_cmp(some), np.uint8)
            fields = {"height": 64, "width": 48, "encoding": "libcaer_cmp", "is_bigendian": False, "events": content}
            fields |= {"seq": k, "time_base": 1_700_000_000_000_000_000 + int(some.t[0]) * 1000}
            bag.write("/dvs", at, bag.make("event_camera_msgs/msg/EventPacket", header=bag.header(at), **fields))
    with EventFile(path) as file:
        found = file.window(0, 2**62)
    assert np.array_equal(found.t_ns, T0_NS + (events.t - events.t[0]) * 1000)
    for name in ("x", "y", "p"):
        assert np.array_equal(getattr(found, name), getattr(events, name))


def test_choice_of_topics(tmp_path: Path) -> None:
    path = bag_path(tmp_path, "ros1")
    events = stream(np.arange(100) * 10)
    with bag_writer(path, "ros1") as bag:
        write_arrays(bag, events, [100])
        write_packets(bag, events, [1], encoding="libcaer")
    with pytest.raises(CalibrationError, match=r"2 topics with events. Say which: .*drive.bag:/dvs/events or .*/event"):
        EventFile(path)
    with pytest.raises(
        CalibrationError, match=r"no topic '/dvs' for events. The topics are: /dvs/events .dvs_msgs/msg/EventArray"
    ):
        EventFile(f"{path}:/dvs")
    with EventFile(f"{path}:dvs/events") as file:
        assert len(file) == 100
    with EventFile(f"{path}:/event_camera/events") as file, pytest.raises(CalibrationError, match="'libcaer'; known"):
        len(file)
    with pytest.raises(CalibrationError, match="there are no images in the bag; expected messages of sensor_msgs"):
        load_frames(path)
    with pytest.raises(CalibrationError, match=r"topic .* has messages of dvs_msgs.*expected sensor_msgs"):
        load_imu(NOISE, f"{path}:/dvs/events")


def test_damaged_bags_are_named(tmp_path: Path) -> None:
    path = bag_path(tmp_path, "ros1")
    with bag_writer(path, "ros1") as bag:
        write_arrays(bag, stream(np.arange(100)), [100])
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CalibrationError, match=r"drive.bag: the bag cannot be read .*rosbag reindex"):
        EventFile(path)
    (tmp_path / "text.mcap").write_text("no bag")
    with pytest.raises(CalibrationError, match=r"text.mcap: the bag cannot be read"):
        EventFile(tmp_path / "text.mcap")


@pytest.mark.parametrize("kind", ["sqlite", "mcap"])
def test_incomplete_metadata_of_a_single_file_does_no_harm(
    tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = bag_path(tmp_path, kind)
    events = stream(np.arange(100) * 10)
    with bag_writer(path, kind) as bag:
        write_arrays(bag, events, [100])
    listing = path / "metadata.yaml"
    content = yaml.safe_load(listing.read_text())
    content["rosbag2_bagfile_information"]["storage_identifier"] = ""
    listing.write_text(yaml.safe_dump(content))
    with caplog.at_level("WARNING"), EventFile(path) as file:
        assert np.array_equal(file.window(0, 2**62).x, events.x)
    assert "metadata.yaml cannot be used" in caplog.text


# --- images and IMU --------------------------------------------------------------------------------------------------

GREY = np.arange(12 * 20, dtype=np.uint8).reshape(12, 20)
COLOUR = np.random.default_rng(0).integers(0, 255, (12, 20, 3)).astype(np.uint8)


def encoded(encoding: str) -> tuple[np.ndarray, int, np.ndarray]:
    """Bytes of an image, bytes per row, and the grey image that it is."""
    grey = cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)
    if encoding == "mono8":  # with padded rows
        return np.pad(GREY, ((0, 0), (0, 5))).ravel(), 25, GREY
    if encoding == "mono16":
        return (GREY.astype("<u2") * 256 + 99).view(np.uint8).ravel(), 40, GREY
    if encoding == "bgr8":
        return COLOUR.ravel(), 60, grey
    if encoding == "rgb8":
        return COLOUR[:, :, ::-1].ravel(), 60, grey
    assert encoding == "bayer_rggb8"
    mosaic = np.empty((12, 20), np.uint8)  # a red picture: only its red pixels are bright
    mosaic[:], mosaic[::2, ::2] = 0, 200
    red = cv2.cvtColor(np.full((12, 20, 3), (0, 0, 200), np.uint8), cv2.COLOR_BGR2GRAY)
    return mosaic.ravel(), 20, red


def write_images(bag: BagWriter, topic: str, encoding: str, times: list[int]) -> np.ndarray:
    content, step, grey = encoded(encoding)
    for t_ns in times:
        message = bag.make(
            "sensor_msgs/msg/Image",
            header=bag.header(t_ns),
            height=12,
            width=20,
            encoding=encoding,
            is_bigendian=0,
            step=step,
            data=content,
        )
        bag.write(topic, T0_NS, message)  # all recorded at once: only headers tell the time
    return grey


@pytest.mark.parametrize("kind", KINDS)
def test_images(tmp_path: Path, kind: str) -> None:
    path = bag_path(tmp_path, kind)
    times = [T0_NS + k * 50_000_000 for k in range(3)]
    encodings = ("mono8", "mono16", "bgr8", "rgb8", "bayer_rggb8")
    with bag_writer(path, kind) as bag:
        expected = {encoding: write_images(bag, f"/{encoding}/image_raw", encoding, times) for encoding in encodings}
        png = np.frombuffer(cv2.imencode(".png", GREY)[1].tobytes(), np.uint8)
        for t_ns in times:
            message = bag.make("sensor_msgs/msg/CompressedImage", header=bag.header(t_ns), format="png", data=png)
            bag.write("/cam/image_raw/compressed", t_ns, message)
    for encoding, grey in expected.items():
        frames = load_frames(f"{path}:/{encoding}/image_raw")
        assert frames.timestamps_ns.tolist() == times
        assert frames.image_size == (20, 12)
        assert np.array_equal(frames.images[1], grey), encoding
    frames = pickle.loads(pickle.dumps(load_frames(f"{path}:/cam/image_raw/compressed")))
    assert np.array_equal(frames.images[2], GREY)
    assert frames.images.fingerprint() != load_frames(f"{path}:/mono8/image_raw").images.fingerprint()
    with pytest.raises(CalibrationError, match="6 topics with images"):
        load_frames(path)


def test_images_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    path = bag_path(tmp_path, "ros1")
    with bag_writer(path, "ros1") as bag:
        write_images(bag, "/same", "mono8", [T0_NS, T0_NS])
        content = {"height": 12, "width": 20, "is_bigendian": 0, "step": 20, "data": GREY.ravel()}
        for topic, change in (("/depth", {"encoding": "32FC1"}), ("/cut", {"encoding": "mono8", "height": 13})):
            message = bag.make("sensor_msgs/msg/Image", header=bag.header(T0_NS), **(content | change))
            bag.write(topic, T0_NS, message)
    with pytest.raises(CalibrationError, match=r"drive.bag: /same: Frames: timestamp 1 .* duplicate"):
        load_frames(f"{path}:/same")
    with pytest.raises(CalibrationError, match="image of /depth is encoded as '32FC1'; known here: mono8"):
        load_frames(f"{path}:/depth")
    with pytest.raises(CalibrationError, match="image of /cut has 240 bytes; 13 rows of 20"):
        load_frames(f"{path}:/cut")


def write_imu(bag: BagWriter, gyro: np.ndarray, accel: np.ndarray) -> None:
    def vector(values: np.ndarray) -> Any:
        return bag.make("geometry_msgs/msg/Vector3", x=values[0], y=values[1], z=values[2])

    for k in range(len(gyro)):
        message = bag.make(
            "sensor_msgs/msg/Imu",
            header=bag.header(T0_NS + k * 5_000_000),
            orientation=bag.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.full(9, 7.0),
            angular_velocity=vector(gyro[k]),
            angular_velocity_covariance=np.full(9, 8.0),
            linear_acceleration=vector(accel[k]),
            linear_acceleration_covariance=np.full(9, 9.0),
        )
        bag.write("/imu", T0_NS + k * 5_000_000 + 3, message)


@pytest.mark.parametrize("kind", KINDS)
def test_imu(tmp_path: Path, kind: str) -> None:
    path = bag_path(tmp_path, kind)
    gyro, accel = np.random.default_rng(2).normal(size=(2, 10, 3))
    with bag_writer(path, kind) as bag:
        write_imu(bag, gyro, accel)
    imu = load_imu(NOISE, path)
    assert np.array_equal(imu.timestamps_ns, T0_NS + np.arange(10) * 5_000_000)
    assert np.array_equal(imu.gyro_rad_s, gyro)
    assert np.array_equal(imu.accel_m_s2, accel)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_rig_of_one_bag(tmp_path: Path, kind: str) -> None:
    path = bag_path(tmp_path, kind)
    events = stream(np.arange(100) * 10)
    with bag_writer(path, kind) as bag:
        write_arrays(bag, events, [100])
        for topic in ("/cam0/image_raw", "/cam1/image_raw"):
            write_images(bag, topic, "mono8", [T0_NS, T0_NS + 1000])
        write_imu(bag, *np.zeros((2, 5, 3)))
    cameras = [
        {"name": "dvs", "model": "pinhole-radtan", "events": path.name},
        {"name": "left", "model": "pinhole-radtan", "frames": f"{path.name}:/cam0/image_raw"},
    ]
    noise = {
        "accelerometer_noise_density": 1e-2,
        "accelerometer_random_walk": 1e-3,
        "gyroscope_noise_density": 1e-3,
        "gyroscope_random_walk": 1e-4,
    }
    target = {
        "target_type": "checkerboard",
        "targetRows": 5,
        "targetCols": 6,
        "rowSpacingMeters": 0.05,
        "colSpacingMeters": 0.05,
    }
    content = {"target": target, "cameras": cameras, "imu": {"data": f"{path.name}:/imu", "noise": noise}}
    listing = tmp_path / "rig.yaml"
    listing.write_text(yaml.safe_dump(content))
    rig = load_rig(listing)
    with rig.cameras[0].open_events() as file:
        assert (len(file), file.size) == (100, (64, 48))
    assert len(rig.cameras[1].load_frames()) == 2
    assert rig.imu is not None
    assert len(rig.imu.load()) == 5
    cameras[1]["frames"] = f"absent{path.name}:/cam0/image_raw"
    listing.write_text(yaml.safe_dump(content))
    with pytest.raises(CalibrationError, match=r"cameras\[1\].frames: .*absentdrive.*does not exist"):
        load_rig(listing)


def test_events_without_a_size_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "events.npz", **{name: np.arange(3) for name in "xypt"})
    camera = RigCamera("dvs", "pinhole-radtan", events=tmp_path / "events.npz")
    with pytest.raises(CalibrationError, match=r"events.npz: .* Give 'resolution: .width, height.' for 'dvs'"):
        camera.open_events()
