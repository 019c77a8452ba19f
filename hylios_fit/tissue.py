"""Plain plane layers with Henyey-Greenstein scattering, and their own fast walk.

What most published values are for. The conventions are those of MCML (Wang, Jacques and Zheng
1995): a collimated beam from above, smooth interfaces, unpolarised Fresnel reflection that takes
the whole ray or none of it. Light that the surface reflects at once is reckoned, not walked.

Three things make the walk fast, and none of them approximates:
- Plane layers under an azimuthally symmetric law need no azimuth and no position sideways when
  only totals are asked for: a ray is its depth and its cosine.
- Depth is counted in mean free paths, so that a flight crosses layers of one index unhindered.
- Rays are absorbed whole. A ray then has one of m + 2 ends, a lane keeps integer counts of them,
  energy is conserved to the last ray, and the errors are those of a multinomial draw.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Key

from hylios_fit import fresnel
from hylios_fit.counter import pcg4d
from hylios_fit.errors import HyliosError
from hylios_fit.threads import in_one_piece, side_by_side

_RANGES = {  # lower, upper, whether the ends belong, what it is called in an error
    "thickness": (0.0, math.inf, False, "above 0 cm"),
    "index": (1.0, math.inf, True, "1 or more"),
    "mu_a": (0.0, math.inf, True, "0 or more, 1/cm (less is an albedo above 1)"),
    "mu_s": (0.0, math.inf, True, "0 or more, 1/cm"),
    "g": (-1.0, 1.0, False, "between -1 and 1, both left out"),
}


@jax.tree_util.register_pytree_node_class
@dataclasses.dataclass(frozen=True, eq=False)
class Tissue:
    """Plane layers, top down, between two clear half-spaces; m layers.

    A number stands for every layer. Only the last layer may be infinitely thick: a half-space.
    Values that cannot be raise `HyliosError` with layer, name, value and range; inside a
    transformation of JAX there are no values to check, and only lengths are.

    thickness in cm; mu_a and mu_s in 1/cm; g is the mean cosine of the Henyey-Greenstein law;
    above and below are the refractive indices over and under the layers.
    """

    thickness: Float[Array, "m"]
    index: Float[Array, "m"]
    mu_a: Float[Array, "m"]
    mu_s: Float[Array, "m"]
    g: Float[Array, "m"]
    above: Float[Array, ""] = 1.0  # pyright: ignore[reportAssignmentType]
    below: Float[Array, ""] = 1.0  # pyright: ignore[reportAssignmentType]

    def __post_init__(self) -> None:
        found = {name: _array(name, getattr(self, name)) for name in _RANGES}
        lengths = {name: v.shape[0] for name, v in found.items() if v.ndim == 1}
        layers = next(iter(lengths.values()), 1)
        if set(lengths.values()) - {layers}:
            each = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise HyliosError(f"expected as many values of each as there are layers, got {each}")
        if layers == 0:
            raise HyliosError("expected at least one layer, got none")
        for name, value in found.items():
            if value.ndim == 0:
                value = value.repeat(layers)
            _check(name, value)
            object.__setattr__(self, name, value)
        for name in ("above", "below"):
            value = _array(name, getattr(self, name))
            if value.ndim:
                raise HyliosError(f"expected one index {name} the layers, got shape {value.shape}")
            if not isinstance(value, Tracer) and not 1.0 <= float(value) < math.inf:
                raise HyliosError(f"the index {name} the layers must be 1 or more, got {value:g}")
            object.__setattr__(self, name, value)

    def tree_flatten(self) -> tuple[tuple[Any, ...], None]:
        return tuple(getattr(self, field.name) for field in dataclasses.fields(self)), None

    @classmethod
    def tree_unflatten(cls, _: None, leaves: tuple[Any, ...]) -> Tissue:
        # checked when it was made; a transformation may put anything in the leaves
        made = object.__new__(cls)
        for field, leaf in zip(dataclasses.fields(cls), leaves, strict=True):
            object.__setattr__(made, field.name, leaf)
        return made


def _array(name: str, value: Any) -> Any:
    if isinstance(value, Tracer):
        return value
    try:
        value = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise HyliosError(f"{name} must be a number or one for each layer, got {value!r}") from None
    if value.ndim > 1:
        raise HyliosError(f"{name} must be a number or one for each layer, got {value.ndim} axes")
    return value


def _check(name: str, value: Any) -> None:
    if isinstance(value, Tracer):
        return
    lower, upper, closed, text = _RANGES[name]
    for layer, number in enumerate(value):
        inside = lower <= number < upper if closed else lower < number < upper
        half_space = name == "thickness" and layer == len(value) - 1 and number == math.inf
        if not (inside or half_space):
            finite = " and finite but in the last layer" if name == "thickness" else ""
            raise HyliosError(
                f"layer {layer + 1} of {len(value)}: {name} must be {text}{finite}, got {number:g}"
            )


class Totals(NamedTuple):
    """Where the light went: counts of rays, and what follows from them.

    `ends` counts the rays that entered by how they ended: out of the top, out of the bottom,
    absorbed in layer 1, 2, ... `specular` is the share of the light that never entered.
    `interactions` counts the times that a ray was scattered or absorbed.
    """

    specular: float
    ends: Int[np.ndarray, "m+2"]
    interactions: int

    @property
    def rays(self) -> int:
        """Rays that entered."""
        return int(self.ends.sum())

    @property
    def shares(self) -> Float[np.ndarray, "m+2"]:
        """Share of the incident light at each end; with `specular` they add up to 1."""
        return (1.0 - self.specular) * self.ends / max(self.rays, 1)

    @property
    def standard_errors(self) -> Float[np.ndarray, "m+2"]:
        """Standard error of each of `shares`."""
        # one ray more of each kind keeps the error of a rare end above 0
        p = (self.ends + 1.0) / (self.rays + 2.0)
        return (1.0 - self.specular) * np.sqrt(p * (1.0 - p) / max(self.rays, 1))

    @property
    def reflectance(self) -> float:
        """Diffuse reflectance: what entered and came back; the whole is `specular` more."""
        return float(self.shares[0])

    @property
    def reflectance_error(self) -> float:
        return float(self.standard_errors[0])

    @property
    def transmittance(self) -> float:
        return float(self.shares[1])

    @property
    def transmittance_error(self) -> float:
        return float(self.standard_errors[1])

    @property
    def absorbed(self) -> Float[np.ndarray, "m"]:
        """Share absorbed in each layer."""
        return self.shares[2:]

    @property
    def absorbed_error(self) -> Float[np.ndarray, "m"]:
        return self.standard_errors[2:]


def henyey_greenstein_density(cosine: Float[Array, "..."], g: Array) -> Float[Array, "..."]:
    """Density of the polar cosine on [-1, 1] (Henyey and Greenstein 1941)."""
    return 0.5 * (1.0 - g**2) / (1.0 + g**2 - 2.0 * g * cosine) ** 1.5


def henyey_greenstein_bend(xi: Float[Array, "..."], g: Array) -> Float[Array, "..."]:
    """1 - cosine drawn from the law by a uniform number in [0, 1].

    The usual inverse of the distribution, with the cancellations done by hand: it has no
    singularity at g = 0, and small angles keep their digits.
    """
    rest = 1.0 - xi
    a = 1.0 - g
    return 2.0 * a**2 * xi * (1.0 + g * rest) / (a + 2.0 * g * rest) ** 2


LANES = 512  # whose state stays near a core
ACCELERATOR_LANES = 1 << 19
LOT = 1024  # rays of a lane at most, so that no count comes near 32 bits; lots run side by side
ROUND = 64  # steps between two looks at how many rays are left
IDLE = -math.inf
SINE = [(-1) ** n * math.pi ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(6)]


class _Stack(NamedTuple):
    """Layers in the units of the walk; those of one index make a slab (s of them)."""

    start: Array  # cosine of a ray that has just entered
    edge: Array  # (m - 1,) depth of the layers' interfaces, in mean free paths
    albedo: Array  # (m,)
    g: Array  # (m,)
    slab_edge: Array  # (s + 1,)
    index: Array  # (s + 2,): above, the slabs, below


class _Lanes(NamedTuple):
    lane: Array  # number of the lane, which its random numbers go by
    left: Array  # rays that it has still to start
    depth: Array  # mean free paths; -1 - end where a ray has just ended; IDLE
    cosine: Array  # to the vertical, downwards positive
    slab: Array
    ends: tuple[Array, ...]
    interactions: Array


def _unit(word: Array, dtype: Any) -> Array:
    """A uniform number in (0, 1] from a word; only rounding reaches 1."""
    return word.astype(dtype) * dtype.type(2.0**-32) + dtype.type(2.0**-33)


def _cos_pi(x: Array) -> Array:
    """cos(pi x) for x in [0, 1]; jnp.cos alone would take more time than all the rest."""
    if x.dtype != jnp.float32:
        return jnp.cos(math.pi * x)
    y = x - 0.5  # -sin(pi y) by its series, right to float32
    y2 = y * y
    out = jnp.full_like(y, SINE[-1])
    for term in SINE[-2::-1]:
        out = out * y2 + term
    return -y * out


def _pick(table: Array, passed: list[Array]) -> Array:
    """The row of `table` after the last of the marks that was passed; a gather is slower."""
    out = jnp.broadcast_to(table[0], passed[0].shape) if passed else table[0]
    for row, mark in enumerate(passed):
        out = jnp.where(mark, table[row + 1], out)
    return out


def _step(s: _Lanes, stack: _Stack, step: Array, key: Array) -> _Lanes:
    """Every lane one flight on: to an interaction or to an interface between slabs."""
    dtype = s.depth.dtype
    words = pcg4d(s.lane, step, key)
    u1, u2, u3 = (_unit(word, dtype) for word in words[:3])
    slabs = stack.index.shape[0] - 2

    ended = s.depth < 0
    begins = ended & (s.left > 0)
    idle = ended & ~begins
    depth = jnp.where(begins, 0.0, s.depth)
    cosine = jnp.where(begins, stack.start, s.cosine)
    # one slab is most of what is asked for, and a fifth faster without keeping track of it
    slab = jnp.where(begins, 0, s.slab) if slabs > 1 else jnp.zeros_like(s.slab)

    depth = depth - jnp.log(u1) * cosine
    after = [slab > i for i in range(slabs - 1)]
    top, bottom = _pick(stack.slab_edge[:-1], after), _pick(stack.slab_edge[1:], after)
    up = (cosine < 0) & (depth <= top)
    down = (cosine > 0) & (depth >= bottom)
    meets = up | down

    # at an interface
    here = _pick(stack.index[1:-1], after)
    beyond = jnp.where(up, _pick(stack.index[:-2], after), _pick(stack.index[2:], after))
    incident = jnp.abs(cosine)
    passes = u2 > fresnel.reflectance(incident, here, beyond)
    refracted = fresnel.refracted_cosine(incident, here, beyond)
    leaving = jnp.where(passes, refracted, -incident)
    leaving = jnp.where(up, -leaving, leaving)
    out_top = up & passes & (slab == 0)
    out_bottom = down & passes & (slab == slabs - 1)
    next_slab = slab + jnp.where(meets & passes, jnp.where(up, -1, 1), 0)

    # inside: absorbed, or scattered with what the first test left of its random number
    passed = [depth >= stack.edge[i] for i in range(stack.edge.shape[0])]
    albedo, g = _pick(stack.albedo, passed), _pick(stack.g, passed)
    absorbed = ~meets & (u2 > albedo)
    bend = henyey_greenstein_bend(jnp.minimum(u2 / albedo, 1.0), g)
    across = jnp.sqrt(jnp.maximum((1.0 - cosine * cosine) * bend * (2.0 - bend), 0.0))
    turned = jnp.clip(cosine - cosine * bend + across * _cos_pi(u3), -1.0, 1.0)

    layer = _pick(jnp.arange(3, len(s.ends) + 1, dtype=dtype), passed)
    depth = jnp.where(meets, jnp.where(up, top, bottom), depth)
    depth = jnp.where(out_top, -1.0, jnp.where(out_bottom, -2.0, depth))
    depth = jnp.where(idle, IDLE, jnp.where(absorbed, -layer, depth))
    return _Lanes(
        lane=s.lane,
        left=s.left - begins.astype(jnp.int32),
        depth=depth,
        cosine=jnp.where(meets, leaving, turned),
        slab=next_slab if slabs > 1 else s.slab,
        ends=tuple(n + (depth == -1.0 - i).astype(jnp.int32) for i, n in enumerate(s.ends)),
        interactions=s.interactions + (~(meets | idle)).astype(jnp.uint32),
    )


def _share_out(s: _Lanes) -> _Lanes:
    """The rays that are left, spread evenly over the lanes, those without a ray first."""
    waits = s.depth < 0
    rank = jnp.where(waits, 0, jnp.sum(waits, dtype=jnp.int32)) - 1
    rank = rank + jnp.where(
        waits, jnp.cumsum(waits, dtype=jnp.int32), jnp.cumsum(~waits, dtype=jnp.int32)
    )
    total, lanes = jnp.sum(s.left, dtype=jnp.int32), s.left.shape[0]
    return s._replace(left=total // lanes + (rank < total % lanes).astype(jnp.int32))


# a fifth faster where there is AVX-512
@partial(
    jax.jit,
    static_argnames=("lanes",),
    compiler_options={"xla_cpu_prefer_vector_width": 512},
)
def _walk(stack: _Stack, key: Array, rays: Array, lanes: int) -> tuple[Array, Array]:
    dtype = stack.edge.dtype
    none = jnp.zeros(lanes, jnp.int32)
    ends = stack.albedo.shape[0] + 2
    state = _Lanes(
        lane=jnp.arange(lanes, dtype=jnp.uint32),
        left=none.at[0].set(rays),
        depth=jnp.full(lanes, IDLE, dtype),
        cosine=jnp.zeros(lanes, dtype),
        slab=none,
        ends=(none,) * ends,
        interactions=none.astype(jnp.uint32),
    )

    def round_(carry):
        def one(_, carry):
            step, s = carry
            return step + 1, _step(s, stack, step, key)

        step, s = carry
        steps = partial(jax.lax.fori_loop, 0, ROUND, one)
        return in_one_piece(steps, (step, _share_out(s)))

    def busy(s):
        return (s.depth >= 0) | (s.left > 0)

    carry, counted = (jnp.zeros((), jnp.uint32), state), []
    if lanes > LANES:  # the last rays would leave most lanes idle: so few go on in few
        # more than `LANES` at work, or rays left that more lanes than that could start
        step, wide = jax.lax.while_loop(
            lambda c: (
                jnp.sum(c[1].depth >= 0, dtype=jnp.int32) + jnp.sum(c[1].left, dtype=jnp.int32)
                > LANES
            ),
            round_,
            carry,
        )
        counted.append((jnp.stack(wide.ends), wide.interactions))
        chosen = jnp.argsort(~busy(wide))[:LANES]
        none = jnp.zeros(LANES, jnp.int32)
        few = jax.tree.map(lambda a: a[chosen], wide)._replace(
            left=none.at[0].set(jnp.sum(wide.left, dtype=jnp.int32)),
            ends=(none,) * ends,
            interactions=none.astype(jnp.uint32),
        )
        carry = step, few
    _, last = jax.lax.while_loop(lambda c: jnp.any(busy(c[1])), round_, carry)
    counted.append((jnp.stack(last.ends), last.interactions))
    how, interactions = zip(*counted, strict=True)
    return jnp.concatenate(how, axis=-1), jnp.concatenate(interactions)


def _stack(tissue: Tissue, incidence: float, dtype: Any) -> _Stack:
    mu_t = tissue.mu_a + tissue.mu_s
    clear = mu_t == 0
    depth = np.where(clear, 0.0, mu_t * np.where(clear, 1.0, tissue.thickness))
    edge = np.concatenate([[0.0], np.cumsum(depth)])
    new = np.diff(tissue.index) != 0  # a slab begins after these
    # nothing is under a half-space
    below = tissue.index[-1] if np.isinf(tissue.thickness[-1]) else tissue.below
    index = np.array([tissue.above, tissue.index[0], *tissue.index[1:][new], below])
    sine = math.sin(incidence) * float(tissue.above) / tissue.index[0]
    put = partial(jnp.asarray, dtype=dtype)
    return _Stack(
        start=put(np.sqrt(1.0 - sine**2)),
        edge=put(edge[1:-1]),
        albedo=put(np.where(clear, 1.0, tissue.mu_s / np.where(clear, 1.0, mu_t))),
        g=put(np.where(clear, 0.0, tissue.g)),
        slab_edge=put(np.concatenate([[0.0], edge[1:-1][new], edge[-1:]])),
        index=put(index),
    )


def walk(
    tissue: Tissue,
    key: Key[Array, ""],
    rays: int,
    *,
    incidence: float = 0.0,
    dtype: Any = jnp.float32,
    lanes: int | None = None,
) -> Totals:
    """Walk `rays` rays through plane layers.

    `incidence` is the angle of the beam to the normal over the layers, in radians. The same key,
    rays, dtype and lanes (rays that walk at once; by default as many as suit the device) give the
    same result. float32 places a ray to 1e-7 of the depth of the stack; layers far thinner than
    that share of it need float64. Raises `HyliosError` for what cannot be walked.
    """
    if isinstance(tissue.mu_a, Tracer):
        raise HyliosError("the walk of plane layers needs their values and cannot be transformed")
    if rays != int(rays) or not 1 <= rays < 2**31:
        raise HyliosError(
            f"rays must be a whole number from 1 to {2**31 - 1}, which a 32-bit counter holds, "
            f"got {rays}"
        )
    if lanes is not None and lanes < 1:
        raise HyliosError(f"lanes must be 1 or more, got {lanes}")
    if not 0.0 <= incidence < math.pi / 2:
        raise HyliosError(
            f"incidence must be 0 to below pi/2 (grazing) in radians, got {incidence:g}"
        )
    dtype = jnp.dtype(dtype)
    if dtype != jax.dtypes.canonicalize_dtype(dtype) or not jnp.issubdtype(dtype, jnp.floating):
        raise HyliosError(f"dtype must be float32, or float64 with jax_enable_x64, got {dtype}")
    if np.isinf(tissue.thickness[-1]) and tissue.mu_a[-1] == 0 < tissue.mu_s[-1]:
        raise HyliosError(
            f"layer {len(tissue.mu_a)}: a half-space that only scatters sends every ray back, but "
            "after a number of steps that has no mean: expected mu_a above 0 1/cm, got 0"
        )
    ends = len(tissue.mu_a) + 2
    n1, n2 = float(tissue.above), float(tissue.index[0])
    if math.sin(incidence) * n1 >= n2:  # total reflection: nothing enters
        return Totals(1.0, np.zeros(ends, np.int64), 0)
    with jax.enable_x64(True):
        specular = float(fresnel.reflectance(jnp.cos(incidence), jnp.asarray(n1), jnp.asarray(n2)))
    if lanes is None:
        lanes = LANES if jax.default_backend() == "cpu" else ACCELERATOR_LANES
    rays = int(rays)
    lots = -(-rays // (LOT * lanes))
    bits = jax.random.bits(key, (lots, 2), jnp.uint32)
    stack = _stack(tissue, incidence, dtype)

    def one(lot: int) -> tuple[Array, Array]:
        share = rays // lots + (lot < rays % lots)
        return _walk(stack, bits[lot], jnp.asarray(share, jnp.int32), lanes)

    counts = np.zeros(ends, np.int64)
    interactions = 0
    for ended, met in side_by_side(one, range(lots)):
        counts += np.asarray(ended).sum(axis=1, dtype=np.int64)
        interactions += int(np.asarray(met).sum(dtype=np.int64))
    return Totals(specular, counts, interactions)
