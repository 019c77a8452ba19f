"""The deterministic solver: `Layers` or `Tissue` -> reflectance, by adding and doubling.

With the share absorbed at a hit known, all that the walk does is plane-parallel transport with
azimuthal symmetry, and its answer can be had without noise (van de Hulst 1980; Prahl et al. 1993;
Plass et al. 1973 for the form of the equations used here). The particles are independent of each
other, as with `--independent-particles`: nothing is rejected.

Light is carried as f = radiance / n^2 times the root of the weight of its stream (`streams`): a
vector that no interface changes but by its Fresnel factors, and in which every layer that scatters
is a symmetric matrix. With E and O the rates at which the sum and the difference of the light that
goes down and up change (symmetric, positive), half a layer of the thickness h answers

    Y = E h/2 t,    Z = t O h/2,    t = tanh(x)/x at x^2 = O E (h/2)^2,

and reflects and transmits R + T = (1 + Y)^-1 (1 - Y), R - T = -(1 + Z)^-1 (1 - Z). A polynomial for
tanh(x)/x starts from a layer thin enough, 2 Y (1 + Z Y)^-1 doubles it, and no step has a limit in
which it divides by nothing: no absorption, no scattering and opaque layers are ordinary cases. All
eigenvalues of Z Y lie between 0 and 1, so that this inverse is a polynomial too: products of
matrices, which a processor is good at, are nearly all that is done.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float
from numpy.polynomial import Chebyshev, Polynomial

from hylios_fit import streams
from hylios_fit.errors import HyliosError
from hylios_fit.precision import HIGHEST
from hylios_fit.skin import LAYERS, Layers, Specimen, let_stand
from hylios_fit.skin import layers as layers_of
from hylios_fit.streams import SAME, Streams
from hylios_fit.threads import cores, side_by_side
from hylios_fit.tissue import Tissue

ORDER = 8
"""Streams for light that can leave; others in proportion. Its error on S1 to S4 is below 1e-4."""
ORDERS = (6, 8, 12, 16, 24, 32)
START = 2.0  # x that the polynomial for tanh(x)/x holds to
DOUBLINGS = 40  # at most; as many are done as the thickest layer of a block needs
STRAIGHT = "clear", "bare"  # kinds of layers that turn no light
OPAQUE = 1e5  # optical thickness that stands for an infinite one


class Coefficients(NamedTuple):
    """What the solver sees of m layers, top down; w wavelengths (or wavelengths of specimens)."""

    thickness: Float[Array, "m w"]
    extinction: Float[Array, "m w"]  # 1/cm
    scattering: Float[Array, "m w"]  # 1/cm, what survives a hit
    once: Float[Array, "m w"]  # 1/cm, Rayleigh scattering that happens once a pass
    moments: tuple[Float[Array, "w l"] | None, ...]  # Legendre moments of the law, by layer
    bottom: Float[Array, "w"]  # reflectance of the diffusing bottom

    def each(self, change: Callable[[Any, int], Any]) -> Coefficients:
        """`change` of every array and its axis of wavelengths."""
        by_layer = (change(a, 1) for a in self[:4])
        moments = tuple(None if a is None else change(a, 0) for a in self.moments)
        return Coefficients(*by_layer, moments=moments, bottom=change(self.bottom, 0))


class Optics(NamedTuple):
    """What refractive indices and roughness make of the streams; u sets of indices."""

    root: Float[Array, "u s"]  # of the stream's weight
    cosine: tuple[Float[Array, "u s"], ...]  # by layer
    even: tuple[Float[Array, "u s s"] | None, ...]
    odd: tuple[Float[Array, "u s s"] | None, ...]
    interface: tuple[Float[Array, "u s"] | None, ...]  # below each layer
    enters: Float[Array, "u s"]
    back: Float[Array, "u s s"]
    leaves: Float[Array, "u s"]


class Solution(NamedTuple):
    """Shares of the incident light; w wavelengths, m layers.

    reflectance = surface (reflected at once) + subsurface (came back from inside); `absorbed` by
    layer, and `bottom` what the bottom absorbed or let through, where they were asked for.
    """

    reflectance: Float[Array, "w"]
    surface: Float[Array, "w"]
    subsurface: Float[Array, "w"]
    absorbed: Float[Array, "m w"] | None
    bottom: Float[Array, "w"] | None


# --- the solver ------------------------------------------------------------------------------


def _transposed(matrix: Array) -> Array:
    return jnp.swapaxes(matrix, -1, -2)


# On a CPU a product of two of these matrices takes a twentieth of the time of a solution by LAPACK.


@lru_cache(maxsize=8)
def _series(name: str, dtype: str) -> tuple[int, tuple[float, ...]]:
    """(b, coefficients) of a polynomial in v = -1 to 1, to be summed up in blocks of b powers."""
    function, high = _FUNCTIONS[name]
    block, degree = _DEGREES[name, dtype]
    told = Chebyshev.interpolate(function, degree, (0.0, high))
    return block, tuple(told.convert(kind=Polynomial, domain=(0.0, high)).coef.tolist())


def _tanh_over(x2: np.ndarray) -> np.ndarray:
    x = np.sqrt(np.maximum(x2, 1e-30))
    return np.tanh(x) / x


_FUNCTIONS = {"tanh": (_tanh_over, START**2), "inverse": (lambda x: 1.0 / (1.0 + x), 1.0)}
# the error falls by 4.2 and 5.8 a degree
_DEGREES = {
    ("tanh", "float32"): (4, 12), ("tanh", "float64"): (5, 25),
    ("inverse", "float32"): (3, 9), ("inverse", "float64"): (5, 20),
}  # fmt: skip


def _sum_up(name: str, x: Array) -> Array:
    """A function of matrices, of which all eigenvalues lie where its series holds: products only
    (Paterson and Stockmeyer 1973)."""
    high = _FUNCTIONS[name][1]
    block, factors = _series(name, x.dtype.name)
    unit = jnp.eye(x.shape[-1], dtype=x.dtype)[None]
    powers = [unit, (2.0 / high) * x - unit]
    while len(powers) <= block:
        powers.append(powers[-1] @ powers[1])

    def part(first: int, last: int) -> Array:
        return sum((factors[i] * powers[i - first] for i in range(first, last)), jnp.zeros_like(x))

    top = (len(factors) - 2) // block * block
    found = part(top, len(factors))
    for first in reversed(range(0, top, block)):
        found = found @ powers[block] + part(first, first + block)
    return found


def _as_an_inverse(function):
    """With the derivative of an inverse: that of the way to it would cost more."""
    function = jax.custom_jvp(function)

    @function.defjvp
    def _(primals, tangents):
        inverse = function(*primals)
        return inverse, -(inverse @ tangents[0] @ inverse)

    return function


@_as_an_inverse
def _inverse_above_one(x: Array) -> Array:
    """(1 + x)^-1 for eigenvalues of x from 0 to 1."""
    return _sum_up("inverse", x)


@_as_an_inverse
def _inverse(a: Array) -> Array:
    """By Gauss and Jordan, for many matrices at once and without pivots: what is inverted here is 1
    plus a positive matrix, or 1 minus what a passive medium sends back."""
    m = jnp.moveaxis(a, 0, -1)
    place = jnp.arange(m.shape[0])[:, None]

    def step(k: Array, m: Array) -> Array:
        here = place == k
        row = m[k]
        row = jnp.where(here, 1.0, row) * (1.0 / jax.lax.dynamic_index_in_dim(row, k, 0))
        rest = jnp.where(here[None], 0.0, m) - m[:, k][:, None] * row[None]
        return jnp.where(here[:, None], row[None], rest)

    return jnp.moveaxis(jax.lax.fori_loop(0, m.shape[0], step, m), -1, 0)


class _Rates(NamedTuple):
    """E and O of a layer, by half of its thickness, and what they change by for the scattering
    coefficient; `thin` is half of the thickness that the series of tanh is for, and `doublings`
    lead from there to the whole."""

    even: Float[Array, "w s s"]
    odd: Float[Array, "w s s"]
    even_by_scattering: Float[Array, "w s s"]
    odd_by_scattering: Float[Array, "w s s"]
    thin: Float[Array, "w 1 1"]
    doublings: Float[Array, ""]


def _kernels(even, odd, cosine, chi) -> list[Array]:
    """What the scattering coefficient takes from E and from O."""
    s = cosine.shape[-1]
    root = jax.lax.rsqrt(cosine)
    frame = root[:, :, None] * root[:, None, :]
    return [
        frame * ((basis * moments[:, None, :s]) @ _transposed(basis))
        for basis, moments in ((even, chi[:, 0::2]), (odd, chi[:, 1::2]))
    ]


def _rates(extinction, scattering, half, even, odd, cosine, chi) -> _Rates:
    unit = jnp.eye(cosine.shape[-1], dtype=half.dtype)[None]
    straight = extinction[:, None, None] * unit / cosine[:, None, :]
    kernels = [-kernel for kernel in _kernels(even, odd, cosine, chi)]
    first, second = (straight + scattering[:, None, None] * kernel for kernel in kernels)
    # no eigenvalue is larger
    least = jnp.maximum(-jnp.min(chi, axis=1), 0.0)
    largest = (extinction + scattering * least) / jnp.min(cosine, axis=1)
    largest = jax.lax.stop_gradient(largest)
    deepest = jax.lax.stop_gradient(jnp.max(largest * half))
    doublings = jnp.minimum(jnp.ceil(jnp.log2(jnp.maximum(deepest / START, 1.0))), DOUBLINGS)
    thin = jnp.minimum(half * jnp.exp2(-doublings), START / jnp.maximum(largest, 1e-30))
    return _Rates(first, second, kernels[0], kernels[1], thin[:, None, None], doublings)


def _slab(extinction, scattering, half, even, odd, cosine, chi):
    """(R, T) of a layer that scatters; all with a leading axis of wavelengths."""
    rates = _rates(extinction, scattering, half, even, odd, cosine, chi)
    e, o = rates.thin * rates.even, rates.thin * rates.odd
    t = _sum_up("tanh", o @ e)

    def double(pair):  # 2 Y (1 + Z Y)^-1, and 2 (1 + Z Y)^-1 Z
        y, z = pair
        shared = 2.0 * _inverse_above_one(z @ y)
        return y @ shared, shared @ z

    def step(pair, number):  # a loop of its own length would have no reverse derivative
        return jax.lax.cond(number < rates.doublings, double, lambda same: same, pair), None

    numbers = jnp.arange(DOUBLINGS, dtype=half.dtype)
    y, z = jax.lax.scan(step, (e @ t, t @ o), numbers)[0]
    # R + T = 2 (1 + Y)^-1 - 1, R - T = 1 - 2 (1 + Z)^-1
    unit = jnp.eye(cosine.shape[-1], dtype=half.dtype)[None]
    both, apart = _inverse(unit + y), _inverse(unit + z)
    return both - apart, both + apart - unit


@jax.custom_jvp
def _layer(extinction, scattering, half, even, odd, cosine, chi):
    """As `_slab`, with derivatives by the first three alone. They are worked out on the way down:
    to remember every doubling for a way back costs several times as much."""
    return _slab(extinction, scattering, half, even, odd, cosine, chi)


@_layer.defjvp
def _(primals, tangents):
    extinction, scattering, half, _, _, cosine, _ = primals
    rates = _rates(*primals)
    e, o = rates.thin * rates.even, rates.thin * rates.odd
    unit = jnp.eye(cosine.shape[-1], dtype=half.dtype)[None]
    straight = rates.thin * unit / cosine[:, None, :]
    ways = (  # by extinction, by scattering
        (straight, straight),
        (rates.thin * rates.even_by_scattering, rates.thin * rates.odd_by_scattering),
    )
    t, turn = jax.linearize(partial(_sum_up, "tanh"), o @ e)
    started = []
    for de, do in ways:
        dt = turn(do @ e + o @ de)
        started.append((de @ t + e @ dt, dt @ o + t @ do))

    def double(_, matrices):  # all but m are symmetric
        y, z, changes = matrices
        m = _inverse_above_one(z @ y)
        turned, p, q = _transposed(m), y @ m, m @ z
        changes = [
            (2.0 * (turned @ dy @ m - p @ dz @ p), 2.0 * (m @ dz @ turned - q @ dy @ q))
            for dy, dz in changes
        ]
        return 2.0 * p, 2.0 * q, changes

    doublings = rates.doublings.astype(jnp.int32)
    y, z, changes = jax.lax.fori_loop(0, doublings, double, (e @ t, t @ o, started))
    both, apart = _inverse(unit + y), _inverse(unit + z)
    by = []
    for dy, dz in changes:
        dboth, dapart = both @ dy @ both, apart @ dz @ apart
        by.append((dapart - dboth, -dapart - dboth))
    # only half the thickness times a coefficient matters
    share = 1.0 / jnp.maximum(half, 1e-30)
    none = rates.odd - rates.even, -rates.even - rates.odd
    by_half = [
        jnp.where(
            (half > 0)[:, None, None],
            (share * extinction)[:, None, None] * more + (share * scattering)[:, None, None] * less,
            at_once,
        )
        for more, less, at_once in zip(*by, none, strict=True)
    ]
    along = [change[:, None, None] for change in tangents[:3]]
    r, t = (
        along[0] * by_extinction + along[1] * by_scattering + along[2] * by_size
        for by_extinction, by_scattering, by_size in zip(*by, by_half, strict=True)
    )
    return (both - apart, both + apart - unit), (r, t)


def _mean_decay(x: Array) -> Array:
    """(1 - exp(-x)) / x, 1 at 0."""
    safe = jnp.where(x > 1e-6, x, 1.0)
    return jnp.where(x > 1e-6, -jnp.expm1(-safe) / safe, 1.0 - 0.5 * x)


def _fibres(absorption, fibre, thickness, even, cosine):
    """(R, T) of a layer that scatters at most once a pass, by Rayleigh's law: a closed form."""
    s = cosine.shape[-1]
    first, third = even[:, :, 0], even[:, :, 1]
    law = first[:, :, None] * first[:, None, :] + 0.1 * third[:, :, None] * third[:, None, :]
    root = jax.lax.rsqrt(cosine)
    chance = 0.5 * law * root[:, :, None] * root[:, None, :]
    depth = thickness[:, None] / cosine
    before = ((absorption + fibre)[:, None] * depth)[:, None, :]  # of stream j, before the event
    after = (absorption[:, None] * depth)[:, :, None]  # of stream i, after it
    rate = chance * (fibre * thickness)[:, None, None]
    straight = jnp.eye(s, dtype=cosine.dtype)[None] * jnp.exp(-before)
    on = jnp.exp(-jnp.minimum(before, after)) * _mean_decay(jnp.abs(before - after))
    return rate * _mean_decay(before + after), straight + rate * on


