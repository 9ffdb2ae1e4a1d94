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
from experiments._study import wilson
from jaxmarine._types import DOFS
from jaxmarine.networks import DampingNetworks, NetworkDamping, perceptron

from .conftest import ROOT
from .test_minesniper import anew


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


def test_networks_as_printed_learn_with_all_their_weights():
    """From a window of another network's forces: all of theirs move, and the vehicle's damping with them."""
    rng, one = np.random.default_rng(0), jnp.ones(6)
    before, true = (
        NetworkDamping(
            networks=DampingNetworks(
                jax.vmap(lambda key: perceptron(12, 5, 1, key))(jax.random.split(jax.random.key(seed), 6)),
                one,
                0 * one,
                50.0 * one,
                form="free",
            ),
            inputs=DOFS,
        )
        for seed in (0, 1)
    )
    nu, known = jnp.asarray(rng.uniform(-0.3, 0.3, (60, 6))), jnp.asarray(rng.uniform(-1.0, 1.0, (5, 6)))
    targets = jax.vmap(true.networks)(nu)
    after = study._retrained(before, nu, targets, known)

    def off(term):
        return float(jnp.abs(jax.vmap(term.networks)(nu) - targets).max())

    assert off(after) < 0.1 * off(before)
    pairs = zip(
        jax.tree.leaves(before.networks.networks), jax.tree.leaves(after.networks.networks), strict=True
    )
    assert all((a != b).all() for a, b in pairs)
    vehicle = eqx.tree_at(study.networks_of, with_damping(before), after)
    state = dataclasses.replace(jm.initial_state(vehicle), velocity=nu[0])
    asked = [jm.inverse_dynamics(v, state, jnp.zeros(6)) for v in (vehicle, with_damping(before))]
    shown = after.networks(nu[0]) - before.networks(nu[0])
    np.testing.assert_allclose(asked[0] - asked[1], shown, atol=1e-9)


PAGE = (ROOT / "experiments" / "README.md").read_text()
FOUND = json.loads((study.HERE / "results.json").read_text())
RUNS = {(run["case"], run["model"]): run for run in FOUND["runs"]}


def sizes(case: str, model: str, error: str) -> np.ndarray:
    """By seed the size of an error, whose axes go together."""
    return np.array([np.linalg.norm(value) for value in RUNS[case, model][error]])


def test_verdicts_follow_from_the_kept_errors():
    pairs = [
        (sizes(case, better, error), sizes(case, worse, error))
        for _, case, better, worse, error in study.CLAIMS
    ]
    for claim, own in zip(FOUND["claims"], anew(pairs), strict=True):
        assert claim["verdict"] == own.pop("verdict") and claim["dives"] == 20
        assert {name: claim[name] for name in own} == pytest.approx(own)


def middle(case: str, model: str, error: str = "late_velocity_rms") -> float:
    return float(np.median(sizes(case, model, error)))


def updates(*models: tuple[str, str]) -> tuple[int, int, int, int]:
    """Taken, offered, judged and regretted over all seeds."""
    taken, offered, judged, regretted = (sum(sum(RUNS[one][name]) for one in models) for name in study.COUNTS)
    return taken, offered, judged, regretted


def found_in_words() -> list[str]:
    """What the page says of the table, with the numbers of the kept runs."""
    printed, braking = f"{study.PLAIN}, learning", f"{study.BRAKING}, learning"
    words = list[str]()
    for model, stale in ((printed, study.PLAIN), (braking, study.BRAKING)):
        slow, fast = (1000 * middle("II", one) for one in (stale, model))
        far, near = (middle("II", one, "rms_m") for one in (stale, model))
        words.append(f"from {slow:.0f} to {fast:.1f} mm/s and the way off from {far:.1f} to {near:.1f} m")
        slow, fast = (1000 * middle("III", one) for one in (f"{stale}, stale", model))
        words.append(f"from {slow:.0f} to {fast:.0f} mm/s")
    late = {
        way: [sizes("III", f"{way}, {end}", "late_velocity_rms") for end in ("learning", "stale")]
        for way in (study.PLAIN, study.BRAKING)
    }
    learning, stale = late[study.PLAIN]
    assert (learning < stale).all()
    learning, stale = late[study.BRAKING]
    (seed,) = np.flatnonzero(learning > stale)
    words.append(
        f"in one dive it did not help (seed {seed}: {learning[seed]:.3f} m/s, stale {stale[seed]:.3f})"
    )
    halved = middle("I", study.MENDED, "rms_m") / middle("I", study.PLAIN, "rms_m")
    words.append(f"take the way off to {halved:.2f} of it without noise")
    kept = updates(*((case, printed) for case in ("II", "III")))
    words.append("{} of {} updates of networks as printed".format(*kept[:2]))
    words.append("{3} of {2} were farther".format(*kept))
    kept = updates(*((case, braking) for case in ("II", "III")), ("III", f"{braking}, with feedback"))
    words.append("{} of {} of those that brake".format(*kept[:2]))
    words.append("{3} of {2}".format(*kept))
    share = middle("III", f"{braking}, with feedback", "rms_m")
    share /= middle("III", f"{study.BRAKING}, stale, with feedback", "rms_m")
    words.append(f"learning takes it to {share:.2f} of what the stale model leaves")
    low, high = wilson(0, 20)
    assert low == 0.0 and not any(study.ran_away(run) for run in FOUND["runs"] if run["case"] != "I")
    words.append(
        f"None of twenty dives of any row of cases II and III ran away (0 to {100 * high:.0f} %, Wilson)"
    )
    return words


def test_the_page_says_what_was_found():
    assert study.table(FOUND) in PAGE
    lines = " ".join(PAGE.split())
    assert [words for words in found_in_words() if words not in lines] == []
    # With noise twenty dives do not tell what helps, and not whether those that brake are better online.
    assert {claim["claim"] for claim in FOUND["claims"] if claim["verdict"] != "holds"} == {
        "ours: with noise too (case II)",
        "ours: networks that brake are better, with noise (case II)",
        "ours: learning online, those that brake are better (case II)",
        "ours: learning online, those that brake are better (case III)",
    }


def test_claims_compare_the_same_seed():
    """Dives that differ tenfold, each a fifth better with the second model: of medians nothing would show."""
    claims = [claim for claim in study.CLAIMS if claim[3] == f"{study.PLAIN}, stale"]
    assert len(claims) == 2 and len({claim[2] for claim in claims}) == 1
    (case, better, worse) = claims[0][1:4]
    rows = [
        {"case": case, "model": model, "seed": seed, "rms_m": [size] * 3, "late_velocity_rms": size}
        for seed in range(20)
        for model, share in ((worse, 1.0), (better, 0.8))
        for size in [share * 10 ** (seed / 19)]
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "CLAIMS", claims)
        found = study.claims(study.gathered(rows))
    assert [(one["verdict"], one["wins"]) for one in found] == [("holds", 20)] * len(claims)
    assert found[1]["median"] == pytest.approx(np.sqrt(3) * found[0]["median"], rel=1e-3)


def test_what_is_no_number_has_run_away():
    run = {"case": "II", "model": "one", "rms_m": [[1.0, 2.0, 2.0], [np.nan] * 3]}
    run["late_velocity_rms"] = [2.0 * study.RUN_AWAY, np.nan]
    assert study.sizes(run["rms_m"]).tolist() == [3.0, np.inf] and study.ran_away(run) == 2
    assert "| inf | inf (2.0000 to inf) | 2 of 2 |" in study.table({"runs": [run], "claims": []})


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
    for way in study.PLAIN, study.BRAKING:
        assert rows["III", f"{way}, learning"]["offered"] > 0
