"""A function of jax as an expression of CasADi, operation by operation, so that no equation is written twice.

`jax.make_jaxpr` writes a function down as a list of operations. Those on numbers are done by jax; those on
symbols are done by the rules here, on arrays of objects whose entries are numbers or `casadi.SX`. Loops must
have a fixed number of turns, and are written out.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi
import jax
import numpy as np
from jax.extend import core

from .._errors import InputError

_ca: Any = casadi  # its names are bound when it is loaded, which type checkers do not see
Values = np.ndarray  # of numbers or, with dtype object, of numbers and symbols


def expressed(name: str, function: Callable[..., Any], sizes: Mapping[str, int], given: str) -> Any:
    """The `casadi.Function` of a function of vectors, by the sizes of its arguments (0: a scalar)."""
    symbols = {key: _ca.SX.sym(key, max(size, 1)) for key, size in sizes.items()}
    shapes = {key: (size,) if size else () for key, size in sizes.items()}
    closed = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(one, np.float64) for one in shapes.values()))
    arguments = []
    for key, symbol in symbols.items():
        entries = np.empty(symbol.numel(), object)
        entries[:] = [symbol[i] for i in range(symbol.numel())]
        arguments.append(entries.reshape(shapes[key]))
    (out,) = _evaluated(closed.jaxpr, closed.consts, arguments)
    return _ca.Function(name, [*symbols.values()], [_ca.vertcat(*np.ravel(out).tolist())], [*sizes], [given])


def _evaluated(jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any]) -> list[Values]:
    known: dict[Any, Values] = dict(
        zip((*jaxpr.constvars, *jaxpr.invars), (*map(np.asarray, consts), *arguments), strict=True)
    )

    def value(atom: Any) -> Values:
        return np.asarray(atom.val) if isinstance(atom, core.Literal) else known[atom]

    for equation in jaxpr.eqns:
        inputs = [value(atom) for atom in equation.invars]
        known |= dict(zip(equation.outvars, _done(equation, inputs), strict=True))
    return [value(atom) for atom in jaxpr.outvars]


def _symbolic(values: Sequence[Values]) -> bool:
    return any(np.asarray(one).dtype == object for one in values)


def _done(equation: Any, inputs: list[Values]) -> Sequence[Values]:
    """What one operation gives."""
    primitive, params = equation.primitive, equation.params
    name = primitive.name
    inner = params.get("jaxpr", params.get("call_jaxpr"))
    if name == "scan":
        return _scanned(params, inputs)
    if inner is not None and name not in ("while", "cond"):
        return _evaluated(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), inputs)
    if not _symbolic(inputs):
        out = primitive.bind(*inputs, **params)
        return [np.asarray(one) for one in (out if primitive.multiple_results else [out])]
    if name in _EACH:
        return [_EACH[name](*inputs)]
    if name in _MOVES:
        return _moved(primitive, params, inputs)
    if name in _RULES:
        return [_RULES[name](*inputs, params=params)]
    raise InputError(
        f"This vehicle cannot be written as CasADi expressions, as it needs the operation `{name}`; "
        "export it as `stablehlo`."
    )


def _scanned(params: dict[str, Any], inputs: list[Values]) -> list[Values]:
    """A loop, turn by turn."""
    first = params["num_consts"]
    second = first + params["num_carry"]
    consts, carry, rows = inputs[:first], inputs[first:second], inputs[second:]
    body, written = params["jaxpr"], []
    turns = range(params["length"])
    for turn in reversed(turns) if params["reverse"] else turns:
        out = _evaluated(
            body.jaxpr, body.consts, [*consts, *carry, *(np.asarray(one)[turn, ...] for one in rows)]
        )
        carry = out[: len(carry)]
        written.append(out[len(carry) :])
    if params["reverse"]:
        written.reverse()
    return [
        *carry,
        *(np.stack([np.asarray(one, object) for one in column]) for column in zip(*written, strict=True)),
    ]


def _moved(primitive: Any, params: dict[str, Any], inputs: list[Values]) -> list[Values]:
    """Operations that only move entries: done on their places, then the entries are fetched."""
    which = _MOVES[primitive.name]
    pool, places = [], []
    for i, entries in enumerate(inputs):
        if which is None or i in which:
            begin = sum(map(len, pool))
            pool.append(np.ravel(np.asarray(entries, object)))
            # Places as floats, since operations may know the type of their entries.
            places.append((begin + np.arange(pool[-1].size, dtype=float)).reshape(np.shape(entries)))
        else:
            places.append(entries)
    out = primitive.bind(*places, **params)
    every = np.concatenate(pool)
    return [
        # By a list of places, as a single one would fetch the entry without its array.
        every[np.ravel(one).astype(int)].reshape(np.shape(one))
        for one in (out if primitive.multiple_results else [out])
    ]


def _each(function: Callable[..., Any], inputs: int) -> Callable[..., Values]:
    """Entry by entry; always an array, a scalar's one of no axes."""
    entrywise = np.frompyfunc(function, inputs, 1)

    def call(*arrays: Values) -> Values:
        out = np.empty(np.broadcast_shapes(*map(np.shape, arrays)), object)
        out[...] = entrywise(*(np.asarray(one, object) for one in arrays))
        return out

    return call


