"""What several experiments use: checkpoints of long runs, summaries, the look of figures."""

from __future__ import annotations

import ast
import functools
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import hylios_fit
from hylios_fit.checkpoints import Step
from hylios_fit.files import atomic_text
from hylios_fit.statevector import PRIORS
from hylios_fit.table import DESIGN

REPOSITORY = Path(__file__).resolve().parents[1]
CACHE = REPOSITORY / "build" / "experiments"
"""Checkpoints and downloads; git ignores `build`."""
WALK = ("absorbers", "counter", "fresnel", "melanosome", "scattering", "skin", "tally", "walker")
FITTING = ("instrument", "inversion", "spectra", "statevector", "surrogate")

PIGMENTS = tuple(axis for axis in DESIGN if PRIORS[axis.name].usual)
"""Axes of the design that a fit leaves free unless told otherwise."""
COLOURS = ("#1b6ca8", "#c8553d", "#3a7d44", "#7a4fa3", "#b58900", "#4d4d4d", "#d1495b", "#2a9d8f")
BANDS_NM: Mapping[str, tuple[float, float]] = {
    "250-400": (250.0, 400.0),
    "400-700": (400.0, 700.0),
    "700-1350": (700.0, 1350.0),
    "1350-2500": (1350.0, 2500.0),
}
"""Ranges of the summaries: from the first wavelength to below the second, the last to its end."""


@functools.cache  # as it was when the run began, whatever is edited meanwhile
def _syntax(module: str) -> bytes:
    """A module's syntax tree, so that comments and line breaks do not count."""
    source = Path(str(hylios_fit.__file__)).with_name(f"{module}.py")
    return ast.dump(ast.parse(source.read_text(encoding="utf-8"))).encode()


def checkpoint(name: str, modules: Iterable[str], **settings: Any) -> Path:
    """A folder for the parts of a long run, one for each set of settings and code.

    Parts that were written by another version of the `modules` of hylios_fit are not found again.
    """
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode())
    for module in sorted(modules):
        digest.update(_syntax(module))
    folder = CACHE / name / digest.hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def kept(folder: Path, name: str, make: Callable[[], Any]) -> Any:
    """A part of a long run from its file; made, and named on the terminal, if it is not there."""
    path = folder / f"{name}.json"
    if not path.exists():
        print(name, flush=True)
        save_json(path, make())
    return json.loads(path.read_text())


def kept_arrays(path: Path, make: Callable[[], Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Arrays by name from an .npz file; made if it is not there."""
    return Step(path).once(make)


def save_json(path: Path, content: Any) -> None:
    """Write a .json file whole or not at all."""
    with atomic_text(path) as file:
        json.dump(content, file)


def embedded_hash(size: str = "large") -> str | None:
    """Of the file of an embedded surrogate."""
    from hylios_fit.datasets import data_folder
    from hylios_fit.surrogate import EMBEDDED

    path = data_folder() / EMBEDDED[size]
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def surrogate_record(surrogate: Any) -> dict[str, Any]:
    """Which surrogate was used: the hash of the large embedded file, and its box."""
    member = surrogate.at(surrogate.forms[0])
    return {
        "class": type(surrogate).__name__,
        "sha256": embedded_hash(),
        "lower": dict(zip(member.names, np.asarray(member.lower, float).tolist(), strict=True)),
        "upper": dict(zip(member.names, np.asarray(member.upper, float).tolist(), strict=True)),
    }


def on_cpu() -> bool:
    """Whether JAX runs on the CPU, where the processor's time is what work costs."""
    import jax

    return jax.default_backend() == "cpu"


def band_masks(wavelength_nm: np.ndarray) -> dict[str, np.ndarray]:
    """Which bands lie in each range of `BANDS_NM`, for the ranges that have any."""
    nm = np.asarray(wavelength_nm, float)
    last = list(BANDS_NM)[-1]
    masks = {
        name: (nm >= low) & ((nm <= high) if name == last else (nm < high))
        for name, (low, high) in BANDS_NM.items()
    }
    return {name: mask for name, mask in masks.items() if mask.any()}


def quantiles(values: Any, digits: int = 4) -> dict[str, float]:
    """Count, mean and quantiles of the finite values."""
    finite = np.asarray(values, float)
    finite = finite[np.isfinite(finite)]
    found: dict[str, float] = {"n": int(finite.size)}
    if finite.size:
        found["mean"] = significant(finite.mean(), digits)
        for name, share in (("q05", 5), ("q25", 25), ("median", 50), ("q75", 75), ("q95", 95)):
            found[name] = significant(np.percentile(finite, share), digits)
    return found


def significant(value: Any, digits: int = 4) -> Any:
    """Rounded to significant digits, so that saved results stay small; arrays become lists."""
    array = np.asarray(value, float)
    if array.ndim:
        return [significant(item, digits) for item in array]
    return float(f"{float(array):.{digits}g}")


def figure(width: float, height: float) -> Any:
    """An empty figure that needs no display and leaves matplotlib's state as it is."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def tidy(axes: Any, x: str, y: str, title: str = "") -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if title:
        axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.25)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def logarithmic(axis: Any) -> None:
    """A log scale with plain numbers at 1, 2 and 5 of each decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    getattr(axis.axes, f"set_{axis.axis_name}scale")("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def save_figure(made: Any, path: Any) -> None:
    made.savefig(path, dpi=110, metadata={"Software": None})


def floats(values: Any) -> np.ndarray:
    """A list from JSON as an array, null as NaN."""
    return np.array([np.nan if v is None else v for v in values], dtype=float)
