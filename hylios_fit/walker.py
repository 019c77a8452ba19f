"""The fast walk: `Layers` -> `Paths`.

Every ray walks for one column of coefficients, its own, as the paper has it: absorbed on the way or
back out. What a path does depends on the wavelength and on the contents only through quantities
that add up along it (path length in every layer, hits, fibre events, ...), so that the probability
density of a path under any other wavelength or content is the exponential of one product,
`log_density`. A ray that gets out therefore serves all wavelengths, weighted by its density there
over the mean of its densities under all columns that were walked (the balance heuristic, Veach and
Guibas 1995; hero wavelengths, Wilkie et al. 2014). `plan` chooses columns that serve a whole
spectrum with few rays; between them weights are bounded, beyond them large ones are rare (`EDGE`).
`tally` does the sums, and states the error.

Two things differ from the letter of the paper (`analog`):
- The inside of a melanosome is averaged: a hit costs its mean survival, tabulated from the literal
  trace, whatever the particle's orientation was.
- Where theta_0 falls from 5 degrees to 0 (780 to 1300 nm), rays of a `plan` walk with the angles
  of `NODES`, and the reflectance is interpolated between them (`node_shares`): long paths that bend
  a little differently could not serve each other otherwise. This changes the reflectance by at most
  0.0006 in S4, 0.0003 in S1 to S3 and 0.0008 in sixty specimens over all contents (`adding` with
  those angles and with the one between them). Shares of the light that may not be negative
  (`tally.collect_bins`) are on straight lines between two of them, and are changed by 0.002 of the
  light in S4 and 0.0002 in S1.
  Where every wavelength has a column of its own, it also has its own angle.
"""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from hylios_fit import counter, fresnel, melanosome, scattering
from hylios_fit.skin import LAYERS, STRATA, Layers
from hylios_fit.threads import in_one_piece

# What is summed along a path, in this order
LENGTH = slice(0, 6)  # path length in each layer, cm
HITS = slice(6, 9)  # melanosomes or complexes hit in each stratum, and survived
PROPOSED = slice(9, 12)  # the same before rejections
FIBRE, FIBRE_LENGTH, TISSUE, BOTTOM = range(12, 16)
BENT, STRAIGHT = 16, 17  # sum of the angles of the hits; 1 if there were hits and none bent
# how far chance turned the ray up: by fibres, tissue and the bottom, 0 in the mean (`_lift`); by
# hits, 0 in the mean with so much of what they met as a hit straightens out (`_steered`)
LIFT, STEERED, MET = 18, 19, 20
SUMS = 21
# What ends a ray inside: its layer, a hit in a stratum, the bottom
ABSORBED, BY_HIT, AT_BOTTOM, ENDS = 1, 7, 10, 11

EASE = 0.5 * scattering.LATIMER_ANGLE  # reflectance is smoothest in asinh(theta_0 / EASE)
NODES = EASE * np.sinh(np.linspace(0.0, np.arcsinh(scattering.LATIMER_ANGLE / EASE), 10))
WIDTH = 1.4  # gaps between nodes after which one counts e times less
FAR = 0.03  # nodes that would weigh no more, from 2.6 gaps away, count nothing
DRAWS = 11  # random numbers that a step may take
MANY = 10  # particles in a pass through the strata, in the mean of the columns
# steps among particles before each step that knows all else, and how many of those between two
# exchanges of rays that ended
STEPS, STEPS_AMONG_MANY = (0, 16), (3, 10)
# On a CPU their numbers stay in a core's cache; and no power of two from 1,024, or they lie pages
# apart and push each other out of it.
LANES, ACCELERATOR_LANES = 192, 1 << 17
BATCH, ACCELERATOR_BATCH = 65_536, 1 << 19  # rays of one compiled call (`batch_rays`)


class Paths(NamedTuple):
    """How the rays ended, and what they met until then.

    sums: what adds up along each path (`LENGTH`, `HITS`, ...), also of rays that ended inside.
    escaped: 1 out above, -1 out below the last layer walked, 0 ended inside.
    hero: column of the layers that each ray walked for.
    end: what ended each ray inside, a row of `end_density`; 0 if nothing did.
    """

    sums: Float[Array, "ray 21"]
    escaped: Float[Array, "ray"]
    hero: Int[Array, "ray"]
    end: Int[Array, "ray"]


class Exits(NamedTuple):
    """How each ray left: its direction, z into the skin, in the medium that it left to, and the
    place (x, y) in cm from where it entered, light coming in along +x."""

    direction: Float[Array, "ray 3"]
    place: Float[Array, "ray 2"]


class _Medium(NamedTuple):
    """Per-layer numbers of the walk; k columns. A seventh layer is the papillary dermis after the
    fibre event of a pass. Tables by layer and column are flat."""

    thickness: Array  # (7,), or (7 k,) where specimens stand side by side
    index: Array  # (8,), or (8 k,) where it differs among columns: air, the layers, below
    event: Array  # (7 k,): rate of particles, fibres or tissue
    absorb: Array  # (7 k,)
    albedo: Array  # (7 k,)
    theta_0: Array  # (k,)
    particle: Array  # (3,): size of the particle relative to that in the basale
    axes: Array  # (2,): a, b in the basale (a sphere's radius twice)
    facets: Array
    bottom: Array  # share that the bottom sends back on the walk, (k,) as the thickness
    one: Array  # 1, for `_keep`


def _uniform(seeds: tuple[Array, Array], step: Array, dtype: Any) -> Array:
    """(draw, ray): the `DRAWS` uniform numbers in (0, 1) of a step, for each ray."""
    draw = jnp.arange(DRAWS, dtype=jnp.uint32)[:, None]
    start, increment = seeds
    word = counter.word((start[None], increment[None]), step * jnp.uint32(DRAWS) + draw)
    if dtype == jnp.float32:
        # 23 bits below the 1 of a float in [1, 2), then the middle of each step
        one_to_two = jax.lax.bitcast_convert_type((word >> 9) | jnp.uint32(0x3F800000), dtype)
        return one_to_two - dtype.type(1.0 - 2.0**-24)
    return (word.astype(dtype) + 0.5) * dtype.type(2.0**-32)


