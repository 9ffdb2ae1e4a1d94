"""The last decisions of a diagnosis, on a linear toy whose costs are known by hand or by least squares."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxmarine.diagnosis import Criteria, Diagnosis, _coefficients, _diagnose, _search, _settle, _unnamed
from jaxmarine.diagnosis._dropped import NEEDLESS, STOOD_IN, UNNAMED
from jaxmarine.diagnosis._explanation import Beginning, Beside, Member, Model
from jaxmarine.diagnosis._filed import Coefficient
from jaxmarine.diagnosis._judge import Judged
from jaxmarine.diagnosis._keeper import HERE, Part
from jaxmarine.diagnosis._knots import Knots
from jaxmarine.diagnosis._result import Dropped, Gain, Predictions
from jaxmarine.diagnosis._score import Reduced
from jaxmarine.diagnosis._search import Found, Round, Trial, _decided, beside_file, nats, significant
from jaxmarine.diagnosis._signals import Places
from jaxmarine.diagnosis._unknown import Dependence
from jaxmarine.diagnosis._unnamed import Answer, Unnamed
from jaxmarine.diagnosis._workbench import BEGUN, Sample, Workbench
from jaxmarine.effects import LinearDamping
from jaxmarine.fitting import Disturbance, Path, Room, Segments
from jaxmarine.logs import Log
from jaxmarine.networks import learned_wrench
from tests.boats import boat

WINDOWS, ROWS, BASE, SUSPECTS = 40, 8, 4, 8
SAMPLES = WINDOWS * ROWS
# A number that is off by v costs v² times this, beside columns at right angles to its own.
SIZE, PRIOR = 1e4, 0.1
# What a finding must save beside seven other suspects, noise being as stated: 19.9. The toy has none.
LEAST = np.log(SAMPLES) + 2 * np.log(SUSPECTS) + 2 * np.log(150.0)


def right_angled() -> np.ndarray:
    """Columns of all suspects, at right angles to one another [windows, rows, suspects]."""
    columns = np.linalg.qr(np.random.default_rng(0).normal(size=(SAMPLES, SUSPECTS)))[0]
    return np.sqrt(SIZE) * columns.reshape(WINDOWS, ROWS, SUSPECTS)


def mixed(which: int, parts: dict[int, float]) -> np.ndarray:
    """The same, with one column in the direction of a weighted sum."""
    out = right_angled()
    column = sum(share * out[..., i] for i, share in parts.items())
    out[..., which] = np.sqrt(SIZE) * column / np.linalg.norm(column)
    return out


def a_log(samples: int) -> Log:
    """A sample a second, of nothing."""
    t = np.arange(float(samples))
    return Log(t, np.zeros((samples, 18)), None, np.zeros((samples, 6)), (), "test.csv")


def usual() -> SimpleNamespace:
    """A disturbance of the usual size in surge, along the path as measured."""
    one, windows = jnp.ones(1), jnp.zeros(WINDOWS)
    force = Disturbance(one, one, 0 * one, windows, windows > 0, (0,))
    return SimpleNamespace(begin=force, path=Path.measured(WINDOWS, (0,)))


class Bench(Workbench):
    """Suspects of one number each, a sample a second: the first four alter a coefficient of the file.

    - `truth`: what the log was made with; `far`: how far above its end a refit of few steps promises to end.
    """

    def __init__(self, truth: dict[Member, float], columns: np.ndarray | None = None):
        self.columns = right_angled() if columns is None else columns
        suspects = tuple(
            SimpleNamespace(effect=LinearDamping, starts=(), label=str(i)) for i in range(SUSPECTS)
        )
        each = tuple(np.eye(SUSPECTS)[:, [i]] for i in range(SUSPECTS))
        layout: Any = SimpleNamespace(suspects=suspects, columns=each, size=SUSPECTS)
        data: Any = SimpleNamespace(logs=(a_log(SAMPLES),), length=float(ROWS))
        self.layout, self.data, self.samples = layout, data, SAMPLES
        self.base = tuple(
            Coefficient(i, "damping.linear", str(i), (i, i), i, 1.0, PRIOR, "-") for i in range(BASE)
        )
        self.group_windows, self.group_log = np.arange(WINDOWS), np.zeros(WINDOWS, int)
        self.group_starts = ROWS * np.arange(float(WINDOWS))
        self.y = sum((v * self.column(m) for m, v in truth.items()), np.zeros((WINDOWS, ROWS)))
        self.vehicle, self._own = boat(), Segments((np.zeros(SAMPLES, int),), np.zeros((1, 0)))
        self.part, self.keeper, self.room = Part(0, (), 0, WINDOWS, 1.0), HERE, Room(1, SAMPLES, WINDOWS)
        self.unsound: set[int] = set()
        self.criteria = Criteria()
        self.far = 0.0

    def column(self, member: Member) -> np.ndarray:
        t = np.arange(SAMPLES).reshape(WINDOWS, ROWS)
        acts = 1.0 if member.since is None else t >= member.since.time
        return self.columns[..., member.suspect] * acts

    def jacobian(self, model: Model) -> np.ndarray:
        members = (*(Member(i) for i in range(BASE)), *model.members)
        return np.stack([self.column(m) for m in members], axis=-1)

    def refine(self, model, max_steps=25, rtol=1e-6):
        self.stretches(model.members)  # raises where there is no room for so many beginnings
        flat, precision = self.jacobian(model).reshape(SAMPLES, -1), self._precision(model)
        z = np.linalg.solve(flat.T @ flat + np.diag(precision), flat.T @ self.y.ravel())
        cost = 0.5 * float(((flat @ z - self.y.ravel()) ** 2).sum() + precision @ z**2)
        promised = cost + (self.far if max_steps <= _settle.FEW_STEPS else 0.0)
        return dataclasses.replace(model, z=z, cost=cost, promised=promised)

    def refine_each(self, models, max_steps=25, rtol=1e-6, times=0):
        return [self.refine(model, max_steps) for model in models]

    def screen(self, model):
        begun = [self.column(m)[..., None] for m in model.members if m.since is not None]
        room = np.zeros((WINDOWS, ROWS, BEGUN - len(begun)))
        columns = np.concatenate([self.columns, *begun, room], axis=-1)
        residual = self.jacobian(model) @ model.z - self.y
        return Reduced(
            (residual**2).sum(1),
            np.einsum("wri,wr->wi", columns, residual),
            np.einsum("wri,wrj->wij", columns, columns),
        )

    def start(self):
        return Model((), np.zeros(BASE), jnp.zeros((1, 12)), np.inf)

    def sampled(self, model):
        return Sample(self, model, 1)

    def sound(self, model):
        return not self.unsound & {m.suspect for m in model.members}

    def brakes(self, model):
        return np.ones((6, 6), bool)

    def fit(self, *members: Member | int) -> Model:
        model = self.start()
        for one in members:
            model = self.with_member(model, one if isinstance(one, Member) else Member(one), np.zeros(1))
        return self.refine(model)

    def least(self, which: list[int]) -> float:
        """Chi-square that is left by dense least squares without any prior."""
        flat = self.columns[..., which].reshape(SAMPLES, -1)
        return float(((flat @ np.linalg.lstsq(flat, self.y.ravel())[0] - self.y.ravel()) ** 2).sum())


def suspects(model: Model) -> list[int]:
    return [m.suspect for m in model.members]


def off(**values: float) -> dict[Member, float]:
    """Numbers by suspect: `off(s4=0.3)`."""
    return {Member(int(name[1:])): value for name, value in values.items()}


def trial(bench: Bench, model: Model, which: int) -> Trial:
    refitted = bench.refine(bench.with_member(model, Member(which), np.zeros(1)))
    return Trial(Member(which), refitted, 2 * (model.cost - refitted.cost))


# --- pruning, rivals, beginnings, harm ------------------------------------------------------------


@pytest.mark.parametrize(("share", "kept"), [(0.98, [4]), (1.02, [4, 5])])
def test_a_member_stays_that_saves_what_a_finding_must(share, kept):
    bench = Bench(off(s4=0.3, s5=np.sqrt(share * LEAST / SIZE)))
    model = _settle.pruned(bench, bench.fit(4, 5))
    assert suspects(model) == kept
    assert model.z[BASE] == pytest.approx(0.3)


@pytest.mark.parametrize(("disturbed", "kept"), [(0.0, [4]), (0.2, [])])
def test_a_member_must_save_more_where_its_own_axis_is_disturbed(disturbed, kept):
    """By a force that pulls one window this way and the next one that way; chi-square of 100 in either."""
    bench = Bench(off(s4=0.1))
    push = disturbed * (-1.0) ** np.arange(WINDOWS)
    push -= push @ (bench.columns[..., 4] ** 2).sum(1) / SIZE  # it says nothing of the mean
    bench.y = bench.y + push[:, None] * bench.columns[..., 4]
    model = bench.fit(4)
    assert 2 * (bench.fit().cost - model.cost) == pytest.approx(100.0, rel=0.05)
    assert suspects(_settle.pruned(bench, model)) == kept


def test_the_best_that_is_sure_wins_a_round_and_not_what_a_few_windows_pull():
    """The fourth saves most, by one window in ten that pulls it; the fifth less, by all alike."""
    bench = Bench(off(s5=0.3))
    pulled = np.arange(WINDOWS) < 4
    bench.y = bench.y + 3.5 * pulled[:, None] * bench.columns[..., 4]
    begun = bench.fit()
    trials = [trial(bench, begun, i) for i in (4, 5)]
    assert trials[0].saved > trials[1].saved > 3 * LEAST
    for one, sure in zip(trials, (False, True), strict=True):
        after = bench.screen(one.model)
        assert significant(bench, one, after, 1.0) == sure
    won = _decided(bench, begun, trials)
    assert won is not None and won[0].accepted and won[0].trials[0].member == Member(5)
    assert _decided(bench, begun, trials[:1]) is None


@pytest.mark.parametrize(
    ("worth", "sound", "afresh"), [(10.0, True, [2.0, 3.0]), (3.5, True, []), (3.5, False, [2.0, 3.0])]
)
def test_where_the_file_has_bent_far_the_likeliest_are_refitted_from_it_as_it_is(worth, sound, afresh):
    """Its prior has a standard deviation of a tenth, and odds of 150 to 1 are a bend by 3.17 of it.

    First what disturbs is suited to a file that holds. One that has not bent saves all that a model is worth;
    those that have, and save less than half of that, stay; unless what it says is no craft's.
    """
    bench, fine = Bench(off(s4=0.3)), usual()
    bench.fine = fine
    member = bench.fit(4)
    # The prior of the fourth weighs nine times as much, which makes it bend no further. The last number tells
    # which one it is.
    bent = [
        dataclasses.replace(member, z=np.array([PRIOR * by, 0.0, 0.0, 0.0, cost]), cost=cost, weight=weight)
        for by, cost, weight in (
            (3.1, 0.0, 1.0),
            (3.3, 3.0, 1.0),
            (9.0, 2.0, 1.0),
            (3.1, 1.0, 9.0),
            (4.0, 4.0, 1.0),
        )
    ]
    begun: list[list[Model]] = []

    def refined(models, *how):
        begun.append(list(models))
        return [dataclasses.replace(one, cost=1.0) for one in models]

    bench.sound = lambda one: sound
    bench.refine_each = refined
    _search._afresh(bench, dataclasses.replace(bench.fit(), cost=worth), bent)
    held, free = begun
    assert all(one.frozen for one in held) and not any(one.frozen for one in free)
    for some in begun:
        assert [one.z[BASE] for one in some] == afresh and all(not one.z[:BASE].any() for one in some)
        assert all(one.cost == np.inf for one in some)
        assert all(one.beside.force is fine.begin and one.beside.path is fine.path for one in some)


@pytest.mark.parametrize(("best", "hopeful"), [(1.0, [4]), (1e6, [])])
def test_what_shows_beside_a_quick_disturbance_must_save_half_of_what_the_best_does(best, hopeful):
    bench = Bench(off(s4=0.3))
    found = _search._hidden(bench, bench.fit(), [Member(4), Member(5)], [], best)
    assert [one.members[-1].suspect for one in found] == hopeful


@pytest.mark.parametrize(("costs", "hidden"), [(1.0, [4]), (0.0, [])])
def test_what_costs_no_less_beside_a_quick_disturbance_is_not_hidden(costs, hidden):
    bench = Bench(off(s4=0.3))
    refitted = bench.refine(bench.fit(4))
    slow = _search.trial_of(bench.fit(), dataclasses.replace(refitted, cost=refitted.cost + costs))
    found = _search._hidden(bench, bench.fit(), [Member(4)], [slow], 1.0)
    assert [one.members[-1].suspect for one in found] == hidden


@pytest.mark.parametrize("begins", [20.0, 300.0])
def test_a_beginning_that_is_far_off_is_reached_in_a_few_refits(begins):
    """To the second; at half a window a step it would take some ninety. No time is tried twice."""
    bench = Bench({Member(4, Beginning(0, 160.0)): 0.5})
    tried: list[float] = []
    refined = bench.refine_each

    def counted(models, *how):
        tried.extend(one.members[-1].since.time for one in models)
        return refined(models, *how)

    bench.refine_each = counted
    model = bench.with_member(bench.fit(), Member(4, Beginning(0, begins)), np.zeros(1))
    found = _search.begun_at_best(bench, model, -1, 1.0, _settle.FEW_STEPS)
    assert found.members[-1].since == Beginning(0, 160.0)
    assert len(tried) == len({*tried}) <= 30


@pytest.mark.parametrize(("always", "refitted"), [(0.0, 1), (1e9, 2)])
def test_what_begins_is_refitted_if_it_costs_less_than_what_acts_always(always, refitted):
    bench = Bench({Member(4, Beginning(0, 160.0)): 0.5})
    begun = bench.with_member(bench.fit(), Member(4, Beginning(0, 150.0)), np.zeros(1))
    found = _search._placed(bench, [begun, bench.fit(4)], {4: always}, 1e-4)
    assert len(found) == refitted and found[-1].members == (Member(4),)
    assert {one.members[-1].since for one in found} <= {None, Beginning(0, 160.0)}


def test_of_two_members_that_say_the_same_one_stays():
    bench = Bench(off(s4=0.3), mixed(5, {4: 1.0}))
    model = _settle.pruned(bench, bench.fit(4, 5))
    assert suspects(model) == [5] and model.z[BASE] == pytest.approx(0.3)


@pytest.mark.parametrize(("far", "kept"), [(9.0, [4]), (11.0, [4, 5])])
def test_a_refit_goes_on_unless_its_few_steps_promise_a_removal_that_is_dear(far, kept):
    """To the end it would show that the member is idle."""
    bench = Bench(off(s4=0.5))
    bench.far = 0.5 * far * LEAST
    assert suspects(_settle.pruned(bench, bench.fit(4, 5))) == kept


@pytest.mark.parametrize(("unsound", "kept"), [({4}, [5]), ({4, 5}, [4, 5])])
def test_a_member_that_means_nothing_goes_if_the_others_mean_something_without_it(unsound, kept):
    bench = Bench(off(s4=0.3, s5=0.3))
    bench.unsound = unsound
    assert suspects(_settle.pruned(bench, bench.fit(4, 5))) == kept


@pytest.mark.parametrize(
    ("truth", "accepted", "members"),
    [
        (off(s5=0.3, s6=0.2), True, [5, 6]),
        (off(s5=0.3, s6=0.2), False, [4, 6]),
        (off(s4=0.3, s6=0.2), True, [4, 6]),
    ],
)
def test_what_a_member_beat_is_weighed_once_more_beside_the_others(truth, accepted, members):
    """The fourth is like the fifth and the sixth together, and beats each while neither is known."""
    bench = Bench(truth, mixed(4, {5: 1.0, 6: 1.0, 7: 0.5}))
    begun = bench.fit()
    rounds = [Round(tuple(trial(bench, begun, i) for i in (4, 5, 6)), accepted, 1.0)]
    model = _settle._reweighed(bench, bench.fit(4, 6), rounds, 1.0)
    assert suspects(model) == members
    flat = bench.columns[..., members].reshape(SAMPLES, -1)
    assert np.allclose(model.z[BASE:], np.linalg.lstsq(flat, bench.y.ravel())[0], rtol=1e-3)


def test_coefficients_and_members_that_stand_alone_are_not_weighed_once_more():
    bench = Bench(off(s5=0.3, s6=0.2), mixed(0, {5: 1.0, 6: 1.0, 7: 0.5}))
    rounds = [Round(tuple(trial(bench, bench.fit(), i) for i in (0, 5)), True, 1.0)]
    for model in (bench.fit(0, 6), bench.fit(0)):
        assert _settle._reweighed(bench, model, rounds, 1.0) is model
    bench = Bench(off(s5=0.3))
    rounds, alone = [Round(tuple(trial(bench, bench.fit(), i) for i in (7, 5)), True, 1.0)], bench.fit(7)
    assert _settle._reweighed(bench, alone, rounds, 1.0) is alone


@pytest.mark.parametrize("begun", [152.0, 176.0, 200.0])
def test_a_beginning_is_moved_to_the_sample_that_costs_least(begun):
    bench = Bench({Member(4, Beginning(0, 173.0)): 0.3, Member(5): 0.2})
    model = bench.fit(5, Member(4, Beginning(0, begun)))
    found = _settle._beginnings_refined(bench, model)
    each = {float(t): bench.fit(5, Member(4, Beginning(0, float(t)))).cost for t in range(SAMPLES)}
    assert found.members == (Member(5), Member(4, Beginning(0, min(each, key=lambda t: each[t]))))
    assert found.cost == min(each.values()) and np.allclose(found.z[BASE:], [0.2, 0.3])


def test_beginnings_that_coincide_part_only_where_there_is_room():
    """There are three of four members: one more would be one too many."""
    times = {4: 80.0, 5: 160.0, 6: 160.0, 7: 240.0}
    bench = Bench({Member(i, Beginning(0, t)): 0.3 for i, t in times.items()})
    members = [Member(i, Beginning(0, t)) for i, t in (times | {4: 83.0}).items()]
    found = _settle._beginnings_refined(bench, bench.fit(*members))
    assert {m.suspect: m.since and m.since.time for m in found.members} == times


@pytest.mark.parametrize(("ratio", "kept"), [(0.94, [4]), (0.96, [4, 5, 6])])
def test_a_member_goes_without_which_predictions_are_clearly_better(monkeypatch, ratio, kept):
    """Without the fifth; the sixth was needed for nothing else. A member that is alone is another matter."""
    bench = Bench(off(s4=0.3))
    errors = {(4, 5, 6): 1.0, (4, 5): 1.0, (4, 6): ratio, (5, 6): 1.0}

    def measured(bench, model, dense):
        assert dense
        return errors[tuple(suspects(model))]

    monkeypatch.setattr(_settle, "gain_at_home", measured)
    assert suspects(_settle._without_harm(bench, bench.fit(4, 5, 6), True)) == kept


def test_settling_leaves_what_is_needed_and_the_coefficient_that_is_wrong(monkeypatch):
    monkeypatch.setattr(_settle, "gain_at_home", lambda bench, model, dense: 1.0)
    bench = Bench(off(s0=-0.3, s4=0.3))
    found = bench.fit(5, 4)
    model, dense, rounds, dropped = _settle.settled(bench, Found(found, bench.screen(found), (), ()))
    assert dropped == (Dropped("5", NEEDLESS),)
    assert (suspects(model), dense, len(rounds)) == ([4, 0], False, 1)
    assert np.allclose(model.z, [0, 0, 0, 0, 0.3, -0.3])


# --- coefficients of the file ---------------------------------------------------------------------


@pytest.mark.parametrize("weight", [1.0, 100.0])
def test_needed_changes_are_those_of_forward_selection_without_a_prior(weight):
    """Beside a member that must always act, against dense least squares; one coefficient is stood for."""
    rng = np.random.default_rng(1)
    bench = Bench({}, right_angled() + rng.normal(scale=3.0, size=(WINDOWS, ROWS, SUSPECTS)))
    bench.y = bench.columns @ np.array([0.4, 0.3, -0.06, 0.02, 0.5, 0.0, 0.0, 0.0])
    model = bench.refine(dataclasses.replace(bench.fit(0, 4), weight=weight))
    chosen: list[int] = []
    while True:
        saved = {
            j: bench.least([0, 4, *chosen]) - bench.least([0, 4, *chosen, j])
            for j in range(1, BASE)
            if j not in chosen
        }
        best = max(saved, key=lambda j: saved[j])
        if saved[best] < LEAST:
            break
        chosen.append(best)
    assert chosen == [1, 2]
    assert _coefficients._needed_changes(bench, model, 1.0) == chosen
    phi = saved[best] / LEAST
    assert _coefficients._needed_changes(bench, model, 1.01 * phi) == chosen
    assert _coefficients._needed_changes(bench, model, 0.99 * phi) == [*chosen, best]


@pytest.mark.parametrize(("value", "chosen"), [(0.99, []), (1.01, [2])])
def test_a_coefficient_needs_to_change_if_that_saves_what_a_finding_must(value, chosen):
    bench = Bench(off(s2=value * np.sqrt(LEAST / SIZE)))
    assert _coefficients._needed_changes(bench, bench.fit(), 1.0) == chosen


def test_two_wrong_coefficients_are_findings_and_three_a_recalibrated_file():
    bench = Bench(off(s1=-0.2, s3=0.3, s0=0.03))
    model, dense, rounds = _coefficients.settle(bench, bench.fit(), (), 1.0)
    assert (suspects(model), dense) == ([3, 1], False)
    assert np.allclose(model.z, [0, 0, 0, 0, 0.3, -0.2], atol=1e-6)
    assert [r.trials[0].member.suspect for r in rounds] == [3, 1]
    bench = Bench(off(s1=-0.2, s3=0.3, s0=0.2))
    free = bench.fit()
    assert _coefficients.settle(bench, free, (), 1.0) == (free, True, ())


@pytest.mark.parametrize(("windows", "members"), [(16, []), (32, [0])])
def test_a_coefficient_that_a_few_windows_pull_stays_as_filed(windows, members):
    """A pull in k of n windows in a row, some quarter of which counts: k / (1 - k / n) is 27 and 160."""
    bench = Bench({})
    bench.y[10 : 10 + windows] = 2.0 * bench.columns[10 : 10 + windows, :, 0]
    model, dense, _ = _coefficients.settle(bench, bench.fit(), (), 1.0)
    assert (suspects(model), dense) == (members, False)


ALL_ALIKE = mixed(4, {0: 1.0, 1: 1.0, 2: 1.0, 3: 1.0})


@pytest.mark.parametrize(
    ("truth", "members"),
    [
        (off(s4=0.4), [4]),
        (off(s4=0.4, s2=0.3), [4, 2]),
        # Three are still wrong beside the cause.
        (off(s0=0.1, s1=0.3, s2=0.5, s3=0.75), None),
        # Each is off by too little for a change beside the cause. All are free at the price of a prior of 16;
        # three numbers are worth 17.3: less than 4 * 9 - 16, and more than 4 * 7.3 - 16.
        (off(s4=0.4, s0=0.03, s1=-0.03, s2=0.03, s3=-0.03), None),
        (off(s4=0.4, s0=0.027, s1=-0.027, s2=0.027, s3=-0.027), [4]),
    ],
)
def test_one_cause_that_does_what_many_coefficients_do_is_named_in_their_place(truth, members):
    bench = Bench(truth, ALL_ALIKE)
    free = bench.fit()
    assert len(_coefficients._needed_changes(bench, free, 1.0)) > bench.criteria.few
    held = beside_file(bench, free, 1.0)
    assert held[0].member == Member(4)
    model, dense, rounds = _coefficients.settle(bench, free, held, 1.0)
    if members is None:
        assert (model, dense, rounds) == (free, True, ())
        return
    assert (suspects(model), dense) == (members, False)
    assert rounds[0].accepted and rounds[0].trials[0].member == Member(4)
    assert len(rounds) == len(members)  # one for the cause, one for each coefficient
    assert np.allclose(model.z[:BASE], 0.0, atol=1e-6)
    assert model.z[BASE] == pytest.approx(0.4, abs=0.01)


def test_what_explains_more_stands_in_the_place_of_a_wrong_coefficient():
    """A cause that is much like a coefficient; and the coefficient, where the log was made with that."""
    like = mixed(5, {0: 1.0, 6: 0.3})
    for truth, better in ((off(s5=0.3), 5), (off(s0=0.3), 0)):
        bench = Bench(truth, like)
        model, dense, (one,) = _coefficients.settle(bench, bench.fit(), (), 1.0)
        assert (suspects(model), dense) == ([better], False)
        assert one.trials[0].member == Member(better)
        assert np.allclose(model.z, [0, 0, 0, 0, 0.3], atol=1e-6)


def test_the_other_coefficients_may_bend_while_one_is_weighed_against_a_cause():
    """The cause takes up a little that another one is off by, and explains the rest less well."""
    like = mixed(5, {0: 0.3, 1: 0.044, 6: 0.02})
    bench = Bench(off(s0=0.3, s1=0.044), like)
    model, _, _ = _coefficients.settle(bench, bench.fit(), (), 1.0)
    assert suspects(model) == [0]
    # Held, 19.4 would be left beside the coefficient, and about 4 beside the cause.
    left = [2 * bench.refine(bench.frozen(bench.fit(i))).cost for i in (0, 5)]
    assert left == pytest.approx([19.4, 4.0], abs=0.5)


@pytest.mark.parametrize(("before", "cost", "z"), [(1.1, 2.0, 0.5), (0.9, 1.0, 0.0)])
def test_a_refit_that_ends_above_twice_the_cost_before_begins_anew(before, cost, z):
    """It ends at a cost of 2 from where it was, and at 1 from neutral numbers."""

    class Astray(Bench):
        def refine(self, model, max_steps=25, rtol=1e-6):
            return dataclasses.replace(model, cost=2.0 if model.z.any() else 1.0)

    bench = Astray({})
    fitted = _coefficients._refitted(bench, dataclasses.replace(bench.start(), z=np.full(BASE, 0.5)), before)
    assert fitted.cost == cost and (fitted.z == z).all()


# --- what is unknown ------------------------------------------------------------------------------

PHI = 2.0


def dependence(dof: int = 0, shapes: int = 3, tied: tuple[str, ...] = ()) -> Dependence:
    return Dependence(dof, ("u", "psi"), tied, 80.0, np.zeros((1, 1, shapes)), False)


def judged_as(model: Model, white: bool = False) -> Judged:
    none: Any = object.__new__(Knots)
    stats = Reduced(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1, 1)))
    return Judged(model, stats, PHI, none, PHI, none, white)


def rival_with(found: tuple[Dependence, ...] = (dependence(),)) -> Any:
    """The file with unknown dependences of three shapes."""
    bench = Bench(off(s0=0.5, s4=0.3))
    start = bench.frozen(bench.start())
    rival = Unnamed(bench)
    now, nothing = judged_as(bench.refine(start)), np.zeros(BASE)
    left = Knots(now.stats, BASE, nothing, nothing, np.zeros(6), object.__new__(Places))
    now = dataclasses.replace(now, stats=bench.screen(start), left=left)
    vars(rival).update(judged=now, answer=Answer(now, found, False))
    return rival


def density(covariance: np.ndarray, bench: Bench) -> float:
    """Log-density of a toy's log beside that of noise alone."""
    noise = np.eye(SAMPLES)
    of = (multivariate_normal(np.zeros(SAMPLES), noise + more) for more in (covariance, 0 * noise))
    with_more, without = (one.logpdf(bench.y.ravel()) for one in of)
    return with_more - without


