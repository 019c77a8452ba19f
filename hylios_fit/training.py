"""Table -> surrogate: a local regression, principal components, a regression, an honest error.

A wavelength knows of a specimen only what its layers absorb and scatter there: some twenty numbers.
So the table is first learned as a function of those, all wavelengths of all rows together, which
makes millions of examples of it (`learn_locally`). Of a table by `adding` it learns more: slopes of
a few specimens, of which each tells as much as many rows, and what a finer order changes
(`solve_finer`). That function then answers for as many more specimens as the regression on the
principal components (`fit`) needs, with its slopes, at the cost of a product of matrices each, and
for parameters that act through the layers alone whether or not the table has an axis for them
(`index_dispersion`).
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hylios_fit import adding, fresnel, perceptron
from hylios_fit.checkpoints import Checkpoints, Step
from hylios_fit.errors import HyliosError
from hylios_fit.files import claimed
from hylios_fit.perceptron import STAGES, Perceptron
from hylios_fit.skin import Layers, Specimen
from hylios_fit.statevector import PRIORS, derived, state_vector
from hylios_fit.surrogate import (
    FLOOR,
    Surrogate,
    assemble,
    check_report,
    digest,
    features,
    load_surrogate,
    save,
)
from hylios_fit.table import (
    ADDING_ORDER,
    USUAL,
    WAVELENGTHS,
    bared,
    forms_of,
    layers_of,
    of_indices,
    read_table,
    solve_rows,
    spread,
    surface_share,
)
from hylios_fit.threads import one_blas_thread, side_by_side

FURTHER = {"index_dispersion": (-0.005, 0.035)}
"""Ranges of parameters that the table has no axis for and its indices cover."""
FIRST = 3e-3
"""Hits in a straight pass that free the light which total reflection keeps in a clear epidermis."""
LOCAL_HIDDEN = (256, 256, 256)
LOCAL_STEPS = 40_000
LOCAL_BATCH = 1024
ALIKE = 100.0  # entries of a walked table whose noise is as good as one: they share paths
TRUST = 1e-3  # error of the logarithm that rows without noise are learned to, about
FINE_ORDER = 12  # of usual slopes, and of what else is solved more finely
FINE = 256  # specimens of each form that are solved at both orders
ORDER_STEPS = 4000
NEAR = 8192  # specimens of each form, every parameter free, that add to the table's rows
STEEP = 256, 128  # specimens of each form whose slopes are solved: usual ones free, every one free
WAYS = 4, 8  # in which each of them is looked at
LEAST = {True: 0.025, False: 0.003}
"""By how much a step along a usual parameter, or another, changes the logarithm at least."""
LOOKED_AT = 384  # specimens that say how much it does
SPECIMENS = 131_072  # of each form, that the local regression answers for
COMPONENTS = 80
SIZES = {
    "large": ((256, 256, 192), 30_000, "silu"),
    "small": ((128, 96, 64), 60_000, "squareplus"),
}
"""Hidden units, steps and activation: whole spectra leave time for the first; few bands need the
second, where an exponential for each unit would count."""
BATCH = 1024
SEEN, EMPHASIS = (380.0, 720.0), 3.0  # nm; errors count so much more where the eye sees them
CORNERS = 0.25  # what a specimen from all over the box weighs: the hardest, and few fits are there
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
    size: str = "large",
) -> str:
    """Train on the table and write the surrogate; returns the report that `check` prints.

    `size` is one of `SIZES`: the small one errs twice as much, and is nearly three times as fast in
    batches of few bands.

    What is done stays in a folder beside the output, `OUT.training`, until all is: interrupted, the
    same call goes on there.

    Its error is measured on `checks` fresh specimens of each form, drawn from the prior of the
    fits, half with the usual parameters free and half with every one, and solved without noise by
    adding-doubling, whichever generator made the table.

    Raises:
        HyliosError: a table that cannot be learned from (`read_table`), a folder of another
            training, or one that cannot be written.
    """
    if size not in SIZES:
        raise HyliosError(f"size: expected one of {', '.join(SIZES)}, got {size!r}")
    table = read_table(table_path, LEAST_ROWS)
    steps = Checkpoints(f"{out_path}.training", _follows_from(table, seed, size))
    with claimed(steps.folder) as mine:
        if not mine:
            raise HyliosError(f"another process is training {out_path}: {steps.folder} is its")
        if progress and steps.begun():
            print(f"going on with {steps.folder}", file=sys.stderr)
        path = save(out_path, *_trained(table, seed, checks, progress, steps, size))
        steps.remove()
    return check_report(load_surrogate(path))


def _trained(
    table: Any, seed: int, checks: int, progress: bool, steps: Checkpoints, size: str
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What the file holds: its numbers, and what is said about them."""
    from hylios_fit import __version__

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
    for form, fitted in _fits(table, forms, seed, progress, steps, size).items():
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
        "size": size,
        "depth": len(SIZES[size][0]) + 1,
        "activation": SIZES[size][2],
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
    return arrays, about


