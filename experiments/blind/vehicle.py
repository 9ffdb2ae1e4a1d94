"""Vehicle files, read into arrays; SI units, axes of the contract."""

import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .gear import TRIM, Array, Gear

DOFS = ("surge", "sway", "heave", "roll", "pitch", "yaw")
POSE = ("x", "y", "z", "phi", "theta", "psi")
VELOCITY = ("u", "v", "w", "p", "q", "r")
ACCELERATION = ("du", "dv", "dw", "dp", "dq", "dr")
FOLDER = Path(__file__).parent / "vehicles"
GEARED = Path(__file__).parent / "geared"  # those with propellers, surfaces or thrusters that turn


@dataclass(frozen=True)
class Vehicle:
    """One vehicle file as arrays.

    - `free`: indices of the free degrees of freedom.
    - `rigid`, `added`, `linear`, `quadratic`: M_RB, M_A, D_l, D_q, each 6 x 6, about o.
    - `cog`, `cob` [m], `weight`, `buoyancy` [N].
    - `names`, `position` [m], `direction`, `max_thrust` and `max_thrust_reverse` [N], `curve` [1]
      (the file's `quadratic`), `lag` [s], `delay` [s], `deadband`, `saturation` [command]: one row per
      thruster.
    - `gear`: what drives it beside those.
    - `noise`: standard deviation of pose, velocity and acceleration, 18 numbers.
    - `raw`: the file's own tables.
    """

    name: str
    free: tuple[int, ...]
    density: float
    gravity: float
    rigid: Array
    added: Array
    linear: Array
    quadratic: Array
    cog: Array
    cob: Array
    weight: float
    buoyancy: float
    names: tuple[str, ...]
    position: Array
    direction: Array
    max_thrust: Array
    max_thrust_reverse: Array
    curve: Array
    lag: Array
    delay: Array
    deadband: Array
    saturation: Array
    gear: Gear
    noise: Array
    raw: dict[str, Any]

    @property
    def steered(self) -> tuple[str, ...]:
        """Columns of a log that a stick or a controller moves."""
        return (*self.names, *self.gear.steered)

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns that drive it."""
        return (*self.names, *self.gear.columns)

    @property
    def places(self) -> Array:
        """Where all that drives it acts, a row each [m]."""
        gear = [one.position for one in (*self.gear.propellers, *self.gear.surfaces)]
        return np.vstack([self.position, *gear])

    @property
    def pushes(self) -> Array:
        """Wrench at o of full thrust ahead, one column per thruster [N, N m]: (d, r x d) T_max."""
        moment = np.cross(self.position, self.direction)
        return np.vstack([self.direction.T, moment.T]) * self.max_thrust

    @cached_property
    def allocation(self) -> Array:
        """What a demand of 1 gives beside the trim, one column per steered one [N, N m].

        Of thrusters their full thrust; of gear by the steady run of a trimmed craft, as a rudder gives
        nothing at rest.
        """
        if not self.gear.steered:
            return self.pushes
        speed = self.cruise
        nu = np.zeros((6, 1))
        nu[0] = speed
        thrust = (TRIM * self.max_thrust)[:, None]
        trim = self.gear.trim()

        def wrench(demand: Array) -> Array:
            return self.gear.wrench(self.gear.asked(demand)[:, None], thrust, nu, nu, np.eye(3)[:, :, None])[
                :, 0
            ]

        level = wrench(trim)
        of_gear = [wrench(trim + 0.3 * one) - level for one in np.eye(len(trim))]
        return np.column_stack([self.pushes, *(column / 0.3 for column in of_gear)])

    @cached_property
    def cruise(self) -> float:
        """Steady speed ahead of a trimmed craft [m/s], by halving."""
        low, high = 0.0, 20.0
        state = self.gear.asked(self.gear.trim())[:, None]
        for _ in range(50):
            u = 0.5 * (low + high)
            nu = np.array([[u], [0], [0], [0], [0], [0]], float)
            thrust = (TRIM * self.max_thrust)[:, None]
            force = self.gear.wrench(state, thrust, nu, nu, np.eye(3)[:, :, None])[0, 0]
            force += TRIM * self.pushes[0].sum() - (self.linear[0, 0] + self.quadratic[0, 0] * u) * u
            low, high = (u, high) if force > 0.0 else (low, u)
        return low

    def asked(self, demand: Array, given: Array) -> Array:
        """Columns of a log (K, columns) of what sticks ask for (K, steered) and the surroundings give."""
        n = len(self.names)
        trimmed = demand[:, n:] + self.gear.trim()
        if self.gear.swivels:
            demand = demand + TRIM * np.isin(np.arange(demand.shape[1]), [i for i, *_ in self.gear.swivels])
        thrusters = np.clip(demand[:, :n], -1.0, 1.0)
        gear = np.array([self.gear.asked(one) for one in trimmed]).reshape(len(demand), -1)
        return np.hstack([thrusters, gear[:, : len(self.gear.steered)], given]).round(6)

    def signals(self) -> list[tuple[str, int]]:
        """Logged channels of the free degrees of freedom: name and row among the 18 signals."""
        every = (*POSE, *VELOCITY, *ACCELERATION)
        return [(every[6 * kind + dof], 6 * kind + dof) for kind in range(3) for dof in self.free]


def skew(r: Array) -> Array:
    """S(r) with S(r) a = r x a."""
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


def rigid_mass(mass: float, cog: Array, inertia: Array) -> Array:
    """M_RB = [[m I, -m S(r_g)], [m S(r_g), I_o]], after Fossen (2011)."""
    s = mass * skew(cog)
    return np.block([[mass * np.eye(3), -s], [s, inertia]])


def square(values: Any) -> Array:
    """A 6 x 6 matrix from a matrix or from its diagonal."""
    a = np.array(values, float)
    return np.diag(a) if a.ndim == 1 else a


def from_tables(raw: dict[str, Any]) -> Vehicle:
    """The vehicle that the tables of a vehicle file describe."""
    body, environment = raw["body"], raw.get("environment", {})
    gravity = environment.get("gravity", 9.81)
    mass, cog = body["mass"], np.array(body.get("cog", np.zeros(3)), float)
    weight = body.get("weight", mass * gravity)
    rigid = body.get("mass_matrix")
    thrusters = raw.get("thruster", [])
    sensors = raw["sensors"]
    kinds = ("position", "attitude", "velocity", "rate", "acceleration", "angular_acceleration")

    def per_thruster(key: str, default: float = 0.0) -> Array:
        return np.array([t.get(key, default) for t in thrusters], float)

    return Vehicle(
        name=raw["name"],
        free=tuple(DOFS.index(d) for d in raw.get("dof", DOFS)),
        density=environment.get("density", 1025.0),
        gravity=gravity,
        rigid=rigid_mass(mass, cog, np.array(body["inertia"], float)) if rigid is None else square(rigid),
        added=square(raw["added_mass"]["matrix"]),
        linear=square(raw["damping"]["linear"]),
        quadratic=square(raw["damping"]["quadratic"]),
        cog=cog,
        cob=np.array(body.get("cob", np.zeros(3)), float),
        weight=weight,
        buoyancy=body.get("buoyancy", weight),
        names=tuple(t["name"] for t in thrusters),
        position=np.array([t["position"] for t in thrusters], float).reshape(-1, 3),
        direction=np.array([t["direction"] for t in thrusters], float).reshape(-1, 3),
        max_thrust=per_thruster("max_thrust"),
        max_thrust_reverse=np.array([t.get("max_thrust_reverse", t["max_thrust"]) for t in thrusters], float),
        curve=per_thruster("quadratic"),
        lag=per_thruster("lag"),
        delay=per_thruster("delay"),
        deadband=per_thruster("deadband"),
        saturation=per_thruster("saturation", 1.0),
        gear=Gear.of(raw),
        noise=np.repeat([sensors[k] for k in kinds], 3).astype(float),
        raw=raw,
    )


def load(path: Path | str) -> Vehicle:
    """Reads a vehicle file; a bare name means one of this folder's `vehicles`, or one that is `geared`."""
    path = Path(path)
    if not path.suffix:
        own = FOLDER / f"{path}.toml"
        path = own if own.exists() else GEARED / f"{path}.toml"
    return from_tables(tomllib.loads(path.read_text()))


def perturbed(raw: dict[str, Any], spread: float, rng: np.random.Generator) -> dict[str, Any]:
    """The tables with every damping and added-mass coefficient times 1 + N(0, spread^2).

    The added mass stays symmetric.
    """

    def wrong(values: Any, symmetric: bool) -> list[list[float]]:
        a = square(values)
        factor = 1.0 + spread * rng.standard_normal((6, 6))
        if symmetric:
            factor = np.triu(factor) + np.triu(factor, 1).T
        return (a * factor).round(6).tolist()

    damping = {k: wrong(v, symmetric=False) for k, v in raw["damping"].items()}
    return raw | {
        "added_mass": {"matrix": wrong(raw["added_mass"]["matrix"], True)},
        "damping": damping,
    }
