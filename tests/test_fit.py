"""`fit`: recovery, honest standard errors, what the data do not determine, learned damping."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float

from jaxmarine._types import CHANNELS, SENSORS
from jaxmarine.effects import (
    CATALOGUE,
    ConstantWrench,
    Craft,
    Motion,
    Suspect,
    ThrusterGain,
    TurningLift,
    WrenchEffect,
)
from jaxmarine.fitting import Fit, FitError, _trajectory, fit
from jaxmarine.fitting._estimate import units
from jaxmarine.fitting._free import set_free
from jaxmarine.fitting._windows import cut
from jaxmarine.logs import Log, Rejected
from jaxmarine.networks import mlp_damping
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Input, Placed, State, Vehicle
from jaxmarine.vehicle_io import load_vehicle, packaged_vehicle, save_vehicle
from tests.boats import NOISE, boat, record, steps
from tests.crafts import packaged

SEEDS = 20


def everything(v: Vehicle):
    return v.added_mass, v.damping.linear, v.damping.quadratic


def wrong(v: Vehicle, *factors: float) -> Vehicle:
    """The vehicle with added mass, linear and quadratic damping times these factors."""
    return eqx.tree_at(everything, v, tuple(f * leaf for f, leaf in zip(factors, everything(v), strict=True)))


def values(found: Fit) -> np.ndarray:
    return np.array([p.value for p in found.parameters])


def planted(vehicle: Vehicle) -> np.ndarray:
    """What `everything` picks, entries that are not zero, in the order of a fit's table."""
    added, linear, quadratic = (np.asarray(leaf) for leaf in everything(vehicle))
    return np.concatenate(
        [
            [added[0, 0], added[1, 1], added[5, 1], added[5, 5]],
            np.diag(linear)[[0, 1, 5]],
            np.diag(quadratic)[[0, 1, 5]],
        ]
    )


@functools.cache
def many_fits(loss: str) -> tuple[Fit, ...]:
    """Fits of the same run under different noise, from a start that is far off."""
    start = wrong(boat(), 0.4, 2.5, 0.4)
    return tuple(
        fit(start, record(boat(), steps(), seed=s), everything, entries="nonzero", loss=loss)
        for s in range(SEEDS)
    )


# --- recovery ---------------------------------------------------------------------------------


def test_planted_parameters_are_recovered_from_a_wrong_start():
    truth, start = boat(), wrong(boat(), 0.4, 2.5, 0.4)
    log = record(truth, steps(), noise=dict.fromkeys(NOISE, 1e-6))
    blind = simulate(start, log, _rest()).channels
    assert np.abs(np.asarray(blind)[:, :2] - log.channels[:, :2]).max() > 1.0  # really wrong
    found = fit(start, log, everything, entries="nonzero")
    assert found.converged and found.result == "converged"
    # atol of the chi-square in units of the noise that the vehicle states
    np.testing.assert_allclose(values(found), planted(truth), rtol=1e-3)
    np.testing.assert_array_equal(found.start.added_mass, start.added_mass)
    names = [p.name for p in found.parameters]
    assert names[:4] == [
        "added_mass[surge]",
        "added_mass[sway]",
        "added_mass[yaw,sway]",
        "added_mass[yaw]",
    ]
    np.testing.assert_allclose([p.start for p in found.parameters], planted(start), atol=1e-12)


def test_what_a_hull_alike_on_both_sides_couples():
    freed, scales = set_free(packaged("bluerov2_heavy"), lambda v: v.added_mass, 0.3, "coupled")
    joined = {"heave,surge", "pitch,surge", "pitch,heave", "roll,sway", "yaw,sway", "yaw,roll"}
    assert {name for name in freed.names if "," in name} == {f"added_mass[{pair}]" for pair in joined}
    # 0.3 of the root of (13.5 + 18.68) kg and (0.23 + 0.135) kg m².
    widths = dict(zip(freed.names, scales.prior, strict=True))
    assert widths["added_mass[pitch,heave]"] == pytest.approx(0.3 * np.sqrt(32.18 * 0.365))


