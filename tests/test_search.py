"""The sums by which the search decides, against draws, dense least squares and numbers worked by hand."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine.diagnosis import Criteria, _search
from jaxmarine.diagnosis._explanation import Beginning, Beside, Member, Model
from jaxmarine.diagnosis._score import Reduced, scatter, t_value
from jaxmarine.diagnosis._search import Trial
from jaxmarine.diagnosis._workbench import Workbench
from jaxmarine.fitting import Disturbance, Path

WINDOWS, ROWS, KNOWN, SUSPECTS = 400, 20, 3, 6
ALL = KNOWN + SUSPECTS
PRIOR = 2.0
MODEL = Model((), np.zeros(KNOWN), jnp.zeros((1, 12)), 0.0)
ONE = jnp.ones(1)
FORCE = Disturbance(ONE, ONE, 0.0 * ONE, ONE, jnp.zeros(1, bool), (0,))
DISTURBED = dataclasses.replace(MODEL, beside=Beside(FORCE, Path.measured(1, (0,)), np.eye(2)))


class Bench(Workbench):
    """Known numbers first, then a column of each suspect; `known_at`: the former's distance from the file."""

    def __init__(self, known_at=(0.0,) * KNOWN):
        self.known_at = np.asarray(known_at)
        columns = [np.ones((1, 2))] * SUSPECTS
        layout: Any = SimpleNamespace(suspects=range(SUSPECTS), columns=columns)
        self.layout, self.group_windows, self.samples = layout, np.arange(100), 1000
        self.criteria = Criteria()

    def known(self, model):
        return np.eye(ALL)[:, :KNOWN], np.full(KNOWN, PRIOR), self.known_at

    def own(self, i):
        return np.eye(ALL)[:, [KNOWN + i]]


def reduced(jacobian: np.ndarray, residual: np.ndarray) -> Reduced:
    return Reduced(
        (residual**2).sum(1),
        np.einsum("wri,wr->wi", jacobian, residual),
        np.einsum("wri,wrj->wij", jacobian, jacobian),
    )


def test_scatter_is_the_variance_of_a_sum_and_knows_neighbours():
    """Of a first-order process: closed form with the weights 3/4, 1/2, 1/4 of Newey and West."""
    rng, rho, count = np.random.default_rng(0), 0.5, 200_000
    white = rng.normal(size=(count, 1))
    assert scatter(white) == pytest.approx(1.0, rel=0.02)
    slow = white.copy()
    for k in range(1, count):
        slow[k] = rho * slow[k - 1] + np.sqrt(1 - rho**2) * white[k]
    assert scatter(slow) == pytest.approx(1 + 2 * (0.75 * rho + 0.5 * rho**2 + 0.25 * rho**3), rel=0.02)
    # Neighbours that pull apart do not make a sum surer.
    assert scatter(np.array([[1.0], [-1.0]] * 50)) == pytest.approx(100 / 99)


def test_t_value_is_the_mean_over_its_standard_error():
    assert t_value(np.array([1.0, 2.0, 3.0, 4.0])) == pytest.approx(10 / (2 * np.sqrt(5 / 3)))


@pytest.mark.parametrize("size", [1.0, 3.0])
def test_dispersion_is_how_much_larger_than_stated_the_noise_is(size):
    rng = np.random.default_rng(1)
    jacobian = rng.normal(size=(WINDOWS, ROWS, ALL))
    stats = reduced(jacobian, size * rng.normal(size=(WINDOWS, ROWS)))
    # The median of six variances, each of 400 windows and so known to 7 %, with neighbours to some more.
    assert _search.dispersion(Bench(), MODEL, stats) == pytest.approx(size**2, rel=0.15)