def test_nats_of_a_file_that_may_bend_are_those_of_the_dense_gaussian():
    """Its coefficients integrated over their prior; beside one member, which pays by Schwarz."""
    bench = Bench(off(s0=0.15, s1=-0.05, s4=0.3))
    flat = bench.columns.reshape(SAMPLES, -1)
    held, bent = (bench.refine(model) for model in (bench.frozen(bench.start()), bench.start()))
    more = nats(bench, bent, bench.screen(bent), 1.0) - nats(bench, held, bench.screen(held), 1.0)
    assert more == pytest.approx(density(PRIOR**2 * flat[:, :BASE] @ flat[:, :BASE].T, bench), abs=1e-6)
    member = bench.refine(bench.frozen(bench.fit(4)))
    gained = nats(bench, member, bench.screen(member), 1.0) - nats(bench, held, bench.screen(held), 1.0)
    assert gained == pytest.approx(0.5 * SIZE * 0.3**2 - 0.5 * np.log(SAMPLES) - np.log(SUSPECTS), rel=1e-6)
    # Where scores scatter four times as much, a quarter is gained by what is explained.
    assert -member.cost / 4 - nats(bench, member, bench.screen(member), 4.0) == pytest.approx(
        0.5 * np.log(SAMPLES) + np.log(SUSPECTS)
    )


