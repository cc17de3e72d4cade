"""One lens of every model, with the angle up to which it is looked at, and a user's own model."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxcal.cameras import CameraModel, camera_model

IMAGE_SIZE = (640, 480)
CORE = (420.0, 425.0, 318.0, 241.0)


class Stereographic(CameraModel):
    """A user's model: nothing but fields, `project`, `from_focal` and, as it sees behind itself, `is_valid`."""

    focal: Array
    centre: Array

    def project(self, point: Any) -> Any:
        return 2.0 * self.focal * point[:2] / (jnp.linalg.norm(point) + point[2]) + self.centre

    def is_valid(self, point: Any) -> Any:
        return point[2] > -0.9 * jnp.linalg.norm(point)

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "Stereographic":
        return cls(jnp.full(2, float(focal)), (jnp.asarray(image_size) - 1.0) / 2.0)


@dataclass(frozen=True)
class Example:
    """`edge_deg` is where the model's domain ends on every azimuth (None: not a circle), `reach_deg` a bit less."""

    intrinsics: tuple[float, ...]
    distortion: tuple[float, ...]
    reach_deg: float
    edge_deg: float | None

    def parameters(self) -> np.ndarray:
        return np.array(self.intrinsics + self.distortion)


# Smooth bumps of up to 2 % of the focal length: rows, columns of knots as in the names below.
def _bumps(rows: int, columns: int) -> tuple[float, ...]:
    row, column, axis = np.meshgrid(np.arange(rows), np.arange(columns), np.arange(2), indexing="ij")
    return tuple((0.02 * np.sin(0.9 * row + 1.3 * column + 2.0 * axis)).ravel().tolist())


def _fold(*coefficients: float) -> float:
    """The smallest x > 0 at which the derivative of x (1 + c1 x^2 + c2 x^4 + ...) vanishes."""
    powers = np.arange(len(coefficients) + 1)
    roots = np.roots(((2 * powers + 1) * np.array([1.0, *coefficients]))[::-1])
    return float(np.sqrt(min(root.real for root in roots if abs(root.imag) < 1e-12 and root.real > 0)))


_RATIONAL = (0.55, 0.045, 2e-4, -1e-4, 0.0005, 0.9, 0.15, 0.004)
_PRISM = (1e-3, -2e-5, -8e-4, 1e-5)
SPLINED = ("splined-3-10-8-150", "splined-2-8-9-170")
OWN = "example_lenses:Stereographic"

LENSES: dict[str, Example] = {
    "pinhole-none": Example(CORE, (), 85.0, 90.0),
    # 1 + 3 k1 r^2 + 5 k2 r^4 has no root: it never folds. The next two do, where that derivative vanishes.
    "pinhole-radtan": Example(CORE, (-0.28, 0.07, 2e-4, -1e-4), 70.0, 90.0),
    "pinhole-radtan5": Example(
        CORE, (-0.28, 0.09, 0.0, 0.0, -0.005), 70.0, np.degrees(np.arctan(_fold(-0.28, 0.09, -0.005)))
    ),
    "pinhole-rational8": Example(CORE, _RATIONAL, 80.0, None),
    "pinhole-thinprism12": Example(CORE, _RATIONAL + _PRISM, 75.0, None),
    "pinhole-tilted14": Example(CORE, _RATIONAL + _PRISM + (0.02, -0.03), 75.0, None),
    "pinhole-equi": Example(
        (220.0, 221.0, 318.0, 241.0),
        (0.01, -0.005, 0.002, -0.0005),
        115.0,
        np.degrees(_fold(0.01, -0.005, 0.002, -0.0005)),
    ),
    "pinhole-fov": Example((220.0, 221.0, 318.0, 241.0), (0.95,), 150.0, 180.0),
    "pinhole-division": Example((220.0, 221.0, 318.0, 241.0), (-0.2,), 150.0, 180.0),
    "omni-none": Example((1.2, 600.0, 605.0, 318.0, 241.0), (), 140.0, np.degrees(np.arccos(-1 / 1.2))),
    "omni-radtan": Example((0.9, 600.0, 605.0, 318.0, 241.0), (-0.1, 0.02, 1e-3, -1e-3), 130.0, None),
    # z = -w d with w = (1 - alpha) / alpha = 2/3 (Usenko et al. 2018, eq. 15, 16; 43 to 45).
    "eucm-none": Example(
        (0.6, 1.1, 300.0, 301.0, 318.0, 241.0),
        (),
        128.0,
        90.0 + np.degrees(np.arctan(np.sqrt(1.1 * 4 / 9 / (1 - 4 / 9)))),
    ),
    "ds-none": Example(
        (-0.2, 0.6, 200.0, 201.0, 318.0, 241.0),
        (),
        117.0,
        np.degrees(np.arccos(-(2 / 3 - 0.2) / np.sqrt(2 * 2 / 3 * -0.2 + 0.2**2 + 1))),
    ),
    SPLINED[0]: Example(CORE, _bumps(8, 10), 54.0, None),
    SPLINED[1]: Example(CORE, _bumps(9, 8), 80.0, None),
    OWN: Example((220.0, 221.0, 318.0, 241.0), (), 150.0, np.degrees(np.arccos(-0.9))),
}


def lens_of(name: str, bend: float = 1.0) -> CameraModel:
    """The example lens of a model, its distortion scaled by `bend`."""
    example = LENSES[name]
    distortion = np.array(example.distortion)
    return camera_model(name).create(example.intrinsics, distortion if name.endswith("fov") else bend * distortion)


def ray_at(angle: Any, azimuth: Any) -> np.ndarray:
    """Unit vectors (..., 3) at an angle (rad) from the optical axis."""
    angle, azimuth = np.broadcast_arrays(angle, azimuth)
    return np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=-1)


def some_points(name: str, shape: tuple[int, ...], part: float = 1.0) -> np.ndarray:
    """Points (*shape, 3) all over the model's domain (or an inner part of it), 0.2 to 5 m away."""
    rng = np.random.default_rng(7)
    angle = part * np.deg2rad(LENSES[name].reach_deg) * np.sqrt(rng.random(shape))
    return rng.uniform(0.2, 5.0, shape)[..., None] * ray_at(angle, 2 * np.pi * rng.random(shape))
