"""Every effect of the catalogue is hidden in a short log, where it is the first that a diagnosis would name.

The logs come from `experiments/blind`, which shares no code with the package. Whole diagnoses take ten times
as long (`test_hidden.py`, most of them slow): here is the first round, of those suspects that promise most.
"""

import functools
import tempfile
from pathlib import Path

import numpy as np
import pytest

import jaxmarine as jm
from experiments.blind import cases, vehicle
from experiments.blind.excitation import commands
from experiments.blind.plant import Effect
from jaxmarine.diagnosis._amid import refine_fully
from jaxmarine.diagnosis._explanation import Member
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.diagnosis._search import _by_penalty, _trials, probes, shortlist
from jaxmarine.effects import (
    CATALOGUE,
    CrossFlowDrag,
    LinearDamping,
    QuadraticDamping,
    SurfaceGain,
    SurfaceLag,
    SurfaceOffset,
    SurfaceRate,
    SurfaceStuck,
    ThrusterGain,
    Voltage,
    Wake,
    WindLoad,
)
from jaxmarine.examples import hidden

# Of those suspects that save most by the linearisation this many are refitted, and those that it cannot see
# where the hidden one is such.
REFITTED = 3
BOAT, ROV, TANKER = "cybership2", "tethra", "tanker"
# With one on a battery all gear is on one craft, whose programs are compiled once.
BOW = """
[[thruster]]
name = "bow"
position = [1.3, 0.0, 0.0]
direction = [0.0, 1.0, 0.0]
max_thrust = 6.0
nominal_voltage = 15.0
voltage_exponent = 1.0
"""
# As long as logs of other quick tests, so that a vehicle's programs are compiled once (an ROV's by the walk).
DURATION = {BOAT: 60.0, ROV: 60.0, TANKER: 60.0}  # [s]
# What gear may have is looked for among what comes nearest, as the whole catalogue takes three times as long.
GEAR = (
    ThrusterGain, SurfaceGain, SurfaceOffset, SurfaceStuck, SurfaceLag, SurfaceRate, Wake, Voltage,
    CrossFlowDrag, WindLoad, LinearDamping, QuadraticDamping,
)  # fmt: skip
SUSPECTED = {BOAT: CATALOGUE, ROV: CATALOGUE, TANKER: GEAR}
# On boat and ROV drawn at random; each raises the error of predictions over 5 s threefold.
HIDDEN = [
    (BOAT, Effect("added_mass", "yaw", {"value": 4.06})),
    (BOAT, Effect("constant_wrench", "yaw", {"value": -0.0272})),
    (BOAT, Effect("coupled_added_mass", "sway+yaw", {"value": 2.72})),
    (BOAT, Effect("coupled_damping", "yaw<-sway", {"value": 0.537})),
    (BOAT, Effect("deadband", None, {"width": 0.0555})),
    (BOAT, Effect("fluid_memory", "yaw", {"gain": 1.55, "time_constant": 1.04})),
    (BOAT, Effect("gyro_bias", None, {"r": 0.017})),
    (BOAT, Effect("hull_lift", None, {"Y_uv": 10.9, "N_uv": -5.79})),
    (BOAT, Effect("inflow_loss", None, {"per_speed": 0.819})),
    (BOAT, Effect("input_delay", None, {"delay": 0.4})),
    (BOAT, Effect("linear_damping", "yaw", {"value": 0.968})),
    (BOAT, Effect("payload", None, {"mass": 3.87, "x": 0.223, "y": 0.072})),
    (BOAT, Effect("quadratic_damping", "yaw", {"value": 32.6})),
    (BOAT, Effect("reverse_thrust", "all", {"factor": 0.847})),
    (BOAT, Effect("saturation", None, {"limit": 0.578})),
    (BOAT, Effect("steady_current", None, {"north": 0.0122, "east": -0.0103})),
    (BOAT, Effect("tether_drag", None, {"coefficient": 2.51})),
    (BOAT, Effect("thrust_curve", None, {"quadratic": 0.285})),
    (BOAT, Effect("thruster_gain", "all", {"factor": 0.861})),
    (BOAT, Effect("thruster_lag", None, {"time_constant": 0.399})),
    (BOAT, Effect("turning_lift", None, {"Y_ur": 5.6, "N_ur": 3.98})),
    (BOAT, Effect("velocity_in_earth_axes", None, {"fraction": 0.149})),
    (BOAT, Effect("velocity_lever_arm", None, {"x": 0.25, "y": -0.245})),
    (BOAT, Effect("velocity_misalignment", None, {"yaw": 0.0846})),
    (BOAT, Effect("velocity_scale", None, {"factor": 1.08})),
    (BOAT, Effect("waves", None, {"north": -0.137, "east": 0.257, "period": 7.94, "phase": 0.403})),
    (BOAT, Effect("wind_push", None, {"north": 0.0557, "east": 0.104})),
    (ROV, Effect("buoyancy", None, {"force": -8.4})),
    (ROV, Effect("trim", None, {"x": 0.00376, "y": -0.00709, "z": -0.0072})),
    (TANKER, Effect("cross_flow_drag", None, {"coefficient": 2.08})),
    (TANKER, Effect("surface_gain", "rudder", {"factor": 0.6})),
    (TANKER, Effect("surface_offset", "rudder", {"angle": 0.1})),
    (TANKER, Effect("surface_stuck", "rudder", {"angle": -0.2})),
    (TANKER, Effect("wake", "shaft", {"fraction": 0.4})),
    (TANKER, Effect("wind", None, {"surge": -5.0, "sway": -6.0, "yaw": 0.8})),
    (TANKER, Effect("voltage", None, {"exponent": 1.5})),
]
# What the independent plant has not, simulated by the package.
OWN = [
    (TANKER, Effect("surface_lag", None, {"time_constant": 1.0})),
    (TANKER, Effect("surface_rate", None, {"limit": 0.1})),
]
# What is looked at before anything is fitted has tests of its own (`test_gross.py`).
GROSS = {"compass_deviation", "exchanged_thrusters", "sensor_delay"}


