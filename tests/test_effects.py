"""Every effect: neutral value, derivative, the independent plant's equation, files."""

import dataclasses
import functools

import hypothesis
import hypothesis.strategies as st
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.blind import catalogue as blind_catalogue
from experiments.blind import plant as blind
from jaxmarine.actuators import Wind
from jaxmarine.actuators._wind import WindTable
from jaxmarine.effects import (
    CATALOGUE,
    ActuatorEffect,
    FluidMemory,
    HullLift,
    Motion,
    SensorEffect,
    TurningLift,
    WindPush,
    WrenchEffect,
    place,
)
from jaxmarine.networks import LearnedWrench, learned_wrench
from jaxmarine.physics import late
from jaxmarine.simulation import gates, initial_state, inputs, simulate
from jaxmarine.vehicle import Input, Placed, Vehicle
from jaxmarine.vehicle_io import load_vehicle, save_vehicle, suspect_named
from tests.crafts import (
    independent,
    independent_run,
    log_of,
    packaged,
    placed,
    random_commands,
    random_start,
    unwrapped,
)

VEHICLES = ("tethra", "cybership2")  # six degrees of freedom, and three
PAIRS = [(cls, name) for name in VEHICLES for cls in CATALOGUE]
ACCUSED = [(cls, name) for cls, name in PAIRS if cls.suspects(packaged(name))]


def labels(pairs):
    return [f"{cls.name}-{name}" for cls, name in pairs]


every_pair = pytest.mark.parametrize(("cls", "name"), PAIRS, ids=labels(PAIRS))
every_accusation = pytest.mark.parametrize(("cls", "name"), ACCUSED, ids=labels(ACCUSED))


# --- what each says of itself -----------------------------------------------------------------


@pytest.mark.parametrize("cls", CATALOGUE, ids=lambda cls: cls.name)
def test_every_effect_says_what_it_is(cls):
    assert "Source" in cls.__doc__ and "Neutral" in cls.__doc__
    assert set(cls.units) == {field.name for field in dataclasses.fields(cls)}
    assert all(cls.units.values())
    assert cls.advice and cls.shown_by and cls.confused_with
    names = {other.name for other in CATALOGUE} | {"unknown"}
    for label in cls.confused_with:
        other, _, target = label.partition(":")
        assert other in names and other != cls.name
        known = {s.label for c in CATALOGUE for s in c.suspects(packaged("tethra"))}
        assert not target or label in known


def test_names_are_unique_and_every_vehicle_has_its_suspects():
    assert len({cls.name for cls in CATALOGUE}) == len(CATALOGUE)
    missing = {cls.name for cls, name in PAIRS} - {cls.name for cls, name in ACCUSED}
    of_actuators = {cls.name for cls in CATALOGUE if issubclass(cls, ActuatorEffect)}
    assert missing == of_actuators - {"thruster_gain", "thruster_lag", "input_delay"}
    assert {cls.name for cls in CATALOGUE if not cls.suspects(packaged("cybership2"))} - missing == {
        "buoyancy",
        "trim",
    }


@every_accusation
def test_suspects_fill_the_parameters_that_they_name(cls, name):
    vehicle = packaged(name)
    neutral, _ = jax.flatten_util.ravel_pytree(cls.neutral(vehicle))
    seen = set()
    for suspect in cls.suspects(vehicle):
        assert suspect.effect is cls and suspect.label not in seen
        seen.add(suspect.label)
        assert set(suspect.slots) <= set(cls.units)
        values = {name: 0.25 + i for i, name in enumerate(suspect.slots)}
        effect = place(suspect, vehicle, values)
        changed = np.flatnonzero(jax.flatten_util.ravel_pytree(effect)[0] != neutral)
        assert sorted(changed) == sorted(i for slots in suspect.slots.values() for i in slots)
        offsets = np.cumsum([0, *(np.size(v) for v in cls.neutral(vehicle).parameters().values())])
        for field, slots in suspect.slots.items():
            own = list(cls.units).index(field)
            assert all(offsets[own] <= i < offsets[own + 1] for i in slots)
        for start in suspect.starts:
            assert set(start) <= set(suspect.slots)


