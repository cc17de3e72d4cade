"""Images with times: from EuRoC/ASL folders, from files named by their time or by a number, from bags."""

import csv
import glob
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Frames
from jaxcal.recording.bag_images import load_bag_frames
from jaxcal.recording.bags import is_bag
from jaxcal.recording.places import split_place
from jaxcal.recording.yaml_files import located

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")
_EXPECTED = (
    "Expected an EuRoC/ASL folder (data.csv beside data/), image files named by their time in ns or with a number in "
    "each name, a pattern of such names (left*.png), or a bag: FILE.bag:/cam0/image_raw."
)
# Images that carry no time but a number are taken this far apart.
_STEP_NS = 100_000_000
_LEAST_TIME_NS = 10**12  # a number as large is a time
_LEAST_NAME_NS = 10**6  # where names are numbers and nothing else, one as large is: recordings may begin at zero


@dataclass(frozen=True)
class ImageFiles:
    """Grey images by index, read from their files when asked for; holds only paths, so it is cheap to send around.

    `paths` one file each; `image_size` (width, height) that each must have. Raises CalibrationError on reading a
    missing or damaged file or one of another size.
    """

    paths: tuple[Path, ...]
    image_size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        path = self.paths[index]
        image = read_grey(path)
        height, width = image.shape
        if (width, height) != self.image_size:
            raise CalibrationError(
                f"{path}: the image is {width}x{height} pixels, but the first one of this camera is "
                f"{self.image_size[0]}x{self.image_size[1]}. All images of a camera must have one size."
            )
        return image

    def fingerprint(self) -> str:
        """A text that changes when any of the files does: names, sizes and times of modification."""
        facts = [(path.name, path.stat()) for path in self.paths]
        return "\n".join(f"{name} {stat.st_size} {stat.st_mtime_ns}" for name, stat in facts)


def read_grey(path: Path) -> np.ndarray:
    """A grey uint8 image (H, W) from a file, as stored (a camera's rotation tag is ignored: pixels are what counts).

    Raises CalibrationError when the file is missing or cannot be decoded.
    """
    try:
        encoded = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise CalibrationError(f"{path}: the image cannot be read ({error.strerror}). Copy it again.") from error
    image = None
    if encoded.size:
        try:
            image = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:
            image = None
    if image is None:
        raise CalibrationError(
            f"{path}: not a readable image ({encoded.size} bytes). It is truncated or damaged: copy it again, or "
            "remove it and its line in data.csv."
        )
    return image


def load_frames(folder: str | Path) -> Frames:
    """The images of one camera with their times, read lazily.

    `folder` is an EuRoC/ASL camera folder (`data.csv` with lines 'time in ns, file name', and `data/`), a bare folder
    of images named `<time in ns>.png`, or a bag of ROS 1, ROS 2 or mcap: `FILE.bag:/cam0/image_raw`, where the topic
    may be left out if only one has images. Or it is a folder of numbered images (`left01.jpg`), or a pattern of their
    names, `calib/left*.jpg`: the last number in each name stands for its time, in nanoseconds where it is as large as
    that, else in steps of 0.1 s. Raises CalibrationError when there are no images, a file that data.csv names is
    missing, a name has no number, or times do not increase.
    """
    if is_pattern(folder):
        return _numbered(str(folder))
    folder, topic = split_place(folder)
    if is_bag(folder):
        return load_bag_frames(folder, topic)
    if topic is not None and folder.exists():
        raise CalibrationError(f"{folder}: '{topic}' names a topic, but this is no bag. {_EXPECTED}")
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: no such image folder. {_EXPECTED}")
    listing = folder / "data.csv"
    times, paths = listed_images(listing) if listing.is_file() else _named_by_time(folder)
    first = read_grey(paths[0])
    image_size = (first.shape[1], first.shape[0])
    with located(str(folder)):
        return Frames(np.array(times, dtype=np.int64), ImageFiles(tuple(paths), image_size), image_size)


def is_pattern(path: str | Path) -> bool:
    """Whether a path is a pattern of file names, rather than the name of a file or folder."""
    return glob.has_magic(str(path)) and not split_place(path)[0].exists()


def _numbered(pattern: str) -> Frames:
    found = sorted(Path(name) for name in glob.glob(pattern))
    if not found:
        raise CalibrationError(f"{pattern}: no such images. Quote the pattern, and check the folder.")
    times, paths = _by_number(found, "Give a narrower pattern.")
    height, width = read_grey(paths[0]).shape
    return Frames(np.array(times, np.int64), ImageFiles(tuple(paths), (width, height)), (width, height))


def _by_number(found: Sequence[Path], narrower: str) -> tuple[list[int], list[Path]]:
    """Times (ns) by the last number in each name, and the files in their order."""
    numbered: dict[int, Path] = {}
    for path in found:
        digits = re.findall(r"\d+", path.stem)
        if not digits:
            raise CalibrationError(f"{path}: no number in the name; images of one moment are matched by it. Rename it.")
        number = int(digits[-1])
        if number in numbered:
            raise CalibrationError(f"{path}: has the number of {numbered[number]}. {narrower}")
        numbered[number] = path
    numbers = sorted(numbered)
    step = 1 if numbers[-1] >= _LEAST_TIME_NS else _STEP_NS
    return [number * step for number in numbers], [numbered[number] for number in numbers]


def listed_images(listing: Path) -> tuple[list[int], list[Path]]:
    """The times (ns) and files that an EuRoC `data.csv` names; CalibrationError where one is missing."""
    folder = listing.parent / "data"
    present = {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()
    times: list[int] = []
    paths: list[Path] = []
    with listing.open(newline="", encoding="utf-8") as file:
        for number, row in enumerate(csv.reader(file), start=1):
            if not row or row[0].lstrip().startswith("#") or (number == 1 and not row[0].strip().isdigit()):
                continue
            if len(row) < 2 or not row[0].strip().isdigit():
                raise CalibrationError(
                    f"{listing}: line {number} is '{','.join(row)}'; expected 'time in whole ns,file name'."
                )
            name = row[1].strip()
            if name not in present:
                raise CalibrationError(
                    f"{folder / name}: no such image, but line {number} of {listing} names it. Copy the recording "
                    "again, or remove the line."
                )
            times.append(int(row[0]))
            paths.append(folder / name)
    if not paths:
        raise CalibrationError(f"{listing}: no images are listed. {_EXPECTED}")
    return times, paths


def _named_by_time(folder: Path) -> tuple[list[int], list[Path]]:
    data = folder / "data"
    source = data if data.is_dir() else folder
    found = [path for path in source.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    if not found:
        raise CalibrationError(f"{folder}: there are no images in this folder. {_EXPECTED}")
    times = {path: int(path.stem) for path in found if path.stem.isdigit()}
    if len(times) < len(found) or max(times.values()) < _LEAST_NAME_NS:
        return _by_number(sorted(found), f"Give a pattern that names the images of one camera: {source}/left*.png.")
    found.sort(key=lambda path: times[path])
    return [times[path] for path in found], found
