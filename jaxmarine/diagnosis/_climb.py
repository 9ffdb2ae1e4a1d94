"""Climbing staircases: what is shown at a sample changes by steps with some parameters, a delay above all."""

import dataclasses
import itertools

import numpy as np

from ._explanation import Model
from ._workbench import EXACT, LIKELIER, Workbench

# Steps of a staircase that are climbed at most: 2 s of delay at 10 Hz.
STAIRS = 20
# Of a step: how far beyond its edge the next one is entered, and what rounding makes of an edge.
BEYOND = 0.01
ROUNDED = 1e-9


def climbed(
    bench: Workbench, model: Model, max_steps: int = 25, rtol: float = EXACT, last: bool = False
) -> Model:
    """A refined model with what is a staircase on the step that costs least.

    What is shown at a sample changes by steps with some parameters; no slope leads from one to the next.

    - `last`: of the last member alone.
    """
    stairs = [
        where.start + list(suspect.slots).index(name)
        for member, where in zip(model.members, bench.slices(model.members), strict=True)
        for suspect in [bench.layout.suspects[member.suspect]]
        for name in suspect.effect.stairs
        if not last or member is model.members[-1]
    ]
    if not stairs:
        return model
    dt = float(np.median([log.dt for log in bench.data.logs]))
    own = np.unique(bench.vehicle.plant().drive.delay)
    filed = float(own[0]) if len(own) == 1 else 0.0
    spacing = np.concatenate([np.diff(log.t) for log in bench.data.logs])
    uneven = len(own) > 1 or bool((np.abs(spacing - dt) > BEYOND * dt).any())
    # What is least on a step often lies at its edge: one enters the next where it begins, as from its
    # middle a refinement may come back over the edge. Where these are uneven a whole sample may lead on.
    for place, up in itertools.product(stairs, (1, -1)):
        for _ in range(STAIRS):
            step = np.ceil((filed + model.z[place]) / dt - ROUNDED)
            edge = (step + BEYOND if up > 0 else step - 1.0 - BEYOND) * dt - filed
            moved = (
                dataclasses.replace(model, z=np.where(np.arange(len(model.z)) == place, goal, model.z))
                for goal in (edge, model.z[place] + up * dt)[: 1 + uneven]
                if filed + goal >= 0
            )
            tried = (bench.refine(one, max_steps, rtol) for one in moved)
            less = (o for o in tried if o.cost < model.cost - LIKELIER and bench.sound(o))
            better = next(less, None)
            if better is None:
                break
            model = better
    return model
