"""Table 1 of the paper: how often boards are found in reconstructed frames, and how well their corners lie.

    python experiments/paper_table1_detection.py --seeds 5
    python experiments/paper_table1_detection.py --quick        # one short recording per scene

Three lenses times two boards, 50 ms windows. The success ratio p_recon / p_GT is the number of boards found in the
reconstructed frames over that in ideal frames of the same moments. An interrupted run goes on where it stopped.
"""

import itertools
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from paper_scenes import (
    BOARDS,
    LENSES,
    SIZE,
    CornerErrors,
    arguments_of,
    boards_found,
    corner_errors,
    corners,
    markdown,
    network_frames,
    parser,
    publish,
    record,
)

import jaxcal
from jaxcal.cli.progress_bars import ProgressBars
from jaxcal.progress import Progress

# p_recon / p_GT of the paper's table 1.
PAPER = {
    ("checkerboard", "none"): 1.0,
    ("checkerboard", "equidistant"): 0.981,
    ("checkerboard", "radtan"): 0.755,
    ("AprilGrid", "none"): 0.981,
    ("AprilGrid", "equidistant"): 0.061,
    ("AprilGrid", "radtan"): 0.329,
}
SPEEDS = (0.0, 25.0, 50.0, 100.0, 200.0, 300.0, 400.0)  # px/s


@dataclass(frozen=True)
class Outcome:
    """One scene over all seeds: boards and corners found in reconstructed and in ideal frames; corner errors."""

    boards: int
    boards_ideal: int
    points: int
    points_ideal: int
    errors: CornerErrors
    ideal: CornerErrors


def main(argv: list[str] | None = None) -> int:
    options = arguments_of(parser(__doc__, seeds=5, duration_s=10.0), argv)
    outcomes: dict[tuple[str, str], Outcome] = {}
    try:
        with ProgressBars() as bars:
            for board, lens in PAPER:
                outcomes[board, lens] = outcome(options, board, lens, bars)
                print(f"{board}, {lens}: done", file=sys.stderr, flush=True)
    except jaxcal.CalibrationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    numbers = [{"board": board, "lens": lens, **figures(found)} for (board, lens), found in outcomes.items()]
    publish(options, "paper_table1", f"{table(outcomes)}\n\n{speed_table(outcomes)}", numbers)
    return 0


def outcome(options: Any, board: str, lens: str, progress: Progress) -> Outcome:
    """All seeds of one scene."""
    found = []
    for seed in range(options.seeds):
        recording = record(options.work, LENSES[lens], SIZE, BOARDS[board], seed, options.duration, progress)
        ideal = corners(recording, recording.ideal_frames(), "ideal", progress)
        frames = network_frames(recording, options.network, progress)
        made = corners(recording, frames, "network", progress)
        found.append((recording, made, ideal))
    return Outcome(
        boards=sum(boards_found(made, r.target) for r, made, _ in found),
        boards_ideal=sum(boards_found(ideal, r.target) for r, _, ideal in found),
        points=sum(len(made) for _, made, _ in found),
        points_ideal=sum(len(ideal) for _, _, ideal in found),
        errors=CornerErrors.together(corner_errors(r, made) for r, made, _ in found),
        ideal=CornerErrors.together(corner_errors(r, ideal) for r, _, ideal in found),
    )


def figures(found: Outcome) -> dict[str, Any]:
    """The numbers of a row."""
    return {
        "boards": found.boards,
        "boards_ideal": found.boards_ideal,
        "ratio": found.boards / max(found.boards_ideal, 1),
        "corner_ratio": found.points / max(found.points_ideal, 1),
        "median_px": found.errors.median_px,
        "rms_px": found.errors.rms_px,
        "ideal_median_px": found.ideal.median_px,
        "latency_ms": found.errors.latency_ms,
        "bias_px": [found.errors.bias_px(*pair) for pair in itertools.pairwise(SPEEDS)],
    }


def table(outcomes: dict[tuple[str, str], Outcome]) -> str:
    """Detection, errors and latency as markdown, a row per board and lens."""
    header = ["board", "lens", "paper", "ours", "boards found", "corners", "median error (px)", "ideal", "latency (ms)"]
    rows = []
    for (board, lens), found in outcomes.items():
        n = figures(found)
        rows.append(
            [
                board,
                lens,
                f"{PAPER[board, lens]:.3f}",
                f"{n['ratio']:.3f}",
                f"{found.boards} of {found.boards_ideal}",
                f"{n['corner_ratio']:.3f}",
                f"{n['median_px']:.3f}",
                f"{n['ideal_median_px']:.3f}",
                f"{n['latency_ms']:.3f}",
            ]
        )
    return markdown(header, rows)


def speed_table(outcomes: dict[tuple[str, str], Outcome]) -> str:
    """Mean error along the motion by speed, all scenes of a board together."""
    pairs = list(itertools.pairwise(SPEEDS))
    rows = []
    for board in BOARDS:
        errors = CornerErrors.together(found.errors for (b, _), found in outcomes.items() if b == board)
        rows.append([board, *(f"{errors.bias_px(*pair):+.3f}" for pair in pairs), f"{np.max(errors.speed):.0f} px/s"])
    header = ["mean error along the motion (px)", *(f"{low:.0f} to {high:.0f} px/s" for low, high in pairs), "fastest"]
    return markdown(header, rows)


if __name__ == "__main__":
    sys.exit(main())
