"""The fast walk: `Layers` -> `Paths`.

Every ray walks for one wavelength, its own, as the paper has it: absorbed on the way or back out.
What a path does depends on the wavelength and on the contents only through quantities that add up
along it (path length in every layer, hits, fibre events, ...), so that the probability density of
a path under any other wavelength or content is the exponential of one product, `log_density`.
A ray that gets out therefore serves all wavelengths, weighted by its density there over the mean
of its densities under all wavelengths that were walked (the balance heuristic, Veach and Guibas
1995; hero wavelengths, Wilkie et al. 2014). The weights are bounded, and `tally` does the sums.

Two things differ from the letter of the paper (`analog`), both far below the errors met in use:
- The inside of a melanosome is averaged: a hit costs its mean survival, tabulated from the literal
  trace, whatever the particle's orientation was.
- Where theta_0 falls from 5 degrees to 0 (780 to 1300 nm), a ray walks with one of the two angles
  of `NODES` around it, drawn so that the mean of theta_0^2, which is what diffusion knows, is
  right: paths that bend differently could not serve each other otherwise.
"""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from hylios_fit import fresnel, melanosome, scattering
from hylios_fit.skin import LAYERS, STRATA, Layers

# What is summed along a path, in this order
LENGTH = slice(0, 6)  # path length in each layer, cm
HITS = slice(6, 9)  # melanosomes or complexes hit in each stratum
PROPOSED = slice(9, 12)  # the same before rejections
FIBRE, FIBRE_LENGTH, TISSUE, BOTTOM = range(12, 16)
SUMS = 16

NODES = scattering.LATIMER_ANGLE * np.sqrt([0.0, 0.1, 0.3, 0.6, 1.0])
ROUND = 16  # looks at the interfaces between two exchanges of rays that ended
SUBSTEPS = 2  # collisions between two looks at the interfaces
LANES = 1024
BATCH = 65_536  # rays of one compiled call; memory does not depend on the number of rays


class Paths(NamedTuple):
    """Rays that came back out, and how many set out.

    sums: what adds up along each path (`LENGTH`, `HITS`, ...); zero weight where `escaped` is 0.
    hero: index of the wavelength that each ray walked for; node: of its angle in `NODES`.
    """

    sums: Float[Array, "ray 16"]
    escaped: Float[Array, "ray"]
    hero: Int[Array, "ray"]
    node: Int[Array, "ray"]


class _Medium(NamedTuple):
    """Per-layer numbers of the walk; k wavelengths."""

    thickness: Array  # (6,)
    index: Array  # (8, k): air, the layers, below
    rate_event: Array  # (6, k): particles, fibres or tissue
    rate_absorb: Array  # (6, k)
    albedo: Array  # (6, k)
    node: Array  # (k,): the lower of the two nodes, and the share of the upper one
    node_part: Array
    nodes: Array  # the angles
    particle: Array  # (3,): size of the particle relative to that in the basale
    axes: Array  # (2,): a, b in the basale (a sphere's radius twice)
    facets: Array
    bottom: Array  # share that the bottom sends back on the walk


def _uniform(ray: Array, step: Array, stream: int, key: Array, dtype: Any) -> list[Array]:
    """Four uniform numbers in (0, 1) from a counter: the hash pcg4d (Jarzynski and Olano 2020)."""
    x = ray.astype(jnp.uint32)
    y = step.astype(jnp.uint32) * jnp.uint32(8) + jnp.uint32(stream)
    v = [x, jnp.broadcast_to(y, x.shape), x ^ key[0], jnp.broadcast_to(y, x.shape) ^ key[1]]
    v = [u * jnp.uint32(1664525) + jnp.uint32(1013904223) for u in v]
    for last in (False, True):
        v[0] = v[0] + v[1] * v[3]
        v[1] = v[1] + v[2] * v[0]
        v[2] = v[2] + v[0] * v[1]
        v[3] = v[3] + v[1] * v[2]
        if not last:
            v = [u ^ (u >> 16) for u in v]
    if dtype == jnp.float32:
        below_one = dtype.type(1.0 - 2.0**-24)  # which the largest would be rounded to
        v = [((u >> 8).astype(dtype) + 0.5) * dtype.type(2.0**-24) for u in v]
        return [jnp.minimum(u, below_one) for u in v]
    return [(u.astype(dtype) + 0.5) * dtype.type(2.0**-32) for u in v]


