"""`run_study`: from a study to its rows, tables and figure."""

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.errors import CalibrationError
from jaxcal.progress import Progress, no_progress
from jaxcal.results import Calibration, load_calibration
from jaxcal.studies import workers as places
from jaxcal.studies.estimates import Block, reference_blocks
from jaxcal.studies.spec import Study
from jaxcal.studies.store import RowStore
from jaxcal.studies.summary import StudyResult
from jaxcal.studies.tables import write_tables
from jaxcal.studies.tasks import Payload, Task, chunks_of, plan


def run_study(
    study: Study,
    folder: str | Path,
    *,
    base: Calibration | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress = no_progress,
) -> StudyResult:
    """Do what of a study is not in `folder` already, and write its tables there.

    Rows are stored as they come (`rows.jsonl`); a study that was interrupted goes on. At the end `study.csv` (a row per
    run and parameter), `runs.csv`, `summary.csv`, and `study.parquet` where pyarrow is installed. `base` is the
    calibration to start from, in place of `study.source`. `workers` processes (or threads, where the runs are one
    compiled call; None: one per core) do the work, or the Dask cluster whose scheduler is at `scheduler` ('tcp://...').
    Rows do not depend on who computes them, nor on the order.

    Raises CalibrationError when the study does not fit its calibration, and when `folder` holds another study.
    """
    folder = Path(folder)
    if study.kind != "recordings" and base is None and study.source is None:
        raise CalibrationError(f"kind '{study.kind}' needs a calibration or a rig.yaml to start from.")
    payload = Payload(study, base if base is not None else _base(study, folder, progress), folder)
    tasks = plan(payload)
    store = RowStore(folder, _identity(payload))
    wanted = {task.index for task in tasks}
    chunks = chunks_of(payload, [task for task in tasks if task.index not in store.rows])
    done = len(tasks) - sum(len(chunk) for chunk in chunks)
    progress(study.kind, done, len(tasks))
    for rows in _results(payload, chunks, workers, scheduler):
        store.append(rows)
        done += len(rows)
        progress(study.kind, done, len(tasks))
    kept = [store.rows[index] for index in sorted(wanted)]
    result = StudyResult(study, kept, _reference(study))
    write_tables(result, folder)
    return result


def load_result(study: Study, folder: str | Path) -> StudyResult:
    """The rows that a study's folder holds so far. Raises CalibrationError when there are none."""
    from jaxcal.studies.store import read_rows

    rows = read_rows(Path(folder))
    if not rows:
        raise CalibrationError(f"{folder}: holds no rows of a study.")
    return StudyResult(study, rows, _reference(study))


def _results(
    payload: Payload, chunks: list[list[Task]], workers: int | None, scheduler: str | None
) -> Iterator[places.Rows]:
    count = min(workers or os.cpu_count() or 1, max(len(chunks), 1))
    if scheduler is not None:
        return places.on_dask(payload, chunks, scheduler)
    # What needs no calibrating is done here, rather than in a process that first imports everything.
    if payload.batch is not None or count == 1 or (payload.study.kind == "recordings" and _all_saved(payload.study)):
        return places.in_threads(payload, chunks, count if payload.batch is not None else 1)
    return places.in_processes(payload, chunks, count)


def _all_saved(study: Study) -> bool:
    return (
        not study.settings
        and not study.sweep
        and all(isinstance(entry, Path) and entry.is_dir() for entry in study.recordings)
    )


def _base(study: Study, folder: Path, progress: Progress) -> Calibration | None:
    """The calibration that runs start from: saved, or made from a rig.yaml once. None where each run has its own."""
    if study.source is None:
        return None
    if study.source.suffix not in (".yaml", ".yml"):
        return load_calibration(study.source)
    if "window_ms" in study.sweep or "window_ms" in study.settings:
        if study.kind != "sweep":
            raise CalibrationError("window_ms is for 'kind: sweep'.")
        return None
    made = folder / "calibration"
    if not (made / "calibration.npz").is_file():
        from jaxcal.pipeline import run_pipeline

        run_pipeline(study.source, made, progress=progress)
    return load_calibration(made)


def _reference(study: Study) -> Mapping[str, Block] | None:
    return None if study.reference is None else reference_blocks(study.reference)


def _identity(payload: Payload) -> dict[str, Any]:
    """What rows depend on; not how many there are, nor what they are held against."""
    study = payload.study
    left = ("runs", "reference", "source", "recordings", "target")
    known = {field.name: getattr(study, field.name) for field in dataclasses.fields(study) if field.name not in left}
    if payload.base is not None:
        known["base"] = _digest(payload.base)
    elif study.source is not None:
        known["rig"] = _file_digest(study.source)
    if study.recordings:
        entries = [entry if isinstance(entry, tuple) else (entry,) for entry in study.recordings]
        known["recordings"] = [[_file_digest(path) for path in entry] for entry in entries]
    if study.target is not None:
        known["target"] = _file_digest(study.target)
    return json.loads(json.dumps(known, default=str))


def _digest(calibration: Calibration) -> str:
    digest = hashlib.sha256(json.dumps(dict(calibration.settings), default=str, sort_keys=True).encode())
    for camera in calibration.cameras:
        for part in (camera.model.parameters, camera.detections.pixels, camera.detections.timestamps_ns, camera.inlier):
            digest.update(np.ascontiguousarray(np.asarray(part)).tobytes())
    digest.update(np.ascontiguousarray(calibration.covariance).tobytes())
    return digest.hexdigest()[:32]


def _file_digest(path: Path) -> str:
    file = path / "calibration.npz" if path.is_dir() else path
    if not file.is_file():
        raise CalibrationError(f"{path}: no such file, and no folder of a calibration.")
    return hashlib.sha256(file.read_bytes()).hexdigest()[:32]
