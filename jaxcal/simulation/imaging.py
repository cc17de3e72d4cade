"""What the cameras of a rig record: streams of events, and frames."""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from jaxcal.simulation.event_sensor import EventArrays, EventSensor
from jaxcal.simulation.measurements import T_cam_target, project_points
from jaxcal.simulation.pattern import Pattern, pattern_of
from jaxcal.simulation.render import (
    blur_px,
    near_edges,
    pixel_rays,
    plane_from_camera,
    render,
    render_some,
    surface_of,
)
from jaxcal.simulation.rig import SimulatedCamera, SimulatedRig

# Purposes of the rig's random generators.
_EVENTS, _FRAMES = 13, 14

# Images rendered in one call around one choice of pixels near edges.
_BATCH = 4
# Pixel lists are padded to whole multiples of this, so that few shapes are compiled.
_PADDING = 1 << 13
# Beyond this many standard deviations of blur from an edge a pixel is of one colour.
_BLUR_REACH = 3.3
_TIME_GRID_S = 4e-3
_SPEED_STEP_S = 1e-3


class _Scene:
    """One camera looking at the rig's target: renders it at any time, all pixels or those near edges."""

    def __init__(self, rig: SimulatedRig, camera: SimulatedCamera):
        self._rig, self._camera = rig, camera
        self._rays = pixel_rays(camera.model, camera.image_size)
        self._surface = surface_of(pattern_of(rig.target))
        self._blur = blur_px(rig.imaging.psf_sigma_px)

    def matrices(self, motion_time_s: np.ndarray) -> np.ndarray:
        """Plane-from-camera matrices (K, 3, 3) at times of the motion (K,)."""
        return plane_from_camera(T_cam_target(self._rig, self._camera, motion_time_s))

    def whole(self, matrix: np.ndarray) -> np.ndarray:
        """Linear intensity (H, W) float32 for one matrix (3, 3)."""
        width, height = self._camera.image_size
        image = render(self._rays, jnp.asarray(matrix[None]), self._surface, self._blur)
        return np.array(image[0]).reshape(height, width)

    def near_edges(self, matrices: np.ndarray, motion_px: float) -> tuple[np.ndarray, np.ndarray]:
        """Flat indices (M,) of pixels near the pattern's edges, and their intensities (K, M) for matrices (K, 3, 3).

        `motion_px` bounds how far anything moves from the middle one of the matrices to any other one.
        """
        band = _BLUR_REACH * self._blur + motion_px
        close = near_edges(self._rays, jnp.asarray(matrices[len(matrices) // 2]), self._surface, band)
        chosen = np.flatnonzero(np.asarray(close))
        padded = np.zeros(max(1, -(-len(chosen) // _PADDING)) * _PADDING, dtype=np.int32)
        padded[: len(chosen)] = chosen
        values = render_some(self._rays, jnp.asarray(padded), jnp.asarray(matrices), self._surface, self._blur)
        return chosen, np.asarray(values)[:, : len(chosen)]


def simulate_events(rig: SimulatedRig, index: int) -> Iterator[tuple[float, EventArrays]]:
    """The events of camera `index`, in order of time, batch by batch, with the share of the duration that is done.

    Timestamps are int64 ns on the camera's own clock. Memory stays bounded: nothing is kept between batches but the
    sensor's state.
    """
    camera, scene = rig.cameras[index], _Scene(rig, rig.cameras[index])
    times = render_times(rig, camera)
    matrices = scene.matrices(times)
    times_ns = rig.camera_time_ns(camera, times)
    seed = int(rig.generator(_EVENTS, index).integers(2**63))
    sensor = EventSensor(*camera.image_size, rig.imaging.event_sensor, seed)
    log_image = np.log(scene.whole(matrices[0]))
    sensor.feed(int(times_ns[0]), log_image)
    flat = log_image.reshape(-1)
    for first in range(1, len(times), _BATCH):
        # The last batch is filled up by repetition, to keep its shape; the repeated images are not fed.
        steps = np.minimum(np.arange(first, first + _BATCH), len(times) - 1)
        chosen, intensities = scene.near_edges(matrices[steps], (_BATCH // 2) * rig.imaging.step_px)
        logs = np.log(intensities)
        parts = []
        for step, log in zip(range(first, min(first + _BATCH, len(times))), logs, strict=False):
            flat[chosen] = log
            parts.append(sensor.feed(int(times_ns[step]), log_image))
        t, x, y, p = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        yield min(first + _BATCH, len(times)) / len(times), (t, x, y, p)


def render_times(rig: SimulatedRig, camera: SimulatedCamera) -> np.ndarray:
    """Times of the motion (K,), seconds, between which the target moves by at most `imaging.step_px` in the image."""
    grid, speed = _image_speed(rig, camera)
    fastest = np.maximum(speed[1:], speed[:-1])
    path = np.concatenate(
        [[0.0], np.cumsum(np.diff(grid) * np.maximum(fastest / rig.imaging.step_px, 1.0 / rig.imaging.step_s))]
    )
    return np.interp(np.linspace(0.0, path[-1], int(np.ceil(path[-1])) + 1), path, grid)


def _image_speed(rig: SimulatedRig, camera: SimulatedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Times of the motion (N,), s, and how fast the target's fastest point in view moves in the image then, px/s."""
    grid = np.linspace(0.0, rig.duration_s, int(np.ceil(rig.duration_s / _TIME_GRID_S)) + 1)
    points = jnp.asarray(_spread_points(pattern_of(rig.target)))
    ends = np.concatenate([grid - 0.5 * _SPEED_STEP_S, grid + 0.5 * _SPEED_STEP_S])
    pixels, real = project_points(camera.model, jnp.asarray(T_cam_target(rig, camera, ends)), points)
    before, after = np.split(np.asarray(pixels), 2)
    size = np.array(camera.image_size)
    seen = np.logical_and(*np.split(np.asarray(real), 2)) & np.all(
        (after > -0.1 * size) & (after < 1.1 * size), axis=-1
    )
    moved = np.linalg.norm(after - before, axis=-1) * seen
    # Some in hand: these points bound the speed of those between them, and of times between these, only nearly.
    return grid, 1.05 * moved.max(axis=1) / _SPEED_STEP_S


def _spread_points(pattern: Pattern) -> np.ndarray:
    """Points (25, 3) all over the pattern, its outline included."""
    x, y = np.meshgrid(
        np.linspace(pattern.x_lines[0], pattern.x_lines[-1], 5), np.linspace(pattern.y_lines[0], pattern.y_lines[-1], 5)
    )
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)


def simulate_frames(rig: SimulatedRig, index: int) -> Iterator[tuple[int, np.ndarray]]:
    """The frames of camera `index`: mid-exposure time in ns on the camera's own clock, and a uint8 image (H, W).

    Grey is linear in intensity: 255 is an intensity of 1.
    """
    camera, scene, imaging = rig.cameras[index], _Scene(rig, rig.cameras[index]), rig.imaging
    times_ns = rig.frame_times_ns(camera)
    middles = rig.motion_time(camera, times_ns)
    within = imaging.exposure_s * ((np.arange(imaging.exposure_samples) + 0.5) / imaging.exposure_samples - 0.5)
    whole = scene.matrices(middles)
    moving = scene.matrices((middles[:, None] + within).ravel()).reshape(len(middles), -1, 3, 3)
    motion_px = 0.5 * imaging.exposure_s * np.interp(middles, *_image_speed(rig, camera))
    for number, time_ns in enumerate(times_ns.tolist()):
        image = scene.whole(whole[number])
        if imaging.exposure_samples > 1:
            chosen, intensities = scene.near_edges(moving[number], float(motion_px[number]))
            image.reshape(-1)[chosen] = intensities.mean(axis=0)
        noise = imaging.grey_noise * rig.generator(_FRAMES, index, number).standard_normal(image.shape)
        yield time_ns, np.clip(np.round(255.0 * image + noise), 0, 255).astype(np.uint8)
