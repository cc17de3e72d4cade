"""The abstract camera model: a subclass writes `project` for one point, the rest follows by autodiff."""

import abc
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxcal.cameras.numerics import constant
from jaxcal.errors import CalibrationError

# Unprojection looks for its start among these angles (rad) from the axis, and goes on by Newton's method.
_START_ANGLES = 40
_WIDEST = 0.98 * np.pi
_UNPROJECT_STEPS = 10
_LONGEST_STEP = 0.1
# Arrays of vectors given from outside a program are filled up to a power of two, not below this.
_FEWEST = 16
_STEP_LENGTHS = np.array([1.0, 0.4, 0.1, 0.0])


class CameraModel(eqx.Module):
    """A lens: maps points in the camera's frame (z forward, metres) to pixels.

    A subclass is an `equinox.Module` whose array fields are its parameters, in the order in which they are estimated
    and printed. It writes `project` for ONE point of shape (3,), in JAX, returning pixels of shape (2,); `project` of
    any subclass then also accepts arrays of points (..., 3), of jax, numpy or lists. The first `num_intrinsics` scalars
    of the parameter vector are reported as `intrinsics` (Kalibr: fx, fy, cx, cy for a pinhole), the others as
    `distortion`, by `projection_names` and `distortion_names` where a model gives them. A model with a closed form for
    `unproject` writes that for one pixel, likewise.

    Where a point cannot be projected (behind a pinhole, say) `project` may return any pixel that is finite and has
    finite derivatives, and `is_valid` says so.

    `held` are the places in the parameter vector that are never estimated, because others stand for them.
    `usual_spread` may name parameters that recordings often leave open, with the 1-sigma of the values that they
    usually take about those of `from_focal`: far wider than what a good recording says, and all there is in a poor one.
    `two_fold` may name parameters that others stand in for but to second order (the tilt of a sensor): their optimum
    may have a mirror image, which is then looked for.
    """

    name: ClassVar[str] = ""
    num_intrinsics: ClassVar[int] = 4
    projection_names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy")
    distortion_names: ClassVar[tuple[str, ...]] = ()
    held: ClassVar[tuple[int, ...]] = ()
    usual_spread: ClassVar[Mapping[str, float]] = MappingProxyType({})
    two_fold: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name, size in (("project", 3), ("unproject", 2)):
            if name in cls.__dict__:
                setattr(cls, name, _batched(cls.__dict__[name], size))

    @abc.abstractmethod
    def project(self, point: Any) -> Float[Array, "*batch 2"]:
        """Pixels (..., 2) of points (..., 3) in the camera frame, metres; written by subclasses for one point.

        Raises CalibrationError when the last axis is not 3.
        """

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Whether one point (3,) lies in the model's domain; by default, in front of the camera."""
        return point[2] > 0

    # --- parameters as one flat vector -------------------------------------------------------------------------------

    @property
    def parameters(self) -> Float[Array, " n"]:
        """All parameters as one vector (n,), fields in order of their definition."""
        values = [getattr(self, f.name) for f in _fields(self)]
        if any(isinstance(value, Tracer) for value in values):
            return jnp.concatenate([jnp.ravel(jnp.asarray(value, dtype=jnp.float64)) for value in values])
        # Numbers at hand are put together without a program, which every model would need one of its own of.
        return jax.device_put(np.concatenate([np.ravel(np.asarray(value, dtype=np.float64)) for value in values]))

    def with_parameters(self, parameters: Any) -> "CameraModel":
        """The same model with another parameter vector (n,). Raises CalibrationError when its length differs."""
        if not isinstance(parameters, Tracer):
            parameters = np.asarray(parameters, dtype=np.float64)  # slices of it need no programs
        if parameters.shape != (self.num_parameters,):
            raise CalibrationError(
                f"camera model '{self.name or type(self).__name__}': parameters of shape {parameters.shape}; "
                f"expected ({self.num_parameters},)."
            )
        values, start = [], 0
        for field in _fields(self):
            shape = np.shape(getattr(self, field.name))
            size = math.prod(shape)
            part = parameters[start : start + size].reshape(shape)
            values.append(jax.device_put(part) if isinstance(part, np.ndarray) else part)
            start += size
        names = [field.name for field in _fields(self)]
        return eqx.tree_at(lambda m: [getattr(m, n) for n in names], self, values)

    @property
    def num_parameters(self) -> int:
        """How many numbers the model has: projection and distortion together."""
        return sum(np.size(getattr(self, f.name)) for f in _fields(self))

    @property
    def intrinsics(self) -> Float[Array, " k"]:
        """The projection's own parameters, as in Kalibr's yaml: [fx, fy, cx, cy] for a pinhole, in pixels."""
        return self.parameters[: self.num_intrinsics]

    @property
    def distortion(self) -> Float[Array, " d"]:
        """The distortion coefficients (may be empty)."""
        return self.parameters[self.num_intrinsics :]

    @property
    def parameter_names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the intrinsics and of the distortion; i1, i2 .. and d1, d2 .. where the model gives no names."""
        rest = self.num_parameters - self.num_intrinsics
        intrinsics, distortion = self.projection_names, self.distortion_names
        if len(intrinsics) != self.num_intrinsics:
            intrinsics = tuple(f"i{k + 1}" for k in range(self.num_intrinsics))
        if len(distortion) != rest:
            distortion = tuple(f"d{k + 1}" for k in range(rest))
        return intrinsics, distortion

    def regularisation(self) -> Float[Array, " n"]:
        """Information (n,), 1 / sigma^2, of a weak prior that draws each parameter to its value in `from_focal`.

        Zero for parameters that every usable recording determines: all those of a model that does not say otherwise.
        """
        return constant(np.zeros(self.num_parameters))

    @classmethod
    def create(cls, intrinsics: Any, distortion: Any = ()) -> "CameraModel":
        """Build the model from its intrinsics and distortion, as a Kalibr yaml gives them.

        Raises CalibrationError when there are too many or too few of either.
        """
        vector = np.concatenate([np.ravel(intrinsics), np.ravel(distortion)]).astype(np.float64)
        template = cls.from_focal(1.0, (2, 2))
        if np.size(intrinsics) != cls.num_intrinsics or len(vector) != template.num_parameters:
            raise CalibrationError(
                f"camera model '{cls.name or cls.__name__}': {np.size(intrinsics)} intrinsics and "
                f"{np.size(distortion)} distortion coefficients; expected {cls.num_intrinsics} and "
                f"{template.num_parameters - cls.num_intrinsics}."
            )
        return template.with_parameters(jnp.asarray(vector))

    @classmethod
    @abc.abstractmethod
    def from_focal(cls, focal: float, image_size: tuple[int, int]) -> "CameraModel":
        """A first model: focal length in pixels, principal point at the image's centre, no distortion."""

    @classmethod
    def starts(cls, focal: float, image_size: tuple[int, int]) -> tuple["CameraModel", ...]:
        """First models to try when the lens is fitted to rays: `from_focal`, and others where its shape has a say."""
        return (cls.from_focal(focal, image_size),)

    # --- what follows from `project` ---------------------------------------------------------------------------------

    def paraxial(self) -> tuple[Float[Array, "2 2"], Float[Array, "2"]]:
        """The lens near its axis: pixels per radian (2, 2) and the pixel (2,) of the axis, whatever the parameters are.

        For a pinhole the matrix is diag(fx, fy) and the pixel (cx, cy).
        """
        axis = jnp.array([0.0, 0.0, 1.0])
        return jax.jacfwd(self.project)(axis)[:, :2], self.project(axis)

    def unproject(self, pixel: Any) -> Float[Array, "*batch 3"]:
        """Rays (..., 3) of unit length through pixels (..., 2): Gauss-Newton on `project`, on the unit sphere.

        Where a lens folds the image, the ray nearer to the axis is found; where a pixel belongs to no point, some ray.
        Derivatives by pixel and by parameters are those of the implicit function.

        Raises CalibrationError when the last axis is not 2.
        """
        return _unproject_all(self, pixel)


