"""Every camera model, a splined one and a user's own among them, through one matrix of properties."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from example_lenses import IMAGE_SIZE, LENSES, OWN, SPLINED, lens_of, ray_at, some_points
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.cameras import CameraModel, Pinhole, camera_model, names
from jaxcal.errors import CalibrationError
from jaxcal.estimation.scalars import written_out

NAMES = sorted(LENSES)
COUNT = 24  # rays looked at together: one shape for all tests of a model


def test_every_registered_model_is_tested_here() -> None:
    assert sorted({*LENSES} - {OWN, *SPLINED}) == names()


every_model = pytest.mark.parametrize("name", NAMES)


@pytest.fixture
def lens(name: str) -> CameraModel:
    return lens_of(name)


# --- programs: compiled once per model -------------------------------------------------------------------------------


@functools.cache
def template(name: str) -> CameraModel:
    return camera_model(name).from_focal(1.0, IMAGE_SIZE)


@functools.partial(jax.jit, static_argnums=0)
def forward(name: str, parameters: jax.Array, points: jax.Array) -> dict[str, jax.Array]:
    """Pixels of points, their derivatives by point (forward mode) and by parameters (reverse mode), and validity."""

    def project(parameters: jax.Array, point: jax.Array) -> jax.Array:
        return template(name).with_parameters(parameters).project(point)

    return {
        "pixels": jax.vmap(project, in_axes=(None, 0))(parameters, points),
        "by_point": jax.vmap(jax.jacfwd(project, argnums=1), in_axes=(None, 0))(parameters, points),
        "by_parameters": jax.vmap(jax.jacrev(project), in_axes=(None, 0))(parameters, points),
        "valid": jax.vmap(template(name).with_parameters(parameters).is_valid)(points),
    }


@functools.partial(jax.jit, static_argnums=0)
def backward(name: str, parameters: jax.Array, pixels: jax.Array) -> dict[str, jax.Array]:
    """Rays of pixels, the model's own way and the generic one, and the derivatives of the first by the pixel."""
    model = template(name).with_parameters(parameters)

    def unproject(pixel: jax.Array) -> tuple[jax.Array, jax.Array]:
        ray = model.unproject(pixel)
        return ray, ray

    by_pixel, rays = jax.vmap(jax.jacfwd(unproject, has_aux=True))(pixels)
    own = any("unproject" in cls.__dict__ for cls in type(model).__mro__ if cls is not CameraModel)
    return {"rays": rays, "by_pixel": by_pixel, "generic": CameraModel.unproject(model, pixels) if own else rays}


@functools.partial(jax.jit, static_argnums=0)
def paraxial(name: str, parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
    return template(name).with_parameters(parameters).paraxial()


@functools.partial(jax.jit, static_argnums=0)
def projected(name: str, parameters: jax.Array, points: jax.Array) -> jax.Array:
    return template(name).with_parameters(parameters).project(points)


@st.composite
def points_in_view(draw: st.DrawFn, name: str, part: float = 1.0) -> np.ndarray:
    """Points (COUNT, 3) in the model's domain at any distance, the axis and the rim among them."""
    unit = st.floats(0.0, 1.0)
    several = st.lists(unit, min_size=3, max_size=3)
    parts, turns = np.array(draw(several)), 2.0 * np.pi * np.array(draw(several))
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    angle = part * np.deg2rad(LENSES[name].reach_deg) * np.concatenate([parts, [0.0, 1.0], rng.random(COUNT - 5)])
    azimuth = np.concatenate([turns, 2.0 * np.pi * rng.random(COUNT - 3)])
    return 10.0 ** rng.uniform(-1.3, 1.3, (COUNT, 1)) * ray_at(angle, azimuth)


@functools.partial(jax.jit, static_argnums=0)
def by_numbers(name: str, parameters: jax.Array, point: jax.Array) -> tuple:
    """Pixel of one point and its derivatives, as the solver takes them, and as autodiff gives them."""

    def project(point: jax.Array, parameters: jax.Array) -> jax.Array:
        return template(name).with_parameters(parameters).project(point)

    written = written_out(project, (3, parameters.shape[0]))
    assert written is not None, "the solver will be slow with this lens"

    def joined(point: jax.Array, parameters: jax.Array) -> jax.Array:
        return jnp.stack(written(list(point), list(parameters)))

    return tuple((f(point, parameters), *jax.jacrev(f, argnums=(0, 1))(point, parameters)) for f in (joined, project))


# --- the matrix ------------------------------------------------------------------------------------------------------


@every_model
@settings(max_examples=12, deadline=None)
@given(data=st.data(), bend=st.floats(0.0, 1.0))
def test_unproject_inverts_project_over_the_whole_domain(name: str, data: st.DataObject, bend: float) -> None:
    points = data.draw(points_in_view(name))
    # Folds move with the coefficients; of these two it is known that they move outwards.
    bend = bend if name in ("pinhole-radtan", "pinhole-equi") else 1.0
    parameters = lens_of(name, bend).parameters
    there = forward(name, parameters, jnp.asarray(points))
    back = backward(name, parameters, there["pixels"])
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.asarray(there["valid"]).all()
    np.testing.assert_allclose(back["rays"], rays, atol=2e-9)
    np.testing.assert_allclose(back["generic"], rays, atol=2e-9)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in SPLINED])
