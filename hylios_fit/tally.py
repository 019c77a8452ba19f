"""`Paths` -> reflectance with its standard error, at any wavelengths and contents near by.

One product and one exponential: the weight of a path is its density under the layers asked for over
the mean of its densities under the layers that were walked.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hylios_fit.skin import Layers
from hylios_fit.walker import HITS, SUMS, Paths, Plan, hero_shares, log_density, node_shares

CHUNK = 512  # rays at a time, so that memory does not depend on their number
MOST_STRATA = 128  # columns whose means are told apart: beyond, the errors are a little too large
NEVER = -1e30


class Tally(NamedTuple):
    """Sums over rays that entered the skin; w wavelengths.

    `common` is the part of `weight2` that is no error: every column that was walked sends its own
    share of the rays, so that only the scatter about the mean of each column's rays counts.
    `freedom` is the number of rays less that of those means.
    """

    rays: Float[Array, ""]
    freedom: Float[Array, ""]
    weight: Float[Array, "w"]
    weight2: Float[Array, "w"]
    common: Float[Array, "w"]

    @property
    def mean(self) -> Float[Array, "w"]:
        """Share of the entered light that comes back out."""
        return self.weight / self.rays

    @property
    def standard_error(self) -> Float[Array, "w"]:
        """Standard error of `mean`."""
        spread = jnp.maximum(self.weight2 - self.common, 0.0)
        return jnp.sqrt(spread / (self.rays * jnp.maximum(self.freedom, 1.0)))

    @property
    def effective_rays(self) -> Float[Array, "w"]:
        """Effective number of the rays that came back: (sum w)^2 / sum w^2."""
        return self.weight**2 / jnp.maximum(self.weight2, 1e-30)


class _Weigher(NamedTuple):
    """What turns the sums along a path into its logarithmic weight; k columns were walked."""

    walked: Array  # (16 + nodes, k)
    asked: Array  # (16 + nodes, w)
    log_share: Array  # (k,)


def _weigher(walked: Layers, asked: Layers, absorb: Any, shares: Array | None) -> _Weigher:
    from_walk, asked_for = log_density(walked, absorb), log_density(asked)
    # a common reference keeps the exponents small, so that float32 is enough
    reference = jnp.mean(from_walk, axis=1, keepdims=True)
    shares = hero_shares(walked.theta_0) if shares is None else shares
    return _Weigher(
        jnp.concatenate([from_walk - reference, _log(node_shares(walked.theta_0))]),
        jnp.concatenate([asked_for - reference, _log(node_shares(asked.theta_0))]),
        _log(shares),
    )


def _log(share: Array) -> Array:
    return jnp.where(share > 0, jnp.log(jnp.where(share > 0, share, 1.0)), NEVER)


def _columns(paths: Paths, nodes: int) -> Array:
    """(ray, 16 + nodes): sums, and the node where it matters, that is if a melanosome was hit."""
    hit = jnp.sum(paths.sums[:, HITS], axis=1) > 0
    node = jnp.where(hit, paths.node, -1)
    return jnp.concatenate([paths.sums, _of(node, nodes, paths.sums.dtype)], axis=1)


def _of(kind: Array, kinds: int, dtype: Any) -> Array:
    """(ray, kinds): 1 in the column of each ray's kind."""
    return (kind[:, None] == jnp.arange(kinds, dtype=kind.dtype)[None]).astype(dtype)


_product = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


def _log_walked(weigher: _Weigher, columns: Array) -> Array:
    """(ray,): logarithm of the density of each path in the walk."""
    each = _product(columns, weigher.walked) + weigher.log_share[None]
    return jax.nn.logsumexp(each, axis=1)


def _weights(weigher: _Weigher, paths: Paths) -> Array:
    """(ray, w)"""
    columns = _columns(paths, weigher.walked.shape[0] - SUMS)
    # inside the exponential, so that gradients of rays that ended within stay finite
    walked = jnp.where(paths.escaped > 0, _log_walked(weigher, columns), -NEVER)
    one = jnp.ones((1, weigher.asked.shape[1]), weigher.asked.dtype)
    columns = jnp.concatenate([columns, -walked[:, None]], axis=1)
    return jnp.exp(_product(columns, jnp.concatenate([weigher.asked, one])))


def _own_weights(weigher: _Weigher, paths: Paths) -> Array:
    """(ray,): the weight for the column that each ray walked for, shared with no other."""
    columns = _columns(paths, weigher.walked.shape[0] - SUMS)
    ratio = (weigher.asked - weigher.walked).T[paths.hero]
    exponent = jnp.sum(columns * ratio, axis=1) - weigher.log_share[paths.hero]
    return jnp.where(paths.escaped > 0, jnp.exp(jnp.where(paths.escaped > 0, exponent, 0.0)), 0.0)


