"""One melanosome or complex: size, attenuation, and the share of a ray that it lets pass.

Melanosomes are prolate spheroids with semi-axes a (minor) and b (major); complexes are spheres
that hold several (section 4.2.1 of the paper). Lengths in cm.
"""

from __future__ import annotations

import csv
import math
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hylios_fit import datasets, fresnel
from hylios_fit.precision import product

FORMS = ("complex", "dispersed", "compact")
MELANIN_INDEX = 1.7
SHRINKING = {"granulosum": 0.25, "spinosum": 0.5, "basale": 1.0}
"""Size of the melanosomes relative to those of the basale (section 5)."""

# full lengths of the major and minor axis in um (Olson et al. 1973): of light and of dark skin
_LIGHT = (0.40, 0.17)
_DARK = (0.69, 0.28)


def semi_axes(form: str) -> tuple[float, float]:
    """Semi-minor and semi-major axis in cm of the melanosomes in the basale."""
    major, minor = _DARK if form == "dispersed" else _LIGHT
    return 0.5e-4 * minor, 0.5e-4 * major


def sphere_radius(form: str) -> float:
    """Radius in cm of a complex in the basale: diameter twice the major axis, or once (compact)."""
    _, b = semi_axes(form)
    return {"complex": 2.0 * b, "compact": b}[form]


def surface_to_volume(a: float, b: float) -> float:
    """S/V of a prolate spheroid in 1/cm (Eq. 4)."""
    c = math.sqrt(1.0 - (a / b) ** 2)
    return 3.0 / (2.0 * a) * (a / b + math.asin(c) / c)


def attenuation_per_content(form: str, scale: float) -> float:
    """Geometric attenuation coefficient in 1/cm per unit volume fraction (Eq. 3)."""
    if form == "dispersed":
        a, b = semi_axes(form)
        return surface_to_volume(a * scale, b * scale) / 4.0
    return 3.0 / (sphere_radius(form) * scale) / 4.0


def met_at_most(form: str) -> float:
    """n_m: diameter of the complex over the minor axis of its melanosomes."""
    a, _ = semi_axes(form)
    return sphere_radius(form) / a


@lru_cache
def met_distribution(form: str) -> tuple[float, ...]:
    """Probability that a ray through a complex meets 0, 1, 2, ... melanosomes.

    A ray through the centre meets n_m, one along a chord of the length x times the diameter meets
    x n_m, rounded up or down at random so that the mean holds. Isotropic chords of a sphere have
    the density 2 x. This is our reading of the paper's "at most n_m".
    """
    if form == "dispersed":
        return (0.0, 1.0)
    n = met_at_most(form)
    top = math.ceil(n) + 1

    def tent(k):  # integral of 2 y / n^2 max(0, 1 - |y - k|) over [0, n]
        y = np.linspace(max(k - 1.0, 0.0), min(k + 1.0, n), 20_001)
        return np.trapezoid(2.0 * y / n**2 * np.clip(1.0 - np.abs(y - k), 0.0, None), y)

    p = np.array([tent(k) if k - 1 < n else 0.0 for k in range(top + 1)])
    return tuple(p / p.sum())


@lru_cache
def _crowding(form: str) -> tuple[float, float]:
    """What rejections cost: (dead length times attenuation per content, half-width in cm).

    A particle may not overlap the one met before, so that a ray that has just met one meets none
    for a mean length; by Sobol points over pairs of particles on a straight ray, judged as in the
    walks. The half-width, along the ray, is that of a particle in the basale.
    """
    from scipy.stats import qmc

    a: Any
    b: Any
    a, b = semi_axes(form)
    if form != "dispersed":
        a = b = sphere_radius(form)
    unit: Any = qmc.Sobol(8, rng=np.random.default_rng(0)).random(4096)
    unit = np.clip(unit, 1e-9, 1.0 - 1e-9)
    found = []
    for u in (unit[:, :4], unit[:, 4:]):
        cos: Any = np.asarray(axis_cosine(a, b, u[:, 0])) if b > a else np.ones(len(u))
        sin = np.sqrt(1.0 - cos**2)
        azimuth, beta = 2.0 * np.pi * u[:, 1], 2.0 * np.pi * u[:, 2]
        turned: Any = (np.cos(azimuth), np.sin(azimuth))
        entry = entry_point(a, b, cos, np.sqrt(u[:, 3]), turned)
        g, along, k = (-np.asarray(part) for part in entry)
        cb, sb = np.cos(beta), np.sin(beta)
        found.append(
            (
                np.stack([cb * g - sb * k, sb * g + cb * k, along], axis=1),
                np.stack([sin * cb, sin * sb, cos], axis=1),
            )
        )
    (centre_1, axis_1), (centre_2, axis_2) = found
    steps = 256
    s = (np.arange(steps) + 0.5) * (4.0 * b / steps)
    apart = (centre_2 - centre_1)[:, None, :] + s[None, :, None] * np.array([0.0, 0.0, 1.0])
    gap = np.linalg.norm(apart, axis=2)
    line = apart / gap[:, :, None]

    def half(axis):
        return np.sqrt(a**2 + (b**2 - a**2) * np.einsum("nsk,nk->ns", line, axis) ** 2)

    dead = 4.0 * b * float(np.mean(gap < half(axis_1) + half(axis_2)))
    width = float(np.mean(np.sqrt(a**2 + (b**2 - a**2) * axis_1[:, 2] ** 2)))
    return attenuation_per_content(form, 1.0) * dead, width


