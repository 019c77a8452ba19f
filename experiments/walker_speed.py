"""What a curve of the walker costs: S1 to S4, 250 to 2500 nm, to the error of the paper's rays."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import _shared
from hylios_fit import skin, tally, walker
from hylios_fit.simulation import simulate
from hylios_fit.skin import Specimen
from hylios_fit.threads import cores

TOLERANCE = 0.0016  # what 10^5 rays at each wavelength give where half of them come back
SPECIMENS = ("S1", "S2", "S3", "S4")
GOAL_S = {"S3": 1.0, "S4": 5.0}
REPEATS = 5
PIGMENTS = (
    "melanosome_granulosum", "melanosome_spinosum", "melanosome_basale", "colloidal_melanin",
    "eumelanin", "pheomelanin", "blood_papillary", "blood_reticular", "oxygen_saturation",
    "bilirubin", "beta_carotene",
)  # fmt: skip
MEMORY_RAYS = (131_072, 1_048_576)


def run(
    seed: int = 0,
    wavelengths: Any = None,
    specimens: tuple[str, ...] = SPECIMENS,
    tolerance: float = TOLERANCE,
    repeats: int = REPEATS,
    memory_rays: tuple[int, ...] = MEMORY_RAYS,
) -> dict[str, Any]:
    """Processor time of whole curves and of their parts on one core, and the time that curves take
    on all; medians of warm runs."""
    nm = np.arange(250.0, 2500.1, 5.0) if wavelengths is None else np.asarray(wavelengths, float)
    settings = {"seed": seed, "tolerance": tolerance, "repeats": repeats}
    found = _alone(wavelengths=nm.tolist(), specimens=specimens, **settings)
    for name in specimens if _shared.on_cpu() else ():  # elsewhere the clock has told it
        _, *lots = [cost for cost, _ in _curves(name, nm, **settings)]
        found[name]["wall_seconds"] = _shared.significant(np.median([t for _, t in lots]), 3)
    return {
        "wavelength_nm": nm.tolist(),
        "tolerance": tolerance,
        "goal_core_seconds": {k: v for k, v in GOAL_S.items() if k in found},
        "repeats": repeats,
        "cores": cores(),
        "timed_by": "CPU seconds" if _shared.on_cpu() else "seconds",
        "pigments": list(PIGMENTS),
        "specimens": found,
        "peak_memory_mib": {str(rays): _peak_memory(rays, len(nm)) for rays in memory_rays},
    }


def _alone(**settings: Any) -> dict[str, Any]:
    """`on_one_core` by a process that has one core from its start: threads that wait for each other
    keep a second one busy, which says nothing of the work."""
    code = """
