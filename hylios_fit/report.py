"""What a run leaves: tables, settings, and one self-contained page.

The page is made from what the files hold, rounded as they are, so that it comes out the same when
it is made again from them. It needs no script and nothing from outside itself.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from .errors import HyliosError
from .files import atomic_text
from .results import QUANTITIES, Estimate, Fit, Outcome, Posterior, read_posteriors
from .spectra import write_csv

SHOWN_SPECTRA = 60
"""Spectra that the page draws one by one; of more it draws a sample, and its table has them all."""
SHOWN_PLANES = 3
"""Posteriors of which the page draws every free parameter beside the quantities."""
PRINTED_ROWS = 60
"""Rows of the table on the terminal."""
DIGITS = 7
"""Significant digits in the files."""

_LEADING = ("spectrum", "outcome", "residual_rms", "reduced_chi2", "iterations")
_TRAILING = ("inflation", "model_error", "form", "form_probability", "informed_by_data", "message")
_FITTED = ("spectrum", "wavelength_nm", "measured", "fitted", "residual", "sd")

_LABELS = {
    "melanin_mg_per_mL": ("Melanin", "mg/mL"),
    "blood_percent": ("Blood", "%"),
    "oxygen_saturation": ("Oxygen saturation", ""),
    "water_percent": ("Water", "%"),
}
_DESCRIPTIONS = {
    "melanin_mg_per_mL": "eumelanin and pheomelanin per volume of epidermis",
    "blood_percent": "share of the dermis by volume",
    "oxygen_saturation": "share of haemoglobin that carries oxygen",
    "water_percent": "share of the dermis by volume",
}


# --- files ------------------------------------------------------------------------------------


def write_estimates(directory: str | os.PathLike[str], fits: Sequence[Fit]) -> Path:
    """Write `estimates.csv`, one row for each fit in its order, and `settings.json` beside it.

    Columns: spectrum, outcome, residual_rms, reduced_chi2, iterations; `Q, Q_sd` for every
    quantity and free parameter; then `Q_low, Q_high` (68 % interval) for each, inflation,
    model_error, form, form_probability (of that form), informed_by_data (names of the quantities
    that the data tell, parted by spaces) and message.
    What a failed fit does not have is an empty cell.

    Raises:
        HyliosError: if two fits have the same name, or the file cannot be written.
    """
    _check_names(fits)
    quantities = _quantities(fits)
    header = [*_LEADING]
    header += [column for name in quantities for column in (name, f"{name}_sd")]
    header += [column for name in quantities for column in (f"{name}_low", f"{name}_high")]
    header += _TRAILING
    path = write_csv(
        Path(directory) / "estimates.csv", header, (_estimates_row(fit, quantities) for fit in fits)
    )
    write_settings(directory, fits)
    return path


def _estimates_row(fit: Fit, quantities: Sequence[str]) -> list[str]:
    row = [fit.spectrum, fit.outcome.code, _text(fit.residual_rms), _text(fit.reduced_chi2)]
    row.append(str(fit.iterations))
    estimates = [fit.quantities.get(name) for name in quantities]
    for one in estimates:
        row += ["", ""] if one is None else [_text(one.value), _text(one.sd)]
    for one in estimates:
        row += ["", ""] if one is None else [_text(one.low), _text(one.high)]
    informed = [name for name in quantities if name in fit.quantities and fit[name].informed]
    sure = _text(fit.form_probability.get(fit.form, math.nan))
    return [
        *row,
        _text(fit.inflation),
        _text(fit.model_error),
        fit.form,
        sure,
        " ".join(informed),
        _message(fit),
    ]


def write_fitted(directory: str | os.PathLike[str], fits: Sequence[Fit]) -> Path:
    """Write `fitted.csv`: measured, fitted, residual and sd for each spectrum and wavelength.

    Raises:
        HyliosError: if two fits have the same name, or the file cannot be written.
    """
    _check_names(fits)

    def rows() -> Iterator[tuple[str, ...]]:
        for fit in fits:
            columns = (fit.wavelength_nm, fit.measured, fit.fitted, fit.residual, fit.sd)
            texts = [[_text(value) for value in column.tolist()] for column in columns]
            for row in zip(*texts, strict=True):
                yield (fit.spectrum, *row)

    return write_csv(Path(directory) / "fitted.csv", _FITTED, rows())


def write_settings(directory: str | os.PathLike[str], fits: Sequence[Fit]) -> Path:
    """Write `settings.json`: what the fits share (`shared`), and what one has differently."""
    everything = [_settings(fit) for fit in fits]
    shared, own = _shared(everything)
    content = {
        "shared": shared,
        "by_spectrum": {fit.spectrum: mine for fit, mine in zip(fits, own, strict=True) if mine},
    }
    path = Path(directory) / "settings.json"
    with atomic_text(path) as stream:
        json.dump(content, stream, indent=2, ensure_ascii=False)
        stream.write("\n")
    return path


def _settings(fit: Fit) -> dict[str, Any]:
    """Settings as JSON holds them, so that written and read ones are the same."""
    return json.loads(json.dumps({**fit.settings, "held": dict(fit.fixed)}, default=_json_default))


def _json_default(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _shared(everything: Sequence[dict[str, Any]]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    if not everything:
        return {}, []
    first = everything[0]
    alike = {
        key: value
        for key, value in first.items()
        if all(key in other and other[key] == value for other in everything)
    }
    return alike, [
        {key: value for key, value in one.items() if key not in alike} for one in everything
    ]


def _check_names(fits: Sequence[Fit]) -> None:
    seen: set[str] = set()
    for fit in fits:
        if fit.spectrum in seen:
            raise HyliosError(f"two fits are named {fit.spectrum!r}: expected different names")
        seen.add(fit.spectrum)


def _quantities(fits: Iterable[Fit]) -> list[str]:
    return list(dict.fromkeys([*QUANTITIES, *(name for fit in fits for name in fit.quantities)]))


def _text(value: float) -> str:
    return f"{value:.{DIGITS}g}" if math.isfinite(value) else ""


def _message(fit: Fit) -> str:
    return " ".join(" ".join(fit.messages).split())


def read_dir(
    directory: str | os.PathLike[str],
) -> tuple[list[Fit], dict[str, Posterior] | None]:
    """Read back what a run left in a folder.

    Needed is `estimates.csv`; `fitted.csv`, `settings.json` and `posterior.nc` are read where they
    are. The fits come without their covariances, which the files do not hold, and with the
    probability of the form that was kept alone.

    Raises:
        HyliosError: if a file is missing or is not what `write_estimates` and its like wrote.
    """
    directory = Path(directory)
    path = directory / "estimates.csv"
    if not path.is_file():
        raise HyliosError(f"{directory}: no estimates.csv in it; expected what `fit -o` wrote")
    spectra = _read_fitted(directory / "fitted.csv")
    shared, own = _read_settings(directory / "settings.json")
    fits = []
    header, rows = _read_table(path, _LEADING)
    for line, row in rows:
        cells = dict(zip(header, row, strict=True))
        try:
            fits.append(_read_fit(cells, header, spectra, shared, own))
        except ValueError as error:
            raise HyliosError(f"{path}: line {line}: {error}") from None
    posterior = directory / "posterior.nc"
    if not posterior.is_file():
        return fits, None
    return fits, {one.spectrum: one for one in read_posteriors(posterior)}


def _read_fit(
    cells: Mapping[str, str],
    header: Sequence[str],
    spectra: Mapping[str, np.ndarray],
    shared: Mapping[str, Any],
    own: Mapping[str, Mapping[str, Any]],
) -> Fit:
    name = cells["spectrum"]
    informed = set(cells.get("informed_by_data", "").split())
    quantities = {}
    for column in header:
        if f"{column}_sd" in cells:
            value, sd = _value(cells, column), _value(cells, f"{column}_sd")
            low = _value(cells, f"{column}_low", value - sd)
            high = _value(cells, f"{column}_high", value + sd)
            quantities[column] = Estimate(value, sd, low, high, column in informed)
    settings = {**shared, **own.get(name, {})}
    held = settings.pop("held", {})
    bands = spectra.get(name, np.zeros((0, 4)))
    message = cells.get("message", "")
    sure = _value(cells, "form_probability")
    return Fit(
        spectrum=name,
        outcome=Outcome(cells["outcome"]),
        messages=(message,) if message else (),
        wavelength_nm=bands[:, 0],
        measured=bands[:, 1],
        fitted=bands[:, 2],
        sd=bands[:, 3],
        residual_rms=_value(cells, "residual_rms"),
        reduced_chi2=_value(cells, "reduced_chi2"),
        inflation=_value(cells, "inflation", 1.0),
        model_error=_value(cells, "model_error", 0.0),
        iterations=int(cells["iterations"] or 0),
        form=cells.get("form", ""),
        form_probability={cells["form"]: sure} if math.isfinite(sure) else {},
        names=(),
        value=np.zeros(0),
        covariance=np.zeros((0, 0)),
        z=np.zeros(0),
        z_covariance=np.zeros((0, 0)),
        quantities=quantities,
        fixed=held,
        settings=settings,
    )


def _value(cells: Mapping[str, str], column: str, default: float = math.nan) -> float:
    text = cells.get(column)
    if text is None:
        return default
    return float(text) if text else math.nan


def _read_fitted(path: Path) -> dict[str, np.ndarray]:
    """For each spectrum its wavelength, measured, fitted and sd, shape (bands, 4)."""
    if not path.is_file():
        return {}
    header, rows = _read_table(path, _FITTED)
    wanted = [header.index(name) for name in ("wavelength_nm", "measured", "fitted", "sd")]
    name_column = header.index("spectrum")
    spectra: dict[str, list[list[float]]] = {}
    for line, row in rows:
        try:
            values = [float(row[column]) if row[column] else math.nan for column in wanted]
        except ValueError as error:
            raise HyliosError(f"{path}: line {line}: {error}") from None
        spectra.setdefault(row[name_column], []).append(values)
    return {name: np.array(values) for name, values in spectra.items()}


def _read_settings(path: Path) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    if not path.is_file():
        return {}, {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return dict(content["shared"]), dict(content["by_spectrum"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise HyliosError(f"{path}: not the settings of a run: {error}") from None


def _read_table(
    path: Path, needed: Sequence[str]
) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise HyliosError(f"{path}: cannot be read: {error}") from None
    reader = csv.reader(io.StringIO(text, newline=""))
    header = next(reader, [])
    missing = [name for name in needed if name not in header]
    if missing:
        raise HyliosError(f"{path}: line 1: expected a column {missing[0]!r}, got {header!r}")

    def rows() -> Iterator[tuple[int, list[str]]]:
        try:
            for row in reader:
                if len(row) != len(header):
                    raise HyliosError(
                        f"{path}: line {reader.line_num}: expected {len(header)} cells, "
                        f"got {len(row)}"
                    )
                yield reader.line_num, row
        except csv.Error as error:
            raise HyliosError(f"{path}: line {reader.line_num}: {error}") from None

    return header, rows()


# --- the terminal -----------------------------------------------------------------------------


def print_table(fits: Sequence[Fit], rows: int = PRINTED_ROWS) -> str:
    """The estimates as aligned text: at most `rows` spectra, and how many there are beyond."""
    table = [["spectrum", "outcome"]]
    table[0] += [" ".join(filter(None, _label(name))).lower() for name in QUANTITIES]
    table[0] += ["residual"]
    for fit in fits[:rows]:
        cells = [_printable(fit.spectrum), fit.outcome.code]
        for name in QUANTITIES:
            one = fit.quantities.get(name)
            if one is None or not math.isfinite(one.value):
                cells.append("")
            else:
                mark = "" if one.informed or one.sd == 0 else " *"
                cells.append(_plus_minus(one).replace(" ± ", " +- ") + mark)
        cells.append(f"{fit.residual_rms:.4f}" if math.isfinite(fit.residual_rms) else "")
        table.append(cells)
    width = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    lines = []
    for row in table:
        # A mark stands outside the column of numbers, so that these stay aligned.
        lines.append("  ".join(cell.ljust(w) for cell, w in zip(row, width, strict=True)).rstrip())
    lines.insert(1, "  ".join("-" * w for w in width))
    if any(cell.endswith(" *") for row in table[1:] for cell in row[2:-1]):
        lines.append("* mostly prior: the spectrum tells little of it")
    if len(fits) > rows:
        lines.append(f"and {len(fits) - rows} more spectra, see estimates.csv")
    reasons = [fit for fit in fits[:rows] if fit.outcome is Outcome.unusable]
    lines += [f"{_printable(fit.spectrum)}: {_printable(_message(fit), 200)}" for fit in reasons]
    return "\n".join(lines)


def _printable(text: str, limit: int = 32) -> str:
    # A name may hold what would steer a terminal.
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    return shown if len(shown) <= limit else shown[: limit - 1] + "…"


# --- numbers and names ------------------------------------------------------------------------


def _label(name: str) -> tuple[str, str]:
    """The quantity in words and its unit."""
    if name in _LABELS:
        return _LABELS[name]
    from .skin import SPECS

    unit = SPECS[name].unit if name in SPECS else ""
    return name.replace("_", " ").capitalize(), unit


def _decimals(sd: float) -> int:
    """Decimals that show two digits of the standard deviation."""
    return min(max(1 - math.floor(math.log10(sd)), 0), 5)


def _plus_minus(one: Estimate) -> str:
    if not (math.isfinite(one.sd) and one.sd > 0):
        return f"{one.value:.4g}"
    digits = _decimals(one.sd)
    return f"{one.value:.{digits}f} ± {one.sd:.{digits}f}"


def _interval(one: Estimate) -> str:
    if not (math.isfinite(one.sd) and one.sd > 0):
        return "held"
    digits = _decimals(one.sd)
    return f"{one.low:.{digits}f} to {one.high:.{digits}f}"


def _rounded(values: Any) -> np.ndarray:
    """The values as the files hold them."""
    array = np.asarray(values, dtype=np.float64)
    texts = [float(f"{value:.{DIGITS}g}") for value in array.ravel().tolist()]
    return np.array(texts).reshape(array.shape)


def _round(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


# --- the page ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shown:
    """One fit as the page sees it: rounded as in the files."""

    number: int
    fit: Fit
    wavelength_nm: np.ndarray
    measured: np.ndarray
    fitted: np.ndarray
    sd: np.ndarray
    quantities: dict[str, Estimate]
    residual_rms: float
    reduced_chi2: float

    @classmethod
    def of(cls, number: int, fit: Fit) -> _Shown:
        bands = (_rounded(v) for v in (fit.wavelength_nm, fit.measured, fit.fitted, fit.sd))
        quantities = {
            name: Estimate(
                _round(one.value), _round(one.sd), _round(one.low), _round(one.high), one.informed
            )
            for name, one in fit.quantities.items()
        }
        return cls(
            number,
            fit,
            *bands,
            quantities=quantities,
            residual_rms=_round(fit.residual_rms),
            reduced_chi2=_round(fit.reduced_chi2),
        )


def report(
    fits: Sequence[Fit],
    posterior: Posterior | Mapping[str, Posterior] | None = None,
    path: str | os.PathLike[str] = "report.html",
) -> Path:
    """Write one self-contained HTML page about these fits.

    It has the estimates of every fit in a table, and for up to 60 spectra (of more: those with a
    posterior, the worst residuals, and an even spread of the others) measured against fitted, the
    residual, both colours, the outcome in words, and the posterior where one is given.

    Args:
        fits: at least one.
        posterior: of one spectrum, or by the spectrum's name.
        path: the file to write.

    Raises:
        HyliosError: if there is no fit, a posterior belongs to none of them, or the file cannot be
            written.
    """
    import jinja2

    posteriors = _posteriors(posterior)
    if not fits:
        raise HyliosError("report: expected at least one fit, got none")
    unknown = set(posteriors) - {fit.spectrum for fit in fits}
    if unknown:
        raise HyliosError(f"report: a posterior of {min(unknown)!r}, but no fit of that name")
    shown = [_Shown.of(number, fit) for number, fit in enumerate(fits, start=1)]
    colours = _colours(shown)
    chosen = _chosen(shown, posteriors)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = resources.files("hylios_fit").joinpath("templates/report.html.jinja")
    page = environment.from_string(template.read_text(encoding="utf-8")).render(
        summary=_summary(shown),
        outcomes=_outcomes(fits),
        quantities=[(*_label(name), _DESCRIPTIONS[name]) for name in QUANTITIES],
        rows=[_row(one, colours, one.number in chosen) for one in shown],
        any_prior=any(
            not one.quantities[name].informed and one.quantities[name].sd > 0
            for one in shown
            for name in QUANTITIES
            if name in one.quantities
        ),
        overview=_overview(shown, colours),
        details=[
            _detail(one, colours, posteriors.get(one.fit.spectrum), len(posteriors))
            for one in shown
            if one.number in chosen
        ],
        total=len(shown),
        notes=[str(note) for note in _settings(fits[0]).get("notes") or ()],
        settings=_setting_rows(fits),
    )
    with atomic_text(path) as stream:
        stream.write(page)
    return Path(path)


def _posteriors(posterior: Posterior | Mapping[str, Posterior] | None) -> dict[str, Posterior]:
    if posterior is None:
        return {}
    if isinstance(posterior, Posterior):
        return {posterior.spectrum: posterior}
    return dict(posterior)


def _chosen(shown: Sequence[_Shown], posteriors: Mapping[str, Posterior]) -> set[int]:
    """Which spectra to draw: all of few; of many a sample that depends on nothing but the fits."""
    if len(shown) <= SHOWN_SPECTRA:
        return {one.number for one in shown}
    picked = [one.number for one in shown if one.fit.spectrum in posteriors][:SHOWN_SPECTRA]
    known = [one for one in shown if math.isfinite(one.residual_rms)]
    by_residual = sorted(known, key=lambda one: (-one.residual_rms, one.number))
    chosen = dict.fromkeys(picked)
    for one in by_residual[: SHOWN_SPECTRA // 3]:
        if len(chosen) < SHOWN_SPECTRA:
            chosen[one.number] = None
    rest = [one.number for one in by_residual if one.number not in chosen]
    room = SHOWN_SPECTRA - len(chosen)
    if rest and room > 0:
        for place in np.unique(np.linspace(0, len(rest) - 1, room).round().astype(int)):
            chosen[rest[place]] = None
    return set(chosen)


def _summary(shown: Sequence[_Shown]) -> list[str]:
    fitted = [one for one in shown if one.fit.outcome.is_fitted]
    what = "spectrum was" if len(shown) == 1 else "spectra were"
    sentences = [f"{len(fitted)} of {len(shown)} {what} fitted."]
    if len(fitted) < len(shown):
        others = f"The other {len(shown) - len(fitted)}" if fitted else "All"
        sentences.append(f"{others} have a row that says what went wrong.")
    if not fitted:
        return sentences
    rms = np.array([one.residual_rms for one in fitted])
    if np.isfinite(rms).any():
        typical = "The residual" if len(fitted) == 1 else "The median residual"
        sentences.append(f"{typical} is {np.nanmedian(rms):.4f} in reflectance (root mean square).")
    if len(fitted) > 1:
        ranges = []
        for name in QUANTITIES:
            values = [one.quantities[name].value for one in fitted if name in one.quantities]
            told = sum(name in one.quantities and one.quantities[name].informed for one in fitted)
            label, unit = _label(name)
            if values and told:
                low, high = np.nanquantile(values, [0.05, 0.95])
                unit = f" {unit}" if unit else ""
                share = "all" if told == len(fitted) else str(told)
                ranges.append(f"{label.lower()} {low:.3g} to {high:.3g}{unit} (told by {share})")
        if ranges:
            sentences.append("From the 5th to the 95th percentile: " + "; ".join(ranges) + ".")
        silent = [
            _label(name)[0].lower()
            for name in QUANTITIES
            if not any(name in one.quantities and one.quantities[name].informed for one in fitted)
        ]
        if silent:
            sentences.append(f"No spectrum tells {' or '.join(silent)}: that is the prior's value.")
    return sentences


def _outcomes(fits: Sequence[Fit]) -> list[dict[str, Any]]:
    return [
        {"code": outcome.code, "word": _word(outcome), "advice": outcome.advice, "count": count}
        for outcome in Outcome
        if (count := sum(fit.outcome is outcome for fit in fits))
    ]


def _word(outcome: Outcome) -> str:
    return outcome.code.replace("_", " ")


def _row(one: _Shown, colours: Mapping[int, _Colours], linked: bool) -> dict[str, Any]:
    fit = one.fit
    colour = colours.get(one.number)
    return {
        "number": one.number,
        "name": _plain_text(fit.spectrum),
        "linked": linked,
        "outcome": fit.outcome.code,
        "word": _word(fit.outcome),
        "usable": fit.outcome.is_fitted,
        "hex": None if colour is None else colour.measured_hex,
        "rms": f"{one.residual_rms:.4f}" if math.isfinite(one.residual_rms) else "",
        "chi2": f"{one.reduced_chi2:.3g}" if math.isfinite(one.reduced_chi2) else "",
        "cells": [_cell(one.quantities.get(name)) for name in QUANTITIES],
        "why": "" if fit.outcome is not Outcome.unusable else _plain_text(_message(fit)),
    }


def _cell(estimate: Estimate | None) -> dict[str, Any] | None:
    if estimate is None or not math.isfinite(estimate.value):
        return None
    return {
        "value": _plus_minus(estimate),
        "interval": _interval(estimate),
        "prior": not estimate.informed and estimate.sd > 0,
    }


def _plain_text(text: str) -> str:
    """Without the control characters that no HTML may hold."""
    return re.sub(
        r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", text
    )


def _detail(
    one: _Shown, colours: Mapping[int, _Colours], posterior: Posterior | None, sampled: int
) -> dict[str, Any]:
    fit = one.fit
    colour = colours.get(one.number)
    estimates = []
    for name, estimate in one.quantities.items():
        cell = _cell(estimate)
        if cell is not None:
            label, unit = _label(name)
            estimates.append({"label": label, "unit": unit, "name": name, **cell})
    return {
        "number": one.number,
        "name": _plain_text(fit.spectrum),
        "outcome": fit.outcome.code,
        "word": _word(fit.outcome),
        "advice": fit.outcome.advice,
        "usable": fit.outcome.is_fitted,
        "message": _plain_text(_message(fit)),
        "form": _form(fit),
        "rms": f"{one.residual_rms:.4f}" if math.isfinite(one.residual_rms) else "",
        "chi2": f"{one.reduced_chi2:.3g}" if math.isfinite(one.reduced_chi2) else "",
        "iterations": fit.iterations,
        "bands": int(np.isfinite(one.measured).sum()),
        "estimates": estimates,
        "colour": colour,
        "difference": None if colour is None else colour.words,
        "figure": _spectrum_figure(one) if np.isfinite(one.measured).any() else None,
        "posterior": None if posterior is None else _posterior(posterior, one, sampled),
    }


def _form(fit: Fit) -> str:
    sure = fit.form_probability.get(fit.form, math.nan)
    return f"{fit.form} (probability {sure:.2f})" if math.isfinite(sure) else fit.form


def _setting_rows(fits: Sequence[Fit]) -> list[tuple[str, str]]:
    everything = [_settings(fit) for fit in fits]
    shared, own = _shared(everything)
    shared.pop("notes", None)
    rows: list[tuple[str, str]] = []

    def add(name: str, value: Any) -> None:
        if isinstance(value, dict) and value:
            for key, inner in value.items():
                add(f"{name}, {key}", inner)
        elif isinstance(value, list):
            rows.append((name, ", ".join(_setting(item) for item in value) or "none"))
        elif value != {}:
            rows.append((name, _setting(value)))

    for name, value in shared.items():
        add(name.replace("_", " "), value)
    differing = sorted({key for one in own for key in one} - {"notes"})
    if differing:
        rows.append(("differs between spectra (settings.json)", ", ".join(differing)))
    return [(_plain_text(name), _plain_text(value)) for name, value in rows]


def _setting(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# --- colours ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Colours:
    measured_hex: str
    measured_ita: float
    fitted_hex: str | None
    fitted_ita: float | None
    difference: float | None

    @property
    def words(self) -> str | None:
        """What the colour difference means to the eye."""
        if self.difference is None:
            return None
        for limit, words in ((1, "not visible"), (2, "hardly visible"), (5, "visible beside it")):
            if self.difference < limit:
                return words
        return "plainly another colour"


def _colours(shown: Sequence[_Shown]) -> dict[int, _Colours]:
    """Colours of the spectra that cover the visible, by number."""
    from .appearance import appearances, colour_differences

    groups: dict[bytes, list[_Shown]] = {}
    for one in shown:
        if one.wavelength_nm.size:
            groups.setdefault(one.wavelength_nm.tobytes(), []).append(one)
    colours: dict[int, _Colours] = {}
    for members in groups.values():
        wavelength = members[0].wavelength_nm
        measured = appearances(wavelength, np.stack([one.measured for one in members]))
        fitted = appearances(wavelength, np.stack([one.fitted for one in members]))
        differences = colour_differences(measured, fitted)
        for one, a, b, difference in zip(members, measured, fitted, differences, strict=True):
            if a is not None:
                colours[one.number] = _Colours(
                    a.hex,
                    a.ita,
                    None if b is None else b.hex,
                    None if b is None else b.ita,
                    difference,
                )
    return colours


# --- figures ----------------------------------------------------------------------------------

_INK, _FIT, _BAND, _GRID, _DRAWS = "#1f2328", "#b3402a", "#d98c74", "#e4e1da", "#35617f"
_STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9.5,
    "axes.edgecolor": "#8a867e",
    "axes.labelcolor": _INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": _GRID,
    "grid.linewidth": 0.6,
    "xtick.color": "#57534c",
    "ytick.color": "#57534c",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    # The same fits give the same bytes.
    "svg.hashsalt": "hylios_fit",
    "svg.fonttype": "none",
}


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), facecolor="none")


def _data_uri(figure: Any, kind: str = "svg", dpi: int = 110, tight: bool = False) -> str:
    stream = io.BytesIO()
    metadata = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
    box = {"bbox_inches": "tight", "pad_inches": 0.04} if tight else {}
    figure.savefig(stream, format=kind, dpi=dpi, metadata=metadata, **box)
    mime = {"svg": "image/svg+xml", "png": "image/png"}[kind]
    return f"data:{mime};base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def _spectrum_figure(one: _Shown) -> str:
    """Measured against fitted, and below it the residual, with the band of what was expected and
    the wider one that the intervals allow for."""
    from matplotlib import rc_context

    kept = np.isfinite(one.measured)
    wavelength, measured = one.wavelength_nm[kept], one.measured[kept]
    fitted, sd = one.fitted[kept], one.sd[kept]
    allowed = np.hypot(_round(one.fit.inflation) * sd, _round(one.fit.model_error) * fitted)
    wider = one.fit.inflation > 1.0 or one.fit.model_error > 0.0
    has_fit = bool(np.isfinite(fitted).any())
    few = wavelength.size <= 80
    with rc_context(_STYLE):
        figure = _figure(6.9, 4.1 if has_fit else 2.7)
        if has_fit:
            top, bottom = figure.subplots(
                2, 1, sharex=True, gridspec_kw={"height_ratios": [2.7, 1], "hspace": 0.09}
            )
        else:
            top, bottom = figure.subplots(), None
        if has_fit:
            if wider:
                top.fill_between(
                    wavelength, fitted - allowed, fitted + allowed, color=_BAND, alpha=0.15,
                    linewidth=0, label="as the intervals allow",
                )  # fmt: skip
            top.fill_between(
                wavelength, fitted - sd, fitted + sd, color=_BAND, alpha=0.35, linewidth=0,
                label="±1 sd of noise and surrogate error",
            )  # fmt: skip
            top.plot(wavelength, fitted, color=_FIT, linewidth=1.5, label="fitted")
        style: dict[str, Any] = {"color": _INK, "label": "measured"}
        if few:
            top.plot(wavelength, measured, ".", markersize=4.5, **style)
        else:
            top.plot(wavelength, measured, linewidth=0.9, **style)
        top.set_ylabel("Reflectance (fraction)")
        highest = max(np.nanmax(measured), np.nanmax(fitted + sd) if has_fit else 0)
        lowest = min(0.0, float(np.nanmin(measured)))
        top.set_ylim(lowest, max(highest * 1.06, 0.02))
        top.legend(loc="best")
        lowest_axes = top
        if bottom is not None:
            residual = measured - fitted
            if wider:
                bottom.fill_between(
                    wavelength, -allowed, allowed, color=_BAND, alpha=0.15, linewidth=0
                )
            bottom.fill_between(wavelength, -sd, sd, color=_BAND, alpha=0.35, linewidth=0)
            bottom.axhline(0, color=_FIT, linewidth=0.9)
            bottom.plot(wavelength, residual, color=_INK, linewidth=0.9)
            if few:
                bottom.plot(wavelength, residual, ".", color=_INK, markersize=4)
            reach = 1.12 * max(np.nanmax(np.abs(residual)), np.nanmax(sd), 1e-4)
            bottom.set_ylim(-reach, reach)
            bottom.set_ylabel("Residual")
            figure.align_ylabels([top, bottom])
            lowest_axes = bottom
        lowest_axes.set_xlabel("Wavelength (nm)")
        lowest_axes.margins(x=0.015)
        # Fixed, for a tight box draws every figure twice.
        bottom_inches, height = 0.5, figure.get_size_inches()[1]
        figure.subplots_adjust(0.125, bottom_inches / height, 0.995, 0.985)
        return _data_uri(figure)


def _overview(shown: Sequence[_Shown], colours: Mapping[int, _Colours]) -> dict[str, str] | None:
    """All fits at a glance: melanin against the typology angle, and residuals by wavelength."""
    from matplotlib import rc_context

    name = QUANTITIES[0]
    fitted = [one for one in shown if one.fit.outcome.is_fitted and name in one.quantities]
    if len(fitted) < 5:
        return None
    coloured = [one for one in fitted if one.number in colours]
    axes = Counter(one.wavelength_nm.tobytes() for one in fitted)
    common = axes.most_common(1)[0][0]
    alike = [one for one in fitted if one.wavelength_nm.tobytes() == common]
    wavelength = alike[0].wavelength_nm
    with rc_context(_STYLE):
        figure = _figure(11.2, 3.7)
        left, right = figure.subplots(1, 2, gridspec_kw={"wspace": 0.24})
        many = len(fitted) > 300
        if len(coloured) >= 5:
            points = coloured
            x = np.array([colours[one.number].measured_ita for one in points])
            fill = [colours[one.number].measured_hex for one in points]
            left.set_xlabel("Individual typology angle of the measured spectrum (°)")
            left.invert_xaxis()
            caption = "Melanin against the individual typology angle (dark skin to the right)"
        else:
            points, fill = fitted, [_FIT] * len(fitted)
            x = np.array([one.quantities[QUANTITIES[1]].value for one in points])
            left.set_xlabel("Blood (%)")
            caption = "Melanin against blood"
        y = np.array([one.quantities[name].value for one in points])
        if not many:
            low = y - np.array([one.quantities[name].low for one in points])
            high = np.array([one.quantities[name].high for one in points]) - y
            left.errorbar(
                x, y, yerr=np.maximum([low, high], 0), fmt="none", ecolor="#a39e94", elinewidth=0.8
            )
        left.scatter(
            x, y, c=fill, s=6 if many else 26, linewidths=0 if many else 0.5, edgecolors=_INK,
            zorder=3,
        )  # fmt: skip
        if np.nanmin(y) > 0 and np.nanmax(y) > 10 * np.nanmin(y):
            left.set_yscale("log")
            left.yaxis.set_major_formatter("{x:g}")
        left.set_ylabel("Melanin (mg/mL)")

        residual = np.stack([one.measured - one.fitted for one in alike])
        known = np.isfinite(residual).any(axis=0)
        quantiles = np.nanquantile(residual[:, known], [0.05, 0.16, 0.5, 0.84, 0.95], axis=0)
        nm = wavelength[known]
        for (a, b), alpha, words in (((0, 4), 0.18, "5 to 95 %"), ((1, 3), 0.32, "16 to 84 %")):
            right.fill_between(
                nm, quantiles[a], quantiles[b], color=_FIT, alpha=alpha, linewidth=0, label=words
            )
        right.plot(nm, quantiles[2], color=_FIT, linewidth=1.5, label="median")
        right.axhline(0, color=_INK, linewidth=0.8)
        right.set_xlabel("Wavelength (nm)")
        right.set_ylabel("Measured minus fitted reflectance")
        right.margins(x=0.015)
        right.legend(loc="best", ncols=3)
        caption += (
            ", with 68 % intervals, each point in its own colour"
            if not many
            else ", each point in its own colour"
        )
        caption += f". Beside it, the residuals of {len(alike)} spectra by wavelength."
        if len(coloured) < 5:
            caption = caption.replace(", each point in its own colour", "")
        return {
            "figure": _data_uri(figure, "png" if many else "svg", dpi=150, tight=True),
            "caption": caption,
        }


def _posterior(posterior: Posterior, one: _Shown, sampled: int) -> dict[str, Any]:
    names = [name for name in posterior.names if posterior.draws(name).std() > 0]
    quantities = [name for name in QUANTITIES if name in names]
    variables = []
    for name in posterior.names:
        label, unit = _label(name)
        cell = _cell(posterior[name])
        rhat, ess = posterior.rhat.get(name, math.nan), posterior.ess.get(name, math.nan)
        variables.append(
            {
                "label": label,
                "unit": unit,
                "cell": cell,
                "rhat": f"{rhat:.3f}" if math.isfinite(rhat) else "",
                "ess": f"{ess:,.0f}" if math.isfinite(ess) else "",
                "poor": not rhat <= 1.01 or not ess >= 400,
            }
        )
    main = quantities or names[:4]
    return {
        "verdict": _plain_text(posterior.verdict[:1].upper() + posterior.verdict[1:]),
        "converged": posterior.converged,
        "variables": variables,
        "autocorrelation": (
            f"{posterior.autocorrelation_time:.3g}"
            if math.isfinite(posterior.autocorrelation_time)
            else "unknown"
        ),
        "steps": posterior.steps,
        "lengths": (
            f"{posterior.steps / posterior.autocorrelation_time:.0f}"
            if posterior.autocorrelation_time > 0
            else "unknown"
        ),
        "burn_in": posterior.burn_in,
        "acceptance": f"{posterior.acceptance:.2f}",
        "draws": posterior.draws(posterior.names[0]).size,
        "corner": _corner(posterior, main, one),
        "planes": (
            _corner(posterior, names, one)
            if sampled <= SHOWN_PLANES and len(names) > len(main)
            else None
        ),
    }


def _corner(posterior: Posterior, names: Sequence[str], one: _Shown) -> str | None:
    """Marginals and planes of the posterior; lines mark the fit that it started from."""
    import warnings

    from matplotlib import rc_context

    if not names:
        return None
    draws = np.stack([posterior.draws(name) for name in names], axis=1)
    draws = draws[np.isfinite(draws).all(axis=1)]
    if len(draws) <= len(names):
        return None
    # Contours need no more draws than this, and they take long.
    draws = draws[:: max(1, len(draws) // 20_000)]
    size = len(names)
    small = size > 4
    labels = []
    for name in names:
        label, unit = _label(name)
        words = label.replace(" ", "\n", 1) if small else label
        labels.append(
            f"{words}\n({unit})" if unit and small else f"{words} ({unit})" if unit else words
        )
    truths = [one.quantities[name].value if name in one.quantities else None for name in names]
    with warnings.catch_warnings(action="ignore"), rc_context({**_STYLE, "axes.grid": False}):
        import corner

        side = (1.25 if small else 1.9) * size
        figure = _figure(side, side)
        corner.corner(
            draws,
            fig=figure,
            labels=labels,
            truths=truths,
            truth_color=_FIT,
            color=_DRAWS,
            bins=24,
            smooth=1.0,
            plot_datapoints=False,
            fill_contours=True,
            max_n_ticks=3,
            levels=(0.39, 0.86),
            quantiles=None if small else (0.15865, 0.84135),
            label_kwargs={"fontsize": 7 if small else 10},
            labelpad=0.06 if small else 0.02,
        )
        for axes in figure.axes:
            axes.tick_params(labelsize=6 if small else 8.5)
        return _data_uri(figure, "png", dpi=90 if small else 110, tight=True)
