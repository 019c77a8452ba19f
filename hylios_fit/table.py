"""The training table: a design over the parameters, simulated row by row or walked in groups.

Absorption changes no path, only its weight. So `SHARE` rows that agree in what changes paths, and
have everything else their own, are served by one set of paths, walked for the least absorbing
mixture among them; their Monte Carlo errors are therefore not independent of each other.

A table is a Zarr group that xarray opens: `reflectance` and `standard_error` over (row,
wavelength_nm), `design` over (row, parameter). Its rows are there from the beginning, NaN until
they are made, a chunk at a time. A chunk has its own random key, is written whole or not at all,
and its standard errors last: whoever makes it, in whatever order and after however many kills, the
same seed gives the same bits. So processes share a table by taking chunks that nobody is at, and
a table grows by further rows of the same sequence.
"""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hylios_fit import fresnel, skin, tally, walker
from hylios_fit.errors import HyliosError
from hylios_fit.files import claimed
from hylios_fit.skin import SPECS, STRATA, Layers, Specimen
from hylios_fit.threads import one_blas_thread

if TYPE_CHECKING:
    import xarray

FORMAT = "hylios_fit table"
FORMAT_VERSION = 2
ROWS = 16_384
RAYS = 16_384  # of each set of paths
SHARE = 8  # rows that one set of paths serves
GROUPS = 8  # sets of paths of one melanosome form that walk together
GENERATORS = ("walker", "adding")
ADDING_ORDER = 6  # of what `adding` stores
ADDING_PARTS = (6, 8, 5, 5, 5)  # its streams in every row, so that no indices need compiling anew
ADDING_CHECK = 12  # the order that says how much it errs
TRACE = 1e-20  # 1/cm, the least that melanosomes scatter in rows that it solves
WAIT = 0.2  # seconds between looks at what another process is at
ABSORB = 0.5  # share of the absorption that ends rays on the way (the rest is in the weights)
INCIDENCE_DEG = 8.0
WAVELENGTHS = np.arange(250.0, 2500.1, 5.0)
FORMS = ("complex", "dispersed")  # light skin and dark skin (Szabo et al. 1969)


class Axis(NamedTuple):
    """One parameter of the design: its range, and how the unit interval is spread over it."""

    name: str
    lower: float
    upper: float
    spread: str  # "log", "linear", or "square" and "cube": denser near `lower`
    source: str  # of the range
    paths: bool = False  # it changes paths, so rows that share them agree in it


