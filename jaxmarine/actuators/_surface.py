"""Control surfaces: rudders, fins, planes and skegs."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float
from pydantic import Field

from .._tables import Number, Table, Triple, pair, unit_direction, usable_name
from .._types import Wrench
from ..physics import UNLIMITED, Drive
from ._base import AbstractActuators, Flow, Stream, along, at_point, servo, stacked

# A deflection [rad] at which none stands: one that is stuck nowhere, and a rate that is not limited.
FREE = 10.0
# Race and wake are mixed by their squares; below this speed [m/s] the root of that is made smooth.
_SLOW = 1e-3
_OF_HULL = ("steering_deduction", "lift_increase", "lift_position")


class SlipstreamTable(Table):
    """Of a surface in a propeller's slipstream."""

    share: Number = Field(default=1.0, ge=0, le=1, description="a number from 0 to 1, eta")
    gain: Number = Field(default=0.5, ge=0, description="a number not below zero, kappa")
    wake_ratio: Number = Field(default=1.0, gt=0, description="a positive number, epsilon")


class HullTable(Table):
    """What a hull makes of its rudder's force and flow."""

    steering_deduction: Number = Field(default=0.0, lt=1, description="a number below 1, t_R")
    lift_increase: Number = Field(default=0.0, description="a number, a_H")
    lift_position: Number = Field(default=0.0, description="a number, x_H [m]")
    straightening: Annotated[tuple[float, float], pydantic.BeforeValidator(pair)] = Field(
        default=(1.0, 1.0),
        description="2 numbers, gamma where the flow at the rudder goes to port and to starboard",
    )
    arm: Number | None = Field(default=None, description="a number, l_R [m]; left out, the position's x")


class SurfaceTable(Table):
    """A rudder, fin or plane with a column of its name that holds its deflection [rad]; or a skeg."""

    name: str = Field(description="the name of the surface and of its command column, in quotes")
    position: Triple = Field(description="[x, y, z] of the centre of pressure from `o` [m]")
    axis: Triple = Field(description="[x, y, z], not zero: the stock, about which it turns right-handed")
    chord: Triple = Field(
        default=(1.0, 0.0, 0.0),
        description="[x, y, z], not zero: from trailing to leading edge at deflection 0",
    )
    area: Number = Field(gt=0, description="a positive number [m²]")
    lift_slope: Number | None = Field(default=None, gt=0, description="a positive number [1/rad]")
    aspect_ratio: Number | None = Field(default=None, gt=0, description="a positive number")
    behind: str | None = Field(default=None, description="the name of a propeller, in quotes")
    slipstream: SlipstreamTable | None = Field(
        default=None, description="a table with share, gain and wake_ratio"
    )
    hull: HullTable | None = Field(
        default=None,
        description="a table with steering_deduction, lift_increase, lift_position, straightening and arm",
    )
    max_angle: Number = Field(
        default=math.pi / 2, gt=0, le=math.pi, description="a positive number up to pi [rad]"
    )
    max_rate: Number | None = Field(default=None, gt=0, description="a positive number [rad/s]")
    lag: Number = Field(default=0.0, ge=0, description="a number not below zero [s]")
    delay: Number = Field(default=0.0, ge=0, description="a number not below zero [s]")
    fixed: bool = Field(
        default=False, strict=True, description="true for a skeg", exclude_if=lambda fixed: not fixed
    )

    _usable_name = pydantic.field_validator("name")(usable_name)
    _unit_direction = pydantic.field_validator("axis", "chord")(unit_direction)

    @pydantic.model_validator(mode="after")
    def _has_a_slope(self) -> "SurfaceTable":
        if (self.lift_slope is None) == (self.aspect_ratio is None):
            raise ValueError("needs one of `lift_slope` [1/rad] and `aspect_ratio`; give either.")
        return self

    @pydantic.model_validator(mode="after")
    def _turns_about_its_span(self) -> "SurfaceTable":
        if abs(np.dot(self.axis, self.chord)) > 1e-6:
            raise ValueError("has a `chord` that is not at right angles to its `axis`; correct one of them.")
        return self

    @pydantic.model_validator(mode="after")
    def _lies_behind(self) -> "SurfaceTable":
        if self.slipstream is not None and self.behind is None:
            raise ValueError("has a `slipstream` without `behind`; name the propeller whose it is.")
        return self

    @property
    def slope(self) -> float:
        """Lift per angle of attack at small angles [1/rad]; by aspect ratio after Fujii and Tuda (1961)."""
        if self.lift_slope is not None:
            return self.lift_slope
        ratio = self.aspect_ratio or 0.0
        return 6.13 * ratio / (ratio + 2.25)


