"""Table -> surrogate: principal components, a regression by scikit-learn, an honest error."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hylios_fit.statevector import state_vector
from hylios_fit.surrogate import (
    FLOOR,
    Surrogate,
    assemble,
    check_report,
    features,
    load_surrogate,
    save,
)
from hylios_fit.table import add_rows, read_table

COMPONENTS = 32
HIDDEN = (128, 128)
EPOCHS = 3200  # over all rates
RATES = ((3e-3, 0.25), (1e-3, 0.25), (3e-4, 0.25), (1e-4, 0.125), (3e-5, 0.125))  # share of epochs
BATCH = 128
LEAST_ROWS = 64  # of each form
CHECKS = 256  # fresh specimens of each form that measure the error
MODES = 32
THREADS = 2


def train(
    table_path: str | Path,
    out_path: str | Path,
    seed: int = 0,
    checks: int = CHECKS,
    progress: bool = True,
) -> str:
    """Train on the table and write the surrogate; returns the report that `check` prints.

    Its error is measured on `checks` fresh specimens of each form, drawn from the prior of the
    fits and solved without noise by adding-doubling, whichever generator made the table.
    """
    from hylios_fit import __version__

    table = read_table(table_path, LEAST_ROWS)
    forms = tuple(str(table["form"].attrs["flag_meanings"]).split())
    names = tuple(str(name) for name in table["parameter"].values)
    surface = float(table.attrs["surface"])
    nm = table["wavelength_nm"].values
    arrays: dict[str, np.ndarray] = {
        "wavelength_nm": nm,
        "lower": table["lower"].values,
        "upper": table["upper"].values,
    }
    for form, fitted in _fits(table, names, forms, surface, seed, progress).items():
        parts = {**fitted, "modes": np.zeros((1, nm.size)), "rest": np.zeros(nm.size)}
        arrays.update({f"{form}/{name}": a.astype(np.float32) for name, a in parts.items()})

    about: dict[str, Any] = {
        "hylios_fit": __version__,
        "names": list(names),
        "forms": list(forms),
        "surface": surface,
        "incidence_deg": float(table.attrs["incidence_deg"]),
        "generator": table.attrs["generator"],
        "rows": int(table.sizes["row"]),
        "rays": int(table.attrs["rays"]),
        "rows_sharing_paths": int(table.attrs["rows_sharing_paths"]),
        "table_seed": int(table.attrs["seed"]),
        "seed": seed,
        "depth": len(HIDDEN) + 1,
        "held_out": f"{checks} fresh specimens of each form, by adding-doubling",
        "held_out_rms": {},
        "held_out_most": {},
    }
    found = _check(assemble(arrays, about), seed, checks, progress)
    for form, (modes, rest, error) in found.items():
        arrays[f"{form}/modes"] = modes.astype(np.float32)
        arrays[f"{form}/rest"] = rest.astype(np.float32)
        rms = np.sqrt(np.mean(error**2, axis=0))
        about["held_out_rms"][form] = [round(float(value), 6) for value in rms]
        about["held_out_most"][form] = round(float(np.quantile(np.abs(error), 0.999)), 6)
    path = save(out_path, arrays, about)
    return check_report(load_surrogate(path))


def fresh(parameters: np.ndarray, form: str) -> np.ndarray:
    """Reflectance (w,) of one specimen (P,), without noise."""
    return add_rows(parameters[None], form)[0][0]


def _check(
    surrogate: Surrogate, seed: int, checks: int, progress: bool
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """By form: modes and rest of the logarithm's error, and the error in reflectance (n, w)."""
    from tqdm import tqdm

    key = jax.random.fold_in(jax.random.key(seed), 1)
    member = surrogate.at(surrogate.forms[0])
    vector = state_vector(member.names, member.lower, member.upper)
    drawn = vector.prior_draws(key, checks)  # the same for each form
    found = {}
    total = checks * len(surrogate.forms)
    with (
        tqdm(total=total, desc="check", unit="specimen", disable=not progress) as bar,
        ThreadPoolExecutor(THREADS) as pool,
    ):
        for form in surrogate.forms:
            member = surrogate.at(form)
            truth = np.empty((checks, len(member.wavelength_nm)))
            for i, one in enumerate(pool.map(lambda row, form=form: fresh(row, form), drawn)):
                truth[i] = one
                bar.update()
            error = np.asarray(member(jnp.asarray(drawn, jnp.float32)), float) - truth
            scaled = error / member.error_scale(truth)
            found[form] = (*_error(scaled, len(member.names)), error)
    return found


