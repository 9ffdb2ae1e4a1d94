"""Sisters and drift: against dense Gaussians, and the study's numbers as the pages have them."""

import json

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from experiments import fleet_drift as study
from jaxmarine.fleets import Class, alarms, change_point, craft_of, pooled

from .conftest import ROOT


def test_the_evidence_of_a_step_is_that_of_dense_gaussians():
    rng = np.random.default_rng(1)
    std = rng.uniform(0.5, 2.0, 8)
    values = 3.0 + std * rng.normal(size=8)
    values[5:] += 4.0
    # The level is known to some 1000: what is left out of a flat prior goes with its inverse square.
    level, prior = 1e6, (5.0 * np.median(std)) ** 2
    without = np.diag(std**2) + level
    evidence = []
    for step in range(1, 8):
        stepped = (np.arange(8) >= step).astype(float)
        with_step = without + prior * np.outer(stepped, stepped)
        likely = [multivariate_normal.logpdf(values, np.zeros(8), one) for one in (with_step, without)]
        evidence.append(likely[0] - likely[1])
    found = change_point(values, std)
    assert found.nats == pytest.approx(np.log(np.mean(np.exp(evidence))), abs=1e-3)
    assert found.dive == 1 + int(np.argmax(evidence))
    assert abs(found.size - 4.0) < 3 * found.std


def test_a_craft_with_its_sisters_is_a_gaussian_given_its_dives():
    rng = np.random.default_rng(2)
    common = Class(rng.normal(size=2), np.array([0.5, 2.0]), np.array([0.3, 0.1]))
    root = rng.normal(size=(3, 2, 2))
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    values = rng.normal(size=(3, 2))
    # Parameters and all dives in one normal distribution, conditioned by Schur's complement.
    prior = np.diag(common.spread**2)
    cross = np.tile(prior, 3)
    whole = np.tile(prior, (3, 3))
    for i in range(3):
        here = slice(2 * i, 2 * i + 2)
        whole[here, here] += covariance[i] + np.diag(common.scatter**2)
    gain = cross @ np.linalg.inv(whole)
    mean, known = craft_of(common, values, covariance)
    np.testing.assert_allclose(mean, common.mean + gain @ (values.ravel() - np.tile(common.mean, 3)))
    np.testing.assert_allclose(known, prior - gain @ cross.T, atol=1e-12)


def test_mean_spread_and_scatter_of_a_class_are_found():
    fleet = study.simulated(np.random.default_rng(3), 60, 40, study.ALONE)
    common = pooled(list(fleet.values), list(fleet.covariance))
    # Five of 480 parameters have a defect, of ten percent; 60 craft know a spread to ten percent.
    np.testing.assert_allclose(common.mean, 1.0, atol=0.04)
    np.testing.assert_allclose(common.spread, study.SPREAD, rtol=0.5)
    np.testing.assert_allclose(common.scatter, study.SCATTER, rtol=0.25)


def test_what_is_stated_truly_has_no_scatter():
    rng = np.random.default_rng(4)
    values = rng.normal(size=(40, 50, 1)) + rng.normal(size=(40, 1, 1))
    assert pooled(list(values), [np.ones((50, 1, 1))] * 40).scatter[0] < 0.3


def test_a_defect_is_told_and_one_wild_dive_is_not():
    rng = np.random.default_rng(5)
    common = Class(np.ones(2), np.array([0.05, 0.05]), np.zeros(2))
    covariance = np.tile(0.01**2 * np.eye(2), (40, 1, 1))
    values = 1.0 + 0.01 * rng.normal(size=(40, 2))
    assert alarms(common, values, covariance) == []
    wild, fallen = values.copy(), values.copy()
    wild[20, 1] -= 0.3
    fallen[20:, 1] -= 0.06
    # What comes after a wild dive is judged by a level that it has moved.
    assert not [one for one in alarms(common, wild, covariance) if one.dive <= 20]
    told = alarms(common, fallen, covariance)
    assert (told[0].dive, told[0].parameter, told[0].rising) == (21, 1, False)


def test_the_study_runs_in_small(tmp_path):
    study.main(tmp_path, quick=True)
    (row,) = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert row["soon"] >= 4 and row["false"] <= 4


def test_the_pages_have_the_numbers_of_the_study():
    rows = json.loads((study.HERE / "results.json").read_text())["rows"]
    assert study.table(rows) in (ROOT / "experiments" / "README.md").read_text()
    # At most one false alarm in a thousand dives, and what a dive can tell alone is told within three.
    assert all(row["false_per_1000"][0] <= 1.0 for row in rows)
    assert all(row["soon_share"][0] >= 0.95 for row in rows if row["step"] >= study.ALONE)
    alone = next(row for row in rows if row["step"] == study.ALONE and not row["heavy"])
    study_page = " ".join((ROOT / "experiments" / "README.md").read_text().split())
    hull, thrusters, scatter = (
        f"{min(part):.3f} to {max(part):.3f}"
        for part in (alone["spread"][:4], alone["spread"][4:], alone["scatter"])
    )
    assert (
        f"of steps of {study.ALONE:g} errors found {hull} and {thrusters} (means over fleets)" in study_page
    )
    assert f"scatter from dive to dive {study.SCATTER:g}, found {scatter}." in study_page
    by_itself, by_sisters = alone["first_dive_error"]
    assert f"first dive {by_sisters:.3f} instead of {by_itself:.3f} (root mean square" in study_page
    page = (ROOT / "docs" / "fleets.md").read_text()
    assert f"{alone['false_per_1000'][0]:.2f} false alarms in 1000 dives" in page
    assert f"{alone['soon']} of {alone['defects']} defects" in page