def _first_hits(extinction, thickness, even, odd, cosine, chi):
    """What (R, T) of a clear layer change by for its scattering coefficient: one hit."""
    sum_, difference = _kernels(even, odd, cosine, chi)
    half = 0.5 * thickness[:, None, None]
    depth = extinction[:, None] * thickness[:, None] / cosine
    into, out = depth[:, None, :], depth[:, :, None]
    on = jnp.exp(-jnp.minimum(into, out)) * _mean_decay(jnp.abs(into - out))
    back = _mean_decay(into + out)
    return half * (sum_ - difference) * back, half * (sum_ + difference) * on


# wavelengths at a time: what they need stays in the cache, and memory is bounded
BLOCK, ACCELERATOR_BLOCK = 32, 8192


@partial(jax.jit, static_argnames=("kinds", "counts", "more"))
def _solve(c: Coefficients, optics: Optics, which: Array, kinds, counts, more: str = ""):
    """What comes back of the light that entered, (w,); with `more` of it:

    - "inner": also what every layer absorbs (m, w), and what the bottom does or lets through (w,);
    - "slopes": also the derivatives by every coefficient of its own wavelength, `Coefficients`.
    """
    w = which.size
    size = min(BLOCK if jax.default_backend() == "cpu" else ACCELERATOR_BLOCK, w)
    padding = -w % size

    def blocks(a, axis):
        a = jnp.concatenate([a, jnp.take(a, jnp.zeros(padding, jnp.int32), axis)], axis)
        shape = (*a.shape[:axis], -1, size, *a.shape[axis + 1 :])
        return jnp.moveaxis(a.reshape(shape), axis, 0)

    def one(block):
        return _solve_block(block[0], optics, block[1], kinds, counts, more)

    def whole(a):
        a = jnp.moveaxis(a, 0, -2)
        return a.reshape(*a.shape[:-2], -1)[..., :w]

    return jax.tree.map(whole, jax.lax.map(one, (c.each(blocks), blocks(which, 0))))


