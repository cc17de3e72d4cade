"""The abstract camera model: a subclass writes `project` for one point, the rest follows by autodiff."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.errors import CalibrationError

_UNPROJECT_STEPS = 20


class CameraModel(eqx.Module):
    """A lens: maps points in the camera's frame (z forward, metres) to pixels.

    A subclass is an `equinox.Module` whose array fields are its parameters, in the order in which they are estimated
    and printed. It writes `project` for ONE point of shape (3,), in JAX, returning pixels of shape (2,); `project` of
    any subclass then also accepts arrays of points (..., 3), of jax, numpy or lists. The first `num_intrinsics` scalars
    of the parameter vector are reported as `intrinsics` (Kalibr: fx, fy, cx, cy for a pinhole), the others as
    `distortion`. A model with a closed form for `unproject` writes that for one pixel, likewise.

    Where a point cannot be projected (behind a pinhole, say) `project` may return anything, and `is_valid` says so.
    """

    name: ClassVar[str] = ""
    num_intrinsics: ClassVar[int] = 4

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
        return jnp.concatenate(
            [jnp.ravel(jnp.asarray(getattr(self, f.name), dtype=jnp.float64)) for f in _fields(self)]
        )

    def with_parameters(self, parameters: Any) -> "CameraModel":
        """The same model with another parameter vector (n,). Raises CalibrationError when its length differs."""
        parameters = jnp.asarray(parameters, dtype=float)
        if parameters.shape != (self.num_parameters,):
            raise CalibrationError(
                f"camera model '{self.name or type(self).__name__}': parameters of shape {parameters.shape}; "
                f"expected ({self.num_parameters},)."
            )
        values, start = [], 0
        for field in _fields(self):
            old = jnp.asarray(getattr(self, field.name))
            values.append(parameters[start : start + old.size].reshape(old.shape))
            start += old.size
        names = [field.name for field in _fields(self)]
        return eqx.tree_at(lambda m: [getattr(m, n) for n in names], self, values)

    @property
    def num_parameters(self) -> int:
        return sum(np.size(getattr(self, f.name)) for f in _fields(self))

    @property
    def intrinsics(self) -> Float[Array, " k"]:
        """The projection's own parameters, as in Kalibr's yaml: [fx, fy, cx, cy] for a pinhole, in pixels."""
        return self.parameters[: self.num_intrinsics]

    @property
    def distortion(self) -> Float[Array, " d"]:
        """The distortion coefficients (may be empty)."""
        return self.parameters[self.num_intrinsics :]

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

    # --- what follows from `project` ---------------------------------------------------------------------------------

    def unproject(self, pixel: Any) -> Float[Array, "*batch 3"]:
        """Rays (..., 3) of unit length through pixels (..., 2): Gauss-Newton on `project`, on the unit sphere.

        Raises CalibrationError when the last axis is not 2.
        """
        return _batched(_unproject, 2)(self, pixel)


@eqx.filter_jit
def _unproject(model: CameraModel, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
    focal, centre = model.intrinsics[:2], model.intrinsics[2:4]
    tangent = (pixel - centre) / focal
    radius = jnp.sqrt(tangent @ tangent + 1e-30)
    start = jnp.append(jnp.sin(radius) / radius * tangent, jnp.cos(radius))
    # Points outside the forward half start on its rim: the equidistant guess is meant for fisheyes.
    start = jnp.where(radius < 1.4, start, jnp.append(tangent / radius, 0.15))

    def step(_: Any, ray: Array) -> Array:
        error = model.project(ray) - pixel
        jacobian = jax.jacfwd(model.project)(ray)
        # Minimum-norm step; the radial direction is in the null space of the projection's Jacobian.
        gram = jacobian @ jacobian.T
        delta = -jacobian.T @ jnp.linalg.solve(gram + 1e-12 * jnp.trace(gram) * jnp.eye(2), error)
        # The constant keeps the gradient finite where the step is zero.
        delta = delta * jnp.minimum(1.0, 0.3 / jnp.sqrt(delta @ delta + 1e-30))
        moved = ray + delta
        return moved / jnp.linalg.norm(moved)

    return jax.lax.fori_loop(0, _UNPROJECT_STEPS, step, start / jnp.linalg.norm(start))


def _batched(of_one: Callable[[Any, Array], Array], size: int) -> Callable[[Any, Any], Array]:
    """A method of one vector (size,), as a method of an array-like (..., size)."""

    @functools.wraps(of_one)
    def of_many(self: CameraModel, vectors: Any) -> Array:
        vectors = jnp.asarray(vectors, dtype=float)
        if vectors.ndim == 0 or vectors.shape[-1] != size:
            raise CalibrationError(
                f"camera model '{self.name or type(self).__name__}': {of_one.__name__.lstrip('_')} got an array of "
                f"shape {vectors.shape}; expected (..., {size})."
            )
        call = functools.partial(of_one, self)
        if vectors.ndim == 1:
            return call(vectors)
        out = jax.vmap(call)(vectors.reshape(-1, size))
        return out.reshape(*vectors.shape[:-1], out.shape[-1])

    return of_many


def _fields(model: CameraModel) -> list[dataclasses.Field[Any]]:
    return [f for f in dataclasses.fields(model) if not f.metadata.get("static", False)]
