"""Chapter 3 of the thesis as an experiment: its classes of controllers on one craft, and a predictive one.

usage: python -m experiments.chapter3 --out DIR [--seeds N] [--quick]

A BlueROV2 Heavy follows a path in surge, sway, heave and yaw through its eight thrusters, in a current that
nobody tells it of. A third of the way weed takes most of one thruster's force, at two thirds it takes up a
payload. Position, heading and velocities are measured with noise. All controllers begin with the file.
Every seed draws current, thruster, payload, noise and way points; of a seed all controllers see the same.

Model-predictive control sends commands through the simulation's own integration and corrects them by
Levenberg-Marquardt of optimistix; commands are within the thrusters' limits by construction, the depth by a
penalty. The last tables give it, after all three have happened, the file, the vehicle that a diagnosis of two
dives under PID has extended, or that of a fit which is told the three causes. Rows and diagnoses are kept in
`DIR`: a run that was cut goes on there.
"""

import dataclasses
import json
import time
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import typer
from jaxtyping import Array, Float
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import claim_table, decided, spread, study, write_results
from experiments.thesis.controllers import AXES, DT, MOST, PID, SONCS, Axes, Controller, Seen, all_of
from jaxmarine import control
from jaxmarine.control._follow import _off
from jaxmarine.effects import Payload, SteadyCurrent, ThrusterGain
from jaxmarine.physics import to_euler
from jaxmarine.simulation import asked, hold
from jaxmarine.vehicle import Input, Plant

HERE = Path(__file__).parent / "control"
DOF = ("surge", "sway", "heave", "yaw")
# Of a good ROV: 2 cm by an acoustic system, 0.01 rad, 1 cm/s by a Doppler log, 0.01 rad/s.
SENSORS = (("position", 0.02), ("attitude", 0.01), ("velocity", 0.01), ("rate", 0.01))
NOISE = np.repeat([size for _, size in SENSORS], 3) * np.isin(np.arange(12) % 6, AXES)
CURRENT, WEED, PAYLOAD = 0.2, 0.3, (2.0, 0.001)  # [m/s], share of thrust that is left, [kg] and [m³]
DEEPEST = 4.0  # [m] floor that the payload pulls towards; the path goes down to 3.8 m
AWAY = 2.0  # [m] from the path: the dive has failed
DIAGNOSED = 12  # seeds at most whose causes are looked for: some minutes each
STRETCH = 15.0  # [s] between trainings of those that learn outside of the loop
MOVES, EACH = 6, 2  # of the predictive controller: so many commands, each held for so many samples
SOLVES = 6  # steps of Levenberg-Marquardt for each command, from the last plan
BEND = 2.0  # largest argument of the tanh that keeps commands within 1: 0.96 of the thrust, with slope left


@dataclasses.dataclass(frozen=True)
class Size:
    """Length of a dive [s], and steps of Adam before it and under way."""

    dive: float = 90.0
    before: int = 1500
    under_way: int = 100


QUICK = Size(dive=15.0, before=50, under_way=5)


class Case(eqx.Module):
    """What a seed draws: `current` [m/s], `factor` of each thruster once there is weed, `payload` [kg, m³],
    and by what sensors are off at each sample; `when` [s] weed and payload come."""

    current: Float[Array, "2"]
    factor: Float[Array, "8"]
    payload: Float[Array, "2"]
    when: Float[Array, "2"]
    errors: Float[Array, "times 12"]


