"""Measured spectra: read from CSV files and from other libraries' objects, written atomically.

A file that cannot be read at all raises `HyliosError` with file, line and column. A file in which
one spectrum is bad is read; that spectrum carries a `problem`, so that no row is lost. What was
decided on the way (unit, layout, order, dropped bands) is said in `Spectra.notes`.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .errors import HyliosError
from .files import atomic_text

WAVELENGTH_LOWER = 250.0
"""Shortest wavelength of the model, nm."""
WAVELENGTH_UPPER = 2500.0
"""Longest wavelength of the model, nm."""
MINIMUM_BANDS = 2
"""Bands that a spectrum must have to be fitted."""
TOLERATED_BELOW = -0.01
"""Reflectance down to here is taken for the noise of a dark measurement and kept as it is."""
TOLERATED_ABOVE = 1.02
"""Reflectance up to here is taken for an error of calibration and kept as it is."""
UNITS = ("auto", "fraction", "percent")

# A spectrum whose values all stay below the first is a fraction, one with a median above the
# second is in percent. In between nobody can know.
_FRACTION_MAXIMUM = 1.2
_PERCENT_MEDIAN = 2.0
# A file's unit may be told by a majority: the few that disagree become rows with a problem.
_MAJORITY = 0.8

_DELIMITERS = {"\t": "tab", ";": "semicolon", ",": "comma"}
_MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--"})
_HEADER = re.compile(
    r"(?:(?:wave[\s_-]?lengths?|wl|lambda|λ)[\s_,/([]*(?P<unit>[^\W\d_]*)[\s)\]]*|(?P<nm>nm))",
    re.IGNORECASE,
)
_NANOMETRES = frozenset({"", "nm", "nanometre", "nanometres", "nanometer", "nanometers"})
_EXPECTED_HEADER = (
    "expected a first line 'wavelength_nm,NAME,NAME,...' (a column for each spectrum) or "
    "'name,400,410,...' (a row for each spectrum)"
)


@dataclass(frozen=True, eq=False)
class Spectra:
    """Reflectance spectra that share one wavelength axis.

    Raises:
        HyliosError: if shapes disagree, or wavelengths are not finite and strictly increasing.
    """

    wavelength_nm: np.ndarray
    """Wavelengths in nm, shape (bands,), strictly increasing."""
    names: tuple[str, ...]
    """One unique name for each spectrum, exactly as it came."""
    reflectance: np.ndarray
    """Reflectance as a fraction, shape (spectra, bands), NaN where a band is missing."""
    problems: tuple[str | None, ...]
    """Why a spectrum cannot be fitted; None where it can."""
    notes: tuple[str, ...] = ()
    """What was decided when the spectra were read, in words."""
    source: str = ""
    """Where they come from: a file's path, or a kind of object."""
    noise: np.ndarray | None = field(default=None)
    """Standard deviation of the noise given with the spectra, shape (bands,), or None."""
    came_nm: np.ndarray | None = field(default=None)
    """The wavelengths in the order in which they came; None where that is theirs."""

    def __post_init__(self) -> None:
        wavelength = _frozen(self.wavelength_nm)
        reflectance = _frozen(self.reflectance)
        noise = None if self.noise is None else _frozen(self.noise)
        if wavelength.ndim != 1:
            raise HyliosError(f"wavelength_nm: expected shape (bands,), got {wavelength.shape}")
        if not np.all(np.isfinite(wavelength)) or np.any(np.diff(wavelength) <= 0):
            raise HyliosError("wavelength_nm: expected finite, strictly increasing wavelengths")
        expected = (len(self.names), wavelength.size)
        if reflectance.shape != expected:
            raise HyliosError(f"reflectance: expected shape {expected}, got {reflectance.shape}")
        if len(self.problems) != len(self.names):
            raise HyliosError(
                f"problems: expected one for each of {len(self.names)} spectra, "
                f"got {len(self.problems)}"
            )
        if len(set(self.names)) != len(self.names):
            raise HyliosError("names: expected a different name for each spectrum")
        if noise is not None and noise.shape != wavelength.shape:
            raise HyliosError(f"noise: expected shape {wavelength.shape}, got {noise.shape}")
        object.__setattr__(self, "wavelength_nm", wavelength)
        object.__setattr__(self, "reflectance", reflectance)
        object.__setattr__(self, "noise", noise)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "problems", tuple(self.problems))
        object.__setattr__(self, "notes", tuple(self.notes))

    def __len__(self) -> int:
        return len(self.names)

    def bands(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Wavelengths (nm) and reflectance of one spectrum without its missing bands."""
        kept = np.isfinite(self.reflectance[index])
        return self.wavelength_nm[kept], self.reflectance[index][kept]

    def select(self, indices: Sequence[int]) -> Spectra:
        """The spectra at these positions, in this order."""
        chosen = list(indices)
        return replace(
            self,
            names=tuple(self.names[i] for i in chosen),
            reflectance=self.reflectance[chosen],
            problems=tuple(self.problems[i] for i in chosen),
        )


def _frozen(values: Any) -> np.ndarray:
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


# --- reading a file ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Grid:
    """What a source holds, before any judgement of its values."""

    wavelength: np.ndarray  # (bands,), as they came
    names: list[str]
    values: np.ndarray  # (spectra, bands), in the source's unit, NaN where missing
    broken: dict[int, list[tuple[int, str]]]  # spectrum -> (band, what is wrong in its cell)
    notes: list[str]
    source: str
    where: Callable[[int, int], str]  # (spectrum, band) -> "line 3, column 2"


def read_spectra(
    path: str | os.PathLike[str],
    unit: str = "auto",
    wavelength_range: tuple[float, float] | None = None,
    noise_column: str | None = None,
) -> Spectra:
    """Read reflectance spectra from a CSV file.

    The first column holds wavelengths in nm under the header `wavelength_nm` (also `wavelength`,
    `nm`, `wl`, with or without a unit) and each further column one spectrum; the transposed
    layout, a row for each spectrum with wavelengths in the header, is recognised. Columns are
    parted by commas, semicolons or tabs; with the latter two a decimal comma is read. Bands stay
    as measured: sorted, never resampled.

    Args:
        path: the file.
        unit: "fraction", "percent", or "auto", which decides by the values and refuses where
            they could be either.
        wavelength_range: keep bands from the first to the second wavelength (nm, inclusive).
        noise_column: the name of a column (a row, if transposed) that is no spectrum but the
            standard deviation of the noise by wavelength, in the same unit.

    Raises:
        HyliosError: if the file as a whole cannot be used; says where and why.
    """
    path = Path(path)
    text, notes = _read_text(path)
    rows, delimiter = _rows(text, path)
    header_line, header = rows[0]
    body = rows[1:]
    layout = _layout(header, body, delimiter)
    if layout is None:
        raise HyliosError(
            f"{path}: line {header_line}: no header: {_EXPECTED_HEADER}, "
            f"got {_shown(delimiter.join(header))}"
        )
    if not body:
        raise HyliosError(f"{path}: a header but no data below line {header_line}")
    read = _read_columns if layout == "columns" else _read_rows
    grid = read(path, header_line, header, body, delimiter, notes)
    return _judge(grid, unit, wavelength_range, noise_column)


def _read_text(path: Path) -> tuple[str, list[str]]:
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise HyliosError(f"{path}: cannot be read: {error.strerror or error}") from None
    if not raw:
        raise HyliosError(f"{path}: the file is empty (zero bytes); {_EXPECTED_HEADER}")
    if raw[:4] == b"PK\x03\x04":
        raise HyliosError(f"{path}: a spreadsheet or archive; expected CSV: save it as CSV first")
    notes: list[str] = []
    encoding = "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = raw.decode(encoding)
    except UnicodeDecodeError:
        text = raw.decode("cp1252", errors="replace")
        notes.append("The file is not UTF-8: its names were read as Windows-1252.")
    if "\x00" in text:
        raise HyliosError(f"{path}: a binary file; expected CSV text")
    if not text.strip():
        raise HyliosError(f"{path}: the file has no text; {_EXPECTED_HEADER}")
    return text, notes


def _rows(text: str, path: Path) -> tuple[list[tuple[int, list[str]]], str]:
    """Non-empty rows with their line numbers, and the delimiter that parts their cells."""
    skipped = 0
    lines = text.splitlines(keepends=True)
    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            break
        skipped += 1
    else:
        raise HyliosError(f"{path}: only comments; {_EXPECTED_HEADER}")
    body = "".join(lines[skipped:])
    sample = "".join(lines[skipped : skipped + 20])
    delimiter = _sniff(sample)
    if delimiter is None:
        line = lines[skipped].strip()
        if _is_wavelength_header(line.strip('"')):
            raise HyliosError(
                f"{path}: line {skipped + 1}: no spectra: the header has one column "
                f"({_shown(line)}); {_EXPECTED_HEADER}"
            )
        raise HyliosError(
            f"{path}: line {skipped + 1}: expected columns parted by commas, semicolons or tabs, "
            f"got {_shown(line)}"
        )
    rows: list[tuple[int, list[str]]] = []
    reader = csv.reader(io.StringIO(body, newline=None), delimiter=delimiter, strict=True)
    try:
        for cells in reader:
            cells = [cell.strip() for cell in cells]
            if any(cells):
                rows.append((skipped + reader.line_num, cells))
    except csv.Error as error:
        raise HyliosError(f"{path}: line {skipped + reader.line_num}: {error}") from None
    return rows, delimiter


def _sniff(sample: str) -> str | None:
    """The delimiter under which the header makes sense and most rows have its length."""
    best: tuple[tuple[bool, float, int], str] | None = None
    for delimiter in _DELIMITERS:
        reader = csv.reader(io.StringIO(sample, newline=None), delimiter=delimiter)
        try:
            rows = [[cell.strip() for cell in row] for row in reader if any(row)]
        except csv.Error:
            continue
        if not rows or len(rows[0]) < 2:
            continue
        body = list(enumerate(rows[1:]))
        known = _layout(rows[0], body, delimiter) is not None
        alike = sum(len(row) == len(rows[0]) for row in rows) / len(rows)
        rank = (known, alike, len(rows[0]))
        if best is None or rank > best[0]:
            best = rank, delimiter
    return None if best is None else best[1]


def _is_wavelength_header(cell: str) -> bool:
    return _HEADER.fullmatch(cell.strip()) is not None


def _layout(header: list[str], body: Sequence[tuple[int, list[str]]], delimiter: str) -> str | None:
    """'columns' (a column for each spectrum), 'rows' (a row for each), or None: no header."""
    cells = _trimmed(header)
    if len(cells) < 2 or _header_wavelength(cells[0], delimiter) is not None:
        return None
    ends_in_wavelengths = _header_wavelength(cells[-1], delimiter) is not None
    if _is_wavelength_header(cells[0]):
        # Spectra may be called 1, 2, 3: then the first column holds the wavelengths all the same.
        first = [_number(row[0], delimiter) for _, row in body]
        all_wavelengths = all(_header_wavelength(c, delimiter) is not None for c in cells[1:])
        if all_wavelengths and first and all(value is None for value in first):
            return "rows"
        return "columns"
    return "rows" if ends_in_wavelengths else None


def _trimmed(cells: list[str]) -> list[str]:
    end = len(cells)
    while end and not cells[end - 1]:
        end -= 1
    return cells[:end]


def _number(cell: str, delimiter: str) -> float | None:
    """The cell as a number, NaN where it is missing, None where it is neither."""
    try:
        value = float(cell)
    except ValueError:
        if cell.lower() in _MISSING:
            return math.nan
        if delimiter != "," and cell.count(",") == 1 and "." not in cell:
            return _number(cell.replace(",", "."), delimiter)
        return None
    return None if "_" in cell else value


def _header_wavelength(cell: str, delimiter: str) -> float | None:
    value = _number(re.sub(r"(?i)[\s_]*nm$", "", cell), delimiter)
    return None if value is None or not math.isfinite(value) else value


def _read_columns(
    path: Path,
    header_line: int,
    header: list[str],
    body: list[tuple[int, list[str]]],
    delimiter: str,
    notes: list[str],
) -> _Grid:
    match = _HEADER.fullmatch(header[0])
    unit = (match.group("unit") or "").lower() if match else ""
    if unit not in _NANOMETRES:
        raise HyliosError(
            f"{path}: line {header_line}, column 1: expected wavelengths in nm, "
            f"the header says {_shown(header[0])}"
        )
    width = max(len(_trimmed(header)), max(_used_width(row) for _, row in body))
    if width > len(header):
        line, row = next((line, row) for line, row in body if _used_width(row) > len(header))
        raise HyliosError(_too_many(path, line, len(header), _used_width(row), delimiter))
    names = [name or f"column {number}" for number, name in enumerate(header[1:width], start=2)]
    wavelength = np.empty(len(body))
    values = np.full((width - 1, len(body)), math.nan)
    broken: dict[int, list[tuple[int, str]]] = {}
    for band, (line, row) in enumerate(body):
        value = _number(row[0], delimiter)
        if value is None or not math.isfinite(value):
            raise HyliosError(
                f"{path}: line {line}, column 1: expected a wavelength in nm, got {_shown(row[0])}"
            )
        wavelength[band] = value
        if len(row) < width:
            notes.append(
                f"Line {line} has {len(row)} of {width} cells: the others were taken "
                "for missing bands."
            )
        for spectrum, cell in enumerate(row[1:width]):
            number = _number(cell, delimiter)
            if number is not None and not math.isinf(number):
                values[spectrum, band] = number
            else:
                why = f"({value:g} nm): expected a number, got {_shown(cell)}"
                broken.setdefault(spectrum, []).append(
                    (band, f"line {line}, column {spectrum + 2} {why}")
                )
    lines = [line for line, _ in body]
    return _Grid(
        wavelength,
        names,
        values,
        broken,
        notes,
        str(path),
        lambda spectrum, band: f"line {lines[band]}, column {spectrum + 2}",
    )


def _read_rows(
    path: Path,
    header_line: int,
    header: list[str],
    body: list[tuple[int, list[str]]],
    delimiter: str,
    notes: list[str],
) -> _Grid:
    cells = _trimmed(header)
    numbers = [_header_wavelength(cell, delimiter) for cell in cells]
    start = next(i for i, number in enumerate(numbers) if i and number is not None)
    wavelengths: list[float] = []
    for column, (cell, number) in enumerate(zip(cells, numbers, strict=True), start=1):
        if column <= start:
            continue
        if number is None:
            raise HyliosError(
                f"{path}: line {header_line}, column {column}: expected a wavelength in nm, "
                f"got {_shown(cell)}"
            )
        wavelengths.append(number)
    notes.append("A row for each spectrum: wavelengths were read from the header.")
    if start > 1:
        left_out = ", ".join(_shown(cell) for cell in cells[1:start])
        notes.append(f"Columns ahead of the wavelengths were left out: {left_out}.")
    values = np.full((len(body), len(wavelengths)), math.nan)
    broken: dict[int, list[tuple[int, str]]] = {}
    names: list[str] = []
    for spectrum, (line, row) in enumerate(body):
        if _used_width(row) > len(cells):
            raise HyliosError(_too_many(path, line, len(cells), _used_width(row), delimiter))
        if len(row) < len(cells):
            notes.append(
                f"Line {line} has {len(row)} of {len(cells)} cells: the others were "
                "taken for missing bands."
            )
        names.append(row[0] or f"line {line}")
        for band, cell in enumerate(row[start : len(cells)]):
            number = _number(cell, delimiter)
            if number is not None and not math.isinf(number):
                values[spectrum, band] = number
            else:
                why = f"({wavelengths[band]:g} nm): expected a number, got {_shown(cell)}"
                broken.setdefault(spectrum, []).append(
                    (band, f"line {line}, column {start + band + 1} {why}")
                )
    lines = [line for line, _ in body]
    return _Grid(
        np.array(wavelengths),
        names,
        values,
        broken,
        notes,
        str(path),
        lambda spectrum, band: f"line {lines[spectrum]}, column {start + band + 1}",
    )


def _used_width(row: list[str]) -> int:
    return len(_trimmed(row))


def _too_many(path: Path, line: int, expected: int, got: int, delimiter: str) -> str:
    hint = " (decimal commas need semicolons or tabs between columns)" if delimiter == "," else ""
    return f"{path}: line {line}: expected {expected} cells as in the header, got {got}{hint}"


def _shown(text: str, limit: int = 60) -> str:
    return repr(text if len(text) <= limit else text[: limit - 1] + "…")


# --- judging what was read --------------------------------------------------------------------


def _judge(
    grid: _Grid,
    unit: str,
    wavelength_range: tuple[float, float] | None,
    noise_column: str | None = None,
) -> Spectra:
    """Order, range, unit and values: the part that files and objects share."""
    source = grid.source
    if unit not in UNITS:
        raise HyliosError(f"unit: expected one of {', '.join(UNITS)}, got {unit!r}")
    notes = list(grid.notes)
    wavelength, values, order = _ordered(grid, notes)
    kept = _kept(wavelength, wavelength_range, notes, source)
    wavelength, values, order = wavelength[kept], values[:, kept], order[kept]

    used = set(order.tolist())
    broken = {
        row: [why for band, why in found if band in used] for row, found in grid.broken.items()
    }
    rows = list(range(len(grid.names)))
    noise = None
    if noise_column is not None:
        if noise_column not in grid.names:
            raise HyliosError(f"{source}: no column {noise_column!r} for the noise")
        row = grid.names.index(noise_column)
        if broken.get(row):
            raise HyliosError(f"{source}: noise: {broken[row][0]}")
        noise = values[row]
        if not np.all(noise > 0):
            band = int(np.argmax(~(noise > 0)))
            raise HyliosError(
                f"{source}: {grid.where(row, order[band])} ({wavelength[band]:g} nm): "
                f"expected a noise above 0, got {noise[band]:g}"
            )
        rows.remove(row)
    if not rows:
        raise HyliosError(f"{source}: no spectra beside the wavelengths")
    values = values[rows]

    scale, looks = _scale(values, unit, wavelength, source, notes)
    values = values * scale
    if noise is not None:
        noise = noise * scale
    names = _unique([grid.names[row] for row in rows], notes)

    problems: list[str | None] = []
    finite = np.isfinite(values)
    counts = finite.sum(axis=1)
    low = finite & (values < TOLERATED_BELOW)
    high = finite & (values > TOLERATED_ABOVE)
    for spectrum, row in enumerate(rows):
        found = list(broken.get(row, ()))
        for name, mask in (("below 0", low[spectrum]), ("above 1", high[spectrum])):
            found += [
                f"{grid.where(row, order[band])} ({wavelength[band]:g} nm): "
                f"reflectance {name}: {values[spectrum, band]:.6g}"
                for band in np.flatnonzero(mask)
            ]
        if scale == 0.01 and looks[spectrum] == "fraction":
            found.append(
                "values of a fraction in a file of percent "
                f"(largest {np.nanmax(values[spectrum]):.3g} %)"
            )
        elif scale == 1 and looks[spectrum] == "percent":
            found.append("values of percent in a file of fractions")
        if counts[spectrum] == 0 and not found:
            found.append("no values: every band is empty")
        elif counts[spectrum] < MINIMUM_BANDS and not found:
            found.append(f"{counts[spectrum]} band has a value; at least {MINIMUM_BANDS} needed")
        problems.append(_summary(found))

    _note_missing(names, problems, finite, wavelength, notes)
    fine = np.array([problem is None for problem in problems])[:, None]
    _note_tolerated(names, values, fine & finite & (values < 0), "slightly below 0", notes)
    _note_tolerated(names, values, fine & finite & (values > 1), "slightly above 1", notes)
    came = grid.wavelength[np.sort(order)] if np.any(np.diff(order) < 0) else None
    return Spectra(
        wavelength, tuple(names), values, tuple(problems), tuple(notes), source, noise, came
    )


def _ordered(grid: _Grid, notes: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    order = np.argsort(grid.wavelength, kind="stable")
    wavelength = grid.wavelength[order]
    twice = np.flatnonzero(np.diff(wavelength) == 0)
    if twice.size:
        first, second = order[twice[0]], order[twice[0] + 1]
        raise HyliosError(
            f"{grid.source}: wavelength {wavelength[twice[0]]:g} nm twice "
            f"({grid.where(0, int(first))} and {grid.where(0, int(second))}); "
            "expected each wavelength once"
        )
    if np.any(np.diff(order) < 0):
        falling = np.all(np.diff(grid.wavelength) < 0)
        notes.append(f"Wavelengths came {'falling' if falling else 'unsorted'}: sorted.")
    return wavelength, grid.values[:, order], order


def _kept(
    wavelength: np.ndarray,
    wavelength_range: tuple[float, float] | None,
    notes: list[str],
    source: str,
) -> np.ndarray:
    inside = (wavelength >= WAVELENGTH_LOWER) & (wavelength <= WAVELENGTH_UPPER)
    limits = f"{WAVELENGTH_LOWER:g} to {WAVELENGTH_UPPER:g} nm"
    if not inside.any():
        hint = (
            " (micrometres? expected nm)" if np.all((wavelength > 0.2) & (wavelength < 3)) else ""
        )
        raise HyliosError(
            f"{source}: all wavelengths lie outside {limits}: "
            f"{wavelength[0]:g} to {wavelength[-1]:g}{hint}"
        )
    if not inside.all():
        notes.append(f"Bands outside {limits} were left out: {_listed(wavelength[~inside])}.")
    if wavelength_range is not None:
        try:
            lower, upper = (float(limit) for limit in wavelength_range)
        except (TypeError, ValueError):
            raise HyliosError(
                f"wavelength_range: expected two wavelengths in nm, got {wavelength_range!r}"
            ) from None
        if not lower < upper:
            raise HyliosError(
                f"wavelength_range: expected the shorter wavelength first, got {lower:g}:{upper:g}"
            )
        chosen = inside & (wavelength >= lower) & (wavelength <= upper)
        if not chosen.any():
            available = wavelength[inside]
            raise HyliosError(
                f"{source}: no band in the range {lower:g} to {upper:g} nm; "
                f"the bands go from {available[0]:g} to {available[-1]:g} nm"
            )
        if chosen.sum() < inside.sum():
            notes.append(
                f"Range {lower:g} to {upper:g} nm: {chosen.sum()} of {inside.sum()} bands used."
            )
        inside = chosen
    if inside.sum() < MINIMUM_BANDS:
        raise HyliosError(
            f"{source}: a single band ({wavelength[inside][0]:g} nm); "
            f"at least {MINIMUM_BANDS} bands are needed"
        )
    return inside


def _scale(
    values: np.ndarray, unit: str, wavelength: np.ndarray, source: str, notes: list[str]
) -> tuple[float, list[str]]:
    """The factor to a fraction, and what each spectrum looks like: fraction, percent, unclear."""
    looks: list[str] = []
    for row in values:
        known = row[np.isfinite(row)]
        if known.size == 0:
            looks.append("unclear")
        elif known.max() <= _FRACTION_MAXIMUM:
            looks.append("fraction")
        elif np.median(known) > _PERCENT_MEDIAN:
            looks.append("percent")
        else:
            looks.append("unclear")
    fractions, percents = looks.count("fraction"), looks.count("percent")
    told = fractions + percents
    finite = np.isfinite(values)
    if not finite.any():
        return (0.01 if unit == "percent" else 1.0), looks
    largest = float(values[finite].max())
    if unit == "percent" and fractions and not percents:
        raise HyliosError(
            f"{source}: unit percent was asked for, but the values are fractions "
            f"(largest {largest:.4g}); use unit fraction"
        )
    if unit == "fraction" and percents and not fractions:
        raise HyliosError(
            f"{source}: unit fraction was asked for, but the values are percent "
            f"(largest {largest:.4g}); use unit percent"
        )
    if unit != "auto":
        return (0.01 if unit == "percent" else 1.0), looks
    if told and fractions >= _MAJORITY * told:
        notes.append(f"Unit: fraction, by the values (largest {largest:.4g}).")
        return 1.0, looks
    if told and percents >= _MAJORITY * told:
        notes.append(f"Unit: percent, by the values (largest {largest:.4g}).")
        return 0.01, looks
    if told:
        raise HyliosError(
            f"{source}: {fractions} spectra look like fractions and {percents} like percent; "
            "expected one unit: say which with unit fraction or unit percent"
        )
    spectrum, band = np.unravel_index(np.nanargmax(np.where(finite, values, -np.inf)), values.shape)
    median = float(np.median(values[finite]))
    raise HyliosError(
        f"{source}: cannot tell fractions from percent: the largest value is {largest:.4g} "
        f"(at {wavelength[band]:g} nm, spectrum {spectrum + 1}), the median {median:.4g}; "
        "say which with unit fraction or unit percent"
    )


def _unique(names: Sequence[str], notes: list[str]) -> list[str]:
    taken = set(names)
    seen: set[str] = set()
    result: list[str] = []
    renamed: list[str] = []
    for name in names:
        unique, number = name, 2
        while unique in seen or (unique != name and unique in taken):
            unique = f"{name} ({number})"
            number += 1
        if unique != name:
            renamed.append(unique)
        seen.add(unique)
        result.append(unique)
    if renamed:
        notes.append(f"Names that came more than once were numbered: {_names(renamed)}.")
    return result


def _summary(found: list[str]) -> str | None:
    if not found:
        return None
    shown = "; ".join(found[:3])
    return shown if len(found) <= 3 else f"{shown}; and {len(found) - 3} more"


def _note_missing(
    names: list[str],
    problems: list[str | None],
    finite: np.ndarray,
    wavelength: np.ndarray,
    notes: list[str],
    limit: int = 10,
) -> None:
    """One note for each pattern of missing bands: thousands of spectra may share a pattern."""
    patterns: dict[bytes, list[int]] = {}
    for spectrum in np.flatnonzero(~finite.all(axis=1)):
        if problems[spectrum] is None:
            patterns.setdefault(finite[spectrum].tobytes(), []).append(int(spectrum))
    for members in list(patterns.values())[:limit]:
        bands = wavelength[~finite[members[0]]]
        notes.append(
            f"Without a value in {bands.size} of {wavelength.size} bands ({_listed(bands)}), "
            f"to be fitted on the others: {_names([names[i] for i in members])}."
        )
    if len(patterns) > limit:
        rest = sum(len(members) for members in list(patterns.values())[limit:])
        notes.append(f"{rest} more spectra lack some bands, each to be fitted on its others.")


def _note_tolerated(
    names: list[str], values: np.ndarray, mask: np.ndarray, what: str, notes: list[str]
) -> None:
    spectra = np.flatnonzero(mask.any(axis=1))
    if spectra.size:
        extreme = values[mask][np.argmax(np.abs(values[mask] - 0.5))]
        notes.append(
            f"Reflectance {what} (to {extreme:.4g}) was taken for noise and kept: "
            f"{_names([names[i] for i in spectra])}."
        )


def _names(names: Sequence[str], limit: int = 3) -> str:
    shown = ", ".join(_shown(name, 40) for name in names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"


def _listed(wavelength: np.ndarray) -> str:
    if wavelength.size <= 4:
        return ", ".join(f"{value:g}" for value in wavelength) + " nm"
    return f"{wavelength.size} bands between {wavelength[0]:g} and {wavelength[-1]:g} nm"


# --- other libraries' objects -----------------------------------------------------------------


def as_spectra(
    obj: Any,
    wavelength_nm: Any = None,
    *,
    unit: str = "auto",
    wavelength_range: tuple[float, float] | None = None,
) -> Spectra:
    """Spectra from what other libraries use for them.

    Taken are: `Spectra` (returned as it is); `colour.SpectralDistribution` and
    `colour.MultiSpectralDistributions`; a pandas Series or DataFrame with wavelengths (nm) as
    its index (a DataFrame with wavelengths as columns is turned); an xarray DataArray with a
    dimension `wavelength_nm`, `wavelength`, `nm` or `wl`; a pair `(wavelengths, values)`; or
    values with `wavelength_nm` beside them. Values have shape (bands,) or (spectra, bands).

    Raises:
        HyliosError: if the object is none of these, or its values cannot be used.
    """
    if isinstance(obj, Spectra):
        if wavelength_nm is not None:
            raise HyliosError("wavelength_nm: Spectra bring their own; expected None")
        return obj if wavelength_range is None else _cropped(obj, wavelength_range)
    kinds = {f"{kind.__module__.split('.')[0]}.{kind.__name__}" for kind in type(obj).__mro__}
    if isinstance(obj, str | os.PathLike):
        raise HyliosError(f"expected spectra, got the path {str(obj)!r}: use read_spectra for it")
    if kinds & {"colour.SpectralDistribution", "colour.MultiSpectralDistributions"}:
        values = np.asarray(obj.values)
        single = values.ndim == 1
        names = [obj.name] if single else list(obj.labels)
        wavelength, source = obj.wavelengths, type(obj).__name__
        values = values[None, :] if single else values.T
    elif "pandas.Series" in kinds:
        names = ["spectrum" if obj.name is None else obj.name]
        wavelength, values, source = obj.index, _numbers(obj)[None, :], "pandas Series"
    elif "pandas.DataFrame" in kinds:
        values, source = _numbers(obj).T, "pandas DataFrame"
        wavelength, names = obj.index, list(obj.columns)
        if not _numeric(wavelength) and _numeric(obj.columns):
            wavelength, names, values = obj.columns, list(obj.index), values.T
    elif "xarray.DataArray" in kinds:
        wavelength, names, values = _from_xarray(obj)
        source = "xarray DataArray"
    else:
        source = "arrays"
        if wavelength_nm is None:
            if not (isinstance(obj, tuple | list) and len(obj) == 2):
                raise HyliosError(
                    "expected a spectrum (colour.SpectralDistribution, pandas Series, xarray "
                    f"DataArray, or wavelengths with values), got {type(obj).__name__}"
                )
            wavelength_nm, obj = obj
        wavelength, wavelength_nm = wavelength_nm, None
        values = np.atleast_2d(_numbers(obj))
        count = len(values)
        names = ["spectrum"] if count == 1 else [f"spectrum {i + 1}" for i in range(count)]
    if wavelength_nm is not None:
        raise HyliosError(f"wavelength_nm: a {source} brings its own; expected None")
    wavelength = _numbers(wavelength, "wavelengths")
    if wavelength.ndim != 1 or values.ndim != 2 or values.shape[1] != wavelength.size:
        raise HyliosError(
            f"{source}: expected values of shape ({wavelength.size},) or "
            f"(spectra, {wavelength.size}) for {wavelength.size} wavelengths, got {values.shape}"
        )
    if not wavelength.size or not len(values):
        raise HyliosError(f"{source}: expected at least one spectrum, got shape {values.shape}")
    if not np.all(np.isfinite(wavelength)):
        raise HyliosError(f"{source}: expected finite wavelengths in nm")
    broken: dict[int, list[tuple[int, str]]] = {}
    for row, band in np.argwhere(np.isinf(values)).tolist():
        why = f"{wavelength[band]:g} nm: expected a finite number, got {values[row, band]}"
        broken.setdefault(row, []).append((band, why))
    grid = _Grid(
        wavelength,
        [str(name) for name in names],
        np.where(np.isinf(values), np.nan, values),
        broken,
        [],
        source,
        lambda spectrum, band: f"value {band + 1}",
    )
    return _judge(grid, unit, wavelength_range)


def _cropped(spectra: Spectra, wavelength_range: tuple[float, float]) -> Spectra:
    notes = list(spectra.notes)
    kept = _kept(spectra.wavelength_nm, wavelength_range, notes, spectra.source)
    left, came = spectra.wavelength_nm[kept], spectra.came_nm
    return replace(
        spectra,
        wavelength_nm=left,
        reflectance=spectra.reflectance[:, kept],
        notes=tuple(notes),
        noise=None if spectra.noise is None else spectra.noise[kept],
        came_nm=None if came is None else came[np.isin(came, left)],
    )


def _numbers(values: Any, what: str = "values") -> np.ndarray:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise HyliosError(f"{what}: expected numbers: {error}") from None


def _numeric(labels: Any) -> bool:
    try:
        np.asarray(labels, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return True


def _from_xarray(obj: Any) -> tuple[Any, list[Any], np.ndarray]:
    found = [dim for dim in obj.dims if _is_wavelength_header(str(dim))]
    if len(found) != 1 or obj.ndim not in (1, 2):
        raise HyliosError(
            "xarray DataArray: expected one dimension wavelength_nm, wavelength, nm or wl and at "
            f"most one other, got dimensions {tuple(obj.dims)}"
        )
    dim = found[0]
    if dim not in obj.coords:
        raise HyliosError(f"xarray DataArray: expected a coordinate of wavelengths on {dim!r}")
    others = [other for other in obj.dims if other != dim]
    if not others:
        return obj.coords[dim].values, [obj.name or "spectrum"], _numbers(obj.values)[None, :]
    other = others[0]
    if other in obj.coords:
        names = list(obj.coords[other].values)
    else:
        names = [f"spectrum {i + 1}" for i in range(obj.sizes[other])]
    return obj.coords[dim].values, names, _numbers(obj.transpose(other, dim).values)


# --- writing ----------------------------------------------------------------------------------


def write_csv(
    path: str | os.PathLike[str], header: Sequence[str], rows: Iterable[Sequence[Any]]
) -> Path:
    """Write a table with the csv module, atomically; None becomes an empty cell.

    Raises:
        HyliosError: if it cannot be written.
    """
    with atomic_text(path) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
    return Path(path)
