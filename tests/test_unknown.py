"""Dependences of a missing wrench on made-up knots, whose cause is known by construction."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from experiments.blind.outside import play
from jaxmarine.diagnosis import _unknown
from jaxmarine.diagnosis._explanation import Model
from jaxmarine.diagnosis._knots import Knots, on_axis
from jaxmarine.diagnosis._learn import learn
from jaxmarine.diagnosis._score import Reduced, blocks
from jaxmarine.diagnosis._search import nats
from jaxmarine.diagnosis._signals import Places, _played
from jaxmarine.diagnosis._unknown import (
    RIDGES,
    Dependence,
    _evidence,
    _left_out,
    _Shapes,
    acting,
    cost_of_removal,
    dependences,
    likely,
    nats_beside,
    size_only,
    tried_nats,
)
from jaxmarine.diagnosis._unnamed import _scatters_beside
from jaxmarine.diagnosis._workbench import Workbench
from jaxmarine.physics import from_euler, rotation

WINDOWS, KNOTS, HEAVE = 60, 8, 2
SHAPE = (WINDOWS, KNOTS)
# Standard deviation with which a window determines a knot [N].
STD = 0.1


@pytest.mark.parametrize("windows", [5, 40, 75])
def test_regressions_on_left_out_windows_are_made_one_by_one(windows):
    """Each window's response by least squares with rows of its own for the pull, without its fold."""
    rng = np.random.default_rng(windows)
    y, values = rng.normal(size=(windows, 3)), rng.normal(size=(windows, 3, 4))
    weight = rng.uniform(0.5, 2.0, size=y.shape)
    found = _left_out(y, weight, values)
    each = np.broadcast_to(weight[..., None], values.shape)
    centred = values - np.average(values, axis=(0, 1), weights=each)
    x = centred / np.sqrt(np.average(centred**2, axis=(0, 1), weights=each))
    x = np.concatenate([x, np.ones((*y.shape, 1))], axis=2)
    fold = blocks(windows)
    for w in range(windows):
        mine = np.flatnonzero(fold == fold[w])
        rest = [i for i in range(windows) if np.abs(mine - i).min() > 1]
        root = np.sqrt(weight[rest].ravel())
        for ridge, got in zip(RIDGES, found, strict=True):
            pull = np.sqrt(ridge * weight.sum()) * np.eye(4, 5)
            rows = np.concatenate([root[:, None] * x[rest].reshape(-1, 5), pull])
            right = np.concatenate([root * y[rest].ravel(), np.zeros(4)])
            expected = x[w] @ np.linalg.lstsq(rows, right)[0]
            np.testing.assert_allclose(got[w], expected, atol=1e-9)


def drift(rng: np.random.Generator, slow: float) -> np.ndarray:
    """A first-order Gauss-Markov signal of unit size along all knots; `slow`: knots that it remembers."""
    decay = np.exp(-1.0 / slow)
    out = np.zeros(WINDOWS * KNOTS)
    for i, kick in enumerate(rng.normal(size=out.size)[1:], 1):
        out[i] = decay * out[i - 1] + np.sqrt(1 - decay**2) * kick
    return out.reshape(SHAPE)


def knots_with(
    heave: np.ndarray,
    signals: dict[str, np.ndarray],
    rng: np.random.Generator,
    driven: np.ndarray | None = None,
    **played,
) -> Knots:
    """Knots of a craft free in heave that misses a given force, with noise; the rest as in `Places`."""
    wrench = np.zeros((*SHAPE, 6))
    wrench[..., HEAVE] = heave
    information = np.zeros(6)
    information[HEAVE] = STD**-2.0
    h = np.tile(np.diag(np.tile(information, KNOTS)), (WINDOWS, 1, 1))
    seen = wrench + STD * rng.normal(size=wrench.shape)
    g = -np.einsum("wab,wb->wa", h, seen.reshape(WINDOWS, -1))
    free = np.zeros(6)
    free[HEAVE] = 1.0
    return Knots(
        stats=Reduced(np.ones(WINDOWS), g, h),
        width=0,
        precision=np.zeros(0),
        offset=np.zeros(0),
        free=free,
        places=Places(
            t=np.arange(WINDOWS * KNOTS, dtype=float).reshape(SHAPE),
            log=np.zeros(WINDOWS, int),
            rotation=np.tile(np.eye(3), (*SHAPE, 1, 1)),
            velocity=np.zeros((*SHAPE, 6)),
            driven=np.zeros((*SHAPE, 6)) if driven is None else driven,
            signals=signals,
            played=played,
        ),
    )