@pytest.mark.parametrize("bends", [True, False])
def test_unknown_dependences_are_likelier_by_what_they_gain_beside_the_file(monkeypatch, bends):
    """The file has half of a chi-square of 2500 + 900 against it; what a refit gains is in `nats_beside`."""
    rival = rival_with()
    monkeypatch.setattr(_unnamed, "nats_beside", lambda k, found, phi: 100.0 / phi)
    held, gained = -0.5 * SIZE * (0.5**2 + 0.3**2), 100.0
    for named, likelier in ((held + gained - 0.1, True), (held + gained + 0.1, False)):
        assert rival.likelier(named, 1.0, bends) == likelier
    assert rival.likelier((held + gained) / 4 - 0.1, 4.0, bends)
    assert not rival_with(()).likelier(-np.inf, 1.0, bends)


def test_a_refitted_file_beside_unknown_dependences_is_asked_for_where_names_are(monkeypatch):
    """What `nats_beside` is asked for with a prior that bends gains 1000 more."""
    rival = rival_with()
    monkeypatch.setattr(_unnamed, "nats_beside", lambda k, found, phi: 1000.0 * bool(k.precision.max() < 1e6))
    held = -0.5 * SIZE * (0.5**2 + 0.3**2)
    assert rival.likelier(held + 500.0, 1.0) and not rival.likelier(held + 500.0, 1.0, bends=False)


