"""The corridor: from files to a calibration, with everything cached that took long."""

import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import h5py
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from jaxcal import Calibration, CalibrationError, Checkerboard, Detections, compare, run_pipeline
from jaxcal import pipeline as pipeline_module
from jaxcal.cameras import PinholeRadtan
from jaxcal.event_frames import LAG_SIGMA_S
from jaxcal.observations import Events, Frames
from jaxcal.pipeline import PipelineSettings
from jaxcal.progress import no_progress
from jaxcal.recording import EventFile, convert_events, load_rig
from jaxcal.results import load_cross_validation
from jaxcal.results.cross_validation import CrossValidation, Evidence, Halves

BOARD = Checkerboard(rows=5, cols=8, spacing=0.05)
TARGET = BOARD.to_yaml()
SIZE = (320, 240)
LENS = PinholeRadtan.create([300.0, 302.0, 160.5, 118.0], [-0.2, 0.05, 0.001, -0.001])
BASELINE = np.array([-0.1, 0.0, 0.0])
FAST = PipelineSettings(report=False)


def write_rig(folder: Path, cameras: list[dict[str, Any]], **more: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.yaml").write_text(yaml.safe_dump({"target": TARGET, "cameras": cameras, **more}))
    return folder / "rig.yaml"


def simulated_detections(seed: int) -> list[Detections]:
    """What two cameras side by side see of a board in 30 poses, with 0.1 px of noise."""
    rng = np.random.default_rng(seed)
    seen: list[list[tuple[int, np.ndarray]]] = [[], []]
    centred = BOARD.points - BOARD.points.mean(axis=0)
    for frame in range(30):
        turn = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0] @ np.diag([1.0, -1.0, -1.0])
        place = np.array([rng.uniform(-0.05, 0.15), rng.uniform(-0.08, 0.08), rng.uniform(0.55, 0.9)])
        for camera, offset in enumerate((np.zeros(3), BASELINE)):
            pixels = np.asarray(LENS.project(jnp.asarray(centred @ turn.T + place + offset)))
            if ((pixels > 0) & (pixels < np.array(SIZE) - 1)).all():
                seen[camera].append((frame, pixels + rng.normal(0, 0.1, pixels.shape)))
    times = 1_600_000_000_000_000_000 + np.arange(30) * 100_000_000
    count = len(BOARD.points)
    return [
        Detections(
            times,
            np.repeat([frame for frame, _ in views], count),
            np.tile(np.arange(count), len(views)),
            np.concatenate([pixels for _, pixels in views]),
            SIZE,
        )
        for views in seen
    ]


def test_detection_files_become_a_calibration(tmp_path: Path) -> None:
    for name, detections in zip(("left", "right"), simulated_detections(0), strict=True):
        detections.save(tmp_path / f"{name}.npz")
    cameras = [{"name": n, "model": "pinhole-radtan", "detections": f"{n}.npz"} for n in ("left", "right")]
    stages: list[str] = []
    calibration = run_pipeline(
        write_rig(tmp_path, cameras),
        tmp_path / "out",
        settings=FAST,
        progress=lambda stage, _, __: stages.append(stage),
    )
    assert [camera.name for camera in calibration.cameras] == ["left", "right"]
    for camera in calibration.cameras:
        assert np.asarray(camera.model.intrinsics) == pytest.approx(np.asarray(LENS.intrinsics), abs=3.0)
        assert camera.reprojection_rms_px < 0.2
    assert calibration.cameras[1].T_cn_cnm1 is not None
    assert calibration.cameras[1].T_cn_cnm1[:3, 3] == pytest.approx(BASELINE, abs=2e-3)
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"calibration.npz", "camchain.yaml", "results.txt"}
    assert stages


def test_a_cross_validation_asked_for_is_kept_and_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[CrossValidation] = []

    def validate(calibration: Calibration, **_: Any) -> CrossValidation:
        halves = Halves("in turns", compare(calibration, calibration), 9.0, 8, 0.34)
        found.append(CrossValidation((halves,), (Evidence("lens", "cam0", 1.0, 2, 0.6, -1.0),)))
        return found[0]

    monkeypatch.setattr(pipeline_module, "cross_validate", validate)
    simulated_detections(0)[0].save(tmp_path / "cam0.npz")
    rig = write_rig(tmp_path, [{"name": "cam0", "model": "pinhole-radtan", "detections": "cam0.npz"}])
    run_pipeline(rig, tmp_path / "out", settings=PipelineSettings(cross_validate=True))
    kept = load_cross_validation(tmp_path / "out")
    assert kept is not None
    assert kept.text() == found[0].text()
    assert found[0].headline in (tmp_path / "out" / "report.html").read_text()


