"""Table -> surrogate: a local regression, principal components, a regression, an honest error.

A wavelength knows of a specimen only what its layers absorb and scatter there: some twenty numbers.
So the table is first learned as a function of those, all wavelengths of all rows together, which
makes millions of examples of it (`learn_locally`). That function then answers for as many more
specimens as the regression on the principal components (`fit`) needs, at the cost of a product of
matrices each, and for parameters that act through the layers alone whether or not the table has an
axis for them (`index_dispersion`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hylios_fit import fresnel
from hylios_fit.perceptron import STAGES, Perceptron
from hylios_fit.skin import LAYERS, Layers, Specimen
from hylios_fit.statevector import PRIORS, derived, state_vector
from hylios_fit.surrogate import (
    FLOOR,
    Surrogate,
    assemble,
    check_report,
    features,
    load_surrogate,
    save,
)
from hylios_fit.table import (
    USUAL,
    forms_of,
    layers_of,
    of_indices,
    read_table,
    solve_rows,
    spread,
    surface_share,
)
from hylios_fit.threads import one_blas_thread

FURTHER = {"index_dispersion": (-0.005, 0.035)}
"""Ranges of parameters that the table has no axis for and its indices cover."""
LOCAL_HIDDEN = (128, 128, 128)
LOCAL_STEPS = 40_000
LOCAL_BATCH = 2048
ALIKE = 100.0  # entries of a walked table whose noise is as good as one: they share paths
TRUST = 1e-3  # error of the logarithm that rows without noise are learned to, about
SPECIMENS = 131_072  # of each form, that the local regression answers for
COMPONENTS = 80
HIDDEN = (192, 128, 128)
STEPS = 80_000
BATCH = 2048
LEAST_ROWS = 64  # of each form
CHECK_ORDER = 8  # of the solver that they are held against
TOGETHER = 16  # of them have the same refractive indices
CHECKS = 256  # fresh specimens of each form that measure the error
MODES = 32
REGIONS = 12  # of the box, that `check` names
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
    fits, half with the usual parameters free and half with every one, and solved without noise by
    adding-doubling, whichever generator made the table.
    """
    from hylios_fit import __version__

    table = read_table(table_path, LEAST_ROWS)
    forms = tuple(forms_of(table))
    nm = table["wavelength_nm"].values
    names, lower, upper = box_of(table)
    curve = fresnel.surface_curve(
        float(np.radians(table.attrs["incidence_deg"])), Specimen().roughness
    )
    arrays: dict[str, np.ndarray] = {
        "wavelength_nm": nm,
        "lower": lower,
        "upper": upper,
        "fresnel": curve.convert(domain=(0.5, 2.5)).coef,
    }
    for form, fitted in _fits(table, forms, seed, progress).items():
        parts = {**fitted, "modes": np.zeros((1, nm.size)), "rest": np.zeros(nm.size)}
        arrays.update({f"{form}/{name}": a.astype(np.float32) for name, a in parts.items()})

    about: dict[str, Any] = {
        "hylios_fit": __version__,
        "names": list(names),
        "forms": list(forms),
        "incidence_deg": float(table.attrs["incidence_deg"]),
        "generator": table.attrs["generator"],
        "rows": int(table.sizes["row"]),
        "rays": int(table.attrs["rays"]),
        "rows_of_a_group": int(table.attrs["rows_of_a_group"]),
        "table_seed": int(table.attrs["seed"]),
        "seed": seed,
        "depth": len(HIDDEN) + 1,
        "held_out": f"{checks} fresh specimens of each form, by adding-doubling",
        "held_out_rms": {},
        "held_out_most": {},
        "regions": {},
    }
    found = _check(assemble(arrays, about), seed, checks, progress)
    for form, (modes, rest, error, drawn) in found.items():
        arrays[f"{form}/modes"] = modes.astype(np.float32)
        arrays[f"{form}/rest"] = rest.astype(np.float32)
        rms = np.sqrt(np.mean(error**2, axis=0))
        about["held_out_rms"][form] = [round(float(value), 6) for value in rms]
        about["held_out_most"][form] = round(float(np.quantile(np.abs(error), 0.999)), 6)
        about["regions"][form] = _regions(names, drawn, error)
    path = save(out_path, arrays, about)
    return check_report(load_surrogate(path))