def test_beside_a_disturbance_a_refit_counts_by_how_far_the_scores_scatter_where_it_was_linearised(
    monkeypatch,
):
    """The answer's scatter as noise does, the file's four times as much: a quarter of 100 nats is gained."""
    rival = rival_with()
    disturbed: Any = object.__new__(Disturbance)
    own = dataclasses.replace(rival.judged, phi=4.0)
    rival.answer = dataclasses.replace(rival.answer, judged=own)
    monkeypatch.setattr(_unnamed, "nats_beside", lambda k, found, phi: 100.0 / phi)
    held = -0.5 * SIZE * (0.5**2 + 0.3**2)
    for disturbance, gained in ((None, 100.0), (disturbed, 25.0)):
        monkeypatch.setattr(Judged, "disturbance", disturbance)
        for more, likelier in ((-0.1, True), (0.1, False)):
            assert rival.likelier(held + gained + more, 1.0, bends=False) == likelier


@pytest.mark.parametrize(
    ("beside", "scatter", "which"),
    [
        ((1.1, 0.9), (1.0, 1.0), 1),
        ((0.95, 0.9), (1.0, 1.0), 1),
        ((0.8, 0.9), (1.0, 1.0), 0),
        ((1.1, 1.1), (1.0, 1.0), None),
        ((5.0, 5.0), (6.0, 4.0), 0),
        ((5.0, 5.0), (4.0, 4.0), None),
    ],
)
def test_a_stand_in_saves_less_than_a_finding_must_beside_what_it_stood_in_for(
    monkeypatch, beside, scatter, which
):
    """Of two members, in units of what a finding must save where its scores scatter as noise does."""
    monkeypatch.setattr(_unnamed, "cost_of_removal", lambda k, where, found: [LEAST * x for x in beside])
    scattered = dict(zip((BASE, BASE + 1), scatter, strict=True))
    monkeypatch.setattr(
        _unnamed, "_scatters_beside", lambda k, where, found: [scattered[one.start] for one in where]
    )
    bench = Bench({})
    now = judged_as(bench.fit(4, 5))
    assert _unnamed._stand_in(bench, now, (dependence(),)) == which
    assert _unnamed._stand_in(bench, now, ()) is None
    assert _unnamed._stand_in(bench, judged_as(bench.fit()), (dependence(),)) is None


