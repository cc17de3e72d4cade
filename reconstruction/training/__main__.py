"""The command `python -m reconstruction.training`: simulate, train, evaluate, export weights and model card.

    python -m reconstruction.training --output models/                      # the shipped weights, from nothing
    python -m reconstruction.training --output out/ --name patterns_v1   # or another recipe's

An interrupted run goes on where it stopped.
"""

import argparse
import logging
import os
from pathlib import Path

import cv2
import torch
from tqdm import tqdm

from jaxcal.progress import Progress
from reconstruction.checkpoints import DEFAULT_NETWORK, load_network, save_network
from reconstruction.networks import ReconstructionNetwork
from reconstruction.reconstructor import find_device
from reconstruction.training.data import load_or_generate
from reconstruction.training.loop import Run, finished, train
from reconstruction.training.recipe import RECIPES, Recipe


class _Bars:
    """One progress bar per stage of the work."""

    def __init__(self):
        self._bars: dict[str, tqdm] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage not in self._bars:
            self._bars[stage] = tqdm(total=total, desc=stage, mininterval=5.0)
        bar = self._bars[stage]
        bar.update(done - bar.n)
        if done == total:
            bar.close()


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m reconstruction.training",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--output", type=Path, required=True, help="folder for the weights and the model card")
    parser.add_argument(
        "--name", default=DEFAULT_NETWORK, choices=RECIPES, help="which recipe; the network's name (%(default)s)"
    )
    parser.add_argument("--parent", type=Path, help="weights to start from, in place of training the recipe's parent")
    parser.add_argument("--cache", type=Path, help="folder for sequences and checkpoints (default: OUTPUT/.cache)")
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        help="CPU threads (default: %(default)s; the layers are small, and more of them change the rounding)",
    )
    parser.add_argument("--device", default="auto", help="'cpu', 'cuda', 'auto': a GPU if there is one (%(default)s)")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="processes that simulate sequences (%(default)s)"
    )
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    cache = arguments.cache or arguments.output / ".cache"
    recipe, bars = RECIPES[arguments.name], _Bars()
    device = find_device(arguments.device)
    run = trained(arguments.name, recipe, cache, arguments.parent, bars, device=device, workers=arguments.workers)
    from reconstruction.training.export import evaluate_and_export

    evaluate_and_export(run, recipe, arguments.output / f"{arguments.name}.safetensors", progress=bars)


def trained(
    name: str,
    recipe: Recipe,
    cache: Path,
    parent: Path | None,
    progress: Progress,
    *,
    device: torch.device,
    workers: int,
) -> Run:
    """The training of a recipe, after its parent's unless the parent's weights are given."""
    checkpoint = cache / f"{name}.checkpoint.pt"
    run = finished(recipe, checkpoint)
    if run is not None:
        return run
    start: ReconstructionNetwork | None = None
    if parent is None and recipe.parent is not None:
        # Through a file, as it is shipped: the weights in it are rounded.
        parent = cache / f"{name}.parent.safetensors"
        if not parent.exists():
            before = trained(f"{name}.parent", recipe.parent, cache, None, progress, device=device, workers=workers)
            save_network(before.average, parent)
    if parent is not None:
        start = load_network(parent)
    dataset = load_or_generate(recipe.data, recipe.num_bins, cache, progress, workers)
    return train(recipe, dataset, checkpoint, parent=start, device=device, progress=progress)


if __name__ == "__main__":
    main()
