"""The training table: a design over the pigmentation parameters, walked in groups of rows.

Absorption changes no path, only its weight. So `SHARE` rows with the same melanosome contents, and
everything else their own, are served by one set of paths, walked for the least absorbing mixture
among them; their Monte Carlo errors are therefore not independent of each other.

A table is a Zarr group that xarray opens: `reflectance` and `standard_error` over (row,
wavelength_nm), `design` over (row, parameter). It is made whole at once, filled chunk by chunk, and
rows still to come are NaN, so that a table interrupted at any moment goes on where it stopped. Each
chunk has its own random key, so that the same seed gives the same table however it was interrupted.
"""

from __future__ import annotations

import os
import shutil
import uuid
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hylios_fit import fresnel, skin, tally, walker
from hylios_fit.errors import HyliosError
from hylios_fit.skin import SPECS, Layers, Specimen

if TYPE_CHECKING:
    import xarray

FORMAT = "hylios_fit table"
FORMAT_VERSION = 1
ROWS = 16_384
RAYS = 8192  # of each set of paths
SHARE = 8  # rows that one set of paths serves
GROUPS = 8  # sets of paths of one melanosome form that walk together
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


# Contents as wide as physiology and Table I need: melanosomes 1 to 10 % on average (Lister 2013),
# melanin 17.9 to 72.3 % within them (Kollias et al. 1991) times their concentrations (Hennessy et
# al. 2005), blood 0.2 to 4 % and more in lesions (Jacques 1996), water as in Blank (1952).
DESIGN = (
    Axis("melanosome_granulosum", 0.0, 12.0, "square"),
    Axis("melanosome_spinosum", 0.0, 12.0, "square"),
    Axis("melanosome_basale", 0.0, 12.0, "square"),
    Axis("colloidal_melanin", 0.0, 20.0, "cube"),
    Axis("eumelanin", 5.0, 150.0, "log"),
    Axis("pheomelanin", 0.2, 20.0, "log"),
    Axis("blood_papillary", 0.02, 12.0, "log"),
    Axis("blood_reticular", 0.02, 12.0, "log"),
    Axis("oxygen_saturation", 0.0, 1.0, "linear"),
    Axis("water", 0.4, 1.3, "linear"),
    Axis("lipids", 0.0, 2.0, "linear"),
)
NAMES = tuple(axis.name for axis in DESIGN)


PATH_AXES = 3  # the first axes of the design: what changes paths, the same within a group


