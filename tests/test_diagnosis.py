"""The whole diagnosis, on data of a simulator that shares no code with the package.

The simulator is `experiments/blind`: its own equations, integrator, effects, commands and noise.
"""

import functools
import json
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxmarine as jm
from experiments.blind.cases import make_case
from experiments.blind.plant import Effect
from jaxmarine.diagnosis._answer import _stated, alternatives
from jaxmarine.diagnosis._explanation import Member, Model
from jaxmarine.diagnosis._saturated import Layout
from jaxmarine.diagnosis._search import Round, Trial
from jaxmarine.diagnosis._workbench import Workbench
from jaxmarine.effects import Suspect, Waves
from jaxmarine.vehicle_io import cause_named

# Logs of quick and of slow tests [s], as long as those of others: a vehicle is compiled once.
SHORT, TRAIN, TEST = 60.0, 120.0, 60.0

WEAK = Effect("thruster_gain", "port", {"factor": 0.8})
ROV_WEAK = Effect("thruster_gain", "port_h", {"factor": 0.8})
CURRENT = Effect("steady_current", None, {"north": 0.05, "east": -0.03})
LATE = Effect("thruster_gain", "star_v", {"factor": 0.7}, since=60.0)
DELAY = Effect("input_delay", None, {"delay": 0.25})
SCALE = Effect("velocity_scale", None, {"factor": 1.08})
DRAG = Effect("quadratic_damping", "sway", {"value": 150.0})

# On three axes, which takes a third of six; an ROV's is found by the walk (`test_walk.py`) each time.
QUICK = {"weak thruster": ("cybership2", WEAK)}
SLOW = {
    "weak thruster of an ROV": ("tethra", ROV_WEAK),
    "current": ("cybership2", CURRENT),
    "late": ("tethra", LATE),
    "delay": ("tethra", DELAY),
    "scale": ("cybership2", SCALE),
    "drag": ("cybership2", DRAG),
}
CASES = QUICK | SLOW
HIDDEN = [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]


@functools.cache
def diagnosed(case: str) -> tuple[dict, jm.Diagnosis, jm.Log]:
    """What the plant says of a case (`answer.json`), its diagnosis, and its test log."""
    vehicle, effect = CASES[case]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        length = SHORT if case in QUICK else TRAIN
        answer = make_case(folder, vehicle, [effect], 7, duration_train=length, duration_test=TEST)
        craft = jm.load_vehicle(folder / "vehicle.toml")
        train, test = (jm.read_log(folder / f"{part}.csv", craft) for part in ("train", "test"))
    return answer, jm.diagnose(craft, train, test), test


@pytest.mark.parametrize("case", HIDDEN)
def test_what_is_hidden_is_named_with_its_size(case):
    _, effect = CASES[case]
    _, diagnosis, _ = diagnosed(case)
    assert diagnosis.verdict == "explained"
    (finding,) = diagnosis.findings
    assert (finding.effect, finding.target) == (effect.effect, effect.target)
    assert set(finding.parameters) == set(effect.parameters)
    for name, value in effect.parameters.items():
        found = finding.parameters[name]
        assert 0.0 < found.std < 0.1 * abs(value), name
        assert abs(found.value - value) < 3 * found.std, name
    if effect.since is None:
        assert finding.since is None
    else:
        assert finding.since == pytest.approx(effect.since, abs=0.5)
        assert finding.since_log == "train.csv"
    assert finding.log_evidence > 100.0
    assert all(other.log_evidence < finding.log_evidence for other in finding.alternatives)


@pytest.mark.parametrize("case", HIDDEN)
def test_the_gain_is_what_the_cause_did_to_predictions(case):
    """`severity` is the factor by which the cause raises the plant's own 5 s prediction errors.

    The plant predicts from true start states; the diagnosis estimates them, before as after, and so
    finds about the same factor, not the very same.
    """
    answer, diagnosis, _ = diagnosed(case)
    severity = answer["options"]["severity"]
    assert severity > 1.5, "the cause really hurts"
    gain = diagnosis.gain
    assert 0.5 < gain.ratio * severity < 1.5
    low, high = gain.ratio_ci95
    assert low <= gain.ratio <= high < 0.9
    assert gain.held_out
    for pair in (gain.position, gain.velocity):
        assert pair is not None and pair.after <= pair.before
    # What is left is sensor noise.
    assert diagnosis.white and not diagnosis.depends_on
    assert diagnosis.misfit_before > 1.5
    assert diagnosis.misfit_after == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("case", QUICK)
def test_the_extended_vehicle_loads_again_and_simulates_the_same(case, tmp_path):
    _, diagnosis, test = diagnosed(case)
    jm.save_vehicle(diagnosis.extended, tmp_path / "extended.toml")
    again = jm.load_vehicle(tmp_path / "extended.toml")
    start = jm.initial_state(again)
    first = jm.simulate(diagnosis.extended, test, start).channels
    assert jnp.array_equal(jm.simulate(again, test, start).channels, first)
    # It is another vehicle than before, by more than any noise.
    before = jm.simulate(diagnosis.vehicle, test, start).channels
    assert jnp.max(jnp.abs(before - first)) > 0.5


