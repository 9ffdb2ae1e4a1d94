"""Vehicle files, read into arrays; SI units, axes of the contract."""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

DOFS = ("surge", "sway", "heave", "roll", "pitch", "yaw")
POSE = ("x", "y", "z", "phi", "theta", "psi")
VELOCITY = ("u", "v", "w", "p", "q", "r")
ACCELERATION = ("du", "dv", "dw", "dp", "dq", "dr")
FOLDER = Path(__file__).parent / "vehicles"


@dataclass(frozen=True)
class Vehicle:
    """One vehicle file as arrays.

    - `free`: indices of the free degrees of freedom.
    - `rigid`, `added`, `linear`, `quadratic`: M_RB, M_A, D_l, D_q, each 6 x 6, about o.
    - `cog`, `cob` [m], `weight`, `buoyancy` [N].
    - `names`, `position` [m], `direction`, `max_thrust` and `max_thrust_reverse` [N], `curve` [1]
      (the file's `quadratic`), `lag` [s], `delay` [s], `deadband`, `saturation` [command]: one row per
      thruster.
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
    noise: Array
    raw: dict[str, Any]

    @property
    def allocation(self) -> Array:
        """Wrench at o of full thrust ahead, one column per thruster [N, N m]: (d, r x d) T_max."""
        moment = np.cross(self.position, self.direction)
        return np.vstack([self.direction.T, moment.T]) * self.max_thrust

    def signals(self) -> list[tuple[str, int]]:
        """Logged channels of the free degrees of freedom: name and row among the 18 signals."""
        every = (*POSE, *VELOCITY, *ACCELERATION)
        return [(every[6 * kind + dof], 6 * kind + dof) for kind in range(3) for dof in self.free]


def skew(r: Array) -> Array:
    """S(r) with S(r) a = r x a."""
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


def rigid_mass(mass: float, cog: Array, inertia: Array) -> Array:
    """M_RB = [[m I, -m S(r_g)], [m S(r_g), I_o]], Fossen (2011), eq. 3.44."""
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
    thrusters = raw["thruster"]
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
        position=np.array([t["position"] for t in thrusters], float),
        direction=np.array([t["direction"] for t in thrusters], float),
        max_thrust=per_thruster("max_thrust"),
        max_thrust_reverse=np.array([t.get("max_thrust_reverse", t["max_thrust"]) for t in thrusters], float),
        curve=per_thruster("quadratic"),
        lag=per_thruster("lag"),
        delay=per_thruster("delay"),
        deadband=per_thruster("deadband"),
        saturation=per_thruster("saturation", 1.0),
        noise=np.repeat([sensors[k] for k in kinds], 3).astype(float),
        raw=raw,
    )


def load(path: Path | str) -> Vehicle:
    """Reads a vehicle file; a bare name means one of this folder's `vehicles`."""
    path = Path(path)
    path = path if path.suffix else FOLDER / f"{path}.toml"
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
