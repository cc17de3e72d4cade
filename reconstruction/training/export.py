"""The trained network as a file that is shipped, with a model card whose numbers and curves belong to that file."""

import hashlib
import itertools
import os
from pathlib import Path

import numpy as np

from jaxcal.progress import Progress, no_progress
from reconstruction.checkpoints import load_network, save_network
from reconstruction.networks import ReconstructionNetwork
from reconstruction.training.evaluate import CornerErrors, Evaluation, evaluate
from reconstruction.training.loop import HISTORY_STEPS, Run
from reconstruction.training.recipe import DataRecipe, Recipe, fingerprint

LICENCE = "Apache-2.0"
_SPEED_BINS = (0.0, 1.0, 3.0, 6.0, 10.0, 15.0, 25.0)  # pixels per window


def evaluate_and_export(run: Run, recipe: Recipe, path: Path, progress: Progress = no_progress) -> Evaluation:
    """Write `path` (float16 safetensors), evaluate what stands there, and write card and curves beside it."""
    save_network(
        run.average,
        path,
        name=path.stem,
        licence=LICENCE,
        recipe=recipe.describe(),
        data=f"simulated {_subject(recipe)}; no recordings",
    )
    evaluation = evaluate(load_network(path), progress=progress)
    _draw_curves(run, evaluation, path.with_suffix(".svg"))
    card = path.with_suffix(".md")
    partial = card.with_suffix(".part")
    partial.write_text(model_card(path, run, recipe, evaluation), encoding="utf-8")
    os.replace(partial, card)
    return evaluation


def model_card(path: Path, run: Run, recipe: Recipe, evaluation: Evaluation) -> str:
    """Markdown: what the network is, what it was trained on and how, what it reaches, its licence and checksum."""
    network, data = run.average, recipe.data
    parameters = sum(tensor.numel() for tensor in network.parameters())
    reconstructed, sharp = evaluation.reconstructed, evaluation.sharp
    stages = "\n".join(
        f"- {stage.crop}x{stage.crop} crops, batch {stage.batch}: {stage.clips} clips of {stage.segments} x "
        f"{stage.windows} windows, one step per {stage.windows} windows, {stage.steps} steps"
        for stage in recipe.stages
    )
    return f"""# {path.stem}

Reconstructs grey images of {_subject(recipe)} from events. `reconstruction.load_network("{path.stem}")`.

| | |
|---|---|
| file | `{path.name}`, {path.stat().st_size} bytes, float16 |
| sha256 | `{hashlib.sha256(path.read_bytes()).hexdigest()}` |
| licence | {LICENCE} |
| architecture | {type(network).__name__}, {parameters} parameters: {_settings(network)} |
| input | {_input(recipe)}, any sensor size |
| output | linear intensity {_moment(network)}; black is at 0.05, white at 0.95 |

{_scope(recipe)}

## Data

{data.sequences} simulated sequences of {data.windows} windows on {data.size}x{data.size} pixels,
{_scenes(data)}, in perspective, at tilts of up to
{data.largest_tilt_deg:g} degrees. Image motion of {0.25 * data.slowest_px:.2g} to {data.fastest_px:g} pixels per
window, with pauses{_swinging(data)}{_lulls(data)}.
Event sensor (ESIM model): contrast thresholds 0.1 to 0.5 (log-uniform), ON and OFF up to a factor 1.5 apart, 1 to
15 % mismatch from pixel to pixel, refractory time 1 us to 0.5 ms, noise 0.01 to 3 Hz, leak up to 0.3 Hz, some hot
pixels.
No recordings, no third-party images.

## Recipe

`python -m reconstruction.training --output models/ --name {path.stem}`, {_duration(run.seconds)} of training on
{run.machine or "two CPU cores"}{_after_parent(recipe)}.
Loss: {_loss(recipe)}.
AdamW {recipe.learning_rate:g}, falling to zero over {_falling(recipe)} of the steps, gradient
norm clipped at {recipe.clip_norm}, weights averaged (decay {recipe.average_decay}); {recipe.precision}.

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

![loss over the steps, and corner error over the speed]({path.stem}.svg)
"""


