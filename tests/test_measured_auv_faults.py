"""The faults of a measured AUV: posteriors of simulated runs, the files, and the quick study."""

import dataclasses
import json
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import jaxmarine as jm
from experiments import measured_auv_faults as auv
from experiments.haizhe import heave
from experiments.haizhe import runs as haizhe

from .conftest import ROOT

# Sizes as fitted to the measured runs, rounded; the two damages are alike.
TRUTH = {
    "log thrust": -0.8,
    "log linear damping": 0.0,
    "log quadratic damping": 2.5,
    "net buoyancy": 0.19,
    "payload": 0.02,
    "gain, slight": 0.8,
    "gain, bad": 0.8,
    "depth bias": 0.1,
    "force at 0 s": 0.3,
}
LEVELS = np.array([1184.0, 1192.0, 1200.0])


@pytest.fixture(scope="module", autouse=True)
def _compiled_quickly() -> Iterator[None]:
    """As in a quick study, with which the programs are then shared."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="module")
def known() -> heave.Fitted:
    """A fit that knows the truth well: as of one session that said nearly everything."""
    theta = heave.MEAN.copy()
    for name, value in TRUTH.items():
        theta[heave.NAMES.index(name)] = value
    precision = np.diag((0.05 * heave.STD) ** -2.0)[None]
    weighted = np.linalg.solve(np.diag(heave.STD**2), theta - heave.MEAN)[None]
    scatter = np.log(list((heave.SCATTER | {"drift": 0.03}).values()))
    return heave.Fitted(jm.load_vehicle(auv.HERE / "haizhe.toml"), theta, scatter, precision, weighted)


def _drawn(known: heave.Fitted, count: int, seed: int) -> haizhe.Runs:
    """Runs of all states at levels that say nothing of the state."""
    rng = np.random.default_rng(seed)
    command = np.repeat(rng.choice(LEVELS, count)[:, None], haizhe.SAMPLES, axis=1)
    command[:, 0] = haizhe.IDLE
    blank = haizhe.Runs(
        state=np.arange(count) % 5,
        clock=np.zeros(count),
        command=command,
        depth=np.zeros((count, haizhe.BLOCKS + 1)),
        samples=np.full((count, haizhe.BLOCKS + 1), float(haizhe.BLOCK)),
        volts=rng.uniform(11.6, 12.2, count),
    )
    return heave.simulated(known, blank, rng)


@pytest.fixture(scope="module")
def runs(known) -> haizhe.Runs:
    return _drawn(known, 400, seed=1)


@pytest.fixture(scope="module")
def posterior(known, runs) -> np.ndarray:
    return heave.probabilities(heave.log_evidence(known, runs))


def test_simulated_runs_get_probabilities_as_often_right_as_they_say(runs, posterior):
    told = -np.log(posterior[np.arange(400), runs.state])
    surprise = told + (posterior * np.log(posterior + 1e-300)).sum(axis=1)
    # Three standard errors; answers twice as sure, or half, are far beyond.
    assert abs(surprise.mean()) < 3.0 * surprise.std() / 20.0
    for power in (2.0, 0.5):
        wrong = posterior**power / (posterior**power).sum(axis=1, keepdims=True)
        off = -np.log(wrong[np.arange(400), runs.state]) + (wrong * np.log(wrong + 1e-300)).sum(axis=1)
        assert abs(off.mean()) > 3.0 * off.std() / 20.0
    for k in range(5):
        # Of many runs each state gets the probability that there is of it.
        assert posterior[:, k].mean() == pytest.approx(0.2, abs=0.04)


def test_what_cannot_be_told_apart_stays_open_and_what_can_is_told(runs, posterior):
    damaged = posterior[:, 3:]
    np.testing.assert_allclose(damaged[:, 0], damaged[:, 1], rtol=0, atol=1e-9)
    assert damaged.max() <= 0.5
    biased = runs.state == haizhe.STATES.index("PressureGain_constant")
    assert (posterior[biased, 2] > auv.CONFIDENT).mean() > 0.8
    assert (posterior[~biased, 2] < 1.0 - auv.CONFIDENT).mean() > 0.9


def test_the_evidence_knows_no_usual_command(known, runs, posterior):
    """A run's answer depends on its own command and depth, not on who else ran at that command."""
    alone = heave.probabilities(heave.log_evidence(known, runs[runs.state == 1][:5]))
    np.testing.assert_allclose(alone, posterior[runs.state == 1][:5], atol=1e-9)
    # A guess from the level that was trained where states had levels of their own fails here.
    taught = dataclasses.replace(runs, command=runs.command.copy())
    taught.command[:, 1:] = np.array([1198.0, 1184.0, 1192.0, 1200.0, 1200.0])[runs.state][:, None]
    guess = auv.judged(heave.probabilities(auv.by_level(taught, runs)), runs.state, np.arange(400))
    model = auv.judged(posterior, runs.state, np.arange(400))
    assert guess["log_loss"][0] > np.log(5.0) > model["log_loss"][2]