def box_of(table: Any) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names (P) of all that can be learned from a table, and their ranges: lower, upper."""
    lower, upper = np.array(list(FURTHER.values())).T
    return (
        (*(str(name) for name in table["parameter"].values), *FURTHER),
        np.concatenate([table["lower"].values, lower]),
        np.concatenate([table["upper"].values, upper]),
    )


def fresh(
    names: tuple[str, ...], lower: Any, upper: Any, count: int, key: Array,
    free: tuple[str, ...] = ("usual",),
) -> np.ndarray:  # fmt: skip
    """(count, P) specimens of a box from the prior with these parameters free; `TOGETHER` in turn
    have the same refractive indices, so that they can be solved together."""
    drawn = state_vector(names, lower, upper, free).prior_draws(key, count)
    alike = of_indices(names)
    first = np.arange(count) // TOGETHER * TOGETHER
    drawn[:, alike] = drawn[first][:, alike]
    return drawn


def _check(
    surrogate: Surrogate, seed: int, checks: int, progress: bool
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """By form: modes and rest of the logarithm's error, the error in reflectance (n, w), and the
    specimens (n, P)."""
    from tqdm import tqdm

    key = jax.random.fold_in(jax.random.key(seed), 1)
    member = surrogate.at(surrogate.forms[0])
    box = member.names, member.lower, member.upper
    part = checks // 2  # the same for each form
    drawn = np.concatenate([fresh(*box, checks - part, key), fresh(*box, part, key, member.names)])
    found = {}
    total = checks * len(surrogate.forms)
    with tqdm(total=total, desc="check", unit="specimen", disable=not progress) as bar:
        for form in surrogate.forms:
            member = surrogate.at(form)
            truth = solved(member.names, form, drawn, bar)
            error = np.asarray(member(jnp.asarray(drawn, jnp.float32)), float) - truth
            scaled = error / member.error_scale(truth)
            found[form] = (*_error(scaled, len(PRIORS)), error, drawn)
    return found


def _regions(
    names: tuple[str, ...], drawn: np.ndarray, error: np.ndarray
) -> list[tuple[str, float, float]]:
    """(what of the box, RMS and largest error there), worst first: each third of the specimens by
    every parameter and every quantity that follows from them."""
    columns = dict(zip(names, drawn.T, strict=True)) | dict(derived(names, drawn))
    found = []
    for name, values in columns.items():
        low, high = np.quantile(values, [1 / 3, 2 / 3])
        thirds = {
            f"{name} below {low:.3g}": values < low,
            f"{name} {low:.3g} to {high:.3g}": (values >= low) & (values <= high),
            f"{name} above {high:.3g}": values > high,
        }
        for text, mine in thirds.items():
            if mine.any():
                rms = float(np.sqrt(np.mean(error[mine] ** 2)))
                found.append((text, round(rms, 6), round(float(np.abs(error[mine]).max()), 6)))
    return sorted(found, key=lambda row: -row[1])[:REGIONS]


def solved(names: tuple[str, ...], form: str, rows: np.ndarray, bar: Any) -> np.ndarray:
    """`solve` for `TOGETHER` rows at a time, side by side; `bar` counts them."""
    lots = [rows[i : i + TOGETHER] for i in range(0, len(rows), TOGETHER)]
    found = []
    with ThreadPoolExecutor(THREADS) as pool:
        for lot in pool.map(partial(solve, names, form), lots):
            found.append(lot)
            bar.update(len(lot))
    return np.concatenate(found)


def solve(names: tuple[str, ...], form: str, rows: np.ndarray) -> np.ndarray:
    """Reflectance (n, w) without noise, finer than the table's."""
    return solve_rows(names, rows, form, CHECK_ORDER)


# --- the local regression -----------------------------------------------------------------------


def local_features(layers: Layers) -> Float[Array, "w f"]:
    """What one wavelength knows of the layers: optical depths, hits, indices, and a rough guess."""
    depth = layers.thickness[:, None]
    absorbed = layers.mu_a * depth
    hits = layers.mu_particle[1:4] * depth[1:4]
    lost = 1.0 - layers.hit_albedo[1:4]
    fibre = layers.mu_fibre * depth[4]
    tissue = layers.mu_tissue[5] * depth[5]
    index = layers.index[jnp.array([0, 1, 4, 5])]
    steps = jnp.sqrt((index[1:] - index[:-1]) ** 2 + 1e-5)
    pigment = jnp.sum(absorbed[1:4] + hits * lost, axis=0)
    guess = _two_fluxes(layers)
    rows = [
        jnp.log(absorbed + 1e-3), jnp.sqrt(absorbed + 1e-4), jnp.log(hits + 0.05),
        jnp.log(lost + 1e-3), jnp.log(hits * lost + 1e-3), layers.theta_0[None],
        jnp.log(fibre + 0.02)[None], jnp.log(tissue + 0.1)[None], jnp.sqrt(tissue + 0.01)[None],
        layers.bottom * jnp.ones_like(tissue)[None], index, steps,
        jnp.log(pigment + 1e-3)[None], jnp.log(pigment + absorbed[0] + 1e-3)[None],
        jnp.log(absorbed[4] + absorbed[5] + 1e-3)[None], guess, jnp.log(guess[-1:] + 0.05),
    ]  # fmt: skip
    return jnp.concatenate(rows).T


