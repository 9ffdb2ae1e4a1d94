"""The study of what decides: numbers with others beside them, moves that are left out, and its table."""

import dataclasses
import json
import operator
import sys
from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.blind.cases import make_case
from experiments.blind.plant import Effect
from experiments.what_decides import MOVES, VARIANTS, Spread, Watched, summary, table, watching, without
from jaxmarine.diagnosis import Criteria, _settle, _unnamed
from jaxmarine.diagnosis._explanation import Model
from jaxmarine.diagnosis._workbench import Workbench

from .conftest import ROOT
from .fleet_work import child

SIZES = st.floats(-100.0, 100.0).filter(lambda x: abs(x) > 1e-3)
ARITHMETIC = (operator.add, operator.sub, operator.mul, operator.truediv)
ORDER = (operator.lt, operator.le, operator.gt, operator.ge)


def spread(own: float, other: float, otherwise: set[str]) -> Spread:
    return Spread(own, {"a": other}, otherwise)


@given(SIZES, SIZES, SIZES, SIZES, st.sampled_from(ARITHMETIC), st.sampled_from(ORDER))
def test_all_numbers_go_through_arithmetic_alike(own, other, first, last, apply, compare):
    """Against the same sums made of each number by itself, as floats and as numpy's, from both sides."""
    for number in (float, np.float64):
        otherwise: set[str] = set()
        after = apply(number(first), spread(own, other, otherwise))
        before = apply(spread(own, other, otherwise), number(first))
        for got, (x, y) in ((after, (first, own)), (before, (own, first))):
            assert got.own == apply(x, y)
        assert (after.others["a"], before.others["a"]) == (apply(first, other), apply(other, first))
        for held, sides in ((number(last), (last, last)), (before, (apply(own, first), apply(other, first)))):
            otherwise.clear()
            told = compare(after, held)
            assert told == compare(apply(first, own), sides[0])
            assert ("a" in otherwise) == (told != compare(apply(first, other), sides[1]))


def test_a_criterion_is_no_truth_by_itself():
    with pytest.raises(TypeError, match="is compared with something"):
        bool(spread(1.0, 2.0, set()))
    otherwise: set[str] = set()
    assert spread(1.0, 2.0, otherwise) == 1.0 and otherwise == {"a"}


def test_an_array_is_compared_number_by_number():
    otherwise: set[str] = set()
    told = np.array([1.0, 3.0, 5.0]) > spread(2.0, 4.0, otherwise)
    np.testing.assert_array_equal(told, [False, True, True])
    assert otherwise == {"a"}
    otherwise.clear()
    assert (np.array([1.0, 5.0]) > spread(2.0, 4.0, otherwise)).any() and not otherwise


def test_criteria_that_watch_are_the_default_and_know_their_variants():
    watched, default = Watched(), Criteria()
    for field in dataclasses.fields(Criteria):
        for sign in "-+":
            other = getattr(VARIANTS[f"{field.name} {sign}"], field.name) / getattr(default, field.name)
            # A count moves by whole ones.
            wide = (0.3, 0.5) if isinstance(getattr(default, field.name), int) else (0.3, 0.3)
            assert wide[0] - 1e-9 <= abs(other - 1) <= wide[1] + 1e-9
    assert not watched.nats > default.nats + 0.25  # log 1.3 is 0.26
    assert watched.otherwise == {"odds +"}
    assert watched.file_error == default.file_error
    assert watched.otherwise == {"odds +", "file_error -", "file_error +"}


def test_a_move_is_left_out_wherever_its_name_was_imported():
    """A function that another module took by name is another name to put something in the place of."""
    rooms = [m for name, m in sys.modules.items() if name.startswith("jaxmarine.diagnosis")]
    for move in MOVES.values():
        for owner, name, _, _ in move.parts:
            if isinstance(owner, type):
                continue
            made, left_out = getattr(owner, name), {(one, other) for one, other, _, _ in move.parts}
            bound = {(room, key) for room in rooms for key, x in vars(room).items() if x is made}
            # Where it is defined nothing asks for it by that name but itself.
            home = sys.modules[made.__module__]
            assert bound - left_out <= {(home, name)} and (owner, name) in bound