def test_slopes_and_covariance_are_those_of_the_simulation(known, runs):
    """Of 400 runs drawn with the simulation, against the linear model."""
    some = runs[:5]
    many = some[np.repeat([1], 400)]
    drawn = heave.simulated(known, many, np.random.default_rng(3)).depth
    model = heave.linear(known.start, known.theta, some[1:2], some.state[1:2])
    mean, cov = known.posterior()
    slope = np.asarray(model.by_theta[0])
    trim = np.asarray(model.by_force[0].sum(axis=1))
    expected = np.asarray(heave.covariance(jnp.asarray(known.log_scatter), model)[0]) + slope @ cov @ slope.T
    expected += np.exp(2.0 * known.log_scatter[heave.SESSION]) * np.outer(trim, trim)
    np.testing.assert_allclose(mean, 0.0, atol=1e-9)
    # Drag with the square of the speed bends what is drawn; a tenth of the spread is left to that.
    spread = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(drawn.std(axis=0), spread, rtol=0.1)
    middle = some.depth[1] - np.asarray(model.residual[0])
    assert (np.abs(drawn.mean(axis=0) - middle) < 0.25 * spread).all()


def test_sessions_part_where_the_state_changes_or_time_passes():
    runs = haizhe.Runs(
        state=np.array([0, 0, 0, 1, 1]),
        clock=np.array([5000.0, 100.0, 500.0, 600.0, 7000.0]),
        **dict.fromkeys(("command", "depth", "samples", "volts"), np.zeros(5)),
    )
    np.testing.assert_array_equal(haizhe.sessions(runs), [1, 0, 0, 2, 3])


def test_files_are_cut_from_the_start_on_and_averaged(tmp_path):
    for k, label in enumerate(haizhe.STATES):
        count = 200
        table = pd.DataFrame({"run": label, "i": range(count), "time": 162703 + k})
        table["pwm1"] = np.where(np.arange(count) < 3, 1100, 1190 + k)
        table["depth"] = np.where(np.arange(count) < 3, 0.1, (np.arange(count) - 3.0) / 100)
        table["voltage"] = 11.9
        table.to_csv(tmp_path / f"train_{label}.csv.gz", index=False)
    runs = haizhe.read(tmp_path, "train")
    np.testing.assert_array_equal(runs.state, range(5))
    np.testing.assert_array_equal(runs.clock, 16 * 3600 + 27 * 60 + 3 + np.arange(5))
    np.testing.assert_array_equal(runs.level, 1190 + np.arange(5))
    np.testing.assert_array_equal(runs.command[:, 0], haizhe.IDLE)
    # Before the start 0.1; then means of 0 to 0.03, 0.04 to 0.07, ... From 0.78 m on the ground is near.
    np.testing.assert_allclose(runs.depth[2], [0.1, *(0.015 + 0.04 * np.arange(45))])
    np.testing.assert_array_equal(runs.samples[2], [3.0] + 20 * [4.0] + 25 * [0.0])


def test_what_may_lie_on_the_ground_is_not_evidence(known, runs):
    some = runs[:5]
    cut = dataclasses.replace(some, samples=some.samples * (np.arange(haizhe.BLOCKS + 1) < 20))
    wild = dataclasses.replace(cut, depth=np.where(cut.samples > 0, cut.depth, 0.82))
    one, other = (heave.probabilities(heave.log_evidence(known, these)) for these in (cut, wild))
    np.testing.assert_allclose(one, other, atol=2e-3)
    assert np.abs(one - heave.probabilities(heave.log_evidence(known, some))).max() > 0.01


def test_scores_are_those_worked_by_hand():
    p = np.array([[0.6, 0.1, 0.1, 0.1, 0.1], [0.02, 0.92, 0.02, 0.02, 0.02]])
    scores = auv.judged(p, np.array([0, 0]), np.array([0, 0]))
    assert scores["log_loss"][0] == pytest.approx(-0.5 * np.log(0.6 * 0.02))
    assert scores["brier"][0] == pytest.approx(0.5 * (0.16 + 4 * 0.01 + 0.98**2 + 0.92**2 + 3 * 0.02**2))
    assert (scores["confident"], scores["confident_right"], scores["inconclusive"]) == (1, 0, 0.5)
    assert scores["confusion"][0] == [1, 1, 0, 0, 0]
    # One session: nothing else can be drawn.
    assert scores["accuracy"] == [0.5, 0.5, 0.5]


