"""Are the sigmas of camera-IMU calibration honest? Many simulated recordings, each calibrated without a guess.

    python experiments/validate_camera_imu.py                              # 100 runs of six rigs: hours on two cores
    python experiments/validate_camera_imu.py --only mono --runs 20
    python experiments/validate_camera_imu.py --only rolling --duration 20

Rigs: one camera, two, four; one camera with an IMU of scale and misalignment errors; with two IMUs; with a rolling
shutter. 40 s, 20 Hz, 0.2 px, the built-in MEMS noise; a new motion and new noise in each run.

For each rig: the share of all parameter errors within 3 sigma (target: 99 %), and the normalised error squared of all
parameters together (NEES) per degree of freedom, beside the bounds that it keeps in 95 % of such studies. Every run's
numbers are appended to --out as they come, and runs that are there are not repeated, so that the study can be
interrupted.
"""

import argparse
import dataclasses
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tqdm import tqdm

from jaxcal import Calibration, calibrate_camera_imu
from jaxcal.imu import imu_model
from jaxcal.simulation import ImuTruth, SimulatedRig, paper_rig, simulate_detections, simulate_imu
from jaxcal.studies.truth import errors, in_sigmas, normalised_square

NOISE_PX = 0.2
KNOT_RATE_HZ = 20.0
SECOND = np.eye(4)
SECOND[:3, :3] = Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix()
SECOND[:3, 3] = [0.06, -0.11, 0.04]


@dataclass(frozen=True)
class Case:
    """Places of its cameras in the built-in rig, models of its IMUs, and the delay of an image row."""

    cameras: tuple[int, ...]
    imu_models: tuple[str, ...] = ("calibrated",)
    line_delay_s: float = 0.0


CASES = {
    "mono": Case((1,)),
    "stereo": Case((1, 2)),
    "four": Case((0, 1, 2, 3)),
    "scale-misalignment": Case((1,), ("scale-misalignment",)),
    "two-imus": Case((1,), ("calibrated", "calibrated")),
    "rolling": Case((1,), line_delay_s=35e-6),
}


def simulated(case: Case, duration_s: float, seed: int) -> tuple[SimulatedRig, list[ImuTruth]]:
    """A rig that moves anew, and IMUs as far from nominal as parts on the market are."""
    rng = np.random.default_rng(seed)
    rig = paper_rig(duration_s=duration_s, seed=seed)
    cameras = [
        dataclasses.replace(rig.cameras[place], name=f"cam{c}", rate_hz=20.0) for c, place in enumerate(case.cameras)
    ]
    truths = []
    for number, name in enumerate(case.imu_models):
        model = imu_model(name)
        parameters = np.array(model.nominal) + 0.2 * np.array(model.spread) * rng.standard_normal(model.size)
        place = (SECOND, 0.0173) if number else (np.eye(4), 0.0)
        truths.append(ImuTruth(name, parameters, *place, number=number))
    return dataclasses.replace(rig, cameras=tuple(cameras)), truths


def run(case: Case, duration_s: float, seed: int) -> dict[str, object]:
    """One calibration: errors in sigmas, NEES, degrees of freedom, CPU seconds."""
    rig, truths = simulated(case, duration_s, seed)
    delay = case.line_delay_s
    extra = {"line_delay_s": delay} if delay else {}
    detections = [simulate_detections(rig, c, NOISE_PX, **extra) for c in range(len(rig.cameras))]
    start = time.process_time()
    calibration: Calibration = calibrate_camera_imu(
        detections,
        [simulate_imu(rig, truth=truth) for truth in truths],
        rig.target,
        imu_models=list(case.imu_models),
        rolling_shutter=bool(delay),
        knot_rate_hz=KNOT_RATE_HZ,
    )
    spent = time.process_time() - start
    found = errors(calibration, rig, truths, [delay] * len(rig.cameras) if delay else None)
    nees, freedom = normalised_square(calibration, found)
    return {
        "seed": seed,
        "converged": calibration.converged,
        "in_sigmas": in_sigmas(calibration, found).tolist(),
        "nees": nees,
        "freedom": freedom,
        "cpu_s": spent,
        "warnings": len(calibration.warnings),
    }


def done_already(path: Path, settings: dict[str, float]) -> dict[int, dict]:
    """Runs of these settings by seed; a line that was cut off is left out."""
    found = {}
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        if row["settings"] == settings:
            found[row["seed"]] = row
    return found


def study(name: str, runs: int, duration_s: float, folder: Path) -> str:
    """A row of the table."""
    path, settings = folder / f"{name}.jsonl", {"duration_s": duration_s}
    found = done_already(path, settings)
    with path.open("a") as file:
        for seed in tqdm(range(runs), desc=name, disable=not sys.stderr.isatty()):
            if seed not in found:
                found[seed] = run(CASES[name], duration_s, seed) | {"settings": settings}
                file.write(json.dumps(found[seed]) + "\n")
                file.flush()
    rows = [found[seed] for seed in range(runs)]
    ratios = np.concatenate([row["in_sigmas"] for row in rows])
    ratios = ratios[np.isfinite(ratios)]  # a number that is held has no sigma
    freedom = sum(row["freedom"] for row in rows)
    nees = sum(row["nees"] for row in rows) / freedom
    low, high = chi2.ppf([0.025, 0.975], freedom) / freedom
    converged = sum(row["converged"] for row in rows)
    return (
        f"| {name} | {runs} | {converged} | {100 * np.mean(np.abs(ratios) < 3.0):.2f} % of {len(ratios)} "
        f"| {np.abs(ratios).max():.2f} | {nees:.3f} | {low:.3f} to {high:.3f} "
        f"| {np.median([row['cpu_s'] for row in rows]):.1f} |"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="rigs (default: all)")
    parser.add_argument("--runs", type=int, default=100, help="recordings of each (%(default)s)")
    parser.add_argument("--duration", type=float, default=40.0, help="seconds of each (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/validate_camera_imu"), help="folder (%(default)s)")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    print("| rig | runs | converged | within 3 sigma | largest | NEES | its 95 % bounds | CPU s, median |")
    print("|---|---|---|---|---|---|---|---|")
    for name in arguments.only:
        print(study(name, arguments.runs, arguments.duration, arguments.out), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
