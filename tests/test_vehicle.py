"""The assembled vehicle: forward against inverse dynamics, locked axes, order of effects, files."""

import dataclasses
import tomllib
from pathlib import Path

import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w

from experiments.blind import plant as blind
from experiments.blind import vehicle as blind_vehicle
from jaxmarine._errors import InputError
from jaxmarine._types import DOFS
from jaxmarine.allocation import _uncurved, allocate
from jaxmarine.effects import (
    CATALOGUE,
    Buoyancy,
    Payload,
    SteadyCurrent,
    VelocityInEarthAxes,
    VelocityLeverArm,
    VelocityScale,
    place,
)
from jaxmarine.logs import Log
from jaxmarine.physics import from_euler, thrust
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import (
    Input,
    Placed,
    State,
    Vehicle,
    forward_dynamics,
    inverse_dynamics,
)
from jaxmarine.vehicle_io import load_vehicle, packaged_vehicle, save_vehicle
from tests.crafts import PACKAGED, independent, packaged, random_start

SEEDS = st.integers(0, 2**32 - 1)


def with_all(vehicle: Vehicle, scale: float = 0.1) -> Vehicle:
    """The vehicle with all effects of the catalogue, each somewhat off its neutral value."""
    rng = np.random.default_rng(0)
    off = [
        jax.tree.map(lambda a: a + scale * jnp.asarray(rng.uniform(0.2, 1.0, a.shape)), cls.neutral(vehicle))
        for cls in CATALOGUE
    ]
    return vehicle.place(*(Placed(effect) for effect in off))


def random_state(vehicle: Vehicle, seed: int) -> State:
    rng = np.random.default_rng(seed)
    attitude = from_euler(jnp.asarray(rng.uniform(-3, 3, 3) * vehicle.free[3:]))
    memory = initial_state(vehicle).memory
    return State(
        position=jnp.asarray(rng.normal(size=3)),
        attitude=attitude,
        velocity=jnp.asarray(rng.normal(size=6) * vehicle.free),
        memory=jnp.asarray(rng.normal(size=memory.shape)),
    )


# --- packaged files ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", PACKAGED)
def test_packaged_vehicles_hold_the_numbers_that_independent_code_reads(name):
    vehicle, other = packaged(name), independent(name)
    assert vehicle.name == name == other.name
    assert vehicle.dof == tuple(DOFS[i] for i in other.free)
    assert vehicle.thruster_names == other.names
    pairs = {
        "rigid": (vehicle.body.matrix, other.rigid),
        "added": (vehicle.added_mass, other.added),
        "linear": (vehicle.damping.linear, other.linear),
        "quadratic": (vehicle.damping.quadratic, other.quadratic),
        "weight": (vehicle.body.weight * vehicle.body.cog, other.weight * other.cog),
        "buoyancy": (vehicle.body.buoyancy * vehicle.body.cob, other.buoyancy * other.cob),
        "allocation": (
            vehicle.plant().allocation * vehicle.thrusters.max_thrust[None, :],
            other.allocation,
        ),
    }
    for what, (got, expected) in pairs.items():
        assert np.allclose(got, expected, rtol=1e-14, atol=1e-12), what
    text = packaged_vehicle(name).read_text()
    assert "# Source:" in text and "# Assumed" in text


# --- thrusters --------------------------------------------------------------------------------


def asymmetric(folder: Path) -> Path:
    """CyberShip II with thrusters that differ ahead and astern and in their curves, but for the last."""
    tables = tomllib.loads(packaged_vehicle("cybership2").read_text())
    for table, reverse, quadratic in zip(tables["thruster"], (0.7, 1.3), (0.6, 1.0), strict=False):
        table |= {"max_thrust_reverse": reverse * table["max_thrust"], "quadratic": quadratic}
    (folder / "ship.toml").write_text(tomli_w.dumps(tables))
    return folder / "ship.toml"


