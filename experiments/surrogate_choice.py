"""Which regression on how many principal components, and how it is trained: error against cost."""

from __future__ import annotations

import itertools
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import _fresh, _shared
from hylios_fit import table, training
from hylios_fit.perceptron import Perceptron
from hylios_fit.surrogate import features
from hylios_fit.threads import one_blas_thread

FORM = "complex"
CHOSEN = training.SIZES["small"][0]
LOCAL_STEPS = 10_000
STEPS = 10_000
BATCH = 1024
ADAM, HALVINGS = 4, 9
SPECIMENS = 32_768
FRESH = 64  # of each kind
PERCEPTRONS = (
    (64, 64), (96, 64, 48), (128, 96, 64), (192, 128, 128), (256, 256, 192), (384, 256, 256),
)  # fmt: skip
COMPONENTS = (5, 10, 20, 40, 60, 80)
BANDS = 3
MODULES = (
    "training", "perceptron", "table", "surrogate", "skin", "adding", "streams", "statevector",
)  # fmt: skip


def run(
    seed: int = 0,
    data: Any = None,
    local_steps: int = LOCAL_STEPS,
    steps: int = STEPS,
    batch: int = BATCH,
    specimens: int = SPECIMENS,
    fresh: int = FRESH,
    perceptrons: tuple[tuple[int, ...], ...] = PERCEPTRONS,
    progress: bool = True,
) -> dict[str, Any]:
    """The training of the small embedded surrogate, of one form, with fewer steps and specimens and
    with other regressions; held against the solver on specimens that none has seen."""
    from tqdm import tqdm

    if data is None:
        data = _fresh.training_table("adding", table.ROWS, progress=progress)
    names = training.box_of(data)[0]
    key = jax.random.fold_in(jax.random.key(seed), 400)
    settings = {"local_steps": local_steps, "specimens": specimens, "rows": int(data.sizes["row"])}
    folder = _shared.checkpoint("surrogate_choice", MODULES, seed=seed, fresh=fresh, **settings)
    held = {}
    for number, (kind, free) in enumerate((("usual", ("usual",)), ("every", names))):
        own = jax.random.fold_in(key, number)
        solved = partial(_fresh.specimens, data, FORM, fresh, own, free, progress)
        found = _shared.kept_arrays(folder / f"{kind}.npz", lambda f=solved: f()._asdict())
        held[kind] = _fresh.Fresh(**found)
    drawn = training.specimens(data, seed, specimens)

    def answers() -> dict[str, np.ndarray]:
        print("local regression", flush=True)
        with one_blas_thread():
            local = training.learn_locally(data, FORM, seed, steps=local_steps)
        every = {kind: local(names, part.rows) for kind, part in held.items()}
        return {"drawn": local(names, drawn), **every}

    log = _shared.kept_arrays(folder / "answers.npz", answers)

    def seen(rows: np.ndarray) -> np.ndarray:
        return np.asarray(features(names, FORM, jnp.asarray(rows, jnp.float32)), float)

    def rms(answers: dict[str, np.ndarray]) -> dict[str, float]:
        errors = {kind: part.errors(answers[kind]) for kind, part in held.items()}
        return {k: _shared.significant(np.sqrt(np.mean(e**2)), 3) for k, e in errors.items()}

    x, asked = seen(drawn), {kind: seen(part.rows) for kind, part in held.items()}

    def learned(network: Any) -> dict[str, Any]:
        start = time.perf_counter()
        fitted = training.fit(x, log["drawn"], network)
        widths = (x.shape[1], *network.hidden, BANDS)
        return {
            "hidden": list(network.hidden),
            "seconds": round(time.perf_counter() - start, 1),
            "products": sum(a * b for a, b in itertools.pairwise(widths)),
            "rms": rms(
                {k: _perceptron(fitted, part, network.activation) for k, part in asked.items()}
            ),
        }

    sizes = [Perceptron(hidden, steps, batch, seed=seed) for hidden in perceptrons]
    networks = [Adam(CHOSEN, ADAM * steps, batch, seed), *sizes[::-1]]  # longest first
    with one_blas_thread(), ThreadPoolExecutor(training.THREADS) as pool:
        made = pool.map(learned, networks)
        adam, *made = tqdm(made, total=len(networks), unit="perceptron", disable=not progress)
    return {
        "form": FORM, **settings, "steps": steps, "batch": batch, "fresh": fresh, "bands": BANDS,
        "chosen": list(CHOSEN), "components": training.COMPONENTS,
        "local": rms(log),
        "perceptrons": made[::-1],
        "adam": {**adam, "steps": ADAM * steps},
        "ridge": [_ridge(x, log["drawn"], asked, degree, rms) for degree in (1, 2)],
        "truncated": _truncated(log["drawn"]),
    }  # fmt: skip