def test_a_move_that_is_left_out_does_nothing_and_one_that_acts_is_told(monkeypatch):
    made = _settle.pruned
    with without(MOVES["drop"]):
        assert _settle.pruned(None, "model") == "model"
    assert _settle.pruned is made
    with without(MOVES["unknown"]):
        assert _unnamed._dependences(None, "judged", None) == ("judged", ())
    # It returns the model that it was given where that has no members, and does nothing then.
    still = Model((), np.zeros(0), jnp.zeros((1, 12)), 0.0)
    with watching(MOVES) as acted:
        assert _settle.pruned(Mock(spec=Workbench), still) is still
    assert acted == set()
    monkeypatch.setattr(_settle, "pruned", lambda bench, model: dataclasses.replace(model, cost=1.0))
    with watching(MOVES) as acted:
        assert _settle.pruned(None, still).cost == 1.0
    assert acted == {"drop"}


def log(case: str, whole: bool, again: dict[str, bool], severity: float = 3.0) -> dict:
    named, none = (
        {"verdict": "explained", "named": [["trim", None, None]]},
        {"verdict": "refused", "named": []},
    )
    rows = {name: {"whole": right, **(named if right == whole else none)} for name, right in again.items()}
    about = {"case": case, "kind": "single", "severity": severity, "program": "1 a"}
    return {**about, **named, "whole": whole, "again": rows}


def test_rates_are_those_of_what_was_made_anew_and_else_those_by_default():
    rows = [
        log("a", True, {"odds +": False, "without drop": True}),
        log("b", False, {"odds +": True, "odds -": True}),
        log("c", True, {}),
        log("d", True, {"odds +": False}, severity=1.1),  # not to be seen, and not counted
        log("e", True, {"without drop": False}),
    ]
    found = summary(rows)
    assert (found["logs"], found["seen"], found["right"]) == (5, 4, 3)
    of = found["variants"]
    assert of["odds +"] == {"again": 2, "changed": 2, "right": 3, "points": 0.0, "lost": ["a"], "won": ["b"]}
    assert of["odds -"] == {"again": 1, "changed": 1, "right": 4, "points": 25.0, "lost": [], "won": ["b"]}
    assert of["without drop"]["right"] == 2 and of["apart +"]["again"] == 0
    lines = table(found).splitlines()
    assert "| `odds` | 150 | +30 % | 2 | 2 | 3 | +0.0 | `a` | `b` |" in lines
    assert sum(line.startswith("| `") for line in lines) == len(VARIANTS)


# In a process of its own: in this one types are checked at each call, and a spread is no float.
ALIKE = """
import json, sys
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
import jaxmarine as jm
from experiments.what_decides import MOVES, VARIANTS, Watched, watching, without

folder = Path(sys.argv[1])
craft = jm.load_vehicle(folder / "vehicle.toml")
logs = [jm.read_log(folder / f"{part}.csv", craft) for part in ("train", "test")]
watched = Watched()
with watching(MOVES) as acted:
    said = jm.diagnose(craft, *logs, criteria=watched).to_json()
same = sorted({*VARIANTS} - watched.otherwise)
assert len(same) > len(VARIANTS) / 2, same
for name in same[::5]:  # the others would take minutes more
    assert jm.diagnose(craft, *logs, criteria=VARIANTS[name]).to_json() == said, name
for name in sorted({*MOVES} - acted):
    with without(MOVES[name]):
        less = jm.diagnose(craft, *logs).to_json()
    assert (less["findings"], less["verdict"]) == (said["findings"], said["verdict"]), name
print(len(same), len(acted))
"""


@pytest.mark.slow
def test_what_no_comparison_decides_otherwise_is_the_same_diagnosis(tmp_path):
    """Of a short log of the boat, of numbers and moves that are said to change nothing: nothing changes."""
    weak = Effect("thruster_gain", "port", {"factor": 0.8})
    make_case(tmp_path, "cybership2", [weak], 7, duration_train=60.0, duration_test=60.0)
    done = child(ALIKE, tmp_path)
    assert done.returncode == 0, done.stderr
    same, acted = map(int, done.stdout.split())
    assert same < len(VARIANTS) and 0 < acted < len(MOVES)


def test_the_page_has_the_rows_that_are_kept():
    rows = json.loads((ROOT / "experiments" / "decides" / "results.json").read_text())["rows"]
    found = summary(rows)
    page = (ROOT / "experiments" / "README.md").read_text()
    assert table(found) in page
    of = [one for name, one in found["variants"].items() if name in VARIANTS]
    changed, again = (sum(one[key] for one in of) for key in ("changed", "again"))
    assert f"{changed} of {again} diagnoses with another criterion" in page
    assert max(len(one["lost"]) + len(one["won"]) for one in of) == 1
    assert "none changes the answer to more than one log" in page