def design(rows: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (rows, P) and melanosome form (rows,; index into FORMS) of the design.

    Scrambled Sobol sequences, one group of `SHARE` rows for each form in turn, so that the first
    rows of a larger table are those of a smaller one.
    """
    from scipy.stats import qmc

    groups = -(-rows // (SHARE * len(FORMS)))

    def sobol(dimensions: int, count: int, stream: int) -> np.ndarray:
        generator = np.random.default_rng([seed, stream])
        points = qmc.Sobol(dimensions, rng=generator)
        return points.random(1 << int(np.ceil(np.log2(max(count, 2)))))[:count]

    paths = np.repeat(sobol(PATH_AXES, groups, 0), SHARE, axis=0)
    unit = np.hstack([paths, sobol(len(DESIGN) - PATH_AXES, groups * SHARE, 1)])
    columns = []
    for u, axis in zip(unit.T, DESIGN, strict=True):
        if axis.spread == "log":
            columns.append(axis.lower * (axis.upper / axis.lower) ** u)
        else:
            power = {"linear": 1, "square": 2, "cube": 3}[axis.spread]
            columns.append(axis.lower + (axis.upper - axis.lower) * u**power)
    grouped = np.stack(columns, axis=1).reshape(groups, 1, SHARE, -1)
    both = np.repeat(grouped, len(FORMS), axis=1).reshape(groups * len(FORMS) * SHARE, -1)
    form = np.arange(len(both)) // SHARE % len(FORMS)
    return both[:rows], form[:rows]


@lru_cache(maxsize=4)
def _coefficients(form: str):
    """Layers of many rows at once: parameters (r, P) -> Layers with a leading axis."""
    defaults = Specimen().values

    def one(row: jax.Array) -> Layers:
        values = {**defaults, **dict(zip(NAMES, row, strict=True))}
        return skin.layers(values, form, WAVELENGTHS)

    return jax.jit(jax.vmap(one))


def _side_by_side(medium: Layers) -> Layers:
    """Rows as further wavelengths of one set of layers: they share thicknesses and surface."""
    first = jax.tree.map(lambda a: a[0], medium)

    def wide(a: jax.Array) -> jax.Array:  # (r, ..., w) -> (..., r w)
        return jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1)

    return first._replace(
        **{
            name: wide(getattr(medium, name))
            for name in ("index", "mu_a", "mu_particle", "hit_albedo", "theta_0", "mu_fibre")
        },
        mu_tissue=wide(medium.mu_tissue),
    )


def walk_rows(
    parameters: np.ndarray, form: str, key: jax.Array, rays: int = RAYS
) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance and its standard error, (rows, wavelengths) each, at 8 degrees of incidence.

    `parameters` (rows, P) in the order of `NAMES`; every `SHARE` rows in turn have the same
    melanosome contents and share `rays` rays.
    """
    w = len(WAVELENGTHS)
    groups = parameters.reshape(-1, SHARE, parameters.shape[-1])
    if not (groups[..., :PATH_AXES] == groups[:, :1, :PATH_AXES]).all():
        raise HyliosError(f"each {SHARE} rows must have the same melanosome contents")
    count = len(groups)
    least = groups.min(axis=1)
    saturation = NAMES.index("oxygen_saturation")
    least[:, saturation] = groups[..., saturation].mean(axis=1)
    coefficients = _coefficients(form)
    walked = coefficients(jnp.asarray(least, jnp.float32))
    asked = coefficients(jnp.asarray(parameters, jnp.float32))
    # groups in turn, so that long and short rays share the lanes
    bits = jax.random.bits(key, (count,), jnp.uint32)
    theta_0 = walked.theta_0[0]
    own = np.stack([walker.choose_heroes(theta_0, b[None], 0, rays) for b in bits], axis=1)
    paths = walker.walk(
        _side_by_side(walked),
        form,
        key,
        incidence=np.radians(INCIDENCE_DEG),
        rays=count * rays,
        absorb=ABSORB,
        heroes=(own + w * np.arange(count)).reshape(-1),
    )
    surface = surface_share(Specimen())
    reflectance, error = np.empty((2, len(parameters), w))
    for g in range(count):
        mine = walker.Paths(
            paths.sums.reshape(rays, count, -1)[:, g],
            paths.escaped.reshape(rays, count)[:, g],
            jnp.asarray(own[:, g], jnp.int32),
            paths.node.reshape(rays, count)[:, g],
        )
        base = Layers(*(part[g] for part in walked))
        for row in range(g * SHARE, (g + 1) * SHARE):
            found = tally.collect(mine, base, Layers(*(part[row] for part in asked)), ABSORB)
            reflectance[row] = surface + (1.0 - surface) * np.asarray(found.mean)
            error[row] = (1.0 - surface) * np.asarray(found.standard_error)
    return reflectance, error


def surface_share(specimen: Specimen) -> float:
    """What the surface reflects at once at the table's angle of incidence."""
    return fresnel.surface_reflectance(
        float(np.radians(INCIDENCE_DEG)), 1.0, specimen.index_corneum, specimen.roughness
    )


# --- storing ----------------------------------------------------------------------------------


def _empty(rows: int, seed: int, rays: int) -> xarray.Dataset:
    import xarray

    from hylios_fit import __version__

    parameters, form = design(rows, seed)
    blank = np.full((rows, len(WAVELENGTHS)), np.nan, np.float32)
    unit = {"units": "1"}
    return xarray.Dataset(
        {
            "reflectance": (("row", "wavelength_nm"), blank, unit),
            "standard_error": (("row", "wavelength_nm"), blank.copy(), unit),
            "design": (("row", "parameter"), parameters),
            "form": (("row",), form.astype(np.int32), {"flag_meanings": " ".join(FORMS)}),
        },
        {
            "wavelength_nm": ("wavelength_nm", WAVELENGTHS, {"units": "nm"}),
            # variable-length strings: those of fixed length have no stable form in Zarr
            "parameter": ("parameter", np.array(NAMES, dtype=object)),
            "unit": ("parameter", np.array([SPECS[name].unit for name in NAMES], dtype=object)),
            "lower": ("parameter", np.array([axis.lower for axis in DESIGN])),
            "upper": ("parameter", np.array([axis.upper for axis in DESIGN])),
        },
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "hylios_fit": __version__,
            "seed": seed,
            "rays": rays,
            "rows_sharing_paths": SHARE,
            "generator": "walker",
            "surface": surface_share(Specimen()),
            "incidence_deg": INCIDENCE_DEG,
        },
    )


