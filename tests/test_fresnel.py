"""Interfaces against the closed forms, and the rough surface against its density."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from hylios_fit import fresnel

PAIRS = [(1.0, 1.55), (1.55, 1.0), (1.4, 1.39), (1.7, 1.4)]


def reflectance(theta, n1, n2, dtype):
    one = jnp.asarray(np.cos(theta), dtype)
    return np.asarray(
        fresnel.reflectance(one, jnp.full_like(one, n1), jnp.full_like(one, n2)), float
    )


@pytest.mark.parametrize(("n1", "n2"), PAIRS)
def test_reflectance_is_that_of_the_sine_and_tangent_formulas(n1, n2, dtype):
    theta = np.linspace(0.01, 1.57, 400)
    expected = [reference.fresnel(t, n1, n2) for t in theta]
    # in single precision the square root loses half the digits near the critical angle
    tolerance = 2e-3 if dtype == jnp.float32 else 1e-6
    np.testing.assert_allclose(reflectance(theta, n1, n2, dtype), expected, atol=tolerance)


@pytest.mark.parametrize(("n1", "n2"), PAIRS)
def test_normal_incidence(n1, n2, dtype):
    found = reflectance(np.zeros(1), n1, n2, dtype)
    np.testing.assert_allclose(found, ((n1 - n2) / (n1 + n2)) ** 2, rtol=1e-5)


def test_brewsters_angle_reflects_only_one_polarisation(x64):
    n1, n2 = 1.0, 1.55
    brewster = math.atan(n2 / n1)
    half = 0.5 * ((n1**2 - n2**2) / (n1**2 + n2**2)) ** 2  # r_p = 0, r_s by sin(i - t) alone
    found = reflectance(np.array([brewster]), n1, n2, jnp.float64)
    np.testing.assert_allclose(found, half, rtol=1e-12)


def test_total_reflection_beyond_the_critical_angle_alone(dtype):
    critical = math.asin(1.0 / 1.55)
    found = reflectance(critical + np.array([-1e-2, 1e-2, 0.5]), 1.55, 1.0, dtype)
    assert found[0] < 0.9
    assert found[1] == found[2] == 1.0


def test_equal_indices_reflect_nothing_up_to_grazing_incidence(dtype):
    # 1 - sin^2 loses the cosine of the last 0.01 rad in single precision
    grazing = 0.02 if dtype == jnp.float32 else 1e-5
    cosines = jnp.asarray([1.0, 0.5, grazing], dtype)
    index = jnp.full_like(cosines, 1.4)
    found = fresnel.reflectance(cosines, index, index)
    np.testing.assert_allclose(found, 0.0, atol=1e-6)
    assert np.all(np.isfinite(fresnel.reflectance(jnp.zeros_like(index), index, index)))


def test_reciprocity(x64):
    theta = np.linspace(0.0, 1.5, 50)
    inside = np.arcsin(np.sin(theta) / 1.55)
    np.testing.assert_allclose(
        reflectance(theta, 1.0, 1.55, jnp.float64),
        reflectance(inside, 1.55, 1.0, jnp.float64),
        atol=1e-12,
    )


def test_refracted_cosine_is_snells_law(x64):
    theta = np.linspace(0.0, 1.5, 50)
    c = jnp.asarray(np.cos(theta))
    found = fresnel.refracted_cosine(c, jnp.full_like(c, 1.0), jnp.full_like(c, 1.55))
    np.testing.assert_allclose(found, np.cos(np.arcsin(np.sin(theta) / 1.55)), atol=1e-12)


def test_basis_is_orthonormal(key, dtype):
    u = jax.random.normal(key, (3, 500), dtype)
    u = u / jnp.linalg.norm(u, axis=0, keepdims=True)
    u = jnp.concatenate([u, jnp.asarray([[0, 0], [0, 0], [1, -1]], dtype)], axis=1)
    p, q = (jnp.stack(v) for v in fresnel.basis((u[0], u[1], u[2])))
    frame = jnp.stack([jnp.broadcast_to(v, u.shape) for v in (p, q, u)])
    gram = jnp.einsum("ikr,jkr->ijr", frame, frame, precision="highest")
    expected = np.broadcast_to(np.eye(3)[..., None], gram.shape)
    np.testing.assert_allclose(gram, expected, atol=5e-6)


# --- the rough surface ---------------------------------------------------------------------------


@pytest.mark.parametrize("roughness", [0.05, 0.1, 0.6])
def test_facets_follow_equation_8(roughness):
    rng = np.random.default_rng(8)
    table = fresnel.facet_table(roughness)
    cosine = np.interp(rng.random(100_000), np.linspace(0, 1, len(table)), table)

    def printed(theta):
        s2 = roughness**2
        return s2**2 / (s2 * np.cos(theta) ** 2 + np.sin(theta) ** 2) ** 2 * np.sin(theta)

    top = 4.0 * math.atan(roughness) if roughness < 0.2 else 1.2
    edges = np.concatenate([np.linspace(0.0, top, 40), [math.pi / 2]])
    cdf = reference.cumulative(printed, 0.0, math.pi / 2, 200_001)
    assert reference.chi_square(np.arccos(np.clip(cosine, 0, 1)), edges, cdf) > 1e-3


@pytest.mark.parametrize("roughness", [0.1, 0.6])
def test_facet_density_is_normalised_and_that_of_equation_8(roughness, x64):
    x = jnp.linspace(0.0, 1.0, 400_001)
    density = np.asarray(fresnel.facet_density(x, jnp.asarray(roughness)))
    assert np.trapezoid(density, x) == pytest.approx(1.0, abs=1e-6)
    theta = np.arccos(np.array([0.99, 0.8, 0.1]))
    at = np.asarray(fresnel.facet_density(jnp.asarray(np.cos(theta)), jnp.asarray(roughness)))
    s2 = roughness**2
    printed = s2**2 / (s2 * np.cos(theta) ** 2 + np.sin(theta) ** 2) ** 2
    np.testing.assert_allclose(at / at[0], printed / printed[0], rtol=1e-6)


def test_a_smooth_surface_is_a_mirror():
    assert np.all(fresnel.facet_table(0.0) == 1.0)
    for incidence in (0.0, math.radians(8), 1.0):
        found = fresnel.surface_reflectance(incidence, 1.0, 1.55, 0.0)
        assert found == pytest.approx(reference.fresnel(incidence, 1.0, 1.55), rel=1e-9)
    nearly = fresnel.surface_reflectance(math.radians(8), 1.0, 1.55, 1e-4)
    assert nearly == pytest.approx(
        fresnel.surface_reflectance(math.radians(8), 1.0, 1.55, 0.0), rel=1e-3
    )


def hits(key, incidence, n1, n2, roughness, count, dtype=jnp.float32):
    k1, k2, k3 = jax.random.split(key, 3)
    table = jnp.asarray(fresnel.facet_table(roughness), dtype)
    cos_s = jnp.interp(
        jax.random.uniform(k1, (count,), dtype), jnp.linspace(0, 1, table.size, dtype=dtype), table
    )
    sin_s = jnp.sqrt(1.0 - cos_s**2)
    phi = 2 * jnp.pi * jax.random.uniform(k2, (count,), dtype)
    facet = (sin_s * jnp.cos(phi), sin_s * jnp.sin(phi), -cos_s)
    one = jnp.ones(count, dtype)
    u = (one * math.sin(incidence), 0 * one, one * math.cos(incidence))
    return fresnel.interact(u, facet, n1 * one, n2 * one, jax.random.uniform(k3, (count,), dtype))


@pytest.mark.parametrize("roughness", [0.1, 0.5])
@pytest.mark.parametrize("incidence", [math.radians(8), 1.2])
def test_surface_reflectance_is_the_share_of_drawn_facets(incidence, roughness, key):
    valid, transmitted, _ = hits(key, incidence, 1.0, 1.55, roughness, 400_000)
    valid, transmitted = np.asarray(valid), np.asarray(transmitted)
    count = valid.sum()
    share = (valid & ~transmitted).sum() / count
    quadrature = fresnel.surface_reflectance(incidence, 1.0, 1.55, roughness)
    error = math.sqrt(quadrature * (1 - quadrature) / count)
    assert abs(share - quadrature) < 4 * error


def test_outcomes_keep_to_their_side_and_to_unit_length(key):
    valid, transmitted, u = hits(key, 1.2, 1.0, 1.55, 0.5, 20_000)
    valid, transmitted = np.asarray(valid), np.asarray(transmitted)
    z = np.asarray(u[2])
    assert valid.any()
    assert (~valid).any()
    assert np.all(z[valid & transmitted] > 0)
    assert np.all(z[valid & ~transmitted] < 0)
    np.testing.assert_allclose(sum(np.asarray(x) ** 2 for x in u), 1.0, atol=1e-5)


def test_a_smooth_interface_reflects_and_refracts_in_the_plane_of_incidence(x64):
    theta, n1, n2 = 0.7, 1.0, 1.55
    u = (jnp.asarray([math.sin(theta)] * 2), jnp.zeros(2), jnp.asarray([math.cos(theta)] * 2))
    facet = (jnp.zeros(2), jnp.zeros(2), -jnp.ones(2))
    xi = jnp.asarray([0.0, 0.999])  # the first is reflected, the second passes
    valid, transmitted, out = fresnel.interact(u, facet, n1 * jnp.ones(2), n2 * jnp.ones(2), xi)
    assert np.all(valid)
    assert list(np.asarray(transmitted)) == [False, True]
    inside = math.asin(math.sin(theta) / n2)
    np.testing.assert_allclose(out[0], [math.sin(theta), math.sin(inside)], atol=1e-12)
    np.testing.assert_allclose(out[2], [-math.cos(theta), math.cos(inside)], atol=1e-12)
