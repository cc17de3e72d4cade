"""The abstract camera model: a subclass writes `project` for one point, the rest follows by autodiff."""

import abc
import dataclasses
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
    any subclass then also accepts arrays of points (..., 3). The first `num_intrinsics` scalars of the parameter
    vector are reported as `intrinsics` (Kalibr: fx, fy, cx, cy for a pinhole), the others as `distortion`.

    Where a point cannot be projected (behind a pinhole, say) `project` may return anything, and `is_valid` says so.
    """

    name: ClassVar[str] = ""
    num_intrinsics: ClassVar[int] = 4

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        method = cls.__dict__.get("project")
        if method is not None and not getattr(method, "__isabstractmethod__", False):
            one_point = method if callable(method) else method.__get__  # equinox wraps methods in a descriptor
            function = getattr(method, "method", one_point)

            def project(self: "CameraModel", points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
                points = jnp.asarray(points)
                call = function
                flat = points.reshape(-1, 3)
                if points.ndim == 1:
                    return call(self, points)
                return jax.vmap(lambda point: call(self, point))(flat).reshape(*points.shape[:-1], 2)

            project.__doc__ = getattr(function, "__doc__", None)
            cls.project = project  # type: ignore[method-assign]

    @abc.abstractmethod
    def project(self, point: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Pixels of points in the camera frame; written by subclasses for one point."""

    def is_valid(self, point: Float[Array, "3"]) -> Any:
        """Whether one point (3,) lies in the model's domain; by default, in front of the camera."""
        return point[2] > 0

    # --- parameters as one flat vector -------------------------------------------------------------------------------

    @property
    def parameters(self) -> Float[Array, " n"]:
        """All parameters as one vector (n,), fields in order of their definition."""
        return jnp.concatenate([jnp.ravel(jnp.asarray(getattr(self, f.name), dtype=jnp.float64)) for f in _fields(self)])

    def with_parameters(self, parameters: Float[Array, " n"]) -> "CameraModel":
        """The same model with another parameter vector (n,)."""
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
        """Build the model from its intrinsics and distortion, as a Kalibr yaml gives them."""
        vector = np.concatenate([np.ravel(intrinsics), np.ravel(distortion)]).astype(np.float64)
        template = cls.from_focal(1.0, (2, 2))
        if len(vector) != template.num_parameters:
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

    def unproject(self, pixels: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """Rays (..., 3) of unit length through pixels (..., 2): Gauss-Newton on `project`, on the unit sphere.

        Models with a closed form may override this.
        """
        pixels = jnp.asarray(pixels)
        rays = jax.vmap(self._unproject_one)(pixels.reshape(-1, 2))
        return rays.reshape(*pixels.shape[:-1], 3)

    def _unproject_one(self, pixel: Float[Array, "2"]) -> Float[Array, "3"]:
        focal, centre = self.intrinsics[:2], self.intrinsics[2:4]
        tangent = (pixel - centre) / focal
        radius = jnp.sqrt(tangent @ tangent + 1e-30)
        start = jnp.append(jnp.sin(radius) / radius * tangent, jnp.cos(radius))
        # Points outside the forward half start on its rim: the equidistant guess is meant for fisheyes.
        start = jnp.where(radius < 1.4, start, jnp.append(tangent / radius, 0.15))

        def step(_: Any, ray: Array) -> Array:
            error = self.project(ray) - pixel
            jacobian = jax.jacfwd(self.project)(ray)
            # Minimum-norm step; the radial direction is in the null space of the projection's Jacobian.
            gram = jacobian @ jacobian.T
            delta = -jacobian.T @ jnp.linalg.solve(gram + 1e-12 * jnp.trace(gram) * jnp.eye(2), error)
            delta = delta * jnp.minimum(1.0, 0.3 / (jnp.linalg.norm(delta) + 1e-30))
            moved = ray + delta
            return moved / jnp.linalg.norm(moved)

        return jax.lax.fori_loop(0, _UNPROJECT_STEPS, step, start / jnp.linalg.norm(start))


def _fields(model: CameraModel) -> list[dataclasses.Field[Any]]:
    return [f for f in dataclasses.fields(model) if not f.metadata.get("static", False)]
