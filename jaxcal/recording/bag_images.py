"""Images of a bag's topic, raw or compressed, read lazily as grey images with the times in their headers."""

import logging
import weakref
from pathlib import Path

import cv2
import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Frames
from jaxcal.recording.bags import Bag, Fields
from jaxcal.recording.yaml_files import located

_log = logging.getLogger(__name__)

_RAW, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (_RAW, _COMPRESSED)

# Encoding -> bytes per number, numbers per pixel, OpenCV's conversion to grey (None: it is grey).
# ROS names a Bayer pattern by its first row, OpenCV by the second one from the second column on.
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    **dict.fromkeys(("mono8", "8UC1"), (1, 1, None)),
    **dict.fromkeys(("mono16", "16UC1"), (2, 1, None)),
    **dict.fromkeys(("bgr8", "8UC3"), (1, 3, cv2.COLOR_BGR2GRAY)),
    "rgb8": (1, 3, cv2.COLOR_RGB2GRAY),
    **dict.fromkeys(("bgra8", "8UC4"), (1, 4, cv2.COLOR_BGRA2GRAY)),
    "rgba8": (1, 4, cv2.COLOR_RGBA2GRAY),
    "bgr16": (2, 3, cv2.COLOR_BGR2GRAY),
    "rgb16": (2, 3, cv2.COLOR_RGB2GRAY),
    **{
        f"bayer_{pattern}{bits}": (bits // 8, 1, conversion)
        for bits in (8, 16)
        for pattern, conversion in {
            "rggb": cv2.COLOR_BayerBG2GRAY,
            "bggr": cv2.COLOR_BayerRG2GRAY,
            "gbrg": cv2.COLOR_BayerGR2GRAY,
            "grbg": cv2.COLOR_BayerGB2GRAY,
        }.items()
    },
    **dict.fromkeys(("yuv422", "uyvy"), (1, 2, cv2.COLOR_YUV2GRAY_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (1, 2, cv2.COLOR_YUV2GRAY_YUY2)),
}


class BagImages:
    """Grey images by index, read from a bag when asked for; cheap to send to another process.

    `path` of the bag, `topic` in it, `image_size` (width, height) that each image must have. Raises CalibrationError on
    reading an image that is damaged, of an unknown encoding or of another size.
    """

    def __init__(self, path: Path, topic: str, places: np.ndarray, image_size: tuple[int, int], kind: str) -> None:
        """`places` (F, 2) int64: when each image was recorded (ns), and its number among those of the same time."""
        self.path, self.topic, self.image_size, self.kind = path, topic, image_size, kind
        self._places = places
        self._bag: Bag | None = None

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> np.ndarray:
        recorded_ns, skip = (int(value) for value in self._places[index])
        if self._bag is None:
            self._bag = Bag(self.path)
            weakref.finalize(self, self._bag.close)
        messages = self._bag.messages(self.topic, recorded_ns, recorded_ns + 1)
        content = [content for _, content in messages][skip]
        where = f"{self.path}: image {index} of {self.topic}"
        image = decode_image(self._bag.fields(content), self.kind, where)
        height, width = image.shape
        if (width, height) != self.image_size:
            raise CalibrationError(
                f"{where} is {width}x{height} pixels, but the first one is {self.image_size[0]}x{self.image_size[1]}. "
                "All images of a camera must have one size."
            )
        return image

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_bag": None}

    def fingerprint(self) -> str:
        """A text that changes when the bag does: its files' names, sizes and times of modification; and the topic."""
        files = sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]
        facts = [(file.name, file.stat()) for file in files]
        return "\n".join([self.topic, *(f"{name} {stat.st_size} {stat.st_mtime_ns}" for name, stat in facts)])


def load_bag_frames(path: Path, topic: str | None) -> Frames:
    """The images of a topic, with the times in their headers, read lazily; the only topic with images without a name.

    Where all headers are without time, the times of recording are taken, which a warning says. Raises CalibrationError
    when there is no such topic, no image, or times do not increase.
    """
    times: list[int] = []
    places: list[tuple[int, int]] = []
    with Bag(path) as bag:
        chosen = bag.choose(topic, IMAGE_TYPES, "images")
        first = None
        for recorded_ns, content in bag.messages(chosen.name):
            if first is None:
                first = decode_image(bag.fields(content), chosen.kind, f"{path}: the first image of {chosen.name}")
            times.append(bag.fields(content).header())
            same = places[-1][1] + 1 if places and places[-1][0] == recorded_ns else 0
            places.append((recorded_ns, same))
    assert first is not None, "a topic that was chosen has messages"
    if not any(times):
        _log.warning("%s: the images of %s have no time in their headers; taking when they were recorded", path, topic)
        times = [recorded_ns for recorded_ns, _ in places]
    image_size = (first.shape[1], first.shape[0])
    images = BagImages(path, chosen.name, np.array(places, np.int64), image_size, chosen.kind)
    with located(f"{path}: {chosen.name}"):
        return Frames(np.array(times, np.int64), images, image_size)


def decode_image(fields: Fields, kind: str, where: str) -> np.ndarray:
    """The grey uint8 image (H, W) in a message of sensor_msgs; 16-bit images keep their upper 8 bits."""
    fields.header()
    if kind == _COMPRESSED:
        return _decompressed(fields.text(), fields.content_bytes(), where)
    height, width = fields.number("I"), fields.number("I")
    encoding = fields.text()
    big_endian, step = fields.number("B"), fields.number("I")
    content = np.frombuffer(fields.content_bytes(), np.uint8)
    if encoding not in _ENCODINGS:
        raise CalibrationError(
            f"{where} is encoded as '{encoding}'; known here: {', '.join(_ENCODINGS)}. Convert the images."
        )
    size, channels, conversion = _ENCODINGS[encoding]
    if height * step > len(content) or width * size * channels > step:
        raise CalibrationError(
            f"{where} has {len(content)} bytes; {height} rows of {step} bytes for {width} pixels of {encoding} were "
            "expected. The bag is damaged: copy it again."
        )
    rows = content[: height * step].reshape(height, step)[:, : width * size * channels]
    if size == 2:
        rows = rows.reshape(height, -1, 2)[:, :, 0 if big_endian else 1]
    pixels = rows.reshape(height, width, channels) if channels > 1 else rows.reshape(height, width)
    pixels = np.ascontiguousarray(pixels)
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion)


def _decompressed(form: str, content: memoryview, where: str) -> np.ndarray:
    image = None
    if len(content):
        try:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:
            image = None
    if image is None:
        raise CalibrationError(
            f"{where} cannot be decoded (format '{form}', {len(content)} bytes). JPEG and PNG are known here; a depth "
            "image is none for calibration."
        )
    return image
