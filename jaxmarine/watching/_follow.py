"""The loop of a watch: rows from a source, one after another, until there are no more."""

import time
from collections.abc import Callable

from ._saved import Kept
from ._sources import Source
from ._watch import Watch

# How long a source is waited for at once, and without a row before it is said that nothing comes [s].
_WAIT, QUIET = 0.2, 5.0


def follow(
    watch: Watch,
    source: Source,
    say: Callable[[str], None],
    each: Callable[[Watch], None],
    kept: Kept | None = None,
    stop_after: float | None = None,
) -> None:
    """Takes rows until the source ends, or nothing has come for `stop_after` [s].

    - `say`: a sentence; `each`: called after rows were taken.
    - `kept`: where the watch is kept; it goes on from there.
    """
    skip = 0
    if kept is not None:
        told, place = kept.opened(watch)
        for sentence in told:
            say(sentence)
        if watch.intake.last is not None:
            say(f"Goes on from t = {watch.intake.last:g} s, as it was kept.")
        if place is not None and source.place is not None:
            source.go_on(place[0])
            skip = place[1]
        each(watch)
    last, silent, said = time.monotonic(), False, 0
    while True:
        before = source.place
        rows = source.take(_WAIT)
        for sentence in source.told[said:]:
            say(sentence)
        said = len(source.told)
        now = time.monotonic()
        if rows is None:
            say(f"{source.name} has ended.")
            return
        if not rows:
            if not silent and now - last > QUIET:
                silent = True
                say(f"Nothing has come from {source.name} for {QUIET:g} s; it is waited for.")
            if stop_after is not None and now - last > stop_after:
                say(f"Nothing has come from {source.name} for {stop_after:g} s; stopped.")
                return
            continue
        if silent:
            say(f"{source.name} goes on.")
        last, silent = now, False
        for k, row in enumerate(rows):
            if k < skip:
                continue
            counted = None if before is None else [before, k + 1]
            if kept is not None:
                kept.add(row, counted)
            for sentence in watch.update(row):
                say(sentence)
            if kept is not None:
                kept.after(watch, counted)
        skip = max(0, skip - len(rows))
        each(watch)
        last = time.monotonic()
