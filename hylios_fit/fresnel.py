"""Interfaces: Fresnel reflectance, refraction, and the rough skin surface.

Directions are unit vectors with z pointing into the skin. A smooth interface has the normal
(0, 0, -1); the rough surface draws a facet for every impact (paper, section 4.3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def reflectance(
    cos_i: Float[Array, "..."], n1: Float[Array, "..."], n2: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Fresnel reflectance of unpolarised light that meets n2 coming from n1.

    `cos_i` is the cosine of the angle of incidence, in [0, 1]. Total internal reflection gives 1.
    Born and Wolf, Principles of Optics, section 1.5.
    """
    return _reflected(cos_i, refracted_cosine(cos_i, n1, n2), n1, n2)


def _reflected(cos_i: Array, cos_t: Array, n1: Array, n2: Array) -> Array:
    tiny = jnp.finfo(jnp.result_type(cos_i)).tiny
    share: Array = unpolarised(cos_i, cos_t, n1, n2, tiny)
    return jnp.where(cos_t > 0, share, jnp.ones_like(share))


def unpolarised(cos_i: Any, cos_t: Any, n1: Any, n2: Any, tiny: Any = 0.0) -> Any:
    """Fresnel's equations for unpolarised light at known cosines on both sides, NumPy's or JAX's.

    `tiny` keeps 0/0 out of grazing incidence between equal indices.
    """
    r_s = (n1 * cos_i - n2 * cos_t) / (n1 * cos_i + n2 * cos_t + tiny)
    r_p = (n2 * cos_i - n1 * cos_t) / (n2 * cos_i + n1 * cos_t + tiny)
    return 0.5 * (r_s**2 + r_p**2)