def open_table(path: str | Path) -> xarray.Dataset:
    """Open a table and check that it is one that this version understands."""
    import xarray

    path = Path(path)
    if not path.exists():
        raise HyliosError(f"there is no table at {path}")
    try:
        table = xarray.open_zarr(path, consolidated=False)
    except Exception as error:
        raise HyliosError(f"{path} is not a table (a Zarr group): {error}") from error
    if table.attrs.get("format") != FORMAT:
        raise HyliosError(f"{path} is a Zarr group, but not a {FORMAT}")
    version = table.attrs.get("format_version")
    if version != FORMAT_VERSION:
        raise HyliosError(
            f"{path} was written in version {version} of the table's format by hylios_fit "
            f"{table.attrs.get('hylios_fit', '?')}; this one reads version {FORMAT_VERSION}: "
            "make the table again with `hylios-fit table`"
        )
    missing = {"reflectance", "standard_error", "design", "form"} - set(table.variables)
    if missing:
        raise HyliosError(f"{path} lacks {', '.join(sorted(missing))}")
    return table


def generate(
    path: str | Path,
    rows: int = ROWS,
    seed: int = 0,
    resume: bool = False,
    rays: int = RAYS,
    progress: bool = True,
    threads: int = 2,
) -> Path:
    """Make or go on with the table at `path`."""
    import zarr
    from tqdm import tqdm

    path = Path(path)
    chunk_rows = len(FORMS) * GROUPS * SHARE
    if rows < chunk_rows or rows % chunk_rows:
        raise HyliosError(f"a table has a multiple of {chunk_rows} rows, asked for {rows}")
    if path.exists() and not resume:
        raise HyliosError(f"{path} exists; add --resume to go on with it, or choose another name")
    if path.exists():
        _same(open_table(path).attrs, path, seed=seed, rays=rays)
        stored = open_table(path).sizes["row"]
        if stored != rows:
            raise HyliosError(f"{path} has {stored} rows, asked for {rows}")
    else:
        new = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
        chunks = (chunk_rows, len(WAVELENGTHS))
        encoding = {name: {"chunks": chunks} for name in ("reflectance", "standard_error")}
        try:
            _empty(rows, seed, rays).to_zarr(
                new, consolidated=False, encoding=encoding, zarr_format=3
            )
            os.replace(new, path)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise
    store: Any = zarr.open_group(path, mode="r+")
    parameters, form = design(rows, seed)
    done = np.isfinite(store["standard_error"][:, 0])
    starts = [s for s in range(0, rows, chunk_rows) if not done[s : s + chunk_rows].all()]
    key = jax.random.key(seed)

    def chunk(start: int) -> tuple[int, np.ndarray, np.ndarray]:
        part = slice(start, start + chunk_rows)
        shape = (chunk_rows, len(WAVELENGTHS))
        reflectance, error = np.empty(shape), np.empty(shape)
        for i, name in enumerate(FORMS):
            mine = form[part] == i
            row_key = jax.random.fold_in(jax.random.fold_in(key, start), i)
            found = walk_rows(parameters[part][mine], name, row_key, rays)
            reflectance[mine], error[mine] = found
        return start, reflectance, error

    with (
        tqdm(total=rows, initial=int(done.sum()), unit="row", disable=not progress) as bar,
        ThreadPoolExecutor(threads) as pool,
    ):
        for start, reflectance, error in pool.map(chunk, starts):
            part = slice(start, start + len(reflectance))
            store["reflectance"][part] = reflectance.astype(np.float32)
            store["standard_error"][part] = error.astype(np.float32)  # last: it marks rows as done
            bar.update(len(reflectance))
    return path


def _same(attributes: dict[Any, Any], path: Path, **asked: Any) -> None:
    for name, value in asked.items():
        if attributes.get(name) != value:
            raise HyliosError(
                f"{path} was begun with {name} {attributes.get(name)}, not {value}: "
                "go on with what it was begun with"
            )
