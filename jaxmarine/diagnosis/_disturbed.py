"""What disturbs a craft, as it was estimated, and in words."""

import numpy as np

from .._types import DOFS
from ..disturbances import RandomWrench
from ..fitting import Disturbance


def known(force: Disturbance) -> RandomWrench:
    """What the filter estimated of a disturbance, without the windows along which it did."""
    axes, count = np.array(force.axes), len(force.axes)

    def on_all(values) -> np.ndarray:
        out = np.zeros(6)
        out[axes] = np.asarray(values)
        return out

    own = on_all(force.size[:count]), on_all(force.time[:count])
    if not force.swells:
        return RandomWrench(*own)
    period, memory = 2 * np.pi / float(force.frequency[-1]), float(force.time[-1])
    return RandomWrench(*own, on_all(force.size[count:]), period, memory)


def in_words(force: RandomWrench) -> str:
    """Sizes and memories of a disturbance, axis by axis, and the period of its swell, in a sentence."""
    units = ["N" if axis < 3 else "N m" for axis in range(6)]
    pushes = ", ".join(
        f"{size:.2g} {unit} in {name} with a memory of {memory:.2g} s"
        for name, unit, size, memory in zip(DOFS, units, force.size, force.memory, strict=True)
        if size > 0
    )
    said = f"What disturbs the craft besides was estimated (standard deviations): {pushes}"
    if force.period is None:
        return said + "."
    each = zip(DOFS, units, force.swell, strict=True)
    swell = ", ".join(f"{size:.2g} {unit} in {name}" for name, unit, size in each if size > 0)
    return f"{said}; and a swell of {force.period:.2g} s: {swell}."
