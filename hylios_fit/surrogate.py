"""The surrogate: parameters -> reflectance spectrum, in JAX, within the range it was trained on.

One `Member` for each melanosome form: standardised features, a perceptron that gives the scores of
the principal components (trained by scikit-learn in `training`), the way back to reflectance, and
what the surface adds by Fresnel's equations. It knows its training box and the covariance of its
own error, measured on specimens that it never saw. Its file is a plain .npz without pickle.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from hylios_fit import datasets, melanosome, skin
from hylios_fit.errors import HyliosError
from hylios_fit.files import load_arrays, save_arrays
from hylios_fit.precision import product
from hylios_fit.skin import LAYERS, SPECS, STRATA, Specimen

FORMAT = "hylios_fit surrogate"
FORMAT_VERSION = 5
EMBEDDED = {"small": "surrogate_small.npz", "large": "surrogate.npz"}  # the cheapest first
FLOOR = 0.3
"""Added to the subsurface reflectance before the logarithm: errors are less than relative."""

# Features: log(x + offset) of what spans orders of magnitude, the rest as it is
OFFSETS = {
    **dict.fromkeys((f"melanosome_{stratum}" for stratum in STRATA), 0.3),
    "colloidal_melanin": 0.1,
    **dict.fromkeys(("eumelanin", "pheomelanin", "blood_papillary", "blood_reticular"), 0.0),
    **dict.fromkeys(("corneum_tail", "carboxyhaemoglobin", "methaemoglobin"), 1.0),
    **dict.fromkeys(("keratin", "dna", "sulfhaemoglobin", "beta_carotene"), 0.3),
    "bilirubin": 0.01,
    "reticular_scattering": 2.0,
    **dict.fromkeys((f"thickness_{layer}" for layer in LAYERS), 0.0),
}
FIRST = 0.002
"""Melanosomes (%) that free the light which total reflection keeps in an epidermis without any."""
FEATURES_NM = np.array(
    [255, 285, 320, 380, 415, 435, 460, 500, 545, 576, 600, 630, 760, 900, 1200, 1450, 1930, 2300.0]
)
"""Wavelengths at which the features hold how deep the layers are, optically."""
DETOUR = 1.64  # bounces inside melanosomes make light absorbed weakly that much longer
ACTIVATIONS = "silu", "squareplus", "tanh"  # of hidden units, functions of `jax.nn`
FAINT = 3e-3  # optical depth that is as good as none
SLACK = 1e-5  # of the box's width, for rounding
SAME_NM = 0.1  # between a band's wavelength and what a spectrum calls it
AGAIN = "project the surrogate itself, not one that is on bands already"
BLOCK = 4096  # rows of a batch of more than two blocks: what they need stays in the cache
VECTORS = {"xla_cpu_prefer_vector_width": 512}  # bits, where a core has them: XLA's own is 256


def features(
    names: tuple[str, ...], form: str, parameters: Float[Array, "... p"]
) -> Float[Array, "... f"]:
    """What the regression sees, before standardising: each parameter, whether there are any
    melanosomes, and the logarithms of the optical depth (absorption) of epidermis, papillary and
    reticular dermis at `FEATURES_NM`."""
    if parameters.ndim > 1:
        rows = parameters.reshape(-1, len(names))
        found = jax.vmap(lambda row: features(names, form, row))(rows)
        return found.reshape(*parameters.shape[:-1], -1)
    at = {name: parameters[i] for i, name in enumerate(names)}
    # all at once: one parameter at a time is as many small steps, which take longer than the rest
    offsets = np.array([OFFSETS.get(name, 1.0) for name in names], parameters.dtype)
    logged = np.array([name in OFFSETS for name in names])
    own = jnp.where(logged, jnp.log(parameters + offsets), parameters)
    contents = jnp.stack([x for name, x in at.items() if name.startswith("melanosome_")])
    v = {**Specimen().values, **at}
    v = {name: jnp.asarray(value, parameters.dtype) for name, value in v.items()}
    melanin = skin.melanin_coefficient(v, FEATURES_NM, parameters.dtype)
    mu_a = skin.absorption(v, FEATURES_NM, parameters.dtype)
    for layer in STRATA:
        scale = melanosome.SHRINKING[layer]
        attenuation = melanosome.attenuation_per_content(form, scale)
        lost = 1.0 - jnp.exp(-DETOUR / attenuation * melanin)  # at a hit, about; faster than expm1
        mu_a[layer] = mu_a[layer] + v[f"melanosome_{layer}"] / 100 * attenuation * lost
    depths = {layer: mu * v[f"thickness_{layer}"] for layer, mu in mu_a.items()}
    epidermis = sum(depths[layer] for layer in LAYERS[:4])
    logs = [jnp.log(depth + FAINT) for depth in (epidermis, *(depths[n] for n in LAYERS[4:]))]
    return jnp.concatenate([own, contents / (contents + FIRST), *logs])


class Member(eqx.Module):
    """The surrogate for one melanosome form, at its own wavelengths or at an instrument's bands.

    Call it with parameters (..., P) in the order of `names`: reflectance (..., B), specular
    included, at 8 degrees of incidence. Outside the box it returns NaN; `Surrogate` says why.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    form: str = eqx.field(static=True)
    projected: bool = eqx.field(static=True)  # on an instrument's bands
    activation: str = eqx.field(static=True)
    lower: Float[Array, "p"]
    upper: Float[Array, "p"]
    centre: Float[Array, "f"]
    scale: Float[Array, "f"]
    weights: tuple[Float[Array, "i o"], ...]
    biases: tuple[Float[Array, "o"], ...]
    components: Float[Array, "k c"] | None  # None: of few bands, part of the last weights
    mean: Float[Array, "c"]
    fresnel: Float[Array, "q"]  # what the surface reflects, a polynomial of the index above 1.5
    dispersion: Float[Array, "c"]  # what `index_dispersion` is multiplied by
    wavelength_nm: np.ndarray  # of the bands
    readout: Float[Array, "c b"] | None  # bands from the wavelengths; None: they are the bands
    modes: Float[Array, "m b"]  # of the logarithm's error: modes.T @ modes + diag(rest)
    rest: Float[Array, "b"]

    def __call__(self, parameters: Float[Array, "... p"]) -> Float[Array, "... b"]:
        """Compiled when first called with numbers; traced, it is part of what is traced."""
        if _traced(self, parameters):
            return self._evaluate(parameters)
        return _compiled(self)(_array(parameters, self.centre.dtype))

    def _evaluate(self, parameters: Float[Array, "... p"]) -> Float[Array, "... b"]:
        p = jnp.asarray(parameters, self.centre.dtype)
        like = (1,) * (p.ndim - 1) + (-1,)
        slack = SLACK * (self.upper - self.lower)
        inside = jnp.all(
            (p >= (self.lower - slack).reshape(like)) & (p <= (self.upper + slack).reshape(like)),
            axis=-1,
            keepdims=True,
        )
        bounded = jnp.clip(p, self.lower.reshape(like), self.upper.reshape(like))
        x = features(self.names, self.form, bounded)
        x = (x - self.centre.reshape(like)) / self.scale.reshape(like)
        for i, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = product(x, w) + b.reshape(like)
            if i < len(self.weights) - 1:
                x = getattr(jax.nn, self.activation)(x)
        if self.components is not None:
            x = product(x, self.components)
        log = x + self.mean.reshape(like)
        surface = self._surface(bounded)
        bands = self._read(surface + (1.0 - surface) * (jnp.exp(log) - FLOOR))
        return jnp.where(inside, bands, jnp.nan)

    def _read(self, columns: Float[Array, "... c"]) -> Float[Array, "... b"]:
        if self.readout is None:
            return columns
        return product(columns, self.readout)

    def surface_at(self, parameters: Any) -> Float[Array, "... b"]:
        """What the surface reflects at once: what an instrument with a gloss trap does not see."""
        return self._read(self._surface(jnp.asarray(parameters, self.centre.dtype)))

    def _surface(self, p: Float[Array, "... p"]) -> Float[Array, "... c"]:
        like = (1,) * (p.ndim - 1) + (-1,)
        corneum, dispersion = (
            p[..., self.names.index(name), None] for name in ("index_corneum", "index_dispersion")
        )
        above = corneum - 1.5 + dispersion * self.dispersion.reshape(like)
        found = self.fresnel[-1]
        for coefficient in self.fresnel[-2::-1]:
            found = found * above + coefficient
        return found

    @property
    def surface(self) -> Float[np.ndarray, "b"]:
        """`surface_at` the usual index of the corneum."""
        return _usual_surface(self)

    # arrays have no hash, and jax.jit wants one of what it compiles
    __hash__ = object.__hash__
    __eq__ = object.__eq__

    def error_covariance(self, reflectance: np.ndarray) -> np.ndarray:
        """Covariance (B, B) of its own error at a reflectance (B,), specular included.

        The error was measured on specimens that training never saw, and is kept in the logarithm
        that the regression was trained in.
        """
        modes = np.asarray(self.modes, float)
        logarithm = modes.T @ modes + np.diag(np.asarray(self.rest, float))
        scale = self.error_scale(reflectance)
        return scale[:, None] * logarithm * scale

    def error_scale(self, reflectance: np.ndarray) -> np.ndarray:
        """Change of the reflectance for one of the logarithm that the regression gives."""
        surface = self.surface
        inside = np.clip(np.asarray(reflectance, float) - surface, 0.0, None)
        return inside + (1.0 - surface) * FLOOR

    def on(self, wavelength_nm: Any, response: Any = None) -> Member:
        """This member at an instrument's bands, projected once so that nothing else is computed.

        Args:
            wavelength_nm: narrow bands (B,), nm, in any order: the reflectance there, linear
                between the surrogate's wavelengths. With `response`, where that was sampled.
            response: wide bands, (B, N) at N rising wavelengths: sensitivity times illuminant, in
                any unit, linear between its samples and 0 outside them. A band is the mean
                reflectance weighted by it: 1 for what reflects all light.

        On an instrument's bands already, it gives those of them that have these wavelengths.

        Raises:
            HyliosError: bands or responses outside the surrogate's wavelengths, or malformed; bands
                that it is not on.
        """
        grid = np.asarray(self.wavelength_nm)
        at = np.atleast_1d(np.asarray(wavelength_nm, float))
        if self.projected:
            if response is not None:
                raise HyliosError(AGAIN)
            return self._only(at)
        narrow = _linear(grid, at)
        if response is None:
            return self.onto(narrow, at)
        wide = np.atleast_2d(np.asarray(response, float))
        if wide.ndim != 2 or wide.shape[1] != at.size or at.size < 2 or (np.diff(at) <= 0).any():
            raise HyliosError(
                f"response: expected shape (bands, {at.size}) at rising wavelengths, "
                f"got {wide.shape} at {at.size} wavelengths"
            )
        # the product of two broken lines, by Simpson's rule between all their corners: exact
        corners = np.union1d(at, grid[(grid > at[0]) & (grid < at[-1])])
        fine = np.union1d(corners, 0.5 * (corners[1:] + corners[:-1]))
        simpson = np.zeros(fine.size)
        for first, factor in ((0, 1.0), (1, 4.0), (2, 1.0)):
            simpson[first : first + fine.size - 2 : 2] += factor * np.diff(corners) / 6.0
        sampled = np.stack([np.interp(fine, at, row) for row in wide])
        return self.onto(sampled * simpson @ _linear(grid, fine))

    def _only(self, wavelength_nm: np.ndarray) -> Member:
        own = np.asarray(self.wavelength_nm)
        near = np.abs(_wavelengths(wavelength_nm)[:, None] - own) <= SAME_NM
        if not (near.sum(axis=1) == 1).all():
            asked = wavelength_nm[near.sum(axis=1) != 1][0]
            bands = ", ".join(f"{nm:.1f}" for nm in own[:8]) + ", ..." * (len(own) > 8)
            raise HyliosError(
                f"the surrogate is on the bands {bands} nm: {asked:.1f} nm is none of them, or "
                f"more than one (to {SAME_NM:g} nm)"
            )
        which = near.argmax(axis=1)
        readout = np.eye(len(own)) if self.readout is None else np.asarray(self.readout)
        return dataclasses.replace(
            self,
            wavelength_nm=own[which],
            readout=jnp.asarray(readout[:, which], self.mean.dtype),
            modes=self.modes[:, which],
            rest=self.rest[which],
        )

    def onto(self, weights: Any, wavelength_nm: Any = None) -> Member:
        """This member at bands that are weighted means of its wavelengths.

        Args:
            weights: (B, W), not negative; each row is divided by its sum.
            wavelength_nm: what to call the bands, (B,); their centres of weight, if None.
        """
        grid = np.asarray(self.wavelength_nm)
        w = np.asarray(weights, float)
        if self.projected:
            raise HyliosError(AGAIN)
        if w.ndim != 2 or w.shape[1] != len(grid):
            raise HyliosError(f"weights: expected shape (bands, {len(grid)}), got {w.shape}")
        if not (np.isfinite(w).all() and (w >= 0).all() and (w.sum(axis=1) > 0).all()):
            raise HyliosError("weights: expected finite, none below 0, and one above 0 in each row")
        w = w / w.sum(axis=1, keepdims=True)
        used = np.flatnonzero(w.any(axis=0))
        readout = w[:, used].T
        dtype = self.mean.dtype
        assert self.components is not None
        components, weights_, biases = self.components[:, used], self.weights, self.biases
        wide, kept = weights_[-1].shape
        if wide * used.size <= (wide + used.size) * kept:  # one product is less work than two
            weights_ = (*weights_[:-1], _at_once(weights_[-1], components))
            biases = (*biases[:-1], _at_once(biases[-1], components))
            components = None
        # errors of the logarithm add up by what it was taken of
        share = w * np.exp(np.asarray(self.mean, float))
        share = (share / share.sum(axis=1, keepdims=True)).T
        return dataclasses.replace(
            self,
            projected=True,
            weights=weights_,
            biases=biases,
            components=components,
            mean=self.mean[used],
            dispersion=self.dispersion[used],
            wavelength_nm=w @ grid if wavelength_nm is None else np.asarray(wavelength_nm, float),
            readout=None
            if np.array_equal(readout, np.eye(len(used)))
            else jnp.asarray(readout, dtype),
            modes=jnp.asarray(np.asarray(self.modes, float) @ share, dtype),
            # not averaged down: neighbouring wavelengths err together
            rest=jnp.asarray(np.asarray(self.rest, float) @ share, dtype),
        )


