"""A craft that is watched: evidence against least squares, names, interruptions, and a kill."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmarine import InputError
from jaxmarine._types import CHANNELS
from jaxmarine.diagnosis import parts_of, saturate
from jaxmarine.disturbances import RandomWrench
from jaxmarine.effects import (
    AddedMass,
    ConstantWrench,
    ExchangedThrusters,
    FluidMemory,
    InputDelay,
    LinearDamping,
    QuadraticDamping,
    ReverseThrust,
    Saturation,
    SensorDelay,
    SteadyCurrent,
    Suspect,
    ThrusterGain,
    ThrusterLag,
    Waves,
    WindPush,
    place,
)
from jaxmarine.fitting import (
    PLANE,
    Disturbance,
    Line,
    Message,
    Records,
    Trail,
    Windows,
    by_plane,
    count_of,
    drifting,
    flowing,
)
from jaxmarine.logs import Log
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Placed
from jaxmarine.vehicle_io import suspect_named
from jaxmarine.watching import Kept, Watch, _blocks, _judge, _ledger, _passage, _rivals, _saved
from jaxmarine.watching._blocks import LONG, WINDOW, Begun, Bench, Place, averaged
from jaxmarine.watching._evidence import Acting, Member, Sum, Suspicions
from jaxmarine.watching._ledger import KEPT, Account, since_each, thinned
from jaxmarine.watching._page import disturbance_of
from jaxmarine.watching._swell import SLIPS, in_step, waves
from tests.boats import NOISE, boat, record, steps

SMALL = (
    SteadyCurrent,
    ThrusterGain,
    ReverseThrust,
    Saturation,
    ExchangedThrusters,
    ConstantWrench,
    LinearDamping,
    QuadraticDamping,
)
# It grows weak within a window, of which some begin at 20 and 24 s, and within a block of half a second.
WEAK, SINCE, SAMPLES, DT = 0.6, 21.7, 400, 0.1
# The row before which a watch is killed: beyond the first snapshot.
KILLED = 330


@pytest.fixture(autouse=True, scope="module")
def _small():
    """Fewer blocks are held: some are let go, and a snapshot is written, after 24 s and not after 80."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (_ledger, _passage):
            patch.setattr(module, "CHUNK", 28)
            patch.setattr(module, "SPARE", 8)
        patch.setattr(_judge, "OPENING", 20)
        yield


def rows_of(log: Log):
    for k in range(len(log.t)):
        seen = {name: log.channels[k, c] for c, name in enumerate(CHANNELS)}
        assert log.commands is not None
        yield {"t": log.t[k]} | seen | dict(zip(log.command_names, log.commands[k], strict=True))


@pytest.fixture(scope="module")
def broken() -> Log:
    """A boat whose starboard thruster grows weak under way, as it begins to go astern.

    From where that window begins it would seem to be weak astern alone.
    """
    weak = place(suspect_named(boat(), "thruster_gain", "starboard"), boat(), {"factor": WEAK})
    commands, t = steps(SAMPLES), np.arange(SAMPLES) * DT
    commands[(t >= 18.0) & (t < 30.0), 1] = 0.4
    commands[(t >= SINCE - 0.5 * DT) & (t < 28.0), 1] = -0.4
    return record(boat().place(Placed(weak, "starboard", SINCE)), commands, seed=1)


