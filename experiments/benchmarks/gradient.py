"""What do the derivatives of a trajectory loss cost, with 24 and with 426 parameters?

usage: python -m experiments.benchmarks.gradient --out DIR [--rounds 9] [--quick]

Windows of 50 samples of the ROV Tethra, compared with positions, attitudes and velocities. The 24
parameters are coefficients (added mass, linear and quadratic damping, a constant wrench), the 426 the
weights of six 12-5-1 networks. The unit is the forward pass that gives the residuals. Gradients are
compared with that of forward tangents, Gauss-Newton systems (J'J and J'r of the parameters) with those of
forward tangents. jaxmarine's system also has the initial states of all windows in it; its sensitivities are
those of the midpoint of a step, and differ by that. Writes results.json and results.md.
"""

import importlib
from pathlib import Path
from typing import Annotated, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import typer

from experiments.benchmarks._forms import Model, casadi_compiled, casadi_rates, casadi_step
from experiments.benchmarks._rounds import (
    Run,
    Table,
    Target,
    Uncompared,
    benchmark,
    compared,
    report,
    threads,
)
from experiments.benchmarks._windows import DT, Fitting, Networks, fitting, logged
from jaxmarine._compiled import compiled
from jaxmarine.fitting import linearise, predict, wrapped
from jaxmarine.simulation import RungeKutta4, hold
from jaxmarine.vehicle import Input, Plant, State

FORWARD, OURS = "forward pass", "jaxmarine, sensitivity recursion"
CASADI = "casadi, compiled by gcc"


# --- the loss, in a form that reverse mode can take -----------------------------------------------


def held(plant: Plant, state: State, drive: Input) -> State:
    """The package's step."""
    return hold(plant, state, drive, DT)


def solved(plant: Plant, state: State, drive: Input) -> State:
    """The same as a `diffeqsolve` of one step."""
    term = diffrax.ODETerm(lambda t, y, args: plant.rates(y, args))
    found = diffrax.diffeqsolve(term, RungeKutta4(), 0.0, DT, DT, state, drive, max_steps=1)
    return jax.tree.map(lambda a: a[0], found.ys)


def loss(theta, case: Fitting, step):
    """Half the sum of squares over all windows, each rolled out from its initial state."""
    problem, windows = case.problem, case.problem.windows
    plant = problem.plant_of(theta, jnp.array(0))
    thrust = plant.drive.max_thrust[None] * problem.records.commands[0]
    index = windows.step

    def one(position, attitude, velocity, index, measured, weight):
        def go(state, k):
            drive = Input(thrust[k], problem.records.commands[0, k], jnp.zeros(6), problem.records.t[0, k])
            return step(plant, state, drive), plant.readings(state, jnp.zeros(6))

        _, shown = jax.lax.scan(go, State(position, attitude, velocity, jnp.zeros(0)), index)
        return ((wrapped(shown - measured) * weight) ** 2).sum()

    parts = (windows.position, windows.attitude, windows.velocity, index, windows.measured, windows.weight)
    return 0.5 * jax.vmap(one)(*parts).sum()


def reverse(case: Fitting, rounds: int) -> Table:
    """Gradients by reverse mode; the unit is the loss itself by the same step."""

    def gradient(step):
        run = compiled(jax.grad(lambda theta, case: loss(theta, case, step)))
        return lambda: lambda: run(case.theta, case)

    value = compiled(lambda theta, case: Uncompared(loss(theta, case, held)))
    forward = compiled(jax.jacfwd(lambda theta, case: loss(theta, case, held)))
    reference = forward(case.theta, case)
    makers = {
        FORWARD: lambda: lambda: value(case.theta, case),
        "reverse": gradient(held),
        "reverse, steps recomputed": gradient(jax.checkpoint(held)),
        "reverse, diffeqsolve per step": gradient(solved),
        "forward tangents": lambda: lambda: forward(case.theta, case),
    }
    title = f"Gradient, {len(case.theta)} parameters, {len(case.delta)} windows"
    return compared(title, makers, reference, FORWARD, rounds)


# --- Gauss-Newton systems ---------------------------------------------------------------------------