# --- neutral values ---------------------------------------------------------------------------


@every_pair
def test_the_neutral_value_changes_nothing(cls, name):
    vehicle = packaged(name)
    effect = cls.neutral(vehicle)
    plain, plant = vehicle.plant(), vehicle.plant(extra=[effect])
    for part in ("load", "drive", "water", "inverse_mass", "damping", "allocation"):
        same = jax.tree.map(
            lambda a, b: np.allclose(a, b, rtol=1e-15, atol=0),
            getattr(plain, part),
            getattr(dataclasses.replace(plant, drive=_clipped(plant.drive)), part),
        )
        assert all(jax.tree.leaves(same)), part
    rng = np.random.default_rng(0)
    start, _ = random_start(vehicle, 1)
    start = dataclasses.replace(start, memory=jnp.asarray(rng.normal(size=6)))
    count = len(vehicle.thruster_names)
    drive = Input(jnp.ones(count), jnp.ones(count), jnp.zeros(6), jnp.asarray(1.3))
    if isinstance(effect, WrenchEffect):
        assert np.array_equal(effect(plant._motion(start, drive)), np.zeros(6))
    if isinstance(effect, SensorEffect):
        nu_dot = jnp.asarray(rng.normal(size=6))
        shown, plainly = plant.readings(start, nu_dot), plain.readings(start, nu_dot)
        assert np.allclose(shown, plainly, rtol=1e-15, atol=0)


def _clipped(drive):
    """No command reaches beyond 1 here, so that a wider saturation is the same."""
    return dataclasses.replace(drive, saturation=jnp.minimum(drive.saturation, 1.0))


# --- derivatives ------------------------------------------------------------------------------

TIMES = np.arange(40) * 0.1


@functools.cache
def slopes(name: str):
    """Thrusts and readings of a vehicle with the whole catalogue off its neutral value, their
    derivatives with respect to all parameters, and the same by central differences."""
    vehicle = packaged(name)
    families = tuple(cls.neutral(vehicle) for cls in CATALOGUE)
    neutral, unravel = jax.flatten_util.ravel_pytree(families)
    rng = np.random.default_rng(2)
    theta = np.asarray(neutral) + 0.2 * rng.uniform(0.2, 1.0, neutral.shape)
    theta[np.asarray(neutral) == 10.0] = 0.6  # a saturation that some commands meet
    commands = jnp.asarray(random_commands(vehicle, len(TIMES), 3, seed=3))
    start, _ = random_start(vehicle, 4, speed=1.0)
    start = dataclasses.replace(start, memory=jnp.asarray(rng.normal(size=6)))
    track = jnp.asarray(rng.normal(size=(6, 18)))

    @jax.jit
    def shown(theta):
        plant = vehicle.plant(extra=unravel(theta))
        over, at = inputs(plant, jnp.asarray(TIMES), commands, jnp.zeros((len(TIMES), 6)))
        now = jax.tree.map(lambda a: a[17], at)
        readings = plant.readings(start, plant.acceleration(start, now))
        rates = plant.rates(start, now).memory
        before = late(jnp.asarray(TIMES[:6]), track, jnp.tile(jnp.asarray(plant.delay), (6, 1)))
        return jnp.concatenate([over.thrust.ravel(), at.thrust.ravel(), readings, rates, before.ravel()])

    exact = np.asarray(jax.jit(jax.jacfwd(shown))(jnp.asarray(theta)))
    step = 1e-6
    between = [
        np.asarray(shown(jnp.asarray(theta + e)) - shown(jnp.asarray(theta - e))) / (2 * step)
        for e in step * np.eye(len(theta))
    ]
    sizes = [sum(np.size(leaf) for leaf in jax.tree.leaves(family)) for family in families]
    own = np.split(np.arange(len(theta)), np.cumsum(sizes)[:-1])
    columns = dict(zip(CATALOGUE, own, strict=True))
    return exact, np.array(between).T, columns


