"""The controllers of chapter 3: conventional, adaptive, and those with networks, of three classes.

Each is a module that turns what is wanted and what is seen into a wrench on surge, sway, heave and yaw, and
keeps what it remembers in `memory`, a pytree. The classes are the thesis' (sec. 3.2): combined control and
learning (CCL), separate control and learning (SCL), augmented control (AC). Papers as the thesis has them.
"""

import abc
import dataclasses
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.linalg
import scipy.signal
from jaxtyping import Array, Float

import jaxmarine as jm
from jaxmarine.control._follow import _off
from jaxmarine.networks import Perceptron, perceptron
from jaxmarine.vehicle import inverse_dynamics

AXES = np.array([0, 1, 2, 5])
DT = 0.2  # [s] between samples
FREQUENCY = 1.0  # [rad/s] of the placed poles: a fifth of a second of hold is a phase of 6 degrees
MOST = np.array([80.0, 80.0, 120.0, 20.0])  # [N, N m] what the thrusters give on each axis, roughly
Four = Float[Array, "4"]


class Seen(eqx.Module):
    """What a controller is told at a sample.

    - `off` [m, rad]: way and turn to the reference, body axes; `slip`: what the velocity lacks; `nu`,
      `wanted` [m/s, rad/s]; `push` [m/s², rad/s²]: the acceleration that is wanted.
    - `feedforward` [N, N m]: what the file needs for the wanted motion; `buoyant`: to be at rest.
    - `before`, `nu_before`: wrench of the commands of the last hold by the file, the velocity at its begin.
    """

    off: Four
    slip: Four
    nu: Four
    wanted: Four
    push: Four
    feedforward: Four
    buoyant: Four
    before: Four
    nu_before: Four

    @classmethod
    def of(cls, model: jm.Vehicle, wanted: jm.State, push, state: jm.State, before, nu_before) -> Self:
        rest = eqx.tree_at(lambda s: s.velocity, wanted, jnp.zeros(6))
        return cls(
            _off(wanted, state)[AXES],
            (wanted.velocity - state.velocity)[AXES],
            state.velocity[AXES],
            wanted.velocity[AXES],
            push[AXES],
            inverse_dynamics(model, wanted, push)[AXES],
            inverse_dynamics(model, rest, jnp.zeros(6))[AXES],
            before,
            nu_before,
        )


class Axes(eqx.Module):
    """Mass [kg, kg m²], linear and quadratic damping of the file on the four axes."""

    mass: Four
    linear: Four
    quadratic: Four

    @classmethod
    def of(cls, vehicle: jm.Vehicle) -> Self:
        parts = (vehicle.mass_matrix, vehicle.damping.linear, vehicle.damping.quadratic)
        return cls(*(jnp.diag(matrix)[AXES] for matrix in parts))

    @property
    def stiffness(self) -> Four:
        return FREQUENCY**2 * self.mass

    @property
    def damping(self) -> Four:
        return 2.0 * FREQUENCY * self.mass

    def pd(self, seen: Seen) -> Four:
        return self.stiffness * seen.off + self.damping * seen.slip


class Controller(eqx.Module):
    """`begin` is the memory before the first sample; a call gives the wrench and the memory after it."""

    axes: Axes

    @abc.abstractmethod
    def begin(self, key) -> Any: ...

    @abc.abstractmethod
    def __call__(self, memory: Any, seen: Seen) -> tuple[Four, Any]: ...


# --- conventional --------------------------------------------------------------------------------


class PID(Controller):
    """Poles at `FREQUENCY`, an integral a fifth as fast that stops at the limit, the weight made up for."""

    model: bool = eqx.field(static=True, default=False)

    def begin(self, key):
        del key
        return jnp.zeros(4)

    def __call__(self, memory, seen):
        wrench = self.axes.pd(seen) + memory + (seen.feedforward if self.model else seen.buoyant)
        inside = jnp.abs(wrench) < MOST
        more = DT * 0.2 * FREQUENCY * self.axes.stiffness * seen.off
        return wrench, memory + jnp.where(inside, more, 0.0)


