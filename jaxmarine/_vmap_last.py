"""`jax.vmap` with the mapped axis kept last, for many small calculations that are alike.

`jax.vmap` brings the mapped axis to the front: a thousand vectors of six become rows of six numbers, and a
processor's inner loops run over six. Kept last they run over the thousand. The function is traced once, for
one element, and its operations are done with one more axis behind; those without a rule here, such as loops,
are left to `jax.vmap`.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

from .physics import apply

# Entry by entry, with operands of one shape or without axes.
_ENTRYWISE = frozenset(
    """abs add and atan2 ceil clamp convert_element_type copy cos cosh div eq exp exp2 expm1 floor ge gt
    integer_pow is_finite le log log1p logistic lt max min mul ne neg not or pow rem round rsqrt select_n
    sign sin sinh sqrt square stop_gradient sub tan tanh""".split()  # noqa: SIM905
)
# Arrays, and whether they have the axis of elements behind.
Value: TypeAlias = tuple[Any, bool]


def vmap_last(function: Callable[..., Any], mapped: Sequence[bool]) -> Callable[..., Any]:
    """The function of many elements, which lie along the last axis of all arrays of the arguments `mapped`.

    As `jax.vmap(function, -1, -1)` but to rounding.
    """

    def many(*args):
        flat, structure = jax.tree.flatten(args)
        flags = [flag for arg, flag in zip(args, mapped, strict=True) for _ in jax.tree.leaves(arg)]
        given = list(zip(flat, flags, strict=True))
        size = next(jnp.shape(value)[-1] for value, flag in given if flag)
        one = [
            jax.ShapeDtypeStruct(jnp.shape(value)[:-1] if flag else jnp.shape(value), jnp.result_type(value))
            for value, flag in given
        ]
        traced, shapes = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(structure, one))
        out = [_behind(value, jnp.ndim(value[0]) - value[1], size) for value in _run(traced, given, size)]
        return jax.tree.unflatten(jax.tree.structure(shapes), out)

    return many


def _behind(value: Value, axes: int, size: int):
    """The array with so many axes, of length one where it has less, and the axis of elements behind."""
    array, flag = value
    array = array if flag else jnp.expand_dims(array, -1)
    array = jnp.reshape(array, (1,) * (axes + 1 - array.ndim) + array.shape)
    return jnp.broadcast_to(array, (*array.shape[:-1], size))


def _run(traced: ClosedJaxpr, given: Sequence[Value], size: int) -> list[Value]:
    """The results of a traced function."""
    jaxpr = traced.jaxpr
    shared = [(const, False) for const in traced.consts]
    values: dict[Any, Value] = dict(zip(jaxpr.constvars, shared, strict=True))
    values |= dict(zip(jaxpr.invars, given, strict=True))

    def read(atom) -> Value:
        return (atom.val, False) if isinstance(atom, Literal) else values[atom]

    for eqn in jaxpr.eqns:
        values |= dict(zip(eqn.outvars, _done(eqn, [read(atom) for atom in eqn.invars], size), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _done(eqn: JaxprEqn, given: list[Value], size: int) -> list[Value]:
    """The results of one operation."""
    name, params = eqn.primitive.name, eqn.params
    values, flags = [value for value, _ in given], [flag for _, flag in given]
    fixed = eqn.primitive.get_bind_params(params)

    def bound(*values, **changed):
        out = eqn.primitive.bind(*values, **(fixed | changed))
        return out if eqn.primitive.multiple_results else [out]

    if not any(flags):
        return [(value, False) for value in bound(*values)]
    if name == "jit" and not (flags == [False, True] and _is_apply(params["jaxpr"], *values)):
        return _run(params["jaxpr"], given, size)
    if name == "jit":
        out = [jnp.matmul(*values)]
    elif name in _ENTRYWISE:
        shape = jnp.broadcast_shapes(*(jnp.shape(v)[: jnp.ndim(v) - flag] for v, flag in given))
        out = bound(*(jnp.broadcast_to(_behind(v, len(shape), size), (*shape, size)) for v in given))
    elif name in _RULES:
        out = _RULES[name](bound, [_behind(v, jnp.ndim(v[0]) - v[1], size) for v in given], params)
    else:
        out = jax.vmap(bound, [-1 if flag else None for flag in flags], -1)(*values)
    return [(value, True) for value in out]


def _is_apply(traced: ClosedJaxpr, first, second) -> bool:
    """Whether this is `physics.apply` to one matrix and many vectors, and no derivative of it."""
    if jnp.ndim(first) != 2 or jnp.ndim(second) != 2:
        return False
    vector = jax.ShapeDtypeStruct(second.shape[:-1], second.dtype)
    # jax traces a function once for arguments of a kind.
    return traced is apply.trace(jax.ShapeDtypeStruct(first.shape, first.dtype), vector).jaxpr


def _sliced(bound, values, params):
    (array,), strides = values, params["strides"]
    return bound(
        array,
        start_indices=(*params["start_indices"], 0),
        limit_indices=(*params["limit_indices"], array.shape[-1]),
        strides=None if strides is None else (*strides, 1),
    )


def _broadcast(bound, values, params):
    shape, axes = params["shape"], params["broadcast_dimensions"]
    return [lax.broadcast_in_dim(values[0], (*shape, values[0].shape[-1]), (*axes, len(shape)))]


def _reshaped(bound, values, params):
    return [jnp.reshape(values[0], (*params["new_sizes"], values[0].shape[-1]))]


def _transposed(bound, values, params):
    axes = params["permutation"]
    return bound(*values, permutation=(*axes, len(axes)))


def _same(bound, values, params):
    """The axes that it names are counted from the first."""
    return bound(*values)


# Operations on the axes of arrays: how they are done with one more axis behind.
_RULES: dict[str, Callable[..., Sequence[Any]]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": _same,
    "reduce_sum": _same,
    "reshape": _reshaped,
    "slice": _sliced,
    "split": _same,
    "squeeze": _same,
    "stack": _same,
    "transpose": _transposed,
}
