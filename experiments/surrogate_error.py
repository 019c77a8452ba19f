"""How far the embedded surrogates are from the solver: reflectance, colour and slopes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import _fresh, _shared
from hylios_fit import training
from hylios_fit.appearance import appearances, colour_differences
from hylios_fit.statevector import state_vector
from hylios_fit.surrogate import Surrogate, load_surrogate

EACH = 500  # specimens of each form and kind
KINDS = {"usual": 1, "every": 2, "bare": 5}  # and how many times fewer specimens
BARE = ("melanosome_granulosum", "melanosome_spinosum")
SLOPES = 24  # of each form whose derivatives are compared
MODULES = ("training", "table", "skin", "adding", "streams", "statevector")
GOALS = {"rms": 5e-4, "most": 3e-3, "ciede2000_q99": 0.1, "slopes": 0.01}


def run(
    seed: int = 0,
    each: int = EACH,
    slopes: int = SLOPES,
    progress: bool = True,
) -> dict[str, Any]:
    """Fresh specimens from the prior, with the pigments, blood, water and lipids free and the rest
    at the model's values, as in a usual fit; with every parameter free; and as the first, without
    melanosomes in the upper strata, as light skin has them and the prior of the fits never."""
    surrogate, small = load_surrogate(), load_surrogate(size="small")
    return {
        "surrogate": _shared.surrogate_record(surrogate),
        "order": training.CHECK_ORDER,
        "goals": GOALS,
        "wavelength_nm": surrogate.wavelength_nm.tolist(),
        **_held(surrogate, seed, each, slopes, progress),
        "small": {
            "sha256": _shared.embedded_hash("small"),
            **_held(small, seed, each, slopes, progress),
        },
    }  # fmt: skip


def _held(
    surrogate: Surrogate, seed: int, each: int, slopes: int, progress: bool
) -> dict[str, Any]:
    found: dict[str, Any] = {"kinds": {}}
    nm = surrogate.wavelength_nm
    names = surrogate.at(surrogate.forms[0]).names
    folder = _shared.checkpoint("surrogate_error", MODULES, seed=seed, names=names)
    for number, (kind, fewer) in enumerate(KINDS.items()):
        parts = {}
        for form in surrogate.forms:
            member = surrogate.at(form)
            key = jax.random.fold_in(jax.random.key(seed), 100 + number)
            free = member.names if kind == "every" else ("usual",)
            count = each // fewer
            rows = training.fresh(member.names, member.lower, member.upper, count, key, free)
            if kind == "bare":
                rows[:, [member.names.index(name) for name in BARE]] = 0.0
            solve = partial(_fresh.solved, member.names, form, rows, progress)
            kept = folder / f"{kind}_{form}_{count}.npz"
            truth = _shared.kept_arrays(kept, lambda f=solve: {"truth": f()})["truth"]
            parts[form] = np.asarray(member(rows.astype(np.float32)), float), truth
        told = {
            form: {k: v for k, v in _errors(nm, *pair).items() if not k.endswith("by_wavelength")}
            for form, pair in parts.items()
        }
        every = [np.concatenate(part) for part in zip(*parts.values(), strict=True)]
        found["kinds"][kind] = {"both": _errors(nm, *every), **told}
    found["slopes"] = {
        form: _slopes(surrogate, form, slopes, seed, folder) for form in surrogate.forms
    }
    return found


def _errors(nm: np.ndarray, found: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    error = found - truth
    use = (nm >= 380) & (nm <= 780)
    pairs = [appearances(nm[use], np.clip(part[:, use], 0.0, 1.0)) for part in (found, truth)]
    away = np.array(colour_differences(*pairs), float)
    return {
        "specimens": len(error),
        "rms": _shared.significant(np.sqrt(np.mean(error**2))),
        "within_3e-3": _shared.significant(np.mean(np.abs(error) <= GOALS["most"]), 6),
        "q999": _shared.significant(np.quantile(np.abs(error), 0.999)),
        "largest": _shared.significant(np.abs(error).max()),
        "ciede2000": {
            f"q{share}": _shared.significant(np.percentile(away, share)) for share in (50, 95, 99)
        },
        "rms_by_wavelength": _shared.significant(np.sqrt(np.mean(error**2, axis=0)), 3),
        "q99_by_wavelength": _shared.significant(np.quantile(np.abs(error), 0.99, axis=0), 3),
    }


def _slopes(surrogate: Surrogate, form: str, count: int, seed: int, folder: Path) -> dict[str, Any]:
    """RMS difference over RMS of the derivatives by each usual parameter, scaled by its range."""
    member = surrogate.at(form)
    vector = state_vector(member.names, member.lower, member.upper)
    rows = vector.prior_draws(jax.random.fold_in(jax.random.key(seed), 200), count)
    kept = folder / f"slopes_{form}_{count}.npz"
    exact = _shared.kept_arrays(
        kept, lambda: training.solve_slopes(member.names, form, rows)._asdict()
    )
    names, true = [str(name) for name in exact["by"]], exact["slopes"]
    own = jax.jit(jax.vmap(jax.jacfwd(member._evaluate)))(rows.astype(np.float32))
    place = [member.names.index(name) for name in names]
    own = np.moveaxis(np.asarray(own, float)[..., place], -1, 1)
    off = np.sqrt(np.mean((own - true) ** 2, axis=(0, 2)))
    size = np.sqrt(np.mean(true**2, axis=(0, 2)))
    return dict(zip(names, _shared.significant(off / size, 3), strict=True))


def draw(result: dict[str, Any], path: Any) -> None:
    """Error by wavelength, and relative error of the slopes."""
    figure = _shared.figure(11, 4.8)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    nm = np.array(result["wavelength_nm"])
    labels = {
        "usual": "pigments, blood, water, lipids free",
        "every": "every parameter free",
        "bare": "the first, upper strata without melanosomes",
    }
    for (kind, told), colour in zip(result["kinds"].items(), _shared.COLOURS, strict=False):
        both = told["both"]
        label = f"{labels[kind]}: RMS {both['rms']:.1e}"
        left.plot(nm, both["rms_by_wavelength"], color=colour, label=label)
        left.plot(nm, both["q99_by_wavelength"], color=colour, ls=":", lw=1)
    every = result["small"]["kinds"]["every"]["both"]
    left.plot(
        nm, every["rms_by_wavelength"], color=_shared.COLOURS[1], ls="--", lw=1,
        label=f"the small surrogate, every parameter free: RMS {every['rms']:.1e}",
    )  # fmt: skip
    left.axhline(result["goals"]["rms"], color="black", ls="--", lw=0.8)
    left.set_yscale("log")
    left.set_ylim(bottom=1e-6)  # room for the legend
    left.legend(fontsize=8)
    numbers = ", ".join(str(told["both"]["specimens"]) for told in result["kinds"].values())
    title = f"{numbers} fresh specimens; dotted: 99 % lie below"
    _shared.tidy(left, "wavelength (nm)", "error of the reflectance", title)
    for (form, found), colour in zip(result["slopes"].items(), _shared.COLOURS[2:], strict=False):
        right.barh(
            np.arange(len(found)) + 0.4 * (form == "dispersed"), 100 * np.array([*found.values()]),
            height=0.4, color=colour, label=form,
        )  # fmt: skip
    names = list(result["slopes"]["complex"])
    right.set_yticks(np.arange(len(names)) + 0.2, names, fontsize=8)
    right.axvline(100 * result["goals"]["slopes"], color="black", ls="--", lw=0.8)
    right.legend(fontsize=8)
    right.invert_yaxis()
    _shared.tidy(right, "RMS error of the slope (%)", "")
    _shared.save_figure(figure, path)
