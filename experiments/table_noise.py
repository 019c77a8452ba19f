"""What the walker's noise costs, and what a finer order and slopes give: the local regression from
tables by both generators, and with a few specimens solved more finely."""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import _fresh, _shared
from hylios_fit import table, training
from hylios_fit.threads import one_blas_thread

ROWS = (1024, 4096, 16_384)
STEPS = 20_000
FRESH = 128
STEEP = 24  # specimens whose slopes it is held against
FORM = "complex"
FINER = "adding, with a finer order and slopes"


def run(
    seed: int = 0,
    rows: tuple[int, ...] = ROWS,
    steps: int = STEPS,
    fresh: int = FRESH,
    steep: int = STEEP,
    folder: Any = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Two tables, made if they are not there, with the time that they took if in one go; and the
    error of what is learned from more and more of their rows: of the reflectance of specimens with
    every parameter free, and of slopes by the usual parameters where these are free."""
    folder = Path(folder or _shared.CACHE)
    found: dict[str, Any] = {
        "rows": list(rows), "steps": steps, "fresh": fresh, "form": FORM,
        "cores": os.cpu_count(), "rays": table.RAYS, "share": table.SHARE, "generators": {},
    }  # fmt: skip
    held: Any = None
    for generator in table.GENERATORS:
        whole, took = _table(folder, generator, max(rows), progress)
        names, lower, upper = training.box_of(whole)
        if held is None:
            key = jax.random.fold_in(jax.random.key(seed), 300)
            held = _fresh.specimens(whole, FORM, fresh, key, names, progress)
            key = jax.random.fold_in(key, 1)
            drawn = training.fresh(names, lower, upper, steep, key)
            true = training.solve_slopes(names, FORM, drawn)
        noise = whole["standard_error"].values[: max(rows)]
        taught: dict[str, Any] = {generator: None}
        if generator == "adding":  # what the walker teaches knows nothing of it
            asked = training.specimens(whole, seed)
            taught[FINER] = training.solve_finer(whole, FORM, asked, seed)
        for label, finer in taught.items():
            used = partial(_learned, whole, steps=steps, seed=seed, finer=finer)
            with one_blas_thread(), ThreadPoolExecutor(training.THREADS) as pool:
                learned = list(pool.map(used, rows))
            errors = [held.errors(local(names, held.rows)) for local in learned]
            found["generators"][label] = {
                **took,
                "standard_error": {
                    **_shared.quantiles(noise),
                    "largest": _shared.significant(noise.max()),
                },
                "rms": _shared.significant([np.sqrt(np.mean(e**2)) for e in errors], 3),
                "slopes": _shared.significant([_off(local, true) for local in learned], 3),
            }
    return found


def _off(local: Any, true: Any) -> float:
    """Error of the slopes over their size, root mean square, of all parameters."""
    square = []
    for name, exact in zip(true.by, np.moveaxis(true.slopes, 1, 0), strict=True):
        ways = np.zeros_like(true.rows)
        ways[:, true.names.index(name)] = 1.0
        log, change = local.along(true.names, true.rows, ways)
        entered = 1.0 - table.surface_share(true.rows, true.names)[:, None]
        square.append(np.mean((entered * np.exp(log) * change - exact) ** 2) / np.mean(exact**2))
    return float(np.sqrt(np.mean(square)))


def _table(
    folder: Path, generator: str, rows: int, progress: bool
) -> tuple[Any, dict[str, float | None]]:
    note = folder / f"{generator}.json"
    new, start = not (folder / f"{generator}.zarr").exists(), time.perf_counter()
    made = _fresh.training_table(generator, rows, folder, progress)
    if new:
        seconds = time.perf_counter() - start
        rate = _shared.significant(rows / seconds, 3)
        _shared.save_json(note, {"seconds": round(seconds, 1), "rows_per_second": rate})
    unknown: dict[str, float | None] = {"seconds": None, "rows_per_second": None}
    return made, json.loads(note.read_text()) if note.exists() else unknown


def _learned(whole: Any, rows: int, steps: int, seed: int, finer: Any) -> Any:
    some = whole.isel(row=slice(0, rows))
    return training.learn_locally(some, FORM, seed, steps=steps, finer=finer)


def draw(result: dict[str, Any], path: Any) -> None:
    """Errors against rows."""
    figure = _shared.figure(9, 4.4)
    left, right = figure.subplots(1, 2)
    for (name, told), colour in zip(result["generators"].items(), _shared.COLOURS, strict=False):
        rate = told["rows_per_second"]
        label = f"{name}: {rate:g} rows a second" if rate and name in table.GENERATORS else name
        left.plot(result["rows"], told["rms"], "o-", color=colour, label=label)
        percent = [100 * off for off in told["slopes"]]
        right.plot(result["rows"], percent, "o-", color=colour, label=name)
    noise = result["generators"]["walker"]["standard_error"]["median"]
    left.axhline(noise, color=_shared.COLOURS[0], ls=":", label="median standard error of a walk")
    for axes, title in ((left, "RMS error of the reflectance"), (right, "RMS error of slopes (%)")):
        _shared.logarithmic(axes.xaxis)
        _shared.logarithmic(axes.yaxis)
        _shared.tidy(axes, "rows of the table (both forms)", title)
    left.legend(fontsize=8)
    _shared.save_figure(figure, path)
