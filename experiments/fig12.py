"""Fig. 12: S3 and S4 from 250 to 2500 nm, beside NIST's measured skin."""

from typing import Any

import numpy as np

from experiments import _paper, _shared, nist
from hylios_fit.errors import HyliosError
from hylios_fit.skin import Specimen
from hylios_fit.units import wavelengths

INCIDENCE = {"S3": 8.0, "S4": 16.75}  # degrees, of the two measurements in the paper
SHARES = (5, 50, 95)
# Named features and where each must be looked for, nm
VALLEYS = {
    "Soret band": (400, 440), "haemoglobin, first": (530, 555), "haemoglobin, second": (565, 590),
    "water 970": (930, 1010), "water 1190": (1140, 1240), "water 1450": (1400, 1500),
    "water 1940": (1880, 2000),
}  # fmt: skip
SAYS = (
    "peaks, valleys and trends of the measured curves are reproduced; beyond about 1300 nm water "
    "and lipids dominate and the two specimens look alike (the plot only, no numbers)."
)


def run() -> dict[str, Any]:
    """Both curves, their features, and how they stand to the measured set where it is at hand."""
    nm = wavelengths(250.0, 2500.0, 5.0)
    curves = {
        name: _paper.reflectance(Specimen.preset(name), nm, angle)
        for name, angle in INCIDENCE.items()
    }
    measured = _nist(nm)
    away = measured and {
        band: _shared.significant(np.mean((curves["S3"] - measured[50])[mask]), 3)
        for band, mask in _shared.band_masks(nm).items()
    }
    alike = _by_band(nm, curves["S3"] - curves["S4"])
    told = f"S3 and S4 differ by {alike['1350-2500']} (RMS) beyond 1350 nm"
    if away:
        told += (
            f"; S3 lies {away['700-1350']:+.3f} from NIST's median at 700 to 1350 nm. The paper's "
            "measured curves are not at hand: the band is NIST's reference set, the odd-numbered "
            "subjects, doi 10.18434/M38597"
        )
    return {
        "paper_says": SAYS,
        "we_differ": told,
        "wavelength_nm": nm.tolist(),
        "incidence_deg": INCIDENCE,
        "curves": {name: _shared.significant(curve) for name, curve in curves.items()},
        "valleys_nm": {name: _valleys(nm, curve) for name, curve in curves.items()},
        "rms_between": alike,
        "nist": measured and {str(k): _shared.significant(v) for k, v in measured.items()},
        "nist_valleys_nm": measured and _valleys(nm, measured[50]),
        "mean_S3_minus_nist_median": away,
    }


def _nist(nm: np.ndarray) -> dict[int, np.ndarray] | None:
    """Percentiles of the measured spectra at `nm`; None without the file."""
    try:
        table = np.genfromtxt(nist.spectra_path(), delimiter=",", skip_header=1)
    except HyliosError:
        return None
    return {share: np.interp(nm, table[:, 0], np.percentile(table[:, 1:], share, axis=1))
            for share in SHARES}  # fmt: skip


def _valleys(nm: np.ndarray, curve: np.ndarray) -> dict[str, float | None]:
    """Wavelength of the lowest point in each window; None where that is the window's edge."""
    found = {}
    for name, (low, high) in VALLEYS.items():
        inside = np.flatnonzero((nm >= low) & (nm <= high))
        at = int(np.argmin(curve[inside]))
        found[name] = float(nm[inside[at]]) if 0 < at < len(inside) - 1 else None
    return found


def _by_band(nm: np.ndarray, difference: np.ndarray) -> dict[str, float]:
    return {
        band: _shared.significant(np.sqrt(np.mean(difference[mask] ** 2)), 3)
        for band, mask in _shared.band_masks(nm).items()
    }


def draw(result: dict[str, Any], path: Any) -> None:
    """The curves over the band of the measured set."""
    figure = _shared.figure(9.0, 5.4)
    axes = figure.subplots()
    nm = result["wavelength_nm"]
    if result["nist"]:
        low, middle, high = (result["nist"][str(share)] for share in SHARES)
        axes.fill_between(nm, low, high, color="black", alpha=0.12, label="NIST, 5 to 95 %")
        axes.plot(nm, middle, "k--", lw=1, label="NIST, median")
    for i, (name, curve) in enumerate(result["curves"].items()):
        label = f"{name} at {result['incidence_deg'][name]:g}°"
        axes.plot(nm, curve, color=_shared.COLOURS[i], label=label)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8)
    _shared.tidy(axes, "wavelength (nm)", "reflectance (specular included)")
    _paper.note(figure, result)
    _shared.save_figure(figure, path)
