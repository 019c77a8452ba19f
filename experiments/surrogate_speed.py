"""How fast the surrogate answers: spectra a second by batch and scene, and one alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from experiments import _shared
from hylios_fit.surrogate import EMBEDDED, Surrogate, load_surrogate

BATCHES = (1, 16, 256, 4096, 16_384, 65_536)
REPEATS = 15  # of each batch, in turns, so that what else the machine does meets all alike
ALONE = 1000  # calls of one spectrum
GOALS = {"451 wavelengths": 300_000, "3 narrow bands": 2_000_000, "3 camera bands": 2_000_000}
GOAL_ALONE_US = 100.0
DISPATCH = {"another thread": True, "the calling thread": False}
"""Where JAX starts what is asked of a CPU: the first is its default."""


def scenes(surrogate: Surrogate) -> dict[str, Surrogate]:
    """The whole spectrum, a sensor's 16 bands, 3 wavelengths, a camera's 3 wide channels."""
    nm = np.arange(400.0, 701.0, 10.0)
    camera = np.exp(-0.5 * ((nm - np.array([[465.0], [540.0], [600.0]])) / 35.0) ** 2)
    return {
        "451 wavelengths": surrogate,
        "16 narrow bands": surrogate.on(np.linspace(463.0, 631.0, 16)),
        "3 narrow bands": surrogate.on([450.0, 550.0, 620.0]),
        "3 camera bands": surrogate.on(nm, camera),
    }


def run(
    seed: int = 0,
    batches: Any = BATCHES,
    repeats: int = REPEATS,
    alone: int = ALONE,
    progress: bool = True,
) -> dict[str, Any]:
    """Times of the public call, parameters checked, in NumPy arrays; compiling apart.

    By the clock, and by the processor time of all threads, which other work on the machine changes
    less.
    """
    from tqdm import tqdm

    surrogates = {size: load_surrogate(size=size) for size in EMBEDDED}
    rows = _rows(surrogates["large"], max(batches), seed)
    calls = {
        f"{scene}, {size}": _waited(call)
        for size, surrogate in surrogates.items()
        for scene, call in scenes(surrogate).items()
    }
    compiling = {}
    for name, call in calls.items():
        start = time.perf_counter()
        call(rows[0])
        compiling[name] = _shared.significant(time.perf_counter() - start, 3)

    rates: dict[str, list[dict[str, Any]]] = {name: [] for name in calls}
    for size in tqdm(batches, desc="batches", disable=not progress):
        for name, (clock, processor) in _times(calls, rows[:size], repeats).items():
            per_core = _shared.significant(size / np.median(processor), 3)
            rates[name].append(
                {"batch": size, **_summary(size / clock), "per_core_second": per_core}
            )
    return {
        "surrogate": _shared.surrogate_record(surrogates["large"]),
        "small": _shared.embedded_hash("small"),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "load_average": _shared.significant(os.getloadavg()[0], 2),
        "goals_per_second": GOALS,
        "goal_alone_us": GOAL_ALONE_US,
        "compile_s": compiling,
        "per_second": rates,
        "alone_us": {
            f"in {name}": _in_a_process(way, alone, seed) for name, way in DISPATCH.items()
        },
    }


def _in_a_process(another_thread: bool, repeats: int, seed: int) -> dict[str, Any]:
    """`_single` in a process of its own: JAX asks where to start things once, as it begins."""
    asked = [str(int(value)) for value in (another_thread, repeats, seed)]
    call = [sys.executable, "-m", "experiments.surrogate_speed", *asked]
    said = subprocess.run(
        call, check=True, stdout=subprocess.PIPE, text=True, cwd=_shared.REPOSITORY
    )
    return json.loads(said.stdout)


def _single(repeats: int, seed: int) -> dict[str, Any]:
    """Microseconds of one spectrum by the large surrogate."""
    found = scenes(load_surrogate())
    single = {
        "surrogate(x)": _waited(found["451 wavelengths"]),
        "jax.jit(surrogate)(x)": _waited(jax.jit(found["451 wavelengths"])),
        "surrogate.on(3 bands)(x)": _waited(found["3 narrow bands"]),
    }
    row = _rows(found["451 wavelengths"], 1, seed)[0]
    return {
        name: _summary(1e6 * clock) for name, (clock, _) in _times(single, row, repeats).items()
    }


def _rows(surrogate: Surrogate, count: int, seed: int) -> np.ndarray:
    """Parameters spread over the box, of the first melanosome form."""
    member = surrogate.at(surrogate.forms[0])
    lower, upper = np.asarray(member.lower), np.asarray(member.upper)
    u = np.random.default_rng(seed).random((count, len(lower)), dtype=np.float32)
    return np.column_stack([lower + u * (upper - lower), np.zeros(count, np.float32)])


def _waited(call: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda x: call(x).block_until_ready()


def _times(
    calls: dict[str, Callable[[Any], Any]], x: np.ndarray, repeats: int
) -> dict[str, np.ndarray]:
    """Seconds of each call by the clock and by the processor (2, repeats), in turns, each warm."""
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for repeat in range(-2, repeats):
        for name, call in calls.items():
            start = time.perf_counter(), time.process_time()
            call(x)
            if repeat >= 0:
                spent[name].append((time.perf_counter() - start[0], time.process_time() - start[1]))
    return {name: np.array(values).T for name, values in spent.items()}


def _summary(values: np.ndarray) -> dict[str, Any]:
    low, median, high = np.percentile(values, (10, 50, 90))
    return {
        name: _shared.significant(value, 3)
        for name, value in (("low", low), ("median", median), ("high", high))
    }


def draw(result: dict[str, Any], path: Any) -> None:
    """Spectra a second against the batch, and the time of one call."""
    figure = _shared.figure(11.0, 4.6)
    batches, alone = figure.subplots(1, 2, width_ratios=(5, 4))
    names = list(result["goals_per_second"])
    for name, points in result["per_second"].items():
        scene, kind = name.rsplit(", ", 1)
        if scene not in names:
            continue
        colour, large = _shared.COLOURS[names.index(scene)], kind == "large"
        size = [point["batch"] for point in points]
        low, median, high = ([p[k] for p in points] for k in ("low", "median", "high"))
        batches.fill_between(size, low, high, color=colour, alpha=0.15, lw=0)
        batches.plot(
            size, median, "o-" if large else "s--", ms=4, lw=1.4, color=colour,
            mfc=colour if large else "white", label=name,
        )  # fmt: skip
        if large and scene != "3 narrow bands":  # the goal of both
            goal = result["goals_per_second"][scene]
            batches.axhline(goal, color=colour, ls=":", lw=1.1)
            label = "goal, whole spectra" if scene == "451 wavelengths" else "goal, three bands"
            batches.annotate(label, (size[0], goal * 1.1), fontsize=7.5, color=colour)
    batches.set_xscale("log")
    batches.set_yscale("log")
    batches.legend(fontsize=8, loc="lower right")
    _shared.tidy(
        batches, "spectra in a batch", "spectra a second",
        f"{result['cores']} cores, load {result['load_average']:g}",
    )  # fmt: skip
    rows = [
        (f"{call}\nstarted {where}", one)
        for where, calls in result["alone_us"].items()
        for call, one in calls.items()
    ]
    for row, (_, one) in enumerate(rows):
        alone.plot([one["low"], one["high"]], [row, row], color=_shared.COLOURS[0], lw=5, alpha=0.3)
        alone.plot(one["median"], row, "o", color=_shared.COLOURS[0])
        alone.annotate(
            f"{one['median']:.0f} µs", (one["median"], row), (0, 8), textcoords="offset points",
            ha="center", fontsize=8,
        )  # fmt: skip
    goal = result["goal_alone_us"]
    alone.axvline(goal, color="black", ls="--", lw=0.9)
    alone.set_yticks(range(len(rows)), [name for name, _ in rows], fontsize=7.5)
    alone.set_ylim(len(rows) - 0.5, -0.6)
    alone.set_xlim(0, 1.15 * max(goal, *(one["high"] for _, one in rows)))
    _shared.tidy(
        alone, "one spectrum by the large surrogate (µs)", "", "median and 10 to 90 % of the calls"
    )
    _shared.save_figure(figure, path)


if __name__ == "__main__":  # the child of `_in_a_process`
    jax.config.update("jax_cpu_enable_async_dispatch", bool(int(sys.argv[1])))
    print(json.dumps(_single(int(sys.argv[2]), int(sys.argv[3]))))
