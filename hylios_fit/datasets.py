"""Find, read and check what ships in data/: absorber tables and measured skin."""

from __future__ import annotations

import csv
import hashlib
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import HyliosError
from .units import TO_NAPIERIAN, WAVELENGTH_MAX, WAVELENGTH_MIN, napierian_factor

ABSORBERS: tuple[str, ...] = (
    "eumelanin",
    "pheomelanin",
    "oxyhaemoglobin",
    "deoxyhaemoglobin",
    "carboxyhaemoglobin",
    "methaemoglobin",
    "sulfhaemoglobin",
    "bilirubin",
    "beta_carotene",
    "water",
    "lipids",
    "keratin",
    "corneum_tail",
    "dna",
    "urocanic_acid",
)
"""The absorbers of section 3.1 and Eq. 2 of the paper, and `corneum_tail`, what isolated corneum
absorbs beyond them; each has data/absorbers/NAME.csv."""

SOURCES = "SOURCES.toml"


@dataclass(frozen=True, eq=False)
class AbsorberTable:
    """Specific absorption of one substance, as published, with its origin.

    Attributes
    ----------
    name:
        One of `ABSORBERS`.
    wavelength_nm:
        (n,) rising from 250 to 2500, nm. Between them the table is meant to be linear.
    value:
        (n,) finite and not negative, in `unit`.
    unit:
        A key of `hylios_fit.units.TO_NAPIERIAN`; says whether the value is decadic.
    source, doi:
        The paper or papers that the numbers come from.
    measured_nm:
        Ranges (low, high) in nm that are measured; the others are filled. Empty where only
        published heights or a stand-in exist.
    filled:
        What fills the rest of the range.
    molar_mass:
        g/mol of what a molar unit counts, or None where the table stays in its own unit.
    note:
        What else a reader must know.
    """

    name: str
    wavelength_nm: NDArray[np.float64]
    value: NDArray[np.float64]
    unit: str
    source: str
    measured_nm: tuple[tuple[float, float], ...]
    filled: str
    doi: str = ""
    molar_mass: float | None = None
    note: str = ""

    def __post_init__(self) -> None:
        wavelength, value = self.wavelength_nm, self.value
        if wavelength.ndim != 1 or wavelength.shape != value.shape or wavelength.size < 2:
            raise HyliosError(
                f"absorber table {self.name}: expected two columns of one length, got shapes "
                f"{wavelength.shape} and {value.shape}"
            )
        if wavelength[0] != WAVELENGTH_MIN or wavelength[-1] != WAVELENGTH_MAX:
            raise HyliosError(
                f"absorber table {self.name}: expected {WAVELENGTH_MIN:g} to {WAVELENGTH_MAX:g} nm,"
                f" got {wavelength[0]:g} to {wavelength[-1]:g}"
            )
        if not np.all(np.diff(wavelength) > 0):
            raise HyliosError(f"absorber table {self.name}: wavelengths do not rise throughout")
        if not np.all(np.isfinite(value)) or np.any(value < 0):
            raise HyliosError(f"absorber table {self.name}: values must be finite and at least 0")
        if self.unit not in TO_NAPIERIAN:
            raise HyliosError(
                f"absorber table {self.name}: unit {self.unit!r} is not one of "
                + "; ".join(TO_NAPIERIAN)
            )

    @property
    def napierian(self) -> NDArray[np.float64]:
        """The table's values as Napierian coefficients, (n,).

        In 1/cm for a pure substance, 1/cm per (mg/mL) for a solute, 1/cm per (mol/L) for
        urocanic acid.
        """
        return self.value * napierian_factor(self.unit, self.molar_mass)


def data_folder() -> Path:
    """Return the folder that holds the data.

    In an installed package it lies inside the package, in a checkout at the repository's top level.

    Raises
    ------
    HyliosError
        If neither place holds it.
    """
    package = Path(__file__).resolve().parent
    candidates = (package / "data", package.parent / "data")
    for folder in candidates:
        if (folder / SOURCES).is_file():
            return folder
    raise HyliosError(
        f"the data folder is missing: no {SOURCES} in " + " or ".join(str(c) for c in candidates)
    )