def _subject(recipe: Recipe) -> str:
    return "the world at large" if recipe.data.pictures == 1.0 else "calibration boards"


def _scope(recipe: Recipe) -> str:
    if recipe.data.pictures == 1.0:
        return (
            "It has never seen a calibration board: it is here for comparison, as a network trained in the usual way."
        )
    return (
        "It knows calibration boards on cluttered backgrounds, and nothing else: it is not for pictures of the world."
    )


def _scenes(data: DataRecipe) -> str:
    if data.pictures == 1.0:
        return "pictures of shapes that cover each other (dead leaves: Lee, Mumford, Huang 2001)"
    return (
        f"{100 * data.checkerboards:.0f} % checkerboards, {100 * data.others:.0f} % circle grids and ChArUco boards, "
        f"the rest AprilGrids\nwith bits of {data.smallest_bit_px:g} to 7 pixels, with white margins, uneven light and "
        "random backgrounds"
    )


def _swinging(data: DataRecipe) -> str:
    return f", {100 * data.swinging:.0f} % of them slower where the motion turns back" if data.swinging else ""


def _lulls(data: DataRecipe) -> str:
    return f";\n{100 * data.lulls:.0f} % fall to 2 to 20 % of their speed for 10 to 40 windows" if data.lulls else ""


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60:.0f} minutes"


def _falling(recipe: Recipe) -> str:
    return "all" if recipe.falling_share == 1.0 else f"the last {100 * recipe.falling_share:.0f} %"


def _moment(network: ReconstructionNetwork) -> str:
    if network.shown_at == 1.0:
        return "at the END of the window"
    return f"at {network.shown_at:g} of the window, with events on either side"


def _input(recipe: Recipe) -> str:
    grid = {
        "window": "normalised voxel grid (E2VID)",
        "running+scale": "voxel grid in units of a passing edge's events, and how many these are (`RunningAndScale`)",
        "running": "voxel grid in units of a passing edge's events (`RunningScale`)",
    }[recipe.data.scaling]
    return f"{grid} of a window of 10 to {recipe.data.longest_window_ms:g} ms, {recipe.num_bins} time bins"


def _after_parent(recipe: Recipe) -> str:
    if recipe.parent is None:
        return ""
    return f", after the {recipe.parent.steps} steps of its parent's recipe ({fingerprint(recipe.parent)})"


def _loss(recipe: Recipe) -> str:
    text = f"L1 of the image + {recipe.gradient_weight} x L1 of its differences"
    if recipe.displacement_weight > 0:
        text += f" + {recipe.displacement_weight} x displacement of corners (px)"
    if recipe.shared_weight > 0:
        text += f"\n+ {recipe.shared_weight} x displacement shared by the corners of an image, and of a clip (px)"
    if recipe.unseen_weight < 1.0:
        text += f";\nplaces past which no edge has come yet count {recipe.unseen_weight:g}"
    return text


def _draw_curves(run: Run, evaluation: Evaluation, path: Path) -> None:
    """The training loss, and the error of the reconstructed corners by speed, as an svg."""
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(8.0, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(HISTORY_STEPS * np.arange(1, len(run.history) + 1), run.history)
    left.set(xlabel="step", ylabel="loss")
    errors = evaluation.reconstructed
    parts = [errors.moving(*pair) for pair in itertools.pairwise(_SPEED_BINS)]
    right.stairs([part.rms_px for part in parts], _SPEED_BINS)
    right.set(xlabel="pixels per window", ylabel="RMS of the corner error (px)", ylim=(0.0, None))
    partial = path.with_suffix(".part")
    figure.savefig(partial, format="svg", metadata={"Date": None})
    os.replace(partial, path)


def _settings(network: ReconstructionNetwork) -> str:
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
