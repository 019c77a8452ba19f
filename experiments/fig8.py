"""Fig. 8: S1 and S2 at 45 degrees against the measured NCSU spectra 117 and 113."""

from typing import Any

import numpy as np

from experiments import _paper, _shared
from hylios_fit.skin import STRATA, Specimen
from hylios_fit.units import wavelengths

MEASURED = {"S1": 117, "S2": 113}
INCIDENCE = 45.0
SAYS = (
    "S1 and S2 follow the measured curves over 400 to 700 nm, also at the blue end, where models "
    "with melanin spread evenly miss (the plot only, no numbers)."
)


def run() -> dict[str, Any]:
    """Both curves, and what every other reading of the paper would change."""
    nm = wavelengths(390.0, 730.0, 10.0)
    specimens = {name: Specimen.preset(name) for name in MEASURED}
    measured = {name: _paper.ncsu(number, nm) for name, number in MEASURED.items()}
    model, readings = {}, {}
    for label, reading in _paper.READINGS.items():
        with reading.in_force():
            curves = {
                name: _paper.reflectance(reading.of(specimen), nm, INCIDENCE)
                for name, specimen in specimens.items()
            }
        model = model or curves
        readings[label] = {
            name: _difference(nm, curve, measured[name]) for name, curve in curves.items()
        }
    return {
        "paper_says": SAYS,
        "we_differ": _told(readings["as taken"]),
        "wavelength_nm": nm.tolist(),
        "incidence_deg": INCIDENCE,
        "specimens": {
            name: {
                "ncsu": MEASURED[name],
                "model": _shared.significant(model[name]),
                "measured": None if measured[name] is None else _shared.significant(measured[name]),
                "melanin_mg_per_mL": _shared.significant(_melanin(specimens[name])),
            }
            for name in MEASURED
        },
        "readings": readings,
    }


def _difference(nm: np.ndarray, model: np.ndarray, measured: Any) -> dict[str, float] | None:
    """Model minus measured by range, in reflectance; None without the measurement."""
    if measured is None:
        return None
    own = model - measured
    seen = (nm >= 400) & (nm <= 700)
    found = {"rms": np.sqrt(np.mean(own[seen] ** 2)), "mean": own[seen].mean()}
    for low in (400, 500, 600):
        found[f"mean {low}-{low + 100}"] = own[(nm >= low) & (nm <= low + 100)].mean()
    return {name: _shared.significant(value, 3) for name, value in found.items()}


def _told(own: dict[str, Any]) -> str:
    if not all(own.values()):
        return "the measured curves are not at hand"
    parts = [
        f"{name} differs from NCSU {MEASURED[name]} by {found['mean 400-500']:+.3f} at 400 to 500 "
        f"nm, {found['mean 500-600']:+.3f} to 600, {found['mean 600-700']:+.3f} to 700"
        for name, found in own.items()
    ]
    return (
        f"{'; '.join(parts)}. Table I gives S1 more melanin than S2, and yet 117 is the lighter of "
        "the two measured: what acts on all melanin alike moves both. Right: other readings, each "
        "alone; none is used, nothing is fitted"
    )


def _melanin(specimen: Specimen) -> float:
    """Eumelanin and pheomelanin per volume of epidermis, mg/mL, strata weighted by thickness."""
    v = specimen.values
    thickness = np.array([v[f"thickness_{stratum}"] for stratum in STRATA])
    content = np.array([v[f"melanosome_{stratum}"] for stratum in STRATA])
    share = content @ thickness / thickness.sum() + v["colloidal_melanin"]
    return float(share / 100 * (v["eumelanin"] + v["pheomelanin"]))


def draw(result: dict[str, Any], path: Any) -> None:
    """The curves, and the difference under every reading."""
    figure = _shared.figure(12.5, 5.0)
    axes = figure.subplots(1, 3, width_ratios=(1, 1, 1.1))
    nm = result["wavelength_nm"]
    for panel, (name, own) in zip(axes, result["specimens"].items(), strict=False):
        panel.plot(nm, own["model"], color=_shared.COLOURS[0], label=f"{name}, as taken")
        if own["measured"]:
            panel.plot(nm, own["measured"], "k--", label=f"measured, NCSU {own['ncsu']}")
        panel.set_ylim(0, 0.7)
        panel.legend(fontsize=8)
        title = f"{own['melanin_mg_per_mL']:.3g} mg/mL of melanin in the epidermis"
        _shared.tidy(panel, "wavelength (nm)", "reflectance at 45°", title)
    rows = list(result["readings"])
    for i, name in enumerate(result["specimens"]):
        found = [result["readings"][row][name] for row in rows]
        if all(found):
            mean = [own["mean"] for own in found]
            axes[2].plot(mean, range(len(rows)), "os"[i], color=_shared.COLOURS[i], label=name)
            axes[2].legend(fontsize=8)
    axes[2].axvline(0, color="black", lw=0.8)
    axes[2].set_yticks(range(len(rows)), rows, fontsize=8)
    axes[2].invert_yaxis()
    _shared.tidy(axes[2], "mean of model - measured, 400 to 700 nm", "")
    _paper.note(figure, result)
    _shared.save_figure(figure, path)
