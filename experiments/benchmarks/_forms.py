"""One vehicle written out by hand: in C, casadi, numba, numpy and jax, all with the same equations.

The state is one vector of 13: position [m] NED, quaternion body to world, velocity in body axes; the wrench
is held over each step. `M nu' + C(nu) nu + D_l nu + D_q |nu| nu + g = tau` with dense matrices.
"""

import ctypes
import dataclasses
import importlib
import os
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxmarine as jm
from experiments.benchmarks._rounds import Missing, Run, threads
from jaxmarine.examples import operator

DT = 0.1  # [s]
SOURCE = Path(__file__).with_name("vehicle.c")
_SHARES, _WEIGHTS = (0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)

Wrenches = Float[np.ndarray, "*vehicles steps 6"]
States = Float[np.ndarray, "*vehicles steps 13"]
Starts = Float[np.ndarray, "*vehicles 13"]


class Model(NamedTuple):
    """The numbers of a vehicle without current, in the order of `model_t` in vehicle.c.

    - `heavy`: weight less buoyancy [N]; `moment`: of both about `o`, force times lever arm [N m].
    """

    inverse: Any
    mass: Any
    linear: Any
    quadratic: Any
    heavy: Any
    moment: Any

    @classmethod
    def of(cls, vehicle: jm.Vehicle) -> Self:
        plant = vehicle.plant()
        load = plant.load
        numbers = (
            plant.inverse_mass,
            load.rigid + load.added,
            plant.damping.linear,
            plant.damping.quadratic,
            load.weight - load.buoyancy,
            load.weight_moment - load.buoyancy_moment,
        )
        return cls(*map(np.asarray, numbers))


@dataclasses.dataclass(frozen=True)
class Dive:
    """Vehicles that start anywhere and are pushed by sticks: what every contender rolls out.

    - `starts` [vehicles, 13], `wrenches` [vehicles, steps, 6].
    """

    vehicle: jm.Vehicle
    model: Model
    starts: Starts
    wrenches: Wrenches

    @classmethod
    def of(cls, vehicles: int, steps: int) -> Self:
        """Of the ROV Tethra."""
        vehicle = jm.load_vehicle(jm.packaged_vehicle("tethra"))
        plant, rng = vehicle.plant(), np.random.default_rng(0)
        count = len(vehicle.command_names)
        # Some operators are enough: others differ by their starts.
        commands = np.stack(
            [operator(count, DT * np.arange(steps), seed) for seed in range(min(vehicles, 20))]
        )
        wrenches = commands @ np.asarray(plant.allocation * plant.drive.max_thrust[None]).T
        starts = np.zeros((vehicles, 13))
        starts[:, 3:7] = np.array([1.0, 0.0, 0.0, 0.0]) + 0.1 * rng.normal(size=(vehicles, 4))
        starts[:, 3:7] /= np.linalg.norm(starts[:, 3:7], axis=1, keepdims=True)
        starts[:, 7:] = 0.1 * rng.normal(size=(vehicles, 6))
        return cls(vehicle, Model.of(vehicle), starts, wrenches[np.arange(vehicles) % len(wrenches)])

    @property
    def steps(self) -> int:
        return self.wrenches.shape[1]


# --- numpy and jax --------------------------------------------------------------------------------


def _cross(a, b, xp):
    return xp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def rates(model: Model, state, tau, xp: Any = jnp, product=lambda a, v: (a * v[None]).sum(-1)):
    """Rates of the state [13, ...] under wrenches [6, ...]; batches lie behind.

    - `product`: of a matrix and one vector, or of a matrix and a batch of them.
    """
    size = xp.sqrt((state[3:7] ** 2).sum(0))
    w, x, y, z = (row / size for row in state[3:7])
    nu = state[7:]
    turn = xp.stack(
        [
            xp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]),
            xp.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]),
            xp.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]),
        ]
    )
    w, x, y, z = state[3:7]
    p, q, r = nu[3:]
    spin = 0.5 * xp.stack(
        [-x * p - y * q - z * r, w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p]
    )
    # One product for all that is linear in the velocity.
    both = product(xp.concatenate([model.mass, model.linear]), nu)
    momentum, drag = both[:6], both[6:] + product(model.quadratic, xp.abs(nu) * nu)
    force = tau[:3] - _cross(nu[3:], momentum[:3], xp) + model.heavy * turn[2]
    turned = _cross(nu[:3], momentum[:3], xp) + _cross(nu[3:], momentum[3:], xp)
    moment = tau[3:] - turned + _cross(model.moment, turn[2], xp)
    acceleration = product(model.inverse, xp.concatenate([force, moment]) - drag)
    return xp.concatenate([(turn * nu[None, :3]).sum(1), spin, acceleration])


def rk4(rates, state, dt=DT):
    """One step of the classical Runge-Kutta method on `rates(state)`, stage by stage."""
    slope, total = jnp.zeros_like(state), jnp.zeros_like(state)
    for share, weight in zip(_SHARES, _WEIGHTS, strict=True):
        slope = rates(state + share * dt * slope)
        total = total + weight * slope
    return state + dt * total


