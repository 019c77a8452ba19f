"""Table II: mean sensitivity indices of S3, beside the paper's and those of other readings."""

import dataclasses
from typing import Any

import numpy as np

from experiments import _paper, _shared
from experiments._paper import READINGS, TABLE_II, ULTRAVIOLET
from hylios_fit.sensitivity import (
    DOMAINS,
    REMOVALS,
    Sensitivity,
    mean_sensitivity_index,
    sensitivity,
)
from hylios_fit.skin import Specimen

OTHERS = (
    "melanin tables not times ln 10", "complex met n_m times", "both of these",
    "strata of 0.0046 cm, reticular 0.125 cm",
)  # fmt: skip
AIMS = {"water": 0.10, "lipids": 0.10, "melanin": 0.20, "blood": 0.20}
SAYS = "the numbers at the left, at a resolution of 5 nm."


def run() -> dict[str, Any]:
    """Indices as taken, with the paper's noise, under other readings, and over DNA and keratin."""
    skin = Specimen.preset("S3")
    found = sensitivity(skin, method="adding")
    readings = {"as taken": found}
    for label in OTHERS:
        with READINGS[label].in_force():
            readings[label] = sensitivity(READINGS[label].of(skin), method="adding")
    bleached = _paper.reflectance(skin.replace(eumelanin=0.0, pheomelanin=0.0), found.wavelength_nm)
    colourless = dataclasses.replace(found.baseline, reflectance=bleached)
    stay = Sensitivity(found.baseline, {"melanin": colourless})
    readings["particles independent of each other"] = sensitivity(
        skin, method="adding", independent_particles=True
    )
    indices = {label: _indices(own) for label, own in readings.items()}
    indices["as taken, counted"] = _indices(found, _paper.RAYS)
    paper = {name: {own[0]: own[1], "all": own[2]} for name, own in TABLE_II.items()}
    far = [
        f"{name} in {d} {indices['as taken, counted'][name][d] / v:.2f}"
        for name in TABLE_II
        for d, v in paper[name].items()
        if abs(indices["as taken, counted"][name][d] / v - 1) > AIMS.get(name, 0.2)
    ]
    return {
        "paper_says": SAYS,
        "we_differ": "counted is what curves of the paper's 10^5 rays at each wavelength would "
        "show, whose noise adds to an index that counts differences of either sign. Farther from "
        f"the paper than 10 % (water, lipids) or 20 %, over the paper's: {', '.join(far)}: what "
        "else absorbs in the ultraviolet here (the tail of the corneum, urocanic acid) leaves them "
        "less light. Right: other inputs for DNA and keratin, the least sure; nothing is fitted",
        "specimen": "S3",
        "paper": paper,
        "indices": indices,
        "over_paper": {
            label: {
                name: {d: _shared.significant(own[name][d] / v, 3) for d, v in paper[name].items()}
                for name in own
            }
            for label, own in indices.items()
        },
        "aims": AIMS,
        "counted_rays": _paper.RAYS,
        "melanosomes_stay_without_melanin": _paper.index(stay, "melanin"),
        # what the paper's own table has for a material where that material does nothing
        "paper_elsewhere": {
            name: _shared.significant(_elsewhere(found.wavelength_nm, *TABLE_II[name]), 2)
            for name in ("DNA", "keratin")
        },
        "ours_elsewhere": _shared.significant(
            _elsewhere(
                found.wavelength_nm, "UV",
                *(indices["as taken, counted"]["DNA"][d] for d in ("UV", "all")),
            ), 2,
        ),
        "ultraviolet": _ultraviolet(skin, found.wavelength_nm),
    }  # fmt: skip


def _elsewhere(nm: np.ndarray, domain: str, own: float, whole: float) -> float:
    """Mean index outside a domain, from that inside and that over all."""
    share = float(np.mean((nm >= DOMAINS[domain][0]) & (nm <= DOMAINS[domain][1])))
    return (whole - share * own) / (1.0 - share)


def _indices(found: Sensitivity, counted: int | None = None) -> dict[str, dict[str, float]]:
    return {name: _paper.index(found, name, counted) for name in REMOVALS}


def _ultraviolet(skin: Specimen, nm: np.ndarray) -> dict[str, dict[str, float]]:
    """Index of DNA and keratin with other inputs for them."""
    low, high = DOMAINS["UV"]
    nm = nm[(nm >= low) & (nm <= high)]
    found = {}
    for label, (reading, keratin) in ULTRAVIOLET.items():
        own = reading.of(skin)
        base = _paper.reflectance(own, nm)
        found[label] = {}
        for name, gone in (("DNA", REMOVALS["DNA"]), ("keratin", keratin)):
            without = _paper.reflectance(own.replace(**dict.fromkeys(gone, 0.0)), nm)
            found[label][name] = _shared.significant(mean_sensitivity_index(base, without))
    return found


def draw(result: dict[str, Any], path: Any) -> None:
    """Indices over the paper's, by material, and what DNA and keratin would need."""
    figure = _shared.figure(13.0, 6.4)
    dots, bars = figure.subplots(1, 2, width_ratios=(1.5, 1))
    rows = [(name, domain) for name, own in result["paper"].items() for domain in own]
    styles = {"as taken": "o", "as taken, counted": "s"}
    for i, (label, table) in enumerate(result["over_paper"].items()):
        found = [table.get(name, {}).get(domain, np.nan) for name, domain in rows]
        dots.plot(
            found, range(len(rows)), styles.get(label, "|"), ms=7 if label in styles else 12,
            mew=2, mfc="none", color=_shared.COLOURS[i % len(_shared.COLOURS)], label=label,
        )  # fmt: skip
    for place, (name, _) in enumerate(rows):
        if name in result["aims"]:
            aim = result["aims"][name]
            dots.fill_betweenx(
                [place - 0.4, place + 0.4], 1 - aim, 1 + aim, color="black", alpha=0.12, lw=0
            )
    dots.axvline(1, color="black", lw=0.8)
    _shared.logarithmic(dots.xaxis)
    labels = [f"{name}, {domain}: {result['paper'][name][domain]}" for name, domain in rows]
    dots.set_yticks(range(len(rows)), labels)
    dots.invert_yaxis()
    dots.legend(fontsize=7.5, loc="lower left")
    _shared.tidy(dots, "index over the paper's (at the left); grey: within 10 or 20 %", "")
    uv = {"paper": {name: result["paper"][name]["UV"] for name in ("DNA", "keratin")}}
    uv |= result["ultraviolet"]
    for i, name in enumerate(("DNA", "keratin")):
        bars.barh(
            np.arange(len(uv)) + 0.4 * (i - 0.5), [own[name] for own in uv.values()], 0.36,
            color=_shared.COLOURS[i], label=name,
        )  # fmt: skip
    bars.set_yticks(range(len(uv)), [label.replace(" of ", " of\n") for label in uv], fontsize=8)
    bars.invert_yaxis()
    bars.legend(fontsize=8)
    _shared.tidy(bars, "index in the ultraviolet", "")
    _paper.note(figure, result)
    _shared.save_figure(figure, path)