@pytest.fixture(scope="module")
def kept_in(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("watching")


@pytest.fixture(scope="module")
def watched(broken, kept_in) -> tuple[Watch, list[str]]:
    """It is watched to the end, but kept only up to some row."""
    watch, kept = Watch(boat(), catalogue=SMALL), Kept(kept_in / "state")
    told, _ = kept.opened(watch)
    for k, row in enumerate(rows_of(broken)):
        if k < KILLED:
            kept.add(row, [k, 0])
        told += watch.update(row)
        if k < KILLED:
            kept.after(watch, [k, 0])
    kept.close()
    return watch, told


# --- evidence ------------------------------------------------------------------------------------


def linear(seed: int = 0):
    """Blocks of a linear model of five numbers, the last three of which are suspected, as an account."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(24, 10, 5)), rng.normal(size=(24, 10))
    said = (y**2).sum(1), np.einsum("bnz,bn->bz", x, y), np.einsum("bnz,bny->bzy", x, x)
    zero = Sum(-np.inf, 0, np.zeros(5), np.zeros((5, 5)))
    account = Account(None, None, None, 0.0, [zero], said, np.eye(2))
    suspects = Suspicions(np.array([0, 1]), np.array([4.0, 0.3]), (np.eye(5)[:, [2]], np.eye(5)[:, [3, 4]]))
    return x, y, account, suspects


def saved(x, y, precision, first: int, own) -> float:
    """Chi-square that `own` columns save from a block on beside columns 0 and 1 under a prior."""

    def left(columns):
        prior = np.zeros((2, columns.shape[1]))
        prior[[0, 1], [0, 1]] = np.sqrt(precision)
        whole, target = np.concatenate([columns, prior]), np.concatenate([y.ravel(), np.zeros(2)])
        return np.sum((target - whole @ np.linalg.lstsq(whole, target)[0]) ** 2)

    acts = np.repeat(np.arange(len(x)) >= first, x.shape[1])[:, None]
    flat = x.reshape(-1, x.shape[2])
    return left(flat[:, :2]) - left(np.concatenate([flat[:, :2], acts * flat[:, own]], axis=1))


def test_nats_are_those_of_least_squares_from_every_beginning(unchecked):
    x, y, account, suspects = linear()
    since = since_each(account, range(0, 24, 4), np.arange(24.0), np.full(24, 10))
    assert [one.t for one in since] == [-np.inf, 4.0, 8.0, 12.0, 16.0, 20.0]
    nats = suspects.nats(since, ())
    for b, first in enumerate((0, 4, 8, 12, 16, 20)):
        price = 0.5 * np.log(10.0 * (24 - first))
        for i, own in enumerate(([2], [3, 4])):
            expected = 0.5 * saved(x, y, suspects.precision, first, own) - len(own) * price
            # The ridge that keeps singular suspects solvable is 1e-10 of the scale.
            assert nats[i, b] == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_a_member_leaves_a_rival_what_it_does_not_explain(unchecked):
    x, y, account, suspects = linear()
    since = since_each(account, range(0, 24, 4), np.arange(24.0), np.full(24, 10))
    beside = suspects.nats(since, (Member(0, 8.0),))
    assert beside[0].max() == -np.inf
    acts = np.repeat(np.arange(24) >= 8, 10)[:, None]
    flat = x.reshape(-1, 5)
    known = np.concatenate([flat[:, :2], acts * flat[:, [2]]], axis=1)
    later = np.repeat(np.arange(24) >= 12, 10)[:, None] * flat[:, 3:]

    def left(columns):
        prior = np.zeros((2, columns.shape[1]))
        prior[[0, 1], [0, 1]] = np.sqrt(suspects.precision)
        whole, target = np.concatenate([columns, prior]), np.concatenate([y.ravel(), np.zeros(2)])
        return np.sum((target - whole @ np.linalg.lstsq(whole, target)[0]) ** 2)

    expected = 0.5 * (left(known) - left(np.concatenate([known, later], axis=1))) - np.log(120.0)
    assert beside[1, 3] == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_beginnings_are_kept_in_constant_room_and_thin_out_with_age():
    zero, sums = np.zeros(1), [Sum(-np.inf, 0, np.zeros(1), np.zeros((1, 1)))]
    for k in range(2000):
        sums[-1] = sums[-1]._replace(t=4.0 * k)
        sums.append(Sum(4.0 * k + 4.0, k + 1, zero, np.zeros((1, 1))))
        sums = thinned(sums, (400.0,))
    ages = sums[-1].t - np.array([one.t for one in sums[1:-1]])
    assert len(sums) <= KEPT + 2 and 400.0 in [one.t for one in sums]
    # An age is met within half of it, and the last ones stand side by side.
    assert ages[-1] == 4.0 and np.all(ages[:-1] / ages[1:] <= 2.0 + 1e-9)


@pytest.mark.parametrize(
    ("rate", "samples"), [(50.0, 25), (10.0, 5), (5.0, 2), (4.0, 2), (2.0, 2), (1.0, 2), (0.5, 2)]
)
def test_a_block_is_as_short_as_two_samples_where_half_a_second_has_fewer(rate, samples):
    """Longer ones bend: what gusts do within one is no longer linear, and slow logs get false names."""
    steps = max(4, round(WINDOW * rate))
    assert steps // parts_of(steps, 1 / rate) == samples


def test_samples_taken_together_measure_the_mean_of_what_each_does(unchecked):
    """As sums of all that leads from a first state and from pushes to each sample; some were not seen."""
    rng, state, pushes, rows, together, groups = np.random.default_rng(0), 3, 2, 4, 3, 2
    count, driven = together * groups, state + pushes
    f, h = rng.normal(size=(count, state, driven)), rng.normal(size=(count, rows, driven))
    residual, seen = rng.normal(size=(count, rows, 5)), rng.random((count, rows)) < 0.7
    seen[:together, 0] = False
    h, residual = h * seen[..., None], residual * seen[..., None]
    dt, by_plane = rng.random(count), rng.normal(size=(count, pushes, PLANE))
    line = Line(*map(jnp.asarray, (f, h, residual, dt, by_plane, np.eye(state))))

    def measured(f, h, pushed):
        """What each sample shows by the first state, and by what pushes in each group, and the last state."""
        by, out = np.eye(state, state + groups * pushes), []
        for step in range(len(f)):
            push = np.eye(groups * pushes)[pushes * pushed[step] :][:pushes]
            both = np.concatenate([by, np.concatenate([np.zeros((pushes, state)), push], axis=1)])
            by = f[step] @ both
            out.append(h[step] @ both)
        return np.array(out), by

    taken = averaged(line, seen, together)
    alone, end = measured(f, h, np.repeat(np.arange(groups), together))
    own, own_end = measured(np.asarray(taken.f), np.asarray(taken.h), np.arange(groups))
    np.testing.assert_allclose(own_end, end, rtol=1e-12, atol=1e-12)
    for mine, theirs in ((own, alone), (np.asarray(taken.residual), residual)):
        for group in range(groups):
            here = slice(together * group, together * (group + 1))
            for row in range(rows):
                # The mean of n numbers with a noise of one has one of one by the root of n.
                n = max(seen[here, row].sum(), 1)
                expected = theirs[here, row].sum(axis=0) / n * np.sqrt(n)
                np.testing.assert_allclose(mine[group, row], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(taken.dt, dt.reshape(groups, together).sum(axis=1))
    np.testing.assert_array_equal(taken.by_plane, by_plane[::together])


@pytest.mark.parametrize(
    ("rate", "acceleration", "steps", "together"),
    [
        (100.0, np.nan, 50, 5),
        (50.0, np.nan, 24, 2),
        # An acceleration shows what pushes at its sample.
        (50.0, 0.02, 25, 1),
        (20.0, np.nan, 10, 1),
        (10.0, np.nan, 5, 1),
        (1.0, np.nan, 2, 1),
    ],
)
def test_samples_within_a_twentieth_of_a_second_are_taken_together(rate, acceleration, steps, together):
    noise = np.repeat([*NOISE.values(), acceleration, np.nan], 3)
    bench = Bench.with_noise(boat(), noise, 1 / rate, (ThrusterGain,))
    assert (bench.steps, bench.together) == (steps, together)
    assert bench.empty.line.f.shape[0] == steps // together


@pytest.mark.parametrize(
    ("numbers", "sound"),
    [
        ({"input_delay": 0.1}, True),
        ({"input_delay": -0.1}, False),  # commands that act before they are given
        ({"sensor_delay:velocity": -0.1}, False),  # a sensor that shows what is yet to come
        ({"sensor_delay:velocity": 0.1, "added_mass:yaw": 1.0}, True),
        ({"added_mass:yaw": -20.0}, False),  # less than none
        ({"added_mass:yaw": -20.0, "input_delay": 0.1}, False),
    ],
)
def test_members_that_no_craft_can_have_are_none(numbers, sound):
    noise = np.repeat([*NOISE.values(), np.nan, np.nan], 3)
    bench = Bench.with_noise(boat(), noise, DT, (InputDelay, SensorDelay, AddedMass))
    ledger = _ledger.Ledger(bench)
    labels = [one.label for one in bench.layout.suspects]
    members = [Member(labels.index(label), -np.inf) for label in numbers]
    # The file's own coefficients may bend as far as they like beside what has no name yet.
    filed = np.full(len(bench.base), -1e3)
    assert ledger.sound(np.array([*filed, *numbers.values()]), members) == sound


def test_rows_at_hand_count_as_squares_of_what_a_model_leaves(unchecked):
    x, y, account, suspects = linear()
    ledger: Any = object.__new__(_ledger.Ledger)
    ledger.suspicions, ledger.held, ledger.begun_at = suspects, 20, np.arange(24.0)
    known, acts = np.array([0.3, -0.1, 0.7]), np.arange(24) >= 8
    left = y + x[:, :, :2] @ known[:2] + acts[:, None] * x[:, :, 2] * known[2]
    at_hand = ledger.at_hand(account, known, (Member(0, 8.0),))
    assert at_hand == pytest.approx(-0.5 * np.sum(left[:20] ** 2), rel=1e-12)


def test_of_what_begins_elsewhere_older_sums_tell_once_they_are_about_it(unchecked):
    """Column 2 is a gain's, 3 and 4 are of something that starts elsewhere."""
    *_, suspects = linear()
    gain, far = SimpleNamespace(starts=()), SimpleNamespace(starts=({"delay": 0.3},))
    ledger: Any = object.__new__(_ledger.Ledger)
    ledger.suspicions = suspects
    ledger.bench = SimpleNamespace(swinging=(), layout=SimpleNamespace(suspects=(gain, far)))
    both, neutral = (Member(0, -np.inf), Member(1, -np.inf)), np.zeros(5)
    ledger.about = Acting(((-np.inf, neutral),))
    assert ledger._first_elsewhere(both) == [[3, 4]]
    ledger.about = Acting(((-np.inf, neutral), (8.0, np.eye(5)[3])))
    assert ledger._first_elsewhere(both) == []


@pytest.mark.parametrize(("label", "kept"), [("input_delay", False), ("added_mass:surge", True)])
def test_rows_told_again_about_what_begins_elsewhere_leave_older_sums_of_it_behind(label, kept):
    noise = np.repeat([*NOISE.values(), np.nan, np.nan], 3)
    ledger = _ledger.Ledger(Bench.with_noise(boat(), noise, DT, (InputDelay, AddedMass)))
    member = Member([one.label for one in ledger.bench.layout.suspects].index(label), ALWAYS)
    (account,), size = ledger.accounts, ledger.bench.layout.size
    account.sums = [Sum(-np.inf, 100, np.ones(size), np.ones((size, size)))]
    known = np.zeros(len(ledger.bench.base) + 1)
    (own,) = ledger.anew(known, [member], account, 0).accounts
    acts = np.full(size, True)
    acts[[*ledger._columns(member.suspect)]] = kept
    np.testing.assert_array_equal(own.sums[-1].g, acts)
    np.testing.assert_array_equal(own.sums[-1].h, np.outer(acts, acts))


@pytest.mark.parametrize(
    ("ought", "said", "here_alone"),
    [
        # 10 nats ought to be said, with a variance of 20: odds of e^3 are passed 10.95 below them.
        (10.0, -4.0, True),
        (10.0, -1.0, True),
        (10.0, -0.9, False),
        (10.0, 50.0, False),
        (100.0, 65.0, True),
        (100.0, 66.0, False),
        # Where next to nothing ought to be said only what speaks against it by as much is too little.
        (0.0, -2.9, False),
        (0.0, -3.1, True),
    ],
)
def test_whom_rows_at_hand_say_too_little_of_is_judged_by_them_alone(unchecked, ought, said, here_alone):
    """Older rows were summed up by slopes; odds of e^3 are those by which two are told apart."""
    late = Suspect(SensorDelay, "velocity", {"delay": (0,)})
    ledger = SimpleNamespace(
        bench=SimpleNamespace(layout=SimpleNamespace(suspects=(late,))),
        suspicions=SimpleNamespace(columns=(np.eye(1),)),
        begins_elsewhere=lambda suspect: False,
        price_of=lambda numbers: 4.0 * numbers,
        apart=lambda account, one, other: ought,
    )
    passage: Any = SimpleNamespace(ledger=ledger)
    none: Any = SimpleNamespace(level=7.0, at_hand=2.0, passage=passage, account=None, known=None, members=())
    told: Any = SimpleNamespace(level=207.0, at_hand=2.0 + said, known=None, members=())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_rivals.Field, "_price", lambda self, member: 5.0)
        rival = _rivals.Field(passage, (), none)._rival(Member(0, -np.inf), told)
    # Of all rows a number costs 5 nats, of those at hand 4.
    assert rival.here == pytest.approx(said - 4.0) and rival.summed != here_alone
    assert rival.nats == pytest.approx(said - 4.0 if here_alone else 195.0)


def test_models_are_expected_to_be_told_apart_by_half_the_squares_of_what_differs(unchecked):
    """Blocks whose residuals are linear in three parameters, the last of which acts from the eighth on."""
    x, _, account, suspects = linear()
    ledger: Any = object.__new__(_ledger.Ledger)
    ledger.suspicions, ledger.held, ledger.begun_at = suspects, 20, np.arange(24.0)
    acts = np.arange(20) >= 8
    with_one, without = np.array([0.3, -0.1, 0.7]), np.array([0.1, 0.2])
    differs = x[:20, :, :2] @ (with_one[:2] - without) + acts[:, None] * x[:20, :, 2] * with_one[2]
    ought = ledger.apart(account, (with_one, (Member(0, 8.0),)), (without, ()))
    # In white noise of unit variance the logarithm of the ratio of likelihoods has that mean, and twice that
    # variance; both here to four standard errors of as many draws.
    assert ought == pytest.approx(0.5 * np.sum(differs**2), rel=1e-12)
    noise = np.random.default_rng(3).normal(size=(4000, *differs.shape))
    drawn = 0.5 * np.sum((noise + differs) ** 2 - noise**2, axis=(1, 2))
    assert drawn.mean() == pytest.approx(ought, abs=4 * np.sqrt(2 * ought / 4000))
    assert drawn.var() == pytest.approx(2 * ought, rel=4 * np.sqrt(2 / 4000))


