"""Compiled programs, by what suits ours best on a processor.

XLA hands groups of operations around a product to a library. Our products are many and small, and a
linearisation then takes half as long again (measured: 0.82 s against 0.55 s for nine of a log of 300 s,
jaxlib 0.10.0 on x86); single products are left to the library. And the newer of its two ways to write groups
of operations takes longer to compile (39 s against 26 s for all programs of a diagnosis), for programs that
run as fast.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

from ._kept import Kept

_OPTIONS = {
    "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT",
    "xla_cpu_use_fusion_emitters": False,
}

Function = TypeVar("Function", bound=Callable[..., Any])


@functools.cache
def _options() -> dict[str, str | bool] | None:
    """The options, None where this compiler does not know them."""
    try:
        jax.jit(lambda x: x, compiler_options=_OPTIONS)(0.0)
    except (RuntimeError, ValueError):
        return None
    return _OPTIONS


_kept: list[Kept] = []


def keep_in(folder: Path) -> None:
    """Keeps the programs of this process in a folder, and takes those that are kept there."""
    _kept[:] = [Kept(folder)]


def _watched() -> bool:
    """Whether JAX runs operations one by one, or looks for numbers that are none: kept programs cannot."""
    config: Any = jax.config
    return config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs


def let_go() -> None:
    """Lets all compiled programs go that this process has loaded."""
    jax.clear_caches()
    for one in _kept:
        one.forget()


def compiled(function: Function) -> Function:
    """`equinox.filter_jit` with these options, and as it is where it is part of another program."""
    jit: Any = eqx.filter_jit
    plain = jit(function)
    tuned = functools.cache(lambda: jit(function, compiler_options=_options()))

    @functools.wraps(function)
    def call(*args, **kwargs):
        inside = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs)))
        if inside:
            return plain(*args, **kwargs)
        if _kept and not _watched():
            return _kept[0](function, _options(), (args, kwargs))
        return tuned()(*args, **kwargs)

    return call  # pyrefly: ignore[bad-return]
