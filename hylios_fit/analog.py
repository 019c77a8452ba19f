"""The paper's algorithm to the letter: one ray, one wavelength, ended by absorption.

Slow and readable, with nothing shared with the fast walk but the laws themselves: it is the
specification in code (section 4 and Figure 6 of the paper). Where the paper leaves a choice:

- A particle that overlaps the one before it, or crosses a layer's boundary, is not there: the ray
  goes on from that point and a new distance is drawn. Overlap is judged on the plane across the
  line of the two centres, which is exact for spheres and never misses an overlap of spheroids.
- A pass through the papillary dermis runs from one interface hit to the next.
- A facet of the rough surface that faces away from the ray, or would send it to the wrong side, is
  drawn again.
- The bottom sends light back by the cosine law about its normal.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from hylios_fit import fresnel, melanosome, scattering
from hylios_fit.precision import product
from hylios_fit.skin import Layers

OUTSIDE, BELOW = -1, 6


class _Ray(NamedTuple):
    key: Array
    depth: Array
    u: Array
    layer: Array
    at_interface: Array
    fibre_met: Array
    alive: Array
    before: tuple[Array, Array, Array]  # last particle: centre from here, axis, size; 0: none


class _One(NamedTuple):
    """The layers at one wavelength."""

    thickness: Array
    index: Array
    mu_a: Array
    mu_particle: Array
    theta_0: Array
    mu_fibre: Array
    mu_tissue: Array
    bottom: Array
    melanin: Array  # absorption coefficient inside a melanosome, 1/cm
    facets: Array


def _uniform(key: Array, dtype) -> Array:
    return 1.0 - jax.random.uniform(key, dtype=dtype)  # (0, 1]


def _direction(u: Array, cos: Array, phi: Array) -> Array:
    p, q = (jnp.stack(v) for v in fresnel.basis((u[0], u[1], u[2])))
    sin = jnp.sqrt(jnp.clip(1.0 - cos**2, 0.0, 1.0))
    new = cos * u + sin * (jnp.cos(phi) * p + jnp.sin(phi) * q)
    return new / jnp.linalg.norm(new)


def _algorithm_1(key: Array, theta_0: Array) -> Array:
    """Polar angle by rejection. The proposals of `scattering` stand in for uniform ones over
    [0, pi], of which 19 in 20 would be refused: the law is the same."""
    dtype = theta_0.dtype

    def draw(state):
        key, _, _ = state
        key, k1, k2, k3 = jax.random.split(key, 4)
        theta = scattering.exponential_proposal(theta_0, _uniform(k1, dtype), _uniform(k2, dtype))
        accepted = scattering.exponential_accepts(theta, jnp.sin(theta), _uniform(k3, dtype))
        return key, theta, accepted

    start = (key, jnp.zeros((), dtype), jnp.array(False))
    return jax.lax.while_loop(lambda s: ~s[2], draw, start)[1]


def _algorithm_2(key: Array, dtype) -> Array:
    """Cosine of the Rayleigh angle, by the paper's rejection."""

    def draw(state):
        key, _, _ = state
        key, k1, k2 = jax.random.split(key, 3)
        theta = jnp.pi * _uniform(k1, dtype)
        cos = jnp.cos(theta)
        bound = 3.0 * math.sqrt(6.0) / 8.0 * (1.0 + cos**2) * jnp.sin(theta)
        return key, cos, _uniform(k2, dtype) <= bound

    start = (key, jnp.zeros((), dtype), jnp.array(False))
    return jax.lax.while_loop(lambda s: ~s[2], draw, start)[1]


def _interface(ray: _Ray, m: _One) -> tuple[_Ray, Array]:
    """Fresnel test at the interface ahead, or the diffusing bottom; also: has the ray left?"""
    dtype = ray.depth.dtype
    key, k1, k2, k3 = jax.random.split(ray.key, 4)
    down = ray.u[2] > 0
    beyond = ray.layer + jnp.where(down, 1, -1)
    surface = (ray.layer == OUTSIDE) | (beyond == OUTSIDE)
    place = _uniform(k1, dtype) * (m.facets.shape[0] - 1)
    cos_s = jnp.interp(place, jnp.arange(m.facets.shape[0], dtype=dtype), m.facets)
    cos_s = jnp.where(surface, cos_s, 1.0)
    sin_s = jnp.sqrt(jnp.clip(1.0 - cos_s**2, 0.0, 1.0))
    phi = 2.0 * jnp.pi * _uniform(k2, dtype)
    up = jnp.where(down, -cos_s, cos_s)  # the facet's normal points to where the ray comes from
    facet = (sin_s * jnp.cos(phi), sin_s * jnp.sin(phi), up)
    n1, n2 = m.index[ray.layer + 1], m.index[jnp.minimum(beyond, 5) + 1]
    valid, transmitted, u = fresnel.interact(
        (ray.u[0], ray.u[1], ray.u[2]), facet, n1, n2, _uniform(k3, dtype)
    )
    bottom = beyond == BELOW
    cos_b = scattering.cosine_polar(_uniform(k1, dtype))
    diffuse = _direction(jnp.array([0.0, 0.0, -1.0], dtype), cos_b, phi)
    absorbed = bottom & (_uniform(k3, dtype) > m.bottom)
    u = jnp.where(bottom, diffuse, jnp.stack(u))
    done = bottom | valid
    layer = jnp.where(done & transmitted & ~bottom, beyond, ray.layer)
    left = done & (layer == OUTSIDE)
    within = jnp.clip(layer, 0, 5)
    new = ray._replace(
        key=key,
        depth=jnp.where(u[2] > 0, 0.0, m.thickness[within]),
        u=u,
        layer=layer,
        at_interface=jnp.array(False),
        fibre_met=jnp.array(False),
        alive=ray.alive & ~left & ~absorbed,
    )
    again = ray._replace(key=key)  # another facet
    return jax.tree.map(lambda a, b: jnp.where(done, a, b), new, again), left