def test_members_go_that_stood_in_and_those_that_mended_them(monkeypatch):
    """The sixth stood in; the fifth only took back what that spoilt, and is worth nothing by itself."""
    bench = Bench(off(s4=0.3))
    monkeypatch.setattr(_unnamed, "extended_by", lambda bench, model, dense: boat())
    monkeypatch.setattr(_unnamed, "judged", lambda bench, model: judged_as(model))
    monkeypatch.setattr(_unnamed, "_dependences", lambda bench, now, vehicle, of_file: (now, (dependence(),)))
    shares = {4: 90.0, 5: 50.0, 6: 10.0}
    monkeypatch.setattr(
        _unnamed,
        "cost_of_removal",
        lambda k, where, found: [shares[i] for i in (4, 5, 6)[: len(where)]],
    )
    monkeypatch.setattr(_unnamed, "_scatters_beside", lambda k, where, found: [1.0 for _ in where])
    answer = _unnamed.with_unknown(bench, judged_as(bench.fit(4, 5, 6)), False, lambda words: None)
    assert answer.dropped == (Dropped("6", STOOD_IN), Dropped("5", NEEDLESS))
    assert suspects(answer.model) == [4] and len(answer.unknown) == 1
    white = judged_as(bench.fit(4, 5, 6), white=True)
    assert _unnamed.with_unknown(bench, white, False, lambda words: None) == Answer(white, (), False)


