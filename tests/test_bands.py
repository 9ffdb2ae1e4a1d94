"""Bands of predictions: what they hold of errors that are like those of the training logs."""

import numpy as np
import pytest

from jaxmarine.diagnosis import BANDS, Predictions
from jaxmarine.diagnosis._bands import ahead_of, banded, errors_of

BEGIN, DT = 20, 0.1


def with_band(shown: Predictions, home: list[Predictions]) -> Predictions:
    return banded(shown, [errors_of(one, ahead_of(shown)) for one in home])


def predicted(rng: np.random.Generator, starts: int, steps: int, dt: float = DT) -> Predictions:
    """Errors that grow as a random walk does, in x and psi; psi is measured at every other sample."""
    times = dt * np.arange(BEGIN + steps) + 7.0 * np.arange(starts)[:, None]
    walk = np.cumsum(rng.normal(size=(starts, BEGIN + steps, 18)), axis=1) * np.sqrt(dt)
    measured = np.full(walk.shape, np.nan)
    measured[..., 0], measured[:, ::2, 5] = walk[..., 0], 0.2 * walk[:, ::2, 5] + 3.0
    after = np.zeros(walk.shape)
    after[..., 5] = 3.0 - 2 * np.pi
    return Predictions(times, BEGIN, measured, after, after, np.ones(18))


def test_a_band_holds_what_it_says_of_errors_alike():
    """Of 200 other predictions, whose steps go together: within four standard errors over both."""
    rng = np.random.default_rng(0)
    home = [predicted(rng, 60, 50), predicted(rng, 140, 50)]
    shown = with_band(predicted(rng, 200, 50), home)
    error = 4 * np.sqrt(BANDS * (1 - BANDS) * (1 / 200 + 1 / 200))
    assert shown.held == pytest.approx(BANDS, abs=error)
    assert shown.band is not None and shown.band.shape == (50, 18)
    # It grows as the walk does, by the root of the time, and says nothing of what was not measured.
    assert shown.band[45, 0] / shown.band[10, 0] == pytest.approx(np.sqrt(65 / 30), rel=0.25)
    assert shown.band[45, 5] == pytest.approx(0.2 * shown.band[45, 0], rel=0.3)
    assert np.isnan(shown.band[:, 1]).all()


def test_a_test_log_that_is_worse_is_held_less():
    rng = np.random.default_rng(1)
    home, worse = predicted(rng, 60, 50), predicted(rng, 60, 50)
    worse.measured[..., 0] *= 3.0
    assert with_band(worse, [home]).held < 0.75


def test_logs_sampled_otherwise_are_read_at_the_same_times():
    rng = np.random.default_rng(2)
    fast, slow = predicted(rng, 300, 50), predicted(rng, 300, 25, 2 * DT)
    by_own, by_slow = with_band(fast, [fast]), with_band(fast, [slow])
    later = np.arange(50) * DT > 1.0
    ratio = by_slow.band[later, 0] / by_own.band[later, 0]
    # The run-in of the slow one is as many samples, and so twice as long: its walk has gone further.
    expected = np.sqrt((np.arange(50)[later] * DT + 4.0) / (np.arange(50)[later] * DT + 2.0))
    np.testing.assert_allclose(ratio, expected, rtol=0.25)


def test_without_a_training_log_that_is_long_enough_there_is_none():
    rng = np.random.default_rng(3)
    shown = with_band(predicted(rng, 5, 50), [])
    assert shown.band is None and shown.held is None


def test_a_prediction_that_runs_away_widens_the_band():
    rng = np.random.default_rng(4)
    home = predicted(rng, 8, 50)
    home.after[0, 30:, 0] = np.nan
    band = with_band(predicted(rng, 8, 50), [home]).band
    assert np.isinf(band[-1, 0]) and np.isfinite(band[0, 0])
