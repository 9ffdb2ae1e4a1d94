"""Effects outside the catalogue, each with one magnitude that is left to choose.

Where that is possible their forms are orthogonal to those of the catalogue: even in a velocity
where the catalogue is odd, or dependent on signals that no named effect uses.
"""

from collections.abc import Callable

import numpy as np

from .catalogue import Draw, Scales, free_dofs
from .plant import Outside
from .vehicle import DOFS, Array, Vehicle

Force = Callable[[Array | float, Array, Array], Array]  # of time, state and velocity through the water


def on(dof: str, force: Force) -> Force:
    """A wrench on one degree of freedom from a scalar force of (t, state, nu_r)."""
    row = DOFS.index(dof)

    def wrench(t: Array | float, s: Array, nu: Array) -> Array:
        out = np.zeros_like(nu)
        out[row] = force(t, s, nu)
        return out

    return wrench


def wrench_draw(
    name: str,
    dof: str,
    depends_on: tuple[str, ...],
    unit: float,
    form: Force,
) -> Draw:
    """A force a * unit * form(t, state, nu_r) on one degree of freedom."""
    return Draw(
        lambda a: Outside(
            name, (dof,), depends_on, on(dof, lambda t, s, nu: a * unit * form(t, s, nu))
        ),
        0.02, 0.7, 6.0,
    )  # fmt: skip


def play(commands: Array, width: float) -> Array:
    """Backlash: the output lags the input by half the width, and turns only after the whole."""
    out, now = np.empty_like(commands), commands[0].copy()
    for k, c in enumerate(commands):
        now = np.clip(now, c - 0.5 * width, c + 0.5 * width)
        out[k] = now
    return out


def driven(vehicle: Vehicle) -> tuple[str, ...]:
    """Degrees of freedom on which the thrusters act noticeably."""
    reach = np.abs(vehicle.allocation).max(1)
    return tuple(d for d in free_dofs(vehicle) if reach[DOFS.index(d)] > 1e-6)


def draw(name: str, vehicle: Vehicle, s: Scales, rng: np.random.Generator) -> Draw:
    """A random effect of this name on this vehicle."""
    u, v, r = s.speed[[0, 1, 5]]
    phase = rng.uniform(0.0, 2.0 * np.pi)
    match name:
        case "depth_force":  # hull compression and stratified water: heave force against depth, 5 m a turn
            return wrench_draw(
                name,
                "heave",
                ("z",),
                s.wrench[2],
                lambda t, x, nu: np.sin(2.0 * np.pi * x[2] / 5.0 + phase),
            )
        case "heading_force":  # twice per turn, as a wind or a magnetic pull has it and a current has not
            return wrench_draw(
                name, "sway", ("psi",), s.wrench[1], lambda t, x, nu: np.sin(2.0 * x[5] + phase)
            )
        case "heading_speed_force":
            dof = "heave" if 2 in vehicle.free else "sway"
            i = DOFS.index(dof)
            return wrench_draw(
                name,
                dof,
                ("psi", "u"),
                s.wrench[i] / u,
                lambda t, x, nu: np.sin(x[5] + phase) * nu[0],
            )
        case "stick_slip":  # dry friction with a Stribeck peak: much at a creep, little when under way
            return wrench_draw(
                name,
                "surge",
                ("u",),
                -s.wrench[0],
                lambda t, x, nu: (0.3 + 0.7 * np.exp(-4.0 * (nu[0] / u) ** 2)) * np.tanh(10.0 * nu[0] / u),
            )
        case "dynamic_trim":  # squat: pitch moment, or for a planar craft a yaw moment, even in speed
            dof = "pitch" if 4 in vehicle.free else "yaw"
            i = DOFS.index(dof)
            return wrench_draw(name, dof, ("u",), s.wrench[i] / u**2, lambda t, x, nu: nu[0] ** 2)
        case "cross_terms":  # yaw damping that grows with the drift, its mean taken out
            unit = -s.wrench[5] / r
            return wrench_draw(
                name, "yaw", ("v", "r"), unit, lambda t, x, nu: (np.abs(nu[1]) / v - 0.8) * nu[5]
            )
        case "bank_force":  # a wall along the track: sway force that falls with distance in y
            return wrench_draw(name, "sway", ("y",), s.wrench[1], lambda t, x, nu: np.cos(x[1] + phase))
        case "hysteresis":
            return Draw(
                lambda a: Outside(
                    name, driven(vehicle), vehicle.names, commands=lambda t, c: play(c, a)
                ),
                0.02, 0.15, 0.6,
            )  # fmt: skip
        case "drifting_gain":
            period = rng.uniform(60.0, 110.0)

            def drift(a: float) -> Outside:
                def act(t: Array, c: Array) -> Array:
                    return c * (1.0 + a * np.sin(2.0 * np.pi * t / period + phase))[:, None]

                return Outside(name, driven(vehicle), ("t", *vehicle.names), commands=act)

            return Draw(drift, 0.03, 0.25, 0.9)
        case _:
            raise ValueError(f"Effect `{name}` is not known.")


def names(vehicle: Vehicle) -> list[str]:
    """Effects that can be seen on this vehicle."""
    out = [
        "heading_force",
        "heading_speed_force",
        "stick_slip",
        "dynamic_trim",
        "cross_terms",
        "bank_force",
    ]
    if not vehicle.gear.columns:  # whose columns hold more than what a thruster makes of them
        out += ["hysteresis", "drifting_gain"]
    return ["depth_force", *out] if 2 in vehicle.free else out
