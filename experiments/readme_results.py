"""Write the README's tables: run the built-in rig, the README's two real rigs, the cameras alone, the benchmarks.

    JAXCAL_DATA=path/to/recordings python experiments/readme_results.py
    JAXCAL_DATA=path/to/recordings python experiments/readme_results.py --only cameras speed

Runs take minutes each, 'truth' and 'stress' hours: their hundreds of calibrations are kept in the user's cache, whence
they go on. The simulated recording is kept there, too; frames and corners are made anew.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import platformdirs

import jaxcal
from jaxcal.pipeline import PipelineSettings, run_pipeline
from jaxcal.recording.tables import load_detections
from jaxcal.results.ground_truth import compare_with_ground_truth
from jaxcal.simulation import paper_rig, write_recording

SECTIONS = ("results", "cameras", "truth", "stress", "speed", "imu-speed")
README = Path(__file__).resolve().parent.parent / "README.md"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS, help="tables to write (default: all)")
    chosen = parser.parse_args()
    if "JAXCAL_DATA" not in os.environ:
        print("error: set JAXCAL_DATA to the folder of real recordings.", file=sys.stderr)
        return 1
    for section in chosen.only:
        makers = {
            "results": rig_table,
            "cameras": camera_table,
            "truth": truth_table,
            "stress": stress_table,
            "speed": lambda: printed_by("bench_cameras.py"),
            "imu-speed": lambda: printed_by("bench_camera_imu.py"),
        }
        block = makers[section]()
        filled = f"<!-- {section} -->\n{block}\n<!-- /{section} -->"
        pattern = rf"<!-- {section} -->.*<!-- /{section} -->"
        README.write_text(re.sub(pattern, lambda _, filled=filled: filled, README.read_text(), flags=re.S))
        print(block)
    return 0


def rig_table() -> str:
    """Rigs with an IMU, through the pipeline."""
    text = README.read_text()
    rows = [
        "| rig | camera | fx, fy, cx, cy (px) | reprojection error (px rms) | time offset (ms) | time of the run (s) |",
        "|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(platformdirs.user_cache_dir("jaxcal")) / "recordings" / "paper_rig"
        built_in = write_recording(paper_rig(), recording, workers=2)
        rigs = {"built-in": built_in}
        for name in ("dvxplorer", "euroc"):
            rigs[name] = Path(folder) / name / "rig.yaml"
            rigs[name].parent.mkdir()
            rigs[name].write_text(rig_in(text, name))
        calibrations = {}
        for name, rig in rigs.items():
            start = time.monotonic()
            # Frames and corners made anew: the time is that of a first run.
            settings = PipelineSettings(cache=Path(folder) / f"cache-{name}")
            calibrations[name] = run_pipeline(rig, Path(folder) / f"out-{name}", settings=settings)
            rows += rows_of(name, calibrations[name], time.monotonic() - start)
        truth = truth_sentence(calibrations["built-in"], built_in.parent / "ground_truth.yaml")
    return "\n".join([*rows, "", truth])


def camera_table() -> str:
    """Real cameras without an IMU: a 24 Mpx fisheye by several models, EuRoC's stereo pair, OpenCV's sample."""
    data = Path(os.environ["JAXCAL_DATA"])
    rows = [
        "| recording | model | fx, fy, cx, cy (px) | rms of a coordinate (px) | left out | time (s) |",
        "|---|---|---|---|---|---|",
    ]
    board, detections = fisheye(data / "real_fisheye_24mp" / "observations.npz")
    for model, warp in (("pinhole-equi", True), ("pinhole-rational8", False), ("pinhole-rational8", True)):
        name = f"{model}{', board warp' if warp else ''}"
        rows += camera_rows("24 Mpx fisheye (mrcal)", name, [detections], board, [model], board_warp=warp)
    grid = jaxcal.AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)
    table = data / "euroc_imu_april" / "observations.npz"
    pair = [load_detections(table, grid, (752, 480), name) for name in ("cam0", "cam1")]
    rows += camera_rows("EuRoC stereo", "pinhole-radtan", pair, grid, None)
    images = [
        cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((data / "opencv_stereo").glob("left*.jpg"))
    ]
    frames = jaxcal.Frames(np.arange(len(images)), [np.asarray(image) for image in images], (640, 480))
    chessboard = jaxcal.Checkerboard(rows=6, cols=9, spacing=1.0)
    corners = jaxcal.detect(frames, chessboard)
    rows += camera_rows("OpenCV sample, left", "pinhole-radtan", [corners], chessboard, None)
    return "\n".join(rows)


def fisheye(path: Path) -> tuple[jaxcal.Checkerboard, jaxcal.Detections]:
    """mrcal's corners; its detector says how well it found each."""
    with np.load(path) as table:
        pixels, weight = table["pixels"], table["weight"]
    pixels, weight = pixels.reshape(len(pixels), -1, 2), weight.reshape(len(weight), -1)
    frame, point = np.nonzero(weight > 0)
    times = np.arange(len(pixels)) * 1_000_000_000
    detections = jaxcal.Detections(times, frame, point, pixels[frame, point], (6016, 4016), weight[frame, point])
    return jaxcal.Checkerboard(rows=10, cols=10, spacing=0.077), detections


