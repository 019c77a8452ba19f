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
    """One row for each spectrum of the file, and what they say together."""
    from hylios_fit.inversion import fit_many
    from hylios_fit.spectra import read_spectra
    from hylios_fit.surrogate import load_surrogate

    path = Path(path) if path else spectra_path()
    surrogate = surrogate or load_surrogate()
    spectra = read_spectra(path, wavelength_range=(250.0, 2500.0))
    fits = fit_many(spectra, surrogate, progress=progress)
    if [fit.spectrum for fit in fits] != list(spectra.names):
        raise HyliosError(f"{len(spectra)} spectra, but the rows are not theirs")
    nm = spectra.wavelength_nm
    residual = np.array([fit.residual for fit in fits])
    measured = np.array([fit.measured for fit in fits])
    fitted = np.array([fit.fitted for fit in fits])
    masks = {"all": np.ones(nm.shape, bool), **_shared.band_masks(nm)}
    rms = {name: _rms(residual[:, mask]) for name, mask in masks.items()}
    outcomes = Counter(fit.outcome.code for fit in fits)
    drawn = slice(None, None, max(1, len(nm) // 250))
    estimates = ("melanin_mg_per_mL", "blood_percent", "oxygen_saturation", "water_percent")
    return {
        "file": path.name,
        "surrogate": _shared.surrogate_record(surrogate),
        "wavelengths": len(nm),
        "spectra": len(spectra),
        "rows": len(fits),
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
                **{name: _shared.significant(fit[name].value) for name in estimates},
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
    """Median measured and fitted, the residual's quantiles, and the RMS of each spectrum."""
    figure = _shared.figure(9.5, 7.5)
    grid = figure.add_gridspec(2, 2, width_ratios=(2, 1))
    spectrum = figure.add_subplot(grid[0, 0])
    residual = figure.add_subplot(grid[1, 0], sharex=spectrum)
    histogram, bands = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    curves = result["curves"]
    nm = np.array(curves["wavelength_nm"])
    spectrum.plot(nm, _shared.floats(curves["measured_median"]), color="black", label="measured")
    spectrum.plot(nm, _shared.floats(curves["fitted_median"]), color="#c8553d", label="fitted")
    spectrum.legend()
    _shared.tidy(
        spectrum, "", "reflectance, median of spectra",
        f"{result['rows']} spectra of {result['file']}",
    )  # fmt: skip
    part = {share: _shared.floats(values) for share, values in curves["residual"].items()}
    residual.fill_between(nm, part["5"], part["95"], color="#1b6ca8", alpha=0.2, lw=0, label="90 %")
    residual.fill_between(nm, part["25"], part["75"], color="#1b6ca8", alpha=0.35, lw=0,
                          label="50 %")  # fmt: skip
    residual.plot(nm, part["50"], color="#1b6ca8", label="median")
    residual.axhline(0, color="black", lw=0.8)
    residual.legend(ncols=3, fontsize=8)
    _shared.tidy(residual, "wavelength (nm)", "measured - fitted (reflectance)")
    rms = _shared.floats(row["residual_rms"] for row in result["row"])
    rms = rms[np.isfinite(rms)]
    histogram.hist(rms, bins=25, color="#1b6ca8")
    _shared.tidy(
        histogram, "residual RMS (reflectance)", "spectra",
        f"median {result['residual_rms']['all']['median']:.4f}" if rms.size else "none fitted",
    )  # fmt: skip
    names = [name for name, found in result["residual_rms"].items() if found["n"]]
    found = [result["residual_rms"][name] for name in names]
    middle = np.array([one["median"] for one in found])
    spread = [middle - [one["q05"] for one in found], [one["q95"] for one in found] - middle]
    bands.errorbar(middle, np.arange(len(names)), xerr=spread, fmt="o", color="#1b6ca8", capsize=3)
    bands.set_yticks(np.arange(len(names)), names)
    bands.set_xlim(left=0)
    bands.invert_yaxis()
    _shared.tidy(bands, "residual RMS, median and 90 %", "range (nm)")
    _shared.save_figure(figure, path)
