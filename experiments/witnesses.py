"""The fast walk against the deterministic solver, on S1 to S4 and random specimens.

Independent particles, as the solver has them; then, with rejections, what these change and how
well the solver's dead length (`skin.let_stand`) stands for them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from experiments import _shared
from hylios_fit import adding, skin, tally, walker
from hylios_fit.simulation import ABSORB
from hylios_fit.skin import Specimen
from hylios_fit.table import spread

SPECIMENS = 200
WAVELENGTHS = 6  # of each, over the whole range
RAYS = 65_536
ORDER = 8
ENOUGH = 50  # effective rays below which a mean is not normally distributed
FORMS = ("complex", "dispersed", "compact")


def specimen_of(number: int, seed: int) -> tuple[Specimen, np.ndarray]:
    """A specimen from the whole range of parameters, and its wavelengths."""
    if number < 4:
        name = f"S{number + 1}"
        return Specimen.preset(name), np.linspace(260.0, 2400.0, 2 * WAVELENGTHS)
    g = np.random.default_rng([seed, number])
    values = {}
    for axis in _shared.PIGMENTS:
        u = np.array(g.uniform())
        values[axis.name] = float(spread(u, axis.lower, axis.upper, axis.spread))
    for name in skin.LAYERS:
        values[f"thickness_{name}"] = skin.SPECS[f"thickness_{name}"].default * 2 ** g.uniform(
            -1, 1
        )
    shift = g.uniform(-0.03, 0.06)  # the order of the indices stays
    for part in ("corneum", "epidermis", "papillary", "reticular"):
        values[f"index_{part}"] = skin.SPECS[f"index_{part}"].default + shift
    values |= {
        "keratin": g.uniform(0, 3),
        "corneum_tail": g.uniform(0, 3),
        "dna": g.uniform(0, 3),
        "methaemoglobin": g.uniform(0, 40),
        "bilirubin": g.uniform(0, 0.3),
        "fibre_fraction": g.uniform(0.05, 0.4),
        "roughness": g.choice([0.0, 0.05, 0.1, 0.2, 0.4]),
        "bottom_reflectance": g.uniform(0.3, 1.0),
        "reticular_scattering": g.choice([0.0, 30.0]) * g.uniform(),
    }
    if g.uniform() < 0.1:
        values["index_dispersion"] = 0.03 * g.uniform()
    # stratified, so that every part of the range is met
    nm = 250.0 * 10.0 ** ((np.arange(WAVELENGTHS) + g.uniform(size=WAVELENGTHS)) / WAVELENGTHS)
    return Specimen(values, FORMS[number % 3], f"random {number}"), nm


def run(seed: int = 0, specimens: int = SPECIMENS, progress: bool = True) -> dict[str, Any]:
    from scipy.stats import chi2, kstest
    from tqdm import tqdm

    folder = _shared.checkpoint(
        "witnesses", (*_shared.WALK, "adding", "streams"), seed=seed, rays=RAYS, order=ORDER
    )
    parts = []
    for number in tqdm(range(4 + specimens), disable=not progress, unit="specimen"):
        path = folder / f"{number}.npz"
        parts.append(_shared.kept_arrays(path, lambda number=number: _one(number, seed)))
    result: dict[str, Any] = {
        "rays": RAYS, "order": ORDER, "random_specimens": specimens, "enough": ENOUGH,
    }  # fmt: skip
    for kind in ("independent", "rejecting"):
        found: dict[str, Any] = {}
        for label, chosen in (("presets", parts[:4]), ("random", parts[4:]), ("all", parts)):
            statistic = float(sum(p[f"{kind}_chi2"] for p in chosen))
            freedom = int(sum(p[f"{kind}_freedom"] for p in chosen))
            z = np.concatenate([p[f"{kind}_z"] for p in chosen])
            difference = np.concatenate([p[f"{kind}_difference"] for p in chosen])
            found[label] = {
                "chi2": statistic, "freedom": freedom, "p": float(chi2.sf(statistic, freedom)),
                "largest_z": float(np.nanmax(np.abs(z))), "comparisons": int(np.isfinite(z).sum()),
                "rms_difference": float(np.sqrt(np.mean(difference**2))),
                "largest_difference": float(np.abs(difference).max()),
            }  # fmt: skip
        result[kind] = found | {"told": _told([p[f"{kind}_told"] for p in parts])}
    every = {
        name: np.concatenate([p[name] for p in parts]) for name in parts[0] if parts[0][name].ndim
    }
    z = every["independent_z"]
    result["normal_p"] = float(kstest(z[np.isfinite(z)][::3], "norm").pvalue)
    result["rejections_change"] = {
        "rms": float(np.sqrt(np.mean(every["change"] ** 2))),
        "largest": float(np.abs(every["change"]).max()),
        "presets": {f"S{i + 1}": float(np.abs(parts[i]["change"]).max()) for i in range(4)},
    }
    result["points"] = {
        "wavelength_nm": np.round(every["nm"], 1).tolist(),
        "reflectance": np.round(every["reflectance"], 5).tolist(),
        "z": [None if not np.isfinite(v) else round(float(v), 3) for v in z],
        "change": np.round(every["change"], 5).tolist(),
    }
    return result


def _told(parts: list[np.ndarray]) -> dict[str, float]:
    """Of the means after what is known of paths is taken off, as `simulate` gives them, the mean
    square in their standard errors: 1 if they are right. Its own error from specimens, whose
    wavelengths share paths."""
    squares = np.array([np.mean(z[np.isfinite(z)] ** 2) for z in parts if np.isfinite(z).any()])
    return {
        "mean_square_z": _shared.significant(squares.mean(), 4),
        "error": _shared.significant(squares.std(ddof=1) / np.sqrt(len(squares)), 3),
        "largest_z": _shared.significant(np.nanmax(np.abs(np.concatenate(parts))), 4),
        "specimens": len(squares),
    }


def _one(number: int, seed: int) -> dict[str, Any]:
    specimen, nm = specimen_of(number, seed)
    layers = specimen.layers(nm)
    stands = skin.let_stand(layers, specimen.values, specimen.melanosome_form)
    key = jax.random.fold_in(jax.random.key(seed), number)
    found: dict[str, Any] = {"nm": nm}
    exact = {}
    for kind, medium, independent in (("independent", layers, True), ("rejecting", stands, False)):
        solution = adding.skin(medium, order=ORDER)
        surface = np.asarray(solution.surface, float)
        exact[kind] = np.asarray(solution.reflectance, float)
        mean, covariance, total, own = _walked(specimen, layers, key, independent)
        inside = np.asarray(solution.subsurface, float)
        difference = (1 - surface) * mean - inside
        covariance = covariance * np.outer(1 - surface, 1 - surface)
        error = np.sqrt(np.diag(covariance))
        effective = tally.effective_rays((1 - surface) * mean, error, RAYS)
        enough = (effective > ENOUGH) & (error > 0)
        # wavelengths that share nearly all paths are one comparison, not two
        size, vectors = np.linalg.eigh(covariance[np.ix_(enough, enough)])
        kept = size > 1e-3 * size.max(initial=0.0)
        along = vectors[:, kept].T @ difference[enough]
        told = (1 - surface) * np.asarray(total.mean, float) - inside
        spread = (1 - surface) * np.asarray(total.standard_error, float)
        use = enough & (not own)
        found |= {
            f"{kind}_told": np.where(use, told / np.where(use, spread, 1.0), np.nan),
            f"{kind}_difference": difference,
            f"{kind}_z": np.where(enough, difference / np.where(error > 0, error, 1.0), np.nan),
            f"{kind}_chi2": np.sum(along**2 / size[kept]),
            f"{kind}_freedom": kept.sum(),
        }
    return found | {
        "reflectance": exact["rejecting"],
        "change": exact["rejecting"] - exact["independent"],
    }


def _walked(specimen: Specimen, layers: Any, key: jax.Array, independent: bool):
    plan, own = walker.plan_or_own(layers, ABSORB)
    paths = walker.walk(
        plan.layers, specimen.melanosome_form, key, rays=RAYS, independent=independent,
        shares=plan.shares,
    )  # fmt: skip
    total = tally.collect(paths, plan.layers, layers, own_only=own, shares=plan.shares)
    if own:
        mean = np.asarray(total.mean, float)
        covariance = np.diag(np.asarray(total.standard_error, float) ** 2)
    else:
        mean, covariance = tally.moments(paths, plan.layers, 1.0, layers, plan.shares)
    return mean, covariance, total, own


def draw(result: Mapping[str, Any], path: Any) -> None:
    """Differences in standard errors, their distribution, and what rejections change."""
    from scipy.stats import norm

    points = {
        name: np.array([np.nan if v is None else v for v in values], float)
        for name, values in result["points"].items()
    }
    figure = _shared.figure(12.0, 4.2)
    along, spread, change = figure.subplots(1, 3, width_ratios=(4, 3, 4))
    along.plot(points["wavelength_nm"], points["z"], ".", ms=3, color=_shared.COLOURS[0])
    along.set_xscale("log")
    ticks = [250, 400, 700, 1350, 2500]
    along.set_xticks(ticks, [str(tick) for tick in ticks])
    along.set_xticks([], minor=True)
    _shared.tidy(
        along, "wavelength (nm)", "walker - adding (standard errors)",
        f"independent particles: chi-square {result['independent']['all']['chi2']:.0f}\n"
        f"for {result['independent']['all']['freedom']}, "
        f"p = {result['independent']['all']['p']:.2g}",
    )  # fmt: skip
    z = points["z"][np.isfinite(points["z"])]
    x = np.linspace(-4.5, 4.5, 200)
    spread.hist(z, 45, range=(-4.5, 4.5), density=True, color=_shared.COLOURS[0], alpha=0.6)
    spread.plot(x, norm.pdf(x), color=_shared.COLOURS[1], label="normal")
    spread.legend(fontsize=8)
    _shared.tidy(spread, "difference (standard errors)", "density")
    change.plot(points["reflectance"], points["change"], ".", ms=3, color=_shared.COLOURS[2])
    _shared.tidy(
        change, "reflectance", "change of reflectance", "what the rejection of particles changes"
    )
    _shared.save_figure(figure, path)
