"""Distortions of the normalised image plane, each one function of a point (2,) and its coefficients.

Polynomial ones carry with them their radial part (`..._radial`), from which a camera model finds where they fold back.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.cameras.numerics import at_least

Plane = Float[Array, "2"]
Scalar = Float[Array, ""]


def no_distortion(plane: Plane) -> Plane:
    """A perfect lens."""
    return plane


def radtan(plane: Plane, coefficients: Float[Array, "4"]) -> Plane:
    """Radial-tangential distortion k1, k2, p1, p2 (Brown 1966; OpenCV's calib3d documentation, first four terms)."""
    return _brown(plane, radtan_radial(plane @ plane, coefficients), coefficients)


def radtan_radial(r2: Scalar, coefficients: Float[Array, "4"]) -> Scalar:
    """Radial factor of `radtan` at a squared radius."""
    k1, k2 = coefficients[0], coefficients[1]
    return 1.0 + r2 * (k1 + k2 * r2)


def radtan5(plane: Plane, coefficients: Float[Array, "5"]) -> Plane:
    """Radial-tangential distortion k1, k2, p1, p2, k3 (OpenCV's calib3d documentation, first five terms)."""
    return _brown(plane, radtan5_radial(plane @ plane, coefficients), coefficients)


def radtan5_radial(r2: Scalar, coefficients: Float[Array, "5"]) -> Scalar:
    """Radial factor of `radtan5` at a squared radius."""
    k1, k2, _, _, k3 = coefficients
    return 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))


def rational8(plane: Plane, coefficients: Float[Array, " d"]) -> Plane:
    """Rational distortion k1, k2, p1, p2, k3, k4, k5, k6 (OpenCV's calib3d documentation, first eight terms)."""
    return _brown(plane, rational8_radial(plane @ plane, coefficients), coefficients)


def rational8_radial(r2: Scalar, coefficients: Float[Array, " d"]) -> Scalar:
    """Radial factor of `rational8` (of the first eight of any more coefficients) at a squared radius.

    (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6); beyond a pole the denominator is held at 1e-6.
    """
    k1, k2, _, _, k3, k4, k5, k6 = coefficients[:8]
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return above / at_least(1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)), 1e-6)


def thin_prism12(plane: Plane, coefficients: Float[Array, " d"]) -> Plane:
    """`rational8` and the thin prism s1..s4: dx = s1 r^2 + s2 r^4, dy = s3 r^2 + s4 r^4 (OpenCV, twelve terms)."""
    s1, s2, s3, s4 = coefficients[8:12]
    r2 = plane @ plane
    return rational8(plane, coefficients) + r2 * jnp.stack([s1 + s2 * r2, s3 + s4 * r2])


def tilted14(plane: Plane, coefficients: Float[Array, "14"]) -> Plane:
    """`thin_prism12`, then a sensor tilted by tau_x and tau_y, rad (OpenCV's calib3d documentation, all terms).

    The tilted plane is met through the same centre: homography [[R33, 0, -R13], [0, R33, -R23], [0, 0, 1]] R with
    R = Ry(tau_y) Rx(tau_x) as that documentation writes them.
    """
    x, y = thin_prism12(plane, coefficients)
    cx, sx = jnp.cos(coefficients[12]), jnp.sin(coefficients[12])
    cy, sy = jnp.cos(coefficients[13]), jnp.sin(coefficients[13])
    turned_x = cy * x + sy * sx * y - sy * cx
    turned_y = cx * y + sx
    depth = at_least(sy * x - cy * sx * y + cy * cx, 1e-6)
    r13, r23, r33 = -sy * cx, sx, cy * cx
    return jnp.stack([r33 * turned_x / depth - r13, r33 * turned_y / depth - r23])


def _brown(plane: Plane, radial: Scalar, coefficients: Float[Array, " d"]) -> Plane:
    """The plane scaled by a radial factor, with the decentring of p1, p2 (third and fourth coefficient) added."""
    p1, p2 = coefficients[2], coefficients[3]
    x, y = plane
    r2 = x * x + y * y
    return jnp.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    )
