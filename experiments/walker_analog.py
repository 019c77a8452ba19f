"""The fast walk against the literal one, on S1 to S4 from 250 to 2500 nm."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from experiments import _shared
from hylios_fit.simulation import simulate
from hylios_fit.skin import Specimen

WAVELENGTHS = (
    250.0, 300.0, 350.0, 415.0, 480.0, 545.0, 577.0, 640.0, 720.0, 850.0, 1000.0, 1200.0, 1450.0,
    1700.0, 1940.0, 2200.0, 2500.0,
)  # fmt: skip
# S4's dispersed melanosomes are hit hundreds of times by a ray that is not absorbed.
ANALOG_RAYS: Mapping[str, int] = {"S1": 4096, "S2": 4096, "S3": 4096, "S4": 1024}
ANALOG_LOT = 1024
# The walker's rays go out in lots, whose spread gives the covariance between wavelengths
# that their shared paths make, and tries the standard error that the walker states.
LOTS = 32
LOT_RAYS = 4096
LIMIT = 4.0


def run(
    seed: int = 0,
    wavelengths: Any = WAVELENGTHS,
    analog_rays: Mapping[str, int] = ANALOG_RAYS,
    lots: int = LOTS,
    lot_rays: int = LOT_RAYS,
    progress: bool = True,
) -> dict[str, Any]:
    """z-scores of walker minus analog and their chi-square; what is done already is kept."""
    from scipy.stats import chi2, norm
    from tqdm import tqdm

    nm = np.asarray(wavelengths, float)
    key = jax.random.key(seed)
    specimens = {}
    statistic, freedom = 0.0, 0
    with tqdm(total=len(analog_rays) * len(nm), disable=not progress, unit="point") as bar:
        for number, (name, rays) in enumerate(analog_rays.items()):
            own = jax.random.fold_in(key, number)
            analog, analog_error = _analog(name, nm, rays, own, seed, bar)
            lot = _walker(name, nm, lots, lot_rays, jax.random.fold_in(own, 1_000_000))
            walker = lot["reflectance"].mean(axis=0)
            error = np.sqrt(np.mean(lot["standard_error"] ** 2, axis=0) / lots)
            covariance = np.cov(lot["reflectance"], rowvar=False).reshape(len(nm), -1) / lots
            difference = walker - analog
            own_statistic = difference @ np.linalg.solve(
                covariance + np.diag(analog_error**2), difference
            )
            statistic, freedom = statistic + own_statistic, freedom + len(nm)
            specimens[name] = {
                "analog_rays": -(-rays // ANALOG_LOT) * ANALOG_LOT,
                "walker_rays": lots * lot_rays,
                "analog": _shared.significant(analog, 6),
                "analog_error": _shared.significant(analog_error),
                "walker": _shared.significant(walker, 6),
                "walker_error": _shared.significant(error),
                "walker_spread_over_stated": _shared.significant(
                    np.sqrt(np.diag(covariance)) / error, 3
                ),
                "z": _shared.significant(difference / np.hypot(error, analog_error)),
                "chi2": _shared.significant(own_statistic),
                "p": _shared.significant(chi2.sf(own_statistic, len(nm))),
            }
    z = np.concatenate([specimen["z"] for specimen in specimens.values()])
    largest = float(np.max(np.abs(z)))
    return {
        "wavelength_nm": nm.tolist(),
        "limit": LIMIT,
        "specimens": specimens,
        "comparisons": int(z.size),
        "largest_abs_z": largest,
        # how often chance alone gives one as large among so many
        "p_of_largest": _shared.significant(-np.expm1(z.size * np.log1p(-2 * norm.sf(largest)))),
        "mean_z": _shared.significant(z.mean()),
        "sd_z": _shared.significant(z.std(ddof=1)),
        "chi2": _shared.significant(statistic),
        "degrees_of_freedom": freedom,
        "p": _shared.significant(chi2.sf(statistic, freedom)),
        "agree": largest < LIMIT,
    }


def _analog(
    name: str, nm: np.ndarray, rays: int, key: jax.Array, seed: int, bar: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance and its standard error; lots of rays that are done are in the checkpoint."""
    folder = _shared.checkpoint(
        "analog", (*_shared.WALK, "analog", "simulation"), specimen=name, seed=seed, lot=ANALOG_LOT
    )
    lots = -(-rays // ANALOG_LOT)
    found = []
    for wavelength in nm:
        path = folder / f"{wavelength:g}.json"
        done = json.loads(path.read_text()) if path.exists() else []
        own = jax.random.fold_in(key, round(wavelength * 10))
        for lot in range(len(done), lots):
            curve = simulate(
                Specimen.preset(name), [wavelength], method="analog", rays=ANALOG_LOT,
                key=jax.random.fold_in(own, lot),
            )  # fmt: skip
            done.append(float(curve.reflectance[0]))
            _shared.save_json(path, done)
        found.append(np.mean(done[:lots]))
        bar.update(1)
    mean, sent = np.array(found), lots * ANALOG_LOT
    # one ray more of each kind keeps the error of a rare outcome above 0, as in `simulate`
    p = (mean * sent + 1.0) / (sent + 2.0)
    return mean, np.sqrt(p * (1.0 - p) / sent)


def _walker(
    name: str, nm: np.ndarray, lots: int, rays: int, key: jax.Array
) -> dict[str, np.ndarray]:
    curves = [
        simulate(Specimen.preset(name), nm, rays=rays, key=jax.random.fold_in(key, lot))
        for lot in range(lots)
    ]
    return {
        part: np.array([getattr(curve, part) for curve in curves])
        for part in ("reflectance", "standard_error")
    }


def draw(result: dict[str, Any], path: Any) -> None:
    """Curves of both walks, and their difference in standard errors."""
    figure = _shared.figure(9.0, 7.0)
    curves, scores = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    nm = np.array(result["wavelength_nm"])
    for i, (name, found) in enumerate(result["specimens"].items()):
        colour = _shared.COLOURS[i]
        curves.plot(nm, found["walker"], color=colour, lw=1.4, label=f"{name} walker")
        curves.errorbar(
            nm, found["analog"], yerr=2 * np.array(found["analog_error"]), fmt="o", ms=3.5,
            color=colour, mfc="white", capsize=2, lw=1,
            label=f"{name} analog, {found['analog_rays']:,} rays a point, ±2 SE",
        )  # fmt: skip
        # side by side, or the four would hide each other
        scores.plot(nm * (1 + 0.006 * (i - 1.5)), found["z"], "o", ms=4, color=colour, label=name)
    curves.legend(fontsize=7.5, ncols=2)
    _shared.tidy(curves, "", "reflectance (specular included)")
    scores.axhline(0, color="black", lw=0.8)
    for limit in (-result["limit"], result["limit"]):
        scores.axhline(limit, color="black", lw=0.8, ls="--")
    scores.axhspan(-1, 1, color="black", alpha=0.06)
    scores.set_xscale("log")
    ticks = [250, 350, 500, 700, 1000, 1500, 2000, 2500]
    scores.set_xticks(ticks, [str(tick) for tick in ticks])
    scores.set_xticks([], minor=True)
    _shared.tidy(
        scores, "wavelength (nm)", "walker - analog (standard errors)",
        f"largest |z| {result['largest_abs_z']:.2f} of {result['comparisons']}; chi-square "
        f"{result['chi2']:.1f} for {result['degrees_of_freedom']}, p = {result['p']:.2f}",
    )  # fmt: skip
    _shared.save_figure(figure, path)
