"""Conversion between camera models by re-fit: exact within a model, small where the models are rich enough."""

import numpy as np
import pytest
from example_lenses import IMAGE_SIZE, LENSES, OWN, SPLINED, lens_of, ray_at
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.cameras import CameraModel, camera_model
from jaxcal.cameras.refit import Refit, fit_rays, refit
from jaxcal.errors import CalibrationError

# Fields of view of the same EUCM shape: half diagonals of 22, 53 and 86 degrees, and 145 seen in the corners.
EUCM = {
    "narrow": (0.5, 1.0, 1200.0, 1203.0, 330.0, 236.0),
    "normal": (0.55, 1.05, 420.0, 421.0, 322.0, 241.0),
    "wide": (0.62, 1.1, 270.0, 271.0, 322.0, 241.0),
    "fisheye": (0.65, 1.05, 180.0, 181.0, 318.0, 242.0),
}
# What each model reaches, RMS in px, on the lens above that it is meant for: its own limit, not the fit's.
REACHED = {
    ("pinhole-none", "narrow"): 2.0,
    ("pinhole-radtan", "narrow"): 1e-3,
    ("pinhole-radtan", "normal"): 0.5,
    ("pinhole-radtan5", "normal"): 0.1,
    ("pinhole-rational8", "normal"): 1e-4,
    ("pinhole-rational8", "wide"): 0.01,
    ("pinhole-thinprism12", "wide"): 0.01,
    ("pinhole-tilted14", "wide"): 0.01,
    ("pinhole-equi", "wide"): 5e-4,
    ("pinhole-equi", "fisheye"): 0.01,
    ("pinhole-fov", "normal"): 0.15,
    ("pinhole-division", "normal"): 0.15,
    ("omni-none", "narrow"): 1e-4,
    ("omni-none", "normal"): 0.05,
    ("omni-radtan", "fisheye"): 0.03,
    ("eucm-none", "fisheye"): 1e-6,
    ("ds-none", "normal"): 0.001,
    ("ds-none", "fisheye"): 0.1,
    ("splined-3-16-12-120", "normal"): 0.005,
    ("splined-3-16-12-210", "wide"): 0.05,
    (OWN, "narrow"): 0.01,
}


def test_every_model_is_refitted_here() -> None:
    kinds = {name.partition("-")[0] if name.startswith("splined") else name for name, _ in REACHED}
    assert kinds == {name for name in LENSES if name not in SPLINED} | {"splined"}


@pytest.mark.parametrize(("name", "kind"), list(REACHED))
def test_an_eucm_lens_becomes_any_other(name: str, kind: str) -> None:
    source = camera_model("eucm-none").create(EUCM[kind])
    found = refit(source, name, IMAGE_SIZE)
    assert isinstance(found.model, camera_model(name))
    assert found.rms_px < REACHED[name, kind]
    assert_residuals_are_what_they_say(found, source)
    if kind != "fisheye":
        assert found.share > 0.95


def assert_residuals_are_what_they_say(found: Refit, source: CameraModel) -> None:
    rays = source.unproject(found.pixels)
    np.testing.assert_allclose(found.residual_px, found.model.project(rays) - found.pixels, atol=1e-6)
    lengths = np.linalg.norm(found.residual_px, axis=1)
    assert found.rms_px == pytest.approx(np.sqrt(np.mean(lengths**2)))
    assert found.max_px == lengths.max()
    assert np.all((found.pixels >= -0.5) & (found.pixels <= np.array(IMAGE_SIZE) - 0.5))


@pytest.mark.parametrize("name", sorted(set(LENSES) - set(SPLINED)))
def test_a_lens_of_its_own_kind_is_found_exactly(name: str) -> None:
    source = lens_of(name)
    # Polynomials are looked at within the image and 65 degrees, where their coefficients are well told apart.
    found = refit(source, type(source), IMAGE_SIZE, max_angle=np.radians(min(65.0, LENSES[name].reach_deg)))
    assert found.max_px < 1e-4
    # Rational coefficients nearly stand for each other; the others come back as they were.
    if not name.startswith(("pinhole-rational", "pinhole-thin", "pinhole-tilted")):
        np.testing.assert_allclose(found.model.parameters, source.parameters, rtol=1e-5, atol=1e-6)


