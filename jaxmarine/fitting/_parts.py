"""Rows in equal parts, for what is done part by part."""

import jax.numpy as jnp
from jaxtyping import Array


def part_of(count: int, most: int, grain: int = 1) -> int:
    """The size of as few equal parts as have at most `most` rows each, in whole grains."""
    parts = -(-count // most)
    return -(-count // (parts * grain)) * grain


def in_parts(a: Array, size: int) -> Array:
    """Rows in parts of a size, filled up by the last row, so that no shorter part is compiled as well."""
    filled = jnp.concatenate([a, jnp.repeat(a[-1:], -len(a) % size, axis=0)])
    return filled.reshape(len(filled) // size, size, *a.shape[1:])


def joined(parts: Array, count: int) -> Array:
    """The first rows of all parts."""
    return parts.reshape(parts.shape[0] * parts.shape[1], *parts.shape[2:])[:count]