def test_the_page_says_what_was_found():
    found = json.loads((auv.HERE / "results.json").read_text())
    page = (ROOT / "experiments" / "README.md").read_text()
    scores = found["scores"]
    assert scores[auv.MODEL]["runs"] == 75 and scores[auv.LEFT_OUT]["runs"] == 300
    assert auv.scores_table(scores) in page and auv.confusion_table(scores, auv.MODEL) in page
    told, state = np.array(found["test_probabilities"]), np.array(found["test_states"])
    weight, pressure = (told[state == k, k] for k in (1, 2))
    sure = [(own > auv.CONFIDENT).sum() for own in (pressure, weight)]
    lines = " ".join(page.split())
    assert f"of least log loss on training runs whose session was left out, {found['trust']:.2f}:" in lines
    assert "which 39 are at the shared levels" in lines
    assert scores["model, test at shared levels"]["runs"] == 39
    words = f"{weight.mean():.2f} on average where they are true, and {sure[0]} and {sure[1]} of their 15"
    assert f"{pressure.mean():.2f}" == f"{weight.mean():.2f}" and words in lines
    # Normal and damaged get 0.3 each, whichever is true, and none is told surely.
    alike = np.flatnonzero(auv.GROUPS == 0)
    means = [told[state == k][:, alike].mean(axis=0) for k in alike]
    np.testing.assert_allclose(means, 0.3, atol=0.05)
    among = scores["model, test, normal and damaged among themselves"]
    assert among["confident"] == 0 and among["log_loss"][0] == pytest.approx(np.log(3), abs=0.05)
    bad = "{:.2f} ± {:.2f} (bad)".format(*found["parameters"]["gain, bad"])
    assert f"The factor of {bad} is known from twelve sessions together" in lines
    assert found["sessions"]["PropellerDamage_bad"] == 12
    assert f"{found['scatter']['trim of a session']:.3f} N/kg, hides" in lines
    run, dealt, level = (
        scores[name]
        for name in (
            "model, simulated",
            "model, simulated, levels dealt out",
            "command level alone, simulated, levels dealt out",
        )
    )
    sure = [f"{one['confident_right']} of {one['confident']}" for one in (dealt, level)]
    losses = [one["log_loss"][0] for one in (dealt, run, level)]
    words = (
        "{:.2f} ({:.2f} with those as run; evidence in full; {} answers over 0.9 right), that of the level "
        "{:.2f} ({})"
    )
    assert words.format(*losses[:2], sure[0], losses[2], sure[1]) in lines
    blind = np.array(scores["model without the command, test"]["confusion"])[:, 1].sum()
    assert f"`weight` is the likeliest state of {blind} of the 75 runs" in lines
    normal = scores[auv.LEFT_OUT]["confusion"][0]
    assert f"{normal[1]} of {sum(normal)} normal ones are likeliest to be `weight`" in lines
    voltage = "the voltage to the power of {:.1f} ± {:.1f}".format(*found["parameters"]["voltage exponent"])
    assert f"{voltage}, and a push of {found['parameters']['force at 0 s'][0]:.0f} N/kg at the start" in lines


def test_the_measured_runs_are_those_that_the_page_tells_of(shared):
    data = shared / "data" / "haizhe-auv"
    if not data.is_dir():
        pytest.skip("the measured runs of ../shared/data/haizhe-auv are not on this machine")
    lines = " ".join((ROOT / "experiments" / "README.md").read_text().split())
    train, test = haizhe.read(data, "train"), haizhe.read(data, "test")
    assert "60 and 15 runs" in lines
    for runs, count in ((train, 60), (test, 15)):
        assert np.bincount(runs.state).tolist() == [count] * 5
    weight, others = (train.level[(train.state == 1) == own] for own in (True, False))
    assert (
        f"{weight.min():.0f} to {weight.max():.0f} µs with more weight, {others.min():.0f} and more" in lines
    )
    _, of_one = np.unique(haizhe.sessions(train)[train.state == 0], return_counts=True)
    assert f"{of_one.max()} of the normal runs are of one session" in lines


def test_without_the_data_it_says_so(tmp_path, capsys):
    auv.main(tmp_path / "out", tmp_path / "none")
    assert "Skipped: the measured runs are not at" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


def test_the_quick_study_is_better_than_chance_and_not_too_sure(shared, tmp_path):
    data = shared / "data" / "haizhe-auv"
    if not data.is_dir():
        pytest.skip("the measured runs of ../shared/data/haizhe-auv are not on this machine")
    auv.main(tmp_path, data, quick=True)

    results = json.loads((tmp_path / "results.json").read_text())
    scores = results["scores"]
    assert scores[auv.MODEL]["runs"] == 15
    assert scores[auv.MODEL]["log_loss"][0] < np.log(5.0)
    assert scores["chance"]["log_loss"][0] == pytest.approx(np.log(5.0))
    # The offset that was put in is about 0.1 m.
    value, std = results["parameters"]["depth bias"]
    assert abs(value - 0.1) < 0.03 and 0.002 < std < 0.02
    for name in ("heave", "confidence"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
