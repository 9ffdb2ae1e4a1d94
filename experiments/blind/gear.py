"""What drives a craft beside fixed thrusters: propellers, rudders and fins, azimuths, wind; strip drag.

Forces after the standard MMG method (after Yasukawa and Yoshimura 2015) with angles as they stand
there, strip theory (after Faltinsen 1990) and harmonics of the apparent wind (Blendermann 1994). Arrays
hold the batch on the last axis.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

AIR = 1.225  # kg/m³
STRIPS = 400  # strips of the hull: their sum is within 1e-5 of the integral
TRIM = 0.5  # demand of what drives a craft with gear ahead: a rudder steers nothing at rest
EAGER = 0.6  # rad, deflection of a surface that a stick asks for at most


def crossed(a: Array, b: Array) -> Array:
    """a x b, of vectors along the first axis; `np.cross` takes half of a run of a craft with gear."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def wrench_at(r: Array, force: Array) -> Array:
    """A force (3, B) at a place (3,) as a wrench at o."""
    return np.concatenate([force, crossed(r, force)])


def flow_at(r: Array, nu: Array) -> Array:
    """Velocity (3, B) of a place of the craft."""
    return nu[:3] + crossed(nu[3:], r)


def turned(vector: Array, axis: Array, angle: Array) -> Array:
    """A vector (3,) turned right-handed about an axis by angles (B,), (3, B); Rodrigues."""
    v, a = vector[:, None], axis[:, None]
    return (
        v * np.cos(angle)
        + crossed(axis, vector)[:, None] * np.sin(angle)
        + a * (axis @ vector) * (1.0 - np.cos(angle))
    )


@dataclass
class Propeller:
    """One `[[propeller]]`."""

    name: str
    position: Array
    direction: Array
    diameter: float
    kt: Array
    kt_reverse: Array
    kq: Array
    wake: float
    deduction: float
    side: float
    most: float
    lag: float
    delay: float
    gain: float = 1.0

    @classmethod
    def of(cls, t: dict[str, Any]) -> "Propeller":
        kt = np.array(t["kt"], float)
        direction = np.array(t["direction"], float)
        return cls(
            t["name"],
            np.array(t["position"], float),
            direction / np.linalg.norm(direction),
            t["diameter"],
            kt,
            np.array(t.get("kt_reverse", [kt[0], 0.0, 0.0]), float),
            np.array(t.get("kq", [0.0, 0.0, 0.0]), float),
            t.get("wake_fraction", 0.0),
            t.get("thrust_deduction", 0.0),
            t.get("astern_side_force", 0.0),
            t["max_speed"],
            t.get("lag", 0.0),
            t.get("delay", 0.0),
        )

    def series(self, k: Array, n: Array, speed: Array) -> Array:
        """n² K(J) with J = speed / (n D), without a division by n."""
        pace = speed / self.diameter
        return k[0] * n**2 + k[1] * n * pace + k[2] * pace**2

    def race(self, n: Array, nu: Array) -> tuple[Array, Array]:
        """Speed of the water that comes to it, and 8 K_T n² D² / pi of its thrust where it gives some."""
        inflow = (1.0 - self.wake) * (self.direction @ flow_at(self.position, nu))
        pull = self.gain * self.series(self.kt, n, inflow) * self.diameter**2
        return inflow, np.where((n > 0.0) & (pull > 0.0), 8.0 / np.pi * pull, 0.0)

    def wrench(self, rho: float, n: Array, nu: Array) -> Array:
        speed = self.direction @ flow_at(self.position, nu)
        size = rho * self.diameter**4 * self.gain
        slow = (1.0 - self.wake) * speed
        ahead = (1.0 - self.deduction) * self.series(self.kt, n, slow)
        astern = self.series(self.kt_reverse, np.abs(n), speed)
        force = self.direction[:, None] * (size * np.where(n < 0.0, -astern, ahead))
        force[1] += np.where(n < 0.0, size * self.side * np.abs(astern), 0.0)
        torque = size * self.diameter * np.where(n < 0.0, -self.kq[0] * n**2, self.series(self.kq, n, slow))
        out = wrench_at(self.position, force)
        out[3:] -= self.direction[:, None] * torque
        return out


