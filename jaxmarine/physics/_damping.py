"""Damping of the hull."""

import jax.numpy as jnp

from .._types import Matrix6, Velocity, Wrench
from ._frames import apply


def damping(linear: Matrix6, quadratic: Matrix6, nu_r: Velocity) -> Wrench:
    """D(nu_r) nu_r: `D_l nu_r + D_q (|nu_r| nu_r)`, on the left-hand side.

    - `linear` [N s/m, N s, N m s], `quadratic` [N s²/m², ...]: full matrices, positive sign.
    - `nu_r`: velocity relative to the water [m/s, rad/s]; the product `|nu_r| nu_r` is elementwise.

    Thesis (5.24), with the elementwise product that is meant there.
    """
    # Both in one product: of small ones the number counts.
    both = jnp.concatenate([linear, quadratic], axis=1)
    return apply(both, jnp.concatenate([nu_r, jnp.abs(nu_r) * nu_r]))
