"""No more than a scene needs: the error and the time saved against what is dropped.

Four scenes of light to brown skin. Everything is solved first at every wavelength at the usual
order of the solver (the truth, good to 2e-5 RMS and 2e-4 at most, and its time); then as planned
for tolerances from 0.0005 to 0.02, on specimens that no plan has seen. Their bands, with as much
noise as the tolerance, are then fitted as planned, and as without a plan: by the large surrogate,
with the usual parameters free.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from experiments import _shared
from hylios_fit import adding, planning
from hylios_fit.inversion import fit_many
from hylios_fit.planning import Plan, Scene, plan
from hylios_fit.skin import SPECS, Specimen
from hylios_fit.statevector import derived
from hylios_fit.surrogate import EMBEDDED, load_surrogate

RANGES = {
    "melanosome_basale": (0.5, 8.0),
    "colloidal_melanin": (0.5, 5.0),
    "eumelanin": (20.0, 90.0),
    "blood_papillary": (0.1, 3.0),
    "blood_reticular": (0.1, 3.0),
    "oxygen_saturation": (0.3, 1.0),
    "water": (0.7, 1.2),
    "lipids": (0.3, 1.7),
}
TOLERANCES = (0.02, 0.005, 0.002, 0.0005)
FRESH = 24
TRUTH = 8
TIMED = 32  # specimens at once
MARKERS = {"solver": "D", "large surrogate": "o", "small surrogate": "s"}
ASKED = ("melanin_mg_per_mL", "blood_percent", "oxygen_saturation")
MODULES = (
    *_shared.WALK, "adding", "inversion", "planning", "simulation", "statevector", "streams",
    "surrogate", "table",
)  # fmt: skip


def scenes() -> dict[str, Scene]:
    """Bands of four instruments; the camera's are Gaussian, 70 nm wide at half of their height."""
    nm = np.arange(400.0, 701.0, 5.0)
    camera = np.stack([np.exp(-0.5 * ((nm - centre) / 30.0) ** 2) for centre in (600, 540, 450)])
    return {
        "camera, 3 bands": Scene(nm, camera, ranges=RANGES),
        "oximeter, 5 bands": Scene([660.0, 730.0, 800.0, 850.0, 940.0], ranges=RANGES),
        "visible, 400:700:10": Scene(np.arange(400.0, 701.0, 10.0), ranges=RANGES),
        "whole range, 250:2500:10": Scene(np.arange(250.0, 2501.0, 10.0), ranges=RANGES),
    }


def run(seed: int = 0) -> dict[str, Any]:
    """What is dropped, the error and the time, for each scene and tolerance; resumable."""
    surrogate = {size: _shared.embedded_hash(size) for size in EMBEDDED}
    folder = _shared.checkpoint(
        "plan", MODULES, ranges=RANGES, seed=seed, fresh=FRESH, surrogate=surrogate
    )
    found: dict[str, Any] = {}
    for name, scene in scenes().items():
        part = name.split(",")[0]
        found[name] = _shared.kept(folder, part, lambda scene=scene: _scene(scene, seed))
    return {
        "tolerances": TOLERANCES,
        "fresh": FRESH,
        "truth_order": TRUTH,
        "surrogate": surrogate,
        "scenes": found,
    }