@dataclass
class Surface:
    """One `[[surface]]`."""

    name: str
    position: Array
    axis: Array
    chord: Array
    area: float
    slope: float
    behind: str | None
    share: float
    kappa: float
    epsilon: float
    deduction: float
    increase: float
    lift_x: float
    gamma: tuple[float, float]
    arm: float
    most: float
    rate: float
    lag: float
    delay: float
    fixed: bool
    gain: float = 1.0
    offset: float = 0.0
    stuck: float | None = None

    @classmethod
    def of(cls, t: dict[str, Any]) -> "Surface":
        axis, chord = np.array(t["axis"], float), np.array(t.get("chord", [1.0, 0.0, 0.0]), float)
        stream, hull = t.get("slipstream", {}), t.get("hull", {})
        ratio = t.get("aspect_ratio", 0.0)
        return cls(
            t["name"],
            np.array(t["position"], float),
            axis / np.linalg.norm(axis),
            chord / np.linalg.norm(chord),
            t["area"],
            t.get("lift_slope", 6.13 * ratio / (ratio + 2.25)),
            t.get("behind"),
            stream.get("share", 1.0),
            stream.get("gain", 0.5 if "slipstream" in t else 0.0),
            stream.get("wake_ratio", 1.0),
            hull.get("steering_deduction", 0.0),
            hull.get("lift_increase", 0.0),
            hull.get("lift_position", 0.0),
            tuple(hull.get("straightening", (1.0, 1.0))),
            hull.get("arm", t["position"][0]),
            t.get("max_angle", math.pi / 2),
            t.get("max_rate", math.inf),
            t.get("lag", 0.0),
            t.get("delay", 0.0),
            t.get("fixed", False),
        )

    def wrench(self, rho: float, angle: Array, nu: Array, races: dict[str, tuple[Array, Array]]) -> Array:
        across = crossed(self.axis, self.chord)
        delta = angle + self.offset if self.stuck is None else np.full_like(angle, self.stuck)
        if self.behind is None:
            ahead = self.epsilon * (self.chord @ flow_at(self.position, nu))
        else:
            inflow, loading = races[self.behind]
            race = inflow + self.kappa * (np.sqrt(inflow**2 + loading) - np.abs(inflow))
            race = np.where(loading > 0.0, race, inflow)
            squared = self.share * race * np.abs(race) + (1.0 - self.share) * inflow * np.abs(inflow)
            mixed = np.where(loading > 0.0, np.sign(squared) * np.sqrt(np.abs(squared)), inflow)
            ahead = self.epsilon * mixed
        side = across @ flow_at(np.array([self.arm, *self.position[1:]]), nu)
        drift = -side if across[1] < 0.0 else side
        side = np.where(drift < 0.0, self.gamma[0], self.gamma[1]) * side
        attack = delta - np.arctan2(side, ahead)
        normal = 0.5 * rho * self.area * self.slope * self.gain * (ahead**2 + side**2) * np.sin(attack)
        lift = across[:, None] * (normal * np.cos(delta))
        drag = self.chord[:, None] * ((1.0 - self.deduction) * normal * np.sin(delta))
        there = np.array([self.lift_x, 0.0, 0.0])
        return wrench_at(self.position, lift - drag) + wrench_at(there, self.increase * lift)