@pytest.mark.parametrize(
    ("names", "force"),
    [
        (("z",), lambda s: np.sin(2 * np.pi * s["z"] / 2.0)),
        (("u",), lambda s: np.abs(s["u"]) * s["u"]),
        (("psi", "u"), lambda s: s["u"] * np.sin(2 * s["psi"])),
        (("y",), lambda s: np.cos(s["y"])),
    ],
    ids=[
        "a place, in waves",
        "a velocity, squared",
        "a heading and a velocity together",
        "a place, many times along the way",
    ],
)
def test_the_signals_of_a_missing_force_are_named(names, force):
    rng = np.random.default_rng(3)
    signals = {name: drift(rng, 4.0) for name in ("z", "u", "w", "port")}
    signals["psi"] = np.pi * drift(rng, 4.0)
    signals["y"] = np.cumsum(0.35 + 0.5 * signals["u"].ravel()).reshape(SHAPE) % 40.0
    (found,) = dependences(knots_with(force(signals), signals, rng), 1.0)
    assert found.dof == "heave"
    assert set(found.signals) == set(names)


@pytest.mark.parametrize("seed", [1, 4])
def test_a_force_that_is_large_in_few_windows_is_blamed_on_all_harmonics_of_the_heading(seed):
    """Savings of 2.5 and 3.2 standard errors, though they are nearly all that can be saved."""
    rng = np.random.default_rng(seed)
    signals = {name: drift(rng, 4.0) for name in ("z", "w", "port")}
    signals["u"] = drift(rng, 8.0)
    signals["u"] *= np.abs(signals["u"])
    signals["psi"] = np.cumsum(0.2 + 0.3 * drift(rng, 8.0).ravel()).reshape(SHAPE)
    turns = np.arange(1, 7) * signals["psi"][..., None] + rng.uniform(0.0, 6.0, 6)
    force = 0.5 * signals["u"] * np.cos(turns).sum(-1)
    looked_at = knots_with(force, signals, rng)
    (found,) = dependences(looked_at, 1.0, {"u": signals["u"]})
    assert set(found.signals) == {"psi", "u"}
    # With its sign drawn afresh for each window it goes with nothing, however large it is in few.
    erratic = np.abs(force) * rng.choice([-1.0, 1.0], (WINDOWS, 1))
    assert dependences(knots_with(erratic, signals, rng), 1.0) == ()


def test_a_lift_is_blamed_on_the_speed_however_much_of_it_a_constant_would_save():
    """What must be explained is what a constant leaves: of a force of one sign that is the smaller part."""
    rng = np.random.default_rng(2)
    signals = {name: drift(rng, 4.0) for name in ("z", "w", "port")}
    signals["u"] = 1.0 + drift(rng, 8.0) ** 2
    (found,) = dependences(knots_with(signals["u"] ** 2, signals, rng), 1.0)
    assert found.signals == ("u",)


def test_a_force_that_depends_on_nothing_is_not_blamed_on_a_signal():
    rng = np.random.default_rng(4)
    signals = {name: drift(rng, 4.0) for name in ("z", "u", "w", "port")}
    assert dependences(knots_with(drift(rng, 3.0), signals, rng), 5.0) == ()


def test_a_velocity_that_a_disturbance_has_caused_is_not_its_cause():
    rng = np.random.default_rng(5)
    push, told = drift(rng, 3.0), drift(rng, 4.0)
    # What the commands make of the velocity, and what the disturbance adds to it.
    signals = {"u": drift(rng, 4.0), "w": told + 0.7 * push}
    moved = knots_with(push, signals, rng)
    assert [found.signals for found in dependences(moved, 1.0)] == [("w",)]
    assert dependences(moved, 1.0, {"w": told}) == ()
    # A drag that the file lacks shows on both.
    lacking = knots_with(-0.8 * signals["w"] + 0.3 * push, signals, rng)
    assert [found.signals for found in dependences(lacking, 1.0, {"w": told})] == [("w",)]


