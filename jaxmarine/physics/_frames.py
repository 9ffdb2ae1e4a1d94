"""Attitude and the small vector algebra that the other physics modules share."""

import jax
import jax.numpy as jnp

from .._types import Matrix3, Quaternion, Scalar, Vector3


def skew(a: Vector3) -> Matrix3:
    """The matrix `S(a)` with `S(a) b = a x b` (after Fossen 2021)."""
    zero = jnp.zeros_like(a[0])
    return jnp.stack(
        [
            jnp.stack([zero, -a[2], a[1]]),
            jnp.stack([a[2], zero, -a[0]]),
            jnp.stack([-a[1], a[0], zero]),
        ]
    )


@jax.jit
def apply(matrix, vector):
    """Matrix times vector as a sum of products.

    Under `vmap` on a CPU a product of many small matrices runs several times faster in this form
    than as a batched `dot`, because XLA fuses it with its neighbours. `jit` is there for `vmap_last` alone,
    to see where one matrix meets many vectors; XLA takes no notice of it.
    """
    return (matrix * vector[None, :]).sum(-1)


def norm(a: Vector3) -> Scalar:
    """Euclidean length with gradient zero, not NaN, at rest."""
    squared = (a * a).sum()
    moving = squared > 0
    return jnp.where(moving, jnp.sqrt(jnp.where(moving, squared, 1.0)), 0.0)


def rotation(attitude: Quaternion) -> Matrix3:
    """Rotation body to world of a quaternion `(w, x, y, z)` of any length (after Fossen 2021)."""
    w, x, y, z = attitude / jnp.sqrt((attitude * attitude).sum())
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]),
            jnp.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]),
            jnp.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]),
        ]
    )


def attitude_rate(attitude: Quaternion, omega: Vector3) -> Quaternion:
    """Time derivative of the quaternion under body rates `omega` [rad/s] (after Fossen 2021)."""
    w, x, y, z = attitude
    p, q, r = omega
    return 0.5 * jnp.stack(
        [
            -x * p - y * q - z * r,
            w * p + y * r - z * q,
            w * q + z * p - x * r,
            w * r + x * q - y * p,
        ]
    )


def conjugate(attitude: Quaternion) -> Quaternion:
    """The attitude that undoes one: rotation(attitude).T."""
    return attitude * jnp.array([1.0, -1.0, -1.0, -1.0])


def compose(a: Quaternion, b: Quaternion) -> Quaternion:
    """The attitude that turns by `b` first (in body axes of `a`): rotation(a) @ rotation(b)."""
    w, x, y, z = a
    bw, bx, by, bz = b
    return jnp.stack(
        [
            w * bw - x * bx - y * by - z * bz,
            w * bx + x * bw + y * bz - z * by,
            w * by - x * bz + y * bw + z * bx,
            w * bz + x * by - y * bx + z * bw,
        ]
    )


def from_euler(angles: Vector3) -> Quaternion:
    """Quaternion of roll, pitch, yaw (ZYX) [rad] (after Fossen 2021)."""
    (sr, sp, sy), (cr, cp, cy) = jnp.sin(0.5 * angles), jnp.cos(0.5 * angles)
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def to_euler(attitude: Quaternion) -> Vector3:
    """Roll, pitch, yaw (ZYX) [rad] of a quaternion; see `to_euler_matrix`."""
    return to_euler_matrix(rotation(attitude))


def to_euler_matrix(turn: Matrix3) -> Vector3:
    """Roll, pitch, yaw (ZYX) [rad] of a rotation body to world.

    At a pitch of 90 degrees roll and yaw are not unique; roll is then zero, and a floor under
    cos(theta) keeps the derivative finite.
    """
    horizontal = jnp.sqrt(jnp.maximum(turn[2, 1] ** 2 + turn[2, 2] ** 2, 1e-18))
    singular = turn[2, 1] ** 2 + turn[2, 2] ** 2 < 1e-18
    one = jnp.ones_like(horizontal)
    roll = jnp.arctan2(jnp.where(singular, 0.0, turn[2, 1]), jnp.where(singular, one, turn[2, 2]))
    yaw = jnp.arctan2(
        jnp.where(singular, -turn[0, 1], turn[1, 0]), jnp.where(singular, turn[1, 1], turn[0, 0])
    )
    return jnp.stack([roll, jnp.arctan2(-turn[2, 0], horizontal), yaw])


def small_turn(angles: Vector3) -> Quaternion:
    """Quaternion of a small rotation vector [rad], smooth at zero (first order, then normalised)."""
    turn = jnp.concatenate([jnp.ones(1, angles.dtype), 0.5 * angles])
    return turn / jnp.sqrt((turn * turn).sum())