def _sum_own_weights(weigher: _Weigher, paths: Paths, columns: int) -> tuple[Array, Array]:
    """(k,) sums over the rays of each column, and of the squares."""

    def part(carry, chunk):
        weight = _own_weights(weigher, chunk)
        lots = jnp.stack([weight, jax.lax.stop_gradient(weight) ** 2], axis=1)
        return carry + _product(_of(chunk.hero, columns, lots.dtype).T, lots), None

    zero = jnp.zeros((columns, 2), weigher.asked.dtype)
    total, _ = jax.lax.scan(part, zero, _chunks(paths))
    return total[:, 0], total[:, 1]


def _chunks(paths: Paths) -> Paths:
    """The rays by `CHUNK`; what fills the last one never came out."""
    rays = paths.hero.shape[0]
    size = min(CHUNK, rays)
    padding = -rays % size
    return Paths(
        *(
            jnp.pad(part, [(0, padding)] + [(0, 0)] * (part.ndim - 1)).reshape(
                -1, size, *part.shape[1:]
            )
            for part in paths
        )
    )


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def _sum_weights(weigher: _Weigher, paths: Paths, stratum: Array, strata: int):
    """(stratum, w) sums of the weights of its rays, and (w,) sums of their squares."""
    return _moments(weigher, paths, stratum, strata)[:2]


def _moments(weigher: _Weigher, paths: Paths, stratum: Array, strata: int, sums: bool = False):
    width = weigher.asked.shape[1]

    def part(carry, chunk):
        each, of = chunk
        weight = _weights(weigher, each)
        columns = _of(of, strata, weight.dtype)
        if sums:
            columns = jnp.concatenate([columns, _columns(each, len(weigher.walked) - SUMS)], axis=1)
        w, w2 = carry
        return (w + _product(columns.T, weight), w2 + jnp.sum(weight**2, axis=0)), None

    rows = strata + (len(weigher.walked) if sums else 0)
    zero = jnp.zeros((rows, width), weigher.asked.dtype)
    chunks = _chunks(paths)
    padded = jnp.pad(stratum, (0, chunks.hero.size - stratum.size)).reshape(chunks.hero.shape)
    (w, w2), _ = jax.lax.scan(part, (zero, zero[0]), (chunks, padded))
    return w[:strata], w2, w[strata:]


@_sum_weights.defjvp
def _(strata, primals, tangents):
    # The derivative of a weight is the weight times the sums along its path: their means serve
    # every parameter at once.
    weigher, paths, stratum = primals
    by_stratum, weight2, mean_sums = _moments(weigher, paths, stratum, strata, sums=True)
    change = tangents[0].asked
    first = jnp.arange(strata)[:, None] == 0
    slope = jnp.where(first, jnp.sum(mean_sums * change, axis=0)[None], 0.0)
    return (by_stratum, weight2), (slope.astype(by_stratum.dtype), jnp.zeros_like(weight2))


@partial(jax.jit, static_argnames=("own_only",))
def collect(
    paths: Paths,
    walked: Layers,
    asked: Layers,
    absorb: float = 1.0,
    own_only: bool = False,
    shares: Float[Array, "k"] | None = None,
) -> Tally:
    """Sum the weights of `paths`, walked in the layers `walked`, for the layers `asked`.

    `walked`, `absorb` and `shares` (by default `walker.hero_shares`) must be what `walker.walk` was
    given. `weight`, and so `mean`, is differentiable in the coefficients of `asked`; the errors are
    not. `own_only` shares no path among columns, as it must be where the refractive index depends
    on the wavelength: `asked` then has the columns of `walked`.
    """
    weigher = _weigher(walked, asked, absorb, shares)
    rays, columns = paths.hero.shape[0], walked.mu_a.shape[1]
    total = jnp.asarray(float(rays), weigher.asked.dtype)
    count = jnp.bincount(paths.hero, length=columns).astype(total.dtype)
    if own_only:
        weight, weight2 = _sum_own_weights(weigher, paths, columns)
        common = jax.lax.stop_gradient(weight) ** 2 / jnp.maximum(count, 1.0)
    else:
        # means of too few rays each would say nothing
        strata = columns if rays >= 8 * columns and columns <= MOST_STRATA else 1
        stratum = paths.hero if strata > 1 else jnp.zeros_like(paths.hero)
        count = count if strata > 1 else total[None]
        by_stratum, weight2 = _sum_weights(weigher, paths, stratum, strata)
        weight = jnp.sum(by_stratum, axis=0)
        still = jax.lax.stop_gradient(by_stratum)
        common = jnp.sum(still**2 / jnp.maximum(count, 1.0)[:, None], axis=0)
    means = jnp.sum((count > 0).astype(total.dtype))
    return Tally(total, total - means, weight, weight2, common)


