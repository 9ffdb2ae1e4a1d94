"""Propellers whose shaft speed is commanded."""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float
from pydantic import Field

from .._tables import Number, Table, Triple, unit_direction, usable_name
from .._types import Wrench
from ..physics import Drive
from ._base import AbstractActuators, Flow, Stream, along, at_point, servo, stacked
from ._swivel import AZIMUTH, turned

_OPEN_WATER = "3 numbers [k0, k1, k2] of k0 + k1 J + k2 J²"
# Below this speed [m/s] a flow has no direction of its own.
_SLOW = 1e-6


class PropellerTable(Table):
    """A propeller with a column of its name that holds its shaft speed [rev/s]."""

    name: str = Field(description="the name of the propeller's command column, in quotes")
    position: Triple = Field(description="[x, y, z] from `o` [m]")
    direction: Triple = Field(description="[x, y, z], not zero: where positive shaft speed pushes")
    diameter: Number = Field(gt=0, description="a positive number [m]")
    kt: Triple = Field(description=f"{_OPEN_WATER}, the thrust coefficient")
    kt_reverse: Triple | None = Field(default=None, description=f"{_OPEN_WATER}, at negative shaft speed")
    kq: Triple = Field(
        default=(0.0, 0.0, 0.0),
        description=f"{_OPEN_WATER}, the torque coefficient",
        exclude_if=lambda kq: not any(kq),
    )
    wake_fraction: Number = Field(default=0.0, lt=1, description="a number below 1")
    wake_decay: Number = Field(
        default=0.0, ge=0, description="a number not below zero", exclude_if=lambda decay: decay == 0.0
    )
    wake_arm: Number | None = Field(default=None, description="a number, x_P [m]; left out, the position's x")
    thrust_deduction: Number = Field(default=0.0, lt=1, description="a number below 1")
    astern_side_force: Number = Field(
        default=0.0, description="a number, share of the thrust", exclude_if=lambda share: share == 0.0
    )
    max_speed: Number = Field(gt=0, description="a positive number [rev/s]")
    swivel: Triple | None = Field(
        default=None, description="[x, y, z], not zero: the axis about which its direction turns"
    )
    lag: Number = Field(default=0.0, ge=0, description="a number not below zero [s]")
    delay: Number = Field(default=0.0, ge=0, description="a number not below zero [s]")

    _usable_name = pydantic.field_validator("name")(usable_name)
    _unit_direction = pydantic.field_validator("direction")(unit_direction)

    @pydantic.field_validator("swivel")
    @classmethod
    def _unit_axis(cls, swivel: Triple | None) -> tuple[float, ...] | None:
        return None if swivel is None else unit_direction(swivel)

    @pydantic.field_validator("kt")
    @classmethod
    def _pushes(cls, kt: Triple) -> Triple:
        if kt[0] <= 0:
            raise ValueError(f"must begin with a positive number, the pull at rest, but that is {kt[0]:g}.")
        return kt


