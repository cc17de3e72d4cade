"""Writing a simulated rig as ordinary recordings, as if a stranger had made them."""

import csv
import dataclasses
import hashlib
import io
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import yaml

from jaxcal.atomic import write_text
from jaxcal.cameras import CameraModel, model_name
from jaxcal.errors import CalibrationError
from jaxcal.observations import ImuRecording
from jaxcal.progress import Progress, no_progress
from jaxcal.simulation.event_sensor import EventArrays
from jaxcal.simulation.imaging import simulate_events, simulate_frames
from jaxcal.simulation.measurements import simulate_imu
from jaxcal.simulation.rig import SimulatedCamera, SimulatedRig
from jaxcal.simulation.worker_pool import run_jobs

# Raise this when the simulation changes what it writes, so that older recordings are made anew.
_VERSION = 1

_MARKER = "simulation.json"
_EVENTS_PER_WRITE = 1 << 20
_EVENTS_PER_CHUNK = 1 << 17
_PER_MILLE = 1000


def write_recording(rig: SimulatedRig, folder: str | Path, progress: Progress = no_progress, workers: int = 2) -> Path:
    """Simulate `rig` and write its recordings into `folder`; returns the path of the `rig.yaml` that names them.

    Written are, for each event camera, `<name>/events.h5` (e2calib's layout: x, y, p, and t in microseconds), for
    each frame camera an EuRoC/ASL folder `<name>/` (data.csv and data/<ns>.png), `imu0/data.csv` (EuRoC),
    `target.yaml` and `imu.yaml` (Kalibr), `ground_truth.yaml` and `rig.yaml`. Camera timestamps are on each camera's
    own clock.

    Each file or folder appears whole or not at all. What an earlier call for the same rig completed is kept; after a
    changed setting all is simulated anew. Up to `workers` processes simulate one camera each; with 1 all happens in
    this process. Raises CalibrationError when `folder` holds something else, or when a worker dies.
    """
    folder = Path(folder)
    _claim(rig, folder)
    jobs = [
        (camera.name, _write_camera, (rig, index, folder))
        # Events take longest: they come first.
        for index, camera in sorted(enumerate(rig.cameras), key=lambda entry: entry[1].kind != "events")
        if not _output(camera, folder).exists()
    ]
    run_jobs(jobs, progress, workers)
    if not (folder / "imu0" / "data.csv").exists():
        _write_imu(simulate_imu(rig), folder / "imu0" / "data.csv")
    return _write_descriptions(rig, folder)


# --- what is done already ------------------------------------------------------------------------------------------


