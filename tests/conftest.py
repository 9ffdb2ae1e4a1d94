"""What all tests share: double precision, strict shapes and fixed seeds."""

import _socket
import gc
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import hypothesis
import jax
import jaxtyping
import pytest
from xdist.scheduler import LoadScopeScheduling

import tests.typed

# Shapes and types are checked at every call into these rooms, in tests only and before anything is imported.
PACKAGE = Path(__file__).resolve().parent.parent / "jaxmarine"
CHECKED = [f"jaxmarine.{path.stem}" for path in sorted(PACKAGE.glob("[a-z]*"))]
jaxtyping.install_import_hook(CHECKED, f"{tests.typed.__name__}.checked")

# Dtype promotion stays "standard": optax multiplies integer step counts by floats.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

# Tracing leaves many small objects: searched for cycles by default, they take a twentieth of a run.
gc.set_threshold(20_000)


def pytest_collection_finish() -> None:
    """What all modules have made stays to the end, and is searched no more."""
    gc.collect()
    gc.freeze()
    # Holm's correction collects all garbage each time: some seconds, beside what JAX holds.
    if holm := sys.modules.get("statsmodels.stats.multitest"):
        holm.gc = SimpleNamespace(collect=lambda: 0)


# Derandomised, so that a run is repeatable; without deadline, because the first example compiles.
hypothesis.settings.register_profile("jaxmarine", derandomize=True, deadline=None)
hypothesis.settings.load_profile("jaxmarine")

ROOT = Path(__file__).resolve().parent.parent

# Modules that diagnose the same vehicles: in one process, which compiles their programs once.
DIAGNOSING = {
    f"test_{name}"
    for name in ("contradiction", "diagnosis", "every_effect", "gross", "hidden", "score", "unknown", "walk")
}


# Modules that take long: begun first, so that no process waits at the end for the other.
LONG = DIAGNOSING | {f"test_{name}" for name in ("watching", "minesniper", "fit", "simulation", "filter")}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.stem not in LONG)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log) -> LoadScopeScheduling:
    """Deals tests out by module, and those that diagnose the same vehicles to one process.

    By a scheduler of our own, as pytest 9.2 hides the groups of `--dist loadgroup` from pytest-xdist 3.8.
    """

    class ByModule(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            module = Path(nodeid.partition("::")[0]).stem
            return "diagnosing" if module in DIAGNOSING else module

    return ByModule(config, log)


@pytest.fixture(scope="module", autouse=True)
def _forgotten() -> Iterator[None]:
    """Compiled programs are let go after a module where there are many.

    Each holds some memory maps, of which Linux gives a process 65530: all tests in one process need more,
    and it would die without a message.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 20_000:
        jax.clear_caches()


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Types are not checked: what the package itself says of wrong ones is."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="session", autouse=True)
def _no_network() -> Iterator[None]:
    """Every test runs without a network, whole diagnoses included."""

    def refuse(*_arguments, **_keywords):
        raise AssertionError("the network was asked for")

    with pytest.MonkeyPatch.context() as patch:
        for name in ("getaddrinfo", "gethostbyname", "create_connection"):
            patch.setattr(socket, name, refuse)
        for name in ("connect", "connect_ex", "sendto", "bind"):
            patch.setattr(socket.socket, name, refuse)
        yield


_REAL = {name: getattr(socket, name) for name in ("getaddrinfo", "gethostbyname", "create_connection")}


@pytest.fixture
def loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    """For what is served on this machine: 127.0.0.1 may be asked for, and nothing else."""

    def only_here(function, host_of):
        def call(*arguments, **keywords):
            host = host_of(arguments)
            assert host == "127.0.0.1", f"{host} was asked for"
            return function(*arguments, **keywords)

        return call

    # It asks by the others.
    monkeypatch.setattr(socket, "create_connection", _REAL["create_connection"])
    for name in ("getaddrinfo", "gethostbyname"):
        monkeypatch.setattr(socket, name, only_here(_REAL[name], lambda arguments: arguments[0]))
    for name in ("connect", "connect_ex", "bind", "sendto"):
        method = only_here(getattr(_socket.socket, name), lambda arguments: arguments[-1][0])
        monkeypatch.setattr(socket.socket, name, method)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of recordings beside the repository, which not every machine has."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("the folder ../shared with recordings is not on this machine")
    return folder
