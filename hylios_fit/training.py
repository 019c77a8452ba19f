"""Table -> surrogate: principal components, a regression by scikit-learn, an honest error."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hylios_fit.errors import HyliosError
from hylios_fit.simulation import with_covariance
from hylios_fit.skin import Specimen
from hylios_fit.statevector import state_vector
from hylios_fit.surrogate import (
    FLOOR,
    LEAST_INSIDE,
    Surrogate,
    assemble,
    check_report,
    features,
    load_surrogate,
    save,
)
from hylios_fit.table import open_table

COMPONENTS = 24
HIDDEN = (64, 64)
ENSEMBLE = 3
PENALTY = 0.003
LEAST_ROWS = 64  # of each form
CHECKS = 32  # fresh specimens of each form that measure the error
CHECK_RAYS = 131_072
MODES = 24


def train(
    table_path: str | Path,
    out_path: str | Path,
    seed: int = 0,
    checks: int = CHECKS,
    progress: bool = True,
) -> str:
    """Train on the table and write the surrogate; returns the report that `check` prints.

    Its error is measured on `checks` fresh specimens of each form, drawn from the prior of the
    fits and walked with many rays.
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
    nm = table["wavelength_nm"].values

    arrays: dict[str, np.ndarray] = {"wavelength_nm": nm, "lower": lower, "upper": upper}
    for i, form in enumerate(tqdm(forms, desc="train", unit="form", disable=not progress)):
        mine = done & (table["form"].values == i)
        if mine.sum() < LEAST_ROWS:
            raise HyliosError(
                f"{table_path} has {mine.sum()} finished rows of the form {form}, training needs "
                f"at least {LEAST_ROWS}: go on with `hylios-fit table --resume`"
            )
        x = np.asarray(features(names, jnp.asarray(table["design"].values[mine], jnp.float32)))
        share = np.clip((reflectance[mine] - surface) / (1.0 - surface), 0.0, None)
        fitted = _fit(x, np.log(share + FLOOR), seed)
        parts = {**fitted, "modes": np.zeros((1, nm.size)), "rest": np.zeros(nm.size)}
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
        "held_out": f"{checks} fresh specimens of each form, {CHECK_RAYS} rays each",
        "held_out_rms": {},
    }
    for form, found in _check(assemble(arrays, about), seed, checks, progress).items():
        arrays[f"{form}/modes"], arrays[f"{form}/rest"] = (
            part.astype(np.float32) for part in found[:2]
        )
        about["held_out_rms"][form] = [round(float(rms), 6) for rms in found[2]]
    path = save(out_path, arrays, about)
    return check_report(load_surrogate(path))


def fresh(
    surrogate: Surrogate, parameters: np.ndarray, form: str, key: jax.Array
) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance (w,) of one specimen by the walker, and the covariance (w, w) of its error."""
    names = surrogate.at(form).names
    specimen = Specimen(dict(zip(names, parameters.tolist(), strict=True)), form, "drawn")
    return with_covariance(
        specimen, surrogate.wavelength_nm, CHECK_RAYS, key, surrogate.incidence_deg
    )


def _check(
    surrogate: Surrogate, seed: int, checks: int, progress: bool
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """By form: modes and rest of the relative error, and its RMS in reflectance."""
    from tqdm import tqdm

    key = jax.random.fold_in(jax.random.key(seed), 1)
    member = surrogate.at(surrogate.forms[0])
    vector = state_vector(member.names, member.lower, member.upper)
    drawn = vector.prior_draws(key, checks)  # the same for each form
    found = {}
    with (
        tqdm(
            total=checks * len(surrogate.forms), desc="check", unit="specimen", disable=not progress
        ) as bar,
        ThreadPoolExecutor(2) as pool,
    ):
        for number, form in enumerate(surrogate.forms):
            member = surrogate.at(form)

            def one(i: int, form: str = form, number: int = number):
                own = jax.random.fold_in(jax.random.fold_in(key, i), number)
                return fresh(surrogate, drawn[i], form, own)

            relative, noise, absolute = [], [], []
            for i, (truth, covariance) in enumerate(pool.map(one, range(checks))):
                guess = np.asarray(member(jnp.asarray(drawn[i], jnp.float32)), float)
                inside = np.abs(guess - float(member.surface)) + LEAST_INSIDE
                relative.append((guess - truth) / inside)
                noise.append(covariance / np.outer(inside, inside))
                absolute.append((guess - truth) ** 2 - np.diag(covariance))
                bar.update()
            rms = np.sqrt(np.maximum(np.mean(absolute, axis=0), 1e-8))
            found[form] = (
                *_error(np.array(relative), np.mean(noise, axis=0), len(member.names)),
                rms,
            )
    return found


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


def _error(
    relative: np.ndarray, noise: np.ndarray, directions: int
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the relative error as `modes` (m, w) and a diagonal `rest` (w,).

    The differences (n, w) hold the Monte Carlo error of the checks themselves, whose covariance
    (w, w) is known and taken off. At least a tenth of the variance that was seen remains, because
    what is taken off is uncertain too. The inverse of a covariance from n specimens is too sure of
    itself by (n - 1)/(n - p - 2) (Hartlap et al. 2007, doi 10.1051/0004-6361:20066170), with p the
    `directions` that a fit can move in: the covariance is widened by that.
    """
    n = len(relative)
    second = relative.T @ relative / n
    size, vectors = np.linalg.eigh(second - noise)
    kept = np.argsort(size)[::-1][:MODES]
    modes = np.sqrt(np.maximum(size[kept], 0.0))[:, None] * vectors[:, kept].T
    own = np.maximum(np.diag(second - noise), 0.1 * np.diag(second))
    rest = np.maximum(own - np.sum(modes**2, axis=0), 0.02 * own)
    widening = (n - 1) / max(n - directions - 2, 1)
    return modes * np.sqrt(widening), rest * widening