def craft() -> jm.Vehicle:
    """The packaged craft with these sensors, level: roll and pitch are held by its weight."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle("bluerov2_heavy"))
    return dataclasses.replace(vehicle, dof=DOF, sensors=SENSORS)


def drawn(seed: int, size: Size) -> tuple[Case, control.Path]:
    """The case and the path of a seed: six way points in a box of 6 by 6 by 2 m, heading where it likes."""
    rng = np.random.default_rng(seed)
    towards = rng.uniform(0.0, 2 * np.pi)
    factor = np.ones(8)
    factor[rng.integers(8)] = WEED
    mass, volume = np.array(PAYLOAD) * rng.uniform(0.5, 1.5)
    count = round(size.dive / 15.0) + 1
    pose = np.zeros((count, 6))
    pose[:, :2] = np.cumsum(rng.uniform(-3.0, 3.0, (count, 2)), axis=0)
    pose[:, 2] = rng.uniform(1.8, 3.8, count)
    pose[:, 5] = np.cumsum(rng.uniform(-1.0, 1.0, count))
    path = control.plan(np.linspace(0.0, size.dive, count), pose)
    times = round(size.dive / DT)
    errors = NOISE * rng.standard_normal((times, 12))
    when = size.dive / 3 * np.array([1.0, 2.0])
    current = CURRENT * np.array([np.cos(towards), np.sin(towards)])
    return Case(*map(jnp.asarray, (current, factor, np.array([mass, volume]), when, errors))), path


def troubled(vehicle: jm.Vehicle, case: Case, weed, load) -> jm.Vehicle:
    """The craft in the current, with weed and payload as far as they are there (0 or 1)."""
    zero = jnp.zeros(())
    mass, volume = load * case.payload
    return vehicle.place(
        jm.Placed(SteadyCurrent(case.current[0], case.current[1], zero)),
        jm.Placed(ThrusterGain(1.0 + weed * (case.factor - 1.0))),
        jm.Placed(Payload(mass, volume, zero, zero, zero)),
    )


def pushed(plant: Plant, command: Float[Array, "8"]) -> Float[Array, "8"]:
    """Thrust of commands that are held [N]: these thrusters have no lag."""
    return asked(plant, command, DT).now[0]


def moved(plant: Plant, state: jm.State, command, dt: float, split: int) -> jm.State:
    """One hold of the simulation."""
    zero = jnp.zeros(())
    return hold(plant, state, Input(pushed(plant, command), command, jnp.zeros(6), zero), dt, split)


class Allocator(eqx.Module):
    """Commands of a wrench on the four axes by the pseudo-inverse of the file's thrusters, and back."""

    effect: Float[Array, "4 8"]

    @classmethod
    def of(cls, vehicle: jm.Vehicle) -> "Allocator":
        return cls(vehicle.plant().allocation[AXES] * vehicle.thrusters.max_thrust[None])

    def __call__(self, wrench) -> Float[Array, "8"]:
        return jnp.clip(jnp.linalg.pinv(self.effect) @ wrench, -1.0, 1.0)


# --- model-predictive control --------------------------------------------------------------------