def _spread(c: Coefficients, optics: Optics, which: Array, kinds, counts, more: str = ""):
    """`_solve`, on a CPU by parts of the wavelengths side by side, a core each.

    XLA spreads single products over threads, which then wait for each other for longer than a
    product takes. Inside a transformation of JAX there are no parts.
    """
    w = which.size
    blocks = -(-w // BLOCK)
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((c, which)))
    if traced or blocks == 1 or jax.default_backend() != "cpu":
        return _solve(c, optics, which, kinds, counts, more)
    size = -(-blocks // cores()) * BLOCK
    c, which = jax.tree.map(np.asarray, (c, which))

    def part(start: int):
        at = np.minimum(np.arange(start, start + size), w - 1)  # one shape, compiled once
        some = c.each(lambda a, axis: a.take(at, axis))
        return _solve(some, optics, which[at], kinds, counts, more)

    found = side_by_side(part, range(0, w, size))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, -1)[..., :w], *found)


def _of(matrix: Array, vector: Array) -> Array:
    return (matrix @ vector[..., None])[..., 0]


class _Part(NamedTuple):
    """A layer or an interface that light meets on its way down, and what lies beneath it."""

    below: Float[Array, "w s s"]  # what all that lies beneath sends back up
    through: Float[Array, "w s s"] | Float[Array, "w s"]  # a diagonal, of no more streams
    back: Float[Array, "w s s"] | Float[Array, "w s"] | None  # what it sends back down
    closed: Float[Array, "w s s"] | None  # (1 - below back)^-1

    def down(self, light: Float[Array, "w s"]) -> tuple[Array, Array]:
        """Light beneath it that goes (down, up), for light that comes from above."""
        light = self._pass(light, self.through)
        up = _of(self.below, light)
        if self.back is not None and self.closed is not None:
            up = _of(self.closed, up)
            light = light + (self.back * up if self.back.ndim == 2 else _of(self.back, up))
        return light, up

    def worth(self, above: Float[Array, "w s"]) -> tuple[Array, Array]:
        """What light beneath it that goes (down, up) is worth, if above it what goes up is worth
        `above`: the way of `down` in the other direction."""
        diagonal = self.through.ndim == 2
        up = self._pass(above, self.through if diagonal else _transposed(self.through))
        if self.closed is not None:
            up = _of(_transposed(self.closed), up)
        return _of(_transposed(self.below), up), up

    def _pass(self, light: Array, through: Array) -> Array:
        if through.ndim == 3:
            return _of(through, light)
        common = through.shape[1]
        beneath = self.below.shape[1] - common
        return jnp.pad(through * light[:, :common], ((0, 0), (0, beneath)))


