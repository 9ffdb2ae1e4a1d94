"""Notes of many logs: each said once, with the logs that it is of; times in words; progress in shares."""

import pickle

import numpy as np
import pytest

from jaxmarine._progress import AGAIN, FITTING, PREDICTING, SETTLING, Estimate, in_round
from jaxmarine.logs import Log, Note, clean, merged, moment


def log(name: str, step: float, names: tuple[int, ...], start: float = 0.0) -> Log:
    """A minute at 10 Hz of channels that come in steps."""
    t = start + 0.1 * np.arange(600)
    channels = np.full((600, 18), np.nan)
    for i in names:
        channels[:, i] = step * np.round((np.sin(t / 3.0 + i) + 2.0) / step)
    return Log(t, channels, np.zeros((600, 1)), None, ("port",), name)


def test_a_note_of_many_logs_and_channels_is_one_sentence_with_their_names():
    """44 of them: four channels of eleven logs."""
    notes = [note for i in range(11) for note in clean(log(f"{220 + i}.csv", 0.02, (0, 1, 6, 7))).notes]
    assert len(notes) == 44 and notes[0].startswith("220.csv: `x` comes in steps of 0.02; where")
    (one,) = merged(notes)
    names = ", ".join(f"{220 + i}.csv" for i in range(11))
    assert one == (
        f"Each of `x`, `y`, `u`, `v` of 11 logs ({names}) comes in steps of 0.02; where its noise is not "
        "stated, it is taken for at least 0.0058."
    )


def test_numbers_that_differ_become_a_range_and_channels_stay_with_their_logs():
    first, second = clean(log("a.csv", 0.02, (0, 1))), clean(log("b.csv", 0.05, (0,)))
    (one,) = merged((*first.notes, *second.notes))
    assert one.startswith(
        "Each of `x` of a.csv and b.csv and `y` of a.csv comes in steps of 0.02 to 0.05; where"
    )
    assert merged(first.notes[:1]) == (str(first.notes[0]),)


def test_what_reading_says_names_its_log_and_other_sentences_stay():
    said = "Column `psi` is wrapped 3 times; {it} counts modulo a turn."
    a, b = Note.on("a.csv", said), Note.on("b.csv", said)
    assert str(a) == said
    assert merged((a,)) == (f"a.csv: {said}",)
    assert merged((a, "Plain.", b, "Plain.")) == (f"a.csv and b.csv: {said}", "Plain.")
    many = merged(Note.on(f"{i}.csv", "It rains.") for i in range(30))
    assert many == ("30 logs (0.csv, 1.csv, 2.csv, ..., 29.csv): It rains.",)


def test_notes_survive_being_sent_to_another_process():
    note = clean(log("a.csv", 0.02, (0,))).notes[0]
    assert isinstance(note, Note)
    again = pickle.loads(pickle.dumps(note))
    assert again == note and merged((again, *clean(log("b.csv", 0.02, (0,))).notes)) == merged(
        (note, *clean(log("b.csv", 0.02, (0,))).notes)
    )


def test_times_are_those_since_the_start_beside_a_clock_that_does_not_begin_at_zero():
    assert moment(12.3, 0.0) == "t = 12.3 s"
    assert moment(2738655.1, 2738642.8) == "12.3 s (t = 2738655.1 s)"
    assert log("a.csv", 0.02, (0,)).clock == 0.0 and log("a.csv", 0.02, (0,), start=0.1).clock == 0.0
    late = log("a.csv", 0.02, (0,), start=1000.0)
    assert late.clock == 1000.0
    late.channels[50, 6] = np.nan
    late.channels[:, 6] = np.random.default_rng(0).normal(scale=0.02, size=600)
    late.channels[123, 6] = 9.0
    (spike,) = [note for note in clean(late).notes if "spikes" in note]
    assert "1 of 600 samples of `u`, at 12.3 s (t = 1012.3 s), leave" in spike


class Clock:
    """Seconds that a test sets."""

    def __init__(self):
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_share_grows_with_each_stage_and_jumps_where_the_search_ends_early():
    clock = Clock()
    estimate = Estimate(clock)
    estimate.hear(FITTING)
    assert str(estimate) == "" and estimate.share == 0.0
    shares = []
    for seconds, words in [(15, in_round(1, 6, "scoring")), (10, in_round(2, 6, "scoring")), (10, SETTLING)]:
        clock.now += seconds
        estimate.hear(words)
        estimate.hear("found thruster_lag")
        shares.append(estimate.share)
    # Of the same speed throughout: 1.5 rounds for the opening, 6 in all, and 4.3 after them.
    assert shares == pytest.approx([1.5 / 11.8, 2.5 / 11.8, 3.5 / 7.8])
    assert estimate.left == pytest.approx(43.0)
    assert str(estimate) == "45 % done, about 40 s left"
    clock.now += 20
    assert estimate.left == pytest.approx(23.0)
    estimate.hear(PREDICTING)
    assert estimate.share > 0.9 and str(estimate).endswith("about 5 s left")


def test_a_second_search_is_work_that_was_not_known_of():
    clock = Clock()
    estimate = Estimate(clock)
    for words in (FITTING, in_round(1, 6, "scoring"), in_round(2, 6, "scoring")):
        estimate.hear(words)
        clock.now += 10
    before = estimate.left
    estimate.hear(AGAIN)
    assert estimate.left is not None and before is not None and estimate.left > before