class Propellers(AbstractActuators):
    """Thrust by shaft speed n [rev/s] and speed of advance V [m/s].

    T = rho D^4 (k0 n² + k1 n V / D + k2 V² / D²) ahead, rho D^4 n² K_T(J) written without J = V / (n D), so
    that n = 0 is regular; V = (1 - wake_fraction) times the speed of the propeller through the water along
    `direction`, and the hull feels (1 - thrust_deduction) T. Astern it is -rho D^4 (k0 n² + k1 |n| V / D +
    k2 V² / D²) by `kt_reverse`, of V without wake, all of it on the hull, and a force to starboard of the
    share `astern_side_force` of it. The shaft's torque by `kq` turns the hull about `-direction`; astern by
    its number at rest alone. `gain` is a factor of all that. Those of `swivels` have a
    column `<name>_angle` [rad], by which `direction` turns right-handed about `axis`.

    Drift and turn take a propeller out of the hull's wake: that is wake_fraction exp(-wake_decay b²), with
    b = drift - wake_arm r / U [rad] the drift of the flow at x = `wake_arm`. None: no propeller has it.

    Source: after Yasukawa and Yoshimura (2015), J. Mar. Sci. Technol. 20, 37-52 (standard MMG
    method), and Fossen (2021); the wake in turns: after Hirano (1980), J. Soc. Nav. Archit. Japan 147, where
    wake_decay is 4.
    """

    key: ClassVar[str] = "propeller"
    title: ClassVar[str] = "Propellers"
    table: ClassVar[type[Table]] = PropellerTable
    told: ClassVar[tuple[str, ...]] = ("kt", "kt_reverse", "wake_fraction")
    positive: ClassVar[tuple[str, ...]] = ("kt", "kt_reverse")

    position: Float[Array, "propellers 3"]
    direction: Float[Array, "propellers 3"]
    diameter: Float[Array, " propellers"]
    kt: Float[Array, "propellers 3"]
    kt_reverse: Float[Array, "propellers 3"]
    kq: Float[Array, "propellers 3"]
    wake_fraction: Float[Array, " propellers"]
    thrust_deduction: Float[Array, " propellers"]
    astern_side_force: Float[Array, " propellers"]
    max_speed: Float[Array, " propellers"]
    lag: Float[Array, " propellers"]
    delay: Float[Array, " propellers"]
    gain: Float[Array, " propellers"]
    axis: Float[Array, "propellers 3"]
    wake_decay: Float[Array, " propellers"] | None
    wake_arm: Float[Array, " propellers"] | None
    names: tuple[str, ...] = eqx.field(static=True)
    swivels: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        vectors = {name: stacked(tables, name, 3) for name in ("position", "direction", "kt", "kq")}
        still = vectors["kt"] * jnp.array([[1.0, 0.0, 0.0]])
        stated = jnp.array([[one.kt_reverse is not None] for one in tables])
        reverse = jnp.where(stated, stacked(tables, "kt_reverse", 3), still)
        names = tuple(one.name for one in tables)
        numbers = {name: stacked(tables, name) for name in _NUMBERS}
        decays = any(one.wake_decay for one in tables)
        arms = [one.position[0] if one.wake_arm is None else one.wake_arm for one in tables]
        return cls(
            **vectors,
            **numbers,
            kt_reverse=reverse,
            gain=jnp.ones(len(names)),
            axis=stacked(tables, "swivel", 3),
            wake_decay=stacked(tables, "wake_decay") if decays else None,
            wake_arm=jnp.asarray(np.array(arms, float)) if decays else None,
            names=names,
            swivels=tuple(i for i, one in enumerate(tables) if one.swivel is not None),
        )

    def tables(self) -> list[dict[str, Any]]:
        out = []
        for i, name in enumerate(self.names):
            table = {key: np.asarray(getattr(self, key)[i]).tolist() for key in (*_NUMBERS, *_VECTORS)}
            if table["kt_reverse"] == [table["kt"][0], 0.0, 0.0]:
                del table["kt_reverse"]
            if self.wake_decay is not None and self.wake_arm is not None:
                table |= {"wake_decay": float(self.wake_decay[i]), "wake_arm": float(self.wake_arm[i])}
            if i in self.swivels:
                table["swivel"] = np.asarray(self.axis[i]).tolist()
            out.append({"name": name} | table)
        return out

    @property
    def columns(self) -> tuple[str, ...]:
        return *self.names, *(f"{self.names[i]}_angle" for i in self.swivels)

    @property
    def units(self) -> tuple[str, ...]:
        return ("rev/s",) * len(self.names) + ("rad",) * len(self.swivels)

    @property
    def limits(self) -> Float[np.ndarray, " columns"]:
        return np.append(self.max_speed, np.full(len(self.swivels), AZIMUTH))

    @property
    def usual(self) -> Float[np.ndarray, "columns 2"]:
        # Ahead, where propellers are at work.
        angles = np.outer(np.ones(len(self.swivels)), [-0.6, 0.6])
        return np.concatenate([np.outer(self.max_speed, [0.2, 0.9]), angles])

    def servo(self) -> Drive:
        zero = jnp.zeros(len(self.swivels))
        reach = jnp.concatenate([self.max_speed, zero + AZIMUTH])
        return servo(reach, jnp.concatenate([self.delay, zero]), jnp.concatenate([self.lag, zero]))

    def _directed(self, state: Float[Array, " columns"]) -> tuple[Array, Array]:
        """Shaft speeds, and where positive ones push."""
        count = len(self.names)
        n, angles = state[:count], state[count:]
        if not self.swivels:
            return n, self.direction
        place = {i: k for k, i in enumerate(self.swivels)}
        zero = jnp.zeros_like(n[0])
        all_angles = jnp.stack([angles[place[i]] if i in place else zero for i in range(count)])
        return n, turned(self.direction, self.axis, all_angles)

    def _advance(self, direction: Float[Array, "propellers 3"], flow: Flow) -> Float[Array, " propellers"]:
        """Speed through the water along the direction, without wake [m/s]."""
        return along(at_point(flow.nu_r, self.position), direction)

    def _wake(self, flow: Flow) -> Float[Array, " propellers"]:
        """Share of the speed that the hull takes from the water at the propeller."""
        if self.wake_decay is None or self.wake_arm is None:
            return self.wake_fraction
        u, v, r = flow.nu_r[0], flow.nu_r[1], flow.nu_r[5]
        squared = u**2 + v**2
        moving = squared > _SLOW**2
        speed = jnp.sqrt(jnp.where(moving, squared, _SLOW**2))
        drift = -jnp.arctan2(jnp.where(moving, v, 0.0), jnp.where(moving, jnp.abs(u), 1.0))
        return self.wake_fraction * jnp.exp(-self.wake_decay * (drift - self.wake_arm * r / speed) ** 2)

    def _ahead(
        self, k: Float[Array, "propellers 3"], n: Array, advance: Array
    ) -> Float[Array, " propellers"]:
        """k0 n² + k1 n V / D + k2 V² / D² [1/s²]."""
        pace = advance / self.diameter
        return k[:, 0] * n**2 + k[:, 1] * n * pace + k[:, 2] * pace**2

    def streams(self, state: Float[Array, " columns"], flow: Flow) -> dict[str, Stream]:
        n, direction = self._directed(state)
        inflow = (1.0 - self._wake(flow)) * self._advance(direction, flow)
        pull = self.gain * self._ahead(self.kt, n, inflow)
        pull = jnp.where((n > 0.0) & (pull > 0.0), pull, 0.0)
        loading = 8.0 / jnp.pi * self.diameter**2 * pull
        return {name: Stream(inflow[i], loading[i]) for i, name in enumerate(self.names)}

    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        n, direction = self._directed(state)
        advance = self._advance(direction, flow)
        slowed = (1.0 - self._wake(flow)) * advance
        astern = n < 0.0
        size = flow.density * self.diameter**4 * self.gain
        ahead = (1.0 - self.thrust_deduction) * self._ahead(self.kt, n, slowed)
        back = self._ahead(self.kt_reverse, jnp.abs(n), advance)
        thrust = size * jnp.where(astern, -back, ahead)
        turning = jnp.where(astern, -self.kq[:, 0] * n**2, self._ahead(self.kq, n, slowed))
        force = thrust[:, None] * direction
        side = size * jnp.where(astern, self.astern_side_force * jnp.abs(back), 0.0)
        force = force + side[:, None] * jnp.array([[0.0, 1.0, 0.0]])
        torque = (size * self.diameter * turning)[:, None] * direction
        moment = jnp.cross(self.position, force) - torque
        return jnp.concatenate([force.sum(0), moment.sum(0)])


_VECTORS = ("position", "direction", "kt", "kt_reverse", "kq")
_NUMBERS = ("diameter", "wake_fraction", "thrust_deduction", "astern_side_force", "max_speed", "lag", "delay")
