"""What choosing the views that tell most is worth: sigmas and time in simulation, held-back errors in a real recording.

    python experiments/view_selection.py
    JAXCAL_DATA=path/to/recordings python experiments/view_selection.py

The simulated part has 2000 views of independent corner noise. What 50 chosen views know by themselves comes first,
beside 50 evenly spaced ones; then whole calibrations, with all views from the start and with the 50 that tell most
first (`views=50`), whom all others join at the end: no precision is lost. EuRoC's left camera is calibrated from its
even frames, both ways, and judged by the odd ones.
"""

import argparse
import functools
import os
import sys
from pathlib import Path

import numpy as np
from bench_cameras import BOARD, NOISE_PX, make_case, timed_in_turn

import jaxcal
from jaxcal.calibration import held_back_residuals, selection
from jaxcal.recording.tables import load_detections

# Simulated is the first; the others are richer, and the search for their optimum is longer.
MODELS = ("pinhole-radtan", "pinhole-rational8", "omni-radtan")


def simulated(views: int, chosen: int) -> None:
    """Sigmas of the intrinsics from chosen, evenly spaced and all views, at the optimum's place."""
    case = make_case(views, 1)
    information = selection.view_information(case.problem, case.state)[:views] / NOISE_PX**2
    everything = _sigmas(information.sum(axis=0))
    best = selection.most_informative_views(case.problem, case.state, chosen)
    even = np.linspace(0, views - 1, chosen).astype(int)
    print(f"simulated, {views} views of {len(BOARD.points)} corners, {NOISE_PX} px:\n")
    print("| views | sigma fx (px) | sigma cx (px) | fx against all | cx against all |\n|---|---|---|---|---|")
    for name, rows in ((f"all {views}", None), (f"{chosen} chosen", best), (f"{chosen} evenly spaced", even)):
        sigma = everything if rows is None else _sigmas(information[rows].sum(axis=0))
        ratio = sigma / everything
        print(f"| {name} | {sigma[0]:.4f} | {sigma[2]:.4f} | {ratio[0]:.2f} | {ratio[2]:.2f} |")


def whole_calibrations(views: int, chosen: int) -> None:
    """`calibrate_cameras` with all views from the start, and with those that tell most first; warm."""
    case = make_case(views, 1)
    print(f"\none camera, {views} views, whole `calibrate_cameras`, warm:\n")
    print("| model | views | s | fx (px) | sigma fx (px) | largest sigma against all | furthest from all (sigma) |")
    print("|---|---|---|---|---|---|---|")
    for model in MODELS:
        calls = [functools.partial(_calibrated, case.detections, model, number) for number in (None, chosen)]
        everything, few = timed_in_turn(calls, 2)
        values, sigmas = _lenses(everything[1])
        for name, (timing, calibration) in ((f"all {views}", everything), (f"{chosen} first", few)):
            own, own_sigmas = _lenses(calibration)
            apart, larger = np.abs((own - values) / sigmas).max(), (own_sigmas / sigmas).max()
            figures = f"{timing.warm:.2f} | {own[0]:.4f} | {own_sigmas[0]:.4f} | {larger:.4f} | {apart:.4f}"
            print(f"| {model} | {name} | {figures} |", flush=True)


def _calibrated(detections: list[jaxcal.Detections], model: str, views: int | None) -> jaxcal.Calibration:
    return jaxcal.calibrate_cameras(detections, BOARD, [model], views=views)


def _lenses(calibration: jaxcal.Calibration) -> tuple[np.ndarray, np.ndarray]:
    """All parameters of all lenses, and their sigmas."""
    values, sigmas = [], []
    for camera in calibration.cameras:
        values += [camera.model.intrinsics, camera.model.distortion]
        sigmas += [calibration.std(f"{camera.name}.{part}") for part in ("intrinsics", "distortion")]
    return np.concatenate(values), np.concatenate(sigmas)


def _sigmas(information: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diag(np.linalg.inv(information)))


def real(data: Path, chosen: int) -> None:
    """Held-back errors of EuRoC's left camera."""
    target = jaxcal.AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)
    detections = load_detections(data / "euroc_imu_april" / "observations.npz", target, (752, 480), "cam0")
    even, odd = (_frames(detections, parity) for parity in (0, 1))
    print(f"\nEuRoC cam0, {len(even.seen_frames)} frames to calibrate, {len(odd.seen_frames)} to judge:\n")
    print(
        "| views | fx | cx | held back: median (px) | held back: rms of the better 98 % (px) |\n|---|---|---|---|---|"
    )
    for name, views in (("all", None), (f"{chosen} first", chosen)):
        calibration = jaxcal.calibrate_cameras([even], target, views=views)
        error = np.linalg.norm(held_back_residuals(calibration, [odd])[0], axis=1)
        error = np.sort(error[np.isfinite(error)])
        rms = np.sqrt(np.mean(error[: int(0.98 * len(error))] ** 2))
        fx, _, cx, _ = np.asarray(calibration.cameras[0].model.intrinsics)
        print(f"| {name} | {fx:.2f} | {cx:.2f} | {np.median(error):.4f} | {rms:.4f} |", flush=True)


def _frames(detections: jaxcal.Detections, parity: int) -> jaxcal.Detections:
    rows = detections.frame % 2 == parity
    return jaxcal.Detections(
        detections.timestamps_ns,
        detections.frame[rows],
        detections.point[rows],
        detections.pixels[rows],
        detections.image_size,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=50, help="how many views to choose (50)")
    parser.add_argument("--of", type=int, default=2000, help="out of how many simulated ones (2000)")
    chosen = parser.parse_args()
    simulated(chosen.of, chosen.views)
    whole_calibrations(chosen.of, chosen.views)
    if "JAXCAL_DATA" in os.environ:
        real(Path(os.environ["JAXCAL_DATA"]), chosen.views)
    else:
        print("\nSet JAXCAL_DATA for the real recording.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
