r"""Mass, Coriolis and damping by small networks: the identification method of the thesis (ch. 4, 5).

Six networks learn the acceleration from velocity and force. At one velocity they show the inverse mass
matrix; the mass gives the Coriolis forces; what is then missing is the damping, which six more learn:

    nu' = N(nu, f),   f = tau - g            acceleration networks
    N(mean nu, f) = M^-1 f + b               mass, by least squares over the forces of the log
    D(nu) nu = f - C(nu) nu - M nu'          targets (4.12)
    D(nu) nu = N_D(nu, |nu|)                 damping networks

The networks minimise the error of the acceleration, so noise in it does no harm but through the mass: the
targets carry M times that noise, and what is wrong in M.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._types import DOFS, Matrix6, Velocity, Wrench
from ..networks import DampingNetworks, NetworkDamping, Perceptron, perceptron
from ..networks._subnets import FORMS, LOWER, SKEW, Form, with_magnitudes
from ..physics import coriolis
from ..vehicle import Placed, Vehicle
from ._least_squares import solve_linear
from ._levenberg_marquardt import fit_samples

Motions = Float[Array, "times 6"]


class AccelerationNetworks(eqx.Module):
    """Six networks of one output each, nu' from (nu, f); all but `networks` are scales of the data."""

    networks: Perceptron  # stacked along the outputs
    input_mean: Float[Array, "12"]
    input_scale: Float[Array, "12"]
    output_mean: Float[Array, "6"]
    output_scale: Float[Array, "6"]

    def __call__(self, nu: Velocity, force: Wrench) -> Velocity:
        x = (jnp.concatenate([nu, force]) - self.input_mean) / self.input_scale
        out = jax.vmap(lambda net: net(x)[0])(self.networks)
        return self.output_mean + self.output_scale * out


class NetworkIdentification(eqx.Module):
    """What the method finds.

    - `mass` [6, 6] about `o`: identified, or as it was given. The Coriolis forces are those of its
      symmetric part.
    - `damping`: the networks; `linear`, `quadratic` (diagonal): the matrices that come closest to them on
      the velocities of the log.
    - `acceleration`: the networks that the mass was read from, None where it was given.
    - `acceleration_cost`, `damping_cost` [starts, networks]: half the mean square error that each start has
      led to, in units of the output's own spread; infinite where it has diverged. The least of each is kept.
    """

    mass: Matrix6
    damping: DampingNetworks
    linear: Matrix6
    quadratic: Matrix6
    acceleration: AccelerationNetworks | None
    acceleration_cost: Float[Array, "starts networks"] | None
    damping_cost: Float[Array, "starts networks"]

    def vehicle(self, vehicle: Vehicle) -> Vehicle:
        """A vehicle whose mass and damping are those that were found, for simulation and control.

        - `vehicle`: gives all else: propulsion, restoring forces, actuators. Its own damping is taken away,
          and its added mass becomes what the found mass has beside its body's.

        A mass that is not symmetric gives momentum no meaning: its symmetric part is taken, as for Coriolis.
        """
        nothing = jnp.zeros((6, 6))
        bare = eqx.tree_at(
            lambda v: (v.added_mass, v.damping.linear, v.damping.quadratic),
            vehicle,
            (0.5 * (self.mass + self.mass.T) - vehicle.body.matrix, nothing, nothing),
        )
        return bare.place(Placed(NetworkDamping(networks=self.damping, inputs=DOFS)))


