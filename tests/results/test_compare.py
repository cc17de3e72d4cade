"""Two calibrations compared: a move of the camera is no difference, and noise is told from change."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from jaxtyping import Array
from rig_examples import make_rig
from scipy.spatial.transform import Rotation
from synthetic_calibration import make_calibration

from jaxcal.cameras import CameraModel
from jaxcal.cli import main
from jaxcal.errors import CalibrationError
from jaxcal.results import Calibration, compare, rig_of
from jaxcal.results.implied_pose import implied_difference

TURN = Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix()


class Turned(CameraModel):
    """A stereographic lens in a camera that was turned by `TURN`: the same lens, seen from a frame of its own."""

    focal: Array

    def project(self, point: Any) -> Any:
        x, y, z = jnp.asarray(TURN) @ point
        return 2.0 * self.focal * jnp.stack([x, y]) / (jnp.linalg.norm(point) + z) + jnp.array([320.0, 240.0])

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "Turned":
        return cls(jnp.asarray(focal))


class Straight(Turned):
    """The same, not turned."""

    def project(self, point: Any) -> Any:
        return super().project(jnp.asarray(TURN.T) @ point)

    def unproject(self, pixel: Any) -> Any:
        plane = (pixel - jnp.array([320.0, 240.0])) / (2.0 * self.focal)
        return jnp.append(2.0 * plane, 1.0 - plane @ plane) / (1.0 + plane @ plane)


@pytest.fixture(scope="module")
def made() -> Calibration:
    return make_calibration(2, True, frames=20)


def with_lens(calibration: Calibration, index: int, parameters: np.ndarray) -> Calibration:
    """The calibration with other parameters of one lens."""
    cameras = list(calibration.cameras)
    cameras[index] = dataclasses.replace(cameras[index], model=cameras[index].model.with_parameters(parameters))
    return dataclasses.replace(calibration, cameras=tuple(cameras))


def drawn(calibration: Calibration, random: np.random.Generator) -> Calibration:
    """The calibration that other noise of the corners might have given."""
    for k, camera in enumerate(calibration.cameras):
        covariance = calibration.covariance_of(f"{camera.name}.intrinsics", f"{camera.name}.distortion")
        step = random.multivariate_normal(np.zeros(len(covariance)), covariance)
        calibration = with_lens(calibration, k, np.asarray(camera.model.parameters) + step)
    return calibration


@pytest.mark.parametrize("ranges", [(np.inf,), (0.5, 2.0, np.inf)])
def test_a_turn_of_the_camera_is_no_difference(ranges: tuple[float, ...]) -> None:
    pixels = np.stack(np.meshgrid(np.linspace(0, 640, 14), np.linspace(0, 480, 10)), axis=-1).reshape(-1, 2)
    weight = np.ones((len(ranges), len(pixels)))
    found = implied_difference(Straight(jnp.asarray(300.0)), Turned(jnp.asarray(300.0)), pixels, ranges, weight)
    np.testing.assert_allclose(found.difference_px, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.pose[:3, :3], TURN.T, atol=1e-9)
    np.testing.assert_allclose(found.pose[:3, 3], 0.0, atol=1e-9)


def test_a_calibration_does_not_differ_from_itself(made: Calibration) -> None:
    found = compare(made, made)
    assert found.headline.startswith("They agree")
    assert all(camera.worst_px < 1e-6 for camera in found.cameras)
    assert all(p.difference == pytest.approx(0.0, abs=1e-9) for p in found.parameters)
    assert any("same frames" in note for note in found.notes)
    camera = made.cameras[0]
    times = camera.detections.timestamps_ns + 1
    other = dataclasses.replace(camera, detections=dataclasses.replace(camera.detections, timestamps_ns=times))
    assert compare(made, dataclasses.replace(made, cameras=(other,)), ranges_m=(np.inf,)).notes[1:] == ()


def test_what_noise_makes_of_a_lens_is_called_noise(made: Calibration) -> None:
    """Normalised differences of draws from the covariance have mean square 1, as far as 12 draws show it."""
    distance = (0.8,)  # about where the board was
    random = np.random.default_rng(0)
    pairs = [compare(drawn(made, random), drawn(made, random), ranges_m=distance) for _ in range(6)]
    squares = np.array([camera.normalised for pair in pairs for camera in pair.cameras], dtype=float) ** 2
    assert 0.4 < squares.mean() < 2.5
    assert all(camera.agreement == "agree" for pair in pairs for camera in pair.cameras)


def test_a_shifted_centre_is_mostly_a_turn_and_a_longer_focus_is_not(made: Calibration) -> None:
    start = np.asarray(made.cameras[0].model.parameters)
    centre, longer = start.copy(), start.copy()
    centre[2] += 2.0
    longer[:2] *= 1.02
    turned = compare(made, with_lens(made, 0, centre)).cameras[0]
    assert turned.worst_px < 0.4
    assert turned.moved[0] == pytest.approx(np.degrees(2.0 / start[0]), rel=0.1)
    found = compare(made, with_lens(made, 0, longer))
    assert [camera.agreement for camera in found.cameras] == ["differ", "agree"]
    assert found.headline.startswith("They differ: cam0")
    far = {p.name: p for p in found.parameters if p.group == "cam0.intrinsics"}["fx"]
    sigma = np.sqrt(2.0) * made.std("cam0.intrinsics")[0]
    assert far.in_sigmas == pytest.approx(0.02 * start[0] / sigma)


def test_a_pose_that_moved_is_found_among_lenses_that_did_not(made: Calibration) -> None:
    camera = made.cameras[1]
    assert camera.T_cn_cnm1 is not None
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix()
    moved = dataclasses.replace(camera, T_cn_cnm1=step @ camera.T_cn_cnm1)
    found = compare(made, dataclasses.replace(made, cameras=(made.cameras[0], moved)))
    assert "cam1.T_cn_cnm1 rotation y" in found.headline
    (first, *_) = found.beyond
    assert first.difference == pytest.approx(np.degrees(0.01))


def test_files_of_others_are_compared_without_sigmas(made: Calibration) -> None:
    found = compare(rig_of(made), rig_of(made), ranges_m=(1.0,))
    assert {camera.agreement for camera in found.cameras} == {"unknown"}
    assert "no uncertainty is known" in found.text()
    assert {p.sigma for p in found.parameters} == {None}
    # One side's uncertainty is better than none.
    assert compare(made, rig_of(made)).cameras[0].agreement == "agree"


def test_cameras_are_matched_by_name_then_by_order(made: Calibration) -> None:
    alone = dataclasses.replace(made, cameras=made.cameras[1:])
    found = compare(made, alone)
    assert [camera.name for camera in found.cameras] == ["cam1"]
    assert found.notes[0] == "cam0: in one of the two only, left out"
    other = make_rig(["pinhole-radtan"], False, 0)
    renamed = dataclasses.replace(other, cameras=(dataclasses.replace(other.cameras[0], name="left"),))
    assert "matched by order" in compare(renamed, other).notes[0]
    with pytest.raises(CalibrationError, match="no camera is in both"):
        compare(renamed, make_rig(["pinhole-radtan"] * 2, False, 0))
    with pytest.raises(CalibrationError, match="one resolution"):
        compare(
            other, dataclasses.replace(other, cameras=(dataclasses.replace(other.cameras[0], image_size=(64, 48)),))
        )
    with pytest.raises(CalibrationError, match="expected metres above 0"):
        compare(made, made, ranges_m=(-1.0,))


def test_the_command_tells_writes_json_and_draws(made: Calibration, tmp_path: Path) -> None:
    # As earlier releases left it, without poses of the board.
    cameras = tuple(dataclasses.replace(camera, T_cam_target=None) for camera in made.cameras)
    dataclasses.replace(made, cameras=cameras).save(tmp_path / "a")
    arguments = ["compare", str(tmp_path / "a"), str(tmp_path / "a" / "camchain-imucam.yaml")]
    arguments += ["--range", "0.8", "--range", "inf"]
    runner, picture = CliRunner(), tmp_path / "out.png"
    result = runner.invoke(main, [*arguments, "--json", "--plot", str(picture)], catch_exceptions=False)
    assert result.exit_code == 0
    told = json.loads(result.output)
    assert [camera["agreement"] for camera in told["cameras"]] == ["unknown", "unknown"]
    assert told["parameters"][0]["in_sigmas"] == 0.0
    assert told["cameras"][0]["by_range"][-1]["range_m"] is None  # infinity
    image = cv2.imread(str(picture))
    assert image is not None
    assert image.std() > 10.0
    result = runner.invoke(main, ["compare", str(tmp_path), str(tmp_path / "nothing")])
    assert result.exit_code == 1
    assert "error: " in result.output