class Predictive(eqx.Module):
    """Commands whose simulated motion stays on the reference: `MOVES` of them, the first is sent.

    Least squares of the way off (5 cm, 0.05 rad), the slip (0.2), commands (3), their changes (0.5) and depth
    beyond the floor (2 cm).

    - `vehicle`: what it predicts with. `observed`: how fast a constant wrench is learned that the predictions
      lack, per sample; 0: not.
    """

    vehicle: jm.Vehicle
    observed: float = eqx.field(static=True, default=0.0)

    def begin(self, key):
        del key
        return jnp.zeros((MOVES, 8)), jnp.zeros(6), jnp.zeros(6)

    def plan(self, memory, wanted: jm.State, seen: jm.State):
        """`wanted`: the reference at the ends of the moves."""
        plan, bias, expected = memory
        plant = self.vehicle.plant()
        # What the water remembers, where a cause says that it does, nobody measures: it begins at rest.
        seen = dataclasses.replace(seen, memory=jm.initial_state(self.vehicle).memory)
        if self.observed:
            first = jnp.where(jnp.any(expected != 0), 1.0, 0.0)
            bias = bias + first * self.observed * (self.vehicle.mass_matrix @ (seen.velocity - expected)) / DT
            bias = bias * np.isin(np.arange(6), AXES)

        def roll(plan, bias):
            def step(state, command):
                drive = Input(pushed(plant, command), command, bias, jnp.zeros(()))
                after = hold(plant, state, drive, EACH * DT, 1)
                return after, after

            return jax.lax.scan(step, seen, jnp.tanh(plan))[1]

        def residuals(plan, bias):
            states = roll(plan, bias)
            off = jax.vmap(_off)(wanted, states)[:, AXES] / 0.05
            slip = (wanted.velocity - states.velocity)[:, AXES] / 0.2
            command = jnp.tanh(plan)
            below = jnp.maximum(states.position[:, 2] - DEEPEST, 0.0) / 0.02
            # The root of the squares keeps plans within tanh's bend.
            parts = (off, slip, command / 3.0, jnp.diff(command, axis=0) / 0.5, below, 0.01 * plan)
            return jnp.concatenate([part.ravel() for part in parts])

        # A plan that a disturbance has led into the bends of tanh is left for none, where that costs less.
        none = jnp.zeros_like(plan)
        cost, of_none = (jnp.sum(residuals(one, bias) ** 2) for one in (plan, none))
        plan = jnp.where(cost < of_none, plan, none)
        solver = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3)
        found = optx.least_squares(residuals, solver, plan, bias, max_steps=SOLVES, throw=False)
        plan = jnp.clip(jnp.where(jnp.isfinite(found.value), found.value, 0.0), -BEND, BEND)
        command = jnp.tanh(plan[0])
        drive = Input(pushed(plant, command), command, bias, jnp.zeros(()))
        expected = hold(plant, seen, drive, DT, 1).velocity
        return command, (plan, bias, expected)


# --- a dive --------------------------------------------------------------------------------------


class Samples(eqx.Module):
    """The reference at each sample, and at the ends of the predictive controller's moves."""

    t: Float[Array, " times"]
    states: jm.State
    acceleration: Float[Array, "times 6"]
    ahead: jm.State

    @classmethod
    def of(cls, path: control.Path, size: Size) -> "Samples":
        t = np.arange(round(size.dive / DT)) * DT
        at = path.at(t)
        ends = t[:, None] + DT * EACH * np.arange(1, MOVES + 1)
        far = path.at(ends.ravel()).states
        ahead = jax.tree.map(lambda a: a.reshape(len(t), MOVES, *a.shape[1:]), far)
        return cls(jnp.asarray(t), at.states, at.acceleration, ahead)


class Flight(eqx.Module):
    """What came of a dive: way off and depth [m], commands, states, and what networks may learn from."""

    off: Float[Array, " times"]
    depth: Float[Array, " times"]
    commands: Float[Array, "times 8"]
    nu: Float[Array, "times 4"]
    wrench: Float[Array, "times 4"]
    slope: Float[Array, "times 4"]
    states: jm.State
    seen: jm.State


def flown(
    file: jm.Vehicle, pilot: Controller | Predictive, memory, case: Case, samples: Samples, state, always
):
    """A stretch of a dive from a state on; `always`: weed and payload are there from the beginning."""
    allocate = Allocator.of(file)

    def step(now, given):
        state, memory, before, nu_before = now
        t, wanted, push, ahead, error = given
        weed, load = jnp.maximum(jnp.where(t >= case.when - 1e-6, 1.0, 0.0), always)
        plant = troubled(file, case, weed, load).plant()
        seen = state.moved(error)
        if isinstance(pilot, Predictive):
            command, memory = pilot.plan(memory, ahead, seen)
        else:
            told = Seen.of(file, wanted, push, seen, before, nu_before)
            wrench, memory = pilot(memory, told)
            command = allocate(wrench)
        command = jnp.clip(command, -1.0, 1.0)
        after = moved(plant, state, command, DT, 2)
        sent = allocate.effect @ command
        out = Flight(
            off=jnp.linalg.norm(wanted.position - state.position),
            depth=state.position[2],
            commands=command,
            nu=nu_before,
            wrench=before,
            slope=(seen.velocity[AXES] - nu_before) / DT,
            states=state,
            seen=seen,
        )
        return (after, memory, sent, seen.velocity[AXES]), out

    over = (samples.t, samples.states, samples.acceleration, samples.ahead, case.errors)
    start = (*state[:1], memory, *state[1:])
    (after, memory, sent, nu), flight = jax.lax.scan(step, start, over)
    return (after, sent, nu), memory, flight


