"""How well corners are placed: jaxcal's detection beside cv2.cornerSubPix, in simulated images with known corners.

    python experiments/corner_accuracy.py               # some minutes
    python experiments/corner_accuracy.py --views 4     # does it work at all?

Three boards in random poses before two lenses, with noise of the grey levels and blur. cornerSubPix begins at the true
corners, with windows that end before the next corner, on the image smoothed as jaxcal smooths it for its own first
guess: what is compared is the last step alone.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from paper_scenes import into_readme, markdown
from scipy.spatial.transform import Rotation

from jaxcal.cameras import CameraModel, PinholeEquidistant, PinholeRadtan
from jaxcal.detection import find_corners
from jaxcal.detection.refine import refine_corners
from jaxcal.simulation.pattern import pattern_of
from jaxcal.simulation.render import blur_px, pixel_rays, plane_from_camera, render, surface_of
from jaxcal.targets import AprilGrid, Charuco, Checkerboard, Target

SIZE = (640, 480)
LENSES: dict[str, CameraModel] = {
    "radtan": PinholeRadtan.create((440.0, 440.0, 319.5, 239.5), (-0.29, 0.085, 3e-4, 2e-4)),
    "fisheye": PinholeEquidistant.create((220.0, 220.0, 319.5, 239.5), (-0.02, 0.01, -0.01, 0.003)),
}
# Each board with its distance before each lens (m).
BOARDS: dict[str, tuple[Target, dict[str, float]]] = {
    "checkerboard": (Checkerboard(rows=6, cols=9, spacing=0.04), {"radtan": 0.55, "fisheye": 0.3}),
    "AprilGrid": (AprilGrid(6, 6, 0.055, 0.3), {"radtan": 0.65, "fisheye": 0.35}),
    "ChArUco": (Charuco(7, 9, 0.04, 0.03, "DICT_4X4_50"), {"radtan": 0.55, "fisheye": 0.3}),
}
# Noise in grey levels of 255, and the lens's blur in pixels, 1-sigma.
CONDITIONS = ((0.0, 0.6), (4.0, 0.6), (15.0, 0.6), (4.0, 1.5))
SEED = 20261126


@dataclass(frozen=True)
class View:
    """An image (H, W) uint8 and the true pixels (N, 2) of all of the board's points."""

    image: np.ndarray
    pixels: np.ndarray


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=20, help="poses of each board before each lens (%(default)s)")
    parser.add_argument("--readme", action="store_true", help="write the table into the README as well")
    options = parser.parse_args()
    rows = []
    for board, (target, distances) in BOARDS.items():
        for noise, blur in CONDITIONS:
            found, errors, others = 0, [], []
            for lens, distance in distances.items():
                for view in views(target, LENSES[lens], distance, noise, blur, options.views):
                    ours, theirs = compared(view, target)
                    found += len(ours)
                    errors.append(ours)
                    others.append(theirs)
            ours, theirs = (np.linalg.norm(np.concatenate(parts), axis=1) for parts in (errors, others))
            medians = float(np.median(theirs)), float(np.median(ours))
            cells = [f"{noise:.0f}", f"{blur:.1f}", str(found), *(f"{median:.4f}" for median in medians)]
            spread = [f"{np.sqrt(np.mean(ours**2)):.4f}", f"{ours.max():.2f}"]
            rows.append([board, *cells, f"{medians[0] / medians[1]:.1f}", *spread])
            print(f"{board}, noise {noise:.0f}, blur {blur:.1f}: done", file=sys.stderr, flush=True)
    header = [
        "board",
        "noise (grey levels)",
        "blur (px)",
        "corners",
        "cornerSubPix, median (px)",
        "jaxcal, median (px)",
    ]
    table = markdown([*header, "ratio", "jaxcal, rms", "largest"], rows)
    print(table)
    if options.readme:
        into_readme("corners", table)
    return 0


def views(target: Target, model: CameraModel, distance: float, noise: float, blur: float, count: int) -> Iterator[View]:
    """The board in poses that follow from the seed alone, the same under all conditions."""
    rays, surface = pixel_rays(model, SIZE), surface_of(pattern_of(target))
    poses, grain = np.random.default_rng(SEED), np.random.default_rng(SEED + 1)
    middle = target.points.mean(axis=0)
    for _ in range(count):
        turn = Rotation.from_euler("zxy", [poses.uniform(-0.6, 0.6), *poses.uniform(-0.5, 0.5, 2)])
        R = turn.as_matrix() @ np.diag([1.0, -1.0, -1.0])
        t = np.array([*(0.1 * distance * poses.standard_normal(2)), distance * poses.uniform(0.8, 1.4)])
        T = np.block([[R, (t - R @ middle)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
        linear = render(rays, jnp.asarray(plane_from_camera(T[None])), surface, blur_px(blur))
        grey = 255.0 * np.asarray(linear).reshape(SIZE[1], SIZE[0]) + noise * grain.standard_normal(SIZE[::-1])
        pixels = np.asarray(model.project(target.points @ R.T + T[:3, 3]))
        yield View(np.clip(np.round(grey), 0, 255).astype(np.uint8), pixels)


def compared(view: View, target: Target) -> tuple[np.ndarray, np.ndarray]:
    """Errors (K, 2), px, of the corners that are found: jaxcal's, and cornerSubPix' at the same ones, but for those
    that went out of its window."""
    point, pixels = find_corners(view.image, target)
    true = view.pixels[point]
    if not len(point):
        return np.empty((0, 2)), np.empty((0, 2))
    theirs, trusted = refine_corners(view.image, true, _half_windows(view, target, point))
    return (pixels - true)[trusted], (theirs - true)[trusted]


def _half_windows(view: View, target: Target, point: np.ndarray) -> np.ndarray:
    """Half-widths (K,) of windows that end before the pattern changes."""
    distance = np.linalg.norm(view.pixels[point][:, None] - view.pixels, axis=2)
    distance[np.arange(len(point)), point] = np.inf
    nearest = distance.min(axis=1)
    if isinstance(target, Charuco):
        nearest *= 0.5 * (1.0 - target.marker_size / target.square_size) / 0.4
    return np.clip(np.floor(0.4 * nearest), 2, 9).astype(np.int64)


if __name__ == "__main__":
    sys.exit(main())
