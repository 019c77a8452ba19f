"""Random words from a counter, for walks that keep no generator's state."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, UInt32


def pcg4d(
    number: UInt32[Array, "n"], step: UInt32[Array, ""], key: UInt32[Array, "2"]
) -> list[UInt32[Array, "n"]]:
    """Four random words for each number at a step: the hash pcg4d (Jarzynski and Olano 2020)."""
    y = jnp.broadcast_to(step, number.shape)
    v = [number, y, number ^ key[0], y ^ key[1]]
    v = [u * jnp.uint32(1664525) + jnp.uint32(1013904223) for u in v]
    for last in (False, True):
        v[0] = v[0] + v[1] * v[3]
        v[1] = v[1] + v[2] * v[0]
        v[2] = v[2] + v[0] * v[1]
        v[3] = v[3] + v[1] * v[2]
        if not last:
            v = [u ^ (u >> 16) for u in v]
    return v