def _keep(m: _Medium, *values: Array) -> tuple[Array, ...]:
    """The values, each computed once.

    XLA's CPU compiler computes again in every consumer what it holds to be cheap, whole chains of
    it; a division, by a number that it does not know to be 1, it does not.
    """
    return tuple(value / m.one for value in values)


# Taylor series on [-pi/2, pi/2], to 6e-8
_SINE = [(-1.0) ** i / math.factorial(2 * i + 1) for i in range(6)]
_COSINE = [(-1.0) ** i / math.factorial(2 * i) for i in range(7)]


def _cos_sin(half: Array) -> tuple[Array, Array]:
    """Cosine and sine of twice an angle in [-pi/2, pi/2].

    In single precision by polynomials, which vectorise where calls of a library do not.
    """
    if half.dtype != jnp.float32:
        return jnp.cos(2.0 * half), jnp.sin(2.0 * half)
    square = half * half
    sine, cosine = _SINE[-1] * square + _SINE[-2], _COSINE[-1] * square + _COSINE[-2]
    for term in reversed(_SINE[:-2]):
        sine = sine * square + term
    for term in reversed(_COSINE[:-2]):
        cosine = cosine * square + term
    sine = sine * half
    return 1.0 - 2.0 * sine * sine, 2.0 * sine * cosine


def _circle(u: Array) -> tuple[Array, Array]:
    """Cosine and sine of a uniform azimuth."""
    return _cos_sin((u - 0.5) * math.pi)


COMPILED = {
    "xla_cpu_prefer_vector_width": 512,  # a third faster where there is AVX-512
    # what `_keep` divides by is inverted once: a tenth faster; NaN and infinity stay what they are
    "xla_cpu_enable_fast_math": True,
    "xla_cpu_fast_math_honor_division": False,
    "xla_cpu_fast_math_honor_nans": True,
    "xla_cpu_fast_math_honor_infs": True,
    "xla_cpu_fast_math_honor_functions": True,
}

FLYING, AGAIN, WAITING, ABOVE, BELOW, ENDED = range(6)
"""Phase of a ray: on its way; to draw its scattering angle again; at an interface; out above, or
below; over inside, plus the row of `end_density` that says by what."""


class _Lane(NamedTuple):
    seeds: tuple[Array, Array]  # of the ray's random numbers
    depth: Array  # below the top of the layer
    u: tuple[Array, ...]
    layer: Array  # -1 outside; 6: papillary dermis whose fibre event has happened
    phase: Array
    before: tuple[Array, ...]  # the particle met before: centre from here, size (0: none), axis
    place: tuple[Array, ...]  # x, y, where exits are recorded
    lengths: Array  # (7, lane), in each of the seven layers
    hits: Array  # (3, lane), in each stratum
    proposed: Array  # (3, lane)
    counts: tuple[Array, ...]  # fibres, tissue, bottom
    bent: Array  # sum of the angles of the hits
    lift: Array  # `LIFT`
    steered: tuple[Array, Array]  # `STEERED` and `MET`


def _medium(layers: Layers, form: str, absorb: float) -> _Medium:
    dtype = layers.mu_a.dtype
    k = layers.mu_a.shape[1]
    one = jnp.ones((1, k), dtype)
    index = jnp.concatenate([one, layers.index, layers.index[-1:]])
    if not _disperses(layers):
        index = index[:, :1]
    event = layers.mu_particle + layers.mu_tissue
    event = event.at[4].set(layers.mu_fibre)
    if form == "dispersed":
        axes = melanosome.semi_axes(form)
    else:
        axes = (melanosome.sphere_radius(form),) * 2

    def seven(table, last):
        return jnp.concatenate([table, last]).reshape(-1)

    return _Medium(
        thickness=seven(layers.thickness, layers.thickness[4:5]),
        index=index.reshape(-1),
        event=seven(event, 0.0 * one),
        absorb=seven(absorb * layers.mu_a, absorb * layers.mu_a[4:5]),
        albedo=seven(layers.hit_albedo**absorb, one),
        theta_0=layers.theta_0,
        particle=jnp.asarray([melanosome.SHRINKING[s] for s in STRATA], dtype),
        axes=jnp.asarray(axes, dtype),
        facets=jnp.asarray(_facets(float(layers.roughness)), dtype),
        bottom=layers.bottom**absorb,
        one=jnp.ones((), dtype),
    )


def _disperses(layers: Layers) -> bool:
    return bool(np.ptp(np.asarray(layers.index), axis=1).any())


_facets = lru_cache(maxsize=32)(fresnel.facet_table)


def _pick(table: Array, layer: Array) -> Array:
    """table[layer] for a few rows by comparisons, which vectorise where a gather does not."""
    out = jnp.broadcast_to(table[0], layer.shape)
    for i in range(1, table.shape[0]):
        out = jnp.where(layer >= i, table[i], out)
    return out


