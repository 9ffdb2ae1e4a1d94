"""The study of a craft that is watched: its quick way, and its numbers as the page has them."""

import json

import pytest

from experiments import live as study

from .conftest import ROOT


def test_the_page_has_the_numbers_of_the_study():
    kept = json.loads((study.HERE / "results.json").read_text())
    found = study.summary(kept["rows"])
    assert {name: kept[name] for name in found} == found
    page = (ROOT / "docs" / "live.md").read_text()
    assert study.table(found) in page
    # Lines of the page break anywhere.
    page = " ".join(page.split())
    logs = [row for row in kept["rows"] if row["kind"] == "delay"]
    named = [row for row in logs if row["named"]]
    assert all(row["first_right"] and len(row["named"]) == 1 for row in named)
    exact, near = (sum(abs(row["off"]) < by for row in named) for by in (0.05, 0.55))
    assert (
        f"Of {len(logs)} logs {len(named)} get a name, all of them the right one first, {exact} since" in page
    )
    assert f"and {near} within half a second" in page


def test_what_is_named_before_the_fault_is_false():
    name = {"label": "a", "since": None, "at": study.SINCE - 1.0, "nats": 20.0}
    log = {"kind": "delay", "disturbance": "none", "factor": 0.8, "first_right": False, "delay": 12.0}
    log |= {"since": study.SINCE}
    null = {"kind": "null", "disturbance": "none", "hours": 0.5, "named": [name | {"label": "b"}]}
    late = name | {"at": study.SINCE + 12.0}
    found = study.summary([log | {"named": [name, late]}, log | {"named": [], "delay": None}, null])
    (quiet,), (size,) = found["quiet"], found["sizes"]
    assert quiet["names"] == ["a", "b"] and quiet["hours"] == 0.5 + 2 * study.SINCE / 3600.0
    assert (size["named"], size["logs"], size["delays"], size["false"]) == (1, 2, [12.0], 1)


def test_a_fault_that_gets_no_name_is_later_than_all():
    def logs(*delays: float | None) -> list[dict]:
        return [{"delay": one, "first_right": one is not None, "named": []} for one in delays]

    (found, late) = (study.size_of(logs(*some)) for some in ((30.0, 10.0, None), (None, 5.0, None)))
    assert (found["median"], found["most"], found["named"]) == (30.0, None, 2)
    assert (late["median"], late["most"], late["false"]) == (None, None, 0)
    twenty = study.size_of(logs(*(float(k) for k in range(20))))
    # Of twenty, nineteen take no longer.
    assert (twenty["median"], twenty["most"]) == (9.0, 18.0)


def test_hours_are_summed_up_by_water_and_setting():
    def hour(water: str, **named: list[str]) -> dict:
        names = {"0.01": [], "1": [], "100": []} | named
        labels = {setting: [{"label": label} for label in some] for setting, some in names.items()}
        return {"kind": "hour", "disturbance": water, "hours": 0.5, "named": labels}

    loose = {"100": ["b", "a", "b"], "1": ["a"]}
    found = study.summary([hour("none"), hour("waves", **loose), hour("waves")])
    hours = {one["disturbance"]: one["hours"] for one in found["settings"]}
    assert hours == {"none": 0.5, "gusts": 0, "slow": 0, "waves": 1.0, "current": 0}
    table = study.table(found)
    assert "| calm | 0.50 | none | none | none |" in table
    assert "| waves | 1.00 | none | 1 `a` | 2 `b`, 1 `a` |" in table


@pytest.mark.slow
def test_a_quick_study_names_the_thruster(tmp_path):
    study.main(tmp_path, quick=True)
    found = json.loads((tmp_path / "results.json").read_text())
    (same,), (size,), (quiet,), (pace,) = (found[name] for name in ("same", "sizes", "quiet", "pace"))
    assert same["named"][0]["label"] == same["diagnosed"][0][0] == f"thruster_gain:{study.THRUSTER}"
    assert size["named"] == 1 and quiet["names"] == [] and pace["axes"] == 6
