"""What a fleet's table gives alarm of: causes that are new, and sizes that have left their level."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ._drift import alarms, change_point
from ._history import Rows, Series, by_craft, label_of, present, series_of
from ._rows import Row
from ._sisters import Class, scatter_of

# Differences of successive logs that the scatter of a size is known by, to about a third.
_KNOWN = 10
# A size is any before it was seen: a spread of so many times the largest error.
_ANY = 1e3


@dataclasses.dataclass(frozen=True)
class Notice:
    """Something of a craft that is not as it was.

    - `first`: the row of the log from which on it is so; `series`: of the size that has changed, with the
      evidence [nats] of one step in it; None of a cause that is new.
    """

    craft: str
    label: str
    first: Row
    series: Series | None = None
    nats: float | None = None


def notices(rows: Sequence[Row]) -> list[Notice]:
    """The notices of all craft."""
    crafts = {
        craft: [log for log in logs if log[0]["error"] is None] for craft, logs in by_craft(rows).items()
    }
    out = [one for craft, logs in crafts.items() if logs for one in _new(craft, logs)]
    alike: dict[tuple[str, str, str], list[tuple[list[Rows], Series]]] = {}
    for craft, logs in crafts.items():
        for series in series_of(craft, logs):
            effect = series.of.partition(":")[0]
            alike.setdefault((logs[0][0]["kind"], effect, series.parameter), []).append((logs, series))
    return out + [one for group in alike.values() for one in _changed(group)]


def _new(craft: str, logs: Sequence[Rows]) -> list[Notice]:
    """Causes that the latest log has and the first one has not."""
    before = {label_of(row) for row in logs[0]}
    found = [(label_of(last), first) for first, last in present(logs)]
    return [
        Notice(craft, label, first) for label, first in found if label is not None and label not in before
    ]


def _changed(group: Sequence[tuple[list[Rows], Series]]) -> list[Notice]:
    """Sizes of one cause in craft of one class that have left their level; scatter is that of all of them."""
    values = [series.sizes[:, None] for _, series in group]
    covariance = [series.std[:, None, None] ** 2 for _, series in group]
    if sum(len(own) - 1 for own in values) < _KNOWN:
        return []
    scatter = scatter_of(values, covariance)
    out = []
    for (logs, series), own, stated in zip(group, values, covariance, strict=True):
        common = Class(own[0], np.array([_ANY * (series.std.max() + scatter[0])]), scatter)
        if alarms(common, own, stated):
            change = change_point(series.sizes, np.hypot(series.std, scatter[0]))
            named = [log for log in logs if series.of in map(label_of, log)]
            out.append(Notice(series.craft, series.of, named[change.dive][0], series, change.nats))
    return out
