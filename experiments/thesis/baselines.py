"""What the thesis' networks are compared with: its own least squares (sec. 6.1, 6.2.4), and fair ones.

Linear methods take arrays of motion and force, those that fit a vehicle the log. All give an `Estimate`.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxmarine as jm
from jaxmarine.effects import QuadraticDamping
from jaxmarine.fitting import damping_matrices, damping_targets, solve_linear

Motions = Float[Array, "times 6"]
_LOWER = np.tril_indices(6)


@dataclasses.dataclass(frozen=True)
class Estimate:
    """The three matrices of table 6.1; `mass` is None where it was given."""

    mass: Float[np.ndarray, "6 6"] | None
    linear: Float[np.ndarray, "6 6"]
    quadratic: Float[np.ndarray, "6 6"]


def errors(estimate, model) -> dict[str, float | None]:
    """(6.3), (6.4), (6.5) and `MeanError` in per cent; None where the model has no such element.

    Elements of the diagonal, off it, those that are zero in the model, relative to the model's largest, and
    the mean over all that are not zero (listing CalcErrors, which computes it and prints it nowhere).
    """
    estimate, model = np.asarray(estimate), np.asarray(model)
    on, there = np.eye(len(model), dtype=bool), model != 0
    relative = np.abs(estimate - model) / np.where(there, np.abs(model), 1.0)

    def worst(where, values):
        return float(100.0 * values[where].max()) if where.any() else None

    return {
        "diagonal": worst(on & there, relative),
        "off_diagonal": worst(~on & there, relative),
        "zero": worst(~there, np.abs(estimate) / model.max()),
        "mean": float(100.0 * relative[there].mean()) if there.any() else None,
    }


# --- linear --------------------------------------------------------------------------------------


def ls_of_the_thesis(nu: Motions, nu_dot: Motions, force: Motions) -> Estimate:
    """(6.1) row by row: force on acceleration, velocity and |v| v of the row; no Coriolis, no symmetry."""

    def row(force, own):
        columns = jnp.concatenate([nu_dot, nu, (jnp.abs(own) * own)[:, None]], axis=1)
        return solve_linear(columns, force).values

    rows = np.asarray(jax.jit(jax.vmap(row, in_axes=(1, 1)))(force, nu))
    return Estimate(rows[:, :6], rows[:, 6:12], np.diag(rows[:, 12]))


def ls_with_mass(nu: Motions, nu_dot: Motions, force: Motions, mass) -> Estimate:
    """LS_2 (sec. 6.2.4): the targets (4.12) of a mass, on velocity and |v| v."""
    wrench = damping_targets(jnp.asarray(mass), nu, nu_dot, force)
    linear, quadratic = damping_matrices(nu, wrench)
    return Estimate(None, np.asarray(linear), np.asarray(quadratic))


def ls_with_coriolis(nu: Motions, nu_dot: Motions, force: Motions) -> Estimate:
    """Force on the left as in (6.1), but with the Coriolis forces and a symmetric mass."""
    basis = _symmetric()

    def inertia(one):
        return -damping_targets(one, nu, nu_dot, jnp.zeros_like(nu))

    columns = jnp.moveaxis(jax.lax.map(inertia, basis), 0, -1)
    found = _weighted(jnp.concatenate([columns, _damping_columns(nu, np.eye(6))], axis=-1), force)
    linear, quadratic = _damping(found[21:])
    return Estimate(np.asarray(jnp.einsum("k,kij->ij", found[:21], basis)), linear, quadratic)


def inverse_ls(nu: Motions, nu_dot: Motions, force: Motions) -> Estimate:
    """Acceleration on the left, row by row, on force, velocity, |v| v and all products of velocities.

    The noise of the acceleration is then no regressor. The products stand for M^-1 C(nu) nu, unconstrained.
    """
    products = jnp.stack([nu[:, i] * nu[:, j] for i, j in zip(*_LOWER, strict=True)], axis=1)
    columns = jnp.concatenate([force, nu, jnp.abs(nu) * nu, products], axis=1)
    rows = jax.vmap(lambda right: solve_linear(columns, right).values, in_axes=1)(nu_dot)
    mass = jnp.linalg.inv(rows[:, :6])
    quadratic = np.diag(np.diag(-mass @ rows[:, 12:18]))
    return Estimate(np.asarray(mass), np.asarray(-mass @ rows[:, 6:12]), quadratic)


def two_stage_ls(nu: Motions, nu_dot: Motions, force: Motions) -> Estimate:
    """Coriolis from the mass of `inverse_ls`, then a symmetric M^-1 with the damping, both of nu'.

    The damping matrices are those of (4.12) with that mass.
    """
    first = jnp.asarray(inverse_ls(nu, nu_dot, force).mass)
    net = damping_targets(first, nu, jnp.zeros_like(nu), force)
    basis = _symmetric()
    columns = jnp.einsum("kij,tj->tik", basis, net)
    drag = jnp.concatenate([nu, jnp.abs(nu) * nu], axis=1)
    free = jnp.einsum("ij,tk->tijk", jnp.eye(6), drag).reshape(len(nu), 6, 72)
    found = _weighted(jnp.concatenate([columns, free], axis=-1), nu_dot)
    mass = jnp.linalg.inv(jnp.einsum("k,kij->ij", found[:21], basis))
    rest = ls_with_mass(nu, nu_dot, force, mass)
    return dataclasses.replace(rest, mass=np.asarray(mass))


def _symmetric() -> Float[Array, "21 6 6"]:
    out = np.zeros((21, 6, 6))
    for k, (i, j) in enumerate(zip(*_LOWER, strict=True)):
        out[k, i, j] = out[k, j, i] = 1.0
    return jnp.asarray(out)


def _damping_columns(nu: Motions, shape) -> Float[Array, "times 6 42"]:
    """Derivatives of D_l nu + D_q |nu| nu with respect to D_l, row by row, and the diagonal of D_q."""
    shape = jnp.asarray(shape)
    linear = jnp.einsum("ij,tk->tijk", shape, nu).reshape(len(nu), 6, 36)
    quadratic = jnp.einsum("ij,tj->tij", shape, jnp.abs(nu) * nu)
    return jnp.concatenate([linear, quadratic], axis=-1)


def _damping(values) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(values[:36]).reshape(6, 6), np.diag(np.asarray(values[36:42]))


@jax.jit
def _weighted(columns: Float[Array, "times 6 p"], right: Motions) -> Float[Array, " p"]:
    """Least squares over all axes; a second solve weighs each by what the first left of it."""

    def solved(weight):
        rows = (columns * weight[None, :, None]).reshape(-1, columns.shape[-1])
        return solve_linear(rows, (right * weight[None]).ravel()).values

    first = solved(1.0 / jnp.std(right, axis=0))
    return solved(1.0 / jnp.std(right - columns @ first, axis=0))


# --- by a vehicle --------------------------------------------------------------------------------


def start_of(vehicle: jm.Vehicle) -> jm.Vehicle:
    """The vehicle with known propulsion and restoring forces, and masses and damping that are guessed.

    The guesses are 20 to 50 % off and have no coupling. The quadratic damping stands in an effect, which has
    six numbers.
    """
    mass, linear = np.diag([280.0] * 3 + [70.0] * 3), np.diag([80.0] * 3 + [35.0] * 3)
    quadratic = np.array([60.0] * 3 + [20.0] * 3)
    bare = eqx.tree_at(
        lambda v: (v.body.matrix, v.damping.linear, v.damping.quadratic),
        vehicle,
        (jnp.asarray(mass), jnp.asarray(linear), jnp.zeros((6, 6))),
    )
    return bare.place(jm.Placed(QuadraticDamping(jnp.asarray(quadratic))))


def free(vehicle: jm.Vehicle):
    """Mass, linear damping, and the six numbers of the quadratic."""
    effect: Any = vehicle.placed[-1].effect
    return vehicle.body.matrix, vehicle.damping.linear, effect.value


def estimate_of(vehicle: jm.Vehicle) -> Estimate:
    """What a fit of `free` has found."""
    mass, linear, quadratic = free(vehicle)
    return Estimate(np.asarray(mass), np.asarray(linear), np.diag(np.asarray(quadratic)))


def acceleration_ml(start: jm.Vehicle, log: jm.Log, noise) -> jm.Fit:
    """Maximum likelihood of the accelerations, with Coriolis and a symmetric positive mass."""
    return jm.fit(start, log, free, loss="one_step", noise=noise, throw=False)


def trajectory(start: jm.Vehicle, log: jm.Log, noise, window: float, reject: bool, steps: int) -> jm.Fit:
    """Maximum likelihood of whole windows of velocities, attitudes and, where measured, positions."""
    return jm.fit(start, log, free, window=window, noise=noise, reject=reject, max_steps=steps, throw=False)