def _solve_block(
    c: Coefficients,
    optics: Optics,
    which: Array,
    kinds: tuple[str, ...],
    counts: tuple[int, ...],
    more: str,
):
    dtype = c.extinction.dtype
    last = len(kinds) - 1
    root = optics.root[which]

    def unit(s):
        return jnp.eye(s, dtype=dtype)[None]

    parts: list[tuple[int | None, _Part]] = []  # from the bottom up; None: an interface
    pulls = {}  # from changes of what a layer reflects and lets through to those of its numbers
    s = counts[last]
    even_out = root[:, :s] / jnp.sqrt(jnp.sum(root[:, :s] ** 2, axis=1, keepdims=True))
    if kinds[-1] == "open":  # a medium below that nothing comes back from
        below = jnp.zeros((which.size, s, s), dtype)
    else:
        below = c.bottom[:, None, None] * even_out[:, :, None] * even_out[:, None, :]
    layers = last if kinds[-1] == "open" else last + 1
    for i in reversed(range(layers)):
        s = counts[i]
        fresnel = optics.interface[i]
        if fresnel is not None:  # between this layer and the next one down
            r = fresnel[which]
            common = min(s, counts[i + 1])
            under, pass_ = r[:, : counts[i + 1]], 1.0 - r[:, :common]
            closed = _inverse(unit(counts[i + 1]) - below * under[:, None, :])
            parts.append((None, _Part(below, pass_, under, closed)))
            inside = (closed @ below)[:, :common, :common]
            above = jnp.zeros((which.size, s, s), dtype)
            above = above.at[:, :common, :common].set(
                pass_[:, :, None] * inside * pass_[:, None, :]
            )
            below = above + r[:, :s, None] * unit(s)
        answer, numbers = _layer_of(c, optics, which, kinds[i], i)
        found: Any
        found, pulls[i] = (
            jax.vjp(answer, *numbers) if more == "slopes" else (answer(*numbers), None)
        )
        if kinds[i] in STRAIGHT:
            parts.append((i, _Part(below, found, None, None)))
            below = found[:, :, None] * below * found[:, None, :]
        else:
            r, t = found
            closed = _inverse(unit(s) - below @ r)
            parts.append((i, _Part(below, t, r, closed)))
            below = r + t @ closed @ below @ t
    parts.reverse()
    s = counts[0]
    source = optics.enters[which] / root[:, :s]
    leaves = optics.leaves[which] * root[:, :s]
    back = optics.back[which] * root[:, None, :s] / root[:, :s, None]
    closed = _inverse(unit(s) - back @ below)
    light = _of(closed, source)
    up = _of(below, light)
    out = jnp.sum(leaves * up, axis=1)
    if not more:
        return out

    if more == "inner":
        return out, *_absorbed(parts, root, light, up)
    # the way of the light that comes back, from its end: what light is worth that goes up
    worth = leaves + _of(
        _transposed(back), _of(_transposed(closed), _of(_transposed(below), leaves))
    )
    rows, light, worth = _derivatives(c, optics, which, kinds, parts, pulls, light, worth)
    bottom = jnp.zeros_like(c.bottom)
    if kinds[-1] != "open":
        bottom = jnp.sum(even_out * worth, axis=1) * jnp.sum(even_out * light, axis=1)
    return out, Coefficients(**rows, moments=(), bottom=bottom)


