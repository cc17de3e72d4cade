"""Small functions of small vectors, written out number by number: what a compiler of loops makes fast code of.

A camera model reads a point and a handful of parameters entry by entry. The derivative of reading an entry is a vector
of zeros and one number; summed over all entries, for every corner, that takes three times as long as the arithmetic.
"""

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import Array

# More numbers than this in any one array, and the program grows long without growing quick.
_MOST_NUMBERS = 24
_EACH_BY_ITSELF = frozenset(
    (
        "abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil",
        "clamp", "convert_element_type", "copy", "copy_p", "cos", "cosh", "div", "eq", "erf", "exp", "exp2",
        "expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt", "max",
        "min", "mul", "ne", "neg", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign", "sin", "sinh",
        "sqrt", "square", "stop_gradient", "sub", "tan", "tanh", "xor",
    )
)  # fmt: skip
_CALLS = frozenset(("jit", "pjit"))
# Arrays of numbers, each of them an array of jax without axes: numpy moves them about.
_Numbers = np.ndarray


def written_out(function: Callable[..., Array], sizes: Sequence[int]) -> Callable[..., list[Array]] | None:
    """`function` of float64 vectors of these sizes, as a function of lists of numbers: gives the list of its values.

    None for a function that does more than arithmetic with few numbers at a time: loops, tables, large arrays.
    """
    traced = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct((size,), jnp.float64) for size in sizes))
    if not _is_plain(traced.jaxpr):
        return None

    def by_numbers(*vectors: Sequence[Array]) -> list[Array]:
        (value,) = _run(traced, [_numbers_of(vector) for vector in vectors])
        return list(value.ravel())

    return by_numbers


def _is_plain(jaxpr: core.Jaxpr) -> bool:
    for variable in [*jaxpr.invars, *jaxpr.constvars, *(v for eqn in jaxpr.eqns for v in eqn.outvars)]:
        if math.prod(variable.aval.shape) > _MOST_NUMBERS:  # pyright: ignore[reportAttributeAccessIssue]
            return False
    return all(
        _is_plain(eqn.params["jaxpr"].jaxpr)
        if eqn.primitive.name in _CALLS
        else eqn.primitive.name in _EACH_BY_ITSELF or eqn.primitive.name in _MOVES
        for eqn in jaxpr.eqns
    ) and all(not _is_batched_dot(eqn) for eqn in jaxpr.eqns)


def _is_batched_dot(eqn: core.JaxprEqn) -> bool:
    return eqn.primitive.name == "dot_general" and eqn.params["dimension_numbers"][1] != ((), ())


def _run(traced: core.ClosedJaxpr, arguments: Sequence[_Numbers]) -> list[_Numbers]:
    """Values of a program's outputs, equation by equation."""
    jaxpr = traced.jaxpr
    known: dict[core.Var, _Numbers] = dict(zip(jaxpr.constvars, map(_numbers_of, traced.consts), strict=True))
    known.update(zip(jaxpr.invars, arguments, strict=True))

    def value(of: core.Var | core.Literal) -> _Numbers:
        return _as_numbers(of.val) if isinstance(of, core.Literal) else known[of]  # literals have no axes

    for eqn in jaxpr.eqns:
        name, operands = eqn.primitive.name, [value(of) for of in eqn.invars]
        if name in _CALLS:
            results = _run(eqn.params["jaxpr"], operands)
        elif name in _MOVES:
            results = [_as_numbers(_MOVES[name](operands, eqn.params))]
        else:
            spread = np.broadcast_arrays(*operands)
            result = np.empty(spread[0].shape, dtype=object)
            for index in np.ndindex(result.shape):
                result[index] = eqn.primitive.bind(*(operand[index] for operand in spread), **eqn.params)
            results = [result]
        known.update(zip(eqn.outvars, results, strict=True))
    return [value(of) for of in jaxpr.outvars]


def _numbers_of(values: Sequence[Array] | Array | np.ndarray) -> _Numbers:
    """A sequence of numbers, or an array of jax or numpy, entry by entry."""
    if not isinstance(values, Array | np.ndarray):
        numbers = np.empty(len(values), dtype=object)
        for place, number in enumerate(values):
            numbers[place] = number
        return numbers
    numbers = np.empty(values.shape, dtype=object)
    for index in np.ndindex(numbers.shape):
        numbers[index] = values[index]
    return numbers


def _as_numbers(value: object) -> _Numbers:
    """An array of numbers, also of one without axes, which numpy gives as the number itself."""
    if isinstance(value, np.ndarray):
        return value
    number = np.empty((), dtype=object)
    number[()] = value
    return number


def _slice(operands: Sequence[_Numbers], params: dict) -> _Numbers:
    strides = params["strides"] or (1,) * operands[0].ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return operands[0][tuple(slice(*bound) for bound in bounds)]


def _broadcast(operands: Sequence[_Numbers], params: dict) -> _Numbers:
    shape = [1] * len(params["shape"])
    for axis, length in zip(params["broadcast_dimensions"], operands[0].shape, strict=True):
        shape[axis] = length
    return np.broadcast_to(operands[0].reshape(shape), params["shape"])


def _dot(operands: Sequence[_Numbers], params: dict) -> _Numbers:
    return np.tensordot(*operands, axes=params["dimension_numbers"][0])


_MOVES: dict[str, Callable[[Sequence[_Numbers], dict], object]] = {
    "slice": _slice,
    "squeeze": lambda operands, params: np.squeeze(operands[0], axis=params["dimensions"]),
    "reshape": lambda operands, params: operands[0].reshape(params["new_sizes"]),
    "expand_dims": lambda operands, params: np.expand_dims(operands[0], params["dimensions"]),
    "transpose": lambda operands, params: operands[0].transpose(params["permutation"]),
    "concatenate": lambda operands, params: np.concatenate(operands, axis=params["dimension"]),
    "stack": lambda operands, params: np.stack(operands, axis=params["axis"]),
    "broadcast_in_dim": _broadcast,
    "reduce_sum": lambda operands, params: operands[0].sum(axis=params["axes"]),
    "dot_general": _dot,
}