import json, os, sys
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
from experiments import walker_speed
print(json.dumps(walker_speed.on_one_core(**json.load(sys.stdin))))
"""
    return json.loads(_child(code, json.dumps(settings)))


def _child(code: str, given: str = "") -> str:
    """What a Python process of its own prints."""
    return subprocess.run(
        [sys.executable, "-c", code], input=given, stdout=subprocess.PIPE, text=True, check=True,
        cwd=_shared.REPOSITORY,
    ).stdout  # fmt: skip


def on_one_core(
    seed: int, wavelengths: list[float], specimens: tuple[str, ...], tolerance: float, repeats: int
) -> dict[str, Any]:
    """By specimen, on the cores that the process has."""
    from tqdm import tqdm

    nm = np.asarray(wavelengths)
    found = {}
    for name in tqdm(specimens, desc="specimens"):
        first, *lots = _curves(name, nm, seed, tolerance, repeats)
        costs = np.array([cost for cost, _ in lots])
        last = lots[-1][1]
        found[name] = {
            "core_seconds": _shared.significant(np.median(costs[:, 0]), 3),
            "core_seconds_all": _shared.significant(costs[:, 0], 3),
            "first_call_core_seconds": _shared.significant(first[0][0], 3),
            "rays": int(np.median([curve.rays for _, curve in lots])),
            "largest_standard_error": _shared.significant(last.standard_error.max()),
            "standard_error": _shared.significant(last.standard_error, 3),
            **_parts(Specimen.preset(name), nm, jax.random.key(seed), repeats),
        }
    return found


def _curves(
    name: str, nm: np.ndarray, seed: int, tolerance: float, repeats: int
) -> list[tuple[tuple[float, float], Any]]:
    """Cost and curve of the first call and of some more."""
    keys = jax.random.split(jax.random.key(seed), repeats + 1)
    specimen = Specimen.preset(name)
    return [_cost(lambda k=key: simulate(specimen, nm, tolerance=tolerance, key=k)) for key in keys]


def _cost(call: Callable[[], Any]) -> tuple[tuple[float, float], Any]:
    """(processor seconds of all threads, wall seconds), and what was made; on an accelerator both
    are wall seconds."""
    wall, busy = time.perf_counter(), time.process_time()
    made = jax.block_until_ready(call())
    seconds = time.perf_counter() - wall
    return (time.process_time() - busy if _shared.on_cpu() else seconds, seconds), made


def _median(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    _, made = _cost(call)  # compiles
    return float(np.median([_cost(call)[0][0] for _ in range(repeats)])), made


def _parts(specimen: Specimen, nm: np.ndarray, key: jax.Array, repeats: int) -> dict[str, Any]:
    """One batch: what its walk, its sums and its gradients cost."""
    medium = specimen.layers(nm)
    to_plan, plan = _median(lambda: walker.plan(medium), repeats)
    rays = walker.batch_rays()

    def walk():
        return walker.walk(
            plan.layers, specimen.melanosome_form, key, rays=rays, shares=plan.shares
        )

    walking, paths = _median(walk, repeats)
    summing, found = _median(
        lambda: tally.collect(paths, plan.layers, medium, shares=plan.shares), repeats
    )
    _, covariance = tally.moments(paths, plan.layers, 1.0, medium, plan.shares)
    improving, _ = _median(lambda: tally.improve(paths, plan, medium), repeats)

    @jax.jit
    def slopes(values, paths):
        def mean(values):
            asked = skin.layers(
                {**specimen.values, **dict(zip(PIGMENTS, values, strict=True))},
                specimen.melanosome_form, nm, jnp.float32,
            )  # fmt: skip
            return tally.collect(paths, plan.layers, asked, shares=plan.shares).mean

        return mean(values), jax.jacfwd(mean)(values)

    values = jnp.asarray(specimen.parameters(PIGMENTS), jnp.float32)
    sloping, _ = _median(lambda: slopes(values, paths), repeats)
    sums = np.asarray(paths.sums, float).mean(axis=0)
    events = sums[walker.PROPOSED].sum() + sums[[walker.FIBRE, walker.TISSUE, walker.BOTTOM]].sum()
    return {
        "batch_rays": rays,
        "plan_seconds": _shared.significant(to_plan, 3),
        "improve_seconds": _shared.significant(improving, 3),
        "walk_seconds": _shared.significant(walking, 3),
        "collect_seconds": _shared.significant(summing, 3),
        # of the errors, after what is known of the paths is taken off
        "variance_left": _shared.significant(
            np.asarray(found.standard_error, float) ** 2 / np.maximum(np.diag(covariance), 1e-30), 3
        ),
        "rays_per_core_second": _shared.significant(rays / (walking + summing), 3),
        # scattering, refused particles and visits to the bottom; interfaces come on top
        "events_per_ray": _shared.significant(events, 3),
        "walk_ns_per_event": _shared.significant(1e9 * walking / rays / events, 3),
        # the values and all slopes from one walk, against the values alone
        "gradient_over_plain": _shared.significant((walking + sloping) / (walking + summing), 3),
    }


def _peak_memory(rays: int, wavelengths: int) -> float:
    """Largest resident memory of a process that simulates, or of its device, in MiB."""
    code = f"""
import resource, jax, numpy as np
from hylios_fit.simulation import simulate
from hylios_fit.skin import Specimen
nm = np.linspace(250, 2500, {wavelengths})
simulate(Specimen.preset("S3"), nm, rays={rays}, key=jax.random.key(0))
stats = jax.devices()[0].memory_stats() or {{}}
peak = stats.get("peak_bytes_in_use", 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
print(peak / 1024**2)
"""
    return _shared.significant(_child(code))


def draw(result: dict[str, Any], path: Any) -> None:
    """Seconds for each specimen, and the standard error that they bought."""
    figure = _shared.figure(9.0, 3.6)
    bars, errors = figure.subplots(1, 2, width_ratios=(1, 2))
    names = list(result["specimens"])
    for i, name in enumerate(names):
        found, colour = result["specimens"][name], _shared.COLOURS[i]
        goal = result["goal_core_seconds"].get(name)
        bars.bar(i, found["core_seconds"], color=colour)
        bars.annotate(
            f"{found['core_seconds']:.2g} s\n{found['rays'] / 1e3:.0f}k rays",
            (i, max(found["core_seconds"], goal or 0.0)),
            ha="center", va="bottom", fontsize=8,
        )  # fmt: skip
        errors.plot(
            result["wavelength_nm"], found["standard_error"], color=colour, lw=1.2, label=name
        )
        if goal:
            bars.plot([i - 0.4, i + 0.4], [goal, goal], color="black", ls="--", lw=1)
    bars.set_xticks(range(len(names)), names)
    bars.margins(y=0.25)
    unit = "core-seconds" if result["timed_by"] == "CPU seconds" else "seconds"
    _shared.tidy(bars, "", f"{unit}, warm", "one curve (dashed: goal)")
    errors.axhline(result["tolerance"], color="black", ls="--", lw=1)
    errors.set_ylim(bottom=0)
    errors.legend(fontsize=8)
    _shared.tidy(errors, "wavelength (nm)", "standard error of reflectance")
    _shared.save_figure(figure, path)
