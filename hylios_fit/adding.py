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

and reflects and transmits R + T = (1 + Y)^-1 (1 - Y), R - T = -(1 + Z)^-1 (1 - Z). A Pade form of
tanh(x)/x starts from a layer thin enough, 2 Y (1 + Z Y)^-1 doubles it, and no step has a limit in
which it divides by nothing: no absorption, no scattering and opaque layers are ordinary cases.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from hylios_fit import streams
from hylios_fit.errors import HyliosError
from hylios_fit.skin import LAYERS, Layers, Specimen, let_stand
from hylios_fit.skin import layers as layers_of
from hylios_fit.streams import SAME, Streams
from hylios_fit.threads import one_blas_thread
from hylios_fit.tissue import Tissue

ORDER = 8
"""Streams for light that can leave; others in proportion. Its error on S1 to S4 is below 1e-4."""
ORDERS = (6, 8, 12, 16, 24, 32)
START = 2.0  # x that the Pade form of tanh(x)/x starts from
DOUBLINGS = 24  # at most; as many are done as the thickest layer of a block needs
OPAQUE = 1e5  # optical thickness that stands for an infinite one


class Coefficients(NamedTuple):
    """What the solver sees of m layers, top down; w wavelengths (or wavelengths of specimens)."""

    thickness: Float[Array, "m w"]
    extinction: Float[Array, "m w"]  # 1/cm
    scattering: Float[Array, "m w"]  # 1/cm, what survives a hit
    once: Float[Array, "m w"]  # 1/cm, Rayleigh scattering that happens once a pass
    moments: tuple[Float[Array, "w l"] | None, ...]  # Legendre moments of the law, by layer
    bottom: Float[Array, "w"]  # reflectance of the diffusing bottom


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


def _slab(extinction, scattering, half, even, odd, cosine, chi):
    """(R, T) of a layer that scatters; all with a leading axis of wavelengths."""
    s = cosine.shape[-1]
    unit = jnp.eye(s, dtype=half.dtype)[None]
    root = jax.lax.rsqrt(cosine)
    steepest = jnp.max(extinction * half / jnp.min(cosine, axis=1))
    doublings = jnp.ceil(jnp.log2(jnp.maximum(jax.lax.stop_gradient(steepest), START) / START))
    doublings = jnp.minimum(doublings, DOUBLINGS)
    frame = (half * jnp.exp2(-doublings))[:, None, None] * root[:, :, None] * root[:, None, :]

    def rate(basis, moments):
        kernel = (basis * moments[:, None, :s]) @ _transposed(basis)
        return frame * (extinction[:, None, None] * unit - scattering[:, None, None] * kernel)

    e, o = rate(even, chi[:, 0::2]), rate(odd, chi[:, 1::2])
    x2 = o @ e
    x4 = x2 @ x2
    t = jnp.linalg.solve(945.0 * unit + 420.0 * x2 + 15.0 * x4, 945.0 * unit + 105.0 * x2 + x4)
    y, z = e @ t, t @ o

    def double(pair):
        y, z = pair
        # 1 + Z Y is not symmetric, Y and Z are: Y (1 + Z Y)^-1 = (1 + Y Z)^-1 Y
        both = jnp.linalg.solve(jnp.stack([unit + y @ z, unit + z @ y]), jnp.stack([y, z]))
        return 2.0 * both[0], 2.0 * both[1]

    def step(pair, number):  # a loop of its own length would have no reverse derivative
        return jax.lax.cond(number < doublings, double, lambda same: same, pair), None

    numbers = jnp.arange(DOUBLINGS, dtype=half.dtype)
    y, z = jax.lax.scan(step, (y, z), numbers)[0]
    whole, odd_part = jnp.linalg.solve(
        jnp.stack([unit + y, unit + z]), jnp.stack([unit - y, z - unit])
    )
    return 0.5 * (whole + odd_part), 0.5 * (whole - odd_part)


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


# wavelengths at a time: what they need stays in the cache, and memory is bounded
BLOCK, ACCELERATOR_BLOCK = 32, 8192


