"""What the scripts of the paper's figures share: curves, other readings, measured skin, layout.

The paper is T. F. Chen et al. 2015, HyLIoS, ACM Trans. Graph. 34(3), 31.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np

from experiments import _shared
from hylios_fit import melanosome
from hylios_fit.exits import simulate_brdf
from hylios_fit.sensitivity import DOMAINS, Sensitivity, sensitivity
from hylios_fit.simulation import simulate
from hylios_fit.skin import DNA_MG_PER_ML, STRATA, Specimen

RAYS = 100_000  # "5nm resolution curves ... using 10^5 sample rays" (section 5.3)

TABLE_II: Mapping[str, tuple[str, float, float]] = {
    "melanin": ("Vis", 0.415, 0.123),
    "blood": ("Vis", 0.229, 0.049),
    "DNA": ("UV", 0.135, 0.018),
    "keratin": ("UV", 0.068, 0.012),
    "water": ("IR", 0.611, 0.491),
    "lipids": ("IR", 0.026, 0.022),
}
"""Table II: the domain of each material's largest index, the index there, and over all."""


def reflectance(specimen: Specimen, nm: Any, incidence: float = 8.0) -> np.ndarray:
    """Directional-hemispherical reflectance by the deterministic solver; `incidence` in degrees."""
    return simulate(specimen, nm, method="adding", incidence=incidence).reflectance


# --- other readings of the paper ---------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Reading:
    """Another way to read the paper: factors on parameters, or functions put in place of others."""

    factors: Mapping[str, float] = dataclasses.field(default_factory=dict)
    form: str | None = None
    instead: Mapping[str, Callable[..., Any]] = dataclasses.field(default_factory=dict)

    def of(self, specimen: Specimen) -> Specimen:
        changes: dict[str, Any] = {k: f * specimen.values[k] for k, f in self.factors.items()}
        if self.form:
            changes["melanosome_form"] = self.form
        return specimen.replace(**changes)

    @contextlib.contextmanager
    def in_force(self) -> Iterator[None]:
        """`instead` replaces functions of hylios_fit, which no option offers."""
        with contextlib.ExitStack() as stack:
            if self.instead:  # what was compiled before, or in between, has the others in it
                jax.clear_caches()
                stack.callback(jax.clear_caches)
            for name, function in self.instead.items():
                stack.enter_context(mock.patch(f"hylios_fit.{name}", function))
            yield


def _always_met(form: str) -> tuple[float, ...]:
    if form == "dispersed":
        return (0.0, 1.0)
    n = melanosome.met_at_most(form)
    whole = math.floor(n)
    return (*(0.0,) * whole, whole + 1 - n, n - whole)


_per_content = melanosome.attenuation_per_content
_DECADIC = 1.0 / math.log(10.0)
_ETA2 = (1.5 / 1.33) ** 2

READINGS: Mapping[str, Reading] = {
    "as taken": Reading(),
    "melanin tables not times ln 10": Reading({"eumelanin": _DECADIC, "pheomelanin": _DECADIC}),
    "complex met n_m times": Reading(instead={"melanosome.met_distribution": _always_met}),
    "both of these": Reading(
        {"eumelanin": _DECADIC, "pheomelanin": _DECADIC},
        instead={"melanosome.met_distribution": _always_met},
    ),
    "complexes do not shrink upwards": Reading(
        instead={"melanosome.attenuation_per_content": lambda form, scale: _per_content(form, 1.0)}
    ),
    "compact complexes": Reading(form="compact"),
    "dispersed melanosomes": Reading(form="dispersed"),
    "no colloidal melanin": Reading({"colloidal_melanin": 0.0}),
    "strata of 0.0046 cm, reticular 0.125 cm": Reading(
        {f"thickness_{stratum}": 0.0046 / 0.0033 for stratum in STRATA}
        | {"thickness_reticular": 1.25}
    ),
    "fibres by the textbook's Eq. 7": Reading(
        {"fibre_fraction": ((_ETA2 + 1.0) / (_ETA2 + 2.0)) ** 2}  # the coefficient is linear in it
    ),
    "oxygen saturation 0.95": Reading({"oxygen_saturation": 0.95 / 0.75}),
}

_SUPPLEMENT = Reading({"dna": 0.185 / DNA_MG_PER_ML[1]})
ULTRAVIOLET: Mapping[str, tuple[Reading, tuple[str, ...]]] = {
    "as taken": (Reading(), ("keratin",)),
    "no tail of the corneum": (Reading({"corneum_tail": 0.0}), ("keratin",)),
    "DNA of the supplement, 0.185 mg/mL": (_SUPPLEMENT, ("keratin",)),
    "the tail goes with keratin": (Reading(), ("keratin", "corneum_tail")),
    "both of these": (_SUPPLEMENT, ("keratin", "corneum_tail")),
}
"""Other inputs for the two materials whose inputs are the least sure, and what goes as keratin."""


# --- measured skin, which lies outside the repository ------------------------------------------


def beside(file: str, variable: str) -> Path | None:
    """A file of measurements: named by an environment variable, or beside the repository."""
    named = os.environ.get(variable)
    folder = _shared.REPOSITORY.parent / "shared" / "data"
    places = [Path(named)] if named else [_shared.CACHE / file, folder / file]
    return next((place for place in places if place.is_file()), None)


def ncsu(number: int, nm: np.ndarray) -> np.ndarray | None:
    """NCSU spectrum 113 or 117 (Vrhel et al. 1994) at `nm`; None without the file.

    390 to 730 nm in 2 nm, linear between; the file may be named in HYLIOS_FIT_NCSU.
    """
    path = beside("ncsu_vrhel_113_117.csv", "HYLIOS_FIT_NCSU")
    if path is None:
        return None
    table = np.genfromtxt(path, delimiter=",", names=True)
    return np.interp(nm, table["wavelength_nm"], table[f"ncsu_{number}"])


