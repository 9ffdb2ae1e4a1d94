"""Craft and logs unlike the packaged ones, and the sums that no whole diagnosis shows by itself."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.blind.grading import first_judged, grade
from jaxmarine._errors import InputError
from jaxmarine._progress import silent
from jaxmarine._types import DOFS
from jaxmarine.diagnosis import Criteria, Gain, _answer, _workbench, diagnose
from jaxmarine.diagnosis._amid import refine_fully
from jaxmarine.diagnosis._climb import climbed
from jaxmarine.diagnosis._diagnose import _missed
from jaxmarine.diagnosis._explanation import Beginning, Member, Model
from jaxmarine.diagnosis._filed import base_coefficients, refiled
from jaxmarine.diagnosis._judge import Judged
from jaxmarine.diagnosis._knots import Knots, at_knots, wave_start
from jaxmarine.diagnosis._noises import missed_by
from jaxmarine.diagnosis._prepare import fitted, named_apart, rescaled, sharpened, workbench
from jaxmarine.diagnosis._saturated import saturate
from jaxmarine.diagnosis._score import Reduced
from jaxmarine.diagnosis._search import _joined, _trials, search
from jaxmarine.diagnosis._signals import Places
from jaxmarine.diagnosis._unnamed import _going_on
from jaxmarine.diagnosis._workbench import Workbench
from jaxmarine.diagnosis._worth import buys_nothing
from jaxmarine.effects import (
    CATALOGUE,
    AddedMass,
    CoupledDamping,
    ExchangedThrusters,
    FluidMemory,
    HullLift,
    InflowLoss,
    InputDelay,
    LinearDamping,
    QuadraticDamping,
    ReverseThrust,
    Saturation,
    SurfaceStuck,
    ThrusterGain,
    place,
)
from jaxmarine.fitting import predict
from jaxmarine.fitting._kinematics import kinematics
from jaxmarine.logs import Log
from jaxmarine.physics import thrust
from jaxmarine.simulation import initial_state, simulate, substeps
from jaxmarine.vehicle import Damping, Placed, Thrusters
from jaxmarine.vehicle_io import suspect_named
from tests.boats import NOISE, boat, record, steps
from tests.crafts import packaged

# Where a test is not about the catalogue: a thruster, and the coefficients of the file. Quick to compile.
FEW = (ThrusterGain, LinearDamping, QuadraticDamping, AddedMass)
NOTHING = Thrusters(**{f.name: jnp.zeros((0, 3) if f.name in ("position", "direction") else 0)
                       for f in dataclasses.fields(Thrusters)})  # fmt: skip


def test_a_vehicle_that_is_stiffer_than_its_file_is_integrated_finely():
    """Yaw is damped eight times as much, for which steps that suit the file are too long."""
    stiff = eqx.tree_at(lambda v: v.damping.linear, boat(), boat().damping.linear.at[5, 5].mul(8.0))
    log = record(stiff, steps(600))
    coarse = workbench(boat(), (log,), FEW, None)
    bench, model = fitted(coarse, coarse.start())
    found = refiled(boat(), bench.base, model.z)
    assert coarse.split < substeps(found, log.dt) <= bench.split
    assert float(found.damping.linear[5, 5]) == pytest.approx(float(stiff.damping.linear[5, 5]), rel=0.1)


@pytest.mark.slow
def test_noise_that_is_not_stated_is_that_of_the_sensors_once_the_cause_is_found():
    """A thruster at half its thrust, in a log of known noise that the file does not state."""
    craft = boat(sensors={})
    weak = craft.place(Placed(ThrusterGain(jnp.array([0.5, 1.0, 1.0]))))
    bench = workbench(craft, (record(weak, steps(900)),), FEW, None)
    begun = bench.start()
    raised = rescaled(bench, begun)
    assert raised.raised and sharpened(raised, refine_fully(raised, begun)) is None  # nothing found, no news
    suspect = [one.label for one in bench.layout.suspects].index("thruster_gain:port")
    found = raised.refine(raised.with_member(begun, Member(suspect), np.array([-0.1])))
    assert found.z[-1] == pytest.approx(-0.5, abs=0.05)
    sharper = sharpened(raised, found)
    assert sharper is not None and not sharper.raised
    # What is left of the channels that move is noise, and with half a thruster too much far more.
    free = np.tile(craft.free, 2) > 0
    found = sharper.refine(found)
    assert np.allclose(missed_by(sharper, found)[:12][free], 1.0, atol=0.2)
    assert (missed_by(raised, refine_fully(raised, begun))[:12][free] > 3.0).any()
    assert _missed(sharper, found) is None
    told = _missed(raised, refine_fully(raised, begun))
    assert told is not None and "the model misses" in told and "rather than of the sensors" in told
    true = np.repeat([NOISE[name] for name in ("position", "attitude", "velocity", "rate")], 3)
    # Of 90 s, and of residuals that the fitted starts make some per cent smaller.
    assert np.allclose((sharper.noise[:12] / true)[np.tile(craft.free, 2) > 0], 1.0, atol=0.2)


@pytest.mark.slow
def test_a_cause_that_the_log_cannot_show_stands_in_nobodys_way():
    """A boat that only goes ahead has no thrust astern to tell of; one of its thrusters is weak."""
    craft = boat()
    weak = craft.place(Placed(ThrusterGain(jnp.array([0.5, 1.0, 1.0]))))
    few = (AddedMass, LinearDamping, QuadraticDamping, ThrusterGain, ReverseThrust)
    bench = workbench(craft, (record(weak, np.abs(steps(600))),), few, None)
    model = refine_fully(bench, bench.start())
    stats = bench.screen(model)
    labels = [one.label for one in bench.layout.suspects]
    blind = [i for i, label in enumerate(labels) if label.startswith("reverse_thrust")]
    assert len(blind) == 4
    for i in blind:
        assert not np.any(stats.h @ bench.own(i)) and not np.any(stats.g @ bench.own(i))
    # Refitted all the same, it stays where it was and changes nothing.
    refitted = bench.refine(bench.with_member(model, Member(blind[0]), np.zeros(1)))
    assert refitted.z[-1] == 0.0 and refitted.cost == pytest.approx(model.cost, rel=1e-6)
    found = search(bench, model, silent, lambda model, stats: False)
    assert [labels[member.suspect] for member in found.model.members] == ["thruster_gain:port"]
    saved = [trial.saved for one in found.rounds for trial in one.trials if trial.member.suspect in blind]
    assert np.abs(saved).max(initial=0.0) < 1.0


def test_suspects_that_the_craft_cannot_have_are_refused_in_a_sentence():
    for none in ((), (SurfaceStuck,), (ExchangedThrusters,)):
        with pytest.raises(InputError, match=r"\w+: can have none of the suspected effects; give a cat"):
            saturate(packaged("tethra"), none)


@pytest.mark.parametrize(
    ("ratio", "interval", "nothing"),
    [
        (0.97, (0.8, 1.2), True),
        (1.1, (0.9, 1.4), True),
        (1.1, None, True),
        (0.9, (0.7, 1.1), False),  # it buys something, if not for certain
        (0.97, (0.95, 0.99), False),  # little, but for certain
        (1.4, (1.1, 1.8), False),  # absent from the test log, perhaps
    ],
)
def test_names_that_leave_the_error_as_it_is_buy_nothing(ratio, interval, nothing):
    for held_out in (True, False):
        gain = Gain(5.0, None, None, ratio, interval, held_out, 60)
        assert buys_nothing(gain, Criteria().worth) == (nothing and held_out)


@pytest.mark.parametrize(
    ("linear", "quadratic", "width"), [(20.0, 30.0, (2.0, 3.0)), (0.0, 0.0, (0.02 * 55, 0.02 * 55))]
)
def test_damping_brakes_until_it_pushes_by_more_than_a_file_is_commonly_wrong(linear, quadratic, width):
    """In surge: a tenth of each coefficient, of zero 2 % of mass and added mass; at the logs' speed."""
    whole = boat()
    damping = Damping(
        whole.damping.linear.at[0, 0].set(linear), whole.damping.quadratic.at[0, 0].set(quadratic)
    )
    log = record(boat(), steps())
    bench = workbench(dataclasses.replace(whole, damping=damping), (log,), CATALOGUE, None)
    speed = float(np.sqrt((np.asarray(bench.data.windows.velocity)[:, 0] ** 2).mean()))
    most = linear + width[0] + (quadratic + width[1]) * speed
    which = next(j for j, c in enumerate(bench.base) if c.label == "linear_damping:surge")
    for share, brakes in ((0.99, True), (1.01, False)):
        model = bench.start()
        model.z[which] = -share * most
        assert bench.brakes(model).all() == brakes


