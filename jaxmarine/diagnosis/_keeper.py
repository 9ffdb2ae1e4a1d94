"""Who keeps the windows of a workbench: this process, or others that work on them where they lie."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Array, Float, Int

from ..fitting import Cut, Kept, refine_windows
from ..logs import Log
from ._explanation import Model
from ._score import AbstractStatistics

Result = TypeVar("Result")


class Part(NamedTuple):
    """Which of the training logs a workbench has: of others it must know no more than this.

    - `first`, `later`: how many logs come before its own, and the names of those that come after them.
    - `before`, `windows`: how many windows of others come before its own, and how many there are in all.
    - `dt` [s]: from sample to sample, the median over all logs.
    """

    first: int
    later: tuple[str, ...]
    before: int
    windows: int
    dt: float

    def every(self, step: int) -> "Part":
        """Of the windows whose number, counted over all, is a multiple of `step`."""
        return self._replace(before=-(-self.before // step), windows=-(-self.windows // step))


@dataclasses.dataclass(frozen=True)
class Outline:
    """What a workbench knows of windows that lie elsewhere.

    - `logs`: with the times of their samples, but none of these (`outlined`).
    - `log`, `starts` [windows]: of each its log, and when it begins [s, its log's own time].
    - `steps`: samples of a window; `seen`: how many numbers of each channel were measured in all of them.
    - `length`, `hold` [s], `speeds` [m/s, rad/s]: as of a `Cut`.
    """

    logs: tuple[Log, ...]
    log: Int[np.ndarray, " windows"]
    starts: Float[np.ndarray, " windows"]
    steps: int
    seen: Int[np.ndarray, " channels"]
    length: float
    hold: float
    speeds: Float[np.ndarray, "6"]

    @classmethod
    def of(cls, data: Cut) -> "Outline":
        windows = data.windows
        return cls(
            logs=data.logs,
            log=np.asarray(windows.log),
            starts=data.starts,
            steps=windows.step.shape[1],
            seen=seen_of(np.asarray(windows.weight)),
            length=data.length,
            hold=data.hold,
            speeds=data.speeds,
        )


def seen_of(weight: Float[np.ndarray, "windows steps channels"]) -> Int[np.ndarray, " channels"]:
    """How many numbers of each channel were measured, by the weights of windows."""
    return (weight > 0).sum(axis=(0, 1))


class Reached(NamedTuple):
    """Where a refinement of a model ended: as of `fitting.Refined`, the initial states where they lie."""

    z: Float[Array | np.ndarray, " z"]
    delta: Array | Kept
    cost: Any
    promised: Any
    damping: Any


class AbstractKeeper(abc.ABC):
    """Works on windows where they lie, for a workbench that says what is to be done.

    What is done is a function of a workbench, that of the windows which lie in one place, and of what is
    given to it; it is one that another process can import.
    """

    @abc.abstractmethod
    def each(self, bench: Any, of: Callable[..., Result], *given: Any) -> list[Result]:
        """What a function says in each place, in the order of the logs."""

    @abc.abstractmethod
    def keep(self, bench: Any, of: Callable[..., Any], *given: Any) -> Any:
        """What a function says in each place, which stays there; it may be given to others."""

    @abc.abstractmethod
    def of_windows(self, bench: Any, found: Any) -> AbstractStatistics:
        """The statistics of each window of what was kept: of groups of windows, and these."""

    @abc.abstractmethod
    def refined(
        self, bench: Any, model: Model, z: Array, max_steps: int, rtol: float, damping: float
    ) -> Reached:
        """`fitting.refine_windows` of a model's task."""

    @abc.abstractmethod
    def remade(self, of: Callable[..., Any], *given: Any) -> "AbstractKeeper":
        """The keeper of a workbench that a function makes of another one, in each place."""


class Here(AbstractKeeper):
    """This process."""

    def each(self, bench: Any, of: Callable[..., Result], *given: Any) -> list[Result]:
        return [of(bench, *given)]

    def keep(self, bench: Any, of: Callable[..., Any], *given: Any) -> Any:
        return of(bench, *given)

    def of_windows(self, bench: Any, found: Any) -> AbstractStatistics:
        del bench
        return found[1]

    def refined(
        self, bench: Any, model: Model, z: Array, max_steps: int, rtol: float, damping: float
    ) -> Reached:
        out = refine_windows(bench.task(model), z, model.delta, max_steps, rtol=rtol, damping=damping)
        return Reached(out.z, out.delta, out.cost, out.promised, out.damping)

    def remade(self, of: Callable[..., Any], *given: Any) -> "AbstractKeeper":
        del of, given
        return self


HERE = Here()