_stage = jax.lax.optimization_barrier  # without it XLA computes what several outputs share again


class _Lane(NamedTuple):
    ray: Array
    depth: Array  # below the top of the layer
    u: tuple[Array, Array, Array]
    layer: Array  # -1 outside, above
    waiting: Array  # at an interface
    again: Array  # a scattering angle to be drawn again
    spent: Array  # the once-a-pass fibre event has happened
    alive: Array
    escaped: Array
    before: tuple[Array, ...]  # the particle met before: centre from here, axis, size (0: none)
    sums: tuple[Array, ...]


def _medium(layers: Layers, form: str, absorb: float) -> _Medium:
    dtype = layers.mu_a.dtype
    k = layers.mu_a.shape[1]
    shares = node_shares(layers.theta_0)
    low = jnp.argmax(shares > 0, axis=0)
    one = jnp.ones((1, k), dtype)
    event = layers.mu_particle + layers.mu_tissue
    event = event.at[4].set(layers.mu_fibre)
    if form == "dispersed":
        axes = melanosome.semi_axes(form)
    else:
        axes = (melanosome.sphere_radius(form),) * 2
    return _Medium(
        thickness=layers.thickness,
        index=jnp.concatenate([one, layers.index, layers.index[-1:]]),
        rate_event=event,
        rate_absorb=absorb * layers.mu_a,
        albedo=layers.hit_albedo**absorb,
        node=low,
        node_part=1.0 - jnp.take_along_axis(shares, low[None], axis=0)[0],
        nodes=jnp.asarray(NODES, dtype),
        particle=jnp.asarray([melanosome.SHRINKING[s] for s in STRATA], dtype),
        axes=jnp.asarray(axes, dtype),
        facets=jnp.asarray(_facets(float(layers.roughness)), dtype),
        bottom=layers.bottom**absorb,
    )


_facets = lru_cache(maxsize=32)(fresnel.facet_table)


def _pick(table: Array, layer: Array) -> Array:
    """table[layer] for six rows by comparisons, which vectorise where a gather does not."""
    out = jnp.broadcast_to(table[0], layer.shape)
    for i in range(1, table.shape[0]):
        out = jnp.where(layer >= i, table[i], out)
    return out


def _gather(table: Array, row: Array, hero: Array) -> Array:
    return table.reshape(-1)[row * table.shape[1] + hero]


def _turn(u: tuple[Array, Array, Array], cos: Array, sin: Array, phi: Array):
    """The direction at a polar angle and azimuth about `u`."""
    p, q = fresnel.basis(u)
    a, b = sin * jnp.cos(phi), sin * jnp.sin(phi)
    out = [cos * ui + a * pi + b * qi for ui, pi, qi in zip(u, p, q, strict=True)]
    norm = jax.lax.rsqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    return out[0] * norm, out[1] * norm, out[2] * norm


def _support2(a2: Array, b2: Array, along: Array) -> Array:
    """Squared half-width of a spheroid along a direction at cosine `along` to its major axis."""
    return a2 + (b2 - a2) * along**2


