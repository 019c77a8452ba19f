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

from experiments import _shared
from hylios_fit import fresnel, table, training
from hylios_fit.skin import Specimen
from hylios_fit.surrogate import FLOOR

ROWS = (256, 512, 1024)
STEPS = 40_000
FRESH = 64
FORM = "complex"
SEED = 20150413  # of the tables


def run(
    seed: int = 0,
    rows: tuple[int, ...] = ROWS,
    steps: int = STEPS,
    fresh: int = FRESH,
    folder: Any = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Two tables, made if they are not there, with the time that they took; and the error of what
    is learned from more and more of their rows, on specimens with every parameter free."""
    folder = Path(folder or _shared.CACHE)
    found: dict[str, Any] = {
        "rows": list(rows), "steps": steps, "fresh": fresh, "form": FORM,
        "cores": os.cpu_count(), "rays": table.RAYS, "share": table.SHARE, "generators": {},
    }  # fmt: skip
    box = {axis.name: (axis.lower, axis.upper) for axis in table.DESIGN} | training.FURTHER
    names, (lower, upper) = tuple(box), np.array(list(box.values())).T
    key = jax.random.fold_in(jax.random.key(seed), 300)
    given = training.fresh(names, lower, upper, fresh, key, names)
    lots = [given[i : i + training.TOGETHER] for i in range(0, fresh, training.TOGETHER)]
    truth = np.concatenate([training.solve(names, FORM, lot) for lot in lots])
    index = np.asarray(table.layers_of(names, FORM)(given).index[:, 0], float)
    surface = fresnel.surface_curve(float(np.radians(8.0)), Specimen().roughness)(index)
    for generator in table.GENERATORS:
        path, took = _table(folder, generator, max(rows), progress)
        whole = table.read_table(path)
        used = partial(_learned, whole, steps=steps, seed=seed)
        with training.quietly(), ThreadPoolExecutor(training.THREADS) as pool:
            learned = list(pool.map(used, rows))
        errors = []
        for answer in learned:
            light = np.exp(answer(names, given)) - FLOOR
            errors.append(float(np.sqrt(np.mean((surface + (1 - surface) * light - truth) ** 2))))
        noise = whole["standard_error"].values
        found["generators"][generator] = {
            "seconds": took,
            "rows_per_second": _shared.significant(max(rows) / took, 3),
            "hours_for_16384": _shared.significant(took / max(rows) * 16_384 / 3600, 3),
            "standard_error": _shared.quantiles(noise),
            "rms": _shared.significant(errors, 3),
        }
    return found


def _table(folder: Path, generator: str, rows: int, progress: bool) -> tuple[Path, float]:
    path, note = folder / f"small_{generator}.zarr", folder / f"small_{generator}.json"
    if not note.exists():
        start = time.perf_counter()
        table.generate(
            path, rows, seed=SEED, generator=generator, resume=path.exists(), progress=progress
        )
        note.write_text(json.dumps({"seconds": time.perf_counter() - start}))
    return path, json.loads(note.read_text())["seconds"]


def _learned(whole: Any, rows: int, steps: int, seed: int) -> Any:
    return training.learn_locally(whole.isel(row=slice(0, rows)), FORM, seed, steps=steps)


def draw(result: dict[str, Any], path: Any) -> None:
    """Error against rows."""
    figure = _shared.figure(6, 4.4)
    axes = figure.subplots()
    for (name, told), colour in zip(result["generators"].items(), _shared.COLOURS, strict=False):
        label = f"{name}: {told['rows_per_second']:g} rows a second"
        axes.plot(result["rows"], told["rms"], "o-", color=colour, label=label)
    noise = result["generators"]["walker"]["standard_error"]["median"]
    axes.axhline(noise, color=_shared.COLOURS[0], ls=":", label="median standard error of a walk")
    _shared.logarithmic(axes.xaxis)
    _shared.logarithmic(axes.yaxis)
    axes.legend(fontsize=8)
    _shared.tidy(axes, "rows of the table (both forms)", "RMS error on fresh specimens")
    _shared.save_figure(figure, path)
