"""The independent plant's propellers, surfaces, azimuths and wind against the package's."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from experiments.blind import cases, catalogue, excitation, plant
from experiments.blind.vehicle import GEARED, Vehicle, load
from jaxmarine.vehicle import Input
from tests.crafts import placed, unwrapped

CRAFT = ("tanker", "torpedo", "azimuth")
# What changes forces, at a size that shows.
EFFECTS = [
    ("tanker", plant.Effect("surface_gain", "rudder", {"factor": 0.6})),
    ("tanker", plant.Effect("surface_offset", "rudder", {"angle": 0.1})),
    ("tanker", plant.Effect("surface_stuck", "rudder", {"angle": -0.2})),
    ("tanker", plant.Effect("wake", "shaft", {"fraction": 0.2})),
    ("tanker", plant.Effect("thruster_gain", "shaft", {"factor": 0.7})),
    ("tanker", plant.Effect("cross_flow_drag", None, {"coefficient": 0.5})),
    ("tanker", plant.Effect("turning_lift", None, {"Y_ur": 20.0, "N_ur": 30.0})),
    ("tanker", plant.Effect("wind", None, {"surge": -0.3, "sway": 0.2, "yaw": 0.05})),
    ("azimuth", plant.Effect("wind_push", None, {"north": 5.0, "east": -3.0})),
    ("azimuth", plant.Effect("voltage", None, {"exponent": 0.8})),
    ("torpedo", plant.Effect("surface_stuck", "plane_star", {"angle": 0.1})),
]


@functools.cache
def both(name: str) -> tuple[jm.Vehicle, Vehicle]:
    """One file, read by the package and by code that shares nothing with it."""
    return jm.load_vehicle(GEARED / f"{name}.toml"), load(name)


def accelerations(name: str, effects: list[plant.Effect], seed: int, ahead: bool) -> tuple:
    """Of the package and of the plant, in one state and under one set of columns drawn at random."""
    vehicle, blind = both(name)
    for effect in effects:
        vehicle = vehicle.place(placed(vehicle, effect))
    rng = np.random.default_rng(seed)
    free = np.isin(np.arange(6), blind.free)
    way = 1.0 if ahead else -0.5
    nu = free * (blind.cruise * np.array([way, 0, 0, 0, 0, 0]) + 0.1 * rng.normal(size=6))
    tilt = free[3:] * 0.2 * rng.normal(size=3)
    demand = rng.uniform(-0.4, 0.4, (1, len(blind.steered))) - 1.0 * (not ahead)
    commands = blind.asked(demand, excitation.surroundings(blind, 2, rng)[1:])[0]
    model = plant.Model(blind, effects)
    state = np.concatenate([np.zeros(3), tilt, nu, [0.0]])[:, None]
    found = model.derivative(0.0, state, model.drive(commands[:, None]), 0.0)[6:12, 0]
    order = [blind.columns.index(column) for column in vehicle.drive_names]
    acts = Input(
        jnp.asarray(model.drive(commands[:, None])[order, 0]),
        jnp.asarray(commands[order]),
        jnp.zeros(6),
        jnp.zeros(()),
    )
    at = jm.initial_state(vehicle, attitude=tilt, velocity=nu)
    return np.asarray(jm.forward_dynamics(vehicle, at, acts)), found


@pytest.mark.parametrize("ahead", [True, False])
@pytest.mark.parametrize("name", CRAFT)
def test_forces_are_those_of_the_package(name, ahead):
    ours, theirs = accelerations(name, [], 1, ahead)
    assert np.abs(theirs).max() > 1e-3
    # The package's strips are eight points of Gauss, its roots are smooth below 1 mm/s.
    np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4 * np.abs(theirs).max())


@pytest.mark.parametrize("name, effect", EFFECTS, ids=lambda x: getattr(x, "effect", x))
def test_effects_are_those_of_the_package(name, effect):
    with_it, without = accelerations(name, [effect], 2, True), accelerations(name, [], 2, True)
    ours, theirs = (after - before for after, before in zip(with_it, without, strict=True))
    assert np.abs(theirs).max() > 1e-5
    np.testing.assert_allclose(ours, theirs, atol=2e-3 * np.abs(theirs).max())


def test_a_run_is_that_of_the_package():
    """A rudder that turns at a limited rate, wind, a shaft that is reversed, over half a minute."""
    vehicle, blind = both("tanker")
    rng = np.random.default_rng(0)
    commands = excitation.commands(blind, 300, rng)
    commands[200:, 0] = -8.0
    order = [blind.columns.index(column) for column in vehicle.command_names]
    nu = np.array([blind.cruise, 0.05, 0, 0, 0, 0.03])
    start = np.zeros((13, 1))
    start[6:12, 0] = nu
    model = plant.Model(blind)
    first = model.drive(commands[:1, :, None])[0]
    run = plant.simulate([(0, model)], commands[:, :, None], start, 300, thrust=first)
    t = 0.1 * np.arange(300)
    log = jm.Log(t, np.full((300, 18), np.nan), commands[:, order], None, vehicle.command_names, "run.csv")
    ours = np.asarray(jm.simulate(vehicle, log, jm.initial_state(vehicle, velocity=nu)).channels)
    error = unwrapped(ours - run.signals()[:, :, 0])
    # The package holds the mean and the slope of a deflection over a sample: a few parts in a million.
    assert np.abs(error[:, 6:12]).max() < 5e-5 and np.abs(error[:, :6]).max() < 1e-3
    assert np.ptp(run.states[:, 5]) > 0.3 and run.states[:, 6].min() < 0.8 * blind.cruise


def test_wind_waves_and_water_go_on_between_samples():
    """As the package has them on a log that is four times as fine."""
    vehicle, blind = both("azimuth")
    coarse, fine = 0.1 * np.arange(60), 0.025 * np.arange(237)
    order = [blind.columns.index(column) for column in vehicle.command_names]
    still = np.zeros((len(coarse), len(blind.columns)))

    def swinging(t: np.ndarray, size: list[float], period: float) -> np.ndarray:
        return np.sin(2 * np.pi * t / period)[:, None] * size

    def all_at(t: np.ndarray) -> list[np.ndarray]:
        wrench = swinging(t, [0.0, 3.0, 0.0, 0.0, 0.0, 2.0], 1.3)
        return [wrench, swinging(t, [8.0, -5.0, 0.0], 2.0), swinging(t, [0.1, 0.2, 0.0], 3.0)]

    sampled = [one[:, :, None] for one in all_at(coarse)]
    start = np.zeros((13, 1))
    start[5] = 0.5
    model = plant.Model(blind, afloat=True)
    run = plant.simulate(
        [(0, model)], still[:, :, None], start, len(coarse), disturbance=plant.Disturbance(*sampled)
    )
    push, drift, water = (
        np.stack([np.interp(fine, coarse, column) for column in one.T], axis=1) for one in all_at(coarse)
    )
    log = jm.Log(
        fine, np.full((len(fine), 18), np.nan), still[:1, order].repeat(len(fine), 0), None,
        vehicle.command_names, "run.csv",
    )  # fmt: skip
    begin = jm.initial_state(vehicle, attitude=(0.0, 0.0, 0.5))
    ours = np.asarray(jm.simulate(vehicle, log, begin, push=push, drift=drift, water=water).channels)[::4]
    error = unwrapped(ours - run.signals()[:, :, 0])
    # A mean over 25 ms in the place of a line: an eighth of what a push changes in that time, at most.
    assert np.abs(error[:, 6:12]).max() < 2e-3 * np.abs(ours[:, 6:12]).max()


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "torpedo" else []) for name in CRAFT]
)
def test_pilots_keep_a_heading_and_hidden_effects_are_drawn(name):
    _, blind = both(name)
    rng = np.random.default_rng(3)
    log = cases.regulated(blind, [], "pilot", 100, rng, 1.0)
    assert log.commands.shape == (100, len(blind.columns)) and np.ptp(log.commands[:, 1]) > 0.0
    size = cases.typical(blind, "rich")
    for effect in catalogue.names(blind):
        drawn = catalogue.draw(effect, blind, size, rng)
        built = drawn.build(drawn.guess)
        assert isinstance(built, plant.Effect)
        plant.Model(blind, [built])


def test_a_share_of_the_logs_is_of_such_craft():
    plan = cases.Plan(4, 0, 0, 0, 0, 30.0, 15.0, geared=0.5)
    designer = cases.Designer(plan, ("otter",), 1)
    assert [cases.turn(number // 2, 0.5) for number in range(4)] == [False, False, True, True]
    assert set(designer.fleet) == {"otter", *CRAFT}
    assert set(cases.Designer(cases.Plan(1, 0, 0, 0, 0, 30.0, 15.0), ("otter",), 1).fleet) == {"otter"}