def test_a_splined_lens_of_its_own_kind_is_found_but_for_its_prior() -> None:
    source = lens_of(SPLINED[0])
    found = refit(source, SPLINED[0], IMAGE_SIZE)
    assert found.rms_px < 0.02


@settings(max_examples=10, deadline=None)
@given(
    alpha=st.floats(0.4, 0.7), beta=st.floats(0.8, 1.2), focal=st.floats(150.0, 3000.0), shift=st.floats(-50.0, 50.0)
)
def test_any_eucm_lens_becomes_kannala_brandt_and_comes_back(
    alpha: float, beta: float, focal: float, shift: float
) -> None:
    source = camera_model("eucm-none").create([alpha, beta, focal, 1.01 * focal, 320.0 + shift, 240.0 - shift])
    there = refit(source, "pinhole-equi", IMAGE_SIZE, max_angle=np.radians(80.0))
    assert there.rms_px < 0.05
    back = refit(there.model, "eucm-none", IMAGE_SIZE, max_angle=np.radians(80.0))
    assert back.rms_px < 0.05


@pytest.mark.parametrize("name", ["eucm-none", "pinhole-radtan", "ds-none", "omni-none"])
def test_rays_with_noise_give_the_lens_within_its_sigma(name: str) -> None:
    source = lens_of(name)
    rng = np.random.default_rng(2)
    angle = np.radians(0.7 * LENSES[name].reach_deg) * np.sqrt(rng.random(500))
    rays = 3.0 * ray_at(angle, rng.uniform(0.0, 2.0 * np.pi, 500))
    pixels = np.asarray(source.project(rays)) + 0.1 * rng.standard_normal((500, 2))
    found = fit_rays(type(source), rays, pixels, IMAGE_SIZE)
    error = np.asarray(found.project(rays) - source.project(rays))
    # 2 N numbers with noise sigma tell n parameters: the mean square error is sigma^2 n / 2 N.
    assert np.sqrt(np.mean(error**2)) < 2.0 * 0.1 * np.sqrt(source.num_parameters / 1000)


def test_corners_without_weight_and_a_start_are_respected() -> None:
    source = lens_of("pinhole-radtan")
    rays = ray_at(np.linspace(0.05, 1.0, 60), np.linspace(0.0, 20.0, 60))
    pixels = np.array(source.project(rays))
    pixels[::7] += 100.0
    weight = np.where(np.arange(60) % 7 == 0, 0.0, 1.0)
    cls = type(source)
    for start in (None, cls.from_focal(300.0, IMAGE_SIZE)):
        found = fit_rays(cls, rays, pixels, IMAGE_SIZE, weight=weight, start=start)
        np.testing.assert_allclose(found.parameters, source.parameters, rtol=1e-6, atol=1e-7)


def test_places_asked_for_are_those_compared() -> None:
    source = camera_model("eucm-none").create(EUCM["wide"])
    pixels = np.stack(np.meshgrid(np.linspace(100.0, 500.0, 9), np.linspace(80.0, 400.0, 7)), axis=-1).reshape(-1, 2)
    found = refit(source, "pinhole-radtan", IMAGE_SIZE, pixels=pixels)
    assert found.share == 1.0
    np.testing.assert_array_equal(found.pixels, pixels)
    # In the middle of a wide lens radtan does what it cannot do up to the corners.
    assert found.rms_px < 1.0 < refit(source, "pinhole-radtan", IMAGE_SIZE).rms_px


def test_a_lens_that_the_other_model_cannot_see_is_refused() -> None:
    source = camera_model("eucm-none").create(EUCM["fisheye"])
    rim = np.array([[318.0 + 340.0 * np.cos(t), 242.0 + 340.0 * np.sin(t)] for t in np.linspace(0.0, 6.0, 30)])
    with pytest.raises(CalibrationError, match=r"0 of 30 places .* within 80 degrees.*wider field of view"):
        refit(source, "pinhole-radtan", IMAGE_SIZE, pixels=rim)


@pytest.mark.parametrize("shapes", [((4, 3), (5, 2)), ((4, 2), (4, 2)), ((0, 3), (0, 2))])
def test_rays_and_pixels_that_do_not_go_together_are_refused(shapes: tuple) -> None:
    with pytest.raises(CalibrationError, match=r"expected \(M, 3\) and \(M, 2\)"):
        fit_rays(camera_model("pinhole-none"), np.ones(shapes[0]), np.ones(shapes[1]), IMAGE_SIZE)