def _collide(lane: _Lane, m: _Medium, hero: Array, theta_0: Array, step: Array, key: Array):
    """Move every lane that is inside a layer to its next event or interface."""
    dtype = lane.depth.dtype
    moving = lane.alive & ~lane.waiting
    u1, u2, u3, u4 = _stage(_uniform(lane.ray, step, 0, key, dtype))
    u5, u6, u7, u8 = _stage(_uniform(lane.ray, step, 1, key, dtype))
    layer = jnp.clip(lane.layer, 0, 5)
    papillary, reticular = layer == 4, layer == 5
    stratum = (layer >= 1) & (layer <= 3)
    event = jnp.where(papillary & lane.spent, 0.0, _gather(m.rate_event, layer, hero))
    absorb = _gather(m.rate_absorb, layer, hero)
    rate = event + absorb
    thickness = _pick(m.thickness, layer)
    cos = lane.u[2]
    ahead = jnp.where(cos > 0, thickness - lane.depth, lane.depth)
    ahead = ahead / jnp.maximum(jnp.abs(cos), 1e-12)
    reach = -jnp.log(u1) / jnp.maximum(rate, 1e-30)
    crosses = reach >= ahead
    drawn_again = moving & lane.again
    moves = moving & ~lane.again
    distance = jnp.where(moves, jnp.minimum(reach, ahead), 0.0)
    depth = jnp.clip(lane.depth + distance * cos, 0.0, thickness)
    stops = moves & ~crosses
    absorbed = stops & (u2 * rate < absorb)
    meets = stops & ~absorbed
    event, absorb, rate, thickness, crosses, distance, depth, absorbed, meets = _stage(
        (event, absorb, rate, thickness, crosses, distance, depth, absorbed, meets)
    )

    # the particle: orientation, where it is hit, whether it can be there (Eqs. 5 and 6)
    met = meets & stratum
    before = lane.before
    if before:
        bx, by, bz, ex, ey, ez, bsize = before
        bx, by, bz = (r - distance * d for r, d in zip((bx, by, bz), lane.u, strict=True))
        size = _pick(m.particle, layer - 1)
        a, b = m.axes[0], m.axes[1]
        u9, u10, _, _ = _stage(_uniform(lane.ray, step, 2, key, dtype))
        spheroid = b > a
        side = jnp.where(spheroid, b, 2.0 * b)  # keeps the unused branch finite for spheres
        cos_axis = jnp.where(spheroid, melanosome.axis_cosine(a, side, u4), 1.0)
        sin_axis = jnp.sqrt(jnp.clip(1.0 - cos_axis**2, 0.0, 1.0))
        beta, phi = 2.0 * jnp.pi * u5, 2.0 * jnp.pi * u6
        g_part, u_part, k_part = melanosome.entry_point(
            a, b, cos_axis, jnp.sqrt(u9), (jnp.cos(phi), jnp.sin(phi))
        )
        p, q = _stage(fresnel.basis(lane.u))
        cb, sb = jnp.cos(beta), jnp.sin(beta)
        g_part, u_part, k_part, cb, sb, sin_axis, cos_axis = _stage(
            (g_part, u_part, k_part, cb, sb, sin_axis, cos_axis)
        )
        g = tuple(cb * pi + sb * qi for pi, qi in zip(p, q, strict=True))
        k = tuple(cb * qi - sb * pi for pi, qi in zip(p, q, strict=True))
        cx, cy, cz = (
            -size * (g_part * gi + u_part * ui + k_part * ki)
            for gi, ui, ki in zip(g, lane.u, k, strict=True)
        )
        nx, ny, nz = (sin_axis * gi + cos_axis * ui for gi, ui in zip(g, lane.u, strict=True))
        cx, cy, cz, nx, ny, nz, size = _stage((cx, cy, cz, nx, ny, nz, size))
        a2, b2 = (a * size) ** 2, (b * size) ** 2
        half = jnp.sqrt(_support2(a2, b2, nz))
        fits = (depth + cz >= half) & (depth + cz <= thickness - half)
        dx, dy, dz = cx - bx, cy - by, cz - bz
        gap2 = dx**2 + dy**2 + dz**2
        inv = jax.lax.rsqrt(jnp.maximum(gap2, 1e-30))
        own = jnp.sqrt(_support2(a2, b2, (dx * nx + dy * ny + dz * nz) * inv))
        ba2, bb2 = (a * bsize) ** 2, (b * bsize) ** 2
        theirs = jnp.sqrt(_support2(ba2, bb2, (dx * ex + dy * ey + dz * ez) * inv))
        apart = (bsize == 0) | (gap2 >= (own + theirs) ** 2)
        hit = _stage(met & fits & apart)
        before = tuple(
            jnp.where(hit, new, old)
            for new, old in zip(
                (cx, cy, cz, nx, ny, nz, size), (bx, by, bz, ex, ey, ez, bsize), strict=True
            )
        )
    else:
        hit = met
        u10 = u4
    absorbed = absorbed | (hit & (u3 >= _gather(m.albedo, layer, hero)))
    hit, absorbed = _stage((hit & ~absorbed, absorbed))
    fibre = meets & papillary
    tissue = meets & reticular

    # the new direction
    theta = scattering.exponential_proposal(theta_0, u7, u8)
    theta = _stage(theta)
    cos_m, sin_m = jnp.cos(theta), jnp.sin(theta)
    bends = hit | drawn_again
    accepted = scattering.exponential_accepts(theta, sin_m, u10)
    cos_f = jax.lax.select(tissue, 2.0 * u3 - 1.0, scattering.rayleigh_cosine(u7, u8, u3, u10))
    cos_new = jnp.where(bends, cos_m, cos_f)
    sin_new = jnp.where(bends, sin_m, jnp.sqrt(jnp.clip(1.0 - cos_f**2, 0.0, 1.0)))
    turns = (bends & accepted) | fibre | tissue
    # a hit has used up the other numbers, but what the test for absorption left of its own is free
    azimuth = 2.0 * jnp.pi * jax.lax.select(hit, _last(u2, absorb, rate), u5)
    cos_new, sin_new, azimuth, turns, bends, accepted = _stage(
        (cos_new, sin_new, azimuth, turns, bends, accepted)
    )
    bent = _turn(lane.u, cos_new, sin_new, azimuth)
    u = tuple(jnp.where(turns, new, old) for new, old in zip(bent, lane.u, strict=True))

    def add(index: int, flag: Array, amount: Array | float = 1.0):
        sums[index] = sums[index] + jnp.where(flag, jnp.asarray(amount, dtype), 0.0)

    sums = list(lane.sums)
    for i in range(6):
        add(i, layer == i, distance)
    for i in range(3):
        add(6 + i, hit & (layer == i + 1))
        add(9 + i, met & (layer == i + 1))
    add(FIBRE, fibre)
    add(FIBRE_LENGTH, papillary & ~lane.spent, distance)
    add(TISSUE, tissue)
    return lane._replace(
        depth=depth,
        u=u,
        waiting=lane.waiting | (moves & crosses),
        again=bends & ~accepted,
        spent=lane.spent | fibre,
        alive=lane.alive & ~absorbed,
        before=before,
        sums=tuple(sums),
    )


