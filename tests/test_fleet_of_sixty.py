"""The fleet that is hindered: what is counted of it, and the study's numbers as the pages have them."""

import json
import subprocess
import sys

import pandas as pd
import pytest

from experiments import fleet_of_sixty as study
from jaxmarine.fleets._page import page

from .conftest import ROOT
from .fleet_work import environment
from .test_fleet import row


def test_alarms_are_read_from_the_page():
    rows = [row(f"c{day}", "clara & co", day, 0.8 if day > 3 else None) for day in range(1, 6)]
    found = study.alarms_of(page(rows))
    assert found == [["clara & co", "New: thrust of port", "2026-03-04"]]
    assert study.alarms_of(page([row("a", "anna", 1)])) == []


def test_a_name_is_right_that_stands_alone():
    weak = {"hidden": "thruster_gain:port", "error": None}
    assert study.right(weak | {"found": ["thruster_gain:port"]})
    assert not study.right(weak | {"found": ["thruster_gain:port", "unknown:yaw"]})
    assert study.right({"hidden": None, "error": None, "found": []})
    assert not study.right({"hidden": None, "error": "is broken", "found": []})


def test_a_log_that_is_not_used_has_a_row_with_its_sentence():
    table = pd.DataFrame([{"name": "ida-2", "craft": "ida", "effect": None, "target": None, "error": "why"}])
    (found,) = study.rows_of(table, study.FLEET)
    assert found == {"log": "ida-2", "kind": "cybership2", "hidden": None, "found": [], "error": "why"}


@pytest.mark.slow
def test_the_study_runs_in_small(tmp_path):
    words = ["-m", "experiments.fleet_of_sixty", "--out", str(tmp_path), "--quick"]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, env=environment())
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "results.json").read_text())
    assert len(results["logs"]) == 6
    broken = {one["log"] for one in results["logs"] if one["error"] is not None}
    assert broken == {study.CUT, study.PICTURE}
    assert all(one["same"] for one in results["alone"].values())
    assert max(results["worker"]["most"]) < study.LIMIT
    assert results["given_back"]["left"][0] < results["given_back"]["held"][0]


def test_the_pages_have_the_numbers_of_the_study():
    results = json.loads((study.HERE / "results.json").read_text())
    page = (ROOT / "experiments" / "README.md").read_text()
    assert study.fleet_table(results) in page
    words = " ".join(page.split())
    for fact in study.facts(results):
        assert fact in words, fact
    for sentence in (one["error"] for one in results["logs"] if one["error"] is not None):
        assert f"`{sentence}`" in words
    fleets = " ".join((ROOT / "docs" / "fleets.md").read_text().split())
    assert all(fact in fleets for fact in study.facts(results)[:3])
    let_go = sum(maps < 2000 for maps in results["worker"]["maps"])
    assert f"have come since the last time, which it did {let_go} times in this run" in words
    used = [one for one in results["logs"] if one["error"] is None]
    assert all(map(study.right, used)) and len(results["logs"]) == 60
    assert all(one["same"] for one in results["alone"].values())