@pytest.mark.parametrize(
    "channels",
    ["u r", *(pytest.param(one, marks=pytest.mark.slow) for one in ("x y psi", "u v r", "x y r", "psi u v"))],
)
def test_any_subset_of_the_channels_will_do(channels):
    """Positions alone, velocities alone, no attitude rates, no heading: what is there is compared."""
    log = record(boat(), steps())
    seen = np.where(np.isin(CHANNELS, channels.split()), log.channels, np.nan)
    found = fit(
        wrong(boat(), 0.4, 2.5, 0.4), dataclasses.replace(log, channels=seen), everything, entries="nonzero"
    )
    std = np.array([p.std_model for p in found.parameters])
    assert found.converged and (np.abs(values(found) - planted(boat())) < 4.0 * std).all()


def test_starts_as_measured_recover_without_noise():
    log = record(boat(), steps(), noise=dict.fromkeys(NOISE, 1e-6))
    found = fit(
        wrong(boat(), 0.9, 1.2, 0.9), log, everything, entries="nonzero", starts="measured", window=20.0
    )
    # The smoothing of the log moves the starts: 14 % at windows of 4 s, 7 % at 20 s, which forget them.
    np.testing.assert_allclose(values(found), planted(boat()), rtol=0.1)


@pytest.mark.parametrize(("starts", "loss"), [("guessed", "trajectory"), ("measured", "one_step")])
def test_starts_that_there_are_not_are_refused(unchecked, starts, loss):
    with pytest.raises(ValueError, match="starts"):
        fit(boat(), record(boat(), steps()), everything, starts=starts, loss=loss)


def test_no_window_begins_faster_than_the_craft_goes():
    """A model that stops turning at once would have windows begin at any rate, which no sensor holds."""
    log = record(boat(), steps())
    seen = np.where(np.isin(CHANNELS, ["u", "v", "psi"]), log.channels, np.nan)
    log = dataclasses.replace(log, channels=seen)
    stiff = eqx.tree_at(lambda v: v.damping.quadratic, boat(), boat().damping.quadratic.at[5, 5].mul(10.0))
    freed, scales = set_free(stiff, lambda v: v.damping.linear, None, "diagonal")
    # Weights are what such a model misses, far more than the sensors' noise.
    noise = np.where(np.isfinite(seen).any(axis=0), 100 * np.repeat([*NOISE.values(), 1.0, 1.0], 3), np.nan)
    data = cut(stiff, (log,), noise, 4.0)
    task = _trajectory.window_task(
        freed,
        units(freed, scales),
        data,
        _trajectory.segments(stiff, (log,)),
        1,
        False,
        data.speeds,
    )
    held = eqx.tree_at(lambda t: t.affine.columns, task, jnp.zeros_like(task.affine.columns))
    found = _trajectory.refine_windows(held, jnp.zeros(3), jnp.zeros((data.windows.count, 12)), 100)
    assert found.converged and np.isfinite(found.cost)
    fastest = np.abs(np.asarray(data.records.velocity)[..., 5]).max()
    assert np.abs(np.asarray(found.delta)[:, 11]).max() < fastest


def test_costly_windows_are_rejected():
    """A speed sensor that fails in two of ten windows spoils a fit; rejected, they cost some precision."""
    log = record(boat(), steps(), seed=0)
    failed = (log.t >= 20.0) & (log.t < 24.0) | (log.t >= 32.0) & (log.t < 36.0)
    channels = log.channels.copy()
    u = CHANNELS.index("u")
    channels[failed, u] += np.where(log.t[failed] % 4.0 < 2.0, 0.3, -0.3)
    spoilt, start = dataclasses.replace(log, channels=channels), wrong(boat(), 0.4, 2.5, 0.4)
    found = fit(start, spoilt, everything, entries="nonzero", reject=True)
    assert found.rejected.tolist() == pytest.approx([20.0, 32.0])
    assert f"{len(found.rejected)} windows rejected" in str(found)
    std = np.array([p.std_model for p in found.parameters])
    # Ten parameters within four standard errors: one false alarm in 1600.
    assert (np.abs(values(found) - planted(boat())) < 4.0 * std).all()
    kept = fit(start, spoilt, everything, entries="nonzero", throw=False)
    assert (np.abs(values(kept) - planted(boat())) > 4.0 * std).any()
    with pytest.raises(ValueError, match="reject"):
        fit(boat(), log, everything, loss="one_step", reject=True)