def _last(u2: Array, absorb: Array, rate: Array) -> Array:
    """What a uniform number tells beyond its being above absorb/rate: uniform again."""
    share = absorb / jnp.maximum(rate, 1e-30)
    return jnp.clip((u2 - share) / jnp.maximum(1.0 - share, 1e-6), 0.0, 1.0)


def _cross(lane: _Lane, m: _Medium, hero: Array, step: Array, key: Array) -> _Lane:
    """Fresnel test, rough surface or diffusing bottom for every lane at an interface."""
    dtype = lane.depth.dtype
    here = lane.alive & lane.waiting
    u1, u2, u3, _ = _uniform(lane.ray, step, 3, key, dtype)
    down = lane.u[2] > 0
    beyond = jnp.where(down, lane.layer + 1, lane.layer - 1)
    n1 = _gather(m.index, lane.layer + 1, hero)
    n2 = _gather(m.index, beyond + 1, hero)
    surface = (lane.layer + beyond) == -1  # between -1 and 0
    bottom = beyond == 6
    place = u1 * (m.facets.shape[0] - 1)
    low = jnp.floor(place).astype(jnp.int32)
    part = place - low.astype(dtype)
    cos_s = (1.0 - part) * m.facets[low] + part * m.facets[low + 1]
    cos_s = jnp.where(surface, cos_s, 1.0)
    sin_s = jnp.sqrt(jnp.clip(1.0 - cos_s**2, 0.0, 1.0))
    phi = 2.0 * jnp.pi * u2
    towards = jnp.where(down, -1.0, 1.0).astype(dtype)
    facet = (sin_s * jnp.cos(phi), sin_s * jnp.sin(phi), towards * cos_s)
    valid, transmitted, u = fresnel.interact(lane.u, facet, n1, n2, u3)
    # rays that the surface reflects at once are counted by quadrature: from outside, all enter
    valid = valid & (transmitted | (lane.layer >= 0))
    lost = here & bottom & (u3 >= m.bottom)
    cos_b = scattering.cosine_polar(u1)
    sin_b = jnp.sqrt(u1)
    diffuse = (sin_b * jnp.cos(phi), sin_b * jnp.sin(phi), -cos_b)
    done = here & (valid | bottom)
    u = tuple(
        jnp.where(done, jnp.where(bottom, d, r), old)
        for d, r, old in zip(diffuse, u, lane.u, strict=True)
    )
    layer = jnp.where(done & transmitted & ~bottom, beyond, lane.layer)
    into = jnp.clip(layer, 0, 5)
    leaves = done & (layer < 0)
    top = u[2] > 0
    sums = list(lane.sums)
    sums[BOTTOM] = sums[BOTTOM] + jnp.where(here & bottom, 1.0, 0.0).astype(dtype)
    return lane._replace(
        depth=jnp.where(done, jnp.where(top, 0.0, _pick(m.thickness, into)), lane.depth),
        u=u,
        layer=layer,
        waiting=lane.waiting & ~done,
        spent=lane.spent & ~done,
        alive=lane.alive & ~leaves & ~lost,
        escaped=lane.escaped | leaves,
        sums=tuple(sums),
    )