def regulator(mass: float, linear: float, most: float) -> tuple[np.ndarray, ...]:
    """Of an axis about rest: integral, way off and slip from sample to sample of a held wrench, and costs."""
    a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -linear / mass]])
    b = np.array([[0.0], [0.0], [-1.0 / mass]])
    sampled: Any = scipy.signal.cont2discrete((a, b, np.eye(3), np.zeros((3, 1))), DT)
    a, b = sampled[:2]
    return a, b, np.diag([1.0 / 0.3**2, 1.0 / 0.1**2, 1.0 / 0.3**2]), np.array([[1.0 / (most / 3) ** 2]])


class LQ(Controller):
    """The linear-quadratic gain of each axis about rest, sample by sample, with an integral.

    0.1 m, 0.3 m/s, 0.3 m s and a third of the thrust cost alike. Gains by scipy's Riccati equation.
    """

    gain: Float[Array, "4 3"]

    @classmethod
    def of(cls, axes: Axes) -> Self:
        def one(mass, linear, most):
            a, b, cost, effort = regulator(mass, linear, most)
            riccati = scipy.linalg.solve_discrete_are(a, b, cost, effort)
            return -np.linalg.solve(effort + b.T @ riccati @ b, b.T @ riccati @ a)[0]

        gains = [one(*x) for x in zip(np.asarray(axes.mass), np.asarray(axes.linear), MOST, strict=True)]
        return cls(axes, jnp.asarray(np.array(gains)))

    def begin(self, key):
        del key
        return jnp.zeros(4)

    def __call__(self, memory, seen):
        wrench = (self.gain * jnp.stack([memory, seen.off, seen.slip], axis=1)).sum(1) + seen.buoyant
        inside = jnp.abs(wrench) < MOST
        return wrench, memory + jnp.where(inside, DT * seen.off, 0.0)


# --- adaptive ------------------------------------------------------------------------------------


class SelfTuning(Controller):
    """Recursive least squares of nu' on (tau / m, nu, |nu| nu, 1), and poles placed with what was found.

    Forgets within 40 s; a share of the file's inertia of at least 0.3 is believed.
    """

    def begin(self, key):
        del key
        ones = jnp.ones(4)
        first = jnp.stack(
            [ones, -self.axes.linear / self.axes.mass, -self.axes.quadratic / self.axes.mass, 0 * ones], 1
        )
        spread = jnp.diag(jnp.array([0.1, 0.5, 1.0, 0.5]) ** 2)
        return first, jnp.broadcast_to(spread, (4, 4, 4)), jnp.zeros(())

    def __call__(self, memory, seen):
        found, spread, count = memory
        nu = seen.nu_before
        row = jnp.stack([(seen.before - seen.buoyant) / self.axes.mass, nu, jnp.abs(nu) * nu, jnp.ones(4)], 1)
        slope = (seen.nu - nu) / DT

        def learn(theta, p, phi, y):
            # The slope's noise is of size 0.1; that is the unit of the covariance.
            size = 0.1**2
            k = p @ phi / (0.995 * size + phi @ p @ phi)
            p = (p - jnp.outer(k, phi @ p)) / 0.995
            # Without excitation a forgetting covariance grows without end.
            p = p * jnp.minimum(1.0, 2.0 / jnp.trace(p))
            return theta + k * (y - phi @ theta), p

        new = jax.vmap(learn)(found, spread, row, slope)
        known = count > 0
        found, spread = (jnp.where(known, a, b) for a, b in zip(new, (found, spread), strict=True))
        wanted = seen.push + FREQUENCY**2 * seen.off + 2.0 * FREQUENCY * seen.slip
        nu = seen.wanted
        rest = found[:, 1] * nu + found[:, 2] * jnp.abs(nu) * nu + found[:, 3]
        share = jnp.maximum(found[:, 0], 0.3)
        return self.axes.mass / share * (wanted - rest) + seen.buoyant, (found, spread, count + 1.0)