def test_nothing_but_the_free_axes_of_the_free_leaves_changes():
    found = many_fits("trajectory")[0]
    kept = np.ones((6, 6), bool)
    kept[np.ix_([0, 1, 5], [0, 1, 5])] = False
    for before, after in zip(everything(found.start), everything(found.vehicle), strict=True):
        np.testing.assert_array_equal(np.asarray(before)[kept], np.asarray(after)[kept])
    restored = eqx.tree_at(everything, found.vehicle, everything(found.start))
    assert eqx.tree_equal(restored, found.start)


def test_one_step_recovers_without_noise_and_goes_on_past_accidents():
    """Half a second is left out of every quarter of the log."""
    exact = dict.fromkeys(SENSORS, 1e-7)
    log = record(boat(), steps(), noise=exact)
    begins = log.t[0] + log.duration * np.array([0.15, 0.4, 0.65, 0.9])
    accidents = tuple(Rejected(log.name, begin, begin + 0.5, "collision") for begin in begins)
    channels = np.array(log.channels)
    for one in accidents:
        channels[(log.t >= one.start) & (log.t <= one.end)] = np.nan
    log = dataclasses.replace(log, channels=channels, rejected=accidents)
    found = fit(wrong(boat(), 0.4, 2.5, 0.4), log, everything, entries="nonzero", loss="one_step")
    np.testing.assert_allclose(values(found), planted(boat()), rtol=1e-4)


@pytest.mark.slow
def test_thrust_ahead_and_astern_and_its_curve_are_found():
    """The file knows of neither: it begins with as much astern as ahead, and in proportion to the command."""

    def of_thrust(v: Vehicle):
        return v.thrusters.max_thrust, v.thrusters.max_thrust_reverse, v.thrusters.quadratic

    truth = [np.array(row) for row in ([44.0, 38.0, 30.0], [30.0, 34.0, 33.0], [0.3, 0.0, -0.2])]
    log = record(eqx.tree_at(of_thrust, boat(), tuple(map(jnp.asarray, truth))), steps(), seed=3)
    found = fit(boat(), log, of_thrust)
    std = np.array([p.std_model for p in found.parameters])
    assert np.abs((values(found) - np.concatenate(truth)) / std).max() < 4.0  # nine normal numbers
    assert (std < 0.05 * np.concatenate([truth[0], truth[0], np.full(3, 2.0)])).all()
    np.testing.assert_array_equal([p.start for p in found.parameters], [40, 40, 30, 40, 40, 30, 0, 0, 0])


# --- standard errors --------------------------------------------------------------------------


def test_errors_of_many_noises_match_both_standard_errors():
    fits = many_fits("trajectory")
    errors = np.array([values(f) for f in fits]) - planted(boat())
    model = np.array([[p.std_model for p in f.parameters] for f in fits])
    sandwich = np.array([[p.std_sandwich for p in f.parameters] for f in fits])
    # The sum of squares over 20 seeds is chi-square: std ratios within 1 +- 3 / sqrt(40). The ten
    # windows of a sandwich scatter it by themselves.
    for std, room in ((model, 0.47), (sandwich, 0.55)):
        ratio = np.sqrt((errors**2).mean(0) / (std**2).mean(0))
        np.testing.assert_allclose(ratio, 1.0, atol=room)
        assert abs(ratio.mean() - 1.0) < 0.2
    # Together the ten parameters of twenty seeds are a whole: nine in ten within 1.64.
    assert 0.82 < np.mean(np.abs(errors / model) < 1.645) < 0.97
    assert abs(np.mean([f.reduced_chi2 for f in fits]) - 1.0) < 0.03


