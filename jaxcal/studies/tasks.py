"""The tasks of a study, and how one is done: wherever it runs, a task gives the same row."""

import functools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal.calibration import calibrate_cameras
from jaxcal.calibration.resolving import check_changes, recordings_of, resolve
from jaxcal.errors import CalibrationError
from jaxcal.observations import Detections
from jaxcal.results import Calibration, load_calibration
from jaxcal.studies import resample
from jaxcal.studies.compiled import Batch, ManyFits, batch_of, run_batch
from jaxcal.studies.estimates import Block, blocks_of
from jaxcal.studies.spec import OWN_SETTINGS, RESAMPLING, Study

# Runs per compiled call: enough to hide what a call costs, few enough that rows come often.
BATCH_RUNS = 50
ALL = "all"


@dataclass(frozen=True)
class Task:
    """One calibration: `combination` of the sweep, `run` in it (-1: with all measurements as they are), `label`."""

    index: int
    combination: int
    run: int
    label: str


@dataclass(frozen=True)
class Payload:
    """What all tasks of a study need: the study, the calibration it starts from, and its folder."""

    study: Study
    base: Calibration | None
    folder: Path

    @functools.cached_property
    def batch(self) -> Batch | None:
        """The base's problem for compiled runs; None where runs are whole calibrations."""
        return batch_of(self.base) if self.base is not None and _compiles(self.study, self.base) else None

    @functools.cached_property
    def moments(self) -> resample.Moments:
        """The views of the base calibration and their times, looked up when first asked for."""
        assert self.base is not None
        return resample.moments_of(self.base)


def plan(payload: Payload) -> list[Task]:
    """All tasks of a study, in a fixed order. Raises CalibrationError where study and calibration do not fit."""
    study = payload.study
    if payload.base is not None:
        _check(study, payload.base)
    labels: list[tuple[int, str]]
    if study.kind == "recordings":
        labels = list(enumerate(_names(study.recordings)))
    elif study.kind == "sweep":
        labels = [(-1, ALL)]
    else:
        part = study.by.rstrip("s")
        count = _parts(payload) if study.kind == "leave-one-out" else study.runs
        what = f"without {part}" if study.kind == "leave-one-out" else "run"
        labels = [(-1, ALL), *((k, f"{what} {k}") for k in range(count))]
    # Numbered run by run, so that a study of more runs goes on where one of fewer ended.
    many = len(study.combinations)
    return [Task(k * many + c, c, run, label) for k, (run, label) in enumerate(labels) for c in range(many)]


def chunks_of(payload: Payload, tasks: Sequence[Task]) -> list[list[Task]]:
    """Tasks that are done in one go: runs of one compiled call, or one calibration each."""
    if payload.batch is None:
        return [[task] for task in tasks]
    whole = [[task] for task in tasks if task.run < 0]
    for c in range(len(payload.study.combinations)):
        own = [task for task in tasks if task.combination == c and task.run >= 0]
        whole += [own[k : k + BATCH_RUNS] for k in range(0, len(own), BATCH_RUNS)]
    return whole


def execute(payload: Payload, tasks: Sequence[Task]) -> list[dict[str, Any]]:
    """Do tasks and give their rows. A calibration that is impossible gives a row that says so."""
    if payload.batch is not None and tasks[0].run >= 0:
        return _compiled_rows(payload, payload.batch, tasks)
    return [_row(payload, task) for task in tasks]


# --- whole calibrations ----------------------------------------------------------------------------------------------


def _row(payload: Payload, task: Task) -> dict[str, Any]:
    settings = payload.study.combinations[task.combination]
    start = time.perf_counter()
    row: dict[str, Any] = {
        "index": task.index,
        "combination": task.combination,
        "settings": settings,
        "run": task.run,
        "label": task.label,
    }
    try:
        found = _calibration(payload, task, {**payload.study.settings, **settings})
    except CalibrationError as error:
        return row | {"status": "failed", "error": str(error), "seconds": time.perf_counter() - start}
    return row | {
        "status": "ok",
        "error": "",
        "seconds": time.perf_counter() - start,
        "converged": found.converged,
        "warnings": len(found.warnings),
        "noise_px": {camera.name: camera.corner_sigma_px for camera in found.cameras},
        "blocks": [block.to_json() for block in blocks_of(found)],
    }