def _particle(
    key: Array, ray: _Ray, m: _One, form: str, depth: Array, before: tuple
) -> tuple[Array, Array, tuple]:
    """Generate the particle that the ray meets: (is it there, absorbed in it, its description)."""
    dtype = ray.depth.dtype
    size = jnp.asarray([melanosome.SHRINKING[s] for s in melanosome.SHRINKING], dtype)[
        jnp.clip(ray.layer - 1, 0, 2)
    ]
    k = jax.random.split(key, 8)
    a, b = (jnp.asarray(x, dtype) * size for x in melanosome.semi_axes(form))
    spheroid = form == "dispersed"
    if spheroid:
        outer_a, outer_b = a, b
        cos_axis = melanosome.axis_cosine(a, b, _uniform(k[0], dtype))
    else:
        outer_a = outer_b = jnp.asarray(melanosome.sphere_radius(form), dtype) * size
        cos_axis = jnp.ones((), dtype)
    beta, phi = (2.0 * jnp.pi * _uniform(k[i], dtype) for i in (1, 2))
    radius = jnp.sqrt(_uniform(k[3], dtype))
    parts = melanosome.entry_point(outer_a, outer_b, cos_axis, radius, (jnp.cos(phi), jnp.sin(phi)))
    p, q = (jnp.stack(v) for v in fresnel.basis((ray.u[0], ray.u[1], ray.u[2])))
    g = jnp.cos(beta) * p + jnp.sin(beta) * q
    across = jnp.cos(beta) * q - jnp.sin(beta) * p
    centre = -(parts[0] * g + parts[1] * ray.u + parts[2] * across)
    axis = jnp.sqrt(jnp.clip(1.0 - cos_axis**2, 0.0, 1.0)) * g + cos_axis * ray.u

    a2, b2 = (outer_a / size) ** 2, (outer_b / size) ** 2

    def half_width(size_, axis_, along):
        return size_ * jnp.sqrt(a2 + (b2 - a2) * product(axis_, along) ** 2)

    half = half_width(size, axis, jnp.array([0.0, 0.0, 1.0], dtype))
    thickness = m.thickness[jnp.clip(ray.layer, 0, 5)]
    fits = (depth + centre[2] >= half) & (depth + centre[2] <= thickness - half)
    apart = centre - before[0]
    gap = jnp.linalg.norm(apart)
    line = apart / jnp.maximum(gap, 1e-30)
    overlaps = (before[2] > 0) & (
        gap < half_width(size, axis, line) + half_width(before[2], before[1], line)
    )

    # absorption inside: of one melanosome, or of those that the ray meets in a complex
    ratio = melanosome.MELANIN_INDEX / m.index[jnp.clip(ray.layer, 0, 5) + 1]
    if spheroid:
        number = jnp.ones((), jnp.int32)
    else:
        chord = jnp.sqrt(jnp.clip(1.0 - radius**2, 0.0, 1.0)) * melanosome.met_at_most(form)
        number = jnp.floor(chord + _uniform(k[4], dtype)).astype(jnp.int32)

    def meet(state):
        i, _ = state
        inside, _ = melanosome.trace_inside(jax.random.fold_in(k[5], i), a, b, m.melanin, ratio)
        return i + 1, inside

    _, survived = jax.lax.while_loop(
        lambda s: (s[0] < number) & s[1], meet, (jnp.zeros((), jnp.int32), jnp.array(True))
    )
    return fits & ~overlaps, ~survived, (centre, axis, size)