def _two_fluxes(layers: Layers) -> Float[Array, "4 w"]:
    """Light that two fluxes (Kubelka and Munk 1931) get back from reticular dermis, papillary
    dermis and epidermis, each with all below, and out of the skin: right to some 10 %."""
    depth = layers.thickness[:, None]
    absorbed, hits = layers.mu_a * depth, layers.mu_particle * depth
    survives = layers.hit_albedo
    bend = 1.0 - jnp.exp(-3.0 * layers.theta_0**2)  # 1 - g of a hit
    fibre = 0.5 * (1.0 - jnp.exp(-1.5 * layers.mu_fibre * depth[4]))
    index = jnp.concatenate([jnp.ones_like(layers.index[:1]), layers.index])

    def slab(k, s):
        x = jnp.sqrt(k * (k + 2.0 * s) + 1e-6)
        fade = jnp.exp(-2.0 * x)
        sinh, cosh = 0.5 * (1.0 - fade) / x, 0.5 * (1.0 + fade)  # over x exp(x), over exp(x)
        whole = cosh + (k + s) * sinh
        return s * sinh / whole, jnp.exp(-x) / whole

    def interface(above, below):
        r = 1.5 * ((above - below) / (above + below)) ** 2
        up = jnp.where(below > above, 1.0 - (above / below) ** 2 * (1.0 - r), r)
        down = jnp.where(below > above, r, 1.0 - (below / above) ** 2 * (1.0 - r))
        return up, down

    light = layers.bottom * jnp.ones_like(bend)
    found = []
    for i in reversed(range(len(LAYERS))):
        fade = jnp.exp(-2.0 * absorbed[i])
        if i == 0:
            r, t = 0.0, fade
        elif i == 4:
            r, t = fibre * fade, (1.0 - fibre) * fade
        elif i == 5:
            r, t = slab(2.0 * absorbed[i], 0.75 * layers.mu_tissue[i] * depth[i])
        else:
            lost = absorbed[i] + hits[i] * (1.0 - survives[i])
            r, t = slab(2.0 * lost, 0.75 * hits[i] * survives[i] * bend)
        light = r + t**2 * light / (1.0 - r * light)
        if i in (1, 4, 5):
            found.append(light)
        up, down = interface(index[i], index[i + 1])
        out = (1.0 - up) * light / (1.0 - up * light)
        light = down + (1.0 - down) * out if i else out  # from outside, all has entered
    return jnp.stack([*found, light])


@lru_cache(maxsize=8)
def _inputs(names: tuple[str, ...], form: str) -> Callable[[Array], Float[Array, "n w f"]]:
    of = layers_of(names, form)
    return jax.jit(lambda rows: jax.vmap(local_features)(of(rows)))


def learn_locally(
    table: Any, form: str, seed: int = 0, bar: Any = None, steps: int | None = None
) -> Callable[[tuple[str, ...], np.ndarray], np.ndarray]:
    """The local regression of a table's rows (`read_table`) of one form.

    What it returns takes names (P) and parameters (n, P), and gives the logarithm (n, w) of the
    light from inside, plus `FLOOR`, as a share of what entered. `bar` counts the stages; `steps`
    of the optimiser, `LOCAL_STEPS` if None.
    """
    mine = table["form"].values == forms_of(table).index(form)
    axes = tuple(str(name) for name in table["parameter"].values)
    rows = table["design"].values[mine]
    at = surface_share(rows, axes)[:, None]
    share = np.clip((table["reflectance"].values[mine] - at) / (1.0 - at), 0.0, None) + FLOOR
    noise = (table["standard_error"].values[mine] / (1.0 - at) / share) ** 2
    log = np.log(share)
    x = np.concatenate([np.asarray(_inputs(axes, form)(lot)) for lot in _lots(rows)])
    x = x.reshape(-1, x.shape[-1])
    centre, scale = x.mean(axis=0), x.std(axis=0) + 1e-6
    middle, unit = float(log.mean()), float(log.std())
    y = ((log - middle) / unit).astype(np.float32).reshape(-1, 1)
    weight, variance = None, float(noise.mean()) / unit**2
    if table.attrs["generator"] == "walker":  # the errors of `adding` are no noise
        weight = (1.0 / (noise + TRUST**2)).reshape(-1)
        variance = ALIKE / float(weight.mean()) / unit**2
        weight /= weight.mean()
    x -= centre
    x /= scale
    steps = steps or LOCAL_STEPS
    network = Perceptron(
        LOCAL_HIDDEN, steps, LOCAL_BATCH, variance=variance, seed=seed, bar=bar
    ).fit(x, y, weight)

    def answer(x: Array) -> np.ndarray:
        found = network.predict((x.reshape(-1, x.shape[-1]) - centre[None]) / scale[None])
        return found.reshape(x.shape[:-1]) * unit + middle

    def every(names: tuple[str, ...], rows: np.ndarray) -> np.ndarray:
        of = _inputs(names, form)
        return np.concatenate([answer(of(lot)) for lot in _lots(rows)])

    return every


