"""Functions written out number by number: the same values and derivatives, and a clear no where they do more."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.estimation.scalars import written_out

TABLE = np.array([[0.5, -1.0, 2.0], [1.5, 0.25, -0.75]])


def moves(a: jax.Array, b: jax.Array) -> jax.Array:
    """Slices, with and without strides, turned, stacked, repeated and joined."""
    grid = jnp.stack([a, 2.0 * a, b[:3]]).T
    return jnp.concatenate([grid[1], b[::2], jnp.broadcast_to(a[:1], (2,)), grid.reshape(-1)[4:6][:, None][:, 0]])


def arithmetic(a: jax.Array, b: jax.Array) -> jax.Array:
    """Products, sums, comparisons, constants, and a function of its own."""
    length = jnp.sqrt(a @ a + 1e-12)
    bent = jnp.where(b > 0.0, jnp.sin(b), b**3) * jnp.maximum(length, 0.3)
    return jnp.append(jnp.asarray(TABLE) @ a, jnp.sum(jax.jit(jnp.arctan2)(bent, length)))


@pytest.mark.parametrize("function", [moves, arithmetic])
@settings(max_examples=25, deadline=None)
@given(numbers=st.lists(st.floats(-3.0, 3.0), min_size=7, max_size=7))
def test_values_and_derivatives_are_those_of_the_function(
    function: Callable[[jax.Array, jax.Array], jax.Array], numbers: list[float]
) -> None:
    ours, theirs = both_ways(function, jnp.asarray(numbers[:3]), jnp.asarray(numbers[3:]))
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


@functools.partial(jax.jit, static_argnums=0)
def both_ways(function: Callable[[jax.Array, jax.Array], jax.Array], a: jax.Array, b: jax.Array) -> tuple:
    """Values and derivatives by a and b: of the function written out, and of the function."""
    by_numbers = written_out(function, (3, 4))
    assert by_numbers is not None

    def joined(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.stack(by_numbers(list(a), list(b)))

    return tuple((f(a, b), *jax.jacrev(f, argnums=(0, 1))(a, b)) for f in (joined, function))


def test_no_derivative_of_reading_an_entry_is_left() -> None:
    """What it is for: reverse-mode derivatives without vectors of zeros about each number."""
    by_numbers = written_out(arithmetic, (3, 4))
    assert by_numbers is not None

    def pulled(*numbers: jax.Array) -> tuple:
        value, pull = jax.vjp(lambda *of: by_numbers(of[:3], of[3:])[2], *numbers)
        return value, pull(jnp.ones_like(value))

    names = str(jax.make_jaxpr(pulled)(*np.linspace(0.5, 2.0, 7)))
    assert "pad" not in names
    assert "pad" in str(jax.make_jaxpr(jax.grad(lambda a, b: arithmetic(a, b)[2]))(jnp.ones(3), jnp.ones(4)))


@pytest.mark.parametrize(
    "function",
    [
        lambda a: a[jnp.argmax(a)] * a,  # a place that depends on the values
        lambda a: jax.lax.fori_loop(0, 3, lambda _, x: jnp.cos(x), a),
        lambda a: jax.jit(lambda x: jnp.sort(x))(a),
        lambda a: jnp.outer(jnp.tile(a, 3), a).ravel()[:2],  # 27 numbers
        lambda a: jnp.einsum("ij,ij->i", jnp.stack([a, a]), jnp.stack([a, 2.0 * a])),
    ],
)
def test_what_is_more_than_arithmetic_with_few_numbers_is_left_as_it_is(
    function: Callable[[jax.Array], jax.Array],
) -> None:
    assert written_out(function, (3,)) is None