def _calibration(payload: Payload, task: Task, settings: Mapping[str, Any]) -> Calibration:
    study, base = payload.study, payload.base
    if study.kind == "recordings":
        return _of_recording(payload, task, settings)
    if base is None:
        assert study.source is not None
        return _pipeline(study.source, payload.folder / "calibrations" / f"{task.index:05d}", settings)
    changes = _changes(settings, len(base.cameras))
    if task.run < 0:
        # What noise is added to in a Monte Carlo study is true as it is.
        return resolve(base, **changes) if changes and study.kind != "monte-carlo" else base
    if study.kind == "monte-carlo":
        rng = resample.generator(study.seed, task.run)
        detections, imus = resample.renoised(base, rng, settings.get("corner_noise_px"))
        return resolve(base, detections=detections, imu=imus or None, **changes)
    moments, repeat = payload.moments, _repeats(base)
    parts = resample.parts_of(study, moments.times_s)
    weights = resample.part_weights(study, int(parts.max()) + 1, task.run, halves=not repeat)
    return resolve(base, detections=resample.with_weights(base, moments, weights[parts], repeat), **changes)


def _of_recording(payload: Payload, task: Task, settings: Mapping[str, Any]) -> Calibration:
    entry = payload.study.recordings[task.run]
    paths = entry if isinstance(entry, tuple) else (entry,)
    if paths[0].suffix in (".yaml", ".yml"):
        return _pipeline(paths[0], payload.folder / "calibrations" / f"{task.index:05d}", settings)
    if len(paths) == 1 and (paths[0].is_dir() or _is_calibration(paths[0])):
        found = load_calibration(paths[0])
        changes = _changes(settings, len(found.cameras))
        return resolve(found, **changes) if changes else found
    if payload.study.target is None:
        raise CalibrationError(f"{paths[0]}: detections need the study's 'target'.")
    from jaxcal.targets import load_target

    detections = [Detections.load(path) for path in paths]
    return calibrate_cameras(detections, load_target(payload.study.target), **_changes(settings, len(paths)))


def _pipeline(rig: Path, output: Path, settings: Mapping[str, Any]) -> Calibration:
    """The whole way from recordings; detections and frames are cached beside the rig."""
    from jaxcal.pipeline import PipelineSettings, run_pipeline
    from jaxcal.recording import load_rig

    options: dict[str, Any] = {"report": False}
    if "window_ms" in settings:
        if load_rig(rig).reconstruction.window_ms is not None:
            raise CalibrationError(f"{rig}: says window_ms itself. Take it out there, so that the study can set it.")
        options["window_ms"] = float(settings["window_ms"])
    own = {name: value for name, value in settings.items() if name not in OWN_SETTINGS}
    options["cameras" if load_rig(rig).imu is None else "camera_imu"] = own
    found = run_pipeline(rig, output, settings=PipelineSettings(**options), workers=1)
    if "camera_model" not in settings:
        return found
    return resolve(found, models=[settings["camera_model"]] * len(found.cameras))


def _changes(settings: Mapping[str, Any], cameras: int) -> dict[str, Any]:
    """Arguments of the calibration's job."""
    changes = {name: value for name, value in settings.items() if name not in OWN_SETTINGS}
    if "camera_model" in settings:
        changes["models"] = [settings["camera_model"]] * cameras
    return changes


def _is_calibration(path: Path) -> bool:
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
        return "meta" in data.files


def _names(recordings: Sequence[Path | tuple[Path, ...]]) -> list[str]:
    """A short name for each recording, none twice."""
    names: list[str] = []
    for entry in recordings:
        path = entry[0] if isinstance(entry, tuple) else entry
        name = path.stem if path.is_dir() or path.stem not in ("rig", "calibration") else path.resolve().parent.name
        names.append(name if name not in names else f"{name} #{len(names)}")
    return names


# --- checks ----------------------------------------------------------------------------------------------------------


def _repeats(base: Calibration) -> bool:
    """Whether a moment may stand there twice: where no trajectory ties moments together."""
    settings = base.settings
    return base.imu is None and not settings.get("time_offsets") and not any(settings.get("rolling_shutter", ()))


def _compiles(study: Study, base: Calibration) -> bool:
    plain = {*study.settings, *study.sweep} <= {"corner_noise_px"}
    return study.kind in RESAMPLING and not study.full and plain and _repeats(base)