def camera_rows(title: str, name: str, detections: list, target: jaxcal.Target, models: list | None, **options) -> list:
    """One row per camera; the residuals count by the precision that the detector states."""
    start = time.monotonic()
    calibration = jaxcal.calibrate_cameras(detections, target, models, **options)
    seconds = time.monotonic() - start
    rows = []
    for camera in calibration.cameras:
        values, sigmas = np.asarray(camera.model.intrinsics), calibration.std(f"{camera.name}.intrinsics")
        lens = ", ".join(f"{v:.2f} ± {s:.2f}" for v, s in zip(values, sigmas, strict=True))
        precision = camera.detections.precision
        scaled = camera.residuals_px * (1.0 if precision is None else precision[:, None])
        rms, lost = np.sqrt(np.mean(scaled[camera.used] ** 2)), 100 * (1 - camera.inlier.mean())
        rows.append(f"| {title} {camera.name} | {name} | {lens} | {rms:.3f} | {lost:.2f} % | {seconds:.1f} |")
    return rows


def truth_table() -> str:
    """What `validate_camera_imu.py` prints; runs that the cache holds are not made again."""
    return kept_study("validate_camera_imu", "--out")


def stress_table() -> str:
    """The sum of what `stress_initialisation.py` prints of 500 problems; those that the cache holds are not solved
    again."""
    told = kept_study("stress_initialisation", "--problems", "500", "--seed", "0", "--output")
    rows = [line for line in told.splitlines() if line.startswith(("| |", "|---", "| all |"))]
    return "\n".join(rows)


def kept_study(name: str, *options: str) -> str:
    """What a script of this folder prints; its last option takes the folder in the cache that keeps its rows."""
    script, rows = Path(__file__).with_name(f"{name}.py"), Path(platformdirs.user_cache_dir("jaxcal")) / name
    command = [sys.executable, str(script), *options, str(rows)]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


def printed_by(name: str) -> str:
    """What a benchmark says."""
    script = Path(__file__).with_name(name)
    done = subprocess.run([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout.strip()


def rig_in(text: str, name: str) -> str:
    """The README's yaml block that begins with '# rig: name'."""
    found = re.search(rf"```yaml\n(# rig: {name}\n.*?)```", text, flags=re.S)
    if found is None:
        raise jaxcal.CalibrationError(f"{README}: no yaml block begins with '# rig: {name}'.")
    return found.group(1)


def rows_of(name: str, calibration: jaxcal.Calibration, seconds: float) -> list[str]:
    """One table row per camera: values with their sigma."""
    rows = []
    for camera in calibration.cameras:
        values, sigmas = np.asarray(camera.model.intrinsics), calibration.std(f"{camera.name}.intrinsics")
        lens = ", ".join(f"{v:.3f} ± {s:.3f}" for v, s in zip(values, sigmas, strict=True))
        offset = "-"
        if camera.timeshift_cam_imu is not None:
            sigma = calibration.std(f"{camera.name}.timeshift_cam_imu")[0]
            offset = f"{camera.timeshift_cam_imu * 1e3:.3f} ± {sigma * 1e3:.3f}"
        error = f"{camera.reprojection_rms_px:.3f}"
        rows.append(f"| {name} | {camera.name} | {lens} | {error} | {offset} | {seconds:.0f} |")
    return rows


def truth_sentence(calibration: jaxcal.Calibration, ground_truth: Path) -> str:
    """The built-in rig against its truth, in one sentence."""
    parameters = compare_with_ground_truth(calibration, ground_truth)
    ratios = np.array([abs(p.error_in_sigmas) for p in parameters if p.error_in_sigmas is not None])
    return (
        f"On the built-in rig, {np.mean(ratios < 3) * 100:.0f} % of {len(ratios)} numbers lie within 3 sigma of the "
        f"truth; the largest deviation is {ratios.max():.1f} sigma."
    )


if __name__ == "__main__":
    sys.exit(main())
