"""`Paths` -> reflectance with its standard error, at any wavelengths and contents near by.

One product and one exponential: the weight of a path is its density under the layers asked for over
the mean of its densities under the layers that were walked.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hylios_fit import scattering
from hylios_fit.precision import HIGHEST, product
from hylios_fit.skin import Layers
from hylios_fit.walker import (
    BENT,
    ENDS,
    LIFT,
    MET,
    NEVER,
    NODES,
    STEERED,
    SUMS,
    Paths,
    Plan,
    angle_density,
    end_density,
    hero_shares,
    log_density,
    node_shares,
)

CHUNK, ACCELERATOR_CHUNK = 64, 8192  # rays at a time: memory does not depend on their number
PIECE = 32  # of a chunk on a CPU, whose weights at all wavelengths stay in the cache
GROUP = 64  # rays whose sum counts as one for the errors: columns take turns within it
GROUPS = 256  # no fewer, or what they say of the errors is noise
PILOT = 4096  # rays that `improve` looks at
WATCHED = 160  # wavelengths whose errors shares are chosen by
TINY = 1e-9  # and at least this, where no ray knows a column
FOLDS = 8  # of the rays of a sum: what each takes off the others say
ENOUGH = 16_384  # rays that say it
RIDGE = 0.05  # of the second moment of what is known, so that its scatter is not learned
DARKER = 2.0  # times the absorption of a column: its density, which no ray walks for, is known too


class Tally(NamedTuple):
    """Sums over rays that entered the skin, less what is told (`collect`); w wavelengths.

    `squares` has the squared sum of the weights of each group of rays, over their number: columns
    take turns among the rays, so that only the scatter between groups is error. `groups` is their
    number.
    """

    rays: Float[Array, ""]
    groups: Float[Array, ""]
    weight: Float[Array, "w"]
    squares: Float[Array, "w"]

    @property
    def mean(self) -> Float[Array, "w"]:
        """Share of the entered light that comes back out."""
        return self.weight / self.rays

    @property
    def standard_error(self) -> Float[Array, "w"]:
        """Standard error of `mean`."""
        spread = jnp.maximum(self.squares - self.weight**2 / self.rays, 0.0)
        return jnp.sqrt(spread / (self.rays * jnp.maximum(self.groups - 1.0, 1.0)))

    @property
    def effective_rays(self) -> Float[Array, "w"]:
        """How many rays of equal weight would have come back for the same error.

        Among uncorrelated weights that is (sum w)^2 / sum w^2.
        """
        return effective_rays(self.mean, self.standard_error, self.rays)


def effective_rays(mean: Any, standard_error: Any, rays: Any) -> Any:
    """Of a mean over `rays`: see `Tally.effective_rays`."""
    return rays * mean**2 / (rays * standard_error**2 + mean**2 + TINY**2)


Lots = TypeVar("Lots", Tally, "Sums")


class _Told(NamedTuple):
    """What more is needed for `_known`."""

    darker: Array  # (32, k): as `walked`, of columns that absorb more (`DARKER`)
    of_node: Array  # (k, node): 1 for each column of a node
    lost_cosine: Array  # (k,), by a hit


class _Weigher(NamedTuple):
    """What turns the sums along a path into its weight; k columns were walked."""

    walked: Array  # (21, k), of the logarithm of the density; then (11, k) of what ended a ray
    # inside, where that is asked for
    asked: Array  # (21, w)
    log_share: Array  # (k,)
    nodes: Array | None  # (node, w): what each counts, where `asked` leaves the angles out
    told: _Told | None  # where ends are asked for


def _weigher(
    walked: Layers,
    asked: Layers,
    absorb: Any,
    shares: Array | None,
    own_only: bool = False,
    positive: bool = False,
    ended: bool = False,
) -> _Weigher:
    from_walk, asked_for = log_density(walked, absorb), log_density(asked)
    # a common reference keeps the exponents small, so that float32 is enough
    reference = jnp.mean(from_walk, axis=1, keepdims=True)
    from_walk, asked_for = from_walk - reference, asked_for - reference
    nodes = None
    if not own_only:  # or the angles are the same, and cancel
        from_walk = from_walk + angle_density(walked.theta_0)
        if shares is None:
            asked_for = asked_for + angle_density(asked.theta_0)
        else:
            nodes = node_shares(asked.theta_0, positive)
    shares = hero_shares(walked.theta_0) if shares is None else shares
    told = None
    if ended:
        more, nodes_walked = DARKER * absorb, jnp.asarray(NODES, walked.theta_0.dtype)
        darker = log_density(walked, more) - reference + angle_density(walked.theta_0)
        from_walk = jnp.concatenate([from_walk, end_density(walked, absorb)])
        told = _Told(
            jnp.concatenate([darker, end_density(walked, more)]),
            (walked.theta_0[:, None] == nodes_walked[None]).astype(shares.dtype),
            scattering.exponential_lost_cosine(walked.theta_0),
        )
    return _Weigher(from_walk, asked_for, _log(shares), nodes, told)


def _log(share: Array) -> Array:
    return jnp.where(share > 0, jnp.log(jnp.where(share > 0, share, 1.0)), NEVER)


def _of(kind: Array, kinds: int, dtype: Any) -> Array:
    """(ray, kinds): 1 in the column of each ray's kind."""
    return (kind[:, None] == jnp.arange(kinds, dtype=kind.dtype)[None]).astype(dtype)


