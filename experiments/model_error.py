"""What fits of measured skin take the model to miss: how smooth it is, by the evidence.

NIST's reference spectra (see `nist`), every thirtieth, and every 300th of ISSA's (see `issa`).
"""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np

from experiments import _shared, issa, nist
from hylios_fit import inversion

LENGTHS = (0.03, 0.05, 0.07, 0.1)
BANDS = (0.1, 0.01, 0.001, 0.0003)
EVERY = {"nist": 30, "issa": 300}


def run(progress: bool = True) -> dict[str, Any]:
    """Mean evidence of a spectrum's fit, and its residual, for each length and share of a band,
    and with the noise inflated instead."""
    from tqdm import tqdm

    from hylios_fit.spectra import read_spectra

    spectra = {
        "nist": read_spectra(nist.spectra_path(), wavelength_range=(250.0, 2500.0)),
        "issa": read_spectra(issa.archive()[0], wavelength_range=(400.0, 700.0)),
    }
    chosen = {
        name: whole.select(range(0, len(whole), EVERY[name])) for name, whole in spectra.items()
    }
    more = ("usual", *nist.BEYOND)
    cases = {
        "nist": (chosen["nist"], None),
        "beyond": (chosen["nist"], more),
        "issa": (chosen["issa"], None),
    }
    kinds = [None, *((length, band) for length in LENGTHS for band in BANDS)]
    rows = []
    for kind in tqdm(kinds, unit="kind", disable=not progress):
        row: dict[str, Any] = {"length": kind and kind[0], "band": kind and kind[1]}
        for name, (part, free) in cases.items():
            fits = _fits(part, free, kind)
            row[name] = {
                "evidence": _shared.significant(np.mean([_evidence(fit) for fit in fits]), 6),
                "residual_rms": _shared.significant(np.median([f.residual_rms for f in fits]), 3),
                "residual_share": _shared.significant(
                    np.median([np.sqrt(np.nanmean((f.residual / f.fitted) ** 2)) for f in fits]), 3
                ),
                "model_error": _shared.significant(np.median([f.model_error for f in fits]), 3),
                "melanin_sd": _shared.significant(
                    np.median([f["melanin_mg_per_mL"].sd / f["melanin_mg_per_mL"].value
                               for f in fits]), 3,
                ),
            }  # fmt: skip
        rows.append(row)
    return {
        "spectra": {name: len(part) for name, part in chosen.items()},
        "taken": {"length": inversion.MODEL_LENGTH, "band": inversion.MODEL_BAND},
        "rows": rows,
    }


def _fits(spectra: Any, free: Any, kind: tuple[float, float] | None) -> list[Any]:
    instead: dict[str, Any]
    if kind is None:
        instead = {"_with_model_error": _inflated}
    else:
        instead = {"MODEL_LENGTH": kind[0], "MODEL_BAND": kind[1]}
    with mock.patch.multiple(inversion, **instead):
        fits = inversion.fit_many(spectra, free=free, starts=2, progress=False)
    return [fit for fit in fits if np.isfinite(fit.residual_rms)]


def _inflated(again: Any, stated: Any, shape: Any, found: Any, target: Any) -> tuple[Any, float]:
    """The noise understated, in the place of an error of the model."""
    reduced, _ = inversion._reduced_chi2(inversion._best(found), target)
    return again({form: covariance * reduced for form, covariance in stated.items()}), 0.0


def _evidence(fit: Any) -> float:
    """Log, by Laplace's approximation, for the form that was kept."""
    used = np.isfinite(np.diag(fit.error_covariance))
    weights, log_determinant = inversion.whitener(fit.error_covariance, used)
    miss = weights @ np.where(used, fit.residual, 0.0)
    volume = 0.5 * np.linalg.slogdet(fit.z_covariance)[1]
    return float(volume - 0.5 * (miss @ miss + fit.z @ fit.z) - log_determinant)


def draw(result: dict[str, Any], path: Any) -> None:
    """Evidence, residual and size against length, a curve for each share of a band."""
    figure = _shared.figure(11, 8.5)
    titles = {
        "nist": "NIST, 250 to 2500 nm", "beyond": "NIST, more free", "issa": "ISSA, 400 to 700 nm",
    }  # fmt: skip
    words = {
        "evidence": "log evidence of a spectrum, mean", "residual_rms": "residual (RMS), median",
        "model_error": "size over residual, both as a share",
    }  # fmt: skip
    grid = figure.subplots(3, 3, sharex=True)
    inflated, *rows = result["rows"]
    for column, (name, title) in zip(grid.T, titles.items(), strict=True):
        for axes, (what, word) in zip(column, words.items(), strict=True):
            relative = what == "model_error"
            for band, colour in zip(BANDS, _shared.COLOURS, strict=False):
                mine = [row for row in rows if row["band"] == band]
                values = [
                    row[name][what] / (row[name]["residual_share"] if relative else 1.0)
                    for row in mine
                ]
                axes.plot(
                    [row["length"] for row in mine], values, "o-", ms=4, color=colour,
                    label=f"share of each band {band:g}",
                )  # fmt: skip
            if not relative:
                axes.axhline(inflated[name][what], color="black", ls=":", label="noise inflated")
            axes.axvline(result["taken"]["length"], color="grey", lw=0.8)
            axes.set_xscale("log")
            axes.set_xticks(LENGTHS, [f"{length:g}" for length in LENGTHS])
            axes.minorticks_off()
            last = what == "model_error"
            _shared.tidy(
                axes, "correlation length (log of the wavelength)" if last else "",
                word if name == "nist" else "", title if what == "evidence" else "",
            )  # fmt: skip
    grid[0, 0].legend(fontsize=7)
    _shared.save_figure(figure, path)