def _fits(
    table: Any, names: tuple[str, ...], forms: tuple[str, ...], surface: float, seed: int,
    progress: bool,
) -> dict[str, dict[str, np.ndarray]]:  # fmt: skip
    """By form: every number of the fitted pipeline by name."""
    import warnings

    import scipy.linalg  # noqa: F401  # its own BLAS, to be limited too
    from sklearn.exceptions import ConvergenceWarning
    from threadpoolctl import threadpool_limits
    from tqdm import tqdm

    with (
        tqdm(
            total=len(forms) * len(RATES), desc="train", unit="stage", disable=not progress
        ) as bar,
        warnings.catch_warnings(),
        threadpool_limits(1),
        ThreadPoolExecutor(THREADS) as pool,
    ):
        warnings.simplefilter("ignore", ConvergenceWarning)  # the epochs are fixed beforehand

        def one(number: int) -> dict[str, np.ndarray]:
            mine = table["form"].values == number
            design = jnp.asarray(table["design"].values[mine], jnp.float32)
            share, noise = (
                table[name].values[mine].astype(float) / (1.0 - surface)
                for name in ("reflectance", "standard_error")
            )
            share = np.clip(share - surface / (1.0 - surface), 0.0, None)
            x = np.asarray(features(names, design), float)
            return _fit(x, np.log(share + FLOOR), noise / (share + FLOOR), seed, bar)

        return dict(zip(forms, pool.map(one, range(len(forms))), strict=True))


def _fit(
    x: np.ndarray, log: np.ndarray, noise: np.ndarray, seed: int, bar: Any
) -> dict[str, np.ndarray]:
    """Standardise, reduce, regress: features (n, f), and what they give with its noise (n, w)."""
    from sklearn.decomposition import PCA
    from sklearn.neural_network import MLPRegressor
    from sklearn.preprocessing import StandardScaler

    scaler: Any = StandardScaler().fit(x)
    pca: Any = PCA(min(COMPONENTS, len(x) // 4), random_state=seed).fit(log)
    scores = pca.transform(log)
    unit = scores[:, 0].std()  # one scale for all, so that what matters more weighs more
    # the most probable weights, where they have variance 1/width and each score this much noise
    variance = np.mean(np.sum(noise**2, axis=1)) / unit**2 / scores.shape[1]
    batch: Any = min(BATCH, len(x))
    network = MLPRegressor(
        hidden_layer_sizes=HIDDEN, activation="tanh", solver="adam", batch_size=batch,
        alpha=variance * max(HIDDEN) * batch / len(x),  # the penalty is added in every batch
        warm_start=True, tol=0.0, n_iter_no_change=EPOCHS, random_state=seed,
    )  # fmt: skip
    inputs = scaler.transform(x).astype(np.float32)
    targets = (scores / unit).astype(np.float32)
    for rate, share in RATES:
        network.set_params(learning_rate_init=rate, max_iter=max(round(share * EPOCHS), 1))
        network.fit(inputs, targets)
        bar.update()
    weights = [np.asarray(w, float) for w in network.coefs_]
    biases = [np.asarray(b, float) for b in network.intercepts_]
    weights[-1], biases[-1] = weights[-1] * unit, biases[-1] * unit
    return {
        "centre": scaler.mean_,
        "scale": scaler.scale_,
        "components": pca.components_,
        "mean": pca.mean_,
        **{f"weight{i}": w[None] for i, w in enumerate(weights)},
        **{f"bias{i}": b[None] for i, b in enumerate(biases)},
    }


def _error(error: np.ndarray, directions: int) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of errors (n, w) as `modes` (m, w) and a diagonal `rest` (w,).

    The inverse of a covariance from n specimens is too sure of itself by (n - 1)/(n - p - 2)
    (Hartlap et al. 2007, doi 10.1051/0004-6361:20066170), with p the `directions` that a fit can
    move in: the covariance is widened by that.
    """
    n = len(error)
    widening = (n - 1) / max(n - directions - 2, 1)
    second = error.T @ error / n * widening
    size, vectors = np.linalg.eigh(second)
    kept = np.argsort(size)[::-1][:MODES]
    modes = np.sqrt(np.maximum(size[kept], 0.0))[:, None] * vectors[:, kept].T
    own = np.diag(second)
    return modes, np.maximum(own - np.sum(modes**2, axis=0), 0.02 * own)