def _reduced(join: Callable[..., Values], entries: Values, axes: Sequence[int], none: float) -> Values:
    """What `join` makes of the entries along some axes; `none` where there are none."""
    rest = [i for i in range(entries.ndim) if i not in axes]
    count = math.prod(entries.shape[i] for i in axes)
    flat = np.transpose(entries, [*rest, *axes]).reshape([*(entries.shape[i] for i in rest), count])
    columns = [flat[..., i] for i in range(count)]
    return functools.reduce(join, columns) if columns else np.full(flat.shape[:-1], none, object)


def _product(a: Values, b: Values, params: dict[str, Any]) -> Values:
    """`dot_general`: batch axes, then what is left of the first, then of the second."""
    (sum_a, sum_b), (batch_a, batch_b) = params["dimension_numbers"]
    left_a = [i for i in range(a.ndim) if i not in (*sum_a, *batch_a)]
    left_b = [i for i in range(b.ndim) if i not in (*sum_b, *batch_b)]
    count = math.prod(a.shape[i] for i in sum_a)
    batch = [a.shape[i] for i in batch_a]
    first = np.transpose(a, [*batch_a, *left_a, *sum_a])
    first = first.reshape([*batch, *(a.shape[i] for i in left_a), *(1 for _ in left_b), count])
    second = np.transpose(b, [*batch_b, *left_b, *sum_b])
    second = second.reshape([*batch, *(1 for _ in left_a), *(b.shape[i] for i in left_b), count])
    products = _each(_times, 2)(first, second)
    return _reduced(_ADD, products, (products.ndim - 1,), 0.0)


def _times(a: Any, b: Any) -> Any:
    # Zeros of numbers leave no trace, so that expressions stay as small as the matrices are sparse.
    if (isinstance(a, float | int) and a == 0) or (isinstance(b, float | int) and b == 0):
        return 0.0
    return a * b


def _selected(which: Values, no: Values, yes: Values) -> Values:
    """`select_n` of two cases, the only ones that conditions on numbers give."""
    return _each(lambda c, one, other: _ca.if_else(c, other, one), 3)(which, no, yes)


# Named in CasADi as in jax.
_OF_ONE = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "sign")
_OF_ONE += ("erf", "floor", "ceil", "log1p", "expm1")
_OF_TWO = ("lt", "le", "gt", "ge", "eq", "ne", "atan2")
_ADD = _each(lambda a, b: a + b, 2)
_EACH: dict[str, Callable[..., Values]] = {
    "add": _ADD,
    "add_any": _ADD,
    "sub": _each(lambda a, b: a - b, 2),
    "mul": _each(_times, 2),
    "div": _each(lambda a, b: a / b, 2),
    "neg": _each(lambda a: -a, 1),
    "max": _each(_ca.fmax, 2),
    "min": _each(_ca.fmin, 2),
    "pow": _each(_ca.power, 2),
    "square": _each(lambda a: a * a, 1),
    "rsqrt": _each(lambda a: 1.0 / _ca.sqrt(a), 1),
    "logistic": _each(lambda a: 1.0 / (1.0 + _ca.exp(-a)), 1),
    "abs": _each(_ca.fabs, 1),
    "select_n": _selected,
    "clamp": _each(lambda low, a, high: _ca.fmin(_ca.fmax(a, low), high), 3),
    "copy": lambda a: a,
    "stop_gradient": lambda a: a,
    "and": _each(_ca.logic_and, 2),
    "or": _each(_ca.logic_or, 2),
    "not": _each(_ca.logic_not, 1),
    **{one: _each(getattr(_ca, one), 2) for one in _OF_TWO},
    **{one: _each(getattr(_ca, one), 1) for one in _OF_ONE},
}
# Which of the operands move; the others say where to. None: all.
_MOVES: dict[str, tuple[int, ...] | None] = {
    "broadcast_in_dim": (0,),
    "reshape": (0,),
    "squeeze": (0,),
    "expand_dims": (0,),
    "transpose": (0,),
    "slice": (0,),
    "rev": (0,),
    "concatenate": None,
    "stack": None,
    "unstack": (0,),
    "split": (0,),
    "gather": (0,),
    "dynamic_slice": (0,),
    "pad": None,
    "scatter": (0, 2),
    "dynamic_update_slice": (0, 1),
}
_RULES: dict[str, Callable[..., Values]] = {
    "convert_element_type": lambda a, params: a,
    "integer_pow": lambda a, params: _each(lambda one: one ** params["y"], 1)(a),
    "reduce_sum": lambda a, params: _reduced(_ADD, a, params["axes"], 0.0),
    "reduce_prod": lambda a, params: _reduced(_EACH["mul"], a, params["axes"], 1.0),
    "reduce_max": lambda a, params: _reduced(_EACH["max"], a, params["axes"], -math.inf),
    "reduce_min": lambda a, params: _reduced(_EACH["min"], a, params["axes"], math.inf),
    "dot_general": _product,
}
