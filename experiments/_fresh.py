"""Specimens that no regression has seen, solved: what regressions are held against."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from experiments import _shared
from hylios_fit import fresnel, table, training
from hylios_fit.skin import Specimen
from hylios_fit.surrogate import FLOOR

SEED = 0
"""Of the tables, as of the one that the embedded surrogates were trained on."""


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
    names, lower, upper = training.box_of(data)
    rows = training.fresh(names, lower, upper, count, key, free)
    index = np.asarray(table.layers_of(names, form)(rows).index[:, 0], float)
    curve = fresnel.surface_curve(float(np.radians(table.INCIDENCE_DEG)), Specimen().roughness)
    return Fresh(rows, solved(names, form, rows, progress), curve(index))


def solved(names: tuple[str, ...], form: str, rows: np.ndarray, progress: bool) -> np.ndarray:
    """(n, w) by adding-doubling."""
    from tqdm import tqdm

    with tqdm(total=len(rows), desc=form, unit="specimen", disable=not progress) as bar:
        return training.solved(names, form, rows, bar)


def training_table(generator: str, rows: int, folder: Any = None, progress: bool = True) -> Any:
    """A table of at least these rows; made, or made longer, if it is not there."""
    path = (folder or _shared.CACHE) / f"{generator}.zarr"
    data = table.read_table(path) if path.exists() else None
    if data is None or data.sizes["row"] < rows:
        table.generate(
            path, rows, seed=SEED, generator=generator, resume=path.exists(), progress=progress
        )
        data = table.read_table(path)
    return data