def _event(ray: _Ray, m: _One, form: str, independent: bool) -> _Ray:
    """The smallest of the sampled distances, and what happens there."""
    dtype = ray.depth.dtype
    key, *k = jax.random.split(ray.key, 9)
    layer = ray.layer

    def distance(key, mu):
        return jnp.where(mu > 0, -jnp.log(_uniform(key, dtype)) / jnp.maximum(mu, 1e-30), jnp.inf)

    thickness = m.thickness[layer]
    cos = ray.u[2]
    ahead = jnp.where(cos > 0, thickness - ray.depth, ray.depth) / jnp.maximum(jnp.abs(cos), 1e-12)
    to_absorber = distance(k[0], m.mu_a[layer])
    to_particle = distance(k[1], m.mu_particle[layer])
    fibre_here = (layer == 4) & ~ray.fibre_met
    to_fibre = jnp.where(fibre_here, distance(k[2], m.mu_fibre), jnp.inf)
    to_tissue = distance(k[3], m.mu_tissue[layer])
    nearest = jnp.minimum(jnp.minimum(to_absorber, to_particle), jnp.minimum(to_fibre, to_tissue))
    interface = ahead <= nearest
    moved = jnp.minimum(ahead, nearest)
    depth = jnp.clip(ray.depth + moved * cos, 0.0, thickness)
    before = (ray.before[0] - moved * ray.u, *ray.before[1:])

    absorbed = ~interface & (nearest == to_absorber)
    particle = ~interface & ~absorbed & (nearest == to_particle)
    fibre = ~interface & ~absorbed & (nearest == to_fibre)
    tissue = ~interface & ~absorbed & (nearest == to_tissue)
    there, taken, found = jax.lax.cond(
        particle,
        lambda: _particle(k[4], ray, m, form, depth, before),
        lambda: (jnp.array(False), jnp.array(False), before),
    )
    hit = particle & (there | independent)

    phi = 2.0 * jnp.pi * _uniform(k[5], dtype)
    bends = m.theta_0 > 0
    one = jnp.ones((), dtype)
    cos_s = jax.lax.cond(hit & bends, lambda: jnp.cos(_algorithm_1(k[6], m.theta_0)), lambda: one)
    cos_s = jax.lax.cond(fibre, lambda: _algorithm_2(k[6], dtype), lambda: cos_s)
    cos_s = jax.lax.select(tissue, 2.0 * _uniform(k[6], dtype) - 1.0, cos_s)
    turned = hit | fibre | tissue
    return ray._replace(
        key=key,
        depth=depth,
        u=jnp.where(turned, _direction(ray.u, cos_s, phi), ray.u),
        at_interface=interface,
        fibre_met=ray.fibre_met | fibre,
        alive=ray.alive & ~absorbed & ~(hit & taken),
        before=jax.tree.map(lambda new, old: jnp.where(hit, new, old), found, before),
    )


def _trace(key: Array, m: _One, form: str, incidence: Array, independent: bool) -> Array:
    """One ray from the air until it is absorbed (0), leaves (1), or is reflected at once (2)."""
    dtype = m.thickness.dtype
    zero = jnp.zeros((), dtype)
    none = jnp.zeros(3, dtype)
    ray = _Ray(
        key=key,
        depth=zero,
        u=jnp.stack([jnp.sin(incidence), zero, jnp.cos(incidence)]),
        layer=jnp.asarray(OUTSIDE, jnp.int32),
        at_interface=jnp.array(True),
        fibre_met=jnp.array(False),
        alive=jnp.array(True),
        before=(none, none, zero),
    )

    def step(state):
        ray, fate = state
        outside = ray.layer == OUTSIDE
        new, left = jax.lax.cond(
            ray.at_interface,
            lambda: _interface(ray, m),
            lambda: (_event(ray, m, form, independent), jnp.array(False)),
        )
        way_out = jax.lax.select(outside, jnp.int32(2), jnp.int32(1))
        return new, jax.lax.select(left, way_out, fate)

    start = (ray, jnp.asarray(0, jnp.int32))
    return jax.lax.while_loop(lambda s: s[0].alive, step, start)[1]


@partial(jax.jit, static_argnames=("form", "rays", "independent"))
def _fates(key, m: _One, form: str, incidence, rays: int, independent: bool) -> Array:
    keys = jax.random.split(key, rays)
    # one ray after the other: side by side, all would wait for the slowest at every loop
    fate = jax.lax.map(lambda k: _trace(k, m, form, incidence, independent), keys)
    return jnp.stack([jnp.sum(fate == 1), jnp.sum(fate == 2)])


def trace(
    layers: Layers,
    melanin: Float[Array, "w"],
    form: str,
    wavelength: int,
    key: Key[Array, ""],
    rays: int,
    *,
    incidence: float = math.radians(8.0),
    independent: bool = False,
) -> tuple[int, int]:
    """Trace `rays` rays at one wavelength (an index): (came back from inside, from the surface).

    `melanin` is the absorption coefficient inside the melanosomes in 1/cm, `incidence` in radians.
    """
    dtype = layers.mu_a.dtype
    air = jnp.ones(1, dtype)
    i = wavelength
    one = _One(
        thickness=layers.thickness,
        index=jnp.concatenate([air, layers.index[:, i]]),
        mu_a=layers.mu_a[:, i],
        mu_particle=layers.mu_particle[:, i],
        theta_0=layers.theta_0[i],
        mu_fibre=layers.mu_fibre[i],
        mu_tissue=layers.mu_tissue[:, i],
        bottom=layers.bottom,
        melanin=melanin[i],
        facets=jnp.asarray(fresnel.facet_table(float(layers.roughness)), dtype),
    )
    inside, surface = _fates(key, one, form, jnp.asarray(incidence, dtype), rays, independent)
    return int(inside), int(surface)
