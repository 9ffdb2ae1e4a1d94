"""How much a hidden effect hurts open-loop prediction, and which named effects look the same."""

from collections.abc import Sequence

import numpy as np

from .catalogue import COUPLINGS, JOINED
from .plant import Effect, Model, Outside, Run, observed, simulate, thrust_states
from .vehicle import DOFS, Array, Vehicle

HORIZON = 50  # samples: 5 s at 10 Hz
SAMPLES = 4500  # of a training and a test log together
DISTINCT = 12.0  # chi-square below which two effects count as the same


def prediction_error(model: Model, run: Run, commands: Array, seen: Array) -> float:
    """Mean square of (prediction - `seen`) / noise, over channels and 5 s from true start states.

    `commands` (K, thrusters), `seen` (K, 18): what noise-free sensors log.
    """
    k = len(commands)
    starts = np.arange(0, k - HORIZON - 1, 25)
    depth = int(np.ceil(model.delay.max() / 0.1)) + 1
    rows = np.maximum(starts[None, :] + np.arange(-depth, HORIZON + 1)[:, None], 0)
    held = commands[rows].transpose(0, 2, 1)
    state = run.states[starts, :, 0].T
    lagging = thrust_states(model, commands[:, :, None])[starts, :, 0].T
    out = simulate(
        [(0, model)], held, state, HORIZON + 1, t0=0.1 * starts, lead=depth, thrust=lagging
    ).signals()
    predicted = observed(model.effects, 0.1 * np.arange(HORIZON + 1), out)[1:]
    wanted = seen[starts[None, :] + np.arange(1, HORIZON + 1)[:, None]].transpose(0, 2, 1)
    error = predicted - wanted
    error[:, 3:6] = (error[:, 3:6] + np.pi) % (2.0 * np.pi) - np.pi
    chosen = [row for _, row in model.vehicle.signals()]
    return float(np.mean((error[:, chosen] / model.vehicle.noise[chosen, None]) ** 2))


def acceleration_along(
    vehicle: Vehicle, effects: Sequence[Effect | Outside], run: Run, commands: Array
) -> Array:
    """Acceleration of a model at the states of a run, over the noise, (K, free); no lag."""
    t = 0.1 * np.arange(len(commands))
    named = [e for e in effects if isinstance(e, Effect)]
    outside = [e for e in effects if isinstance(e, Outside)]
    model = Model(vehicle, named, outside)
    thrust = model.drive(altered(outside, t, commands).T)
    free = list(vehicle.free)
    rates = model.derivative(t, run.states[:, :, 0].T, thrust, 0.0)[6:12]
    return (rates[free] / vehicle.noise[12:][free, None]).T


def added_acceleration(
    vehicle: Vehicle, effects: Sequence[Effect | Outside], run: Run, commands: Array
) -> Array:
    """What effects add to the acceleration along a run, in units of the noise, (K, free)."""
    acting = acceleration_along(vehicle, effects, run, commands)
    return acting - acceleration_along(vehicle, [], run, commands)


def suspect_columns(
    vehicle: Vehicle, hidden: Sequence[Effect | Outside], run: Run, commands: Array
) -> list[tuple[Effect, Array]]:
    """Each suspect with its columns (K, free, n), linearised about the true model."""
    truth = acceleration_along(vehicle, hidden, run, commands)
    return [
        (
            steps[0],
            np.stack(
                [acceleration_along(vehicle, [*hidden, e], run, commands) - truth for e in steps],
                -1,
            ),
        )
        for steps in linear_suspects(vehicle)
    ]


def altered(outside: Sequence[Outside], t: Array, commands: Array) -> Array:
    """The commands that the thrusters see, (K, thrusters)."""
    for o in outside:
        commands = commands if o.commands is None else o.commands(t, commands)
    return commands