def test_thrust_astern_and_its_curve_are_those_of_the_independent_plant(tmp_path):
    path = asymmetric(tmp_path)
    vehicle, other = load_vehicle(path), blind.Model(blind_vehicle.load(path))
    commands = np.linspace(-1.0, 1.0, 21)[:, None] * [1.0, -1.0, 0.5]
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), vehicle.plant().drive)
    push = thrust(drive, jnp.arange(21.0), jnp.asarray(commands)).mean
    np.testing.assert_allclose(push, other.drive(commands[..., None])[..., 0], rtol=1e-14, atol=1e-14)
    # And is kept, with its keys where the file had them only.
    save_vehicle(vehicle, tmp_path / "copy.toml")
    again = load_vehicle(tmp_path / "copy.toml")
    for name in ("max_thrust", "max_thrust_reverse", "quadratic"):
        np.testing.assert_array_equal(getattr(again.thrusters, name), getattr(vehicle.thrusters, name))
    assert [name in tables for tables in tomllib.loads((tmp_path / "copy.toml").read_text())["thruster"]
            for name in ("max_thrust_reverse", "quadratic")] == [True] * 4 + [False] * 2  # fmt: skip


def test_where_no_thrust_astern_is_stated_it_follows_that_ahead(tmp_path):
    vehicle = load_vehicle(asymmetric(tmp_path))
    stronger = eqx.tree_at(lambda v: v.thrusters.max_thrust, vehicle, 2.0 * vehicle.thrusters.max_thrust)
    same, doubled = vehicle.thrusters.max_thrust_reverse, stronger.thrusters.max_thrust
    np.testing.assert_array_equal(stronger.plant().drive.max_thrust_reverse, [same[0], same[1], doubled[2]])


def test_allocated_commands_give_the_wrench_by_the_independent_plant(tmp_path):
    path = asymmetric(tmp_path)
    vehicle, other = load_vehicle(path), blind.Model(blind_vehicle.load(path))
    wrench = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 6)) * np.abs(other.vehicle.allocation).max(1)
    commands = np.asarray(allocate(vehicle, jnp.asarray(0.2 * wrench)))
    assert (commands < -0.1).any(axis=0).all() and (commands > 0.1).any(axis=0).all()
    assert np.abs(commands).max() < 1.0
    given = other.drive(commands[..., None])[..., 0] @ other.allocation.T
    free = [0, 1, 5]
    np.testing.assert_allclose(given[:, free], 0.2 * wrench[:, free], rtol=1e-9, atol=1e-9)
    # No thrust takes no command, and what is more than there is takes all there is.
    assert not np.any(allocate(vehicle, jnp.zeros(6)))
    assert np.abs(allocate(vehicle, jnp.asarray(1e6 * wrench))).max(axis=1) == pytest.approx(1.0)


def losing(vehicle: Vehicle, folder: Path, *losses: float) -> Vehicle:
    """The vehicle with thrusters that lose these to the flow [N s/m], saved and read."""
    lossy = eqx.tree_at(lambda v: v.thrusters.advance_loss, vehicle, jnp.asarray(losses))
    save_vehicle(lossy, folder / "lossy.toml")
    return load_vehicle(folder / "lossy.toml")


def test_thrusters_lose_to_the_flow_that_comes_to_them(tmp_path):
    path = asymmetric(tmp_path)
    losses, vehicle = (0.4, 0.7, 0.3), load_vehicle(path)
    plain, lossy = vehicle.plant(), losing(vehicle, tmp_path, *losses).plant()
    tables = tomllib.loads(path.read_text())["thruster"]
    rng = np.random.default_rng(0)
    for _ in range(10):
        given, nu = rng.uniform(-1.0, 1.0, 3), rng.normal(size=6)
        acting, wrench = np.zeros(3), np.zeros(6)
        for i, (one, c, loss) in enumerate(zip(tables, given, losses, strict=True)):
            most = one["max_thrust"] if c > 0 else one.get("max_thrust_reverse", one["max_thrust"])
            curve = one.get("quadratic", 0.0)
            acting[i] = most * ((1 - curve) * c + curve * c * abs(c))
            place, direction = np.array(one["position"]), np.array(one["direction"])
            direction = direction / np.linalg.norm(direction)
            force = -loss * abs(c) * (nu[:3] + np.cross(nu[3:], place)) @ direction * direction
            wrench += np.concatenate([force, np.cross(place, force)])
        acting, nu = jnp.asarray(acting), jnp.asarray(nu)
        changed = lossy.pushed(acting, nu) - plain.pushed(acting, nu)
        # Of small commands of a curve the loss fades.
        np.testing.assert_allclose(changed, wrench, atol=2e-3)
    # At rest, and where no thrust is asked for, there is nothing to lose.
    np.testing.assert_array_equal(lossy.pushed(acting, jnp.zeros(6)), plain.pushed(acting, jnp.zeros(6)))
    assert not np.any(lossy.pushed(jnp.zeros(3), nu))
    assert np.isfinite(jax.jacfwd(lambda given: lossy.pushed(given, nu))(jnp.zeros(3))).all()


