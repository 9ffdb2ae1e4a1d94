"""The study of names under way and afterwards: from logs to a table, and its numbers as the page has them."""

import json

from experiments import live_names as study
from experiments.blind.cases import make_case

from .conftest import ROOT


def row(steering: str, kind: str, diagnosed: list[str], *named: str) -> dict:
    said = [{"label": one, "since": None, "at": 60.0, "nats": 30.0} for one in named]
    return {"steering": steering, "kind": kind, "diagnosed": diagnosed, "named": said}


def test_the_page_has_the_numbers_of_the_study():
    kept = json.loads((study.HERE / "results.json").read_text())
    assert kept["table"] == study.summary(kept["rows"])
    page = (ROOT / "docs" / "live.md").read_text()
    assert study.table(kept["rows"]) in page
    by = {kind: [row for row in kept["rows"] if row["kind"] == kind] for kind in study.KINDS}
    false = [row for row in by["null"] if row["named"]]
    # Lines of the page break anywhere.
    page = " ".join(page.split())
    assert f"hidden {len(false)} of {len(by['null'])} logs got a name" in page
    right = [row for row in by["single"] if row["named"] and study.named(row)[0] in row["diagnosed"]]
    same = [row for row in by["single"] if {*study.named(row)} == {*row["diagnosed"]}]
    said = f"Of {len(by['single'])} logs with one effect {len(same)} get the names of a diagnosis"
    assert said in page and f"first name is right on {len(right)}." in page
    silent = [row for row in by["single"] if not row["named"]]
    assert len(silent) == 3 and "Three stay silent" in page
    other = [row for row in by["single"] if row["named"] and {*study.named(row)} != {*row["diagnosed"]}]
    assert sum({*row["diagnosed"]} > {*study.named(row)} for row in other) == 1
    assert "one has a name less" in page
    wrong = [row for row in other if study.named(row)[0] not in row["diagnosed"]]
    assert len(wrong) == 1
    assert "one is named wrongly: a fluid memory in sway, of 20 nats, for the linear damping there" in page
    assert [study.group(row) for row in wrong] == ["feedback"]
    assert (study.named(wrong[0]), round(wrong[0]["named"][0]["nats"])) == (["fluid_memory:sway"], 20)
    assert wrong[0]["hidden"] == [["linear_damping", "sway"]]
    assert len(other) == len(wrong) + 1
    assert f"more than {max(len(row['named']) for row in kept['rows'])} name." in page
    assert {row["program"] for row in kept["rows"]} == {kept["program"]}
    assert f"All {len(kept['rows'])} rows are by one program" in page


def test_names_are_the_same_in_any_order_or_differ_by_what_is_said():
    rows = [
        row("sticks", "single", ["a"], "a"),
        row("sticks", "single", ["a", "b"], "b", "a"),
        row("sticks", "single", ["a"]),
        row("sticks", "single", ["a"], "a", "b"),
        row("sticks", "single", ["a"], "b"),
        row("pilot", "null", []),
        row("station", "null", [], "b"),
    ]
    by = {(one["steered"], one["kind"]): one for one in study.summary(rows)}
    assert by["sticks", "single"] | {"logs": 5, "same": 2, "silent": 1, "more": 1} == by["sticks", "single"]
    assert by["feedback", "null"] | {"logs": 2, "same": 1, "silent": 0, "more": 1} == by["feedback", "null"]
    assert [by["sticks", "null"]["logs"], by["feedback", "single"]["logs"]] == [0, 0]
    # 2 of 5 after Wilson: 12 to 77 %; one of five names another.
    assert "| sticks | one effect | 5 | 2 (12% to 77%) | 1 | 1 | 1 |" in study.table(rows)


def test_it_goes_on_where_it_was_cut_and_takes_the_matrix_as_it_lies(tmp_path, monkeypatch):
    """Logs that are not there, and those of other kinds, are left out; none is watched twice."""
    cases, rows = tmp_path / "cases", tmp_path / "results.json"
    for name in ("null_00_0", "pair_00_0"):
        make_case(cases / name, "cybership2", [], 1, duration_train=10.0, duration_test=10.0)
    graded = {"vehicle": "cybership2", "steering": "sticks", "disturbance": "none", "hidden": None}
    found = [["thruster_gain", "port", 30.0]]
    rows.write_text(
        json.dumps(
            {
                "rows": [
                    graded | {"case": f"{kind}_00_{i}", "kind": kind, "found": found}
                    for kind, i in (("null", 0), ("pair", 0), ("single", 0))
                ]
            }
        )
    )
    seen = []

    def watched(vehicle, log):
        seen.append((vehicle.name, len(log.t)))
        return log

    said = [{"label": "thruster_gain:port", "since": None, "at": 8.0, "nats": 30.0}]
    monkeypatch.setattr(study, "watched", watched)
    monkeypatch.setattr(study, "names_of", lambda watch: said)
    for _ in range(2):
        study.main(cases, rows, tmp_path / "out")
    assert seen == [("cybership2", 100)]  # of 10 s at 10 Hz
    kept = json.loads((tmp_path / "out" / "results.json").read_text())
    (one,) = kept["rows"]
    assert (one["case"], one["diagnosed"], one["named"]) == ("null_00_0", ["thruster_gain:port"], said)
    assert kept["table"][0] == {
        "steered": "sticks", "kind": "null", "logs": 1, "same": 1, "silent": 0, "more": 0,
    }  # fmt: skip