def _regressors(seen: Seen, slope: float) -> tuple[Four, Float[Array, "4 4"]]:
    """s = slip + slope off, and what mass, damping and a bias multiply."""
    s = seen.slip + slope * seen.off
    push = seen.push + slope * seen.slip
    return s, jnp.stack([push, seen.wanted, jnp.abs(seen.wanted) * seen.wanted, jnp.ones(4)], axis=1)


class ModelReference(Controller):
    """tau = Y theta + K s with theta' = Gamma Y' s: the error falls as exp(-t) where theta is right.

    After Slotine and Li: V = s' M s / 2 + |theta - true|² / 2 Gamma does not grow in an undisturbed plant of
    this form. A leak keeps theta near the file's under noise.
    """

    def begin(self, key):
        del key
        return jnp.stack([self.axes.mass, self.axes.linear, self.axes.quadratic, 0.0 * self.axes.mass], 1)

    def __call__(self, memory, seen):
        s, y = _regressors(seen, FREQUENCY)
        wrench = (y * memory).sum(1) + self.axes.damping * s + seen.buoyant
        scale = self.begin(None).at[:, 3].set(self.axes.mass)
        rate = 0.5 * scale * jnp.abs(scale) / self.axes.mass[:, None]
        leak = 0.005 * (memory - self.begin(None))
        inside = (jnp.abs(wrench) < MOST)[:, None]
        return wrench, memory + DT * jnp.where(inside, rate * y * s[:, None] - leak, 0.0)


# --- networks ------------------------------------------------------------------------------------


class Combined(Controller):
    """CCL: a perceptron beside a PD controller, whose wrench is the error that it learns from.

    At each sample, all weights; a step of the gradient of size `rate`. Direct control (sec. 3.2.1).
    """

    rate: float = 0.05

    def begin(self, key):
        net = perceptron(16, 12, 4, key)
        return eqx.tree_at(lambda n: n.weight_2, net, jnp.zeros((4, 12)))

    def __call__(self, memory, seen):
        x = jnp.concatenate([seen.off, 2 * seen.nu, 2 * seen.wanted, 2 * seen.push])
        feedback = self.axes.pd(seen)
        told, back = jax.vjp(lambda net: net(x), memory)
        (slope,) = back(jnp.clip(feedback / MOST, -1.0, 1.0))
        wrench = feedback + MOST * told + seen.buoyant
        return wrench, jax.tree.map(lambda w, g: w + self.rate * g, memory, slope)


class CMAC(Controller):
    """SCL: a table of the inverse model beside a PD controller, of what wrench gave which acceleration.

    Eight tilings of (velocity, acceleration) of each axis, hashed into 512 cells; every sample moves those
    that it meets by a tenth of the error. Sec. 3.3.4.
    """

    def begin(self, key):
        del key
        return jnp.zeros((4, 8, 512))

    def _cells(self, nu, push):
        offset = jnp.arange(8.0)[None] / 8.0
        a = jnp.floor(nu[:, None] / 0.15 + offset).astype(int)
        b = jnp.floor(push[:, None] / 0.15 + offset * 3.0 % 1.0).astype(int)
        return (a * 31 + b * 17) % 512

    def __call__(self, memory, seen):
        rows, tiles = jnp.arange(4)[:, None], jnp.arange(8)[None]
        met = self._cells(seen.nu_before, (seen.nu - seen.nu_before) / DT)
        wrong = (seen.before - seen.buoyant) - memory[rows, tiles, met].sum(1)
        memory = memory.at[rows, tiles, met].add(0.1 * wrong[:, None] / 8.0)
        recalled = memory[rows, tiles, self._cells(seen.wanted, seen.push)].sum(1)
        return self.axes.pd(seen) + recalled + seen.buoyant, memory