class Surrogate(eqx.Module):
    """Both members. The last parameter is `melanosome_form`: 0 complex, 1 dispersed.

    A call with numbers compiles when the first of their shape come, and raises `HyliosError` with
    names and ranges outside the training box; under jit or vmap, where it cannot, it returns NaN.
    """

    members: dict[str, Member]
    about: dict[str, Any] = eqx.field(static=True)

    __hash__ = object.__hash__
    __eq__ = object.__eq__

    @property
    def forms(self) -> tuple[str, ...]:
        return tuple(self.members)

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.at(self.forms[0]).names, "melanosome_form")

    @property
    def wavelength_nm(self) -> np.ndarray:
        return np.asarray(self.at(self.forms[0]).wavelength_nm)

    @property
    def incidence_deg(self) -> float:
        return float(self.about["incidence_deg"])

    def at(self, form: str) -> Member:
        """The member for one melanosome form."""
        if form not in self.members:
            raise HyliosError(
                f"the surrogate knows the forms {', '.join(self.members)}, got {form!r}"
            )
        return self.members[form]

    def on(self, wavelength_nm: Any, response: Any = None) -> Surrogate:
        """This surrogate at an instrument's bands (see `Member.on`)."""
        on = {form: member.on(wavelength_nm, response) for form, member in self.members.items()}
        return Surrogate(on, self.about)

    def __call__(self, parameters: Float[Array, "... q"]) -> Float[Array, "... w"]:
        if _traced(self, parameters):
            return self._evaluate(parameters)
        ready = _ready(self)
        given = _array(parameters, ready.dtype)
        p = np.asarray(given)
        if p.shape[-1:] == (ready.count,):
            for least, most, one in ready.forms:
                if ((p >= least) & (p <= most)).all():  # of one form, as most are: half the work
                    return one(given)
        self.check(p)
        return ready.mixed(given)

    def _evaluate(self, parameters: Float[Array, "... q"]) -> Float[Array, "... w"]:
        p = jnp.asarray(parameters)
        form = p[..., -1:]
        found: Any = jnp.nan
        for name, member in self.members.items():
            found = jnp.where(form == _number(name), member(p[..., :-1]), found)
        return found

    def check(self, parameters: np.ndarray) -> None:
        """Raise `HyliosError` naming every parameter outside the training range."""
        p = np.asarray(parameters)
        if p.ndim == 0 or p.shape[-1] != len(self.names):
            raise HyliosError(
                f"expected {len(self.names)} parameters ({', '.join(self.names)}), "
                f"got {p.shape[-1] if p.ndim else 1}"
            )
        ready = _ready(self)
        p = np.atleast_2d(_array(p, ready.dtype))
        (least, most, _), *_ = ready.forms
        member = self.at(self.forms[0])
        wrong = []
        for i, (name, low, high) in enumerate(
            zip(member.names, np.asarray(member.lower), np.asarray(member.upper), strict=True)
        ):
            x = p[..., i]
            bad = ~((x >= least[i]) & (x <= most[i]))
            if bad.any():
                wrong.append(f"{name} = {x[bad].flat[0]:g} (trained on {low:g} to {high:g})")
        if not np.isin(p[..., -1], [_number(form) for form in self.forms]).all():
            known = ", ".join(f"{_number(form)} {form}" for form in self.forms)
            wrong.append(
                f"melanosome_form ({known}; it was not trained on "
                f"{', '.join(f for f in melanosome.FORMS if f not in self.forms)})"
            )
        if wrong:
            raise HyliosError("outside the surrogate's training range: " + "; ".join(wrong))

    def of(self, specimen: Specimen, wavelength_nm: Any) -> np.ndarray:
        """Reflectance of a specimen at wavelengths, with a check that the surrogate knows it."""
        usual = Specimen().values
        # fibres act by their number and their radius cubed (Eq. 7), of which the first is known
        thicker = (specimen.fibre_radius / usual["fibre_radius"]) ** 3
        if thicker != 1.0 and "fibre_fraction" in self.names:
            fraction = min(specimen.fibre_fraction * thicker, SPECS["fibre_fraction"].upper)
            specimen = specimen.replace(fibre_fraction=fraction, fibre_radius=usual["fibre_radius"])
        unknown = [
            f"{name} = {value:g} (it knows {usual[name]:g})"
            for name, value in specimen.values.items()
            if name not in self.names and value != usual[name]
        ]
        if unknown:
            raise HyliosError("the surrogate was not trained on " + "; ".join(unknown))
        parameters = specimen.parameters(self.names)
        self.check(parameters)
        member = self.at(specimen.melanosome_form)
        if member.projected:
            raise HyliosError("ask the surrogate itself, not one that is on bands already")
        bands = np.atleast_1d(np.asarray(wavelength_nm, float))
        weights = _linear(np.asarray(member.wavelength_nm), bands)
        # the whole spectrum, because that is compiled once for all bands
        return weights @ np.asarray(member(jnp.asarray(parameters[:-1], jnp.float32)), float)