MELANOSOMES = "1 to 10 % of the epidermis on average (Lister 2013), more in single strata"
MELANIN = "17.9 to 72.3 % of a melanosome (Kollias et al. 1991), at the ratios of Hennessy (2005)"
BLOOD = "0.2 to 4 % (Jacques 1996); port-wine stains have several times that (Barsky et al. 1980)"
CELLS = "35 to 120 um of living epidermis (Whitton and Everall 1973; Sandby-Moller et al. 2003)"
INDEX = "1.36 to 1.43 in vivo (Ding et al. 2006), up to what the measured near infrared asks for"
ULTRAVIOLET = "none, to several times what the ultraviolet of NIST's set asks for"
DESIGN = (
    Axis("melanosome_granulosum", 0.0, 12.0, "square", MELANOSOMES, paths=True),
    Axis("melanosome_spinosum", 0.0, 12.0, "square", MELANOSOMES, paths=True),
    Axis("melanosome_basale", 0.0, 12.0, "square", MELANOSOMES, paths=True),
    Axis("colloidal_melanin", 0.0, 20.0, "cube", "0.8 to 15 % in Table I of the paper"),
    Axis("eumelanin", 5.0, 150.0, "log", MELANIN),
    Axis("pheomelanin", 0.2, 20.0, "log", MELANIN),
    Axis("blood_papillary", 0.02, 20.0, "log", BLOOD),
    Axis("blood_reticular", 0.02, 12.0, "log", BLOOD),
    Axis("oxygen_saturation", 0.0, 1.0, "linear", "all that is possible"),
    Axis("water", 0.4, 1.3, "linear", "dry to oedematous, as in Blank (1952)"),
    Axis("lipids", 0.0, 3.0, "linear", "none to three times the usual"),
    Axis("keratin", 0.0, 4.0, "square", "none, to several times the usual"),
    Axis("corneum_tail", 0.0, 20.0, "cube", ULTRAVIOLET),
    Axis("dna", 0.0, 4.0, "square", "none, to several times the usual"),
    Axis("urocanic_acid", 0.0, 5.0, "square", "4 to 34 nmol/cm2 (de Fine Olivarius 1997)"),
    Axis("carboxyhaemoglobin", 0.0, 30.0, "square", "to 20 %, smoke poisoning (Blumenthal 2001)"),
    Axis("methaemoglobin", 0.0, 60.0, "square", "to 40 %, methaemoglobinaemia (Wright 1999)"),
    Axis("sulfhaemoglobin", 0.0, 12.0, "square", "to 8 %, as sulfhaemoglobinaemia has"),
    Axis("bilirubin", 0.0, 0.4, "square", "to severe jaundice of the newborn (Maisels 2008)"),
    Axis("beta_carotene", 0.0, 10.0, "square", "none, to carotenodermia (Alaluf et al. 2002)"),
    Axis("thickness_corneum", 5e-4, 5e-3, "log", "6 to 40 um, but for palms (Egawa 2007)", True),
    Axis("thickness_granulosum", 1.5e-3, 0.01, "log", CELLS, paths=True),
    Axis("thickness_spinosum", 1.5e-3, 0.01, "log", CELLS, paths=True),
    Axis("thickness_basale", 1.5e-3, 0.01, "log", CELLS, paths=True),
    Axis("thickness_papillary", 0.005, 0.05, "log", "0.1 to 0.3 mm (Meglinski 2002)", paths=True),
    Axis("thickness_reticular", 0.05, 0.5, "log", "0.5 to 4 mm (Laurent et al. 2007)", paths=True),
    Axis("index_corneum", 1.42, 1.62, "linear", "1.47 to 1.57 (Tearney 1995; Ding 2006)", True),
    Axis("index_epidermis", 1.35, 1.57, "linear", INDEX, paths=True),
    Axis("index_papillary", 1.35, 1.57, "linear", INDEX, paths=True),
    Axis("index_reticular", 1.35, 1.57, "linear", INDEX, paths=True),
    Axis("fibre_fraction", 0.05, 0.6, "linear", "0.22 in the paper; fibres of 66 to 140 nm", True),
    Axis("reticular_scattering", 0.0, 80.0, "square", "46/cm (Jacques 2013), to twice that", True),
    Axis("reticular_scattering_power", 0.0, 3.0, "linear", "1 to 3 (Jacques 2013)", paths=True),
    Axis("bottom_reflectance", 0.0, 1.0, "linear", "all that is possible"),
)
NAMES = tuple(axis.name for axis in DESIGN)
PATHS = np.array([axis.paths for axis in DESIGN])


def of_indices(names: Iterable[str]) -> np.ndarray:
    """Which of the parameters (P,) the streams of the solver depend on: indices and dispersion."""
    return np.array([name.startswith("index_") for name in names])


INDICES = of_indices(NAMES)
USUAL = NAMES.index("lipids") + 1  # pigments, blood, water, lipids
PLAIN = 5
BARE = 3
SHIFT = (-0.04, 0.12)
"""The refractive indices of a row are moved together by as much as `index_dispersion` moves them
within the spectrum: so the table knows what that does without a spectrum of indices in each row."""


def spread(u: np.ndarray, lower: float, upper: float, how: str) -> np.ndarray:
    """The unit interval over a range, as `Axis.spread` says."""
    if how == "log":
        return lower * (upper / lower) ** u
    return lower + (upper - lower) * u ** {"linear": 1, "square": 2, "cube": 3}[how]