def _weights(weigher: _Weigher, paths: Paths) -> Array:
    """(ray, w)"""
    return _density(weigher, *_ready(weigher, paths, _mixed(weigher, paths)[0]))


def _mixed(weigher: _Weigher, paths: Paths) -> tuple[Array, Array]:
    """(ray,), the logarithm of the density of each path under all columns together; and (ray, k),
    what each column has of it."""
    return _mix(_under(paths, weigher.walked), weigher)


def _mix(each: Array, weigher: _Weigher) -> tuple[Array, Array]:
    each = each + weigher.log_share[None]
    largest = jnp.max(each, axis=1)
    each = jnp.exp(each - largest[:, None])
    total = jnp.sum(each, axis=1)
    return largest + jnp.log(total), each / total[:, None]


def _under(paths: Paths, density: Array) -> Array:
    """(ray, k): logarithm of the density of each path under each column."""
    rows = paths.sums
    if density.shape[0] > SUMS:
        rows = jnp.concatenate([rows, _of(paths.end, ENDS, rows.dtype)], axis=1)
    return product(rows, density)


def _known(told: _Told, sums: Array, shares: Array, darker: Array) -> Array:
    """(ray, k + 3 node) of which the means over all paths are known, whatever was walked: the share
    of each column in the density; of each node, that share times how far chance turned the ray up
    at fibres and at hits; and what columns that absorb more would have of it."""
    hits = sums[:, STEERED, None] + told.lost_cosine[None] * sums[:, MET, None]
    by_column = shares * sums[:, LIFT, None], shares * hits, darker
    by_node = [product(each, told.of_node) for each in by_column]
    return jnp.concatenate([shares, *by_node], axis=1)


def _ready(weigher: _Weigher, paths: Paths, unit: Array) -> tuple[Array, Array | None]:
    """What `_density` takes of each path, where exp(`unit`) is 1: (ray, 22) of its exponent, or
    (ray, 17) and (ray, node) of the angles."""
    sums, angles = paths.sums, None
    if weigher.nodes is not None:
        angles = product(sums, angle_density(jnp.asarray(NODES, unit.dtype)))
        largest = jnp.max(angles, axis=1)
        angles = jnp.exp(angles - largest[:, None])
        sums, unit = sums[:, :BENT], unit - largest
    # inside the exponential, so that gradients of rays that ended within stay finite
    unit = jnp.where(paths.escaped > 0, unit, -NEVER)
    return jnp.concatenate([sums, -unit[:, None]], axis=1), angles


