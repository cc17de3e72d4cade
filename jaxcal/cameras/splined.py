"""A lens that no formula fits: a B-spline surface over a stereographic projection, in the manner of mrcal."""

import functools
import math
import re
import types
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.cameras.base import CameraModel
from jaxcal.cameras.numerics import at_least, constant, first_pinhole, keeps_orientation, length
from jaxcal.errors import CalibrationError

_SHORT_NAME = re.compile(r"splined-(\d+)-(\d+)-(\d+)-(\d+(?:\.\d+)?)")
_MRCAL_NAME = re.compile(
    r"LENSMODEL_SPLINED_STEREOGRAPHIC_order=(\d+)_Nx=(\d+)_Ny=(\d+)_fov_x_deg=(\d+(?:\.\d+)?)", re.IGNORECASE
)
_CLASS_NAME = re.compile(r"Splined_(\d+)_(\d+)_(\d+)_(\d+(?:p\d+)?)")
# 1-sigma of the prior on a knot, in focal lengths: lenses of 120 degrees differ by less from a stereographic one.
_KNOT_SIGMA = 1.0


class SplinedStereographic(CameraModel):
    """`splined-ORDER-NX-NY-FOV`: fx, fy, cx, cy; NY rows of NX knots (dx, dy).

    The model is mrcal's LENSMODEL_SPLINED_STEREOGRAPHIC (its documentation, "lens models"), with the same parameters.
    u = 2 tan(theta / 2) (x, y) / |(x, y)| is the stereographic image of a point; pixel = f (u + s(u)) + c, where s is a
    uniform B-spline surface of degree ORDER (2 or 3) with its knots evenly spaced in u, the outermost half a cell
    (quadratic) or a whole one (cubic) beyond +-2 tan(FOV / 4) in x, FOV in degrees; in y they are equally far apart.
    Outside, s stays what it is at the edge, where mrcal extrapolates the polynomial; `is_valid` ends there.

    Two freedoms are held when it is calibrated. The surface can do what f and c do: these four are held (as mrcal
    recommends). And it can turn the image as turning the camera would: both numbers of the knot at the centre, and dy
    of one half way to the right, are held, which fixes the camera's frame and costs nothing.
    """

    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    knots: Float[Array, "ny nx 2"]

    order: ClassVar[int]
    shape: ClassVar[tuple[int, int]]  # rows, columns of knots
    fov_x_deg: ClassVar[float]

    @classmethod
    def knots_per_unit(cls) -> float:
        """Knots per unit of u."""
        return (cls.shape[1] - cls.order) / (4.0 * math.tan(math.radians(cls.fov_x_deg) / 4.0))

    @classmethod
    def edge(cls) -> tuple[float, float]:
        """The largest |u_x| and |u_y| where the surface is defined."""
        rows, columns = cls.shape
        per_unit = cls.knots_per_unit()
        return (columns - cls.order) / (2.0 * per_unit), (rows - cls.order) / (2.0 * per_unit)

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Pixel (2,) of a point (3,) in the camera frame, metres."""
        plane = _stereographic(point)
        return self.focal * (plane + self._surface(plane)) + self.centre

    def _surface(self, plane: Float[Array, "2"]) -> Float[Array, "2"]:
        edge = jnp.asarray(self.edge())
        last = jnp.array([self.shape[1] - 1.0, self.shape[0] - 1.0])
        place = jnp.clip(plane, -edge, edge) * self.knots_per_unit() + last / 2.0
        support = self.order + 1
        # First knot of the cell: floor for cubics, whose cells lie between knots, nearest for quadratics.
        cell = jnp.floor(place + (0.5 if self.order == 2 else 0.0))
        cell = jnp.clip(cell, 1.0, last - (1.0 if self.order == 2 else 2.0))
        column, row = cell.astype(int) - 1
        patch = jax.lax.dynamic_slice(self.knots, (row, column, jnp.zeros_like(row)), (support, support, 2))
        across, down = (_weights(place[k] - cell[k], self.order) for k in range(2))
        return jnp.einsum("i,j,ijk->k", down, across, patch)

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Whether a point (3,) lies where the surface is defined and does not fold the image there."""
        plane = _stereographic(point)
        unfolded = keeps_orientation(lambda u: u + self._surface(u), plane)
        ahead = point[2] > -0.999999 * length(point)  # opposite the axis, where the stereographic projection ends
        return jnp.all(jnp.abs(plane) <= jnp.asarray(self.edge())) & unfolded & ahead

    def regularisation(self) -> Float[Array, " n"]:
        """A prior of 1-sigma one focal length on every knot, far wider than what data say; none on fx, fy, cx, cy.

        A knot is seen by the corners of a few cells only. Where there are none nothing else would determine it; where
        there are some the prior weighs less than one corner with an error of a focal length.
        """
        return constant(np.append(np.zeros(4), np.full(self.knots.size, _KNOT_SIGMA**-2)))

    @classmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        """Focal length at the image's centre in pixels; a flat surface, so a stereographic lens."""
        return cls(*first_pinhole(focal, image_size), constant(np.zeros((*cls.shape, 2))))