def _of_layer(m: _Medium, table: Array, rows: int, layer: Array, hero: Array) -> Array:
    """From a table by layer alone, or by layer and column."""
    if table.shape[0] == rows:
        return _pick(table, layer)
    return _at(table, jnp.maximum(layer, 0) * (m.event.shape[0] // 7) + hero)


def _thickness(m: _Medium, layer: Array, hero: Array) -> Array:
    return _of_layer(m, m.thickness, 7, layer, hero)


def _index(m: _Medium, layer: Array, hero: Array) -> Array:
    return _of_layer(m, m.index, 8, layer + 1, hero)


def _at(table: Array, place: Array) -> Array:
    return table.at[place].get(mode="promise_in_bounds")


def _number(flag: Array, dtype: Any) -> Array:
    """1 or 0: what `_keep` takes."""
    return jnp.where(flag, 1.0, 0.0).astype(dtype)


def _combine(a: Array, u: tuple, b: Array, p: tuple, c: Array, q: tuple) -> list[Array]:
    return [a * ui + b * pi + c * qi for ui, pi, qi in zip(u, p, q, strict=True)]


def _support2(a2: Array, b2: Array, along: Array) -> Array:
    """Squared half-width of a spheroid along a direction at cosine `along` to its major axis."""
    return a2 + (b2 - a2) * along**2


def _sphere(m: _Medium, size: Array, u: tuple, p: tuple, q: tuple, xi: tuple) -> tuple[Array, ...]:
    """A sphere that a ray hits: centre from the point of entry, size."""
    radius = m.axes[0] * size
    c, s = _circle(xi[0])
    across = radius * jnp.sqrt(xi[1])
    b, c = _keep(m, across * c, across * s)
    centre = _combine(radius * jnp.sqrt(1.0 - xi[1]), u, b, p, c, q)
    return (*_keep(m, *centre), size)


def _spheroid(
    m: _Medium, size: Array, u: tuple, p: tuple, q: tuple, xi: tuple
) -> tuple[Array, ...]:
    """A spheroid that a ray hits (Eqs. 5 and 6): centre from the point of entry, size, axis."""
    a, b = m.axes[0], m.axes[1]
    (cos_axis,) = _keep(m, melanosome.axis_cosine(a, b, xi[2]))
    sin_axis = jnp.sqrt(1.0 - cos_axis**2)
    c, s = _keep(m, *_circle(xi[0]))
    parts = melanosome.entry_point(a, b, cos_axis, jnp.sqrt(xi[1]), (c, s))
    g_part, u_part, k_part = _keep(m, *parts)
    cb, sb = _keep(m, *_circle(xi[3]))
    # in the plane of ray and axis g = cb p + sb q, across it k = cb q - sb p
    centre = _combine(
        -size * u_part, u, -size * (cb * g_part - sb * k_part), p,
        -size * (sb * g_part + cb * k_part), q,
    )  # fmt: skip
    axis = _combine(cos_axis, u, sin_axis * cb, p, sin_axis * sb, q)
    return (*_keep(m, *centre), size, *_keep(m, *axis))


def _there(m: _Medium, new: tuple, old: tuple, depth: Array, thickness: Array) -> Array:
    """Whether a particle can be there: inside its layer, and clear of the one before."""
    across = [n - o for n, o in zip(new[:3], old[:3], strict=True)]
    gap2 = across[0] ** 2 + across[1] ** 2 + across[2] ** 2
    if len(new) == 4:
        half = m.axes[0] * new[3]
        reach2 = (half + m.axes[0] * old[3]) ** 2
    else:
        (inverse,) = _keep(m, jax.lax.rsqrt(jnp.maximum(gap2, 1e-30)))

        def extent(particle):
            a2, b2 = (m.axes[0] * particle[3]) ** 2, (m.axes[1] * particle[3]) ** 2
            dot = sum(d * e for d, e in zip(across, particle[4:], strict=True))
            return jnp.sqrt(_support2(a2, b2, dot * inverse))

        half2 = _support2((m.axes[0] * new[3]) ** 2, (m.axes[1] * new[3]) ** 2, new[6])
        half = jnp.sqrt(half2)
        reach2 = (extent(new) + extent(old)) ** 2
    fits = (depth + new[2] >= half) & (depth + new[2] <= thickness - half)
    return fits & ((old[3] == 0) | (gap2 >= reach2))


class _Near(NamedTuple):
    """Of the layer that each ray is in."""

    absorb: Array
    event: Array
    albedo: Array
    thickness: Array
    size: Array | None  # of its particles, where they have a place


def _near(m: _Medium, layer: Array, hero: Array, placed: bool) -> _Near:
    row = jnp.maximum(layer, 0) * (m.event.shape[0] // 7) + hero
    return _Near(
        _at(m.absorb, row),
        _at(m.event, row),
        _at(m.albedo, row),
        _thickness(m, layer, hero),
        _pick(m.particle, layer - 1) if placed else None,
    )


class _Event(NamedTuple):
    """What the way to the next event or interface comes to, up to the angle of a hit."""

    draws: tuple[Array, ...]  # the step's uniform numbers
    distance: Array
    depth: Array
    crosses: Array  # comes to an interface
    absorbed: Array
    met: Array  # a particle, a fibre or tissue
    frame: tuple[tuple, tuple]  # at right angles to the direction
    particle: Array  # met one, which may not be there
    hit: Array
    before: Any  # the last particle that was hit
    ends: Array
    bends: Array  # a hit asks for an angle, now or again
    accepted: Array  # the angle stands (Algorithm 1)
    angle: tuple[Array, Array, Array]  # theta, its cosine and sine


def _event(
    lane: _Lane, m: _Medium, near: _Near, moves: Array, theta_0: Array, step: Array, spheroid: bool
) -> _Event:
    dtype = lane.depth.dtype
    (every,) = _keep(m, _uniform(lane.seeds, step, dtype))
    draws: tuple[Array, ...] = tuple(every)
    u1, u2, u3, u4, u5, _, u7, u8, u9, u10, u11 = draws
    rate = near.event + near.absorb
    ahead = jnp.where(lane.u[2] > 0, near.thickness - lane.depth, lane.depth)
    ahead = ahead / jnp.maximum(jnp.abs(lane.u[2]), 1e-12)
    reach = -jnp.log(u1) / jnp.maximum(rate, 1e-30)
    crosses = moves & (reach >= ahead)
    stops = moves & ~crosses
    met = stops & (u2 * rate >= near.absorb) & (near.event > 0)
    absorbed, met, distance = _keep(
        m,
        _number(stops & ~met, dtype),
        _number(met, dtype),
        jnp.where(moves, jnp.minimum(reach, ahead), 0.0),
    )
    (depth,) = _keep(m, jnp.clip(lane.depth + distance * lane.u[2], 0.0, near.thickness))
    absorbed, met = absorbed > 0, met > 0

    # the particle: where it lies, whether it can be there
    particle = met & (lane.layer <= 3)
    p, q = fresnel.basis((lane.u[0], lane.u[1], lane.u[2]))
    p, q = _keep(m, *p), _keep(m, *q)
    before, hit = lane.before, particle
    if before:
        assert near.size is not None
        moved = [b - distance * ui for b, ui in zip(before[:3], lane.u, strict=True)]
        before = (*_keep(m, *moved), *before[3:])
        make = _spheroid if spheroid else _sphere
        new = make(m, near.size, lane.u, p, q, (u5, u9, u4, u11))
        can = particle & _there(m, new, before, depth, near.thickness)
        hit = _keep(m, _number(can, dtype))[0] > 0
        before = tuple(jnp.where(hit, n, o) for n, o in zip(new, before, strict=True))

    theta = scattering.exponential_proposal(theta_0, u7, u8)
    cos, sin = _keep(m, *_cos_sin(jnp.minimum(0.5 * theta, 0.5 * math.pi)))
    return _Event(
        draws, distance, depth, crosses, absorbed, met, (p, q), particle, hit, before,
        ends=absorbed | (hit & (u3 >= near.albedo)),
        bends=hit | (lane.phase == AGAIN),
        accepted=scattering.exponential_accepts(theta, sin, u10),
        angle=(theta, cos, sin),
    )  # fmt: skip


def _turned(
    m: _Medium, u: tuple, event: _Event, cos: Array, sin: Array
) -> tuple[Array, Array, Array]:
    """The direction, turned by an angle about a uniform azimuth."""
    p, q = event.frame
    c, s = _keep(m, *_circle(event.draws[5]))
    cos, b, c = _keep(m, cos, sin * c, sin * s)
    return fresnel.unit(_keep(m, *_combine(cos, u, b, p, c, q)))


def _particle_step(
    state: tuple[_Lane, Array, Array, Array],
    m: _Medium,
    near: _Near,
    theta_0: Array,
    step: Array,
    worth: Array,
    spheroid: bool,
) -> tuple[_Lane, Array, Array, Array]:
    """As `_step`, of rays among melanosomes, up to an interface; all others wait. With the lane:
    the length, the hits and the particles proposed since its layer was looked up (`near`)."""
    lane, length, hits, proposed = state
    dtype = lane.depth.dtype
    moves = (lane.phase == FLYING) & (lane.layer >= 1) & (lane.layer <= 3)
    event = _event(lane, m, near, moves, theta_0, step, spheroid)
    theta, cos, sin = event.angle
    turns = event.bends & event.accepted
    bend = jnp.where(turns & ~event.ends, theta, 0.0)
    u = _turned(m, lane.u, event, jnp.where(turns, cos, 1.0), jnp.where(turns, sin, 0.0))

    end = jnp.where(event.absorbed, ABSORBED, BY_HIT - 1) + lane.layer
    phase = jnp.where(turns, FLYING, jnp.where(event.bends, AGAIN, lane.phase))
    phase = jnp.where(event.crosses, WAITING, phase)
    phase = jnp.where(event.ends, ENDED + end, phase)
    lane = lane._replace(
        depth=event.depth,
        u=u,
        phase=phase,
        before=event.before,
        place=_moved(lane, event),
        bent=lane.bent + bend,
        steered=_steered(lane, u, bend, worth),
    )
    return (
        lane,
        length + event.distance,
        hits + _number(event.hit & ~event.ends, dtype),
        proposed + _number(event.particle, dtype),
    )


def _moved(lane: _Lane, event: _Event) -> tuple[Array, ...]:
    return tuple(x + event.distance * ui for x, ui in zip(lane.place, lane.u, strict=False))


def _among(
    lane: _Lane,
    m: _Medium,
    hero: Array,
    theta_0: Array,
    first: Array,
    steps: int,
    spheroid: bool,
) -> _Lane:
    """So many of `_particle_step`, during which no ray changes its layer."""
    near, worth = _near(m, lane.layer, hero, bool(lane.before)), _worth(lane)
    zero = jnp.zeros_like(lane.depth)

    def one(i, state):
        return _particle_step(
            state, m, near, theta_0, first + i.astype(jnp.uint32), worth, spheroid
        )

    state: Any = jax.lax.fori_loop(0, steps, one, (lane, zero, zero, zero))
    lane, length, hits, proposed = state

    return lane._replace(
        lengths=_into(lane.lengths, 0, lane.layer, length),
        hits=_into(lane.hits, 1, lane.layer, hits),
        proposed=_into(lane.proposed, 1, lane.layer, proposed),
    )


def _into(totals: Array, first: int, layer: Array, new: Array) -> Array:
    """The totals (row, lane) of the layer `first` and those below it, with what is `new` in the
    layer that each ray is in: one pass over all rows."""
    row = jnp.arange(first, first + totals.shape[0], dtype=layer.dtype)[:, None]
    return totals + jnp.where(layer[None] == row, new[None], 0.0)


def _step(
    lane: _Lane,
    m: _Medium,
    hero: Array,
    theta_0: Array,
    step: Array,
    spheroid: bool,
    below: int,
    steers: bool,
) -> _Lane:
    """Move every ray to its next event or interface, and let that happen. Whether hits are looked
    at for how they steer: only where there are many."""
    dtype = lane.depth.dtype
    layer = lane.layer
    near = _near(m, layer, hero, bool(lane.before))
    event = _event(lane, m, near, lane.phase == FLYING, theta_0, step, spheroid)
    _, _, u3, _, u5, _, u7, u8, u9, u10, _ = event.draws
    crosses, distance, depth = event.crosses, event.distance, event.depth
    hit, bends, accepted, ends = event.hit, event.bends, event.accepted, event.ends
    fibre, tissue = event.met & (layer == 4), event.met & (layer == 5)

    # the new direction
    theta, cos, sin = event.angle
    cos_f = jnp.where(tissue, 2.0 * u3 - 1.0, scattering.rayleigh_cosine(u7, u8, u3, u10))
    turns = (bends & accepted) | fibre | tissue
    cos = jnp.where(turns, jnp.where(bends, cos, cos_f), 1.0)
    sin_f = jnp.sqrt(jnp.clip(1.0 - cos_f**2, 0.0, 1.0))
    sin = jnp.where(turns, jnp.where(bends, sin, sin_f), 0.0)
    bend = jnp.where(bends & accepted & ~ends, theta, 0.0)
    turned = u = _turned(m, lane.u, event, cos, sin)

    # the interface
    here = crosses | (lane.phase == WAITING)
    down = u[2] > 0
    layer = jnp.where(layer == 6, 4, layer)
    beyond = jnp.where(down, layer + 1, layer - 1)
    n1, n2 = _keep(m, _index(m, layer, hero), _index(m, beyond, hero))
    cos_s = _facet(m, u9)
    (cos_s,) = _keep(m, jnp.where(layer + beyond == -1, cos_s, 1.0))  # between -1 and 0: rough
    sin_s = jnp.sqrt(jnp.clip(1.0 - cos_s**2, 0.0, 1.0))
    c, s = _keep(m, *_circle(u5))
    facet = _keep(m, sin_s * c, sin_s * s, jnp.where(down, -cos_s, cos_s))
    valid, transmitted, refracted = fresnel.interact(
        u, (facet[0], facet[1], facet[2]), n1, n2, u3, partial(_keep, m)
    )
    # rays that the surface reflects at once are counted by quadrature: from outside, all enter
    valid = valid & (transmitted | (layer >= 0))
    valid, passes = _keep(m, _number(valid, dtype), _number(transmitted, dtype))
    refracted = _keep(m, *refracted)
    bottom = beyond == 6
    kept = _at(m.bottom, hero) if m.bottom.ndim else m.bottom
    lost = here & bottom & (u3 >= kept)
    done = here & ((valid > 0) | bottom)
    passes = done & (passes > 0) & ~bottom
    lift = _lift(u[2], fibre | tissue, u9, here & bottom & ~lost, lane.counts[2])
    sin_b = jnp.sqrt(u9)
    diffuse = (sin_b * c, sin_b * s, -scattering.cosine_polar(u9))
    u = tuple(
        jnp.where(done, jnp.where(bottom, d, r), o)
        for d, r, o in zip(diffuse, refracted, u, strict=True)
    )
    layer = jnp.where(passes, beyond, jnp.where(fibre, 6, jnp.where(done, layer, lane.layer)))
    top = u[2] > 0
    depth = jnp.where(done, jnp.where(top, 0.0, _thickness(m, layer, hero)), depth)

    happened = fibre, tissue, here & bottom
    over = lane.phase >= ABOVE
    by_medium = ABSORBED + jnp.where(lane.layer == 6, 4, lane.layer)
    end = jnp.where(event.absorbed, by_medium, jnp.where(lost, AT_BOTTOM, BY_HIT - 1 + lane.layer))
    phase = jnp.where(bends & ~accepted, AGAIN, FLYING)
    phase = jnp.where(here & ~done, WAITING, phase)
    phase = jnp.where(ends | lost, ENDED + end, phase)
    phase = jnp.where(passes & (layer < 0), ABOVE, phase)
    if below < len(LAYERS) - 1:
        phase = jnp.where(passes & (layer == below + 1), BELOW, phase)
    return lane._replace(
        depth=depth,
        u=u,
        layer=layer,
        phase=jnp.where(over, lane.phase, phase),
        before=event.before,
        place=_moved(lane, event),
        lengths=_into(lane.lengths, 0, lane.layer, distance),
        hits=_into(lane.hits, 1, lane.layer, _number(hit & ~ends, dtype)),
        proposed=_into(lane.proposed, 1, lane.layer, _number(event.particle, dtype)),
        counts=tuple(
            total + _number(flag, dtype) for flag, total in zip(happened, lane.counts, strict=True)
        ),
        bent=lane.bent + bend,
        lift=lane.lift + lift,
        steered=_steered(lane, turned, bend, _worth(lane)) if steers else lane.steered,
    )


def _lift(cosine: Array, scattered: Array, u: Array, sent_back: Array, bottoms: Array) -> Array:
    """How far chance turned a ray up, where it scattered by as much as down (Rayleigh's law and the
    even one are), or came back from the bottom. The later, the less that matters: what it counts is
    known before the draw, or the mean were not 0."""
    counts = jnp.maximum(1.0 - 0.2 * bottoms, 0.2)
    lift = jnp.where(scattered, -(cosine**3), 0.0)
    # half of the diffuse light from the bottom is that near to the normal
    lift = jnp.where(sent_back, jnp.where(u < 0.5, 0.25, -0.25), lift)
    return counts * lift


def _worth(lane: _Lane) -> Array:
    """What hits that are to come count in `STEERED` and `MET`: less deep down, and late."""
    return (4 - lane.layer).astype(lane.bent.dtype) * jnp.exp(-lane.bent / 30.0)


def _steered(lane: _Lane, u: tuple, theta: Array, worth: Array) -> tuple[Array, Array]:
    """What `STEERED` and `MET` are after hits that bent rays by `theta` to the direction `u`: how
    much it changed the cosine, upwards, and what that was. A hit leaves the mean cosine of its law
    of it (`scattering.exponential_lost_cosine`)."""
    worth = jnp.where(theta > 0, worth, 0.0)
    steered, met = lane.steered
    return steered + worth * (lane.u[2] - u[2]), met - worth * lane.u[2]


def _facet(m: _Medium, u: Array) -> Array:
    """Polar cosine of a facet of the rough surface (Eq. 8)."""
    place = u * (m.facets.shape[0] - 1)
    low = jnp.floor(place)
    part = place - low
    row = low.astype(jnp.int32)
    return (1.0 - part) * _at(m.facets, row) + part * _at(m.facets, row + 1)


def _start(
    ray: Array,
    key: Array,
    incidence: Array,
    dtype: Any,
    independent: bool,
    spheroid: bool,
    exits: bool,
) -> _Lane:
    zero = jnp.zeros(ray.shape, dtype)
    return _Lane(
        seeds=counter.seeds(ray, key),
        depth=zero,
        u=(zero + jnp.sin(incidence), zero, zero + jnp.cos(incidence)),
        layer=jnp.full(ray.shape, -1, jnp.int32),
        phase=jnp.full(ray.shape, WAITING, jnp.int32),
        before=() if independent else (zero,) * (7 if spheroid else 4),
        place=(zero,) * (2 if exits else 0),
        lengths=jnp.zeros((7, *ray.shape), dtype),
        hits=jnp.zeros((3, *ray.shape), dtype),
        proposed=jnp.zeros((3, *ray.shape), dtype),
        counts=(zero,) * 3,
        bent=zero,
        lift=zero,
        steered=(zero, zero),
    )


def _sums(lane: _Lane) -> Array:
    """(lane, 21): what adds up along each path."""
    first, last = lane.lengths[:4], lane.lengths[5]
    unspent, spent = lane.lengths[4], lane.lengths[6]
    fibre, tissue, bottom = lane.counts
    straight = _number((jnp.sum(lane.hits, axis=0) > 0) & (lane.bent == 0), lane.bent.dtype)
    rows = (
        *first, unspent + spent, last, *lane.hits, *lane.proposed, fibre, unspent, tissue, bottom,
        lane.bent, straight, lane.lift, *lane.steered,
    )  # fmt: skip
    return jnp.stack(rows, axis=1)


@partial(
    jax.jit,
    static_argnames=(
        "rays",
        "independent",
        "spheroid",
        "exits",
        "below",
        "lanes",
        "among",
        "round_length",
    ),
    compiler_options=COMPILED,
)
def _walk(
    medium: _Medium,
    heroes: Array,
    order: Array,
    key: Array,
    first: Array,
    sent: Array,
    incidence: Array,
    rays: int,
    independent: bool,
    spheroid: bool,
    exits: bool,
    below: int,
    lanes: int,
    among: int,
    round_length: int,
) -> tuple[Paths, Array]:
    dtype = medium.thickness.dtype
    fresh = partial(
        _start, key=key, incidence=incidence, dtype=dtype,
        independent=independent, spheroid=spheroid, exits=exits,
    )  # fmt: skip

    def round_(state):
        step, lane, place, sums, escaped, end, left, upcoming = state
        ray = order[jnp.clip(place, 0, rays - 1)]
        hero = heroes[ray]
        theta_0 = medium.theta_0[hero]

        def one(_, carry):
            step, lane = carry
            step = step + 1
            if among:
                lane = _among(lane, medium, hero, theta_0, step, among, spheroid)
                step = step + jnp.uint32(among)
            return step, _step(lane, medium, hero, theta_0, step, spheroid, below, among > 0)

        steps = partial(jax.lax.fori_loop, 0, round_length, one)
        step, lane = in_one_piece(steps, (step, lane))
        ended = (lane.phase >= ABOVE) & (place < sent)
        # out-of-range places are dropped: each ray is written once, when it ends
        target = jnp.where(ended, ray, rays)
        sums = sums.at[target].set(_sums(lane), mode="drop")
        out = _number(lane.phase == ABOVE, dtype) - _number(lane.phase == BELOW, dtype)
        escaped = escaped.at[target].set(out, mode="drop")
        end = end.at[target].set(jnp.maximum(lane.phase - ENDED, 0), mode="drop")
        if exits:
            way = jnp.stack((*lane.u, *lane.place), axis=1)
            left = left.at[target].set(way, mode="drop")
        after = upcoming + jnp.cumsum(ended, dtype=jnp.int32) - 1
        place = jnp.where(ended, after, place).astype(jnp.int32)
        begins = ended & (place < sent)
        new = fresh(first + order[jnp.clip(place, 0, rays - 1)].astype(jnp.uint32))
        lane = jax.tree.map(
            lambda n, o: jnp.where(jnp.broadcast_to(begins, n.shape), n, o), new, lane
        )
        upcoming = upcoming + jnp.sum(ended, dtype=jnp.int32)
        return step, lane, place, sums, escaped, end, left, upcoming

    place = jnp.arange(lanes, dtype=jnp.int32)
    lane = fresh(first + order[:lanes].astype(jnp.uint32))
    state = (
        jnp.zeros((), jnp.uint32),
        lane,
        place,
        jnp.zeros((rays, SUMS), dtype),
        jnp.zeros(rays, dtype),
        jnp.zeros(rays, jnp.int32),
        jnp.zeros((rays if exits else 0, 5), dtype),
        jnp.asarray(lanes, jnp.int32),
    )

    def going_on(state):
        _, lane, place, *_, upcoming = state
        return (upcoming < sent) | jnp.any((lane.phase < ABOVE) & (place < sent))

    state = jax.lax.while_loop(going_on, round_, state)
    _, _, _, sums, escaped, end, left, _ = state
    return Paths(sums, escaped, heroes, end), left


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
    shares: Float[Array, "k"] | None = None,
    sent: int | None = None,
) -> Paths:
    """Walk `rays` rays, number `first` and on, spread over the layers' columns.

    `absorb` is the share of the absorption that ends rays on the way (the rest is in the weights;
    the answer does not depend on it). `independent` leaves out the rejection of particles that
    overlap the one before or cross a boundary. `incidence` in radians. The same key and numbers
    (`first`, `rays`) give the same paths. `shares` of the rays for each column, by default
    `hero_shares`; or `heroes`, the column of each. Only the first `sent` of them set out, if given:
    a pilot needs no program of its own.
    """
    return _run(
        layers, form, key, incidence, first, rays, absorb, independent, heroes, shares, False,
        LAYERS[-1], sent,
    )[0]  # fmt: skip


def walk_out(
    layers: Layers,
    form: str,
    key: Key[Array, ""],
    *,
    incidence: float = math.radians(8.0),
    first: int = 0,
    rays: int = BATCH,
    absorb: float = 1.0,
    independent: bool = False,
    shares: Float[Array, "k"] | None = None,
    last: str = LAYERS[-1],
) -> tuple[Paths, Exits]:
    """`walk`, with the direction and the place of every exit.

    `last` names the last layer that is there: a ray that crosses its lower interface leaves below,
    into a medium with the index of the next layer. After the reticular dermis comes the bottom, as
    ever.
    """
    paths, left = _run(
        layers, form, key, incidence, first, rays, absorb, independent, None, shares, True, last
    )
    return paths, Exits(left[:, :3], left[:, 3:])


def _run(
    layers, form, key, incidence, first, rays, absorb, independent, heroes, shares, exits, last,
    sent=None,
) -> tuple[Paths, Array]:  # fmt: skip
    medium = _medium(layers, form, absorb)
    bits = jax.random.bits(key, (2,), jnp.uint32)
    sent = rays if sent is None else sent
    if heroes is None:
        shares = hero_shares(layers.theta_0) if shares is None else shares
        heroes = np.zeros(rays, np.int32)
        heroes[:sent] = spread(shares, bits, first, sent)
    return _walk(
        medium,
        jnp.asarray(heroes, jnp.int32),
        jnp.asarray(_longest_first(medium, np.asarray(heroes)[:sent], rays), jnp.int32),
        bits,
        jnp.asarray(first, jnp.uint32),
        jnp.asarray(sent, jnp.int32),
        jnp.asarray(incidence, layers.mu_a.dtype),
        rays,
        independent,
        form == "dispersed",
        exits,
        LAYERS.index(last),
        min(LANES if jax.default_backend() == "cpu" else ACCELERATOR_LANES, rays),
        *_rhythm(medium),
    )


def batch_rays() -> int:
    """Rays of one compiled call: memory does not depend on how many there are in all."""
    return BATCH if jax.default_backend() == "cpu" else ACCELERATOR_BATCH


def _rhythm(medium: _Medium) -> tuple[int, int]:
    """`STEPS`, or `STEPS_AMONG_MANY`: there a ray seldom needs a step that knows all else."""
    parts = (np.asarray(part).reshape(7, -1)[1:4] for part in (medium.event, medium.thickness))
    return STEPS_AMONG_MANY if _are_many(*parts) else STEPS


def _are_many(mu_particle: np.ndarray, thickness: np.ndarray) -> bool:
    return bool(np.mean(np.sum(mu_particle * thickness, axis=0)) > MANY)


def _longest_first(medium: _Medium, heroes: np.ndarray, rays: int) -> np.ndarray:
    """In which order the rays set out: those of columns that lose little live long, and would keep
    the other lanes waiting at the end."""
    columns = medium.theta_0.shape[0]
    thickness = np.asarray(medium.thickness).reshape(7, -1)
    each = np.asarray(medium.absorb) + np.asarray(medium.event) * (1.0 - np.asarray(medium.albedo))
    lost = np.sum(each.reshape(7, columns) * thickness, axis=0)
    rank = np.unique(lost, return_inverse=True)[1].astype(np.uint16)  # sorted by their digits
    order = np.arange(rays)
    order[: heroes.size] = np.argsort(rank[heroes], kind="stable")
    return order


@partial(jax.jit, static_argnames="positive")
def node_shares(theta_0: Float[Array, "w"], positive: bool = False) -> Float[Array, "node w"]:
    """What each of `NODES` counts at each wavelength; at either end its node alone.

    The weights, some of them below 0, with the least sum of squares that are exact for parabolas in
    asinh(theta_0 / `EASE`), squares of nodes `WIDTH` gaps away counting e times as much. Far ones
    count nothing (`FAR`): they have no columns for these wavelengths, and a rare path could count
    hundreds of times. Or, if `positive`, those of the straight line between the two nodes around.
    """
    count = len(NODES)
    place, asked = np.arcsinh(NODES / EASE), jnp.arcsinh(theta_0[None] / EASE)  # (1, w)
    nodes, number = (jnp.asarray(x, asked.dtype) for x in (place, np.arange(count)))
    away = number[:, None] - jnp.interp(asked[0], nodes, number)[None]
    if positive:
        return jnp.maximum(1.0 - jnp.abs(away), 0.0)
    weight, nodes = jnp.maximum(jnp.exp(-((away / WIDTH) ** 2)) - FAR, 0.0), nodes[:, None]
    # polynomials that are orthogonal over the weighted nodes: there (`at`), and where asked (`to`)
    at, to = jnp.ones_like(weight), jnp.ones_like(asked)
    last_at, last_to, last_norm = 0.0 * at, 0.0 * to, 1.0
    shares = jnp.zeros_like(weight)
    for _ in range(3):
        norm = jnp.sum(weight * at**2, axis=0, keepdims=True)
        shares = shares + weight * at * to / norm
        middle = jnp.sum(weight * nodes * at**2, axis=0, keepdims=True) / norm
        ratio, last_norm = norm / last_norm, norm
        at, last_at = (nodes - middle) * at - ratio * last_at, at
        to, last_to = (asked - middle) * to - ratio * last_to, to
    ends = jnp.asarray(np.eye(count)[:, [0, -1]], asked.dtype)
    shares = jnp.where(theta_0[None] > 0, shares, ends[:, :1])
    return jnp.where(theta_0[None] < (1.0 - 1e-6) * NODES[-1], shares, ends[:, 1:])


@jax.jit
def hero_shares(theta_0: Float[Array, "w"]) -> Float[Array, "w"]:
    """Share of the rays that walk for each wavelength.

    More where few wavelengths can serve each other (theta_0 falls), fewer in the infrared beyond,
    where water leaves little light and little error.
    """
    falling = (theta_0 > 0) & (theta_0 < 0.999 * scattering.LATIMER_ANGLE)
    weight = jnp.where(falling, 2.5, jnp.where(theta_0 > 0, 1.0, 0.35)).astype(theta_0.dtype)
    return weight / jnp.sum(weight)


def spread(shares: Array, bits: Array, first: int, rays: int) -> np.ndarray:
    """Column of each ray: a golden-ratio sequence from a random start, so that every ray's is
    drawn from `shares` and any number of them is well spread."""
    start = float(bits[0]) / 2.0**32
    place = (start + (first + np.arange(rays, dtype=np.float64)) * 0.6180339887498949) % 1.0
    cumulative = np.cumsum(np.asarray(shares, np.float64))
    cumulative /= cumulative[-1]
    return np.minimum(np.searchsorted(cumulative, place, side="right"), len(cumulative) - 1)


class Plan(NamedTuple):
    """What rays walk for: columns of coefficients, and the share of the rays for each."""

    layers: Layers
    shares: Float[Array, "k"]


COLUMNS = (4, 1, 1, 1, 2, 2, 2, 2, 2, 8)  # of each node of `NODES`
EVEN = 0.65  # power of its demand that a node's share of the rays goes with (1/2 would be best if
# no node served another)
LEAST_SHARE = 0.01  # of the rays, for every column that serves anything
FEW = 0.004  # hits in a straight pass of a stratum without melanosomes
NOTHING = 1e-12
NEVER = -1e30
# of the absorption on the way, the rest in the weights; more where paths are long and cost much
SPENT, SPENT_AMONG_MANY = 0.4, 0.8
# of a column's demand, what lies beyond the outermost (and before an only one, where fibres scatter
# more): further in, rare long paths had weights of hundreds
EDGE = 0.2
REACH = 0.6  # how far, in the logarithm of a scattering coefficient, paths serve others well


def plan(layers: Layers) -> Plan:
    """Columns that serve the wavelengths of `layers` with few rays, always as many.

    Paths that bend at one of `NODES` serve all wavelengths that know it, the better the nearer
    their scattering by fibres and tissue. So each node gets columns at steps of that scattering,
    closer and with more of the rays where a guess of the reflectance says that light comes back.
    Of the absorption each has a share (`SPENT`, `SPENT_AMONG_MANY`) of the least that the
    wavelengths around it have: the bright ones decide how long rays must live.
    """
    dtype = layers.mu_a.dtype
    used = np.abs(np.asarray(node_shares(layers.theta_0), float))
    wide: Any = layers._replace(
        **{name: np.asarray(getattr(layers, name), float) for name in Layers._fields}
    )
    depth = wide.thickness[:, None]
    absorb = SPENT_AMONG_MANY if _are_many(wide.mu_particle[1:4], depth[1:4]) else SPENT
    # four thicknesses: down and up at 60 degrees
    lost = wide.mu_a - wide.mu_particle * np.log(np.maximum(wide.hit_albedo, 1e-30))
    guess = np.exp(-4.0 * np.sum(lost * depth, axis=0)) * wide.bottom
    spread = guess * (1.0 - 0.5 * guess) + 0.01
    fibre = np.log(wide.mu_fibre * wide.thickness[4] + 0.05)
    tissue = np.log(wide.mu_tissue[5] * wide.thickness[5] + 0.05)
    order = np.argsort(-fibre, kind="stable")
    chosen, shares, mu_a, albedo = [], [], [], []
    for node, count in enumerate(COLUMNS):
        mine = order[used[node, order] > 1e-6]
        if not mine.size:
            chosen += [order[0]] * count
            shares += [0.0] * count
            mu_a += [absorb * wide.mu_a[:, order[0]]] * count
            albedo += [wide.hit_albedo[:, order[0]] ** absorb] * count
            continue
        gaps = np.abs(np.diff(fibre[mine])) + 2.0 * np.abs(np.diff(tissue[mine]))
        gaps = 0.5 * np.minimum(np.concatenate([[REACH], gaps, [REACH]]), REACH)
        demand = (gaps[1:] + gaps[:-1]) * spread[mine] * used[node, mine]
        total = np.cumsum(demand)
        at = np.searchsorted(total, total[-1] * np.linspace(EDGE, count - EDGE, count) / count)
        ends = np.searchsorted(total, total[-1] * (np.arange(count + 1)) / count)
        ends[0], ends[-1] = 0, len(mine) - 1
        for i in range(count):
            # as far as the columns on both sides, which these paths help out
            near = mine[ends[max(i - 1, 0)] : ends[min(i + 2, count)] + 1]
            chosen.append(mine[at[i]])
            mu_a.append(absorb * wide.mu_a[:, near].min(axis=1))
            albedo.append(wide.hit_albedo[:, near].max(axis=1) ** absorb)
        shares += [total[-1] ** EVEN / count] * count
    at = np.array(chosen)
    # where there are no melanosomes a few are met, or no path would know what the first one does
    few = np.zeros((len(LAYERS), 1))
    few[1:4, 0] = FEW / wide.thickness[1:4]
    columns = wide._replace(
        index=wide.index[:, at],
        mu_particle=np.maximum(wide.mu_particle[:, at], few),
        mu_fibre=wide.mu_fibre[at],
        mu_tissue=wide.mu_tissue[:, at],
        mu_a=np.stack(mu_a, axis=1),
        hit_albedo=np.stack(albedo, axis=1),
        theta_0=np.repeat(NODES, COLUMNS),
        bottom=wide.bottom**absorb,
    )
    share = np.array(shares) / np.sum(shares)
    # dark wavelengths too must meet what is rare in them, or their errors are not what they seem
    share = np.where(share > 0, np.maximum(share, LEAST_SHARE), 0.0)
    share /= share.sum()
    return Plan(Layers(*(jnp.asarray(part, dtype) for part in columns)), jnp.asarray(share, dtype))


def own_plan(layers: Layers, absorb: float) -> Plan:
    """Every wavelength its own column, with the share `absorb` of its absorption, for paths that
    cannot serve others."""
    columns = layers._replace(
        mu_a=absorb * layers.mu_a,
        hit_albedo=layers.hit_albedo**absorb,
        bottom=layers.bottom**absorb,
    )
    return Plan(columns, hero_shares(layers.theta_0))


def plan_or_own(layers: Layers, absorb: float) -> tuple[Plan, bool]:
    """`plan`; or `own_plan`, and True, where the refractive index depends on the wavelength and
    bends every path its own way."""
    if _disperses(layers):
        return own_plan(layers, absorb), True
    return plan(layers), False


def log_density(layers: Layers, absorb: float = 1.0) -> Float[Array, "21 w"]:
    """Coefficients of the sums along a path in the logarithm of its density at each wavelength.

    What does not depend on the wavelength or the contents (directions, facets, positions of
    particles) is left out: only ratios of densities count. Angles of hits have `angle_density`.
    """

    def log(x):  # the derivative of x^n at 0 stays what it is: 1 for a single hit
        return jnp.log(x + NOTHING)

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
            *[0.0 * row] * (SUMS - BENT),
        ]
    )