class Surfaces(AbstractActuators):
    r"""Normal force of surfaces, $F_N = \frac12 \rho A U_R^2 f_\alpha \sin\alpha$.

    With u_R along the chord, v_R across it (towards $axis \times chord$) the speeds of the surface through
    the water, $\alpha = \delta - atan(v_R / u_R)$ and $U_R^2 = u_R^2 + v_R^2$; written without the angle,
    $F_N \sim U_R (u_R \sin\delta - v_R \cos\delta)$, so that rest is regular. It acts across the turned
    chord, its part along the chord less by `steering_deduction`, its part across more by `lift_increase`,
    which acts at x = `lift_position`. v_R is that at x = `arm` times `straightening`: its first number where
    the flow at the rudder goes to port (v + arm r negative), its second where it goes to starboard.

    In the stream of a propeller u_R is by epsilon (`wake_ratio`) and eta (`share`) the root mean square of
    the wake u_P and of the race u_P + kappa (sqrt(u_P² + 8 K_T n² D² / pi) - u_P), kappa the `race`; where it
    gives no thrust, epsilon u_P.

    `gain` is a factor of the force, `offset` [rad] adds to the deflection, `stuck` [rad] stands in its place
    (`FREE`: nowhere).

    Source: after Yasukawa and Yoshimura (2015), J. Mar. Sci. Technol. 20, 37-52.
    """

    key: ClassVar[str] = "surface"
    title: ClassVar[str] = "Control surfaces"
    table: ClassVar[type[Table]] = SurfaceTable
    told: ClassVar[tuple[str, ...]] = ("lift_slope",)
    positive: ClassVar[tuple[str, ...]] = ("lift_slope",)

    position: Float[Array, "surfaces 3"]
    axis: Float[Array, "surfaces 3"]
    chord: Float[Array, "surfaces 3"]
    area: Float[Array, " surfaces"]
    lift_slope: Float[Array, " surfaces"]
    share: Float[Array, " surfaces"]
    race: Float[Array, " surfaces"]
    wake_ratio: Float[Array, " surfaces"]
    steering_deduction: Float[Array, " surfaces"]
    lift_increase: Float[Array, " surfaces"]
    lift_position: Float[Array, " surfaces"]
    straightening: Float[Array, "surfaces 2"]
    arm: Float[Array, " surfaces"]
    max_angle: Float[Array, " surfaces"]
    max_rate: Float[Array, " surfaces"]
    lag: Float[Array, " surfaces"]
    delay: Float[Array, " surfaces"]
    gain: Float[Array, " surfaces"]
    offset: Float[Array, " surfaces"]
    stuck: Float[Array, " surfaces"]
    names: tuple[str, ...] = eqx.field(static=True)
    behind: tuple[str | None, ...] = eqx.field(static=True)
    fixed: tuple[bool, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        streams = [one.slipstream or SlipstreamTable(gain=0.0) for one in tables]
        hulls = [one.hull or HullTable() for one in tables]
        arms = [h.arm if h.arm is not None else one.position[0] for h, one in zip(hulls, tables, strict=True)]
        zero = jnp.zeros(len(tables))
        return cls(
            **{name: stacked(tables, name, 3) for name in ("position", "axis", "chord")},
            **{name: stacked(tables, name) for name in ("area", "max_angle", "lag", "delay")},
            lift_slope=stacked(tables, "slope"),
            share=stacked(streams, "share"),
            race=stacked(streams, "gain"),
            wake_ratio=stacked(streams, "wake_ratio"),
            **{name: stacked(hulls, name) for name in _OF_HULL},
            straightening=stacked(hulls, "straightening", 2),
            arm=jnp.asarray(np.array(arms, float)),
            max_rate=jnp.asarray(np.array([UNLIMITED if t.max_rate is None else t.max_rate for t in tables])),
            gain=zero + 1.0,
            offset=zero,
            stuck=zero + FREE,
            names=tuple(one.name for one in tables),
            behind=tuple(one.behind for one in tables),
            fixed=tuple(one.fixed for one in tables),
        )

    def tables(self) -> list[dict[str, Any]]:
        out = []
        for i, name in enumerate(self.names):

            def told(*keys, i=i):
                return {key: np.asarray(getattr(self, key)[i]).tolist() for key in keys}

            table = {"name": name} | told("position", "axis", "chord", "area", "lift_slope", "max_angle")
            table |= {"behind": self.behind[i], "fixed": self.fixed[i]} | told("lag", "delay")
            hull = told(*_OF_HULL, "straightening", "arm")
            if hull["arm"] == table["position"][0]:
                del hull["arm"]
            plain = HullTable(arm=hull.get("arm"))
            table["hull"] = None if HullTable(**hull) == plain and "arm" not in hull else hull
            if self.behind[i] is not None:
                stream = told("share", "race", "wake_ratio")
                table["slipstream"] = {"gain": stream.pop("race")} | stream
            rate = float(self.max_rate[i])
            table["max_rate"] = rate if rate < UNLIMITED else None
            out.append(table)
        return out

    @property
    def _moving(self) -> np.ndarray:
        return np.flatnonzero(~np.array(self.fixed, bool))

    @property
    def columns(self) -> tuple[str, ...]:
        return tuple(self.names[i] for i in self._moving)

    @property
    def units(self) -> tuple[str, ...]:
        return ("rad",) * len(self._moving)

    @property
    def limits(self) -> Float[np.ndarray, " columns"]:
        """Beyond `max_angle` a command is one that is not reached; beyond half a turn it is no deflection."""
        return np.full(len(self._moving), math.pi)

    @property
    def usual(self) -> Float[np.ndarray, "columns 2"]:
        # Up to where most stall, and less where they turn less.
        return np.outer(np.minimum(0.6, np.asarray(self.max_angle)[self._moving]), [-1.0, 1.0])

    def servo(self) -> Drive:
        numbers = (self.max_angle, self.delay, self.lag, self.max_rate)
        return servo(*(one[self._moving] for one in numbers))

    def streams(self, state: Float[Array, " columns"], flow: Flow) -> dict[str, Stream]:
        del state, flow
        return {}

    def _deflection(self, state: Float[Array, " columns"]) -> Float[Array, " surfaces"]:
        place = {int(i): k for k, i in enumerate(self._moving)}
        zero = jnp.zeros_like(self.area[0])
        angles = jnp.stack([state[place[i]] if i in place else zero for i in range(len(self.names))])
        return jnp.where(jnp.abs(self.stuck) < FREE, self.stuck, angles + self.offset)

    def _speed(self, flow: Flow) -> Float[Array, " surfaces"]:
        """u_R: speed through the water along the chord, in the stream of a propeller or without [m/s]."""
        own = along(at_point(flow.nu_r, self.position), self.chord)
        behind = [None if name is None else flow.streams[name] for name in self.behind]
        wake = jnp.stack([own[i] if b is None else b.inflow for i, b in enumerate(behind)])
        none = jnp.zeros_like(own[0])
        loading = jnp.stack([none if b is None else b.loading for b in behind])
        loaded = loading > 0.0
        raised = jnp.sqrt(jnp.where(loaded, wake**2 + loading, 1.0))
        race = wake + self.race * jnp.where(loaded, raised - jnp.abs(wake), 0.0)
        mixed = self.share * race * jnp.abs(race) + (1.0 - self.share) * wake * jnp.abs(wake)
        # Without a race all is the wake, to the last bit.
        mixed = jnp.where(loaded, mixed / jnp.sqrt(jnp.abs(mixed) + _SLOW**2), wake)
        return self.wake_ratio * mixed

    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        across = jnp.cross(self.axis, self.chord)
        x, y, z = self.position.T
        there = at_point(flow.nu_r, jnp.stack([self.arm, y, z], axis=1))
        v = along(there, across)
        to_port = jnp.where(across[:, 1] < 0.0, -v, v) < 0.0
        v = jnp.where(to_port, self.straightening[:, 0], self.straightening[:, 1]) * v
        u = self._speed(flow)
        squared = u**2 + v**2
        moving = squared > 0.0
        speed = jnp.where(moving, jnp.sqrt(jnp.where(moving, squared, 1.0)), 0.0)
        delta = self._deflection(state)
        sin, cos = jnp.sin(delta), jnp.cos(delta)
        normal = 0.5 * flow.density * self.area * self.lift_slope * self.gain * speed * (u * sin - v * cos)
        sideways = (normal * cos)[:, None] * across
        own = sideways - ((1.0 - self.steering_deduction) * normal * sin)[:, None] * self.chord
        hull = self.lift_increase[:, None] * sideways
        zero = jnp.zeros_like(x)
        at_hull = jnp.stack([self.lift_position, zero, zero], axis=1)
        moment = jnp.cross(self.position, own) + jnp.cross(at_hull, hull)
        return jnp.concatenate([(own + hull).sum(0), moment.sum(0)])