@every_pair
def test_derivatives_are_those_of_finite_differences(cls, name):
    exact, between, columns = slopes(name)
    mine = columns[cls]
    scale = np.abs(exact).max(axis=0)[mine]
    used = [i for s in cls.suspects(packaged(name)) for slots in s.slots.values() for i in slots]
    assert (scale[used] > 0).all()  # whatever can be accused is felt
    # Rounding of some 100 N over a step of 2e-6, and the curvature times its square.
    assert np.abs(exact - between)[:, mine].max(initial=0.0) < 1e-5 * max(1.0, scale.max(initial=0.0))


# --- lift ahead and astern --------------------------------------------------------------------


def test_lift_opposes_drift_and_turns_ahead_and_astern():
    zero, one = jnp.zeros(()), jnp.ones(())
    hull = HullLift(2.0 * one, 3.0 * one, 5.0 * one, 7.0 * one)
    turning = TurningLift(2.0 * one, 3.0 * one)
    v, w, r = 0.3, -0.2, 0.4
    for u in (0.5, -0.5):
        nu = jnp.array([u, v, w, 0.1, 0.2, r])
        none, turn, six = jnp.zeros(3), jnp.eye(3), jnp.zeros(6)
        motion = Motion(none, turn, nu, nu, six, zero, none)
        np.testing.assert_allclose(hull(motion), [0, -2 * 0.5 * v, -5 * 0.5 * w, 0, -7 * u * w, -3 * u * v])
        np.testing.assert_allclose(turning(motion), [0, -2 * u * r, 0, 0, 0, -3 * 0.5 * r])


def test_a_wind_pushes_to_one_side_whatever_the_heading():
    push = WindPush(jnp.asarray(3.0), jnp.asarray(-2.0))
    for psi in (0.0, 0.7, -2.0):
        c, s = np.cos(psi), np.sin(psi)
        turn, none, six = jnp.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), jnp.zeros(3), jnp.ones(6)
        found = push(Motion(none, turn, six, six, six, jnp.zeros(()), none))
        np.testing.assert_allclose(found, [3 * c - 2 * s, -3 * s - 2 * c, 0, 0, 0, 0], atol=1e-12)


def test_a_push_of_the_wind_is_suspected_afloat_where_no_wind_is_logged():
    boat = packaged("cybership2")
    assert WindPush.suspects(boat) and not WindPush.suspects(packaged("tethra"))
    table = {"frontal_area": 0.1, "lateral_area": 0.3, "length": 1.2, "surge": (-0.6,), "sway": (-0.8,)}
    logged = Wind.of([WindTable(**table)])
    assert not WindPush.suspects(dataclasses.replace(boat, actuators=(logged,)))


@pytest.mark.parametrize(
    ("dof", "slots"),
    [
        (("surge", "sway", "yaw"), ("Y_ur", "N_ur")),
        (("surge", "yaw"), ("N_ur",)),
        (("surge", "sway"), None),
        (("sway", "yaw"), None),
    ],
)
def test_turning_lift_is_of_free_axes_only(dof, slots):
    craft = dataclasses.replace(packaged("cybership2"), dof=dof)
    assert [tuple(one.slots) for one in TurningLift.suspects(craft)] == ([] if slots is None else [slots])


# --- the independent plant --------------------------------------------------------------------

# Ten seconds, finely sampled: what is averaged over a hold is then what happens within it.
FINE = np.arange(400) * 0.025


@functools.cache
def catalogued(name: str) -> tuple[Vehicle, np.ndarray, object]:
    """The vehicle with the whole catalogue: one compiled program serves all effects."""
    vehicle = packaged(name)
    whole = vehicle.place(*(Placed(cls.neutral(vehicle)) for cls in CATALOGUE))
    commands = random_commands(vehicle, len(FINE), 20, seed=5)
    rows = random_start(vehicle, 6, speed=0.1)[1]
    run = independent_run(name, [], FINE, commands, rows, 0.025)
    scales = blind_catalogue.scales(independent(name), run[:, 6:12], commands)
    return whole, commands, scales


