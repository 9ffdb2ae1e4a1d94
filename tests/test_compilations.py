"""How many programs a diagnosis compiles: counted, not timed."""

from collections import Counter
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import pytest

from experiments._study import ScalarEffect
from jaxmarine import _compiled
from jaxmarine.diagnosis import diagnose
from jaxmarine.effects import CATALOGUE, AddedMass, HullLift, LinearDamping, QuadraticDamping, ThrusterGain
from jaxmarine.examples import hidden
from tests.boats import boat

# Of a diagnosis, single operations on arrays included; with more, its start would take seconds longer.
MOST = 300
FEW = (AddedMass, LinearDamping, QuadraticDamping, ThrusterGain)


class CubicDrag(ScalarEffect):
    """X = -coefficient u_r³."""

    name = "cubic_drag"
    units = {"coefficient": "N s³/m³"}
    coefficient: jax.Array

    def __call__(self, motion):
        return jnp.zeros(6).at[0].set(-self.coefficient * motion.nu_r[0] ** 3)


@pytest.fixture
def unoptimised() -> Iterator[None]:
    """Programs are counted, and need not be fast."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


def compiled(catalogue) -> Counter[str]:
    """Programs that a process' first diagnosis of a weak thruster compiles, or loads, by their names."""
    logs = hidden(boat(), "thruster_gain", "port", {"factor": 0.7}, (40.0, 30.0), catalogue=FEW)
    names: Counter[str] = Counter()

    def heard(event: str, seconds: float, **more) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            names[str(more["fun_name"])] += 1

    jax.clear_caches()
    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        found = diagnose(boat(), *logs, catalogue=catalogue)
    finally:
        jax.monitoring.unregister_event_duration_listener(heard)
    assert [finding.label for finding in found.findings] == ["thruster_gain:port"]
    return names


@pytest.mark.slow
@pytest.mark.parametrize(
    ("catalogue", "another"), [(FEW, HullLift), (CATALOGUE, CubicDrag)], ids=["few", "all"]
)
def test_an_effect_more_in_the_catalogue_compiles_nothing_more(unoptimised, catalogue, another):
    _compiled._options()  # asks the compiler once in a process
    names = compiled(catalogue)
    # Less, where the search comes to its end without some of the steps that it took before.
    assert compiled((*catalogue, another)) <= names
    assert names.total() <= MOST
