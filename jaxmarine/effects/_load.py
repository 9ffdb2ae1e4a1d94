"""Stage inertia: what the vehicle carries, its masses, weight and buoyancy."""

import dataclasses
from typing import Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import DOFS, Scalar
from ..physics import Load, rigid_body_matrix, skew
from ._base import Craft, LoadEffect, Suspect, free, per_dof, scalar, zeros


class AddedMass(LoadEffect):
    """More added mass on one axis, with its Coriolis terms. Neutral: 0. Source: after Fossen (2021)."""

    name = "added_mass"
    units = {"value": "kg or kg m²"}
    confused_with = ("payload", "thruster_gain:all")
    shown_by = "strong accelerations along that axis"
    advice = "entrained water, fouling or a wrong coefficient: added mass of that axis"

    value: Float[Array, "6"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(6))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return per_dof(cls, craft)

    def __call__(self, load: Load) -> Load:
        return dataclasses.replace(load, added=load.added + jnp.diag(self.value))


# Axes whose added masses a hull joins that is alike on port and starboard. Source: after Fossen (2021).
_PAIRS = (
    ("surge", "heave"),
    ("surge", "pitch"),
    ("heave", "pitch"),
    ("sway", "roll"),
    ("sway", "yaw"),
    ("roll", "yaw"),
)
_ROWS, _COLUMNS = np.array([[DOFS.index(dof) for dof in pair] for pair in _PAIRS]).T
# The same as a pattern of a matrix, its diagonal included.
JOINED = np.eye(6, dtype=bool)
JOINED[_ROWS, _COLUMNS] = JOINED[_COLUMNS, _ROWS] = True


class CoupledAddedMass(LoadEffect):
    """More added mass between two axes, in both rows of the matrix, with its Coriolis terms. Neutral: 0.

    Only between axes that a hull joins which is alike on port and starboard. Source: after Fossen (2021).
    """

    name = "coupled_added_mass"
    units = {"value": "kg, kg m or kg m²"}
    confused_with = ("payload", "coupled_damping", "velocity_lever_arm")
    shown_by = "strong accelerations along one axis while the other is free"
    advice = "the water's mass lies off where the file has it: look at trim, draught and appendages"

    value: Float[Array, "6"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(len(_PAIRS)))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return tuple(
            Suspect(cls, "+".join(pair), {"value": (i,)})
            for i, pair in enumerate(_PAIRS)
            if {*pair} <= {*craft.dof}
        )

    def __call__(self, load: Load) -> Load:
        more = jnp.zeros((6, 6), self.value.dtype).at[_ROWS, _COLUMNS].set(self.value)
        return dataclasses.replace(load, added=load.added + more + more.T)


class Payload(LoadEffect):
    """A point body of `mass` and `volume` fixed at (x, y, z) from `o`. Neutral: no mass, no volume.

    It adds rigid mass with its lever arms, weight and buoyancy, no added mass.
    Source: parallel axes, after Fossen (2021).
    """

    name = "payload"
    units = {"mass": "kg", "volume": "m³", "x": "m", "y": "m", "z": "m"}
    confused_with = ("buoyancy", "trim", "added_mass", "constant_wrench")
    shown_by = "strong accelerations and changes of roll and pitch"
    advice = "weigh the vehicle: something has been added or lost at that place"

    mass: Scalar
    volume: Scalar
    x: Scalar
    y: Scalar
    z: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(*(scalar() for _ in range(5)))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        names = ["mass", "x", "y"]
        if free(craft, "heave", "roll", "pitch"):
            names = ["mass", "volume", "x", "y", "z"]
        slots = {name: (list(cls.units).index(name),) for name in names}
        # Without a mass its place has no slope. Neutrally buoyant, or the weight would hide the place.
        body = {"mass": 1.0, "volume": 1e-3}
        starts = ({**body, "x": 0.3}, {**body, "x": -0.3}, {**body, "y": 0.2}, {**body, "y": -0.2})
        filled = tuple({name: start.get(name, 0.0) for name in names} for start in starts)
        return (Suspect(cls, None, slots, filled),)

    def __call__(self, load: Load) -> Load:
        place = jnp.stack([self.x, self.y, self.z])
        inertia = -self.mass * skew(place) @ skew(place)
        displaced = load.density * self.volume
        return dataclasses.replace(
            load,
            rigid=load.rigid + rigid_body_matrix(self.mass, inertia, place),
            weight=load.weight + self.mass * load.gravity,
            weight_moment=load.weight_moment + self.mass * load.gravity * place,
            buoyancy=load.buoyancy + displaced * load.gravity,
            buoyancy_moment=load.buoyancy_moment + displaced * load.gravity * place,
        )


class Buoyancy(LoadEffect):
    """More buoyancy than the file says, `force` up at the centre of buoyancy. Neutral: 0.

    Source: after Fossen (2021).
    """

    name = "buoyancy"
    units = {"force": "N"}
    confused_with = ("payload", "constant_wrench:heave")
    shown_by = (
        "roll and pitch of some tens of degrees: a force in earth axes turns, one in body axes does not"
    )
    advice = "trim the ballast: the vehicle is lighter or heavier than the file says (salinity, foam, leak)"

    force: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return (Suspect(cls, None, {"force": (0,)}),) if free(craft, "heave") else ()

    def __call__(self, load: Load) -> Load:
        # A vehicle without buoyancy has no centre of it; the force then acts at `o`.
        whole = jnp.where(load.buoyancy == 0.0, 1.0, load.buoyancy)
        return dataclasses.replace(
            load,
            buoyancy=load.buoyancy + self.force,
            buoyancy_moment=load.buoyancy_moment * (1.0 + self.force / whole),
        )


class Trim(LoadEffect):
    """The centre of buoyancy lies elsewhere, by (x, y, z). Neutral: 0. Source: after Fossen (2021).

    Only the moment of weight and buoyancy about `o` shows: a shift of the centre of gravity looks the same.
    """

    name = "trim"
    units = {"x": "m", "y": "m", "z": "m"}
    confused_with = ("payload", "constant_wrench:roll", "constant_wrench:pitch")
    shown_by = "rest, and roll and pitch of some tens of degrees"
    advice = "check where foam and ballast sit: the centre of buoyancy has moved against that of gravity"

    x: Scalar
    y: Scalar
    z: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(), scalar(), scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        roll, pitch = free(craft, "roll"), free(craft, "pitch")
        wanted = {"x": pitch, "y": roll, "z": roll or pitch}
        slots = {name: (i,) for i, name in enumerate("xyz") if wanted[name]}
        return (Suspect(cls, None, slots),) if slots else ()

    def __call__(self, load: Load) -> Load:
        shift = jnp.stack([self.x, self.y, self.z])
        return dataclasses.replace(load, buoyancy_moment=load.buoyancy_moment + load.buoyancy * shift)