# One program for all seeds at once, with one controller, or one for each.
_flown = eqx.filter_jit(eqx.filter_vmap(flown, in_axes=(None, None, 0, 0, 0, 0, None)))
_each_its_own = eqx.filter_jit(eqx.filter_vmap(flown, in_axes=(None, 0, 0, 0, 0, 0, None)))


def begun(samples: Samples) -> tuple:
    """At rest on the reference; nothing was sent yet."""
    state = jax.tree.map(lambda a: a[:, 0], samples.states)
    none = jnp.zeros((len(samples.t), 4))
    return state, none, none


@eqx.filter_jit
def _taught(pilot: SONCS, file: jm.Vehicle, key, steps: int):
    """Networks that were trained on the file's craft, at velocities and wrenches drawn at random."""
    first, second, third, fourth = jax.random.split(key, 4)
    nu = 0.5 * jax.random.uniform(first, (256, 4), minval=-1.0, maxval=1.0)
    wrench = MOST[None] * jax.random.uniform(second, (256, 4), minval=-1.0, maxval=1.0)
    mass, linear, quadratic = (x[None] for x in (pilot.axes.mass, pilot.axes.linear, pilot.axes.quadratic))
    slope = (wrench - linear * nu - quadratic * jnp.abs(nu) * nu) / mass
    return pilot.learned(pilot.begin(third), nu, wrench, slope, fourth, steps)


@eqx.filter_jit
def _taught_again(pilot: SONCS, memory, flight: Flight, keys, steps: int):
    def one(memory, nu, wrench, slope, key):
        return pilot.learned(memory, nu[1:], wrench[1:], slope[1:], key, steps)

    return jax.vmap(one)(memory, flight.nu, flight.wrench, flight.slope, keys)


