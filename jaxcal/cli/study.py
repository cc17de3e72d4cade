"""`jaxcal study`: many calibrations, and how far their results repeat."""

import json
from pathlib import Path

import click


@click.command()
@click.argument("study_file", metavar="STUDY.YAML", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--out",
    "--output",
    "-o",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for rows, tables and figure.",
)
@click.option("--workers", type=click.IntRange(min=1), help="Processes or threads on this machine (one per core).")
@click.option("--scheduler", metavar="tcp://HOST:PORT", help="Run on the Dask cluster of this scheduler instead.")
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Box plots: out.png, .svg or .pdf.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def study(
    study_file: Path, out: Path | None, workers: int | None, scheduler: str | None, plot: Path | None, as_json: bool
) -> None:
    """Repeat calibrations as STUDY.YAML says, and tell how far the results scatter.

    \b
    Are the sigmas true, for these views and this noise? (bootstrap.yaml)
        kind: bootstrap            # views drawn anew with replacement, 1000 times
        calibration: result/       # what jaxcal saved
        runs: 1000
        by: views                  # or segments (of time; needed with an IMU)

    \b
        jaxcal study bootstrap.yaml --plot boxes.png

    \b
    The same with fresh noise, at three levels of it, for two lenses:
        kind: monte-carlo
        calibration: result/
        runs: 200
        sweep: {corner_noise_px: [0.1, 0.2, 0.4], camera_model: [pinhole-radtan, pinhole-equi]}

    \b
    Does one view, or ten seconds, spoil it?
        kind: leave-one-out
        calibration: result/
        by: segments
        segments: 12

    \b
    Did the rig stay as it was, week by week?
        kind: recordings
        recordings: [week1/rig.yaml, week2/rig.yaml, week3/result/]
        reference: cad.yaml        # a calibration of any tool, or a simulation's ground_truth.yaml

    \b
    Which settings matter?
        kind: sweep
        rig: rig.yaml              # or calibration: result/
        sweep: {window_ms: [20, 33, 50], knot_rate_hz: [20, 50]}

    Other keys: seed; settings (done otherwise in all runs: arguments of calibrate_cameras or calibrate_camera_imu);
    target (of recordings that are detections files); full: true (whole calibrations, with outlier rejection anew, also
    where the runs fit into one compiled call).

    OUT (by default a folder named as STUDY.YAML is) gets study.csv, a row per run and parameter, runs.csv, summary.csv,
    and study.parquet where pyarrow is installed (pip install 'jaxcal[parquet]'). Rows are stored as they come: started
    again, a study goes on. Results depend on the seed, not on the number of workers.
    """
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.studies import load_study, run_study
    from jaxcal.studies.figure import PICTURES, write_figure
    from jaxcal.studies.tables import summary_table, summary_text

    if plot is not None and plot.suffix not in PICTURES:
        raise click.UsageError(f"{plot}: pictures end in .png, .svg or .pdf.")
    wanted = load_study(study_file)
    folder = out or study_file.with_suffix("")
    with ProgressBars() as bars:
        result = run_study(wanted, folder, workers=workers, scheduler=scheduler, progress=bars)
    if plot is not None:
        write_figure(result, plot)
    if as_json:
        facts = {"kind": wanted.kind, "against": result.against, "failed": len(result.failed), "out": str(folder)}
        ratio = result.pooled_ratio if result.pooled_ratio == result.pooled_ratio else None
        table = summary_table(result)
        rows = [dict(zip(table, map(_finite, values), strict=True)) for values in zip(*table.values(), strict=True)]
        click.echo(json.dumps({**facts, "observed_over_stated": ratio, "summary": rows}, indent=2))
        return
    click.echo(summary_text(result), nl=False)
    click.echo(f"tables: {folder.resolve()}")
    if plot is not None:
        click.echo(f"{plot}: written")


def _finite(value: object) -> object:
    """JSON has no NaN."""
    return None if isinstance(value, float) and value != value else value