@partial(jax.jit, static_argnames=("kinds", "counts", "inner"))
def _solve(c: Coefficients, optics: Optics, which: Array, kinds, counts, inner: bool):
    """(back, absorbed (m, w), bottom (w,)) in shares of the light that entered."""
    w = which.size
    size = min(BLOCK if jax.default_backend() == "cpu" else ACCELERATOR_BLOCK, w)
    padding = -w % size

    def blocks(a, axis):
        a = jnp.concatenate([a, jnp.take(a, jnp.zeros(padding, jnp.int32), axis)], axis)
        shape = (*a.shape[:axis], -1, size, *a.shape[axis + 1 :])
        return jnp.moveaxis(a.reshape(shape), axis, 0)

    wide = Coefficients(
        thickness=blocks(c.thickness, 1),
        extinction=blocks(c.extinction, 1),
        scattering=blocks(c.scattering, 1),
        once=blocks(c.once, 1),
        moments=tuple(None if a is None else blocks(a, 0) for a in c.moments),
        bottom=blocks(c.bottom, 0),
    )

    def one(block):
        return _solve_block(block[0], optics, block[1], kinds, counts, inner)

    out, absorbed, bottom = jax.lax.map(one, (wide, blocks(which, 0)))
    if not inner:
        return out.reshape(-1)[:w], None, None
    absorbed = jnp.moveaxis(absorbed, 1, 0).reshape(absorbed.shape[1], -1)
    return out.reshape(-1)[:w], absorbed[:, :w], bottom.reshape(-1)[:w]


def _solve_block(
    c: Coefficients,
    optics: Optics,
    which: Array,
    kinds: tuple[str, ...],
    counts: tuple[int, ...],
    inner: bool,
):
    dtype = c.extinction.dtype
    last = len(kinds) - 1
    root = optics.root[which]

    def unit(s):
        return jnp.eye(s, dtype=dtype)[None]

    down = {}  # how the light that enters a part from above goes on, for the way down
    s = counts[last]
    if kinds[-1] == "open":  # a medium below that nothing comes back from
        below = jnp.zeros((which.size, s, s), dtype)
    else:
        even_out = root[:, :s] / jnp.sqrt(jnp.sum(root[:, :s] ** 2, axis=1, keepdims=True))
        below = c.bottom[:, None, None] * even_out[:, :, None] * even_out[:, None, :]
    layers = last if kinds[-1] == "open" else last + 1
    for i in reversed(range(layers)):
        s = counts[i]
        fresnel = optics.interface[i]
        if fresnel is not None:  # between this layer and the next one down
            r = fresnel[which]
            common = min(s, counts[i + 1])
            under, over = r[:, : counts[i + 1]], r[:, :s]
            pass_ = 1.0 - r[:, :common]
            closed = unit(counts[i + 1]) - below * under[:, None, :]
            down["interface", i] = (below, under, pass_)
            inside = jnp.linalg.solve(closed, below)[:, :common, :common]
            above = jnp.zeros((which.size, s, s), dtype)
            above = above.at[:, :common, :common].set(
                pass_[:, :, None] * inside * pass_[:, None, :]
            )
            below = above + over[:, :, None] * unit(s)
        mu = optics.cosine[i][which]
        if kinds[i] == "clear":
            fade = jnp.exp(-c.extinction[i][:, None] * c.thickness[i][:, None] / mu)
            down["layer", i] = (below, None, fade)
            below = fade[:, :, None] * below * fade[:, None, :]
            continue
        even = optics.even[i]
        assert even is not None
        if kinds[i] == "fibres":
            r, t = _fibres(c.extinction[i], c.once[i], c.thickness[i], even[which], mu)
        else:
            odd, chi = optics.odd[i], c.moments[i]
            assert odd is not None
            assert chi is not None
            r, t = _slab(
                c.extinction[i], c.scattering[i], 0.5 * c.thickness[i], even[which], odd[which],
                mu, chi,
            )  # fmt: skip
        down["layer", i] = (below, r, t)
        below = r + t @ jnp.linalg.solve(unit(s) - below @ r, below @ t)
    s = counts[0]
    source = optics.enters[which] / root[:, :s]
    back = optics.back[which] * root[:, None, :s] / root[:, :s, None]
    light = jnp.linalg.solve(unit(s) - back @ below, source[:, :, None])
    up = (below @ light)[:, :, 0]
    out = jnp.sum(optics.leaves[which] * root[:, :s] * up, axis=1)
    if not inner:
        return out, None, None
    d = light[:, :, 0]
    absorbed = []

    def net(d, u):
        return jnp.sum(root[:, : d.shape[1]] * (d - u), axis=1)

    arrives = net(d, up)
    for i in range(layers):
        below, r, t = down["layer", i]
        if r is None:
            d = t * d
        else:  # d = t d + r u, u = below d
            d = jnp.linalg.solve(unit(d.shape[1]) - r @ below, t @ d[:, :, None])[:, :, 0]
        u = (below @ d[:, :, None])[:, :, 0]
        leaves = net(d, u)
        absorbed.append(arrives - leaves)
        arrives = leaves
        if ("interface", i) in down:
            below, under, pass_ = down["interface", i]
            common = pass_.shape[1]
            start = jnp.zeros((which.size, counts[i + 1]), dtype)
            start = start.at[:, :common].set(pass_ * d[:, :common])
            # d = start + under * u, u = below d
            over_ = unit(counts[i + 1]) - under[:, :, None] * below
            d = jnp.linalg.solve(over_, start[:, :, None])[:, :, 0]
    return out, jnp.stack(absorbed), arrives


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
        if kinds[i] in ("scatter", "fibres") else None
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


