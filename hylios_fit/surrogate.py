"""The surrogate: parameters -> reflectance spectrum, in JAX, within the range it was trained on.

One `Member` for each melanosome form: standardised features, a small ensemble of perceptrons that
gives the scores of the principal components (trained by scikit-learn in `training`), and the way
back to reflectance. It knows its training box and the covariance of its own error, measured on
specimens that it never saw. Its file is a plain .npz without pickle.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from hylios_fit import datasets, melanosome
from hylios_fit.errors import HyliosError
from hylios_fit.skin import Specimen

FORMAT = "hylios_fit surrogate"
FORMAT_VERSION = 1
FLOOR = 0.02
"""Added to the subsurface reflectance before the logarithm: dark bands are not all noise."""

# Features: log(x + offset) of what may be 0, log of what may not, the rest as it is
OFFSETS = {
    "melanosome_granulosum": 0.3,
    "melanosome_spinosum": 0.3,
    "melanosome_basale": 0.3,
    "colloidal_melanin": 0.1,
    "eumelanin": 0.0,
    "pheomelanin": 0.0,
    "blood_papillary": 0.0,
    "blood_reticular": 0.0,
}
LEAST_INSIDE = 0.002  # reflectance, below which the relative error is not taken
SLACK = 1e-5  # of the box's width, for rounding


def features(names: tuple[str, ...], parameters: Float[Array, "... p"]) -> Float[Array, "... p"]:
    """What the regression sees, before standardising."""
    columns = []
    for i, name in enumerate(names):
        x = parameters[..., i]
        columns.append(jnp.log(x + OFFSETS[name]) if name in OFFSETS else x)
    return jnp.stack(columns, axis=-1)


class Member(eqx.Module):
    """The surrogate for one melanosome form, at its own wavelengths or at an instrument's bands.

    Call it with parameters (..., P) in the order of `names`: reflectance (..., B), specular
    included, at 8 degrees of incidence. Outside the box it returns NaN; `Surrogate` says why.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    form: str = eqx.field(static=True)
    lower: Float[Array, "p"]
    upper: Float[Array, "p"]
    centre: Float[Array, "p"]
    scale: Float[Array, "p"]
    weights: tuple[Float[Array, "e i o"], ...]
    biases: tuple[Float[Array, "e o"], ...]
    components: Float[Array, "k c"]
    mean: Float[Array, "c"]
    surface: Float[Array, ""]
    wavelength_nm: np.ndarray
    low: np.ndarray  # columns between which each band lies, and the share of the upper one
    high: np.ndarray
    part: Float[Array, "b"]
    modes: Float[Array, "m b"]  # relative error: modes.T @ modes + diag(rest)
    rest: Float[Array, "b"]

    def __call__(self, parameters: Float[Array, "... p"]) -> Float[Array, "... b"]:
        p = jnp.asarray(parameters, self.centre.dtype)
        like = (1,) * (p.ndim - 1) + (-1,)
        slack = SLACK * (self.upper - self.lower)
        inside = jnp.all(
            (p >= (self.lower - slack).reshape(like)) & (p <= (self.upper + slack).reshape(like)),
            axis=-1,
            keepdims=True,
        )
        bounded = jnp.clip(p, self.lower.reshape(like), self.upper.reshape(like))
        x = (features(self.names, bounded) - self.centre.reshape(like)) / self.scale.reshape(like)
        x = jnp.broadcast_to(x, (self.weights[0].shape[0], *x.shape))
        for i, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = jnp.einsum("e...i,eio->e...o", x, w)
            x = x + b.reshape(b.shape[0], *(1,) * (p.ndim - 1), b.shape[1])
            if i < len(self.weights) - 1:
                x = jnp.tanh(x)
        scores = jnp.mean(x, axis=0)
        log = scores @ self.components + self.mean.reshape(like)
        spectrum = self.surface + (1.0 - self.surface) * (jnp.exp(log) - FLOOR)
        part = self.part.reshape(like)
        below, above = (
            jnp.take(spectrum, at, axis=-1, mode="clip") for at in (self.low, self.high)
        )
        bands = (1.0 - part) * below + part * above
        return jnp.where(inside, bands, jnp.nan)

    # arrays have no hash, and jax.jit wants one of what it compiles
    __hash__ = object.__hash__
    __eq__ = object.__eq__

    def error_covariance(self, reflectance: np.ndarray) -> np.ndarray:
        """Covariance (B, B) of its own error at a reflectance (B,), specular included.

        The error was measured on specimens that training never saw, and is kept relative to the
        light that comes back from inside, with which it grows.
        """
        modes = np.asarray(self.modes, float)
        relative = modes.T @ modes + np.diag(np.asarray(self.rest, float))
        inside = np.abs(np.asarray(reflectance, float) - float(self.surface)) + LEAST_INSIDE
        return inside[:, None] * relative * inside

    def on(self, wavelength_nm: Any) -> Member:
        """This member at an instrument's bands: linear between its wavelengths, projected once."""
        bands = np.atleast_1d(np.asarray(wavelength_nm, float))
        grid = np.asarray(self.wavelength_nm)
        if bands.min() < grid[0] or bands.max() > grid[-1]:
            raise HyliosError(
                f"the surrogate covers {grid[0]:g} to {grid[-1]:g} nm, "
                f"asked for {bands.min():g} to {bands.max():g} nm"
            )
        low = np.clip(np.searchsorted(grid, bands, side="right") - 1, 0, len(grid) - 2)
        part = (bands - grid[low]) / (grid[low + 1] - grid[low])
        columns, place = np.unique(np.concatenate([low, low + 1]), return_inverse=True)
        if not np.array_equal(self.low, np.arange(len(grid))):
            raise HyliosError("project the surrogate itself, not one that is on bands already")
        dtype = self.mean.dtype
        rest = np.asarray(self.rest, float)
        modes = np.asarray(self.modes, float)
        return eqx.tree_at(
            lambda m: (
                m.components, m.mean, m.wavelength_nm, m.low, m.high, m.part, m.modes, m.rest
            ),
            self,
            (
                self.components[:, columns],
                self.mean[columns],
                bands,
                place[: len(bands)].astype(np.int32),
                place[len(bands) :].astype(np.int32),
                jnp.asarray(part, dtype),
                jnp.asarray((1 - part) * modes[:, low] + part * modes[:, low + 1], dtype),
                # not averaged down: neighbouring wavelengths err together
                jnp.asarray((1 - part) * rest[low] + part * rest[low + 1], dtype),
            ),
        )  # fmt: skip


