"""What the coupling terms of a file may be off by that are not recalibrated: quadratic damping's, and added
mass between axes that no hull joins which is alike on port and starboard."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..effects import JOINED
from ..physics import coriolis
from ..vehicle import Vehicle
from ._signals import Places


def couplings(vehicle: Vehicle, places: Places) -> Float[np.ndarray, "windows knots 6 couplings"]:
    """The wrench [N, N m] at the knots of each term off the diagonals of added mass and quadratic damping.

    Velocities over ground stand for those through the water, and accelerations are differences between
    knots: it is the size of what such a term may hide that matters here.
    """
    nu = places.velocity
    nu_dot = np.gradient(nu, axis=1) / np.gradient(places.t, axis=1)[..., None]
    swirl = jax.vmap(jax.vmap(coriolis, (None, 0)), (None, 0))
    between = np.outer(vehicle.free, vehicle.free) > 0
    added = np.asarray(vehicle.added_mass)
    out = []
    for i, j in np.argwhere(np.triu(added != 0, 1) & between & ~JOINED):
        pair = np.zeros((6, 6))
        pair[i, j] = pair[j, i] = added[i, j]
        out.append(nu_dot @ pair + np.asarray(swirl(jnp.asarray(pair), jnp.asarray(nu))))
    quadratic = np.asarray(vehicle.damping.quadratic)
    for i, j in np.argwhere((quadratic != 0) & between & ~np.eye(6, dtype=bool)):
        out.append(np.eye(6)[i] * quadratic[i, j] * (np.abs(nu) * nu)[..., j : j + 1])
    return np.stack(out, axis=-1) if out else np.zeros((*nu.shape, 0))