def linear_suspects(vehicle: Vehicle) -> list[list[Effect]]:
    """Small steps of effects that are linear in their parameters, a list for each."""
    dofs = [DOFS[i] for i in vehicle.free]
    out = []
    for dof in dofs:
        for name in ("constant_wrench", "linear_damping", "quadratic_damping", "added_mass"):
            out.append([Effect(name, dof, {"value": 1e-3})])
    for to, by in COUPLINGS:
        if to in dofs and by in dofs:
            out.append([Effect("coupled_damping", f"{to}<-{by}", {"value": 1e-3})])
    for pair in JOINED:
        if set(pair) <= set(dofs):
            out.append([Effect("coupled_added_mass", "+".join(pair), {"value": 1e-3})])
    for target in (*vehicle.names, "all"):
        out.append([Effect("thruster_gain", target, {"factor": 1.001})])
        out.append([Effect("reverse_thrust", target, {"factor": 1.001})])
    out.append([Effect("thrust_curve", None, {"quadratic": 1e-3})])
    out.append([Effect("inflow_loss", None, {"per_speed": 1e-3})])
    out.append([Effect("tether_drag", None, {"coefficient": 1e-3})])
    out.append([Effect("hull_lift", None, {k: 1e-3}) for k in ("Y_uv", "N_uv", "Z_uw", "M_uw")])
    out.append([Effect("turning_lift", None, {k: 1e-3}) for k in ("Y_ur", "N_ur")])
    if "heave" not in dofs:
        out.append([Effect("wind_push", None, {k: 1e-3}) for k in ("north", "east")])
    if len(dofs) == 6:
        out.append([Effect("buoyancy", None, {"force": 1e-3})])
        out.append([Effect("trim", None, {k: 1e-5}) for k in "xyz"])
    return out


def unexplained_share(signature: Array, columns: Array) -> float:
    """Squared share of a signature that no combination of columns (K, free, n) reproduces."""
    a = columns.reshape(-1, columns.shape[-1])
    a = a[:, np.abs(a).max(0) > 0.0]
    b = signature.ravel()
    if not a.size or not b.any():
        return 1.0
    a = a / np.linalg.norm(a, axis=0)
    left = b - a @ np.linalg.lstsq(a, b, rcond=None)[0]
    return float(left @ left / (b @ b))


def equivalents(
    vehicle: Vehicle, effect: Effect, run: Run, commands: Array, error: float
) -> list[list[str | None]]:
    """Named effects that act as this one does within the noise of a whole case.

    `error` is the mean square prediction error that the effect causes, in units of the noise.
    Delay, lag and sensor effects add no acceleration here and so have no equal.
    """
    signature = added_acceleration(vehicle, [effect], run, commands)
    out: list[list[str | None]] = []
    for suspect, columns in suspect_columns(vehicle, [effect], run, commands):
        name, target = suspect.effect, suspect.target
        if (name, target) == (effect.effect, effect.target):
            continue
        lost = unexplained_share(signature, columns) * error * SAMPLES * 3 * len(vehicle.free)
        if lost < DISTINCT:
            out.append([name, target])
    return out


def nearest(
    vehicle: Vehicle, outside: Sequence[Outside], run: Run, commands: Array
) -> tuple[str, str | None, float]:
    """The named effect nearest to effects outside the catalogue, and the share it leaves."""
    signature = added_acceleration(vehicle, outside, run, commands)
    shares = [
        (round(unexplained_share(signature, columns), 3), suspect)
        for suspect, columns in suspect_columns(vehicle, outside, run, commands)
    ]
    share, effect = min(shares, key=lambda x: x[0])
    return effect.effect, effect.target, share


def likeness(vehicle: Vehicle, first: Effect, second: Effect, run: Run, commands: Array) -> float:
    """Cosine between what two effects add to the acceleration."""
    a, b = (added_acceleration(vehicle, [e], run, commands).ravel() for e in (first, second))
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return abs(float(a @ b)) / size if size else 0.0
