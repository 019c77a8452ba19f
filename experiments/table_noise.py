"""What the walker's noise costs: the local regression from tables by both generators."""

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
FORM = "complex"


def run(
    seed: int = 0,
    rows: tuple[int, ...] = ROWS,
    steps: int = STEPS,
    fresh: int = FRESH,
    folder: Any = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Two tables, made if they are not there, with the time that they took if in one go; and the
    error of what is learned from more and more of their rows, on specimens with every parameter
    free."""
    folder = Path(folder or _shared.CACHE)
    found: dict[str, Any] = {
        "rows": list(rows), "steps": steps, "fresh": fresh, "form": FORM,
        "cores": os.cpu_count(), "rays": table.RAYS, "share": table.SHARE, "generators": {},
    }  # fmt: skip
    held: Any = None
    for generator in table.GENERATORS:
        whole, took = _table(folder, generator, max(rows), progress)
        names = training.box_of(whole)[0]
        if held is None:
            key = jax.random.fold_in(jax.random.key(seed), 300)
            held = _fresh.specimens(whole, FORM, fresh, key, names, progress)
        used = partial(_learned, whole, steps=steps, seed=seed)
        with one_blas_thread(), ThreadPoolExecutor(training.THREADS) as pool:
            learned = list(pool.map(used, rows))
        errors = [held.errors(answer(names, held.rows)) for answer in learned]
        noise = whole["standard_error"].values[: max(rows)]
        found["generators"][generator] = {
            **took,
            "standard_error": {
                **_shared.quantiles(noise),
                "largest": _shared.significant(noise.max()),
            },
            "rms": _shared.significant([np.sqrt(np.mean(e**2)) for e in errors], 3),
        }
    return found


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
    unknown = {"seconds": None, "rows_per_second": None}
    return made, json.loads(note.read_text()) if note.exists() else unknown


def _learned(whole: Any, rows: int, steps: int, seed: int) -> Any:
    return training.learn_locally(whole.isel(row=slice(0, rows)), FORM, seed, steps=steps)


def draw(result: dict[str, Any], path: Any) -> None:
    """Error against rows."""
    figure = _shared.figure(6, 4.4)
    axes = figure.subplots()
    for (name, told), colour in zip(result["generators"].items(), _shared.COLOURS, strict=False):
        rate = told["rows_per_second"]
        label = f"{name}: {rate:g} rows a second" if rate else name
        axes.plot(result["rows"], told["rms"], "o-", color=colour, label=label)
    noise = result["generators"]["walker"]["standard_error"]["median"]
    axes.axhline(noise, color=_shared.COLOURS[0], ls=":", label="median standard error of a walk")
    _shared.logarithmic(axes.xaxis)
    _shared.logarithmic(axes.yaxis)
    axes.legend(fontsize=8)
    _shared.tidy(axes, "rows of the table (both forms)", "RMS error on fresh specimens")
    _shared.save_figure(figure, path)
