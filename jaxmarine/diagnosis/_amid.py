"""What disturbance the model stands amid: wider by a swell or a current where the logs ask for one."""

import dataclasses
from collections.abc import Callable, Sequence

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
    unlearned,
    with_current,
    with_swell,
)
from ._explanation import Beside, Member, Model
from ._workbench import FEW_STEPS, ROUGH, Workbench


def disturbed(bench: Workbench, model: Model) -> Model:
    """The model beside a disturbance of the usual size, along the path as measured."""
    fine = bench.fine
    return dataclasses.replace(
        model, beside=Beside(fine.begin, fine.path, unlearned(fine.begin)), cost=np.inf
    )


def refine_fully(bench: Workbench, model: Model) -> Model:
    """The model refined; raises `InputError` where the vehicle runs away along the logs."""
    (begun,) = suited(bench, [model])
    out = bench.likeliest(begun)
    if model.beside is not None and np.isfinite(out.cost):
        out = amid_more(bench, out)
    if not np.isfinite(out.cost):
        raise runaway(bench.data.logs[0].name, bench.vehicle.name)
    return out


def suited(bench: Workbench, models: Sequence[Model]) -> list[Model]:
    """Models with the file as it is, each beside the disturbance that suits it while that holds.

    Beside one that is too small the file's coefficients would bend until they mean nothing, and a refinement
    does not find back from there. As they are without a disturbance, and where the file has bent already.
    """
    if any(model.beside is None or model.z[: len(bench.base)].any() for model in models):
        return list(models)
    held = bench.refine_each([bench.frozen(model) for model in models], FEW_STEPS, ROUGH, 1)
    return [
        dataclasses.replace(one, frozen=model.frozen, cost=np.inf) if np.isfinite(one.cost) else model
        for one, model in zip(held, models, strict=True)
    ]


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
    amid = Beside(wider, beside.path, unlearned(wider))
    return bench.likeliest(dataclasses.replace(model, beside=amid))


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


def calmed(model: Model) -> Model:
    """The model beside its disturbance without the swell that it has."""
    assert model.beside is not None
    force, learned = model.beside.force, model.beside.covariance
    own = np.arange(len(force.axes))
    parts = np.append(own, [len(force.size) - 1] if force.flows else []).astype(int)
    some = {name: getattr(force, name)[parts] for name in ("size", "time", "frequency")}
    calm = dataclasses.replace(force, **some)
    kept = np.append(np.arange(2 * len(own)), np.arange(len(learned) - 2 * force.flows, len(learned)))
    beside = dataclasses.replace(model.beside, force=calm, covariance=learned[np.ix_(kept, kept)])
    return dataclasses.replace(model, beside=beside)
