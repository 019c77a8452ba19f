"""Random words from a counter, for walks that keep no generator's state.

`pcg4d` gives four at once; `seeds` and `word` one at a time, each by itself and for a third of the
work, where a compiler would mix all four again for each.
"""

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


def seeds(
    number: UInt32[Array, "n"], key: UInt32[Array, "2"]
) -> tuple[UInt32[Array, "n"], UInt32[Array, "n"]]:
    """Start and increment of each number's own sequence for `word`: as in SplitMix (Steele, Lea and
    Flood 2014), two sequences differ in both."""
    start, increment, _, _ = pcg4d(number, jnp.uint32(0), key)
    return start, increment | jnp.uint32(1)


def word(
    seeds: tuple[UInt32[Array, "n"], UInt32[Array, "n"]], place: UInt32[Array, ""]
) -> UInt32[Array, "n"]:
    """The random word at a place of each sequence: its counter, mixed by lowbias32 (Wellons 2018,
    hash-prospector)."""
    start, increment = seeds
    v = start + increment * place
    v = (v ^ (v >> 16)) * jnp.uint32(0x7FEB352D)
    v = (v ^ (v >> 15)) * jnp.uint32(0x846CA68B)
    return v ^ (v >> 16)
