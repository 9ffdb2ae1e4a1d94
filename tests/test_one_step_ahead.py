"""Likelihoods one step ahead: densities in SI units, the choice of a noise, and the page's numbers."""

import json
import math
from types import SimpleNamespace
from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from experiments import one_step_ahead
from experiments.one_step_ahead import BESIDE, WHITE, compared, nats, table
from jaxmarine.diagnosis._workbench import Workbench

from .conftest import ROOT


def test_a_density_is_that_in_si_units(monkeypatch):
    """Of Gaussian errors against SciPy: channels of unlike noise, one with fewer samples, one unused."""
    rng, noise = np.random.default_rng(0), np.array([0.2, 3.0, np.nan])
    weight = np.ones((5, 8, 3)) / np.nan_to_num(noise, nan=1.0)
    weight[2:, :, 1], weight[..., 2] = 0.0, 0.0
    error = rng.normal(size=weight.shape) * np.nan_to_num(noise, nan=1.0)
    used = weight > 0
    in_noise = scipy.stats.norm.logpdf((error * weight)[used]).mean()
    monkeypatch.setattr(one_step_ahead, "log_score", lambda bench, model, weathers: in_noise)
    bench = Mock(spec=Workbench, noise=noise)
    bench.cut = SimpleNamespace(windows=SimpleNamespace(weight=jnp.asarray(weight)))
    expected = scipy.stats.norm.logpdf(error, scale=noise)[used].mean()
    assert nats(bench, None) == pytest.approx(expected, abs=1e-12)


def test_each_model_takes_the_noise_that_suits_its_training_logs(monkeypatch):
    bench = Mock(spec=Workbench, noise=np.array([1.0, np.nan]), own_noise=np.array([0.05, np.nan]))
    monkeypatch.setattr(one_step_ahead, "opened_with", lambda *_: SimpleNamespace(bench=bench, tests=()))
    monkeypatch.setattr(one_step_ahead, "with_noise", lambda bench, noise: float(noise[0]))

    def scores(noise: float, tests: tuple) -> dict:
        # Nothing is less than the sensors' own noise.
        assert noise >= 0.05
        best = {WHITE: 0.3, BESIDE: 0.1}
        return {name: {"train": 1.0 - abs(math.log(noise / x)), "test": noise} for name, x in best.items()}

    monkeypatch.setattr(one_step_ahead, "scores", scores)
    found = compared(None, (), ())
    assert found["best"] == {
        WHITE: {"share": "0.3", "train": 1.0, "test": 0.3},
        BESIDE: {"share": "0.1", "train": 1.0, "test": 0.1},
    }
    assert f"| {BESIDE} | 0.1 | 1.00 | 0.10 |" in table(found)


def test_the_page_has_the_numbers_of_the_boats():
    page = (ROOT / "experiments" / "README.md").read_text()
    more = []
    for name, words in (("blueboat", "BlueBoat, 4 test logs"), ("vtec_s3", "VTec S-III, 3 test logs")):
        best = json.loads((ROOT / "experiments" / "ahead" / f"{name}.json").read_text())["best"]
        white, beside = best[WHITE]["test"], best[BESIDE]["test"]
        assert f"| {words} | {white:.2f} | {beside:.2f} | {beside - white:.2f} |" in page
        more.append(math.exp(beside - white))
    assert "A number is {:.1f} and {:.1f} times as likely beside a disturbance".format(*more) in page
