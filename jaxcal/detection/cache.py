"""Detections on disk: found again for the same images, target and detector; kept chunk by chunk while running."""

import hashlib
import io
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from jaxcal.atomic import write_bytes
from jaxcal.detection.corners import DETECTOR_VERSION
from jaxcal.detection.worker import Corners
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections, Frames
from jaxcal.targets import Target


@runtime_checkable
class Fingerprinted(Protocol):
    """Images that can say cheaply whether they are still the same ones."""

    def fingerprint(self) -> str:
        """A text that changes with any of the images."""
        ...


def detection_key(frames: Frames, target: Target) -> str:
    """A hash of all that the detections depend on: the images and their times, the target, the detectors."""
    digest = hashlib.sha256()
    facts = [DETECTOR_VERSION, cv2.__version__, type(target).__name__, target.to_yaml(), list(frames.image_size)]
    digest.update(json.dumps(facts, sort_keys=True).encode())
    digest.update(np.ascontiguousarray(frames.timestamps_ns, dtype=np.int64).tobytes())
    if isinstance(frames.images, Fingerprinted):
        digest.update(frames.images.fingerprint().encode())
    else:
        for index in range(len(frames.images)):
            image = np.ascontiguousarray(frames.images[index])
            digest.update(f"{image.shape}{image.dtype}".encode())
            digest.update(image.tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class DetectionCache:
    """The cached detections of one camera: `<name>-<key>.detections.npz` in `folder`, its parts beside it."""

    folder: Path
    name: str
    key: str

    @property
    def path(self) -> Path:
        """The file that holds the detections once they are complete."""
        return self.folder / f"{self.name}-{self.key[:16]}.detections.npz"

    @property
    def _parts(self) -> Path:
        return self.folder / f"{self.name}-{self.key[:16]}.parts"

    def load(self) -> Detections | None:
        """The finished detections, if they are there and readable."""
        if not self.path.exists():
            return None
        try:
            return Detections.load(self.path)
        except CalibrationError:
            return None  # damaged: detected anew, and replaced

    def load_part(self, frames: tuple[int, ...]) -> Corners | None:
        """What an interrupted run found in these frames."""
        try:
            with self._part(frames).open("rb") as file, np.load(file, allow_pickle=False) as part:
                return Corners(part["frame"], part["point"], part["pixels"])
        except Exception:  # absent or damaged, which numpy reports in many ways: detected anew
            return None

    def save_part(self, frames: tuple[int, ...], corners: Corners) -> None:
        """Keep what was found in these frames until all are done."""
        content = io.BytesIO()
        np.savez(content, frame=corners.frame, point=corners.point, pixels=corners.pixels)
        write_bytes(self._part(frames), content.getvalue())

    def save(self, detections: Detections) -> None:
        """Keep the finished detections; the parts are no longer needed, nor are older ones of this camera."""
        detections.save(self.path)
        shutil.rmtree(self._parts, ignore_errors=True)
        for old in self.folder.glob(f"{self.name}-{'[0-9a-f]' * 16}.detections.npz"):
            if old != self.path:
                old.unlink(missing_ok=True)

    def _part(self, frames: tuple[int, ...]) -> Path:
        return self._parts / f"{frames[0]:06d}-{frames[-1]:06d}.npz"
