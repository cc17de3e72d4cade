"""The main job: calibrate all cameras and the IMU of a rig jointly, from ordinary recordings.

Without arguments: simulate the built-in hybrid rig (two event cameras, two frame cameras, one IMU, a checkerboard),
write it as ordinary recordings, calibrate it from those files alone, and print the result beside the truth.

With --rig: calibrate what your rig.yaml names, as `jaxcal calibrate rig.yaml` does (see its --help for all that a
rig.yaml can say). All paths in it are relative to its folder:

    target: target.yaml              # Kalibr's target.yaml, or its keys right here
    cameras:
      - name: cam0
        model: pinhole-radtan        # pinhole-none, pinhole-radtan, pinhole-equi, or mypackage.mymodule:MyCamera
        events: cam0/events.h5       # one of events (h5 with x, y, p, t in microseconds) ...
        resolution: [640, 480]
      - name: cam1
        model: pinhole-radtan
        frames: cam1                 # ... frames (EuRoC/ASL folder: data.csv and data/, or <time in ns>.png) ...
      - name: cam2
        model: pinhole-radtan
        detections: observations.npz # ... or detections (of jaxcal, or a corner table with the prefix's columns)
        prefix: cam0
        resolution: [752, 480]
    imu:                             # leave out to calibrate the cameras alone
      data: imu0/data.csv            # EuRoC csv: time in ns, gyroscope rad/s, accelerometer m/s^2
      noise: imu.yaml                # Kalibr's imu.yaml, or its keys right here
    reconstruction:                  # optional
      window_ms: 33                  # events of this long a time make one frame
      network: null                  # weights; null: the network that comes with jaxcal

A checkerboard's rows and columns are INNER corners. Nothing is guessed from names: no initial values are read.
"""

import argparse
import logging
import sys
import time
from pathlib import Path

import platformdirs

import jaxcal
from jaxcal.cli.outcome import show_calibration
from jaxcal.cli.progress_bars import ProgressBars
from jaxcal.pipeline import PipelineSettings, run_pipeline


def main() -> int:
    arguments = parse_arguments()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    bars = ProgressBars()
    try:
        start = time.monotonic()
        rig = arguments.rig or simulated_rig(arguments.recording, bars)
        settings = (
            PipelineSettings() if arguments.window_ms is None else PipelineSettings(window_ms=arguments.window_ms)
        )
        calibration = run_pipeline(rig, arguments.output, settings=settings, workers=arguments.workers, progress=bars)
        bars.close()
        show_calibration(calibration, arguments.output, ground_truth=rig.parent / "ground_truth.yaml")
        print(f"done in {time.monotonic() - start:.0f} s")
    except jaxcal.CalibrationError as error:
        bars.close()
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", type=Path, help="your rig.yaml; without it the built-in rig is simulated")
    parser.add_argument(
        "--output", type=Path, default=Path("out/multicam"), help="folder for the results (%(default)s)"
    )
    parser.add_argument(
        "--recording", type=Path, help="folder for the simulated recording (default: in the user's cache folder)"
    )
    parser.add_argument("--window-ms", type=float, help="length of an event window, where rig.yaml does not say")
    parser.add_argument("--workers", type=int, help="processes for simulation and detection (default: one per core)")
    return parser.parse_args()


def simulated_rig(recording: Path | None, bars: ProgressBars) -> Path:
    """The rig.yaml of the built-in rig's recording, simulated unless it is there already."""
    from jaxcal.simulation import paper_rig, write_recording

    folder = recording or Path(platformdirs.user_cache_dir("jaxcal")) / "recordings" / "paper_rig"
    return write_recording(paper_rig(), folder, progress=bars, workers=2)


if __name__ == "__main__":
    sys.exit(main())
