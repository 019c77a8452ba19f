"""Directions of the deterministic solver: streams of light, and what interfaces do to them.

A stream is one value of the invariant p = n sin(theta), which no smooth interface changes. The
range of p is split at every refractive index, so that each stream either exists in a layer or is
totally reflected before it, and every smooth interface is a diagonal matrix. Within a part
[a, b] of the range, p^2 = b^2 - (b^2 - a^2) q^2: q is proportional to the cosine in a medium of
index b, in which the light behaves smoothly but for grazing directions, and Gauss-Legendre nodes
in q (in the root of q, where light can be trapped) do the rest.

Everything here depends on the refractive indices and the roughness alone, is computed in NumPy in
float64, and is kept: no derivative goes through it.
"""

from __future__ import annotations

import dataclasses
import math
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy.polynomial.legendre import leggauss, legvander

from hylios_fit import fresnel

SAME = 1e-9  # indices closer than this are one
TRAPPED = 1.0 - 1e-12  # instead of 1: light that nothing frees leaves a matrix singular
# facets per order: the Fresnel law and the parts of the range have kinks that smear slowly
FACETS = (32, 12)


def _panels(
    breaks: tuple[float, ...], order: int, parts: tuple[int, ...]
) -> list[tuple[float, float, int, int]]:
    """(a, b, nodes, power of q) of every part of the range; nodes as in `parts`, if as many."""
    panels = []
    for k, (a, b) in enumerate(zip((0.0, *breaks[:-1]), breaks, strict=True)):
        share = (b * b - a * a) / (b * b)
        nodes = order if a == 0.0 else max(3, math.ceil(1.7 * order * share**0.35))
        if len(parts) == len(breaks):
            nodes = parts[k]
        panels.append((a, b, nodes, 1 if a == 0.0 else 2))
    return panels


@lru_cache(maxsize=64)
def _unit_nodes(n: int) -> tuple[np.ndarray, np.ndarray]:
    x, w = leggauss(n)
    return (x + 1.0) / 2.0, w / 2.0


@dataclasses.dataclass(frozen=True, eq=False)
class Streams:
    """The streams of one set of refractive indices; s streams, in the order of p.

    weight: p dp of each; square: p^2; upper, below: p^2 = upper - below without loss at the top
    of a part, where the cosine goes to 0.
    """

    panels: tuple[tuple[float, float, int, int], ...]
    weight: Float[np.ndarray, "s"]
    upper: Float[np.ndarray, "s"]
    below: Float[np.ndarray, "s"]

    def __hash__(self) -> int:
        return hash(self.panels)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Streams) and self.panels == other.panels

    @classmethod
    def make(cls, indices: tuple[float, ...], order: int, parts: tuple[int, ...] = ()) -> Streams:
        """Streams for media of these indices; `parts`, if given, says how many in each part of
        the range between two of them, where `order` alone would decide it by its width."""
        breaks: list[float] = []
        for n in sorted(indices):
            if not breaks or n > breaks[-1] + SAME:
                breaks.append(n)
        panels = _panels(tuple(breaks), order, parts)
        weight, upper, below = [], [], []
        for a, b, n, power in panels:
            x, w = _unit_nodes(n)
            x, w = x[::-1], w[::-1]  # p rises
            span = b * b - a * a
            weight.append(span * power * w * x ** (2 * power - 1))
            upper.append(np.full(n, b * b))
            below.append(span * x ** (2 * power))
        return cls(tuple(panels), *(np.concatenate(v) for v in (weight, upper, below)))

    @property
    def parts(self) -> tuple[int, ...]:
        """How many streams each part of the range has."""
        return tuple(nodes for _, _, nodes, _ in self.panels)

    def count(self, index: float) -> int:
        """How many streams, the first ones, exist in a medium."""
        return int(np.sum(self.upper <= (index + SAME) ** 2))

    def cosine(self, index: float) -> np.ndarray:
        """Cosine of each stream that exists in a medium."""
        s = self.count(index)
        gap = index**2 - self.upper[:s]
        return np.sqrt(np.where(np.abs(gap) < 4 * SAME, 0.0, gap) + self.below[:s]) / index

    def interpolation(self, p: np.ndarray) -> np.ndarray:
        """(..., s): weights by which values at the streams give the value at any p."""
        flat = np.ravel(p)
        out = np.zeros((flat.size, self.weight.size))
        edges = np.array([b for _, b, _, _ in self.panels[:-1]])
        part = np.searchsorted(edges, flat, side="right")
        first = 0
        for k, (a, b, n, power) in enumerate(self.panels):
            use = np.nonzero(part == k)[0]
            if use.size:
                q = np.sqrt(np.clip((b * b - flat[use] ** 2) / (b * b - a * a), 0.0, 1.0))
                out[use, first : first + n] = _lagrange(n, q ** (1.0 / power))
            first += n
        return out.reshape(*np.shape(p), -1)