@pytest.mark.parametrize(
    ("nats", "order", "gap"),
    [
        # All that was ever told counts where it tells of both.
        ({"gain": (400.0, 20.0, True), "mass": (300.0, 90.0, True)}, ["gain", "mass"], 100.0),
        # Of a delay rows at hand alone tell: those count, whatever older ones say of a gain.
        ({"gain": (400.0, 20.0, True), "delay": (90.0, 90.0, False)}, ["delay", "gain"], 70.0),
        ({"gain": (400.0, 95.0, True), "delay": (90.0, 90.0, False)}, ["gain", "delay"], 5.0),
        ({"lag": (80.0, 80.0, False), "delay": (90.0, 90.0, False)}, ["delay", "lag"], 10.0),
        # Of those of which all rows tell the best one is compared, though another has more at hand.
        (
            {"gain": (400.0, 20.0, True), "mass": (300.0, 95.0, True), "delay": (90.0, 90.0, False)},
            ["delay", "mass", "gain"],
            -5.0,
        ),
    ],
)
def test_two_are_compared_by_the_rows_that_tell_of_both(nats, order, gap):
    told: Any = None
    ranked = _rivals.ranked(
        [
            _rivals.Rival(all_, label, ALWAYS, told, here, summed)
            for label, (all_, here, summed) in nats.items()
        ]
    )
    assert [one.label for one in ranked] == order and ranked[1].behind(ranked[0]) == gap


@pytest.mark.parametrize(
    ("delay", "most"),
    [
        *((delay, 9.0) for delay in (0.1, 0.17, 0.3, 0.45, 0.85, 1.3, 1.9)),
        (1.1, 1.25),
        (1.3, 1.35),
        (0.2, 0.25),
    ],
)
def test_a_delay_is_searched_among_the_steps_by_which_samples_show_it(unchecked, monkeypatch, delay, most):
    """Of steps of 0.1 s, to the one beside it at most; no craft bears more than a certain delay."""
    late = Suspect(InputDelay, None, {"delay": (0,)}, ({"delay": 0.3},))
    layout = SimpleNamespace(suspects=(late,), neutral_of=lambda i: np.zeros(1))
    ledger: Any = SimpleNamespace(bench=SimpleNamespace(layout=layout, dt=0.1), accounts=[None])
    passage: Any = SimpleNamespace(ledger=ledger)

    def told(passage, members, known, account, since):
        step = np.ceil(known[-1] / 0.1)
        return None if known[-1] > most else SimpleNamespace(level=500 - (step - np.ceil(delay / 0.1)) ** 2)

    monkeypatch.setattr(_rivals, "promised", told)
    monkeypatch.setattr(_rivals, "possible", lambda told: True)
    monkeypatch.setattr(_rivals.Field, "_price", lambda self, member: 4.0)
    field, member = _rivals.Field(passage, (), _none(passage, 0.0)), Member(0, ALWAYS)
    (start,) = field._starts(member)
    assert abs(np.ceil(start[0] / 0.1) - np.ceil(delay / 0.1)) <= 1
    # What promises less than its price has none.
    assert not [*_rivals.Field(passage, (), _none(passage, 497.0))._starts(member)]


def _none(passage: Any, level: float) -> Any:
    return SimpleNamespace(passage=passage, known=np.zeros(0), level=level)


def rival_of(monkeypatch, weighed: float, levels: dict[tuple[float, float], float]) -> _rivals.Rival | None:
    """What becomes of a lag, weighed from a time on, by levels for where it begins and its first number.

    Where slopes lead from there it stays; its slope at neutral leads to -0.1 s.
    """
    late = Suspect(ThrusterLag, None, {"time_constant": (0,)}, ({"time_constant": 0.15},))
    layout = SimpleNamespace(suspects=(late,), neutral_of=lambda i: np.zeros(1))
    suspicions = SimpleNamespace(
        estimate=lambda since, model: np.array([-0.1]),
        parts_of=lambda known, members: [known],
        columns=(np.eye(1),),
    )
    ledger = SimpleNamespace(
        bench=SimpleNamespace(layout=layout, steps=4),
        suspicions=suspicions,
        accounts=[None],
        # Blocks of a second, with a sample each quarter.
        begun_at=np.arange(12.0),
        ends_at=np.arange(12.0) + 1.0,
        room=20,
        block_of=int,
        since=lambda account: [
            Sum(t, seen, np.zeros(0), np.zeros((0, 0))) for t, seen in ((-np.inf, 1000), (8.0, 400))
        ],
        begins_elsewhere=lambda suspect: True,
        price_of=lambda numbers: 0.0,
        apart=lambda account, one, other: 0.0,
        begun_within=lambda t: np.array([t - 1.0, t, t + 1.0]) if t > -np.inf else np.zeros(0),
        nats_from=lambda account, model, times: [(None, [levels.get((t, -0.1), 0.0)]) for t in times],
    )
    passages = SimpleNamespace(ledger=ledger, rows=SimpleNamespace(t=np.arange(48) / 4))

    def told(passage, members, known, account, begins, cuts=()):
        since, first = members[-1].since, float(known[-1])
        # Before it begins nothing acts otherwise.
        assert begins == (cuts[0] if cuts else since) and passage is passages
        level = levels.get((since, first))
        if level is None:
            return None
        # From another beginning it goes on beside the disturbance that was told with the first.
        assert account == (None if since == weighed else "told")
        return SimpleNamespace(
            level=level, at_hand=level, members=members, known=known, account=account, passage=passages
        )

    def promised(*given):
        found = told(*given)
        # Slopes promise a little less than there is.
        return found and SimpleNamespace(**(vars(found) | {"level": found.level - 0.1}))

    def settled(*given):
        found = told(*given)
        return found and SimpleNamespace(**(vars(found) | {"account": "told"}))

    monkeypatch.setattr(_rivals, "tell", settled)
    monkeypatch.setattr(_rivals, "promised", promised)
    monkeypatch.setattr(_rivals, "possible", lambda told: True)
    none: Any = SimpleNamespace(
        level=0.0, at_hand=0.0, known=np.zeros(0), members=(), account=None, passage=passages
    )
    field: Any = _rivals.Field(passages, (), none)
    member = Member(0, weighed)
    return next(field.sloped([_rivals.Weighed(30.0, member, None)]), None)


@pytest.mark.parametrize(("beside_own", "named"), [(230.0, True), (20.0, False)])
def test_columns_are_exchanged_beside_a_disturbance_of_their_own(unchecked, monkeypatch, beside_own, named):
    """Beside the one that was estimated of the file, which pushed as they do not, all speaks against it."""
    first = SimpleNamespace(level=-70.0, at_hand=-80.0, known=np.zeros(0), account="first")
    own: Any = SimpleNamespace(level=beside_own, at_hand=beside_own - 20.0, known=np.zeros(0), account="own")
    passage: Any = SimpleNamespace(
        ledger=SimpleNamespace(accounts=["file's"]), exchanged=lambda cause: "otherwise"
    )
    monkeypatch.setattr(
        _rivals, "promised", lambda passage, *given: first if passage == "otherwise" else None
    )
    monkeypatch.setattr(_rivals, "suited", lambda told, before: own if told is first else None)
    monkeypatch.setattr(_rivals, "tell", lambda *given: own if given[-1] == "own" else None)
    none: Any = SimpleNamespace(level=0.0, at_hand=0.0, known=np.zeros(0))
    pair = Placed(ExchangedThrusters(), "port+bow")
    found = list(_rivals.Field(passage, (), none).connected_otherwise([pair], 30.0))
    said = [(one.label, one.nats, one.here, one.summed) for one in found]
    assert said == [("exchanged_thrusters:port+bow", 230.0, 210.0, False)] * named


ALWAYS = -np.inf
# Of a parameter by the numbers measured since, 3.45 and 3.0 nats.
PRICE = {ALWAYS: 0.5 * np.log(1000.0)} | {t: 0.5 * np.log(400.0) for t in (8.0, 8.5, 9.0, 9.75)}
BLOCKS = {(7.0, -0.1): 50.0, (8.0, -0.1): 60.0, (9.0, -0.1): 70.0}


