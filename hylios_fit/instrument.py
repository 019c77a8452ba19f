"""What an instrument makes of a spectrum: its bands, specular in or out, its noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from .errors import HyliosError

SPECULAR = ("included", "excluded")

# The noise of measured skin, by maximum likelihood on the repeats of NIST's reference set (Cooksey,
# Allen and Tsai 2017, doi 10.18434/M38597; 50 subjects, three repeats each, 63 bands from 250 to
# 2500 nm). Chi-square for each degree of freedom over the subjects: mean 1.00, quartiles 0.62 and
# 1.06. It is noise of measuring skin, not of the instrument alone: the probe is put down anew, so
# a repeat moves as a whole and smoothly, and neighbouring bands say nearly the same.
NOISE_OFFSET = 0.0021
"""sd of a shift common to all bands, in reflectance: how the probe sits on the skin."""
NOISE_SCALE = 0.021
"""sd of a factor common to all bands, as a share of the reflectance."""
NOISE_LOCAL = 0.021
"""sd of what changes with wavelength smoothly, as a share of the reflectance."""
NOISE_LENGTH = 0.153
"""Correlation length of that change, in the logarithm of the wavelength (Matern 3/2)."""
NOISE_BAND = 0.0003
"""sd of each band on its own, in reflectance."""


def noise_sd(wavelength_nm: Any, reflectance: Any, noise: Any = None) -> np.ndarray:
    """Standard deviation of one measurement of skin, in reflectance.

    The default is that of NIST's repeats (see `NOISE_OFFSET` and the constants below it):
    sqrt(0.0021^2 + (0.030 R)^2), which is 0.003 at R = 0.06 and 0.012 at R = 0.4.

    Args:
        wavelength_nm: shape (bands,), nm.
        reflectance: shape (..., bands), as a fraction; values below 0 count as 0.
        noise: None for the default, one standard deviation for all bands, or one for each band.

    Returns:
        shape (..., bands); NaN where the reflectance is NaN.

    Raises:
        HyliosError: if shapes disagree or the noise is not above 0.
    """
    wavelength, values = _checked(wavelength_nm, reflectance)
    if noise is None:
        share = NOISE_SCALE**2 + NOISE_LOCAL**2
        return np.sqrt(NOISE_OFFSET**2 + NOISE_BAND**2 + share * np.maximum(values, 0) ** 2)
    given = np.asarray(noise, dtype=np.float64)
    if given.ndim > 1 or (given.ndim == 1 and given.size != wavelength.size):
        raise HyliosError(
            f"noise: expected one number or {wavelength.size} (one a band), got shape {given.shape}"
        )
    if not np.all((given > 0) & (given < 1)):
        raise HyliosError(
            "noise: expected standard deviations of the reflectance as a fraction, "
            f"above 0 and below 1, got {given if given.ndim == 0 else np.nanmin(given)}"
        )
    return np.where(np.isnan(values), np.nan, np.broadcast_to(given, values.shape))


def noise_covariance(wavelength_nm: Any, reflectance: Any, noise: Any = None) -> np.ndarray:
    """Covariance of one measurement's noise between its bands.

    The default has what NIST's repeats have: a common shift, a common factor, a smooth change
    with wavelength, and a small part for each band on its own. Its diagonal is `noise_sd` squared.
    A noise that is given is taken as independent between bands.

    Args:
        wavelength_nm: shape (bands,), nm.
        reflectance: shape (bands,), as a fraction, without missing values.
        noise: as for `noise_sd`.

    Returns:
        shape (bands, bands), positive definite.

    Raises:
        HyliosError: as `noise_sd`, and if a reflectance is missing.
    """
    wavelength, values = _checked(wavelength_nm, reflectance)
    if values.ndim != 1 or not np.all(np.isfinite(values)):
        raise HyliosError(
            f"reflectance: expected {wavelength.size} finite values, got shape {values.shape}"
        )
    if noise is not None:
        return np.diag(noise_sd(wavelength, values, noise) ** 2)
    level = np.maximum(values, 0)
    share = NOISE_SCALE**2 + NOISE_LOCAL**2 * smooth(wavelength, NOISE_LENGTH)
    covariance = NOISE_OFFSET**2 + share * np.outer(level, level)
    covariance[np.diag_indices_from(covariance)] += NOISE_BAND**2
    return covariance


def smooth(wavelength_nm: np.ndarray, length: float) -> np.ndarray:
    """Correlation (B, B) of what changes smoothly with wavelength (Matern 3/2), over a length in
    the logarithm of the wavelength."""
    distance = np.log(wavelength_nm)
    distance = np.sqrt(3) * np.abs(distance[:, None] - distance) / length
    return (1 + distance) * np.exp(-distance)


def _checked(wavelength_nm: Any, reflectance: Any) -> tuple[np.ndarray, np.ndarray]:
    wavelength = np.asarray(wavelength_nm, dtype=np.float64)
    values = np.asarray(reflectance, dtype=np.float64)
    if wavelength.ndim != 1 or values.ndim < 1 or values.shape[-1] != wavelength.size:
        raise HyliosError(
            f"reflectance: expected shape (..., {wavelength.size}), got {values.shape}"
        )
    return wavelength, values


def specular_offset(surface: Any, specular: str = "included") -> Any:
    """What to add to a modelled reflectance so that it is what the instrument reports.

    Args:
        surface: the share of light that the skin's surface reflects, (B,) or one for all bands
            (`member.surface`).
        specular: "included", or "excluded" for an instrument with a gloss trap. A trap is taken
            to lose all of the surface's reflection; a rough surface keeps part of it, which is
            then found in the residual.

    Raises:
        HyliosError: for another word.
    """
    if specular not in SPECULAR:
        raise HyliosError(f"specular: expected {' or '.join(SPECULAR)}, got {specular!r}")
    return 0.0 if specular == "included" else -surface


def interpolation_matrix(grid_nm: Any, bands_nm: Any) -> np.ndarray:
    """Linear interpolation from the model's grid to an instrument's bands, as a matrix.

    Args:
        grid_nm: shape (W,), strictly increasing, nm.
        bands_nm: shape (B,), nm, within the grid.

    Returns:
        shape (B, W): `matrix @ on_grid` is the spectrum on the bands; each row sums to 1.

    Raises:
        HyliosError: if a band lies outside the grid.
    """
    grid = np.asarray(grid_nm, dtype=np.float64)
    bands = np.asarray(bands_nm, dtype=np.float64)
    if grid.ndim != 1 or grid.size < 2 or not np.all(np.diff(grid) > 0):
        raise HyliosError("grid_nm: expected at least 2 strictly increasing wavelengths")
    outside = bands[~((bands >= grid[0]) & (bands <= grid[-1]))]
    if bands.ndim != 1 or outside.size:
        got = f"{outside[0]:g}" if outside.size else f"shape {bands.shape}"
        raise HyliosError(f"bands_nm: expected within {grid[0]:g} to {grid[-1]:g} nm, got {got}")
    left = np.clip(np.searchsorted(grid, bands, side="right") - 1, 0, grid.size - 2)
    weight = (bands - grid[left]) / (grid[left + 1] - grid[left])
    matrix = np.zeros((bands.size, grid.size))
    rows = np.arange(bands.size)
    matrix[rows, left] = 1 - weight
    matrix[rows, left + 1] += weight
    return matrix
