"""Recovery of specimens drawn from the prior: do the 68 % intervals hold the truth in 68 %?

The spectra are those of the walker, which knows nothing of the surrogate that fits them. Their
noise is what each kind states:

- `analog`: the walker's error, and on top of it the binomial error that `ANALOG_RAYS` rays of the
  literal walk have in each band (0.0016 at a reflectance of 0.5), independent between bands;
- `walker`: nothing but the walker's own error. Bands share paths, and so errors: the fit is told
  their whole covariance;
- `diagonal`: the same spectra, the fit told standard errors only, as if bands were independent.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import numpy as np

from experiments import _shared

STEP_NM = 10.0
SPECIMENS = 200
RAYS = 131_072  # of the walker for a specimen
ANALOG_RAYS = 100_000
ABSORB = 0.5  # as in `simulate`
RANGES: Mapping[str, tuple[float, float]] = {"250-2500": (250, 2500), "400-700": (400, 700)}
KINDS = ("analog", "walker", "diagonal")
SHOWN = "analog"
QUANTITIES = ("melanin_mg_per_mL", "blood_percent", "oxygen_saturation", "water_percent")
TARGET = (0.60, 0.76)
NORMAL_95 = 1.959964


def run(
    seed: int = 0,
    specimens: int = SPECIMENS,
    rays: int = RAYS,
    surrogate: Any = None,
    simulated: Any = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Coverage by quantity, kind of noise and range; simulations that are done are kept.

    `simulated`: (truth, form, key) -> reflectance (B,) and covariance (B, B) on `bands()`, in place
    of the walker.
    """
    from tqdm import tqdm

    from hylios_fit.surrogate import load_surrogate

    surrogate = surrogate or load_surrogate()
    member = surrogate.at(surrogate.forms[0])
    key = jax.random.key(seed)
    truths, forms = draws(surrogate, specimens, jax.random.fold_in(key, 0))
    nm = bands()
    simulated = simulated or partial(walked, names=member.names, rays=rays)
    folder = _shared.checkpoint(
        "recovery", _shared.WALK, truths=truths.tolist(), rays=rays, seed=seed,
        bands=nm.tolist(), by=getattr(simulated, "__name__", "walker"),
    )  # fmt: skip

    def one(i: int) -> dict[str, np.ndarray]:
        def make() -> dict[str, np.ndarray]:
            own = jax.random.fold_in(jax.random.fold_in(key, 1), i)
            reflectance, covariance = simulated(truths[i], forms[i], key=own)
            return {"reflectance": reflectance, "covariance": covariance}

        return _shared.kept_arrays(folder / f"{i:04d}.npz", make)

    bar = partial(tqdm, total=specimens, unit="specimen", disable=not progress)
    made = list(bar(map(one, range(specimens)), desc="walk"))
    rng = np.random.default_rng(seed)
    rows = [
        _fits(truth, form, nm, found["reflectance"], found["covariance"], surrogate, rng)
        for truth, form, found in bar(zip(truths, forms, made, strict=True), desc="fit")
    ]
    masks = _shared.band_masks(nm)
    error = np.sqrt([np.diag(found["covariance"]) for found in made])
    return {
        "surrogate": _shared.surrogate_record(surrogate),
        "specimens": specimens,
        "forms": dict(Counter(forms)),
        "step_nm": STEP_NM,
        "walker_rays": rays,
        "analog_rays": ANALOG_RAYS,
        "noise": {
            "walker": {name: _shared.quantiles(error[:, mask]) for name, mask in masks.items()},
            "analog_at_half": _shared.significant(0.5 / np.sqrt(ANALOG_RAYS)),
        },
        "target": list(TARGET),
        "cases": {
            f"{kind} {name}": _summary([row[kind, name] for row in rows], forms)
            for kind in KINDS
            for name in RANGES
        },
        "shown": {
            name: _points([row[SHOWN, name] for row in rows]) for name in RANGES
        },
    }  # fmt: skip


def bands() -> np.ndarray:
    return np.arange(250.0, 2500.1, STEP_NM)