def identify_by_networks(
    nu: Motions,
    nu_dot: Motions,
    force: Motions,
    *,
    key: PRNGKeyArray,
    mass: Matrix6 | None = None,
    intercept: bool = True,
    symmetric: bool = False,
    pattern: Float[np.ndarray, "6 6"] | None = None,
    form: Form = "free",
    hidden: int = 5,
    epochs: int = 50,
    restarts: int = 1,
) -> NetworkIdentification:
    """Mass and damping of a craft from its motion and the forces on it, by the thesis' networks.

    - `nu` [m/s, rad/s], `nu_dot` [m/s², rad/s²], `force` tau - g(eta) [N, N m] at the same samples.
    - `mass`: where it is known; else it is identified.
    - `intercept`: lets the networks have a value of their own at mean velocity and zero force. The thesis
      does not (listing CheckNeuralM), and so takes the drag of the mean motion for mass.
    - `symmetric`, `pattern` (entries that are zero stay so; the rest must fall into blocks of coupled axes,
      so that the inverse has the same zeros): structure of the mass matrix (thesis, sec. 8.4.3).
    - `form` of the damping, see `DampingNetworks`.
    - `hidden`, `epochs`: 5 tangents and 50 steps of Levenberg-Marquardt in the thesis; `restarts`: random
      starts, of which each network keeps its best.

    Raises ValueError where an axis never moves. Source: thesis, sec. 4.3 and 5.3.
    """
    idle = [dof for dof, speed in zip(DOFS, np.abs(np.asarray(nu)).max(axis=0), strict=True) if speed == 0]
    if idle:
        raise ValueError(f"Argument `nu` never moves in {', '.join(idle)}: the method needs all six axes.")
    first, second = jax.random.split(key)
    acceleration = cost = None
    if mass is None:
        acceleration, cost = train_acceleration(nu, nu_dot, force, first, hidden, epochs, restarts)
        mass = mass_of(acceleration, nu, force, intercept, symmetric, pattern)
    targets = damping_targets(mass, nu, nu_dot, force)
    damping, damping_cost = train_damping(nu, targets, second, form, hidden, epochs, restarts)
    linear, quadratic = damping_matrices(nu, jax.vmap(damping)(nu))
    return NetworkIdentification(mass, damping, linear, quadratic, acceleration, cost, damping_cost)


@jax.jit
def damping_targets(mass: Matrix6, nu: Motions, nu_dot: Motions, force: Motions) -> Motions:
    """D(nu) nu = f - C(nu) nu - M nu' (thesis 4.12, with the mass multiplied out) [N, N m]."""
    kinetic = 0.5 * (mass + mass.T)
    gyro = jax.vmap(lambda v: coriolis(kinetic, v))(nu)
    return force - gyro - nu_dot @ mass.T


@jax.jit
def damping_matrices(nu: Motions, wrench: Motions) -> tuple[Matrix6, Matrix6]:
    """Linear D_l and diagonal D_q with D_l nu + D_q |nu| nu closest to a wrench (listing CheckNeuralD)."""

    def row(wrench, own):
        regressors = jnp.concatenate([nu, (jnp.abs(own) * own)[:, None]], axis=1)
        return solve_linear(regressors, wrench).values

    rows = jax.vmap(row, in_axes=(1, 1))(wrench, nu)
    return rows[:, :6], jnp.diag(rows[:, 6])


def mass_of(
    networks: AccelerationNetworks,
    nu: Motions,
    force: Motions,
    intercept: bool = True,
    symmetric: bool = False,
    pattern: Float[np.ndarray, "6 6"] | None = None,
) -> Matrix6:
    """The mass that networks show at the mean velocity under the forces of the log (sec. 4.3.3)."""
    basis = _basis(symmetric, np.ones((6, 6)) if pattern is None else pattern)
    return _mass_of(networks, nu, force, intercept, basis)


@eqx.filter_jit
def _mass_of(networks: AccelerationNetworks, nu: Motions, force: Motions, intercept: bool, basis) -> Matrix6:
    still = nu.mean(axis=0)
    shown = jax.vmap(lambda f: networks(still, f))(force)
    # Rows of one size each: forces and moments are told apart by nothing else.
    columns = jnp.einsum("kij,tj->tik", basis, force)
    if intercept:
        own = jnp.broadcast_to(jnp.diag(networks.output_scale), (len(nu), 6, 6))
        columns = jnp.concatenate([columns, own], axis=-1)
    columns = columns / networks.output_scale[None, :, None]
    right = shown / networks.output_scale[None]
    found = solve_linear(columns.reshape(-1, columns.shape[-1]), right.ravel()).values
    return jnp.linalg.inv(jnp.einsum("k,kij->ij", found[: len(basis)], basis))