def _start(ray: Array, incidence: Array, dtype: Any, independent: bool) -> _Lane:
    zero = jnp.zeros(ray.shape, dtype)
    none = jnp.zeros(ray.shape, bool)
    return _Lane(
        ray=ray,
        depth=zero,
        u=(zero + jnp.sin(incidence), zero, zero + jnp.cos(incidence)),
        layer=jnp.full(ray.shape, -1, jnp.int32),
        waiting=~none,
        again=none,
        spent=none,
        alive=~none,
        escaped=none,
        before=() if independent else (zero,) * 7,
        sums=(zero,) * SUMS,
    )


@partial(jax.jit, static_argnames=("rays", "independent", "substeps", "lanes"))
def _walk(
    medium: _Medium,
    heroes: Array,
    key: Array,
    first: Array,
    incidence: Array,
    rays: int,
    independent: bool,
    substeps: int,
    lanes: int,
) -> Paths:
    dtype = medium.thickness.dtype
    number = first + jnp.arange(rays, dtype=jnp.uint32)
    lot = _uniform(number, jnp.zeros((), jnp.uint32), 4, key, dtype)[0]
    upper = (lot < medium.node_part[heroes]).astype(medium.node.dtype)
    nodes = medium.node[heroes] + upper
    fresh = partial(_start, incidence=incidence, dtype=dtype, independent=independent)

    def round_(state):
        step, lane, place, sums, escaped, upcoming = state

        def one(i, carry):
            step, lane = carry
            hero = heroes[jnp.clip(place, 0, rays - 1)]
            theta_0 = medium.nodes[nodes[jnp.clip(place, 0, rays - 1)]]

            def collide(_, carry):
                step, lane = carry
                return step + 1, _collide(lane, medium, hero, theta_0, step + 1, key)

            step, lane = jax.lax.fori_loop(0, substeps, collide, (step, lane))
            return step, _cross(lane, medium, hero, step, key)

        step, lane = jax.lax.fori_loop(0, ROUND, one, (step, lane))
        ended = ~lane.alive & (place < rays)
        # out-of-range places are dropped: each ray is written once, when it ends
        target = jnp.where(ended, place, rays)
        sums = sums.at[target].set(jnp.stack(lane.sums, axis=1), mode="drop")
        escaped = escaped.at[target].set(lane.escaped.astype(dtype), mode="drop")
        order = upcoming + jnp.cumsum(ended, dtype=jnp.int32) - 1
        place = jnp.where(ended, order, place).astype(jnp.int32)
        begins = ended & (place < rays)
        new = fresh(first + place.astype(jnp.uint32))
        lane = jax.tree.map(lambda n, o: jnp.where(begins, n, o), new, lane)
        return step, lane, place, sums, escaped, upcoming + jnp.sum(ended, dtype=jnp.int32)

    place = jnp.arange(lanes, dtype=jnp.int32)
    lane = fresh(first + place.astype(jnp.uint32))
    state = (
        jnp.zeros((), jnp.uint32),
        lane,
        place,
        jnp.zeros((rays, SUMS), dtype),
        jnp.zeros(rays, dtype),
        jnp.asarray(lanes, jnp.int32),
    )
    state = jax.lax.while_loop(lambda s: jnp.any(s[1].alive & (s[2] < rays)), round_, state)
    return Paths(state[3], state[4], heroes, nodes.astype(jnp.int32))