def rk4_in_loop(rates, state, dt=DT):
    """The same with the stages as a loop, so that the equations are compiled once and stay in cache."""

    def stage(carry, now):
        slope, total = carry
        slope = rates(state + now[0] * dt * slope)
        return (slope, total + now[1] * slope), None

    nothing = jnp.zeros_like(state)
    (_, total), _ = jax.lax.scan(stage, (nothing, nothing), jnp.array([_SHARES, _WEIGHTS]).T)
    return state + dt * total


@jax.jit
def by_jax(model: Model, start: Float[Array, "13"], wrenches: Float[Array, "steps 6"]):
    """One vehicle; states at the ends of all holds."""

    def step(state, tau):
        after = rk4(lambda s: rates(model, s, tau), state)
        return after, after

    return jax.lax.scan(step, start, wrenches)[1]


@jax.jit
def by_jax_batch_last(model: Model, starts: Float[Array, "13 vehicles"], wrenches):
    """Many vehicles alike, wrenches [steps, 6, vehicles]; states [steps, 13, vehicles]."""

    def step(state, tau):
        after = rk4_in_loop(lambda s: rates(model, s, tau, product=jnp.matmul), state)
        return after, after

    return jax.lax.scan(step, starts, wrenches)[1]


# --- C ----------------------------------------------------------------------------------------------


def library() -> ctypes.CDLL:
    """vehicle.c by the system's compiler, for this very processor."""
    compiler = next(filter(None, map(shutil.which, (os.environ.get("CC", "cc"), "gcc", "clang"))), None)
    if compiler is None:
        raise Missing("no C compiler found")
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "vehicle.so"
        flags = ["-O3", "-march=native", "-shared", "-fPIC"]
        command = [compiler, *flags, str(SOURCE), "-o", str(made), "-lm"]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        if ran.returncode:
            raise Missing(f"{compiler} does not compile {SOURCE.name}")
        return ctypes.CDLL(str(made))


def by_c(dive: Dive) -> Run:
    """All vehicles, shared out over the threads; states [vehicles, steps, 13]."""
    built, pointer = library(), ctypes.POINTER(ctypes.c_double)
    model = np.concatenate([np.ravel(part) for part in dive.model])
    states = np.empty((*dive.wrenches.shape[:2], 13))
    parts = np.array_split(np.arange(len(dive.starts)), min(threads(), len(dive.starts)))
    pool = ThreadPoolExecutor(len(parts))

    def numbers(array):
        return array.ctypes.data_as(pointer)

    def part(which):
        here = slice(which[0], which[-1] + 1)
        arrays = [numbers(a[here]) for a in (dive.wrenches, dive.starts, states)]
        built.roll_out(numbers(model), len(which), dive.steps, ctypes.c_double(DT), *arrays)

    def run():
        if len(parts) == 1:
            part(parts[0])
        else:
            list(pool.map(part, parts))
        return states

    return run


# --- casadi -----------------------------------------------------------------------------------------


