"""Specimens that no regression has seen, solved: what regressions are held against."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from experiments import _shared
from hylios_fit import fresnel, table, training
from hylios_fit.skin import Specimen
from hylios_fit.surrogate import FLOOR

SEED = 20150413
"""Of the tables, as of the one that the embedded surrogate was trained on."""
ROWS = 16_384


class Fresh(NamedTuple):
    """Specimens (n, P), their reflectance (n, w), and what of it the surface reflects."""

    rows: np.ndarray
    truth: np.ndarray
    surface: np.ndarray

    def errors(self, log: np.ndarray) -> np.ndarray:
        """Of reflectances from the logarithm that regressions are trained on, (n, w)."""
        return self.surface + (1.0 - self.surface) * (np.exp(log) - FLOOR) - self.truth


def specimens(
    data: Any, form: str, count: int, key: Any, free: tuple[str, ...], progress: bool = True
) -> Fresh:
    """Fresh specimens from the prior within a table's box."""
    box = training.box_of(data)
    names, (lower, upper) = tuple(box), np.array(list(box.values())).T
    rows = training.fresh(names, lower, upper, count, key, free)
    index = np.asarray(table.layers_of(names, form)(rows).index[:, 0], float)
    curve = fresnel.surface_curve(float(np.radians(table.INCIDENCE_DEG)), Specimen().roughness)
    return Fresh(rows, solved(names, form, rows, progress), curve(index))


def solved(names: tuple[str, ...], form: str, rows: np.ndarray, progress: bool) -> np.ndarray:
    """(n, w) by adding-doubling."""
    from tqdm import tqdm

    lots = [rows[i : i + training.TOGETHER] for i in range(0, len(rows), training.TOGETHER)]
    with ThreadPoolExecutor(training.THREADS) as pool:
        found = pool.map(partial(training.solve, names, form), lots)
        return np.concatenate(list(tqdm(found, total=len(lots), desc=form, disable=not progress)))


def training_table(generator: str, rows: int, folder: Any = None, progress: bool = True) -> Any:
    """A table of at least these rows; made, or made longer, if it is not there."""
    path = (folder or _shared.CACHE) / f"{generator}.zarr"
    if not path.exists() or table.read_table(path).sizes["row"] < rows:
        table.generate(
            path, rows, seed=SEED, generator=generator, resume=path.exists(), progress=progress
        )
    return table.read_table(path)
