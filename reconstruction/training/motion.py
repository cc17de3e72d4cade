"""How a board moves before the camera: smooth homographies at prescribed image speeds, with pauses."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class View:
    """What the camera sees on average.

    `width`, `height` of the image in pixels; `texels_per_pixel` at the image's middle; `focal` in pixels; `offset`
    (2,) of the principal point from the image's middle in pixels (a crop lies anywhere in the sensor); `look_at` (2,)
    texel that appears in the middle; `tilt` rotation vector (3,) of the board against the image plane; `amplitude`
    of the sideways motion in pixels.
    """

    width: int
    height: int
    texels_per_pixel: float
    focal: float
    offset: Float[np.ndarray, "2"]
    look_at: Float[np.ndarray, "2"]
    tilt: Float[np.ndarray, "3"]
    amplitude: float


class Path:
    """A closed curve of board poses, run through by the length of the image motion.

    `homographies(s)` maps texels to pixels after `s` pixels of image motion, measured at whichever of the image's
    corners and middle moves fastest, so that a step ds moves no point of the image by much more than ds.
    """

    def __init__(self, rng: np.random.Generator, view: View, length: float, wobble: float = 1.0):
        self._view = view
        self._waves = [_waves(rng) for _ in range(6)]
        self._scales = np.array([view.amplitude, view.amplitude, 0.12 * wobble, *([0.15 * wobble] * 3)])
        laps = 2.0
        while True:
            u = np.linspace(0.0, laps, int(400 * laps))
            travelled = np.concatenate([[0.0], np.cumsum(self._steps(u))])
            if travelled[-1] >= length:
                break
            laps *= 1.5
        self._u, self._travelled = u, travelled

    def homographies(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
        return self._at(np.interp(s, self._travelled, self._u))

    def swing(self, windows: int, top_speed: float, samples: int) -> Float[np.ndarray, " n"]:
        """Image motion so far, as `speed_profile` gives it, of a hand that swings: evenly along the waves that make
        the path, so that it slows down where it turns back, and moves by at most `top_speed` pixels per window."""
        steepest = (np.diff(self._travelled) / np.diff(self._u)).max()
        u = np.linspace(0.0, windows * top_speed / steepest, windows * samples + 1)
        return np.interp(u, self._u, self._travelled)

    def _at(self, u: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
        view = self._view
        offsets = self._scales[:, None] * np.stack([wave(u) for wave in self._waves])
        middle = np.array([view.width - 1, view.height - 1]) / 2
        principal = middle + view.offset
        camera = np.array([[view.focal, 0, principal[0]], [0, view.focal, principal[1]], [0, 0, 1.0]])
        depth = view.focal * view.texels_per_pixel * np.exp(offsets[2])
        pixel = np.stack([middle[0] + offsets[0], middle[1] + offsets[1], np.ones_like(u)])
        translation = (np.linalg.inv(camera) @ pixel) * depth
        rotation = (Rotation.from_rotvec(offsets[3:].T) * Rotation.from_rotvec(view.tilt)).as_matrix()
        planar = np.concatenate([rotation[:, :, :2], translation.T[:, :, None]], axis=2)
        centring = np.array([[1, 0, -view.look_at[0]], [0, 1, -view.look_at[1]], [0, 0, 1.0]])
        return camera @ planar @ centring

    def _steps(self, u: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n_less_1"]:
        """Pixels that the fastest of five image points moves between neighbours in `u`."""
        homographies = self._at(u)
        x, y = self._view.width - 1, self._view.height - 1
        points = np.array([[0, 0], [x, 0], [0, y], [x, y], [x / 2, y / 2]], dtype=np.float64)
        texels = apply_homography(np.linalg.inv(homographies[:-1]), points)
        moved = apply_homography(homographies[1:], texels)
        return np.linalg.norm(moved - points, axis=-1).max(axis=1)


def apply_homography(homographies: Float[np.ndarray, "n 3 3"], points: np.ndarray) -> Float[np.ndarray, "n m 2"]:
    """`points` (M, 2), or (N, M, 2) one set for each, mapped by each homography."""
    mapped = points @ np.swapaxes(homographies[:, :, :2], 1, 2) + homographies[:, None, :, 2]
    return mapped[..., :2] / mapped[..., 2:]


def _waves(rng: np.random.Generator):
    """A smooth wandering function of one variable, of about unit size."""
    rates, phases = rng.uniform(0.3, 1.3, 3), rng.uniform(0, 2 * np.pi, 3)
    sizes = rng.dirichlet(np.ones(3))
    return lambda u: np.sin(2 * np.pi * np.multiply.outer(u, rates) + phases) @ sizes


def speed_profile(rng: np.random.Generator, windows: int, top_speed: float, samples: int = 16) -> np.ndarray:
    """Image motion so far, in pixels, at `samples` instants per window: (windows * samples + 1,), from 0.

    The speed wanders between a quarter of `top_speed` (pixels per window) and all of it, and half the profiles stand
    still for some windows.
    """
    count = windows * samples
    knots = top_speed * rng.uniform(0.25, 1.0, windows // 3 + 2)
    speed = np.interp(np.arange(count) / samples, 3.0 * np.arange(len(knots)), knots)
    for _ in range(int(rng.integers(1, 3)) if rng.random() < 0.5 else 0):
        start, length = rng.uniform(2, windows), rng.uniform(1.5, 6)
        window = np.arange(count) / samples
        distance = np.maximum(start - window, window - start - length)  # from the pause, in windows
        speed = speed * np.clip(distance / 0.5, 0.0, 1.0)
    return np.concatenate([[0.0], np.cumsum(speed) / samples])


def lull(rng: np.random.Generator, travelled: Float[np.ndarray, " n"], samples: int) -> Float[np.ndarray, " n"]:
    """Image motion so far, slowed to a fiftieth to a fifth for 10 to 40 windows that begin in its first half."""
    windows = (len(travelled) - 1) / samples
    start, length = rng.uniform(0.1, 0.5) * windows, rng.uniform(10, 40)
    slowed = np.exp(rng.uniform(np.log(0.02), np.log(0.2)))
    window = (np.arange(len(travelled) - 1) + 0.5) / samples
    factor = np.interp(window, [start - 1.0, start, start + length, start + length + 1.0], [1.0, slowed, slowed, 1.0])
    return np.concatenate([[0.0], np.cumsum(np.diff(travelled) * factor)])
