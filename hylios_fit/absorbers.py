"""Specific absorption of the skin's absorbers, as Napierian coefficients."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .datasets import ABSORBERS, read_absorber
from .errors import HyliosError
from .units import WAVELENGTH_MAX, WAVELENGTH_MIN

UNITS: dict[str, str] = {
    name: "1/cm" if name in ("water", "lipids", "keratin", "corneum_tail") else "1/cm per (mg/mL)"
    for name in ABSORBERS
} | {"urocanic_acid": "1/cm per (mol/L)"}
"""Unit of each entry of `specific_absorption`."""


def specific_absorption(wavelength_nm: ArrayLike) -> dict[str, NDArray[np.float64]]:
    """Return the specific absorption (zeta of Eq. 2) of all absorbers.

    Each is to be multiplied by its content and added up, with no further factor ln 10: by mg/mL
    for melanins, haemoglobins, bilirubin, beta-carotene and DNA; by mol/L for urocanic acid; by the
    fraction of the volume for water, lipids, keratin and corneum_tail.

    Parameters
    ----------
    wavelength_nm:
        (...) wavelengths in nm, 250 to 2500, any order.

    Returns
    -------
    dict
        Name (in the order of `ABSORBERS`) -> (...) read-only coefficients in the unit that `UNITS`
        names. Linear between the rows of the table.

    Raises
    ------
    HyliosError
        If a wavelength is not a number or lies outside 250 to 2500 nm.

    Source: data/absorbers/NAME.csv, which name their papers.
    """
    wavelength = np.array(wavelength_nm, dtype=np.float64, order="C")
    inside = (wavelength >= WAVELENGTH_MIN) & (wavelength <= WAVELENGTH_MAX)
    if not np.all(inside):
        raise HyliosError(
            f"wavelengths must lie within {WAVELENGTH_MIN:g} to {WAVELENGTH_MAX:g} nm,"
            f" got {wavelength[~inside].flat[0]:g}"
        )
    return dict(_interpolate(wavelength.tobytes(), wavelength.shape))


@lru_cache(maxsize=32)
def _interpolate(
    wavelength: bytes, shape: tuple[int, ...]
) -> tuple[tuple[str, NDArray[np.float64]], ...]:
    at = np.frombuffer(wavelength, dtype=np.float64).reshape(shape)
    result = []
    for name in ABSORBERS:
        table = read_absorber(name)
        value = np.asarray(np.interp(at, table.wavelength_nm, table.napierian))
        value.setflags(write=False)
        result.append((name, value))
    return tuple(result)
