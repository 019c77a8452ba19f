"""What each method costs and what it gives: time for a spectrum against its error.

Six sets of 16 specimens, each with 31 wavelengths: easy skin (S3 and light specimens near it,
visible), and where methods fail. The truth is adding-doubling at three times the usual order; its
last step is drawn as the floor. Times are core time (of all threads) from a specimen's parameters
to its reflectance, compiled and warm: medians, of one spectrum and of 16 (surrogates: 4096) at
once. Walks have no batch. The literal walk's error is measured at 1000 rays a wavelength; beyond,
it is carried on as 1/sqrt(rays), with the time of a ray measured at 8192.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import _fresh, _shared
from hylios_fit import adding, fresnel, skin, streams, table
from hylios_fit.simulation import simulate
from hylios_fit.skin import SPECS, Layers, Specimen
from hylios_fit.surrogate import FLOOR, Surrogate, features, load_surrogate
from hylios_fit.threads import one_blas_thread

NUMBER = 16
TRUTH = 24
BELOW_TRUTH = 16  # what the truth is held against
MANY = 4096
VISIBLE = np.arange(400.0, 701.0, 10.0)
LIGHT: Mapping[str, tuple[float, float]] = {
    "melanosome_granulosum": (0.05, 1.0),
    "melanosome_spinosum": (0.05, 1.0),
    "melanosome_basale": (0.8, 5.0),
    "colloidal_melanin": (0.5, 3.0),
    "eumelanin": (20.0, 90.0),
    "pheomelanin": (1.0, 5.0),
    "blood_papillary": (0.1, 1.5),
    "blood_reticular": (0.1, 1.5),
    "oxygen_saturation": (0.4, 0.95),
    "water": (0.7, 1.2),
    "lipids": (0.3, 1.7),
}
DARK = LIGHT | {
    "melanosome_granulosum": (7.0, 11.9),
    "melanosome_spinosum": (7.0, 11.9),
    "melanosome_basale": (7.0, 11.9),
    "colloidal_melanin": (8.0, 19.0),
    "eumelanin": (30.0, 100.0),
    "blood_papillary": (0.5, 4.0),
    "blood_reticular": (0.5, 4.0),
}
LITTLE = LIGHT | {"blood_papillary": (0.02, 0.05), "blood_reticular": (0.02, 0.05)}
MUCH = LIGHT | {"blood_papillary": (6.0, 11.9), "blood_reticular": (6.0, 11.9)}
#: Ranges, preset or form, wavelengths. All have 31, so that everything compiles once.
REGIMES: Mapping[str, tuple[Mapping[str, tuple[float, float]], str, np.ndarray]] = {
    "easy": (LIGHT, "S3", VISIBLE),
    "dark": (DARK, "S4", VISIBLE),
    "ultraviolet": (LIGHT, "S3", np.arange(250.0, 401.0, 5.0)),
    "water bands": (LIGHT, "S3", np.arange(1390.0, 1991.0, 20.0)),
    "little blood": (LITTLE, "", VISIBLE),
    "much blood": (MUCH, "", VISIBLE),
}
HARD = tuple(REGIMES)[1:]

TRANSPORT = (*_shared.WALK, "adding", "analog", "simulation", "streams")
WALKER_RAYS = {1_000: 16, 10_000: 16, 100_000: 8, 1_000_000: 1}  # rays: specimens
ANALOG_RAYS = 1_000
ANALOG_SPECIMENS = 2
ANALOG_BEYOND = (10_000, 100_000, 1_000_000)
ORDERS = {"float64": (6, 8, 12, 16), "float32": (6, 8, 12)}
COMPONENTS = (2, 4, 8, 12, 16, 24, 32, 48)
TABLE_ROWS = 8192
NEAREST = 64  # rows of a local linear regression


# --- specimens and the truth -------------------------------------------------------------------


@lru_cache
def specimens(regime: str, seed: int) -> tuple[Specimen, ...]:
    """The regime's, a preset of the paper first where it has one; Sobol points in its ranges."""
    from scipy.stats import qmc

    ranges, preset, _ = REGIMES[regime]
    unit = qmc.Sobol(len(ranges), rng=np.random.default_rng([seed, 77])).random(NUMBER)
    low, high = np.array(list(ranges.values())).T
    values = np.where(low > 0.3, low + (high - low) * unit, low * (high / low) ** unit)
    form = "dispersed" if regime == "dark" else "complex"
    made = [Specimen(dict(zip(ranges, map(float, v), strict=True)), form) for v in values]
    return ((Specimen.preset(preset),) if preset else ()) + tuple(made[1 if preset else 0 :])


