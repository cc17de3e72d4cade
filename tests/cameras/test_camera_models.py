"""Every camera model through one matrix of properties; two of them against OpenCV; a user's own model by name."""

import functools
from pathlib import Path
from typing import Any

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from jaxcal.cameras import CameraModel, Pinhole, camera_model, model_name, names
from jaxcal.errors import CalibrationError

IMAGE_SIZE = (640, 480)
INTRINSICS = [420.0, 425.0, 318.0, 241.0]
# name -> (distortion of a real-looking lens, half of its field of view in degrees)
LENSES = {
    "pinhole-none": ([], 70.0),
    "pinhole-radtan": ([-0.28, 0.07, 2e-4, -1e-4], 60.0),
    "pinhole-equi": ([0.01, -0.005, 0.002, -0.0005], 80.0),
}


def test_every_registered_model_is_tested_here() -> None:
    assert sorted(LENSES) == names()


@pytest.fixture(params=names())
def lens(request: pytest.FixtureRequest) -> CameraModel:
    return make(request.param, 1.0)


def make(name: str, bend: float) -> CameraModel:
    """The example lens of this name, its distortion scaled by `bend`."""
    return camera_model(name).create(INTRINSICS, bend * np.asarray(LENSES[name][0]))


def ray_at(angle: Any, azimuth: Any) -> np.ndarray:
    """Unit vectors (3, ...) at an angle from the optical axis, rad."""
    return np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])


