"""Studies: scatter agrees with sigma; rows do not depend on workers, kills or order; files mean what they say."""

import csv
import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from studied import EXAMPLE, base_calibration

from jaxcal import Calibration, CalibrationError, resolve
from jaxcal.cli import main
from jaxcal.studies import Study, StudyResult, load_result, load_study, run_study
from jaxcal.studies.resample import generator, moments_of, part_weights, parts_of, with_weights
from jaxcal.studies.store import RowStore, read_rows
from jaxcal.studies.tables import tidy_table
from jaxcal.studies.tasks import Payload, Task, chunks_of, execute, plan
from jaxcal.studies.workers import in_processes


@pytest.fixture(scope="module")
def base() -> Calibration:
    return base_calibration()


@pytest.fixture(scope="module")
def bootstrap(base: Calibration, tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    return run_study(Study(kind="bootstrap", runs=150, seed=1), tmp_path_factory.mktemp("boot"), base=base, workers=2)


def without_times(rows: Any) -> list[dict[str, Any]]:
    """Rows less what a clock says."""
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


def assert_agree(rows: Any, others: Any) -> None:
    """Equal but for rounding: a process of its own may compile the same programs otherwise (see tests/conftest.py)."""
    (values, tree), (other_values, other_tree) = (
        jax.tree.flatten(without_times(rows)),
        jax.tree.flatten(without_times(others)),
    )
    assert tree == other_tree
    for value, other in zip(values, other_values, strict=True):
        assert value == (pytest.approx(other, rel=1e-9, abs=1e-12) if isinstance(other, float) else other)


# --- what a study says -----------------------------------------------------------------------------------------------


def test_a_bootstrap_scatters_as_the_sigmas_say(bootstrap: StudyResult) -> None:
    assert not bootstrap.failed
    assert all(row["converged"] for row in bootstrap.rows)
    assert 0.8 < bootstrap.pooled_ratio < 1.2
    for p in bootstrap.parameters:
        assert 0.6 < p.ratio < 1.5, p.name
        assert abs(p.bias) < 0.5 * p.stated_sigma


def test_fresh_noise_scatters_as_the_sigmas_say_and_in_proportion(base: Calibration, tmp_path: Path) -> None:
    study = Study(kind="monte-carlo", runs=100, seed=2, sweep={"corner_noise_px": (0.05, 0.2)})
    result = run_study(study, tmp_path, base=base, workers=1)
    half = len(result.parameters) // 2
    for quiet, loud in zip(result.parameters[:half], result.parameters[half:], strict=True):
        assert dict(quiet.settings) == {"corner_noise_px": 0.05}
        assert loud.std / quiet.std == pytest.approx(4.0, rel=0.02)  # the same random numbers, four times as large
        assert 0.75 < quiet.ratio < 1.3
        assert quiet.rms_in_sigmas == pytest.approx(loud.rms_in_sigmas, rel=0.05)
    noise = [row["noise_px"]["left"] for row in result.rows if row["settings"] == {"corner_noise_px": 0.2}][1:]
    assert np.mean(noise) == pytest.approx(0.2, rel=0.01)


def test_leaving_views_out_gives_the_jackknifes_sigma(base: Calibration, tmp_path: Path) -> None:
    result = run_study(Study(kind="leave-one-out", by="segments", segments=16), tmp_path, base=base, workers=1)
    assert len(result.rows) == 17
    assert 0.6 < result.pooled_ratio < 1.4


def test_a_compiled_run_is_what_a_whole_calibration_gives(base: Calibration, tmp_path: Path) -> None:
    study = Study(kind="leave-one-out", runs=1)
    result = run_study(study, tmp_path, base=base, workers=1)
    moments = moments_of(base)
    weights = (np.arange(len(moments.times_s)) != 3).astype(float)
    whole = resolve(base, detections=with_weights(base, moments, weights, repeat=True))
    row = next(row for row in result.rows if row["run"] == 3)
    blocks = result.blocks(row)
    for camera in whole.cameras:
        sigma = base.std(f"{camera.name}.intrinsics")
        found = blocks[f"{camera.name}.intrinsics"].values
        assert np.abs(found - np.asarray(camera.model.intrinsics)).max() < 0.02 * sigma.min()
        assert row["noise_px"][camera.name] == pytest.approx(camera.corner_sigma_px, rel=2e-3)
    np.testing.assert_allclose(blocks["right.T_cn_cnm1"].sigma[3:], 1e3 * whole.std("right.T_cn_cnm1")[3:], rtol=0.02)


# --- the same whoever computes it ------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32), run=st.integers(0, 10**6), views=st.integers(4, 60))
def test_a_runs_random_numbers_follow_from_seed_and_number_alone(seed: int, run: int, views: int) -> None:
    study = Study(kind="bootstrap", seed=seed)
    weights = part_weights(study, views, run)
    np.testing.assert_array_equal(weights, part_weights(study, views, run))
    assert weights.sum() == views
    assert part_weights(study, views, run, halves=True).sum() == views // 2
    assert generator(seed, run).integers(2**60) != generator(seed, run + 1).integers(2**60)
    segments = parts_of(Study(kind="bootstrap", by="segments", segments=4), np.random.default_rng(run).random(views))
    assert set(np.bincount(segments, minlength=4)) <= {views // 4, -(-views // 4)}


def test_rows_do_not_depend_on_workers_or_on_how_tasks_are_cut(
    base: Calibration, bootstrap: StudyResult, tmp_path: Path
) -> None:
    other = run_study(Study(kind="bootstrap", runs=150, seed=1), tmp_path, base=base, workers=1)
    assert without_times(other.rows) == without_times(bootstrap.rows)
    payload = Payload(Study(kind="bootstrap", runs=150, seed=1), base, tmp_path)
    tasks = [task for task in plan(payload) if task.run in (140, 3, 77)]
    assert len(chunks_of(payload, tasks)) == 1
    by_index = {row["index"]: row for row in without_times(bootstrap.rows)}
    assert without_times(execute(payload, tasks[::-1])) == [by_index[task.index] for task in tasks[::-1]]


def test_a_study_of_more_runs_goes_on_where_one_of_fewer_ended(
    base: Calibration, bootstrap: StudyResult, tmp_path: Path
) -> None:
    run_study(Study(kind="bootstrap", runs=20, seed=1), tmp_path, base=base, workers=1)
    seen: list[int] = []
    more = Study(kind="bootstrap", runs=60, seed=1)
    result = run_study(more, tmp_path, base=base, workers=1, progress=lambda _, done, __: seen.append(done))
    assert seen[0] == 21
    assert without_times(result.rows) == without_times(bootstrap.rows)[:61]


# --- the store -------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(data=st.data(), count=st.integers(1, 6))
def test_a_file_cut_anywhere_loses_no_complete_row_and_keeps_no_other(
    data: st.DataObject, count: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("store")
    rows = [{"index": k, "text": "é" * k, "value": 0.1 * k} for k in range(count)]
    store = RowStore(folder, {"kind": "test"})
    sizes = [0]
    for row in rows:
        store.append([row])
        sizes.append(store.path.stat().st_size)
    cut = data.draw(st.integers(0, sizes[-1]))
    store.path.write_bytes(store.path.read_bytes()[:cut])
    # A row whose line end alone is missing is complete.
    complete = sum(size - 1 <= cut for size in sizes[1:])
    again = RowStore(folder, {"kind": "test"})
    assert [again.rows[k] for k in sorted(again.rows)] == rows[:complete]
    again.append(rows)
    again.append(rows[:1])
    assert read_rows(folder) == rows


def test_another_study_is_refused_the_folder(base: Calibration, tmp_path: Path) -> None:
    run_study(Study(kind="leave-one-out", by="segments", segments=4), tmp_path, base=base, workers=1)
    with pytest.raises(CalibrationError, match=r"holds another study; it differs in seed \(seed: 0 there, 7 here\)"):
        run_study(Study(kind="leave-one-out", by="segments", segments=4, seed=7), tmp_path, base=base)
    cameras = (dataclasses.replace(base.cameras[0], inlier=~base.cameras[0].inlier), *base.cameras[1:])
    moved = dataclasses.replace(base, cameras=cameras)
    with pytest.raises(CalibrationError, match="differs in base"):
        run_study(Study(kind="leave-one-out", by="segments", segments=4), tmp_path, base=moved)


def test_a_study_killed_at_any_moment_goes_on(base: Calibration, bootstrap: StudyResult, tmp_path: Path) -> None:
    base.save(tmp_path / "base")
    (tmp_path / "s.yaml").write_text("kind: bootstrap\ncalibration: base\nruns: 150\nseed: 1\n")
    command = [sys.executable, "-m", "jaxcal.cli", "study", str(tmp_path / "s.yaml"), "--workers", "1"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rows = tmp_path / "s" / "rows.jsonl"
    for _ in range(3000):
        if process.poll() is not None or (rows.exists() and len(read_rows(rows.parent)) > 1):
            break
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = read_rows(rows.parent)
    assert 1 < len(before) <= 151
    done = CliRunner().invoke(main, ["study", str(tmp_path / "s.yaml"), "--json"])
    assert done.exit_code == 0, done.output
    assert read_rows(rows.parent)[: len(before)] is not None
    assert_agree(read_rows(rows.parent), bootstrap.rows)
    assert json.loads(done.output)["observed_over_stated"] == pytest.approx(bootstrap.pooled_ratio)
    after = {row["index"]: row for row in read_rows(rows.parent)}
    assert all(after[row["index"]] == row for row in before)  # kept, not made again


# --- processes and clusters ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_worker_process_that_is_killed_loses_nothing(base: Calibration, tmp_path: Path) -> None:
    base.save(tmp_path / "base")
    study = Study(kind="recordings", recordings=(tmp_path / "base",) * 40)
    payload = Payload(study, None, tmp_path)
    tasks = plan(payload)
    store, killed = RowStore(tmp_path / "out", {}), []
    for rows in in_processes(payload, chunks_of(payload, tasks), workers=2):
        store.append(rows)
        if not killed:
            killed.append(child_of_this_process())
            os.kill(killed[0], signal.SIGKILL)
    lines = store.path.read_bytes().splitlines()
    assert len(lines) == len(store.rows) == 40  # nothing lost, nothing twice
    by_hand = {row["index"]: row for row in without_times(execute(payload, tasks))}
    assert {row["index"]: row for row in without_times(store.rows.values())} == by_hand


def test_a_run_that_always_ends_its_worker_is_named(tmp_path: Path) -> None:
    payload = Payload(Study(kind="bootstrap", settings={"views": Deadly()}), None, tmp_path)
    with pytest.raises(CalibrationError, match=r"run 0 ended its worker process 3 times"):
        list(in_processes(payload, [[Task(0, 0, 0, "deadly")]], workers=1))


class Deadly:
    """What ends the process that unpickles it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (9,)


def child_of_this_process() -> int:
    """The process id of a worker of the study."""
    own = Path(f"/proc/{os.getpid()}/task")
    children = [int(pid) for task in own.iterdir() for pid in (task / "children").read_text().split()]
    return next(pid for pid in children if b"jaxcal.studies" in Path(f"/proc/{pid}/cmdline").read_bytes())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Dask warns of the machine's clocks and ports
def test_on_a_dask_cluster_a_killed_worker_loses_nothing(
    base: Calibration, bootstrap: StudyResult, tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster:
        pids = [worker.pid for worker in cluster.workers.values()]
        first = threading.Event()

        def kill_one(stage: str, done: int, total: int) -> None:
            if done >= 1 and not first.is_set():
                first.set()
                os.kill(pids[0], signal.SIGKILL)

        study = Study(kind="bootstrap", runs=150, seed=1)
        result = run_study(study, tmp_path, base=base, scheduler=cluster.scheduler_address, progress=kill_one)
    assert first.is_set()
    lines = (tmp_path / "rows.jsonl").read_bytes().splitlines()
    assert len(lines) == len(result.rows) == 151  # nothing lost, nothing twice
    for ours, here in zip(result.rows, bootstrap.rows, strict=True):
        for a, b in zip(ours["blocks"], here["blocks"], strict=True):
            np.testing.assert_allclose(a["values"], b["values"], rtol=1e-9, atol=1e-9)


def test_no_scheduler_is_an_error_that_names_it(base: Calibration, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="no Dask scheduler answers there"):
        run_study(Study(kind="bootstrap", runs=2), tmp_path, base=base, scheduler="tcp://127.0.0.1:9")


# --- recordings, sweeps, files ---------------------------------------------------------------------------------------


def test_recordings_are_held_against_a_reference(base: Calibration, tmp_path: Path) -> None:
    base.save(tmp_path / "monday")
    moments = moments_of(base)
    for name, first in (("tuesday", 0), ("wednesday", 1)):
        weights = np.arange(len(moments.times_s)) % 2 == first
        resolve(base, detections=with_weights(base, moments, weights.astype(float), repeat=False)).save(tmp_path / name)
    for camera in base.cameras:
        camera.detections.save(tmp_path / f"{camera.name}.npz")
    (tmp_path / "board.yaml").write_text(json.dumps(base.target.to_yaml()))
    (tmp_path / "s.yaml").write_text(
        "kind: recordings\nrecordings: [monday, tuesday, wednesday, [left.npz, right.npz]]\ntarget: board.yaml\n"
        "reference: monday/camchain.yaml\n"
    )
    result = run_study(load_study(tmp_path / "s.yaml"), tmp_path / "out", workers=1)
    assert [row["label"] for row in result.rows] == ["monday", "tuesday", "wednesday", "left"]
    table = tidy_table(result)
    first = [abs(table["deviation"][k]) for k, label in enumerate(table["label"]) if label == "monday"]
    assert max(first) < 1e-9
    later = [table["in_sigmas"][k] for k, label in enumerate(table["label"]) if label in ("tuesday", "wednesday")]
    assert 0.2 < np.sqrt(np.nanmean(np.square(later))) < 2.0


def test_a_sweep_tries_every_combination_and_tells_what_failed(base: Calibration, tmp_path: Path) -> None:
    study = Study(kind="sweep", sweep={"camera_model": ("pinhole-radtan", "pinhole-radtan5"), "views": (16, 2)})
    result = run_study(study, tmp_path, base=base, workers=1)
    assert [row["status"] for row in result.rows] == ["ok", "failed", "ok", "failed"]
    assert "views=2" in result.failed[0]["error"]
    with (tmp_path / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["camera_model"], row["views"]) for row in rows][2] == ("pinhole-radtan5", "16")
    assert load_result(study, tmp_path).rows == result.rows


def test_tables_hold_the_same_as_csv_and_as_parquet(bootstrap: StudyResult, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    from jaxcal.studies.tables import write_tables

    write_tables(bootstrap, tmp_path)
    with (tmp_path / "study.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = parquet.read_table(tmp_path / "study.parquet").to_pydict()
    assert len(rows) == len(columns["value"]) == 151 * 22
    assert [float(row["value"]) for row in rows] == columns["value"]
    assert {row["parameter"] for row in rows} >= {"fx", "k1", "rx", "tz"}


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_figure_is_drawn(bootstrap: StudyResult, tmp_path: Path, suffix: str) -> None:
    from jaxcal.studies.figure import write_figure

    path = tmp_path / f"boxes{suffix}"
    write_figure(bootstrap, path)
    content = path.read_bytes()
    assert content.startswith(b"\x89PNG" if suffix == ".png" else b"<?xml")
    if suffix == ".svg":
        assert b"right.T_cn_cnm1" not in content or len(content) > 10_000
    with pytest.raises(CalibrationError, match="pictures end in"):
        write_figure(bootstrap, tmp_path / "boxes.txt")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "bootstrp"}, "kind 'bootstrp' is unknown. Did you mean 'bootstrap'"),
        ({"run": 5}, "unknown key 'run'. Did you mean 'runs'"),
        ({"runs": 0}, "runs is 0; expected a whole number, 1 or more"),
        ({"by": "view"}, "by 'view' is unknown. Did you mean 'views'"),
        ({"sweep": {"spline_oder": [4]}}, "sweep: 'spline_oder' is no setting. Did you mean 'spline_order'"),
        ({"sweep": {"spline_order": [4]}}, "'spline_order' is no setting of calibrate_cameras"),
        ({"sweep": {"camera_model": ["pinhole-radtam"]}}, "Did you mean 'pinhole-radtan'"),
        ({"calibration": "nowhere"}, "calibration: .*nowhere does not exist"),
        ({"recordings": ["base"]}, "recordings are for 'kind: recordings'"),
        ({"settings": {"corner_noise_px": 0.1}}, "corner_noise_px is for 'kind: monte-carlo'"),
        ({"settings": {"window_ms": 20}}, "a saved calibration holds no events"),
    ],
)
def test_mistakes_are_named(base: Calibration, change: dict[str, Any], message: str, tmp_path: Path) -> None:
    base.save(tmp_path / "base")
    (tmp_path / "study.yaml").write_text(json.dumps({**EXAMPLE, **change}))
    with pytest.raises(CalibrationError, match=message):
        run_study(load_study(tmp_path / "study.yaml"), tmp_path / "out", workers=1)


def test_the_command_says_what_it_found(base: Calibration, tmp_path: Path) -> None:
    base.save(tmp_path / "base")
    (tmp_path / "study.yaml").write_text(json.dumps({**EXAMPLE, "runs": 20}))
    done = CliRunner().invoke(main, ["study", str(tmp_path / "study.yaml"), "--plot", str(tmp_path / "b.png")])
    assert done.exit_code == 0, done.output
    assert "observed over stated sigma" in done.output
    assert (tmp_path / "b.png").exists()
    assert (tmp_path / "study" / "summary.csv").exists()
    shown = CliRunner().invoke(main, ["study", "--help"]).output
    for kind in ("bootstrap", "monte-carlo", "leave-one-out", "recordings", "sweep"):
        assert f"kind: {kind}" in shown
