"""The study of planned manoeuvres: how it draws and judges, and a quick run."""

import dataclasses
import json
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import typer
from statsmodels.stats.contingency_tables import mcnemar
from typer.testing import CliRunner

import jaxmarine as jm
from experiments import _study, told_apart
from experiments.blind import excitation
from experiments.blind.plant import Effect
from experiments.blind.vehicle import load
from jaxmarine.diagnosis import Alternative, Finding
from jaxmarine.diagnosis._plan import _Causes
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.effects import CATALOGUE


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


CORNERS = (12, 3)


class Free(_Causes):
    """What a random manoeuvre asks of a problem, for a craft that goes as it is commanded.

    Its speed [m/s] and place [m] along each command, in a box of 1 m/s and 8 m.
    """

    def __init__(self):
        for field in dataclasses.fields(_Causes):
            setattr(self, field.name, None)

    def commands(self, corners):
        t = jnp.linspace(0.0, len(corners), 120)
        whole = jnp.concatenate([jnp.zeros((1, corners.shape[1])), jnp.tanh(corners)])
        return jax.vmap(lambda y: jnp.interp(t, jnp.arange(len(y)), y), in_axes=1, out_axes=1)(whole)

    def flown(self, commands):
        return commands, None

    def sizes(self, speed):
        away = jnp.cumsum(speed, axis=0) * 0.2 / 8.0
        return jnp.stack([(speed**2).sum(-1), (away**2).sum(-1)], axis=-1)[None]


def test_a_random_manoeuvre_is_as_strong_as_it_is_to_be_and_in_the_box(monkeypatch):
    def flown(problem, corners):
        size = float(problem.sizes(problem.commands(corners)).max())
        return SimpleNamespace(corners=corners, apart=0.0, safe=size <= 1.0)

    monkeypatch.setattr(told_apart, "_Flown", SimpleNamespace(of=flown))
    problem, rms = Free(), 0.45
    made = [told_apart.as_strong(problem, rms, CORNERS, [seed]) for seed in (0, 1)]
    for one in made:
        assert one.safe
        commands = np.asarray(problem.commands(one.corners))
        assert np.sqrt((commands**2).mean()) == pytest.approx(rms, rel=1e-9)
    assert not np.allclose(made[0].corners, made[1].corners), "random"


def test_commands_cannot_be_stronger_than_their_limits():
    problem = Free()
    assert told_apart.of_strength(problem, jnp.ones(CORNERS), 1.1) is None


def test_a_claim_is_decided_by_the_cases_on_which_two_ways_differ():
    pairs = {
        "clear": ([True] * 9 + [False], [False] * 8 + [True, False]),
        "alike": ([True, False] * 5, [True, False] * 5),
        "few": ([True] * 3 + [False] * 7, [False] * 10),
    }
    clear, alike, few = _study.discordant(pairs)
    assert (clear["won"], clear["lost"], clear["verdict"]) == (8, 0, "holds")
    # Two-sided, 8 of 8 by a coin.
    assert clear["p"] == pytest.approx(2 * 0.5**8)
    assert clear["p_holm"] == pytest.approx(3 * clear["p"])
    assert (alike["p"], alike["verdict"]) == (1.0, "undecided")
    assert few["p"] == pytest.approx(0.25) and few["verdict"] == "undecided"
    table = [[1, 8], [0, 1]]
    assert clear["p"] == pytest.approx(mcnemar(table, exact=True).pvalue)


def test_the_page_has_the_numbers_of_the_kept_run():
    kept = json.loads((told_apart.HERE / "results.json").read_text())
    page = (told_apart.HERE.parent / "README.md").read_text()
    found = told_apart.summary(kept["rows"])
    assert found == kept["draws"]
    assert told_apart.table(found, kept["rows"]).strip() in page
    lines, kinds = " ".join(page.split()), told_apart.KINDS
    assert f"is drawn again: here {['never', 'once', 'twice'][found['undrawn']]}." in lines
    seconds = [
        r["draw_cpu_s"] + r["plan_cpu_s"] + sum(r[kind]["cpu_s"] for kind in kinds) for r in kept["rows"]
    ]
    assert f"({np.median(seconds):.0f} s of one core for a draw, in the median;" in lines
    low, high = told_apart.SEVERITY
    assert f"of a severity between {low:g} and {high:g} (" in lines
    assert f"in a box ({told_apart.BOX.speed:g} m/s, {told_apart.BOX.radius:g} m)" in lines
    right = sum(found[kind]["decides"] for kind in kinds)
    assert f"{right} of {len(kinds) * found['of']} manoeuvres name the right one of two" in lines
    assert [one["dives"] for one in found["nats"] if "found" in one["claim"]] == [2, 4]
    for row in kept["rows"]:
        assert row["random"]["command_rms"] == pytest.approx(row["planned"]["command_rms"], rel=1e-6)


@pytest.mark.slow
def test_the_rival_of_a_late_command_is_a_lag(tmp_path):
    craft = jm.load_vehicle(told_apart.cases.FOLDER / f"{told_apart.SHIP}.toml")
    commands = excitation.commands(load(told_apart.SHIP), 240, np.random.default_rng(0))
    late = Effect("input_delay", None, {"delay": 0.3})
    log = told_apart.recorded(late, commands, tmp_path / "first.csv", [0])
    bench = workbench(craft, (log,), CATALOGUE, None)
    true = [s.label for s in bench.layout.suspects].index("input_delay")
    rival, left = told_apart.imitation(bench, true)
    assert rival.effect.name == "thruster_lag"
    assert float(rival.effect.time_constant) == pytest.approx(0.3, abs=0.1)
    assert left > 0.0


@pytest.mark.slow
def test_a_quick_run_writes_its_table_and_goes_on_where_it_was_cut(tmp_path):
    app = typer.Typer()
    app.command()(told_apart.main)
    for _ in range(2):
        ran = CliRunner().invoke(app, ["--out", str(tmp_path), "--quick"], catch_exceptions=False)
        assert ran.exit_code == 0
    (row,) = json.loads((tmp_path / "results.json").read_text())["rows"]
    planned, random = row["planned"], row["random"]
    assert planned["expected_nats"] > random["expected_nats"]
    assert planned["command_rms"] == pytest.approx(random["command_rms"], rel=1e-6)
    assert (tmp_path / "evidence.svg").exists()
