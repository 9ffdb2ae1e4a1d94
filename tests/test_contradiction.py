"""Sensors that contradict one another are told by kinematics, whatever forces act."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine.diagnosis._saturated import saturate
from jaxmarine.effects import VelocityInEarthAxes, VelocityScale
from jaxmarine.fitting._kinematics import contradiction, disagreement, kinematics
from jaxmarine.logs import Log
from jaxmarine.vehicle import Placed
from tests.boats import boat, record, steps


def logs_of(*effects) -> tuple[Log, ...]:
    craft = boat().place(*(Placed(effect) for effect in effects))
    return (record(craft, steps(600)),)


def told(logs: tuple[Log, ...]):
    craft = boat()
    suspects = saturate(craft)[1].suspects
    found = contradiction(craft, logs, suspects)
    return None if found is None else (suspects[found[0]].label, found[1])


def test_the_motion_over_a_stretch_is_that_of_its_samples():
    """Against the measured velocities of a log without noise, averaged by the trapezoidal rule."""
    log = record(boat(), steps(300), noise=dict.fromkeys(("position", "attitude", "velocity", "rate"), 0.0))
    seen = kinematics(boat(), (log,))
    assert seen is not None
    size = seen.nu.shape[1] - 1
    for k in range(len(seen.nu)):
        here = slice(k * size, k * size + size + 1)
        nu, psi = log.channels[here, 6:12], log.channels[here, 5]
        over_ground = np.trapezoid(
            [
                nu[:, 0] * np.cos(psi) - nu[:, 1] * np.sin(psi),
                nu[:, 0] * np.sin(psi) + nu[:, 1] * np.cos(psi),
            ],
            dx=0.1,
        )
        # The rule is off by dt² / 12 times the change of acceleration: below 1 mm/s at 10 Hz.
        shown = (seen.rotation[k] @ seen.nu[k][:, :3, None])[..., 0]
        assert np.allclose(shown[:, :2], over_ground, atol=1e-3)
        assert np.allclose(seen.nu[k][:, 5], np.trapezoid(nu[:, 5], dx=0.1), atol=4e-3)


def test_velocities_in_earth_axes_are_told_with_their_fraction():
    label, values = told(logs_of(VelocityInEarthAxes(jnp.asarray(1.0))))
    assert label == "velocity_in_earth_axes"
    assert values["fraction"] == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
def test_a_false_scale_is_told_where_it_is_gross():
    label, values = told(logs_of(VelocityScale(jnp.asarray(0.3))))
    assert label == "velocity_scale"
    # The noise of positions pulls the slope on them down by a few per cent.
    assert values["factor"] == pytest.approx(0.3, rel=0.05)


def test_sensors_that_agree_are_left_alone():
    assert told(logs_of()) is None
    # Five per cent are no gross contradiction: the search weighs them with all other causes.
    assert told(logs_of(VelocityScale(jnp.asarray(1.05)))) is None
    (log,) = logs_of(VelocityInEarthAxes(jnp.asarray(1.0)))
    without = log.channels.copy()
    without[:, :6] = np.nan
    assert told((dataclasses.replace(log, channels=without),)) is None


NOISE = np.repeat([0.02, 0.005, 0.02, 0.01, np.nan], [3, 3, 3, 3, 6])


def apart(log: Log, *found) -> str | None:
    """What is said of sensors on the boat with these effects found."""
    return disagreement(boat().place(*(Placed(effect) for effect in found)), (log,), NOISE)


def changed(log: Log, columns: slice, values: np.ndarray) -> Log:
    channels = np.array(log.channels)
    channels[:, columns] = values
    return dataclasses.replace(log, channels=channels)


@pytest.mark.parametrize(
    ("columns", "what"), [(slice(0, 6), "positions and attitude come"), (slice(3, 6), "attitude comes")]
)
@pytest.mark.parametrize("lag", [6, -6])
def test_sensors_that_come_at_other_times_are_told_with_the_lag(columns, what, lag):
    log = record(boat(), steps(600))
    whole = slice(6, -6)
    moved = log.channels[6 - lag : len(log.t) - 6 - lag, columns]
    cut = {name: getattr(log, name)[whole] for name in ("t", "channels", "commands")}
    said = apart(changed(dataclasses.replace(log, **cut), columns, moved))
    assert said is not None
    assert what in said and "0.6 s" in said and ("later" if lag > 0 else "earlier") in said


def test_a_heading_in_degrees_contradicts_its_rate():
    log = record(boat(), steps(600))
    said = apart(changed(log, slice(5, 6), np.rad2deg(log.channels[:, 5:6])))
    assert said is not None
    assert "r contradict" in said and "units" in said


def test_a_slow_log_is_too_coarse_to_tell_a_time_by():
    """With a sample every 2 s there are two lags to try: one fewer than a parabola takes."""
    log = record(boat(), steps(1200))
    slow = {name: getattr(log, name)[::20] for name in ("t", "channels", "commands")}
    log = dataclasses.replace(log, **slow)
    said = apart(changed(log, slice(5, 6), np.rad2deg(log.channels[:, 5:6])))
    assert said is not None and "contradict" in said


def test_a_coarse_sensor_of_which_less_noise_is_stated_is_no_contradiction():
    """Positions in steps of 0.5 m, with a stated noise of 0.02 m."""
    log = record(boat(), steps(600))
    assert apart(changed(log, slice(0, 2), np.round(log.channels[:, 0:2] / 0.5) * 0.5)) is None


def test_sensors_that_agree_or_whose_error_was_found_are_not_blamed():
    scale = VelocityScale(jnp.asarray(2.0))
    (clean,), (scaled,) = logs_of(), logs_of(scale)
    assert apart(clean) is None
    assert apart(scaled) is not None
    assert apart(scaled, scale) is None


def test_sensors_with_samples_of_their_own_between_the_rows_are_compared_as_well():
    """A gyroscope at 50 Hz makes the rows; positions and velocities stand in every third or fourth."""
    log = record(boat(), steps(3000, hold=100), dt=0.02)
    sparse = log.channels.copy()
    keep = np.arange(len(log.t))
    sparse[keep % 3 > 0, :6] = np.nan
    sparse[keep % 4 > 0, 6:9] = np.nan
    log = dataclasses.replace(log, channels=sparse)
    assert apart(log) is None
    wrong = apart(changed(log, slice(7, 8), -log.channels[:, 7:8]))
    assert wrong is not None and wrong.startswith("v contradict")
    # Nothing is made up over half a second.
    gap = changed(log, slice(0, 6), np.where((keep % 25 > 0)[:, None], np.nan, log.channels[:, :6]))
    assert kinematics(boat(), (gap,)) is None