def _lagrange(n: int, x: np.ndarray) -> np.ndarray:
    """Barycentric Lagrange weights (x, n) on the Gauss-Legendre nodes of [0, 1], falling."""
    nodes = _unit_nodes(n)[0][::-1]
    gaps = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(gaps, 1.0)
    barycentric = 1.0 / np.prod(gaps, axis=1)
    away = x[:, None] - nodes[None, :]
    away = np.where(np.abs(away) < 1e-14, 1e-14, away)
    share = barycentric / away
    return share / np.sum(share, axis=1, keepdims=True)


def interface(streams: Streams, n1: float, n2: float) -> np.ndarray:
    """Fresnel reflectance (s,) of the streams that exist on either side of a smooth interface."""
    low, high = sorted((streams.count(n1), streams.count(n2)))
    if abs(n1 - n2) < SAME:
        return np.zeros(high)
    c1, c2 = streams.cosine(n1)[:low], streams.cosine(n2)[:low]
    reflectance = np.full(high, TRAPPED)
    reflectance[:low] = fresnel.unpolarised(c1, c2, n1, n2)
    return reflectance


@lru_cache(maxsize=64)
def scattering_basis(streams: Streams, index: float) -> tuple[np.ndarray, np.ndarray]:
    """Even and odd Legendre polynomials at the streams of a medium, orthonormal over them.

    Columns l = 0, 2, 4, ... and 1, 3, 5, ... of (s, s) matrices times the root of the weight in
    solid angle: the kernel of a scattering law with Legendre moments chi is Q diag(chi) Q.T, with
    no light lost whatever the number of streams, and the identity where nothing is deflected.
    """
    mu = streams.cosine(index)
    s = mu.size
    weight = streams.weight[:s] / (index**2 * mu)
    every = legvander(mu, 2 * s - 1) * np.sqrt(weight)[:, None]

    def orthonormal(columns: np.ndarray) -> np.ndarray:
        q, r = np.linalg.qr(columns)
        return q * np.sign(np.diag(r))

    return orthonormal(every[:, 0::2]), orthonormal(every[:, 1::2])


@dataclasses.dataclass(frozen=True)
class Surface:
    """What the outer surface does, in shares of the incident flux.

    at_once: reflected from outside; enters (s,): share of the light that got in, by stream;
    back (s, s): from stream j inside to stream i inside; leaves (s,): out of each stream.
    """

    at_once: float
    enters: Float[np.ndarray, "s"]
    back: Float[np.ndarray, "s s"]
    leaves: Float[np.ndarray, "s"]


@lru_cache(maxsize=64)
def surface(
    streams: Streams, outside: float, inside: float, roughness: float, incidence: float, order: int
) -> Surface:
    """The surface between two media for light that comes at `incidence` (rad) from outside."""
    p = outside * math.sin(incidence)
    s = streams.count(inside)
    if roughness <= 0:
        c1 = math.cos(incidence)
        c2 = math.sqrt(1.0 - (p / inside) ** 2)
        at_once = fresnel.unpolarised(c1, c2, outside, inside)
        reflected = interface(streams, outside, inside)[:s]
        enters = streams.interpolation(np.array([p]))[0, :s]
        return Surface(at_once, enters, np.diag(reflected), 1.0 - reflected)
    at_once, enters = _facets(streams, np.array([p]), outside, inside, roughness, 4 * order)
    squares = streams.upper[:s] - streams.below[:s]
    back, leaves = _facets(streams, np.sqrt(squares), inside, outside, roughness, order)
    got_in = enters[0, :s]
    return Surface(
        float(np.sum(at_once)), got_in / np.sum(got_in), back[:, :s].T, np.sum(leaves, axis=1)
    )


