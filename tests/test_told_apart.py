"""The study of planned manoeuvres: how it judges a diagnosis, and a quick run."""

import json
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from experiments import told_apart
from experiments.blind.plant import Effect
from jaxmarine.diagnosis import Alternative, Finding


def found(*named: str, close: str | None = None) -> Any:
    """A diagnosis with these names, the first not told from `close`."""
    marked = () if close is None else (Alternative(close, None, 1.0, indistinguishable=True),)
    return SimpleNamespace(
        findings=tuple(Finding(name, None, None, None, {}, 20.0, marked) for name in named)
    )


@pytest.mark.parametrize(
    ("diagnosis", "expected"),
    [
        (found("input_delay"), "decides"),
        (found("input_delay", close="saturation"), "decides"),
        (found("input_delay", close="thruster_lag"), "undecided"),
        (found("thruster_lag", close="input_delay"), "undecided"),
        (found(), "undecided"),
        (found("thruster_lag"), "wrong"),
        (found("input_delay", "saturation"), "wrong"),
    ],
)
def test_a_diagnosis_decides_only_where_it_names_the_truth_and_nothing_like_it(diagnosis, expected):
    assert told_apart.outcome(diagnosis, "input_delay", "thruster_lag") == expected


def test_a_cause_in_words_is_that_of_the_independent_plant():
    assert told_apart.hidden("constant_wrench:heave value=-6") == Effect(
        "constant_wrench", "heave", {"value": -6.0}
    )


@pytest.mark.slow
def test_a_quick_run_writes_its_table_and_goes_on_where_it_was_cut(tmp_path):
    app = typer.Typer()
    app.command()(told_apart.main)
    for _ in range(2):
        ran = CliRunner().invoke(app, ["--out", str(tmp_path), "--quick"], catch_exceptions=False)
        assert ran.exit_code == 0
    (row,) = json.loads((tmp_path / "results.json").read_text())["rows"]
    planned, random = row["planned"], row["random"]
    assert planned["expected_nats"] > 10.0 * random["expected_nats"]
    assert planned["outcome"] == "decides"
    assert (tmp_path / "evidence.svg").exists()