def walk(
    layers: Layers,
    form: str,
    key: Key[Array, ""],
    *,
    incidence: float = math.radians(8.0),
    first: int = 0,
    rays: int = BATCH,
    absorb: float = 1.0,
    independent: bool = False,
    heroes: np.ndarray | None = None,
) -> Paths:
    """Walk `rays` rays, number `first` and on, spread over the layers' wavelengths.

    `absorb` is the share of the absorption that ends rays on the way (the rest is in the weights;
    the answer does not depend on it). `independent` leaves out the rejection of particles that
    overlap the one before or cross a boundary. `incidence` in radians. The same key and numbers
    (`first`, `rays`) give the same paths.
    """
    medium = _medium(layers, form, absorb)
    bits = jax.random.bits(key, (2,), jnp.uint32)
    if heroes is None:
        heroes = choose_heroes(layers.theta_0, bits, first, rays)
    return _walk(
        medium,
        jnp.asarray(heroes, jnp.int32),
        bits,
        jnp.asarray(first, jnp.uint32),
        jnp.asarray(incidence, layers.mu_a.dtype),
        rays,
        independent,
        SUBSTEPS,
        min(LANES, rays),
    )


def node_shares(theta_0: Float[Array, "w"]) -> Float[Array, "node w"]:
    """Probability of each of `NODES` at each wavelength; their mean of theta^2 is theta_0^2."""
    nodes = jnp.asarray(NODES**2, theta_0.dtype)[:, None]
    gaps = nodes[1:] - nodes[:-1]
    square = theta_0[None] ** 2
    up = jnp.clip((square - nodes[:-1]) / gaps, 0.0, 1.0)  # (node - 1, w)
    edge = jnp.ones_like(square)
    return jnp.concatenate([edge, up]) - jnp.concatenate([up, 0.0 * edge])


def hero_shares(theta_0: Float[Array, "w"]) -> Float[Array, "w"]:
    """Share of the rays that walk for each wavelength.

    More where few wavelengths can serve each other (theta_0 falls), fewer in the infrared beyond,
    where water leaves little light and little error.
    """
    falling = (theta_0 > 0) & (theta_0 < 0.999 * scattering.LATIMER_ANGLE)
    weight = jnp.where(falling, 2.5, jnp.where(theta_0 > 0, 1.0, 0.35)).astype(theta_0.dtype)
    return weight / jnp.sum(weight)


def choose_heroes(theta_0: Array, bits: Array, first: int, rays: int) -> np.ndarray:
    """Wavelength of each ray: a golden-ratio sequence from a random start, so that every ray's is
    drawn from `hero_shares` and any number of them is well spread."""
    start = float(bits[0]) / 2.0**32
    place = (start + (first + np.arange(rays, dtype=np.float64)) * 0.6180339887498949) % 1.0
    cumulative = np.cumsum(np.asarray(hero_shares(theta_0), np.float64))
    return np.minimum(np.searchsorted(cumulative, place, side="right"), len(cumulative) - 1)


def log_density(layers: Layers, absorb: float = 1.0) -> Float[Array, "16 w"]:
    """Coefficients of the sums along a path in the logarithm of its density at each wavelength.

    What does not depend on the wavelength or the contents (directions, facets, positions of
    particles) is left out: only ratios of densities count. The chance of a node is `node_shares`.
    """
    tiny = 1e-30

    def log(x):
        return jnp.log(jnp.maximum(x, tiny))

    k = layers.mu_a.shape[1]
    particle = layers.mu_particle[1:4]
    exposure = absorb * layers.mu_a + layers.mu_particle + layers.mu_tissue
    row = jnp.ones((1, k), layers.mu_a.dtype)
    return jnp.concatenate(
        [
            -exposure,
            absorb * log(layers.hit_albedo[1:4]),
            log(particle),
            log(layers.mu_fibre)[None],
            -layers.mu_fibre[None],
            log(layers.mu_tissue[5:]),
            (absorb * log(layers.bottom)) * row,
        ]
    )


assert len(LAYERS) == 6