def test_alternatives_are_those_of_the_round_that_was_won():
    """A suspect that was weighed earlier too, and whose rival then is a finding itself by now."""
    labels = ("a", "b", "c")
    suspects = [SimpleNamespace(effect=SimpleNamespace(name=name), target=None) for name in labels]
    bench: Any = object.__new__(Workbench)
    bench.criteria = jm.Criteria()
    bench.layout = SimpleNamespace(suspects=suspects, columns=[np.zeros((3, 1))] * 3)
    bench.samples = 1000
    model = Model((), np.zeros(0), jnp.zeros((0, 12)), 0.0)
    a, b, c = (Member(i) for i in range(3))
    rounds = (
        Round((Trial(a, model, 9000.0), Trial(b, model, 3000.0), Trial(c, model, 10.0)), True, 1.0),
        Round((Trial(b, model, 2500.0), Trial(c, model, 2499.0), Trial(a, model, 5.0)), True, 1.0),
    )
    (other,) = alternatives(bench, b, {0, 1}, 1.0, rounds, 1200.0)
    assert (other.effect, other.indistinguishable) == ("c", True)
    assert other.log_evidence == pytest.approx(1199.5)


@given(phase=st.floats(-20.0, 20.0))
def test_a_phase_is_stated_within_half_a_turn_and_the_force_is_the_same(phase):
    """Against the force itself, at times within a period of 5 s."""
    slots = {name: (i,) for i, name in enumerate(Waves.units)}
    bench: Any = object.__new__(Workbench)
    bench.layout = Layout(np.array([0.0, 0.0, 5.0, 0.0]), (Suspect(Waves, None, slots),), (np.eye(4),))
    told = _stated(bench, Member(0), np.array([2.0, -3.0, 0.0, phase]))
    assert -np.pi / 2 < told["phase"] <= np.pi / 2
    t = np.linspace(0.0, 5.0, 7)
    for name, size in (("north", 2.0), ("east", -3.0)):
        force = told[name] * np.sin(2 * np.pi * t / 5.0 + told["phase"])
        # Rounding of an angle of some turns.
        np.testing.assert_allclose(force, size * np.sin(2 * np.pi * t / 5.0 + phase), atol=1e-13)


def test_the_causes_of_a_group_can_be_given_to_a_plan():
    _, diagnosis, _ = diagnosed("weak thruster")
    (finding,), rival = diagnosis.findings, diagnosis.rounds[0][1]
    own, other = (
        cause_named(diagnosis.vehicle, words) for words in diagnosis.causes_of((finding.label, rival.label))
    )
    factor = own.effect.parameters()["factor"][diagnosis.vehicle.thruster_names.index("port")]
    assert float(factor) == pytest.approx(finding.parameters["factor"].value, rel=1e-3)
    assert other.effect.name == rival.label.partition(":")[0]


def test_the_answer_is_strict_json_with_the_contracts_keys(tmp_path):
    _, diagnosis, _ = diagnosed("weak thruster")
    page = jm.write_report(diagnosis, tmp_path)
    assert page == tmp_path / "index.html" and page.stat().st_size > 10_000

    def refuse(constant: str):
        raise AssertionError(f"{constant} is no JSON")

    answer = json.loads((tmp_path / "diagnosis.json").read_text(), parse_constant=refuse)
    assert {"schema", "verdict", "findings", "gain", "residual_after"} <= set(answer)
    assert answer["schema"] == 1 and answer["verdict"] == "explained"
    (finding,) = answer["findings"]
    assert {"effect", "target", "since", "parameters", "log_evidence", "alternatives"} <= set(finding)
    assert (finding["effect"], finding["target"], finding["since"]) == ("thruster_gain", "port", None)
    assert set(finding["parameters"]["factor"]) == {"value", "std", "unit"}
    assert finding["parameters"]["factor"]["unit"] == "1"
    for other in finding["alternatives"]:
        assert set(other) == {"effect", "target", "log_evidence", "indistinguishable"}
    assert sum(other["indistinguishable"] for other in finding["alternatives"]) <= 2
    gain = answer["gain"]
    assert gain["horizon_s"] == 5.0
    for key in ("position_rmse_m", "velocity_rmse_m_s"):
        assert set(gain[key]) >= {"before", "after"}
    low, high = gain["ratio_ci95"]
    assert low <= gain["ratio"] <= high
    assert np.isfinite(gain["ratio"])
    assert answer["residual_after"] == {"white": True, "depends_on": []}
    excitation = {axis["dof"]: axis for axis in answer["excitation"]}
    assert tuple(excitation) == diagnosis.vehicle.dof
    assert excitation["surge"]["excited"] == "yes" and excitation["surge"]["relative_std"]["inertia"] < 0.02
