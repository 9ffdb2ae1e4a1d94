"""A small plot as SVG: axes with ticks, lines, bands, points and marks, in the colours of the page's classes.

Coordinates have a tenth of a pixel and no curve has more points than there are pixels, so that a page stays
small however long the logs are.
"""

import dataclasses
import html
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.ticker import MaxNLocator

WIDTH, HEIGHT = 340.0, 230.0
_TOP, _RIGHT, _BOTTOM = 8.0, 10.0, 36.0
_LETTER = 6.3  # width of a digit of the labels
_TICKS = MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10])


class Shape(NamedTuple):
    """One shape: `form` is line, band or points, `kind` whose it is; a band lies between `y` and `upper`."""

    form: str
    kind: str
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    upper: Float[np.ndarray, " n"] | None = None

    @property
    def outline(self) -> tuple[Float[np.ndarray, " outline"], Float[np.ndarray, " outline"]]:
        """Its points, those of a band along the lower edge and back along the upper one."""
        if self.upper is None:
            return self.x, self.y
        return np.concatenate([self.x, self.x[::-1]]), np.concatenate([self.y, self.upper[::-1]])


@dataclasses.dataclass
class Plot:
    """What is drawn, in the units of its axes; `svg` makes the text of the page, `_pictures.py` a print.

    - `from_zero`: the vertical axis begins at 0. `equal`: both axes have one scale, as a map has.
    """

    x_title: str
    y_title: str
    from_zero: bool = False
    equal: bool = False
    shapes: list[Shape] = dataclasses.field(default_factory=list)
    marks: list[float] = dataclasses.field(default_factory=list)

    @property
    def empty(self) -> bool:
        return not self.shapes

    def line(self, kind: str, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> None:
        """A curve, interrupted where there is no number; `kind`: its class on the page."""
        self.shapes.append(Shape("line", kind, np.asarray(x, float), np.asarray(y, float)))

    def band(
        self,
        kind: str,
        x: Float[np.ndarray, " n"],
        low: Float[np.ndarray, " n"],
        high: Float[np.ndarray, " n"],
    ) -> None:
        """What lies between two curves."""
        self.shapes.append(Shape("band", kind, *(np.asarray(one, float) for one in (x, low, high))))

    def points(self, kind: str, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> None:
        self.shapes.append(Shape("points", kind, np.asarray(x, float), np.asarray(y, float)))

    def mark(self, x: float) -> None:
        """A dotted line upwards."""
        self.marks.append(x)

    def svg(self) -> str:
        """The plot as an `svg` element that is as wide as what it stands in."""
        outlines = [shape.outline for shape in self.shapes]
        x_low, x_high = _ends([x for x, _ in outlines] + [np.array(self.marks)])
        y_low, y_high = _ends([y for _, y in outlines] + [np.zeros(int(self.from_zero))])
        room = 0.04 * (y_high - y_low)
        y_low, y_high = (y_low if self.from_zero and y_low == 0 else y_low - room), y_high + room
        y_ticks = _labels(y_low, y_high)
        left = 22.0 + _LETTER * max((len(text) for _, text in y_ticks), default=1)
        wide, high = WIDTH - left - _RIGHT, HEIGHT - _TOP - _BOTTOM
        if self.equal:
            scale = max((x_high - x_low) / wide, (y_high - y_low) / high)
            x_low, x_high = _about(x_low, x_high, scale * wide)
            y_low, y_high = _about(y_low, y_high, scale * high)
            y_ticks = _labels(y_low, y_high)

        def across(x):
            return left + wide * (np.asarray(x) - x_low) / (x_high - x_low)

        def up(y):
            return _TOP + high * (y_high - np.asarray(y)) / (y_high - y_low)

        out = [f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" aria-hidden="true">']
        for value, text in y_ticks:
            y = float(up(value))
            out.append(
                f'<path class="{"zero" if value == 0 else "grid"}" d="M{left:.1f} {y:.1f}h{wide:.1f}"/>'
            )
            out.append(f'<text class="end" x="{left - 5:.1f}" y="{y + 4:.1f}">{text}</text>')
        for value, text in _labels(x_low, x_high):
            x = float(across(value))
            out.append(f'<path class="grid" d="M{x:.1f} {_TOP:.1f}v{high:.1f}"/>')
            out.append(f'<text class="middle" x="{x:.1f}" y="{_TOP + high + 14:.1f}">{text}</text>')
        for mark in self.marks:
            out.append(f'<path class="mark" d="M{float(across(mark)):.1f} {_TOP:.1f}v{high:.1f}"/>')
        for shape, (x, y) in zip(self.shapes, outlines, strict=True):
            path = _path(across(x), up(y), shape.form)
            out.append(f'<path class="{shape.form} {shape.kind}" d="{path}"/>')
        middle = left + wide / 2
        out.append(
            f'<text class="middle" x="{middle:.1f}" y="{HEIGHT - 5:.1f}">{html.escape(self.x_title)}</text>'
        )
        turned = f'transform="translate(11 {_TOP + high / 2:.1f}) rotate(-90)"'
        out.append(f'<text class="middle" {turned}>{html.escape(self.y_title)}</text></svg>')
        return "".join(out)


def _ends(values: Sequence[np.ndarray]) -> tuple[float, float]:
    """The least and the greatest number, a little apart."""
    every = np.concatenate([np.zeros(0), *values])
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if every.size else (0.0, 1.0)
    return (low, high) if high > low else _about(low, high, max(abs(low), 1.0))


def _about(low: float, high: float, width: float) -> tuple[float, float]:
    """A range of a width with the same middle."""
    middle = (low + high) / 2
    return middle - width / 2, middle + width / 2


def _labels(low: float, high: float) -> list[tuple[float, str]]:
    """Round numbers within a range, and how they are written."""
    ticks = [float(tick) for tick in _TICKS.tick_values(low, high) if low <= tick <= high]
    step = min(np.diff(ticks), default=1.0)
    places = next((n for n in range(12) if abs(step * 10**n - round(step * 10**n)) < 1e-6), 0)
    large = max(map(abs, ticks), default=0.0)
    plain = large < 1e6 and places < 5
    exponent = 0 if plain or large == 0 else math.floor(math.log10(large))
    ticks = [0.0 if abs(tick) < 1e-9 * large else tick for tick in ticks]
    return [
        (tick, (f"{tick:.{places}f}" if plain else f"{tick / 10**exponent:g}e{exponent}").replace("-", "−"))
        for tick in ticks
    ]


def _path(x: np.ndarray, y: np.ndarray, shape: str) -> str:
    """The commands that draw a shape; a point is a line of no length with a round end."""
    known = np.isfinite(x) & np.isfinite(y)
    if shape == "points":
        return "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x[known], y[known], strict=True))
    begins = known & ~np.append(False, known[:-1])
    steps = zip(x[known], y[known], begins[known], strict=True)
    drawn = "".join(f"{'M' if first else 'L'}{a:.1f} {b:.1f}" for a, b, first in steps)
    return drawn + "Z" if shape == "band" and drawn else drawn