def _scene(scene: Scene, seed: int) -> dict[str, Any]:
    share = np.random.default_rng(seed + 1).random((FRESH, len(scene.ranges)))
    rows = scene.values(share)
    specimens = [Specimen(dict(zip(SPECS, row, strict=True))) for row in rows]
    everything = np.ones((FRESH, 6))
    truth = planning._spectra(scene, rows, everything, scene.wavelength_nm, TRUTH)
    truth = truth @ scene.weights.T
    many = (specimens * (-(-TIMED // FRESH)))[:TIMED]
    full = _seconds(lambda: _whole(scene, many)) / TIMED
    large = load_surrogate().on(scene.wavelength_nm, scene.response)
    form: dict[str, Any] = {"melanosome_form": scene.specimen.melanosome_form}
    steps = []
    for tolerance in TOLERANCES:
        start = time.perf_counter()
        made = plan(scene, tolerance)
        took = time.perf_counter() - start
        noise = tolerance * np.random.default_rng(seed + 2).normal(size=truth.shape)
        measured = scene.centre_nm, truth + noise
        missed = made.reflectance(specimens) - truth
        steps.append(
            {
                "tolerance": tolerance,
                "dropped": {n: _shared.significant(e, 2) for n, e in made.dropped.items()},
                "kept": {n: _shared.significant(e, 2) for n, e in made.kept.items()},
                "told": {n: _shared.significant(e, 2) for n, e in made.told.items()},
                "method": made.method,
                "size": made.size,
                "order": made.order,
                "wavelengths": len(made.wavelength_nm),
                "of_wavelengths": len(scene.wavelength_nm),
                "rays": made.rays,
                "error_seen": _shared.significant(made.error, 3),
                "error": _shared.significant(np.abs(missed).max(), 3),
                "rms": _shared.significant(np.sqrt(np.mean(missed**2)), 3),
                "seconds": _shared.significant(_seconds(lambda m=made: _planned(m, many)) / TIMED),
                "planning_s": _shared.significant(took, 2),
                "fit": _fitted(rows, measured, tolerance, plan=made),
                "usual_fit": _fitted(rows, measured, tolerance, surrogate=large, fix=form),
            }
        )
    return {"seconds": _shared.significant(full), "order": adding.ORDER, "steps": steps}


def _whole(scene: Scene, specimens: list[Specimen]) -> np.ndarray:
    rows = np.array([list(specimen.values.values()) for specimen in specimens])
    medium = planning.side_by_side(rows, "complex", scene.wavelength_nm)
    found = adding.skin(medium, order=adding.ORDER).reflectance
    return np.asarray(found, float).reshape(len(rows), -1) @ scene.weights.T


def _planned(made: Plan, specimens: list[Specimen]) -> np.ndarray:
    return made.reflectance(specimens)


def _fitted(rows: np.ndarray, measured: Any, noise: float, **how: Any) -> dict[str, Any]:
    """Core time of a fit, how many of the true values its 68 % intervals hold where the bands tell
    the quantity, and its median error and interval (half of its width) as a share of the value."""

    for _ in range(2):  # once to compile
        start = time.process_time()
        found = fit_many(measured, noise=noise, progress=False, **how)
        seconds = (time.process_time() - start) / len(rows)
    true = derived(tuple(SPECS), rows)
    quantities = {}
    for name in ASKED:
        told = [i for i, one in enumerate(found) if one[name].informed]
        estimates = [found[i][name] for i in told]
        value, low, high = (
            np.array([getattr(e, part) for e in estimates]) for part in ("value", "low", "high")
        )
        exact = true[name][told]
        held = (low <= exact) & (exact <= high)
        quantities[name] = {"told": len(told), "in_68": int(held.sum())}
        if told:
            quantities[name] |= {
                "error": _shared.significant(np.median(np.abs(value / exact - 1.0)), 2),
                "interval": _shared.significant(np.median((high - low) / (2.0 * value)), 2),
            }
    return {
        "free": len(found[0].names),
        "outcomes": dict(Counter(one.outcome.code for one in found)),
        "seconds": _shared.significant(seconds, 2),
        "quantities": quantities,
    }


def _seconds(call: Callable[[], Any], repeats: int = 5) -> float:
    """Core time, median, compiled."""
    call()
    found = []
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(call())
        found.append(time.process_time() - start)
    return float(np.median(found))


def draw(result: dict[str, Any], path: Any) -> None:
    """Error and time against the tolerance, and what was dropped at each."""
    figure = _shared.figure(14.0, 9.5)
    above, below = figure.subfigures(2, 1, height_ratios=(1, 1.25))
    errors, times, fits = above.subplots(1, 3)
    kept = below.subplots(1, len(result["scenes"]))
    tolerances = np.array(result["tolerances"])
    for i, (name, scene) in enumerate(result["scenes"].items()):
        colour = _shared.COLOURS[i]
        steps = scene["steps"]
        errors.plot(tolerances, [s["error"] for s in steps], "o-", color=colour, label=name)
        errors.plot(tolerances, [s["rms"] for s in steps], "o:", color=colour, mfc="white", lw=1)
        gain = [scene["seconds"] / s["seconds"] for s in steps]
        times.plot(tolerances, gain, "-", color=colour, label=name)
        for tolerance, s, at in zip(tolerances, steps, gain, strict=True):
            solved = s["method"] != "surrogate"
            shape = MARKERS["solver" if solved else f"{s['size']} surrogate"]
            times.plot(tolerance, at, shape, color=colour)
            if solved:
                times.annotate(
                    f"{s['wavelengths']}", (tolerance, at), (-8, 0), textcoords="offset points",
                    fontsize=8, color=colour, ha="right", va="center",
                )  # fmt: skip
        for fit, style in (("fit", "o-"), ("usual_fit", "o:")):
            fits.plot(
                tolerances, [s[fit]["seconds"] for s in steps], style, color=colour, ms=4,
                mfc=colour if fit == "fit" else "white",
            )  # fmt: skip
        _dropped(kept[i], name, steps)
    errors.plot(tolerances, tolerances, color="black", lw=1, ls="--", label="tolerance")
    for axes in (errors, times, fits):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(tolerances, [f"{t:g}" for t in tolerances])
        axes.minorticks_off()
    errors.legend(fontsize=8.5)
    kinds = [times.plot([], [], m, color="black", label=n)[0] for n, m in MARKERS.items()]
    times.legend(handles=kinds, fontsize=8.5)
    times.margins(x=0.12)
    _shared.logarithmic(times.yaxis)
    _shared.logarithmic(fits.yaxis)
    _shared.tidy(
        errors, "tolerance (reflectance)", "error on fresh specimens",
        "filled: largest of all; open: RMS",
    )  # fmt: skip
    _shared.tidy(
        times, "tolerance (reflectance)", "times faster than everything at order 8",
        "numbers: wavelengths that are solved",
    )  # fmt: skip
    _shared.tidy(
        fits, "tolerance, and noise of the bands", "core time of a fit (s)",
        "filled: as planned; open: without a plan",
    )  # fmt: skip
    _shared.save_figure(figure, path)


def _dropped(axes: Any, name: str, steps: list[dict[str, Any]]) -> None:
    """Effect of each name, and the tolerances at which it is dropped."""
    effect = steps[-1]["kept"] | steps[-1]["dropped"]
    names = sorted(effect, key=lambda n: -effect[n])
    for y, one in enumerate(names):
        for x, step in enumerate(steps):
            out = one in step["dropped"]
            axes.plot(
                x, y, "s", ms=6.5, color="#e8e8e8" if out else _shared.COLOURS[0], mec="#bbbbbb",
                mew=0.4,
            )  # fmt: skip
    labels = [f"{one} {effect[one]:.0e}".replace("e-0", "e-") for one in names]
    axes.set_yticks(range(len(names)), labels, fontsize=6.5)
    axes.set_xticks(
        range(len(steps)), [f"{s['tolerance']:g}" for s in steps], fontsize=7, rotation=60
    )
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlim(-0.6, len(steps) - 0.4)
    axes.set_title(f"{name}\nblue: kept; grey: dropped", fontsize=9)
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