def data_path(name: str) -> Path:
    """Return the path of a file in data/, for example ``data_path("absorbers/water.csv")``.

    Raises
    ------
    HyliosError
        If there is no such file.
    """
    path = data_folder() / name
    if not path.is_file():
        raise HyliosError(f"no data file {name!r} in {path.parents[len(Path(name).parts) - 1]}")
    return path


@cache
def read_absorber(name: str) -> AbsorberTable:
    """Read the table of one absorber.

    Raises
    ------
    HyliosError
        If the name is none of `ABSORBERS` or its file is damaged.
    """
    if name not in ABSORBERS:
        raise HyliosError(f"unknown absorber {name!r}; expected one of " + ", ".join(ABSORBERS))
    path = data_path(f"absorbers/{name}.csv")
    header: dict[str, str] = {}
    rows: list[list[str]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            key, _, text = line[1:].partition(":")
            header[key.strip()] = text.strip()
        elif line:
            rows.append(line.split(","))
    missing = {"name", "unit", "source", "doi", "measured_nm", "filled"} - header.keys()
    if missing or header["name"] != name:
        raise HyliosError(
            f"{path}: the header must name {name} and give unit, source, doi, measured_nm and"
            f" filled; missing: {', '.join(sorted(missing)) or 'none'}"
        )
    if not rows or rows[0] != ["wavelength_nm", "value"]:
        raise HyliosError(f"{path}: expected the columns wavelength_nm,value")
    try:
        table = np.array(rows[1:], dtype=np.float64).reshape(-1, 2)
    except ValueError as error:
        raise HyliosError(f"{path}: expected two numbers in each row ({error})") from None
    table.setflags(write=False)
    return AbsorberTable(
        name=name,
        wavelength_nm=table[:, 0],
        value=table[:, 1],
        unit=header["unit"],
        source=header["source"],
        doi=header["doi"],
        measured_nm=_ranges(header["measured_nm"]),
        filled=header["filled"],
        molar_mass=float(header["molar_mass"]) if "molar_mass" in header else None,
        note=header.get("note", ""),
    )


def _ranges(text: str) -> tuple[tuple[float, float], ...]:
    """Read "250-400; 500-600" as ranges; a text that starts with "none" has no range."""
    if text.startswith("none"):
        return ()
    pairs = [part.split("-") for part in text.split(";")]
    return tuple((float(low), float(high)) for low, high in pairs)


def sources() -> dict[str, dict[str, str]]:
    """Return data/SOURCES.toml: file name in data/ -> sha256, what, source, doi, terms."""
    text = (data_folder() / SOURCES).read_text(encoding="utf-8")
    try:
        return tomllib.loads(text)["files"]
    except (tomllib.TOMLDecodeError, KeyError) as error:
        raise HyliosError(f"{data_folder() / SOURCES}: damaged ({error!r})") from None


def verify() -> None:
    """Compare every file that data/SOURCES.toml lists with its hash.

    Raises
    ------
    HyliosError
        Naming the first file that is missing or whose sha256 differs.
    """
    folder = data_folder()
    for name, entry in sources().items():
        path = folder / name
        if not path.is_file():
            raise HyliosError(f"data file {name} is listed in {SOURCES} and missing from {folder}")
        found = hashlib.sha256(path.read_bytes()).hexdigest()
        if found != entry["sha256"]:
            raise HyliosError(
                f"data file {name} was changed: sha256 {found}, {SOURCES} has {entry['sha256']}"
            )


def measured_examples_path() -> Path:
    """Return the bundled spectra: measured skin, percent, specular included, d/8.

    A selection of the International Skin Spectra Archive (Lu et al. 2025, Scientific Data,
    doi 10.1038/s41597-025-04857-5) as a spectra file: first column wavelength_nm, then a column
    for each spectrum. `measured_examples_subjects` tells whose they are.
    """
    return data_path("skin/issa_examples.csv")


def measured_examples_subjects() -> tuple[dict[str, str], ...]:
    """Return a row for each bundled spectrum, in their order.

    Keys: spectrum, record, subject, group, origin, site, sex, age, L, a, b, ITA (individual
    typology angle in degrees); a field that the archive leaves open is empty.
    """
    with data_path("skin/issa_examples_subjects.csv").open(encoding="utf-8", newline="") as file:
        return tuple(csv.DictReader(file))