@pytest.mark.parametrize("command", [0.6, -0.6])
def test_a_boat_without_drag_comes_to_the_speed_that_the_flow_leaves_it(tmp_path, command):
    """m u' = T(c) - k |c| u, from 0.3 m/s on: a propeller that pushes astern meanwhile gains."""
    ship = losing(packaged("cybership2"), tmp_path, 2.0, 2.0, 0.0)
    ship = eqx.tree_at(lambda v: (v.damping.linear, v.damping.quadratic), ship, (jnp.zeros((6, 6)),) * 2)
    t = np.arange(0.0, 30.0, 0.1)
    commands = np.tile([command, command, 0.0], (300, 1))
    log = Log(t, np.full((300, 18), np.nan), commands, None, ship.command_names, "log")
    u = np.asarray(simulate(ship, log, initial_state(ship, velocity=(0.3, 0, 0, 0, 0, 0))).channels)[:, 6]
    mass, loss, last = float(ship.mass_matrix[0, 0]), 2.0 * 2.0 * 0.6, command / 0.6
    np.testing.assert_allclose(u, last + (0.3 - last) * np.exp(-loss / mass * t), rtol=1e-6)


@pytest.mark.parametrize("quadratic", [-1.0, -0.3, 0.0, 0.5, 0.51, 1.0, 1.6])
def test_a_curve_is_undone_to_its_end(quadratic):
    c = np.linspace(-1.0, 1.0, 41)
    share = (1.0 - quadratic) * c + quadratic * c * np.abs(c)
    curve = jnp.full(41, quadratic)
    back = np.asarray(_uncurved(jnp.asarray(share), curve))
    # Small commands that a curve turns round give what larger ones of the other sign do.
    own = c * share > 0
    np.testing.assert_allclose(back[own], c[own], atol=1e-9)
    np.testing.assert_allclose((1.0 - quadratic) * back + quadratic * back * np.abs(back), share, atol=1e-9)
    slopes = jax.jacfwd(lambda s: _uncurved(s, curve))(jnp.asarray(2.0 * share))
    assert np.isfinite(slopes).all()


# --- equations of motion ----------------------------------------------------------------------

FULL = {name: with_all(packaged(name)) for name in ("tethra", "cybership2")}


@eqx.filter_jit
def there_and_back(vehicle: Vehicle, state: State, nu_dot, t):
    """The acceleration under the wrench that is to give `nu_dot`."""
    wrench = inverse_dynamics(vehicle, state, nu_dot, t)
    nothing = jnp.zeros(len(vehicle.thruster_names))
    return forward_dynamics(vehicle, state, Input(nothing, nothing, wrench, t))


@pytest.mark.parametrize("name", FULL)
@hypothesis.given(SEEDS)
@hypothesis.settings(max_examples=25)
def test_forward_and_inverse_dynamics_are_inverses(name, seed):
    vehicle = FULL[name]
    state = random_state(vehicle, seed)
    nu_dot = np.random.default_rng(seed + 1).normal(size=6) * vehicle.free
    back = there_and_back(vehicle, state, jnp.asarray(nu_dot), jnp.asarray(3.0))
    assert np.abs(np.asarray(back) - nu_dot).max() < 1e-10  # rounding of some hundred newtons


