"""A gain that cannot hide: by quantity and channel, over several logs, of starts that are meant."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine._errors import InputError
from jaxmarine._types import CHANNELS
from jaxmarine.diagnosis._gain import Candidate, gain
from jaxmarine.diagnosis._gain import predictions as predicted
from jaxmarine.diagnosis._prepare import predictable, workbench
from jaxmarine.diagnosis._result import Gain, Predictions
from jaxmarine.effects import ThrusterGain
from jaxmarine.fitting import Room, cut, noise_of
from jaxmarine.logs import Rejected
from jaxmarine.vehicle import Placed
from tests.boats import boat, record, steps

U, V, X = (CHANNELS.index(name) for name in ("u", "v", "x"))
NOISE = np.full(len(CHANNELS), 0.02)
BEGIN = 20


def told(
    before: dict[int, float], after: dict[int, float], starts: int = 60, log: str = "test.csv", seed: int = 0
) -> Predictions:
    """Predictions of 5 s at 10 Hz that miss by so much, of either sign, beside a run-in that they meet."""
    rng = np.random.default_rng(seed)
    times = np.arange(starts)[:, None] + 0.1 * np.arange(70)
    measured = np.full((starts, 70, len(CHANNELS)), np.nan)
    shape = rng.choice([-1.0, 1.0], size=(starts, 70, len(CHANNELS)))
    errors = []
    for each in (before, after):
        error = np.zeros_like(shape)
        for channel, size in each.items():
            measured[..., channel] = 0.0
            error[..., channel] = np.where(np.arange(70) < BEGIN, 0.02, size) * shape[..., channel]
        errors.append(error)
    noise = np.where(np.isfinite(measured).any((0, 1)), NOISE, np.nan)
    return Predictions(times, BEGIN, measured, errors[0], errors[1], noise, log)


def of(*logs: Predictions, noise: np.ndarray = NOISE) -> Gain:
    return gain(logs, noise, [True] * len(logs))[0]


def test_a_channel_that_gets_worse_is_told_whatever_all_together_say():
    """As of a boat whose positions hide it: 0.6 to 1.1 m/s beside 3 to 0.9 m."""
    found = of(told({X: 3.0, U: 0.6, V: 0.1}, {X: 0.9, U: 1.1, V: 0.1}))
    expected = np.sqrt((0.9**2 + 1.1**2 + 0.1**2) / (3.0**2 + 0.6**2 + 0.1**2))
    assert found.ratio == pytest.approx(expected) and found.ratio < 0.5
    assert set(found.worse) == {"velocity", "u"}
    assert found.velocity is not None and found.velocity.before == pytest.approx(np.hypot(0.6, 0.1))
    assert found.channels["u"].ratio == pytest.approx(1.1 / 0.6)
    assert found.channels["u"].ratio_ci95 == pytest.approx((1.1 / 0.6, 1.1 / 0.6))
    assert set(found.channels) == {"x", "u", "v"} and found.attitude is None and found.rate is None
    said = found.to_json()
    assert said["worse"] == ["velocity", "u"] and said["attitude_rmse_rad"] is None
    assert said["per_channel"]["v"]["ratio"] == pytest.approx(1.0)


@pytest.mark.parametrize(("after", "worse"), [(0.0205, False), (0.022, False), (0.023, True)])
def test_what_grows_beside_a_sensors_noise_must_show(after, worse):
    """At the noise of 0.02 an error that grows to 0.0224 has half the noise added: that is the limit."""
    assert bool(of(told({U: 0.02}, {U: after})).worse) == worse


def test_a_raised_noise_hides_nothing():
    """Errors are weighed by a noise of 2 m/s, to which an estimate was raised; the sensor's own is 0.02."""
    one = told({U: 0.6}, {U: 1.1})
    raised = dataclasses.replace(one, noise=100 * one.noise)
    assert set(of(raised).worse) == {"velocity", "u"}


def test_nothing_is_certain_of_a_short_log_and_of_errors_that_scatter():
    assert not of(told({U: 0.6}, {U: 1.1}, starts=3)).worse
    rng = np.random.default_rng(3)
    one = told({U: 0.5}, {U: 0.5})
    wild = one.after * rng.lognormal(sigma=1.5, size=60)[:, None, None] * (np.arange(70) >= BEGIN)[:, None]
    assert not of(dataclasses.replace(one, after=wild)).worse


def test_several_logs_count_by_their_starts_and_stretches_end_with_a_log():
    """Two logs whose errors are one size each: the jackknife by hand, with the stretches of each."""
    first, second = told({U: 1.0}, {U: 0.5}, 40, "a.csv"), told({U: 1.0}, {U: 0.2}, 20, "b.csv", seed=1)
    found = of(first, second)
    assert found.ratio == pytest.approx(np.sqrt((40 * 0.25 + 20 * 0.04) / 60))
    assert [(one.name, one.starts) for one in found.per_log] == [("a.csv", 40), ("b.csv", 20)]
    assert [one.ratio for one in found.per_log] == pytest.approx([0.5, 0.2])
    # 45.9 s of starts and predictions of 6.9 s give six stretches, 25.9 s give three.
    sizes = [(len(part), 0.25) for part in np.array_split(np.arange(40), 6)]
    sizes += [(len(part), 0.04) for part in np.array_split(np.arange(20), 3)]
    whole = np.array([count * square for count, square in sizes])
    counts = np.array([count for count, _ in sizes])
    without = 0.5 * np.log((whole.sum() - whole) / (60 - counts))
    half = 2.306 * np.sqrt(8 / 9 * ((without - without.mean()) ** 2).sum())  # Student, 8 degrees of freedom
    ends = found.ratio * np.exp([-half, half])
    assert found.ratio_ci95 == pytest.approx(tuple(ends), rel=1e-3)