@pytest.mark.parametrize(
    ("weighed", "levels", "since", "level"),
    [
        # A beginning costs as much as a number: 60 - 3 - 3.45 lies between 56.8 and 57.2, less 3.45 each.
        (8.0, {(8.0, -0.1): 60.0, (ALWAYS, -0.1): 57.2}, ALWAYS, 57.2),
        (8.0, {(8.0, -0.1): 60.0, (ALWAYS, -0.1): 56.8}, 8.0, 60.0),
        # Where the slope leads no craft is, or another place is better: its start counts.
        (ALWAYS, {(ALWAYS, 0.15): 260.0}, ALWAYS, 260.0),
        (ALWAYS, {(ALWAYS, -0.1): 20.0, (ALWAYS, 0.15): 260.0}, ALWAYS, 260.0),
        (ALWAYS, {(ALWAYS, -0.1): 260.0, (ALWAYS, 0.15): 20.0}, ALWAYS, 260.0),
        (8.0, {(8.0, 0.15): 260.0, (ALWAYS, 0.15): 259.0}, ALWAYS, 259.0),
        # Blocks that are linear about it tell when it began.
        (8.0, BLOCKS, 9.0, 70.0),
        (8.0, {(7.0, -0.1): 50.0, (8.0, -0.1): 60.0, (9.0, -0.1): 55.0}, 8.0, 60.0),
        # To the sample, in the block that suits best or in the one before; not in others.
        (8.0, {**BLOCKS, (9.75, -0.1): 75.0, (10.5, -0.1): 90.0}, 9.75, 75.0),
        (8.0, {**BLOCKS, (8.5, -0.1): 75.0, (7.5, -0.1): 90.0}, 8.5, 75.0),
    ],
)
def test_a_suspect_is_told_from_where_it_may_be(unchecked, monkeypatch, weighed, levels, since, level):
    rival = rival_of(monkeypatch, weighed, levels)
    assert (rival.since, rival.nats) == (since, pytest.approx(level - PRICE[since]))


def test_a_suspect_that_rows_do_not_bear_out_is_no_rival(unchecked, monkeypatch):
    assert rival_of(monkeypatch, ALWAYS, {(ALWAYS, 0.15): 2.0}) is None


@pytest.mark.parametrize(
    ("nats", "waits"),
    [
        # Patience is 400 blocks, and 30 nats led when rivals were asked last, two suspects alike.
        ([30.0, 29.0, 20.0], 400),
        ([60.0, 58.0, 20.0], 16),
        ([30.0, 28.0, 27.5], 100),
        # One that led must fall behind by six: two that go up and down are not asked about all the time.
        ([30.0, 25.0, 20.0], 400),
        ([30.0, 23.0, 20.0], 100),
        ([30.0, 29.0, 26.0], 400),
    ],
)
def test_who_leads_decides_how_long_rivals_wait(unchecked, nats, waits):
    bench = SimpleNamespace(layout=SimpleNamespace(suspects=("a", "b", "c")), length=4.0)
    judge: Any = _judge.Judge(SimpleNamespace(bench=bench), 0.01)
    judge.nats, judge.asked_with, judge.asked_about, judge.patience = np.array(nats), 30.0, [0, 1], 400
    assert judge._waits() == waits


@pytest.mark.parametrize(
    ("grows", "asked"),
    [
        # 20 nats are sure: asked at once, then after 32 blocks (patience has doubled), then after 64.
        (lambda block: 20.0, [100, 132, 196]),
        # Once there are twice as many, 16 blocks from one time to the next at least; then patience holds.
        (lambda block: 20.0 if block < 108 else 50.0, [100, 116, 180]),
        (lambda block: 20.0 if block < 124 else 40.0, [100, 124, 188]),
        # Once another is within 3 nats of the best, or no longer, likewise, or in a quarter of patience.
        (lambda block: (20.0, 17.5 if block >= 108 else 0.0), [100, 116, 180]),
        (lambda block: (20.0, 17.5 * (108 <= block < 120)), [100, 116, 132]),
        # Nothing is sure, or no longer: patience begins anew.
        (lambda block: 10.0, []),
        (lambda block: 20.0 if block < 104 or block >= 200 else 10.0, [100, 200, 232]),
    ],
)
def test_rivals_are_asked_anew_once_rows_tell_more_or_patience_ends(unchecked, monkeypatch, grows, asked):
    """The best by windows, before and after the disturbance is estimated anew, and the best by blocks."""
    layout, ledger = SimpleNamespace(suspects=("a", "b", "c")), SimpleNamespace(blocks=0, full=False)
    bench = SimpleNamespace(layout=layout, length=4.0, swinging=())
    ledger.bench = bench
    judge: Any = _judge.Judge(SimpleNamespace(bench=bench, ledger=ledger), 0.01)
    judge.bound, judge.estimated_at = 15.0, 80
    decided = []

    def weigh():
        best, next_best = np.broadcast_to(grows(ledger.blocks), 2) * [1.0, np.ndim(grows(ledger.blocks))]
        nats = np.array([[best, 0.0], [next_best, 0.0], [0.0, 0.0]])
        zero = np.zeros(0), np.zeros((0, 0))
        return [Sum(-np.inf, 1000, *zero), Sum(8.0, 500, *zero)], nats

    monkeypatch.setattr(judge, "_weigh", weigh)
    monkeypatch.setattr(judge, "_closely", lambda since, table: [Member(2, 8.5)])
    monkeypatch.setattr(judge, "_estimate", lambda: setattr(judge, "estimated_at", ledger.blocks))
    monkeypatch.setattr(judge, "_decide", lambda some, swinging: decided.append((ledger.blocks, some)) or [])
    for ledger.blocks in range(100, 240, 4):
        judge._look()
    assert [block for block, _ in decided] == asked
    best = ([one for one in some if one.suspect != 1] for _, some in decided)
    assert all(some == [Member(0, -np.inf), Member(2, 8.5)] for some in best)


@pytest.mark.parametrize(
    ("nats", "here", "says"),
    [
        ({"gain": 400.0, "delay": 93.0}, {"gain": 95.0, "delay": 93.0}, ["gain", "delay"]),
        ({"gain": 400.0, "delay": 90.0}, {"gain": 95.0, "delay": 40.0}, ["gain"]),
        # Rows at hand are for a delay, of which they are not sure; all rows are sure that something is wrong.
        ({"gain": 400.0, "delay": 25.0}, {"gain": 20.0, "delay": 25.0}, ["delay", "gain"]),
        ({"gain": 28.0, "delay": 25.0}, {"gain": 20.0, "delay": 25.0}, []),
    ],
)
def test_one_is_named_that_is_sure_by_all_rows_and_ahead_by_those_that_tell_of_both(
    unchecked, monkeypatch, nats, here, says
):
    told: Any = SimpleNamespace(members=(Member(0, ALWAYS),))
    some = [_rivals.Rival(nats[one], one, ALWAYS, told, here[one], one == "gain") for one in nats]
    bench = SimpleNamespace(layout=SimpleNamespace(suspects=("gain",)), length=4.0, swinging=())
    judge: Any = _judge.Judge(SimpleNamespace(bench=bench, ledger=SimpleNamespace(bench=bench)), 0.01)
    judge.bound, said = 30.0, []
    sure = _rivals.Weighed(50.0, Member(0, ALWAYS), SimpleNamespace())
    monkeypatch.setattr(judge, "_weighed", lambda suspected: [sure])
    monkeypatch.setattr(judge, "label", lambda suspect: "another")
    monkeypatch.setattr(_judge, "rivals", lambda *given: _rivals.ranked(some))
    monkeypatch.setattr(judge, "_cannot_tell", lambda labels, nats, since: said.extend(labels) or [])
    monkeypatch.setattr(judge, "_name", lambda best: said.append(best.label) or [])
    judge._decide([], False)
    assert said == says


@pytest.mark.parametrize(
    ("full", "swells", "answers", "asks"),
    [
        (True, True, [], True),
        (True, False, [], False),
        (True, False, ["port+bow"], True),
        (False, True, ["port+bow"], False),
    ],
)
def test_what_no_slope_tells_is_asked_of_all_rows_that_can_be_at_hand(
    unchecked, monkeypatch, full, swells, answers, asks
):
    """If a swell is a regular wave, and if columns are exchanged where signs say so; after a while again."""
    bench = SimpleNamespace(layout=SimpleNamespace(suspects=("waves",)), length=4.0, swinging=(0,))
    account = SimpleNamespace(force=SimpleNamespace(swells=swells))
    ledger = SimpleNamespace(full=full, blocks=160, accounts=[account], bench=bench)
    judge: Any = _judge.Judge(SimpleNamespace(bench=bench, ledger=ledger), 0.01)
    monkeypatch.setattr(_judge, "answered_otherwise", lambda passage: answers)
    assert judge._unsloped() == asks
    judge.swell_at, judge.calm = 150, 16
    assert not judge._unsloped()


# --- blocks that are linear about something ------------------------------------------------------


@pytest.fixture(scope="module")
def begun(broken) -> Watch:
    """A watch before it has estimated what disturbs the boat."""
    watch = Watch(boat(), catalogue=SMALL)
    for row in list(rows_of(broken))[:100]:
        watch.update(row)
    return watch