def casadi_rates(ca: Any, model: Model, state: Any, tau: Any) -> Any:
    """`rates` as an expression of casadi; the mass matrix may be one too."""
    w, x, y, z = ca.vertsplit(state[3:7] / ca.norm_2(state[3:7]))
    nu = state[7:]
    turn = ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        ca.horzcat(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        ca.horzcat(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    w, vector = state[3], state[4:7]
    spin = 0.5 * ca.vertcat(-ca.dot(vector, nu[3:]), w * nu[3:] + ca.cross(vector, nu[3:]))
    momentum = model.mass @ nu
    a, b, down = momentum[:3], momentum[3:], turn[2, :].T
    force = tau - model.linear @ nu - model.quadratic @ (ca.fabs(nu) * nu)
    force -= ca.vertcat(ca.cross(nu[3:], a), ca.cross(nu[:3], a) + ca.cross(nu[3:], b))
    force += ca.vertcat(float(model.heavy) * down, ca.cross(model.moment, down))
    return ca.vertcat(turn @ nu[:3], spin, model.inverse @ force)


def casadi_step(rates: Any, state: Any) -> Any:
    """One step of the classical Runge-Kutta method on `rates(state)` as an expression."""
    slope, total = 0.0, 0.0
    for share, weight in zip(_SHARES, _WEIGHTS, strict=True):
        slope = rates(state + share * DT * slope)
        total += weight * slope
    return state + DT * total


def casadi_compiled(ca: Any, function: Any, flags: str = "-O3 -march=native") -> Any:
    """The function as C, by the system's compiler."""
    if shutil.which("gcc") is None:
        raise Missing("casadi compiles by gcc, which was not found")
    folder = Path(tempfile.mkdtemp(prefix="jaxmarine-casadi-"))
    try:
        code, made = folder / "function.c", folder / "function.so"
        generator = ca.CodeGenerator(code.name)
        generator.add(function)
        generator.generate(f"{folder}{os.sep}")
        command = ["gcc", *flags.split(), "-shared", "-fPIC", str(code), "-o", str(made), "-lm"]
        subprocess.run(command, check=True, capture_output=True)
        return ca.external(function.name(), str(made))
    finally:
        shutil.rmtree(folder)


def by_casadi(dive: Dive) -> Run:
    """One vehicle; states at the ends of all holds."""
    ca = importlib.import_module("casadi")
    state, tau = ca.SX.sym("state", 13), ca.SX.sym("tau", 6)
    after = casadi_step(lambda at: casadi_rates(ca, dive.model, at, tau), state)
    step = ca.Function("step", [state, tau], [after])
    roll_out = casadi_compiled(ca, step.mapaccum("roll_out", dive.steps))
    # Transposed here: casadi's matrices lie by columns.
    start, wrenches = ca.DM(dive.starts[0]), ca.DM(dive.wrenches[0].T)
    return lambda: np.asarray(roll_out(start, wrenches)).T


# --- numba ------------------------------------------------------------------------------------------


def by_numba(dive: Dive) -> Run:
    """One vehicle; states at the ends of all holds."""
    njit = importlib.import_module("numba").njit

    @njit
    def cross(a, b, out):
        out[0] = a[1] * b[2] - a[2] * b[1]
        out[1] = a[2] * b[0] - a[0] * b[2]
        out[2] = a[0] * b[1] - a[1] * b[0]

    @njit
    def product(a, v, out):
        for i in range(6):
            total = 0.0
            for j in range(6):
                total += a[i, j] * v[j]
            out[i] = total

    @njit
    def slopes(inverse, mass, linear, quadratic, heavy, moment, s, tau, out, room):
        nu = s[7:]
        size = 1.0 / np.sqrt(s[3] ** 2 + s[4] ** 2 + s[5] ** 2 + s[6] ** 2)
        w, x, y, z = s[3] * size, s[4] * size, s[5] * size, s[6] * size
        down, momentum, drag, by_square = room[0], room[1], room[2], room[3]
        squared, force, turned = room[4], room[5], room[6]
        out[0] = (1 - 2 * (y * y + z * z)) * nu[0] + 2 * (x * y - z * w) * nu[1] + 2 * (x * z + y * w) * nu[2]
        out[1] = 2 * (x * y + z * w) * nu[0] + (1 - 2 * (x * x + z * z)) * nu[1] + 2 * (y * z - x * w) * nu[2]
        down[0], down[1], down[2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
        out[2] = down[0] * nu[0] + down[1] * nu[1] + down[2] * nu[2]
        w, x, y, z = s[3], s[4], s[5], s[6]
        out[3] = 0.5 * (-x * nu[3] - y * nu[4] - z * nu[5])
        out[4] = 0.5 * (w * nu[3] + y * nu[5] - z * nu[4])
        out[5] = 0.5 * (w * nu[4] + z * nu[3] - x * nu[5])
        out[6] = 0.5 * (w * nu[5] + x * nu[4] - y * nu[3])
        product(mass, nu, momentum)
        product(linear, nu, drag)
        for i in range(6):
            squared[i] = abs(nu[i]) * nu[i]
        product(quadratic, squared, by_square)
        for i in range(6):
            force[i] = tau[i] - drag[i] - by_square[i]
        cross(nu[3:], momentum[:3], turned)
        for i in range(3):
            force[i] += heavy * down[i] - turned[i]
        cross(nu[:3], momentum[:3], turned)
        for i in range(3):
            force[3 + i] -= turned[i]
        cross(nu[3:], momentum[3:], turned)
        for i in range(3):
            force[3 + i] -= turned[i]
        cross(moment, down, turned)
        for i in range(3):
            force[3 + i] += turned[i]
        product(inverse, force, out[7:])

    @njit
    def roll_out(inverse, mass, linear, quadratic, heavy, moment, start, wrenches):
        states = np.empty((len(wrenches), 13))
        s, at, slope, total = start.copy(), np.empty(13), np.zeros(13), np.empty(13)
        room = np.empty((7, 6))
        for k in range(len(wrenches)):
            total[:] = 0.0
            for stage in range(4):
                for i in range(13):
                    at[i] = s[i] + _SHARES[stage] * DT * slope[i]
                slopes(inverse, mass, linear, quadratic, heavy, moment, at, wrenches[k], slope, room)
                for i in range(13):
                    total[i] += _WEIGHTS[stage] * slope[i]
            for i in range(13):
                s[i] += DT * total[i]
            states[k] = s
        return states

    matrices = [np.ascontiguousarray(part) for part in dive.model[:4]]
    numbers = (*matrices, float(dive.model.heavy), dive.model.moment)
    return lambda: roll_out(*numbers, dive.starts[0], dive.wrenches[0])