def test_mistakes_in_the_rig_are_reported_before_any_work(tmp_path: Path) -> None:
    simulated_detections(0)[0].save(tmp_path / "left.npz")
    (tmp_path / "cam1").mkdir()
    cameras = [
        {"name": "cam1", "model": "pinhole-radtan", "frames": "cam1"},  # would fail later: the folder is empty
        {"name": "left", "model": "pinhole-radtn", "detections": "left.npz"},
    ]
    with pytest.raises(CalibrationError, match=r"'pinhole-radtn' is unknown. Did you mean 'pinhole-radtan'"):
        run_pipeline(write_rig(tmp_path, cameras), tmp_path / "out")


# --- frames from events: a network that is quick and whose frames can be foretold ----------------------------------


class CountingNetwork:
    """Paints each window's number of events; has weights, as the real ones, and shows the end of the window."""

    shown_at = 1.0

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def state_dict(self) -> dict[str, Any]:
        import torch

        return {"weight": torch.tensor([self.weight])}


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Stands in for the `reconstruction` package; `.windows` lists what it was asked to reconstruct."""
    fake = SimpleNamespace(weight=1.0, windows=[])

    def reconstruct(
        windows: Iterable[tuple[int, Events, bool, int]],
        network: CountingNetwork,
        *,
        width: int,
        height: int,
        **options: Any,
    ) -> Iterator[tuple[int, np.ndarray]]:
        fake.options = options
        for end, events, wanted, shown in windows:
            fake.windows.append((end, len(events)))
            if wanted:
                yield shown, np.full((height, width), len(events) % 256, np.uint8)

    fake.load_network = lambda path=None: CountingNetwork(fake.weight)
    fake.reconstruct = reconstruct
    monkeypatch.setitem(sys.modules, "reconstruction", fake)
    return fake


@pytest.fixture
def handed_over(monkeypatch: pytest.MonkeyPatch) -> dict[str, Frames]:
    """The frames of each camera as detection gets them; the pipeline ends there."""
    got: dict[str, Frames] = {}

    class Enough(Exception):
        pass

    def remember(frames: Frames, *_: Any, name: str, **__: Any) -> Detections:
        got[name] = frames
        return simulated_detections(0)[0]

    def stop(*_: Any, **__: Any) -> None:
        raise CalibrationError("stopped by the test")

    monkeypatch.setattr(pipeline_module, "detect", remember)
    monkeypatch.setattr(pipeline_module, "_calibrated", stop)
    return got


T0_US = 1_600_000_000_000_123


@pytest.fixture
def event_rig(tmp_path: Path) -> Path:
    for name in ("cam0", "cam1"):
        rng = np.random.default_rng(len(name))
        t = T0_US + np.sort(rng.integers(0, 200_000, 3_000))
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file["t"], file["p"] = t, rng.integers(0, 2, len(t))
            file["x"], file["y"] = rng.integers(0, 32, len(t)), rng.integers(0, 24, len(t))
    cameras = [
        {"name": n, "model": "pinhole-radtan", "events": f"{n}.h5", "resolution": [32, 24]} for n in ("cam0", "cam1")
    ]
    return write_rig(tmp_path, cameras)


def walk(rig: Path, settings: PipelineSettings = FAST) -> None:
    with pytest.raises(CalibrationError, match="stopped by the test"):
        run_pipeline(rig, rig.parent / "out", settings=settings)


def test_frames_carry_the_end_of_their_window(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]
) -> None:
    walk(event_rig, PipelineSettings(window_ms=20.0))
    frames = handed_over["cam0"]
    assert frames.image_size == (32, 24)
    assert np.all(frames.timestamps_ns % 20_000_000 == 0)
    assert np.all(np.diff(frames.timestamps_ns) == 20_000_000)
    assert np.array_equal(frames.timestamps_ns, handed_over["cam1"].timestamps_ns)  # cameras share their times
    with EventFile(event_rig.parent / "cam0.h5", 32, 24) as events:
        for index, end in enumerate(frames.timestamps_ns):
            expected = len(events.window(int(end) - 20_000_000, int(end))) % 256
            assert np.all(frames.images[index] == expected)


def test_a_part_of_the_recording(event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]) -> None:
    times = T0_US * 1000 + np.arange(20) * 10_000_000
    (event_rig.parent / "cam2").mkdir()
    for t in times:
        cv2.imwrite(str(event_rig.parent / "cam2" / f"{t}.png"), np.zeros((24, 32), np.uint8))
    content = yaml.safe_load(event_rig.read_text()) | {"from_to": [0.05, 0.15], "frame_rate_hz": 50}
    content["cameras"].append({"name": "cam2", "model": "pinhole-radtan", "frames": "cam2"})
    event_rig.write_text(yaml.safe_dump(content))
    walk(event_rig, PipelineSettings(window_ms=10.0))
    for name in ("cam0", "cam1", "cam2"):
        since = handed_over[name].timestamps_ns - times[0]
        assert len(since) in (5, 6)
        assert since.min() >= 50_000_000
        assert since.max() <= 150_000_000
    assert max(count for _, count in network.windows) < 600  # the first window does not hold all that was skipped
    event_rig.write_text(yaml.safe_dump(content | {"from_to": [5, 6]}))
    with pytest.raises(CalibrationError, match=r"cam2: no frame lies between 5.00 s and 6.00 s"):
        run_pipeline(event_rig, event_rig.parent / "out", settings=FAST)


def test_frames_made_of_events_have_stamps_that_may_lag(event_rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: Any, stamp_sigma_s: Any, **__: Any) -> None:
        raise CalibrationError(f"sigmas {stamp_sigma_s}")

    monkeypatch.setattr(pipeline_module, "calibrate_cameras", stop)
    both = load_rig(event_rig)
    one = replace(both, cameras=(replace(both.cameras[0], events=None, frames=Path()), both.cameras[1]))
    for rig, options, sigmas in (
        (both, {}, [LAG_SIGMA_S, LAG_SIGMA_S]),
        (one, {}, [0.0, LAG_SIGMA_S]),
        (one, {"stamp_sigma_s": 1e-4}, 1e-4),
    ):
        with pytest.raises(CalibrationError, match=re.escape(f"sigmas {sigmas}")):
            pipeline_module._calibrated(rig, [], [], options, no_progress)


def test_options_of_the_job_are_checked_before_any_work(event_rig: Path, network: SimpleNamespace) -> None:
    content = yaml.safe_load(event_rig.read_text())
    event_rig.write_text(yaml.safe_dump(content | {"calibration": {"vews": 20}}))
    with pytest.raises(CalibrationError, match=r"rig.yaml: calibration: unknown key 'vews'. Did you mean 'views'"):
        run_pipeline(event_rig, event_rig.parent / "out", settings=FAST)
    assert not network.windows


def test_frames_are_made_once(event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]) -> None:
    walk(event_rig)
    made = len(network.windows)
    assert made > 8
    walk(event_rig)
    assert len(network.windows) == made
    walk(event_rig, PipelineSettings(window_ms=50.0))
    assert len(network.windows) > made


@pytest.mark.parametrize("change", ["weights", "events"])
def test_frames_are_made_again_when_their_origin_changes(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames], change: str
) -> None:
    walk(event_rig)
    made = len(network.windows)
    if change == "weights":
        network.weight = 2.0
    else:
        with h5py.File(event_rig.parent / "cam0.h5", "a") as file:
            file["x"][0] = 31 - file["x"][0]
    walk(event_rig)
    assert len(network.windows) == (2 * made if change == "weights" else made + made // 2)
    assert len(list((event_rig.parent / ".jaxcal" / "frames").iterdir())) == 2  # the old ones are gone


@pytest.mark.parametrize("suffix", [".npz", ".txt"])
def test_frames_do_not_depend_on_the_format_of_the_events(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames], suffix: str
) -> None:
    walk(event_rig)
    times, images = handed_over["cam0"].timestamps_ns, list(handed_over["cam0"].images)
    source = event_rig.parent / "cam0.h5"
    with EventFile(source, 32, 24) as events:
        convert_events(events, source.with_suffix(suffix))
    event_rig.write_text(event_rig.read_text().replace("cam0.h5", f"cam0{suffix}"))
    walk(event_rig)
    assert np.array_equal(handed_over["cam0"].timestamps_ns, times)
    assert np.array_equal(list(handed_over["cam0"].images), images)


def test_an_interrupted_reconstruction_leaves_nothing_half_done(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]
) -> None:
    def stop(stage: str, done: int, _: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_pipeline(event_rig, event_rig.parent / "out", settings=FAST, progress=stop)
    assert list((event_rig.parent / ".jaxcal" / "frames").iterdir()) == []
    walk(event_rig)
    assert len(handed_over["cam0"]) == len(handed_over["cam1"]) > 3


def test_without_an_imu_event_frames_share_the_times_of_the_frames(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]
) -> None:
    times = T0_US * 1000 + np.arange(-1, 10) * 25_000_000 + 777
    (event_rig.parent / "cam2").mkdir()
    for t in times:
        cv2.imwrite(str(event_rig.parent / "cam2" / f"{t}.png"), np.zeros((24, 32), np.uint8))
    content = yaml.safe_load(event_rig.read_text())
    content["cameras"].append({"name": "cam2", "model": "pinhole-radtan", "frames": "cam2"})
    event_rig.write_text(yaml.safe_dump(content))
    walk(event_rig)
    shared = handed_over["cam0"].timestamps_ns
    assert len(shared) >= 7
    assert set(shared) <= set(times)


def add_to_rig(rig: Path, **more: Any) -> None:
    rig.write_text(yaml.safe_dump(yaml.safe_load(rig.read_text()) | more))


def test_the_rig_says_how_frames_are_made(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]
) -> None:
    add_to_rig(event_rig, reconstruction={"rate_hz": 50, "upsample_rate": 3, "auto_hdr": True, "Imin": 0.1})
    walk(event_rig, PipelineSettings(reconstructor={"auto_hdr": False}))
    frames = handed_over["cam0"]
    assert np.all(frames.timestamps_ns % 20_000_000 == 0)
    per_camera = len(network.windows) / 2
    assert 2.5 * len(frames) < per_camera <= 3 * len(frames)
    assert network.options == {"auto_hdr": False, "Imin": 0.1}  # what is asked for in Python goes before the rig


def test_hot_pixels_are_found_for_each_camera(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]
) -> None:
    with h5py.File(event_rig.parent / "cam1.h5", "a") as file:
        for name, value in (("x", 5), ("y", 7)):
            file[name][::20] = value  # pyright: ignore[reportIndexIssue]
    walk(event_rig)
    made = len(network.windows)
    add_to_rig(event_rig, reconstruction={"hot_pixels": "auto"})
    walk(event_rig)
    assert network.options["hot_pixels"].tolist() == [[5, 7]]
    assert len(network.windows) == 2 * made  # other options, other frames


def test_event_frames_at_the_stamps_of_a_frame_camera(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]
) -> None:
    times = T0_US * 1000 + np.arange(1, 7) * 25_000_000 + 777
    (event_rig.parent / "cam2").mkdir()
    for t in times:
        cv2.imwrite(str(event_rig.parent / "cam2" / f"{t}.png"), np.zeros((24, 32), np.uint8))
    cameras = yaml.safe_load(event_rig.read_text())["cameras"]
    cameras.append({"name": "cam2", "model": "pinhole-radtan", "frames": "cam2"})
    add_to_rig(event_rig, cameras=cameras, reconstruction={"stamps_of": "cam2", "time_offset_ms": 2.5})
    walk(event_rig)
    assert np.array_equal(handed_over["cam0"].timestamps_ns, times + 2_500_000)


def test_event_frames_for_each_knot_of_the_spline(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]
) -> None:
    times = 1000 * T0_US + np.arange(200) * 1_000_000
    rows = [f"{t},{0.1 * np.sin(n)},0,0,0,0,9.81" for n, t in enumerate(times)]
    (event_rig.parent / "imu.csv").write_text("\n".join(["#t,w,w,w,a,a,a", *rows]) + "\n")
    noise = dict.fromkeys(("gyroscope_noise_density", "gyroscope_random_walk"), 1e-3)
    noise |= dict.fromkeys(("accelerometer_noise_density", "accelerometer_random_walk"), 1e-2)
    imu = {"data": "imu.csv", "noise": noise | {"update_rate": 1000.0}}
    add_to_rig(event_rig, imu=imu, reconstruction={"rate_hz": "auto"}, calibration={"knot_rate_hz": 40.0})
    walk(event_rig)
    np.testing.assert_array_equal(np.diff(handed_over["cam0"].timestamps_ns), 25_000_000)


def test_recordings_shorter_than_a_window_or_endless_are_refused(event_rig: Path, network: SimpleNamespace) -> None:
    with pytest.raises(CalibrationError, match=r"cam0.h5: the recording is .* ms long, shorter than one window"):
        run_pipeline(event_rig, event_rig.parent / "out", settings=PipelineSettings(window_ms=10_000.0))
    with h5py.File(event_rig.parent / "cam0.h5", "a") as file:
        file["t"][-1] = T0_US + 10**15
    with pytest.raises(CalibrationError, match=r"cam0.h5: the events span .* free of jumps"):
        run_pipeline(event_rig, event_rig.parent / "out", settings=FAST)


def test_the_cache_moves_where_it_can_be_written(
    event_rig: Path, network: SimpleNamespace, handed_over: dict[str, Frames]
) -> None:
    (event_rig.parent / ".jaxcal").write_text("not a folder")
    walk(event_rig)
    assert (event_rig.parent / "out" / "cache" / "frames").is_dir()


def test_torch_is_imported_only_where_there_are_events() -> None:
    code = "import sys, jaxcal, jaxcal.pipeline, jaxcal.recording, jaxcal.detection; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == "False"
