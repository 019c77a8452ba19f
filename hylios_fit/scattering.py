"""Each law of scattering once: its density and its sampler side by side.

Samplers take uniform numbers in (0, 1), so that every walk can bring its own generator.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

LATIMER_ANGLE = math.radians(5.0)
"""Mean angle theta_0 of the light that a pigmented organelle scatters (Latimer 1984), rad."""


def melanosome_angle(wavelength_nm: np.ndarray) -> np.ndarray:
    """theta_0 in radians: 5 degrees, falling in a line to 0 from 780 to 1300 nm (section 4.2.1)."""
    wavelength_nm = np.asarray(wavelength_nm, float)
    return LATIMER_ANGLE * np.clip((1300.0 - wavelength_nm) / (1300.0 - 780.0), 0.0, 1.0)


def exponential_log_norm(theta_0: Float[Array, "..."]) -> Float[Array, "..."]:
    """Logarithm of the integral of exp(-theta/theta_0) sin(theta) over [0, pi]."""
    t2 = theta_0**2
    return jnp.log(t2) - jnp.log1p(t2) + jnp.log1p(jnp.exp(-jnp.pi / theta_0))


def exponential_density(theta: Float[Array, "..."], theta_0: float) -> Float[Array, "..."]:
    """Density of the polar angle that Algorithm 1 draws, on [0, pi].

    As printed, its acceptance test carries sin(theta): p ~ exp(-theta/theta_0) sin(theta), whose
    mean is near 2 theta_0 although the text calls theta_0 the mean. The algorithm stands.
    """
    norm = exponential_log_norm(jnp.asarray(theta_0))
    return jnp.exp(-theta / theta_0 - norm) * jnp.sin(theta)


def exponential_lost_cosine(theta_0: Float[Array, "..."]) -> Float[Array, "..."]:
    """1 - the mean cosine of the angle of `exponential_density`; 0 where theta_0 is."""
    t2, back = theta_0**2, jnp.exp(-jnp.pi / jnp.maximum(theta_0, 1e-6))
    return (3.0 * t2 + back * (2.0 + 5.0 * t2)) / ((1.0 + 4.0 * t2) * (1.0 + back))


def exponential_proposal(
    theta_0: Float[Array, "..."], xi_1: Float[Array, "..."], xi_2: Float[Array, "..."]
) -> Float[Array, "..."]:
    """A polar angle from theta exp(-theta/theta_0), for `exponential_accepts`.

    Accepting with probability sin(theta)/theta gives the law of Algorithm 1, and refuses 0.8 % of
    the draws at 5 degrees, where uniform angles over [0, pi] are refused 19 times out of 20.
    """
    return -theta_0 * jnp.log(xi_1 * xi_2)


def exponential_accepts(
    theta: Float[Array, "..."], sin_theta: Float[Array, "..."], xi: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Whether a proposed angle stands: xi theta < sin(theta), theta < pi; theta = 0 always does."""
    return (xi * theta < sin_theta) & (theta < jnp.pi) | (theta <= 0)


def rayleigh_density(cosine: Float[Array, "..."]) -> Float[Array, "..."]:
    """Density of the polar cosine that Algorithm 2 draws: 3/8 (1 + cos^2) on [-1, 1]."""
    return 0.375 * (1.0 + cosine**2)


def rayleigh_cosine(xi_1: Array, xi_2: Array, xi_3: Array, xi_4: Array) -> Array:
    """A polar cosine of the Rayleigh law from four uniform numbers.

    The law is three parts uniform and one part 3/2 cos^2, and the largest of three uniform numbers
    has the density 3 x^2.
    """
    sign = jnp.where(xi_1 < 0.5, -1.0, 1.0).astype(xi_2.dtype)
    magnitude = jnp.where(
        xi_4 < 0.75, xi_2, jnp.maximum(jnp.maximum(xi_2, xi_3), (xi_4 - 0.75) * 4)
    )
    return sign * magnitude


def cosine_polar(xi: Array) -> Array:
    """Cosine of a polar angle from the cosine law, arccos(sqrt(1 - xi)) (section 4.2.1)."""
    return jnp.sqrt(1.0 - xi)


def fibre_coefficient(
    wavelength_nm: np.ndarray,
    radius_nm: float,
    fraction: float,
    index_ratio: float = 1.5 / 1.33,
    textbook: bool = False,
) -> np.ndarray:
    """Rayleigh scattering coefficient of the papillary fibres in 1/cm (Eq. 7).

    The paper prints the factor (eta^2 - 1)/(eta^2 + 1); `textbook` takes (eta^2 - 1)/(eta^2 + 2)
    (McCartney 1976), 2.07 times weaker in the square.
    """
    wavelength_cm = np.asarray(wavelength_nm, float) * 1e-7
    r = radius_nm * 1e-7
    eta2 = index_ratio**2
    contrast = ((eta2 - 1.0) / (eta2 + (2.0 if textbook else 1.0))) ** 2
    volume = 4.0 / 3.0 * math.pi * r**3
    return 128.0 * math.pi**5 * r**6 * fraction / (3.0 * wavelength_cm**4) / volume * contrast