def _precision(dtype: Any) -> Any:
    """Double precision where it is asked for, and where JAX is set to it."""
    return jax.enable_x64(np.float64 in (dtype, jax.dtypes.canonicalize_dtype(np.float64)))


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
        with one_blas_thread():
            out, absorbed, bottom = jax.block_until_ready(
                _solve(c, optics, which, kinds, counts, inner)
            )
        entered = 1.0 - at
        if inner:
            absorbed, bottom = entered[None] * absorbed, entered * bottom
        return Solution(at + entered * out, at, entered * out, absorbed, bottom)


@partial(jax.jit, static_argnames=("kinds", "counts"))
def _solve_back(c: Coefficients, optics: Optics, which: Array, kinds, counts):
    """What comes back (w,), and its derivative by every coefficient of its own wavelength."""
    out, pull = jax.vjp(lambda c: _solve(c, optics, which, kinds, counts, False)[0], c)
    return out, pull(jnp.ones_like(out))[0]


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

    A layer that scatters nothing is solved as clear, unless one of the parameters that are `moving`
    would make it scatter.
    """
    w = layers.mu_a.shape[1]
    index, roughness = (
        _concrete("the indices", layers.index),
        _concrete("the roughness", layers.roughness),
    )
    kinds = ["clear"] * 6
    for i in (1, 2, 3):
        if _present(layers.mu_particle[i]) or f"melanosome_{LAYERS[i]}" in moving:
            kinds[i] = "scatter"
    if _present(layers.mu_fibre) or {"fibre_fraction", "fibre_radius"} & {*moving}:
        kinds[4] = "fibres"
    if _present(layers.mu_tissue[5]) or "reticular_scattering" in moving:
        kinds[5] = "scatter"
    theta_0 = _concrete("theta_0", layers.theta_0)
    angles, place = np.unique(theta_0, return_inverse=True)
    top = Streams.make((1.0, *index[:, 0]), order, parts).weight.size
    with _precision(dtype):
        chi = jnp.asarray(streams.exponential_moments(tuple(angles), 2 * top)[place], dtype)
        isotropic = jnp.zeros_like(chi).at[:, 0].set(1.0)

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
        with one_blas_thread():
            out, by = jax.block_until_ready(_solve_back(c, optics, which, kinds, counts))
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
    kinds = tuple("scatter" if _present(layers.mu_s[i]) else "clear" for i in range(m))
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
