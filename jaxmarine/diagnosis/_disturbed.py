"""What disturbs a craft, as it was estimated, and in words."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from .._compiled import compiled
from .._types import DOFS
from ..disturbances import RandomWrench
from ..fitting import PLANE, Disturbance
from ..vehicle import Input, Plant, State, Vehicle
from ._explanation import Model
from ._result import MissingWrench
from ._workbench import Workbench


def known(force: Disturbance) -> RandomWrench:
    """What the filter estimated of a disturbance, without the windows along which it did."""
    axes, parts = np.array(force.axes), force.parts
    size, memory = np.asarray(force.size), np.asarray(force.time)

    def on_all(values) -> np.ndarray:
        out = np.zeros(6)
        out[axes] = values
        return out

    out = RandomWrench(on_all(size[parts.own]), on_all(memory[parts.own]))
    if force.swell is not None:
        swell, period = on_all(size[parts.swell]), 2 * np.pi / float(force.swell.frequency)
        out = dataclasses.replace(out, swell=swell, period=period, swell_memory=float(force.swell.time))
    if force.drifts:
        drift = {"drift": size[parts.drift].item(), "drift_memory": memory[parts.drift].item()}
        out = dataclasses.replace(out, **drift)
    if force.flows:
        current = {"current": size[parts.current].item(), "current_memory": memory[parts.current].item()}
        out = dataclasses.replace(out, **current)
    return out


def without_current(
    missing: MissingWrench, bench: Workbench, model: Model, vehicle: Vehicle
) -> MissingWrench:
    """The missing wrench without what the current does to the hull beside which a model stands.

    That is as the current was expected by all that was measured before, along the motion that was measured.
    It takes away what is missing in its direction, no more: windows that begin with any sway hide a part.

    - `vehicle`: that on which it acts.
    """
    places = bench.places
    if model.beside is None or not model.beside.force.flows:
        return missing
    parts = bench.fine.parts
    level = np.asarray(model.beside.path.push)[: bench.fine.count, -PLANE:]
    level = np.repeat(level, places.t.shape[1] // parts, axis=0)
    water = np.pad(level, ((0, 0), (0, 1)))
    turns = Rotation.from_matrix(places.rotation.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    drag = np.asarray(_dragged(vehicle.plant(), turns, places.velocity.reshape(-1, 6), water))
    sign = np.sign(missing.wrench)
    left = np.abs(missing.wrench) - np.clip(sign * drag, 0.0, np.abs(missing.wrench))
    return dataclasses.replace(missing, wrench=sign * left)


@compiled
def _dragged(plant: Plant, attitude, velocity, water) -> Float[Array, "times 6"]:
    """The wrench that moving water adds; thrusters at rest."""
    columns = plant.drive.max_thrust.shape[-1]
    still = Input(jnp.zeros(columns), jnp.zeros(columns), jnp.zeros(6), jnp.zeros(()))

    def one(attitude, velocity, water):
        state = State(jnp.zeros(3), attitude, velocity, jnp.zeros(6 * len(plant.memories)))
        flowing = dataclasses.replace(still, water=water)
        return plant.balance(state, jnp.zeros(6), still) - plant.balance(state, jnp.zeros(6), flowing)

    return jax.vmap(one)(attitude, velocity, water)


def in_words(force: RandomWrench) -> str:
    """Sizes and memories of a disturbance, axis by axis, its swell, drift and current, in a sentence."""
    units = ["N" if axis < 3 else "N m" for axis in range(6)]
    pushes = ", ".join(
        f"{size:.2g} {unit} in {name} with a memory of {memory:.2g} s"
        for name, unit, size, memory in zip(DOFS, units, force.size, force.memory, strict=True)
        if size > 0
    )
    said = f"What disturbs the craft besides was estimated (standard deviations): {pushes}"
    if force.period is not None:
        each = zip(DOFS, units, force.swell, strict=True)
        swell = ", ".join(f"{size:.2g} {unit} in {name}" for name, unit, size in each if size > 0)
        said += f"; and a swell of {force.period:.2g} s: {swell}"
    if force.drift_memory is not None:
        said += (
            f"; and a force that keeps its direction as the craft turns, {force.drift:.2g} N to the north "
            f"and to the east with a memory of {force.drift_memory:.2g} s"
        )
    if force.current_memory is not None:
        said += (
            f"; and a current that wanders by {force.current:.2g} m/s to the north and to the east with a "
            f"memory of {force.current_memory:.2g} s"
        )
    return f"{said}."
