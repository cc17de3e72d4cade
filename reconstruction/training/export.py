"""The trained network as a file that is shipped, with a model card whose numbers were measured on that file."""

import hashlib
import itertools
import os
from pathlib import Path

from jaxcal.progress import Progress, no_progress
from reconstruction.checkpoints import load_network, save_network
from reconstruction.networks import FoldedFireNet
from reconstruction.training.evaluate import CornerErrors, Evaluation, evaluate
from reconstruction.training.recipe import Recipe, fingerprint

LICENCE = "Apache-2.0"
_SPEED_BINS = (0.0, 1.0, 3.0, 6.0, 10.0, 15.0, 25.0)  # pixels per window


def evaluate_and_export(
    network: FoldedFireNet, recipe: Recipe, seconds: float, path: Path, progress: Progress = no_progress
) -> Evaluation:
    """Write `path` (float16 safetensors), evaluate what stands there, and write the model card beside it."""
    save_network(
        network,
        path,
        name=path.stem,
        licence=LICENCE,
        recipe=recipe.describe(),
        data="simulated checkerboards and AprilGrids; no recordings",
    )
    evaluation = evaluate(load_network(path), progress=progress)
    card = path.with_suffix(".md")
    partial = card.with_suffix(".part")
    partial.write_text(model_card(path, network, recipe, seconds, evaluation), encoding="utf-8")
    os.replace(partial, card)
    return evaluation


def model_card(path: Path, network: FoldedFireNet, recipe: Recipe, seconds: float, evaluation: Evaluation) -> str:
    """Markdown: what the network is, what it was trained on and how, what it reaches, its licence and checksum."""
    data, parameters = recipe.data, sum(tensor.numel() for tensor in network.parameters())
    reconstructed, sharp = evaluation.reconstructed, evaluation.sharp
    stages = "\n".join(
        f"- {stage.crop}x{stage.crop} crops, batch {stage.batch}: {stage.clips} clips of {stage.segments} x "
        f"{stage.windows} windows, one step per {stage.windows} windows, {stage.steps} steps"
        for stage in recipe.stages
    )
    return f"""# {path.stem}

Reconstructs grey images of calibration boards from events. `reconstruction.load_network("{path.stem}")`.

| | |
|---|---|
| file | `{path.name}`, {path.stat().st_size} bytes, float16 |
| sha256 | `{hashlib.sha256(path.read_bytes()).hexdigest()}` |
| licence | {LICENCE} |
| architecture | {type(network).__name__}, {parameters} parameters: {_settings(network)} |
| input | normalised voxel grid of a window of 10 to 50 ms, {recipe.num_bins} time bins, any sensor size |
| output | linear intensity at the END of the window; the board's black is at 0.05, its white at 0.95 |

It knows boards (checkerboards, AprilGrids) before cluttered backgrounds, and nothing else: it is not for pictures of
the world.

## Data

{data.sequences} simulated sequences of {data.windows} windows on {data.size}x{data.size} pixels,
{100 * data.checkerboards:.0f} % checkerboards and the rest AprilGrids, in perspective, at tilts of up to 50 degrees,
with white margins, uneven light and random backgrounds. Image motion of 0.4 to 25 pixels per window, with pauses. Event
sensor (ESIM model): contrast thresholds 0.1 to 0.5 (log-uniform), ON and OFF up to a factor 1.5 apart, 1 to 15 %
mismatch from pixel to pixel, refractory time 1 us to 0.5 ms, noise 0.01 to 3 Hz, leak up to 0.3 Hz, some hot pixels.
No recordings, no third-party images.

## Recipe

`python -m reconstruction.training --output models/`, {seconds / 60:.0f} minutes of training with one thread
on a shared machine with two CPU cores.
Loss: L1 of the image + {recipe.gradient_weight} x L1 of its differences. AdamW {recipe.learning_rate}, linear decay to
zero, gradient norm clipped at {recipe.clip_norm}, weights averaged (decay {recipe.average_decay}); bfloat16.

{stages}

Recipe fingerprint `{fingerprint(recipe)}`; all settings are in the file's metadata.

## Results

Held-out simulated recordings of a 9x6 checkerboard (384x288 pixels, cells of about 21 to 25 pixels, tilts up to 30
degrees, all kinds of sensors above), images reconstructed with the default options; corners by
`findChessboardCornersSB` and `cornerSubPix`.

| | reconstructed | sharp frames |
|---|---|---|
| boards found | {reconstructed.found} of {reconstructed.shown} | {sharp.found} of {sharp.shown} |
| corner error against truth, RMS of the 2-D error (px) | {reconstructed.rms_px:.3f} | {sharp.rms_px:.3f} |
| latency (ms) | {1e3 * reconstructed.latency_s:.3f} | {1e3 * sharp.latency_s:.3f} |

Detection ratio {evaluation.detection_ratio:.3f}. By speed of the corner:

| pixels per window | corners | RMS (px) | mean error along the motion (px) | latency (ms) |
|---|---|---|---|---|
{_speed_rows(reconstructed)}
"""


def _settings(network: FoldedFireNet) -> str:
    return ", ".join(f"{name} {value}" for name, value in network.settings.items())


def _speed_rows(errors: CornerErrors) -> str:
    rows = []
    for slowest, fastest in itertools.pairwise(_SPEED_BINS):
        part = errors.moving(slowest, fastest)
        if len(part.errors):
            rows.append(
                f"| {slowest:g} to {fastest:g} | {len(part.errors)} | {part.rms_px:.3f} | {part.bias_px:+.3f} | "
                f"{1e3 * part.latency_s:+.3f} |"
            )
    return "\n".join(rows)