def _absorbed(parts, root, light, up):
    """By layer, top down (m, w), and by the bottom."""

    def net(light, up):
        return jnp.sum(root[:, : light.shape[1]] * (light - up), axis=1)

    absorbed, arrives = [], net(light, up)
    for i, part in parts:
        light, up = part.down(light)
        rest = net(light, up)
        if i is not None:
            absorbed.append(arrives - rest)
        arrives = rest
    return jnp.stack(absorbed), arrives


def _derivatives(c, optics, which, kinds, parts, pulls, light, worth):
    """By the numbers of every layer, each (m, w); and the light that goes down at the bottom, and
    what light is worth that goes up there."""
    none = jnp.zeros_like(c.bottom)
    by = {name: [none] * len(kinds) for name in ("thickness", "extinction", "scattering", "once")}
    for i, part in parts:
        above, light, up = light, *part.down(light)
        upward, (downward, worth) = worth, part.worth(worth)
        if i is None:
            continue
        # what a change of what the layer reflects, and of what it lets through, is worth
        if kinds[i] in STRAIGHT:
            change: Any = upward * up + downward * above
        else:
            change = (
                upward[:, :, None] * above[:, None] + downward[:, :, None] * up[:, None],
                upward[:, :, None] * up[:, None] + downward[:, :, None] * above[:, None],
            )
        for name, found in zip(_numbers(kinds[i]), pulls[i](change), strict=True):
            by[name][i] = found
        if kinds[i] == "bare":
            even, odd, mu = (a[i][which] for a in (optics.even, optics.odd, optics.cosine))
            r, t = _first_hits(c.extinction[i], c.thickness[i], even, odd, mu, c.moments[i])
            by["scattering"][i] = jnp.sum(
                upward * (_of(r, above) + _of(t, up)) + downward * (_of(t, above) + _of(r, up)),
                axis=1,
            )
    return {name: jnp.stack(found) for name, found in by.items()}, light, worth


def _numbers(kind: str) -> tuple[str, ...]:
    """Of `Coefficients`, what a layer of this kind is made of."""
    if kind in STRAIGHT:
        return "extinction", "thickness"
    return "extinction", "once" if kind == "fibres" else "scattering", "thickness"


def _layer_of(c: Coefficients, optics: Optics, which: Array, kind: str, i: int):
    """(function, what it is of): what layer i reflects and lets through, or what straight light
    keeps of itself in a clear one."""
    numbers = tuple(getattr(c, name)[i] for name in _numbers(kind))
    mu, even, odd, chi = optics.cosine[i][which], optics.even[i], optics.odd[i], c.moments[i]
    if kind in STRAIGHT:
        return lambda lost, depth: jnp.exp(-lost[:, None] * depth[:, None] / mu), numbers
    assert even is not None
    if kind == "fibres":
        return lambda lost, once, depth: _fibres(lost, once, depth, even[which], mu), numbers
    assert odd is not None
    rest = even[which], odd[which], mu, chi
    slab = _layer if kind == "scatter" else _slab
    return lambda lost, turned, depth: slab(lost, turned, 0.5 * depth, *rest), numbers