def accepted_share(
    form: str, scale: float, content: Float[Array, ""], thickness: Float[Array, ""]
) -> Float[Array, ""]:
    """Share of the particles that the walks let stand: a closed form for `adding`.

    `content` is a volume fraction, `thickness` that of the stratum in cm. Every particle met
    silences the ray for a mean length (the walks' test against the predecessor: a dead time that
    does not extend itself, so that rates fall as 1/(1 + rate x dead length)), and none stands
    within its half-width of a boundary.
    """
    with jax.ensure_compile_time_eval():  # numbers, also inside a transformation
        crowding, width = _crowding(form)
    room = jnp.clip(1.0 - 2.0 * width * scale / thickness, 0.0, 1.0)
    return room / (1.0 + crowding * room * content)


def axis_cosine(a: Array, b: Array, xi: Array) -> Array:
    """|cos alpha| between ray and major axis, from Eq. 5.

    chi_1 is the area that a ray sees from the side, pi a b, and chi_2 that along the axis, pi a^2:
    this is the reading in which the chance grows with the area that faces the ray.
    """
    side, end = b, a  # chi_1 and chi_2 over pi a
    root = jnp.sqrt(side**2 - (side**2 - end**2) * xi)
    return jnp.clip((side - root) / (side - end), 0.0, 1.0)  # rounding may pass 1