@hypothesis.given(SEEDS)
@hypothesis.settings(max_examples=25)
def test_accelerations_are_those_of_the_independent_plant(seed):
    """At one instant, with effects of every stage that the equations of motion have."""
    rng = np.random.default_rng(seed)
    vehicle = packaged("bluerov2_heavy")
    current = dict(zip(("north", "east", "down"), rng.normal(size=3), strict=True))
    load = dict(zip(("x", "y", "z"), rng.normal(size=3), strict=True))
    load |= {"mass": 12.0, "volume": 0.01}
    effects = [
        blind.Effect("steady_current", None, current),
        blind.Effect("payload", None, load),
        blind.Effect("tether_drag", None, {"coefficient": 30.0}),
        blind.Effect("inflow_loss", None, {"per_speed": 0.2}),
    ]
    (start, rows), thrust = random_start(vehicle, seed, speed=1.0), rng.normal(size=8)
    model = blind.Model(independent("bluerov2_heavy"), effects)
    expected = model.derivative(0.0, rows, thrust[:, None], 0.0)[6:12, 0]
    got = accelerate(
        jnp.asarray(list(current.values())),
        jnp.asarray([load[k] for k in ("mass", "volume", "x", "y", "z")]),
        start,
        jnp.asarray(thrust),
    )
    assert np.allclose(got, expected, rtol=1e-11, atol=1e-11)


@jax.jit
def accelerate(current, load, start, thrust):
    vehicle = packaged("bluerov2_heavy")
    by_name = {cls.name: cls for cls in CATALOGUE}
    others = {"tether_drag": {"coefficient": 30.0}, "inflow_loss": {"per_speed": 0.2}}
    extra = [SteadyCurrent(*current), Payload(*load)]
    extra += [place(by_name[name].suspects(vehicle)[0], vehicle, value) for name, value in others.items()]
    drive = Input(thrust, jnp.zeros(8), jnp.zeros(6), jnp.zeros(()))
    return vehicle.plant(extra=extra).acceleration(start, drive)


def test_locked_axes_take_no_part():
    vehicle = FULL["cybership2"]
    state, locked = random_state(vehicle, 5), vehicle.free == 0
    drive = Input(jnp.ones(3), jnp.ones(3), jnp.ones(6), jnp.asarray(1.0))
    assert np.array_equal(forward_dynamics(vehicle, state, drive)[locked], np.zeros(3))
    # Nor do they change what the free ones do: water that sinks past a planar vehicle is not felt,
    # not even by the cable, whose drag grows with the whole speed; nor is another roll inertia.
    sinking = vehicle.place(Placed(SteadyCurrent(jnp.zeros(()), jnp.zeros(()), jnp.asarray(0.5))))
    level = initial_state(vehicle, attitude=(0, 0, 0.4), velocity=(0.3, 0.1, 0, 0, 0, 0.2))
    assert np.allclose(
        forward_dynamics(vehicle, level, drive),
        forward_dynamics(sinking, level, drive),
        rtol=1e-13,
        atol=1e-13,
    )
    heavier = eqx.tree_at(lambda v: v.body.matrix, vehicle, vehicle.body.matrix.at[3, 3].multiply(7.0))
    assert np.array_equal(forward_dynamics(vehicle, state, drive), forward_dynamics(heavier, state, drive))


def test_a_mass_matrix_is_written_where_it_says_more_than_mass_inertia_and_cog(tmp_path):
    tethra, path = packaged("tethra"), tmp_path / "copy.toml"
    save_vehicle(tethra, path)
    text = path.read_text()
    assert "mass_matrix" not in text
    assert np.array_equal(load_vehicle(path).body.matrix, tethra.body.matrix)
    # What is edited then takes effect.
    path.write_text(text.replace("mass = 231.0", "mass = 462.0"))
    heavier = load_vehicle(path).body.matrix
    assert np.allclose(heavier[:3], 2 * tethra.body.matrix[:3], rtol=1e-15)

    coupled = tethra.body.matrix.at[0, 5].set(9.0).at[5, 0].set(9.0)
    save_vehicle(eqx.tree_at(lambda v: v.body.matrix, tethra, coupled), path)
    assert np.array_equal(load_vehicle(path).body.matrix, coupled)