def improve(paths: Paths, plan: Plan, asked: Layers, rays: int = 2048) -> Plan:
    """The plan with shares that make the largest error among the wavelengths smaller.

    From a pilot, the `paths` of that plan, of which it looks at the first `rays`.
    """
    step = -(-asked.theta_0.shape[0] // 256)
    every = {
        name: getattr(asked, name)[..., ::step]
        for name in Layers._fields
        if name not in ("thickness", "bottom", "roughness")
    }
    pilot = Paths(*(part[:rays] for part in paths))
    shares = _improve(pilot, plan.layers, asked._replace(**every), plan.shares)
    return plan._replace(shares=shares)


@jax.jit
def _improve(paths: Paths, walked: Layers, asked: Layers, shares: Array) -> Array:
    weigher = _weigher(walked, asked, 1.0, shares)
    columns = _columns(paths, len(weigher.walked) - SUMS)
    each = _product(columns, weigher.walked)
    largest = jnp.max(each, axis=1, keepdims=True)
    density = jnp.exp(each - largest)
    out = paths.escaped[:, None] > 0
    wanted = jnp.exp(jnp.where(out, _product(columns, weigher.asked) - largest, NEVER))
    sent = _of(paths.hero, len(shares), density.dtype)
    mean_of = sent / jnp.maximum(jnp.sum(sent, axis=0, keepdims=True), 1.0)

    def better(_, state):
        now, best, least = state
        mixed = _product(density, now)
        weight = wanted / mixed[:, None]
        scatter = (weight - _product(sent, _product(mean_of.T, weight))) ** 2
        ray = _product(mean_of, now)
        error = _product(ray, scatter)
        largest = jnp.max(error)
        best = jnp.where(largest < least, now, best)
        # the largest errors lead: the gradient of a high power mean, in damped steps
        lead = (error / largest) ** 5
        borne = _product((ray * _product(scatter, lead) / mixed), density)
        new = now * (borne / jnp.sum(borne * now)) ** 0.2
        # never nothing: what the pilot missed would weigh without a bound
        new = jnp.maximum(new, 0.1 * shares)
        return new / jnp.sum(new), best, jnp.minimum(least, largest)

    start = (shares, shares, jnp.asarray(jnp.inf, density.dtype))
    return jax.lax.fori_loop(0, 40, better, start)[1]


@partial(jax.jit, static_argnames=("bins", "own_only"))
def collect_bins(
    paths: Paths, place: Array, bins: int, plan: Plan, asked: Layers, own_only: bool = False
) -> tuple[Float[Array, "bin w"], Float[Array, "bin w"]]:
    """Sums of the weights, and of their squares, of the rays in each bin.

    `place` (ray,) is the bin of each ray, -1 for none. Their sum over all bins is `collect`'s.
    """
    weigher = _weigher(plan.layers, asked, 1.0, plan.shares)

    def part(carry, chunk):
        each, at = chunk
        if own_only:
            own = _of(each.hero, asked.mu_a.shape[1], weigher.asked.dtype)
            weight = own * _own_weights(weigher, each)[:, None]
        else:
            weight = _weights(weigher, each)
        into = _of(at, bins, weight.dtype).T
        w, w2 = carry
        return (w + _product(into, weight), w2 + _product(into, weight**2)), None

    zero = jnp.zeros((bins, weigher.asked.shape[1]), weigher.asked.dtype)
    chunks = _chunks(paths)
    fill = chunks.hero.size - place.size
    padded = jnp.pad(place, (0, fill), constant_values=-1).reshape(chunks.hero.shape)
    return jax.lax.scan(part, (zero, zero), (chunks, padded))[0]


def out_below(paths: Paths) -> Paths:
    """The rays that left below in the place of those that left above (see `walker.walk_out`)."""
    return paths._replace(escaped=-paths.escaped)


def add(one: Tally | None, two: Tally) -> Tally:
    """The sums of two lots of rays."""
    return two if one is None else Tally(*(a + b for a, b in zip(one, two, strict=True)))


def moments(
    paths: Paths,
    walked: Layers,
    absorb: float,
    asked: Layers | None = None,
    shares: Float[Array, "k"] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (w,) as `collect` gives it, and the covariance (w, w) of its error between wavelengths.

    `asked` are the layers `walked` if not given.
    """
    from scipy.sparse import csr_array

    hero, back = np.asarray(paths.hero), np.asarray(paths.escaped) > 0
    count = np.bincount(hero, minlength=walked.mu_a.shape[1])
    asked = walked if asked is None else asked
    weights = np.asarray(_all_weights(paths, walked, asked, absorb, shares))
    weights = weights.reshape(-1, weights.shape[-1])[: hero.size][back].astype(np.float64)
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
def _all_weights(
    paths: Paths, walked: Layers, asked: Layers, absorb: float, shares: Array | None
) -> Float[Array, "chunk ray w"]:
    weigher = _weigher(walked, asked, absorb, shares)
    return jax.lax.map(partial(_weights, weigher), _chunks(paths))
