"""Every sampler against its density by chi-square, and the algorithms as printed."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from hylios_fit import scattering

THETA_0 = scattering.LATIMER_ANGLE


def accepted_angles(key, theta_0, count, dtype):
    k = jax.random.split(key, 3)
    xi = [1.0 - jax.random.uniform(x, (count,), dtype) for x in k]
    theta = scattering.exponential_proposal(jnp.asarray(theta_0, dtype), xi[0], xi[1])
    keep = scattering.exponential_accepts(theta, jnp.sin(theta), xi[2])
    return np.asarray(theta[keep], float)


@pytest.mark.parametrize("theta_0", [THETA_0, 0.01, 1.0])
def test_the_exponential_law_and_its_sampler_agree(theta_0, key, dtype):
    theta = accepted_angles(key, theta_0, 100_000, dtype)
    edges = np.concatenate([np.linspace(0.0, min(8 * theta_0, 3.0), 40), [math.pi]])
    law = reference.cumulative(lambda t: np.exp(-t / theta_0) * np.sin(t), 0.0, math.pi, 400_001)
    assert reference.chi_square(theta, edges, law) > 1e-3


def test_the_printed_algorithm_1_draws_the_same_law():
    rng = np.random.default_rng(1)
    theta = [reference.algorithm_1(rng, THETA_0) for _ in range(4000)]
    x = np.linspace(0.0, math.pi, 20_001)
    density = np.asarray(scattering.exponential_density(jnp.asarray(x, jnp.float32), THETA_0))
    law = reference.cumulative(lambda t: np.interp(t, x, density), 0.0, math.pi)
    edges = np.concatenate([np.linspace(0.0, 6 * THETA_0, 20), [math.pi]])
    assert reference.chi_square(theta, edges, law) > 1e-3
    # its mean is near twice the angle that the text calls the mean
    assert np.mean(theta) == pytest.approx(2 * THETA_0, rel=0.05)


@pytest.mark.parametrize("theta_0", [0.01, THETA_0, 1.0])
def test_the_exponential_density_is_normalised(theta_0, x64):
    t = jnp.linspace(0.0, jnp.pi, 200_001)
    assert np.trapezoid(scattering.exponential_density(t, theta_0), t) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("theta_0", [0.01, THETA_0, 1.0])
def test_what_a_hit_leaves_of_the_cosine(theta_0, x64):
    t = jnp.linspace(0.0, jnp.pi, 200_001)
    density = scattering.exponential_density(t, theta_0)
    mean = np.trapezoid(density * 2.0 * jnp.sin(0.5 * t) ** 2, t)
    lost = scattering.exponential_lost_cosine(jnp.asarray([theta_0, 0.0]))
    np.testing.assert_allclose(lost, [mean, 0.0], rtol=1e-5)


def test_few_proposals_are_refused(key):
    kept = len(accepted_angles(key, THETA_0, 100_000, jnp.float32)) / 100_000
    assert kept == pytest.approx(0.992, abs=0.002)


def test_an_angle_of_zero_always_stands():
    zero = jnp.zeros(1)
    theta = scattering.exponential_proposal(zero, jnp.full(1, 0.3), jnp.full(1, 0.2))
    assert float(theta[0]) == 0.0
    assert bool(scattering.exponential_accepts(theta, jnp.sin(theta), jnp.full(1, 0.99))[0])


def test_melanosome_angle_falls_in_a_line_from_780_to_1300_nm():
    found = scattering.melanosome_angle(np.array([300.0, 780.0, 1040.0, 1300.0, 2500.0]))
    np.testing.assert_allclose(found, THETA_0 * np.array([1, 1, 0.5, 0, 0]), atol=1e-15)
    assert math.degrees(THETA_0) == pytest.approx(5.0)


def test_the_rayleigh_law_and_its_sampler_agree(key, dtype):
    xi = jax.random.uniform(key, (4, 200_000), dtype)
    cosine = np.asarray(scattering.rayleigh_cosine(*xi), float)
    law = reference.cumulative(lambda c: np.asarray(scattering.rayleigh_density(c)), -1.0, 1.0)
    assert reference.chi_square(cosine, np.linspace(-1, 1, 41), law) > 1e-3


def test_the_printed_algorithm_2_draws_the_same_law():
    rng = np.random.default_rng(2)
    cosine = [math.cos(reference.algorithm_2(rng)) for _ in range(10_000)]
    law = reference.cumulative(scattering.rayleigh_density, -1.0, 1.0)
    assert reference.chi_square(cosine, np.linspace(-1, 1, 21), law) > 1e-3
    theta = np.linspace(0, math.pi, 100_001)
    printed = 3 * math.sqrt(6) / 8 * (1 + np.cos(theta) ** 2) * np.sin(theta)
    assert printed.max() == pytest.approx(1.0, abs=1e-8)


def test_the_rayleigh_density_is_normalised():
    c = np.linspace(-1, 1, 10_001)
    assert np.trapezoid(scattering.rayleigh_density(c), c) == pytest.approx(1.0, abs=1e-6)


def test_the_cosine_law(key):
    cosine = np.asarray(scattering.cosine_polar(jax.random.uniform(key, (100_000,))), float)
    assert reference.chi_square(cosine, np.linspace(0, 1, 31), lambda c: c**2) > 1e-3


def test_equation_7_as_printed_and_as_in_the_textbook():
    nm = np.array([400.0, 550.0, 800.0])
    printed = scattering.fibre_coefficient(nm, 100.0, 0.22)
    r, wavelength = 1e-5, nm * 1e-7  # cm
    eta2 = (1.5 / 1.33) ** 2
    by_hand = (
        128 * math.pi**5 * r**6 * 0.22 / (3 * wavelength**4)
        / (4 / 3 * math.pi * r**3)
        * ((eta2 - 1) / (eta2 + 1)) ** 2
    )  # fmt: skip
    np.testing.assert_allclose(printed, by_hand, rtol=1e-12)
    textbook = scattering.fibre_coefficient(nm, 100.0, 0.22, textbook=True)
    np.testing.assert_allclose(printed / textbook, 2.07, atol=0.005)
    assert np.all(scattering.fibre_coefficient(nm, 100.0, 0.0) == 0.0)
    # Rayleigh: the fourth power of the wavelength, the third of the radius at a fixed volume
    assert printed[0] / printed[2] == pytest.approx(16.0)
    doubled = scattering.fibre_coefficient(nm, 200.0, 0.22)
    np.testing.assert_allclose(doubled / printed, 8.0)