@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_every_formula_can_be_written_out_for_the_solver(name: str, data: st.DataObject) -> None:
    parameters = lens_of(name).parameters
    for point in data.draw(points_in_view(name))[:4]:
        ours, expected = by_numbers(name, parameters, jnp.asarray(point))
        for one, other in zip(ours, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * (1.0 + np.abs(other).max()))


@every_model
@settings(max_examples=6, deadline=None)
@given(data=st.data())
def test_jacobians_equal_central_differences(name: str, data: st.DataObject) -> None:
    """By points and by parameters, forward and reverse; and the inverse's is the inverse of it."""
    points = data.draw(points_in_view(name, part=0.93))
    parameters = np.asarray(lens_of(name).parameters)
    found = forward(name, jnp.asarray(parameters), jnp.asarray(points))
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    scale = np.abs(found["by_point"]).max(axis=(1, 2), keepdims=True)
    for axis in range(3):
        step = 1e-5 * distance * np.eye(3)[axis] * np.maximum(np.abs(points[:, 2:] / distance), 0.05)
        up, down = (np.asarray(projected(name, parameters, points + sign * step)) for sign in (1.0, -1.0))
        expected = (up - down) / (2.0 * step[:, axis : axis + 1])
        np.testing.assert_allclose(found["by_point"][:, :, axis] / scale[:, 0], expected / scale[:, 0], atol=2e-6)
    for column in parameters_to_check(parameters):
        step = np.zeros(len(parameters))
        step[column] = 1e-5 * max(abs(parameters[column]), 0.1)
        up, down = (np.asarray(projected(name, parameters + sign * step, points)) for sign in (1.0, -1.0))
        expected = (up - down) / (2.0 * step[column])
        size = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(found["by_parameters"][:, :, column] / size, expected / size, atol=2e-6)
    # d pixel / d ray . d ray / d pixel = 1, with the derivative at the unit ray being that at the point times distance.
    by_pixel = backward(name, jnp.asarray(parameters), found["pixels"])["by_pixel"]
    both = np.einsum("nij,njk->nik", distance[:, :, None] * found["by_point"], by_pixel)
    np.testing.assert_allclose(both, np.tile(np.eye(2), (COUNT, 1, 1)), atol=1e-6)


def parameters_to_check(parameters: np.ndarray) -> np.ndarray:
    """All columns, or the first few and some knots."""
    count = len(parameters)
    return np.arange(count) if count < 20 else np.concatenate([np.arange(4), np.arange(4, count, 17)])


@every_model
def test_the_domain_ends_where_it_should(name: str) -> None:
    edge = LENSES[name].edge_deg
    if edge is None:  # not a circle: a ring inside is valid, and the antipode never is
        inside, outside = LENSES[name].reach_deg, 179.9999
    else:
        inside, outside = edge - 0.05, min(edge + 0.05, 179.99999)
    azimuth = np.linspace(0.0, 6.2, COUNT)

    def valid(points: np.ndarray) -> np.ndarray:
        return np.asarray(forward(name, lens_of(name).parameters, jnp.asarray(points))["valid"])

    if not (edge is not None and edge > 179.9):
        assert not valid(ray_at(np.deg2rad(outside), azimuth)).any()
    assert valid(ray_at(np.deg2rad(inside), azimuth)).all()
    antipode = np.tile([0.0, 0.0, -1.0], (COUNT, 1))
    assert not valid(antipode).any()