@lru_cache
def _coefficients(form: str, nm: tuple[float, ...]) -> Callable[[Any], Layers]:
    """Rows of all parameters -> layers side by side, as `adding` takes them, compiled."""
    of = table.layers_of(tuple(SPECS), form, wavelength_nm=nm)
    return jax.jit(lambda rows: skin.side_by_side(of(rows)))


def layers_of(given: tuple[Specimen, ...], nm: np.ndarray) -> Layers:
    rows = np.array([list(specimen.values.values()) for specimen in given], np.float32)
    return _coefficients(given[0].melanosome_form, tuple(nm.tolist()))(rows)


def added(given: tuple[Specimen, ...], nm: np.ndarray, order: int, dtype: Any = None) -> np.ndarray:
    found = adding.skin(layers_of(given, nm), order=order, dtype=dtype).reflectance
    return np.asarray(found, float).reshape(len(given), -1)


# --- what people use instead -------------------------------------------------------------------


def reduced(medium: Layers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Absorption, reduced scattering (1/cm) and thickness (cm) of the layers, (6, columns)."""
    mu_a, hits, survives, fibre, tissue, thickness = (
        np.array(part, float)
        for part in (
            medium.mu_a, medium.mu_particle, medium.hit_albedo, medium.mu_fibre, medium.mu_tissue,
            medium.thickness,
        )
    )  # fmt: skip
    angle, place = np.unique(np.asarray(medium.theta_0, float), return_inverse=True)
    g = streams.exponential_moments(tuple(angle), 2)[place, 1]
    mu_s = hits * survives * (1.0 - g) + tissue
    mu_s[4] += fibre  # Rayleigh's law: as much forwards as backwards
    return mu_a + hits * (1.0 - survives), mu_s, thickness


@lru_cache
def surface(index: float) -> tuple[float, float]:
    """What a smooth surface reflects from outside (8 degrees), and of diffuse light inside."""
    outside = fresnel.surface_reflectance(np.radians(8.0), 1.0, index, 0.0)
    cos = (np.arange(4000) + 0.5) / 4000
    sin = index * np.sqrt(1.0 - cos**2)
    out = np.sqrt(np.clip(1.0 - sin**2, 0.0, None))
    inside = np.where(sin < 1.0, fresnel.unpolarised(cos, out, index, 1.0), 1.0)
    return outside, float(2.0 * np.mean(inside * cos))


def kubelka_munk(medium: Layers) -> np.ndarray:
    """Two fluxes: Kubelka and Munk (1931), layers added as in Kubelka (1954), K and S as in
    van Gemert and Star (1987), the surface as in Saunderson (1942)."""
    mu_a, mu_s, h = reduced(medium)
    k, s = 2.0 * mu_a, np.clip(0.75 * mu_s - 0.25 * mu_a, 0.0, None)
    root = np.sqrt(k * (k + 2.0 * s)) + 1e-12
    depth = np.clip(root * h, 0.0, 300.0)
    sinh, cosh = np.sinh(depth), np.cosh(depth)
    r = s * sinh / ((s + k) * sinh + root * cosh)
    t = root / ((s + k) * sinh + root * cosh)
    below = np.asarray(medium.bottom, float)
    for i in reversed(range(6)):
        below = r[i] + t[i] ** 2 * below / (1.0 - r[i] * below)
    k_1, k_2 = surface(float(medium.index[0, 0]))
    return k_1 + (1.0 - k_1) * (1.0 - k_2) * below / (1.0 - k_2 * below)


def diffusion(medium: Layers, cells: int = 12) -> np.ndarray:
    """The diffusion equation in the layers, D = 1/(3 (mu_a + mu_s')), lit by a beam that fades
    (Ishimaru 1978; the surface as in Haskell et al. 1994), by finite volumes."""
    mu_a, mu_s, h = (np.repeat(a, cells, axis=0) for a in reduced(medium))
    h = h / cells
    mu_t = mu_a + mu_s + 1e-6
    beam = np.exp(-np.cumsum(mu_t * h, axis=0))
    arrives = np.concatenate([np.ones_like(beam[:1]), beam[:-1]])
    source = mu_s / mu_t * (arrives - beam)
    bottom = np.asarray(medium.bottom, float)
    source[-1] += bottom * beam[-1]
    k_1, k_2 = surface(float(medium.index[0, 0]))
    half = 0.5 * h * 3.0 * mu_t
    between = 1.0 / (half[:-1] + half[1:])
    out = 1.0 / (half[0] + 2.0 * (1.0 + k_2) / (1.0 - k_2))
    lost = (1.0 - bottom) / (half[-1] * (1.0 - bottom) + 2.0 * (1.0 + bottom))
    # Thomas's elimination, from the bottom up
    above = np.concatenate([out[None], between])
    under = np.concatenate([between, lost[None]])
    diagonal = mu_a * h + above + under
    for i in reversed(range(len(h) - 1)):
        factor = between[i] / diagonal[i + 1]
        diagonal[i] -= factor * between[i]
        source[i] += factor * source[i + 1]
    return k_1 + (1.0 - k_1) * out * source[0] / diagonal[0]


# --- regressions on the table ------------------------------------------------------------------


class Regression:
    """Features -> spectra by any function fitted on the table's rows of one form."""

    def __init__(self, kind: str, data: Any, form: str, seed: int):
        number = table.FORMS.index(form)
        mine = data["form"].values == number
        self.names = tuple(str(name) for name in data["parameter"].values)
        self.nm = data["wavelength_nm"].values
        self.form = form
        rows = data["design"].values[mine]
        x = self._features(rows)
        self.centre, self.scale = x.mean(axis=0), x.std(axis=0)
        x = (x - self.centre) / self.scale
        # the table's surfaces are of many indices, those that are asked for of one
        given, own = (table.surface_share(r)[:, None] for r in (rows, self._usual()))
        share = (data["reflectance"].values[mine] - given) / (1.0 - given)
        self.surface = own
        y = own + (1.0 - own) * share
        self.kind = kind
        if kind in ("nearest", "local"):
            from scipy.spatial import KDTree

            self.tree, self.x, self.y = KDTree(x), x, y
        else:
            self._fit(x, y, seed)

    def _features(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(features(self.names, self.form, jnp.asarray(rows, jnp.float32)), float)

    def _usual(self) -> np.ndarray:
        return Specimen().parameters(self.names)[None]

    def _fit(self, x: np.ndarray, y: np.ndarray, seed: int) -> None:
        from sklearn.decomposition import PCA
        from sklearn.kernel_ridge import KernelRidge
        from sklearn.linear_model import Ridge
        from sklearn.neural_network import MLPRegressor
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import PolynomialFeatures

        log = np.log(np.clip((y - self.surface) / (1.0 - self.surface), 0.0, None) + FLOOR)
        self.pca: Any = PCA(24, random_state=seed).fit(log)
        scores = self.pca.transform(log)
        unit = self.pca.singular_values_[0] / np.sqrt(len(x))
        scores = scores / unit
        self.unit = unit
        if self.kind.startswith("polynomial"):
            degree = int(self.kind[-1])
            self.model = make_pipeline(PolynomialFeatures(degree), Ridge(1e-3)).fit(x, scores)
        elif self.kind == "kernel":
            few, rest = slice(0, 1536), slice(1536, 2048)
            best = np.inf
            for gamma in (0.003, 0.01, 0.03):
                for alpha in (1e-6, 1e-4):
                    model: Any = KernelRidge(kernel="rbf", gamma=gamma)
                    model.set_params(alpha=alpha)
                    model.fit(x[few], scores[few])
                    error = np.mean((model.predict(x[rest]) - scores[rest]) ** 2)
                    if error < best:
                        best, self.model = error, model
        else:
            self.model = MLPRegressor(
                hidden_layer_sizes=(64, 64), activation="tanh", solver="lbfgs", alpha=1e-5,
                max_iter=400, random_state=seed,
            ).fit(x, scores)  # fmt: skip

    def __call__(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Reflectance (n, columns) of parameters (n, P); `columns` of the table's wavelengths."""
        x = (self._features(rows) - self.centre) / self.scale
        if self.kind == "nearest":
            return self.y[self.tree.query(x)[1]][:, columns]
        if self.kind == "local":
            found = np.empty((len(x), columns.size))
            for i, near in enumerate(np.asarray(self.tree.query(x, NEAREST)[1])):
                design = np.column_stack([np.ones(NEAREST), self.x[near] - x[i]])
                found[i] = np.linalg.lstsq(design, self.y[near][:, columns], rcond=None)[0][0]
            return found
        scores = np.atleast_2d(self.model.predict(x)) * self.unit
        log = scores @ self.pca.components_[:, columns] + self.pca.mean_[columns]
        return self.surface + (1.0 - self.surface) * (np.exp(log) - FLOOR)


REGRESSIONS = {
    "nearest": "nearest row of the table",
    "local": f"linear in the {NEAREST} nearest rows",
    "polynomial 2": "polynomial ridge, degree 2",
    "kernel": "kernel ridge, 1536 rows",
    "perceptron": "one perceptron, 64 x 64",
}


def truncated(surrogate: Any, count: int) -> Any:
    """The surrogate with the first `count` of its components."""
    import dataclasses

    members = {
        form: dataclasses.replace(
            member,
            weights=(*member.weights[:-1], member.weights[-1][..., :count]),
            biases=(*member.biases[:-1], member.biases[-1][..., :count]),
            components=member.components[:count],
        )
        for form, member in surrogate.members.items()
    }
    return type(surrogate)(members, surrogate.about)


# --- the run -----------------------------------------------------------------------------------


def core_time(call: Callable[[], Any], spectra: int, repeats: int = 7) -> dict[str, float]:
    """Seconds for one spectrum, medians, warm: of the cores and of the clock."""
    call()
    found = []
    for _ in range(repeats):
        core, wall, inner = time.process_time(), time.perf_counter(), 0
        while True:  # the clock of the cores ticks coarsely
            jax.block_until_ready(call())
            inner += 1
            if time.perf_counter() - wall > 0.05:
                break
        spent = time.process_time() - core, time.perf_counter() - wall
        found.append([part / inner / spectra for part in spent])
    core, wall = np.median(found, axis=0)
    return {"core_s": _shared.significant(core, 3), "wall_s": _shared.significant(wall, 3)}


Parts = Callable[[str, Callable[[], Any]], Any]


def _parts(modules: tuple[str, ...], **settings: Any) -> Parts:
    """What keeps each part of the run in a file once it is done."""
    return partial(_shared.kept, _shared.checkpoint("speed_accuracy", modules, **settings))


def rms(found: np.ndarray, truth: np.ndarray) -> float:
    return _shared.significant(np.sqrt(np.mean((found - truth) ** 2)), 3)


def run(seed: int = 0, table_path: str | None = None) -> dict[str, Any]:
    """Error by regime and time for every method; what is done already is kept."""
    base = {"seed": seed, "regimes": {n: [dict(r[0]), r[2].tolist()] for n, r in REGIMES.items()}}
    exact = _parts(TRANSPORT, **base)
    truth = {
        name: np.array(
            exact(
                f"truth {name}",
                lambda name=name: added(specimens(name, seed), REGIMES[name][2], TRUTH).tolist(),
            )
        )
        for name in REGIMES
    }
    floor = exact(
        "floor",
        lambda: {
            name: rms(added(specimens(name, seed), REGIMES[name][2], BELOW_TRUTH), truth[name])
            for name in REGIMES
        },
    )
    methods: list[dict[str, Any]] = []
    _walks(exact, seed, truth, methods)
    _deterministic(exact, seed, truth, methods)
    with one_blas_thread():
        about = _from_table(base, seed, table_path, truth, methods)
        about |= _embedded(base, seed, truth, methods)
    return {
        "truth_order": TRUTH,
        "floor_order": BELOW_TRUTH,
        "specimens": NUMBER,
        "wavelength_nm": {
            name: [regime[2][0], regime[2][-1], len(regime[2])] for name, regime in REGIMES.items()
        },
        "floor": floor,
        "methods": methods,
        **about,
    }


def _walks(exact: Parts, seed: int, truth: Mapping[str, np.ndarray], methods: list) -> None:
    def walk(regime: str, method: str, rays: int, count: int) -> dict[str, float]:
        found, core, wall = [], [], []
        for i, specimen in enumerate(specimens(regime, seed)[-count:]):
            if i == 0:  # compiles
                simulate(
                    specimen, REGIMES[regime][2], method, rays=min(rays, 10_000),
                    key=jax.random.key(seed),
                )  # fmt: skip
            start = time.process_time(), time.perf_counter()
            curve = simulate(
                specimen, REGIMES[regime][2], method, rays=rays,
                key=jax.random.fold_in(jax.random.key(seed), 100 + i),
            )  # fmt: skip
            core.append(time.process_time() - start[0])
            wall.append(time.perf_counter() - start[1])
            found.append(curve.reflectance)
        return {
            "rms": rms(np.array(found), truth[regime][-count:]),
            "core_s": _shared.significant(np.median(core), 3),
            "wall_s": _shared.significant(np.median(wall), 3),
        }

    def entry(family: str, label: str, found: Mapping[str, Any], **more: Any) -> None:
        easy = found["easy"]
        methods.append(
            {
                "family": family, "label": label,
                "error": {name: part["rms"] for name, part in found.items()},
                "one": {name: easy[name] for name in ("core_s", "wall_s")}, "many": None, **more,
            }
        )  # fmt: skip

    for rays, count in WALKER_RAYS.items():
        found = {
            name: exact(
                f"walker {rays} {name}",
                lambda name=name, rays=rays, count=count: walk(name, "walker", rays, count),
            )
            for name in REGIMES
        }
        entry("walker", f"{rays:.0e}".replace("e+0", "e"), found, specimens=count)
    found = {
        name: exact(
            f"analog {name}",
            lambda name=name: walk(name, "analog", ANALOG_RAYS, ANALOG_SPECIMENS),
        )
        for name in REGIMES
    }
    entry("analog walk", "1e3", found, specimens=ANALOG_SPECIMENS)

    def of_a_ray() -> float:
        nm, specimen, rays = [400.0, 550.0, 700.0], specimens("easy", seed)[-1], 8192
        for lot in (rays // 2, rays):  # the first compiles
            start = time.process_time()
            simulate(specimen, nm, "analog", rays=lot, key=jax.random.key(seed + 1))
        return (time.process_time() - start) / len(nm) / rays

    a_ray = exact("analog ray", of_a_ray)
    for rays in ANALOG_BEYOND:
        part = (ANALOG_RAYS / rays) ** 0.5
        methods.append(
            {
                "family": "analog walk", "label": f"{rays:.0e}".replace("e+0", "e"),
                "error": {n: _shared.significant(f["rms"] * part, 3) for n, f in found.items()},
                "one": {"core_s": _shared.significant(a_ray * rays * 31, 3), "wall_s": None},
                "many": None, "extrapolated": True,
            }
        )  # fmt: skip


def _deterministic(exact: Parts, seed: int, truth: Any, methods: list) -> None:
    def measured(function: Callable[[tuple[Specimen, ...], np.ndarray], np.ndarray]) -> dict:
        easy = specimens("easy", seed)
        with_all = easy[-1:]  # with particles in every stratum
        return {
            "error": {
                name: rms(function(specimens(name, seed), REGIMES[name][2]), truth[name])
                for name in REGIMES
            },
            "one": core_time(lambda: function(with_all, VISIBLE), 1),
            "many": core_time(lambda: function(easy, VISIBLE), NUMBER),
        }

    for dtype, orders in ORDERS.items():
        for order in orders:
            found = exact(
                f"adding {dtype} {order}",
                lambda order=order, dtype=dtype: measured(
                    lambda given, nm: added(given, nm, order, jnp.dtype(dtype))
                ),
            )
            family = "adding" if dtype == "float64" else "adding, float32"
            methods.append({"family": family, "label": str(order), **found})
    for family, function in (("Kubelka-Munk", kubelka_munk), ("diffusion", diffusion)):
        found = exact(
            family,
            lambda function=function: measured(
                lambda given, nm: function(layers_of(given, nm)).reshape(len(given), -1)
            ),
        )
        methods.append({"family": family, "label": "", **found})


def _measured_rows(function: Callable[..., Any], names: Any, seed: int, truth: Any, many: int):
    """As `measured`, of a function of parameters (n, P) and a regime."""
    rows = {
        name: np.array([s.parameters(names) for s in specimens(name, seed)], np.float32)
        for name in REGIMES
    }
    easy = np.tile(rows["easy"], (-(-many // NUMBER), 1))[:many]
    return {
        "error": {name: rms(function(rows[name], name), truth[name]) for name in REGIMES},
        "one": core_time(lambda: function(rows["easy"][-1:], "easy"), 1),
        "many": core_time(lambda: function(easy, "easy"), many),
    }


def _from_table(base: Any, seed: int, path: str | None, truth: Any, methods: list) -> dict:
    data = table.read_table(path) if path else _fresh.training_table("adding", TABLE_ROWS)
    data = data.isel(row=slice(0, TABLE_ROWS))
    grid = data["wavelength_nm"].values
    parts = _parts((*TRANSPORT, "table", "surrogate"), **base, rows=int(data.sizes["row"]))

    def measured(kind: str) -> dict:
        by_form = {form: Regression(kind, data, form, seed) for form in table.FORMS}
        columns = {name: np.searchsorted(grid, REGIMES[name][2]) for name in REGIMES}
        form = {name: specimens(name, seed)[0].melanosome_form for name in REGIMES}
        return _measured_rows(
            lambda rows, name: by_form[form[name]](rows, columns[name]),
            by_form["complex"].names, seed, truth, 256,
        )  # fmt: skip

    for kind, label in REGRESSIONS.items():
        found = parts(kind, lambda kind=kind: measured(kind))
        methods.append({"family": label, "label": "", **found})
    return {"table_rows": int(data.sizes["row"])}


def _embedded(base: Any, seed: int, truth: Any, methods: list) -> dict:
    surrogate, small = load_surrogate(), load_surrogate(size="small")
    hashes = {"sha256": _shared.embedded_hash(), "small": _shared.embedded_hash("small")}
    parts = _parts((*TRANSPORT, "surrogate"), **base, surrogate=hashes)
    whole = int(surrogate.at(surrogate.forms[0]).components.shape[0])

    def measured(asked: Surrogate, count: int) -> dict:
        short = truncated(asked, count) if count < whole else asked
        on = {name: short.on(REGIMES[name][2]) for name in REGIMES}
        return _measured_rows(
            lambda rows, name: np.asarray(on[name](rows), float),
            surrogate.names, seed, truth, MANY,
        )  # fmt: skip

    counts = sorted({*(k for k in COMPONENTS if k < whole), whole})
    for count in counts:
        found = parts(f"surrogate {count}", lambda count=count: measured(surrogate, count))
        methods.append({"family": "large embedded surrogate", "label": str(count), **found})
    found = parts("small surrogate", lambda: measured(small, whole))
    methods.append({"family": "small embedded surrogate", "label": str(whole), **found})
    return {"surrogate": {**hashes, "components": whole}}


# --- the figure --------------------------------------------------------------------------------

FAMILIES = {  # colour, marker, label of the legend
    "analog walk": ("#4d4d4d", "v"),
    "walker": ("#1b6ca8", "^"),
    "adding": ("#c8553d", "o"),
    "adding, float32": ("#e39b86", "o"),
    "large embedded surrogate": ("#3a7d44", "s"),
    "small embedded surrogate": ("#8cc084", "s"),
    "polynomial ridge, degree 2": ("#b58900", "D"),
    "polynomial ridge, degree 3": ("#b58900", "P"),
    "kernel ridge, 1536 rows": ("#7a4fa3", "D"),
    "one perceptron, 64 x 64": ("#2a9d8f", "D"),
    "nearest row of the table": ("#d1495b", "X"),
    f"linear in the {NEAREST} nearest rows": ("#d1495b", "P"),
    "Kubelka-Munk": ("#000000", "*"),
    "diffusion": ("#8d6e63", "*"),
}


def draw(result: dict[str, Any], path: Any) -> None:
    """Error against time for easy skin and for the rest, and where each method fails."""
    figure = _shared.figure(13.5, 12.5)
    grid = figure.add_gridspec(2, 2, height_ratios=(3, 2))
    left = figure.add_subplot(grid[0, 0])
    right = figure.add_subplot(grid[0, 1], sharex=left, sharey=left)
    for axes, regimes in ((left, ("easy",)), (right, HARD)):
        _panel(axes, result, regimes)
    left.set_title("easy skin: S3 and 15 light specimens, 400 to 700 nm", fontsize=11)
    right.set_title(
        "where methods fail: dark, ultraviolet, water bands, little and much blood\n"
        "(RMS over all; bars from the best regime to the worst)", fontsize=11,
    )  # fmt: skip
    figure.legend(
        *left.get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=9.5,
        frameon=False,
    )  # fmt: skip
    _regimes(figure.add_subplot(grid[1, :]), result)
    _shared.save_figure(figure, path)


def _overall(errors: Mapping[str, float], regimes: tuple[str, ...]) -> tuple[float, float, float]:
    """RMS over regimes, the least and the most."""
    found = [errors[name] for name in regimes]
    return float(np.sqrt(np.mean(np.square(found)))), min(found), max(found)


def _panel(axes: Any, result: dict[str, Any], regimes: tuple[str, ...]) -> None:
    floor = _overall(result["floor"], regimes)[0]
    best: list[tuple[float, float]] = []
    for family, (colour, marker) in FAMILIES.items():
        mine = [m for m in result["methods"] if m["family"] == family]
        if not mine:
            continue
        for one in (True, False):
            use = [m for m in mine if one or m["many"]]
            x = [m["one" if one else "many"]["core_s"] for m in use]
            y, low, high = np.array([_overall(m["error"], regimes) for m in use]).reshape(-1, 3).T
            if not use:
                continue
            best += zip(x, y, strict=True)
            if len(regimes) > 1 and (not one or not mine[0]["many"]):
                axes.vlines(x, low, high, color=colour, lw=0.8, alpha=0.45)
            axes.plot(
                x, y, ls=":" if one else "-", lw=1.0, marker=marker, ms=7, color=colour,
                mfc="white" if one else colour, zorder=3,
                label=family if one is not bool(mine[0]["many"]) else None,
            )  # fmt: skip
            labelled = len(use) > 1 and family != "adding, float32"
            if labelled and one is not bool(mine[0]["many"]):
                for i, (m, at_x, at_y) in enumerate(zip(use, x, y, strict=True)):
                    if i and at_y / y[i - 1] > 0.6 and i < len(use) - 1:
                        continue  # the labels would hide each other
                    axes.annotate(
                        m["label"] + ("*" if m.get("extrapolated") else ""), (at_x, at_y),
                        (5, 5 if i < len(use) - 1 else -8), textcoords="offset points", fontsize=8,
                        color=colour,
                    )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    frontier = []
    for x, y in sorted(best):
        if not frontier or y < frontier[-1][1]:
            frontier.append((x, y))
    axes.plot(
        *np.array(frontier).T, color="black", lw=5, alpha=0.13, zorder=1, label="frontier"
    )  # fmt: skip
    axes.axhspan(
        1e-9, floor, color="black", alpha=0.12, lw=0, label="the truth's own uncertainty"
    )  # fmt: skip
    axes.set_ylim(min(floor, 1e-5) / 2, 0.6)
    _shared.tidy(axes, "core time of a spectrum of 31 wavelengths (s)", "RMS error in reflectance")
    axes.text(
        0.02, 0.02, "filled: many at once; open: one by one; * extrapolated",
        transform=axes.transAxes, fontsize=8.5,
    )  # fmt: skip


def _regimes(axes: Any, result: dict[str, Any]) -> None:
    """Errors by method and regime, as numbers."""
    from matplotlib.colors import LogNorm

    last: dict[str, dict[str, Any]] = {}
    for m in result["methods"]:
        chosen = {"adding": "8", "adding, float32": "8", "walker": "1e5", "analog walk": "1e5"}
        if m["family"] not in chosen or m["label"] == chosen[m["family"]]:
            last[m["family"]] = m
    rows = [family for family in FAMILIES if family in last]
    table_ = np.array([[last[f]["error"][name] for name in REGIMES] for f in rows]).T
    axes.imshow(table_, norm=LogNorm(3e-5, 0.3), cmap="RdYlGn_r", aspect="auto", alpha=0.75)
    for i, j in np.ndindex(table_.shape):
        axes.text(j, i, f"{table_[i, j]:.0e}".replace("e-0", "e-"), ha="center", va="center")
    names = [f + (f", {last[f]['label']}" if last[f]["label"] else "") for f in rows]
    names = [name.replace(" ridge", "\nridge").replace(" walk,", "\nwalk,") for name in names]
    names = [n.replace(", ", ",\n", 1) if len(n) > 14 else n for n in names]
    axes.set_xticks(range(len(rows)), names, fontsize=8.5, rotation=30, ha="right")
    axes.set_yticks(range(len(REGIMES)), list(REGIMES), fontsize=10)
    axes.set_title("RMS error in reflectance by method and regime", fontsize=11)
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
