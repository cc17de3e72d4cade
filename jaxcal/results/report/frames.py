"""A few frames of a camera with the detected corners drawn on them, as SVG over a small JPEG."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.observations import Frames
from jaxcal.results.calibration import CameraCalibration
from jaxcal.results.report.camera_figures import frame_rms

_SHOWN = 6
_PIXELS_ACROSS = 480
_JPEG_QUALITY = 72


@dataclass(frozen=True)
class FramePicture:
    """One frame: the SVG's content over (width, height) of the original image, and what to say below it."""

    width: int
    height: int
    jpeg_base64: str
    used: tuple[tuple[float, float], ...]
    rejected: tuple[tuple[float, float], ...]
    radius: float
    caption: str


def frame_pictures(camera: CameraCalibration, frames: Frames) -> list[FramePicture]:
    """Up to six frames spread over the recording, the one with the largest error among them.

    Frames are found by their timestamps; those that `frames` does not hold are left out. Raises CalibrationError when
    an image is not a grey or colour picture of the camera's size.
    """
    return [_picture(camera, frames, *chosen) for chosen in _choose(camera, frames)]


def _choose(camera: CameraCalibration, frames: Frames) -> list[tuple[int, int, float, bool]]:
    """(frame of the detections, index into the images, rms, whether it is the worst), in order of time."""
    image_of = {int(time): index for index, time in enumerate(frames.timestamps_ns)}
    seen, rms = frame_rms(camera)
    pairs = [
        (int(frame), image_of[int(camera.detections.timestamps_ns[frame])], float(error))
        for frame, error in zip(seen, rms, strict=True)
        if int(camera.detections.timestamps_ns[frame]) in image_of
    ]
    if not pairs:
        return []
    worst = max(range(len(pairs)), key=lambda k: pairs[k][2])
    spread = np.linspace(0, len(pairs) - 1, min(_SHOWN, len(pairs))).round().astype(int).tolist()
    if worst not in spread:
        nearest = min(range(len(spread)), key=lambda k: abs(spread[k] - worst))
        spread[nearest] = worst
    return [(*pairs[k], k == worst) for k in sorted(spread)]


def _picture(
    camera: CameraCalibration, frames: Frames, frame: int, index: int, rms: float, worst: bool
) -> FramePicture:
    detections = camera.detections
    mine = detections.frame == frame
    width, height = camera.image_size
    seconds = (detections.timestamps_ns[frame] - detections.timestamps_ns[0]) * 1e-9
    caption = f"{seconds:.2f} s: {rms:.2f} px rms, {int((mine & camera.used).sum())} corners"
    rejected = detections.pixels[mine & ~camera.inlier]
    if len(rejected):
        caption += f", {len(rejected)} rejected"
    return FramePicture(
        width=width,
        height=height,
        jpeg_base64=_jpeg(frames.images[index], camera, index),
        used=_points(detections.pixels[mine & camera.used]),
        rejected=_points(rejected),
        radius=round(width / 160.0, 2),
        caption=f"Worst frame, {caption}" if worst else caption,
    )


def _jpeg(image: np.ndarray, camera: CameraCalibration, index: int) -> str:
    width, height = camera.image_size
    image = np.asarray(image)
    if image.shape[:2] != (height, width) or image.dtype != np.uint8:
        raise CalibrationError(
            f"report: image {index} of {camera.name} is {image.dtype} of shape {image.shape}; expected uint8 of "
            f"{height} x {width} (rows x columns). Give the images the corners were detected in."
        )
    across = min(width, _PIXELS_ACROSS)
    small = cv2.resize(image, (across, max(1, round(height * across / width))), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise CalibrationError(f"report: image {index} of {camera.name} could not be compressed.")
    return base64.b64encode(data.tobytes()).decode()


def _points(pixels: np.ndarray) -> tuple[tuple[float, float], ...]:
    return tuple((round(float(u), 1), round(float(v), 1)) for u, v in pixels)
