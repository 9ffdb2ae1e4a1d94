"""Programs that are kept between starts: the same numbers, none taken for another, all of them run."""

import os
import pickle
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from jaxmarine import _compiled, _kept
from jaxmarine._angles import wrap_to_pi

# Says a rotation, computed by a kept program, and how many programs of it were compiled or loaded by JAX.
START = """
import sys
import jax, jax.numpy as jnp
from jaxmarine import keep_programs
from jaxmarine._compiled import compiled
from jaxmarine.physics import rotation
jax.config.update("jax_enable_x64", True)
names = []
def heard(event, seconds, **more):
    if event == "/jax/core/compile/backend_compile_duration":
        names.append(more["fun_name"])
jax.monitoring.register_event_duration_secs_listener(heard)
keep_programs(sys.argv[1])
turned = compiled(rotation)(jnp.array([0.5, 0.5, -0.5, 0.5]))
print([round(float(x), 12) for x in turned.ravel()], sum("rotation" in name for name in names))
"""


def started(folder: Path) -> tuple[str, int]:
    """What a process of its own computes, and how many of its programs were compiled."""
    done = subprocess.run([sys.executable, "-c", START, folder], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    numbers, _, count = done.stdout.strip().rpartition(" ")
    return numbers, int(count)


@pytest.fixture(scope="module")
def begun(tmp_path_factory) -> tuple[Path, tuple[str, int]]:
    """The folder that a first start leaves, and what that start says."""
    folder = tmp_path_factory.mktemp("begun")
    return folder, started(folder)


@pytest.fixture
def left(begun, tmp_path) -> Iterator[Path]:
    """That folder, which is put back afterwards: JAX's own cache knows programs by it too."""
    before = shutil.copytree(begun[0], tmp_path / "before")
    yield begun[0]
    shutil.rmtree(begun[0])
    shutil.copytree(before, begun[0])


def test_a_later_start_compiles_nothing_and_computes_the_same(begun, left):
    (first, compiled_first), (again, compiled_again) = begun[1], started(left)
    # The rotation by 120 degrees about (1, -1, 1): a permutation of the axes with signs, in closed form.
    assert first == again == str([0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0])
    assert (compiled_first, compiled_again) == (1, 0)


def test_programs_run_that_the_own_cache_of_jax_knew_before(begun, left):
    # Its programs lose their kernels where they are kept a second time.
    for file in (left / "programs").iterdir():
        file.unlink()
    assert started(left) == begun[1]
    assert started(left) == (begun[1][0], 0)


def test_what_is_damaged_is_made_anew(begun, left):
    (file,) = (left / "programs").iterdir()
    file.write_bytes(file.read_bytes()[:100])
    assert started(left) == begun[1]
    assert started(left) == (begun[1][0], 0)


class Bomb:
    """What runs code when it is unpickled."""

    def __reduce__(self):
        return (exec, ("import sys; sys.unpickled = True",))


@pytest.fixture
def kept(tmp_path) -> _kept.Kept:
    return _kept.Kept(tmp_path / "programs")


def test_other_shapes_types_options_and_sources_are_other_programs(kept, monkeypatch):
    def asked(given, options=None) -> int:
        kept(wrap_to_pi, options, ((given,), {}))
        return len(list(kept.folder.iterdir()))

    one = jnp.array([1.0, 0.0, 0.0, 0.0])
    assert [asked(one), asked(one), asked(jnp.stack([one, one]).T)] == [1, 1, 2]
    assert asked(one.astype(jnp.float32)) == 3
    with jax.enable_x64(False):
        assert asked(one.astype(jnp.float32)) == 4
    kept.forget()
    assert asked(one, {"xla_cpu_use_fusion_emitters": False}) == 5
    monkeypatch.setattr(_kept, "_machine", lambda: "other sources")
    kept.forget()
    assert asked(one) == 6


def test_a_function_of_somebody_else_runs_and_is_not_kept(kept):
    def twice(x):
        return 2 * x

    given = jnp.arange(3.0)
    assert kept(twice, None, ((given,), {})).tolist() == [0.0, 2.0, 4.0]
    # One of the package is, but for one that is given such a function: its name may be another's next time.
    assert kept(wrap_to_pi, None, ((given,), {})).tolist() == given.tolist()
    assert len(list(kept.folder.iterdir())) == 1
    assert kept(jax.tree.map, None, ((twice, given), {})).tolist() == [0.0, 2.0, 4.0]
    assert len(list(kept.folder.iterdir())) == 1


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
@pytest.mark.parametrize("whose", ["file", "folder"])
def test_what_others_can_write_is_not_run(tmp_path, whose):
    folder = tmp_path / "programs"
    one = jnp.array([1.0, 0.0, 0.0, 0.0])
    _kept.Kept(folder)(wrap_to_pi, None, ((one,), {}))
    (file,) = folder.iterdir()
    file.write_bytes(pickle.dumps(Bomb()))
    (file if whose == "file" else folder).chmod(0o777)
    turned = _kept.Kept(folder)(wrap_to_pi, None, ((one,), {}))
    assert turned.tolist() == [1.0, 0.0, 0.0, 0.0] and not hasattr(sys, "unpickled")


def test_a_new_folder_is_the_users_alone(kept):
    kept(wrap_to_pi, None, ((jnp.array([1.0, 0.0, 0.0, 0.0]),), {}))
    assert stat.S_IMODE(kept.folder.stat().st_mode) == 0o700


def test_what_only_borrows_a_name_is_not_kept(kept):
    # A derivative has the module and the name of its function.
    given = jnp.array([0.3, 4.0])
    kept(wrap_to_pi, None, ((given,), {}))
    turned = kept(jax.jacfwd(wrap_to_pi), None, ((given,), {}))
    assert turned.tolist() == jnp.eye(2).tolist() and len(list(kept.folder.iterdir())) == 1


def test_kept_programs_are_loaded_whatever_the_mask_of_new_files(tmp_path, monkeypatch):
    before = os.umask(0o002)
    try:
        one, folder = jnp.array([1.0, 0.0, 0.0, 0.0]), tmp_path / "programs"
        _kept.Kept(folder)(wrap_to_pi, None, ((one,), {}))
        monkeypatch.setattr(_kept, "_made", None)
        assert _kept.Kept(folder)(wrap_to_pi, None, ((one,), {})).tolist() == [1.0, 0.0, 0.0, 0.0]
    finally:
        os.umask(before)


def test_threads_wait_for_one_program(kept, monkeypatch):
    made, true = [], _kept._made
    monkeypatch.setattr(_kept, "_made", lambda *given: made.append(given) or true(*given))
    one = jnp.array([1.0, 0.0, 0.0, 0.0])
    with ThreadPoolExecutor(4) as pool:
        out = list(pool.map(lambda _: kept(wrap_to_pi, None, ((one,), {})).tolist(), range(4)))
    assert len(made) == 1 and out == [[1.0, 0.0, 0.0, 0.0]] * 4


def test_operations_can_be_watched_one_by_one(tmp_path, monkeypatch):
    monkeypatch.setattr(_compiled, "_kept", [])
    _compiled.keep_in(tmp_path)
    turned = _compiled.compiled(wrap_to_pi)
    with jax.disable_jit():
        assert turned(jnp.array([1.0, 0.0, 0.0, 0.0])).tolist() == [1.0, 0.0, 0.0, 0.0]
    # As a part of another program it is that one's.
    jax.jit(turned)(jnp.array([1.0, 0.0, 0.0, 0.0]))
    assert not _compiled._kept[0]._loaded


def test_without_a_folder_to_write_into_programs_run(tmp_path):
    (tmp_path / "file").write_text("in the way")
    kept = _kept.Kept(tmp_path / "file" / "programs")
    assert kept(wrap_to_pi, None, ((jnp.array([1.0, 0.0, 0.0, 0.0]),), {})).tolist() == [1.0, 0.0, 0.0, 0.0]


def test_programs_are_let_go(tmp_path, monkeypatch):
    monkeypatch.setattr(_compiled, "_kept", [])
    _compiled.keep_in(tmp_path)
    _compiled.compiled(wrap_to_pi)(jnp.array([1.0, 0.0, 0.0, 0.0]))
    assert _compiled._kept[0]._loaded
    _compiled.let_go()
    assert not _compiled._kept[0]._loaded