class SONCS(Controller):
    """SCL: a controller network, trained through a forward network in imagination (sec. 3.3.3).

    Both are trained before the dive on the file's craft, and anew every `STRETCH` on what was seen since; in
    between they are as they are.
    """

    def begin(self, key):
        first, second = jax.random.split(key)
        return perceptron(8, 16, 4, first), perceptron(12, 16, 4, second)

    def wrench(self, net: Perceptron, off, slip, wanted):
        return jnp.asarray(MOST) * net(jnp.concatenate([2 * off, 4 * slip, 2 * wanted]))

    def __call__(self, memory, seen):
        _, net = memory
        return self.wrench(net, seen.off, seen.slip, seen.wanted) + seen.buoyant, memory

    @staticmethod
    def slope(net: Perceptron, nu, wrench):
        return net(jnp.concatenate([2 * nu, wrench / MOST]))

    def learned(self, memory, nu, wrench, slope, key, steps: int):
        """Both networks after so many steps of Adam: the forward one on samples, the other through it."""
        forward, net = memory

        def miss(net):
            return ((jax.vmap(lambda n, w: self.slope(net, n, w))(nu, wrench) - slope) ** 2).mean()

        forward: Any = _adam(miss, forward, steps)
        first, second, third = jax.random.split(key, 3)
        off = jax.random.uniform(first, (64, 4), minval=-0.5, maxval=0.5)
        begin = jax.random.uniform(second, (64, 4), minval=-0.4, maxval=0.4)
        speed = jax.random.uniform(third, (64, 4), minval=-0.4, maxval=0.4)

        def imagined(net):
            def one(off, nu, wanted):
                def step(now, _):
                    off, nu = now
                    tau = self.wrench(net, off, wanted - nu, wanted)
                    nu = nu + DT * self.slope(forward, nu, jnp.clip(tau, -MOST, MOST))
                    off = off + DT * (wanted - nu)
                    cost = ((off / 0.1) ** 2 + ((wanted - nu) / 0.3) ** 2 + (tau / MOST) ** 2).mean()
                    return (off, nu), cost

                return jax.lax.scan(step, (off, nu), None, length=15)[1].mean()

            return jax.vmap(one)(off, begin, speed).mean()

        return forward, _adam(imagined, net, steps)


def _adam(loss, start, steps: int):
    rule = optax.adam(0.01)

    def step(now, _):
        net, state = now
        change, state = rule.update(jax.grad(loss)(net), state)
        return (optax.apply_updates(net, change), state), None

    return jax.lax.scan(step, (start, rule.init(start)), None, length=steps)[0][0]


class Augmented(Controller):
    """AC: the file's feedforward and a PD controller, and a linear layer over products that learns.

    Wrench W' phi with phi = (acceleration, velocity, its products, 1) and W' = Gamma phi s', less a leak;
    after Li et al. (2002) by the thesis' (3.14) and (3.15).
    """

    def begin(self, key):
        del key
        return jnp.zeros((19, 4))

    def __call__(self, memory, seen):
        s = seen.slip + FREQUENCY * seen.off
        products = (seen.nu[:, None] * seen.nu[None])[np.tril_indices(4)]
        phi = jnp.concatenate([seen.push, seen.nu, products, jnp.ones(1)])
        wrench = seen.feedforward + self.axes.pd(seen) + phi @ memory
        inside = jnp.abs(wrench) < MOST
        more = 0.5 * jnp.outer(phi, s * self.axes.mass) - 0.005 * memory
        return wrench, memory + DT * jnp.where(inside[None], more, 0.0)


def all_of(vehicle: jm.Vehicle) -> dict[str, Controller]:
    """The controllers by the names of the table."""
    axes = Axes.of(vehicle)
    return {
        "PID": PID(axes),
        "PID and feedforward of the file": dataclasses.replace(PID(axes), model=True),
        "LQ with integral": LQ.of(axes),
        "self-tuning": SelfTuning(axes),
        "model-reference adaptive": ModelReference(axes),
        "CCL: perceptron beside PD": Combined(axes),
        "SCL: CMAC beside PD": CMAC(axes),
        "SCL: SONCS": SONCS(axes),
        "AC: PD, file and adaptive layer": Augmented(axes),
    }
