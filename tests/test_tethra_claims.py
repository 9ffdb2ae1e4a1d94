"""What the thesis says beside its tables: noise that lasts, idle sticks, what the study found."""

import json

import jax
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import jaxmarine as jm
from experiments import tethra_claims as study
from experiments._study import short
from experiments.thesis import baselines, plant
from jaxmarine.networks import perceptron

from .conftest import ROOT


def quiet_log(samples: int) -> jm.Log:
    """A log whose velocities and accelerations are known, of no craft."""
    channels = np.zeros((samples, 18))
    channels[:, 6:] = 0.1
    return jm.Log(0.1 * np.arange(samples), channels, np.zeros((samples, 4)), None, tuple("abcd"), "-")


def test_lasting_noise_is_as_large_as_white_noise_and_has_a_mean_and_a_memory():
    clean = quiet_log(40_000)
    off = {
        kind: plant.noisy(clean, kind, 3).channels[:, 6:12] - clean.channels[:, 6:12]
        for kind in ("white", "coloured")
    }
    size = np.array([0.01] * 6)  # 1 cm/s and 0.01 rad/s
    # 4000 s are 400 memories of 10 s, whose mean square is right within some 7 %.
    for found in off.values():
        np.testing.assert_allclose(np.sqrt((found**2).mean(axis=0)), size, rtol=0.1)
    assert np.abs(off["white"].mean(axis=0)).max() < 0.05 * size[0]
    np.testing.assert_allclose(np.abs(off["coloured"].mean(axis=0)), size * np.sqrt(0.5), rtol=0.15)
    slow = off["coloured"] - off["coloured"].mean(axis=0)
    after = round(plant.MEMORY / plant.DT)
    kept = (slow[after:] * slow[:-after]).mean(axis=0) / (slow**2).mean(axis=0)
    np.testing.assert_allclose(kept, np.exp(-1.0), atol=0.12)
    np.testing.assert_array_equal(plant.noisy(clean, "coloured", 3).channels[:, 12:], clean.channels[:, 12:])


def test_a_tenth_of_the_noise_of_accelerations_is_that():
    clean = quiet_log(5000)
    whole, tenth = (plant.noisy(clean, kind, 3).channels - clean.channels for kind in ("text", "tenth"))
    np.testing.assert_allclose(tenth[:, 12:], 0.1 * whole[:, 12:], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(tenth[:, 6:12], whole[:, 6:12])


def test_mean_error_is_that_of_the_listing():
    """Of the mass of the networks in table 6.1, by hand: ten elements that are not zero."""
    model = np.diag([231.0, 231, 231, 52, 50, 53])
    model[[0, 4], [4, 0]], model[[1, 3], [3, 1]] = -52.0, 52.0
    found = np.diag([255.0, 222, 236, 51, 49, 53])
    found[0, 4], found[4, 0], found[1, 3], found[3, 1] = -53.0, -54.0, 47.0, 52.0
    found[2, 0] = 15.0  # where the model has none it does not count
    by_hand = (24 / 231 + 9 / 231 + 5 / 231 + 1 / 52 + 1 / 50 + 0 + 1 / 52 + 2 / 52 + 5 / 52 + 0) / 10
    assert baselines.errors(found, model)["mean"] == pytest.approx(100 * by_hand)


def test_networks_that_are_compared_have_as_many_weights():
    def weights(*nets):
        return sum(a.size for net in nets for a in jax.tree.leaves(net))

    key = jax.random.key(0)
    one = weights(perceptron(12, study.ONE, 6, key))
    assert (6 * weights(perceptron(12, study.HIDDEN, 1, key)), one) == (426, 424)


def test_a_relative_error_is_that_of_its_axis():
    true = np.random.default_rng(0).normal(size=(1000, 3)) * [1.0, 10.0, 0.1]
    assert study.relative(np.broadcast_to(true.mean(axis=0), true.shape), true) == pytest.approx(np.ones(3))
    assert study.relative(1.2 * true - 0.2 * true.mean(axis=0), true) == pytest.approx(np.full(3, 0.2))


@pytest.fixture(scope="module")
def found() -> dict:
    return json.loads((study.HERE / "results.json").read_text())


def test_claims_compare_the_errors_that_they_name(found):
    names = sorted({name for _, better, worse, _ in study.CLAIMS for name in (better, worse)})
    assert set(names) <= set(found["errors"])
    rng = np.random.default_rng(0)
    errors = {name: rng.uniform(0.1, 1.0, 12).tolist() for name in names}
    for one, (words, better, worse, share) in zip(study.claims(errors), study.CLAIMS, strict=True):
        first, second = np.array(errors[better]), np.array(errors[worse])
        assert one["claim"] == words and one["wins"] == (first < share * second).sum()
        assert (one["median"], one["against"]) == pytest.approx((np.median(first), np.median(second)))


def test_what_is_kept_of_the_dives_decides_the_claims(found):
    for kind in ("errors", "seconds"):
        assert {len(values) for values in found[kind].values()} == {12}
    claims = study.claims(found["errors"])
    assert [one["claim"] for one in claims] == [words for words, *_ in study.CLAIMS]
    assert short(claims) == short(found["claims"])


def test_the_page_says_what_was_found(found):
    page = (ROOT / "experiments" / "README.md").read_text()
    assert study.table(found) in page
    assert " ".join(study.remarks(found).split()) in " ".join(page.split())
    # What the sentences take for granted.
    verdicts = {one["claim"]: one["verdict"] for one in found["claims"]}
    assert verdicts["4.3.5: the first by steepest descent"] == "holds"
    assert verdicts["4.3.5: normalised outputs mend it, steepest descent"] == "holds"
    assert verdicts["A.1.1: batch converges better than sample by sample, as many epochs"] == "refuted"
    minutes = sum(sum(values) for name, values in found["seconds"].items() if name.startswith("all of")) / 60
    assert f"some {minutes:.0f} min of one core" in page


@pytest.mark.slow  # trains some thirty networks
def test_a_quick_run_has_every_claim_and_goes_on_where_it_was(tmp_path):
    app = typer.Typer()
    app.command()(study.main)
    for _ in range(2):
        arguments = ["--out", str(tmp_path), "--quick"]
        assert CliRunner().invoke(app, arguments, catch_exceptions=False).exit_code == 0
    found = json.loads((tmp_path / "results.json").read_text())
    assert [one["claim"] for one in found["claims"]] == [words for words, *_ in study.CLAIMS]
    assert all(len(seconds) == 1 and seconds[0] >= 0 for seconds in found["seconds"].values())