def off(one: Predictions, starts: slice, channel: int, before: float, after: float) -> Predictions:
    """The same with the state of some starts off by so much, from before they begin on."""
    shown = {"before": one.before.copy(), "after": one.after.copy()}
    shown["before"][starts, :, channel] += before
    shown["after"][starts, :, channel] += after
    return dataclasses.replace(one, **shown)


def test_starts_that_both_models_miss_are_not_scored_but_told():
    good = told({X: 0.3, U: 0.2}, {X: 0.1, U: 0.1})
    bad = off(good, slice(10, 14), X, 5.0, 5.0)
    found = of(bad)
    (lost,) = found.unscored
    assert (lost.log, lost.count, lost.of, lost.quantities) == ("test.csv", 4, 60, ("position",))
    assert found.starts == 56 and found.sound
    assert found.ratio == pytest.approx(of(good).ratio)
    assert len(gain([bad], NOISE, [True])[1].times) == 56


def test_a_start_that_one_model_meets_is_scored():
    """A wrong file misses what lies before a start too; to leave those out would flatter it."""
    good = told({X: 0.3}, {X: 0.1})
    for before, after in ((5.0, 0.0), (0.0, 5.0)):
        found = of(off(good, slice(10, 14), X, before, after))
        assert not found.unscored and found.starts == 60
        assert (found.ratio > 1.0) == (after > 0)


def test_where_starts_are_off_as_a_rule_no_start_is_odd_and_the_gain_says_little():
    good = told({X: 0.3}, {X: 0.1})
    assert of(off(good, slice(None), X, 0.1, 0.1)).sound  # 5 times the noise, as waves leave it
    found = of(off(good, slice(None), X, 5.0, 5.0))
    assert not found.sound and found.starts == 60


def test_too_few_good_starts_are_said_and_all_are_scored():
    good = told({X: 0.3}, {X: 0.1}, starts=7)
    found = of(off(good, slice(0, 3), X, 5.0, 5.0))
    assert not found.sound and found.starts == 7 and found.unscored[0].count == 3


@pytest.mark.slow
def test_a_position_that_jumps_spoils_the_starts_after_it_and_no_others():
    """A boat's log whose fixes jump by 3 m at 20 s, predicted with half the port thrust and as it is."""
    craft = boat()
    half = craft.place(Placed(ThrusterGain(jnp.array([0.5, 1.0, 1.0])), "port"))
    log = record(craft, steps(400))
    channels = log.channels.copy()
    channels[log.t >= 20.0, X] += 3.0
    jumped = dataclasses.replace(log, channels=channels)
    noise = noise_of(craft, [log])
    data = cut(craft, [log], noise, 4.0)
    families = (ThrusterGain(jnp.ones(3)),)  # a program takes one parameter at least

    def measured(one) -> Gain:
        candidates = [
            Candidate(vehicle, families, np.ones((1, 3)), np.ones((1, len(vehicle.placed))))
            for vehicle in (half, craft)
        ]
        room = Room.of(data.records, data.windows)
        segment = np.zeros(len(one.t), int)
        times, (before, after), seen, begin = predicted(candidates, one, noise, 4.0, 0.1, segment, room, 8)
        return of(Predictions(times, begin, seen, before, after, noise, one.name), noise=noise)

    clean, spoilt = measured(log), measured(jumped)
    assert not clean.unscored and clean.ratio < 0.5
    (lost,) = spoilt.unscored
    # Run-ins of 4 s that hold the jump in their middle; fixes before or after it outweigh the rest otherwise.
    assert lost.quantities[0] == "position" and 0 < lost.count <= 0.15 * lost.of
    assert spoilt.sound


def test_test_logs_that_cannot_be_predicted_are_left_out_where_others_serve():
    """One that is too short, and one whose accident leaves no stretch for two predictions."""
    craft, log = boat(), record(boat(), steps(400))
    bench = workbench(craft, [log], (ThrusterGain,), 2.0)
    good, short = (dataclasses.replace(log.between(0.0, end), name=f"{end:g}.csv") for end in (30.0, 8.0))
    hit = Rejected("hit.csv", 6.0, 25.0, "collision")
    spoilt = dataclasses.replace(good, name="hit.csv", rejected=(hit,))
    tests, notes = predictable(bench, (short, good, spoilt))
    assert [test.name for test in tests] == ["30.csv"]
    assert [note.split(":")[1].strip() for note in notes] == ["8.csv", "hit.csv"]
    assert "is shorter than a prediction with its run-in (9 s)" in notes[0]
    with pytest.raises(InputError, match=r"8\.csv: is shorter than a prediction"):
        predictable(bench, (short, spoilt))
