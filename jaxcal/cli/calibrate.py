"""`jaxcal calibrate`: a rig.yaml in, a calibration and its report out."""

from dataclasses import replace
from pathlib import Path

import click

from jaxcal.cli.outcome import EXIT_CODES, RERUN_FILE


@click.command(epilog=EXIT_CODES)
@click.argument("rig", metavar="RIG.yaml", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--output",
    "-o",
    "--out",
    default=Path("out"),
    show_default=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for the results.",
)
@click.option("--window-ms", type=float, help="Length of an event window, where RIG.yaml does not say (33).")
@click.option("--workers", type=int, help="Processes for detection (one per core).")
@click.option("--report/--no-report", default=True, help="Write report.html, too (some seconds).  [default: report]")
@click.option(
    "--cross-validate", is_flag=True, help="Cross-validate the result, too, for the report; see that command."
)
@click.option("--rerun", type=RERUN_FILE, help="Write a log for the Rerun viewer, too: out.rrd (jaxcal[rerun]).")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@click.pass_context
def calibrate(
    ctx: click.Context,
    rig: Path,
    output: Path,
    window_ms: float | None,
    workers: int | None,
    report: bool,
    cross_validate: bool,
    rerun: Path | None,
    as_json: bool,
) -> None:
    """Calibrate the cameras, event cameras and IMUs that a rig.yaml names, jointly.

    \b
    jaxcal init recording/ --target board.yaml        writes recording/rig.yaml for what it finds
    jaxcal calibrate recording/rig.yaml --output out/
    jaxcal calibrate rig.yaml --json > result.json    for scripts

    \b
    A rig.yaml, with most of what it can say; paths are relative to it:
        target: board.yaml                # Kalibr's target.yaml, or its keys right here
        cameras:
          - name: cam0
            model: pinhole-radtan         # or pinhole-equi, ds-none, omni-radtan, mypackage.module:MyCamera
            events: cam0.raw              # one of events (raw, h5, aedat4, bag.bag:/topic, ...),
            resolution: [640, 480]        #   with the sensor's size where the file does not tell it,
          - name: cam1
            model: pinhole-radtan
            frames: cam1                  # frames (EuRoC folder, <time in ns>.png, bag.bag:/topic, 'left*.png')
            rolling_shutter: true         #   whose rows are seen one after another,
          - name: cam2
            model: pinhole-radtan
            detections: corners.npz       # and detections (of `jaxcal detect`, or a corner table)
        imus:                             # leave out to calibrate the cameras alone; one IMU may stand as `imu:`
          - data: imu0/data.csv           # EuRoC csv, npz, or bag.bag:/topic
            noise: imu.yaml               # Kalibr's imu.yaml (`jaxcal imu-noise` makes one), or its keys right here
            model: scale-misalignment     # calibrated (default), scale-misalignment[-size-effect]
        from_to: [5, 60]                  # use only this part; seconds after the first frame
        frame_rate_hz: 10                 # at most so many images a second
        reconstruction: {window_ms: 33}   # events of so long a time make one frame
        calibration:                      # arguments of the job, as in Python
          intrinsics: prior               # with an IMU: free, prior or held, and the calibration they come from
          cameras: earlier/camchain.yaml
          imu_noise: estimated            # also gravity_magnitude, spline_order, knot_rate_hz
          board_warp: true                # the board is bent; also point_offset_sigma_m, loss, max_steps
          # without an IMU: views, time_offsets, sync_tolerance_s

    The folder gets report.html (look there first), Kalibr's camchain and imu.yaml, results.txt and calibration.npz,
    which holds everything. Reconstructed frames and corners are kept in .jaxcal/ beside RIG.yaml: a run that was
    broken off, however it was, goes on where it stopped.
    """
    from jaxcal.recording import load_rig

    described = load_rig(rig)  # a mistake in it is said at once, before the heavy imports
    from jaxcal.cli.outcome import show_calibration
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.pipeline import PipelineSettings, run_pipeline
    from jaxcal.results import load_cross_validation
    from jaxcal.results.rerun_file import require_rerun, write_rerun

    if rerun is not None:
        require_rerun(rerun)
    settings = PipelineSettings(report=report, cross_validate=cross_validate)
    if window_ms is not None:
        settings = replace(settings, window_ms=window_ms)
    with ProgressBars() as bars:
        calibration = run_pipeline(described, output, settings=settings, workers=workers, progress=bars)
    if rerun is not None:
        write_rerun(calibration, rerun)
    truth = rig.parent / "ground_truth.yaml"
    found = load_cross_validation(output) if cross_validate else None
    status = show_calibration(calibration, output, as_json=as_json, ground_truth=truth, cross_validation=found)
    ctx.exit(status)
