"""What noise a model leaves in each channel, beside that of its sensor."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..fitting import largest, overdispersion, predict, wrapped
from ._explanation import Model
from ._workbench import Workbench


def largest_noise(bench: Workbench) -> Float[np.ndarray, " channels"]:
    """Noise per channel at which it tells no more than that it stays as it is within a window."""
    return largest(np.asarray(bench.cut.windows.measured), bench.own_weight) * bench.own_noise


def noise_left(bench: Workbench, model: Model) -> Float[np.ndarray, " channels"]:
    """Noise per channel that the model leaves over the windows, of samples that are worth one each.

    That of the sensors where it is no more; see `fitting._weights`.
    """
    most = largest_noise(bench) / bench.own_noise
    own = bench.own_weight
    return overdispersion(_errors(bench, model), own, np.nan_to_num(most, nan=1.0)) * bench.own_noise


def missed_by(bench: Workbench, model: Model) -> Float[np.ndarray, " channels"]:
    """Root mean square error that the model leaves in each channel, in units of its sensor's noise."""
    count = (bench.own_weight > 0).sum(axis=(0, 1))
    return np.sqrt((_errors(bench, model) ** 2).sum(axis=(0, 1)) / np.maximum(count, 1))


def _errors(bench: Workbench, model: Model) -> Float[np.ndarray, "windows steps channels"]:
    """Prediction minus measured in units of the sensors' own noise, 0 where nothing was measured."""
    model = bench.undisturbed(model)
    channels = predict(bench.problem(model.members), jnp.asarray(bench.theta(model)), model.delta)[0]
    error = np.asarray(channels)[: bench.count] - np.asarray(bench.cut.windows.measured)
    return np.asarray(wrapped(error)) * bench.own_weight
