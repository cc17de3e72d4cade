"""Speed and truth of studies: a thousand bootstrap calibrations of one camera, 40 views of 144 corners.

    python experiments/bench_studies.py
    python experiments/bench_studies.py --runs 1000 --workers 2 --gate 15

Prints wall and CPU seconds of the study without its compilation and with it ('cold': a study of a few runs before, in
the same process; compiled programs on the disk, if there are any, are used), and how the bootstrap's scatter compares
with the sigma that the calibration states. With --gate it fails when the warm wall time is longer.
"""

import argparse
import os
import platform
import sys
import tempfile
import time
from pathlib import Path

import jax
from bench_cameras import BOARD, make_detections
from tqdm import tqdm

import jaxcal
from jaxcal.studies import Study, run_study
from jaxcal.studies.tables import summary_text

VIEWS = 40


def timed(study: Study, base: jaxcal.Calibration, workers: int, folder: Path) -> tuple[float, float, float]:
    """Wall and CPU seconds of a study, and its observed over stated sigma."""
    wall, cpu = time.perf_counter(), time.process_time()
    bar = tqdm(total=study.runs + 1, disable=not sys.stderr.isatty())

    def progress(stage: str, done: int, total: int) -> None:
        bar.update(done - bar.n)

    result = run_study(study, folder, base=base, workers=workers, progress=progress)
    bar.close()
    spent = time.perf_counter() - wall, time.process_time() - cpu
    if study.runs >= 100:
        print(summary_text(result))
    return *spent, result.pooled_ratio


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="threads")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gate", type=float, help="fail when the warm study takes longer, s")
    arguments = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}")
    print(f"load of the machine before: {os.getloadavg()[0]:.1f} (others' work makes wall times longer)\n")
    base = jaxcal.calibrate_cameras(make_detections(VIEWS, 1), BOARD)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, runs in (("cold, 50 runs", 50), (f"warm, {arguments.runs} runs", arguments.runs)):
            study = Study(kind="bootstrap", runs=runs, seed=arguments.seed)
            rows.append((name, *timed(study, base, arguments.workers, Path(folder) / name)))
    print("| bootstrap of 40 views x 144 corners | wall s | CPU s | observed / stated sigma |\n|---|---|---|---|")
    for name, wall, cpu, ratio in rows:
        print(f"| {name}, {arguments.workers} threads | {wall:.2f} | {cpu:.2f} | {ratio:.3f} |")
    if arguments.gate is not None and rows[-1][1] > arguments.gate:
        print(f"slower than {arguments.gate:g} s")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