def test_a_force_that_only_the_driven_craft_lacks_is_no_disturbance():
    """Its size goes with a command, its value, drawn afresh for each window, with nothing."""
    rng = np.random.default_rng(12)
    signals = {name: drift(rng, 4.0) for name in ("u", "port")}
    signals["port"] *= np.arange(len(signals["port"]))[:, None] % 3 == 0
    erratic = rng.normal(size=(len(signals["port"]), 1))

    def looked_at(force: np.ndarray) -> Knots:
        k = knots_with(force, signals, rng, port=np.zeros((*SHAPE, 1)))
        chi2 = (STD * k.stats.g[:, HEAVE::6]) ** 2
        return dataclasses.replace(k, stats=dataclasses.replace(k.stats, chi2=chi2.sum(axis=1)))

    missing = looked_at(10.0 * erratic * signals["port"])
    assert dependences(missing, 5.0) == ()
    (found,) = size_only(missing, 5.0, None, 1.0)
    assert (found.dof, found.signals, found.size_only) == ("heave", ("port",), True)
    # The same size at all times is a disturbance.
    assert size_only(looked_at(drift(rng, 3.0)), 5.0, None, 1.0) == ()


def test_what_a_coupling_of_the_file_may_be_off_by_is_not_unknown():
    rng = np.random.default_rng(8)
    signals = {name: drift(rng, 4.0) for name in ("u", "w")}
    coupling = 2.0 * signals["u"]

    def left(force: np.ndarray) -> list[tuple[str, ...]]:
        missing = knots_with(force, signals, rng)
        assert [found.signals for found in dependences(missing, 1.0)] == [("u",)]
        bent = missing.beside(on_axis(HEAVE, coupling[..., None]), 0.1)
        # Independent of `beside`: the change of chi-square by the wrench that has now been added.
        push = bent.stats.g - missing.stats.g
        added = np.linalg.solve(missing.stats.h[0][2::6, 2::6], push[:, 2::6].T).T
        chi2 = (2 * missing.stats.g[:, 2::6] * added + push[:, 2::6] * added).sum(1)
        np.testing.assert_allclose(bent.stats.chi2 - missing.stats.chi2, chi2, rtol=1e-9)
        return [found.signals for found in dependences(bent, 1.0)]

    assert left(0.1 * coupling) == []
    assert left(0.1 * coupling + 0.3 * np.abs(signals["u"]) * signals["u"]) == [("u",)]


# --- memory of a command ----------------------------------------------------------------------


def test_a_play_is_that_of_another_program():
    commands = np.cumsum(np.random.default_rng(6).normal(size=(200, 2)), axis=0)
    widths = np.array([[0.5, 2.0], [1.0, 3.0]])
    for i, row in enumerate(widths):
        for j, width in enumerate(row):
            behind = _played(commands, widths)[:, i, j] * width
            np.testing.assert_allclose(behind, play(commands[:, i], width) - commands[:, i], atol=1e-12)


def backlash(rng: np.random.Generator) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """A force behind a backlash of a width that is none of the shapes', the signals, and their plays."""
    told = drift(rng, 6.0)
    signals = {"u": drift(rng, 4.0), "port": told}
    widths = np.abs(told).max() * np.array([[0.1, 0.2, 0.4, 0.8]])
    played = _played(told.reshape(-1, 1), widths)[:, 0].reshape(*SHAPE, 4)
    return play(told.ravel(), 0.9).reshape(SHAPE) - told, signals, played


def test_hysteresis_is_a_dependence_on_its_command():
    rng = np.random.default_rng(7)
    force, signals, played = backlash(rng)
    (found,) = dependences(knots_with(force, signals, rng, port=played), 1.0)
    assert found.signals == ("port",)
    # Without its memory a command says little of where within the backlash the thrust is.
    without = dependences(knots_with(force, signals, rng, port=played[..., :0]), 1.0)
    assert not without or without[0].saved < 0.5 * found.saved


# --- where and when ---------------------------------------------------------------------------