def test_one_step_is_biased_by_sensor_noise_and_the_trajectory_is_not():
    seeds, noise = 6, dict.fromkeys(SENSORS, 0.02) | {"velocity": 0.1}
    start = boat()
    # The trajectory is given less: no accelerations.
    unused = {"trajectory": np.array([1.0] * 12 + [np.nan] * 6), "one_step": np.ones(18)}
    std = np.repeat([noise[kind] for kind in SENSORS], 3)
    error: dict[str, np.ndarray] = {}
    for loss in ("trajectory", "one_step"):
        fits = [
            fit(
                start,
                record(start, steps(), noise=noise, seed=100 + s),
                everything,
                entries="nonzero",
                loss=loss,
                noise=std * unused[loss],
            )
            for s in range(seeds)
        ]
        off = np.array([values(f) for f in fits]) - planted(start)
        error[loss] = off.mean(0) / (off.std(0, ddof=1) / np.sqrt(seeds))
    assert np.abs(error["trajectory"]).max() < 5.0  # the largest of ten t of five
    assert np.abs(error["one_step"]).max() > 8.0


# --- what is free -----------------------------------------------------------------------------


def test_thrust_astern_follows_that_ahead_unless_it_is_stated_or_freed():
    stated = eqx.tree_at(lambda v: v.thrusters.max_thrust_reverse, boat(), jnp.array([0.0, 35.0, 0.0]))

    def astern(free, raw, **options):
        freed, _ = set_free(stated, free, **options)
        return freed(freed.start * jnp.asarray(raw)).plant().drive.max_thrust_reverse

    def ahead(v: Vehicle):
        return v.thrusters.max_thrust

    np.testing.assert_allclose(astern(ahead, 2.0), [80.0, 35.0, 60.0])
    np.testing.assert_allclose(astern(lambda v: v.thrusters.max_thrust_reverse, 0.5), [20.0, 17.5, 15.0])

    def both(v: Vehicle):
        return v.thrusters.max_thrust, v.thrusters.max_thrust_reverse

    np.testing.assert_allclose(astern(both, [2.0, 2.0, 2.0, 0.5, 0.5, 0.5]), [20.0, 17.5, 15.0])
    # What a prior holds is as it was: stated, or as ahead.
    held = np.full(3, np.inf), np.array([0.0, 0.0, np.inf])
    np.testing.assert_allclose(astern(both, [2.0, 2.0, 2.0, 0.5], prior=held), [80.0, 35.0, 15.0])


def test_a_prior_of_a_number_that_is_zero_is_as_wide_as_one():
    _, scales = set_free(boat(), lambda v: (v.thrusters.quadratic, v.thrusters.max_thrust_reverse), prior=0.3)
    np.testing.assert_allclose(scales.prior, [0.3, 0.3, 0.3, 12.0, 12.0, 9.0])
    # Of thrust that is lost to the flow, as what leaves none of 40 and 30 N at 1 m/s.
    _, scales = set_free(boat(), lambda v: v.thrusters.advance_loss, prior=0.3)
    np.testing.assert_allclose(scales.prior, [12.0, 12.0, 9.0])


# --- what the data do not determine -----------------------------------------------------------


def test_an_axis_at_rest_is_reported():
    """Noise in its estimated initial states looks like motion that determines its parameters."""
    commands = steps()
    commands[:, 2] = 0.0  # straight on: both astern alike, the bow thruster off
    commands[:, 1] = commands[:, 0]
    # A prior on the added mass keeps the solve short; the information does not count it.
    spreads = (jnp.full((6, 6), 0.1), *[jnp.full((6, 6), jnp.inf)] * 2)
    log = record(boat(), commands, seed=1)
    still = fit(boat(), log, everything, entries="nonzero", prior=spreads)
    named = {name for c in still.undetermined for name, _ in c.weights}
    leaves = ("added_mass", "damping.linear", "damping.quadratic")
    assert {f"{leaf}[{axis}]" for leaf in leaves for axis in ("sway", "yaw")} <= named
    assert not {f"{leaf}[surge]" for leaf in leaves} & named
    assert "not determined by the data" in repr(still)


