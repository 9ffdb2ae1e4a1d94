"""How answers to logs with tricks are graded, on answers made by hand: no diagnosis is run."""

import json
from typing import Any

import numpy as np
import pandas as pd
import pytest

from experiments import adversary
from experiments.adversary import BLAMED, NOTHING, REFUSED, Trick, fresh_tricks, is_honest

from .conftest import ROOT

CONTRADICTED = "u, v contradict what positions and attitude show, whatever forces act: check them."
TAKEN_FIRST = "Positions, attitude and velocities contradict one another as gyro_bias would make them."


def said(verdict: str, *names: str, unknown: str = "", of: str = "", **more: Any) -> dict[str, Any]:
    """An answer as it is kept; `unknown`: the axis of an unknown cause, `of`: a signal that it depends on."""
    return {
        "verdict": verdict,
        "names": [*names],
        "unknown": [unknown] * bool(unknown),
        "depends_on": [of] * bool(of),
        "contradicted": None,
        "notes": [],
        **more,
    }


@pytest.mark.parametrize(
    ("honest", "signals", "answer", "fair"),
    [
        ((REFUSED,), (), {"refused": "no"}, True),
        ((NOTHING,), (), {"refused": "no"}, False),
        ((NOTHING,), (), said("nothing_found"), True),
        ((BLAMED,), (), said("nothing_found"), False),
        ((BLAMED,), (), said("nothing_found", contradicted=CONTRADICTED), True),
        ((NOTHING,), (), said("nothing_found", contradicted=CONTRADICTED), False),
        ((NOTHING,), (), said("nothing_found", notes=[TAKEN_FIRST]), False),
        ((BLAMED,), (), said("nothing_found", notes=[TAKEN_FIRST]), True),
        (("waves",), (), said("explained", "waves"), True),
        (("waves",), (), said("explained", "waves", "trim"), False),
        (("waves",), (), said("explained", "waves", contradicted=CONTRADICTED), False),
        (("waves", BLAMED), (), said("explained", "waves", contradicted=CONTRADICTED), True),
        ((BLAMED,), (), said("explained", "waves", contradicted=CONTRADICTED), False),
        ((), ("t", "psi"), said("unexplained", unknown="sway", of="t"), True),
        ((), ("t", "psi"), said("unexplained", unknown="sway", of="u"), False),
        ((), (), said("unexplained", unknown="sway"), False),
        ((), ("t",), said("nothing_found"), False),
        (("waves",), ("t",), said("partly_explained", "waves", unknown="sway", of="t"), True),
        (("waves",), ("t",), said("partly_explained", "trim", unknown="sway", of="t"), False),
        ((), ("t",), said("unexplained", unknown="sway", of="t", contradicted=CONTRADICTED), False),
    ],
)
def test_an_answer_is_honest_if_nothing_false_is_said(honest, signals, answer, fair):
    assert is_honest(Trick("", honest, signals=signals), answer) == fair


@pytest.mark.parametrize(
    "note", [CONTRADICTED, TAKEN_FIRST, "The logged attitude comes about 0.5 s later than the velocities."]
)
def test_answers_kept_without_the_sentence_have_it_among_their_notes(note):
    kept = said("nothing_found", notes=[note])
    del kept["contradicted"]
    assert is_honest(Trick("", (BLAMED,)), kept) and not is_honest(Trick("", (NOTHING,)), kept)


def test_fresh_tricks_do_what_they_say():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 150.0, 0.1)
    columns = ("x", "y", "psi", "u", "v", "r", "port", "star", "bow")
    log = pd.DataFrame({"t": t} | {name: rng.uniform(-1.0, 1.0, len(t)) for name in columns})
    made = {name: trick.logs((log, log), rng)[0] for name, trick in fresh_tricks().items()}
    changed = {
        name: {c for c in log if len(one) != len(log) or not np.array_equal(one[c], log[c])}
        for name, one in made.items()
    }
    assert changed.pop("gap") == {"t", *columns} and changed.pop("weak at first") == set()
    assert changed == {
        "frozen": {"v"},
        "mirrored": {"v"},
        "fast clock": {"t"},
        "degrees of yaw": {"r"},
        "coarse commands": {"port", "star", "bow"},
        "turned compass": {"psi"},
        "unlogged thruster": {"bow"},
        "dropouts": {"u"},
    }
    values = {name: {c: np.asarray(one[c]) for c in log} for name, one in made.items()}
    gap, stuck = values["gap"]["t"], values["frozen"]["v"]
    assert np.diff(gap).max() == pytest.approx(40.1) and len(gap) == len(log) - 400
    assert len(np.unique(stuck[(t >= 50.0) & (t < 110.0)])) == 1
    assert len(np.unique(stuck)) == len(log) - 599
    assert set(np.unique(4 * values["coarse commands"]["port"])) == set(range(-4, 5))
    assert np.mean(values["dropouts"]["u"] == 0.0) == pytest.approx(1 / 97, rel=0.1)


@pytest.mark.parametrize(
    ("folder", "tricks"), [(adversary.HERE, fresh_tricks), (adversary.MENDED, adversary.tricks)]
)
def test_the_page_says_what_the_tricks_got(folder, tricks):
    found = json.loads((folder / "results.json").read_text())
    for name, trick in tricks().items():
        assert found[name]["fair"] == is_honest(trick, found[name]["said"])
        assert found[name]["text"] == trick.text and found[name]["honest"] == [*trick.answers]
    assert found.keys() == tricks().keys()
    assert adversary.table(found) in (ROOT / "experiments" / "README.md").read_text()


def test_a_traceback_is_no_honest_answer():
    assert not is_honest(Trick("", (NOTHING, REFUSED)), {"crashed": "LinAlgError()"})