def _lots(rows: np.ndarray, size: int = 64) -> list[Array]:
    """Rows in lots of one size, but for the last: what they need stays small."""
    return [jnp.asarray(rows[i : i + size], jnp.float32) for i in range(0, len(rows), size)]


# --- the regression on principal components -----------------------------------------------------


def _fits(
    table: Any, forms: tuple[str, ...], seed: int, progress: bool
) -> dict[str, dict[str, np.ndarray]]:
    """By form: every number of the fitted pipeline by name."""
    from tqdm import tqdm

    names, asked = box_of(table)[0], specimens(table, seed)
    with (
        tqdm(
            total=2 * len(forms) * STAGES, desc="train", unit="stage", disable=not progress
        ) as bar,
        one_blas_thread(),
        ThreadPoolExecutor(THREADS) as pool,
    ):

        def one(form: str) -> dict[str, np.ndarray]:
            log = learn_locally(table, form, seed, bar)(names, asked)
            x = features(names, form, jnp.asarray(asked, jnp.float32))
            network = Perceptron(HIDDEN, STEPS, BATCH, seed=seed, bar=bar)
            return fit(np.asarray(x, float), log, network)

        return dict(zip(forms, pool.map(one, forms), strict=True))


def specimens(table: Any, seed: int, count: int | None = None) -> np.ndarray:
    """(count, P), by default `SPECIMENS`, that the second regression learns from: a tenth spread
    over the box as the table is, as many over the model as published, where the usual parameters
    alone move, and the rest from the prior: three tenths with the usual parameters free, half with
    all."""
    from scipy.stats import qmc

    names, lower, upper = box_of(table)
    spreads = dict(zip(table["parameter"].values, table["spread"].values, strict=True))
    count = count or SPECIMENS
    part = count // 10
    sobol = qmc.Sobol(len(names), rng=np.random.default_rng([seed, 2]))
    unit = sobol.random(1 << math.ceil(math.log2(2 * part)))[: 2 * part]
    columns = [
        spread(u, low, high, spreads.get(name, "linear"))
        for u, name, low, high in zip(unit.T, names, lower, upper, strict=True)
    ]
    over = np.stack(columns, axis=1)
    over[part:, USUAL:] = Specimen().parameters(names)[USUAL:]
    prior = [
        state_vector(names, lower, upper, free).prior_draws(
            jax.random.fold_in(jax.random.key(seed), 2 + number), drawn
        )
        for number, (free, drawn) in enumerate(((("usual",), 3 * part), (names, count - 5 * part)))
    ]
    return np.concatenate([over, *prior])


def fit(x: np.ndarray, log: np.ndarray, network: Any) -> dict[str, np.ndarray]:
    """Standardise, reduce, regress: features (n, f), and what they give (n, w).

    The network is a `Perceptron`, or another with `coefs_` and `intercepts_`, not fitted yet.
    Returns every number of what the surrogate evaluates, by name.
    """
    from sklearn.decomposition import PCA
    from sklearn.preprocessing import StandardScaler

    scaler: Any = StandardScaler().fit(x)
    # in single precision the components beyond 3e-4 of the first were noise, and cost 4e-4
    log = log.astype(float)
    pca: Any = PCA(min(COMPONENTS, len(x) // 4), random_state=0).fit(log)
    scores = pca.transform(log)
    unit = scores[:, 0].std()  # one scale for all, so that what matters more weighs more
    network.fit(scaler.transform(x), scores / unit)
    weights, biases = (
        [*parts[:-1], parts[-1] * unit] for parts in (network.coefs_, network.intercepts_)
    )
    return {
        "centre": scaler.mean_,
        "scale": scaler.scale_,
        "components": pca.components_,
        "mean": pca.mean_,
        **{f"weight{i}": w for i, w in enumerate(weights)},
        **{f"bias{i}": b for i, b in enumerate(biases)},
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