def _at_once(a: Array, b: Array) -> Array:
    return jnp.asarray(np.asarray(a, float) @ np.asarray(b, float), a.dtype)


def _wavelengths(at: np.ndarray) -> np.ndarray:
    if at.ndim != 1 or not at.size or not np.isfinite(at).all():
        raise HyliosError(f"bands: expected a list of wavelengths in nm, got shape {at.shape}")
    return at


def _linear(grid: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(B, W): linear interpolation from the grid to each wavelength."""
    _wavelengths(at)
    if at.min() < grid[0] or at.max() > grid[-1]:
        raise HyliosError(
            f"the surrogate covers {grid[0]:g} to {grid[-1]:g} nm, "
            f"asked for {at.min():g} to {at.max():g} nm"
        )
    low = np.clip(np.searchsorted(grid, at, side="right") - 1, 0, len(grid) - 2)
    part = (at - grid[low]) / (grid[low + 1] - grid[low])
    weights = np.zeros((len(at), len(grid)))
    rows = np.arange(len(at))
    weights[rows, low] = 1.0 - part
    weights[rows, low + 1] = part
    return weights


def _number(form: str) -> int:
    """What stands for a form among parameters, also where it is the only one."""
    return melanosome.FORMS.index(form)


def _array(numbers: Any, dtype: Any) -> Any:
    return numbers if isinstance(numbers, Array) else np.asarray(numbers, dtype)


_ASKED: WeakKeyDictionary[Any, bool] = WeakKeyDictionary()


def _traced(module: Member | Surrogate, parameters: Any) -> bool:
    """Whether any of it is; of a module, which stays what it is, that is looked up once."""
    found = _ASKED.get(module)
    if found is None:
        found = _ASKED[module] = _holds_tracers(module)
    return found or _holds_tracers(parameters)


def _holds_tracers(tree: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


@lru_cache(maxsize=32)
def _compiled(member: Member) -> Callable[[Any], Array]:
    return _jitted(member._evaluate)


def _jitted(function: Callable[[Any], Array]) -> Callable[[Any], Array]:
    """Compiled for the widest vectors. Such a program is no part of another: where one is traced,
    it still answers with numbers."""
    on_cpu = jax.default_backend() == "cpu"

    @partial(jax.jit, compiler_options=VECTORS if on_cpu else None)
    def compiled(rows: Any) -> Array:
        if rows.ndim != 2 or len(rows) <= 2 * BLOCK:
            return function(rows)
        return jax.lax.map(function, rows, batch_size=BLOCK)

    def answer(rows: Any) -> Array:
        with jax.ensure_compile_time_eval():
            return compiled(rows)

    return answer


@lru_cache(maxsize=32)
def _usual_surface(member: Member) -> np.ndarray:
    """Worked out once: every fit asks for it."""
    return np.asarray(member.surface_at(Specimen().parameters(member.names)), float)


class _Ready(NamedTuple):
    """What each call of a surrogate would do again."""

    count: int  # of parameters
    dtype: Any
    forms: tuple[tuple[np.ndarray, np.ndarray, Callable[[Any], Array]], ...]  # box, compiled
    mixed: Callable[[Any], Array]


@lru_cache(maxsize=32)
def _ready(surrogate: Surrogate) -> _Ready:
    dtype, forms = surrogate.at(surrogate.forms[0]).centre.dtype, []
    for form, member in surrogate.members.items():
        lower, upper = np.asarray(member.lower, float), np.asarray(member.upper, float)
        slack = SLACK * (upper - lower)
        box = [np.append(x, _number(form)).astype(dtype) for x in (lower - slack, upper + slack)]
        forms.append((*box, _jitted(lambda p, m=member: m._evaluate(p[..., :-1]))))
    return _Ready(len(surrogate.names), dtype, tuple(forms), _jitted(surrogate._evaluate))


# --- the file ---------------------------------------------------------------------------------


def save(path: str | Path, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> Path:
    """Write a surrogate file atomically; `about` is stored as JSON with a hash of the arrays."""
    path = Path(path)
    about = {**about, "format": FORMAT, "format_version": FORMAT_VERSION, "sha256": digest(arrays)}
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    save_arrays(path, {"about": text, **arrays}, compress=True)
    return path


def digest(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 of arrays and their names."""
    found = hashlib.sha256()
    for name in sorted(arrays):
        found.update(name.encode())
        found.update(np.ascontiguousarray(arrays[name]).tobytes())
    return found.hexdigest()


def load_surrogate(path: str | Path | None = None, size: str = "large") -> Surrogate:
    """An embedded surrogate, or the one in a file that `hylios-fit train` wrote.

    `size` chooses among the embedded, without a path: the large one, or the small one, which errs
    more and in batches of few bands (`Surrogate.on`) is nearly three times as fast.
    """
    if path is not None:
        return _load(Path(path))
    if size not in EMBEDDED:
        raise HyliosError(f"size: expected one of {', '.join(EMBEDDED)}, got {size!r}")
    return _load(datasets.data_path(EMBEDDED[size]))


@lru_cache(maxsize=4)
def _load_cached(path: Path, stamp: tuple[int, int]) -> Surrogate:
    again = "train it again with `hylios-fit train`"
    try:
        arrays = load_arrays(path)
    except HyliosError as error:
        raise HyliosError(f"not a surrogate file, {again}: {error}") from error
    try:
        about = json.loads(arrays.pop("about").tobytes())
    except (ValueError, KeyError) as error:
        raise HyliosError(f"{path} is not a surrogate file ({error}): {again}") from error
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise HyliosError(f"{path} is an .npz file, but not a {FORMAT}")
    if about.get("format_version") != FORMAT_VERSION:
        raise HyliosError(
            f"{path} has version {about.get('format_version')} of the surrogate's format, this "
            f"hylios_fit reads version {FORMAT_VERSION}: {again}"
        )
    if _activation(about) not in ACTIVATIONS:
        raise HyliosError(
            f"{path}: the activation is one of {', '.join(ACTIVATIONS)}, got {_activation(about)!r}"
        )
    if about.get("sha256") != digest(arrays):
        raise HyliosError(f"{path} is damaged: its numbers do not match their hash")
    return assemble(arrays, about)


def assemble(arrays: dict[str, np.ndarray], about: dict[str, Any]) -> Surrogate:
    """A surrogate from what its file holds."""
    members = {form: _member(form, arrays, about) for form in about["forms"]}
    return Surrogate(members, _Frozen(about))


class _Frozen(dict):  # hashable, as a static field must be
    def __hash__(self) -> int:  # type: ignore[override]
        return hash(self.get("sha256"))


def _load(path: Path) -> Surrogate:
    try:
        stat = path.stat()
    except OSError as error:
        raise HyliosError(f"there is no surrogate at {path}: {error.strerror}") from error
    return _load_cached(path, (stat.st_mtime_ns, stat.st_size))


def _activation(about: dict[str, Any]) -> str:
    return about.get("activation", "tanh")  # files of before it was said


def _member(form: str, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> Member:
    def get(name: str) -> Array:
        return jnp.asarray(arrays[f"{form}/{name}"], jnp.float32)

    depth = int(about["depth"])
    return Member(
        names=tuple(about["names"]),
        form=form,
        projected=False,
        activation=_activation(about),
        lower=jnp.asarray(arrays["lower"], jnp.float32),
        upper=jnp.asarray(arrays["upper"], jnp.float32),
        centre=get("centre"),
        scale=get("scale"),
        weights=tuple(get(f"weight{i}") for i in range(depth)),
        biases=tuple(get(f"bias{i}") for i in range(depth)),
        components=get("components"),
        mean=get("mean"),
        fresnel=jnp.asarray(arrays["fresnel"], jnp.float32),
        dispersion=jnp.asarray(skin.dispersion(arrays["wavelength_nm"]), jnp.float32),
        wavelength_nm=arrays["wavelength_nm"].astype(float),
        readout=None,
        modes=get("modes"),
        rest=get("rest"),
    )


def check_report(surrogate: Surrogate) -> str:
    """What `hylios-fit check` prints: the training range and the held-out errors by wavelength."""
    about = surrogate.about
    member = surrogate.at(surrogate.forms[0])
    lines = [
        f"surrogate of {about['rows']} rows ({about['generator']}), "
        f"hylios_fit {about['hylios_fit']}, seed {about['seed']}",
        f"hidden units: {', '.join(str(w.shape[1]) for w in member.weights[:-1])}",
        f"held out: {about['held_out']}",
        "",
        "trained on:",
    ]
    for name, low, high in zip(
        member.names, np.asarray(member.lower), np.asarray(member.upper), strict=True
    ):
        lines.append(f"  {name:24s} {low:8.3g} to {high:.3g}")
    lines.append(f"  {'melanosome_form':24s} {' or '.join(surrogate.forms)}")
    lines += ["", "held-out error in reflectance (RMS):"]
    lines.append("  wavelength (nm)     " + "".join(f"{form:>12s}" for form in surrogate.forms))
    error = {f: np.asarray(about["held_out_rms"][f]) for f in surrogate.forms}
    grid = surrogate.wavelength_nm
    edges = [250, 300, 350, 400, 450, 500, 550, 600, 650, 700, 800, 900, 1000, 1100, 1200, 1300]
    edges += [1400, 1600, 1800, 2000, 2500]
    bands = []
    for low, high in itertools.pairwise(edges):
        use = (grid >= low) & (grid <= high)
        values = [float(np.sqrt(np.mean(error[f][use] ** 2))) for f in surrogate.forms]
        bands.append((max(values), f"  {low:5d} to {high:5d}      ", values))
    for _, label, values in bands:
        lines.append(label + "".join(f"{v:12.5f}" for v in values))
    worst = max(bands)
    lines += ["", f"worst band:{worst[1].rstrip()} nm, {worst[0]:.5f}"]
    whole = [float(np.sqrt(np.mean(error[f] ** 2))) for f in surrogate.forms]
    lines.append("whole range           " + "".join(f"{v:12.5f}" for v in whole))
    most = about["held_out_most"]
    lines.append("99.9 % of all within  " + "".join(f"{most[f]:12.4f}" for f in surrogate.forms))
    for form in surrogate.forms:
        lines += ["", f"by region of the box, {form}, worst first (RMS, largest):"]
        lines += [f"  {text:46s}{rms:9.5f}{top:9.4f}" for text, rms, top in about["regions"][form]]
    return "\n".join(lines)
