"""Whether innovations go with the past: by noise that does not, and by series made to."""

import numpy as np
import pytest

from jaxmarine.diagnosis import Criteria
from jaxmarine.diagnosis._innovations import PAST, Remembered, _evidence, told

SAMPLES, TRIALS = 2000, 100


def best(white: np.ndarray, source: np.ndarray) -> tuple[float, slice]:
    return max(((_evidence([white], [source], ago), ago) for ago in PAST), key=lambda one: one[0])


def test_noise_remembers_nothing():
    """At odds of 20 to 1 with a penalty of half a log n, none of a hundred is taken for more."""
    rng = np.random.default_rng(1)
    for _ in range(TRIALS):
        white, command = rng.normal(size=SAMPLES), np.repeat(rng.normal(size=SAMPLES // 10), 10)
        assert best(white, command)[0] < Criteria().close
        assert best(white, white)[0] < Criteria().close


@pytest.mark.parametrize("ago", PAST)
def test_what_goes_with_a_past_command_is_found_with_its_time(ago):
    """A fifth of its size in white noise: (n r² - log n) / 2 nats, within four standard errors of r."""
    rng = np.random.default_rng(2)
    command, white = rng.normal(size=SAMPLES), rng.normal(size=SAMPLES)
    width = ago.stop - ago.start
    for k in range(ago.stop, SAMPLES):
        white[k] += 0.2 * np.sqrt(width) * command[k - ago.stop + 1 : k - ago.start + 1].mean()
    nats, when = best(white, command)
    assert when == ago
    low, high = (0.5 * (SAMPLES * r**2 - np.log(SAMPLES)) for r in (0.2 - 4 / 45, 0.2 + 4 / 45))
    assert low < nats < high


def test_gaps_and_logs_that_are_too_short_say_nothing():
    rng = np.random.default_rng(3)
    white, command = rng.normal(size=SAMPLES), rng.normal(size=SAMPLES)
    whole = _evidence([white], [command], PAST[0])
    broken = np.where(np.arange(SAMPLES) < 1000, white, np.nan)
    assert _evidence([broken], [command], PAST[0]) != whole
    assert np.isfinite(_evidence([broken], [np.where(np.isnan(broken), np.nan, command)], PAST[0]))
    assert _evidence([white], [np.zeros(SAMPLES)], PAST[0]) == -np.inf


def test_the_sentence_says_what_to_log_instead():
    one = told(Remembered("u", "port", (0.1, 0.1), 12.3))
    assert "the command of port 0.1 s before (by 12.3 nats)" in one and "set-points" in one
    other = told(Remembered("r", None, (0.4, 0.7), 5.0))
    assert "what it left of it 0.4 to 0.7 s before" in other and "set-points" not in other