def draws(surrogate: Any, count: int, key: jax.Array) -> tuple[np.ndarray, list[str]]:
    """(count, P) parameters from the prior within the surrogate's box, the forms in turn."""
    from hylios_fit.statevector import state_vector

    member = surrogate.at(surrogate.forms[0])
    vector = state_vector(member.names, member.lower, member.upper)
    forms = [surrogate.forms[i % len(surrogate.forms)] for i in range(count)]
    return vector.prior_draws(key, count), forms


def walked(
    truth: np.ndarray, form: str, names: tuple[str, ...], rays: int, key: jax.Array
) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance (B,) of a specimen by the walker, and the covariance (B, B) of its error."""
    from hylios_fit.simulation import with_covariance
    from hylios_fit.skin import Specimen

    specimen = Specimen(dict(zip(names, truth.tolist(), strict=True)), form, "drawn")
    return with_covariance(specimen, bands(), rays, key)


def _fits(
    truth: np.ndarray,
    form: str,
    nm: np.ndarray,
    reflectance: np.ndarray,
    covariance: np.ndarray,
    surrogate: Any,
    rng: np.random.Generator,
) -> dict[tuple[str, str], dict[str, Any]]:
    from hylios_fit.inversion import fit
    from hylios_fit.statevector import derived

    member = surrogate.at(form)
    true = {name: float(value) for name, value in derived(member.names, truth).items()}
    binomial = np.clip(reflectance * (1.0 - reflectance), 0.0, None) / ANALOG_RAYS
    noisy = reflectance + rng.normal(size=nm.size) * np.sqrt(binomial)
    cases = {
        "analog": (noisy, covariance + np.diag(binomial)),
        "walker": (reflectance, covariance),
        "diagonal": (reflectance, np.diag(np.diag(covariance))),
    }
    box = _box(member)
    found = {}
    for kind, (values, noise) in cases.items():
        for name, (low, high) in RANGES.items():
            kept = (nm >= low) & (nm <= high)
            one = fit((nm[kept], values[kept]), surrogate, noise=noise[np.ix_(kept, kept)])
            found[kind, name] = {
                "outcome": one.outcome.code,
                "form": one.form,
                "reduced_chi2": one.reduced_chi2,
                "inflation": one.inflation,
                "residual_rms": one.residual_rms,
                **{q: _standing(one[q], true[q], box.get(q)) for q in QUANTITIES},
            }
    return found


def _box(member: Any) -> dict[str, tuple[float, float]]:
    from hylios_fit.statevector import DERMIS_WATER_PERCENT

    at = {name: i for i, name in enumerate(member.names)}
    scale = {"oxygen_saturation": ("oxygen_saturation", 1.0),
             "water_percent": ("water", DERMIS_WATER_PERCENT)}  # fmt: skip
    return {
        quantity: (factor * float(member.lower[at[name]]), factor * float(member.upper[at[name]]))
        for quantity, (name, factor) in scale.items()
    }


def _standing(
    estimate: Any, truth: float, box: tuple[float, float] | None
) -> tuple[float, float, float, float, bool, float]:
    """Truth, value, interval, informed, and the error in standard deviations of the estimate.

    Intervals are symmetric in the logarithm of melanin and blood and, for a parameter of the state,
    in the logit of its place in the box: there the error is taken.
    """

    def spread(x: float) -> float:
        if box is None:
            return float(np.log(x))
        share = np.clip((x - box[0]) / (box[1] - box[0]), 1e-12, 1 - 1e-12)
        return float(np.log(share) - np.log1p(-share))

    if not np.isfinite(estimate.value):
        return truth, np.nan, np.nan, np.nan, False, np.nan
    middle = spread(estimate.value)
    sd = (spread(estimate.high) - spread(estimate.low)) / 2.0
    return (
        truth, estimate.value, estimate.low, estimate.high, bool(estimate.informed),
        (spread(truth) - middle) / max(sd, 1e-12),
    )  # fmt: skip


def _summary(rows: list[dict[str, Any]], forms: list[str]) -> dict[str, Any]:
    outcomes = Counter(row["outcome"] for row in rows)
    quantities = {}
    for name in QUANTITIES:
        columns = list(zip(*(row[name] for row in rows), strict=True))
        truth, value, low, high = (np.array(column, float) for column in columns[:4])
        informed = np.array(columns[4], bool)
        score = np.array(columns[5], float)
        inside = (truth >= low) & (truth <= high)
        known = np.isfinite(value)
        parts = {"all": known, "informed": known & informed, "not_informed": known & ~informed}
        quantities[name] = {
            part: _coverage(inside[mask], score[mask], truth[mask], value[mask])
            for part, mask in parts.items()
        }
    return {
        "outcomes": {name: outcomes[name] for name in sorted(outcomes)},
        "form_found": float(
            np.mean([row["form"] == form for row, form in zip(rows, forms, strict=True)])
        ),
        "inflated": float(np.mean([row["inflation"] > 1.0 for row in rows])),
        "reduced_chi2": _shared.quantiles([row["reduced_chi2"] for row in rows]),
        "residual_rms": _shared.quantiles([row["residual_rms"] for row in rows]),
        "quantities": quantities,
    }


def _coverage(
    inside: np.ndarray, score: np.ndarray, truth: np.ndarray, value: np.ndarray
) -> dict[str, Any]:
    from scipy.stats import binomtest

    n = len(inside)
    if n == 0:
        return {"n": 0}
    in_68, in_95 = int(inside.sum()), int((np.abs(score) <= NORMAL_95).sum())
    return {
        "n": n,
        "in_68": in_68,
        "share_68": _shared.significant(in_68 / n),
        "share_68_interval_95": _exact(binomtest(in_68, n)),
        "share_95": _shared.significant(in_95 / n),
        "share_95_interval_95": _exact(binomtest(in_95, n)),
        "mean_score": _shared.significant(score.mean()),
        "rms_score": _shared.significant(np.sqrt(np.mean(score**2))),
        "median_abs_relative_error": _shared.significant(np.median(np.abs(value / truth - 1))),
    }


def _exact(test: Any) -> list[float]:
    found = test.proportion_ci(0.95)
    return _shared.significant([found.low, found.high])


def _points(rows: list[dict[str, Any]]) -> dict[str, dict[str, list[Any]]]:
    columns = ("truth", "value", "low", "high", "informed")
    return {
        name: {
            column: [
                bool(row[name][i]) if column == "informed" else _shared.significant(row[name][i])
                for row in rows
            ]
            for i, column in enumerate(columns)
        }
        for name in QUANTITIES
    }


LABELS = {
    "melanin_mg_per_mL": "melanin (mg/mL)",
    "blood_percent": "blood (% of the dermis)",
    "oxygen_saturation": "oxygen saturation",
    "water_percent": "water (% of the dermis)",
}


def draw(result: dict[str, Any], path: Any) -> None:
    """Estimates with their intervals over the truth, for both ranges."""
    figure = _shared.figure(13.0, 3.4 * len(result["shown"]))
    panels = figure.subplots(len(result["shown"]), len(QUANTITIES), squeeze=False)
    for row, (name, points) in zip(panels, result["shown"].items(), strict=True):
        covered = result["cases"][f"{SHOWN} {name}"]["quantities"]
        for panel, quantity in zip(row, QUANTITIES, strict=True):
            got = points[quantity]
            truth, value, low, high = (
                _shared.floats(got[part]) for part in ("truth", "value", "low", "high")
            )
            informed = np.array(got["informed"], bool)
            for mask, colour, label in (
                (informed, "#1b6ca8", "informed"), (~informed, "#b0b0b0", "mostly prior"),
            ):  # fmt: skip
                if mask.any():
                    panel.errorbar(
                        truth[mask], value[mask],
                        yerr=[(value - low)[mask], (high - value)[mask]],
                        fmt="o", ms=2.5, lw=0.7, color=colour, label=f"{label} ({mask.sum()})",
                    )  # fmt: skip
            ends = [np.nanmin([truth, value]), np.nanmax([truth, value])]
            panel.plot(ends, ends, color="black", lw=0.8)
            if quantity in ("melanin_mg_per_mL", "blood_percent"):
                _shared.logarithmic(panel.xaxis)
                _shared.logarithmic(panel.yaxis)
            panel.legend(fontsize=7)
            part = covered[quantity]["informed"]
            told = "none informed"
            if part["n"]:
                told = f"{part['in_68']} of {part['n']} held"
            label = LABELS[quantity]
            _shared.tidy(panel, f"true {label}", f"estimated {label}", f"{name} nm: {told}")
    _shared.save_figure(figure, path)
