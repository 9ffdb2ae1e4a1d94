"""What is counted over logs with a known answer, on rows made by hand: no diagnosis is run."""

import hashlib
import json
from typing import Any

from experiments._study import program
from experiments.blind_matrix import GROUPS, HERE, Row, detectable, missed_table, summary, table, table_of

from .conftest import ROOT


def row(kind: str, hidden: list, *found: tuple[str, str | None], **more: Any) -> Row:
    """A log's row, with all that is graded from the whole answer taken for right."""
    return {
        "case": "-",
        "vehicle": "-",
        "kind": kind,
        "severity": 2.0,
        "hidden": hidden or None,
        "found": [[*one, 9.0] for one in found],
        **dict.fromkeys(("first", "whole", "signal", "own_name"), True),
        **dict.fromkeys(("since", "true_ratio", "probability")),
        "verdict": "-",
        "depends_on": [],
        "parameters": [],
        "ratio": 1.0,
        "seconds": 1.0,
        **more,
    }


def test_strictly_nothing_is_forgiven():
    trim, payload = ("trim", None), ("payload", None)
    s = summary(
        [
            row("null", []),
            row("single", [trim], trim),
            row("single", [trim], payload),  # indistinguishable, or accepted for it
            row("single", [trim], severity=1.2),
            row("pair", [trim, payload], payload, trim),
            row("pair", [trim, payload], trim, trim),
            row("misfit", [trim], trim, ("linear_damping", "surge")),
        ]
    )
    assert (s["strict"]["right"], s["strict"]["of"]) == (2, 5)
    assert [(one["right"], one["of"]) for one in s["strict_of"].values()] == [(1, 2), (1, 2), (0, 1)]
    assert "nothing forgiven: 2 of 5" in table(s)


def test_what_the_evidences_are_sure_of_and_what_hardly_shows_is_counted():
    rows = [
        row("single", [], probability=0.995),
        row("single", [], probability=0.99, own_name=False),
        row("single", [], probability=0.5),
        row("single", []),
        row("single", [], severity=1.25, probability=1.0),
        row("single", [], severity=1.05, first=False),
    ]
    for one in rows:
        one["hidden"] = [["trim", None]]
    text = table(summary(rows))
    assert "call 2 of 3 first names 99 % sure and more, of which 1 are right" in text
    assert "Of 2 effects that raise the error by less than 30 % (median 15 %), 1 are named" in text


def test_rows_of_several_programs_are_told():
    old, new = row("null", []), row("null", [], program="1 abc")
    assert "programs" not in table(summary([new, new]))
    assert "from 2 programs: 1 abc, an unnamed one." in table(summary([old, new, old]))


def test_a_program_is_its_sources(tmp_path):
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "c.py").write_text("second")
    (tmp_path / "a.py").write_text("first ")
    (tmp_path / "notes.md").write_text("not a source")
    assert program(tmp_path).split()[-1] == hashlib.sha256(b"first second").hexdigest()[:12]
    before = program(tmp_path)
    (tmp_path / "a.py").write_text("other ")
    assert program(tmp_path) != before
    assert program().split()[0][0].isdigit()


def test_logs_under_feedback_stand_beside_those_of_sticks():
    gain = ("thruster_gain", "all")
    named, fed = {"value": 1.0, "true": 1.1, "std": 0.1}, {"steering": "station", "disturbance": "waves"}
    off = {"value": 1.0, "true": 1.5, "std": 0.1}
    s = summary(
        [
            row("single", [gain], gain, parameters=[named]),
            row("single", [gain], gain, parameters=[named, off], **fed),
            row("single", [gain], first=False, whole=False, **fed),
            row("null", [], steering="sticks"),
        ]
    )
    first, holding = s["targets"][0], s["targets"][-1]
    assert [(first[by]["right"], first[by]["of"], first[by]["met"]) for by in ("sticks", "feedback")] == [
        (1, 1, True),
        (1, 2, False),
    ]
    assert [(holding[by]["right"], holding[by]["of"]) for by in ("sticks", "feedback")] == [(1, 1), (1, 2)]
    assert not holding["sticks"]["met"]  # all of them are more than 95 % intervals should hold
    text = table(s)
    assert "| 1 of 1 | 100.0 (20.7 to 100.0) | 98 | yes | 1 of 2 | 50.0 (9.5 to 90.5) | 95 | no |" in text
    assert "| station, waves | 2.00 |" in text


def test_the_page_has_the_numbers_of_the_present_code():
    page = (ROOT / "docs" / "trust.md").read_text()
    for folder, steered, words in (
        ("by_sticks", GROUPS[0], "{right} of {count} answers are wholly right"),
        ("geared", GROUPS[0], "Of the {count} that were\ndrawn first"),
        ("geared_fed_back", GROUPS[1], "and {right} of {count} answers are wholly right"),
        ("fed_back", GROUPS[1], "Of {count} that can be seen"),
        (
            "fed_back_anew",
            GROUPS[1],
            "Of {count} of these that can be seen, {right} have a wholly right answer",
        ),
        (
            "fed_back_third",
            GROUPS[1],
            "Of {count} of these that can be\nseen, {right} have a wholly right answer",
        ),
    ):
        rows = json.loads((HERE / folder / "results.json").read_text())["rows"]
        counted = summary(rows)
        assert table_of(counted, steered) in page
        seen = [row for row in rows if detectable(row)]
        right = sum(row["whole"] for row in seen)
        assert words.format(right=right, count=len(seen)) in page
        if folder in ("geared", "fed_back"):
            assert f"{right} have a wholly right answer" in page


def test_the_page_says_on_how_many_logs_all_this_rests():
    page = (ROOT / "docs" / "trust.md").read_text()
    counted = {
        path.parent.name: sum(map(detectable, json.loads(path.read_text())["rows"]))
        for path in HERE.glob("*/results.json")
    }
    assert f"was measured on {sum(counted.values())} [simulated logs]" in page
    gear = counted["geared"] + counted["geared_fed_back"]
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert f"was measured on {sum(counted.values())} [simulated logs]" in readme
    assert f"how-often-it-is-right), {gear} of them of craft with propellers" in readme
    assert f"was measured on {gear} logs only" in page


def test_the_page_says_how_often_intervals_of_right_answers_hold_the_truth():
    rows = json.loads((HERE / "by_sticks" / "results.json").read_text())["rows"]
    off = [
        abs(one["value"] - one["true"]) / one["std"]
        for row in rows
        if detectable(row) and row["whole"]
        for one in row["parameters"]
    ]
    told = f"{sum(x <= 1.96 for x in off)} of {len(off)} hold it, and those that do not are off by at most"
    assert f"{told} {max(off):.1f} standard deviations" in (ROOT / "docs" / "trust.md").read_text()


def test_the_page_has_what_was_missed():
    rows = [
        row
        for folder in (
            "by_sticks",
            "geared",
            "geared_fed_back",
            "fed_back",
            "fed_back_anew",
            "fed_back_third",
        )
        for row in json.loads((HERE / folder / "results.json").read_text())["rows"]
    ]
    assert missed_table(summary(rows)) in (ROOT / "experiments" / "README.md").read_text()