# --- what it needs from layers and tissue ------------------------------------------------------


@lru_cache(maxsize=32)
def _optics(
    indices: tuple[tuple[float, ...], ...],
    kinds: tuple[str, ...],
    outside: float,
    roughness: float,
    incidence: float,
    order: int,
    parts: tuple[int, ...],
) -> tuple[dict[str, Any], tuple[int, ...], np.ndarray]:
    """NumPy arrays for `Optics`, streams by layer, and the share reflected at once (u,)."""
    parts = Streams.make((outside, *indices[0]), order, parts).parts
    sets = [Streams.make((outside, *row), order, parts) for row in indices]
    counts = {tuple(st.count(n) for n in row) for st, row in zip(sets, indices, strict=True)}
    if len(counts) > 1 or len({st.weight.size for st in sets}) > 1:
        raise HyliosError(
            "the refractive indices of the layers change their order with the wavelength: "
            "solve such wavelengths one by one"
        )
    surfaces = _surfaces(sets, indices, outside, roughness, incidence, order)
    layers = range(len(kinds))
    bases = [
        [streams.scattering_basis(st, row[i]) for st, row in zip(sets, indices, strict=True)]
        if kinds[i] != "clear" else None
        for i in layers
    ]  # fmt: skip

    def below(i):
        if i + 1 == len(kinds) or all(abs(row[i] - row[i + 1]) < SAME for row in indices):
            return None
        pairs = zip(sets, indices, strict=True)
        return np.stack([streams.interface(st, row[i], row[i + 1]) for st, row in pairs])

    arrays = {
        "root": np.sqrt([st.weight for st in sets]),
        "cosine": tuple(
            np.stack([st.cosine(row[i]) for st, row in zip(sets, indices, strict=True)])
            for i in layers
        ),
        "even": tuple(None if b is None else np.stack([pair[0] for pair in b]) for b in bases),
        "odd": tuple(
            None if b is None or kinds[i] == "fibres" else np.stack([pair[1] for pair in b])
            for i, b in enumerate(bases)
        ),
        "interface": tuple(below(i) for i in layers),
        "enters": np.stack([s.enters for s in surfaces]),
        "back": np.stack([s.back for s in surfaces]),
        "leaves": np.stack([s.leaves for s in surfaces]),
    }
    return arrays, counts.pop(), np.array([s.at_once for s in surfaces])


BETWEEN = 9  # sets of indices that a rough surface is worked out for, where there are more


def _surfaces(sets, indices, outside, roughness, incidence, order) -> list[streams.Surface]:
    """The surface for each set of indices; interpolated where dispersion makes many of them."""

    def one(row):
        st = Streams.make((outside, *row), order, sets[0].parts)
        return streams.surface(st, outside, row[0], roughness, incidence, order)

    if roughness <= 0 or len(indices) <= BETWEEN:
        return [one(row) for row in indices]
    first = np.array(indices[0])
    shift = np.array([row[0] for row in indices]) - first[0]
    if not np.allclose(np.array(indices) - first, shift[:, None], atol=1e-6):
        return [one(row) for row in indices]
    # dispersion shifts all indices alike, and everything is smooth in the shift
    middle, half = 0.5 * (shift.max() + shift.min()), 0.5 * (shift.max() - shift.min())
    k = np.arange(BETWEEN)
    nodes = np.cos(np.pi * (k + 0.5) / BETWEEN)
    at = [one(tuple(first + middle + half * node)) for node in nodes]
    weight = (-1.0) ** k * np.sin(np.pi * (k + 0.5) / BETWEEN)
    away = (shift[:, None] - middle) / half - nodes
    share = weight / np.where(np.abs(away) < 1e-13, 1e-13, away)
    share /= share.sum(axis=1, keepdims=True)

    def mixed(name):
        return np.tensordot(share, np.stack([getattr(s, name) for s in at]), axes=1)

    parts = (mixed(f.name) for f in dataclasses.fields(streams.Surface))
    return [streams.Surface(*row) for row in zip(*parts, strict=True)]


@contextmanager
def _precision(dtype: Any) -> Iterator[None]:
    """Double precision where it is asked for, and where JAX is set to it; products in full."""
    wide = np.float64 in (dtype, jax.dtypes.canonicalize_dtype(np.float64))
    with jax.enable_x64(wide), jax.default_matmul_precision(HIGHEST):
        yield


def _concrete(name: str, value: Any) -> np.ndarray:
    if isinstance(value, Tracer):
        raise HyliosError(
            f"adding-doubling has no derivative in {name}: its streams depend on it. Keep it out "
            "of jit, grad and vmap, and batch over specimens instead"
        )
    return np.asarray(value, np.float64)


