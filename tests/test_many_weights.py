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
    assert f"more than {MANY} weights" in page


def test_gradients_serve_from_where_they_are_taken():
    """About the limit they take less memory than Gauss-Newton; far below they take longer, and as much."""
    kept = json.loads((study.HERE / "results.json").read_text())["rows"]
    rows = {(row["weights"], row["solver"]): row for row in kept}
    few, many = ((rows[count, "gauss_newton"], rows[count, "gradients"]) for count in (48, 513))
    # Of four inputs and two layers as wide as the network, before the last.
    assert [(4 + 1 + row[0]["width"]) * row[0]["width"] for row in (few, many)] == [36, 456]
    assert 36 < MANY < 456
    assert few[0]["cpu_s"] < few[1]["cpu_s"]
    # Processor time of two runs, which other work shared the machine with: 1.0 and 1.5 times as much.
    assert many[1]["cpu_s"] < 2.0 * many[0]["cpu_s"] and many[1]["memory_mb"] < many[0]["memory_mb"]


@pytest.mark.slow
def test_a_quick_study_compares_both(tmp_path):
    study.main(tmp_path, quick=True)
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [(row["weights"], row["solver"]) for row in rows] == [(20, "gauss_newton"), (20, "gradients")]
    assert all(row["cpu_s"] > 0 and row["memory_mb"] > 0 and 0 < row["held"] < 1 for row in rows)
