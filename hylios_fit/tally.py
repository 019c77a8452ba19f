"""`Paths` -> reflectance with its standard error, at any wavelengths and contents near by.

One product and one exponential: the weight of a path is its density under the layers asked for over
the mean of its densities under the layers that were walked.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hylios_fit.skin import Layers
from hylios_fit.walker import HITS, Paths, hero_shares, log_density, node_shares

CHUNK = 2048  # rays at a time, so that memory does not depend on their number


class Tally(NamedTuple):
    """Sums over rays that entered the skin; w wavelengths."""

    rays: Float[Array, ""]
    weight: Float[Array, "w"]
    weight2: Float[Array, "w"]

    @property
    def mean(self) -> Float[Array, "w"]:
        """Share of the entered light that comes back out."""
        return self.weight / self.rays

    @property
    def standard_error(self) -> Float[Array, "w"]:
        """Standard error of `mean`, the rays taken as independent draws from their mixture."""
        spread = jnp.maximum(self.weight2 / self.rays - self.mean**2, 0.0)
        return jnp.sqrt(spread / jnp.maximum(self.rays - 1.0, 1.0))

    @property
    def effective_rays(self) -> Float[Array, "w"]:
        """Effective number of the rays that came back: (sum w)^2 / sum w^2."""
        return self.weight**2 / jnp.maximum(self.weight2, 1e-30)


@partial(jax.jit, static_argnames=("own_only",))
def collect(
    paths: Paths, walked: Layers, asked: Layers, absorb: float = 1.0, own_only: bool = False
) -> Tally:
    """Sum the weights of `paths`, walked in the layers `walked`, for the layers `asked`.

    Differentiable in `asked`; `walked` and `absorb` must be what `walker.walk` was given, with one
    of its wavelengths for each hero. `own_only` shares no path among wavelengths, as it must be
    where the refractive index depends on the wavelength: `asked` then has the same wavelengths.
    """
    from_walk = log_density(walked, absorb)
    asked_for = log_density(asked)
    # a common reference keeps the exponents small, so that float32 is enough
    reference = jnp.mean(from_walk, axis=1, keepdims=True)
    from_walk, asked_for = from_walk - reference, asked_for - reference
    log_share = jnp.log(hero_shares(walked.theta_0))
    never = jnp.asarray(-1e30, from_walk.dtype)

    def log_node(layers):
        share = node_shares(layers.theta_0)
        return jnp.where(share > 0, jnp.log(jnp.where(share > 0, share, 1.0)), never)

    node_walk, node_asked = log_node(walked), log_node(asked)

    def part(carry, chunk):
        sums, escaped, hero, node = chunk
        precise = jax.lax.Precision.HIGHEST
        p = jnp.matmul(sums, from_walk, precision=precise) + log_share[None]
        q = jnp.matmul(sums, asked_for, precision=precise)
        # the angle that a ray walked with matters only where it hit a melanosome
        hit = jnp.sum(sums[:, HITS], axis=1)[:, None] > 0
        p = p + jnp.where(hit, node_walk[node], 0.0)
        q = q + jnp.where(hit, node_asked[node], 0.0)
        if own_only:
            own = hero[:, None] == jnp.arange(p.shape[1], dtype=hero.dtype)[None]
            p = jnp.where(own, p, never)
            q = jnp.where(own, q, never)
        total = jax.nn.logsumexp(p, axis=1, keepdims=True)
        # inside the exponential, so that gradients of rays that ended within stay finite
        weight = jnp.exp(jnp.where(escaped[:, None] > 0, q - total, never))
        if own_only:
            weight = jnp.where(own, weight, 0.0)
        w, w2 = carry
        return (w + jnp.sum(weight, axis=0), w2 + jnp.sum(weight**2, axis=0)), None

    rays = paths.hero.shape[0]
    size = min(CHUNK, rays)
    padding = -rays % size
    chunks = tuple(
        jnp.pad(part_, [(0, padding)] + [(0, 0)] * (part_.ndim - 1)).reshape(
            -1, size, *part_.shape[1:]
        )
        for part_ in paths
    )
    zero = jnp.zeros(asked_for.shape[1], asked_for.dtype)
    (weight, weight2), _ = jax.lax.scan(part, (zero, zero), chunks)
    return Tally(jnp.asarray(float(rays), zero.dtype), weight, weight2)


def add(one: Tally | None, two: Tally) -> Tally:
    """The sums of two lots of rays."""
    return two if one is None else Tally(*(a + b for a, b in zip(one, two, strict=True)))


def moments(paths: Paths, walked: Layers, absorb: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean (w,) as `collect` gives it, and the covariance (w, w) of its error between wavelengths.

    Every wavelength sends its own share of the rays, so that the error is what the weights scatter
    about the mean of those that were sent by one wavelength.
    """
    from scipy.sparse import csr_array

    hero, back = np.asarray(paths.hero), np.asarray(paths.escaped) > 0
    count = np.bincount(hero, minlength=walked.mu_a.shape[1])
    weights = np.asarray(_weights(paths, walked, absorb))[back].astype(np.float64)
    rows = np.arange(len(weights))
    sent_for = csr_array((np.ones(len(rows)), (hero[back], rows)), shape=(len(count), len(rows)))
    mean_of_hero = (sent_for @ weights) / np.maximum(count, 1)[:, None]
    # count / (count - 1): the means are from the same rays
    share = count / np.maximum(count - 1.0, 1.0)
    scaled = weights * np.sqrt(share)[hero[back], None]
    about_zero = scaled.T @ scaled
    scatter = about_zero - (mean_of_hero.T * (share * count)) @ mean_of_hero
    return weights.sum(axis=0) / hero.size, 0.5 * (scatter + scatter.T) / hero.size**2


@jax.jit
def _weights(paths: Paths, walked: Layers, absorb: float) -> Float[Array, "ray w"]:
    """What each ray adds to the tally."""

    def one(ray: Paths) -> Array:
        alone = Paths(*(part[None] for part in ray))
        return collect(alone, walked, walked, absorb).weight

    return jax.lax.map(one, paths, batch_size=CHUNK)
