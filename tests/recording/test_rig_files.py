"""rig.yaml: what a good one gives, and what each mistake says."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import yaml

from jaxcal import AprilGrid, CalibrationError, Detections, load_rig
from jaxcal.recording import FrameTimes

TARGET = {"target_type": "aprilgrid", "tagRows": 6, "tagCols": 6, "tagSize": 0.088, "tagSpacing": 0.3}
NOISE = {
    "accelerometer_noise_density": 1.4e-3,
    "accelerometer_random_walk": 8.6e-5,
    "gyroscope_noise_density": 8.0e-5,
    "gyroscope_random_walk": 2.2e-6,
}


@pytest.fixture
def content(tmp_path: Path) -> dict[str, Any]:
    """A rig with each kind of camera; its files lie beside it."""
    (tmp_path / "target.yaml").write_text(yaml.safe_dump(TARGET))
    (tmp_path / "imu.yaml").write_text(yaml.safe_dump(NOISE))
    (tmp_path / "imu.csv").write_text("1,0,0,0,0,0,9.8\n2,0,0,0,0,0,9.8\n")
    (tmp_path / "cam1").mkdir()
    for t in (1, 2):
        cv2.imwrite(str(tmp_path / "cam1" / f"{t}.png"), np.zeros((4, 6), np.uint8))
    with h5py.File(tmp_path / "events.h5", "w") as file:
        for name in "xypt":
            file[name] = np.arange(4)
    table = {"left_ns": np.array([1]), "left_point": np.array([2]), "left_uv": np.array([[3.0, 4.0]])}
    np.savez(tmp_path / "table.npz", **table)
    return {
        "target": "target.yaml",
        "cameras": [
            {"name": "cam0", "model": "pinhole-radtan", "events": "events.h5", "resolution": [640, 480]},
            {"name": "cam1", "model": "pinhole-equi", "frames": "cam1"},
            {
                "name": "cam2",
                "model": "pinhole-radtan",
                "detections": "table.npz",
                "prefix": "left",
                "resolution": [9, 9],
            },
        ],
        "imu": {"data": "imu.csv", "noise": "imu.yaml"},
        "reconstruction": {"window_ms": 20, "network": None},
    }


def write(folder: Path, content: Any) -> Path:
    (folder / "rig.yaml").write_text(yaml.safe_dump(content))
    return folder / "rig.yaml"


def test_every_kind_of_camera_opens(tmp_path: Path, content: dict[str, Any]) -> None:
    rig = load_rig(write(tmp_path, content))
    assert rig.target == AprilGrid(rows=6, cols=6, tag_size=0.088, tag_spacing=0.3)
    assert [camera.model for camera in rig.cameras] == ["pinhole-radtan", "pinhole-equi", "pinhole-radtan"]
    with rig.cameras[0].open_events() as events:
        assert len(events) == 4
    assert len(rig.cameras[1].load_frames()) == 2
    corners = rig.cameras[2].load_detections(rig.target)
    assert isinstance(corners, Detections)
    assert corners.pixels.tolist() == [[3.0, 4.0]]
    assert rig.imu is not None
    assert len(rig.imu.load()) == 2
    assert rig.reconstruction.window_ms == 20.0
    for camera, ask in ((1, "open_events"), (0, "load_frames")):
        with pytest.raises(CalibrationError, match=f"camera 'cam{camera}' has no"):
            getattr(rig.cameras[camera], ask)()


def test_inline_target_and_noise(tmp_path: Path, content: dict[str, Any]) -> None:
    filed = load_rig(write(tmp_path, content))
    inline = load_rig(write(tmp_path, content | {"target": TARGET, "imu": {"data": "imu.csv", "noise": NOISE}}))
    assert filed == inline


def test_the_imu_and_reconstruction_are_optional(tmp_path: Path, content: dict[str, Any]) -> None:
    del content["imu"], content["reconstruction"]
    rig = load_rig(write(tmp_path, content))
    assert rig.imu is None
    assert rig.reconstruction.window_ms is None


def test_several_imus_options_and_a_part_of_the_recording(tmp_path: Path, content: dict[str, Any]) -> None:
    one = content.pop("imu")
    content["imus"] = [one, one | {"model": "scale-misalignment"}]
    content["cameras"][1]["rolling_shutter"] = True
    content |= {"from_to": [1, 2.5], "frame_rate_hz": 4, "calibration": {"imu_noise": "given"}}
    rig = load_rig(write(tmp_path, content))
    assert [imu.model for imu in rig.imus] == ["calibrated", "scale-misalignment"]
    assert rig.imu == rig.imus[0]
    assert [camera.rolling_shutter for camera in rig.cameras] == [False, True, False]
    assert rig.span_ns([5_000_000_000, 4_000_000_000]) == (5_000_000_000, 6_500_000_000)
    assert rig.frame_rate_hz == 4.0
    assert rig.calibration == {"imu_noise": "given"}
    alone = load_rig(write(tmp_path, content | {"imus": one, "from_to": None}))
    assert len(alone.imus) == 1
    assert alone.span_ns([0]) is None


def test_images_by_a_pattern_of_names(tmp_path: Path, content: dict[str, Any]) -> None:
    for name in ("left03.png", "left10.png", "right03.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((4, 6), np.uint8))
    content["cameras"][1]["frames"] = "left*.png"
    frames = load_rig(write(tmp_path, content)).cameras[1].load_frames()
    assert frames.timestamps_ns.tolist() == [300_000_000, 1_000_000_000]
    content["cameras"][1]["frames"] = "middle*.png"
    with pytest.raises(CalibrationError, match=r"middle\*.png does not exist"):
        load_rig(write(tmp_path, content))


def change(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """A function that sets (or, for None, removes) the value at a dotted path."""

    def apply(content: Any) -> None:
        *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
        for part in parents:
            content = content[part]
        if value is None:
            del content[last]
        else:
            content[last] = value

    return apply


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("camera", [], "unknown key 'camera'. Did you mean 'cameras'"),
        ("target", None, "'target' is missing"),
        ("target", "absent.yaml", "rig.yaml: target: .*absent.yaml does not exist"),
        ("target", {**TARGET, "tagsize": 1}, "rig.yaml: target: unknown key 'tagsize'. Did you mean 'tagSize'"),
        ("cameras", [], r"rig.yaml: cameras: expected a list of cameras, at least one"),
        ("cameras", {"cam0": 1}, "expected a list of cameras"),
        ("cameras.0", "cam0", r"cameras\[0\]: expected 'key: value' lines"),
        ("cameras.0.event", "events.h5", r"rig.yaml: cameras\[0\]: unknown key 'event'. Did you mean 'events'"),
        ("cameras.0.events", None, r"cameras\[0\]: give exactly one of .*; found none"),
        ("cameras.0.frames", "cam1", "found events and frames"),
        ("cameras.0.resolution", [640], r"cameras\[0\].resolution: expected \[width, height\]"),
        ("cameras.0.resolution", [640, 480.5], "expected .width, height. in pixels"),
        ("cameras.0.name", "a/b", "leave out slashes"),
        ("cameras.0.model", 3, r"cameras\[0\].model: expected a text, found 3"),
        ("cameras.0.prefix", "cam0", r"cameras\[0\].prefix: only a camera with 'detections'"),
        ("cameras.1.name", "cam0", r"cameras\[1\].name: 'cam0' is the name of cameras\[0\] too"),
        ("cameras.1.frames", "cam9", r"cameras\[1\].frames: .*cam9 does not exist"),
        ("imu.nois", "imu.yaml", "rig.yaml: imu: unknown key 'nois'. Did you mean 'noise'"),
        ("imu.data", None, "imu: 'data' is missing"),
        ("imu.noise", {**NOISE, "gyroscope_noise_density": "x"}, "imu.noise: gyroscope_noise_density: expected a pos"),
        (
            "imu.model",
            "scale-misalignmnt",
            "imu.model: 'scale-misalignmnt' is unknown. Did you mean 'scale-misalignment'",
        ),
        ("imu", "imu.csv", "imu: expected 'data:' and 'noise:', or a list"),
        ("imus", [], "give 'imu' or 'imus', not both"),
        ("cameras.0.rolling_shutter", "yes", r"cameras\[0\].rolling_shutter: expected true or false"),
        ("from_to", [3, 2], r"rig.yaml: from_to: expected \[start, end\] in seconds"),
        ("from_to", 3, r"from_to: expected \[start, end\]"),
        ("frame_rate_hz", 0, "frame_rate_hz: expected a positive number"),
        ("calibration", ["views"], "calibration: expected 'key: value' lines"),
        ("reconstruction.window", 20, "reconstruction: unknown key 'window'. Did you mean 'window_ms'"),
        ("reconstruction.rate_hz", 20, "reconstruction: window_ms and rate_hz each say when frames are wanted"),
        ("reconstruction.rate_hz", "often", "reconstruction.rate_hz: expected a positive number"),
        ("reconstruction.stamps_off", "cam1", "unknown key 'stamps_off'. Did you mean 'stamps_of'"),
        ("reconstruction.hotpixels", "auto", "unknown key 'hotpixels'. Did you mean 'hot_pixels'"),
        ("reconstruction.hot_pixels", "absent.txt", "reconstruction.hot_pixels: .* does not exist"),
        ("reconstruction.precision", "float8", "reconstruction.precision: expected one of auto, float32"),
        ("reconstruction.upsample_rate", 1.5, "reconstruction.upsample_rate: expected a whole number"),
        ("reconstruction.unsharp_mask_amount", -1, "reconstruction.unsharp_mask_amount: .* not negative"),
        ("reconstruction.auto_hdr", "yes", "reconstruction.auto_hdr: expected true or false"),
        ("reconstruction.window_ms", 0, "reconstruction.window_ms: expected a positive number"),
        ("reconstruction.network", "absent.safetensors", "reconstruction.network: .* does not exist"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, content: dict[str, Any], path: str, value: Any, message: str) -> None:
    change(path, value)(content)
    with pytest.raises(CalibrationError, match=message):
        load_rig(write(tmp_path, content))


def test_files_that_are_no_rig(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"absent.yaml: no such rig file"):
        load_rig(tmp_path / "absent.yaml")
    (tmp_path / "broken.yaml").write_text("cameras: [")
    with pytest.raises(CalibrationError, match="not a readable yaml file"):
        load_rig(tmp_path / "broken.yaml")
    (tmp_path / "text.yaml").write_text("hello")
    with pytest.raises(CalibrationError, match="expected 'key: value' lines"):
        load_rig(tmp_path / "text.yaml")


def test_image_size_against_the_rig(tmp_path: Path, content: dict[str, Any]) -> None:
    content["cameras"][1]["resolution"] = [640, 480]
    rig = load_rig(write(tmp_path, content))
    with pytest.raises(CalibrationError, match="the images are 6x4, but the rig says 640x480 for 'cam1'"):
        rig.cameras[1].load_frames()


def test_the_reconstruction_is_read_in_full(tmp_path: Path, content: dict[str, Any]) -> None:
    (tmp_path / "times.txt").write_text("1\n2\n")
    (tmp_path / "hot.txt").write_text("3,1\n")
    content["reconstruction"] = {
        "timestamps": "times.txt",
        "time_offset_ms": -1.5,
        "upsample_rate": 4,
        "hot_pixels": "hot.txt",
        "unsharp_mask_amount": 0,
        "auto_hdr": True,
        "precision": "bfloat16",
        "device": "cpu",
    }
    reconstruction = load_rig(write(tmp_path, content)).reconstruction
    expected = FrameTimes(timestamps=tmp_path / "times.txt", time_offset_ms=-1.5, upsample_rate=4)
    assert reconstruction.times == expected
    assert reconstruction.options == {
        "unsharp_mask_amount": 0.0,
        "auto_hdr": True,
        "precision": "bfloat16",
        "device": "cpu",
        "hot_pixels": str(tmp_path / "hot.txt"),
    }


def test_a_network_is_a_file_or_a_name(tmp_path: Path, content: dict[str, Any]) -> None:
    content["reconstruction"]["network"] = "patterns_v1"
    assert load_rig(write(tmp_path, content)).reconstruction.network == Path("patterns_v1")
    (tmp_path / "patterns_v1").touch()
    assert load_rig(write(tmp_path, content)).reconstruction.network == tmp_path / "patterns_v1"


def test_the_reconstruction_must_fit_the_cameras(tmp_path: Path, content: dict[str, Any]) -> None:
    content["reconstruction"] = {"stamps_of": "cam1"}
    assert load_rig(write(tmp_path, content)).reconstruction.times.stamps_of == "cam1"
    content["reconstruction"] = {"rate_hz": "auto"}
    assert load_rig(write(tmp_path, content)).reconstruction.times.rate_hz == "auto"
    with pytest.raises(CalibrationError, match="rate_hz: 'auto' takes the rate from the IMU's readings"):
        load_rig(write(tmp_path, {key: value for key, value in content.items() if key != "imu"}))
    content["reconstruction"] = {"stamps_of": "cam0"}
    with pytest.raises(CalibrationError, match="stamps_of: 'cam0' is no camera with 'frames'; those are cam1"):
        load_rig(write(tmp_path, content))
    content["reconstruction"] = {"hot_pixels": "table.npz"}
    content["cameras"].append({"name": "cam3", "model": "pinhole-radtan", "events": "events.h5"})
    with pytest.raises(CalibrationError, match="hot_pixels: one file cannot serve several event cameras"):
        load_rig(write(tmp_path, content))