def end_density(layers: Layers, absorb: float = 1.0) -> Float[Array, "11 w"]:
    """As `log_density`, of what ended a ray inside: nothing, each layer, a hit in each stratum, the
    bottom. With it the densities of all paths, those that ended as well, add up to 1."""

    def log(x):
        return jnp.log(jnp.maximum(x, NOTHING**2))

    row = jnp.ones((1, layers.mu_a.shape[1]), layers.mu_a.dtype)
    kept = layers.bottom**absorb
    return jnp.concatenate(
        [
            0.0 * row,
            log(absorb * layers.mu_a),
            log(1.0 - layers.hit_albedo[1:4] ** absorb),
            # the bottom is among the sums: what `log_density` has of it is taken back
            (log(1.0 - kept) - absorb * jnp.log(layers.bottom + NOTHING)) * row,
        ]
    )


def angle_density(theta_0: Float[Array, "w"]) -> Float[Array, "21 w"]:
    """As `log_density`, of the angles by which hits bend the path (`exponential_density`); relative
    to the last of `NODES`."""
    some = theta_0 > 0
    angle: Any = jnp.where(some, theta_0, NODES[-1])
    norm = scattering.exponential_log_norm(angle) - scattering.exponential_log_norm(NODES[-1])
    # a hit never bends where theta_0 is 0, and always does elsewhere
    bent: Any = jnp.where(some, 1.0 / NODES[-1] - 1.0 / angle, NEVER)
    straight: Any = jnp.where(some, NEVER, 0.0)
    rows: list[Array] = [jnp.zeros_like(theta_0)] * SUMS
    rows[HITS] = [-norm] * 3
    rows[BENT], rows[STRAIGHT] = bent, straight
    return jnp.stack(rows).astype(theta_0.dtype)


assert len(LAYERS) == 6
