"""Craft of the package by what was measured of them: the thrusters' curve, top speed; and a check."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from jaxmarine.examples import operated, recorded

from .crafts import packaged

NEW = ("bluerov2", "blueboat", "milliampere")
# Some points of Blue Robotics' public table of the T200 (September 2019): PWM [µs]; kgf at 12, 14 and 16 V.
T200 = {
    1100: (-2.90, -3.52, -4.07),
    1200: (-1.95, -2.35, -2.71),
    1300: (-1.02, -1.24, -1.44),
    1400: (-0.32, -0.40, -0.48),
    1500: (0.0, 0.0, 0.0),
    1600: (0.39, 0.50, 0.60),
    1700: (1.28, 1.55, 1.82),
    1800: (2.46, 2.99, 3.42),
    1900: (3.71, 4.52, 5.25),
}


def test_the_thrusters_of_the_bluerov2_are_those_of_the_table():
    craft = packaged("bluerov2")
    pwm, kgf = np.array(list(T200)), np.array(list(T200.values()))
    t = np.arange(float(len(pwm)))
    plant, nothing = craft.plant(), jnp.zeros((len(t), 6))
    for k, volts in enumerate((12.0, 14.0, 16.0)):
        commands = np.repeat((pwm[:, None] - 1500.0) / 400.0, 7, axis=1)
        commands[:, 6] = volts
        drive = jm.simulation.inputs(plant, jnp.asarray(t), jnp.asarray(commands), nothing)[1]
        # t5 pushes straight up.
        others = jnp.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0])
        up = [-plant.pushed(acting * others, jnp.zeros(6))[2] for acting in drive.thrust]
        off = np.abs(np.array(up) - 9.80665 * kgf[:, k])
        # Of up to 51 N. At full command the current is limited, which the curve does not know.
        assert off[1:-1].max() < 0.5 and off.max() < 1.9


@functools.cache
def driven(name: str) -> jm.Log:
    craft = packaged(name)
    t = np.arange(0.0, 60.0, 0.2)
    return recorded(craft, operated(craft, t, seed=4), t, seed=5, name="log.csv")


@pytest.mark.parametrize("name", NEW)
def test_a_packaged_craft_is_driven_and_stays_upright(name):
    log = driven(name)
    assert np.nanmax(np.abs(log.channels[:, 6:9])) < 3.5
    assert np.nanmax(np.abs(log.channels[:, 3:5])) < 0.8


@pytest.mark.slow
@pytest.mark.parametrize("name", NEW)
def test_a_log_of_a_packaged_craft_is_checked(name):
    craft = packaged(name)
    check = jm.check(craft, driven(name))
    assert not check.gross
    assert {axis.dof for axis in check.axes} == set(craft.dof)
    assert all(axis.inertia < 0.3 for axis in check.axes)


def test_the_blueboat_goes_as_fast_as_its_maker_says():
    craft = packaged("blueboat")
    t = np.arange(0.0, 40.0, 0.2)
    ahead = jm.Log(t, np.full((len(t), 18), np.nan), np.ones((len(t), 2)), None, craft.command_names, "-")
    assert float(jm.simulate(craft, ahead, jm.initial_state(craft))["u"][-1]) == pytest.approx(3.0, abs=0.02)
    # Its thrust at full command is what the runs show, ahead and astern.
    over, _ = jm.simulation.inputs(
        craft.plant(), jnp.arange(2.0), jnp.array([[1.0, 1.0], [-1.0, -1.0]]), jnp.zeros((2, 6))
    )
    np.testing.assert_allclose(over.thrust[:, 0], [55.2, -27.6], atol=0.1)