def test_the_mass_matrix_is_that_of_the_file():
    vehicle = packaged("bluerov2_heavy")
    plant = vehicle.plant()
    assert np.allclose(plant.inverse_mass @ vehicle.mass_matrix, np.eye(6), atol=1e-12)


# --- effects in a vehicle ---------------------------------------------------------------------


def test_effects_act_in_the_catalogues_order_whatever_the_order_of_finding():
    vehicle = packaged("tethra")
    one = jnp.asarray
    effects = [
        Placed(VelocityInEarthAxes(one(0.7))),
        Placed(VelocityScale(one(1.2))),
        Placed(VelocityLeverArm(one(0.5), one(-0.2), one(0.3))),
        Placed(Payload(one(5.0), one(0.02), one(0.3), one(0.1), one(-0.4))),
        Placed(Buoyancy(one(30.0))),
    ]
    state, nu_dot = random_state(vehicle, 8), jnp.arange(6.0)
    drive = Input(jnp.ones(4), jnp.zeros(4), jnp.zeros(6), one(0.0))
    shown = [
        (plant.readings(state, nu_dot), plant.acceleration(state, drive))
        for plant in (vehicle.place(*effects).plant(), vehicle.place(*effects[::-1]).plant())
    ]
    for a, b in zip(*shown, strict=True):
        assert np.array_equal(a, b)
    # And as the contract has it: lever arm, then scale, then earth axes.
    turn = np.asarray(vehicle.plant()._motion(state, drive).rotation)
    nu = np.asarray(state.velocity)
    v = 1.2 * (nu[:3] + np.cross(nu[3:], [0.5, -0.2, 0.3]))
    assert np.allclose(shown[0][0][6:9], 0.3 * v + 0.7 * turn @ v, rtol=1e-13)


def test_a_closed_gate_is_a_vehicle_without_the_effect():
    vehicle = packaged("tethra")
    late = vehicle.place(*(dataclasses.replace(p, since=10.0) for p in with_all(vehicle).placed))
    state, drive = random_state(late, 3), Input(jnp.ones(4), jnp.ones(4), jnp.ones(6), jnp.ones(()))
    none, every = jnp.zeros(len(late.placed)), jnp.ones(len(late.placed))
    plain, closed, opened = vehicle.plant(), late.plant(none), late.plant(every)
    expected = plain.acceleration(state, drive)
    assert np.allclose(closed.acceleration(state, drive), expected, rtol=1e-12, atol=1e-13)
    expected = with_all(vehicle).plant().acceleration(state, drive)
    assert np.allclose(opened.acceleration(state, drive), expected, rtol=1e-12, atol=1e-13)


def test_wrong_shapes_are_refused(unchecked):
    vehicle = packaged("tethra")
    with pytest.raises(ValueError, match="added_mass"):
        dataclasses.replace(vehicle, added_mass=jnp.zeros((6, 5)))


def test_everything_has_a_finite_derivative_at_rest():
    vehicle = packaged("tethra")
    state = initial_state(vehicle.place(*(Placed(cls.neutral(vehicle)) for cls in CATALOGUE)))

    def accelerate(velocity, families):
        moving = dataclasses.replace(state, velocity=velocity)
        drive = Input(jnp.zeros(4), jnp.zeros(4), jnp.zeros(6), jnp.zeros(()))
        plant = vehicle.plant(extra=families)
        return plant.readings(moving, plant.acceleration(moving, drive))

    families = tuple(cls.neutral(vehicle) for cls in CATALOGUE)
    slopes = jax.jit(jax.jacrev(accelerate, argnums=(0, 1)))(jnp.zeros(6), families)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


def test_a_missing_vehicle_file_is_said_so():
    with pytest.raises(InputError):
        load_vehicle(packaged_vehicle("nobodys"))
