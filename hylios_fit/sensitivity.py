"""How much each material matters: the paper's mean sensitivity index (Eq. 9, Table II).

A material is taken out of the specimen, everything else stays, and the two reflectance curves are
compared wavelength by wavelength.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.special import erf

from hylios_fit.errors import HyliosError
from hylios_fit.simulation import Curve, simulate
from hylios_fit.skin import STRATA, Specimen
from hylios_fit.units import WAVELENGTH_MAX, WAVELENGTH_MIN, wavelengths

DOMAINS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "UV": (WAVELENGTH_MIN, 400.0),
        "Vis": (400.0, 700.0),
        "IR": (700.0, WAVELENGTH_MAX),
        "all": (WAVELENGTH_MIN, WAVELENGTH_MAX),
    }
)
"""Ranges in nm, both ends included (section 5.2 of the paper)."""

STEP_NM = 5.0

REMOVALS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "melanin": (*(f"melanosome_{stratum}" for stratum in STRATA), "colloidal_melanin"),
        "blood": ("blood_papillary", "blood_reticular"),
        "DNA": ("dna",),
        "keratin": ("keratin",),
        "water": ("water",),
        "lipids": ("lipids",),
    }
)
"""The parameters that are set to zero to take a material out.

Melanin goes with the melanosomes that hold it, and so does what they scatter: "setting the
parameters associated with a specific material to zero" (section 5.2).
"""


def mean_sensitivity_index(
    baseline: Float[np.ndarray, "w"], modified: Float[np.ndarray, "w"]
) -> float:
    """Eq. 9: the mean of |rho_b - rho_m| / max(rho_b, rho_m); two zeros do not differ."""
    return float(np.mean(_change(np.asarray(baseline), np.asarray(modified))))


def _change(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    larger = np.maximum(one, two)
    return np.abs(one - two) / np.where(larger > 0, larger, 1.0)


def _counted_change(one: np.ndarray, two: np.ndarray, rays: int) -> np.ndarray:
    """Mean of `_change` where both are shares of `rays` rays: a folded normal distribution."""
    if rays < 1:
        raise HyliosError(f"counted is a number of rays from 1, got {rays}")
    apart = np.abs(one - two)
    spread = np.sqrt((one * (1.0 - one) + two * (1.0 - two)) / rays)
    noisy = np.where(spread > 0, spread, 1.0)
    folded = noisy * np.sqrt(2.0 / np.pi) * np.exp(-0.5 * (apart / noisy) ** 2) + apart * erf(
        apart / (noisy * np.sqrt(2.0))
    )
    larger = np.maximum(one, two)
    return np.where(spread > 0, folded, apart) / np.where(larger > 0, larger, 1.0)


@dataclasses.dataclass(frozen=True)
class Sensitivity:
    """The curve of a specimen, and its curve without each material (names of `REMOVALS`).

    All curves have the same wavelengths, in nm.
    """

    baseline: Curve
    without: Mapping[str, Curve]

    @property
    def wavelength_nm(self) -> np.ndarray:
        return self.baseline.wavelength_nm

    def _within(self, domain: str) -> np.ndarray:
        if domain not in DOMAINS:
            raise HyliosError(f"domain is one of {', '.join(DOMAINS)}, got {domain!r}")
        low, high = DOMAINS[domain]
        return (self.wavelength_nm >= low) & (self.wavelength_nm <= high)

    def _curve(self, material: str) -> Curve:
        if material not in self.without:
            raise HyliosError(f"material is one of {', '.join(self.without)}, got {material!r}")
        return self.without[material]

    def msi(self, material: str, domain: str = "all", counted: int | None = None) -> float:
        """Mean sensitivity index of a material in a domain (`DOMAINS`), 0 to 1.

        `counted`: expected index of curves that are counted, each reflectance the share of so many
        rays that came back. Their noise adds to an index that counts differences of either sign:
        with the paper's 100,000 rays about 0.009 to a material that does nothing.
        """
        within, modified = self._within(domain), self._curve(material).reflectance
        one, two = self.baseline.reflectance[within], modified[within]
        if counted is None:
            return mean_sensitivity_index(one, two)
        return float(np.mean(_counted_change(one, two, counted)))

    def standard_error(self, material: str, domain: str = "all") -> float:
        """The most that the standard error of `msi` can be; 0 for a method without noise.

        Errors are taken as fully shared between wavelengths, which share their paths, and not at
        all between the two curves, which share their random numbers.
        """
        within, modified = self._within(domain), self._curve(material)
        value = np.stack([self.baseline.reflectance, modified.reflectance])[:, within]
        error = np.stack([self.baseline.standard_error, modified.standard_error])[:, within]
        order = np.argsort(value, axis=0)
        (low, high), (low_error, high_error) = (
            np.take_along_axis(part, order, axis=0) for part in (value, error)
        )
        some = np.where(high > 0, high, 1.0)
        return float(np.mean(np.hypot(low_error, low / some * high_error) / some))

    def rows(self, counted: int | None = None) -> list[tuple[str, str, float]]:
        """(material, domain, msi), material by material: the table of `hylios-fit sensitivity`."""
        return [
            (material, domain, self.msi(material, domain, counted))
            for material in self.without
            for domain in DOMAINS
        ]


def sensitivity(
    specimen: Specimen,
    method: str = "adding",
    *,
    key: jax.Array | None = None,
    **options: Any,
) -> Sensitivity:
    """Mean sensitivity index of each material in `specimen`, 250 to 2500 nm in 5 nm (Table II).

    `method`, `key` and `options` are those of `simulate`. A walk uses the same random numbers for
    every curve, so that small differences show through its noise; what noise is left adds to the
    index, which counts differences of either sign.

    Raises `HyliosError` as `simulate` does.
    """
    nm = wavelengths(WAVELENGTH_MIN, WAVELENGTH_MAX, STEP_NM)

    def curve(changes: dict[str, float]) -> Curve:
        return simulate(specimen.replace(**changes), nm, method=method, key=key, **options)

    baseline = curve({})
    without = {material: curve(dict.fromkeys(names, 0.0)) for material, names in REMOVALS.items()}
    return Sensitivity(baseline, MappingProxyType(without))