def test_blocks_about_an_effect_are_those_of_a_craft_that_has_it(begun):
    passage = begun.parts.passage
    bench, layout = passage.bench, passage.bench.layout
    placed, z, own = [], np.zeros(layout.size), []
    for effect, target, parameter, value in (
        ("thruster_gain", "port", "factor", 0.5),
        ("quadratic_damping", "surge", "value", 25.0),
    ):
        suspect = suspect_named(boat(), effect, target)
        placed.append(Placed(place(suspect, boat(), {parameter: value}), target))
        i = layout.place_of(placed[-1])
        z += layout.columns[i][:, 0] * (value - layout.neutral_of(i)[0])
        own.append(layout.columns[i][:, 0])
    other = Bench.with_noise(boat().place(*placed), bench.noise, bench.dt, SMALL)
    rows = passage.rows.part(0, bench.past + bench.steps + 1)

    def told(bench, z):
        window = bench.window(rows, bench.steps, None, LONG, False, 1, z, np.zeros((0, 13)))
        return window.line.residual, window.end

    for mine, theirs in zip(told(bench, z), told(other, np.zeros(layout.size)), strict=True):
        np.testing.assert_allclose(mine[..., -1] + mine[..., :-1] @ z, theirs[..., -1], atol=1e-9)
        # A factor beside that of one half counts half as much; damping adds up.
        for column, share in zip(own, (0.5, 1.0), strict=True):
            np.testing.assert_allclose(
                share * mine[..., :-1] @ column, theirs[..., :-1] @ column, rtol=1e-6, atol=1e-9
            )