def design(rows: int, seed: int = 0, generator: str = "walker") -> tuple[np.ndarray, np.ndarray]:
    """Parameters (rows, P) and melanosome form (rows,; index into FORMS) of the design.

    Scrambled Sobol sequences, one group of `SHARE` rows for each form in turn, so that the first
    rows of a larger table are those of a smaller one. Rows of a group agree in what changes paths
    (`walker`), or in the indices, which the streams depend on (`adding`). Every `PLAIN`-th group is
    of the model as published, where the first `USUAL` parameters alone move: an edge of the box,
    and what is asked for most. Every `BARE`-th is `bared`.
    """
    groups = -(-rows // (SHARE * len(FORMS)))
    plain = np.arange(groups) % PLAIN == PLAIN - 1
    together = PATHS if generator == "walker" else INDICES
    values = np.tile(Specimen().parameters(NAMES), (groups, SHARE, 1))
    values[~plain], place = _groups(int(np.sum(~plain)), np.arange(len(NAMES)), together, seed, 0)
    shift = SHIFT[0] + (SHIFT[1] - SHIFT[0]) * place
    values[np.ix_(~plain, np.arange(SHARE), INDICES)] += shift[:, None, None]
    some = np.arange(USUAL)
    values[plain, :, :USUAL] = _groups(int(np.sum(plain)), some, together, seed, 2)[0]
    values = bared(values)
    both = np.repeat(values[:, None], len(FORMS), axis=1).reshape(-1, len(NAMES))
    form = np.arange(len(both)) // SHARE % len(FORMS)
    return both[:rows], form[:rows]


def bared(values: np.ndarray) -> np.ndarray:
    """Parameters (n, ..., P), every `BARE`-th of the n without melanosomes in the uppermost one,
    two or three strata in turn: light skin has none there (Szabo et al. 1969), vitiligo nowhere."""
    number = np.arange(len(values))
    strata = np.where(number % BARE == BARE - 1, number // BARE % len(STRATA) + 1, 0)
    values = values.copy()
    for i, stratum in enumerate(STRATA):
        values[strata > i, ..., NAMES.index(f"melanosome_{stratum}")] = 0.0
    return values


def _groups(
    count: int, axes: np.ndarray, together: np.ndarray, seed: int, stream: int
) -> tuple[np.ndarray, np.ndarray]:
    """Values (count, SHARE, axes) by two Sobol sequences, of the groups and of the rows, and one
    more number of each group."""
    from scipy.stats import qmc

    def sobol(dimensions: int, count: int, stream: int) -> np.ndarray:
        points = qmc.Sobol(dimensions, rng=np.random.default_rng([seed, stream]))
        return points.random(1 << int(np.ceil(np.log2(max(count, 2)))))[:count]

    alike = together[axes]
    common = sobol(int(alike.sum()) + 1, count, stream)
    unit = np.empty((count, SHARE, len(axes)))
    unit[..., alike] = common[:, None, 1:]
    own = sobol(int((~alike).sum()), count * SHARE, stream + 1)
    unit[..., ~alike] = own.reshape(count, SHARE, own.shape[1])
    columns = (
        spread(unit[..., i], DESIGN[axis].lower, DESIGN[axis].upper, DESIGN[axis].spread)
        for i, axis in enumerate(axes)
    )
    return np.stack(list(columns), axis=-1), common[:, 0]


@lru_cache(maxsize=8)
def layers_of(
    names: tuple[str, ...],
    form: str,
    stand: bool = True,
    wavelength_nm: tuple[float, ...] = tuple(WAVELENGTHS.tolist()),
) -> Callable[[Any], Layers]:
    """Parameters (n, P) -> layers with a leading axis, everything unnamed as usual; with `stand`
    as many particles as the walks let stand. Compiled."""
    defaults = Specimen().values

    def one(row: jax.Array) -> Layers:
        values = {**defaults, **dict(zip(names, row, strict=True))}
        medium = skin.layers(values, form, np.array(wavelength_nm))
        return skin.let_stand(medium, values, form) if stand else medium

    every = jax.jit(jax.vmap(one))
    return lambda rows: every(jnp.asarray(rows, jnp.float32))


def walk_rows(
    parameters: np.ndarray, form: str, key: jax.Array, rays: int = RAYS
) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance and its standard error, (rows, wavelengths) each, at 8 degrees of incidence.

    `parameters` (rows, P) in the order of `NAMES`; every `SHARE` rows in turn agree in what
    changes paths, and share `rays` rays.
    """
    w = len(WAVELENGTHS)
    groups = parameters.reshape(-1, SHARE, parameters.shape[-1])
    if not (groups[..., PATHS] == groups[:, :1, PATHS]).all():
        raise HyliosError(f"each {SHARE} rows must agree in what changes paths")
    asked = layers_of(NAMES, form, stand=False)(parameters)
    count = len(groups)

    def grouped(part: jax.Array) -> jax.Array:
        return part.reshape(count, SHARE, *part.shape[1:])

    # of each wavelength what loses least, layer by layer: no row's weights grow along a path
    walked = jax.tree.map(lambda part: grouped(part)[:, 0], asked)._replace(
        mu_a=grouped(asked.mu_a).min(axis=1),
        hit_albedo=grouped(asked.hit_albedo).max(axis=1),
        bottom=grouped(asked.bottom).max(axis=1),
    )
    # groups in turn, so that long and short rays share the lanes
    bits = jax.random.bits(key, (count,), jnp.uint32)
    shares = walker.hero_shares(walked.theta_0[0])
    own = np.stack([walker.spread(shares, b[None], 0, rays) for b in bits], axis=1)
    paths = walker.walk(
        skin.side_by_side(walked),
        form,
        key,
        incidence=np.radians(INCIDENCE_DEG),
        rays=count * rays,
        absorb=ABSORB,
        heroes=(own + w * np.arange(count)).reshape(-1),
    )
    surface = surface_share(parameters)
    reflectance, error = np.empty((2, len(parameters), w))
    for g in range(count):
        mine = walker.Paths(
            paths.sums.reshape(rays, count, -1)[:, g],
            paths.escaped.reshape(rays, count)[:, g],
            jnp.asarray(own[:, g], jnp.int32),
            paths.end.reshape(rays, count)[:, g],
        )
        base = Layers(*(part[g] for part in walked))
        for row in range(g * SHARE, (g + 1) * SHARE):
            found = tally.collect(mine, base, Layers(*(part[row] for part in asked)), ABSORB)
            reflectance[row] = surface[row] + (1.0 - surface[row]) * np.asarray(found.mean)
            error[row] = (1.0 - surface[row]) * np.asarray(found.standard_error)
    return reflectance, error


def add_rows(parameters: np.ndarray, form: str) -> tuple[np.ndarray, np.ndarray]:
    """As `walk_rows`, by the deterministic solver.

    The error of all rows is that of the usual specimen: what a higher order changes.
    """
    reflectance = solve_rows(NAMES, parameters, form)
    return reflectance, np.broadcast_to(_order_error(form), reflectance.shape)


@lru_cache(maxsize=4)
def _order_error(form: str) -> np.ndarray:
    usual = Specimen().parameters(NAMES)[None]
    coarse, fine = (solve_rows(NAMES, usual, form, n) for n in (ADDING_ORDER, ADDING_CHECK))
    return np.abs(coarse - fine)


def solve_rows(
    names: tuple[str, ...], parameters: np.ndarray, form: str, order: int = ADDING_ORDER
) -> np.ndarray:
    """Reflectance (n, w) of specimens (n, P) by adding-doubling, at the table's wavelengths.

    Specimens of the same refractive indices are solved together. Programs are compiled for each
    order of the indices, but not for each choice of strata without melanosomes: all have a trace.
    """
    from hylios_fit import adding

    medium = layers_of(names, form)(parameters)
    medium = medium._replace(mu_particle=medium.mu_particle.at[:, 1:4].max(TRACE))
    angle = float(np.radians(INCIDENCE_DEG))
    reflectance = np.empty((len(parameters), len(WAVELENGTHS)))
    _, group = np.unique(parameters[:, of_indices(names)], axis=0, return_inverse=True)
    parts = tuple(math.ceil(n * order / ADDING_ORDER) for n in ADDING_PARTS)
    for number in range(group.max() + 1):
        rows = np.flatnonzero(group == number)
        some = skin.side_by_side(jax.tree.map(lambda a, rows=rows: a[rows], medium))
        found = adding.skin(some, incidence=angle, order=order, dtype=np.float32, parts=parts)
        reflectance[rows] = np.asarray(found.reflectance).reshape(len(rows), -1)
    return reflectance


def surface_share(parameters: np.ndarray, names: tuple[str, ...] = NAMES) -> np.ndarray:
    """What the surface reflects at once at the table's angle of incidence, (rows,)."""
    angle = float(np.radians(INCIDENCE_DEG))
    curve = fresnel.surface_curve(angle, Specimen().roughness)
    return curve(parameters[:, names.index("index_corneum")])


# --- storing ----------------------------------------------------------------------------------

COLUMNS = ("reflectance", "standard_error", "design", "form", "parameter", "lower", "upper")
ATTRIBUTES = ("hylios_fit", "seed", "rays", "generator", "incidence_deg")


def _empty(rows: int, seed: int, rays: int, generator: str = "walker") -> xarray.Dataset:
    import xarray

    from hylios_fit import __version__

    parameters, form = design(rows, seed, generator)
    blank = np.full((rows, len(WAVELENGTHS)), np.nan, np.float32)
    unit = {"units": "1"}

    # variable-length strings: those of fixed length have no stable form in Zarr
    def words(values: Any) -> tuple[str, np.ndarray]:
        return "parameter", np.array(list(values), dtype=object)

    return xarray.Dataset(
        {
            "reflectance": (("row", "wavelength_nm"), blank, unit),
            "standard_error": (("row", "wavelength_nm"), blank.copy(), unit),
            "design": (("row", "parameter"), parameters),
            "form": (("row",), form.astype(np.int32), {"flag_meanings": " ".join(FORMS)}),
        },
        {
            "wavelength_nm": ("wavelength_nm", WAVELENGTHS, {"units": "nm"}),
            "parameter": words(NAMES),
            "unit": words(SPECS[name].unit for name in NAMES),
            "lower": ("parameter", np.array([axis.lower for axis in DESIGN])),
            "upper": ("parameter", np.array([axis.upper for axis in DESIGN])),
            "spread": words(axis.spread for axis in DESIGN),
            "source": words(axis.source for axis in DESIGN),
        },
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "hylios_fit": __version__,
            "seed": seed,
            "rays": rays,
            "rows_of_a_group": SHARE,
            "generator": generator,
            "incidence_deg": INCIDENCE_DEG,
        },
    )


def _open(path: Path, mode: Any = "r") -> Any:
    """The Zarr group, if it is a table of this version's format."""
    import zarr

    if not path.exists():
        raise HyliosError(f"there is no table at {path}")
    try:
        store = zarr.open_group(path, mode=mode)
    except Exception as error:
        raise HyliosError(f"{path} is not a table (a Zarr group): {error}") from error
    if store.attrs.get("format") != FORMAT:
        raise HyliosError(f"{path} is a Zarr group, but not a {FORMAT}")
    version = store.attrs.get("format_version")
    if version != FORMAT_VERSION:
        raise HyliosError(
            f"{path} was written in version {version} of the table's format by hylios_fit "
            f"{store.attrs.get('hylios_fit', '?')}; this one reads version {FORMAT_VERSION}: "
            "make the table again with `hylios-fit table`"
        )
    missing = [name for name in COLUMNS if name not in store]
    missing += [name for name in ATTRIBUTES if name not in store.attrs]
    if missing:
        raise HyliosError(f"{path} lacks {', '.join(missing)}")
    return store


def open_table(path: str | Path) -> xarray.Dataset:
    """Open a table, finished or not, and check that it is one that this version understands."""
    import xarray

    _open(Path(path))
    try:
        return xarray.open_zarr(path, chunks=None, consolidated=False)
    except Exception as error:
        raise HyliosError(
            f"{path} cannot be read ({error}): if it was killed while it grew, "
            "`hylios-fit table --resume` mends it"
        ) from error


def read_table(path: str | Path, least_rows: int = 1) -> xarray.Dataset:
    """The finished rows of a table, in memory, checked to be fit for training.

    Args:
        least_rows: finished rows that each melanosome form must have.

    Raises:
        HyliosError: a damaged table, rows of another version, a parameter without a range, or too
            few rows.
    """
    table = open_table(path)
    _same(table.attrs, Path(path), "has rows", hylios_fit=_version())
    try:
        table = table.load()
    except Exception as error:
        raise HyliosError(f"{path} is damaged: {error}; make the table again") from error
    for name, low, high in zip(
        table["parameter"].values, table["lower"].values, table["upper"].values, strict=True
    ):
        if not low < high:
            raise HyliosError(f"{path}: the range of {name} is {low:g} to {high:g}, of no width")
    # standard errors are written last
    table = table.isel(row=np.flatnonzero(np.isfinite(table["standard_error"]).any(axis=1)))
    for name in ("reflectance", "standard_error", "design"):
        bad = ~np.isfinite(table[name].values)
        if bad.any():
            row, column = np.argwhere(bad)[0]
            where = table["wavelength_nm" if name != "design" else "parameter"].values[column]
            raise HyliosError(
                f"{path} is damaged: {bad.any(axis=1).sum()} of its finished rows have no "
                f"{name} (the first is row {row}, at {where}); make the table again"
            )
    for number, form in enumerate(forms_of(table)):
        count = int((table["form"].values == number).sum())
        if count < least_rows:
            raise HyliosError(
                f"{path} has {count} finished rows of the form {form}, training needs at least "
                f"{least_rows}: go on with `hylios-fit table --resume`, or ask it for more --rows"
            )
    return table


def forms_of(table: xarray.Dataset) -> list[str]:
    """The melanosome forms that the numbers in `form` stand for."""
    return str(table["form"].attrs["flag_meanings"]).split()


def generate(
    path: str | Path,
    rows: int | None = None,
    seed: int = 0,
    resume: bool = False,
    rays: int = RAYS,
    progress: bool = True,
    threads: int = 2,
    generator: str = "walker",
    executor: Executor | None = None,
) -> Path:
    """Make the table at `path`, go on with it, or append rows to it.

    Several processes may work at one table at once, each called with `resume`.

    Args:
        rows: of the whole table; default: those that it has, `ROWS` for a new one.
        seed: of the design and of the walks.
        resume: go on with a table that exists.
        rays: of each set of paths (walker).
        threads: chunks of rows that are made at once, without an `executor`.
        generator: one of `GENERATORS`.
        executor: where the chunks are made, instead of threads; for a Dask cluster that shares
            the folder, `dask.distributed.Client(...).get_executor()`.

    Raises:
        HyliosError: a table that exists or was begun otherwise, or cannot be written.
    """
    from tqdm import tqdm

    path = Path(path)
    if generator not in GENERATORS:
        raise HyliosError(f"generator is one of {', '.join(GENERATORS)}, got {generator!r}")
    rays = rays if generator == "walker" else 0
    step = len(FORMS) * GROUPS * SHARE
    if rows is not None and (rows < step or rows % step):
        raise HyliosError(f"a table has a multiple of {step} rows, asked for {rows}")
    if path.exists() and not resume:
        raise HyliosError(f"{path} exists; add --resume to go on with it, or choose another name")
    with _writing(path):
        if not path.exists():
            _begin(path, _empty(rows or ROWS, seed, rays, generator), step)
        asked = {"generator": generator, "seed": seed, "rays": rays, "rows_of_a_group": SHARE}
        total = _extend(path, rows, asked)
    done = _done(path)
    starts = [s for s in range(0, total, step) if not done[s : s + step].all()]
    with (
        tqdm(total=total, initial=int(done.sum()), unit="row", disable=not progress) as bar,
        one_blas_thread(),
        nullcontext(executor) if executor else ThreadPoolExecutor(threads) as pool,
    ):
        while starts:
            futures = {pool.submit(make_chunk, str(path), start): start for start in starts}
            try:
                for future in as_completed(futures):
                    if future.result():
                        starts.remove(futures[future])
                        if progress:  # others may be at it, too
                            bar.update(_written(path, total, step) - bar.n)
            except BaseException:
                for future in futures:
                    future.cancel()
                raise
            if starts:
                time.sleep(WAIT)  # for those that another process is at
    return path


def _done(path: Path) -> np.ndarray:
    """Which rows are finished: their standard errors are there."""
    store = _open(path)
    try:
        return np.isfinite(store["standard_error"][:, 0])
    except Exception as error:
        raise HyliosError(f"{path} is damaged: {error}; make the table again") from error


def _written(path: Path, total: int, step: int) -> int:
    """Rows of the first `total` that are finished, without a look into their files."""
    return step * sum((_chunk(path, i) / "0").exists() for i in range(total // step))


def _chunk(path: Path, number: int) -> Path:
    """Where a chunk's standard errors go, which are written last."""
    return path / "standard_error" / "c" / str(number)


def make_chunk(path: str, start: int) -> bool:
    """Make the chunk that begins at row `start`, unless it is there: the unit of all the work.

    False if another process is at it.
    """
    folder = Path(path)
    store = _open(folder, "r+")
    about = store.attrs
    _same(about, folder, "was begun", hylios_fit=_version())
    part = slice(start, start + store["standard_error"].chunks[0])
    number = start // store["standard_error"].chunks[0]
    with _writing(folder), claimed(_chunk(folder, number)) as mine:
        if not mine:
            return False
        if np.isfinite(store["standard_error"][part, 0]).all():
            return True
        parameters, form = store["design"][part], store["form"][part]
        reflectance, error = np.empty((2, len(parameters), len(WAVELENGTHS)), np.float32)
        for i, name in enumerate(FORMS):
            rows = form == i
            if about["generator"] == "walker":
                key = jax.random.fold_in(jax.random.key(about["seed"]), start)
                found = walk_rows(parameters[rows], name, jax.random.fold_in(key, i), about["rays"])
            else:
                found = add_rows(parameters[rows], name)
            reflectance[rows], error[rows] = found
        store["reflectance"][part] = reflectance
        store["standard_error"][part] = error  # last: it marks rows as done
    return True


def _begin(path: Path, empty: xarray.Dataset, step: int) -> None:
    """A table without finished rows, there at once; unless another process was faster."""
    new = path.with_name(f".{path.name}.new")
    chunks = {name: (step, *empty[name].shape[1:]) for name in COLUMNS[:4]}
    with claimed(path.parent, wait=True):
        if path.exists():
            return
        shutil.rmtree(new, ignore_errors=True)  # of one that was killed
        try:
            encoding = {name: {"chunks": shape} for name, shape in chunks.items()}
            empty.to_zarr(new, consolidated=False, encoding=encoding, zarr_format=3)
            os.replace(new, path)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise


def _extend(path: Path, rows: int | None, asked: dict[str, Any]) -> int:
    """Append rows to what there is, if more are asked for; how many there are now.

    Standard errors grow last: a table killed on the way has its old rows, and is extended anew.
    """
    with claimed(path, wait=True):
        store = _open(path, "r+")
        _same(store.attrs, path, "was begun", hylios_fit=_version(), **asked)
        old = store["standard_error"].shape[0]
        total = old if rows is None else rows
        if total < old:
            raise HyliosError(f"{path} has {old} rows, asked for {total}: a table does not shrink")
        parameters, form = design(total, asked["seed"], asked["generator"])
        names = tuple(store["parameter"][:])
        if names != NAMES or not np.array_equal(store["design"][:old], parameters[:old]):
            raise HyliosError(
                f"{path} was begun with another design of parameters: make the table again"
            )
        try:
            if total > old:
                _resize(store, total)
                store["design"][old:], store["form"][old:] = parameters[old:], form[old:]
                store["standard_error"].resize((total, len(WAVELENGTHS)))
        except BaseException:
            with suppress(OSError):
                _resize(store, old)
            raise
    return total


def _resize(store: Any, rows: int) -> None:
    for name in ("design", "form", "reflectance"):
        store[name].resize((rows, *store[name].shape[1:]))


def _version() -> str:
    from hylios_fit import __version__

    return __version__


def _same(attributes: Any, path: Path, how: str, **asked: Any) -> None:
    for name, value in asked.items():
        if attributes.get(name) != value:
            advice = (
                "rows of two versions do not mix, make the table again"
                if name == "hylios_fit"
                else "go on with what it was begun with"
            )
            raise HyliosError(
                f"{path} {how} with {name} {attributes.get(name)}, not {value}: {advice}"
            )


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise HyliosError(
            f"{path}: cannot be written: {error.strerror or error}; what was there stays, "
            "`hylios-fit table --resume` goes on with it"
        ) from error