class Surrogate(eqx.Module):
    """Both members. The last parameter is `melanosome_form`: 0 complex, 1 dispersed.

    Outside the training box a call raises `HyliosError` with names and ranges; under jit or vmap,
    where it cannot, it returns NaN.
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

    def __call__(self, parameters: Float[Array, "... q"]) -> Float[Array, "... w"]:
        p = jnp.asarray(parameters)
        if not isinstance(p, Tracer):
            self.check(np.asarray(parameters, float))
        form = p[..., -1:]
        first, second = (member(p[..., :-1]) for member in self.members.values())
        return jnp.where(form == 0, first, jnp.where(form == 1, second, jnp.nan))

    def check(self, parameters: np.ndarray) -> None:
        """Raise `HyliosError` naming every parameter outside the training range."""
        p = np.atleast_2d(parameters)
        if p.shape[-1] != len(self.names):
            raise HyliosError(
                f"expected {len(self.names)} parameters ({', '.join(self.names)}), "
                f"got {p.shape[-1]}"
            )
        member = self.at(self.forms[0])
        lower, upper = np.asarray(member.lower, float), np.asarray(member.upper, float)
        slack = SLACK * (upper - lower)
        wrong = []
        for i, name in enumerate(member.names):
            bad = ~((p[..., i] >= lower[i] - slack[i]) & (p[..., i] <= upper[i] + slack[i]))
            if bad.any():
                value = p[..., i][bad].flat[0]
                wrong.append(f"{name} = {value:g} (trained on {lower[i]:g} to {upper[i]:g})")
        if not np.isin(p[..., -1], range(len(self.forms))).all():
            wrong.append(
                "melanosome_form (0 complex, 1 dispersed; it was not trained on "
                f"{', '.join(f for f in melanosome.FORMS if f not in self.forms)})"
            )
        if wrong:
            raise HyliosError("outside the surrogate's training range: " + "; ".join(wrong))

    def of(self, specimen: Specimen, wavelength_nm: Any) -> np.ndarray:
        """Reflectance of a specimen at wavelengths, with a check that the surrogate knows it."""
        usual = Specimen().values
        unknown = [
            f"{name} = {value:g} (it knows {usual[name]:g})"
            for name, value in specimen.values.items()
            if name not in self.names and value != usual[name]
        ]
        if unknown:
            raise HyliosError("the surrogate was not trained on " + "; ".join(unknown))
        parameters = specimen.parameters(self.names)
        self.check(parameters)
        member = self.at(specimen.melanosome_form).on(wavelength_nm)
        return np.asarray(member(jnp.asarray(parameters[:-1], jnp.float32)), float)


# --- the file ---------------------------------------------------------------------------------


def save(path: str | Path, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> Path:
    """Write a surrogate file atomically; `about` is stored as JSON with a hash of the arrays."""
    path = Path(path)
    about = {**about, "format": FORMAT, "format_version": FORMAT_VERSION, "sha256": _hash(arrays)}
    buffer = io.BytesIO()
    content: dict[str, Any] = {
        "about": np.frombuffer(json.dumps(about).encode(), np.uint8),
        **arrays,
    }
    np.savez_compressed(buffer, **content)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_bytes(buffer.getvalue())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise HyliosError(f"cannot write the surrogate {path}: {error.strerror}") from error
    return path


def _hash(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def load_surrogate(path: str | Path | None = None) -> Surrogate:
    """The embedded surrogate, or the one in a file that `hylios-fit train` wrote."""
    if path is None:
        return _load(datasets.data_path("surrogate.npz"))
    return _load(Path(path))


@lru_cache(maxsize=4)
def _load_cached(path: Path, stamp: tuple[int, int]) -> Surrogate:
    try:
        # from memory: numpy leaves a damaged file open
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(arrays.pop("about").tobytes())
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise HyliosError(
            f"{path} is not a surrogate file, or is damaged or cut short ({error}): "
            "train it again with `hylios-fit train`"
        ) from error
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise HyliosError(f"{path} is an .npz file, but not a {FORMAT}")
    if about.get("format_version") != FORMAT_VERSION:
        raise HyliosError(
            f"{path} has version {about.get('format_version')} of the surrogate's format, this "
            f"hylios_fit reads version {FORMAT_VERSION}: train it again with `hylios-fit train`"
        )
    if about.get("sha256") != _hash(arrays):
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


def _member(form: str, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> Member:
    def get(name: str) -> Array:
        return jnp.asarray(arrays[f"{form}/{name}"], jnp.float32)

    depth = int(about["depth"])
    w = len(arrays["wavelength_nm"])
    everywhere = np.arange(w, dtype=np.int32)  # of one width, with and without JAX's x64
    return Member(
        names=tuple(about["names"]),
        form=form,
        lower=jnp.asarray(arrays["lower"], jnp.float32),
        upper=jnp.asarray(arrays["upper"], jnp.float32),
        centre=get("centre"),
        scale=get("scale"),
        weights=tuple(get(f"weight{i}") for i in range(depth)),
        biases=tuple(get(f"bias{i}") for i in range(depth)),
        components=get("components"),
        mean=get("mean"),
        surface=jnp.asarray(about["surface"], jnp.float32),
        wavelength_nm=arrays["wavelength_nm"].astype(float),
        low=everywhere,
        high=everywhere,
        part=jnp.zeros(w, jnp.float32),
        modes=get("modes"),
        rest=get("rest"),
    )


def check_report(surrogate: Surrogate) -> str:
    """What `hylios-fit check` prints: the training range and the held-out errors by wavelength."""
    about = surrogate.about
    member = surrogate.at(surrogate.forms[0])
    lines = [
        f"surrogate of {about['rows']} rows ({about['generator']}, {about['rays']} rays for every "
        f"{about['rows_sharing_paths']}), hylios_fit {about['hylios_fit']}, seed {about['seed']}",
        f"held out: {about['held_out']}",
        "",
        "trained on:",
    ]
    for name, low, high in zip(
        member.names, np.asarray(member.lower), np.asarray(member.upper), strict=True
    ):
        lines.append(f"  {name:24s} {low:8.3g} to {high:.3g}")
    lines.append(f"  {'melanosome_form':24s} {' or '.join(surrogate.forms)}")
    lines += ["", "held-out error in reflectance (RMS; Monte Carlo noise of the check taken off):"]
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
        lines.append(label + "".join(f"{v:12.4f}" for v in values))
    worst = max(bands)
    lines += ["", f"worst band:{worst[1].rstrip()} nm, {worst[0]:.4f}"]
    whole = [float(np.sqrt(np.mean(error[f] ** 2))) for f in surrogate.forms]
    lines.append("whole range           " + "".join(f"{v:12.4f}" for v in whole))
    return "\n".join(lines)