def test_dispersion_knows_that_a_disturbance_lasts():
    """The same force in two windows in a row."""
    rng = np.random.default_rng(2)
    jacobian = np.tile(rng.normal(size=(1, ROWS, ALL)), (WINDOWS, 1, 1))
    residual = np.repeat(rng.normal(size=(WINDOWS // 2, ROWS)), 2, axis=0)
    # Every second pair of neighbours is alike: 1 + 2 * 3/4 * 1/2.
    found = _search.dispersion(Bench(), MODEL, reduced(jacobian, residual))
    assert found == pytest.approx(1.75, rel=0.15)


def test_own_dispersion_is_that_of_the_axis_that_is_disturbed():
    """One axis for each number; a disturbance along one that the median over suspects does not see."""
    residual = np.random.default_rng(3).normal(size=(WINDOWS, ALL))
    residual[:, KNOWN - 1] *= 4.0
    stats = reduced(np.tile(np.eye(ALL), (WINDOWS, 1, 1)), residual)
    phi = _search.dispersion(Bench(), MODEL, stats)
    assert phi == pytest.approx(1.0, rel=0.15)
    here = _search.own_dispersion(Bench(), MODEL, stats, slice(KNOWN - 1, KNOWN), phi)
    assert here == pytest.approx(16.0, rel=0.15)
    assert _search.own_dispersion(Bench(), MODEL, stats, slice(0, 1), phi) < 1.3


def test_putting_back_costs_what_dense_least_squares_say():
    """Three numbers under a prior at their best, and the same with the second one put back to the file."""
    rng = np.random.default_rng(4)
    jacobian, residual = rng.normal(size=(WINDOWS, ROWS, ALL)), rng.normal(size=(WINDOWS, ROWS))

    def least(free: list[int]) -> tuple[np.ndarray, np.ndarray]:
        rows = np.vstack([jacobian[..., free].reshape(-1, len(free)), np.sqrt(PRIOR) * np.eye(len(free))])
        x = np.zeros(KNOWN)
        x[free] = np.linalg.lstsq(rows, -np.concatenate([residual.ravel(), np.zeros(len(free))]))[0]
        return x, residual + jacobian[..., :KNOWN] @ x

    (best, at), (_, back) = least([0, 1, 2]), least([0, 2])
    found = _search.putting_back(Bench(best), MODEL, reduced(jacobian, at), slice(1, 2))
    assert np.allclose(found, (back**2).sum(1) - (at**2).sum(1), atol=1e-9)


def test_what_a_finding_must_save():
    """Two parameters, six suspects, 100 windows to begin in, 1000 samples: by hand."""
    always, late = Member(0), Member(0, Beginning(0, 30.0))
    assert _search.penalty(Bench(), always) == pytest.approx(2 * np.log(1000))
    assert _search.penalty(Bench(), late) == pytest.approx(3 * np.log(1000))
    for member, tried, price in ((always, 6, 2 * np.log(1000)), (late, 600, 3 * np.log(1000))):
        least = price + 2 * np.log(tried) + 2 * np.log(150)
        assert _search.needed(Bench(), member, 2.0) == pytest.approx(2 * least)
    assert _search.least_needed(Bench()) == pytest.approx(_search.needed(Bench(), always, 1.0))


@pytest.mark.parametrize(("saved", "hoped"), [(3.0, 3.0), (0.0, 12.0)])
def test_a_suspect_that_could_not_take_a_step_yet_is_hoped_to_save_what_the_next_one_promises(saved, hoped):
    """Velocities of half the size, from the true ones: three steps went too far."""
    refitted = dataclasses.replace(MODEL, cost=10.0, promised=4.0)
    assert _search._hoped(Trial(Member(0), refitted, saved)) == hoped


@pytest.mark.parametrize(("saved", "begins", "pays"), [(8.0, 0, False), (12.0, 0, True), (12.0, 1, False)])
def test_a_rough_refit_must_pay_for_its_numbers_by_what_it_saves_and_promises(saved, begins, pays):
    """Two numbers cost log(1000) = 6.9 each, and a beginning as much again; what is promised is 4."""
    member = Member(0, Beginning(0, 30.0) if begins else None)
    refitted = dataclasses.replace(MODEL, cost=10.0, promised=8.0)
    assert _search._pays(Bench(), Trial(member, refitted, saved)) == pays


@pytest.mark.parametrize(
    ("cost", "best", "share"), [(2000.0, 8e3, 2e-3), (100.0, 8e3, 8e-3), (2000.0, 80.0, 1e-4)]
)
def test_what_decides_nothing_between_suspects_is_worth_no_step(cost, best, share):
    """A thousandth of what the best saves, of -2 log p or of 1000 samples, and a ten thousandth of those."""
    hopeful = [Trial(Member(0), dataclasses.replace(MODEL, cost=one), 1.0) for one in (1.0, cost)]
    assert _search._decisive(Bench(), hopeful, best) == pytest.approx(share)


def test_of_suspects_that_save_a_fifth_of_the_best_the_leading_three_are_tried_with_a_beginning():
    """Once each, unless it was tried with that beginning already."""
    begun = {which: Member(which, Beginning(0, 10.0 * which)) for which in range(6)}

    def trials(saved: dict[Member, float]) -> list[Trial]:
        return [Trial(member, MODEL, worth) for member, worth in saved.items()]

    weak = trials({Member(2): 19.0, Member(1): 21.0, Member(0): 100.0})
    assert _search._late(weak, begun) == [begun[0], begun[1]]
    many = trials({Member(0): 90.0, begun[1]: 80.0, Member(2): 70.0, Member(3): 60.0, begun[0]: 100.0})
    assert _search._late(many, begun) == []
    assert _search._late(trials({Member(3): 1.0, Member(4): 0.5}), {3: begun[3]}) == [begun[3]]


def test_what_pays_for_its_numbers_beside_a_disturbance_is_refitted_to_the_end_behind_what_is_sure():
    """Two numbers cost log(1000) = 6.9 each; a finding of six suspects at odds of 150 another 13.6."""
    asked = []

    class Refuses(Bench):
        def likeliest(self, model):
            asked.append(model.cost)
            return model

        def stands(self, model, beside):
            return False

    saved = [20.0, 30.0, 13.0, 15.0, 28.0]
    for model, refitted in ((DISTURBED, [30.0, 28.0, 20.0]), (MODEL, [30.0, 28.0])):
        trials = [
            Trial(Member(i), dataclasses.replace(model, cost=worth), worth) for i, worth in enumerate(saved)
        ]
        assert _search._decided(Refuses(), model, trials) is None
        assert asked == refitted
        asked.clear()


def test_what_a_disturbance_gains_by_being_fitted_to_the_end_is_no_suspects(monkeypatch):
    """A suspect saves 20 in part and 32 in the end, where 2 or 6 are gained without it; it needs 27.4."""
    model = dataclasses.replace(DISTURBED, cost=100.0)
    with_it = dataclasses.replace(model, members=(Member(0),), cost=90.0)
    monkeypatch.setattr(_search, "significant", lambda bench, trial, after, phi: trial.saved > 27.4)
    monkeypatch.setattr(_search, "dispersion", lambda *given: 1.0)

    class Fits(Bench):
        def __init__(self, gained):
            super().__init__()
            self.gained = gained

        def likeliest(self, model):
            return dataclasses.replace(model, cost=84.0 if model.members else 100.0 - 0.5 * self.gained)

        def stands(self, model, beside):
            return True

        def screen(self, model):
            return object.__new__(Reduced)

    for gained, found in ((2.0, True), (6.0, False)):
        decided = _search._decided(Fits(gained), model, [Trial(Member(0), with_it, 20.0)])
        assert (decided is not None) == found
        assert decided is None or decided[0].trials[0].saved == pytest.approx(32.0 - gained)