# --- the answer that is given ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("alone", "together", "white", "members", "dense", "named"),
    [
        (False, False, False, 1, False, True),
        (True, False, False, 1, False, True),  # than one name by itself, which may have left much to them
        (True, False, False, 2, False, False),  # than several
        (False, True, False, 1, False, False),  # than names and what else is unknown
        (True, True, True, 1, False, True),  # noise alone is left
        (True, True, False, 0, False, True),  # nothing of the file is changed by the answer
        (False, True, False, 0, True, False),  # a file that was refitted has followed what is unknown
    ],
)
def test_unknown_dependences_alone_are_the_answer_where_they_are_likelier(
    monkeypatch, alone, together, white, members, dense, named
):
    rival = rival_with()
    bench = rival.bench
    model = bench.fit(*range(4, 4 + members))
    answer = Answer(judged_as(model, white), (dependence(),), dense)
    rounds = (Round((trial(bench, bench.fit(), 4),), True, 1.0),)
    monkeypatch.setattr(_diagnose, "settled", lambda bench, found: (model, dense, rounds, ()))
    monkeypatch.setattr(_diagnose, "judged", lambda bench, model: judged_as(model, white))
    monkeypatch.setattr(_diagnose, "with_unknown", lambda bench, now, dense, progress, of_file: answer)
    monkeypatch.setattr(_diagnose, "nats_of", lambda bench, now, unknown: together if unknown else alone)
    asked = []

    def likelier(nats, phi, bends=True):
        asked.append(bends)
        return nats

    rival.likelier, rival.beats = likelier, lambda model, stats: False
    found = Found(model, bench.screen(model), (), ())
    chosen, weighed = _diagnose._chosen(bench, rival, found, lambda words: None)
    assert weighed == rounds
    assert (chosen is answer) == named
    assert chosen.dropped == (() if named else tuple(Dropped(str(i), UNNAMED) for i in suspects(model)))
    assert named or (chosen.unknown == rival.answer.unknown and not chosen.changed)
    # A file that was refitted was compared with one that is when unknown dependences were looked for.
    assert members or not any(asked)