def refracted_cosine(
    cos_i: Float[Array, "..."], n1: Float[Array, "..."], n2: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Cosine of the refracted ray by Snell's law; 0 where all light is reflected."""
    ratio = n1 / n2
    # 1 - sin^2, written so that equal indices change nothing at grazing incidence in float32
    cos2 = (1.0 - ratio) * (1.0 + ratio) + (ratio * cos_i) ** 2
    inside = cos2 > 0.0
    return jnp.where(inside, jnp.sqrt(jnp.where(inside, cos2, 1.0)), 0.0)


def facet_density(cos_s: Float[Array, "..."], roughness: Float[Array, ""]) -> Float[Array, "..."]:
    """Eq. 8 as a normalised density of the facet's polar cosine on [0, 1]."""
    s2 = roughness**2
    k = jnp.sqrt(1.0 - s2)
    # integral of 1/(1 - k^2 x^2)^2 over [0, 1]
    norm = 0.5 / s2 + 0.5 * jnp.arctanh(k) / k
    return 1.0 / (norm * (1.0 - k**2 * cos_s**2) ** 2)


@lru_cache(maxsize=32)
def facet_table(roughness: float, size: int = 2049) -> np.ndarray:
    """Polar cosine of the facet (Eq. 8) at `size` equal steps of its cumulative distribution.

    Linear interpolation in it is the sampler of both walks. A roughness of 0 is a mirror.
    """
    if roughness <= 0:
        return np.ones(size)
    s2 = roughness**2
    k = np.sqrt(max(1.0 - s2, 1e-12))

    def distance_from_top(tan2):  # 1 - CDF in x = cos, written so that nothing cancels near x = 1
        x = 1.0 / np.sqrt(1.0 + tan2)
        return x, 0.5 * x / (1.0 - k**2 * x**2) + 0.5 * np.arctanh(k * x) / k

    tan = np.concatenate([[0.0], np.geomspace(1e-4 * roughness, 1e6, 40_000)])
    x, upper = distance_from_top(tan**2)
    cdf = 1.0 - upper / upper[0]
    return np.interp(np.linspace(0.0, 1.0, size), cdf, x)


def basis(u: tuple[Array, Array, Array]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Two unit vectors that complete `u` to an orthonormal basis (Duff et al., JCGT 2017)."""
    ux, uy, uz = u
    sign = jnp.where(uz >= 0, 1.0, -1.0).astype(uz.dtype)
    a = -1.0 / (sign + uz)
    b = ux * uy * a
    return (1.0 + sign * ux * ux * a, sign * b, -sign * ux), (b, sign + uy * uy * a, -uy)


def unit(u: Any) -> tuple[Array, Array, Array]:
    """A direction without the rounding of its length, which would add up: one step of Newton's
    from a length near 1."""
    x, y, z = u
    norm = 1.5 - 0.5 * (x * x + y * y + z * z)
    return x * norm, y * norm, z * norm


def interact(
    u: tuple[Array, Array, Array],
    facet: tuple[Array, Array, Array],
    n1: Array,
    n2: Array,
    xi: Array,
    keep: Callable[..., tuple[Array, ...]] = lambda *values: values,
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """A Fresnel test on a facet.

    `facet` is the facet's normal, pointing to the side that the ray comes from, and `xi` a uniform
    number. Returns (valid, transmitted, direction). Where the facet faces away from the ray, or
    would send the outcome to the wrong side of the mean surface, `valid` is false: that facet
    is drawn again. `keep` is handed what several results need.
    """
    cos_i, ratio = keep(-(u[0] * facet[0] + u[1] * facet[1] + u[2] * facet[2]), n1 / n2)
    c = jnp.clip(cos_i, 0.0, 1.0)
    (cos_t,) = keep(refracted_cosine(c, n1, n2))
    transmitted = xi >= _reflected(c, cos_t, n1, n2)
    along_u, along_n = keep(
        jnp.where(transmitted, ratio, 1.0),
        jnp.where(transmitted, ratio * c - cos_t, 2.0 * c),
    )
    out = unit(tuple(along_u * ui + along_n * ni for ui, ni in zip(u, facet, strict=True)))
    # the mean normal points to the side of the incoming ray: -sign(uz)
    side = jnp.where(transmitted, 1.0, -1.0) * jnp.sign(u[2])
    valid = (cos_i > 0) & (out[2] * side > 0)
    return valid, transmitted, out


class Outcomes(NamedTuple):
    """What a facet does to a ray: cosine of incidence on it, and for each way of going on its
    chance (0 where the ray would end on the wrong side) and the cosine to the surface's normal."""

    cos_i: np.ndarray
    reflected: np.ndarray
    up: np.ndarray
    transmitted: np.ndarray
    on: np.ndarray


def facet_outcomes(
    cos_s: np.ndarray, cos_phi: np.ndarray, sine: float, n1: float, n2: float
) -> Outcomes:
    """The two ends of `interact` for a ray at the given sine to the normal, in float64.

    `cos_s` is the polar cosine of the facets and `cos_phi` the cosine of their azimuth from the
    plane of incidence; they broadcast. A facet that faces away does nothing.
    """
    down = math.sqrt(max(1.0 - sine**2, 0.0))
    cos_i = cos_s * down - np.sqrt(1.0 - cos_s**2) * cos_phi * sine
    c = np.clip(cos_i, 0.0, 1.0)
    ratio = n1 / n2
    cos2 = (1.0 - ratio) * (1.0 + ratio) + (ratio * c) ** 2
    cos_t = np.sqrt(np.maximum(cos2, 0.0))
    share = np.where(cos2 > 0, unpolarised(c, cos_t, n1, n2, 1e-300), 1.0)
    up = 2.0 * c * cos_s - down
    on = ratio * down - (ratio * c - cos_t) * cos_s
    return Outcomes(
        cos_i,
        np.where((cos_i > 0) & (up > 0), share, 0.0),
        up,
        np.where((cos_i > 0) & (on > 0), 1.0 - share, 0.0),
        on,
    )


@lru_cache(maxsize=64)
def surface_reflectance(
    incidence: float, n1: float, n2: float, roughness: float, size: int = 512
) -> float:
    """Share of the light that the skin's surface reflects at once.

    `incidence` in radians. A quadrature over the facets of Eq. 8 in the same terms as the walks
    draw them: facets that face away or send the light to the wrong side do not count.
    """
    table = facet_table(roughness)
    cos_s = np.interp((np.arange(size) + 0.5) / size, np.linspace(0, 1, len(table)), table)
    cos_phi = np.cos(np.pi * (np.arange(size) + 0.5) / size)
    found = facet_outcomes(cos_s[:, None], cos_phi[None, :], math.sin(incidence), n1, n2)
    reflected, entered = np.mean(found.reflected), np.mean(found.transmitted)
    return float(reflected / (reflected + entered))


def surface_reflectances(incidence: float, index: np.ndarray, roughness: float) -> np.ndarray:
    """`surface_reflectance` from air, for each index below."""
    return np.array([surface_reflectance(incidence, 1.0, float(n), roughness) for n in index])


CURVE = (1.25, 1.8)  # indices between which `surface_curve` holds


@lru_cache(maxsize=16)
def surface_curve(incidence: float, roughness: float) -> np.polynomial.Polynomial:
    """`surface_reflectance` from air as a polynomial of the index below, right to 1e-8."""
    nodes = 0.5 * (CURVE[0] + CURVE[1] + (CURVE[1] - CURVE[0]) * np.cos(np.pi * np.arange(13) / 12))
    values = surface_reflectances(incidence, nodes, roughness)
    return np.polynomial.Polynomial.fit(nodes, values, 10, domain=CURVE)
