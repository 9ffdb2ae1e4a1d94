"""Commands as an operator gives them: demands per axis, held for some seconds, with a slew."""

import numpy as np

from .vehicle import DOFS, Array, Vehicle

SLEW = 0.5  # s, time constant of the first-order slew to a new demand
HOLD = (2.0, 8.0)  # s, shortest and longest hold of a demand
FASTEST_TURN = 1.0  # rad/s, steady yaw rate of the largest demand
ALONE = 20.0  # s, turn of each axis where they are moved one at a time
STEEPEST_TILT = 0.25  # rad, static roll and pitch of the largest demand
EVERY = ("surge", "yaw", "heave", "sway", "roll", "pitch")
LEVEL = {"surge": 0.42, "sway": 0.38, "heave": 0.42, "yaw": 0.3, "roll": 0.12, "pitch": 0.12}
# Of craft that are steered by surfaces, beside the trim: they give little, and never too much.
BY_SURFACES = {"surge": 0.4, "yaw": 0.8, "pitch": 0.4, "roll": 0.1}
BREEZE = (0.5, 2.0)  # m/s, mean wind over a model basin; gusts are a quarter of a m/s, of 5 s
FULL, EMPTY, SAG = 1.08, 0.92, 0.04  # battery at the beginning and the end, over its nominal voltage; by load


def axes(vehicle: Vehicle) -> list[tuple[str, Array]]:
    """Axes that the thrusters can command, each with its pattern of largest element 1."""
    # Planes at the stern push a craft up by turning its bow down: they command its pitch.
    order = ("surge", "yaw", "pitch", "roll") if vehicle.gear.surfaces else EVERY
    free = [i for i in vehicle.free if DOFS[i] in order]
    inverse = np.linalg.pinv(vehicle.allocation[free])
    out: list[tuple[str, Array]] = []
    for dof in order:
        if DOFS.index(dof) not in free:
            continue
        pattern = inverse[:, free.index(DOFS.index(dof))]
        if (vehicle.allocation @ pattern)[DOFS.index(dof)] < 0.5:
            continue
        pattern = pattern / np.abs(pattern).max()
        chosen = np.array([p for _, p in out] + [pattern])
        if np.linalg.svd(chosen, compute_uv=False)[-1] > 0.1:
            out.append((dof, pattern))
    return out


def level(vehicle: Vehicle, dof: str, pattern: Array) -> float:
    """Largest demand on an axis, less where it would turn or tilt the vehicle too far."""
    if vehicle.gear.surfaces:
        return BY_SURFACES[dof]
    i = DOFS.index(dof)
    moment = (vehicle.allocation @ pattern)[i]
    if dof == "yaw":
        drag = vehicle.linear[i, i] + vehicle.quadratic[i, i] * FASTEST_TURN
        return min(LEVEL[dof], drag * FASTEST_TURN / moment)
    if dof in ("roll", "pitch"):
        righting = vehicle.weight * vehicle.cog[2] - vehicle.buoyancy * vehicle.cob[2]
        return min(LEVEL[dof], righting * np.sin(STEEPEST_TILT) / moment)
    return LEVEL[dof]


def demand(samples: int, rng: np.random.Generator, dt: float, slower: float = 1.0) -> Array:
    """Random holds in [-1, 1] behind a first-order slew; half begin at zero."""
    slewed, left = np.exp(-dt / SLEW), 0
    goal = rng.uniform(-1.0, 1.0)
    now = goal * rng.integers(0, 2)
    out = np.empty(samples)
    for k in range(samples):
        if left == 0:
            left = int(slower * rng.uniform(*HOLD) / dt)
            goal = rng.uniform(-1.0, 1.0) if k else goal
        now = goal + slewed * (now - goal)
        out[k], left = now, left - 1
    return out


def commands(
    vehicle: Vehicle, samples: int, rng: np.random.Generator, kind: str = "rich", dt: float = 0.1
) -> Array:
    """Commands (samples, columns), six digits as in a log.

    `kind`: "rich" moves all axes at once, "weak" the same at 35 %, "single" one axis after the
    other.
    """
    out = np.zeros((samples, len(vehicle.steered)))
    slower = pace(vehicle)
    chosen = axes(vehicle)
    turn = rng.permutation(len(chosen))[np.arange(samples) // round(ALONE / dt) % len(chosen)]
    for number, (dof, pattern) in enumerate(chosen):
        c = demand(samples, rng, dt, slower) * level(vehicle, dof, pattern)
        if kind == "single":
            c = np.where(turn == number, c, 0.0)
        out += c[:, None] * pattern
    out = out * (0.35 if kind == "weak" else 1.0)
    return vehicle.asked(out, surroundings(vehicle, samples, rng, dt))


def pace(vehicle: Vehicle) -> float:
    """How much longer demands last on a craft with surfaces: by the seconds that it takes for its length."""
    if not vehicle.gear.surfaces:
        return 1.0
    return float(max(1.0, np.abs(vehicle.places[:, 0]).max() / vehicle.cruise))


def surroundings(vehicle: Vehicle, samples: int, rng: np.random.Generator, dt: float = 0.1) -> Array:
    """What wind and battery fill of the columns (samples, given)."""
    out = []
    if "wind_speed" in vehicle.gear.given:
        mean, direction = rng.uniform(*BREEZE), rng.uniform(-np.pi, np.pi)
        air, left = np.zeros((samples, 2)), np.exp(-dt / 5.0)
        for k in range(1, samples):
            air[k] = left * air[k - 1] + 0.25 * np.sqrt(1.0 - left**2) * rng.standard_normal(2)
        north, east = (air + mean * np.array([np.cos(direction), np.sin(direction)])).T
        out += [np.hypot(north, east), np.arctan2(east, north)]
    if "battery" in vehicle.gear.given:
        sag = SAG * np.abs(demand(samples, rng, dt))
        out.append(np.nanmax(vehicle.gear.volts) * (np.linspace(FULL, EMPTY, samples) - sag))
    return np.array(out).reshape(-1, samples).T.round(6)
