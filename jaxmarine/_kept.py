"""Compiled programs kept between starts, so that a later one neither traces nor lowers them.

JAX keeps what its compiler made, but asks for it by the operations of a program, and to find those takes
longer than to load it: of a second start that diagnoses a log of 300 s on six axes, 20 s of 24 s (CPU). Here
a program is asked for by what determines its operations: the sources, the function, and all that is no array
among its arguments. What cannot be told apart so, such as an effect of one's own, is not kept.
"""

import contextlib
import functools
import hashlib
import io
import os
import pickle
import platform
import stat
import threading
import types
import uuid
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from ._files import written_whole
from ._program import program

# Whose classes and functions are the same wherever their versions are.
_LIBRARIES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax")
_KNOWN = ("builtins", "collections", "functools", *_LIBRARIES, __name__.partition(".")[0])


class _Array(NamedTuple):
    """Stands for an array."""

    shape: tuple[int, ...]
    dtype: str
    weak: bool


class _Unknown(Exception):
    """Something that another start may know by the same name, and that is not the same."""


def _need_known(thing: Any) -> None:
    """Raises `_Unknown` of a class or function whose sources are not told by what a program is asked for."""
    home = getattr(thing, "__module__", None) or type(thing).__module__
    if home.partition(".")[0] not in _KNOWN:
        raise _Unknown(home)


def _need_named(function: Any) -> None:
    """Raises `_Unknown` of what its module and name do not tell: JAX's transformations keep a function's."""
    _need_known(function)
    whole = isinstance(function, types.FunctionType) and not hasattr(function, "__wrapped__")
    if not whole or "<" in function.__qualname__:
        raise _Unknown(repr(function))


class _Words(pickle.Pickler):
    """Pickles what names fix; the same things give the same bytes, whichever are one object."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self.fast = True

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type) or callable(obj):
            _need_known(obj)
        return NotImplemented


def _pickled(value: Any) -> bytes:
    file = io.BytesIO()
    _Words(file).dump(value)
    return file.getvalue()


@functools.cache
def _machine() -> str:
    """What programs are for, besides their sources: libraries, options of the compiler, processor."""
    flags = Path("/proc/cpuinfo")
    features = (
        [line for line in flags.read_text().splitlines() if line.lower().startswith(("flags", "features"))]
        if flags.exists()
        else []
    )
    versions = [f"{name} {version(name)}" for name in _LIBRARIES]
    options, device = os.environ.get("XLA_FLAGS", ""), jax.devices()[0]
    processor = platform.machine(), platform.processor(), features[:1]
    return repr((versions, options, device.platform, device.device_kind, processor))


def _of_own(path: Path) -> bytes:
    """A file's content; raises `PermissionError` where somebody else could have written it.

    What is kept is run as it is, as what JAX's own cache holds is.
    """
    for place in (path, path.parent) if hasattr(os, "getuid") else ():
        status = place.stat()
        if status.st_uid != os.getuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise PermissionError(f"{place} may be written by others.")
    return path.read_bytes()


class _Program(NamedTuple):
    """A compiled program from arrays to arrays, and what it gives, with an `_Array` for each array."""

    run: Callable[..., list[jax.Array]]
    gives: Any

    def __call__(self, arrays: list[Any]) -> Any:
        leaves, tree = jax.tree.flatten(self.gives, is_leaf=_stands)
        out = iter(self.run(*arrays))
        return jax.tree.unflatten(tree, [next(out) if _stands(leaf) else leaf for leaf in leaves])


def _stands(leaf: Any) -> bool:
    return isinstance(leaf, _Array)


def _described(leaf: Any) -> Any:
    if not eqx.is_array(leaf):
        return leaf
    return _Array(leaf.shape, str(leaf.dtype), bool(getattr(leaf, "weak_type", False)))


class Kept:
    """Compiled programs in a folder, and those that this process has loaded."""

    def __init__(self, folder: Path):
        self.folder = folder
        # Of the sources that run now: they may be edited later.
        self._program = program()
        self._loaded: dict[Any, _Program] = {}
        self._locks: dict[Any, threading.RLock] = {}

    def forget(self) -> None:
        """Lets loaded programs go."""
        self._loaded.clear()
        self._locks.clear()

    def __call__(self, function: Callable[..., Any], options: Any, given: tuple[Any, Any]) -> Any:
        """What a function gives for (args, kwargs); compiled at the first time, with some options."""
        leaves, tree = jax.tree.flatten(given)
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        # What a number becomes without a type, beside what is asked for.
        asked = (function, np.dtype(jnp.result_type(float)).str, tree, tuple(map(_described, leaves)))
        ready = self._loaded.get(asked)
        if ready is None:
            # Threads that ask for the same one wait for the first.
            with self._locks.setdefault(asked, threading.RLock()):
                ready = self._loaded.get(asked)
                if ready is None:
                    ready = self._of(*asked[:2], options, jax.tree.map(_described, given))
                    self._loaded[asked] = ready
        return ready(arrays)

    def _of(self, function: Callable[..., Any], default: str, options: Any, described: Any) -> _Program:
        name = getattr(function, "__name__", "program")
        try:
            _need_named(function)
            words = _pickled(
                (
                    f"{function.__module__}.{function.__qualname__}",
                    default,
                    self._program,
                    _machine(),
                    options,
                    described,
                )
            )
        except Exception:
            # Whatever cannot be told by words.
            return _Program(*_made(function, options, described, name))
        path = self.folder / f"{hashlib.sha256(words).hexdigest()}.program"
        # Whatever is wrong with what was kept, it can be made anew; and where nothing can be kept, used.
        with contextlib.suppress(Exception):
            run, gives = pickle.loads(_of_own(path))
            return _Program(_loaded(*run), gives)
        # By a name that none had before: what JAX's own cache has loaded cannot be kept again, as its kernels
        # are left out (jaxlib 0.10).
        run, gives = _made(function, options, described, f"{name}_{uuid.uuid4().hex}")
        with contextlib.suppress(Exception):
            payload, takes, returns = serialize(run)
            whole = _pickled(((payload, takes.num_leaves, returns.num_leaves), gives))
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with written_whole(path) as part:
                part.write_bytes(whole)
                part.chmod(0o600)
        return _Program(run, gives)


def _made(function: Callable[..., Any], options: Any, described: Any, name: str) -> tuple[Any, Any]:
    """A compiled program from arrays to arrays, and what it gives, with an `_Array` for each array."""
    leaves, tree = jax.tree.flatten(described, is_leaf=_stands)
    given = []

    def of_arrays(*arrays: jax.Array) -> list[jax.Array]:
        more = iter(arrays)
        args, kwargs = jax.tree.unflatten(tree, [next(more) if _stands(leaf) else leaf for leaf in leaves])
        found = function(*args, **kwargs)
        given.append(jax.tree.map(_described, found))
        return [leaf for leaf in jax.tree.leaves(found) if eqx.is_array(leaf)]

    of_arrays.__name__ = name
    asked = [jax.ShapeDtypeStruct(one.shape, one.dtype, weak_type=one.weak) for one in leaves if _stands(one)]
    return jax.jit(of_arrays, compiler_options=options).lower(*asked).compile(), given[0]


def _loaded(payload: bytes, takes: int, returns: int) -> Any:
    trees = jax.tree.structure(((0,) * takes, {})), jax.tree.structure([0] * returns)
    return deserialize_and_load(payload, *trees, execution_devices=jax.devices()[:1])
