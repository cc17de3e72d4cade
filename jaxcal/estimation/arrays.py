"""Numbers at hand as arrays of the device."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array


def on_device(values: Any) -> Array:
    """Numbers, lists or numpy arrays as an array of the device, of the same shape.

    `jnp.asarray` compiles a program to copy each new shape (jax 0.10): two dozen of them in one calibration.
    """
    return jax.device_put(np.asarray(values))
