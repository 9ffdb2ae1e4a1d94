"""Cases I to III with the thesis' networks: which updates are kept, and a quick run."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import jaxmarine as jm
from experiments import tethra_networks as study
from jaxmarine._types import DOFS
from jaxmarine.networks import DampingNetworks, NetworkDamping, perceptron

from .conftest import ROOT


def braking(seed: int, size: float) -> NetworkDamping:
    """Random networks of the form that brakes, with forces of a size [N, N m]."""
    net, one = perceptron(12, 5, 36, jax.random.key(seed)), jnp.ones(6)
    networks = DampingNetworks(net, one, 0 * one, size * one, form="dissipative")
    return NetworkDamping(networks=networks, inputs=DOFS)


def log_of(vehicle: jm.Vehicle, seconds: float) -> jm.Log:
    """Motion that is made up, and the wrench that the vehicle needs for it."""
    t = np.arange(round(seconds / study.DT)) * study.DT
    phase = np.arange(6)
    channels = np.zeros((len(t), 18))
    channels[:, 6:12] = 0.3 * np.sin(0.5 * t[:, None] + phase)
    channels[:, 12:] = 0.15 * np.cos(0.5 * t[:, None] + phase)

    def wrench(nu, nu_dot):
        state = dataclasses.replace(jm.initial_state(vehicle), velocity=nu)
        return jm.inverse_dynamics(vehicle, state, nu_dot)

    asked = jax.vmap(wrench)(*(jnp.asarray(channels[:, part]) for part in (slice(6, 12), slice(12, 18))))
    return jm.Log(t, channels, None, np.asarray(asked), vehicle.thruster_names, "-")


def with_damping(term: NetworkDamping) -> jm.Vehicle:
    base = study.craft()
    nothing = jnp.zeros((6, 6))
    bare = dataclasses.replace(base, placed=base.placed[:-1], damping=jm.vehicle.Damping(nothing, nothing))
    return bare.place(jm.Placed(term))


def test_an_update_is_kept_only_where_it_explains_what_came_later(monkeypatch):
    true, other, far = (braking(seed, size) for seed, size in ((0, 50.0), (1, 50.0), (2, 500.0)))
    log = log_of(with_damping(true), study.WINDOW + study.JUDGED)
    asked = []

    def offer(term):
        def retrained(before, nu, targets, known):
            asked.append((before, len(nu), targets, jax.vmap(true.networks)(nu)))
            return term

        monkeypatch.setattr(study, "_retrained", retrained)

    model = with_damping(other)
    online = study.Online(np.zeros((3, 6)))
    offer(true)
    first = dataclasses.replace(
        log, **{name: getattr(log, name)[:50] for name in ("t", "channels", "wrench")}
    )
    assert online.update(model, first) is model and not asked  # the window is not full
    online.log = None
    after = online.update(model, log)
    assert eqx.tree_equal(study.networks_of(after), true) and (online.taken, online.offered) == (1, 1)
    # It learns from the window without its end, forces that are the damping's: slopes of a sine of 0.5 rad/s
    # by central differences err by (0.05)² / 6 of 0.15 m/s², times 230 kg; one-sided at the ends.
    before, count, targets, exact = asked[0]
    assert study.networks_of(model) is before and count == round(study.WINDOW / study.DT)
    np.testing.assert_allclose(targets[1:-1], exact[1:-1], atol=0.05)
    for worse in other, far:
        offer(worse)
        online.log = None
        kept = online.update(after, log)
        assert kept is after
    # What came after the update that was taken speaks for it, and is asked once.
    assert (online.taken, online.offered, online.judged, online.regretted) == (1, 3, 1, 0)
    online.replaced = true
    online.update(model, first)
    assert (online.judged, online.regretted) == (2, 1)
    online.replaced = true
    online.forget()
    online.update(model, first)
    assert online.judged == 2


def test_the_page_says_what_was_found():
    found = json.loads((study.HERE / "results.json").read_text())
    assert {one["seeds"] for one in found["summary"]} == {20}
    assert sum(one.get("ran_away", 0) for one in found["summary"]) == 0
    page = (ROOT / "experiments" / "README.md").read_text()
    assert study.table(found) in page
    online = [one for one in found["summary"] if one["model"].startswith(f"{study.BRAKING}, learning")]
    taken, offered, judged, regretted = (sum(one[name] for one in online) for name in study.COUNTS)
    assert 0 < regretted < judged <= taken < offered
    assert f"{taken} of {offered} updates" in page and f"{regretted} of {judged}" in page


def test_claims_compare_the_same_seed():
    """Dives that differ tenfold, each a fifth better with the second model: of medians nothing would show."""
    claims = [claim for claim in study.CLAIMS if claim[0].startswith("thesis") and claim[1] == "III"]
    assert len({claim[2:4] for claim in claims}) == 1
    (case, better, worse) = claims[0][1:4]
    rows = [
        {"case": case, "model": model, "seed": seed, "rms_m": [size] * 3, "late_velocity_rms": size}
        for seed in range(20)
        for model, share in ((worse, 1.0), (better, 0.8))
        for size in [share * 10 ** (seed / 19)]
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "CLAIMS", claims)
        found = study.claims(rows)
    assert [(one["verdict"], one["wins"]) for one in found] == [("holds", 20)] * len(claims)
    assert found[1]["median"] == pytest.approx(np.sqrt(3) * found[0]["median"])


@pytest.mark.slow  # trains six times
def test_a_quick_run_ends_with_every_case(tmp_path):
    app = typer.Typer()
    app.command()(study.main)
    ran = CliRunner().invoke(app, ["--out", str(tmp_path), "--quick"], catch_exceptions=False)
    assert ran.exit_code == 0
    (kept,) = (tmp_path / "parts").iterdir()
    found = json.loads(kept.read_text())
    rows = {(row["case"], row["model"]): row for row in found}
    ways = list(study.WAYS)
    assert {way for case, way in rows if case == "I"} == set(ways)
    # A minute of data: a symmetric mass with an intercept keeps the dive within some metres.
    assert np.isfinite(rows["I", ways[1]]["rms_m"]).all()
    assert rows["III", f"{study.BRAKING}, learning"]["offered"] > 0
