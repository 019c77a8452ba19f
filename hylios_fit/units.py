"""The unit system, in one table, and the conversions that data need on their way in.

========================  ==========================================================
quantity                  unit inside the package
========================  ==========================================================
length                    cm
absorption, scattering    1/cm, Napierian: intensity falls as exp(-mu * length)
wavelength                nm
angle                     rad
concentration             mg/mL (the same number as g/L); urocanic acid mol/L
content                   % by volume where a name in the public tables says so,
                          otherwise a fraction
reflectance               fraction
========================  ==========================================================
"""

import math

import numpy as np

from hylios_fit.errors import HyliosError

WAVELENGTH_MIN: float = 250.0
"""Shortest wavelength that the absorber tables cover, in nm."""

WAVELENGTH_MAX: float = 2500.0
"""Longest wavelength that the absorber tables cover, in nm."""

LN10: float = math.log(10.0)
"""Decadic to Napierian: mu_a = LN10 * extinction * concentration."""

DEGREE: float = math.pi / 180.0
"""Radians in one degree."""

CM_PER_NM: float = 1e-7
CM_PER_UM: float = 1e-4

TO_NAPIERIAN: dict[str, float] = {
    "1/cm, Napierian": 1.0,
    "mL/(mg cm), decadic": LN10,
    "L/(mol cm), decadic": LN10,
    "L/(mmol cm), decadic": 1e3 * LN10,
}
"""Published unit of an absorber table -> factor to the Napierian coefficient.

The result is in 1/cm for a pure substance, 1/cm per (mg/mL) for a mass extinction and 1/cm per
(mol/L) for a molar one; `napierian_factor` divides the last by the molar mass where one is given.
"""


def napierian_factor(unit: str, molar_mass: float | None = None) -> float:
    """Return what a tabulated value is multiplied by to enter mu_a.

    Parameters
    ----------
    unit:
        A key of `TO_NAPIERIAN`.
    molar_mass:
        g/mol of what the molar unit counts (for haemoglobin tabulated per haem: a quarter of the
        tetramer). Turns 1/cm per (mol/L) into 1/cm per (mg/mL), because 1 mg/mL is 1 g/L.

    Raises
    ------
    KeyError
        If the unit is not in the table.
    """
    factor = TO_NAPIERIAN[unit]
    return factor if molar_mass is None else factor / molar_mass


def wavelengths(low: float, high: float, step: float) -> np.ndarray:
    """Return wavelengths from `low` to `high` in steps of `step`, all in nm, shape (n,).

    `high` is the last one where a whole number of steps reaches it.

    Raises
    ------
    HyliosError
        If the step is not positive or the range is not within 250 to 2500 nm.
    """
    if not WAVELENGTH_MIN <= low <= high <= WAVELENGTH_MAX:
        raise HyliosError(
            f"expected wavelengths {WAVELENGTH_MIN:g} <= low <= high <= {WAVELENGTH_MAX:g} nm, "
            f"got {low:g} to {high:g}"
        )
    if not 0 < step < math.inf:
        raise HyliosError(f"expected a step above 0 nm, got {step:g}")
    # A step such as 0.1 is not exact: without the slack the last wavelength could be lost.
    return low + step * np.arange(math.floor((high - low) / step * (1 + 1e-12)) + 1)
