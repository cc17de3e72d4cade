"""Does cross-validation tell errors of the model from noise? Simulated recordings, with none and with one error each.

    python experiments/validate_cross_validation.py --runs 100 --seeds 3

Prints how often nothing but noise is flagged (and the p-values of every test, which should be spread evenly), and for
each error of several sizes whether it was flagged, and as what first. Corners are simulated; their noise is 0.1 px.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import jaxcal
from jaxcal.results.cross_validation import CrossValidation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "calibration"))
from model_error_examples import RICH_LENS, corners, refocused, rig_for  # pyright: ignore


def checked(seed: int, cameras: int, **error: Any) -> CrossValidation:
    """Calibrate a simulated recording and cross-validate it."""
    rig = rig_for(seed, cameras)
    return jaxcal.cross_validate(jaxcal.calibrate_cameras(corners(rig, **error), rig.target))


def errors(seed: int) -> Iterator[tuple[str, str, int, dict[str, Any]]]:
    """What was done to the recording, the cause that should be named, the number of cameras, and how."""
    lens = rig_for(seed).cameras[0].model
    yield "equidistant lens taken for radtan", "lens", 1, {"lens": RICH_LENS}
    for bend in (0.001, 0.002, 0.004):
        yield f"board bent by {1e3 * bend:g} mm", "bent board", 1, {"bend_m": bend}
    for delay in (1e-6, 5e-6, 30e-6):
        yield f"rolling shutter, {1e6 * delay:g} us a row", "rolling shutter", 1, {"line_delay_s": delay}
    for share in (0.0005, 0.002):
        yield f"focal length +{1e2 * share:g} % half-way", "changed lens", 1, {"late_lens": refocused(lens, share)}
    for shift in (0.0002, 0.001):
        yield f"second camera moved by {1e3 * shift:g} mm", "moved camera", 2, {"late_shift_m": shift}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="recordings with noise only")
    parser.add_argument("--seeds", type=int, default=2, help="recordings of each error")
    arguments = parser.parse_args()
    alarms, named = 0, Counter()
    spread: dict[str, list[float]] = {}
    for seed in tqdm(range(arguments.runs), disable=not sys.stderr.isatty()):
        found = checked(1000 + seed, 1)
        alarms += found.flagged
        named.update(cause.cause for cause in found.causes)
        for half in found.halves:
            spread.setdefault(f"halves {half.split}", []).append(half.p_value)
        for e in found.evidence:
            spread.setdefault(e.cause, []).append(e.p_value)
    if arguments.runs:
        print(f"noise only: {alarms} of {arguments.runs} flagged {dict(named)}\n")
        print("| test | p below 0.05 | p below 0.5 | smallest p |\n|---|---|---|---|")
        for name, values in spread.items():
            p = np.array(values)
            print(f"| {name} | {np.mean(p < 0.05):.2f} | {np.mean(p < 0.5):.2f} | {p.min():.2g} |")
    print("\n| error | flagged | named first | also named |\n|---|---|---|---|", flush=True)
    for k, (what, cause, cameras, _) in enumerate(errors(0)):
        results = [checked(seed, cameras, **list(errors(seed))[k][3]) for seed in range(arguments.seeds)]
        first = Counter(r.causes[0].cause if r.causes else "nothing" for r in results)
        also = Counter(c.cause for r in results for c in r.causes[1:])
        right = f"{first[cause]} of {len(results)} as {cause}" + (f" ({dict(first)})" if len(first) > 1 else "")
        print(f"| {what} | {sum(r.flagged for r in results)} of {len(results)} | {right} | {dict(also)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