@every_accusation
def test_effects_are_those_of_the_independent_plant(cls, name):
    whole, commands, scales = catalogued(name)
    vehicle = packaged(name)
    rng = np.random.default_rng(sum(map(ord, cls.name)))
    draw = blind_catalogue.draw(cls.name, independent(name), scales, rng)
    hidden = draw.build(draw.guess)
    assert isinstance(hidden, blind.Effect)
    mine = dataclasses.replace(placed(vehicle, hidden), target=hidden.target if not cls.units else None)
    others = (p for p in whole.placed if not isinstance(p.effect, cls))
    loaded = dataclasses.replace(vehicle, placed=()).place(*others, mine)
    loaded = dataclasses.replace(loaded, placed=tuple(sorted(loaded.placed, key=_place_of)))
    start, rows = random_start(vehicle, 6, speed=0.1)
    start = dataclasses.replace(start, memory=jnp.zeros(6))
    track = simulate(loaded, log_of(loaded, FINE, commands), start)
    expected = independent_run(name, [hidden], FINE, commands, rows, 0.0125)
    plain = independent_run(name, [], FINE, commands, rows, 0.0125)
    noise = independent(name).noise
    felt = np.abs(unwrapped(expected - plain) / noise).max()
    error = np.abs(unwrapped(track.channels - expected) / noise)
    assert felt > 1.0
    # In units of the sensors' noise. Runge-Kutta at 0.025 s; a lag's thrust is averaged over it.
    assert error[:, :12].max() < (0.06 if cls.name == "thruster_lag" else 2e-3)
    assert error.max() < (0.3 if cls.name == "thruster_lag" else 0.05)


def _place_of(placed: Placed) -> int:
    return CATALOGUE.index(type(placed.effect))


def test_a_wrong_sign_would_be_noticed():
    """The comparison above, with one equation broken on purpose."""
    whole, commands, _ = catalogued("cybership2")
    vehicle = packaged("cybership2")
    start, rows = random_start(vehicle, 6, speed=0.1)
    start = dataclasses.replace(start, memory=jnp.zeros(6))
    right = blind.Effect("hull_lift", None, {"Y_uv": 5.0, "N_uv": 1.0})
    wrong = placed(vehicle, blind.Effect("hull_lift", None, {"Y_uv": 5.0, "N_uv": -1.0})).effect
    loaded = dataclasses.replace(
        whole,
        placed=tuple(Placed(wrong) if isinstance(p.effect, type(wrong)) else p for p in whole.placed),
    )
    track = simulate(loaded, log_of(loaded, FINE, commands), start)
    expected = independent_run("cybership2", [right], FINE, commands, rows, 0.0125)
    noise = independent("cybership2").noise
    assert np.abs(unwrapped(track.channels - expected) / noise)[:, :12].max() > 1.0


# --- files ------------------------------------------------------------------------------------


def a_learned_wrench(vehicle: Vehicle) -> LearnedWrench:
    inputs = ("u", "psi", "t", vehicle.thruster_names[0])  # psi enters as sine and cosine
    term = learned_wrench(
        "yaw",
        inputs,
        vehicle.thruster_names,
        np.array([-1.0, -1.0, -1.0, 0.0, -1.0]),
        np.array([1.0, 1.0, 1.0, 60.0, 1.0]),
        5.0,
        jax.random.key(0),
    )
    assert np.array_equal(term.weight_2, np.zeros(8))  # begins as the physics
    return dataclasses.replace(
        term, weight_2=jnp.asarray(np.random.default_rng(7).normal(size=8)), bias_2=jnp.asarray(0.3)
    )


def test_an_untrained_learned_term_does_nothing():
    vehicle = packaged("tethra")
    fresh = dataclasses.replace(a_learned_wrench(vehicle), weight_2=jnp.zeros(8), bias_2=jnp.zeros(()))
    start, _ = random_start(vehicle, 1)
    drive = Input(jnp.ones(4), jnp.ones(4), jnp.zeros(6), jnp.asarray(1.0))
    motion = vehicle.plant()._motion(start, drive)
    assert np.array_equal(fresh(motion), np.zeros(6))
    assert a_learned_wrench(vehicle)(motion)[5] != 0.0


