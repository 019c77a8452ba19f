"""Table -> surrogate: principal components, a regression by scikit-learn, an honest error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from hylios_fit import surrogate as surrogate_module
from hylios_fit.errors import HyliosError
from hylios_fit.surrogate import FLOOR, features
from hylios_fit.table import PATH_AXES, open_table

COMPONENTS = 12
HIDDEN = (64, 64)
ENSEMBLE = 3
PENALTY = 0.003
HELD_OUT = 0.12
LEAST_ROWS = 64  # of each form
MODES = 12


def train(
    table_path: str | Path, out_path: str | Path, seed: int = 0, progress: bool = True
) -> str:
    """Train on the table and write the surrogate; returns the report that `check` prints.

    An eighth of the sets of paths of each form is never seen in training and measures the error.
    """
    from tqdm import tqdm

    from hylios_fit import __version__

    table = open_table(table_path).load()
    reflectance = table["reflectance"].values.astype(float)
    error = table["standard_error"].values.astype(float)
    done = np.isfinite(reflectance).all(axis=1) & np.isfinite(error).all(axis=1)
    forms = tuple(str(table["form"].attrs["flag_meanings"]).split())
    names = tuple(str(name) for name in table["parameter"].values)
    lower, upper = table["lower"].values, table["upper"].values
    if not (upper > lower).all():
        raise HyliosError(f"{table_path}: the range of {names[int(np.argmin(upper - lower))]} is 0")
    surface = float(table.attrs["surface"])

    arrays: dict[str, np.ndarray] = {
        "wavelength_nm": table["wavelength_nm"].values,
        "lower": lower,
        "upper": upper,
    }
    held_out_rows = 0
    for i, form in enumerate(tqdm(forms, unit="form", disable=not progress)):
        mine = done & (table["form"].values == i)
        if mine.sum() < LEAST_ROWS:
            raise HyliosError(
                f"{table_path} has {mine.sum()} finished rows of the form {form}, training needs "
                f"at least {LEAST_ROWS}: go on with `hylios-fit table --resume`"
            )
        x = np.asarray(features(names, jnp.asarray(table["design"].values[mine], jnp.float32)))
        share = np.clip((reflectance[mine] - surface) / (1.0 - surface), 0.0, None)
        # whole sets of paths are held out: rows that share paths share their noise
        _, group = np.unique(
            table["design"].values[mine][:, :PATH_AXES], axis=0, return_inverse=True
        )
        drawn = np.random.default_rng(seed).permutation(group.max() + 1)
        test = drawn[group] < HELD_OUT * (group.max() + 1)
        held_out_rows += int(test.sum())
        fitted = _fit(x[~test], np.log(share[~test] + FLOOR), seed)
        log = _predict(fitted, x[test])
        residual = surface + (1.0 - surface) * (np.exp(log) - FLOOR) - reflectance[mine][test]
        modes, rest = _error(residual, error[mine][test])
        parts = {**fitted, "modes": modes, "rest": rest}
        arrays.update({f"{form}/{name}": a.astype(np.float32) for name, a in parts.items()})

    about: dict[str, Any] = {
        "hylios_fit": __version__,
        "names": list(names),
        "forms": list(forms),
        "surface": surface,
        "incidence_deg": float(table.attrs["incidence_deg"]),
        "generator": table.attrs["generator"],
        "rows": int(done.sum()),
        "rays": int(table.attrs["rays"]),
        "rows_sharing_paths": int(table.attrs["rows_sharing_paths"]),
        "table_seed": int(table.attrs["seed"]),
        "seed": seed,
        "depth": len(HIDDEN) + 1,
        "held_out_rows": held_out_rows,
    }
    path = surrogate_module.save(out_path, arrays, about)
    return surrogate_module.check_report(surrogate_module.load_surrogate(path))


def _fit(x: np.ndarray, log: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Standardise, reduce, regress; every number of the fitted pipeline by name."""
    import warnings

    from sklearn.decomposition import PCA
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor
    from sklearn.preprocessing import StandardScaler
    from threadpoolctl import threadpool_limits

    scaler = StandardScaler().fit(x)
    pca = PCA(min(COMPONENTS, len(x) // 4), random_state=seed).fit(log)
    scores = pca.transform(log)
    unit = scores[:, 0].std()  # one scale for all, so that what matters more weighs more
    layers: list[list[Any]] = []
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore", ConvergenceWarning)  # the budget is the regularisation
        for number in range(ENSEMBLE):
            network = MLPRegressor(
                hidden_layer_sizes=HIDDEN, activation="tanh", solver="lbfgs", alpha=PENALTY,
                max_iter=4000, max_fun=80_000, tol=1e-6, random_state=seed + number,
            ).fit(scaler.transform(x), scores / unit)  # fmt: skip
            layers.append([*network.coefs_, *network.intercepts_])
    depth = len(HIDDEN) + 1
    stacked = [np.stack(arrays) for arrays in zip(*layers, strict=True)]
    stacked[depth - 1] = stacked[depth - 1] * unit
    stacked[-1] = stacked[-1] * unit
    found = {
        "centre": scaler.mean_,
        "scale": scaler.scale_,
        "components": pca.components_,
        "mean": pca.mean_,
        **{f"weight{i}": stacked[i] for i in range(depth)},
        **{f"bias{i}": stacked[depth + i] for i in range(depth)},
    }
    return {name: np.asarray(value, float) for name, value in found.items()}


def _predict(fitted: dict[str, np.ndarray], x: np.ndarray) -> np.ndarray:
    y = np.broadcast_to((x - fitted["centre"]) / fitted["scale"], (ENSEMBLE, *x.shape))
    depth = len(HIDDEN) + 1
    for i in range(depth):
        y = y @ fitted[f"weight{i}"] + fitted[f"bias{i}"][:, None]
        y = np.tanh(y) if i < depth - 1 else y
    return y.mean(axis=0) @ fitted["components"] + fitted["mean"]


def _error(residual: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the surrogate's error as `modes` (m, w) and a diagonal `rest` (w,).

    The residuals of held-out rows hold the Monte Carlo noise of the rows themselves, whose variance
    is known and taken off; at least a tenth of what was seen remains, because what is taken off is
    uncertain too.
    """
    seen = np.mean(residual**2, axis=0)
    own = np.maximum(seen - np.mean(noise**2, axis=0), 0.1 * seen)
    scaled = residual * np.sqrt(own / seen)
    _, singular, directions = np.linalg.svd(scaled / np.sqrt(len(scaled)), full_matrices=False)
    modes = singular[:MODES, None] * directions[:MODES]
    return modes, np.maximum(own - np.sum(modes**2, axis=0), 1e-10)
