"""Commands as an operator gives them: demands per axis, held for some seconds, with a slew."""

import numpy as np

from .vehicle import DOFS, Array, Vehicle

SLEW = 0.5  # s, time constant of the first-order slew to a new demand
HOLD = (2.0, 8.0)  # s, shortest and longest hold of a demand
FASTEST_TURN = 1.0  # rad/s, steady yaw rate of the largest demand
ALONE = 20.0  # s, turn of each axis where they are moved one at a time
STEEPEST_TILT = 0.25  # rad, static roll and pitch of the largest demand
LEVEL = {"surge": 0.42, "sway": 0.38, "heave": 0.42, "yaw": 0.3, "roll": 0.12, "pitch": 0.12}


def axes(vehicle: Vehicle) -> list[tuple[str, Array]]:
    """Axes that the thrusters can command, each with its pattern of largest element 1."""
    free = list(vehicle.free)
    inverse = np.linalg.pinv(vehicle.allocation[free])
    out: list[tuple[str, Array]] = []
    for dof in ("surge", "yaw", "heave", "sway", "roll", "pitch"):
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
    i = DOFS.index(dof)
    moment = (vehicle.allocation @ pattern)[i]
    if dof == "yaw":
        drag = vehicle.linear[i, i] + vehicle.quadratic[i, i] * FASTEST_TURN
        return min(LEVEL[dof], drag * FASTEST_TURN / moment)
    if dof in ("roll", "pitch"):
        righting = vehicle.weight * vehicle.cog[2] - vehicle.buoyancy * vehicle.cob[2]
        return min(LEVEL[dof], righting * np.sin(STEEPEST_TILT) / moment)
    return LEVEL[dof]


def demand(samples: int, rng: np.random.Generator, dt: float) -> Array:
    """Random holds in [-1, 1] behind a first-order slew; half begin at zero."""
    slewed, left = np.exp(-dt / SLEW), 0
    goal = rng.uniform(-1.0, 1.0)
    now = goal * rng.integers(0, 2)
    out = np.empty(samples)
    for k in range(samples):
        if left == 0:
            left = int(rng.uniform(*HOLD) / dt)
            goal = rng.uniform(-1.0, 1.0) if k else goal
        now = goal + slewed * (now - goal)
        out[k], left = now, left - 1
    return out


def commands(
    vehicle: Vehicle, samples: int, rng: np.random.Generator, kind: str = "rich", dt: float = 0.1
) -> Array:
    """Commands (samples, thrusters) in [-1, 1], six digits as in a log.

    `kind`: "rich" moves all axes at once, "weak" the same at 35 %, "single" one axis after the
    other.
    """
    out = np.zeros((samples, len(vehicle.names)))
    chosen = axes(vehicle)
    turn = rng.permutation(len(chosen))[np.arange(samples) // round(ALONE / dt) % len(chosen)]
    for number, (dof, pattern) in enumerate(chosen):
        c = demand(samples, rng, dt) * level(vehicle, dof, pattern)
        if kind == "single":
            c = np.where(turn == number, c, 0.0)
        out += c[:, None] * pattern
    return np.clip(out * (0.35 if kind == "weak" else 1.0), -1.0, 1.0).round(6)
