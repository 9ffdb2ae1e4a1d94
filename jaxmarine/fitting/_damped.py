"""Damped Gauss-Newton inside optimistix' loop, for whatever gives a cost, its normal equations and a step."""

import abc
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._compiled import compiled
from ._trust import Trust, pick

# Decrease of the chi-square that is not worth a step: far below what a parameter's standard error costs.
ATOL = 1e-2
# Damping beyond which no step will find a decrease.
LOST = 1e8

Y = TypeVar("Y")
Found = TypeVar("Found")


class State(eqx.Module, Generic[Y, Found]):
    """The point that is tried next, what was found at the one that was taken last, and how the steps go."""

    y_eval: Y
    found: Found
    trust: Trust
    terminate: Bool[Array, ""]
    steps: Int[Array, ""]


class DampedGaussNewton(optx.AbstractMinimiser[Y, Found, State]):
    """Takes a function to half a chi-square and what its steps are made of; damping as in `Trust`.

    It ends where the predicted decrease of the chi-square is not worth a step, where a step failed whose
    slopes are `by_chance`, where damping finds none, or after `limit` steps; that, the `damping` it starts
    with and what `worth` asks for come as options, traced, so that one compiled program serves a probe and a
    long fit.
    """

    # What optimistix asks of any minimiser; the options decide.
    rtol: float = 0.0
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm

    @abc.abstractmethod
    def usable(self, found: Found) -> Bool[Array, ""]:
        """Whether a step can start from there: where a cost is finite its derivatives may not be."""

    @abc.abstractmethod
    def moved(self, y: Y, found: Found, args: Any, damping: Float[Array, ""]) -> tuple[Y, Float[Array, ""]]:
        """The next point, and the decrease that the quadratic model, which knows no damping, promises."""

    @abc.abstractmethod
    def worth(self, options: dict[str, Any], cost: Float[Array, ""]) -> Float[Array, ""]:
        """The least decrease of the chi-square that is worth a step."""

    def by_chance(self, y: Y, found: Found, args: Any) -> bool | Bool[Array, ""]:
        """Whether slopes promise no more than chance makes them, which need not be there."""
        del y, found, args
        return False

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> State:
        del fn, args, f_struct, tags
        return State(
            y_eval=y,
            found=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), aux_struct),
            trust=Trust.start(options["damping"]),
            terminate=jnp.array(False),
            steps=jnp.array(0),
        )

    def step(self, fn, y, args, options, state: State, tags):
        del tags
        cost, found = fn(state.y_eval, args)
        usable = jnp.isfinite(cost) & self.usable(found)
        better, trust = state.trust.judged(jnp.where(usable, cost, jnp.inf))
        y, found = pick(better, state.y_eval, y), pick(better, found, state.found)
        after, predicted = self.moved(y, found, args, trust.damping)
        idle = ~better & self.by_chance(y, found, args)
        small = 2 * predicted < self.worth(options, trust.cost)
        lost = ~jnp.isfinite(predicted) | (trust.damping > LOST)
        return y, State(after, found, trust.promised(predicted), small | lost | idle, state.steps + 1), found

    def terminate(self, fn, y, args, options, state: State, tags):
        del fn, y, args, tags
        spent = state.steps >= options["limit"]
        result = optx.RESULTS.where(
            state.terminate | ~spent,
            optx.RESULTS.successful,
            optx.RESULTS.nonlinear_max_steps_reached,
        )
        return state.terminate | spent, result

    def postprocess(self, fn, y, aux, args, options, state: State, tags, result):
        del fn, aux, args, options, tags, result
        return (
            y,
            state.found,
            {
                "cost": state.trust.cost,
                "steps": state.steps,
                "predicted": state.trust.predicted,
                "damping": state.trust.damping,
                "taken": state.trust.taken,
            },
        )


def minimise(
    fn: Callable[..., Any], solver: DampedGaussNewton, y: Any, args: Any, options: dict[str, Array]
) -> Any:
    """optimistix' solution, however it ended."""
    return optx.minimise(
        fn,
        solver,
        y,
        args,
        options=options,
        has_aux=True,
        max_steps=None,
        throw=False,
        adjoint=optx.ImplicitAdjoint(),
    )


@compiled
def _stepped(solver: Any, y, args, options, state: State, given):
    y, state, _ = solver.step(lambda y, args: given, y, args, options, state, frozenset())
    ended, result = solver.terminate(None, y, args, options, state, frozenset())
    return y, state, ended, result


def minimise_outside(
    fn: Callable[[Any], Any], solver: Any, y: Any, args: Any, options: dict[str, Array]
) -> tuple[Any, Any, dict[str, Array]]:
    """As `minimise`, step by step of the solver, with a function that runs programs of its own.

    Inside optimistix' loop its programs would be compiled once more (a linearisation takes 10 to 20 s).

    - `fn`: from a point to its cost and what was found there; `args` are the solver's.

    Returns the point, what was found there, and the solver's statistics.
    """
    given = fn(y)
    state = solver.init(None, y, args, options, None, given[1], frozenset())
    while True:
        y, state, ended, result = _stepped(solver, y, args, options, state, given)
        if ended:
            return solver.postprocess(None, y, None, args, options, state, frozenset(), result)
        given = fn(state.y_eval)
