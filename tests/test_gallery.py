"""The worked cases of the documentation: their pages are what the study's results say."""

import json

import pytest

from experiments import gallery

RESULTS = json.loads((gallery.HERE / "results.json").read_text(encoding="utf-8"))
DOCS = gallery.HERE.parents[1] / "docs" / "gallery"
# What was hidden: the name, a parameter and its value; of a force without a name the signal.
HIDDEN = {
    "rov": ("thruster_gain:port_h", "factor", 0.72),
    "ship": ("surface_offset:rudder", "angle", 0.06),
    "auv": ("surface_stuck:plane_star", "angle", 0.08),
    "boat": ("reverse_thrust:starboard", "factor", 0.5),
}


@pytest.mark.parametrize("case", gallery.CASES, ids=lambda case: case["name"])
def test_pages_are_written_from_the_results(case):
    page = (DOCS / f"{case['name']}.md").read_text(encoding="utf-8")
    assert page == gallery.page(case, RESULTS[case["name"]])
    assert (DOCS / f"{case['name']}.png").exists()


@pytest.mark.parametrize("name", HIDDEN)
def test_what_was_hidden_was_found_and_nothing_else(name):
    label, parameter, value = HIDDEN[name]
    found = RESULTS[name]
    assert found["verdict"] == "explained" and list(found["findings"]) == [label]
    # Within a twentieth, which is what a reader would call right.
    assert found["findings"][label][parameter] == pytest.approx(value, rel=0.05)
    assert found["ratio"] < 0.5


def test_a_force_that_nobody_knows_gets_no_name():
    found = RESULTS["unknown"]
    assert found["verdict"] == "unexplained" and list(found["findings"]) == ["unknown:heave"]
    assert found["depends_on"] == ["u"]
    # It was learned, and predicts.
    assert found["ratio"] < 0.8


@pytest.mark.slow  # a diagnosis
def test_a_case_is_run_anew(tmp_path):
    gallery.main(tmp_path, "", quick=True)
    told = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert list(told["rov"]["findings"]) == ["thruster_gain:port_h"]
