"""Frames written as recordings: an EuRoC folder of PNG files, a bag of images."""

import contextlib
import csv
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.progress import Progress, no_progress, track
from jaxcal.recording.images import listed_images

# A folder in the making that nobody has written to for so long was left by a process that was killed.
_ABANDONED_S = 600.0
_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def write_frame_folder(
    folder: Path,
    frames: Iterable[tuple[int, np.ndarray]],
    *,
    notes: Callable[[], dict[str, str]] | None = None,
    replace: bool = False,
) -> int:
    """Write frames (t_ns, uint8 (H, W) or (H, W, 3) BGR) as an EuRoC camera folder, and return their number.

    `folder` gets `data.csv` (time in ns, file name) and `data/<time in ns, 19 digits>.png`, and the text files that
    `notes` names when all frames have been drawn. It appears when it is complete: until then the files lie in a hidden
    folder beside it, which is removed where a process was killed over it. `replace`: take the place of what is there.

    Raises CalibrationError when the folder exists, holds anything and must not be replaced, or cannot be written.
    """
    if folder.exists() and not replace and (not folder.is_dir() or any(folder.iterdir())):
        raise CalibrationError(f"{folder}: exists already. Name another folder, or remove this one.")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        _sweep(folder)
        with _part(folder) as part:
            count = _write(part, frames)
            for name, text in (notes() if notes is not None else {}).items():
                (part / name).write_text(text, encoding="utf-8")
            _take_place(part, folder)
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot be written ({error}). Is the disk full?") from error
    return count


def _write(part: Path, frames: Iterable[tuple[int, np.ndarray]]) -> int:
    (part / "data").mkdir(parents=True)
    count = 0
    with (part / "data.csv").open("w", newline="") as listing:
        table = csv.writer(listing, lineterminator="\n")
        table.writerow(["#timestamp [ns]", "filename"])
        for t_ns, image in frames:
            ok, encoded = cv2.imencode(".png", image, _FAST_PNG)
            assert ok, "any 8-bit image can be encoded"
            # Nineteen digits, as times since 1970 have: names sort by time, and end in nanoseconds as Kalibr wants.
            name = f"{t_ns:019d}.png"
            (part / "data" / name).write_bytes(encoded.tobytes())
            table.writerow([t_ns, name])
            count += 1
    return count


@contextlib.contextmanager
def _part(folder: Path) -> Iterator[Path]:
    """A hidden folder beside `folder`, gone at the end."""
    part = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.part")
    try:
        yield part
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _sweep(folder: Path) -> None:
    """Remove what processes that were killed left beside `folder`."""
    for part in folder.parent.glob(f".{folder.name}.*.part"):
        with contextlib.suppress(OSError):
            newest = max(path.stat().st_mtime for path in (part, part / "data") if path.exists())
            if time.time() - newest > _ABANDONED_S:
                shutil.rmtree(part, ignore_errors=True)


def _take_place(part: Path, folder: Path) -> None:
    if folder.exists():
        old = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.part")
        os.replace(folder, old)
        os.replace(part, folder)
        shutil.rmtree(old, ignore_errors=True)
    else:
        os.replace(part, folder)


# --- bags ------------------------------------------------------------------------------------------------------------


def write_frame_bag(bag: Path, folder: Path, topic: str, *, progress: Progress = no_progress) -> int:
    """Write the images of an EuRoC folder to a bag, as sensor_msgs/Image with their times; returns their number.

    `bag` with the suffix .bag: ROS 1, as Kalibr reads it; else the folder of a ROS 2 bag (mcap). Grey images are mono8,
    others bgr8. The bag appears when it is complete, and takes the place of one that is there. Raises CalibrationError
    when the `rosbags` package is not installed or the bag cannot be written.
    """
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise CalibrationError(
            f"{bag}: bags are written by the package 'rosbags': pip install 'jaxcal[ros]'."
        ) from error
    ros1 = bag.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/Image"
    times, paths = listed_images(folder / "data.csv")
    part = bag.with_name(f".{bag.name}.{uuid.uuid4().hex}.part")
    try:
        bag.parent.mkdir(parents=True, exist_ok=True)
        if ros1:
            writer = rosbag1.Writer(part)
        else:
            writer = rosbag2.Writer(part, version=8, storage_plugin=rosbag2.StoragePlugin.MCAP)
        serialise = store.serialize_ros1 if ros1 else store.serialize_cdr
        with writer:
            connection = writer.add_connection(topic, kind, typestore=store)
            rows = zip(times, paths, strict=True)
            for number, (t_ns, path) in enumerate(track(rows, f"write {bag.name}", len(times), progress)):
                message = _image_message(store, path, t_ns, number if ros1 else None)
                writer.write(connection, t_ns, serialise(message, kind))
        if bag.is_dir():
            shutil.rmtree(bag)
        os.replace(part, bag)
    except (OSError, rosbag1.WriterError, rosbag2.WriterError) as error:
        raise CalibrationError(
            f"{bag}: cannot be written ({error}). Is the disk full, or the topic no name?"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True) if part.is_dir() else part.unlink(missing_ok=True)
    return len(times)


def _image_message(store, path: Path, t_ns: int, sequence: int | None):
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise CalibrationError(f"{path}: the image cannot be read. Reconstruct again.")
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=t_ns // 1_000_000_000, nanosec=t_ns % 1_000_000_000)
    number = {} if sequence is None else {"seq": sequence}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **number)
    return types["sensor_msgs/msg/Image"](
        header=header,
        height=image.shape[0],
        width=image.shape[1],
        encoding="mono8" if image.ndim == 2 else "bgr8",
        is_bigendian=0,
        step=image.shape[1] * (1 if image.ndim == 2 else 3),
        data=image.reshape(-1),
    )