def test_a_memory_that_pushes_brakes_no_more_than_damping_that_does():
    """It is as much in the end: against linear damping of 20 N s/m, and the tenth of it that may be wrong."""
    whole = boat()
    damping = Damping(whole.damping.linear.at[0, 0].set(20.0), whole.damping.quadratic.at[0, 0].set(0.0))
    log = record(boat(), steps())
    bench = workbench(dataclasses.replace(whole, damping=damping), (log,), CATALOGUE, None)
    speed = float(np.sqrt((np.asarray(bench.data.windows.velocity)[:, 0] ** 2).mean()))
    most = 22.0 + 0.02 * 55 * speed
    memory = bench.layout.place_of(Placed(FluidMemory.neutral(boat()), "surge"))
    for share, brakes in ((0.99, True), (1.01, False)):
        model = bench.with_member(bench.start(), Member(memory), np.array([-share * most, 0.0]))
        assert bench.brakes(model).all() == brakes


def test_a_suspect_takes_over_how_far_its_coefficient_has_bent():
    bench = workbench(boat(), (record(boat(), steps()),), CATALOGUE, None)
    which = next(j for j, c in enumerate(bench.base) if c.label == "linear_damping:surge")
    model = bench.start()
    model.z[which] = 3.0
    joined = _joined(bench, model, Member(bench.base[which].suspect), None)
    np.testing.assert_array_equal(bench.theta(joined), bench.theta(model))
    assert joined.z[which] == 0.0 and joined.z[-1] == 3.0
    # From a beginning on it acts beside the coefficient, not in its place.
    late = _joined(bench, model, Member(bench.base[which].suspect, Beginning(0, 10.0)), None)
    assert late.z[which] == 3.0 and late.z[-1] == 0.0