def _density(weigher: _Weigher, exponent: Array, angles: Any) -> Array:
    """(ray, w): density of each path that came back."""
    one = jnp.ones((1, weigher.asked.shape[1]), weigher.asked.dtype)
    density = jnp.concatenate([weigher.asked[: exponent.shape[1] - 1], one])
    density = jnp.exp(product(exponent, density))
    return density if weigher.nodes is None else density * product(angles, weigher.nodes)


def _own_weights(weigher: _Weigher, paths: Paths) -> Array:
    """(ray,): the weight for the column that each ray walked for, shared with no other."""
    ratio = (weigher.asked - weigher.walked).T[paths.hero]
    exponent = jnp.sum(paths.sums * ratio, axis=1) - weigher.log_share[paths.hero]
    return jnp.where(paths.escaped > 0, jnp.exp(jnp.where(paths.escaped > 0, exponent, 0.0)), 0.0)


def _sum_own_weights(weigher: _Weigher, paths: Paths, columns: int) -> tuple[Array, Array]:
    """(k,) sums over the rays of each column, and of the squares."""

    def part(carry, chunk):
        weight = _own_weights(weigher, chunk)
        lots = jnp.stack([weight, jax.lax.stop_gradient(weight) ** 2], axis=1)
        return carry + product(_of(chunk.hero, columns, lots.dtype).T, lots), None

    zero = jnp.zeros((columns, 2), weigher.asked.dtype)
    total, _ = jax.lax.scan(part, zero, _chunks(paths))
    return total[:, 0], total[:, 1]


def _chunks(paths: Paths, group: int = 1) -> Paths:
    """The rays by `CHUNK` or `ACCELERATOR_CHUNK`, whole groups; what fills the last one never came
    out."""
    rays = paths.hero.shape[0]
    most = CHUNK if jax.default_backend() == "cpu" else ACCELERATOR_CHUNK
    size = min(most, rays + -rays % group)
    padding = -rays % size
    return Paths(
        *(
            jnp.pad(part, [(0, padding)] + [(0, 0)] * (part.ndim - 1)).reshape(
                -1, size, *part.shape[1:]
            )
            for part in paths
        )
    )