@dataclass
class Gear:
    """All of a craft's gear, and its columns in a log behind those of fixed thrusters.

    - `swivels`: numbers of thrusters and the axes that their directions turn about.
    - `volts`: per thruster its nominal voltage, NaN where it has none; `exponent`: of its thrust.
    """

    rho: float
    propellers: list[Propeller] = field(default_factory=list)
    surfaces: list[Surface] = field(default_factory=list)
    swivels: list[tuple[int, str, Array, Array, Array]] = field(default_factory=list)
    strip: dict[str, float] | None = None
    wind: dict[str, Any] | None = None
    volts: Array = field(default_factory=lambda: np.zeros(0))
    exponent: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, raw: dict[str, Any]) -> "Gear":
        thrusters = raw.get("thruster", [])
        vector = {
            key: [np.array(t.get(key, [0, 0, 0]), float) for t in thrusters]
            for key in ("position", "direction", "swivel")
        }
        return cls(
            raw.get("environment", {}).get("density", 1025.0),
            [Propeller.of(t) for t in raw.get("propeller", [])],
            [Surface.of(t) for t in raw.get("surface", [])],
            [
                (i, t["name"], vector["position"][i], vector["direction"][i], vector["swivel"][i])
                for i, t in enumerate(thrusters)
                if "swivel" in t
            ],
            dict(raw["cross_flow"]) if "cross_flow" in raw else None,
            {**raw["wind"]} if "wind" in raw else None,
            np.array([t.get("nominal_voltage", np.nan) for t in thrusters], float),
            np.array([t.get("voltage_exponent", 1.0) for t in thrusters], float),
        )

    @property
    def moving(self) -> list[Surface]:
        return [one for one in self.surfaces if not one.fixed]

    @property
    def steered(self) -> tuple[str, ...]:
        """Columns that a stick or a controller moves."""
        names = [p.name for p in self.propellers] + [s.name for s in self.moving]
        return (*names, *(f"{name}_angle" for _, name, *_ in self.swivels))

    @property
    def given(self) -> tuple[str, ...]:
        """Columns that the surroundings fill."""
        wind = ("wind_speed", "wind_direction") if self.wind is not None else ()
        return (*wind, *(("battery",) if np.isfinite(self.volts).any() else ()))

    @property
    def columns(self) -> tuple[str, ...]:
        return (*self.steered, *self.given)

    def limits(self) -> Array:
        """The largest state of each column."""
        known = [p.most for p in self.propellers] + [s.most for s in self.moving]
        return np.array(known + [np.inf] * (len(self.columns) - len(known)))

    def trim(self) -> Array:
        """Demand of each steered column of a craft that goes straight ahead."""
        return np.array([TRIM] * len(self.propellers) + [0.0] * (len(self.moving) + len(self.swivels)))

    def asked(self, demand: Array) -> Array:
        """State of each column for demands in [-1, 1]; still air and a full battery where there are such."""
        demand = np.clip(demand, -1.0, 1.0)
        n, m = len(self.propellers), len(self.moving)
        # Thrust goes with the square of a shaft's speed.
        speeds = (
            np.array([0.6 * p.most for p in self.propellers])
            * np.sign(demand[:n])
            * np.sqrt(np.abs(demand[:n]))
        )
        angles = np.array([min(s.most, EAGER) for s in self.moving]) * demand[n : n + m]
        rest = [0.0, 0.0] if self.wind is not None else []
        if "battery" in self.given:
            rest.append(float(np.nanmax(self.volts)))
        return np.concatenate([speeds, angles, EAGER * demand[n + m :], rest])

    def servos(self, key: str, rest: float = 0.0) -> Array:
        """The `lag`, `delay` [s] or `rate` [rad/s] of each column, `rest` where it has none."""
        those = [getattr(one, key, rest) for one in (*self.propellers, *self.moving)]
        return np.array(those + [rest] * (len(self.columns) - len(those)))

    def add_strip_drag(self, coefficient: float) -> None:
        assert self.strip is not None
        self.strip["coefficient"] += coefficient

    def add_wind(self, harmonics: dict[str, float]) -> None:
        """To the first harmonics."""
        assert self.wind is not None
        for key, more in harmonics.items():
            first, *others = self.wind.get(key, [0.0])
            self.wind[key] = [first + more, *others]

    def supplied(self, thrust: Array, state: Array) -> Array:
        """Thrust [N] at the battery's voltage."""
        on = np.isfinite(self.volts)
        if not on.any():
            return thrust
        ratio = state[self.columns.index("battery")] / np.where(on, self.volts, 1.0)[:, None]
        return np.where(on[:, None], thrust * ratio ** self.exponent[:, None], thrust)

    def wrench(self, state: Array, thrust: Array, nu: Array, nu_r: Array, r: Array) -> Array:
        """Of all gear (6, B); of thrusters that swivel what their turn changes.

        `state` (columns, B), `thrust` [N] (thrusters, B), `r` body to earth.
        """
        out = np.zeros_like(nu)
        races, k = {}, 0
        for p in self.propellers:
            out += p.wrench(self.rho, state[k], nu_r)
            races[p.name] = p.race(state[k], nu_r)
            k += 1
        for s in self.surfaces:
            angle = np.zeros_like(nu[0]) if s.fixed else state[k]
            k += not s.fixed
            out += s.wrench(self.rho, angle, nu_r, races)
        for i, _, place, direction, axis in self.swivels:
            changed = turned(direction, axis, state[k]) - direction[:, None]
            out += wrench_at(place, thrust[i] * changed)
            k += 1
        if self.strip is not None:
            out += self.strips(nu_r)
        if self.wind is not None:
            out += self.blown(state[k], state[k + 1], nu, r)
        return out

    def strips(self, nu_r: Array) -> Array:
        """Drag of the hull's sections, by the midpoint rule."""
        assert self.strip is not None
        length, out = self.strip["length"], np.zeros_like(nu_r)
        x = (np.arange(STRIPS) + 0.5) / STRIPS * length - 0.5 * length
        across = nu_r[1] + x[:, None] * nu_r[5]
        size = 0.5 * self.rho * self.strip["draft"] * self.strip["coefficient"] * length / STRIPS
        drag = -size * np.abs(across) * across
        out[1], out[5] = drag.sum(0), (x[:, None] * drag).sum(0)
        return out

    def blown(self, speed: Array, direction: Array, nu: Array, r: Array) -> Array:
        """Force of the wind that blows from a direction."""
        assert self.wind is not None
        air = -speed * np.array([np.cos(direction), np.sin(direction), np.zeros_like(direction)])
        over = (r * air[:, None]).sum(0) - nu[:3]
        angle, w = np.arctan2(-over[1], -over[0]), self.wind
        pressure = 0.5 * AIR * (over[0] ** 2 + over[1] ** 2)

        def series(key: str, function) -> Array:
            return np.sum([a * function((k + 1) * angle) for k, a in enumerate(w.get(key, [0.0]))], axis=0)

        force = np.zeros_like(over)
        force[0] = pressure * w["frontal_area"] * series("surge", np.cos)
        force[1] = pressure * w["lateral_area"] * series("sway", np.sin)
        x, z = w.get("centre", (0.0, 0.0))
        out = wrench_at(np.array([x, 0.0, z]), force)
        out[5] += pressure * w["lateral_area"] * w["length"] * series("yaw", np.sin)
        return out