# --- Figs. 18, 20 and 22: two materials each ---------------------------------------------------


def pair(materials: tuple[str, str], domain: str, says: str) -> dict[str, Any]:
    """Curves of S3 without each of two materials, and the index of both in every domain."""
    found = sensitivity(Specimen.preset("S3"), method="adding")
    low, high = DOMAINS[domain]
    shown = (found.wavelength_nm >= low) & (found.wavelength_nm <= high)
    over = "; ".join(
        f"{name} {index(found, name, RAYS)[where] / value:.2f} in {where}, "
        f"{index(found, name, RAYS)['all'] / whole:.2f} over all"
        for name, (where, value, whole) in TABLE_II.items()
        if name in materials
    )
    return {
        "paper_says": says,
        "we_differ": f"index of counted curves over the paper's: {over}",
        "specimen": "S3",
        "domain": domain,
        "wavelength_nm": found.wavelength_nm[shown].tolist(),
        "baseline": _shared.significant(found.baseline.reflectance[shown]),
        "without": {
            name: _shared.significant(found.without[name].reflectance[shown]) for name in materials
        },
        "msi": {name: index(found, name) for name in materials},
        "counted_rays": RAYS,
        "msi_counted": {name: index(found, name, RAYS) for name in materials},
        "paper": {
            name: {TABLE_II[name][0]: TABLE_II[name][1], "all": TABLE_II[name][2]}
            for name in materials
        },
    }


def index(found: Sensitivity, material: str, counted: int | None = None) -> dict[str, float]:
    """The index of a material in every domain."""
    return {domain: _shared.significant(found.msi(material, domain, counted)) for domain in DOMAINS}


def draw_pair(result: dict[str, Any], path: Any) -> None:
    """Left the curves, right the indices."""
    figure = _shared.figure(10.0, 4.6)
    curves, bars = figure.subplots(1, 2)
    nm = result["wavelength_nm"]
    for i, (name, values) in enumerate(result["without"].items()):
        curves.plot(nm, values, color=_shared.COLOURS[i], label=f"no {name}")
        own, paper = result["msi"][name], result["paper"][name]
        places = np.arange(len(own)) + 0.4 * (i - 0.5)
        bars.bar(places, list(own.values()), 0.36, color=_shared.COLOURS[i], label=f"no {name}")
        counted = list(result["msi_counted"][name].values())
        label = "with the noise of 10^5 rays" if i == 0 else None
        bars.bar(places, counted, 0.36, color="none", ec="black", lw=0.8, label=label)
        at = [places[list(own).index(domain)] for domain in paper]
        label = "paper, Table II" if i == 0 else None
        bars.plot(at, list(paper.values()), "D", color="black", mfc="white", ms=6, label=label)
    curves.plot(nm, result["baseline"], "k--", label=result["specimen"])
    curves.set_ylim(0, 1.05 * max(max(values) for values in result["without"].values()))
    bars.set_xticks(range(len(own)), list(own))
    curves.legend(fontsize=8)
    bars.legend(fontsize=8)
    _shared.tidy(curves, "wavelength (nm)", "reflectance at 8° (specular included)")
    _shared.tidy(bars, "domain", "mean sensitivity index")
    note(figure, result)
    _shared.save_figure(figure, path)


# --- Figs. 13 and 14: the BRDF in the plane of incidence ----------------------------------------

AROUND_DEG = 15.0  # azimuths this far from the plane of incidence count as in it
THETA_EDGES_RAD = np.deg2rad(np.arange(0.0, 91.0, 2.5))


def in_plane(
    specimen: Specimen, nm: Any, incidence: float, rays: int, key: jax.Array
) -> dict[str, Any]:
    """Mean over `nm` of the BRDF in the plane of incidence; `incidence` in degrees.

    Angles of reflection are negative on the side that the light comes from. At normal incidence
    all azimuths count alike. Errors are taken as shared by the wavelengths, which share paths.
    """
    edge = np.deg2rad(AROUND_DEG)
    phi = np.array([0.0, np.pi] if incidence == 0 else [0.0, edge, np.pi - edge, np.pi])
    brdf = simulate_brdf(
        specimen, nm, rays=rays, key=key, incidence=incidence,
        theta_edges_rad=THETA_EDGES_RAD, phi_edges_rad=phi,
    )  # fmt: skip
    projected = brdf.projected_solid_angle

    def across(part: np.ndarray) -> list[float]:
        mean = part.mean(axis=0)
        return _shared.significant(np.concatenate([mean[::-1, -1], mean[:, 0]]))

    theta = np.rad2deg(brdf.theta_rad)
    return {
        "angle_deg": np.concatenate([-theta[::-1], theta]).round(6).tolist(),
        "surface": across(brdf.surface),
        "subsurface": across(brdf.subsurface),
        "standard_error": across(brdf.standard_error),
        "surface_reflectance": _shared.significant(np.sum(brdf.surface.mean(axis=0) * projected)),
        "subsurface_reflectance": _shared.significant(
            np.sum(brdf.subsurface.mean(axis=0) * projected)
        ),
    }


# --- layout ------------------------------------------------------------------------------------


def note(figure: Any, result: dict[str, Any]) -> None:
    """What the paper reports and where we differ, under the figure."""
    import textwrap

    width = int(15.5 * figure.get_figwidth())
    lines = [f"Paper: {result['paper_says']}", f"Here: {result['we_differ']}."]
    text = "\n".join(line for part in lines for line in textwrap.wrap(part, width))
    figure.supxlabel(text, fontsize=8, x=0.01, ha="left")