# Where masked corners may lie: on the axis, behind, in the focal point, beside it, far outside, next to the antipode.
ODD_POINTS = np.array(
    [
        [0, 0, 1], [0, 0, -1], [0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.1, 0.1, -1], [-3, 2, -5],
        [1e-12, 0, -1], [1e-9, 1e-9, 1], [1e6, 0, 1], [0, 1e6, -1], [1e-7, 0, 1e-7], [3, 4, 1e-9], [0, 0, 1e-30],
        [0, 0, 1e6], [1, 1, -1e-9], [-1, 0, 1e-3], [5, 5, -0.3], [1e-3, 0, -1e3], [1e-20, 1e-20, 0], [2, 0, -2],
        [0, -1, 0.2], [0.5, 0.5, 0.5],
    ],
    dtype=float,
)  # fmt: skip


@every_model
@pytest.mark.parametrize("own", [True, False], ids=["example", "from_focal"])
def test_values_and_gradients_are_finite_everywhere(name: str, own: bool) -> None:
    if name == OWN:
        points = np.tile(ODD_POINTS[-1], (COUNT, 1))  # what a user writes in one line need not be
    else:
        points = ODD_POINTS
    parameters = (lens_of(name) if own else camera_model(name).from_focal(400.0, IMAGE_SIZE)).parameters
    there = forward(name, parameters, jnp.asarray(points))
    back = backward(name, parameters, there["pixels"])
    for quantity in (there["pixels"], there["by_point"], there["by_parameters"], back["rays"], back["by_pixel"]):
        bad = ~np.isfinite(quantity).reshape(COUNT, -1).all(axis=1)
        assert not bad.any(), points[bad]
    # Squares of them too: a solver adds those up, times zero where a corner is masked.
    assert np.isfinite(np.asarray(there["by_parameters"]) ** 2).all()


@every_model
def test_on_the_axis(lens: CameraModel, name: str) -> None:
    """The axis is the principal point (bent there by a splined surface), and its Jacobian the paraxial scale."""
    scale, centre = paraxial(name, lens.parameters)
    found = forward(name, lens.parameters, jnp.tile(jnp.array([0.0, 0.0, 1.0]), (COUNT, 1)))
    np.testing.assert_allclose(found["by_point"][0, :, :2], scale, atol=1e-6)
    np.testing.assert_allclose(found["by_point"][0, :, 2], 0.0, atol=1e-6)
    np.testing.assert_allclose(found["pixels"][0], centre, atol=1e-9)
    if name not in (*SPLINED, "pinhole-tilted14"):
        np.testing.assert_allclose(centre, np.asarray(lens.intrinsics)[-2:], atol=1e-9)
    assert np.linalg.det(scale) > 0.0


@pytest.mark.parametrize("name", ["pinhole-equi", "eucm-none"])
def test_batches_equal_one_by_one(lens: CameraModel, name: str) -> None:
    points = some_points(name, (2, 3))
    pixels = np.asarray(lens.project(points))
    rays = np.asarray(lens.unproject(pixels))
    assert pixels.shape == (2, 3, 2)
    assert rays.shape == (2, 3, 3)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(lens.project(points[index]), pixels[index], rtol=1e-12)
        np.testing.assert_allclose(lens.unproject(pixels[index]), rays[index], rtol=1e-9, atol=1e-12)
    assert lens.project(np.zeros((0, 3))).shape == (0, 2)
    assert lens.unproject(np.zeros((0, 2))).shape == (0, 3)


# --- parameters ------------------------------------------------------------------------------------------------------


@every_model
def test_parameters_are_intrinsics_then_distortion(lens: CameraModel, name: str) -> None:
    example = LENSES[name]
    np.testing.assert_array_equal(lens.intrinsics, example.intrinsics)
    np.testing.assert_array_equal(lens.distortion, example.distortion)
    np.testing.assert_array_equal(lens.parameters, example.parameters())
    assert lens.num_parameters == len(example.parameters())
    first, second = lens.parameter_names
    assert (len(first), len(second)) == (len(example.intrinsics), len(example.distortion))
    assert len({*first, *second}) == lens.num_parameters
    assert first[-4:] == ("fx", "fy", "cx", "cy")


@every_model
def test_with_parameters_replaces_them_all(lens: CameraModel) -> None:
    vector = np.arange(1.0, lens.num_parameters + 1.0)
    other = lens.with_parameters(vector)
    assert type(other) is type(lens)
    np.testing.assert_array_equal(other.parameters, vector)
    assert jax.tree.structure(other) == jax.tree.structure(lens)


