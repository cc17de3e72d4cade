"""Write the README's table of results: run the built-in rig and the README's two real rigs, and fill in what came out.

    JAXCAL_DATA=path/to/recordings python experiments/readme_results.py

Runs take minutes each; what is cached (recordings, frames, corners) is not made again.
"""

import argparse
import os
import re
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import platformdirs

import jaxcal
from jaxcal.pipeline import run_pipeline
from jaxcal.results.ground_truth import compare_with_ground_truth
from jaxcal.simulation import paper_rig, write_recording

README = Path(__file__).resolve().parent.parent / "README.md"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    if "JAXCAL_DATA" not in os.environ:
        print("error: set JAXCAL_DATA to the folder of real recordings.", file=sys.stderr)
        return 1
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
            calibrations[name] = run_pipeline(rig, Path(folder) / f"out-{name}")
            rows += rows_of(name, calibrations[name], time.monotonic() - start)
        truth = truth_sentence(calibrations["built-in"], built_in.parent / "ground_truth.yaml")
    block = "\n".join([*rows, "", truth])
    filled = f"<!-- results -->\n{block}\n<!-- /results -->"
    README.write_text(re.sub(r"<!-- results -->.*<!-- /results -->", lambda _: filled, text, flags=re.S))
    print(block)
    return 0


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
        lens = ", ".join(f"{v:.2f} ± {s:.2f}" for v, s in zip(values, sigmas, strict=True))
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
