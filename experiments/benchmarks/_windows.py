"""A log of the ROV Tethra in windows, with parameters to fit: 24 coefficients, or the weights of networks."""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxmarine as jm
from jaxmarine.diagnosis._saturated import SaturatedPlant
from jaxmarine.effects import (
    AddedMass,
    ConstantWrench,
    Craft,
    LinearDamping,
    Motion,
    QuadraticDamping,
    WrenchEffect,
)
from jaxmarine.examples import operator, recorded
from jaxmarine.fitting import Affine, Problem, cut, measured_channels, start_precision

DT = 0.1  # [s]
# Six entries each: 24 parameters, all zero where they change nothing.
COEFFICIENTS = (AddedMass, LinearDamping, QuadraticDamping, ConstantWrench)
_SIZES = np.repeat([[20.0, 5.0], [20.0, 5.0], [20.0, 5.0], [3.0, 0.5]], 3, axis=1).ravel()


class Networks(WrenchEffect):
    """Perceptrons 12-hidden-outputs from the velocity and its magnitude to the wrench.

    - `first` [networks, hidden, 12], `second` [networks, outputs, hidden], with their biases.
    """

    name: ClassVar[str] = "networks"

    first: Float[Array, "networks hidden 12"]
    bias_1: Float[Array, "networks hidden"]
    second: Float[Array, "networks outputs hidden"]
    bias_2: Float[Array, "networks outputs"]

    @classmethod
    def of(cls, networks: int, hidden: int, outputs: int) -> Self:
        rng = np.random.default_rng(0)
        shapes = (networks, hidden, 12), (networks, hidden), (networks, outputs, hidden), (networks, outputs)
        return cls(*(jnp.asarray(rng.normal(size=shape) / shape[-1]) for shape in shapes))

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        raise NotImplementedError("Networks of random weights change something.")

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[()]:
        del craft
        return ()

    def __call__(self, motion: Motion) -> Float[Array, "6"]:
        x = jnp.concatenate([motion.nu_r, jnp.abs(motion.nu_r)])
        hidden = jnp.tanh((self.first * x[None, None]).sum(-1) + self.bias_1)
        return ((self.second * hidden[:, None]).sum(-1) + self.bias_2).ravel()


class Fitting(eqx.Module):
    """The windows of a log, and where the parameters are.

    - `theta`: parameters; `delta` [windows, 12]: changes of the windows' initial states.
    """

    vehicle: jm.Vehicle
    problem: Problem
    theta: Float[Array, " parameters"]
    delta: Float[Array, "windows 12"]

    @property
    def affine(self) -> Affine:
        """z moves every parameter by itself."""
        count = len(self.theta)
        return Affine(self.theta[None], jnp.eye(count), jnp.ones((1, count)))


def logged(seconds: float) -> jm.Log:
    """A dive with the file's noise."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    t = np.arange(0.0, seconds - DT / 2, DT)
    commands = operator(len(vehicle.command_names), t, seed=0)
    return recorded(vehicle, commands, t, 1, "dive")


def fitting(log: jm.Log, steps: int, families: Sequence[Any] | None = None) -> Fitting:
    """Windows of so many steps, of positions, attitudes and velocities.

    - `families`: effects whose numbers are the parameters; None: 24 coefficients, off by a little.
    """
    vehicle = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    noise = np.where(np.arange(len(vehicle.stated_noise)) < 12, vehicle.stated_noise, np.nan)
    data = cut(vehicle, (log,), noise, steps * DT)
    if families is None:
        families = [cls.neutral(vehicle) for cls in COEFFICIENTS]
        theta = jnp.asarray(_SIZES * np.random.default_rng(2).uniform(-1.0, 1.0, 24))
    else:
        theta, _ = jax.flatten_util.ravel_pytree(tuple(families))
    plant_of = SaturatedPlant(vehicle, tuple(families), jnp.ones((1, 0)))
    precision = jnp.asarray(start_precision(vehicle.free))
    problem = Problem(plant_of, data.records, data.windows, precision, measured_channels(data.windows))
    return Fitting(vehicle, problem, theta, jnp.zeros((data.windows.count, 12)))