def _ready(c, kinds, index, outside, roughness, incidence, order, dtype, parts=()):
    """(c, optics, which set of them, streams by layer, share reflected at once) for `_solve`.

    index: (m + open, w) in float64, concrete.
    """
    columns, which = np.unique(np.round(index, 12), axis=1, return_inverse=True)
    arrays, counts, at_once = _optics(
        tuple(map(tuple, columns.T.tolist())), kinds, outside, roughness, incidence, order, parts
    )
    which = np.broadcast_to(which.reshape(-1), c.extinction.shape[1:])
    optics = jax.tree.map(lambda a: jnp.asarray(a, dtype), Optics(**arrays))
    c = jax.tree.map(lambda a: jnp.asarray(a, dtype), c)
    return c, optics, jnp.asarray(which, jnp.int32), counts, jnp.asarray(at_once[which], dtype)


def _run(c, kinds, index, outside, roughness, incidence, order, dtype, inner, parts=()) -> Solution:
    with _precision(dtype):
        c, optics, which, counts, at = _ready(
            c, kinds, index, outside, roughness, incidence, order, dtype, parts
        )
        entered = 1.0 - at
        absorbed = bottom = None
        found = _spread(c, optics, which, kinds, counts, "inner" if inner else "")
        if inner:
            found, absorbed, bottom = found
            absorbed, bottom = entered[None] * absorbed, entered * bottom
        solution = Solution(at + entered * found, at, entered * found, absorbed, bottom)
        return jax.block_until_ready(solution)


def skin(
    layers: Layers,
    *,
    incidence: float = math.radians(8.0),
    order: int = ORDER,
    dtype: Any = None,
    inner: bool = False,
    parts: tuple[int, ...] = (),
) -> Solution:
    """Light in the six layers of skin; w wavelengths, or the wavelengths of many specimens.

    `incidence` in radians; `dtype` float64 unless given; `inner` also works out what every layer
    absorbs. `parts` fixes the streams between one index and the next, so that specimens with other
    indices need no compiling (`Streams.make`). Differentiable in all of `layers` but the indices
    and the roughness, which must be concrete. A specimen's scalars (`thickness`, `bottom`) may
    carry an axis of wavelengths.
    """
    dtype = jnp.dtype(jnp.float64 if dtype is None else dtype)
    _check(order, incidence)
    c, kinds, index, roughness = _of_skin(layers, order, dtype, parts)
    return _run(c, kinds, index, 1.0, roughness, incidence, order, dtype, inner, parts)


def _of_skin(
    layers: Layers, order: int, dtype: Any, parts: tuple[int, ...] = (), moving: Sequence[str] = ()
):
    """(coefficients, kind of each layer, indices, roughness).

    A layer that scatters nothing is clear, or "bare" where one of the parameters that are `moving`
    would make it scatter: then its first scattering is what has to be known.
    """
    w = layers.mu_a.shape[1]
    index, roughness = (
        _concrete("the indices", layers.index),
        _concrete("the roughness", layers.roughness),
    )
    kinds = ["clear"] * 6
    for i in (1, 2, 3):
        if _present(layers.mu_particle[i]):
            kinds[i] = "scatter"
        elif f"melanosome_{LAYERS[i]}" in moving:
            kinds[i] = "bare"
    if _present(layers.mu_fibre) or {"fibre_fraction", "fibre_radius"} & {*moving}:
        kinds[4] = "fibres"
    if _present(layers.mu_tissue[5]):
        kinds[5] = "scatter"
    elif "reticular_scattering" in moving:
        kinds[5] = "bare"
    theta_0 = _concrete("theta_0", layers.theta_0)
    angles, place = np.unique(theta_0, return_inverse=True)
    top = Streams.make((1.0, *index[:, 0]), order, parts).weight.size
    with _precision(dtype):
        moments = streams.exponential_moments(tuple(angles), 2 * top)[place]
        alone = np.broadcast_to(np.eye(1, moments.shape[1]), moments.shape)
        chi, isotropic = (jnp.asarray(each, dtype) for each in (moments, alone))

        def wide(value):
            value = jnp.asarray(value, dtype)
            return jnp.broadcast_to(value if value.ndim else value[None], (w,))

        thickness = jnp.stack([wide(layers.thickness[i]) for i in range(6)])
        hits = jnp.asarray(layers.mu_particle, dtype)
        tissue = jnp.asarray(layers.mu_tissue, dtype)
        once = jnp.zeros((6, w), dtype).at[4].set(jnp.asarray(layers.mu_fibre, dtype))
        c = Coefficients(
            thickness=thickness,
            extinction=jnp.asarray(layers.mu_a, dtype) + hits + tissue,
            scattering=hits * jnp.asarray(layers.hit_albedo, dtype) + tissue,
            once=once,
            moments=(None, chi, chi, chi, None, isotropic),
            bottom=wide(layers.bottom),
        )
    return c, tuple(kinds), index, float(roughness)


MOVED = ("thickness", "mu_a", "mu_particle", "hit_albedo", "mu_fibre", "mu_tissue", "bottom")
"""What of `Layers` a derivative can go through."""