@functools.lru_cache
def splined_stereographic(order: int, nx: int, ny: int, fov_x_deg: float) -> type[SplinedStereographic]:
    """The class of splined lenses with this configuration (mrcal's order, Nx, Ny, fov_x_deg); one class for each.

    Raises CalibrationError when the order is not 2 or 3, there are too few knots, or the angle is not in (0, 360).
    """
    name = f"splined-{order}-{nx}-{ny}-{fov_x_deg:g}"
    if order not in (2, 3):
        raise CalibrationError(f"camera model '{name}': order {order}; expected 2 (quadratic) or 3 (cubic).")
    if min(nx, ny) < order + 1:
        raise CalibrationError(f"camera model '{name}': {nx} x {ny} knots; order {order} needs {order + 1} or more.")
    if not 0.0 < fov_x_deg < 360.0:
        raise CalibrationError(f"camera model '{name}': a field of view of {fov_x_deg:g} deg; expected 0 to 360.")
    middle, right = ny // 2 * nx + nx // 2, ny // 2 * nx + 3 * nx // 4
    class_name = name.replace("s", "S", 1).replace("-", "_").replace(".", "p")
    contents = {
        "__doc__": f"`{name}`: {nx} x {ny} knots of degree {order} over {fov_x_deg:g} deg (SplinedStereographic).",
        "__module__": __name__,
        "__annotations__": {},
        "name": name,
        "order": order,
        "shape": (ny, nx),
        "fov_x_deg": float(fov_x_deg),
        "held": (0, 1, 2, 3, 4 + 2 * middle, 5 + 2 * middle, 5 + 2 * right),
        "distortion_names": tuple(f"d{axis}[{row},{col}]" for row in range(ny) for col in range(nx) for axis in "xy"),
    }
    return types.new_class(class_name, (SplinedStereographic,), exec_body=lambda body: body.update(contents))


def splined_from_name(name: str) -> type[SplinedStereographic] | None:
    """The class called `splined-3-16-12-120` or, as in mrcal, `LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=16_...`."""
    match = _SHORT_NAME.fullmatch(name) or _MRCAL_NAME.fullmatch(name)
    if match is None:
        return None
    return splined_stereographic(int(match[1]), int(match[2]), int(match[3]), float(match[4]))


def __getattr__(name: str) -> Any:
    """Generated classes as attributes of the module, so that pickles and 'module:Class' names find them."""
    match = _CLASS_NAME.fullmatch(name)
    if match is None:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return splined_stereographic(int(match[1]), int(match[2]), int(match[3]), float(match[4].replace("p", ".")))


def _stereographic(point: Float[Array, "3"]) -> Float[Array, "2"]:
    distance = length(point)
    return 2.0 * point[:2] / at_least(distance + point[2], 1e-6 * distance)


def _weights(t: Float[Array, ""], order: int) -> Float[Array, " k"]:
    """Uniform B-spline weights (order + 1,): t in [-1/2, 1/2] from the middle knot of three, or in [0, 1] of four."""
    if order == 2:
        return jnp.stack([(0.5 - t) ** 2 / 2.0, 0.75 - t * t, (0.5 + t) ** 2 / 2.0])
    s = 1.0 - t
    return jnp.stack([s**3, 4.0 - 6.0 * t**2 + 3.0 * t**3, 4.0 - 6.0 * s**2 + 3.0 * s**3, t**3]) / 6.0
