"""Simulated sequences: a moving board, the events it makes, and the image that each window should give."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxcal.simulation.event_sensor import EventSensor, EventSensorConfig
from reconstruction.training.motion import Path, View, apply_homography, lull, speed_profile
from reconstruction.training.patterns import Pattern, aprilgrid, charuco, checkerboard, circle_grid, picture
from reconstruction.training.recipe import DataRecipe

# What the network's output means: the pattern's black and white, with room for overshoot in 8 bits.
BLACK, WHITE = 0.05, 0.95

_PIXELS_PER_STEP = 0.4  # largest image motion between two renderings
_EDGE_ON = 0.3  # nearest over farthest depth of a plane in a crop: below this there is a horizon close by
_SUPERSAMPLING = 3  # texels per pixel, and samples per pixel along each axis


@dataclass(frozen=True)
class Window:
    """One window of a sequence.

    `t_us`, `x`, `y`, `p` its events, `duration_us` its length, `span_us` its start, the moment that its image should
    show, and its end; at that moment: `target` (H, W) float32 linear intensity from BLACK to WHITE, `corners` (N, 2)
    true pixel positions of the board's corners, `velocity` (N, 2) of theirs in pixels per second.
    """

    t_us: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray
    duration_us: float
    span_us: tuple[float, float, float]
    target: Float[np.ndarray, "height width"]
    corners: Float[np.ndarray, "n 2"]
    velocity: Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Scene:
    """A board on its way before an event camera.

    `travelled` (windows * samples + 1,) pixels of image motion so far, `samples` times per window of `window_us`
    microseconds; `blur_px` standard deviation of the lens's blur; `black_to_white` intensity of black over that of
    white; `shown_at` as `ReconstructionNetwork.shown_at`.
    """

    pattern: Pattern
    view: View
    path: Path
    travelled: Float[np.ndarray, " n"]
    samples: int
    window_us: float
    blur_px: float
    black_to_white: float
    sensor: EventSensorConfig
    shown_at: float = 1.0


def training_scene(rng: np.random.Generator, recipe: DataRecipe) -> Scene:
    """A random part of a random board that fills a crop, as the recipe says."""
    while True:
        scene = _any_training_scene(rng, recipe)
        if recipe.edge_on or _least_foreshortening(scene) > _EDGE_ON:
            return replace(scene, shown_at=recipe.shown_at)


def _any_training_scene(rng: np.random.Generator, recipe: DataRecipe) -> Scene:
    size, surround = recipe.size, recipe.size * _SUPERSAMPLING // 2
    kind = rng.random()
    if kind >= 1.0 - recipe.pictures:
        pattern = picture(rng, 5 * surround)
    elif kind < recipe.checkerboards:
        cell = int(np.exp(rng.uniform(np.log(7), np.log(34))) * _SUPERSAMPLING)
        pattern = checkerboard(rng, int(rng.integers(4, 13)), int(rng.integers(3, 10)), cell, surround)
    elif kind < recipe.checkerboards + recipe.others:
        cell = int(np.exp(rng.uniform(np.log(9), np.log(34))) * _SUPERSAMPLING)
        make = charuco if rng.random() < 0.5 else circle_grid
        pattern = make(rng, int(rng.integers(4, 10)), int(rng.integers(3, 8)), cell, surround)
    else:
        bit = int(np.exp(rng.uniform(np.log(recipe.smallest_bit_px), np.log(7.0))) * _SUPERSAMPLING)
        pattern = aprilgrid(rng, int(rng.integers(2, 5)), int(rng.integers(2, 5)), bit, surround)
    view = View(
        width=size,
        height=size,
        texels_per_pixel=float(_SUPERSAMPLING),
        focal=rng.uniform(300, 900),
        offset=rng.uniform(-1, 1, 2) * (270, 190),
        look_at=pattern.middle + rng.uniform(-0.5, 0.5, 2) * pattern.extent,
        tilt=_tilt(rng, recipe.largest_tilt_deg),
        amplitude=float(np.exp(rng.uniform(np.log(10), np.log(70)))),
    )
    top_speed = float(np.exp(rng.uniform(np.log(recipe.slowest_px), np.log(recipe.fastest_px))))
    scene = _moving(rng, pattern, view, recipe.windows, top_speed=top_speed, longest_ms=recipe.longest_window_ms)
    if recipe.swinging and rng.random() < recipe.swinging:
        scene = replace(scene, travelled=scene.path.swing(recipe.windows, top_speed, scene.samples))
    if recipe.lulls and rng.random() < recipe.lulls:
        scene = replace(scene, travelled=lull(rng, scene.travelled, scene.samples))
    return scene


def _least_foreshortening(scene: Scene) -> float:
    """How far the image keeps from the horizon of the board's plane: 1 for a board seen head-on, 0 on the horizon."""
    x, y = scene.view.width - 1, scene.view.height - 1
    corners = np.array([[0, 0, 1.0], [x, 0, 1], [0, y, 1], [x, y, 1]])
    depths = (np.linalg.inv(scene.path.homographies(scene.travelled)) @ corners.T)[:, 2]
    return float((depths.min(axis=1) / np.abs(depths).max(axis=1)).min())


def evaluation_scene(rng: np.random.Generator, windows: int, top_speed: float, shown_at: float = 1.0) -> Scene:
    """A whole 9 x 6 checkerboard, 20 pixels or more to the cell, that stays within a 384 x 288 image."""
    cell = int(rng.uniform(21, 25) * _SUPERSAMPLING)
    pattern = checkerboard(rng, 9, 6, cell, 100 * _SUPERSAMPLING)
    view = View(
        width=384,
        height=288,
        texels_per_pixel=float(_SUPERSAMPLING),
        focal=rng.uniform(450, 900),
        offset=rng.uniform(-1, 1, 2) * (120, 90),
        look_at=pattern.middle,
        tilt=_tilt(rng, 30.0),
        amplitude=30.0,
    )
    return replace(_moving(rng, pattern, view, windows, top_speed=top_speed, wobble=0.6), shown_at=shown_at)