@pytest.mark.parametrize(("delay", "known"), [(0.23, 20), (0.63, 20), (0.23, 0), (0.63, 3)])
def test_a_late_sensor_shows_what_was_before_a_block(begun, delay, known):
    """Lines between samples of what was expected before and the block's path; before those the first line."""
    bench = Bench.with_noise(boat(), begun.parts.passage.bench.noise, DT, (SensorDelay,))
    rows = begun.parts.passage.rows.part(0, bench.past + bench.steps + 1)
    past = np.zeros((known, 13))
    past[:, 3], past[:, 7:9] = 1.0, np.random.default_rng(1).normal(size=(known, 2))
    (suspect,) = [i for i, one in enumerate(bench.layout.suspects) if one.target == "velocity"]

    def told(delay):
        z = delay * bench.layout.columns[suspect][:, 0]
        window = bench.window(rows, bench.steps, None, LONG, False, 1, z, past)
        velocity = [bench.channels.index(channel) for channel in (6, 7)]
        by = window.line.residual[:, velocity, :-1] @ bench.layout.columns[suspect][:, 0]
        return window, window.line.residual[:, velocity, -1] + by * delay, by

    window, off, slope = told(delay)
    own = slice(-bench.steps - 1, -1)
    t = rows.t[own]
    path = np.concatenate([past, window.states])[:, 7:9]
    times = t[0] + DT * np.arange(-known, bench.steps)
    cell = np.clip(np.searchsorted(times, t - delay) - 1, 0, None)
    rise = (path[cell + 1] - path[cell]) / DT
    shown = path[cell] + rise * (t - delay - times[cell])[:, None]
    measured = rows.channels[own, 6:8]
    np.testing.assert_allclose(off, (shown - measured) / bench.noise[6:8], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(slope, -rise / bench.noise[6:8], rtol=1e-9, atol=1e-9)


def test_what_fluids_remember_hangs_on_the_past_alone(begun):
    """Were what is measured in a block and behind it in their memory, its noise would be taken for theirs."""
    passage = begun.parts.passage
    bench = Bench.with_noise(boat(), passage.bench.noise, DT, (FluidMemory,))
    rows = passage.rows.part(0, bench.past + bench.steps + 1)
    other = np.array(rows.channels)
    other[-bench.steps :] += 10 * bench.noise * np.random.default_rng(2).normal(size=(bench.steps, 18))
    start = Begun(np.zeros(3), np.array([1.0, 0, 0, 0]), np.ones(6), np.zeros(len(bench.axes) + PLANE))
    faster, still = np.zeros((2, 20, 13))
    faster[:, 3], faster[:, 7:], still[:, 3] = 1.0, 0.5, 1.0

    def slopes(channels, trail):
        here = dataclasses.replace(rows, channels=channels)
        window = bench.window(here, bench.steps, start, 0.0, True, 1, np.zeros(bench.layout.size), trail)
        return window.end[:, :-1]

    own = slopes(rows.channels, faster)
    np.testing.assert_array_equal(own, slopes(other, faster))
    assert np.abs(own - slopes(rows.channels, still)).max() > 1e-3 * np.abs(own).max() > 0


def test_what_was_before_windows_is_the_path_of_those_before_them():
    """Of two logs, of one some windows are missing and of one samples: as far as they follow each other."""
    log, begins = [0, 0, 0, 0, 1, 1], [10, 13, 20, 23, 0, 3]
    step = np.array(begins)[:, None] + np.arange(3)
    states = np.arange(18.0)[:, None] * np.ones(13)
    shapes = (3, 1), (3, 1), (3,), (4,), (6,)
    windows = Windows(jnp.array(log), jnp.asarray(step), *(jnp.zeros((6, *shape)) for shape in shapes))
    dt = jnp.ones((2, 30)).at[1, 2].set(100.0)
    whole = [jnp.zeros((2, 30, width)) for width in (1, 6, 4, 6)]
    records = Records(dt, dt, jnp.ones((2, 30)), *whole, jnp.zeros((2, 30), int))
    trail, known, before = Trail.nothing(4), [], []
    for part in (slice(0, 2), slice(2, 6)):
        some = jax.tree.map(lambda a, part=part: a[part], windows)
        found, trail = trail.then(records, some, jnp.asarray(states.reshape(6, 3, 13)[part]))
        known += np.asarray(found.known).tolist()
        before += np.asarray(found.states).tolist()
    assert known == [0, 3, 0, 3, 0, 0]
    for w, count in enumerate(known):
        np.testing.assert_array_equal(
            np.array(before[w])[4 - count :], states[3 * w - count : 3 * w] if count else states[:0]
        )


def test_rows_that_are_told_again_about_the_same_say_the_same(begun):
    passage = begun.parts.passage
    account = passage.ledger.accounts[0]
    again = passage.again(np.zeros(len(passage.bench.base)), (), account)
    held = passage.ledger.held
    assert again.ledger.held == held > 10 and again.ledger.blocks == passage.ledger.blocks
    np.testing.assert_array_equal(again.ledger.begun_at[:held], passage.ledger.begun_at[:held])
    for mine, theirs in zip(again.ledger.accounts[0].said, account.said, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("named", [(), ("thruster_gain:port",)])
def test_who_begins_within_a_window_is_in_nothing_before(begun, named):
    """As blocks tell it that were without a trace of any suspect before, one after the other.

    What is named acts all the while, though others may have columns of its own: all thrusters together.
    """
    ledger = begun.parts.passage.ledger
    bench, first = ledger.bench, ledger.bench.whole + 3
    labels = [one.label for one in bench.layout.suspects]
    members = [Member(labels.index(one), -np.inf) for one in named]
    own = [np.flatnonzero(ledger.suspicions.columns[one.suspect].any(axis=1)) for one in members]
    begins = float(ledger.begun_at[first])
    near = ledger.begun_at[first - bench.whole + 1 : first + bench.whole]
    np.testing.assert_array_equal(ledger.begun_within(begins), near)
    filed = [one.index for one in bench.base]
    after = _ledger.Ledger(bench)
    for k in range(ledger.held):
        window = jax.tree.map(lambda a, k=k: a[k], ledger.windows)
        if k < first:
            acts = np.zeros(window.end.shape[-1])
            acts[[*filed, *np.concatenate([*own, []]).astype(int), -1]] = 1.0
            seen = window.line.residual * acts, window.end * acts
            window = eqx.tree_at(lambda w: (w.line.residual, w.end), window, seen)
        assert after.add(window, Place(*(one[k] for one in ledger.places))) is not None
    account = after.accounts[0]
    since = since_each(account, [0, first], after.begun_at[: after.held], after.counts)
    # Behind another beginning, and before one.
    some = [float(ledger.begun_at[first - 2]), begins, float(ledger.begun_at[first + 1])]
    _, (told, nats), _ = ledger.nats_from(ledger.accounts[0], members, some)
    assert (told.t, told.seen) == (begins, since[1].seen)
    # To what rounding leaves of a hundred nats.
    np.testing.assert_allclose(nats, after.suspicions.nats(since, members)[:, 1], rtol=1e-7, atol=1e-7)
    windows = ledger.nats(ledger.accounts[0], ledger.since(ledger.accounts[0]), members)
    nats, windows = (np.delete(one, [m.suspect for m in members], axis=0) for one in (nats, windows))
    assert np.abs(windows[:, 1:3].max(axis=1) - nats).max() > 1.0


def test_a_column_behind_two_gates_acts_once_both_are_passed():
    begun_at, gates = np.array([0.0, 1.0, 2.0, 3.0]), (((0, 2), 1.0), ((2,), 3.0))
    expected = np.array([[0, 1, 0], [1, 1, 0], [1, 1, 0], [1, 1, 1]], float)
    for some in (gates, gates[::-1]):
        np.testing.assert_array_equal(_ledger.acts_of(some, begun_at, 3), expected)
    np.testing.assert_array_equal(_ledger.acts_of(gates, np.array(1.0), 3), expected[1])


def test_beginnings_asked_together_are_those_asked_one_by_one(begun, monkeypatch):
    """In any order, over blocks that are filtered in two parts, beside a member that began among them."""
    ledger = begun.parts.passage.ledger
    account, begun_at = ledger.accounts[0], ledger.begun_at
    some = [float(begun_at[k]) for k in (9, 3, 14)]
    members = [Member(2, float(begun_at[6]))]
    together = ledger.nats_from(account, members, some)
    monkeypatch.setattr(_ledger, "CHUNK", 14)
    for t, (told, nats) in zip(some, together, strict=True):
        ((alone, other),) = ledger.nats_from(account, members, [t])
        assert told.t == alone.t == t
        np.testing.assert_allclose(nats, other, rtol=1e-7, atol=1e-7)


def test_blocks_of_samples_taken_together_are_means_of_those_of_each(begun, monkeypatch):
    """By twos, of which a sensor missed one, beside blocks of the same samples one by one."""
    passage, found = begun.parts.passage, []
    for near, together, count in ((0.01, 1, 5), (0.2, 2, 4)):
        monkeypatch.setattr(_blocks, "NEAR", near)
        bench = Bench.with_noise(boat(), passage.bench.noise, DT, (ThrusterGain,))
        assert (bench.together, bench.steps) == (together, count)
        rows = passage.rows.part(0, 60 + count + 1)
        rows.channels[61, 6:8] = np.nan
        start = Begun(np.zeros(3), np.eye(4)[0], np.full(6, 0.1) * boat().free, np.zeros(3 + PLANE))
        z = np.zeros(bench.layout.size)
        window = bench.window(rows, count, start, 0.0, True, 1, z, np.zeros((0, 13)))
        found.append(window.line.residual)
    alone, taken = found
    seen = np.full((2, len(bench.channels), 1), 2.0)
    seen[0, [bench.channels.index(channel) for channel in (6, 7)]] = 1.0
    sums = alone[:4].reshape(2, 2, *alone.shape[1:]).sum(axis=1)
    np.testing.assert_allclose(taken, sums / np.sqrt(seen), rtol=1e-9, atol=1e-9)
    assert np.abs(taken[..., :-1]).max() > 0.1


@pytest.mark.parametrize("after", [7.0, 9.0, 12.5])
def test_rows_told_again_from_a_time_on_say_what_they_do_told_again_as_a_whole(broken, after):
    """Within a stretch, where one begins behind a gap, and between two blocks; beside another disturbance."""
    watch = Watch(boat(), catalogue=(*SMALL, SensorDelay, InputDelay, FluidMemory))
    rows = list(rows_of(broken))[:110]
    for row in [*rows[:48], *rows[56:]]:
        watch.update(row)
    passage = watch.parts.passage
    layout, begun_at = passage.bench.layout, passage.ledger.begun_at
    gaps = np.flatnonzero(np.diff(begun_at[: passage.ledger.held]) > 0.6) + 1
    assert 9 in gaps and passage.ledger.held > 14
    account = passage.ledger.accounts[0]
    stronger = dataclasses.replace(
        account, force=dataclasses.replace(account.force, size=3 * account.force.size)
    )
    suspect = next(i for i, one in enumerate(layout.suspects) if one.label == "thruster_gain:port")
    base = len(passage.bench.base)
    none = passage.again(np.zeros(base), (), stronger)
    since = float(np.interp(after, np.arange(15), begun_at[:15]))
    told = np.append(np.zeros(base), -0.4), (Member(suspect, since),)
    whole = passage.again(*told, stronger)
    split = int(after % 1 > 0)
    for _ in range(2):  # anew, and from what was remembered
        part = none.again(*told, stronger, since)
        assert part.ledger.held == passage.ledger.held + split
        assert part.ledger.blocks == passage.ledger.blocks + split
        assert part.ledger.t == whole.ledger.t
        np.testing.assert_array_equal(part.rows.t[-20:], whole.rows.t[-20:])
        for mine, theirs in zip(part.ledger.accounts[0].said, whole.ledger.accounts[0].said, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(part.course.begun.state, whole.course.begun.state, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(part.course.trail, whole.course.trail, rtol=1e-9, atol=1e-9)


@pytest.fixture(scope="module", params=[0.0, 1.7e9], ids=["since the start", "since 1970"])
def stepping(request) -> Watch:
    """A watch of a boat that gets new commands within blocks, by any clock."""
    catalogue = (ThrusterGain, LinearDamping, InputDelay, ThrusterLag, FluidMemory, SensorDelay)
    watch = Watch(boat(), catalogue=catalogue)
    for row in rows_of(record(boat(), steps(110, hold=17))):
        watch.update(row | {"t": row["t"] + request.param})
    return watch


def told_in_two(watch: Watch, row: int) -> tuple[_passage.Passage, Member, int]:
    """What it was told, again, as if a thruster began to be weak with a row; the block that was split."""
    passage, ledger = watch.parts.passage, watch.parts.passage.ledger
    labels = [one.label for one in ledger.bench.layout.suspects]
    member = Member(labels.index("thruster_gain:port"), float(passage.rows.t[row]))
    known = np.zeros(len(ledger.bench.base) + 1)
    again = passage.again(known, (member,), ledger.accounts[0])
    assert again is not None
    return again, member, ledger.block_of(member.since)


@pytest.mark.parametrize("row", [34, 51, 63])
def test_a_block_within_which_something_begins_is_told_as_two(stepping, row):
    """Where nothing acts otherwise the two say what the one did; samples that fill them say nothing.

    New commands come with the first two rows, and hang on delays and lags. But for what is linear about a
    path that begins anew amid the block: of this boat some hundredths of a suspect's error.
    """
    passage = stepping.parts.passage
    bench, ledger, account = passage.bench, passage.ledger, passage.ledger.accounts[0]
    held = ledger.held
    split, member, k = told_in_two(stepping, row)
    split = split.ledger
    assert ledger.begun_at[k] < member.since - 0.5 * DT and split.begun_at[k + 1] == member.since
    whole = passage.again(np.zeros(len(bench.base)), (), account).ledger
    assert split.held == held + 1 == whole.held + 1
    np.testing.assert_array_equal(np.delete(split.begun_at[: held + 1], k + 1), ledger.begun_at[:held])
    np.testing.assert_array_equal(np.delete(split.ends_at[: held + 1], k), ledger.ends_at[:held])
    assert split.counts[k : k + 2].sum() == ledger.counts[k]
    assert split.samples[: held + 1].sum() == bench.steps * held
    assert split.samples[k : k + 2].sum() == bench.steps
    # Windows begin where they did.
    begins = [one.t for one in split.since(split.accounts[0])]
    assert {*begins} == {one.t for one in whole.since(whole.accounts[0])} | {member.since}
    told, before = (
        [one[: one_of.held].sum(axis=0) for one in one_of.accounts[0].said] for one_of in (split, whole)
    )
    assert told[0] == pytest.approx(before[0], abs=0.02)
    # The member's own column, and what hangs on it, has not acted before.
    own = np.flatnonzero(ledger.suspicions.columns[member.suspect].any(axis=1))
    others = np.setdiff1d(np.arange(bench.layout.size), own)
    size = np.sqrt(np.maximum(np.diag(before[2])[others], 1e-12))
    np.testing.assert_allclose(told[1][others] / size, before[1][others] / size, atol=0.05)
    both = np.ix_(others, others)
    np.testing.assert_allclose(
        told[2][both] / np.outer(size, size), before[2][both] / np.outer(size, size), atol=0.02
    )


def test_blocks_that_were_told_as_two_are_told_again_so(stepping):
    """From the first on, and from a second part on, when those before are let go."""
    split, member, k = told_in_two(stepping, 34)
    ledger = split.ledger
    known = np.zeros(len(ledger.bench.base) + 1)
    for gone in (0, k + 1):
        for one in (*ledger.of_blocks, *ledger.accounts[0].said):
            one[: ledger.held - gone] = one[gone : ledger.held].copy()
        ledger.held -= gone
        again = split.again(known, (member,), ledger.accounts[0]).ledger
        assert again.held == ledger.held > 8
        for mine, theirs in zip(again.places, ledger.places, strict=True):
            np.testing.assert_array_equal(mine[: again.held], theirs[: again.held])
        began = np.asarray(ledger.windows.joined[1 : ledger.held])
        np.testing.assert_array_equal(again.windows.joined[1 : again.held], began)
        assert not again.windows.joined[0]


def test_where_there_is_no_room_for_another_block_rows_are_not_told_again(stepping, monkeypatch):
    passage, none = stepping.parts.passage, np.zeros(len(stepping.parts.passage.bench.base))
    account = passage.ledger.accounts[0]
    assert passage.again(none, (), account) is not None
    monkeypatch.setattr(_ledger, "CHUNK", passage.ledger.held // 2)
    assert passage.again(none, (), account) is None


def test_a_swell_that_keeps_in_step_starts_as_the_wave_that_pushes_so(unchecked):
    """By the disturbance's own states from a block's end on, which forget nothing here."""
    rng = np.random.default_rng(4)
    axes, period, ends = (0, 1, 5), 6.5, 123.4
    heading = Rotation.from_euler("z", 0.8)
    parts, frequency = 2 * len(axes), 2 * np.pi / period
    force = Disturbance(
        jnp.ones(parts),
        jnp.full(parts, 1e12),
        jnp.array([0.0] * 3 + [frequency] * 3),
        jnp.zeros(1),
        jnp.zeros(1, bool),
        axes,
    )
    # Along one line, seen from the craft; a yawing moment is no part of a wave.
    towards = heading.inv().apply([3.0, -1.0, 0.0])
    states = np.zeros(force.states)
    pairs = np.outer([towards[0], towards[1], 4.0], rng.normal(size=2))
    states[3:] = np.pad(pairs, ((0, 0), (2, 0))).ravel()
    mean = jnp.zeros((13 + force.states, 2)).at[13:, 1].set(states)
    message = Message(mean, jnp.zeros((len(mean), len(mean))), jnp.zeros((13, 2)))
    _, layout = saturate(boat(), (Waves,))
    ledger = SimpleNamespace(
        t=ends,
        begun_at=[ends - 60.0],
        suspicions=SimpleNamespace(acting=lambda known, members: Acting(((-np.inf, np.zeros(1)),))),
        bench=SimpleNamespace(layout=layout),
    )
    begun = SimpleNamespace(attitude=heading.as_quat(scalar_first=True))
    passage: Any = SimpleNamespace(course=SimpleNamespace(begun=begun), ledger=ledger)
    account: Any = SimpleNamespace(force=force, message=message)
    slots = layout.suspects[0].slots
    some = waves(passage, account, np.zeros(0), (), 0)
    found = [dict(zip(slots, z + layout.neutral_of(0), strict=True)) for z in some]
    assert [60.0 / one["period"] - 60.0 / period for one in found] == pytest.approx(SLIPS)
    wave = Waves(*(jnp.asarray(found[0][name]) for name in ("north", "east", "period", "phase")))
    by = force.output(by_plane(force.axes, jnp.asarray(begun.attitude)))
    for after in (0.0, 1.3, 4.0):
        push = -(by @ force.after(jnp.asarray(after), jnp.asarray(states)[:, None]))[:3, 0]
        here: Any = SimpleNamespace(t=ends + after, rotation=jnp.asarray(heading.as_matrix()))
        np.testing.assert_allclose(wave(here)[:2], push[:2], rtol=1e-9, atol=1e-9)


def test_a_wave_that_is_told_hours_later_has_the_phase_that_slopes_led_to():
    """They are those of sin(2 pi t / period + phase) at the time of the rows."""
    _, layout = saturate(boat(), (SteadyCurrent, Waves))
    names = [one.label for one in layout.suspects]
    suspicions = Suspicions(np.arange(0), np.zeros(0), layout.columns)
    members = (Member(names.index("steady_current"), -np.inf), Member(names.index("waves"), -np.inf))
    width, t = layout.columns[members[0].suspect].shape[1], 5 * 3600.0
    before = np.append(np.full(width, 0.1), [1.0, 2.0, 3.0, 0.4])  # a period of 5 + 3 s
    slopes = before + np.append(np.zeros(width), [0.5, 0.0, 0.02, 0.1])
    found = in_step(suspicions, layout, members, before, slopes, t)
    np.testing.assert_array_equal(found[:-1], slopes[:-1])
    # By a difference quotient, where the period hardly moves.
    small = 1e-6
    turned = 2 * np.pi * t * (1 / (8.0 + small) - 1 / 8.0) / small * 0.02 + 0.1
    assert 2 * np.pi * t * (1 / 8.02 - 1 / 8.0) + found[-1] - before[-1] == pytest.approx(turned, rel=1e-5)


# --- a watch -------------------------------------------------------------------------------------


def test_a_file_that_says_it_is_a_guess_is_told_so_once():
    guessed = Watch(dataclasses.replace(boat(), prior=(("added_mass", 0.6),)), catalogue=SMALL)
    row = {"t": 0.0, "x": 0.0, "port": 0.1, "starboard": 0.0, "bow": 0.0}
    told = guessed.update(row) + guessed.update(row | {"t": 0.1})
    assert len(told) == 1 and "jaxmarine fit" in told[0]
    assert not Watch(boat(), catalogue=SMALL).update(row)


def test_a_thruster_that_grows_weak_is_named_with_its_time(watched):
    watch, told = watched
    (name,) = watch.named
    value, std, _ = name.parameters["factor"]
    assert name.label == "thruster_gain:starboard" and SINCE < name.at < SINCE + 20.0
    # It began within a block, and what was said since then is kept when that is let go.
    assert name.since == pytest.approx(SINCE)
    ledger = watch.parts.passage.ledger
    assert ledger.begun_at[0] > SINCE and name.since in [one.t for one in ledger.since(ledger.accounts[0])]
    assert abs(value - WEAK) < 4 * std + 0.02
    assert any("thruster_gain:starboard, since t =" in said for said in told)
    gain = watch.extended.plant().drive.gain
    np.testing.assert_allclose(gain, [1.0, WEAK, 1.0], atol=0.03)


def sailed(commands: np.ndarray, seed: int, **acting: np.ndarray) -> tuple[Log, np.ndarray]:
    """A log of the boat under what acts on it besides, and its channels without noise."""
    t = np.arange(len(commands)) * DT
    blank = Log(t, np.full((len(t), 18), np.nan), commands, None, boat().thruster_names, "x")
    clean = np.asarray(simulate(boat(), blank, initial_state(boat()), **acting).channels)
    noise = np.repeat([*NOISE.values(), np.nan, np.nan], 3)
    noisy = clean + noise * np.random.default_rng(seed).normal(size=clean.shape)
    return dataclasses.replace(blank, channels=noisy), clean


def test_nothing_is_named_of_a_boat_that_is_only_pushed_by_gusts_and_swell(tmp_path):
    size, swell = np.array([[1.0, 1.0, 0.0, 0.0, 0.0, 0.2], [2.0, 4.0, 0.0, 0.0, 0.0, 0.5]])
    # To where blocks are let go for the third time.
    t = np.arange(540) * DT
    push = RandomWrench(size, np.full(6, 3.0), swell, 4.0, 10.0).draw(t, 5)
    log, clean = sailed(steps(540, 4), 6, push=push)
    watch = Watch(boat(), catalogue=SMALL)
    for row in rows_of(log):
        watch.update(row)
    status, force = watch.status, watch.status.disturbance
    assert not status.named and not status.undecided and max(status.nats.values()) < status.bound
    # In step with itself for ten seconds: its spectrum is a thirtieth of a hertz wide.
    assert 1.0 / force.period == pytest.approx(1.0 / 4.0, abs=1.0 / (np.pi * 10.0))
    # Of the size that was drawn: the standard error of one from a few memories is a half.
    np.testing.assert_allclose(force.swell[[0, 1, 5]], swell[[0, 1, 5]], rtol=0.6)
    # Expected of a position that is measured to a centimetre or two.
    np.testing.assert_allclose(status.state.position, clean[round(status.t / DT), :3], atol=0.05)
    rows = {one["axis"]: one for one in disturbance_of(status)}
    swelling = rows[f"sway, swell of {force.period:.2g} s"]
    assert (swelling["size"], swelling["memory"], swelling["unit"]) == (
        force.swell[1], force.swell_memory, "N",
    )  # fmt: skip
    assert len(rows) == 2 * len(status.axes) and rows["yaw"]["now"] == status.state.wrench[2]
    kept_and_restored(watch, tmp_path / "swell")
    # And in a drift and a current, too.
    account = watch.parts.passage.ledger.accounts[0]
    wider = flowing(drifting(account.force, 3.0))
    for what in ("before", "message"):
        setattr(account, what, getattr(account, what).widened(account.force, wider))
    account.force, account.learned = wider, np.eye(count_of(wider))
    again = kept_and_restored(watch, tmp_path / "both")
    assert {one["axis"] for one in disturbance_of(again.status)} == {
        *rows, "drift, north", "drift, east", "water, north", "water, east",
    }  # fmt: skip


def kept_and_restored(watch: Watch, path: Path) -> Watch:
    """Another watch that goes on where one was; its first account is the same."""
    again = Watch(boat(), catalogue=SMALL)
    _saved.write_state(watch, path, None)
    _saved.restore(again, path)
    mine, theirs = (one.parts.passage.ledger.accounts[0] for one in (watch, again))
    assert mine.force.kind == theirs.force.kind
    trails = [one.parts.passage.course.trail for one in (watch, again)]
    assert len(trails[0])
    np.testing.assert_array_equal(*trails)
    for what in ("force", "before", "message"):
        parts = (jax.tree.leaves(getattr(one, what)) for one in (mine, theirs))
        for a, b in zip(*parts, strict=True):
            np.testing.assert_array_equal(a, b)
    return again


def test_an_effect_without_a_slope_is_named_and_nothing_after_it():
    """Thrusters that give no more than two fifths, of a file that has no limit."""
    limited = place(suspect_named(boat(), "saturation", None), boat(), {"limit": 0.4})
    watch = Watch(boat(), catalogue=SMALL)
    for row in rows_of(record(boat().place(Placed(limited, None)), steps(200, 2), seed=3)):
        watch.update(row)
    (name,) = watch.named
    value, std, _ = name.parameters["limit"]
    assert name.label == "saturation" and abs(value - 0.4) < 4 * std < 0.2
    assert not watch.status.undecided


def test_columns_that_are_exchanged_are_named_and_kept(tmp_path, monkeypatch):
    """A watch that was kept then goes on with them as they are."""
    log = record(boat(), steps(260, 5), seed=7)
    wrong = dataclasses.replace(log, commands=log.commands[:, [1, 0, 2]])
    first, second = Watch(boat(), catalogue=SMALL), Watch(boat(), catalogue=SMALL)
    rows = list(rows_of(wrong))
    for row in rows[:200]:
        first.update(row)
    assert [one.label for one in first.named] == ["exchanged_thrusters:port+starboard"]
    _saved.write_state(first, tmp_path / "state", None)
    _saved.restore(second, tmp_path / "state")
    # One of another program has other numbers in its place.
    with monkeypatch.context() as patch, pytest.raises(InputError, match="of another version"):
        patch.setattr(_saved, "FORMAT", _saved.FORMAT - 1)
        _saved.restore(Watch(boat(), catalogue=SMALL), tmp_path / "state")
    for row in rows[200:]:
        assert first.update(row) == second.update(row)
    for watch in (first, second):
        (placed,) = watch.extended.placed
        assert placed.target == "port+starboard" and len(watch.named) == 1
    for label, nats in first.status.nats.items():
        assert nats < first.status.bound
        assert second.status.nats[label] == pytest.approx(nats, rel=1e-9, abs=1e-9)


@pytest.mark.slow
def test_a_current_that_may_wander_is_not_named_as_a_steady_one():
    """Both are looked at after ten seconds: one hardly moves in its memory of 40 s, one does not at all.

    In a minute that is four memories of 15 s long the steady one is told, and the size of those that wander.
    """
    t = np.arange(600) * DT
    slow, quick = (
        RandomWrench(np.zeros(6), np.ones(6), current=0.1, current_memory=memory).draw_current(t, 0)
        for memory in (40.0, 15.0)
    )
    steady = np.tile([0.1, -0.05, 0.0], (len(t), 1))
    for water in (slow, quick, steady):
        watch = Watch(boat(), catalogue=SMALL)
        log, _ = sailed(steps(len(t)), 0, water=water)
        told = [one for row in rows_of(log) for one in watch.update(row)]
        if water is slow:
            # It is said all the same that something is wrong.
            assert "cannot be told yet, steady_current, a current that wanders" in told[0]
        if water is not steady:
            assert not watch.named
            assert watch.status.disturbance.current == pytest.approx(0.1, rel=0.5)
            continue
        assert [one.label for one in watch.named] == ["steady_current"]
        for part, true in (("north", 0.1), ("east", -0.05)):
            value, std, _ = watch.named[0].parameters[part]
            assert abs(value - true) < 4 * std


@pytest.mark.slow
def test_a_force_that_may_wander_is_not_named_as_a_steady_wind():
    """While the boat turns; told again in five memories, in which the steady one is."""
    t, zero = np.arange(600) * DT, np.zeros(6)
    drawn = RandomWrench(zero, np.ones(6), drift=4.0, drift_memory=12.0).draw_drift(t, 1)
    steady = np.tile([5.0, -3.0, 0.0], (len(t), 1))
    for force, named in ((drawn, ()), (steady, ("wind_push",))):
        watch = Watch(boat(), catalogue=(*SMALL, WindPush))
        log, _ = sailed(steps(len(t)), 0, drift=force)
        told = [one for row in rows_of(log) for one in watch.update(row)]
        assert tuple(one.label for one in watch.named) == named, told
        if named:
            for part, true in (("north", 5.0), ("east", -3.0)):
                value, std, _ = watch.named[0].parameters[part]
                assert abs(value - true) < 4 * std
        else:
            assert watch.status.disturbance.drift == pytest.approx(4.0, rel=0.6)


@pytest.mark.slow
def test_a_wave_that_keeps_in_step_is_named_and_a_swell_is_not(monkeypatch):
    """As soon as all rows are at hand that can be, of a boat that hardly turns: a swell is along its axes.

    These are 40 s, some times that in which a swell is in step with itself; of half of that a wave is hardly
    told.
    """
    for module in (_ledger, _passage):
        monkeypatch.setattr(module, "CHUNK", 48)
        monkeypatch.setattr(module, "SPARE", 16)
    t, commands = np.arange(900) * DT, 0.2 * steps(900)
    truth = {"north": 12.0, "east": -6.0, "period": 3.0, "phase": 0.7}
    wave = Placed(place(suspect_named(boat(), "waves", None), boat(), truth), None)
    swell = np.array([12.0, 6.0, 0.0, 0.0, 0.0, 0.2])
    push = RandomWrench(np.zeros(6), np.ones(6), swell, 3.0, 6.0).draw(t, 2)
    regular, irregular = record(boat().place(wave), commands), sailed(commands, 0, push=push)[0]
    for log, labels in ((regular, ["waves"]), (irregular, [])):
        watch = Watch(boat(), catalogue=(*SMALL, Waves))
        for row in rows_of(log):
            watch.update(row)
        assert [one.label for one in watch.named] == labels
        if labels:
            found = {name: value for name, (value, _, _) in watch.named[0].parameters.items()}
            assert abs(found["period"] - 3.0) < 4 * watch.named[0].parameters["period"][1]
            # The rows at hand when it was named.
            told = watch.named[0].at - np.arange(0.0, 40.0, DT)
            (mine, true) = (
                np.outer(np.sin(2 * np.pi * told / one["period"] + one["phase"]), [one["north"], one["east"]])
                for one in (found, truth)
            )
            # A tenth of 13 N.
            np.testing.assert_allclose(mine, true, atol=1.3)


def test_a_watch_that_was_killed_goes_on_as_if_it_had_not_been(broken, watched, kept_in):
    assert (kept_in / "state").exists()
    # In the middle of a line of the journal.
    with (kept_in / "state.rows").open("ab") as file:
        file.write(b'[1, [330, 0], {"t": 7')
    second, kept = Watch(boat(), catalogue=SMALL), Kept(kept_in / "state")
    _, place_of_source = kept.opened(second)
    kept.close()
    assert place_of_source == [KILLED - 1, 0]
    for row in list(rows_of(broken))[KILLED:]:
        second.update(row)
    whole, again = watched[0].status, second.status
    assert [(n.label, n.since, n.at) for n in again.named] == [(n.label, n.since, n.at) for n in whole.named]
    assert again.blocks == whole.blocks
    for label, nats in whole.nats.items():
        assert again.nats[label] == pytest.approx(nats, rel=1e-9, abs=1e-9)
    other = dataclasses.replace(boat(), name="another")
    with pytest.raises(InputError, match="of another vehicle"):
        Kept(kept_in / "state").opened(Watch(other, catalogue=SMALL))


def test_gaps_and_clocks_that_jump_back_are_told_and_lose_nothing(broken):
    watch = Watch(boat(), catalogue=SMALL)
    told = []
    for k, row in enumerate(rows_of(broken)):
        if 130 <= k < 160:
            continue
        row = row | {"t": row["t"] - 1000.0} if k >= 180 else row
        if k < 200:
            told += watch.update(row)
            told += watch.update(row)  # sent twice
    assert any("Nothing came from t = 12.9 to 16 s" in said for said in told)
    assert any("The clock jumped back by" in said for said in told)
    assert sum("count once" in said for said in told) == 1
    status = watch.status
    # All whole blocks of three stretches, of 6 rows with one more each.
    block = watch.parts.passage.bench.steps
    assert status.blocks == (130 - 1) // block + (20 - 1) // block + (20 - 1) // block
    assert not status.named and max(status.nats.values()) < 5.0


def test_rows_that_are_not_this_craft_s_are_refused_and_bad_ones_left_out():
    with pytest.raises(InputError, match="lacks the command bow"):
        Watch(boat(), catalogue=SMALL).update({"t": 0.0, "x": 0.0, "port": 0.1, "starboard": 0.0})
    with pytest.raises(InputError, match="neither commands"):
        Watch(boat(), catalogue=SMALL).update({"t": 0.0, "x": 0.0})
    watch = Watch(boat(), catalogue=SMALL)
    row = {"t": 0.0, "port": 1.4, "starboard": "", "bow": float("nan"), "x": float("inf")}
    assert "beyond 1; it counts as 1" in watch.update(row)[0]
    assert "no time" in watch.update(row | {"t": float("nan")})[0]
    np.testing.assert_array_equal(watch.opening[0].commands, [[1.0, 0.0, 0.0]])
    assert np.isnan(watch.opening[0].channels).all()


def test_memory_stays_the_same(watched):
    watch, _ = watched
    passage, _ = watch.parts
    bench, course, ledger = passage.bench, passage.course, passage.ledger
    assert ledger.let_go >= 1 and len(course.rows) < bench.past + 3 * bench.steps
    assert ledger.held <= 2 * _ledger.CHUNK and len(ledger.accounts) <= 2
