"""What disturbs a craft, in words."""

import numpy as np

from .._types import DOFS
from ..fitting import Disturbance


def in_words(force: Disturbance) -> str:
    """Sizes and memories of a disturbance, axis by axis, and the period of its swell, in a sentence."""
    count, size, time = len(force.axes), np.asarray(force.size), np.asarray(force.time)
    units = ["N" if axis < 3 else "N m" for axis in force.axes]
    names = [DOFS[axis] for axis in force.axes]
    pushes = ", ".join(
        f"{s:.2g} {unit} in {name} with a memory of {t:.2g} s"
        for name, unit, s, t in zip(names, units, size, time, strict=False)
    )
    said = f"What disturbs the craft besides was estimated (standard deviations): {pushes}"
    if not force.swells:
        return said + "."
    swell = ", ".join(
        f"{s:.2g} {unit} in {name}" for name, unit, s in zip(names, units, size[count:], strict=True)
    )
    period = 2 * np.pi / float(force.frequency[-1])
    return f"{said}; and a swell of {period:.2g} s: {swell}."