def _group(rays: int) -> int:
    """How many form a group: a power of two, so that `CHUNK` has whole ones."""
    return min(GROUP, 1 << max((rays // GROUPS).bit_length() - 1, 0))


class Sums(NamedTuple):
    """Sums over the rays of each fold (f) and its groups: the rays and groups, the weights (w), and
    what is known of the paths (k, `_known`) beyond its mean; and products of the sums of a group,
    over its rays. `add` those of lots that share a plan."""

    rays: Float[Array, "f"]
    groups: Float[Array, "f"]
    weight: Float[Array, "f w"]
    squares: Float[Array, "f w"]
    beyond: Float[Array, "f k"]
    beyond2: Float[Array, "f k k"]
    cross: Float[Array, "f k w"]


@jax.custom_jvp
def _shared(weigher: _Weigher, paths: Paths, sent: Array) -> Tally:
    return tell(_sums(weigher, paths, sent)[0])


@_shared.defjvp
def _(primals, tangents):
    # The derivative of a weight is the weight times the sums along its path: their means serve
    # every parameter at once.
    sums, by_sum = _sums(*primals, slopes=True)
    found = tell(sums)
    slope = jnp.sum(by_sum * tangents[0].asked, axis=0).astype(found.weight.dtype)
    return found, jax.tree.map(jnp.zeros_like, found)._replace(weight=slope)


def _sums(
    weigher: _Weigher, paths: Paths, sent: Array, slopes: bool = False
) -> tuple[Sums, Array | None]:
    """The sums; and (21, w), where slopes are asked for, those along paths times what their weights
    count."""
    width, dtype = weigher.asked.shape[1], weigher.asked.dtype

    def zeros(*shape):
        return jnp.zeros(shape, dtype)

    group = _group(paths.hero.shape[0])
    chunks = _chunks(paths, group)
    size = chunks.hero.shape[1]
    cut = PIECE if size == CHUNK else size
    within = min(group, cut)  # of a group in a piece
    folds, known, told = 1, 0, weigher.told
    both = weigher.walked
    if told is not None:
        both = jnp.concatenate([both, told.darker], axis=1)
        share = jnp.exp(weigher.log_share)[None]
        mean = _known(told, zeros(1, SUMS), share, share)
        folds, known = FOLDS, mean.shape[1]
    # what did not set out is not looked at
    used = (sent + size - 1) // size

    def grouped(x, many=group):
        return jnp.sum(x.reshape(-1, many, *x.shape[1:]), axis=1)

    def look(i):
        """A chunk; the logarithm of its densities; of each group, how many set out and (k) what
        is known has beyond its mean."""
        chunk = jax.tree.map(lambda part: part[i], chunks)
        each = _under(chunk, both)
        log, shares = _mix(each[:, : weigher.walked.shape[1]], weigher)
        set_out = (i * size + jnp.arange(size, dtype=used.dtype) < sent).astype(dtype)
        if told is None:
            return chunk, log, grouped(set_out), zeros(size // group, 0)
        darker = each[:, weigher.walked.shape[1] :]
        darker = jnp.exp(darker + (weigher.log_share[None] - log[:, None]))
        beyond = _known(told, chunk.sums, shares, darker) - mean
        return chunk, log, grouped(set_out), grouped(set_out[:, None] * beyond)

    def over(part, zero):
        """The sums of `part` over the chunks of each fold."""

        def fold(f):
            low, high = f * used // folds, (f + 1) * used // folds
            return jax.lax.fori_loop(low, high, partial(part, f), zero)

        return jax.lax.map(fold, jnp.arange(folds, dtype=used.dtype))

    def known_so_far(carry, count, c):
        rays, beyond, beyond2 = carry
        scaled = c / jnp.maximum(count, 1.0)[:, None]
        return rays + jnp.sum(count), beyond + jnp.sum(c, axis=0), beyond2 + product(c.T, scaled)

    factor = None
    if slopes and known:

        def of_known(f, i, carry):
            _, _, count, c = look(i)
            return known_so_far(carry, count, c)

        found = over(of_known, (zeros(), zeros(known), zeros(known, known)))
        factor = _factors(*found)

    def part(f, i, carry):
        carry, by_sum = carry
        chunk, log, count, c = look(i)
        scaled = c / jnp.maximum(count, 1.0)[:, None]
        some: tuple[Any, ...] = _ready(weigher, chunk, log)
        if by_sum is not None:
            counts = jnp.ones(size, dtype)
            if factor is not None:
                level, tilt = factor
                counts = jnp.repeat(level[f] - product(scaled, tilt[f]), group)
            some = *some, chunk.sums * counts[:, None]

        def piece(by_sum, some):
            exponent, angles, *sums = some
            weight = _density(weigher, exponent, angles)
            if by_sum is not None:
                by_sum = by_sum + product(sums[0].T, weight)
            return by_sum, grouped(weight, within)

        pieces = jax.tree.map(lambda x: x.reshape(-1, cut, *x.shape[1:]), some)
        by_sum, w = jax.lax.scan(piece, by_sum, pieces)
        w = grouped(w.reshape(-1, width), group // within)
        rays, beyond, beyond2 = known_so_far((carry.rays, carry.beyond, carry.beyond2), count, c)
        found = Sums(
            rays,
            carry.groups + jnp.sum((count > 0).astype(dtype)),
            carry.weight + jnp.sum(w, axis=0),
            carry.squares + jnp.sum(w**2 / jnp.maximum(count, 1.0)[:, None], axis=0),
            beyond,
            beyond2,
            carry.cross + product(scaled.T, w),
        )
        return found, by_sum

    zero = Sums(
        zeros(), zeros(), zeros(width), zeros(width), zeros(known),
        zeros(known, known), zeros(known, width),
    )  # fmt: skip
    found, by_sum = over(part, (zero, zeros(SUMS, width) if slopes else None))
    return found, None if by_sum is None else jnp.sum(by_sum, axis=0)


def _others(x: Array) -> Array:
    """Of each fold, what all the others have."""
    return jnp.sum(x, axis=0, keepdims=True) - x


def _solve(moments: Array, right: Array) -> Array:
    """Solutions (k, n) of a regression from its second moments (k, k), with `RIDGE`."""
    ridged = moments + jnp.diag(RIDGE * jnp.diag(moments) + TINY)
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(ridged), right)


def _inverses(rays: Array, beyond2: Array) -> Array:
    """(f, k, k) of the moments that the other folds have; nothing where they have few rays."""
    moments = _others(beyond2)
    one = jnp.eye(moments.shape[1], dtype=moments.dtype)
    inverse = jax.vmap(_solve, (0, None))(moments, one)
    return jnp.where((_others(rays) >= ENOUGH)[:, None, None], inverse, 0.0)


@jax.jit
def tell(sums: Sums) -> Tally:
    """The sums of all folds, after what is told is taken off the weights and the squares
    of groups: of each fold as much as goes with it in the others."""
    rays, groups = jnp.sum(sums.rays), jnp.sum(sums.groups)
    weight, squares = jnp.sum(sums.weight, axis=0), jnp.sum(sums.squares, axis=0)
    if sums.beyond.shape[1]:
        others, beyond, light, cross = (
            _others(x) for x in (sums.rays, sums.beyond, sums.weight, sums.cross)
        )
        cross = cross - beyond[..., None] * (light / jnp.maximum(others, 1.0)[:, None])[:, None]
        controls = product(_inverses(sums.rays, sums.beyond2), cross)
        weight = weight - jnp.einsum("fk,fkw->w", sums.beyond, controls, precision=HIGHEST)
        twice = product(sums.beyond2, controls) - 2.0 * sums.cross
        squares = squares + jnp.sum(twice * controls, axis=(0, 1))
    return Tally(rays, groups, weight, squares)


def _factors(rays: Array, beyond: Array, beyond2: Array) -> tuple[Array, Array]:
    """What the weights of a group count in what `tell` sums up, which is linear in them: so much by
    fold (f,), less (f, k) times what is known has beyond its mean, by ray."""
    tilt = jnp.einsum("fkl,fl->fk", _inverses(rays, beyond2), beyond, precision=HIGHEST)
    level = jnp.sum(tilt * _others(beyond), axis=1) / jnp.maximum(_others(rays), 1.0)
    return 1.0 + _others(level), _others(tilt)


@partial(jax.jit, static_argnames=("own_only",))
def collect(
    paths: Paths,
    walked: Layers,
    asked: Layers,
    absorb: float = 1.0,
    own_only: bool = False,
    shares: Float[Array, "k"] | None = None,
    sent: Any = None,
) -> Tally:
    """Sum the weights of `paths`, walked in the layers `walked`, for the layers `asked`.

    `walked`, `absorb`, `shares` and `sent` must be what `walker.walk` was given: shares of a
    `plan`, or none where every wavelength has a column of its own (`walker.hero_shares`). `weight`,
    and so `mean`, is differentiable in the coefficients of `asked`; the errors are not. `own_only`
    shares no path among columns, as it must be where the refractive index depends on the
    wavelength: `asked` then has the columns of `walked`.

    The densities of all paths under a column of a plan, over those under all columns together, have
    the mean 1, whatever the column is, also one that absorbs more and that no ray walks for; and
    what chance turned its rays up has the mean 0 (`_known`). Where many rays share a plan, what the
    sample has beyond these means tells how much more light comes back there than should, and that
    is taken off (control variates of mixtures, Owen and Zhou 2000,
    doi 10.1080/01621459.2000.10473909). How much it is, every eighth of the rays (`FOLDS`) is told
    by the others, so that it biases nothing; where hardly any light comes back the mean may fall
    below 0, within its error.
    """
    weigher, sent = _to_sum(paths, walked, asked, absorb, own_only, shares, sent)
    if own_only:
        return tell(_own_sums(weigher, paths, sent))
    return _shared(weigher, paths, sent)


@partial(jax.jit, static_argnames=("own_only",))
def gather(
    paths: Paths,
    walked: Layers,
    asked: Layers,
    own_only: bool = False,
    shares: Float[Array, "k"] | None = None,
    sent: Any = None,
) -> Sums:
    """As `collect`, of one lot of several: `tell` what all of them `add` up to, so that a small lot
    is steadied by what the others know, if `paths` has room for `ENOUGH` rays. Not differentiable.
    """
    weigher, sent = _to_sum(paths, walked, asked, 1.0, own_only, shares, sent)
    return _own_sums(weigher, paths, sent) if own_only else _sums(weigher, paths, sent)[0]


def _to_sum(paths, walked, asked, absorb, own_only, shares, sent) -> tuple[_Weigher, Array]:
    rays = paths.hero.shape[0]
    many = shares is not None and not own_only and rays - rays // FOLDS >= ENOUGH
    weigher = _weigher(walked, asked, absorb, shares, own_only, ended=many)
    return weigher, jnp.asarray(rays if sent is None else sent, jnp.int32)


def _own_sums(weigher: _Weigher, paths: Paths, sent: Array) -> Sums:
    """Each column has its share of the rays: only the scatter about its own mean is error."""
    rays, columns = paths.hero.shape[0], weigher.walked.shape[1]
    total = sent.astype(weigher.asked.dtype)
    out = (jnp.arange(rays, dtype=jnp.int32) < sent).astype(total.dtype)
    count = jnp.bincount(paths.hero, out, length=columns)
    weight, weight2 = _sum_own_weights(weigher, paths, columns)
    still = jax.lax.stop_gradient(weight) ** 2
    squares = weight2 + still / total - still / jnp.maximum(count, 1.0)
    groups = total - jnp.sum((count > 0).astype(total.dtype)) + 1.0
    none = jnp.zeros((1, 0), total.dtype)
    return Sums(
        total[None], groups[None], weight[None], squares[None],
        none, none[..., None], none[..., None],
    )  # fmt: skip


def improve(paths: Paths, plan: Plan, asked: Layers, rays: int = PILOT) -> tuple[Plan, float]:
    """The plan with shares that make the largest error among the wavelengths smaller, and what that
    will be: its square, times the rays.

    From a pilot, the `paths` of that plan, of which it looks at the first `rays`.
    """
    step = -(-asked.theta_0.shape[0] // WATCHED)
    every = {
        name: getattr(asked, name)[..., ::step]
        for name in Layers._fields
        if name not in ("thickness", "bottom", "roughness")
    }
    pilot = Paths(*(part[:rays] for part in paths))
    shares, variance = _improve(pilot, plan.layers, asked._replace(**every), plan.shares)
    return plan._replace(shares=shares), float(variance)


@jax.jit
def _improve(paths: Paths, walked: Layers, asked: Layers, shares: Array) -> tuple[Array, Array]:
    weigher = _weigher(walked, asked, 1.0, shares, ended=True)
    each = _under(paths, weigher.walked)
    largest = jnp.max(each, axis=1)
    density = jnp.exp(each - largest[:, None]) * jnp.sign(shares)[None]
    told_by = weigher.told
    assert told_by is not None
    darker = jnp.exp(_under(paths, told_by.darker) - largest[:, None])
    wanted = _density(weigher, *_ready(weigher, paths, largest))
    sent = _of(paths.hero, len(shares), density.dtype)
    mean_of = sent / jnp.maximum(jnp.sum(sent, axis=0, keepdims=True), 1.0)

    def about_mean(x):
        return x - product(mean_of.T, x)[paths.hero]

    def rest(now):
        """What each ray counts, and what its weights are off by, beyond what is known tells."""
        ray, mixed = product(mean_of, now), product(density, now)[:, None]
        share = now[None] / mixed
        known = _known(told_by, paths.sums, density * share, darker * share)
        tells, weight = about_mean(known), about_mean(wanted / mixed)
        moments = product(tells.T, ray[:, None] * tells)
        told = _solve(moments, product(tells.T, ray[:, None] * weight))
        return ray, weight - product(tells, told)

    def better(_, state):
        now, best, least = state
        ray, off = rest(now)
        scatter = off**2
        error = product(ray, scatter)
        largest = jnp.max(error)
        best = jnp.where(largest < least, now, best)
        # the largest errors lead: the gradient of a high power mean, in steps damped enough that
        # they do not swing
        lead = (error / jnp.maximum(largest, TINY**2)) ** 16  # no light, no error
        borne = ray * product(scatter, lead) / product(density, now)
        borne = product(borne, density)
        new = now * (borne / jnp.sum(borne * now)) ** 0.1
        # never nothing: what the pilot missed would weigh without a bound
        new = jnp.maximum(new, 0.2 * shares)
        return new / jnp.sum(new), best, jnp.where(largest < least, largest, least)

    start = (shares, shares, jnp.asarray(jnp.inf, density.dtype))
    return jax.lax.fori_loop(0, 8, better, start)[1:]


@partial(jax.jit, static_argnames=("bins", "own_only"))
def collect_bins(
    paths: Paths, place: Array, bins: int, plan: Plan, asked: Layers, own_only: bool = False
) -> tuple[Float[Array, "bin w"], Float[Array, "bin w"]]:
    """Sums of the weights, and of their squares, of the rays in each bin.

    `place` (ray,) is the bin of each ray, -1 for none. Their sum over all bins is `collect`'s, but
    where that has weights below 0 (`walker.node_shares`), as no bin may have, and for what it takes
    off.
    """
    weigher = _weigher(plan.layers, asked, 1.0, plan.shares, own_only, positive=True)

    def part(carry, chunk):
        each, at = chunk
        if own_only:
            own = _of(each.hero, asked.mu_a.shape[1], weigher.asked.dtype)
            weight = own * _own_weights(weigher, each)[:, None]
        else:
            weight = _weights(weigher, each)
        into = _of(at, bins, weight.dtype).T
        w, w2 = carry
        return (w + product(into, weight), w2 + product(into, weight**2)), None

    zero = jnp.zeros((bins, weigher.asked.shape[1]), weigher.asked.dtype)
    chunks = _chunks(paths)
    fill = chunks.hero.size - place.size
    padded = jnp.pad(place, (0, fill), constant_values=-1).reshape(chunks.hero.shape)
    return jax.lax.scan(part, (zero, zero), (chunks, padded))[0]


def out_below(paths: Paths) -> Paths:
    """The rays that left below in the place of those that left above (see `walker.walk_out`)."""
    return paths._replace(escaped=-paths.escaped)


def add(one: Lots | None, two: Lots) -> Lots:
    """The sums of two lots of rays."""
    return two if one is None else jax.tree.map(jnp.add, one, two)


def moments(
    paths: Paths,
    walked: Layers,
    absorb: float,
    asked: Layers | None = None,
    shares: Float[Array, "k"] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (w,) of the weights, and the covariance (w, w) of its error between wavelengths.

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