def test_what_a_manoeuvre_shows_is_determined():
    moved = many_fits("trajectory")[0]
    assert not moved.undetermined
    assert np.all(np.diff(moved.information) >= 0)
    seen = {c.dof: c for c in moved.coverage}
    assert list(seen) == ["surge", "sway", "yaw"]
    log = record(boat(), steps(), seed=0)
    assert abs(seen["surge"].velocity_std - np.std(log.channels[:, 6])) < 0.02


def test_a_prior_holds_what_it_names():
    tight = (jnp.full((6, 6), 1e-4), jnp.full((6, 6), jnp.inf), jnp.full((6, 6), jnp.inf))
    start = wrong(boat(), 1.0, 2.0, 0.5)
    log = record(boat(), steps(), seed=3)
    found = fit(start, log, everything, entries="nonzero", prior=tight)
    np.testing.assert_allclose(found.vehicle.added_mass, boat().added_mass, atol=1e-3)
    np.testing.assert_allclose([p.std_model for p in found.parameters[:4]], 1e-4, rtol=1e-2)
    free = many_fits("trajectory")[3]
    for name, truth in (("damping.linear[surge]", 20.0), ("damping.linear[sway]", 60.0)):
        assert found[name].std_model < free[name].std_model
        assert abs(found[name].value - truth) < 4.0 * found[name].std_model


# --- what is free -----------------------------------------------------------------------------


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from(["all", "nonzero", "diagonal"]))
def test_the_total_mass_stays_positive_whatever_the_numbers(seed: int, entries):
    vehicle = eqx.tree_at(
        lambda v: v.body.matrix, boat(), boat().body.matrix.at[0, 5].set(9.0).at[5, 0].set(9.0)
    )
    for leaf in (lambda v: v.added_mass, lambda v: v.body.matrix):
        freed, _ = set_free(vehicle, leaf, entries=entries)
        raw = freed.start + 2.0 * np.random.default_rng(seed).normal(size=freed.start.shape)
        total = np.asarray(freed(raw).mass_matrix)
        np.testing.assert_allclose(total, total.T, atol=1e-9 * np.abs(total).max())
        inside = total[np.ix_([0, 1, 5], [0, 1, 5])]
        assert np.linalg.eigvalsh(inside / np.sqrt(np.outer(*[np.diag(inside)] * 2))).min() > 0
        assert eqx.tree_equal(freed(freed.start), vehicle, rtol=1e-12, atol=1e-12)


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from(["all", "diagonal"]))
def test_dissipative_damping_takes_energy_whatever_the_numbers(seed: int, entries):
    rng = np.random.default_rng(seed)
    freed, _ = set_free(boat(), lambda v: v.damping.linear, entries=entries, dissipative=True)
    matrix = np.asarray(freed(freed.start + 30.0 * rng.normal(size=freed.start.shape)).damping.linear)
    velocity = rng.normal(size=(100, 6)) * boat().free
    assert np.einsum("ki,ij,kj->k", velocity, matrix, velocity).min() > -1e-9
    start = np.asarray(freed(freed.start).damping.linear)
    np.testing.assert_allclose(start, boat().damping.linear, atol=1e-9)
    if entries == "all":
        assert np.abs(matrix - matrix.T).max() > 1.0  # a gyroscopic part is allowed


def test_dissipative_holds_where_the_log_would_have_it_otherwise():
    truth = eqx.tree_at(lambda v: v.damping.linear, boat(), -0.2 * boat().damping.linear)
    found = fit(
        boat(),
        record(truth, steps(), noise=dict.fromkeys(SENSORS, 1e-3), seed=1),
        lambda v: v.damping.linear,
        entries="diagonal",
        dissipative=True,
        loss="one_step",
    )
    assert all(0.0 <= p.value < 0.05 * p.start for p in found.parameters)