def test_a_craft_without_thrusters_can_be_weighed():
    """Driven by a logged wrench; least of no limits is none."""
    driven = record(boat(), steps())
    towed = dataclasses.replace(boat(), thrusters=NOTHING, thruster_names=())
    log = dataclasses.replace(driven, commands=None, wrench=np.zeros((len(driven.t), 6)), command_names=())
    bench = workbench(towed, (log,), CATALOGUE, None)
    assert bench.sound(bench.start())


def test_every_knot_of_a_slow_log_has_two_samples():
    """Velocities show a force from the next sample on: with one to each the last knot would be free."""
    bench = workbench(boat(), (record(boat(), steps(), dt=1.0),), CATALOGUE, None)
    assert (bench.knots, bench.data.windows.step.shape[1]) == (6, 12)
    assert (np.diff(bench.places.t, axis=1) == 2.0).all()


@pytest.mark.slow
def test_the_last_knot_of_a_slow_log_shows():
    bench = workbench(boat(), (record(boat(), steps(), dt=1.0),), CATALOGUE, None)
    width = len(bench.start().z)
    shown = np.diagonal(at_knots(bench, bench.start()).h[:, width:, width:], axis1=1, axis2=2)
    assert (shown.reshape(bench.count, 6, 6)[..., boat().free > 0] > 0.0).all()


@pytest.mark.parametrize("counts", [(75,), (600,), (601,), (9000,), (700, 3, 900), (2,) * 700])
def test_groups_are_few_and_of_one_log(counts):
    log = np.repeat(np.arange(len(counts)), counts)
    group = _workbench._grouped(log, len(log))
    assert set(np.diff(group)) <= {0, 1} and group[0] == 0
    assert group[-1] < _workbench.GROUPS + len(counts)
    if len(log) <= _workbench.GROUPS:
        assert (group == np.arange(len(log))).all()
    assert all(len(set(log[group == g])) == 1 for g in range(group[-1] + 1))


@pytest.mark.slow
def test_windows_screened_in_groups_say_the_same_together(monkeypatch):
    log = record(boat(), steps())
    each = workbench(boat(), (log,), CATALOGUE, None)
    monkeypatch.setattr(_workbench, "GROUPS", 4)
    few = workbench(boat(), (log,), CATALOGUE, None)
    (one, two), starts = (bench.screen(bench.start()) for bench in (each, few)), few.group_windows
    assert len(one.g) == each.count and len(two.g) == len(starts) <= 4
    size = np.abs(one.h.sum(0)).max()
    for now, until in zip(range(len(starts)), [*starts[1:], each.count], strict=True):
        part = slice(starts[now], until)
        assert two.chi2[now] == pytest.approx(one.chi2[part].sum())
        assert np.allclose(two.g[now], one.g[part].sum(0), atol=1e-9 * size)
        assert np.allclose(two.h[now], one.h[part].sum(0), atol=1e-9 * size)
    assert few.group_starts.tolist() == each.data.starts[starts].tolist()