def _basis(symmetric: bool, pattern) -> Float[Array, "k 6 6"]:
    """One matrix for each free entry, of size one."""
    out = []
    for i, j in zip(*np.nonzero(pattern), strict=True):
        if symmetric and j > i:
            continue
        one = np.zeros((6, 6))
        one[i, j] = 1.0
        if symmetric:
            one[j, i] = 1.0
        out.append(one)
    return jnp.asarray(np.array(out))


def _spread(x: Float[Array, "samples columns"]) -> Float[Array, " columns"]:
    spread = jnp.std(x, axis=0)
    return jnp.where(spread > 0, spread, 1.0)


@eqx.filter_jit
def train_acceleration(
    nu: Motions, nu_dot: Motions, force: Motions, key: PRNGKeyArray, hidden: int, epochs: int, restarts: int
) -> tuple[AccelerationNetworks, Float[Array, "starts networks"]]:
    """The networks of sec. 4.3.3, and what each start has led to."""
    inputs = jnp.concatenate([nu, force], axis=1)
    mean, scale = inputs.mean(axis=0), _spread(inputs)
    out_mean, out_scale = nu_dot.mean(axis=0), _spread(nu_dot)
    x, y = (inputs - mean[None]) / scale[None], (nu_dot - out_mean[None]) / out_scale[None]
    networks, cost = _train_each(FORMS["free"], x, y, key, hidden, epochs, restarts)
    return AccelerationNetworks(networks, mean, scale, out_mean, out_scale), cost


@eqx.filter_jit
def train_damping(
    nu: Motions,
    targets: Motions,
    key: PRNGKeyArray,
    form: Form = "free",
    hidden: int = 5,
    epochs: int = 50,
    restarts: int = 1,
) -> tuple[DampingNetworks, Float[Array, "starts networks"]]:
    """The networks of sec. 4.3.4, and what each start has led to."""
    if form not in ("free", "zero_at_rest", "dissipative"):
        raise ValueError(f"Argument `form` must be free, zero_at_rest or dissipative, but is {form!r}.")
    scale, out_scale = _spread(nu), _spread(targets)
    if form == "dissipative":
        # One power for all axes, so that force times velocity keeps its sign: output 1 / input on each axis.
        out_scale = (out_scale * scale).mean() / scale
    out_mean = targets.mean(axis=0) if form == "free" else jnp.zeros(6)
    x = jax.vmap(with_magnitudes)(nu / scale[None])
    y = (targets - out_mean[None]) / out_scale[None]
    shown = FORMS[form]
    if form == "dissipative":
        size = jnp.std(y, axis=0)
        entries = len(LOWER[0]) + len(SKEW[0])
        starts = jax.vmap(lambda k: perceptron(12, hidden, entries, k))(jax.random.split(key, restarts))

        def error(net, sample):
            return (shown(net, sample[0]) - sample[1]) / size

        found = fit_samples(error, starts, (x, y), max_steps=epochs)
        networks, cost = found.best, (found.costs / len(nu))[:, None]
    else:
        networks, cost = _train_each(shown, x, y, key, hidden, epochs, restarts)
    return DampingNetworks(networks, scale, out_mean, out_scale, form), cost


def _train_each(
    shown, x: Float[Array, "times 12"], y: Motions, key: PRNGKeyArray, hidden: int, epochs: int, restarts: int
) -> tuple[Perceptron, Float[Array, "starts networks"]]:
    """Six networks of one output, from all starts at once; of each the best, and all costs."""

    def one(keys, y):
        starts = jax.vmap(lambda k: perceptron(12, hidden, 1, k))(keys)
        return fit_samples(lambda net, s: shown(net, s[0]) - s[1], starts, (x, y[:, None]), max_steps=epochs)

    found = jax.vmap(one, in_axes=(0, 1))(jax.random.split(key, (6, restarts)), y)
    best = jnp.argmin(found.costs, axis=1)
    networks = jax.tree.map(lambda a: jax.vmap(lambda row, i: row[i])(a, best), found.values)
    return networks, found.costs.T / len(x)
