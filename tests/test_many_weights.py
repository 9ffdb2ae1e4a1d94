"""The study of networks of many weights: its numbers as the page has them, and its quick way."""

import json

import pytest

from experiments import many_weights as study
from jaxmarine.fitting._hidden import MANY

from .conftest import ROOT


def test_the_page_has_the_numbers_of_the_study():
    kept = json.loads((study.HERE / "results.json").read_text())
    page = (ROOT / "docs" / "subnets.md").read_text()
    assert study.table(kept["rows"]) in page
    assert f"{kept['last_information_gb']:.0f} GB" in page
    assert f"From {MANY} weights" in page


def test_gradients_serve_from_where_they_are_taken():
    """Above the limit they take less time and memory, and no error worth the name more."""
    rows = {
        (row["weights"], row["solver"]): row
        for row in json.loads((study.HERE / "results.json").read_text())["rows"]
    }
    for (weights, solver), by_all in rows.items():
        if solver == "gauss_newton" and weights > 1.5 * MANY:
            by_layers = rows[weights, "gradients"]
            assert by_layers["cpu_s"] < by_all["cpu_s"]
            assert by_layers["distance_10s"] < 1.2 * by_all["distance_10s"]


@pytest.mark.slow
def test_a_quick_study_compares_both(tmp_path):
    study.main(tmp_path, quick=True)
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [(row["weights"], row["solver"]) for row in rows] == [(20, "gauss_newton"), (20, "gradients")]
    assert all(row["cpu_s"] > 0 and row["memory_mb"] > 0 for row in rows)
