"""The manoeuvre that tells causes apart, against a refit of the rival and the box that it is to keep to."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine import InputError
from jaxmarine.diagnosis import Box, Manoeuvre, plan
from jaxmarine.diagnosis._explanation import Member
from jaxmarine.diagnosis._plan import DT, _causes, _ranges
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.effects import CATALOGUE, GyroBias
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Placed
from jaxmarine.vehicle_io import cause_named, load_vehicle, packaged_vehicle

from .crafts import packaged

BOX = Box(speed=0.5, radius=3.0)
WORDS = ("input_delay delay=0.25", "thruster_lag time_constant=0.25")


def causes() -> tuple[Placed, Placed]:
    delay, lag = (cause_named(packaged("cybership2"), words) for words in WORDS)
    return delay, lag


# Its programs compile for minutes.
slow = pytest.mark.slow


@functools.cache
def planned() -> Manoeuvre:
    return plan(packaged("cybership2"), causes(), 24.0, BOX)


@slow
def test_the_evidence_is_what_a_refit_of_the_rival_leaves():
    """The plan refits by one linear step; the diagnosis' solver goes on until nothing is left to gain.

    The log is the one that the first cause makes; without noise, so that all that is left is the difference.
    """
    craft, found = packaged("cybership2"), planned()
    problem = _causes(craft, causes(), 24.0, BOX)
    commands = jnp.asarray(found.log.commands)
    apart = problem.separations(commands, *problem.flown(commands))
    assert found.evidence == pytest.approx(0.5 * float(apart.min()), rel=1e-6)
    # Kinds of effects that its programs hold for other plans change nothing.
    wider = _causes(craft, causes(), 24.0, BOX, (GyroBias,))
    np.testing.assert_allclose(wider.separations(commands, *wider.flown(commands)), apart, rtol=1e-6)

    bench = workbench(craft, (found.log,), CATALOGUE, None)
    assert bench.data.length == pytest.approx(problem.window * DT, abs=0.5 * DT)
    stated = min(std for _, std in craft.sensors)
    assert np.nanmin(bench.noise) == pytest.approx(stated), "in units of the stated noise"
    labels = [suspect.label for suspect in bench.layout.suspects]

    def left(label: str) -> float:
        suspect = bench.with_member(bench.start(), Member(labels.index(label)), np.array([0.25]))
        return 2 * bench.refine(suspect).cost

    assert left("input_delay") < 0.02 * left("thruster_lag"), "the true cause leaves nothing"
    # One step against convergence: the lag's and the delay's curvature are what lies between.
    assert left("thruster_lag") == pytest.approx(float(apart[0]), rel=0.15)


@slow
def test_it_beats_every_random_manoeuvre_in_the_same_box():
    found = planned()
    assert found.random
    assert found.evidence > 2.0 * max(found.random_evidence)


@slow
@pytest.mark.parametrize("which", [0, 1])
def test_commands_and_states_stay_within_their_limits(which):
    craft, found = packaged("cybership2"), planned()
    assert np.abs(found.log.commands).max() <= 1.0
    run = simulate(craft.place(causes()[which]), found.log, initial_state(craft))
    position, velocity = np.asarray(run.states.position), np.asarray(run.states.velocity)
    assert np.hypot(position[:, 0], position[:, 1]).max() <= BOX.radius
    assert np.linalg.norm(velocity[:, :3], axis=1).max() <= BOX.speed


def test_each_column_is_planned_in_its_own_unit(tmp_path):
    """Shaft speed and rudder of the tanker; thrusters, angles and battery of a ferry with one."""
    ship = packaged("kvlcc2")
    wake, lag = (cause_named(ship, words) for words in ("wake:propeller fraction=0.1", WORDS[1]))
    problem = _causes(ship, (wake, lag), 24.0, BOX)
    # The hyperbolic tangent of these is 1 to ten digits, of others between.
    corners = jnp.array([[20.0, -20.0], [-20.0, 20.0], [0.0, 0.0], [0.5, 0.5]])
    commands = np.asarray(problem.commands(corners))
    assert commands.shape == (240, 2) and not commands[0].any()
    at = [round(share * 239) for share in (0.25, 0.5)]
    # From 0.2 to 0.9 of 25 rev/s, and to either side as far as the rudder goes, or others stall.
    np.testing.assert_allclose(commands[at], [[22.5, -0.6], [5.0, 0.6]], rtol=0.02)
    assert 5.0 < commands[-1, 0] < 22.5 and 0.0 < commands[-1, 1] < 0.6

    text = packaged_vehicle("milliampere").read_text().replace("lag = 0.3", "nominal_voltage = 20.0")
    (tmp_path / "ferry.toml").write_text(text)
    middle, half = _ranges(load_vehicle(tmp_path / "ferry.toml"))
    np.testing.assert_allclose(middle, [0, 0, 0, 0, 19.0])
    np.testing.assert_allclose(half, [1, 1, 0.6, 0.6, 0])


def test_what_cannot_be_planned_is_refused():
    craft, both = packaged("cybership2"), causes()
    with pytest.raises(InputError, match="two causes"):
        plan(craft, both[:1])
    with pytest.raises(InputError, match="too short"):
        plan(craft, both, 3.0)
    with pytest.raises(InputError, match="sensors"):
        plan(dataclasses.replace(craft, sensors=()), both)
    with pytest.raises(InputError, match="empty"):
        Box(depth=(3.0, 1.0))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("input_dely delay=1", "input_delay"),
        ("input_delay", "needs a value of delay"),
        ("input_delay lag=1", "no parameter `lag`"),
        ("input_delay delay=fast", "number"),
    ],
)
def test_a_cause_in_words_is_refused_with_a_sentence(words, sentence):
    with pytest.raises(InputError, match=sentence):
        cause_named(packaged("cybership2"), words)