def entry_point(
    a: Array, b: Array, cos_axis: Array, radius: Array, azimuth: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Where a ray enters a spheroid, uniform over its projected surface, relative to the centre.

    `radius` in [0, 1] is the square root of a uniform number and `azimuth` the (cos, sin) of a
    uniform angle: a point of the disk that the unit sphere shows to the ray, carried over by the
    map that makes the sphere a spheroid. Components along (g, u, k): u is the ray, g the unit
    vector at right angles to it in the plane of the major axis, k = g x u up to sign.
    """
    sin_axis = jnp.sqrt(jnp.clip(1.0 - cos_axis**2, 0.0, 1.0))
    ve, vw = cos_axis / b, sin_axis / a  # the ray in the frame of the unit sphere
    norm = jax.lax.rsqrt(ve**2 + vw**2)
    ve, vw = ve * norm, vw * norm
    depth = jnp.sqrt(jnp.clip(1.0 - radius**2, 0.0, 1.0))
    in_plane, across = radius * azimuth[0], radius * azimuth[1]
    ye = -in_plane * vw - depth * ve
    yw = in_plane * ve - depth * vw
    return (
        b * ye * sin_axis - a * yw * cos_axis,
        b * ye * cos_axis + a * yw * sin_axis,
        a * across,
    )


def _bounce(key: Array, direction: Array, inward: Array, turned: Array) -> Array:
    """Reflect inside and perturb by the cosine law, drawn again until it stays inside."""
    # `turned` guards the loop: under vmap it also runs for rays that are out, without an end
    mirrored = direction - 2.0 * product(direction, inward) * inward
    mirrored = mirrored / jnp.linalg.norm(mirrored)
    p, q = (jnp.stack(v) for v in fresnel.basis((mirrored[0], mirrored[1], mirrored[2])))

    def draw(state):
        key, _ = state
        key, k1, k2 = jax.random.split(key, 3)
        cos = jnp.sqrt(1.0 - jax.random.uniform(k1, dtype=direction.dtype))
        sin = jnp.sqrt(jnp.clip(1.0 - cos**2, 0.0, 1.0))
        phi = 2.0 * jnp.pi * jax.random.uniform(k2, dtype=direction.dtype)
        return key, sin * (jnp.cos(phi) * p + jnp.sin(phi) * q) + cos * mirrored

    def outside(state):
        return turned & (product(state[1], inward) <= 0)

    return jax.lax.while_loop(outside, draw, draw((key, mirrored)))[1]


def chord(position: Array, direction: Array, a: Array, b: Array) -> Array:
    """Length of the chord from a point on the spheroid (axes a, a, b) along a direction."""
    inverse = jnp.stack([1.0 / a, 1.0 / a, 1.0 / b])
    p, d = position * inverse, direction * inverse
    return -2.0 * product(p, d) / product(d, d)


def trace_inside(
    key: Array, a: Array, b: Array, mu_inside: Array, index_ratio: Array
) -> tuple[Array, Array]:
    """One ray through one melanosome, to the letter: (survived, path length inside in cm).

    The orientation follows Eqs. 5 and 6; the ray goes straight in at a point of the projected
    surface; at every chord it is tested for absorption (Eq. 1) and, at the surface, by Fresnel with
    `index_ratio` = melanin over surroundings; a ray turned back goes on inside.
    """
    dtype = jnp.result_type(a)
    key, k1, k2, k3 = jax.random.split(key, 4)
    cos_axis = axis_cosine(a, b, jax.random.uniform(k1, dtype=dtype))
    radius = jnp.sqrt(jax.random.uniform(k2, dtype=dtype))
    phi = 2.0 * jnp.pi * jax.random.uniform(k3, dtype=dtype)
    sin_axis = jnp.sqrt(1.0 - cos_axis**2)
    g, u, k = entry_point(a, b, cos_axis, radius, (jnp.cos(phi), jnp.sin(phi)))
    # axes of the spheroid: x at right angles to the major axis in the plane of the ray, z major
    position = jnp.stack([sin_axis * u - cos_axis * g, k, cos_axis * u + sin_axis * g])
    direction = jnp.stack([sin_axis, jnp.zeros_like(sin_axis), cos_axis])

    def step(state):
        key, position, direction, inside, _, path = state
        key, k_absorb, k_fresnel, k_bounce = jax.random.split(key, 4)
        length = chord(position, direction, a, b)
        reach = -jnp.log1p(-jax.random.uniform(k_absorb, dtype=dtype)) / mu_inside
        absorbed = reach < length
        position = position + length * direction
        inward = -position / jnp.stack([a, a, b]) ** 2
        inward = inward / jnp.linalg.norm(inward)
        cos_i = jnp.clip(-product(direction, inward), 0.0, 1.0)
        share = fresnel.reflectance(cos_i, index_ratio, jnp.ones_like(index_ratio))
        turned = inside & (jax.random.uniform(k_fresnel, dtype=dtype) < share)
        direction = jnp.where(turned, _bounce(k_bounce, direction, inward, turned), direction)
        return key, position, direction, ~absorbed & turned, ~absorbed, path + length

    start = (key, position, direction, jnp.array(True), jnp.array(True), jnp.zeros((), dtype))
    end = jax.lax.while_loop(lambda s: s[3], step, start)
    return end[4], end[5]


# --- the share that passes, tabulated ---------------------------------------------------------

PATHS_FILE = "melanosome_paths.csv"


@lru_cache
def _paths() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each size class: index ratios (r,), path lengths in units of a (n,), weights (r, n)."""
    found: dict[str, dict[float, list[tuple[float, float]]]] = {}
    with datasets.data_path(PATHS_FILE).open(encoding="utf-8") as lines:
        for row in csv.DictReader(line for line in lines if not line.startswith("#")):
            ratios = found.setdefault(row["melanosome"], {})
            pair = (float(row["path_over_a"]), float(row["weight"]))
            ratios.setdefault(float(row["index_ratio"]), []).append(pair)
    return {
        name: (
            np.array(sorted(ratios)),
            np.array([p for p, _ in ratios[min(ratios)]]),
            np.array([[w for _, w in ratios[r]] for r in sorted(ratios)]),
        )
        for name, ratios in found.items()
    }


def survival(
    form: str, scale: float, mu_inside: Float[Array, "w"], index_around: Float[Array, "w"]
) -> Float[Array, "w"]:
    """Share of the light that survives one hit of a melanosome (dispersed) or complex.

    `mu_inside` is the absorption coefficient of the melanin inside in 1/cm. The path length inside
    does not depend on it, so that its distribution, traced once (`trace_inside`) and tabulated,
    gives the share at every coefficient: a positive sum of exponentials, exact at no absorption,
    differentiable, and never above 1.
    """
    a, _ = semi_axes(form)
    ratios, lengths, weights = _paths()["dark" if form == "dispersed" else "light"]
    last = len(ratios) - 1
    first, step = float(ratios[0]), float(ratios[1] - ratios[0])
    place = jnp.clip((MELANIN_INDEX / index_around - first) / step, 0.0, last)
    low = jnp.minimum(jnp.floor(place), last - 1.0)
    part = (place - low)[:, None]
    table = jnp.asarray(weights, mu_inside.dtype)
    row = low.astype(int)
    weight = (1.0 - part) * table[row] + part * table[row + 1]
    path = jnp.asarray(lengths, mu_inside.dtype) * (a * scale)
    one = jnp.sum(weight * jnp.exp(-mu_inside[:, None] * path[None]), axis=-1)
    chances = met_distribution(form)
    total = jnp.zeros_like(one)
    for chance in reversed(chances):  # Horner's rule
        total = total * one + chance
    return total