@st.composite
def placements(draw, name: str):
    """Some suspects of the vehicle with parameters, some of them from a time on."""
    suspects = [s for cls in CATALOGUE for s in cls.suspects(packaged(name))]
    out = []
    for suspect in draw(st.lists(st.sampled_from(suspects), min_size=1, max_size=4)):
        number = st.floats(0.05, 2.0)
        values = {parameter: draw(number) for parameter in suspect.slots}
        since = draw(st.none() | st.floats(0.0, 100.0))
        log = draw(st.none() | st.just("a.csv")) if since is not None else None
        out.append((suspect, values, since, log))
    return out


@pytest.mark.parametrize("name", VEHICLES)
def test_saved_and_loaded_vehicles_are_the_same(name, tmp_path_factory):
    vehicle = packaged(name)
    path = tmp_path_factory.mktemp(name) / "extended.toml"
    learned = a_learned_wrench(vehicle)

    @hypothesis.given(placements(name))
    @hypothesis.settings(max_examples=15)
    def check(entries):
        extended = vehicle.place(
            *(Placed(place(s, vehicle, v), s.target, since, log) for s, v, since, log in entries),
            Placed(learned, "yaw"),
        )
        save_vehicle(extended, path)
        again = load_vehicle(path)
        # A simulation knows a vehicle by its plants and its gates.
        assert jax.tree.structure(again) == jax.tree.structure(extended)
        for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(extended), strict=True):
            assert np.array_equal(a, b)
        log = log_of(vehicle, np.arange(0.0, 100.0, 7.0), name="a.csv")
        assert np.array_equal(gates(again, log), gates(extended, log))

    check()


def test_a_saved_and_loaded_vehicle_simulates_the_same(tmp_path):
    vehicle = packaged("tethra")
    found = [("steady_current", None, {"north": 0.2, "east": -0.1}), ("waves", None, None)]
    found += [("fluid_memory", "sway", {"gain": 40.0, "time_constant": 0.7})]
    found += [("thruster_gain", "port_h", {"factor": 0.71}), ("gyro_bias", None, {"r": 0.01})]
    effects = []
    for effect, target, values in found:
        suspect = suspect_named(vehicle, effect, target)
        values = values or {"north": 20.0, "east": 10.0, "period": 5.0, "phase": 0.5}
        effects.append(Placed(place(suspect, vehicle, values), target))
    late = dataclasses.replace(effects[3], since=1.0)
    extended = vehicle.place(*effects[:3], late, effects[4])
    extended = extended.place(Placed(a_learned_wrench(vehicle), "yaw"))
    save_vehicle(extended, tmp_path / "extended.toml")
    again = load_vehicle(tmp_path / "extended.toml")
    log = log_of(vehicle, TIMES, random_commands(vehicle, len(TIMES), 5, seed=8))
    start = initial_state(extended, velocity=(0.3, 0, 0, 0, 0, 0.1))
    one, other = simulate(extended, log, start), simulate(again, log, start)
    assert np.allclose(one.channels, other.channels, rtol=1e-14, atol=1e-14)
    plain = dataclasses.replace(start, memory=jnp.zeros(0))
    assert np.abs(one.channels - simulate(vehicle, log, plain).channels).max() > 0.1


def test_fluid_memory_is_damping_after_a_while():
    """At a constant velocity the lagged damping becomes that of the same gain."""
    memory = FluidMemory(jnp.full(6, 3.0), jnp.full(6, 0.7))
    vehicle = packaged("tethra").place(Placed(memory))
    start = initial_state(vehicle, velocity=(0.4, 0, 0, 0, 0, 0))
    start = dataclasses.replace(start, memory=start.velocity)
    plant = vehicle.plant()
    drive = Input(jnp.zeros(4), jnp.zeros(4), jnp.zeros(6), jnp.zeros(()))
    assert np.array_equal(plant.rates(start, drive).memory, np.zeros(6))
    assert memory(plant._motion(start, drive))[0] == pytest.approx(-3.0 * 0.4)
