"""How long work says what it does: a function that is called with a few words at each stage.

Of the words of a diagnosis an `Estimate` reads how much of it is done.
"""

import re
import time
from collections.abc import Callable

Progress = Callable[[str], None]

# How words begin that say what was found, before anything is settled.
FOUND = "found "
# The stages of a diagnosis, and how long each takes in rounds of its search: as measured on logs of some
# minutes, once programs are compiled.
FITTING = "fitting the vehicle file"
AGAIN = "searching again, with sensors as exact as what was found leaves them"
SETTLING = "settling what was found"
LOOKING = "looking for what the residual depends on"
LEARNING = "learning what is missing"
PREDICTING = "predicting the test logs"
LASTS = {FITTING: 1.5, AGAIN: 0.0, SETTLING: 2.0, LOOKING: 1.0, LEARNING: 1.0, PREDICTING: 0.3}
MOST_ROUNDS = 6

_ROUND = re.compile(r"round (\d+) of at most (\d+): ")


def silent(text: str) -> None:
    """Says nothing."""
    del text


def in_round(which: int, most: int, words: str) -> str:
    """Words on a round of the search, of which there are at most so many."""
    return f"round {which} of at most {most}: {words}"


class Estimate:
    """How much of a diagnosis is done, and how long the rest takes, from its words.

    The rest is counted at its most: it shrinks at once where the search ends after fewer rounds, and grows
    where a search is made again.

    - `clock`: tells the time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._began = self._entered = clock()
        self._stage, self._lasts, self._done = "", 0.0, 0.0
        self._to_come = sum(LASTS.values()) + MOST_ROUNDS

    def hear(self, words: str) -> None:
        """Takes note of the stage that begins, if words say that one does."""
        found = _ROUND.match(words)
        stage = found[0] if found else words
        if stage == self._stage or not (found or stage in LASTS):
            return
        self._done, self._entered = self._done + self._lasts, self._clock()
        self._stage, self._lasts = stage, 1.0 if found else LASTS[stage]
        later = list(LASTS)
        if found:
            rounds, later = int(found[2]) - int(found[1]) + 1, later[later.index(SETTLING) :]
        else:
            rounds = MOST_ROUNDS if stage in (FITTING, AGAIN) else 0
            later = later[later.index(stage) :]
        self._to_come = rounds + sum(LASTS[name] for name in later)

    @property
    def share(self) -> float:
        """Of the work that is done, 0 to 1."""
        return self._done / (self._done + self._to_come)

    @property
    def left(self) -> float | None:
        """Seconds that the rest takes, None while nothing is done."""
        if not self._done:
            return None
        lasts = self._to_come * (self._entered - self._began) / self._done
        return max(lasts - (self._clock() - self._entered), 0.0)

    def __str__(self) -> str:
        left = self.left
        if left is None:
            return ""
        return f"{100 * self.share:.0f} % done, about {_rounded(left)} left"


def _rounded(seconds: float) -> str:
    """To about a tenth, as nothing more is known: `5 s`, `50 s`, `3 min`."""
    if seconds < 90:
        return f"{max(5 * round(seconds / 5), 5)} s" if seconds < 20 else f"{10 * round(seconds / 10)} s"
    return f"{round(seconds / 60)} min"
