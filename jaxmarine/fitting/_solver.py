"""Gauss-Newton over windows, inside optimistix' loop.

optimistix' own Levenberg-Marquardt would see the initial states of all windows as one dense block of
unknowns: for 75 windows 900 columns beside the 20 that matter. This solver is handed the normal
equations window by window, eliminates each window's initial state exactly, and keeps optimistix'
loop, results and statistics.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._compiled import compiled
from ._linearise import Affine, Statistics, linearise
from ._rollout import Problem
from ._trust import Trust, pick

# Damping of the initial states, as a share of that of the parameters.
STATES = 1e-4
# Decrease of the chi-square that is not worth a step: far below what a parameter's standard error costs.
ATOL = 1e-2
# Damping of the first step, where nothing is known of the ones before.
LEAST_DAMPING = 1e-4


class Task(eqx.Module):
    """What is solved: the problem, the affine map of z, and a normal prior on z around zero.

    `precision` is the prior's inverse variance; an unused z has precision 1 and an empty map.
    """

    problem: Problem
    affine: Affine
    precision: Float[Array, " z"]

    def weighed(self, weight: Float[Array | np.ndarray, "windows steps 18"]) -> "Task":
        """The task with other weights of what was measured."""
        return eqx.tree_at(lambda t: t.problem.windows.weight, self, jnp.asarray(weight))


def _solved(system: tuple[Array, Array]) -> Array:
    """x of a x = b, a positive definite."""
    a, b = system
    return jax.scipy.linalg.solve(a, b, assume_a="pos")


Unknowns = tuple[Float[Array, " z"], Float[Array, "windows 12"]]


def residual_statistics(y: Unknowns, task: Task) -> tuple[Float[Array, ""], Statistics]:
    """Half the chi-square with the prior, and the statistics of the windows."""
    z, delta = y
    stats = linearise(task.problem, task.affine.at(z), delta)
    return 0.5 * (stats.chi2.sum() + (task.precision * z * z).sum()), stats


class _State(eqx.Module):
    y_eval: Unknowns
    stats: Statistics
    trust: Trust
    terminate: Bool[Array, ""]
    steps: Int[Array, ""]


class WindowGaussNewton(optx.AbstractMinimiser[Unknowns, Statistics, _State]):
    """Damped Gauss-Newton on `residual_statistics`; damping as in `Trust`, scaled by Marquardt (1963).

    It ends where the predicted decrease of the chi-square falls below `ATOL + rtol * chi-square`, where
    damping of 1e8 finds no decrease, or after `limit` steps; `rtol`, `limit` and the damping that it starts
    with come as options, traced, so that one compiled program serves a probe and a long fit.
    """

    # What optimistix asks of any minimiser; the options decide.
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        del fn, args, f_struct, tags
        return _State(
            y_eval=y,
            stats=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), aux_struct),
            trust=Trust.start(options["damping"]),
            terminate=jnp.array(False),
            steps=jnp.array(0),
        )

    def step(self, fn, y, args: Task, options, state: _State, tags):
        del tags
        cost, stats = fn(state.y_eval, args)
        # Where a roll-out is finite its sensitivities may not be: no step could start from there.
        usable = jnp.isfinite(cost) & jnp.isfinite(stats.h_zz).all() & jnp.isfinite(stats.h_xx).all()
        better, trust = state.trust.judged(jnp.where(usable, cost, jnp.inf))
        y, stats = pick(better, state.y_eval, y), pick(better, stats, state.stats)

        z, delta = y
        # Initial states are damped too, or a step of theirs that overshoots could never be shortened; but
        # far less, since within a window they are nearly collinear and would creep (measured: a payload
        # took 5 steps without it, and did not converge in 25 with as much damping as z).
        softened = jax.vmap(lambda h: h + STATES * trust.damping * jnp.diag(jnp.diag(h)))(stats.h_xx)
        _, g, h = eqx.tree_at(lambda s: s.h_xx, stats, softened).reduced()
        prior = args.precision * z
        h = h.sum(0) + jnp.diag(args.precision)
        scale = jnp.diag(h) + 1e-12 * jnp.diag(h).max()
        d_z = -jax.scipy.linalg.solve(h + trust.damping * jnp.diag(scale), g.sum(0) + prior, assume_a="pos")
        # Window by window, as in `Statistics.reduced`.
        d_x = -jax.lax.map(_solved, (softened, stats.g_x + stats.h_xz @ d_z))
        # Decrease by the quadratic model itself, which knows no damping.
        bend = jnp.einsum("wx,wxy,wy->", d_x, stats.h_xx, d_x) + d_z @ (
            stats.h_zz.sum(0) @ d_z + args.precision * d_z
        )
        slope = (stats.g_x * d_x).sum() + (stats.g_z.sum(0) + prior) @ d_z
        predicted = -(slope + jnp.einsum("wx,wxz,z->", d_x, stats.h_xz, d_z) + 0.5 * bend)
        small = 2 * predicted < ATOL + options["rtol"] * 2 * trust.cost
        lost = ~jnp.isfinite(predicted) | (trust.damping > 1e8)
        return (
            y,
            _State(
                y_eval=(z + d_z, delta + d_x),
                stats=stats,
                trust=trust.promised(predicted),
                terminate=small | lost,
                steps=state.steps + 1,
            ),
            stats,
        )

    def terminate(self, fn, y, args, options, state: _State, tags):
        del fn, y, args, tags
        spent = state.steps >= options["limit"]
        result = optx.RESULTS.where(
            state.terminate | ~spent,
            optx.RESULTS.successful,
            optx.RESULTS.nonlinear_max_steps_reached,
        )
        return state.terminate | spent, result

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        del fn, aux, args, options, tags, result
        return (
            y,
            state.stats,
            {
                "cost": state.trust.cost,
                "steps": state.steps,
                "predicted": state.trust.predicted,
                "damping": state.trust.damping,
            },
        )


class Refined(eqx.Module):
    """Where a refinement ended: z, the windows' initial states, the statistics there, and why.

    `promised` is the decrease of the cost that one step more would bring by the last linearisation, with
    the `damping` that it would have.
    """

    z: Float[Array, " z"]
    delta: Float[Array, "windows 12"]
    stats: Statistics
    cost: Float[Array, ""]
    promised: Float[Array, ""]
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    result: optx.RESULTS


def refine_windows(
    task: Task,
    z,
    delta,
    max_steps: int = 30,
    rtol: float = 1e-9,
    damping: float = LEAST_DAMPING,
) -> Refined:
    """Minimises the chi-square over z and all initial states, from z and delta."""
    options = {
        "limit": jnp.asarray(max_steps),
        "rtol": jnp.asarray(rtol),
        "damping": jnp.asarray(damping, jnp.result_type(float)),
    }
    return _refine_windows(task, z, delta, options)


@compiled
def _refine_windows(task: Task, z, delta, options) -> Refined:
    solution: Any = optx.minimise(
        residual_statistics,
        WindowGaussNewton(),
        (z, delta),
        task,
        options=options,
        has_aux=True,
        max_steps=None,
        throw=False,
        adjoint=optx.ImplicitAdjoint(),
    )
    z, delta = solution.value
    return Refined(
        z=z,
        delta=delta,
        stats=solution.aux,
        cost=solution.stats["cost"],
        promised=solution.stats["predicted"],
        damping=solution.stats["damping"],
        steps=solution.stats["steps"],
        converged=solution.result == optx.RESULTS.successful,
        result=solution.result,
    )
