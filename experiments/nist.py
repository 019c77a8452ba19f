"""Fits of NIST's reference spectra of skin, 250 to 2500 nm.

Cooksey, Allen and Tsai 2017, doi 10.18434/M38597: directional-hemispherical reflectance at 8
degrees, specular included. The file has a column for each repeat of each subject; the environment
variable HYLIOS_FIT_NIST names it.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from experiments import _shared
from hylios_fit.errors import HyliosError

FILE = "nist_skin_reflectance_odd_subjects.csv"
SHARES = (5, 25, 50, 75, 95)
BEYOND = (
    "corneum_tail", "reticular_scattering", "reticular_scattering_power", "bottom_reflectance",
    "index_epidermis", "index_papillary", "index_reticular", "index_dispersion",
)  # fmt: skip
"""What the published model lacks on measured skin, each off or at its value unless it is freed."""
ESTIMATES = ("melanin_mg_per_mL", "blood_percent", "oxygen_saturation", "water_percent")


def spectra_path() -> Path:
    """The file of spectra: that of HYLIOS_FIT_NIST, or one that lies beside the repository."""
    named = os.environ.get("HYLIOS_FIT_NIST")
    places = [Path(named)] if named else [
        folder / FILE for folder in (_shared.CACHE, _shared.REPOSITORY.parent / "shared" / "data")
    ]  # fmt: skip
    for path in places:
        if path.is_file():
            return path
    raise HyliosError(
        f"NIST's spectra are not at {' or '.join(map(str, places))}: name the file in the "
        "environment variable HYLIOS_FIT_NIST"
    )


def run(path: Any = None, surrogate: Any = None, progress: bool = True) -> dict[str, Any]:
    """One row for each spectrum of the file, and what they say together; then every third (the
    first repeat of each subject) once more, with what the published model lacks free as well."""
    from hylios_fit.inversion import fit_many
    from hylios_fit.spectra import read_spectra
    from hylios_fit.surrogate import load_surrogate

    path = Path(path) if path else spectra_path()
    surrogate = surrogate or load_surrogate()
    spectra = read_spectra(path, wavelength_range=(250.0, 2500.0))
    known = surrogate.at(surrogate.forms[0]).names
    more = ("usual", *(name for name in BEYOND if name in known))
    published = fit_many(spectra, surrogate, progress=progress)
    once = spectra.select(range(0, len(spectra), 3))
    beyond = fit_many(once, surrogate, free=more, progress=progress)
    for fits, asked in ((published, spectra), (beyond, once)):
        if [fit.spectrum for fit in fits] != list(asked.names):
            raise HyliosError(f"{len(asked)} spectra, but the rows are not theirs")
    return {
        "file": path.name,
        "surrogate": _shared.surrogate_record(surrogate),
        "wavelengths": len(spectra.wavelength_nm),
        "spectra": len(spectra),
        "rows": len(published),
        **_summary(published),
        "beyond": {"free": list(more), **_summary(beyond)},
    }


def _summary(fits: list[Any]) -> dict[str, Any]:
    nm = fits[0].wavelength_nm
    residual = np.array([fit.residual for fit in fits])
    measured = np.array([fit.measured for fit in fits])
    fitted = np.array([fit.fitted for fit in fits])
    masks = {"all": np.ones(nm.shape, bool), **_shared.band_masks(nm)}
    rms = {name: _rms(residual[:, mask]) for name, mask in masks.items()}
    outcomes = Counter(fit.outcome.code for fit in fits)
    drawn = slice(None, None, max(1, len(nm) // 250))
    estimates = (*ESTIMATES, *(name for name in BEYOND if name in fits[0].names))
    return {
        "outcomes": {name: outcomes[name] for name in sorted(outcomes)},
        "share_fitted": float(np.mean([fit.outcome.is_fitted for fit in fits])),
        "share_within_noise": float(np.mean([fit.outcome.code == "fitted" for fit in fits])),
        "residual_rms": {name: _shared.quantiles(values) for name, values in rms.items()},
        "reduced_chi2": _shared.quantiles([fit.reduced_chi2 for fit in fits]),
        "forms": dict(sorted(Counter(fit.form for fit in fits).items())),
        "estimates": {
            name: _shared.quantiles([fit[name].value for fit in fits if fit.outcome.is_fitted])
            for name in estimates
        },
        "curves": {
            "wavelength_nm": nm[drawn].tolist(),
            "measured_median": _over(measured[:, drawn], 50),
            "fitted_median": _over(fitted[:, drawn], 50),
            "residual": {str(share): _over(residual[:, drawn], share) for share in SHARES},
        },
        "row": [
            {
                "spectrum": fit.spectrum,
                "outcome": fit.outcome.code,
                "residual_rms": _shared.significant(fit.residual_rms),
                **{name: _shared.significant(fit[name].value) for name in ESTIMATES},
            }
            for fit in fits
        ],
    }


def _rms(residual: np.ndarray) -> np.ndarray:
    """(S,) root mean square of each row over the bands that it has, NaN where it has none."""
    used = np.isfinite(residual)
    total = np.sum(np.where(used, residual, 0.0) ** 2, axis=1)
    return np.sqrt(total / np.where(used.any(axis=1), used.sum(axis=1), np.nan))


def _over(values: np.ndarray, share: float) -> list[float]:
    kept = values[np.isfinite(values).any(axis=1)]
    if not len(kept):
        return [float("nan")] * values.shape[1]
    return _shared.significant(np.nanpercentile(kept, share, axis=0))


def draw(result: dict[str, Any], path: Any) -> None:
    """Median measured and fitted, the residual's quantiles, and the RMS of each spectrum, by the
    published model and with what it lacks."""
    figure = _shared.figure(9.5, 7.5)
    grid = figure.add_gridspec(2, 2, width_ratios=(2, 1))
    spectrum = figure.add_subplot(grid[0, 0])
    residual = figure.add_subplot(grid[1, 0], sharex=spectrum)
    histogram, bands = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    nm = np.array(result["curves"]["wavelength_nm"])
    measured = _shared.floats(result["curves"]["measured_median"])
    spectrum.plot(nm, measured, color="black", label="measured")
    residual.axhline(0, color="black", lw=0.8)
    both = (("published model", "#c8553d", result), ("with more free", "#1b6ca8", result["beyond"]))
    for number, (label, colour, part) in enumerate(both):
        curves = part["curves"]
        fitted = _shared.floats(curves["fitted_median"])
        spectrum.plot(nm, fitted, color=colour, ls="--", label=label)
        share = {name: _shared.floats(values) for name, values in curves["residual"].items()}
        residual.fill_between(nm, share["5"], share["95"], color=colour, alpha=0.25, lw=0)
        residual.plot(nm, share["50"], color=colour, label=f"{label}: median and 90 %")
        rms = _shared.floats(row["residual_rms"] for row in part["row"])
        rms = rms[np.isfinite(rms)]
        middle = part["residual_rms"]["all"]["median"]
        if rms.size:
            histogram.hist(rms, bins=25, color=colour, alpha=0.7, label=f"median {middle:.4f}")
        names = [name for name, found in part["residual_rms"].items() if found["n"]]
        found = [part["residual_rms"][name] for name in names]
        middle = np.array([one["median"] for one in found])
        spread = [middle - [one["q05"] for one in found], [one["q95"] for one in found] - middle]
        place = np.arange(len(names)) + 0.2 * number
        bands.errorbar(middle, place, xerr=spread, fmt="o", color=colour, capsize=3)
        bands.set_yticks(np.arange(len(names)), names)
    spectrum.legend()
    residual.legend(fontsize=8)
    histogram.legend(fontsize=8)
    title = f"{result['rows']} spectra of {result['file']}"
    _shared.tidy(spectrum, "", "reflectance, median of spectra", title)
    _shared.tidy(residual, "wavelength (nm)", "measured - fitted (reflectance)")
    _shared.tidy(histogram, "residual RMS (reflectance)", "spectra")
    bands.set_xlim(left=0)
    bands.invert_yaxis()
    _shared.tidy(bands, "residual RMS, median and 90 %", "range (nm)")
    _shared.save_figure(figure, path)
