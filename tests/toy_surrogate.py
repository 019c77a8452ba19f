"""A small analytic stand-in for the surrogate: Beer-Lambert over Kubelka-Munk, 11 parameters.

Not skin, but smooth, cheap and of the same interface, so that inversion and sampling are tested
without training anything.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

NAMES = (
    "melanosome_granulosum",
    "melanosome_spinosum",
    "melanosome_basale",
    "colloidal_melanin",
    "eumelanin",
    "pheomelanin",
    "blood_papillary",
    "blood_reticular",
    "oxygen_saturation",
    "water",
    "lipids",
)
LOWER = np.array([0.0, 0.0, 0.0, 0.0, 5.0, 0.2, 0.02, 0.02, 0.05, 0.4, 0.0])
UPPER = np.array([12.0, 12.0, 12.0, 20.0, 150.0, 20.0, 12.0, 12.0, 1.0, 1.3, 2.0])


def bump(wavelength, centre, width, height):
    return height * np.exp(-0.5 * ((wavelength - centre) / width) ** 2)


class ToyMember(eqx.Module):
    names: tuple[str, ...] = eqx.field(static=True)
    lower: np.ndarray
    upper: np.ndarray
    wavelength_nm: np.ndarray
    coefficients: np.ndarray  # (6, B): eumelanin, pheomelanin, oxy, deoxy, water, lipids
    scattering: np.ndarray  # (B,)
    sieve: np.ndarray  # ()
    projected = False

    def surface_at(self, parameters):
        return 0.04

    def error_covariance(self, reflectance):
        distance = np.subtract.outer(*2 * (np.asarray(self.wavelength_nm),))
        return 0.003**2 * np.exp(-0.5 * (distance / 50.0) ** 2) + 1e-8 * np.eye(distance.shape[0])

    def __call__(self, parameters):
        columns = jnp.moveaxis(jnp.asarray(parameters), -1, 0)[..., None]
        p = dict(zip(self.names, columns, strict=True))
        eumelanin, pheomelanin, oxy, deoxy, water, lipids = jnp.asarray(self.coefficients)
        pigment = (p["eumelanin"] * eumelanin + p["pheomelanin"] * pheomelanin) / 100.0
        depth = 0.0
        for stratum in ("granulosum", "spinosum", "basale"):
            whole = 0.0033 * p[f"melanosome_{stratum}"] * pigment
            # Pigment in packets shades itself: less absorption than the same amount dissolved.
            depth = depth + whole / (1.0 + self.sieve * whole)
            depth = depth + 0.0033 * p["colloidal_melanin"] * pigment
        saturation = p["oxygen_saturation"]
        blood = 1.47 * (saturation * oxy + (1.0 - saturation) * deoxy)
        papillary = 0.02 * p["blood_papillary"] * blood
        dermis = p["blood_reticular"] * blood + p["water"] * water + p["lipids"] * lipids + 0.05
        ratio = dermis / self.scattering
        diffuse = 1.0 + ratio - jnp.sqrt(ratio * (ratio + 2.0))
        return 0.04 + 0.93 * jnp.exp(-2.0 * (depth + papillary)) * diffuse

    def on(self, wavelength_nm):
        grid = np.asarray(self.wavelength_nm)
        to = np.asarray(wavelength_nm, dtype=float)
        return ToyMember(
            self.names,
            self.lower,
            self.upper,
            to,
            np.stack([np.interp(to, grid, row) for row in np.asarray(self.coefficients)]),
            np.interp(to, grid, np.asarray(self.scattering)),
            self.sieve,
        )


class ToySurrogate:
    forms = ("complex", "dispersed")
    names = (*NAMES, "melanosome_form")

    def at(self, form):
        w = np.arange(250.0, 2501.0, 5.0)
        oxy = bump(w, 415, 14, 260) + bump(w, 542, 12, 30) + bump(w, 577, 9, 32) + 0.6
        deoxy = bump(w, 433, 16, 240) + bump(w, 556, 20, 30) + bump(w, 758, 25, 1.0) + 1.0
        haem = np.exp(-(((w - 400.0).clip(0) / 600.0) ** 2))
        water = bump(w, 1450, 60, 20) + bump(w, 1940, 60, 80) + bump(w, 970, 30, 0.3)
        water = water + 60.0 / (1.0 + np.exp(-(w - 2350.0) / 60.0))
        lipids = bump(w, 1210, 15, 0.4) + bump(w, 1730, 20, 2.0) + bump(w, 2310, 20, 6.0)
        coefficients = np.stack(
            [
                15.0 * np.exp(-2.43 * (w - 694.0) / 694.0),
                15.0 * np.exp(-4.78 * (w - 694.0) / 694.0),
                oxy * haem,
                deoxy * haem,
                water,
                lipids,
            ]
        )
        sieve = np.asarray({"complex": 4.0, "dispersed": 1.0}[form])
        return ToyMember(NAMES, LOWER, UPPER, w, coefficients, 40.0 * (w / 500.0) ** -1.2, sieve)
