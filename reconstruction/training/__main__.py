"""The command `python -m reconstruction.training`: simulate, train, evaluate, export weights and model card."""

import argparse
import logging
from pathlib import Path

import cv2
import torch
from tqdm import tqdm

from reconstruction.checkpoints import DEFAULT_NETWORK
from reconstruction.training.data import load_or_generate
from reconstruction.training.loop import train
from reconstruction.training.recipe import Recipe


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
    parser = argparse.ArgumentParser(prog="python -m reconstruction.training", description=__doc__)
    parser.add_argument("--output", type=Path, required=True, help="folder for the weights and the model card")
    parser.add_argument("--name", default=DEFAULT_NETWORK, help="name of the network (default: %(default)s)")
    parser.add_argument("--cache", type=Path, help="folder for sequences and checkpoints (default: OUTPUT/.cache)")
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        help="CPU threads (default: %(default)s; the layers are small, and more of them change the rounding)",
    )
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    cache = arguments.cache or arguments.output / ".cache"
    recipe, bars = Recipe(), _Bars()
    dataset = load_or_generate(recipe.data, recipe.num_bins, cache, bars)
    network, seconds = train(recipe, dataset, cache / f"{arguments.name}.checkpoint.pt", progress=bars)
    from reconstruction.training.export import evaluate_and_export

    evaluate_and_export(network, recipe, seconds, arguments.output / f"{arguments.name}.safetensors", progress=bars)


if __name__ == "__main__":
    main()