def system(jacobian, residual):
    """J'J and J'r of any number of windows."""
    jacobian = jacobian.reshape(-1, jacobian.shape[-1])
    return jacobian.T @ jacobian, jacobian.T @ residual.reshape(-1)


def gauss_newton_of(case: Fitting):
    """The package's: initial states and parameters together."""
    stats = linearise(case.problem, case.affine, case.delta)
    return stats.h_zz.sum(0), stats.g_z.sum(0)


by_recursion = compiled(gauss_newton_of)


def residuals(theta, case: Fitting):
    return predict(case.problem, theta[None], case.delta)[1]


@eqx.filter_jit
def by_tangents(theta, case: Fitting):
    """One forward tangent per parameter through the solver, initial states held."""
    return system(jax.jacfwd(residuals)(theta, case), residuals(theta, case))


def by_differences(case: Fitting) -> Run:
    """scipy's forward differences, of the compiled residuals."""

    def run():
        values = np.asarray(residuals(case.theta, case)).ravel()
        jacobian = scipy.optimize.approx_fprime(
            np.asarray(case.theta),
            lambda theta: np.asarray(residuals(jnp.asarray(theta), case)).ravel(),
            1e-6,
        )
        return system(jacobian, values)

    return run


def by_casadi(case: Fitting) -> Run:
    """Sensitivities step by step, by the exact derivatives of the step; initial states held."""
    ca: Any = importlib.import_module("casadi")
    count, steps = len(case.theta), case.problem.windows.step.shape[1]
    numbers = Model.of(case.vehicle)

    def filled(name: str, *shape: int):
        return ca.SX.sym(name, *shape)

    state, tau, theta, inverse = (
        filled("x", 13),
        filled("tau", 6),
        filled("theta", 24),
        filled("inverse", 6, 6),
    )
    change = filled("change", 24)
    mass, linear, quadratic, push = (theta[k : k + 6] + change[k : k + 6] for k in range(0, 24, 6))
    model = Model(
        # Inverted once for all steps; to first order in the change, which is all that a derivative sees.
        inverse - inverse @ ca.diag(change[:6]) @ inverse,
        numbers.mass + ca.diag(mass),
        numbers.linear + ca.diag(linear),
        numbers.quadratic + ca.diag(quadratic),
        numbers.heavy,
        numbers.moment,
    )
    rates = casadi_rates(ca, model, state, tau + push)
    parts = (rates, ca.jacobian(rates, state), ca.jacobian(rates, change))
    parts = [ca.densify(ca.substitute(part, change, ca.SX.zeros(24))) for part in parts]
    slopes = ca.Function("slopes", [state, tau, theta, inverse], parts)

    measured, weight = filled("measured", 12), filled("weight", 12)
    w, x, y, z = ca.vertsplit(state[3:7] / ca.norm_2(state[3:7]))
    roll = ca.atan2(2 * (y * z + x * w), 1 - 2 * (x * x + y * y))
    pitch = ca.asin(2 * (y * w - x * z))
    yaw = ca.atan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z))
    error = ca.vertcat(state[:3], roll, pitch, yaw, state[7:]) - measured
    turns = ca.vertcat(ca.DM.zeros(3), ca.floor((error[3:6] + ca.pi) / (2 * ca.pi)), ca.DM.zeros(6))
    error = (error - 2 * ca.pi * turns) * weight
    slope = ca.densify(ca.jacobian(error, state))
    show = ca.Function("show", [state, measured, weight], [error, slope])

    sizes = [(13, 1), (13, count), (count, count), (count, 1)]
    carried = [ca.MX.sym(f"carried_{k}", *size) for k, size in enumerate(sizes)]
    given = [ca.MX.sym(f"given_{k}", *s) for k, s in enumerate([(6, 1), (12, 1), (12, 1), (24, 1), (6, 6)])]
    at, moved, h, g = carried
    error, slope = show(at, given[1], given[2])
    jacobian = slope @ moved

    def along(both):
        """Rates of the state and of its derivatives by the parameters, side by side."""
        rate, by_state, by_theta = slopes(both[:, 0], given[0], *given[3:])
        return ca.horzcat(rate, by_state @ both[:, 1:] + by_theta)

    after = casadi_step(along, ca.horzcat(at, moved))
    left = [after[:, 0], after[:, 1:], h + jacobian.T @ jacobian, g + jacobian.T @ error]
    window = ca.Function("one", [*carried, *given], left).mapaccum("window", steps, 4)
    run_all = casadi_compiled(ca, window).map(len(case.delta), "thread", threads())

    windows, records = case.problem.windows, case.problem.records
    commands = np.asarray(records.commands)[0][np.asarray(windows.step)]
    plant = case.vehicle.plant()
    pushed = commands @ np.asarray(plant.allocation * plant.drive.max_thrust[None]).T
    begun = np.concatenate([windows.position, windows.attitude, windows.velocity], axis=1)

    def columns(array):
        """Windows and steps as columns."""
        return np.asarray(array).reshape(-1, np.shape(array)[-1]).T

    total = len(case.delta)
    nothing = [np.zeros((rows, columns * total)) for rows, columns in sizes[1:]]
    fixed = [
        begun.T,
        *nothing,
        columns(pushed),
        columns(windows.measured[..., :12]),
        columns(windows.weight[..., :12]),
    ]

    def run():
        theta = np.asarray(case.theta)
        inverse = np.linalg.inv(numbers.mass + np.diag(theta[:6]))
        theta = np.tile(theta[:, None], total * steps)
        _, _, h, g = run_all(*fixed, theta, np.tile(inverse, total * steps))
        # After the last step of every window.
        h = np.asarray(h).reshape(count, total, steps, count)[:, :, -1].sum(1)
        return h, np.asarray(g).reshape(count, total, steps)[:, :, -1].sum(1)

    return run