def test_one_name_is_asked_for_only_beside_what_else_is_unknown():
    rival = rival_with()
    rival.likelier = lambda named, phi, bends=True: True
    one, two = (rival.bench.fit(*range(4, 4 + n)) for n in (1, 2))
    assert not rival.beats(one, rival.bench.screen(one)) and rival.beats(two, rival.bench.screen(two))


@pytest.mark.parametrize(
    ("disturbed", "alone", "bent", "held", "white", "beaten"),
    [
        (True, True, True, True, False, True),
        (False, True, True, True, False, False),
        (True, False, True, True, False, False),
        (True, True, False, True, False, False),
        (True, True, True, False, False, False),
        (True, True, True, True, True, False),
    ],
)
def test_beside_a_disturbance_one_name_gives_way_with_what_else_is_unknown(
    monkeypatch, disturbed, alone, bent, held, white, beaten
):
    """Before it is settled: where what is unknown is likelier than it, and than it with the rest.

    With a file that bends or holds; and noise alone is explained.
    """
    rival, one, rest = rival_with(), jnp.ones(1), (dependence(),)
    force = Disturbance(one, one, 0.0 * one, one, jnp.zeros(1, bool), (0,))
    model = rival.bench.fit(4)
    if disturbed:
        model = dataclasses.replace(model, beside=Beside(force, Path.measured(1, (0,)), np.eye(2)))
    likelier = {"alone": alone, "bent": bent, "held": held}
    monkeypatch.setattr(_unnamed, "judged", lambda bench, model: judged_as(model, white))
    monkeypatch.setattr(_unnamed, "extended_by", lambda bench, model, dense: None)
    monkeypatch.setattr(_unnamed, "_dependences", lambda bench, now, vehicle: (now, rest))
    monkeypatch.setattr(
        _unnamed, "nats_of", lambda bench, now, unknown: "held" if now.model.frozen else "bent"
    )
    monkeypatch.setattr(_unnamed, "nats", lambda *given: "alone")
    monkeypatch.setattr(_unnamed, "dispersion", lambda *given: 1.0)
    rival.likelier = lambda named, phi: likelier[named]
    rival.bench.likeliest = lambda model: model
    assert rival.beats_one(model, object.__new__(Reduced)) == beaten


def test_names_that_are_beaten_are_not_settled_first(monkeypatch):
    rival = rival_with()
    model = rival.bench.fit(4, 5)
    monkeypatch.setattr(_unnamed, "nats_beside", lambda k, found, phi: 1e9)
    monkeypatch.setattr(_diagnose, "settled", None)
    found = Found(model, rival.bench.screen(model), (), ())
    chosen, _ = _diagnose._chosen(rival.bench, rival, found, lambda words: None)
    assert chosen.model is rival.judged.model and not chosen.changed


def gain(ratio: float, interval: tuple[float, float] | None) -> Gain:
    return Gain(5.0, None, None, ratio, interval, True, 60)


@pytest.mark.parametrize(
    ("members", "dense", "unknown", "home", "ratio", "note"),
    [
        ((4,), False, (), 0.9, 0.8, None),
        ((4,), False, (), 1.1, 0.8, "What was named at first predicts the training log worse"),
        ((), True, (), 1.1, 0.8, "The file as it was refitted at first predicts the training log worse"),
        ((4,), False, (), 0.9, 0.97, "What was named at first buys nothing on test.csv; it was dropped."),
        # What else is unknown is learned before the gain is asked for.
        ((4,), False, (dependence(),), 0.9, 0.97, None),
        ((), True, (), 0.9, 0.97, None),
    ],
)
def test_an_answer_that_buys_nothing_gives_way(monkeypatch, members, dense, unknown, home, ratio, note):
    rival = rival_with()
    answer = Answer(judged_as(rival.bench.fit(*members)), unknown, dense)
    measured = (gain(ratio, (ratio - 0.2, ratio + 0.2)), object.__new__(Predictions))
    monkeypatch.setattr(_diagnose, "gain_at_home", lambda bench, model, dense: home)
    monkeypatch.setattr(_diagnose, "measured_gain", lambda *asked: measured)
    kept, known, notes = _diagnose._worthwhile(rival.bench, rival, answer, (a_log(2),), lambda words: None)
    if note is None:
        assert kept is answer and notes == []
        assert known == (measured if members and not unknown else None)
    else:
        assert kept.model is rival.judged.model and known is None
        assert len(notes) == 1 and notes[0].startswith(note)


