"""The training set: generated once, kept as two arrays on disk, read in random clips."""

import logging
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float

from jaxcal.progress import Progress, no_progress
from reconstruction.training.recipe import DataRecipe, Stage, fingerprint
from reconstruction.training.sequences import training_scene, windows
from reconstruction.voxel import accumulate, scaler, window_time

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Dataset:
    """`voxels` (sequences, windows, planes, size, size) float16 and `targets` (sequences, windows, size, size) float16,
    both mapped from disk, or in a device's memory."""

    voxels: torch.Tensor
    targets: torch.Tensor

    def near(self, device: torch.device) -> "Dataset":
        """Itself in the memory of a GPU, if it leaves a third of what is free there to the training."""
        if device.type == "cuda":
            needed = sum(tensor.numel() * tensor.element_size() for tensor in (self.voxels, self.targets))
            if needed < 2 * torch.cuda.mem_get_info(device)[0] // 3:
                return Dataset(self.voxels.to(device), self.targets.to(device))
        return self

    def clip(
        self, rng: np.random.Generator, stage: Stage
    ) -> tuple[Float[torch.Tensor, "t b c h w"], Float[torch.Tensor, "t b 1 h w"]]:
        """A batch of random clips: windows first. Each is cropped, and turned or mirrored at random."""
        count, length, size = self.voxels.shape[0], self.voxels.shape[1], self.voxels.shape[-1]
        total = stage.windows * stage.segments
        drawn = []
        for sequence in rng.integers(count, size=stage.batch):
            start = int(rng.integers(length - total + 1))
            top, left = (int(v) for v in rng.integers(size - stage.crop + 1, size=2))
            part = (
                sequence,
                slice(start, start + total),
                ...,
                slice(top, top + stage.crop),
                slice(left, left + stage.crop),
            )
            drawn.append(_turned(rng, self.voxels[part], self.targets[part][:, None]))
        voxels, targets = (torch.stack(tensors, dim=1) for tensors in zip(*drawn, strict=True))
        return voxels.float(), targets.float()


def _turned(rng: np.random.Generator, *tensors: torch.Tensor) -> list[torch.Tensor]:
    """One of the eight turns and mirrorings of a square, the same for all tensors (..., size, size)."""
    turns, mirrored = int(rng.integers(4)), rng.random() < 0.5
    turned = [torch.rot90(tensor, turns, dims=(-2, -1)) for tensor in tensors]
    return [tensor.flip(-1) if mirrored else tensor for tensor in turned]


def load_or_generate(
    recipe: DataRecipe, num_bins: int, cache: Path, progress: Progress = no_progress, workers: int = 1
) -> Dataset:
    """The training set, from `cache` if it is complete there; a set that is interrupted is continued.

    `workers` processes simulate; what they make does not depend on how many there are.
    """
    folder = cache / f"sequences-{fingerprint(recipe)}-{num_bins}"
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{index:04d}.npz" for index in range(recipe.sequences)]
    missing = [(recipe, num_bins, index, path) for index, path in enumerate(paths) if not path.exists()]
    already = len(paths) - len(missing)
    progress("simulate training sequences", already, len(paths))
    for done, _ in enumerate(_generated(missing, workers), start=already + 1):
        progress("simulate training sequences", done, len(paths))
    return _merged(paths, folder)


def _generated(tasks: list[tuple[DataRecipe, int, int, Path]], workers: int) -> Iterator[None]:
    if workers <= 1 or len(tasks) < 2:
        for task in tasks:
            yield _generate(*task)
        return
    # New processes, not forked ones: torch's and cv2's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        for done in as_completed([pool.submit(_generate, *task) for task in tasks]):
            yield done.result()


def _generate(recipe: DataRecipe, num_bins: int, index: int, path: Path) -> None:
    rng = np.random.default_rng([recipe.seed, index])
    scene = training_scene(rng, recipe)
    scaled = scaler(recipe.scaling)
    voxels, targets = [], []
    for window in windows(scene, seed=index):
        size = {"width": recipe.size, "height": recipe.size, "num_bins": num_bins}
        time, span = window_time(window.t_us, window.span_us, recipe.shown_at)
        grid = accumulate(window.x, window.y, time, window.p, **size, span=span)
        voxels.append(scaled(grid))
        targets.append(window.target)
    partial = path.with_suffix(".part")
    with partial.open("wb") as file:
        np.savez(file, voxels=np.array(voxels, dtype=np.float16), targets=np.array(targets, dtype=np.float16))
    os.replace(partial, path)


def _merged(paths: list[Path], folder: Path) -> Dataset:
    """One array file each for voxels and targets, so that clips can be cut from disk without reading sequences."""
    names = ("voxels", "targets")
    merged = {name: folder / f"{name}.npy" for name in names}
    if not all(path.exists() for path in merged.values()):
        with np.load(paths[0]) as first:
            shapes = {name: (len(paths), *first[name].shape) for name in names}
        partial = {name: folder / f"{name}.part.npy" for name in names}
        arrays = {
            name: np.lib.format.open_memmap(partial[name], mode="w+", dtype=np.float16, shape=shapes[name])
            for name in names
        }
        for index, path in enumerate(paths):
            with np.load(path) as sequence:
                for name in names:
                    arrays[name][index] = sequence[name]
        for name in names:
            arrays[name].flush()
            os.replace(partial[name], merged[name])
    # Mapped so that writing would change a copy: torch knows no arrays that cannot be written.
    return Dataset(*(torch.from_numpy(np.load(merged[name], mmap_mode="c")) for name in names))