def gauss_newton(case: Fitting, rounds: int, more: dict[str, Any]) -> Table:
    """Normal equations of the parameters; the unit is the forward pass that gives the residuals."""
    makers = {
        FORWARD: lambda: lambda: Uncompared(residuals(case.theta, case)),
        OURS: lambda: lambda: by_recursion(case),
        "forward tangents": lambda: lambda: by_tangents(case.theta, case),
        "scipy, finite differences": lambda: by_differences(case),
        **more,
    }
    title = f"Gauss-Newton system, {len(case.theta)} parameters, {len(case.delta)} windows"
    return compared(title, makers, by_tangents(case.theta, case), FORWARD, rounds)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    rounds: Annotated[int, typer.Option(min=1, help="Times that everything is timed.")] = 9,
    quick: Annotated[bool, typer.Option("--quick", help="Few and short windows, two rounds.")] = False,
) -> None:
    """Times gradients and Gauss-Newton systems of the trajectory loss."""
    steps, many, few, rounds = (8, 4, 2, 2) if quick else (50, 200, 40, rounds)
    with benchmark(out, quick):
        coefficients = fitting(logged(many * steps * DT), steps)
        # Forward tangents of so many parameters need much time and memory: fewer windows.
        networks = fitting(logged(few * steps * DT), steps, [Networks.of(6, 1 if quick else 5, 1)])
        systems = [
            gauss_newton(coefficients, rounds, {CASADI: lambda: by_casadi(coefficients)}),
            gauss_newton(networks, rounds, {}),
        ]
        tables = [reverse(coefficients, rounds), reverse(networks, rounds), *systems]
        report(out, tables, targets(tables))


def targets(tables: list[Table]) -> list[Target]:
    """Of the gradient and of the systems with 24 and with 426 parameters, in the order of the tables."""
    with_few, with_networks, system, large = tables
    return [
        Target(
            "reverse gradient, p = 24, against the loss", with_few, "reverse, steps recomputed", FORWARD, 3.5
        ),
        Target(
            "reverse gradient, p = 426, against the loss",
            with_networks,
            "reverse, steps recomputed",
            FORWARD,
            3.5,
        ),
        Target("Gauss-Newton system, p = 24, against 24 forward passes", system, OURS, FORWARD, 1.5, 24),
        Target("Gauss-Newton system, p = 24, against casadi", system, OURS, CASADI, 1.0),
        Target("Gauss-Newton system, p = 426, against the forward pass", large, OURS, FORWARD, 130.0),
    ]


if __name__ == "__main__":
    typer.run(main)
