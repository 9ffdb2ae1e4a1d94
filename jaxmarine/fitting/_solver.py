"""Gauss-Newton over windows, inside optimistix' loop.

optimistix' own Levenberg-Marquardt would see the initial states of all windows as one dense block of
unknowns: for 75 windows 900 columns beside the 20 that matter. This solver is handed the normal
equations window by window, eliminates each window's initial state exactly, and keeps optimistix'
loop, results and statistics.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .._compiled import compiled
from ._affine import Affine
from ._damped import ATOL, DampedGaussNewton, minimise
from ._linearise import Statistics, linearise
from ._rollout import Problem

# Damping of the initial states, as a share of that of the parameters.
STATES = 1e-4
# Damping of the first step, where nothing is known of the ones before.
LEAST_DAMPING = 1e-4


class Task(eqx.Module):
    """What is solved: the problem, the affine map of z, and a normal prior on z around zero.

    `precision` is the prior's inverse variance; an unused z has precision 1 and an empty map.
    """

    problem: Problem
    affine: Affine
    precision: Float[Array, " z"]

    def weighed(self, weight: Float[Array | np.ndarray, "windows steps channels"]) -> "Task":
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


class WindowGaussNewton(DampedGaussNewton[Unknowns, Statistics]):
    """Damped Gauss-Newton on `residual_statistics`, scaled by Marquardt (1963).

    A step is worth `ATOL` and a share of the chi-square (option `rtol`).
    """

    def usable(self, found: Statistics) -> Bool[Array, ""]:
        return jnp.isfinite(found.h_zz).all() & jnp.isfinite(found.h_xx).all()

    def moved(
        self, y: Unknowns, found: Statistics, args: Task, damping: Float[Array, ""]
    ) -> tuple[Unknowns, Float[Array, ""]]:
        z, delta = y
        soft = softened(found, damping)
        _, g, h = soft.reduced()
        d_z = step_of(g.sum(0), h.sum(0), args.precision, z, damping)
        d_x, decrease = followed(found, soft, d_z)
        prior = args.precision * z
        predicted = decrease - prior @ d_z - 0.5 * d_z @ (args.precision * d_z)
        return (z + d_z, delta + d_x), predicted

    def worth(self, options, cost: Float[Array, ""]) -> Float[Array, ""]:
        return worth_of(options["rtol"], cost)


def worth_of(rtol, cost):
    """The least decrease of the chi-square that is worth a step, at a cost."""
    return ATOL + rtol * 2 * cost


def softened(found: Statistics, damping: Float[Array, ""]) -> Statistics:
    """The statistics with damped initial states.

    They are damped too, or a step of theirs that overshoots could never be shortened; but far less, since
    within a window they are nearly collinear and would creep (measured: a payload took 5 steps without it,
    and did not converge in 25 with as much damping as z).
    """
    h_xx = jax.vmap(lambda h: h + STATES * damping * jnp.diag(jnp.diag(h)))(found.h_xx)
    return eqx.tree_at(lambda s: s.h_xx, found, h_xx)


def step_of(g: Float[Array, " z"], h: Float[Array, "z z"], precision, z, damping) -> Float[Array, " z"]:
    """The step of z from the gradient and information of all windows, initial states eliminated."""
    h = h + jnp.diag(precision)
    scale = jnp.diag(h) + 1e-12 * jnp.diag(h).max()
    return -jax.scipy.linalg.solve(h + damping * jnp.diag(scale), g + precision * z, assume_a="pos")


def followed(
    found: Statistics, soft: Statistics, d_z: Float[Array, " z"]
) -> tuple[Float[Array, "windows 12"], Float[Array, ""]]:
    """The steps of the initial states that go with one of z, and the decrease they promise without prior."""
    # Window by window, as in `Statistics.reduced`.
    d_x = -jax.lax.map(_solved, (soft.h_xx, found.g_x + found.h_xz @ d_z))
    bend = jnp.einsum("wx,wxy,wy->", d_x, found.h_xx, d_x) + d_z @ found.h_zz.sum(0) @ d_z
    slope = (found.g_x * d_x).sum() + found.g_z.sum(0) @ d_z
    return d_x, -(slope + jnp.einsum("wx,wxz,z->", d_x, found.h_xz, d_z) + 0.5 * bend)


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
    solution = minimise(residual_statistics, WindowGaussNewton(), (z, delta), task, options)
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
