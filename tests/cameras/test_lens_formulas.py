"""Camera models against what defines them: OpenCV, SciPy's B-splines, the papers' formulas, and each other."""

import functools

import cv2
import jax
import numpy as np
import pytest
from example_lenses import CORE, LENSES, ray_at, some_points
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from jaxcal.cameras import camera_model
from jaxcal.cameras.splined import SplinedStereographic, splined_stereographic
from jaxcal.errors import CalibrationError

OPENCV = ["none", "radtan", "radtan5", "rational8", "thinprism12", "tilted14"]
POINTS = 40


def projected(name: str, parameters: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pixels (N, 2), compiled once per model."""
    return np.asarray(_project(name, np.asarray(parameters, dtype=float), points))


@functools.partial(jax.jit, static_argnums=0)
def _project(name: str, parameters: jax.Array, points: jax.Array) -> jax.Array:
    return camera_model(name).from_focal(1.0, (2, 2)).with_parameters(parameters).project(points)


def opencv_matrix() -> np.ndarray:
    fx, fy, cx, cy = CORE
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("kind", OPENCV)
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_pinholes_equal_opencv(kind: str, seed: int) -> None:
    """Coefficients of either sign; the example lens's size of each."""
    name = f"pinhole-{kind}"
    rng = np.random.default_rng(seed)
    distortion = np.array(LENSES[name].distortion)
    # Numerators bend both ways; denominators (k4, k5, k6) that turn negative have a pole instead of a value.
    sign = rng.choice([-1.0, 1.0], len(distortion))
    sign[5:8] = 1.0
    distortion = rng.uniform(0.2, 1.5, len(distortion)) * sign * distortion
    points = ray_at(rng.uniform(0.0, 1.1, POINTS), rng.uniform(0.0, 6.3, POINTS)) * rng.uniform(0.2, 5.0, (POINTS, 1))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), opencv_matrix(), distortion)
    found = projected(name, np.concatenate([CORE, distortion]), points)
    np.testing.assert_allclose(found, expected.reshape(-1, 2), rtol=1e-9, atol=1e-8)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_kannala_brandt_equals_opencv_in_front_and_its_own_polynomial_behind(seed: int) -> None:
    rng = np.random.default_rng(seed)
    distortion = rng.uniform(-1.0, 1.0, 4) * [0.1, 0.05, 0.02, 0.005]
    angle, azimuth = rng.uniform(0.0, 1.56, POINTS), rng.uniform(-np.pi, np.pi, POINTS)
    points = ray_at(angle, azimuth)
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), opencv_matrix(), distortion)
    parameters = np.concatenate([CORE, distortion])
    found = projected("pinhole-equi", parameters, points)
    np.testing.assert_allclose(found, expected.reshape(-1, 2), rtol=1e-9, atol=1e-8)
    theta = angle + np.pi / 2 - 0.01
    radius = theta + sum(k * theta ** (3 + 2 * i) for i, k in enumerate(distortion))
    behind = np.array(CORE[2:]) + np.array(CORE[:2]) * radius[:, None] * ray_at(np.pi / 2, azimuth)[:, :2]
    found = projected("pinhole-equi", parameters, ray_at(theta, azimuth))
    np.testing.assert_allclose(found, behind, rtol=1e-9, atol=1e-8)