@every_model
@pytest.mark.parametrize("more", [-1, 1])
def test_a_wrong_number_of_parameters_is_refused(lens: CameraModel, name: str, more: int) -> None:
    with pytest.raises(CalibrationError, match=rf"expected \({lens.num_parameters},\)"):
        lens.with_parameters(np.ones(lens.num_parameters + more))
    example = LENSES[name]
    wanted = f"expected {len(example.intrinsics)} and {len(example.distortion)}"
    with pytest.raises(CalibrationError, match=wanted):
        type(lens).create(example.intrinsics, np.zeros(len(example.distortion) + 1))
    # The right total does not excuse the wrong parts.
    with pytest.raises(CalibrationError, match=wanted):
        type(lens).create(np.ones(len(example.intrinsics) + more), np.zeros(max(len(example.distortion) - more, 0)))


@every_model
def test_from_focal_has_that_focal_length_at_the_centre(name: str) -> None:
    cls = camera_model(name)
    for first in (cls.from_focal(500.0, IMAGE_SIZE), *cls.starts(500.0, IMAGE_SIZE)):
        assert type(first) is cls
        scale, centre = paraxial(name, first.parameters)
        np.testing.assert_allclose(scale, 500.0 * np.eye(2), rtol=1e-9, atol=1e-6)
        # Pixel (0, 0) is the centre of the top-left pixel, so the image's centre is at half the size less one.
        np.testing.assert_allclose(centre, [319.5, 239.5], atol=1e-9)


@every_model
def test_priors_are_weak_and_only_on_knots(lens: CameraModel, name: str) -> None:
    information = np.asarray(lens.regularisation())
    assert information.shape == (lens.num_parameters,)
    assert np.all(information >= 0)
    if name in SPLINED:
        assert np.all((information > 0) == (np.arange(len(information)) >= 4))
        # One corner with an error of a focal length would outweigh it.
        assert information.max() <= 1.0
        assert set(type(lens).held) > {0, 1, 2, 3}
    else:
        assert not information.any()
        assert type(lens).held == ()


# --- what is taken and what is refused -------------------------------------------------------------------------------


@every_model
def test_numpy_lists_and_whole_numbers_are_taken(lens: CameraModel) -> None:
    points = [[1, 0, 4], [0, 2, 5]]
    expected = lens.project(jnp.asarray(points, dtype=float))
    for given_points in (points, np.array(points), np.array(points, dtype=np.float32), jnp.array(points)):
        np.testing.assert_allclose(lens.project(given_points), expected, rtol=1e-12)


@every_model
@pytest.mark.parametrize("shape", [(), (2,), (3, 2), (0, 4)])
def test_points_and_pixels_of_a_wrong_shape_are_refused(lens: CameraModel, shape: tuple[int, ...]) -> None:
    with pytest.raises(CalibrationError, match=r"project got an array of shape .* expected \(\.\.\., 3\)"):
        lens.project(np.ones(shape))
    with pytest.raises(CalibrationError, match=r"unproject got an array of shape .* expected \(\.\.\., 2\)"):
        lens.unproject(np.ones((*shape, 3)))


class ClosedForm(Pinhole):
    """A pinhole that writes its own inverse, for one pixel."""

    def unproject(self, pixel: Any) -> Any:
        assert pixel.shape == (2,)
        ray = jnp.append((pixel - self.centre) / self.focal, 1.0)
        return ray / jnp.linalg.norm(ray)


def test_an_inverse_in_closed_form_is_written_for_one_pixel_and_takes_many() -> None:
    points = some_points("pinhole-none", (2, 3))
    closed, other = ClosedForm.create(LENSES["pinhole-none"].intrinsics), lens_of("pinhole-none")
    pixels = np.asarray(other.project(points))
    np.testing.assert_allclose(closed.project(points), pixels, rtol=1e-12)
    np.testing.assert_allclose(closed.unproject(pixels), other.unproject(pixels), atol=1e-9)


@every_model
def test_pixels_that_no_point_has_still_get_a_finite_ray(name: str) -> None:
    far = 10.0 ** np.linspace(2.0, 6.0, COUNT)[:, None] * ray_at(np.pi / 2, np.linspace(0.0, 6.0, COUNT))[:, :2]
    rays = backward(name, lens_of(name).parameters, jnp.asarray(far))["rays"]
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, rtol=1e-9)