@pytest.mark.parametrize(("alone", "left"), [(0.8, {4}), (0.97, set())])
def test_of_several_names_the_least_likely_goes_first(monkeypatch, alone, left):
    """The log has 4 in it and no 5; together they save nothing of the test log, `alone` is what 4 leaves."""
    rival = rival_with()
    ratios = {(4,): alone, (5, 4): 0.97}

    def measured(bench, model, *rest):
        ratio = ratios[tuple(suspects(model))]
        return gain(ratio, (ratio - 0.2, ratio + 0.2)), object.__new__(Predictions)

    monkeypatch.setattr(_diagnose, "gain_at_home", lambda bench, model, dense: 0.9)
    monkeypatch.setattr(_diagnose, "measured_gain", measured)
    monkeypatch.setattr(_diagnose, "judged", lambda bench, model: judged_as(model))
    monkeypatch.setattr(_diagnose, "with_unknown", lambda bench, now, dense, *_: Answer(now, (), dense))
    monkeypatch.setattr(_diagnose, "nats_of", lambda bench, now, unknown: 0.0)
    rival.likelier = lambda named, phi, bends=True: False
    answer = Answer(judged_as(rival.bench.fit(5, 4)), (), False)
    kept, known, notes = _diagnose._worthwhile(rival.bench, rival, answer, (a_log(2),), lambda words: None)
    assert {*suspects(kept.model)} == left and (known is not None) == bool(left)
    assert notes[0] == "With 5 what was named at first buys nothing on test.csv; it was dropped."
    left_too = [] if left else ["What is named without it buys nothing on test.csv; it was dropped."]
    assert notes[1:] == left_too
    assert [one.label for one in kept.dropped] == ["5", *("4" for _ in left_too)]


def test_what_a_name_leaves_that_goes_is_asked_for_what_is_unknown(monkeypatch):
    """5 stood for a force that depends on signals: what is left is 4 and that, which is learned next."""
    rival = rival_with()
    rival.likelier = lambda named, phi, bends=True: False
    monkeypatch.setattr(_diagnose, "gain_at_home", lambda bench, model, dense: 0.9)
    monkeypatch.setattr(_diagnose, "measured_gain", lambda *asked: (gain(0.97, (0.8, 1.1)), None))
    monkeypatch.setattr(_diagnose, "judged", lambda bench, model: judged_as(model))
    monkeypatch.setattr(_diagnose, "nats_of", lambda bench, now, unknown: 0.0)
    unknown = (dependence(),)
    monkeypatch.setattr(_diagnose, "with_unknown", lambda bench, now, dense, *_: Answer(now, unknown, dense))
    answer = Answer(judged_as(rival.bench.fit(5, 4)), (), False)
    kept, known, notes = _diagnose._worthwhile(rival.bench, rival, answer, (a_log(2),), lambda words: None)
    assert suspects(kept.model) == [4] and kept.unknown == unknown and known is None
    assert notes == ["With 5 what was named at first buys nothing on test.csv; it was dropped."]


@pytest.mark.parametrize(("home", "away", "kept"), [(0.89, 0.79, 1), (0.91, 0.79, 0), (0.89, 0.81, 0)])
def test_what_is_learned_is_left_out_where_the_model_predicts_better_without_it(
    monkeypatch, home, away, kept
):
    """Without it 0.9 of the file's error is left at home, 0.8 on the test log; a note tells of no value."""
    term = learned_wrench("surge", ("u",), (), np.zeros(1), np.ones(1), 1.0, jax.random.key(0), 2)
    bench = Bench({})
    bench.vehicle = boat()
    monkeypatch.setattr(_diagnose, "learn", lambda knots, found, thrusters: (term,))
    monkeypatch.setattr(
        _diagnose, "gain_at_home", lambda bench, model, dense, terms=(): home if terms else 0.9
    )
    predicted: Any = object.__new__(Predictions)
    monkeypatch.setattr(
        _diagnose,
        "measured_gain",
        lambda bench, model, changed, terms, tests: (gain(away if terms else 0.8, (0.5, 1.5)), predicted),
    )
    answer = Answer(judged_as(bench.fit(4)), (dependence(0), dependence(1, shapes=0)), False)
    test = (a_log(100),)
    terms, measured, notes = _diagnose._learned(bench, answer, True, test, lambda words: None)
    # By what the extended vehicle then has, where something was left to measure.
    assert (measured and measured[0].ratio) == (away if kept else 0.8 if home < 0.9 else None)
    assert len(terms) == kept and all(one.target == "surge" for one in terms)
    assert notes[0].startswith("sway: much more is missing where u, psi is large")
    assert [note.startswith("What was learned of it predicts") for note in notes[1:]] == [True] * (1 - kept)
    known = dataclasses.replace(answer, unknown=())
    assert _diagnose._learned(bench, known, True, test, lambda words: None) == ((), None, [])


WORSE, UNSURE = "predicts test.csv worse than the file does", "does not confirm this"


@pytest.mark.parametrize(
    ("interval", "changed", "said"),
    [
        ((1.01, 1.2), True, WORSE),
        ((1.01, 1.2), False, WORSE),
        ((0.9, 1.01), True, UNSURE),
        ((0.9, 1.01), False, None),
        ((0.9, 0.99), True, None),
        (None, True, UNSURE),
    ],
)
def test_a_reader_is_told_what_the_test_log_says(interval, changed, said):
    diagnosis: Any = object.__new__(Diagnosis)
    quiet = dict(tests=("test.csv",), findings=(), recalibrated=(), contradicted=None, misfit_after=1.0)
    vars(diagnosis).update(quiet, gain=gain(0.95, interval))
    answer = Answer(judged_as(Bench({}).fit()), (dependence(),), False)
    notes = _diagnose._remarks(diagnosis, answer, changed)
    assert len(notes) == (said is not None) and all(said in note for note in notes)


def test_a_reader_is_told_what_else_stands_against_the_answer():
    diagnosis: Any = object.__new__(Diagnosis)
    loud = dict(
        tests=("test.csv",),
        findings=(),
        recalibrated=("one",),
        contradicted="Sensors disagree.",
        misfit_after=1e4,
    )
    vars(diagnosis).update(loud, gain=gain(0.5, (0.4, 0.6)))
    answer = Answer(judged_as(Bench({}).fit()), (dependence(tied=("r",)),), True)
    many, tied, contradicted, far = _diagnose._remarks(diagnosis, answer, True)
    assert many.startswith("Many coefficients of the file are off together")
    assert tied.startswith("surge: r would explain the missing wrench as well as one of u, psi;")
    assert contradicted == "Sensors disagree." and "100 times the sensor noise" in far
