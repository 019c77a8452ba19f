"""Interactions a second and core of the walk in plain layers, beside scalar C, and their errors."""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from experiments import _shared
from hylios_fit import tissue
from hylios_fit.tissue import Tissue, Totals

# layers; published reflectance (specular included) and transmittance; rays of one timed run
CASES: dict[str, tuple[Tissue, tuple[float, float | None], int]] = {
    "slab": (Tissue(0.02, 1.0, [10.0], 90.0, 0.75), (0.09739, 0.66096), 16_000_000),
    "half-space": (Tissue(math.inf, 1.5, [10.0], 90.0, 0.0), (0.2600, None), 8_000_000),
    "two layers": (
        Tissue([0.01, 0.2], 1.4, [5.0, 0.5], [200.0, 150.0], 0.8),
        (0.4365, 0.1308),
        800_000,
    ),
}
SOURCES = {
    "slab": "van de Hulst 1980",
    "half-space": "Giovanelli 1955",
    "two layers": "adding-doubling",
}
C_SHARE = 8  # of the rays that the walk sends go through the C programs
REPEATS = 7
LANES = (128, 1024, 4096, 16384)
FEW = 100_000  # rays of the run that shows what the last ones cost


def run(seed: int = 0, repeats: int = REPEATS, thinner: int = 1) -> dict[str, Any]:
    """Medians of runs that take turns; `thinner` divides the rays of every run."""
    key = jax.random.key(seed)
    with tempfile.TemporaryDirectory() as folder:
        program = _compiled(Path(folder))
        cases = {}
        for number, name in enumerate(CASES):
            own = jax.random.fold_in(key, number)
            cases[name] = _case(name, own, repeats, thinner, program)
    return {
        "c_compiler": "none found: the C programs were left out" if program is None else _version(),
        "c_flags": "-O3 -march=native",
        "timed_by": "CPU seconds" if _shared.on_cpu() else "seconds",
        "repeats": repeats,
        "cases": cases,
        "changes": _changes(key, max(repeats // 2, 1), thinner),
    }


def _case(
    name: str, key: jax.Array, repeats: int, thinner: int, program: Path | None
) -> dict[str, Any]:
    layers, published, rays = CASES[name]
    rays = max(rays // thinner, 1)
    tissue._walk.clear_cache()
    first, _ = _timed(lambda: tissue.walk(layers, key, 1))
    found: dict[str, list[tuple[float, Any]]] = {"walk": [], "C mcml": [], "C reduced": []}
    for repeat in range(repeats):
        own = jax.random.fold_in(key, repeat)
        found["walk"].append(_timed(lambda own=own: tissue.walk(layers, own, rays)))
        for mode in ("mcml", "reduced") if program else ():
            seconds, *rest = _c_run(program, mode, layers, rays // C_SHARE + 1, repeat)
            found[f"C {mode}"].append((seconds, rest))
    walked = [totals for _, totals in found["walk"]]
    ends = np.sum([totals.ends for totals in walked], axis=0)
    whole = Totals(walked[0].specular, ends, sum(totals.interactions for totals in walked))
    methods = {"walk": _rates([s for s, _ in found["walk"]], whole)}
    for mode in ("C mcml", "C reduced"):
        if found[mode]:
            methods[mode] = _c_rates(found[mode], whole.specular, rays // C_SHARE + 1)
    z = {"reflectance": (whole.specular + whole.reflectance - published[0])}
    z["reflectance"] /= whole.reflectance_error
    if published[1] is not None:
        z["transmittance"] = (whole.transmittance - published[1]) / whole.transmittance_error
    return {
        "source": SOURCES[name],
        "published": published,
        "reflectance": whole.specular + whole.reflectance,
        "reflectance_error": whole.reflectance_error,
        "transmittance": whole.transmittance,
        "transmittance_error": whole.transmittance_error,
        "z": z,
        "rays_of_one_run": rays,
        "first_call_s": _shared.significant(first, 3),
        "methods": methods,
    }


def _rates(seconds: list[float], whole: Totals) -> dict[str, Any]:
    each = np.array(seconds)
    count = whole.interactions / len(each)
    rays = whole.rays / len(each)
    p = whole.ends[:2] / whole.rays
    return _record(each, count, rays, p * (1 - p) * (1 - whole.specular) ** 2)


def _c_rates(runs: list[tuple[float, Any]], specular: float, rays: int) -> dict[str, Any]:
    each = np.array([seconds for seconds, _ in runs])
    counts = np.array([rest[0] for _, rest in runs])
    moments = np.mean([rest[1:] for _, rest in runs], axis=0).reshape(-1, 2)[:2] / rays
    variance = (moments[:, 1] - moments[:, 0] ** 2) * (1 - specular) ** 2
    return _record(each, counts.mean(), rays, variance)


def _record(each: np.ndarray, count: float, rays: float, variance: np.ndarray) -> dict[str, Any]:
    seconds = np.median(each) / rays
    return {
        "interactions_per_s": _shared.significant(count / np.median(each)),
        "slowest_and_fastest": _shared.significant([count / each.max(), count / each.min()]),
        "interactions_per_ray": _shared.significant(count / rays),
        # of the reflectance and the transmittance, after one second and one interaction
        "error_after_a_second": _shared.significant(np.sqrt(variance * seconds)),
        "error_times_root_interactions": _shared.significant(np.sqrt(variance * count / rays)),
    }


def _changes(key: jax.Array, repeats: int, thinner: int) -> dict[str, float]:
    """Interactions a second in the two layers, with one thing done another way."""
    layers, _, rays = CASES["two layers"]
    rays = max(rays // thinner, 1)

    def rate(rays: int = rays, **options: Any) -> float:
        tissue._walk.clear_cache()
        tissue.walk(layers, key, 1, **options)
        runs = [
            _timed(lambda i=i: tissue.walk(layers, jax.random.fold_in(key, i), rays, **options))
            for i in range(repeats)
        ]
        return _shared.significant(np.median([totals.interactions / s for s, totals in runs]))

    def library(lane: Any, step: Any, words_key: Any) -> Any:
        own = jax.random.fold_in(jax.random.wrap_key_data(words_key), step)
        return list(jax.random.bits(own, (3, *lane.shape), jnp.uint32))

    def gathered(table: Any, passed: list[Any]) -> Any:
        return table[sum(mark.astype(jnp.int32) for mark in passed)] if passed else table[0]

    found = {"as it is": rate()}
    with _replaced("_cos_pi", lambda x: jnp.cos(np.float32(np.pi) * x)):
        found["jnp.cos"] = rate()
    with _replaced("pcg4d", library):
        found["jax.random"] = rate()
    with _replaced("_pick", gathered):
        found["gather"] = rate()
    for lanes in LANES:
        found[f"{lanes} lanes"] = rate(lanes=lanes)
    found[f"{FEW:,} rays"] = rate(min(FEW, rays))
    with _replaced("in_one_piece", lambda steps, given: steps(given)):
        found["in many pieces"] = rate()
    tissue._walk.clear_cache()
    return found


@contextmanager
def _replaced(name: str, by: Any) -> Iterator[None]:
    with mock.patch.object(tissue, name, by):
        yield


def _timed(work: Callable[[], Totals]) -> tuple[float, Totals]:
    """Seconds of all threads, which is a core's time however many there are, and the result."""
    clock = time.process_time if _shared.on_cpu() else time.perf_counter
    start = clock()
    found = work()
    return clock() - start, found


def _compiled(folder: Path) -> Path | None:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    program = folder / "tissue_speed"
    source = Path(__file__).with_suffix(".c")
    command = [compiler, "-O3", "-march=native", str(source), "-o", str(program), "-lm"]
    if subprocess.run(command, capture_output=True).returncode:
        return None
    return program


def _version() -> str:
    compiler = shutil.which("gcc") or "cc"
    said = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True)
    return said.stdout.splitlines()[0]


def _c_run(program: Path, mode: str, layers: Tissue, rays: int, seed: int) -> list[float]:
    """Seconds, interactions, and pairs of sum and sum of squares for each end."""
    rows = zip(layers.thickness, layers.index, layers.mu_a, layers.mu_s, layers.g, strict=True)
    numbers = [rays, seed, layers.above, layers.below, *(v for row in rows for v in row)]
    said = subprocess.run(
        [program, mode, *map(str, numbers)], capture_output=True, text=True, check=True
    )
    return [float(word) for word in said.stdout.split()]


def draw(result: dict[str, Any], path: Any) -> None:
    """Speed, error after a second, and what single changes do."""
    figure = _shared.figure(11.0, 4.0)
    speed, error, changes = figure.subplots(1, 3, width_ratios=(3, 3, 2.6))
    names = {
        "walk": "walk, JAX",
        "C reduced": "the same walk, scalar C",
        "C mcml": "MCML's steps, scalar C",
    }
    cases = list(result["cases"])
    for i, (method, label) in enumerate(names.items()):
        found = [result["cases"][case]["methods"].get(method) for case in cases]
        place = [c + 0.27 * (i - 1) for c, f in enumerate(found) if f]
        found = [f for f in found if f]
        if not found:
            continue
        rates = [f["interactions_per_s"] / 1e6 for f in found]
        bars = speed.bar(place, rates, 0.25, color=_shared.COLOURS[i], label=label)
        speed.bar_label(bars, [f"{rate:.0f}" for rate in rates], fontsize=8)
        error.plot(
            place, [f["error_after_a_second"][0] for f in found], "o",
            color=_shared.COLOURS[i], label=label,
        )  # fmt: skip
    for axes in (speed, error):
        axes.set_xticks(range(len(cases)), cases)
    speed.legend(fontsize=7.5)
    speed.margins(y=0.25)
    unit = "core and second" if result["timed_by"] == "CPU seconds" else "second"
    _shared.tidy(speed, "", f"million interactions per {unit}")
    _shared.logarithmic(error.yaxis)
    _shared.tidy(error, "", f"standard error of the reflectance after one {unit.split()[-1]}")
    rows = {name: rate / 1e6 for name, rate in result["changes"].items()}
    bars = changes.barh(list(rows), list(rows.values()), color=_shared.COLOURS[0])
    changes.bar_label(bars, [f"{rate:.0f}" for rate in rows.values()], fontsize=8)
    changes.invert_yaxis()
    changes.margins(x=0.15)
    changes.tick_params(axis="y", labelsize=7.5)
    _shared.tidy(changes, "million interactions", "", "two layers, one change each")
    _shared.save_figure(figure, path)