def _check(study: Study, base: Calibration) -> None:
    changes = {name: None for name in (*study.settings, *study.sweep) if name not in OWN_SETTINGS}
    check_changes(str(base.settings.get("job", "calibrate_cameras")), changes)
    if "window_ms" in (*study.settings, *study.sweep):
        raise CalibrationError("window_ms: a saved calibration holds no events. Give the rig.yaml: 'rig: rig.yaml'.")
    if study.kind in ("bootstrap", "leave-one-out") and study.by == "views" and not _repeats(base):
        raise CalibrationError(
            f"{study.kind} by views: this calibration's views are tied together by a trajectory. Use 'by: segments'."
        )
    if base.imu is not None:
        recordings_of(base)


def _parts(payload: Payload) -> int:
    batch = payload.batch
    times = payload.moments.times_s if batch is None else batch.known.times_s
    return int(resample.parts_of(payload.study, times).max()) + 1


# --- compiled runs ---------------------------------------------------------------------------------------------------


def _compiled_rows(payload: Payload, batch: Batch, tasks: Sequence[Task]) -> list[dict[str, Any]]:
    study, start = payload.study, time.perf_counter()
    # Always as many runs, so that there is one program, and each row the same however tasks were cut into calls.
    runs = [task.run for task in tasks]
    runs += [runs[-1]] * (BATCH_RUNS - len(runs))
    settings = {**study.settings, **study.combinations[tasks[0].combination]}
    parts = resample.parts_of(study, batch.known.times_s)
    count = int(parts.max()) + 1
    of_view = np.stack([resample.part_weights(study, count, run)[parts] for run in runs])
    pixels = None
    if study.kind == "monte-carlo":
        chosen = settings.get("corner_noise_px")
        noise = batch.noise_px
        if chosen is not None:
            cameras = batch.known.calibration.cameras
            noise = [n * float(chosen) / camera.corner_sigma_px for n, camera in zip(noise, cameras, strict=True)]
        pixels = [resample.noisy(batch.fitted, noise, resample.generator(study.seed, run)) for run in runs]
    fits = run_batch(batch, pixels, of_view)
    seconds = (time.perf_counter() - start) / len(tasks)
    names = [camera.name for camera in batch.known.calibration.cameras]
    template = blocks_of(batch.known.calibration)
    return [
        {
            "index": task.index,
            "combination": task.combination,
            "settings": study.combinations[task.combination],
            "run": task.run,
            "label": task.label,
            "status": "ok",
            "error": "",
            "seconds": seconds,
            "converged": bool(fits.converged[k]),
            "warnings": 0,
            "noise_px": dict(zip(names, fits.sigmas[k].tolist(), strict=True)),
            "blocks": [block.to_json() for block in _fitted_blocks(batch, fits, k, template)],
        }
        for k, task in enumerate(tasks)
    ]


def _fitted_blocks(batch: Batch, fits: ManyFits, run: int, template: Sequence[Block]) -> list[Block]:
    """The blocks of one run, in the units of the calibration's own."""
    calibration, layout, states = batch.known.calibration, batch.known.layout, fits.states
    values: dict[str, np.ndarray] = {}
    places = []
    for c, camera in enumerate(calibration.cameras):
        group, place = layout.place(c)
        lens, count = np.asarray(states.lenses[group])[run, place], camera.model.num_intrinsics
        values[f"{camera.name}.intrinsics"], values[f"{camera.name}.distortion"] = lens[:count], lens[count:]
        places.append(_matrix(np.asarray(states.R_cam_rig)[run, c], np.asarray(states.t_cam_rig)[run, c]))
        if c:
            values[f"{camera.name}.T_cn_cnm1"] = places[c] @ np.linalg.inv(places[c - 1])
    for b in range(layout.extra_boards):
        rotation, shift = np.asarray(states.target.R_target_board), np.asarray(states.target.t_target_board)
        values[f"target.T_target_board{b + 1}"] = _matrix(rotation[run, b], shift[run, b])
    if layout.warp:
        values["target.warp"] = 1e3 * np.asarray(states.target.warp)[run]
    rows = _rows_of(calibration)
    scale = {"deg": np.degrees(1.0), "mm": 1e3}
    return [
        Block(
            block.name,
            block.labels,
            block.units,
            values[block.name],
            fits.std[run, rows[block.name]] * np.array([scale.get(unit, 1.0) for unit in block.units]),
        )
        for block in template
    ]


def _rows_of(calibration: Calibration) -> dict[str, slice]:
    rows, start = {}, 0
    for name, size in calibration.blocks:
        rows[name] = slice(start, start + size)
        start += size
    return rows


def _matrix(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, translation
    return out
