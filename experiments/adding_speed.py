"""The deterministic solver: error by order, time of a curve, of many specimens, of slopes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import _shared
from hylios_fit import adding, scattering, skin, tally, walker
from hylios_fit.skin import Specimen
from hylios_fit.table import NAMES as DESIGNED
from hylios_fit.table import design, layers_of
from hylios_fit.units import wavelengths

NAMES = tuple(axis.name for axis in _shared.PIGMENTS)
PRESETS = ("S1", "S2", "S3", "S4")
ORDERS = (4, 6, 8, 12, 16)
FINEST = 32
MANY = 500
REPEATS = 3
WALKS = 48  # of the slopes, for their standard error
RAYS = 65_536
FINE = 16  # order of the slopes that they are held against
GOAL = 1e-4
LEAST = 1e-4  # change of the reflectance over a parameter's whole range that a slope is of interest


def _timed(call: Callable[[], Any]) -> tuple[float, float]:
    """First call, then the median of the rest, in seconds."""
    times = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return times[0], float(np.median(times[1:]))


def run(
    seed: int = 0,
    many: int = MANY,
    presets: tuple[str, ...] = PRESETS,
    orders: tuple[int, ...] = ORDERS,
    walks: int = WALKS,
    progress: bool = True,
) -> dict[str, Any]:
    from tqdm import tqdm

    nm = wavelengths(250, 2500, 5)
    result: dict[str, Any] = {"wavelengths": len(nm), "goal": GOAL, "presets": {}}
    for name in tqdm(presets, disable=not progress):
        layers = Specimen.preset(name).layers(nm)
        # at few wavelengths: the finest order is a matter of minutes otherwise
        few = Specimen.preset(name).layers(nm[::15])
        exact = np.asarray(adding.skin(few, order=FINEST).reflectance)
        by_order = {}
        for order in orders:
            error = np.abs(np.asarray(adding.skin(few, order=order).reflectance) - exact)
            found = {}
            for dtype in (jnp.float64, jnp.float32):
                first, warm = _timed(partial(adding.skin, layers, order=order, dtype=dtype))
                found[dtype.__name__] = {"first_s": first, "s": warm}
            by_order[str(order)] = {
                "largest_error": float(error.max()),
                "rms_error": float(np.sqrt(np.mean(error**2))),
                **found,
            }
        first, warm = _timed(
            partial(adding.slopes, Specimen.preset(name), nm, NAMES, order=adding.ORDER)
        )
        result["presets"][name] = {
            "orders": by_order,
            "slopes": {"parameters": len(NAMES), "first_s": first, "s": warm},
        }
    result["many"] = _many(nm, many)
    result["slopes"] = _slopes(nm[::5], seed, presets, walks) if walks else {}
    result["nodes"] = {name: _nodes(Specimen.preset(name), nm) for name in presets}
    return result


def _nodes(specimen: Specimen, nm: np.ndarray) -> dict[str, float]:
    """What the walk's few angles (`walker.NODES`) change where the angle falls with the wavelength:
    the solver with each of them, mixed as the walk mixes them, against the solver."""
    layers = specimen.layers(nm)
    shares = np.asarray(walker.node_shares(layers.theta_0), float)
    mixed = np.zeros(nm.size)
    for node, share in zip(walker.NODES, shares, strict=True):
        bent = layers._replace(theta_0=np.full(nm.size, node))
        mixed += share * np.asarray(adding.skin(bent).reflectance, float)
    error = mixed - np.asarray(adding.skin(layers).reflectance, float)
    worst = int(np.argmax(np.abs(error)))
    return {
        "largest": _shared.significant(error[worst], 3), "at_nm": float(nm[worst]),
        "rms": _shared.significant(np.sqrt(np.mean(error**2)), 3),
    }  # fmt: skip


def _many(nm: np.ndarray, count: int) -> dict[str, Any]:
    """Random specimens of the training design, side by side."""
    parameters, form = design(2 * count, 1, "adding")
    parameters = parameters[form == 0][:, [DESIGNED.index(name) for name in NAMES]]
    layers = layers_of(NAMES, "complex", stand=False)
    lot, took, energy = 50, 0.0, 0.0
    for first in range(-lot, count, lot):  # one lot more, to compile
        together = skin.side_by_side(layers(parameters[max(first, 0) : max(first, 0) + lot]))
        start = time.perf_counter()
        found = jax.block_until_ready(adding.skin(together))
        took += (time.perf_counter() - start) * (first >= 0)
        energy = max(energy, float(np.max(np.asarray(found.reflectance))))
    return {"specimens": count, "s_each": took / count, "largest_reflectance": energy}


def _slopes(nm: np.ndarray, seed: int, presets: tuple[str, ...], walks: int) -> dict[str, Any]:
    """Slopes of the walk against the solver's, in standard errors (independent particles), where
    they are of interest: the few paths that tell of less say nothing of their own error."""
    found = {}
    for name in presets:
        specimen = Specimen.preset(name)
        _, exact = adding.slopes(specimen, nm, NAMES, order=FINE, independent=True)
        layers = specimen.layers(nm)
        surface = np.asarray(adding.skin(layers).surface)
        plan = walker.plan(layers)

        def curve(x, paths, specimen=specimen, plan=plan):
            values = {**specimen.values, **dict(zip(NAMES, x, strict=True))}
            asked = skin.layers(values, specimen.melanosome_form, nm)
            return tally.collect(paths, plan.layers, asked, shares=plan.shares).mean

        slopes = []
        x = jnp.asarray(specimen.parameters(NAMES), jnp.float32)
        for number in range(walks):
            paths = walker.walk(
                plan.layers, specimen.melanosome_form,
                jax.random.fold_in(jax.random.key(seed), number), rays=RAYS, independent=True,
                shares=plan.shares,
            )  # fmt: skip
            slopes.append((1 - surface) * np.asarray(jax.jacfwd(curve)(x, paths)).T)
        mean, error = np.mean(slopes, axis=0), np.std(slopes, axis=0, ddof=1) / np.sqrt(walks)
        exact = np.asarray(exact, float)
        width = np.array([axis.upper - axis.lower for axis in _shared.PIGMENTS])[:, None]
        seen = (np.abs(exact) * width > LEAST) & (error > 0)
        t = np.where(seen, (mean - exact) / np.where(seen, error, 1.0), 0.0)
        angle = scattering.melanosome_angle(nm)
        falls = (angle > 0) & (angle < scattering.LATIMER_ANGLE)
        found[name] = {
            "mean_square_t": {
                label: {
                    k: _shared.significant(np.mean(row[use & where] ** 2), 3)
                    for k, row, use in zip(NAMES, t, seen, strict=True)
                    if (use & where).any()
                }
                for label, where in (("own angle", ~falls), ("mean over angles", falls))
            },
            # Student's t with walks - 1 degrees of freedom has this mean square
            "expected": (walks - 1) / (walks - 3),
            "compared": {k: int(use.sum()) for k, use in zip(NAMES, seen, strict=True)},
            "rms_difference_over_slope": {
                k: _shared.significant(np.sqrt(np.mean(d**2) / np.mean(e**2)), 2)
                for k, d, e in zip(NAMES, mean - exact, exact, strict=True)
            },
            "rms_error_over_slope": {
                k: _shared.significant(np.sqrt(np.mean(d**2) / np.mean(e**2)), 2)
                for k, d, e in zip(NAMES, error, exact, strict=True)
            },
        }
    return found


def draw(result: Mapping[str, Any], path: Any) -> None:
    """Error against time, by order, for each specimen."""
    figure = _shared.figure(7.0, 4.5)
    axes = figure.subplots()
    for i, (name, found) in enumerate(result["presets"].items()):
        for dtype, style in (("float64", "o-"), ("float32", "s:")):
            time_s = [o[dtype]["s"] for o in found["orders"].values()]
            error = [o["largest_error"] for o in found["orders"].values()]
            axes.plot(
                time_s, error, style, ms=4, color=_shared.COLOURS[i],
                label=f"{name}, {dtype}" if i == 0 or dtype == "float64" else None,
            )  # fmt: skip
    for order, o in result["presets"]["S3"]["orders"].items():
        axes.annotate(
            f"order {order}", (o["float64"]["s"], o["largest_error"]), fontsize=8,
            xytext=(4, 4), textcoords="offset points",
        )  # fmt: skip
    axes.axhline(result["goal"], color="black", lw=0.8, ls="--")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.legend(fontsize=8)
    _shared.tidy(
        axes, f"seconds for {result['wavelengths']} wavelengths, compiled",
        "largest error of the reflectance", "adding and doubling, by order",
    )  # fmt: skip
    _shared.save_figure(figure, path)