def test_numbers_that_are_positive_by_what_they_are_stay_so():
    """Also where the file has none: damping then begins at next to nothing, and fades out."""
    ship = load_vehicle(packaged_vehicle("kvlcc2"))

    def free(v):
        propeller, surface = v.actuators
        return v.damping.linear, propeller.kt, surface.lift_slope

    freed, scales = set_free(ship, free, prior=0.5, entries="diagonal")
    start = np.asarray(freed.entries(freed.start))
    mass = np.diag(np.asarray(ship.mass_matrix))[[0, 1, 5]]
    np.testing.assert_allclose(start, [*(2e-4 * mass), 0.2931, -0.2753, -0.1385, 2.747], rtol=1e-9)
    # Far above, a standard deviation is half of the size: 0.2 of the mass a second.
    damping = freed.parts[0]
    far = np.asarray(damping.entries(damping.start + 1e6)) - np.asarray(damping.entries(damping.start + 9e5))
    np.testing.assert_allclose(far, 1e5, rtol=1e-4)
    np.testing.assert_allclose(2.0 * scales.prior[:3], 0.5 * 0.2 * mass)
    low = np.asarray(freed.entries(freed.start - 5.0))
    assert (low[[0, 1, 2, 3, 6]] > 0).all() and (low[[0, 1, 2]] < start[:3]).all() and low[4] < -5.0


def test_a_hulls_lift_that_the_file_lacks_is_held_by_mass_and_length():
    vehicle = boat().place(Placed(TurningLift.neutral(boat()), None))
    _, scales = set_free(vehicle, lambda v: v.placed[0].effect, prior=0.3)
    mass = float(vehicle.body.mass)
    length = 4.0 * np.sqrt(float(vehicle.body.matrix[5, 5]) / mass)
    np.testing.assert_allclose(scales.prior, [0.3 * mass, 0.3 * mass * length])


@pytest.mark.slow
def test_a_solve_that_damping_has_stopped_begins_anew(monkeypatch):
    """The last solve is made to end far off, by a damping under which a step promises nothing."""
    log, start = record(boat(), steps(200), seed=3), wrong(boat(), 1.0, 1.6, 1.0)
    usual, heavy = _trajectory.refine_windows, []

    def slowed(task, z, delta, max_steps, *rtol):
        if rtol == (_trajectory.FINE,) and not heavy:
            heavy.append(True)
            return usual(task, 0 * z, delta, max_steps, *rtol, 1e7)
        return usual(task, z, delta, max_steps, *rtol)

    def found():
        return values(fit(start, log, lambda v: v.damping.linear, entries="diagonal"))

    expected = found()
    monkeypatch.setattr(_trajectory, "refine_windows", slowed)
    np.testing.assert_allclose(found(), expected, rtol=1e-3)
    assert heavy


def test_an_effect_is_freed_on_its_target_only():
    gain = Placed(ThrusterGain.neutral(boat()), "all")
    push = Placed(ConstantWrench.neutral(boat()), "sway")
    vehicle = boat().place(gain, push)
    freed, _ = set_free(vehicle, lambda v: (v.placed[0].effect.factor, v.placed[1].effect.value))
    assert freed.names == ("thruster_gain:all.factor", "constant_wrench:sway.value")
    changed = freed(jnp.array([0.7, 3.0]))
    np.testing.assert_array_equal(changed.placed[0].effect.factor, [0.7, 0.7, 0.7])
    np.testing.assert_array_equal(changed.placed[1].effect.value, [0, 3.0, 0, 0, 0, 0])


def test_a_prior_relative_to_the_file_does_not_hold_an_effect_that_is_none_yet():
    gain = Placed(ThrusterGain.neutral(boat()), "all")
    push = Placed(ConstantWrench.neutral(boat()), "sway")
    vehicle = boat().place(gain, push)
    _, scales = set_free(vehicle, lambda v: tuple(p.effect for p in v.placed), prior=0.3)
    np.testing.assert_allclose(scales.prior, [0.3, np.inf])