@eqx.filter_jit
def _unproject(model: CameraModel, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
    numbers, rest = eqx.partition(model, eqx.is_inexact_array)
    fixed = eqx.combine(jax.lax.stop_gradient(numbers), rest)
    wanted = jax.lax.stop_gradient(pixel)
    ray = jax.lax.fori_loop(0, _UNPROJECT_STEPS, lambda _, ray: _closer(fixed, wanted, ray), _start(fixed, wanted))
    # One undamped step more: it carries the derivatives, which are then those of the implicit function.
    moved = ray + _newton_step(model, pixel, jax.lax.stop_gradient(ray))
    return moved / jnp.linalg.norm(moved)


def _start(model: CameraModel, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
    """A ray near the one wanted: on the pixel's side of the axis, at the angle where the image first is as far out."""
    scale, centre = model.paraxial()
    arm = pixel - centre
    wanted = jnp.sqrt(arm @ arm + 1e-30)
    azimuth = _solve(scale, arm)
    azimuth = azimuth / jnp.sqrt(azimuth @ azimuth + 1e-30)
    angles = jnp.linspace(0.0, _WIDEST, _START_ANGLES)
    rays = jnp.concatenate([jnp.sin(angles)[:, None] * azimuth, jnp.cos(angles)[:, None]], axis=1)
    reach = jax.vmap(lambda ray: (model.project(ray) - centre) @ arm)(rays) / wanted
    # Beyond the first angle at which the image stops moving outwards lies a fold, or the rear.
    last = jnp.argmin(jnp.append(reach[1:] > reach[:-1], False))
    far = jnp.minimum(jnp.argmax(jnp.append(reach >= wanted, True)), last)
    near = jnp.maximum(far - 1, 0)
    share = jnp.clip((wanted - reach[near]) / jnp.maximum(reach[far] - reach[near], 1e-30), 0.0, 1.0)
    angle = angles[near] + share * (angles[far] - angles[near])
    return jnp.append(jnp.sin(angle) * azimuth, jnp.cos(angle))


def _newton_step(model: CameraModel, pixel: Float[Array, "2"], ray: Float[Array, "3"]) -> Float[Array, "3"]:
    """The smallest change of a ray that brings its projection to the pixel, to first order."""
    error = model.project(ray) - pixel
    jacobian = jax.jacfwd(model.project)(ray)
    # The radial direction is in the null space of the projection's Jacobian, so a minimum-norm step is wanted.
    gram = jacobian @ jacobian.T
    return -jacobian.T @ _solve(gram + (1e-12 * jnp.trace(gram) + 1e-30) * jnp.eye(2), error)


def _closer(model: CameraModel, pixel: Float[Array, "2"], ray: Float[Array, "3"]) -> Float[Array, "3"]:
    """A Newton step from a ray, of the length (full, a part, or none) that comes closest to the pixel."""
    step = _newton_step(model, pixel, ray)
    step = step * jnp.minimum(1.0, _LONGEST_STEP / jnp.sqrt(step @ step + 1e-30))
    moved = ray + _STEP_LENGTHS[:, None] * step
    moved = moved / jnp.linalg.norm(moved, axis=1, keepdims=True)
    errors = jax.vmap(lambda ray: jnp.sum((model.project(ray) - pixel) ** 2))(moved)
    return moved[jnp.argmin(errors)]


def _solve(matrix: Float[Array, "2 2"], right: Float[Array, "2"]) -> Float[Array, "2"]:
    """Cramer's rule, which compiles and runs far faster than a batch of factorisations."""
    (a, b), (c, d) = matrix
    return jnp.stack([d * right[0] - b * right[1], a * right[1] - c * right[0]]) / (a * d - b * c)


def _batched(of_one: Callable[[Any, Array], Array], size: int) -> Callable[[Any, Any], Array]:
    """A method of one vector (size,), as a method of an array-like (..., size).

    Called outside of any program it becomes one: operation by operation each would be compiled for each shape.
    """

    def of_all(model: CameraModel, vectors: Array) -> Array:
        return jax.vmap(functools.partial(of_one, model))(vectors)

    program = eqx.filter_jit(of_all)

    def at_once(model: CameraModel, vectors: np.ndarray) -> Array:
        count = math.prod(vectors.shape[:-1])
        padded = np.ones((max(_FEWEST, 1 << (count - 1).bit_length()), size))  # few shapes: few programs
        padded[:count] = vectors.reshape(-1, size)
        out = np.asarray(program(model, jax.device_put(padded)))[:count]
        return jax.device_put(out.reshape(*vectors.shape[:-1], out.shape[-1]))

    @functools.wraps(of_one)
    def of_many(self: CameraModel, vectors: Any) -> Array:
        inside = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((self, vectors)))
        vectors = jnp.asarray(vectors, dtype=float) if inside else np.asarray(vectors, dtype=float)
        if vectors.ndim == 0 or vectors.shape[-1] != size:
            raise CalibrationError(
                f"camera model '{self.name or type(self).__name__}': {of_one.__name__.lstrip('_')} got an array of "
                f"shape {vectors.shape}; expected (..., {size})."
            )
        if not inside:
            return at_once(self, vectors)
        if vectors.ndim == 1:
            return of_one(self, vectors)
        out = of_all(self, vectors.reshape(-1, size))
        return out.reshape(*vectors.shape[:-1], out.shape[-1])

    return of_many


_unproject_all = _batched(_unproject, 2)


def _fields(model: CameraModel) -> list[dataclasses.Field[Any]]:
    return [f for f in dataclasses.fields(model) if not f.metadata.get("static", False)]