@settings(max_examples=20, deadline=None)
@given(w=st.floats(0.01, 2.8), seed=st.integers(0, 2**31))
def test_field_of_view_lens_equals_its_formula(w: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = ray_at(rng.uniform(0.01, 1.5, POINTS), rng.uniform(-np.pi, np.pi, POINTS))
    undistorted = np.hypot(points[:, 0], points[:, 1]) / points[:, 2]
    distorted = np.arctan(2.0 * undistorted * np.tan(w / 2.0)) / w  # Devernay & Faugeras 2001, eq. 13
    plane = points[:, :2] / points[:, 2:] * (distorted / undistorted)[:, None]
    found = projected("pinhole-fov", np.array([*CORE, w]), points)
    np.testing.assert_allclose(found, np.array(CORE[2:]) + np.array(CORE[:2]) * plane, rtol=1e-9)


def test_a_field_of_view_lens_without_angle_is_a_pinhole() -> None:
    points = some_points("pinhole-none", (POINTS,), part=0.6)
    none = projected("pinhole-none", np.array(CORE), points)
    np.testing.assert_allclose(projected("pinhole-fov", np.array([*CORE, 0.0]), points), none, atol=1e-4)


@settings(max_examples=20, deadline=None)
@given(bend=st.floats(-0.6, 0.02), seed=st.integers(0, 2**31))
def test_division_lens_is_undistorted_by_its_formula(bend: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = ray_at(rng.uniform(0.01, 1.2, POINTS), rng.uniform(-np.pi, np.pi, POINTS))
    plane = (projected("pinhole-division", np.array([*CORE, bend]), points) - CORE[2:]) / CORE[:2]
    undistorted = plane / (1.0 + bend * np.sum(plane**2, axis=1, keepdims=True))  # Fitzgibbon 2001, eq. 5
    np.testing.assert_allclose(undistorted, points[:, :2] / points[:, 2:], rtol=1e-9)


@settings(max_examples=20, deadline=None)
@given(xi=st.floats(0.0, 2.5), seed=st.integers(0, 2**31))
def test_omni_equals_mei_and_its_two_successors_at_their_special_cases(xi: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    edge = np.pi - np.arccos(min(xi, 1.0 / max(xi, 1e-9)))
    points = ray_at(rng.uniform(0.0, 0.97 * edge, POINTS), rng.uniform(-np.pi, np.pi, POINTS))
    points = points * rng.uniform(0.2, 5.0, (POINTS, 1))
    distance = np.linalg.norm(points, axis=1)
    plane = points[:, :2] / (points[:, 2] + xi * distance)[:, None]
    expected = np.array(CORE[2:]) + np.array(CORE[:2]) * plane
    np.testing.assert_allclose(projected("omni-none", np.array([xi, *CORE]), points), expected, rtol=1e-9, atol=1e-7)
    # With alpha = xi / (1 + xi) the unified model is EUCM with beta = 1, double sphere with its xi = 0 ...
    alpha, core = xi / (1.0 + xi), np.array(CORE) / [1.0 + xi, 1.0 + xi, 1.0, 1.0]
    for name, shape in (("eucm-none", [alpha, 1.0]), ("ds-none", [0.0, alpha])):
        np.testing.assert_allclose(projected(name, np.r_[shape, core], points), expected, rtol=1e-9, atol=1e-7)
    # ... and double sphere with alpha = 0.
    np.testing.assert_allclose(projected("ds-none", np.r_[xi, 0.0, CORE], points), expected, rtol=1e-9, atol=1e-7)


@settings(max_examples=20, deadline=None)
@given(alpha=st.floats(0.05, 0.9), beta=st.floats(0.3, 2.5), xi=st.floats(-0.5, 0.9), seed=st.integers(0, 2**31))
def test_eucm_and_double_sphere_equal_their_papers(alpha: float, beta: float, xi: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = ray_at(rng.uniform(0.0, 1.2, POINTS), rng.uniform(-np.pi, np.pi, POINTS))
    points = points * rng.uniform(0.2, 5.0, (POINTS, 1))
    x, y, z = points.T
    d = np.sqrt(beta * (x**2 + y**2) + z**2)
    expected = np.array(CORE[2:]) + np.array(CORE[:2]) * points[:, :2] / (alpha * d + (1 - alpha) * z)[:, None]
    np.testing.assert_allclose(projected("eucm-none", np.r_[alpha, beta, CORE], points), expected, rtol=1e-9)
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    below = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    seen = below > 0.02 * d1  # a negative xi narrows the lens' view: beyond its border the formula means nothing
    expected = np.array(CORE[2:]) + np.array(CORE[:2]) * points[seen, :2] / below[seen, None]
    np.testing.assert_allclose(projected("ds-none", np.r_[xi, alpha, CORE], points[seen]), expected, rtol=1e-9)


def test_omni_radtan_is_radtan_on_the_plane_of_omni() -> None:
    points = some_points("omni-radtan", (POINTS,), part=0.8)
    xi, *core = LENSES["omni-radtan"].intrinsics
    distortion = LENSES["omni-radtan"].distortion
    plane = projected("omni-none", np.array([xi, 1.0, 1.0, 0.0, 0.0]), points)
    flat = np.column_stack([plane, np.ones(POINTS)])
    expected = projected("pinhole-radtan", np.r_[core, distortion], flat)
    np.testing.assert_allclose(projected("omni-radtan", np.r_[xi, core, distortion], points), expected, rtol=1e-10)


# --- splined ---------------------------------------------------------------------------------------------------------


def surface_by_scipy(order: int, knots: np.ndarray, per_unit: float, plane: np.ndarray) -> np.ndarray:
    """The tensor-product B-spline with basis functions centred on knots that are 1 / per_unit apart, around zero."""
    weights = []
    for axis, count in ((0, knots.shape[1]), (1, knots.shape[0])):
        place = plane[:, axis] * per_unit + (count - 1) / 2.0
        basis = [BSpline.basis_element(np.arange(order + 2.0) - (order + 1) / 2.0 + k, False) for k in range(count)]
        weights.append(np.stack([np.nan_to_num(element(place)) for element in basis], axis=1))
    return np.einsum("nj,ni,ijk->nk", weights[0], weights[1], knots)


@pytest.mark.parametrize(("order", "nx", "ny", "fov"), [(3, 10, 8, 150.0), (2, 8, 9, 170.0)])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_splined_lens_is_a_spline_over_the_stereographic_plane(
    order: int, nx: int, ny: int, fov: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    cls = splined_stereographic(order, nx, ny, fov)
    across = 2.0 * np.tan(np.radians(fov / 4.0))
    per_unit = (nx - order) / (2.0 * across)
    # The field of view ends where a full set of order + 1 knots does.
    np.testing.assert_allclose(cls.edge(), [across, (ny - order) / (2.0 * per_unit)], rtol=1e-12)
    plane = rng.uniform(-1.0, 1.0, (POINTS, 2)) * cls.edge()
    square = np.sum(plane**2, axis=1, keepdims=True)
    points = rng.uniform(0.2, 5.0, (POINTS, 1)) * np.hstack([plane, 1.0 - square / 4.0])
    knots = rng.normal(0.0, 0.1, (ny, nx, 2))
    surface = surface_by_scipy(order, knots, per_unit, plane)
    found = projected(cls.name, np.r_[CORE, knots.ravel()], points)
    np.testing.assert_allclose(found, np.array(CORE[2:]) + np.array(CORE[:2]) * (plane + surface), rtol=1e-9, atol=1e-8)


def test_beyond_its_field_of_view_a_splined_surface_stays_what_it_is_at_the_edge() -> None:
    cls = splined_stereographic(3, 10, 8, 150.0)
    example = LENSES[cls.name]
    edge = cls.edge()[0]
    far = np.array([[edge, 0.1], [1.7 * edge, 0.1]])
    square = np.sum(far**2, axis=1, keepdims=True)
    pixels = projected(cls.name, example.parameters(), np.hstack([far, 1.0 - square / 4.0]))
    np.testing.assert_allclose(pixels[1] - pixels[0], [CORE[0] * 0.7 * edge, 0.0], atol=1e-8)


@pytest.mark.parametrize(
    ("configuration", "said"),
    [((4, 9, 9, 90.0), "order 4"), ((3, 3, 9, 90.0), "needs 4 or more"), ((2, 9, 9, 400.0), "field of view of 400")],
)
def test_splined_configurations_that_make_no_sense_are_refused(configuration: tuple, said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        splined_stereographic(*configuration)
    with pytest.raises(CalibrationError, match=said):
        camera_model("splined-" + "-".join(f"{number:g}" for number in configuration))


def test_held_knots_fix_the_frame() -> None:
    """The two held numbers at the centre and the one to the right move when the camera is turned."""
    cls = splined_stereographic(3, 16, 12, 120.0)
    assert issubclass(cls, SplinedStereographic)
    names = [name for group in cls.from_focal(1.0, (2, 2)).parameter_names for name in group]
    assert [names[place] for place in cls.held] == ["fx", "fy", "cx", "cy", "dx[6,8]", "dy[6,8]", "dy[6,12]"]