def fingerprint(rig: SimulatedRig) -> str:
    """A hash of all that determines a rig's recording."""
    text = json.dumps([_VERSION, _describe(rig)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _describe(value: Any) -> Any:
    """`value` as plain lists and dictionaries."""
    if isinstance(value, CameraModel):
        return [model_name(value), np.asarray(value.parameters).tolist()]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: _describe(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"type": type(value).__name__, **fields}
    if isinstance(value, (list, tuple)):
        return [_describe(item) for item in value]
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    return np.asarray(value).tolist()


def _claim(rig: SimulatedRig, folder: Path) -> None:
    """Make `folder` hold parts of this rig's recording or nothing; CalibrationError when it is somebody else's."""
    marker = folder / _MARKER
    outputs = ["imu0", "target.yaml", "imu.yaml", "ground_truth.yaml", "rig.yaml", *(c.name for c in rig.cameras)]
    mark = {"what": "simulated by jaxcal", "fingerprint": fingerprint(rig), "outputs": outputs}
    old: Any = None
    if marker.exists():
        try:
            old = json.loads(marker.read_text())
        except ValueError as error:
            raise CalibrationError(f"{marker}: damaged ({error}). Delete the folder and simulate again.") from error
        if old == mark:
            return
        for name in old["outputs"]:
            _remove(folder / name)
    elif folder.exists() and any(folder.iterdir()):
        raise CalibrationError(
            f"{folder}: this folder is not empty and no simulation wrote it. Give an empty or a new folder."
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_text(marker, json.dumps(mark, indent=1))


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# --- cameras -------------------------------------------------------------------------------------------------------


def _output(camera: SimulatedCamera, folder: Path) -> Path:
    """What exists once the camera is complete."""
    return folder / camera.name / ("events.h5" if camera.kind == "events" else "data.csv")


def _write_camera(rig: SimulatedRig, index: int, folder: Path, report: Callable[[int, int], None]) -> None:
    """Simulate one camera; `report(done, total)` is called now and then."""
    camera = rig.cameras[index]
    if camera.kind == "events":
        _write_events(rig, index, _output(camera, folder), report)
    else:
        _write_frames(rig, index, folder / camera.name, report)


def _write_events(rig: SimulatedRig, index: int, path: Path, report: Callable[[int, int], None]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    with h5py.File(part, "w") as file:
        file.attrs["width"], file.attrs["height"] = rig.cameras[index].image_size
        for name, dtype in (("x", np.uint16), ("y", np.uint16), ("p", np.uint8), ("t", np.int64)):
            file.create_dataset(
                name, (0,), dtype, maxshape=(None,), chunks=(_EVENTS_PER_CHUNK,), compression="lzf", shuffle=True
            )
        waiting: list[EventArrays] = []
        for share, batch in simulate_events(rig, index):
            waiting.append(batch)
            if sum(len(t) for t, *_ in waiting) >= _EVENTS_PER_WRITE:
                _append_events(file, waiting)
                waiting = []
                report(int(share * _PER_MILLE), _PER_MILLE)
        _append_events(file, waiting)
    os.replace(part, path)
    report(_PER_MILLE, _PER_MILLE)


def _append_events(file: h5py.File, batches: list[EventArrays]) -> None:
    if not batches:
        return
    t_ns, x, y, p = (np.concatenate(arrays) for arrays in zip(*batches, strict=True))
    # A sensor's counter shows whole microseconds that have passed.
    for name, values in (("x", x), ("y", y), ("p", p), ("t", t_ns // 1000)):
        dataset = file[name]
        assert isinstance(dataset, h5py.Dataset)
        start = dataset.shape[0]
        dataset.resize(start + len(values), axis=0)
        dataset[start:] = values


def _write_frames(rig: SimulatedRig, index: int, folder: Path, report: Callable[[int, int], None]) -> None:
    # data.csv is written last: it says that the folder is complete.
    _remove(folder)
    (folder / "data").mkdir(parents=True)
    total = len(rig.frame_times_ns(rig.cameras[index]))
    rows = []
    for done, (time_ns, image) in enumerate(simulate_frames(rig, index), start=1):
        name = f"{time_ns}.png"
        ok, encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not ok:
            raise CalibrationError(f"{folder / 'data' / name}: the image could not be encoded.")
        (folder / "data" / name).write_bytes(encoded.tobytes())
        rows.append((time_ns, name))
        report(done, total)
    _write_csv(folder / "data.csv", ["#timestamp [ns]", "filename"], rows)


# --- IMU and descriptions --------------------------------------------------------------------------------------------


def _write_imu(imu: ImuRecording, path: Path) -> None:
    gyro = [f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"]
    accel = [f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
    values = np.hstack([imu.gyro_rad_s, imu.accel_m_s2]).tolist()
    rows = [
        (time, *(f"{value:.12g}" for value in row))
        for time, row in zip(imu.timestamps_ns.tolist(), values, strict=True)
    ]
    _write_csv(path, ["#timestamp [ns]", *gyro, *accel], rows)


def _write_descriptions(rig: SimulatedRig, folder: Path) -> Path:
    noise = rig.imu_noise
    imu = {
        "accelerometer_noise_density": noise.accel_noise_density,
        "accelerometer_random_walk": noise.accel_random_walk,
        "gyroscope_noise_density": noise.gyro_noise_density,
        "gyroscope_random_walk": noise.gyro_random_walk,
        "rostopic": "/imu0",
        "update_rate": noise.update_rate,
    }
    cameras = [
        {
            "name": camera.name,
            "model": model_name(camera.model),
            camera.kind: f"{camera.name}/events.h5" if camera.kind == "events" else camera.name,
            "resolution": list(camera.image_size),
        }
        for camera in rig.cameras
    ]
    path = folder / "rig.yaml"
    _write_yaml(folder / "target.yaml", rig.target.to_yaml())
    _write_yaml(folder / "imu.yaml", imu)
    _write_yaml(folder / "ground_truth.yaml", rig.ground_truth())
    _write_yaml(
        path,
        {"target": "target.yaml", "cameras": cameras, "imu": {"data": "imu0/data.csv", "noise": "imu.yaml"}},
    )
    return path


def _write_yaml(path: Path, content: Any) -> None:
    write_text(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))


def _write_csv(path: Path, header: list[str], rows: list[tuple[Any, ...]]) -> None:
    content = io.StringIO()
    writer = csv.writer(content, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    write_text(path, content.getvalue())