def dive(
    file: jm.Vehicle,
    pilot,
    cases: Case,
    samples: Samples,
    size: Size,
    always: float = 0.0,
    program: Any = _flown,
):
    """All seeds' dives under one controller, in stretches between which it may learn.

    Returns what came of them, and the CPU time of one sample of one seed [ms], without compiling and without
    what is learned between stretches.
    """
    count, length = samples.t.shape
    keys = jax.random.split(jax.random.key(0), count)
    memory = jax.vmap(pilot.begin)(keys)
    if isinstance(pilot, SONCS):
        one = _taught(pilot, file, keys[0], size.before)
        memory = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), one)
        length = round(STRETCH / DT)
    now, from_start, compiled, cpu, parts = begun(samples), jnp.asarray(always), None, 0.0, []
    for k in range(samples.t.shape[1] // length):
        part = slice(k * length, (k + 1) * length)
        cut = jax.tree.map(lambda a, part=part: a[:, part], samples)
        own = eqx.tree_at(lambda c: c.errors, cases, cases.errors[:, part])
        given = (file, pilot, memory, own, cut, now, from_start)
        compiled = compiled or program.lower(*given).compile()
        began = time.process_time()
        now, memory, flight = jax.block_until_ready(compiled(*given))
        cpu += time.process_time() - began
        parts.append(flight)
        if isinstance(pilot, SONCS):
            memory = _taught_again(pilot, memory, flight, keys, size.under_way)
    flight = jax.tree.map(lambda *a: jnp.concatenate(a, axis=1), *parts)
    return flight, 1e3 * cpu / flight.off.size


def row(flight: Flight) -> dict[str, Any]:
    """Per seed: rms of the way off [m] in each third and over all, mean square command, failures."""
    off = np.asarray(flight.off)
    finite = np.isfinite(off).all(axis=1)
    off = np.where(np.isfinite(off), off, 1e3)
    failed = ~finite | (off.max(axis=1) > AWAY)
    thirds = [np.sqrt((part**2).mean(axis=1)).tolist() for part in np.array_split(off, 3, axis=1)]
    return {
        "rms_m": np.sqrt((off**2).mean(axis=1)).tolist(),
        "thirds_rms_m": thirds,
        "effort": np.nanmean(np.asarray(flight.commands) ** 2, axis=(1, 2)).tolist(),
        "failed": failed.tolist(),
        "deepest_m": np.nanmax(np.asarray(flight.depth), axis=1).tolist(),
    }


# --- what naming the cause buys ------------------------------------------------------------------


def logged(file: jm.Vehicle, flight: Flight, k: int) -> jm.Log:
    """What sensors showed of dive k."""
    seen = jax.tree.map(lambda a: np.asarray(a)[k], flight.seen)
    count = len(seen.position)
    channels = np.full((count, 18), np.nan)
    channels[:, :3] = seen.position
    channels[:, 3:6] = np.asarray(jax.vmap(to_euler)(jnp.asarray(seen.attitude)))
    channels[:, 6:12] = seen.velocity
    channels[:, :12][:, NOISE == 0] = np.nan
    commands = np.asarray(flight.commands[k])
    return jm.Log(np.arange(count) * DT, channels, commands, None, file.thruster_names, f"dive {k}")


def heavier(file: jm.Vehicle, mass, volume) -> float:
    """What a payload of a mass [kg] and a volume [m³] weighs in water [N]."""
    return float(9.81 * (mass - file.density * volume))


def told(file: jm.Vehicle, log: jm.Log) -> tuple[jm.Vehicle, dict[str, Any]]:
    """The vehicle of the three causes, by `jm.fit` to one dive, and what it found of them."""
    zero = jnp.zeros(())
    begun = file.place(
        jm.Placed(SteadyCurrent(zero, zero, zero)),
        jm.Placed(ThrusterGain(jnp.ones(8))),
        jm.Placed(Payload(zero, zero, zero, zero, zero)),
    )

    def free(vehicle):
        water, gain, load = (one.effect for one in vehicle.placed)
        return water.north, water.east, gain.factor, load.mass, load.volume

    prior = (0.3, 0.3, np.full(8, 0.3), 3.0, 0.003)
    fit = jm.fit(begun, log, free, prior=tuple(map(jnp.asarray, prior)), throw=False)
    found = free(fit.vehicle)
    return fit.vehicle, {
        "current": [float(found[0]), float(found[1])],
        "factor": np.asarray(found[2]).tolist(),
        "heavier_N": heavier(file, found[3], found[4]),
    }


def diagnosed(file: jm.Vehicle, train: jm.Log, test: jm.Log, kept: Path) -> tuple[jm.Vehicle, dict[str, Any]]:
    """The vehicle that `jm.diagnose` of two dives extends the file to, and the names; both are kept there."""
    if not (kept / "found.json").exists():
        kept.mkdir(parents=True, exist_ok=True)
        answer = jm.diagnose(file, train, test)
        jm.save_vehicle(answer.extended, kept / "extended.toml")
        names = {
            one.label: {name: number.value for name, number in one.parameters.items()}
            for one in answer.findings
            if one.named
        }
        found = {"verdict": answer.verdict, "names": names}
        (kept / "found.json").write_text(json.dumps(found), encoding="utf-8")
    return jm.load_vehicle(kept / "extended.toml"), json.loads((kept / "found.json").read_text())


def hidden(file: jm.Vehicle, case: Case) -> dict[str, Any]:
    """What is true of a case, as `told` finds it."""
    return {
        "current": np.asarray(case.current).tolist(),
        "factor": np.asarray(case.factor).tolist(),
        "heavier_N": heavier(file, *case.payload),
    }


# --- what is written -----------------------------------------------------------------------------

FEEDFORWARD, LQ, TUNING = "PID and feedforward of the file", "LQ with integral", "self-tuning"
REFERENCE, PERCEPTRON, CMAC = (
    "model-reference adaptive",
    "CCL: perceptron beside PD",
    "SCL: CMAC beside PD",
)
AUGMENTED = "AC: PD, file and adaptive layer"
FILED, OBSERVED = "MPC with the file", "MPC with the file and an observer"
NAMED, FITTED = "MPC with the diagnosed causes", "MPC with the causes, told and fitted"
TRUE = "MPC with the true causes"
# Each controller against the simpler one that it is to be better than: which is less off, dive by dive.
CLAIMS = (
    (FEEDFORWARD, "PID"),
    (LQ, "PID"),
    (TUNING, "PID"),
    (REFERENCE, "PID"),
    (PERCEPTRON, "PID"),
    (CMAC, "PID"),
    (AUGMENTED, FEEDFORWARD),
    (PERCEPTRON, TUNING),
    (PERCEPTRON, REFERENCE),
    (FILED, FEEDFORWARD),
    (FILED, LQ),
    (OBSERVED, FILED),
    (OBSERVED, LQ),
)


NAMED_CLAIMS = (
    (NAMED, FILED),
    (NAMED, OBSERVED),
    (NAMED, FITTED),
    (OBSERVED, FILED),
    (TRUE, NAMED),
)


def claims(rows: dict[str, dict[str, Any]], pairs: tuple[tuple[str, str], ...]) -> list[dict[str, Any]]:
    """The claims, decided by pairs of the same dive."""
    return decided(
        {
            f"{one}: less off than {other}": list(zip(rows[one]["rms_m"], rows[other]["rms_m"], strict=True))
            for one, other in pairs
        }
    )


def counted(found: list[dict[str, Any]]) -> str:
    """How many diagnoses name what, where current, weed and a weight are hidden in all of them."""
    kinds = [{label.split(":")[0] for label in one["diagnosed"]["names"]} for one in found]
    count = {kind: sum(kind in own for own in kinds) for kind in sorted(set().union(*kinds))}
    lines = ["| named | diagnoses |", "|---|---|"]
    lines += [
        f"| `{kind}` | {count[kind]} of {len(found)} |" for kind in sorted(count, key=lambda k: -count[k])
    ]
    return "\n".join(lines) + "\n"


def markdown(results: dict[str, Any]) -> str:
    lines = [
        "| controller | way off, rms m | current | and weed | and payload | effort | failed | ms of CPU |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, one in results["controllers"].items():
        thirds = [f"{np.median(part):.3f}" for part in one["thirds_rms_m"]]
        failed, effort = f"{sum(one['failed'])} of {len(one['failed'])}", np.median(one["effort"])
        lines.append(
            f"| {name} | {spread(one['rms_m'], 3)} | {' | '.join(thirds)} | {effort:.3f} | {failed} "
            f"| {one['cpu_ms']:.2g} |"
        )
    if results["claims"]:
        lines += ["", claim_table(results["claims"]).rstrip()]
    if results["named"]:
        lines += [
            "",
            "| all three from the beginning | way off, rms m | deepest m | failed |",
            "|---|---|---|---|",
        ]
        for name, one in results["named"].items():
            failed = f"{sum(one['failed'])} of {len(one['failed'])}"
            deepest = spread(one["deepest_m"], 2)
            lines.append(f"| {name} | {spread(one['rms_m'], 3)} | {deepest} | {failed} |")
        lines += ["", claim_table(results["named_claims"]), counted(results["found"]).rstrip()]
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and table.")],
    seeds: Annotated[int, typer.Option(min=1, help="Dives of each controller.")] = 20,
    quick: Annotated[bool, typer.Option("--quick", help="Two short dives, few controllers.")] = False,
) -> None:
    """Controllers of chapter 3 of the thesis on one craft with current, weed and payload."""
    size, seeds = (QUICK, 2) if quick else (Size(), seeds)
    with study(out, quick), Progress(transient=True) as bar:
        file = craft()
        both = [drawn(seed, size) for seed in range(seeds)]
        cases = jax.tree.map(lambda *a: jnp.stack(a), *(case for case, _ in both))
        samples = jax.tree.map(lambda *a: jnp.stack(a), *(Samples.of(path, size) for _, path in both))
        pilots: dict[str, Any] = dict(all_of(file))
        pilots[FILED] = Predictive(file)
        pilots[OBSERVED] = Predictive(file, 0.1)
        if quick:
            pilots = {name: pilots[name] for name in ("PID", "SCL: SONCS", FILED)}
        asked = {"dive_s": size.dive, "seeds": seeds}
        results: dict[str, Any] = asked | {"controllers": {}, "claims": [], "named": {}}
        if (out / "results.json").exists():
            kept = json.loads((out / "results.json").read_text())
            results = kept if asked.items() <= kept.items() else results
        for name, pilot in bar.track(pilots.items(), description="controllers"):
            if name not in results["controllers"]:
                flight, cpu = dive(file, pilot, cases, samples, size)
                results["controllers"][name] = row(flight) | {"cpu_ms": cpu}
                write_results(out, results, markdown(results))
        if not quick:
            results["claims"] = claims(results["controllers"], CLAIMS)
            some, paths = jax.tree.map(lambda a: a[:DIAGNOSED], (cases, samples))
            results |= causes(file, some, paths, size, out / "parts")
            write_results(out, results, markdown(results))


def causes(file: jm.Vehicle, cases: Case, samples: Samples, size: Size, parts: Path) -> dict[str, Any]:
    """With all three from the beginning: two dives under PID, from which causes are found, then a third one.

    The second and the third dive of a seed have the paths of its neighbours, and their noise.
    """
    seeds, pilot = len(samples.t), PID(Axes.of(file))

    def flight_of(n: int, pilot, program=_flown, some=slice(None)) -> Flight:
        """The n-th dive of some seeds."""
        path = jax.tree.map(lambda a: jnp.roll(a, n, axis=0)[some], samples)
        noisy = eqx.tree_at(lambda c: c.errors, cases, jnp.roll(cases.errors, n, axis=0))
        return dive(file, pilot, jax.tree.map(lambda a: a[some], noisy), path, size, 1.0, program)[0]

    train, test = (flight_of(n, pilot) for n in range(2))
    fits, extended, found = [], [], []
    for k in range(seeds):
        log, unseen = (logged(file, flight, k) for flight in (train, test))
        vehicle, by_fit = told(file, log)
        fits.append(vehicle)
        vehicle, by_diagnosis = diagnosed(file, log, unseen, parts / f"{k} of {seeds}")
        extended.append(vehicle)
        case = jax.tree.map(lambda a, k=k: a[k], cases)
        found.append({"true": hidden(file, case), "fitted": by_fit, "diagnosed": by_diagnosis})
    always = jnp.ones(())
    runs = {
        FILED: (Predictive(file), _flown),
        OBSERVED: (Predictive(file, 0.1), _flown),
        FITTED: (Predictive(jax.tree.map(lambda *a: jnp.stack(a), *fits)), _each_its_own),
        TRUE: (Predictive(jax.vmap(lambda case: troubled(file, case, always, always))(cases)), _each_its_own),
    }
    rows = {name: row(flight_of(2, *run)) for name, run in runs.items()}
    # Each diagnosis has named causes of its own, which is a program of its own.
    alone = [flight_of(2, Predictive(one), some=slice(k, k + 1)) for k, one in enumerate(extended)]
    rows[NAMED] = row(jax.tree.map(lambda *a: jnp.concatenate(a), *alone))
    return {"named": rows, "found": found, "named_claims": claims(rows, NAMED_CLAIMS)}


if __name__ == "__main__":
    typer.run(main)