def test_velocities_are_those_through_the_water():
    turns = jax.vmap(jax.vmap(lambda a: rotation(from_euler(a))))
    angles = np.random.default_rng(10).uniform(-1.0, 1.0, (2, 3, 3))
    here = Places(
        t=np.zeros((2, 3)),
        log=np.zeros(2, int),
        rotation=np.asarray(turns(jnp.asarray(angles))),
        velocity=np.zeros((2, 3, 6)),
        driven=np.zeros((2, 3, 6)),
        signals={"u": np.ones((2, 3)), "w": np.zeros((2, 3)), "r": np.full((2, 3), 0.3)},
        played={},
    )
    water = np.array([0.3, -0.2, 0.1])
    moving = here.through_water(water, here.signals)
    for w, k in np.ndindex(2, 3):
        own = Rotation.from_euler("ZYX", angles[w, k, ::-1]).inv().apply(water)
        assert moving["u"][w, k] == pytest.approx(1.0 - own[0], abs=1e-12)
        assert moving["w"][w, k] == pytest.approx(-own[2], abs=1e-12)
    assert np.array_equal(moving["r"], here.signals["r"])


def test_a_drift_over_several_logs_is_named_but_not_learned():
    rng = np.random.default_rng(11)
    t = np.arange(WINDOWS * KNOTS, dtype=float).reshape(SHAPE)
    k = knots_with(np.sin(t / 100.0), {"t": t, "u": drift(rng, 4.0)}, rng)
    found = dependences(k, 1.0)
    assert found[0].signals == ("t",) and learn(k, found, ())
    later = np.repeat([0, 1], WINDOWS // 2)
    two = dataclasses.replace(k, places=dataclasses.replace(k.places, log=later))
    assert learn(two, found, ()) == ()


def test_thrusters_that_drift_together_are_named_together():
    # As of a sagging battery: two propellers that turn against one another, and one that has no part in it.
    rng = np.random.default_rng(12)
    t = np.arange(WINDOWS * KNOTS, dtype=float).reshape(SHAPE)
    commands = {name: 10.0 * drift(rng, 4.0) for name in ("port", "star", "bow")}
    force = 0.3 * np.sin(2 * np.pi * t / 130.0) * (commands["port"] - commands["star"])
    played = {name: _played(c.reshape(-1, 1), np.full((1, 4), 5.0))[:, 0] for name, c in commands.items()}
    played = {name: behind.reshape(*SHAPE, 4) for name, behind in played.items()}
    (found,) = dependences(knots_with(force, {"t": t, **commands}, rng, **played), 1.0)
    assert set(found.signals) == {"t", "port", "star"}


def test_drives_that_drift_alike_show_in_what_they_give_together():
    """Of eight, as by a battery: shapes of each, times swings, are more than the log tells."""
    rng = np.random.default_rng(13)
    t = np.arange(WINDOWS * KNOTS, dtype=float).reshape(SHAPE)
    commands = {f"t{i}": drift(rng, 4.0) for i in range(1, 9)}
    thrust = 10.0 * np.tensordot([1, -1, 1, 1, -1, 1, -1, 1], np.array(list(commands.values())), 1)
    driven = np.zeros((*SHAPE, 6))
    driven[..., HEAVE] = thrust
    played = {name: np.zeros((*SHAPE, 0)) for name in commands}
    force = 0.03 * np.sin(2 * np.pi * t / 130.0) * thrust
    k = knots_with(force, {"t": t, **commands}, rng, driven, **played)
    (found,) = dependences(k, 1.0)
    assert set(found.signals) == {"t", *commands} and not found.remembers
    blind = dataclasses.replace(k, places=dataclasses.replace(k.places, driven=np.zeros((*SHAPE, 6))))
    assert all(one.saved < 0.8 * found.saved for one in dependences(blind, 1.0))


@pytest.mark.parametrize("size", [1.0, 0.0])
def test_other_axes_are_looked_at_again_once_something_is_found(monkeypatch, size):
    """Which may act on them too. Where nothing is, each is looked at once."""
    rng, asked = np.random.default_rng(14), []
    signals = {name: drift(rng, 4.0) for name in ("z", "u")}
    k = knots_with(size * np.abs(signals["u"]) * signals["u"], signals, rng)
    k = dataclasses.replace(k, free=np.eye(6)[0] + np.eye(6)[HEAVE])
    best = _unknown._best_signals
    monkeypatch.setattr(
        _unknown, "_best_signals", lambda ledger, axis: asked.append(axis) or best(ledger, axis)
    )
    found = dependences(k, 1.0)
    assert [one.signals for one in found] == ([("u",)] if size else [])
    assert asked == ([0, HEAVE, 0] if size else [0, HEAVE])


# --- what is learned of it ----------------------------------------------------------------------


def test_a_network_learns_the_force_and_ends_beyond_the_places_seen():
    rng = np.random.default_rng(8)
    signals = {"z": drift(rng, 4.0), "u": drift(rng, 4.0)}
    k = knots_with(np.sin(2 * np.pi * signals["z"] / 2.0), signals, rng)
    (term,) = learn(k, dependences(k, 1.0), ())
    seen = np.quantile(signals["z"], [0.02, 0.98])
    z = np.linspace(*seen, 200)
    force = np.array([term.force(jnp.array([x]), term.network) for x in z])
    # Each knot is seen to 0.1 N, and some ten of them lie within the width of a turn.
    assert np.sqrt(np.mean((force - np.sin(np.pi * z)) ** 2)) < STD
    away = signals["z"].max() + 10.0
    assert float(term.force(jnp.array([away]), term.network)) == 0.0


def test_what_hangs_on_the_past_of_a_command_is_not_learned_as_if_it_did_not():
    rng = np.random.default_rng(9)
    force, signals, played = backlash(rng)
    k = knots_with(force, signals, rng, port=played)
    (found,) = dependences(k, 1.0)
    assert found.remembers and learn(k, (found,), ("port",)) == ()
    at_once = knots_with(np.abs(signals["port"]) * signals["port"], signals, rng, port=played)
    (found,) = dependences(at_once, 1.0)
    assert not found.remembers and learn(at_once, (found,), ("port",))


def test_evidence_of_shapes_of_one_size_is_that_of_the_gaussian():
    """Against the densities with and without them, over sizes; and the size at which it is largest."""
    rng = np.random.default_rng(11)
    x = rng.normal(size=(40, 3)) * [1.0, 2.0, 0.5]
    y = x @ [0.5, -0.4, 0.3] + rng.normal(size=40)
    nats, pull = _evidence(x.T @ x, -x.T @ y)

    def of(size: float) -> float:
        return float(multivariate_normal(np.zeros(40), np.eye(40) + size**2 * x @ x.T).logpdf(y))

    best = max(np.geomspace(0.01, 10.0, 400), key=of)
    # It looks at sizes a quarter apart, an eighth away at most.
    assert nats == pytest.approx(of(best) - of(0.0), abs=0.1)
    assert pull**-0.5 == pytest.approx(best, rel=0.15)


@dataclasses.dataclass(frozen=True)
class Slow(Knots):
    """A force in heave that is measured, amid one that lasts, whose size is estimated by the densities.

    And z, one number on a column that looks much like the force.
    """

    y: np.ndarray
    column: np.ndarray
    size: float

    def covariance(self, size: float) -> np.ndarray:
        ages = np.abs(np.subtract.outer(*[np.arange(self.y.size)] * 2))
        return STD**2 * np.eye(self.y.size) + size**2 * np.exp(-ages / 20.0)

    def density(self, size: float, more: np.ndarray | float = 0.0, y: np.ndarray | None = None) -> float:
        of = multivariate_normal(np.zeros(self.y.size), self.covariance(size) + more)
        return float(of.logpdf(self.y if y is None else y))

    def likeliest(self, y: np.ndarray) -> float:
        return max(np.geomspace(0.02, 5.0, 25), key=lambda size: self.density(size, y=y))

    def summed(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = np.column_stack([self.column, values[:, :, HEAVE].reshape(self.y.size, -1)])
        told = x.T @ np.linalg.inv(self.covariance(self.size))
        return -told @ self.y, told @ x

    def where(self, step: np.ndarray, wrench: np.ndarray) -> "Slow":
        size = self.likeliest(self.y - self.column * step - wrench[:, :, HEAVE].ravel())
        lost = self.density(self.size) - self.density(size)
        return dataclasses.replace(self, size=size, lost=self.lost + lost)


@pytest.mark.parametrize("force", [1.0, 0.0])
def test_what_lasts_is_estimated_again_beside_a_dependence_that_it_stood_in_for(force):
    """Against the dense Gaussian with both; and what goes with nothing is left to what lasts."""
    rng = np.random.default_rng(3)
    u = drift(rng, 20.0)
    lasting = np.linalg.cholesky(np.exp(-np.abs(np.subtract.outer(*[np.arange(u.size)] * 2)) / 20.0))
    y = force * u.ravel() + 0.1 * lasting @ rng.normal(size=u.size) + STD * rng.normal(size=u.size)
    whole = knots_with(u, {"u": u, "v": drift(rng, 6.0)}, rng)
    parts = {one.name: getattr(whole, one.name) for one in dataclasses.fields(Knots)}
    known = {"width": 1, "precision": np.ones(1), "offset": np.zeros(1)}
    k = Slow(**{**parts, **known}, y=y, column=np.tanh(3 * u.ravel()), size=1.0)
    k = dataclasses.replace(k, size=k.likeliest(y))
    one = Dependence(HEAVE, ("u",), (), 1.0, u[..., None], False)
    accepted, after = likely(k, (one,))
    assert [found.signals for found in accepted] == [("u",)] * bool(force)
    if not force:
        assert after is k
        return
    # It had stood in for most of the force.
    assert after.size < 0.3 * k.size and after.lost > 10.0
    shape = u.reshape(-1, 1)
    shape = shape / np.sqrt((shape**2).mean())
    either = np.outer(k.column, k.column)
    best = max(
        k.density(after.size, either + size**2 * shape @ shape.T) for size in np.geomspace(0.5, 2.0, 30)
    )
    more = nats_beside(after, accepted, 1.0)
    # What z may be is paid for with and without.
    paid = 0.5 * np.log(1.0 + k.column @ np.linalg.solve(k.covariance(k.size), k.column))
    assert more == pytest.approx(best - k.density(k.size) + paid - tried_nats(k), abs=0.1)
    alone = nats_beside(k, (), 1.0)
    assert accepted[0].saved == pytest.approx(2 * (more - alone))
    # Beside the one that stood in for it less was to be gained.
    assert nats_beside(k, accepted, 1.0) < more - 3.0


def test_regressors_at_samples_are_the_functions_that_they_are_at_the_knots():
    """Where they lie there, whatever others there are: a heading that is wrapped, and one far off."""
    rng = np.random.default_rng(2)
    heading, u = np.pi + 0.3 * drift(rng, 20.0), drift(rng, 20.0)
    knots = knots_with(u, {"psi": heading, "u": u}, rng).places
    turned = Rotation.from_euler("z", heading.reshape(-1, 1)).as_quat(scalar_first=True)
    states = np.concatenate(
        [np.zeros((*SHAPE, 3)), turned.reshape(*SHAPE, 4), np.zeros((*SHAPE, 6))], axis=-1
    )
    states[..., 7] = u
    states[0, 0, 7] = 50.0
    there = knots.in_states(states)
    np.testing.assert_allclose(there.signals["psi"], heading, atol=1e-9)
    here, at = (_Shapes(places, knots).of(("psi", "u")) for places in (knots, there))
    np.testing.assert_allclose(at[1:], here[1:], atol=1e-9)


def test_dependences_beside_known_numbers_are_worth_what_the_densities_say():
    """The restricted likelihood of a force that goes with u², a constant known beside it."""
    rng = np.random.default_rng(13)
    u = drift(rng, 6.0)
    signals = {"u": u, "v": drift(rng, 6.0)}
    force = u**2 + 0.5
    proposed = dependences(knots_with(force, signals, rng), 1.0)
    known = np.ones(u.size) / STD
    y = force.ravel() / STD + rng.normal(size=u.size)
    z = float(known @ y / (known @ known))
    rest = y - z * known

    # Columns: the known number, and the force at each knot on each axis.
    per_window = []
    for own in np.arange(u.size).reshape(SHAPE):
        knotted = np.einsum("ok,a->oka", np.eye(KNOTS) / STD, np.eye(6)[HEAVE]).reshape(KNOTS, -1)
        x = np.column_stack([known[own], knotted])
        per_window.append((-x.T @ rest[own], x.T @ x, rest[own] @ rest[own]))
    g, h, chi2 = (np.array([one[i] for one in per_window]) for i in range(3))
    k = knots_with(force, signals, rng)
    k = dataclasses.replace(
        k, stats=Reduced(chi2, g, h), width=1, precision=np.zeros(1), offset=np.array([z])
    )

    features = proposed[0].features.reshape(u.size, -1)
    features = features / np.sqrt((features**2).mean(axis=0)) / STD

    def restricted(size: float) -> float:
        """Log-density of y, the known number integrated out, less that at its fit."""
        v = np.eye(u.size) + size**2 * features @ features.T
        inverse = np.linalg.inv(v)
        told = known @ inverse @ known
        left = y - known * (known @ inverse @ y) / told
        shrunk = np.linalg.slogdet(v)[1] + np.log(told / (known @ known))
        return float(-0.5 * (left @ inverse @ left + shrunk))

    found = minimize_scalar(lambda x: -restricted(np.exp(x)), bounds=np.log([1e-3, 10.0]), method="bounded")
    gained = -float(found.fun) + 0.5 * float(rest @ rest)
    assert gained > 100.0
    # Sizes are looked at a quarter apart, and the knots' information is widened by a millionth. One of two
    # signals, and another, on each free axis.
    tried = np.log(2**2 * k.free.sum())
    assert nats_beside(k, proposed, 1.0) == pytest.approx(gained - tried, abs=0.2)
    # Scores that scatter four times as much tell a quarter as much.
    assert nats_beside(k, proposed, 4.0) < 0.3 * gained
    # Numbers that are not where they fit best are refitted, which gains what they are off by.
    off = dataclasses.replace(k, stats=Reduced(chi2, g + 0.1 * h[:, :, 0], h))
    more = 0.5 * 0.1**2 * float(known @ known)
    assert nats_beside(off, proposed, 1.0) == pytest.approx(gained - tried + more, abs=0.2)


@pytest.mark.parametrize("phi", [1.0, 5.0])
@pytest.mark.parametrize("held", [True, False])
def test_a_model_beside_two_dependences_is_as_likely_as_the_dense_gaussian_says(phi, held):
    """Coefficients under a prior and off by most of it, scores that scatter `phi` times as much as noise."""
    rng = np.random.default_rng(1)
    u, v = drift(rng, 6.0), drift(rng, 6.0)
    shapes = np.stack([u, u**2], -1), np.stack([v, np.abs(v) * v, v**3], -1)
    found = tuple(Dependence(HEAVE, (name,), (), 1.0, x, False) for name, x in zip("uv", shapes, strict=True))
    flat = [x.reshape(u.size, -1) for x in shapes]
    first, second = (x / np.sqrt((x**2).mean(axis=0)) for x in flat)
    x = rng.normal(size=(u.size, 3)) * [1.0, 2.0, 0.3] + 0.3 * u.reshape(-1, 1)
    prior = np.array([0.3, 0.2, 0.5])
    y = np.sqrt(phi) * rng.normal(size=u.size) + x @ (prior * [0.5, -1.0, 0.3])
    y = y + first @ [0.5, -0.3] + second @ [0.4, 0.2, 0.1]

    # Where the coefficients stand by an earlier refit, which does not matter.
    z = np.zeros(3) if held else prior * [0.4, -0.8, 0.1]
    precision = (1e12 if held else phi) / prior**2
    rest, per_window = x @ z - y, []
    for own in np.arange(u.size).reshape(SHAPE):
        knotted = np.einsum("ok,a->oka", np.eye(KNOTS), np.eye(6)[HEAVE]).reshape(KNOTS, -1)
        columns = np.column_stack([x[own], knotted])
        per_window.append((rest[own] @ rest[own], columns.T @ rest[own], columns.T @ columns))
    chi2, g, h = (np.array([one[i] for one in per_window]) for i in range(3))
    k = dataclasses.replace(
        knots_with(u, {"u": u, "v": v}, rng),
        stats=Reduced(chi2, g, h),
        width=3,
        precision=precision,
        offset=z,
    )
    bench: Any = object.__new__(Workbench)
    bench.base, bench.known = (0, 1, 2), lambda model: (np.eye(3), precision, z)
    cost = 0.5 * float(chi2.sum() + precision @ z**2)
    model = Model((), z, jnp.zeros((0, 12)), cost, frozen=held)
    told = nats(bench, model, Reduced(chi2, g[:, :3], h[:, :3, :3]), phi) + nats_beside(k, found, phi)

    def density(log_first: float, log_second: float) -> float:
        covariance = phi * np.eye(u.size) + sum(
            np.exp(2 * size) * shape @ shape.T for size, shape in ((log_first, first), (log_second, second))
        )
        if not held:
            covariance = covariance + (x * prior**2) @ x.T
        shrunk = np.linalg.slogdet(covariance)[1] - u.size * np.log(phi)
        return -0.5 * (shrunk + y @ np.linalg.solve(covariance, y))

    def best(of) -> float:
        return float(
            minimize_scalar(
                lambda size: -of(size), bounds=(-8.0, 4.0), method="bounded", options={"xatol": 0.02}
            ).x
        )

    # One after the other, each at the size at which it gains most.
    one = best(lambda size: density(size, -30.0))
    other = best(lambda size: density(one, size))
    tried = 2 * np.log(2**2 * k.free.sum())
    # Sizes are looked at a quarter apart.
    assert told == pytest.approx(density(one, other) - tried, abs=0.2)


def test_a_member_is_worth_what_it_saves_beside_dependences_by_scores_without_them():
    """Against dense least squares: one member that acts beside a force, and one that only resembles it."""
    rng = np.random.default_rng(5)
    u = drift(rng, 6.0)
    shapes = np.stack([u, u**2], -1)
    found = (Dependence(HEAVE, ("u",), (), 1.0, shapes, False),)
    x = np.stack([np.sin(0.3 * np.arange(u.size)), (u + 0.3 * rng.normal(size=SHAPE)).ravel()], -1)
    flat = shapes.reshape(u.size, -1)
    y = 0.5 * x[:, 0] + flat @ [3.0, -2.0] + rng.normal(size=u.size)
    z = np.linalg.lstsq(x, y)[0]
    rest, per_window = x @ z - y, []
    for own in np.arange(u.size).reshape(SHAPE):
        columns = np.column_stack(
            [x[own], np.einsum("ok,a->oka", np.eye(KNOTS), np.eye(6)[HEAVE]).reshape(KNOTS, -1)]
        )
        per_window.append((rest[own] @ rest[own], columns.T @ rest[own], columns.T @ columns))
    chi2, g, h = (np.array([one[i] for one in per_window]) for i in range(3))
    k = dataclasses.replace(
        knots_with(u, {"u": u}, rng), stats=Reduced(chi2, g, h), width=2, precision=np.zeros(2), offset=z
    )

    def left(*columns: np.ndarray) -> float:
        dense = np.column_stack(columns)
        return float(((dense @ np.linalg.lstsq(dense, y)[0] - y) ** 2).sum())

    members = [slice(0, 1), slice(1, 2)]
    least = left(x, flat)
    dense = [left(x[:, [1]], flat) - least, left(x[:, [0]], flat) - least]
    # The knots' information is widened by a millionth.
    assert cost_of_removal(k, members, found) == pytest.approx(dense, rel=1e-2, abs=0.1)
    assert dense[0] > 50.0 > 5.0 > dense[1]
    assert acting(k, found).stats.chi2.sum() == pytest.approx(least, rel=1e-4)
    # Of 60 windows or so; without the dependence, what it explains scatters the scores.
    assert _scatters_beside(k, members, found) == pytest.approx([1.0, 1.0], abs=0.5)
    without = dataclasses.replace(found[0], features=np.zeros((*SHAPE, 0)))
    assert _scatters_beside(k, members, (without,))[1] > 2.0


@pytest.mark.parametrize("size", [0.0, 0.15])
def test_a_dependence_must_make_the_logs_more_likely(size):
    """One that is there does, one that is not does not, however it was proposed."""
    rng = np.random.default_rng(7)
    t = np.arange(WINDOWS * KNOTS).reshape(SHAPE)
    signals = {"u": np.sin(0.11 * t), "v": np.cos(0.17 * t + 1.0)}
    proposed = dependences(knots_with(signals["u"], signals, rng), 1.0)
    assert [one.signals for one in proposed] == [("u",)]
    k = knots_with(size * signals["u"], signals, rng)
    # Of two that are proposed for one axis the first is taken: a network for each would act twice.
    found, same = likely(k, proposed * 2)
    assert [one.signals for one in found] == [("u",)] * bool(size) and same is k
