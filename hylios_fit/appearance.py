"""What a spectrum looks like: colour under daylight, colour differences, typology angle.

CIE 1931 observer (2 degrees), illuminant D65, tables and formulas by colour-science.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from .errors import HyliosError

NEEDED_NM = (400.0, 700.0)
"""A spectrum that does not reach from the first to the second wavelength has no colour here."""
LARGEST_GAP_NM = 25.0
"""Nor has one with a wider gap between its bands in that range."""

_GRID = np.arange(380.0, 781.0, 5.0)


@dataclass(frozen=True)
class Appearance:
    """Colour of a reflectance spectrum under D65 for the 2 degree observer."""

    xyz: tuple[float, float, float]
    """Tristimulus values; Y is 100 for a perfect white."""
    lab: tuple[float, float, float]
    """CIE L*, a*, b*."""
    hex: str
    """sRGB as #rrggbb, clipped to the gamut."""

    @property
    def ita(self) -> float:
        """Individual typology angle, degrees: arctan((L* - 50) / b*) (Chardon 1991).

        Very light skin lies above 55, light to 41, intermediate to 28, tan to 10, brown to -30,
        dark below.
        """
        return float(np.degrees(np.arctan2(self.lab[0] - 50, self.lab[2])))


def appearance(wavelength_nm: Any, reflectance: Any) -> Appearance | None:
    """Colour of one spectrum, shape (bands,); None where it does not cover 400 to 700 nm.

    NaN marks a missing band. Bands may have any step to 25 nm, even or not; for the colour only,
    the spectrum is interpolated to 5 nm and continued flat beyond its ends, as CIE 15 has it.
    """
    return appearances(wavelength_nm, np.asarray(reflectance, dtype=np.float64)[None, :])[0]


def appearances(wavelength_nm: Any, reflectance: Any) -> list[Appearance | None]:
    """Colours of many spectra, shape (spectra, bands), on one wavelength axis.

    Raises:
        HyliosError: if shapes disagree.
    """
    wavelength = np.asarray(wavelength_nm, dtype=np.float64)
    values = np.asarray(reflectance, dtype=np.float64)
    if wavelength.ndim != 1 or values.ndim != 2 or values.shape[1] != wavelength.size:
        raise HyliosError(
            f"reflectance: expected shape (spectra, {wavelength.size}), got {values.shape}"
        )
    result: list[Appearance | None] = [None] * len(values)
    finite = np.isfinite(values)
    # Spectra that lack the same bands share one interpolation.
    patterns: dict[bytes, list[int]] = {}
    for index, mask in enumerate(finite):
        patterns.setdefault(mask.tobytes(), []).append(index)
    for members in patterns.values():
        mask = finite[members[0]]
        if not _covers(wavelength[mask]):
            continue
        xyz, lab, srgb = _colours(wavelength[mask], values[members][:, mask])
        codes = np.rint(np.clip(srgb, 0, 1) * 255).astype(int)
        for index, one_xyz, one_lab, code in zip(members, xyz, lab, codes, strict=True):
            result[index] = Appearance(
                _triple(one_xyz), _triple(one_lab), "#{:02x}{:02x}{:02x}".format(*code)
            )
    return result


def colour_difference(first: Appearance | None, second: Appearance | None) -> float | None:
    """CIEDE2000 between two colours; None where one of them is None."""
    if first is None or second is None:
        return None
    return colour_differences([first], [second])[0]


def colour_differences(
    first: list[Appearance | None], second: list[Appearance | None]
) -> list[float | None]:
    """CIEDE2000 between pairs of colours; None where one of a pair is None."""
    result: list[float | None] = [None] * len(first)
    pairs = [(i, a, b) for i, (a, b) in enumerate(zip(first, second, strict=True)) if a and b]
    if pairs:
        colour = _colour()
        one = np.array([a.lab for _, a, _ in pairs])
        other = np.array([b.lab for _, _, b in pairs])
        with _quiet():
            difference = np.atleast_1d(colour.delta_E(one, other, method="CIE 2000"))
        for (index, _, _), value in zip(pairs, difference, strict=True):
            result[index] = float(value)
    return result


def _covers(wavelength: np.ndarray) -> bool:
    lower, upper = NEEDED_NM
    if wavelength.size < 2 or wavelength[0] > lower or wavelength[-1] < upper:
        return False
    steps = np.diff(wavelength)
    visible = (wavelength[1:] > lower) & (wavelength[:-1] < upper)
    return bool(np.all(steps[visible] <= LARGEST_GAP_NM))


def _colours(
    wavelength: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from scipy.interpolate import CubicSpline

    near = np.flatnonzero((wavelength >= _GRID[0] - 50) & (wavelength <= _GRID[-1] + 50))
    spline = CubicSpline(wavelength[near], values[:, near], axis=1)
    # Held at the ends: a spline beyond its knots is a guess.
    on_grid = spline(np.clip(_GRID, wavelength[near[0]], wavelength[near[-1]]))
    weights, white = _weights()
    xyz = on_grid @ weights
    colour = _colour()
    with _quiet():
        lab = colour.XYZ_to_Lab(xyz / 100, white)
        srgb = colour.XYZ_to_sRGB(np.maximum(xyz, 0) / 100)
    return xyz, np.asarray(lab), np.asarray(srgb)


@cache
def _weights() -> tuple[np.ndarray, np.ndarray]:
    """Weights (grid, 3) from reflectance to X, Y, Z, and the chromaticity of the white."""
    colour = _colour()
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    illuminant = colour.SDS_ILLUMINANTS["D65"]
    matching = np.stack(
        [np.interp(_GRID, observer.wavelengths, column) for column in observer.values.T], axis=1
    )
    weights = matching * np.interp(_GRID, illuminant.wavelengths, illuminant.values)[:, None]
    weights *= 100 / weights[:, 1].sum()
    white = weights.sum(axis=0)
    return weights, white[:2] / white.sum()


def _colour() -> Any:
    # colour-science warns on import of optional packages that it lacks, none of them used here.
    with _quiet():
        import colour

    return colour


def _quiet() -> warnings.catch_warnings:
    return warnings.catch_warnings(action="ignore")


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
