"""Commands that answer what was measured are told from those that do not."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine._types import SENSORS
from jaxmarine.diagnosis._disturbed import in_words, known
from jaxmarine.diagnosis._prepare import opened_with
from jaxmarine.effects import LinearDamping
from jaxmarine.fitting import Disturbance, answers, drifting, flowing
from jaxmarine.logs import Log
from jaxmarine.simulation import initial_state, simulate
from tests.boats import NOISE as NOISE_OF
from tests.boats import boat, record, steps

DT, SAMPLES, NOISE = 0.1, 2000, 0.01


def steered(seed: int, gain: float, push: float = 0.0, lag: int = 0, shake: float = 0.0) -> Log:
    """A craft of 50 kg in surge whose speed is held by a proportional pilot that sees its noise.

    - `gain` 0: it is steered by sticks instead; `push`: size of a slow force on it [N]; `lag`: samples that
      the pilot is late; `shake`: of a stick that acts besides, and then all other sensors show noise.
    """
    rng = np.random.default_rng(seed)
    goals = np.repeat(rng.uniform(-0.8, 0.8, SAMPLES // 40), 40)
    u, force = 0.0, 0.0
    seen, commands = np.empty(SAMPLES), np.empty(SAMPLES)
    for k in range(SAMPLES):
        seen[k] = u + NOISE * rng.normal()
        answer = gain * (goals[k] - seen[max(k - lag, 0)]) if gain else goals[k]
        commands[k] = np.clip(answer + (shake * rng.normal() if shake else 0.0), -1.0, 1.0)
        force += -force * DT / 5.0 + push * np.sqrt(2 * DT / 5.0) * rng.normal()
        u += DT * (40.0 * commands[k] + force - 40.0 * u) / 50.0
    channels = np.full((SAMPLES, 18), np.nan)
    if shake:
        channels[:, :12] = NOISE * rng.normal(size=(SAMPLES, 12))
    channels[:, 6] = seen
    return Log(DT * np.arange(SAMPLES), channels, commands[:, None], None, ("stern",), "log.csv")


@pytest.mark.parametrize("push", [0.0, 8.0])
@pytest.mark.parametrize("seed", range(4))
def test_a_pilot_is_told_from_sticks(seed, push):
    assert answers(steered(seed, 4.0, push))
    assert answers(steered(seed, 4.0, push, lag=1))
    assert not answers(steered(seed, 0.0, push))


def test_a_weak_answer_shows_beside_a_stick_that_shakes_and_among_many_sensors():
    """It makes up a tenth of the command's changes: without its prior 9 of these 12 logs are told."""
    assert sum(answers(steered(seed, 4.0, shake=0.12)) for seed in range(12)) >= 10


@pytest.mark.parametrize("seed", range(4))
def test_what_a_motion_remembers_of_commands_is_no_answer(seed):
    """Of a stick that shakes, the speed shows the mean, and where it will be better than it does itself."""
    assert not answers(steered(seed, 0.0, shake=0.3))


def test_sticks_of_a_craft_with_three_thrusters_are_not_feedback():
    """Whatever moves with the commands does so after them."""
    for seed in range(5):
        assert not answers(record(boat(), steps(1500, seed=seed), seed=seed))


@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_a_held_heading_shows_in_what_two_thrusters_differ_by(gain):
    """Under sticks for the speed that shake a hundred times as much as what answers the rate of yaw."""
    rng = np.random.default_rng(1)
    ahead, seen = 0.3 * rng.normal(size=SAMPLES), NOISE * rng.normal(size=SAMPLES)
    turn = -gain * seen if gain else 0.5 * NOISE * rng.normal(size=SAMPLES)
    commands = np.stack([ahead + turn, ahead - turn], axis=1)
    channels = np.full((SAMPLES, 18), np.nan)
    channels[:, 11] = seen
    log = Log(DT * np.arange(SAMPLES), channels, commands, None, ("port", "star"), "log.csv")
    assert answers(log) == (gain > 0)


@pytest.mark.parametrize(("samples", "amid"), [(300, False), (400, True)])
def test_half_a_minute_is_too_short_to_tell_what_disturbs_and_says_so(samples, amid):
    """Nine usual memories are 36 s; of a boat whose commands answer the noise of its speeds."""
    noise = np.repeat([NOISE_OF.get(kind, np.nan) for kind in SENSORS], 3)
    noise = noise * np.random.default_rng(1).normal(size=(samples, len(noise)))
    commands = 0.5 * steps(samples) - 2.0 * noise[:, [6, 7, 11]]
    t = DT * np.arange(samples)
    blank = Log(t, np.full((samples, 18), np.nan), commands, None, boat().command_names, "log.csv")
    clean = np.asarray(simulate(boat(), blank, initial_state(boat())).channels)
    log = dataclasses.replace(blank, channels=clean + noise)
    opened = opened_with(boat(), log, dataclasses.replace(log, name="test.csv"), (LinearDamping,), None)
    assert answers(log) and opened.feedback == amid
    (said,) = [str(note) for note in opened.notes if "commands answer" in str(note)]
    assert ("too short to tell what disturbs" in said) == (not amid)


def test_logs_that_cannot_tell_are_not_feedback():
    log = steered(0, 4.0)
    assert not answers(dataclasses.replace(log, commands=np.zeros_like(log.commands)))
    short = slice(0, 100)
    assert not answers(Log(log.t[short], log.channels[short], log.commands[short], None, ("stern",), "a.csv"))
    assert not answers(Log(log.t, log.channels, None, np.zeros((SAMPLES, 6)), (), "wrenches.csv"))


def test_what_disturbs_is_said_in_words():
    force = Disturbance(
        size=jnp.array([3.0, 0.5, 1.2, 0.04]),
        time=jnp.array([4.0, 11.0, 8.0, 8.0]),
        frequency=jnp.array([0.0, 0.0, 1.0, 1.0]),
        gap=jnp.zeros(1),
        joined=jnp.zeros(1, bool),
        axes=(1, 5),
    )
    said = in_words(known(force))
    assert "3 N in sway with a memory of 4 s, 0.5 N m in yaw with a memory of 11 s" in said
    assert said.endswith("a swell of 6.3 s: 1.2 N in sway, 0.04 N m in yaw.")
    both = known(flowing(drifting(force, 2.0, 13.0), 0.2))
    assert both.to_json()["drift"] == {"size_N": 2.0, "memory_s": 13.0}
    assert "keeps its direction as the craft turns, 2 N to the north and to the east" in in_words(both)
    assert "a memory of 13 s; and a current that wanders by 0.2 m/s" in in_words(both)