def _follows_from(table: Any, seed: int, size: str) -> dict[str, Any]:
    """All that a training depends on: the table, seed and size, the version and its constants."""
    from hylios_fit import __version__

    columns = "design", "form", "reflectance", "standard_error", "lower", "upper"
    modules = {"perceptron": vars(perceptron), "training": globals()}
    return {
        "table": digest({name: table[name].values for name in columns}),
        "generator": table.attrs["generator"],
        "seed": seed,
        "size": SIZES[size],
        "hylios_fit": __version__,
        "constants": {
            f"{module}.{name}": repr(value)
            for module, names in modules.items()
            for name, value in names.items()
            if name.isupper() and name != "SIZES"
        },
    }


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
    for lot in side_by_side(partial(solve, names, form), lots):
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
        hits / (hits + FIRST),
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
    bend = 1.0 - jnp.exp(-3.0 * layers.theta_0**2)  # 1 - g of a hit
    index = jnp.concatenate([jnp.ones_like(layers.index[:1]), layers.index])

    k = 2.0 * (absorbed + hits * (1.0 - layers.hit_albedo))
    s = 0.75 * (hits * layers.hit_albedo * bend[None] + layers.mu_tissue * depth)
    x = jnp.sqrt(k * (k + 2.0 * s) + 1e-6)
    fade = jnp.exp(-2.0 * x)
    sinh, cosh = 0.5 * (1.0 - fade) / x, 0.5 * (1.0 + fade)  # over x exp(x), over exp(x)
    whole = cosh + (k + s) * sinh
    r, t = s * sinh / whole, jnp.exp(-x) / whole
    fibre = 0.5 * (1.0 - jnp.exp(-1.5 * layers.mu_fibre * depth[4]))
    through = jnp.exp(-k[4])
    r, t = r.at[4].set(fibre * through), t.at[4].set((1.0 - fibre) * through)

    above, below = index[:-1], index[1:]
    turned = 1.5 * ((above - below) / (above + below)) ** 2
    up = jnp.where(below > above, 1.0 - (above / below) ** 2 * (1.0 - turned), turned)
    down = jnp.where(below > above, turned, 1.0 - (below / above) ** 2 * (1.0 - turned))

    def layer(light: Array, own: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        r, t, up, down = own
        light = r + t**2 * light / (1.0 - r * light)
        out = (1.0 - up) * light / (1.0 - up * light)
        return down + (1.0 - down) * out, (light, out)

    light = layers.bottom * jnp.ones_like(bend)
    # in a loop, for as one expression it takes seconds to compile
    _, (inside, out) = jax.lax.scan(layer, light, (r, t, up, down), reverse=True)
    return jnp.concatenate([inside[jnp.array([5, 4, 1])], out[:1]])  # from outside, all has entered


@lru_cache(maxsize=8)
def _inputs(names: tuple[str, ...], form: str) -> Callable[[Array], Float[Array, "n w f"]]:
    of = layers_of(names, form)
    return jax.jit(lambda rows: jax.vmap(local_features)(of(rows)))


def _examples(names: tuple[str, ...], form: str, rows: np.ndarray) -> np.ndarray:
    """The inputs at every wavelength of rows (n, P), (n w, f)."""
    x = np.concatenate([np.asarray(_inputs(names, form)(lot)) for lot in _lots(rows)])
    return x.reshape(-1, x.shape[-1])


class Slopes(NamedTuple):
    """Specimens, and how their reflectance changes with some of the parameters."""

    names: tuple[str, ...]  # of the parameters (P)
    rows: Float[np.ndarray, "n P"]
    reflectance: Float[np.ndarray, "n w"]
    by: tuple[str, ...]  # the parameters (p) that it changes with
    slopes: Float[np.ndarray, "n p w"]


class Finer(NamedTuple):
    """What a finer order of the solver says beyond a table of the usual order."""

    names: tuple[str, ...]  # of the parameters (P)
    rows: Float[np.ndarray, "n P"]
    coarse: Float[np.ndarray, "n w"]  # reflectance as the table would have it
    fine: Float[np.ndarray, "n w"]
    near: tuple[Float[np.ndarray, "m P"], Float[np.ndarray, "m w"]]
    """Other specimens, from the prior, and their reflectance as the table would have it."""
    slopes: tuple[Slopes, ...]  # of others still


def solve_slopes(
    names: tuple[str, ...], form: str, rows: np.ndarray, bar: Any = None, every: bool = False,
    step: Step | None = None,
) -> Slopes:  # fmt: skip
    """By adding-doubling, for the usual parameters, or at a lower order for every one that it has a
    derivative in; `bar` counts `STAGES`, `step` keeps what is solved."""
    moving = ~of_indices(names) if every else [PRIORS[name].usual for name in names]
    by = tuple(itertools.compress(names, moving))
    order = CHECK_ORDER if every else FINE_ORDER

    def solve() -> dict[str, np.ndarray]:
        found = []
        for row in _in_stages(rows, bar):
            specimen = Specimen(dict(zip(names, row.tolist(), strict=True)), form)
            found.append(adding.slopes(specimen, WAVELENGTHS, by, order=order, dtype=np.float32))
        reflectance, slopes = (np.asarray(part, float) for part in zip(*found, strict=True))
        return {"reflectance": reflectance, "slopes": slopes}

    found = _once(step, solve, bar)
    return Slopes(names, rows, found["reflectance"], by, found["slopes"])


def solve_finer(
    table: Any, form: str, asked: np.ndarray, seed: int = 0, bar: Any = None,
    steps: Checkpoints | None = None,
) -> Finer:  # fmt: skip
    """Reflectances of `fresh` specimens, half with the usual parameters free and half with every
    one; those of more with every one, where the table's rows, spread over the box, lie far apart;
    and the slopes of some that are `asked`, with the usual ones free, and of others with every one.
    `bar` counts `STAGES` of each of the four, `steps` keep them.
    """

    def step(name: str) -> Step | None:
        return None if steps is None else steps.step(f"{form}-{name}")

    box = names, _, _ = box_of(table)
    key = jax.random.fold_in(jax.random.key(seed), 5)
    rows = np.concatenate([fresh(*box, FINE // 2, key), fresh(*box, FINE // 2, key, names)])

    def free(count: int, number: int) -> np.ndarray:
        drawn = fresh(*box, count, jax.random.fold_in(jax.random.key(seed), number), names)
        # a wavelength sees its own indices alone, whatever those of the others
        drawn[:, [names.index(name) for name in FURTHER]] = 0.0
        return drawn

    def solve(rows: np.ndarray, **orders: int) -> dict[str, np.ndarray]:
        lots = [rows[i : i + TOGETHER] for i in range(0, len(rows), TOGETHER)]
        found = [
            [solve_rows(names, lot, form, n) for n in orders.values()]
            for lot in _in_stages(lots, bar)
        ]
        parts = (np.concatenate(part) for part in zip(*found, strict=True))
        return dict(zip(orders, parts, strict=True))

    both = _once(step("order"), partial(solve, rows, coarse=ADDING_ORDER, fine=FINE_ORDER), bar)
    near = free(NEAR, 7)
    light = _once(step("near"), partial(solve, near, coarse=ADDING_ORDER), bar)["coarse"]
    usual, every = STEEP
    steep = free(every, 6)
    slopes = (
        solve_slopes(names, form, asked[_prior(len(asked)) :][:usual], bar, step=step("usual")),
        solve_slopes(names, form, steep, bar, every=True, step=step("every")),
    )
    return Finer(names, rows, both["coarse"], both["fine"], (near, light), slopes)


def _once(
    step: Step | None, make: Callable[[], dict[str, np.ndarray]], bar: Any
) -> dict[str, np.ndarray]:
    """What `make` gives, which counts `STAGES`, or has given before."""
    if step is None:
        return make()
    if bar is not None and step.path.exists():
        bar.update(STAGES)
    return step.once(make)


def _in_stages(items: Any, bar: Any) -> Iterator[Any]:
    for number, item in enumerate(items):
        yield item
        if bar is not None:
            bar.update((number + 1) * STAGES // len(items) - number * STAGES // len(items))


@dataclass(frozen=True, eq=False)  # known by identity: what is compiled for it is found again
class Local:
    """The local regression of one form: parameters -> the logarithm of the light from inside, plus
    `FLOOR`, as a share of what entered."""

    form: str
    network: Perceptron
    centre: Float[np.ndarray, "f"]
    scale: Float[np.ndarray, "f"]
    middle: float
    unit: float

    def __call__(self, names: tuple[str, ...], rows: np.ndarray) -> Float[np.ndarray, "n w"]:
        answer = _answer(self, names)
        return np.concatenate([answer(lot) for lot in _lots(rows)])

    def along(
        self, names: tuple[str, ...], rows: np.ndarray, ways: np.ndarray
    ) -> tuple[Float[np.ndarray, "n w"], Float[np.ndarray, "n w"]]:
        """What it says of rows (n, P), and how that changes along a way at each (n, P)."""
        return _changes(_answer(self, names), rows, ways)

    def slopes(self, names: tuple[str, ...], rows: np.ndarray) -> Float[np.ndarray, "n w P"]:
        """How what it says of rows (n, P) changes with every parameter."""
        function = _answer(self, names)
        every = jax.jit(jax.vmap(jax.jacfwd(lambda row: function(row[None])[0])))
        return np.concatenate([every(lot) for lot in _lots(rows, 2)])


@lru_cache(maxsize=4)
def _answer(local: Local, names: tuple[str, ...]) -> Callable[[Array], Float[Array, "n w"]]:
    of = _inputs(names, local.form)

    def answer(rows: Array) -> Array:
        x = (of(rows) - local.centre[None, None]) / local.scale[None, None]
        return local.network.answer(x)[..., 0] * local.unit + local.middle

    return jax.jit(answer)


def learn_locally(
    table: Any,
    form: str,
    seed: int = 0,
    bar: Any = None,
    steps: int | None = None,
    finer: Finer | None = None,
    step: Step | None = None,
) -> Local:
    """The local regression of a table's rows (`read_table`) of one form, and of what is `finer`.

    `bar` counts the stages, and `step` keeps them; `steps` of the optimiser, `LOCAL_STEPS` if None.
    """
    mine = table["form"].values == forms_of(table).index(form)
    axes = tuple(str(name) for name in table["parameter"].values)
    rows = table["design"].values[mine]
    share, log = _from_inside(axes, rows, table["reflectance"].values[mine])
    noise = (table["standard_error"].values[mine] / share) ** 2
    x = _examples(axes, form, rows)
    centre, scale = x.mean(axis=0), x.std(axis=0) + np.float32(1e-6)
    middle, unit = float(log.mean()), float(log.std())
    seen = emphasis(table["wavelength_nm"].values) ** 2
    seen /= seen.mean()
    weight, variance = np.ones_like(log), float(noise.mean()) / unit**2
    if table.attrs["generator"] == "walker":  # the errors of `adding` are no noise
        weight = 1.0 / (noise + TRUST**2)
        variance = ALIKE / float(weight.mean()) / unit**2
        weight /= weight.mean()
    weight = (weight * seen).reshape(-1)
    x, y, along = (x - centre) / scale, log.reshape(-1, 1), None
    if finer is not None:
        near, light = finer.near
        x = np.concatenate([x, (_examples(finer.names, form, near) - centre) / scale])
        y = np.concatenate([y, _from_inside(finer.names, near, light)[1].reshape(-1, 1)])
        y = y + _order(finer, form, centre, scale, seed)(x)
        generator = np.random.default_rng([seed, 3])
        lots = [
            _seen(slopes, form, unit, generator)
            for slopes, ways in zip(finer.slopes, WAYS, strict=True)
            for _ in range(ways)
        ]
        inputs, logs, *changes = (np.concatenate(part) for part in zip(*lots, strict=True))
        along = changes[0] / scale, changes[1] / unit
        x, y = np.concatenate([x, (inputs - centre) / scale]), np.concatenate([y, logs])
        weight = np.concatenate([weight, np.resize(seen, len(y) - len(weight))])  # by wavelength
    y = (y - middle) / unit
    network = Perceptron(
        LOCAL_HIDDEN, steps or LOCAL_STEPS, LOCAL_BATCH, variance=variance, seed=seed, bar=bar,
        step=step,
    ).fit(x, y, weight, along)  # fmt: skip
    return Local(form, network, centre, scale, middle, unit)


def _from_inside(
    names: tuple[str, ...], rows: np.ndarray, reflectance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Change of the reflectance for one of the logarithm that is learned, and that logarithm."""
    entered = 1.0 - surface_share(rows, names)[:, None]
    share = np.clip((reflectance - 1.0) / entered + 1.0, 0.0, None) + FLOOR
    return entered * share, np.log(share)


def _order(
    finer: Finer, form: str, centre: np.ndarray, scale: np.ndarray, seed: int
) -> Callable[[np.ndarray], np.ndarray]:
    """What the finer order adds to the logarithm (n, 1), from standardised inputs (n, f)."""
    # what dispersion does to the surface is left out of both, and cancels
    coarse, fine = (
        _from_inside(finer.names, finer.rows, part)[1] for part in (finer.coarse, finer.fine)
    )
    x = (_examples(finer.names, form, finer.rows) - centre) / scale
    more = (fine - coarse).reshape(-1, 1)
    unit = float(more.std()) or 1.0
    network = Perceptron((32, 32), ORDER_STEPS, LOCAL_BATCH, seed=seed).fit(x, more / unit)
    return lambda x: network.predict(x) * unit


def _seen(
    slopes: Slopes, form: str, size: float, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Inputs of the local regression (n w, f), the logarithm (n w, 1), and how both change along
    some way at each specimen."""
    names, rows = slopes.names, slopes.rows
    share, log = _from_inside(names, rows, slopes.reflectance)
    of_log = slopes.slopes / share[:, None]
    place = [names.index(name) for name in slopes.by]
    ways = np.zeros_like(rows)
    # each parameter changes the logarithm as much
    sizes = np.sqrt(len(place) * np.mean(of_log**2, axis=(0, 2)))
    ways[:, place] = _ways(rows[:, place], size / sizes, generator)
    inputs, change = _changes(_inputs(names, form), rows, ways)
    steep = np.einsum("np,npw->nw", ways[:, place], of_log)
    wide = (-1, inputs.shape[-1])
    return inputs.reshape(wide), log.reshape(-1, 1), change.reshape(wide), steep.reshape(-1, 1)


def _ways(rows: np.ndarray, lengths: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Directions (n, P) at rows (n, P): steps up or down of about these lengths (P), between
    constant ones, as contents add up, and proportional ones, as their logarithms do. None where
    there is nothing."""
    return generator.choice([-1.0, 1.0], rows.shape) * _steps(rows, lengths)


def _steps(rows: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    there = np.abs(rows)
    return lengths * np.sqrt(there / there.mean(axis=0))


def _changes(
    function: Callable[[Array], Array], rows: np.ndarray, ways: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A function of rows (n, P), and how it changes along a way at each (n, P)."""
    along = _along(function)
    found = [along(*pair) for pair in zip(_lots(rows), _lots(ways), strict=True)]
    value, change = (np.concatenate(part) for part in zip(*found, strict=True))
    return value, change


@lru_cache(maxsize=8)
def _along(function: Callable[[Array], Array]) -> Callable[[Array, Array], tuple[Array, Array]]:
    return jax.jit(lambda rows, ways: jax.jvp(function, (rows,), (ways,)))


def _lots(rows: np.ndarray, size: int = 8) -> list[Array]:
    """Rows in lots of one size, but for the last: what they need is so small that it is not asked
    of the system anew each time, which took as long as the work."""
    return [jnp.asarray(rows[i : i + size], jnp.float32) for i in range(0, len(rows), size)]


# --- the regression on principal components -----------------------------------------------------


def _fits(
    table: Any, forms: tuple[str, ...], seed: int, progress: bool, steps: Checkpoints, size: str
) -> dict[str, dict[str, np.ndarray]]:
    """By form: every number of the fitted pipeline by name."""
    from tqdm import tqdm

    names, asked = box_of(table)[0], specimens(table, seed)
    exact = table.attrs["generator"] == "adding"
    with (
        tqdm(
            total=(2 + 4 * exact) * len(forms) * STAGES, desc="train", unit="stage",
            disable=not progress,
        ) as stages,
        one_blas_thread(),
        ThreadPoolExecutor(THREADS) as pool,
    ):  # fmt: skip
        bar = _Stages(stages)

        def one(form: str) -> dict[str, np.ndarray]:
            finer = solve_finer(table, form, asked, seed, bar, steps) if exact else None
            kept = steps.step(f"{form}-local")
            local = learn_locally(table, form, seed, bar, finer=finer, step=kept)
            x, log, along = answers(local, names, asked, seed)
            kept = steps.step(f"{form}-network")
            hidden, count, bend = SIZES[size]
            network = Perceptron(
                hidden, count, BATCH, seed=seed, activation=bend, bar=bar, step=kept
            )
            seen = emphasis(table["wavelength_nm"].values)
            return fit(x, log, network, along, importance(len(asked)), seen)

        found = {pool.submit(one, form): form for form in forms}
        try:
            return {found[done]: done.result() for done in as_completed(found)}
        except BaseException:
            bar.ended.set()
            raise


class _Stages:
    """The bar of several threads, which ends them all when one of them or the user has ended."""

    def __init__(self, bar: Any):
        self.bar = bar
        self.ended = Event()

    def update(self, count: int = 1) -> None:
        if self.ended.is_set():
            raise CancelledError
        self.bar.update(count)


def answers(
    local: Local, names: tuple[str, ...], asked: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Features (n, f) of specimens (n, P), what the local regression says of them (n, w), and the
    change of both along some way at each."""
    ways = _ways(asked, _lengths(local, names, asked, seed), np.random.default_rng([seed, 4]))
    x, dx = _changes(_features(names, local.form), asked, ways)
    log, change = local.along(names, asked, ways)
    return x.astype(float), log, (dx, change)


@lru_cache(maxsize=8)
def _features(names: tuple[str, ...], form: str) -> Callable[[Array], Float[Array, "n f"]]:
    """One function for each, so that `_along` compiles it once."""
    return partial(features, names, form)


def _lengths(local: Local, names: tuple[str, ...], asked: np.ndarray, seed: int) -> np.ndarray:
    """Of the steps (P) along each parameter: its spread in the prior, or more where that changes
    too little for its slope to be learned (`LEAST`)."""
    own = asked[len(asked) // 2 :].std(axis=0)
    prior = np.arange(_prior(len(asked)), len(asked))
    some = np.random.default_rng(seed + 1).choice(prior, min(LOOKED_AT, len(prior)), replace=False)
    steps = _steps(asked, own)[some, None]
    changes = np.sqrt(np.mean((local.slopes(names, asked[some]) * steps) ** 2, axis=(0, 1)))
    least = np.array([LEAST[PRIORS[name].usual] for name in names])
    return own * np.maximum(least / np.maximum(changes, 1e-9), 1.0)


def specimens(table: Any, seed: int, count: int | None = None) -> np.ndarray:
    """(count, P), by default `SPECIMENS`, that the second regression learns from: a tenth spread
    over the box as the table is, as many over the model as published, where the usual parameters
    alone move, both `bared` as there, and the rest from the prior: three tenths with the usual
    parameters free, half with all."""
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
    over = bared(over)
    prior = [
        state_vector(names, lower, upper, free).prior_draws(
            jax.random.fold_in(jax.random.key(seed), 2 + number), drawn
        )
        for number, (free, drawn) in enumerate(((("usual",), 3 * part), (names, count - 5 * part)))
    ]
    return np.concatenate([over, *prior])


def importance(count: int) -> np.ndarray:
    """What each of so many `specimens` counts, (count,)."""
    return np.where(np.arange(count) < count // 10, CORNERS, 1.0)


def emphasis(wavelength_nm: np.ndarray) -> np.ndarray:
    """What errors are multiplied by, (w,): a colour needs more of few wavelengths than a fit."""
    low, high = SEEN
    return np.where((wavelength_nm >= low) & (wavelength_nm <= high), EMPHASIS, 1.0)


def _prior(count: int) -> int:
    """Where among so many `specimens` those from the prior begin, the usual parameters free."""
    return 2 * (count // 10)


def fit(
    x: np.ndarray,
    log: np.ndarray,
    network: Any,
    along: tuple[np.ndarray, np.ndarray] | None = None,
    weight: np.ndarray | None = None,
    scale: np.ndarray | float = 1.0,
) -> dict[str, np.ndarray]:
    """Standardise, reduce, regress: features (n, f), and what they give (n, w).

    The network is a `Perceptron`, or another with `coefs_` and `intercepts_`, not fitted yet;
    `along`, which only the first takes, are the changes of both along one direction at each,
    `weight` what each counts, and `scale` (w,) what errors are multiplied by.
    Returns every number of what the surrogate evaluates, by name.
    """
    from sklearn.decomposition import PCA
    from sklearn.preprocessing import StandardScaler

    scaler: Any = StandardScaler().fit(x)
    # in single precision the components beyond 3e-4 of the first were noise, and cost 4e-4
    log = log.astype(float) * scale
    pca: Any = PCA(min(COMPONENTS, len(x) // 4), random_state=0).fit(log)
    scores = pca.transform(log)
    unit = scores[:, 0].std()  # one scale for all, so that what matters more weighs more
    more: dict[str, Any] = {}
    if weight is not None:
        more["sample_weight"] = weight
    if along is not None:
        more["along"] = along[0] / scaler.scale_, (along[1] * scale) @ pca.components_.T / unit
    network.fit(scaler.transform(x), scores / unit, **more)
    weights, biases = (
        [*parts[:-1], parts[-1] * unit] for parts in (network.coefs_, network.intercepts_)
    )
    return {
        "centre": scaler.mean_,
        "scale": scaler.scale_,
        "components": pca.components_ / scale,
        "mean": pca.mean_ / scale,
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
