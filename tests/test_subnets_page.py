"""The page on learned subnets runs as written, and its networks find what is hidden."""

import contextlib
import io
import re
import types
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm

from .conftest import ROOT

PAGE = (ROOT / "docs" / "subnets.md").read_text()
NUMBER = r"-?\d+\.\d+"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def ran(folder: Path, patch: pytest.MonkeyPatch) -> dict:
    """What all blocks of the page leave, in their order, and what they printed."""
    out, printed = {"__name__": "subnets"}, io.StringIO()
    patch.chdir(folder)
    with contextlib.redirect_stdout(printed):
        for text in blocks("python"):
            exec(compile(text, "subnets.md", "exec"), out)
    return out | {"printed": printed.getvalue()}


@pytest.fixture(scope="module")
def names(tmp_path_factory) -> dict:
    """The page with fits that take no step: what the blocks are besides, for the time that there is."""

    def unmoved(vehicle, log, free, *, loss, prior, entries, throw=True):
        assert jax.tree.structure(free(vehicle)) == jax.tree.structure(prior)
        return types.SimpleNamespace(vehicle=vehicle, draw=lambda count, key: (vehicle,) * count)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jm, "fit", unmoved)
        return ran(tmp_path_factory.mktemp("subnets"), patch)


@pytest.mark.slow
def test_the_page_runs_as_written_and_finds_what_is_hidden(tmp_path, monkeypatch):
    names = ran(tmp_path, monkeypatch)
    (promised,) = blocks("text")
    assert re.sub(NUMBER, "#", names["printed"]) == re.sub(NUMBER, "#", promised)
    told = [[float(x) for x in re.findall(NUMBER, text)] for text in (names["printed"], promised)]
    np.testing.assert_allclose(told[0], told[1], rtol=0.02, atol=2e-3)

    fit = names["fit"]
    for u in np.linspace(-0.2, 0.2, 9):  # where the log went
        # A hundredth of a thruster.
        assert names["braking"](u) == pytest.approx(-8.0 * u * abs(u), abs=0.02)
    assert float(fit.vehicle.added_mass[0, 0]) == pytest.approx(
        2.0, abs=3 * fit["added_mass[surge]"].std_model
    )
    assert fit.converged and fit.reduced_chi2 < 1.1
    assert eqx.tree_equal(names["again"], fit.vehicle)

    # The saved ship sails nearer to the truth than the wrong file does.
    before = jm.simulate(names["heavy"], names["test"], jm.initial_state(names["heavy"]))
    truth = names["test"].channels[:, 6]  # u, with noise
    errors = [
        float(np.sqrt(np.mean((np.asarray(run["u"]) - truth) ** 2))) for run in (names["track"], before)
    ]
    assert errors[0] < 0.5 * errors[1]


def test_what_is_saved_comes_back(names):
    assert eqx.tree_equal(names["again"], names["start"])


def test_a_matrix_that_is_made_so_takes_power_everywhere(names):
    term = names["damped"].placed[0].effect
    motion = names["still"]
    assert float(jnp.abs(term(motion)).max()) == 0.0
    for nu in np.random.default_rng(0).normal(size=(50, 6)) * 3.0:
        wrench = term(eqx.tree_at(lambda m: m.nu_r, motion, jnp.asarray(nu)))
        assert float(wrench @ nu) <= 0.0
        assert jnp.array_equal(wrench[2:5], jnp.zeros(3))


def test_a_mass_that_is_made_so_is_symmetric_and_positive(names):
    laden, heavy = names["laden"], names["heavy"]
    more = np.asarray(laden.plant().load.added - heavy.plant().load.added)
    assert np.array_equal(more, more.T)
    assert np.linalg.eigvalsh(more[np.ix_([0, 1, 5], [0, 1, 5])]).min() > 0.0
    assert np.abs(more[2:5]).max() == 0.0
    # Kinetic energy grows with it, and forward dynamics has it: F = (M + dM) nu'.
    push = jnp.array([1.0, 0.5, 0, 0, 0, 0.1])
    drive = jm.vehicle.Input(jnp.zeros(3), jnp.zeros(3), push, jnp.zeros(()))
    state = jm.initial_state(heavy)
    slow, fast = (np.asarray(jm.forward_dynamics(v, state, drive)) for v in (laden, heavy))
    mass = np.asarray(heavy.mass_matrix)[np.ix_([0, 1, 5], [0, 1, 5])]
    np.testing.assert_allclose(mass @ fast[[0, 1, 5]], push[jnp.array([0, 1, 5])], atol=1e-12)
    total = mass + more[np.ix_([0, 1, 5], [0, 1, 5])]
    np.testing.assert_allclose(total @ slow[[0, 1, 5]], push[jnp.array([0, 1, 5])], atol=1e-12)


def test_a_straight_curve_is_more_thrust(names):
    craft, log = names["heavy"], names["test"]
    line = eqx.tree_at(lambda m: m.weight, eqx.nn.Linear(1, 1, key=jax.random.key(0)), jnp.full((1, 1), 0.2))
    curved = craft.place(jm.Placed(names["Curve"].on(craft, line)))
    stronger = eqx.tree_at(lambda v: v.thrusters.max_thrust, craft, 1.2 * craft.thrusters.max_thrust)
    start = jm.initial_state(craft)
    one, other = (jm.simulate(v, log, start) for v in (curved, stronger))
    np.testing.assert_allclose(one["u"], other["u"], atol=1e-9)
    np.testing.assert_allclose(one["psi"], other["psi"], atol=1e-9)
