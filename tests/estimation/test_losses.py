"""Robust losses: the weight is the loss's slope, small residuals are left alone, large ones are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import CalibrationError
from jaxcal.estimation import LOSSES, barron, robust_loss

squares = st.floats(1e-6, 1e6)
widths = st.floats(0.1, 30.0)


@pytest.mark.parametrize("kind", LOSSES)
@settings(deadline=None, max_examples=50)
@given(squared=squares, width=widths)
def test_the_weight_is_the_slope_of_the_loss(kind: str, squared: float, width: float) -> None:
    slope = jax.grad(lambda s: robust_loss(kind, s, width)[0])(jnp.asarray(squared))
    assert float(robust_loss(kind, jnp.asarray(squared), width)[1]) == pytest.approx(float(slope), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("kind", LOSSES)
@settings(deadline=None, max_examples=50)
@given(squared=squares, width=widths)
def test_no_loss_exceeds_the_square_and_none_falls(kind: str, squared: float, width: float) -> None:
    low, high = (float(robust_loss(kind, jnp.asarray(s), width)[0]) for s in (squared, 1.1 * squared))
    assert 0.0 < low <= squared * (1 + 1e-12)
    assert high >= low


@pytest.mark.parametrize("kind", LOSSES)
def test_small_residuals_and_infinite_widths_mean_least_squares(kind: str) -> None:
    squared = jnp.asarray([0.0, 1e-8, 1.0, 1e4])
    rho, weight = robust_loss(kind, squared[:2], 1.0)
    np.testing.assert_allclose(rho, squared[:2], rtol=1e-6, atol=1e-16)
    np.testing.assert_allclose(weight, 1.0, rtol=1e-6)
    rho, weight = robust_loss(kind, squared, jnp.asarray(jnp.inf))
    np.testing.assert_array_equal(rho, squared)
    np.testing.assert_array_equal(weight, 1.0)


@settings(deadline=None, max_examples=50)
@given(squared=squares, width=widths)
def test_barrons_family_holds_the_others(squared: float, width: float) -> None:
    s = jnp.asarray(squared)
    np.testing.assert_allclose(barron(s, width, 2.0)[0], s)
    # In Barron's parametrisation the scale of Cauchy's loss is sqrt(2), that of Geman-McClure's 2 times ours.
    np.testing.assert_allclose(barron(s, width / np.sqrt(2), 0.0)[0], robust_loss("cauchy", s, width)[0], rtol=1e-9)
    np.testing.assert_allclose(barron(s, width / 2, -2.0)[0], robust_loss("geman-mcclure", s, width)[0], rtol=1e-7)
    lower, between, upper = (float(barron(s, width, shape)[1]) for shape in (-2.0, -1.0, 0.0))
    assert lower <= between * (1.0 + 1e-14)
    assert between <= upper * (1.0 + 1e-14)


def test_an_unknown_loss_is_named() -> None:
    with pytest.raises(CalibrationError, match=r"'hubert' is unknown; known: huber"):
        robust_loss("hubert", jnp.asarray(1.0), 1.0)
