"""Random effects of the catalogue, each with one magnitude that is left to choose."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .plant import Effect, Outside
from .vehicle import DOFS, Array, Vehicle

COUPLINGS = (
    ("sway", "yaw"),
    ("yaw", "sway"),
    ("heave", "pitch"),
    ("pitch", "heave"),
    ("surge", "pitch"),
    ("pitch", "surge"),
    ("sway", "roll"),
    ("roll", "sway"),
    ("heave", "surge"),
    ("yaw", "surge"),
)
JOINED = (
    ("surge", "heave"),
    ("surge", "pitch"),
    ("heave", "pitch"),
    ("sway", "roll"),
    ("sway", "yaw"),
    ("roll", "yaw"),
)
LASTING = (
    "constant_wrench",
    "buoyancy",
    "thruster_gain",
    "payload",
    "tether_drag",
    "gyro_bias",
    "added_mass",
)
DAMPED = ("linear_damping", "quadratic_damping", "coupled_damping")
# Coefficients that a wrong file has wrong anyway: none is hidden beside it, and none named there is false.
DAMP = (*DAMPED, "added_mass", "coupled_added_mass")


@dataclass(frozen=True)
class Scales:
    """Typical size of motion of an undisturbed run, per degree of freedom.

    - `speed`: root mean square velocity [m/s, rad/s]; `drag`: D_l + D_q speed [N s/m, N m s].
    - `wrench`: what is a moderate push, the larger of drag times speed and 0.3 times the actuators'
      root mean square [N, N m].
    - `inertia`: diagonal of M_RB + M_A.
    - `reach`: half size of the vehicle [m].
    """

    speed: Array
    drag: Array
    wrench: Array
    inertia: Array
    reach: Array


@dataclass(frozen=True)
class Draw:
    """An effect but for its magnitude `a`, between `low` and `high`, first tried at `guess`."""

    build: Callable[[float], Effect | Outside]
    low: float
    guess: float
    high: float


def scales(vehicle: Vehicle, velocity: Array, commands: Array) -> Scales:
    """Scales of a run with velocity (K, 6) and commands (K, thrusters)."""
    speed = np.maximum(np.sqrt((velocity**2).mean(0)), 1e-3)
    drag = np.diag(vehicle.linear) + np.diag(vehicle.quadratic) * speed
    if vehicle.gear.columns:  # whose force hangs on the flow
        pushed = 0.5 * np.abs(vehicle.allocation).sum(1)
    else:
        pushed = np.sqrt(((commands @ vehicle.allocation.T) ** 2).mean(0))
    return Scales(
        speed=speed,
        drag=drag,
        wrench=np.maximum(drag * speed, 0.3 * pushed),
        inertia=np.diag(vehicle.rigid + vehicle.added).copy(),
        reach=np.maximum(np.abs(vehicle.places).max(0), [0.2, 0.1, 0.05]),
    )


def sign(rng: np.random.Generator, positive: float = 0.5) -> float:
    """1 with probability `positive`, else -1."""
    return 1.0 if rng.random() < positive else -1.0


def shares(rng: np.random.Generator, n: int) -> Array:
    """n numbers of random sign, none small beside the others, of length 1."""
    a = rng.uniform(0.4, 1.0, n) * rng.choice([-1.0, 1.0], n)
    return a / np.linalg.norm(a)


def free_dofs(vehicle: Vehicle) -> list[str]:
    """Names of the free degrees of freedom."""
    return [DOFS[i] for i in vehicle.free]


def damping_draw(name: str, vehicle: Vehicle, s: Scales, rng: np.random.Generator) -> Draw:
    """More or less damping on one axis; never below 30 % of what the file has."""
    dof = str(rng.choice(free_dofs(vehicle)))
    i = DOFS.index(dof)
    linear = name == "linear_damping"
    unit = s.drag[i] if linear else s.drag[i] / s.speed[i]
    has = (vehicle.linear if linear else vehicle.quadratic)[i, i]
    most = 0.7 * has / unit
    less = most > 0.1 and rng.random() < 0.3
    sense = -1.0 if less else 1.0
    high = most if less else 8.0
    return Draw(lambda a: Effect(name, dof, {"value": sense * a * unit}), 0.01, min(0.5, high), high)


def draw(name: str, vehicle: Vehicle, s: Scales, rng: np.random.Generator) -> Draw:
    """A random effect of this name on this vehicle."""
    dofs = free_dofs(vehicle)
    planar = "heave" not in dofs
    dof = str(rng.choice(dofs))
    i = DOFS.index(dof)
    one = sign(rng)
    top = float(np.linalg.norm(s.speed[:3]))
    xyz = ("x", "y") if planar else ("x", "y", "z")

    def effect(parameters: Callable[[float], dict[str, float]], target: str | None = None):
        return lambda a: Effect(name, target, parameters(a))

    match name:
        case "steady_current":
            rising = not planar and rng.random() < 0.3
            c = shares(rng, 3 if rising else 2) * ([1.0, 1.0, 0.4] if rising else 1.0)
            return Draw(
                effect(lambda a: dict(zip(("north", "east", "down"), a * c, strict=False))),
                0.01 * top, 0.4 * top, 2.0 * top,
            )  # fmt: skip
        case "waves":
            c, period, phase = shares(rng, 2), rng.uniform(3.0, 12.0), rng.uniform(-1.5, 1.5)
            force = s.wrench[0]
            return Draw(
                effect(
                    lambda a: dict(north=a * c[0], east=a * c[1], period=period, phase=phase)
                ),
                0.05 * force, 0.6 * force, 5.0 * force,
            )  # fmt: skip
        case "wind_push":
            c = shares(rng, 2) * s.wrench[0]
            return Draw(effect(lambda a: {"north": a * c[0], "east": a * c[1]}), 0.01, 0.4, 4.0)
        case "tether_drag":
            unit = s.drag[0] / s.speed[0]
            return Draw(effect(lambda a: {"coefficient": a * unit}), 0.02, 0.5, 8.0)
        case "added_mass":
            return Draw(effect(lambda a: {"value": a * s.inertia[i]}, dof), 0.02, 0.4, 3.0)
        case "payload":
            place = s.reach * rng.uniform(-1.0, 1.0, 3)
            mass = vehicle.rigid[0, 0]
            heavy = rng.uniform(-0.2, 0.8)

            def parameters(a: float) -> dict[str, float]:
                volume = {} if planar else {"volume": a * mass * (1.0 - heavy) / vehicle.density}
                return {"mass": a * mass, **volume, **dict(zip(xyz, place.tolist(), strict=False))}

            return Draw(effect(parameters), 0.005, 0.05, 0.4)
        case "buoyancy":
            capacity = np.abs(vehicle.allocation[2]).sum()
            return Draw(effect(lambda a: {"force": one * a * capacity}), 0.005, 0.1, 0.5)
        case "trim":
            arm = np.linalg.norm(vehicle.weight * vehicle.cog - vehicle.buoyancy * vehicle.cob)
            c = shares(rng, 3) * arm / vehicle.buoyancy
            return Draw(effect(lambda a: dict(zip("xyz", (a * c).tolist(), strict=True))), 0.01, 0.2, 0.7)
        case "linear_damping" | "quadratic_damping":
            return damping_draw(name, vehicle, s, rng)
        case "coupled_damping":
            to, by = COUPLINGS[rng.choice([k for k, c in enumerate(COUPLINGS) if set(c) <= set(dofs)])]
            unit = np.sqrt(s.drag[DOFS.index(to)] * s.drag[DOFS.index(by)])
            return Draw(effect(lambda a: {"value": one * a * unit}, f"{to}<-{by}"), 0.02, 0.4, 1.5)
        case "coupled_added_mass":  # less than the root of both, or the mass would not be positive
            one_of = [k for k, pair in enumerate(JOINED) if set(pair) <= set(dofs)]
            pair = JOINED[rng.choice(one_of)]
            i, j = (DOFS.index(dof) for dof in pair)
            unit = np.sqrt(s.inertia[i] * s.inertia[j])
            return Draw(effect(lambda a: {"value": one * a * unit}, "+".join(pair)), 0.01, 0.15, 0.6)
        case "hull_lift":
            unit = s.drag[[1, 5, 2, 4]] / s.speed[0]
            unit[[1, 3]] = np.sqrt(unit[[0, 2]] * unit[[1, 3]])
            unit *= rng.uniform(0.5, 1.0, 4) * np.array([1.0, sign(rng), 1.0, sign(rng)])
            keys = ("Y_uv", "N_uv") if planar else ("Y_uv", "N_uv", "Z_uw", "M_uw")
            return Draw(effect(lambda a: dict(zip(keys, (a * unit).tolist(), strict=False))), 0.02, 0.5, 5.0)
        case "turning_lift":  # of a size with the yaw damping at the typical speed
            unit = np.array([one * np.sqrt(s.drag[1] * s.drag[5]), s.drag[5]]) / s.speed[0]
            unit *= rng.uniform(0.5, 1.0, 2)
            return Draw(effect(lambda a: {"Y_ur": a * unit[0], "N_ur": a * unit[1]}), 0.02, 0.5, 5.0)
        case "fluid_memory":
            tau = float(np.exp(rng.uniform(np.log(0.5), np.log(5.0))))
            return Draw(effect(lambda a: {"gain": a * s.drag[i], "time_constant": tau}, dof), 0.05, 0.8, 6.0)
        case "constant_wrench":
            return Draw(effect(lambda a: {"value": one * a * s.wrench[i]}, dof), 0.01, 0.4, 4.0)
        case "thruster_gain":
            driving = (*vehicle.names, *(p.name for p in vehicle.gear.propellers))
            target = "all" if rng.random() < 0.25 and vehicle.names else str(rng.choice(driving))
            sense = sign(rng, 0.25)
            return Draw(
                effect(lambda a: {"factor": 1.0 + sense * a}, target),
                0.02,
                0.3,
                0.6 if sense > 0 else 1.0,
            )
        case "reverse_thrust":  # mostly weaker astern, as propellers are made for one way
            target = "all" if rng.random() < 0.5 else str(rng.choice(vehicle.names))
            sense = sign(rng, 0.25)
            return Draw(effect(lambda a: {"factor": 1.0 + sense * a}, target), 0.03, 0.3, 0.9)
        case "surface_gain":
            target = str(rng.choice([one.name for one in vehicle.gear.surfaces]))
            sense = sign(rng, 0.25)
            return Draw(effect(lambda a: {"factor": 1.0 + sense * a}, target), 0.05, 0.4, 0.95)
        case "surface_offset":
            target = str(rng.choice([one.name for one in vehicle.gear.moving]))
            return Draw(effect(lambda a: {"angle": one * a}, target), 0.01, 0.1, 0.3)
        case "surface_stuck":
            target = str(rng.choice([one.name for one in vehicle.gear.moving]))
            return Draw(effect(lambda a: {"angle": one * a}, target), 0.0, 0.05, 0.2)
        case "wake":
            target = str(rng.choice([p.name for p in vehicle.gear.propellers]))
            return Draw(effect(lambda a: {"fraction": one * a}, target), 0.02, 0.2, 0.5)
        case "cross_flow_drag":
            return Draw(effect(lambda a: {"coefficient": a}), 0.05, 0.6, 4.0)
        case "wind":
            keys = ("surge", "sway", "yaw")
            c = shares(rng, 3) * [1.0, 1.0, 0.3]
            return Draw(effect(lambda a: dict(zip(keys, (a * c).tolist(), strict=True))), 0.05, 0.6, 4.0)
        case "voltage":
            return Draw(effect(lambda a: {"exponent": one * a}), 0.05, 1.0, 3.0)
        case "thrust_curve":
            return Draw(effect(lambda a: {"quadratic": a}), 0.03, 0.4, 1.0)
        case "thruster_lag":
            return Draw(effect(lambda a: {"time_constant": a}), 0.05, 0.3, 2.0)
        case "input_delay":
            return Draw(effect(lambda a: {"delay": round(a, 2)}), 0.05, 0.3, 1.5)
        case "deadband":
            return Draw(effect(lambda a: {"width": a}), 0.01, 0.08, 0.3)
        case "saturation":
            return Draw(effect(lambda a: {"limit": 0.7 - a}), 0.05, 0.35, 0.65)
        case "inflow_loss":
            return Draw(effect(lambda a: {"per_speed": a / (3.0 * top)}), 0.02, 0.3, 0.9)
        case "velocity_lever_arm":
            c = shares(rng, len(xyz))
            return Draw(effect(lambda a: dict(zip(xyz, (a * c).tolist(), strict=True))), 0.01, 0.15, 3.0)
        case "velocity_scale":
            sense = sign(rng)
            return Draw(effect(lambda a: {"factor": 1.0 + sense * a}), 0.01, 0.1, 0.5)
        case "velocity_misalignment":
            return Draw(effect(lambda a: {"yaw": one * a}), 0.01, 0.1, 0.6)
        case "velocity_in_earth_axes":
            return Draw(effect(lambda a: {"fraction": a}), 0.01, 0.1, 1.0)
        case "gyro_bias":
            keys = ("r",) if planar else ("p", "q", "r")
            c = shares(rng, len(keys))
            return Draw(effect(lambda a: dict(zip(keys, (a * c).tolist(), strict=True))), 0.002, 0.02, 0.3)
        case "compass_deviation":
            c = shares(rng, 3)
            keys = ("constant", "cos", "sin")
            return Draw(effect(lambda a: dict(zip(keys, (a * c).tolist(), strict=True))), 0.01, 0.15, 0.5)
        case "sensor_delay":
            target = str(rng.choice(["position", "attitude", "velocity", "rate"]))
            # Whole samples of 0.1 s: what lies between is not logged.
            return Draw(effect(lambda a: {"delay": max(round(a, 1), 0.1)}, target), 0.1, 0.3, 1.0)
        case "exchanged_thrusters":
            i, j = sorted(rng.choice(len(vehicle.names), 2, replace=False))
            target = f"{vehicle.names[i]}+{vehicle.names[j]}"
            return Draw(effect(lambda a: {}, target), 1.0, 1.0, 1.0)
        case _:
            raise ValueError(f"Effect `{name}` is not in the catalogue.")


def names(vehicle: Vehicle) -> list[str]:
    """Effects that can be seen on this vehicle.

    Of craft with gear those that are of their gear, and those of hull and sensors that ships share.

    Restoring effects need heave, roll and pitch; a further lag or dead zone on thrusters that have
    one in the file is left out, because the contract does not say how the two combine.
    """
    if vehicle.gear.columns:
        return names_of_geared(vehicle)
    out = [
        "steady_current", "waves", "tether_drag", "added_mass", "payload", "linear_damping",
        "quadratic_damping", "coupled_damping", "hull_lift", "fluid_memory", "constant_wrench",
        "thruster_gain", "thrust_curve", "input_delay", "saturation", "inflow_loss",
        "velocity_lever_arm",
        "velocity_scale", "velocity_misalignment", "velocity_in_earth_axes", "gyro_bias",
        "reverse_thrust", "turning_lift", "coupled_added_mass",
        "compass_deviation", "sensor_delay", "exchanged_thrusters",
    ]  # fmt: skip
    if len(vehicle.free) == 6:
        out += ["buoyancy", "trim"]
    if "heave" not in free_dofs(vehicle):
        out += ["wind_push"]
    if not vehicle.lag.any():
        out += ["thruster_lag"]
    if not vehicle.deadband.any():
        out += ["deadband"]
    return out


def names_of_geared(vehicle: Vehicle) -> list[str]:
    """Effects that can be seen on a craft with propellers, surfaces or thrusters that turn."""
    gear = vehicle.gear
    out = ["turning_lift", "sensor_delay", "compass_deviation", "thruster_gain"]
    if vehicle.names:
        out += ["reverse_thrust"]
    if gear.surfaces:
        out += ["surface_stuck", "surface_offset", "surface_gain"]
    if gear.propellers:
        out += ["wake"]
    if gear.strip is not None:
        out += ["cross_flow_drag"]
    if "battery" in gear.given:
        out += ["voltage"]
    if gear.wind is not None:
        return [*out, "wind"]
    return out if "heave" in free_dofs(vehicle) else [*out, "wind_push"]