def _facets(
    streams: Streams, p: np.ndarray, n1: float, n2: float, roughness: float, order: int
) -> tuple[np.ndarray, np.ndarray]:
    """Shares (p, s) of the light that comes with each p from n1: reflected and transmitted.

    A quadrature over the facets of Eq. 8 in the terms in which the walks draw them: facets that
    face away, or would send the light to the wrong side, do not count (`fresnel.interact`).
    """
    polar, azimuth = (k * order for k in FACETS)
    table = fresnel.facet_table(roughness)
    # denser towards steep facets, which are few
    x, w = _unit_nodes(polar)
    place, chance = x**2, 2.0 * x * w
    cos_s = np.interp(place * (len(table) - 1), np.arange(len(table)), table)[:, None]
    cos_phi = np.cos(np.pi * (np.arange(azimuth) + 0.5) / azimuth)[None, :]
    weight = np.broadcast_to(chance[:, None] / azimuth, (polar, azimuth))
    reflected, transmitted = [], []
    for sine in p / n1:
        found = fresnel.facet_outcomes(cos_s, cos_phi, sine, n1, n2)
        back, through = weight * found.reflected, weight * found.transmitted
        whole = np.sum(back) + np.sum(through)
        reflected.append(_deposit(streams, n1, found.up, back / whole))
        transmitted.append(_deposit(streams, n2, found.on, through / whole))
    return np.array(reflected), np.array(transmitted)


CELLS = 1024  # of each part of the range; the error of a deposit falls with their square


def _deposit(streams: Streams, index: float, cosine: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Flux (s,) in the streams of light at cosines in a medium: adjoint to interpolation."""
    use = share > 0
    square = index**2 * (1.0 - cosine[use] ** 2)
    share = share[use]
    out = np.zeros(streams.weight.size)
    first = 0
    edges = np.array([b * b for _, b, _, _ in streams.panels[:-1]])
    part = np.searchsorted(edges, square, side="right")
    for k, (a, b, n, power) in enumerate(streams.panels):
        mine = part == k
        if np.any(mine):
            q2 = np.clip((b * b - square[mine]) / (b * b - a * a), 0.0, 1.0)
            at = q2 ** (0.5 / power) * CELLS
            low = np.minimum(at.astype(int), CELLS - 1)
            rest = at - low
            amount = share[mine]
            cells = np.bincount(low, amount * (1.0 - rest), CELLS + 1)
            cells += np.bincount(low + 1, amount * rest, CELLS + 1)
            # not by a matrix product: threads of the linear algebra would wait for each other
            out[first : first + n] = np.sum(cells[:, None] * _cells(n), axis=0)
        first += n
    return out


@lru_cache(maxsize=64)
def _cells(n: int) -> np.ndarray:
    return _lagrange(n, np.linspace(0.0, 1.0, CELLS + 1))


@lru_cache(maxsize=8)
def exponential_moments(theta_0: tuple[float, ...], moments: int) -> np.ndarray:
    """Legendre moments (angle, l) of the law of `scattering.exponential_density`; 1 at 0."""
    chi = np.ones((len(theta_0), moments))
    for row, angle in zip(chi, theta_0, strict=True):
        if angle > 0:
            top = min(math.pi, 45.0 * angle)
            x, w = _unit_nodes(400)
            theta = top * x
            density = w * np.exp(-theta / angle) * np.sin(theta)
            terms = density[:, None] * legvander(np.cos(theta), moments - 1)
            row[:] = np.sum(terms, axis=0) / np.sum(density)
    return chi