@lru_cache(maxsize=16)
def _moving(names: tuple[str, ...], form: str, nm: tuple[float, ...], independent: bool, dtype):
    """(values, x) -> what moves in the layers, each with an axis of wavelengths."""

    def parts(values: dict[str, Array], x: Array) -> dict[str, Array]:
        values = {**values, **dict(zip(names, x, strict=True))}
        medium = layers_of(values, form, np.array(nm), dtype)
        if not independent:
            medium = let_stand(medium, values, form)
        along = jnp.ones(len(nm), dtype)
        medium = medium._replace(
            thickness=medium.thickness[:, None] * along[None], bottom=medium.bottom * along
        )
        return {name: getattr(medium, name) for name in MOVED}

    return jax.jit(lambda values, x: (parts(values, x), jax.jacfwd(partial(parts, values))(x)))


def slopes(
    specimen: Specimen,
    wavelength_nm: np.ndarray,
    names: Sequence[str],
    *,
    incidence: float = math.radians(8.0),
    order: int = ORDER,
    dtype: Any = None,
    independent: bool = False,
) -> tuple[Float[Array, "w"], Float[Array, "p w"]]:
    """Reflectance, and its derivative by every parameter in `names`, per unit of the parameter.

    A wavelength sees its own coefficients alone, so that one backward pass serves them all and
    the cost does not grow with the number of parameters. `incidence` in radians; `independent`
    leaves out the rejection of particles.
    """
    dtype = jnp.dtype(jnp.float64 if dtype is None else dtype)
    for name in names:
        if name.startswith("index") or name in ("roughness", "melanosome_form"):
            raise HyliosError(
                f"adding-doubling has no derivative in {name}: its streams depend on it"
            )
    nm = np.atleast_1d(np.asarray(wavelength_nm, float))
    with _precision(dtype):
        fixed = specimen.layers(nm, dtype)
        x = jnp.asarray(specimen.parameters(names), dtype)
        values = {name: jnp.asarray(value, dtype) for name, value in specimen.values.items()}
        moving = _moving(
            tuple(names), specimen.melanosome_form, tuple(nm.tolist()), independent, dtype
        )
        parts, tangents = moving(values, x)

        c, kinds, index, roughness = _of_skin(fixed._replace(**parts), order, dtype, moving=names)
        c, optics, which, counts, at = _ready(
            c, kinds, index, 1.0, roughness, incidence, order, dtype
        )
        out, by = _spread(c, optics, which, kinds, counts, "slopes")
        by_part = {
            "thickness": by.thickness,
            "mu_a": by.extinction,
            "mu_particle": by.extinction + by.scattering * parts["hit_albedo"],
            "hit_albedo": by.scattering * parts["mu_particle"],
            "mu_fibre": by.once[4],
            "mu_tissue": by.extinction + by.scattering,
            "bottom": by.bottom,
        }
        total = jnp.zeros((len(names), nm.size), dtype)
        for name in MOVED:
            product = by_part[name][..., None] * tangents[name]  # (layer,) w p
            total = total + jnp.sum(product.reshape(-1, nm.size, len(names)), axis=0).T
        return at + (1.0 - at) * out, (1.0 - at)[None] * total


def tissue(
    layers: Tissue, *, incidence: float = 0.0, order: int = 16, dtype: Any = None
) -> Solution:
    """Light in plain layers with Henyey-Greenstein scattering (m,); every share has one value.

    `incidence` in radians. `Solution.bottom` is the transmittance. Differentiable in thickness,
    mu_a, mu_s and g.
    """
    dtype = jnp.dtype(jnp.float64 if dtype is None else dtype)
    _check(order, incidence)
    index = _concrete("the indices", layers.index)
    above, below = (float(_concrete("the indices", n)) for n in (layers.above, layers.below))
    m = index.size
    kinds = tuple("tissue" if _present(layers.mu_s[i]) else "clear" for i in range(m))
    every = np.concatenate([index, [below]])
    top = Streams.make((above, *every), order).weight.size
    with _precision(dtype):
        mu_a, mu_s, g, h = (
            jnp.asarray(v, dtype) for v in (layers.mu_a, layers.mu_s, layers.g, layers.thickness)
        )
        extinction = mu_a + mu_s
        h = jnp.minimum(h, OPAQUE / jnp.maximum(extinction, 1e-30))
        power = jnp.arange(2 * top, dtype=dtype)
        column = partial(jnp.expand_dims, axis=1)
        c = Coefficients(
            thickness=column(h),
            extinction=column(extinction),
            scattering=column(mu_s),
            once=jnp.zeros((m, 1), dtype),
            moments=tuple(_powers(g[i], power)[None] for i in range(m)),
            bottom=jnp.zeros(1, dtype),
        )
    return _run(c, (*kinds, "open"), every[:, None], above, 0.0, incidence, order, dtype, True)


def _powers(g: Array, power: Array) -> Array:
    """g^l with finite derivatives at 0."""
    return jnp.cumprod(
        jnp.concatenate([jnp.ones_like(power[:1]), jnp.broadcast_to(g, power.shape)[1:]])
    )


def _present(value: Any) -> bool:
    return isinstance(value, Tracer) or bool(np.any(np.asarray(value) > 0))


def _check(order: int, incidence: float) -> None:
    if not 2 <= order <= 256:
        raise HyliosError(f"order must lie in 2 to 256, got {order}")
    if not 0 <= incidence <= math.radians(89.0):
        raise HyliosError(f"incidence must lie in 0 to 89 degrees, got {math.degrees(incidence):g}")