@functools.cache
def read(ship: str) -> tuple[vehicle.Vehicle, jm.Vehicle]:
    """A craft as the plant and as the package has it."""
    known = vehicle.GEARED / f"{ship}.toml"
    text = (known if known.exists() else cases.FOLDER / f"{ship}.toml").read_text()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{ship}.toml"
        path.write_text(f"{text}{BOW if ship == TANKER else ''}")
        return vehicle.load(path), jm.load_vehicle(path)


def recorded(ship: str, effect: Effect, seed: int, path: Path) -> jm.Log:
    """A log of the craft with an effect that its file does not have."""
    rng = np.random.default_rng(seed)
    truth, craft = read(ship)
    steered = commands(truth, round(DURATION[ship] / cases.DT), rng, "rich").round(6)
    run = cases.roll_out(truth, [effect], steered, float(rng.uniform(-np.pi, np.pi)))
    path.write_text(cases.table(truth, run, truth.noise, rng), encoding="utf-8")
    return jm.read_log(path, craft)


@pytest.mark.parametrize(
    ("seed", "ship", "effect"),
    [pytest.param(i, *one, id=f"{one[0]} {one[1].effect}") for i, one in enumerate(HIDDEN)],
)
def test_every_effect_is_the_first_to_be_named(seed, ship, effect, tmp_path):
    named_first(ship, effect, recorded(ship, effect, seed, tmp_path / "train.csv"))


@pytest.mark.parametrize(("ship", "effect"), [pytest.param(*one, id=one[1].effect) for one in OWN])
def test_every_effect_of_the_package_alone_is_too(ship, effect):
    # The second log, which is not used, is as long: it takes no program of its own.
    lengths = (DURATION[ship], DURATION[ship])
    log, _ = hidden(read(ship)[1], effect.effect, effect.target, effect.parameters, lengths)
    named_first(ship, effect, log)


def test_these_are_all_effects_of_the_catalogue():
    assert {effect.effect for _, effect in (*HIDDEN, *OWN)} | GROSS == {cls.name for cls in CATALOGUE}


def named_first(ship: str, effect: Effect, log: jm.Log) -> None:
    """Whether of the most promising suspects the hidden one explains most, by numbers within their errors."""
    bench = workbench(read(ship)[1], (log,), SUSPECTED[ship], None)
    suspects = bench.layout.suspects
    label = effect.effect if effect.target is None else f"{effect.effect}:{effect.target}"
    true = Member([one.label for one in suspects].index(label))
    model = refine_fully(bench, bench.start())
    ranked, _ = shortlist(bench, model, bench.screen(model))
    begun = [(one, None) for one in ranked if one.since is None][:REFITTED]
    if suspects[true.suspect].starts or suspects[true.suspect].effect.swings:
        begun += probes(bench, model, max(ranked.values()))
    best = _by_penalty(bench, _trials(bench, model, begun))[0]
    assert best.member == true, suspects[best.member.suspect].label
    known, precision, _ = bench.known(best.model)
    information = known.T @ bench.screen(best.model).h.sum(0) @ known + np.diag(precision)
    std = np.sqrt(np.diag(np.linalg.inv(information)))[bench.slices(best.model.members)[-1]]
    for (name, value), error in zip(best.parameters(bench).items(), std, strict=True):
        assert value == pytest.approx(effect.parameters[name], abs=4 * error), (name, value, error)
    # Which number of several a short log leaves open depends on the log, but not all of them.
    true_values = np.array([effect.parameters[name] for name in best.parameters(bench)])
    assert (std / np.abs(true_values)).min() < 0.5
