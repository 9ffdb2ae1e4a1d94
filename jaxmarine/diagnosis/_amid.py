"""What disturbance the model stands amid: wider by a swell or a current where the logs ask for one."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from .._errors import runaway
from ..effects import WaterEffect
from ..fitting import (
    USUAL_MEMORY,
    Disturbance,
    count_of,
    improbability,
    start_spread,
    with_current,
    with_swell,
)
from ._explanation import Beside, Member, Model
from ._workbench import Workbench

# Variance of the logarithms of sizes and memories before anything is known of them: steps of a half.
UNLEARNED = 0.25


def disturbed(bench: Workbench, model: Model) -> Model:
    """The model beside a disturbance of the usual size, along the path as measured."""
    fine = bench.fine
    learned = UNLEARNED * np.eye(count_of(fine.begin))
    return dataclasses.replace(model, beside=Beside(fine.begin, fine.path, learned), cost=np.inf)


def refine_fully(bench: Workbench, model: Model) -> Model:
    """The model refined; raises `InputError` where the vehicle runs away along the logs."""
    out = bench.likeliest(model)
    if model.beside is not None and np.isfinite(out.cost):
        out = amid_more(bench, out)
    if not np.isfinite(out.cost):
        raise runaway(bench.data.logs[0].name, bench.vehicle.name)
    return out


def amid_more(bench: Workbench, model: Model, steady: bool = True) -> Model:
    """The model beside a swell and a current too, where the logs are likelier so by the odds of a name.

    Each of their numbers is paid for as a name's are (Schwarz). As it is without a disturbance.

    - `steady`: leaves a current that suits the logs better where it is steady to its name; False asks
      once more for that current alone.
    """
    if model.beside is None:
        return model
    force, left = model.beside.force, []
    if steady and not force.swells:
        left.append(with_swell)
    if not force.flows and {0, 1} & set(force.axes):
        left.append(with_current)
    while left:
        amid = [widened(bench, model, one) for one in left]
        priced = [one.cost + price(bench, one) for one in amid]
        best = int(np.argmin(np.nan_to_num(priced, nan=np.inf)))
        if not priced[best] < model.cost + price(bench, model) - bench.criteria.nats:
            break
        if left.pop(best) is with_current:
            # One that wanders can stand for one that is steady, which is a cause with a name.
            named = [bench.likeliest(one).cost for one in _in_currents(bench, model)] if steady else []
            if min(named, default=np.inf) < amid[best].cost:
                continue
        model = amid[best]
    return model


def price(bench: Workbench, model: Model) -> float:
    """Nats that the numbers of a model's disturbance must pay for (Schwarz)."""
    if model.beside is None:
        return 0.0
    return 0.5 * count_of(model.beside.force) * float(np.log(bench.samples))


def widened(bench: Workbench, model: Model, with_one: Callable[..., Disturbance | None]) -> Model:
    """The model beside a wider disturbance, refined; as it is where that is no likelier to begin with."""
    beside = model.beside
    assert beside is not None
    problem, every = bench.lines(model, beside)
    spread = start_spread(problem.start_precision)
    unit = bench.fine.unit
    worth = float(improbability(spread, every, [beside.force], unit)[0])
    wider = with_one(spread, every, beside.force, unit, worth)
    if wider is None:
        return model
    unlearned = UNLEARNED * np.eye(count_of(wider))
    return bench.likeliest(dataclasses.replace(model, beside=Beside(wider, beside.path, unlearned)))


def _in_currents(bench: Workbench, model: Model) -> list[Model]:
    """The model with each steady motion of the water that it does not have."""
    water = [i for i in bench.open(model) if issubclass(bench.layout.suspects[i].effect, WaterEffect)]
    return [bench.with_member(model, Member(i), np.zeros(bench.layout.columns[i].shape[1])) for i in water]


def hurried(model: Model) -> Model:
    """The model beside a disturbance that forgets no slower than is usual, and changes as it did."""
    assert model.beside is not None
    force = model.beside.force
    slow = (force.frequency == 0) & (force.time > USUAL_MEMORY.median)
    slow = slow.at[len(force.axes) :].set(False)
    time = jnp.where(slow, USUAL_MEMORY.median, force.time)
    quick = dataclasses.replace(force, size=force.size * jnp.sqrt(time / force.time), time=time)
    return dataclasses.replace(model, beside=dataclasses.replace(model.beside, force=quick))