class Adam:
    """Scikit-learn's own perceptron, its rate halved eight times over the steps."""

    activation = "tanh"

    def __init__(self, hidden: tuple[int, ...], steps: int, batch: int, seed: int):
        self.hidden, self.steps, self.batch, self.seed = hidden, steps, batch, seed

    def fit(self, x: np.ndarray, y: np.ndarray) -> None:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.neural_network import MLPRegressor

        x, y = x.astype(np.float32), y.astype(np.float32)
        batch: Any = self.batch
        network: Any = MLPRegressor(
            hidden_layer_sizes=self.hidden, activation=self.activation, batch_size=batch, alpha=0.0,
            warm_start=True,
            max_iter=max(round(self.steps * self.batch / len(x) / HALVINGS), 1), tol=0.0,
            n_iter_no_change=10**9, random_state=self.seed,
        )  # fmt: skip
        for halved in range(HALVINGS):
            network.set_params(learning_rate_init=3e-3 * 0.5**halved)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ConvergenceWarning)  # it ends as it was told to
                network.fit(x, y)
        self.coefs_, self.intercepts_ = network.coefs_, network.intercepts_


def _perceptron(fitted: dict[str, np.ndarray], x: np.ndarray, activation: str) -> np.ndarray:
    x = (x - fitted["centre"]) / fitted["scale"]
    layers = sum(name.startswith("weight") for name in fitted)
    for i in range(layers):
        x = x @ fitted[f"weight{i}"] + fitted[f"bias{i}"]
        x = np.asarray(getattr(jax.nn, activation)(x)) if i < layers - 1 else x
    return x @ fitted["components"] + fitted["mean"]


def _ridge(x: Any, log: np.ndarray, asked: Any, degree: int, rms: Any) -> dict[str, Any]:
    from sklearn.linear_model import Ridge
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    model = make_pipeline(StandardScaler(), PolynomialFeatures(degree), Ridge(1.0))
    model.fit(x.astype(np.float32), log)
    terms = int(model.named_steps["polynomialfeatures"].n_output_features_)
    answers = {kind: model.predict(part.astype(np.float32)) for kind, part in asked.items()}
    return {"degree": degree, "products": terms * (1 + BANDS), "rms": rms(answers)}


def _truncated(log: np.ndarray) -> list[dict[str, float]]:
    """What so many components leave out of the prior's spectra, in reflectance."""
    from sklearn.decomposition import PCA

    pca: Any = PCA(max(COMPONENTS), random_state=0).fit(log.astype(float))
    last = log[-4096:]
    scores = pca.transform(last.astype(float))
    found = []
    for count in COMPONENTS:
        back = scores[:, :count] @ pca.components_[:count] + pca.mean_
        error = np.sqrt(np.mean((np.exp(back) - np.exp(last)) ** 2))
        found.append({"components": count, "rms": _shared.significant(error, 3)})
    return found


def draw(result: dict[str, Any], path: Any) -> None:
    """Error against products, and against components."""
    figure = _shared.figure(10, 4.4)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    labels = {"usual": "pigments, blood, water, lipids free", "every": "every parameter free"}
    for (kind, label), colour in zip(labels.items(), _shared.COLOURS, strict=False):
        for name, marker in (("perceptrons", "o"), ("ridge", "^")):
            points = result[name]
            left.plot(
                [p["products"] for p in points], [p["rms"][kind] for p in points], marker,
                color=colour, label=f"{name.rstrip('s')}, {label}",
            )  # fmt: skip
        adam = result["adam"]
        left.plot(
            adam["products"], adam["rms"][kind], "x", color=colour,
            label=f"by Adam in {adam['steps'] // result['steps']} times the steps",
        )  # fmt: skip
        for point in result["perceptrons"] if kind == "usual" else ():
            left.annotate(
                "-".join(map(str, point["hidden"])), (point["products"], point["rms"][kind]),
                (-6 if len(point["hidden"]) == 2 else 2, -5), textcoords="offset points",
                fontsize=7, rotation=90, ha="center", va="top",
            )  # fmt: skip
        left.axhline(result["local"][kind], color=colour, ls=":", lw=1)
    _shared.logarithmic(left.xaxis)
    left.set_yscale("log")
    left.set_ylim(bottom=4e-5)
    left.tick_params(axis="x", labelsize=8, rotation=30)
    left.legend(fontsize=7, loc="center left", bbox_to_anchor=(0.0, 0.66))
    title = "dotted: what they learned from"
    _shared.tidy(left, "products for three bands", "RMS error of the reflectance", title)
    points = result["truncated"]
    right.plot([p["components"] for p in points], [p["rms"] for p in points], "o-", ms=4)
    right.set_yscale("log")
    _shared.tidy(right, "principal components", "RMS error of the reflectance by what is left out")
    _shared.save_figure(figure, path)
