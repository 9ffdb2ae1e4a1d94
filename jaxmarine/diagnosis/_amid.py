"""Amid what a model stands: a disturbance, wider by a swell, a drift or a current where logs ask for one."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from .._errors import runaway
from ..effects import AbstractEffect, WaterEffect, WindPush
from ..fitting import (
    USUAL_MEMORY,
    Wider,
    count_of,
    improbability,
    likeliest_of,
    unlearned,
    wider_by,
    with_current,
    with_drift,
    without_swell,
)
from ._explanation import Beside, Member, Model
from ._saturated import Layout
from ._workbench import FEW_STEPS, ROUGH, Workbench

# Of what wanders, the cause that does the same and is steady.
STEADY: dict[Wider, type[AbstractEffect]] = {with_drift: WindPush, with_current: WaterEffect}


def steady_of(layout: Layout, wider: Sequence[Wider] = tuple(STEADY)) -> list[int]:
    """Suspects that are steady and do what one of some wider disturbances does while it wanders."""
    causes = tuple(STEADY[one] for one in wider)
    return [i for i, one in enumerate(layout.suspects) if issubclass(one.effect, causes)]


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
    """The model beside a swell, a drift and a current too, where logs are likelier so by the odds of a name.

    Each of their numbers is paid for as a name's are (Schwarz). As it is without a disturbance.

    - `steady`: leaves a drift or a current that suits the logs better where it is steady to its name; False
      asks once more for those alone.
    """
    if model.beside is None:
        return model
    left = [one for one in wider_by(model.beside.force) if steady or one in STEADY]
    amid, named = {one: widened(bench, model, one) for one in left}, None

    def priced(one: Wider) -> float:
        return float(np.nan_to_num(amid[one].cost + price(bench, amid[one]), nan=np.inf))

    while amid:
        best = min(amid, key=priced)
        if not priced(best) < model.cost + price(bench, model) - bench.criteria.nats:
            break
        wider = amid.pop(best)
        if best in STEADY and steady:
            # What wanders can stand for what is steady, which has a name: a drift for a current, too.
            named = _steadily(bench, model) if named is None else named
            if named < wider.cost:
                continue
        model, named = wider, None
        amid = {one: widened(bench, model, one) for one in amid}
    return model


def price(bench: Workbench, model: Model) -> float:
    """Nats that the numbers of a model's disturbance must pay for (Schwarz)."""
    if model.beside is None:
        return 0.0
    return 0.5 * count_of(model.beside.force) * float(np.log(bench.samples))


def widened(bench: Workbench, model: Model, with_one: Wider) -> Model:
    """The model beside a wider disturbance, refined; as it is where that is no likelier to begin with."""
    beside = model.beside
    assert beside is not None
    every, spread, unit = bench.lines(model), bench.spread, bench.fine.unit
    worth = float(improbability(spread, every, [beside.force], unit)[0])
    wider = likeliest_of(spread, every, with_one(beside.force), unit, worth)
    if wider is None:
        return model
    amid = Beside(wider, beside.path, unlearned(wider))
    return bench.likeliest(dataclasses.replace(model, beside=amid))


def _steadily(bench: Workbench, model: Model) -> float:
    """Least cost with one suspect more that is steady where a disturbance wanders; infinite without such."""
    columns, some = bench.layout.columns, [i for i in steady_of(bench.layout) if i in bench.open(model)]
    each = (bench.with_member(model, Member(i), np.zeros(columns[i].shape[1])) for i in some)
    return min((bench.likeliest(one).cost for one in each), default=np.inf)


def hurried(model: Model) -> Model:
    """The model beside forces that forget no slower than is usual, and change as they did."""
    assert model.beside is not None
    force = model.beside.force
    slow = (force.frequency == 0) & (force.time > USUAL_MEMORY.median)
    slow = slow.at[force.parts.current].set(False)
    time = jnp.where(slow, USUAL_MEMORY.median, force.time)
    quick = dataclasses.replace(force, size=force.size * jnp.sqrt(time / force.time), time=time)
    return dataclasses.replace(model, beside=dataclasses.replace(model.beside, force=quick))


def calmed(model: Model) -> Model:
    """The model beside its disturbance without the swell that it has."""
    assert model.beside is not None
    calm, learned = without_swell(model.beside.force, model.beside.covariance)
    return dataclasses.replace(
        model, beside=dataclasses.replace(model.beside, force=calm, covariance=learned)
    )
