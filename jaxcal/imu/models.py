"""IMU models by Kalibr's names: what a gyroscope and an accelerometer read, given how they move and their parameters.

Rehder, Nikolic, Schneider, Hinzmann and Siegwart, "Extending kalibr: calibrating the extrinsics of multiple IMUs and of
individual axes", ICRA 2016, sec. III; parameters and their order as in Kalibr's results.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.errors import CalibrationError
from jaxcal.trajectory import so3

_LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
_EYE = (1.0, 0.0, 1.0, 0.0, 0.0, 1.0)

# From (parameters, angular velocity, specific force at the IMU's origin, and at each accelerometer's place (3, 3), all
# in the IMU's frame) to readings (6,) without biases.
Response = Callable[[Array, Array, Array, Array], Array]


@dataclass(frozen=True)
class ImuModel:
    """An IMU model: `blocks` of parameters in order, with the names of their entries, their `nominal` values, and the
    1-sigma `spread` of what parts on the market show, as a weak prior. `accelerometers` gives the places (3, 3) of the
    three accelerometers in the IMU's frame, m, from the parameters; None where they are all at its origin."""

    name: str
    blocks: tuple[tuple[str, tuple[str, ...]], ...]
    nominal: tuple[float, ...]
    spread: tuple[float, ...]
    response: Response
    accelerometers: Callable[[Array], Array] | None = None

    @property
    def size(self) -> int:
        """How many numbers the model has."""
        return len(self.nominal)

    def labels(self) -> list[str]:
        """A name for every parameter."""
        return [f"{block} {entry}" for block, entries in self.blocks for entry in entries]

    def matrices(self, parameters: np.ndarray) -> dict[str, np.ndarray]:
        """The parameters as Kalibr writes them: M_accel, M_gyro (3, 3) lower triangular, A_gyro (3, 3), C_gyro_i (3, 3)
        a rotation, r_y, r_z (3,) m."""
        out, start = {}, 0
        for block, entries in self.blocks:
            values = np.asarray(parameters)[start : start + len(entries)]
            start += len(entries)
            if block.startswith("M_"):
                out[block] = np.asarray(_lower(jnp.asarray(values)))
            elif block == "C_gyro_i":
                out[block] = np.asarray(so3.exp(jnp.asarray(values)))
            else:
                out[block] = values.reshape(3, 3) if len(entries) == 9 else values
        return out


def _lower(values: Float[Array, "6"]) -> Float[Array, "3 3"]:
    rows, columns = np.array(_LOWER).T
    return jnp.zeros((3, 3)).at[rows, columns].set(values)


def _calibrated(parameters: Array, omega: Array, force: Array, at_axes: Array) -> Array:
    return jnp.concatenate([omega, force])


def _scale_misalignment(parameters: Array, omega: Array, force: Array, at_axes: Array) -> Array:
    """accel = M_accel f; gyro = M_gyro C_gyro_i omega + A_gyro C_gyro_i f; f at each axis' own place."""
    M_accel, M_gyro = _lower(parameters[:6]), _lower(parameters[6:12])
    A_gyro, C_gyro_i = parameters[12:21].reshape(3, 3), so3.exp(parameters[21:24])
    return jnp.concatenate([M_gyro @ C_gyro_i @ omega + A_gyro @ C_gyro_i @ force, M_accel @ jnp.diagonal(at_axes)])


def _places(parameters: Array) -> Array:
    """The x axis' accelerometer is at the origin: its place and the IMU's are told apart by nothing."""
    return jnp.concatenate([jnp.zeros((1, 3)), parameters[24:30].reshape(2, 3)])


_ENTRIES = tuple(f"{i + 1}{j + 1}" for i, j in _LOWER)
_FULL = tuple(f"{i + 1}{j + 1}" for i in range(3) for j in range(3))
_SCALE_BLOCKS = (("M_accel", _ENTRIES), ("M_gyro", _ENTRIES), ("A_gyro", _FULL), ("C_gyro_i", ("x", "y", "z")))
_SCALE_NOMINAL = (*_EYE, *_EYE, *(12 * (0.0,)))
_SCALE_SPREAD = (*(12 * (0.1,)), *(9 * (0.01,)), *(3 * (0.1,)))

IMU_MODELS: Mapping[str, ImuModel] = MappingProxyType(
    {
        model.name: model
        for model in (
            ImuModel("calibrated", (), (), (), _calibrated),
            ImuModel("scale-misalignment", _SCALE_BLOCKS, _SCALE_NOMINAL, _SCALE_SPREAD, _scale_misalignment),
            ImuModel(
                "scale-misalignment-size-effect",
                (*_SCALE_BLOCKS, ("r_y", ("x", "y", "z")), ("r_z", ("x", "y", "z"))),
                (*_SCALE_NOMINAL, *(6 * (0.0,))),
                (*_SCALE_SPREAD, *(6 * (0.05,))),
                _scale_misalignment,
                _places,
            ),
        )
    }
)


def imu_model(name: str) -> ImuModel:
    """The model of that name. Raises CalibrationError when there is none."""
    if name not in IMU_MODELS:
        raise CalibrationError(f"IMU model '{name}' is unknown; known: {', '.join(IMU_MODELS)}.")
    return IMU_MODELS[name]


def respond(
    model: ImuModel,
    parameters: Float[Array, " m"],
    R_imu_rig: Float[Array, "3 3"],
    t_imu_rig: Float[Array, "3"],
    omega: Float[Array, "3"],
    alpha: Float[Array, "3"],
    force: Float[Array, "3"],
) -> Float[Array, "6"]:
    """Readings (gyro rad/s, accel m/s^2) without biases of an IMU somewhere on a rig.

    `omega`, `alpha` angular velocity and acceleration, `force` the specific force R' (a - g) at the rig's origin, all
    in the rig's frame. Furgale et al. 2013, eq. 11 and 12; lever arms as in Rehder et al. 2016, eq. 5.
    """

    def force_at(place: Array) -> Array:
        return R_imu_rig @ (force + jnp.cross(alpha, place) + jnp.cross(omega, jnp.cross(omega, place)))

    origin = -R_imu_rig.T @ t_imu_rig
    at_origin = force_at(origin)
    if model.accelerometers is None:
        at_axes = jnp.tile(at_origin, (3, 1))
    else:
        at_axes = jnp.stack([force_at(origin + R_imu_rig.T @ place) for place in model.accelerometers(parameters)])
    return model.response(parameters, R_imu_rig @ omega, at_origin, at_axes)
