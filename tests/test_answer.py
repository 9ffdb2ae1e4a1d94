"""Standard errors of an answer against the spread of draws, and what else it could be by hand."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine.diagnosis import Criteria
from jaxmarine.diagnosis._answer import alternatives, spread
from jaxmarine.diagnosis._explanation import Member, Model
from jaxmarine.diagnosis._search import Round, Trial
from jaxmarine.diagnosis._workbench import Workbench

WINDOWS, DRAWS = 75, 400


def with_memory(rng: np.random.Generator, share: float, columns: int) -> np.ndarray:
    """Scores of windows that remember a share of the one before, of unit variance [windows, columns]."""
    out = rng.normal(size=(WINDOWS, columns))
    for k in range(1, WINDOWS):
        out[k] = share * out[k - 1] + np.sqrt(1 - share**2) * out[k]
    return out


@pytest.mark.parametrize(("weight", "share"), [(1.0, 0.0), (30.0, 0.0), (30.0, 0.5)])
def test_a_heavy_prior_and_a_lasting_disturbance_leave_intervals_honest(weight, share):
    """A coefficient that is off as widely as its prior says, beside a member that mimics it in part.

    Scores scatter `weight` times as much as the information says. The errors of 400 draws, in standard
    errors, have a root mean square of 1 within 12 %: 3.5 % from the number of draws, the rest from an
    estimate that knows 75 windows only.
    """
    rng = np.random.default_rng(5)
    prior, information = 0.1, np.array([[400.0, 300.0], [300.0, 900.0]]) / WINDOWS
    precision = np.array([weight / prior**2, 1e-8])
    root, off = np.linalg.cholesky(information), []
    total = WINDOWS * information
    for _ in range(DRAWS):
        truth = np.array([prior * rng.normal(), 0.7])
        noise = np.sqrt(weight) * with_memory(rng, share, 2) @ root.T
        z = np.linalg.solve(total + np.diag(precision), total @ truth + noise.sum(0))
        scores = (z - truth) @ information - noise
        covariance = spread(scores, total, precision, np.array([prior, 0.0]), weight == 1.0)
        off.append((z - truth) / np.sqrt(np.diag(covariance)))
    assert np.sqrt(np.mean(np.square(off), axis=0)) == pytest.approx(1.0, abs=0.12)


PHI = 2.0


def weighed_beside(saved: dict[int, float], accepted: bool = True) -> Round:
    """A round by what each suspect saved, the winner first."""
    nothing = Model((), np.zeros(0), jnp.zeros((1, 12)), 0.0)
    return Round(tuple(Trial(Member(i), nothing, x) for i, x in saved.items()), accepted, PHI)


def others(rounds: list[Round], named: set[int]) -> list[tuple[str, float, bool]]:
    """Of the suspect 0, whose evidence beside all others is 50 nats."""
    bench: Any = object.__new__(Workbench)
    bench.criteria = Criteria()
    suspects = [SimpleNamespace(effect=SimpleNamespace(name=name), target=None) for name in "abcdefghi"]
    columns = [np.zeros((9, 2 if name == "i" else 1)) for name in "abcdefghi"]
    bench.layout, bench.samples = SimpleNamespace(suspects=suspects, columns=columns), round(np.exp(5.0))
    found = alternatives(bench, Member(0), named, PHI, rounds, 50.0)
    return [(one.effect, one.log_evidence, one.indistinguishable) for one in found]


def test_alternatives_stand_as_far_behind_a_finding_as_in_its_round():
    """Chi-square of 4 is 1 nat at a dispersion of 2; odds of 1 to 20 are 3 nats."""
    told = others([weighed_beside({0: 200.0, 1: 189.0, 2: 187.0})], {0})
    assert told == [("b", pytest.approx(47.25), True), ("c", pytest.approx(46.75), False)]
    # A parameter more costs half a logarithm of the samples, 2.5 nats.
    assert others([weighed_beside({0: 200.0, 8: 199.0})], {0}) == [
        ("i", pytest.approx(47.25, abs=0.01), True)
    ]
    # One that proved better in its round, as evidence was not known there, is as good.
    assert others([weighed_beside({1: 204.0, 0: 200.0})], {0}) == [("b", pytest.approx(51.0), True)]


def test_two_alternatives_at_most_are_as_good_and_six_are_listed():
    saved = {0: 200.0, 7: 100.0, 1: 199.0, 2: 198.0, 3: 197.0, 4: 196.0, 5: 195.0, 6: 194.0, 8: 193.0}
    told = others([weighed_beside(saved)], {0, 3})
    assert [name for name, _, _ in told] == ["b", "c", "h", "e", "f", "g"]  # less what is named itself
    assert [close for _, _, close in told] == [True, True, False, False, False, False]


def test_alternatives_are_those_of_the_round_that_was_won():
    lost = weighed_beside({1: 200.0, 0: 199.0, 2: 198.0})
    won = weighed_beside({0: 200.0, 3: 199.0, 4: 198.0})
    refused = weighed_beside({0: 200.0, 5: 199.0}, accepted=False)
    assert [one[0] for one in others([refused, lost, won], {0, 1})] == ["d", "e"]
    assert [one[0] for one in others([refused, lost], {0, 1})] == ["c"]
    assert others([refused], {0}) == []