@pytest.mark.slow
def test_a_sample_of_the_windows_says_of_a_suspect_what_all_of_them_do(monkeypatch):
    """Every third window of a log in which a thruster is weak: its factor, and three times what it saves."""
    weak = Placed(place(suspect_named(boat(), "thruster_gain", "port"), boat(), {"factor": 0.7}), "port")
    log = record(boat().place(weak), steps())
    bench = workbench(boat(), (log,), FEW, None)
    which = next(i for i, one in enumerate(bench.layout.suspects) if one.label == "thruster_gain:port")
    model = bench.refine(bench.start())
    starts = [(Member(which), None)]
    (whole,) = _trials(bench, model, starts)
    monkeypatch.setattr(_workbench, "SAMPLE", bench.count // 3)
    fresh = bench.reweighed(bench.noise)
    sample = fresh.sampled(model)
    np.testing.assert_array_equal(sample.bench.data.starts, bench.data.starts[::3])
    (some,) = _trials(fresh, model, starts)
    assert whole.model.z[-1] == pytest.approx(0.7 - 1.0, abs=0.01)
    # Noise of a third of the samples; which third is driven hardest is chance.
    assert some.model.z[-1] == pytest.approx(whole.model.z[-1], abs=0.02)
    assert some.saved == pytest.approx(whole.saved, rel=0.3)
    assert some.model.weight == model.weight and some.model.delta is model.delta
    # From where either left off all windows end at the same cost.
    assert bench.refine(some.model).cost == pytest.approx(bench.refine(whole.model).cost, abs=0.01)


def test_a_log_that_goes_on_moves_as_it_did_before():
    log, start = record(boat(), steps(200)), initial_state(boat())
    longer = _going_on(log, 333)
    assert len(longer.t) == 333 and np.allclose(np.diff(longer.t), log.dt)
    moved = [np.asarray(simulate(boat(), one, start).states.velocity) for one in (log, longer)]
    np.testing.assert_array_equal(moved[1][:200], moved[0])


@pytest.mark.slow
def test_rows_that_are_missing_are_stepped_over_as_a_simulation_does():
    """A quarter of the rows of an exact log of a vehicle that is stiff in what is left of them."""
    stiff = boat()
    damping = dataclasses.replace(stiff.damping, linear=25.0 * stiff.damping.linear)
    stiff = dataclasses.replace(stiff, damping=damping)
    kept = np.sort(np.random.default_rng(0).permutation(600)[:450])
    blank = Log(0.1 * kept, np.full((450, 18), np.nan), steps(600)[kept], None, stiff.thruster_names, "-")
    true = np.asarray(simulate(stiff, blank, initial_state(stiff)).channels)
    bench = workbench(stiff, (dataclasses.replace(blank, channels=true),), FEW, None)
    assert bench.data.hold == pytest.approx(np.diff(blank.t).max())
    found = bench.refine(bench.frozen(bench.start()))
    residual = predict(bench.problem(()), jnp.asarray(bench.theta(found)), found.delta)[1][: bench.count]
    # Of the channels whose noise is stated: a hundredth of it, as the starts are fitted to so much.
    assert np.sqrt((np.asarray(residual) ** 2).mean(axis=(0, 1)))[:12].max() < 0.01


@pytest.mark.parametrize(
    ("start", "stuck"),
    [
        (0.75, True),
        pytest.param(0.3, True, marks=pytest.mark.slow),
        pytest.param(1.1, False, marks=pytest.mark.slow),
    ],
)
def test_a_late_command_is_found_over_the_steps_that_accelerometers_show(start, stuck):
    """New commands at each sample, of which an accelerometer shows the one that acts then: 0.82 s late."""
    craft = boat(sensors=NOISE | {"acceleration": 0.02})
    late = craft.place(Placed(InputDelay(jnp.array(0.82))))
    log = record(late, steps(400, hold=1), NOISE | {"acceleration": 0.02})
    bench = workbench(craft, (log,), (InputDelay,), None)
    model = bench.with_member(bench.start(), Member(0), np.array([start]))
    found = climbed(bench, bench.likeliest(model))
    assert found.z[-1] == pytest.approx(0.82, abs=0.01)
    # A slope alone may lead no further than to the end of a step.
    assert (bench.refine(model).cost > 2 * found.cost) == stuck


def test_a_command_that_is_late_by_whole_samples_is_found_from_beyond():
    """At the edge of a step: from the middle of the one below a refinement comes back over it, and stays."""
    sensors = NOISE | {"acceleration": 0.1}
    craft = boat(sensors=sensors)
    late = craft.place(Placed(InputDelay(jnp.array(0.3))))
    log = record(late, steps(400, hold=4), sensors, seed=4)
    bench = workbench(craft, (log,), (InputDelay,), None)
    stuck = bench.likeliest(bench.with_member(bench.start(), Member(0), np.array([0.34])))
    found = climbed(bench, stuck)
    assert found.z[-1] == pytest.approx(0.3, abs=1e-3)
    assert found.cost < 0.5 * stuck.cost


@pytest.mark.parametrize("target", ["surge<-sway", "yaw<-surge"])
def test_a_coupling_that_drives_the_craft_is_no_damping(target):
    """By the eigenvalues of D + D', at speeds that are as large on the average as those of the log."""
    craft, log = boat(), record(boat(), steps())
    bench = workbench(craft, (log,), (CoupledDamping, LinearDamping, QuadraticDamping), None)
    which = [s.label for s in bench.layout.suspects].index(f"coupled_damping:{target}")
    pushed, moving = (DOFS.index(one) for one in target.split("<-"))
    speed = np.sqrt((np.asarray(log.channels)[:, 6:12] ** 2).mean(axis=0))
    own = np.asarray(craft.damping.linear) + np.asarray(craft.damping.quadratic) * speed
    least = 2 * np.sqrt(own[pushed, pushed] * own[moving, moving])
    # The file's damping may be a tenth larger, which the priors of both axes and both laws allow.
    for share, brakes in ((-1.3, False), (-0.9, True), (0.9, True), (1.3, False)):
        damping = own.copy()
        damping[pushed, moving] = share * least
        assert (np.linalg.eigvalsh(damping + damping.T)[0] >= 0) == brakes
        model = bench.with_member(bench.start(), Member(which), np.array([share * least]))
        assert bench.brakes(model).all() == brakes


def test_a_pair_of_couplings_that_takes_no_energy_is_none_that_drives():
    """As the Coriolis forces of a turn: of any size, where both terms are of opposite signs."""
    bench = workbench(boat(), (record(boat(), steps()),), (CoupledDamping,), None)
    labels = [s.label for s in bench.layout.suspects]
    first, second = (labels.index(f"coupled_damping:{one}") for one in ("surge<-sway", "sway<-surge"))
    alone = bench.with_member(bench.start(), Member(first), np.array([1000.0]))
    both = bench.with_member(alone, Member(second), np.array([-1000.0]))
    assert not bench.brakes(alone).all() and bench.brakes(both).all()


def test_a_coupling_of_the_file_that_drives_leaves_other_axes_judged():
    own = boat()
    # Roll is locked: nothing couples to it.
    linear = own.damping.linear.at[0, 1].set(1000.0).at[3, 1].set(1e6)
    craft = dataclasses.replace(own, damping=Damping(linear, own.damping.quadratic))
    bench = workbench(craft, (record(own, steps()),), (LinearDamping, CoupledDamping), None)
    labels = [s.label for s in bench.layout.suspects]

    def refitted(label: str, value: float) -> Model:
        model = bench.with_member(bench.start(), Member(labels.index(label)), np.array([value]))
        return dataclasses.replace(model, cost=0.0)

    start = bench.start()
    assert np.argwhere(~bench.brakes(start)).tolist() == [[0, 1], [1, 0]]
    assert bench.stands(refitted("linear_damping:yaw", 5.0), start)
    assert not bench.stands(refitted("linear_damping:yaw", -50.0), start)
    assert not bench.stands(refitted("coupled_damping:yaw<-surge", 1000.0), start)


@pytest.mark.parametrize(("share", "sound"), [(0.8, True), (1.2, False)])
def test_a_loss_of_thrust_that_turns_it_round_is_none(share, sound):
    """At the speeds of the log along the thrusters, of which those ahead are the fastest."""
    craft, log = boat(), record(boat(), steps())
    bench = workbench(craft, (log,), (InflowLoss,), None)
    fastest = np.sqrt((np.asarray(log.channels)[:, 6:8] ** 2).mean(axis=0)).max()
    model = bench.with_member(bench.start(), Member(0), np.array([share / fastest]))
    assert bench.sound(model) == sound


@pytest.mark.parametrize("lift", [0.0, 300.0])
def test_a_lift_of_the_file_brakes_as_damping_does(lift):
    """A boat whose sway is braked by the lift of its hull alone, Y = -Y_uv |u| v."""
    own = boat()
    linear, quadratic = (own.damping.linear.at[1, 1].set(0.0), own.damping.quadratic.at[1, 1].set(0.0))
    hull = Placed(HullLift(*(jnp.asarray(one) for one in (lift, 0.0, 0.0, 0.0))))
    craft = dataclasses.replace(own, damping=Damping(linear, quadratic)).place(hull)
    log = record(craft, steps())
    bench = workbench(craft, (log,), (CoupledDamping, LinearDamping, QuadraticDamping), None)
    which = [s.label for s in bench.layout.suspects].index("coupled_damping:surge<-sway")
    u = np.sqrt((np.asarray(log.channels)[:, 6] ** 2).mean())
    surge = float(own.damping.linear[0, 0] + own.damping.quadratic[0, 0] * u)
    coupling = 2 * np.sqrt(surge * 300.0 * u)
    model = bench.with_member(bench.start(), Member(which), np.array([0.9 * coupling]))
    assert bench.brakes(model).all() == (lift > 0.0)


def test_a_vehicle_that_runs_away_is_told_so():
    """Damping with the sign of SNAME's derivatives, which pushes: no run of that vehicle stays finite."""
    wrong, log = boat(), record(boat(), steps())
    pushing = Damping(-wrong.damping.linear, -wrong.damping.quadratic)
    wrong = dataclasses.replace(wrong, damping=pushing)
    assert not np.isfinite(simulate(wrong, log, initial_state(wrong)).channels).all()
    bench = workbench(wrong, (log,), (ThrusterGain,), None)  # one cause: quick to compile
    with pytest.raises(InputError, match="runs away on it; check the signs"):
        refine_fully(bench, bench.start())


def test_commands_beyond_ten_are_those_of_the_file():
    """Neutral changes nothing, whatever the unit of the commands."""
    percent = boat()
    limits = dataclasses.replace(percent.thrusters, saturation=jnp.full(3, 100.0))
    percent = dataclasses.replace(percent, thrusters=limits)
    t, commands = jnp.arange(3.0), jnp.full((3, 3), 50.0)

    def pushed(vehicle):
        drive = jax.tree.map(lambda a: jnp.broadcast_to(a, (3, 3)), vehicle.plant().drive)
        return np.asarray(thrust(drive, t, commands).instant)

    neutral = percent.place(Placed(Saturation.neutral(percent)))
    assert (pushed(neutral) == pushed(percent)).all()
    assert np.allclose(pushed(percent), 50.0 * np.array([40.0, 40.0, 30.0]))


def test_logs_of_one_name_are_told_apart_and_a_log_tested_on_itself_keeps_its_own():
    one, other = (record(boat(), steps(seed=i), seed=i) for i in range(2))
    (first, second), (test,), notes = named_apart((one, other), (one,))
    assert (first.name, second.name, test.name) == ("log.csv", "log.csv (2)", "log.csv")
    assert notes == ["Another log is called log.csv too; this one is `log.csv (2)` here."]
    _, (test,), _ = named_apart((one,), (other,))
    assert test.name == "log.csv (2)"
    # A log that is the second of its name is that in the test as well; and no log is given another's name.
    _, (test,), _ = named_apart((one, other), (other,))
    assert test.name == "log.csv (2)"
    taken = dataclasses.replace(one, name="log.csv (2)")
    (*_, last), _, _ = named_apart((one, taken, other), ())
    assert last.name == "log.csv (3)"


def test_a_diagnosis_without_logs_or_in_single_precision_is_refused(monkeypatch):
    log = record(boat(), steps())
    with pytest.raises(InputError, match="at least one training log"):
        diagnose(boat(), (), log)
    monkeypatch.setattr("jax.config.read", lambda name: False)
    with pytest.raises(ValueError, match="A diagnosis needs double precision"):
        diagnose(boat(), log, log)


def test_a_boat_that_cannot_sway_still_goes_east():
    """The motion that positions show, on a circle at 1 m/s, against that speed."""
    t = np.arange(0.0, 60.0, 0.1)
    psi = 0.2 * t
    channels = np.full((len(t), 18), np.nan)
    channels[:, 0], channels[:, 1] = np.sin(psi) / 0.2, -np.cos(psi) / 0.2
    channels[:, 5], channels[:, 6], channels[:, 11] = psi, 1.0, 0.2
    channels[:, 2:5] = 0.0
    log = dataclasses.replace(record(boat(), steps(len(t))), channels=channels)
    seen = kinematics(boat(("surge", "yaw")), (log,))
    assert seen is not None
    # The mean motion over a stretch is its chord, shorter than the arc by a share of (0.2 rad)² / 24.
    mean = np.einsum("sij,sj->si", seen.rotation[:, 0], seen.nu[:, 0, :3])
    assert np.allclose(np.linalg.norm(mean, axis=1), 1.0, atol=0.002)


def tabled() -> Workbench:
    """A workbench that knows no log: the boat with a coupling and without linear damping of sway."""
    craft = boat()
    linear = craft.damping.linear.at[1, 1].set(0.0).at[1, 5].set(-7.0)
    craft = dataclasses.replace(craft, damping=dataclasses.replace(craft.damping, linear=linear))
    bench: Any = object.__new__(Workbench)
    bench.vehicle, (_, bench.layout) = craft, saturate(craft)
    bench.base = base_coefficients(craft, bench.layout)
    return bench


def test_coefficients_of_the_file_and_how_far_it_is_commonly_wrong():
    """A tenth, of the total mass, couplings and damping; where sway has no linear one, 2 % of 90 kg."""
    found = {c.label: (c.value, c.prior) for c in tabled().base}
    expected = {
        "added_mass:surge": (5.0, 5.5),
        "added_mass:sway": (40.0, 9.0),
        "added_mass:yaw": (3.0, 1.1),
        "linear_damping:surge": (20.0, 2.0),
        "linear_damping:sway": (0.0, 1.8),
        "linear_damping:yaw": (12.0, 1.2),
        "quadratic_damping:surge": (30.0, 3.0),
        "quadratic_damping:sway": (90.0, 9.0),
        "quadratic_damping:yaw": (8.0, 0.8),
        "coupled_added_mass:sway+yaw": (2.0, 0.2),
        "coupled_damping:sway<-yaw": (-7.0, 0.7),
    }
    assert found == {label: pytest.approx(pair) for label, pair in expected.items()}
    assert list(found)[-1] == "coupled_damping:sway<-yaw"


def test_a_refiled_vehicle_has_each_coefficient_changed_and_nothing_else():
    bench = tabled()
    changes = np.arange(1.0, len(bench.base) + 1)
    by = dict(zip([c.label for c in bench.base], changes, strict=True))
    after, before = refiled(bench.vehicle, bench.base, changes), bench.vehicle
    mass, linear, quadratic = (np.zeros((6, 6)) for _ in range(3))
    for axis, i in (("surge", 0), ("sway", 1), ("yaw", 5)):
        mass[i, i] = by[f"added_mass:{axis}"]
        linear[i, i] = by[f"linear_damping:{axis}"]
        quadratic[i, i] = by[f"quadratic_damping:{axis}"]
    mass[1, 5] = mass[5, 1] = by["coupled_added_mass:sway+yaw"]
    linear[1, 5] = by["coupled_damping:sway<-yaw"]
    assert np.allclose(after.added_mass - before.added_mass, mass)
    assert np.allclose(after.damping.linear - before.damping.linear, linear)
    assert np.allclose(after.damping.quadratic - before.damping.quadratic, quadratic)
    assert np.allclose(after.body.matrix, before.body.matrix)


def test_a_coefficient_is_stood_for_by_what_changes_it_always_and_held_by_that_and_more():
    bench = tabled()
    suspect = {one.label: i for i, one in enumerate(bench.layout.suspects)}
    nothing = Model((), np.zeros(len(bench.base)), jnp.zeros((1, 12)), 0.0)

    def labels(which: np.ndarray) -> list[str]:
        return [c.label for c, one in zip(bench.base, which, strict=True) if one]

    model = bench.with_member(nothing, Member(suspect["linear_damping:yaw"]), np.zeros(1))
    late = Member(suspect["quadratic_damping:yaw"], Beginning(0, 5.0))
    model = bench.with_member(model, late, np.zeros(1))
    model = bench.with_member(model, Member(suspect["thruster_gain:port"]), np.zeros(1))
    assert labels(bench.stood_for(model)) == labels(bench.held(model)) == ["linear_damping:yaw"]
    first = bench.base[0].label
    assert labels(bench.held(dataclasses.replace(model, held=(0,)))) == [first, "linear_damping:yaw"]
    assert labels(bench.stood_for(dataclasses.replace(model, held=(0,)))) == ["linear_damping:yaw"]
    assert bench.held(bench.frozen(model)).all() and not bench.stood_for(bench.frozen(nothing)).any()
    # What is held has a prior a million times as narrow; others one as wide as the file is commonly wrong.
    _, precision, _ = bench.known(dataclasses.replace(model, weight=4.0))
    priors = np.array([c.prior for c in bench.base])
    assert np.allclose(precision[: len(priors)] * priors**2, np.where(bench.held(model), 1e12, 4.0))


# --- sums ----------------------------------------------------------------------------------------


def _of_jacobian(jacobian: np.ndarray, residual: np.ndarray) -> Reduced:
    return Reduced(
        (residual**2).sum(1),
        np.einsum("wri,wr->wi", jacobian, residual),
        np.einsum("wri,wrj->wij", jacobian, jacobian),
    )


def _places(t: np.ndarray) -> Places:
    """Level, heading north, of one log."""
    shape = t.shape
    return Places(
        log=np.zeros(len(t), int),
        t=t,
        rotation=np.broadcast_to(np.eye(3), (*shape, 3, 3)),
        velocity=np.zeros((*shape, 6)),
        driven=np.zeros((*shape, 6)),
        signals={},
        played={},
    )


@pytest.mark.parametrize("doubted", [0.3, 3.0])
def test_intervals_hold_what_doubted_coefficients_shift(monkeypatch, doubted):
    """By draws: two numbers are estimated as if three others, which are wrong, were right.

    `doubted`: size of what the wrong ones do to a sample, in units of its noise.
    """
    rng = np.random.default_rng(0)
    windows, rows, draws = 20, 15, 300
    values = np.zeros((windows, 1, 6, 3))
    values[:, 0, range(3), range(3)] = 1.0
    monkeypatch.setattr(_answer, "couplings", lambda vehicle, places: values)
    bench: Any = object.__new__(Workbench)
    bench.base, bench.vehicle, bench.layout = (), boat(), SimpleNamespace(suspects=())
    bench.criteria = Criteria()
    held, errors = [], []
    for _ in range(draws):
        jacobian = rng.normal(size=(windows, rows, 2 + 6))
        # The wrong ones push where the estimated ones do, too.
        jacobian[:, :, 2:5] += jacobian[:, :, :1]
        truth = rng.normal(size=3)
        jacobian[:, :, 2:5] *= doubted / Criteria().file_error
        wrong = Criteria().file_error * truth
        y = jacobian[:, :, 2:5] @ wrong + rng.normal(size=(windows, rows))
        flat = jacobian[:, :, :2].reshape(-1, 2)
        z = np.linalg.lstsq(flat, y.ravel())[0]
        residual = (flat @ z - y.ravel()).reshape(windows, rows)
        knots = Knots(
            _of_jacobian(jacobian, residual),
            2,
            np.full(2, 1e-9),
            np.zeros(2),
            np.ones(6),
            _places(np.zeros((windows, 1))),
        )
        phi = float((residual**2).mean())
        model = Model((), z, jnp.zeros((windows, 12)), 0.0)
        now = Judged(model, knots.stats, phi, knots, phi, knots, False)
        white = np.linalg.inv(flat.T @ flat)
        std = np.sqrt(np.diag(white + _answer._considered(bench, now, False)))
        held.append(np.abs(z) < 1.96 * std)
        errors.append(np.abs(z) / np.sqrt(np.diag(white)))
    # Without them the intervals would hold far less often than they say.
    assert np.mean(np.array(errors)[:, 0] < 1.96) < 0.75
    # 300 draws of 95 % leave 92.5 % in one of fifty runs.
    assert np.mean(held, axis=0).min() > 0.925


@pytest.mark.parametrize(("length", "period"), [(300.0, 3.7), (600.0, 5.3), (1200.0, 8.9)])
def test_a_swell_is_found_in_a_long_log(length, period):
    """A force to the north and east at knots of unit information, against its own period and size."""
    t = np.arange(0.25, length, 0.5).reshape(-1, 8)
    windows, count = t.shape
    force = np.zeros((windows, count, 6))
    swing = np.sin(2 * np.pi * t / period + 0.7)
    force[..., 0], force[..., 1] = 2.0 * swing, -1.0 * swing
    identity = np.broadcast_to(np.eye(6 * count), (windows, 6 * count, 6 * count))
    flat = force.reshape(windows, -1)
    stats = Reduced((flat**2).sum(1), -flat, identity)
    found = Knots(stats, 0, np.zeros(0), np.zeros(0), np.ones(6), _places(t))
    saved, start = wave_start(found)
    assert saved > 0.9 * (flat**2).sum()
    # Within the width of the peak, from where a fit converges.
    assert start["period"] == pytest.approx(period, abs=0.3 * period**2 / length)
    assert np.hypot(start["north"], start["east"]) == pytest.approx(np.hypot(2.0, 1.0), rel=0.1)


def _finding(effect: str, *others: str) -> dict[str, Any]:
    same = [
        {"effect": name, "target": None, "log_evidence": 0.0, "indistinguishable": True} for name in others
    ]
    return {"effect": effect, "target": None, "since": None, "log_evidence": 9.0, "alternatives": same}


def test_one_finding_stands_for_one_cause_only():
    hidden = [{"accept": [[name, None]], "since": None, "parameters": {}} for name in ("waves", "payload")]
    answer = {"findings": hidden, "options": {}}
    vague = {"verdict": "explained", "findings": [_finding("trim", "waves", "payload")]}
    assert grade(answer, vague) == {"first": True, "whole": False}
    both = {"verdict": "explained", "findings": [_finding("trim", "waves"), _finding("payload")]}
    assert grade(answer, both) == {"first": True, "whole": True}
    wrong = {"findings": [_finding("linear_damping"), _finding("payload")]}
    assert first_judged({"findings": hidden, "options": {"misfit": True}}, wrong)["effect"] == "payload"