def _tilt(rng: np.random.Generator, largest_deg: float) -> Float[np.ndarray, "3"]:
    """Any roll, then a tilt about any axis in the image plane, as one rotation vector."""
    axis = rng.uniform(0, 2 * np.pi)
    lean = np.deg2rad(largest_deg) * np.sqrt(rng.uniform(0, 1))
    tilted = Rotation.from_rotvec(lean * np.array([np.cos(axis), np.sin(axis), 0.0]))
    return (tilted * Rotation.from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)])).as_rotvec()


def _moving(
    rng: np.random.Generator,
    pattern: Pattern,
    view: View,
    windows: int,
    *,
    top_speed: float,
    wobble: float = 1.0,
    longest_ms: float = 50.0,
) -> Scene:
    samples = 16
    travelled = speed_profile(rng, windows, top_speed, samples)
    return Scene(
        pattern=pattern,
        view=view,
        path=Path(rng, view, float(travelled[-1]) + 1.0, wobble),
        travelled=travelled,
        samples=samples,
        window_us=float(np.exp(rng.uniform(np.log(10_000), np.log(1e3 * longest_ms)))),
        blur_px=rng.uniform(0.3, 1.0),
        black_to_white=float(np.exp(rng.uniform(np.log(0.03), np.log(0.15)))),
        sensor=random_sensor(rng),
    )


def random_sensor(rng: np.random.Generator) -> EventSensorConfig:
    """Thresholds, mismatch and noise over the range of real sensors and their bias settings."""
    contrast = np.exp(rng.uniform(np.log(0.1), np.log(0.5)))
    asymmetry = np.exp(rng.uniform(-0.2, 0.2))
    return EventSensorConfig(
        contrast_on=float(contrast * asymmetry),
        contrast_off=float(contrast / asymmetry),
        threshold_mismatch=rng.uniform(0.01, 0.15),
        refractory_ns=int(np.exp(rng.uniform(np.log(1e3), np.log(5e5)))),
        leak_rate_hz=rng.uniform(0.0, 0.3),
        shot_noise_rate_hz=float(np.exp(rng.uniform(np.log(0.01), np.log(3.0)))),
        hot_pixel_fraction=float(rng.choice([0.0, 2e-4])),
    )


def windows(scene: Scene, seed: int) -> Iterator[Window]:
    """The scene's windows one after the other, as an event camera would see them."""
    sensor = EventSensor(scene.view.width, scene.view.height, scene.sensor, seed)
    instants = np.arange(len(scene.travelled)) / scene.samples
    sensor.feed(0, _log_intensity(scene, _render(scene, scene.path.homographies(scene.travelled[:1])[0])))
    for index in range((len(scene.travelled) - 1) // scene.samples):
        part = slice(index * scene.samples, (index + 1) * scene.samples + 1)
        fastest = np.diff(scene.travelled[part]).max() * scene.samples
        steps = max(2, int(np.ceil(fastest / _PIXELS_PER_STEP)))
        at = index + np.union1d(np.arange(1, steps + 1) / steps, [scene.shown_at])
        homographies = scene.path.homographies(np.interp(at, instants, scene.travelled))
        yield _window(scene, sensor, at, homographies)


def _window(
    scene: Scene, sensor: EventSensor, at: Float[np.ndarray, " n"], homographies: Float[np.ndarray, "n 3 3"]
) -> Window:
    """Render and feed the images at times `at` (in windows); one is the moment that is shown, the last one the end."""
    index = round(at[-1]) - 1
    shown = int(np.argmin(np.abs(at - index - scene.shown_at)))
    events, images = [], []
    for time, homography in zip(at, homographies, strict=True):
        image = _render(scene, homography)
        images.append(image)
        events.append(sensor.feed(round(time * scene.window_us * 1e3), _log_intensity(scene, image)))
    t_ns, x, y, p = (np.concatenate(arrays) for arrays in zip(*events, strict=True))
    around = [max(shown - 1, 0), min(shown + 1, len(at) - 1)]
    before, corners, after = apply_homography(homographies[[around[0], shown, around[1]]], scene.pattern.corners)
    return Window(
        t_us=t_ns * 1e-3,
        x=x,
        y=y,
        p=p,
        duration_us=scene.window_us,
        span_us=(index * scene.window_us, at[shown] * scene.window_us, at[-1] * scene.window_us),
        target=(BLACK + (WHITE - BLACK) * images[shown]).astype(np.float32),
        corners=corners,
        velocity=(after - before) / ((at[around[1]] - at[around[0]]) * scene.window_us * 1e-6),
    )


def _render(scene: Scene, homography: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "height width"]:
    """Reflectance seen by each pixel (averaged over its area), blurred by the lens."""
    n = _SUPERSAMPLING
    # Pixel (0, 0) spans samples 0..n-1, whose middle is sample (n-1)/2.
    to_samples = np.array([[n, 0, (n - 1) / 2], [0, n, (n - 1) / 2], [0, 0, 1.0]])
    size = (scene.view.width * n, scene.view.height * n)
    fine = cv2.warpPerspective(
        scene.pattern.texture, to_samples @ homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    pixels = cv2.resize(fine, (scene.view.width, scene.view.height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(pixels, (0, 0), scene.blur_px, borderType=cv2.BORDER_REFLECT))


def _log_intensity(scene: Scene, reflectance: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    dark = scene.black_to_white
    return np.log(dark + (1.0 - dark) * reflectance).astype(np.float32)