@pytest.mark.parametrize(
    ("free", "options", "says"),
    [
        (lambda v: v.mass_matrix, {}, "pick leaves"),
        (lambda v: 1.0, {}, "must return leaves"),
        (lambda v: (v.added_mass, v.body.matrix), {}, "only their sum"),
        (lambda v: (v.added_mass, v.added_mass), {}, "twice"),
        (lambda v: v.added_mass, {"prior": -0.1}, "positive"),
        (lambda v: v.added_mass, {"prior": (1.0, 1.0)}, "free\\(vehicle\\)"),
        (lambda v: v.added_mass, {"entries": "some"}, "one of all"),
        (lambda v: v.added_mass, {"prior": 0.0 * jnp.ones((6, 6))}, "nothing free"),
        (lambda v: v.added_mass, {"prior": jnp.ones((6, 6)).at[[1, 5], [5, 1]].set(0.0)}, "give it a width"),
    ],
)
def test_what_cannot_be_free_is_said(unchecked, free, options, says: str):
    with pytest.raises(ValueError, match=says):
        set_free(boat(), free, **options)


@pytest.mark.parametrize("leaf", ["max_thrust", "max_thrust_reverse", "quadratic"])
def test_a_craft_without_thrusters_has_none_to_free(leaf: str):
    torpedo = packaged("remus100")
    with pytest.raises(ValueError, match="nothing free: what it names is empty"):
        set_free(torpedo, lambda v: getattr(v.thrusters, leaf), 0.3)


@pytest.mark.parametrize(
    ("free", "options", "says"),
    [
        (lambda v: v.added_mass, {}, "start with larger entries"),
        (lambda v: v.damping.linear, {"entries": "diagonal", "dissipative": True}, "free those off"),
    ],
)
def test_a_start_that_is_not_positive_is_refused(free, options, says: str):
    coupled = eqx.tree_at(free, boat(), replace_fn=lambda matrix: matrix + 1e3 * (1.0 - jnp.eye(6)))
    with pytest.raises(ValueError, match=says):
        set_free(coupled, free, **options)


def test_too_few_steps_raise_with_advice_or_stand_in_the_result():
    log, start = record(boat(), steps()), wrong(boat(), 0.4, 2.5, 0.4)
    with pytest.raises(FitError, match="raise `max_steps`"):
        fit(start, log, everything, entries="nonzero", max_steps=1)
    found = fit(start, log, everything, entries="nonzero", max_steps=1, throw=False)
    assert not found.converged and "max_steps" in found.result


def test_the_table_shows_start_value_and_error():
    found = many_fits("trajectory")[0]
    row = next(line for line in repr(found).splitlines() if line.startswith("damping.linear[surge]"))
    parameter = found["damping.linear[surge]"]
    start, value, model, sandwich = (float(cell) for cell in row.split()[1:])
    assert start == 50.0
    np.testing.assert_allclose(value, parameter.value, rtol=1e-4)
    np.testing.assert_allclose([model, sandwich], [parameter.std_model, parameter.std_sandwich], rtol=0.05)


# --- learned damping --------------------------------------------------------------------------


class CubicDamping(WrenchEffect):
    """Drag with the cube of the velocity, which no linear-plus-quadratic drag is."""

    name = "cubic_damping"
    units = {"value": "N s³/m³"}

    value: Float[Array, ""]

    @classmethod
    def neutral(cls, craft: Craft) -> "CubicDamping":
        del craft
        return cls(jnp.zeros(()))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        del craft
        return ()

    def __call__(self, motion: Motion) -> Float[Array, "6"]:
        return jnp.zeros(6).at[0].set(-self.value * motion.nu_r[0] ** 3)


def _surge(linear: float, quadratic: float) -> Vehicle:
    bare = boat(("surge",))
    return eqx.tree_at(
        lambda v: (v.damping.linear, v.damping.quadratic),
        bare,
        (
            bare.damping.linear.at[0, 0].set(linear),
            bare.damping.quadratic.at[0, 0].set(quadratic),
        ),
    )


def _rest() -> State:
    return initial_state(boat())


