"""How long a reconstructed frame takes, and where: voxel grid against network, precisions, memory over the recording.

    python experiments/bench_reconstruction.py
    python experiments/bench_reconstruction.py --network models/other.safetensors --repeat 20 --gate

Windows of 640x480 with 1e5 to 2e6 events. Every figure is the median over repetitions of CPU time (all threads) and of
wall time; ratios are between neighbours in one run, so that they hold on a machine that others use, too. --gate: leave
with 1 where the voxel grid takes longer than the network, or memory grows with the recording's length.
"""

import argparse
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

import reconstruction
from jaxcal.observations import Events
from reconstruction import voxel_torch
from reconstruction.networks import ReconstructionNetwork
from reconstruction.voxel import accumulate, normalise

WIDTH, HEIGHT = 640, 480
EVENTS = (100_000, 300_000, 1_000_000, 2_000_000)
TARGET_MS = 60.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", help="weights, or the name of a network that jaxcal ships")
    parser.add_argument("--repeat", type=int, default=7, help="repetitions of each measurement")
    parser.add_argument("--gate", action="store_true", help="leave with 1 where a promise is not kept")
    arguments = parser.parse_args()
    network = reconstruction.load_network(arguments.network)
    name = f"{type(network).__name__} {network.settings}"
    print(f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    print(f"{name}, {WIDTH}x{HEIGHT}\n")
    slowest = voxels_against_network(network, arguments.repeat)
    precisions(network, arguments.repeat)
    growth = memory_growth(network)
    kept = slowest < 1.0 and growth < 16.0
    return 1 if arguments.gate and not kept else 0


def voxels_against_network(network: ReconstructionNetwork, repeat: int) -> float:
    """Prints a row per number of events, and returns the largest ratio of voxel grid to network."""
    print("| events | voxel grid, CPU ms | torch scatter-add, CPU ms | network, CPU ms | grid / network |")
    print("|---|---|---|---|---|")
    ratios = []
    for count in EVENTS:
        x, y, t, p = moving_edges(count, seed=count)
        size: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "num_bins": network.num_bins}
        reconstructor = reconstruction.Reconstructor(network, WIDTH, HEIGHT)
        reconstructor(x, y, t, p)  # compiles, and allocates the state
        whole, _ = measured(lambda r=reconstructor, x=x, y=y, t=t, p=p: r(x, y, t, p), repeat)
        grid, _ = measured(lambda x=x, y=y, t=t, p=p, size=size: normalise(accumulate(x, y, t, p, **size)), repeat)
        scatter, _ = measured(
            lambda x=x, y=y, t=t, p=p, size=size: voxel_torch.normalise(
                voxel_torch.accumulate(x, y, t, p, **size, device="cpu")
            ),
            repeat,
        )
        ratios.append(grid / (whole - grid))
        print(f"| {count:,} | {grid:.1f} | {scatter:.1f} | {whole - grid:.1f} | {ratios[-1]:.2f} |", flush=True)
    print()
    return max(ratios)


def precisions(network: ReconstructionNetwork, repeat: int) -> None:
    """Prints the time of a whole frame in each precision, beside the target."""
    print("| precision | frame, CPU ms | frame, wall ms | against float32 | largest difference, grey levels |")
    print("|---|---|---|---|---|")
    windows = [moving_edges(300_000, seed=number) for number in range(2)]
    images, base = {}, float("nan")
    for precision in ("float32", "bfloat16", "auto"):
        reconstructor = reconstruction.Reconstructor(network, WIDTH, HEIGHT, precision=precision)
        images[precision] = [reconstructor(*window) for window in windows][-1]
        cpu, wall = measured(lambda r=reconstructor: r(*windows[0]), repeat)
        base = cpu if precision == "float32" else base
        difference = int(np.abs(images[precision].astype(int) - images["float32"]).max())
        print(f"| {precision} | {cpu:.1f} | {wall:.1f} | {cpu / base:.2f} | {difference} |", flush=True)
    print(f"\ntarget: {TARGET_MS:.0f} ms of wall time on 2 cores that are free\n")


def memory_growth(network: ReconstructionNetwork) -> float:
    """Prints and returns by how many MiB the peak memory grows from the 10th window of a stream to the 60th."""
    stream = reconstruction.reconstruct(endless_windows(100_000), network, width=WIDTH, height=HEIGHT)
    for _ in range(10):
        next(stream)
    before = peak_mib()
    for _ in range(50):
        next(stream)
    growth = peak_mib() - before
    print(f"peak memory: {before:.0f} MiB after 10 windows, {growth:+.1f} MiB after 50 more")
    return growth


# --- events ----------------------------------------------------------------------------------------------------------


def moving_edges(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """x, y, t_us, p of events along forty edges that move for 33 ms; a tenth of them noise anywhere."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 33_000, count))
    along, edge = rng.uniform(0, HEIGHT, count), rng.integers(0, 40, count)
    x = 16.0 * edge + 0.1 * along + 10.0 * t / 33_000 + rng.normal(0, 0.7, count)
    noise = rng.random(count) < 0.1
    x[noise] = rng.uniform(0, WIDTH, np.count_nonzero(noise))
    return (
        (x % WIDTH).astype(np.uint16),
        along.astype(np.uint16),
        t,
        edge % 2 == (rng.random(count) < 0.05),
    )


def endless_windows(count: int) -> Iterator[tuple[int, Events]]:
    """The same `count` events in window after window of 33 ms."""
    x, y, t, p = moving_edges(count, seed=0)
    number = 0
    while True:
        start_ns = number * 33_000_000
        yield start_ns + 33_000_000, Events(start_ns + 1000 * t, x, y, p, WIDTH, HEIGHT)
        number += 1


# --- measuring -------------------------------------------------------------------------------------------------------


def measured(work: Callable[[], object], repeat: int) -> tuple[float, float]:
    """Median CPU and wall time in milliseconds."""
    work()
    cpu, wall = [], []
    for _ in range(repeat):
        begin_cpu, begin_wall = time.process_time(), time.perf_counter()
        work()
        cpu.append(time.process_time() - begin_cpu)
        wall.append(time.perf_counter() - begin_wall)
    return 1e3 * statistics.median(cpu), 1e3 * statistics.median(wall)


def peak_mib() -> float:
    """The most memory that this process has had so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


if __name__ == "__main__":
    sys.exit(main())