def some_points(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Points (*shape, 3) all over the field of view, 0.2 to 5 m away."""
    rng = np.random.default_rng(7)
    angle, azimuth = np.deg2rad(LENSES[name][1]) * np.sqrt(rng.random(shape)), 2 * np.pi * rng.random(shape)
    distance = rng.uniform(0.2, 5.0, shape)
    return np.moveaxis(distance * ray_at(angle, azimuth), 0, -1)


# --- projection ------------------------------------------------------------------------------------------------------


@eqx.filter_jit
def there_and_back(model: CameraModel, point: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    pixel = model.project(point)
    ray = model.unproject(pixel)
    return pixel, ray, model.project(ray)


@pytest.mark.parametrize("name", names())
@settings(max_examples=40, deadline=None)
@given(
    part=st.floats(0.0, 1.0), azimuth=st.floats(-np.pi, np.pi), distance=st.floats(0.05, 20.0), bend=st.floats(0.0, 1.0)
)
def test_unproject_inverts_project(name: str, part: float, azimuth: float, distance: float, bend: float) -> None:
    ray = ray_at(part * np.deg2rad(LENSES[name][1]), azimuth)
    pixel, back, again = there_and_back(make(name, bend), jnp.asarray(distance * ray))
    np.testing.assert_allclose(back, ray, atol=1e-9)
    np.testing.assert_allclose(again, pixel, atol=1e-8)


@functools.partial(jax.jit, static_argnums=0)
def projected(name: str, inputs: jax.Array) -> jax.Array:
    return make(name, 1.0).with_parameters(inputs[3:]).project(inputs[:3])


@functools.partial(jax.jit, static_argnums=0)
def jacobian_of_projected(name: str, inputs: jax.Array) -> jax.Array:
    return jax.jacfwd(lambda x: projected(name, x))(inputs)


@pytest.mark.parametrize("name", names())
@settings(max_examples=15, deadline=None)
@given(part=st.floats(0.0, 1.0), azimuth=st.floats(-np.pi, np.pi), distance=st.floats(0.2, 5.0))
def test_jacobian_by_point_and_parameters_equals_central_differences(
    name: str, part: float, azimuth: float, distance: float
) -> None:
    # Near the rim the pixels of a wide lens are a steep function: differences are only good to a part in a million.
    point = distance * ray_at(0.95 * part * np.deg2rad(LENSES[name][1]), azimuth)
    inputs = np.concatenate([point, make(name, 1.0).parameters])
    jacobian = np.asarray(jacobian_of_projected(name, jnp.asarray(inputs)))
    for column, size in enumerate(np.maximum(np.abs(inputs), 0.1)):
        step = np.zeros(len(inputs))
        step[column] = 1e-5 * size * (point[2] / distance if column < 3 else 1.0)
        up, down = (projected(name, jnp.asarray(inputs + sign * step)) for sign in (1.0, -1.0))
        expected = (np.asarray(up) - np.asarray(down)) / (2.0 * step[column])
        np.testing.assert_allclose(jacobian[:, column], expected, rtol=1e-6, atol=1e-6 * np.abs(jacobian).max())


def test_gradients_are_finite_on_the_optical_axis(lens: CameraModel) -> None:
    axis = jnp.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(lens.project(axis), INTRINSICS[2:], atol=1e-9)
    by_point = jax.jacrev(lens.project)(axis)
    np.testing.assert_allclose(by_point, [[420.0, 0.0, 0.0], [0.0, 425.0, 0.0]], atol=1e-6)
    by_parameters = jax.jacrev(lambda p: lens.with_parameters(p).project(axis))(lens.parameters)
    assert np.isfinite(by_parameters).all()
    np.testing.assert_allclose(by_parameters[:, 2:4], np.eye(2), atol=1e-9)
    by_pixel = jax.jacfwd(lens.unproject)(jnp.array(INTRINSICS[2:]))
    assert np.isfinite(by_pixel).all()


def test_batches_equal_one_by_one(lens: CameraModel) -> None:
    points = some_points(lens.name, (2, 3))
    pixels, rays = np.asarray(lens.project(points)), np.asarray(lens.unproject(lens.project(points)))
    assert pixels.shape == (2, 3, 2)
    assert rays.shape == (2, 3, 3)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(lens.project(points[index]), pixels[index], rtol=1e-12)
        np.testing.assert_allclose(lens.unproject(pixels[index]), rays[index], rtol=1e-9, atol=1e-12)


def test_numpy_lists_and_whole_numbers_are_taken(lens: CameraModel) -> None:
    points = [[1, 0, 4], [0, 2, 5]]
    expected = lens.project(jnp.asarray(points, dtype=float))
    for given_points in (points, np.array(points), np.array(points, dtype=np.float32), jnp.array(points)):
        np.testing.assert_allclose(lens.project(given_points), expected, rtol=1e-12)
    rays = lens.unproject(np.asarray(expected))
    np.testing.assert_allclose(np.cross(rays, points), 0.0, atol=1e-8)
    assert lens.project(np.zeros((0, 3))).shape == (0, 2)
    assert lens.unproject(np.zeros((0, 2))).shape == (0, 3)


@pytest.mark.parametrize("shape", [(), (2,), (3, 2), (0, 4)])
def test_points_and_pixels_of_a_wrong_shape_are_refused(lens: CameraModel, shape: tuple[int, ...]) -> None:
    with pytest.raises(CalibrationError, match=r"project got an array of shape .* expected \(\.\.\., 3\)"):
        lens.project(np.ones(shape))
    with pytest.raises(CalibrationError, match=r"unproject got an array of shape .* expected \(\.\.\., 2\)"):
        lens.unproject(np.ones((*shape, 3)))


def test_points_behind_are_not_valid_but_finite(lens: CameraModel) -> None:
    behind = jnp.array([0.1, 0.1, -1.0])
    assert not lens.is_valid(behind)
    assert lens.is_valid(jnp.array([0.1, 0.1, 1.0]))
    assert np.isfinite(lens.project(behind)).all()
    assert np.isfinite(jax.jacfwd(lens.project)(behind)).all()


def test_radtan_equals_opencv() -> None:
    points = some_points("pinhole-radtan", (50,))
    matrix, distortion = opencv_arguments("pinhole-radtan")
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    np.testing.assert_allclose(make("pinhole-radtan", 1.0).project(points), expected.reshape(-1, 2), atol=1e-8)


def test_equidistant_equals_opencv() -> None:
    points = some_points("pinhole-equi", (50,))
    matrix, distortion = opencv_arguments("pinhole-equi")
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, distortion)
    np.testing.assert_allclose(make("pinhole-equi", 1.0).project(points), expected.reshape(-1, 2), atol=1e-8)


def opencv_arguments(name: str) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy = INTRINSICS
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.asarray(LENSES[name][0])


# --- parameters ------------------------------------------------------------------------------------------------------


def test_parameters_are_intrinsics_then_distortion(lens: CameraModel) -> None:
    np.testing.assert_array_equal(lens.intrinsics, INTRINSICS)
    np.testing.assert_array_equal(lens.distortion, LENSES[lens.name][0])
    np.testing.assert_array_equal(lens.parameters, np.concatenate([lens.intrinsics, lens.distortion]))
    assert lens.num_parameters == len(lens.parameters)
    again = type(lens).create(lens.intrinsics, lens.distortion)
    np.testing.assert_array_equal(again.parameters, lens.parameters)


def test_with_parameters_replaces_them_all(lens: CameraModel) -> None:
    vector = np.arange(1.0, lens.num_parameters + 1.0)
    other = lens.with_parameters(vector)
    assert type(other) is type(lens)
    np.testing.assert_array_equal(other.parameters, vector)
    np.testing.assert_array_equal(lens.intrinsics, INTRINSICS)
    assert jax.tree.structure(other) == jax.tree.structure(lens)


@pytest.mark.parametrize("more", [-1, 1])
def test_a_wrong_number_of_parameters_is_refused(lens: CameraModel, more: int) -> None:
    with pytest.raises(CalibrationError, match=rf"{lens.name}.*expected \({lens.num_parameters},\)"):
        lens.with_parameters(np.ones(lens.num_parameters + more))
    count = len(LENSES[lens.name][0])
    with pytest.raises(CalibrationError, match=f"expected 4 and {count}"):
        type(lens).create(INTRINSICS, np.zeros(count + 1))
    # The right total does not excuse the wrong parts.
    with pytest.raises(CalibrationError, match=f"expected 4 and {count}"):
        type(lens).create(np.ones(4 + more), np.zeros(max(count - more, 0)))


def test_from_focal_is_centred_and_without_distortion(lens: CameraModel) -> None:
    first = type(lens).from_focal(500.0, IMAGE_SIZE)
    # Pixel (0, 0) is the centre of the top-left pixel, so the image's centre is at half the size less one.
    np.testing.assert_array_equal(first.intrinsics, [500.0, 500.0, 319.5, 239.5])
    np.testing.assert_array_equal(first.distortion, np.zeros_like(lens.distortion))


# --- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", names())
def test_names_lead_to_models_and_back(name: str) -> None:
    assert model_name(camera_model(name)) == name
    assert model_name(make(name, 1.0)) == name


def test_a_misspelt_name_gets_a_suggestion() -> None:
    with pytest.raises(CalibrationError, match=r"Did you mean 'pinhole-radtan'.*Known: .*pinhole-equi"):
        camera_model("pinhole-radtann")
    with pytest.raises(CalibrationError, match=r"'zzz' is unknown. Known"):
        camera_model("zzz")


USERS_MODULE = """
import jax.numpy as jnp
from jaxtyping import Array
from jaxcal import CameraModel

class Stereographic(CameraModel):
    focal: Array
    centre: Array

    def project(self, point):
        return 2.0 * self.focal * point[:2] / (jnp.linalg.norm(point) + point[2]) + self.centre

    def is_valid(self, point):
        return point[2] > -0.9 * jnp.linalg.norm(point)

    @classmethod
    def from_focal(cls, focal, image_size):
        return cls(jnp.full(2, float(focal)), (jnp.asarray(image_size) - 1) / 2)
"""


@pytest.fixture
def users_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> type[CameraModel]:
    (tmp_path / "my_lenses_in_a_file.py").write_text(USERS_MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    return jaxcal.camera_model("my_lenses_in_a_file:Stereographic")


def test_a_users_model_works_by_dotted_name(users_model: type[CameraModel]) -> None:
    assert model_name(users_model) == "my_lenses_in_a_file:Stereographic"
    lens = users_model.create(INTRINSICS)
    assert model_name(lens) == "my_lenses_in_a_file:Stereographic"
    np.testing.assert_array_equal(lens.parameters, INTRINSICS)
    # It sees behind itself, where no pinhole does: 100 degrees from the axis.
    rays = np.stack([ray_at(np.deg2rad(angle), azimuth) for angle, azimuth in [(10, 0.3), (60, 2.0), (100, -1.0)]])
    np.testing.assert_allclose(lens.unproject(lens.project(3.0 * rays)), rays, atol=1e-9)
    assert jax.vmap(lens.is_valid)(jnp.asarray(rays)).all()
    with pytest.raises(CalibrationError, match="expected 4 and 0"):
        users_model.create(INTRINSICS, [0.1])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("my_lenses_in_a_file:Telecentric", "Telecentric"),
        ("my_lenses_in_a_file:Array", "not a subclass of jaxcal.CameraModel"),
        ("no_such_module_anywhere:Lens", "No module named 'no_such_module_anywhere'"),
    ],
)
@pytest.mark.usefixtures("users_model")
def test_a_users_model_that_is_not_there(name: str, said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        camera_model(name)


class ClosedForm(Pinhole):
    """A pinhole that writes its own inverse, for one pixel."""

    def unproject(self, pixel: Any) -> Any:
        assert pixel.shape == (2,)
        ray = jnp.append((pixel - self.centre) / self.focal, 1.0)
        return ray / jnp.linalg.norm(ray)


def test_an_inverse_in_closed_form_is_written_for_one_pixel_and_takes_many() -> None:
    points = some_points("pinhole-none", (2, 3))
    closed, iterated = ClosedForm.create(INTRINSICS), Pinhole.create(INTRINSICS)
    pixels = np.asarray(iterated.project(points))
    np.testing.assert_allclose(closed.project(points), pixels, rtol=1e-12)
    np.testing.assert_allclose(closed.unproject(pixels), iterated.unproject(pixels), atol=1e-9)