def _prediction_error(vehicle: Vehicle, truth: Vehicle) -> float:
    """Root mean square error of u over open-loop predictions of 5 s on commands not seen before."""
    log = record(truth, 0.8 * steps(seed=9), noise=dict.fromkeys(NOISE, 0.0))
    states = simulate(truth, log, _rest()).states
    errors = []
    for k in range(0, 350, 50):
        part = dataclasses.replace(
            log,
            t=log.t[k : k + 50],
            channels=log.channels[k : k + 50],
            commands=log.commands[k : k + 50],
        )
        start = jax.tree.map(lambda a, k=k: a[k], states)
        errors.append(simulate(vehicle, part, start)["u"] - part.channels[:, 6])
    return float(np.sqrt(np.mean(np.square(errors))))


def _weights(v: Vehicle):
    return v.placed[0].effect.network


def _hybrid(vehicle: Vehicle) -> Vehicle:
    term = mlp_damping(("surge",), np.array([1.0]), np.array([20.0]), jax.random.key(0))
    return vehicle.place(Placed(term))


def _fit_hybrid(vehicle: Vehicle, log: Log, spread: float, loss: str) -> Fit:
    """Damping free, and the network within `spread`: a tiny one leaves the classical drag alone."""

    def free(v: Vehicle):
        return v.damping.linear, v.damping.quadratic, _weights(v)

    wide = jnp.full((6, 6), jnp.inf)
    spreads = jax.tree.map(lambda a: jnp.full_like(a, spread), _weights(vehicle))
    prior = (wide, wide, spreads)
    return fit(vehicle, log, free, entries="diagonal", prior=prior, loss=loss, max_steps=300)


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "times_better"), [("trajectory", 4.0), ("one_step", 2.0)])
def test_a_network_learns_damping_that_is_neither_linear_nor_quadratic(loss, times_better):
    truth = _surge(2.0, 0.0).place(Placed(CubicDamping(jnp.asarray(60.0))))
    start = _hybrid(_surge(6.0, 90.0))
    log = record(truth, steps(), seed=4)
    classical = _fit_hybrid(start, log, 1e-6, loss)
    best = _prediction_error(classical.vehicle, truth)
    assert _prediction_error(start, truth) > 3.0 * best  # the start is really wrong
    hybrid = _fit_hybrid(start, log, 3.0, loss)
    assert _prediction_error(hybrid.vehicle, truth) < best / times_better
    np.testing.assert_allclose(hybrid.reduced_chi2, 1.0, atol=0.15)


def test_an_unfitted_network_is_the_physics_and_a_fitted_one_is_zero_at_rest():
    vehicle = _hybrid(_surge(6.0, 90.0))
    still, moving = jnp.zeros(6), jnp.array([0.7, 0.0, 0.0, 0.0, 0.0, 0.0])
    drive = Input(jnp.zeros(3), jnp.zeros(3), jnp.zeros(6), jnp.zeros(()))

    def force(v: Vehicle, nu):
        state = dataclasses.replace(_rest(), velocity=nu)
        return np.asarray(v.plant().balance(state, jnp.zeros(6), drive))

    np.testing.assert_array_equal(force(vehicle, moving), force(_surge(6.0, 90.0), moving))
    rng = np.random.default_rng(0)
    trained = eqx.tree_at(
        lambda v: jax.tree.leaves(_weights(v)),
        vehicle,
        [jnp.asarray(rng.normal(size=a.shape)) for a in jax.tree.leaves(_weights(vehicle))],
    )
    np.testing.assert_array_equal(force(trained, still), np.zeros(6))
    assert abs(force(trained, moving)[0] - force(vehicle, moving)[0]) > 0.1


def test_a_learned_damping_is_stored_beside_the_vehicle(tmp_path):
    vehicle = _hybrid(_surge(6.0, 90.0))
    rng = np.random.default_rng(1)
    vehicle = eqx.tree_at(
        lambda v: jax.tree.leaves(_weights(v)),
        vehicle,
        [jnp.asarray(rng.normal(size=a.shape)) for a in jax.tree.leaves(_weights(vehicle))],
    )
    save_vehicle(vehicle, tmp_path / "boat.toml")
    assert eqx.tree_equal(load_vehicle(tmp_path / "boat.toml", CATALOGUE), vehicle)
