"""ROS 1 bags, ROS 2 bags and mcap files: topics, raw messages in order of time, and the few fields we need of them."""

import logging
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxcal.errors import CalibrationError

_log = logging.getLogger(__name__)

_SIGNATURES = (b"#ROSBAG V2.0", b"\x89MCAP0\r\n", b"SQLite format 3\0")
_SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: by suffix, by the first bytes, or a folder with ROS 2's metadata.yaml."""
    if path.is_dir():
        listing = path / _METADATA
        return listing.is_file() and b"rosbag2_bagfile_information" in listing.read_bytes()[:4096]
    if path.suffix.lower() in _SUFFIXES:
        return True
    if not path.is_file():
        return False
    return _first_bytes(path).startswith(_SIGNATURES)


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(16)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages such as 'sensor_msgs/msg/Imu', and their number."""

    name: str
    kind: str
    count: int


class Bag:
    """An open bag. Messages come as bytes; `fields` reads them. Use it as a context manager.

    Raises CalibrationError when the `rosbags` package is not installed, or the file is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader, self._errors = _open(path)

    def __enter__(self) -> "Bag":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    @property
    def ros2(self) -> bool:
        """Whether messages are serialised as ROS 2 does it (CDR)."""
        return not self._reader.__class__.__module__.startswith("rosbags.rosbag1")

    def topics(self) -> list[Topic]:
        """All topics, by name."""
        counts: dict[tuple[str, str], int] = {}
        for connection in self._reader.connections:
            key = (connection.topic, connection.msgtype)
            counts[key] = counts.get(key, 0) + connection.msgcount
        return [Topic(name, kind, count) for (name, kind), count in sorted(counts.items())]

    def choose(self, wanted: str | None, kinds: Collection[str], what: str) -> Topic:
        """The topic of that name, or the only one whose messages are of the given types.

        `what` says in errors what is looked for ("events"). Raises CalibrationError, with the topics that there are.
        """
        topics = self.topics()
        suitable = [topic for topic in topics if topic.kind in kinds and topic.count]
        named = [topic for topic in topics if topic.name in (wanted, f"/{wanted}")] if wanted is not None else suitable
        listed = ", ".join(f"{topic.name} ({topic.kind}, {topic.count})" for topic in topics) or "none"
        if wanted is not None and not named:
            instead = f" Did you mean '{suitable[0].name}'?" if len(suitable) == 1 else ""
            raise CalibrationError(
                f"{self.path}: there is no topic '{wanted}' for {what}.{instead} The topics are: {listed}."
            )
        if not named:
            raise CalibrationError(
                f"{self.path}: there are no {what} in the bag; expected messages of {' or '.join(kinds)}. The topics "
                f"are: {listed}."
            )
        if len(named) > 1:
            choices = " or ".join(f"{self.path}:{topic.name}" for topic in named)
            raise CalibrationError(f"{self.path}: there are {len(named)} topics with {what}. Say which: {choices}.")
        topic = named[0]
        if topic.kind not in kinds:
            raise CalibrationError(
                f"{self.path}: topic '{topic.name}' has messages of {topic.kind}; expected {' or '.join(kinds)} for "
                f"{what}. The topics are: {listed}."
            )
        if not topic.count:
            raise CalibrationError(f"{self.path}: topic '{topic.name}' has no messages. Was the sensor switched on?")
        return topic

    def messages(
        self, topic: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[int, bytes]]:
        """The messages of a topic that were recorded at start_ns <= t < stop_ns, as (time, bytes), in order of time.

        The time is that of recording, by the recorder's clock.
        """
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        try:
            for _, time_ns, content in self._reader.messages(connections, start=start_ns, stop=stop_ns):
                yield time_ns, content
        except self._errors as error:
            raise _damaged(self.path, error) from error

    def fields(self, content: bytes) -> "Fields":
        """A cursor at the start of a message."""
        return Fields(self.path, content, self.ros2)


class Fields:
    """Reads the fields of one serialised message one after the other: of ROS 1, or of ROS 2 (CDR).

    CDR aligns each number to its size, counted from behind its 4-byte preamble; texts end with a zero byte.
    """

    def __init__(self, path: Path, content: bytes, ros2: bool) -> None:
        self.content = content
        self._path, self._ros2 = path, ros2
        self._origin = 4 if ros2 else 0
        self.place = self._origin
        self.order = "<"
        if ros2:
            if len(content) < 4 or content[1] not in (0, 1):
                raise self._cut()
            self.order = "<" if content[1] else ">"

    def number(self, code: str) -> Any:
        """The next number, by its `struct` code."""
        size = struct.calcsize(code)
        self._align(size)
        try:
            (value,) = struct.unpack_from(self.order + code, self.content, self.place)
        except struct.error as error:
            raise self._cut() from error
        self.place += size
        return value

    def numbers(self, code: str, count: int) -> tuple[Any, ...]:
        """The next `count` numbers of one kind."""
        return tuple(self.number(code) for _ in range(count))

    def text(self) -> str:
        """The next text."""
        return bytes(self.content_bytes()).rstrip(b"\0").decode("utf-8", "replace")

    def content_bytes(self) -> memoryview:
        """The next sequence of bytes."""
        size = self.number("I")
        if self.place + size > len(self.content):
            raise self._cut()
        part = memoryview(self.content)[self.place : self.place + size]
        self.place += size
        return part

    def header(self) -> int:
        """The next std_msgs/Header; gives its time stamp in nanoseconds."""
        if not self._ros2:
            self.number("I")  # a sequence number
        seconds, nanoseconds = self.number("i" if self._ros2 else "I"), self.number("I")
        self.text()
        return seconds * 1_000_000_000 + nanoseconds

    def _align(self, size: int) -> None:
        if self._ros2:
            self.place += -(self.place - self._origin) % size

    def _cut(self) -> CalibrationError:
        return CalibrationError(
            f"{self._path}: a message is shorter than its type. The bag is damaged, or was recorded with another "
            "definition of the message: record or convert it again."
        )


def _open(path: Path) -> tuple[Any, tuple[type[Exception], ...]]:
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise CalibrationError(f"{path}: bags are read by the package 'rosbags': pip install 'jaxcal[ros]'.") from error
    if not path.exists():
        raise CalibrationError(f"{path}: no such bag.")
    errors = (rosbag1.ReaderError, rosbag2.ReaderError, OSError, ValueError, EOFError, KeyError)
    ros1 = not path.is_dir() and _first_bytes(path).startswith(_SIGNATURES[0])
    try:
        reader = rosbag1.Reader(path) if ros1 else rosbag2.Reader(path)
        reader.open()
    except errors as error:
        inside = [file for suffix in (".mcap", ".db3") for file in path.glob(f"*{suffix}")] if path.is_dir() else []
        if len(inside) != 1:
            raise _damaged(path, error) from error
        # Some recorders leave a metadata.yaml that is incomplete; the one file beside it tells all that it should.
        _log.warning("%s: metadata.yaml cannot be used (%s); reading %s without it", path, error, inside[0].name)
        return _open(inside[0])
    return reader, errors


def _damaged(path: Path, error: Exception) -> CalibrationError:
    remedy = "`rosbag reindex`" if path.suffix == ".bag" else "`ros2 bag reindex` or `mcap recover`"
    return CalibrationError(
        f"{path}: the bag cannot be read ({error}). If the recording was broken off, {remedy} may mend it; else copy "
        "it again."
    )
