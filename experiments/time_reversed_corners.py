"""Does a reconstruction that runs backwards in time cancel the latency of one that runs forwards? A measurement.

    python experiments/time_reversed_corners.py --scenes 4 --windows 16

Corners in reconstructed images trail the events by a fraction of a millisecond: the network knows only what was. Run
over the recording from its end, with time turned round and polarity flipped, it knows only what will be, and should
lead by as much. Simulated checkerboards are reconstructed both ways up to the same moments, and corners are compared
with the truth: forwards, backwards, and the mean of the two. Nothing of jaxcal uses this: networks that show
the middle of their windows see what comes, too. patterns_v1, which shows the end, was not trained on streams that run
backwards.

What it showed (4 scenes of 16 windows, 28 boards, patterns_v1): corners trail by 0.23 ms forwards and by 0.65 ms
backwards, both behind the true motion; their mean by 0.44 ms. It does not cancel. This suggests that the lag is in the
events (a pixel fires after its threshold is crossed), that the network, trained forwards, makes up for a part of it,
and does so in the wrong direction when time is turned round.
"""

import argparse
import sys
from collections.abc import Sequence

import numpy as np

import reconstruction
from reconstruction.networks import ReconstructionNetwork
from reconstruction.training.evaluate import CornerErrors, find_corners
from reconstruction.training.sequences import Scene, Window, evaluation_scene, windows

TOP_SPEEDS = (2.5, 6.0, 12.0, 21.0)  # pixels per window
SEED = 88_000_000
SETTLING = 4  # windows, at either end
WITHIN_PX = 3.0
WAYS = ("forwards", "backwards", "mean")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", default="patterns_v1", help="weights, or a name (default: %(default)s)")
    parser.add_argument("--scenes", type=int, default=4, help="boards on their way, at different speeds")
    parser.add_argument("--windows", type=int, default=16, help="windows of each scene")
    arguments = parser.parse_args()
    network = reconstruction.load_network(arguments.network)
    collected: dict[str, list[CornerErrors]] = {way: [] for way in WAYS}
    for number in range(arguments.scenes):
        rng = np.random.default_rng([SEED, number])
        scene = evaluation_scene(rng, arguments.windows, TOP_SPEEDS[number % len(TOP_SPEEDS)])
        for way, errors in measured(scene, network, SEED + number).items():
            collected[way].append(errors)
        print(
            f"scene {number}: top speed {TOP_SPEEDS[number % len(TOP_SPEEDS)]} px/window", file=sys.stderr, flush=True
        )
    print("| corners | boards | latency, ms | bias along the motion, px | error, px rms | median, px |")
    print("|---|---|---|---|---|---|")
    for way, parts in collected.items():
        errors = together(parts)
        lengths = np.linalg.norm(errors.errors, axis=1)
        print(
            f"| {way} | {errors.found} of {errors.shown} | {1e3 * errors.latency_s:+.3f} | {errors.bias_px:+.3f} | "
            f"{errors.rms_px:.3f} | {np.median(lengths) if len(lengths) else float('nan'):.3f} |"
        )
    return 0


def measured(scene: Scene, network: ReconstructionNetwork, seed: int) -> dict[str, CornerErrors]:
    """Errors of the corners that are found both ways, at the windows' ends that are settled both ways."""
    seen = list(windows(scene, seed))
    width, height = scene.view.width, scene.view.height
    size = scene.pattern.size
    assert size is not None
    forwards = reconstruction.Reconstructor(network, width, height)
    ahead = [forwards(window.x, window.y, window.t_us, window.p) for window in seen]
    # Backwards, the image after window k + 1 shows the moment at which window k ends.
    backwards = reconstruction.Reconstructor(network, width, height)
    behind: dict[int, np.ndarray] = {}
    for index in range(len(seen) - 1, 0, -1):
        behind[index - 1] = backwards(*turned_round(seen[index], len(seen) * scene.window_us))
    found: dict[str, list[np.ndarray]] = {way: [] for way in WAYS}
    velocity, shown = [], 0
    highest = np.array([width - 1, height - 1]) - 4.0
    for index in range(SETTLING, len(seen) - 1 - SETTLING):
        truth = seen[index].corners
        if (truth <= 4.0).any() or (truth >= highest).any():
            continue
        shown += 1
        one, other = (matched(find_corners(image, size), truth) for image in (ahead[index], behind[index]))
        if one is None or other is None:
            continue
        for way, corners in zip(WAYS, (one, other, (one + other) / 2), strict=True):
            found[way].append(corners - truth)
        velocity.append(seen[index].velocity)
    nothing = [np.zeros((0, 2))]
    moved = np.concatenate(velocity or nothing)
    return {
        way: CornerErrors(
            np.concatenate(found[way] or nothing),
            moved,
            np.full(len(moved), scene.window_us * 1e-6),
            len(found[way]),
            shown,
        )
        for way in WAYS
    }


def turned_round(window: Window, end_us: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A window's events (x, y, t_us, p) as they come when time runs from `end_us` back to 0: a rise is then a fall."""
    return window.x[::-1], window.y[::-1], end_us - window.t_us[::-1], window.p[::-1] <= 0


def matched(corners: np.ndarray | None, truth: np.ndarray) -> np.ndarray | None:
    """The corners in the order of the true ones; None where the board was not found, or elsewhere."""
    if corners is None:
        return None
    distance = np.linalg.norm(corners[:, None] - truth[None], axis=-1)
    nearest = distance.argmin(axis=0)
    if len(corners) != len(truth) or len(np.unique(nearest)) < len(truth) or distance.min(axis=0).max() > WITHIN_PX:
        return None
    return corners[nearest]


def together(parts: Sequence[CornerErrors]) -> CornerErrors:
    """All corners of several images."""
    return CornerErrors(
        np.concatenate([part.errors for part in parts]),
        np.concatenate([part.velocity for part in parts]),
        np.concatenate([part.window_s for part in parts]),
        sum(part.found for part in parts),
        sum(part.shown for part in parts),
    )


if __name__ == "__main__":
    sys.exit(main())
