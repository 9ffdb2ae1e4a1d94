"""The sums that decide a verdict, against dense least squares and against numbers worked by hand."""

import numpy as np
import pytest

from jaxmarine._types import CHANNELS
from jaxmarine.diagnosis._gain import gain
from jaxmarine.diagnosis._score import Reduced, savings

WINDOWS, ROWS, KNOWN, OWN = 12, 30, 3, 2


def least(jacobian: np.ndarray, residual: np.ndarray, prior: np.ndarray, offset: np.ndarray) -> float:
    """The least chi-square of residual + jacobian x with x_i + offset_i held near 0 by the first prior_i."""
    count = jacobian.shape[1]
    pull = np.zeros((len(prior), count))
    pull[:, : len(prior)] = np.diag(np.sqrt(prior))
    whole = np.vstack([jacobian, pull])
    target = np.concatenate([residual, np.sqrt(prior) * offset])
    x = np.linalg.lstsq(whole, -target)[0]
    return float(((whole @ x + target) ** 2).sum())


def test_savings_are_those_of_dense_least_squares():
    """Two suspects beside three known numbers under a prior; acting always, or from each window on."""
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(WINDOWS, ROWS, KNOWN + 2 * OWN))
    truth = np.array([0.3, -0.2, 0.1, 0.0, 0.0, 0.5, -0.4])
    residual = rng.normal(size=(WINDOWS, ROWS)) - jacobian @ truth
    stats = Reduced(
        (residual**2).sum(1),
        np.einsum("wri,wr->wi", jacobian, residual),
        np.einsum("wri,wrj->wij", jacobian, jacobian),
    )
    known, rest = np.split(np.eye(KNOWN + 2 * OWN), [KNOWN], axis=1)
    owns = (rest[:, :OWN], rest[:, OWN:])
    prior, offset = np.array([4.0, 100.0, 1e-3]), np.array([0.2, -0.1, 0.4])
    earliest = 3
    table = savings(stats, known, prior, offset, owns, earliest)

    def flat(columns: np.ndarray, begin: int) -> np.ndarray:
        acting = (np.arange(WINDOWS) >= begin)[:, None, None]
        now = np.concatenate([jacobian @ known, acting * (jacobian @ columns)], axis=2)
        return now.reshape(WINDOWS * ROWS, -1)

    for i, own in enumerate(owns):
        before = least(flat(own[:, :0], 0), residual.ravel(), prior, offset)
        for begin in range(WINDOWS):
            if begin and (begin < earliest or begin > WINDOWS - earliest):
                assert table[i, begin] == -np.inf
                continue
            after = least(flat(own, begin), residual.ravel(), prior, offset)
            # The ridge of 1e-10 that keeps the elimination regular is all that differs.
            assert table[i, begin] == pytest.approx(before - after, rel=1e-6)
    assert table[1, 0] > 10 * table[0, 0]


def predictions(starts: int, size: float, seed: int):
    """Predictions of u that miss the measurement by errors of a given size."""
    rng = np.random.default_rng(seed)
    shown = np.full((starts, 6, len(CHANNELS)), np.nan)
    shown[..., CHANNELS.index("u")] = size * rng.choice([-1.0, 1.0], size=(starts, 6))
    return shown


def test_the_gain_is_the_ratio_of_root_mean_square_errors():
    starts, stride = 60, 1.0
    times = stride * np.arange(starts)[:, None] + np.arange(6)
    measured = np.where(np.isfinite(predictions(starts, 1.0, 0)), 0.0, np.nan)
    before, after = predictions(starts, 0.4, 1), predictions(starts, 0.1, 2)
    # Samples of the run-in do not count.
    before[:, :2], after[:, :2] = 100.0, 100.0
    noise = np.full(len(CHANNELS), 0.02)
    found, _ = gain(times, before, after, measured, 2, noise, True)
    assert found.ratio == pytest.approx(0.25)
    # Errors of one size at every start leave nothing for the bootstrap to draw.
    assert found.ratio_ci95 == pytest.approx((0.25, 0.25))
    assert found.velocity is not None and found.position is None
    assert (found.velocity.before, found.velocity.after) == pytest.approx((0.4, 0.1))


def test_the_interval_of_the_gain_knows_that_predictions_overlap(monkeypatch):
    """Ten neighbouring starts, half a second apart, share their errors: the true ratio still lies inside."""
    monkeypatch.setattr("jaxmarine.diagnosis._gain.RESAMPLES", 300)
    starts, alike, sigma, rng = 60, 10, 0.3, np.random.default_rng(4)
    noise = np.ones(len(CHANNELS))
    times = 0.5 * np.arange(starts)[:, None] + np.arange(6.0)
    before = predictions(starts, 1.0, 5)
    measured = np.where(np.isfinite(before), 0.0, np.nan)
    truth = np.exp(sigma**2)  # root mean square of the lognormal sizes
    inside = 0
    for _ in range(40):
        size = np.repeat(rng.lognormal(sigma=sigma, size=starts // alike), alike)[:, None, None]
        low, high = gain(times, before, size * before, measured, 0, noise, True)[0].ratio_ci95
        inside += low < truth < high
    # Some 80 % with six independent stretches; starts drawn one by one would give less than half.
    assert inside >= 26
