"""One melanosome or complex against explicit geometry and against a literal trace."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from hylios_fit import melanosome

INDEX = 1.40
TRACED = 20_000
FORMS = ["complex", "dispersed"]


def draw_entries(key, form, count=100_000):
    k = jax.random.split(key, 3)
    a, b = (jnp.float32(x * 1e4) for x in melanosome.semi_axes(form))
    cos_axis = melanosome.axis_cosine(a, b, jax.random.uniform(k[0], (count,)))
    radius = jnp.sqrt(jax.random.uniform(k[1], (count,)))
    phi = 2 * jnp.pi * jax.random.uniform(k[2], (count,))
    parts = melanosome.entry_point(a, b, cos_axis, radius, (jnp.cos(phi), jnp.sin(phi)))
    return float(a), float(b), np.asarray(cos_axis, float), [np.asarray(p, float) for p in parts]


@partial(jax.jit, static_argnames="count")
def traced(key, a, b, mu, ratio, count):
    def one(k):
        return melanosome.trace_inside(k, a, b, mu, ratio)

    return jax.lax.map(one, jax.random.split(key, count), batch_size=4000)


# --- sizes and attenuation -----------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_surface_to_volume_is_that_of_the_spheroid(form):
    a, b = melanosome.semi_axes(form)
    assert 0 < a < b
    volume = 4 / 3 * math.pi * a * a * b
    expected = reference.spheroid_surface(a * 1e4, b * 1e4) * 1e-8 / volume
    assert melanosome.surface_to_volume(a, b) == pytest.approx(expected, rel=1e-9)


def test_semi_axes_are_half_the_lengths_of_olson_et_al():
    assert melanosome.semi_axes("complex") == pytest.approx((0.085e-4, 0.20e-4))
    assert melanosome.semi_axes("dispersed") == pytest.approx((0.14e-4, 0.345e-4))
    assert melanosome.SHRINKING == {"granulosum": 0.25, "spinosum": 0.5, "basale": 1.0}


def test_spheres_of_complexes():
    # diameter twice the major axis, or once
    assert 2 * melanosome.sphere_radius("complex") == pytest.approx(0.80e-4)
    assert 2 * melanosome.sphere_radius("compact") == pytest.approx(0.40e-4)


def test_mean_free_paths_of_s3_and_s4():
    um = 1e4
    assert um / (0.03 * melanosome.attenuation_per_content("complex", 1.0)) == pytest.approx(
        18, rel=0.02
    )
    # 2.24 um in the basale itself, and less where they are smaller
    s4 = [um / (0.10 * melanosome.attenuation_per_content("dispersed", x)) for x in (1.0, 0.5)]
    assert s4 == pytest.approx([2.24, 1.12], rel=0.01)


@pytest.mark.parametrize("form", FORMS)
def test_smaller_particles_attenuate_more(form):
    whole = melanosome.attenuation_per_content(form, 1.0)
    assert melanosome.attenuation_per_content(form, 0.25) == pytest.approx(4 * whole)


@pytest.mark.parametrize(("form", "n"), [("complex", 4.7), ("compact", 2.35)])
def test_met_melanosomes(form, n):
    assert melanosome.met_at_most(form) == pytest.approx(n, abs=0.01)
    chances = np.array(melanosome.met_distribution(form))
    assert np.all(chances >= 0)
    assert chances.sum() == pytest.approx(1.0, abs=1e-12)
    assert len(chances) - 1 >= math.ceil(n)
    assert chances @ np.arange(len(chances)) == pytest.approx(
        2 / 3 * melanosome.met_at_most(form), rel=1e-6
    )


def test_met_melanosomes_are_those_of_chords_rounded_at_random():
    rng = np.random.default_rng(47)
    chord = np.sqrt(1 - rng.random(200_000)) * melanosome.met_at_most("complex")
    number = np.floor(chord + rng.random(chord.size)).astype(int)
    chances = np.array(melanosome.met_distribution("complex"))
    found = np.bincount(number, minlength=len(chances)) / chord.size
    np.testing.assert_allclose(found, chances[: len(found)], atol=4 * 0.5 / math.sqrt(chord.size))
    assert melanosome.met_distribution("dispersed") == (0.0, 1.0)


# --- orientation and entry -----------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_axis_cosines_follow_equation_5(form, key, dtype):
    a, b = (jnp.asarray(x * 1e4, dtype) for x in melanosome.semi_axes(form))
    xi = jax.random.uniform(key, (100_000,), dtype)
    found = np.asarray(melanosome.axis_cosine(a, b, xi), float)
    side, end = math.pi * float(a) * float(b), math.pi * float(a) ** 2
    law = reference.cumulative(lambda c: side * (1 - c) + end * c, 0.0, 1.0)
    assert reference.chi_square(found, np.linspace(0, 1, 31), law) > 1e-3
    ends = melanosome.axis_cosine(a, b, jnp.asarray([0.0, 1.0], dtype))
    np.testing.assert_allclose(ends, [0.0, 1.0], atol=1e-3)


@pytest.mark.parametrize("form", FORMS)
def test_rays_enter_where_the_spheroid_faces_them(form, key):
    a, b, cos_axis, (g, u, k) = draw_entries(key, form)
    sin_axis = np.sqrt(1 - cos_axis**2)
    # the frame of the spheroid: major axis, and across it in the plane of the ray
    major = sin_axis * g + cos_axis * u
    minor = sin_axis * u - cos_axis * g
    on_surface = (minor**2 + k**2) / a**2 + major**2 / b**2
    np.testing.assert_allclose(on_surface, 1.0, atol=1e-4)
    facing = minor * sin_axis / a**2 + major * cos_axis / b**2
    assert np.all(facing <= 1e-4 / a)


@pytest.mark.parametrize("form", FORMS)
def test_entry_points_are_uniform_over_the_shadow(form, key):
    a, b, cos_axis, (g, _, k) = draw_entries(key, form)
    half_width = np.sqrt(a**2 * cos_axis**2 + b**2 * (1 - cos_axis**2))
    x, y = g / half_width, k / a
    assert (
        reference.chi_square(np.clip(x**2 + y**2, 0, 1), np.linspace(0, 1, 31), lambda r2: r2)
        > 1e-3
    )
    assert (
        reference.chi_square(
            np.arctan2(y, x), np.linspace(-math.pi, math.pi, 31), lambda t: t / (2 * math.pi)
        )
        > 1e-3
    )


# --- the light inside ----------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("optical_depth", [0.0, 0.5])
def test_the_trace_agrees_with_explicit_geometry(form, optical_depth, key):
    a, b = (x * 1e4 for x in melanosome.semi_axes(form))
    ratio = melanosome.MELANIN_INDEX / INDEX
    rng = np.random.default_rng(5)
    slow = np.array(
        [reference.trace_inside(rng, a, b, optical_depth / a, ratio) for _ in range(3000)]
    )
    args = (jnp.float32(x) for x in (a, b, max(optical_depth / a, 1e-12), ratio))
    fast = np.array([np.asarray(x, float) for x in traced(key, *args, TRACED)]).T
    error = np.sqrt(slow.var(axis=0) / len(slow) + fast.var(axis=0) / len(fast))
    difference = np.abs(slow.mean(axis=0) - fast.mean(axis=0))
    assert np.all(difference <= 4 * error), (slow.mean(axis=0), fast.mean(axis=0), error)
    if optical_depth == 0:
        assert np.all(slow[:, 0] == 1)
        assert np.all(fast[:, 0] == 1)


@pytest.mark.parametrize("form", FORMS)
def test_equal_indices_let_the_ray_straight_out(form, key):
    a, b = (jnp.float32(x * 1e4) for x in melanosome.semi_axes(form))
    _, path = traced(key, a, b, jnp.float32(1e-12), jnp.float32(1.0), TRACED)
    path = np.asarray(path)
    # the mean of single chords at one orientation is volume over shadow
    cosines = melanosome.axis_cosine(a, b, jnp.linspace(0, 1, 4001))
    shadow = math.pi * a * jnp.sqrt(a**2 * cosines**2 + b**2 * (1 - cosines**2))
    expected = float(jnp.mean(4 / 3 * math.pi * a * a * b / shadow))
    assert abs(path.mean() - expected) < 4 * path.std() / math.sqrt(TRACED) + 1e-4 * expected


def test_internal_bounces_raise_weak_absorption_by_1_64(key):
    for form in FORMS:
        a, b = (jnp.float32(x * 1e4) for x in melanosome.semi_axes(form))
        mean = [
            np.asarray(traced(key, a, b, jnp.float32(1e-12), jnp.float32(ratio), TRACED)[1]).mean()
            for ratio in (1.0, melanosome.MELANIN_INDEX / INDEX)
        ]
        assert mean[1] / mean[0] == pytest.approx(1.64, rel=0.03)


def one_survival(mu, ratio_around, form="dispersed", scale=1.0):
    mu = jnp.asarray(np.atleast_1d(mu), jnp.float32)
    return np.asarray(melanosome.survival(form, scale, mu, jnp.full_like(mu, ratio_around)), float)


@pytest.mark.parametrize("mu", [300.0, 3e3, 3e4, 3e5])
def test_the_table_of_survival_agrees_with_the_trace(mu, key):
    a, b = (jnp.float32(x) for x in melanosome.semi_axes("dispersed"))
    ratio = jnp.float32(melanosome.MELANIN_INDEX / INDEX)
    survived, _ = traced(key, a, b, jnp.float32(mu), ratio, TRACED)
    share = np.asarray(survived).mean()
    table = one_survival(mu, INDEX)[0]
    error = math.sqrt(table * (1 - table) / TRACED)
    assert abs(share - table) < 4 * error
    assert 0.0 < table < 1.0


def test_survival_of_a_complex_is_that_of_the_melanosomes_it_holds(key):
    mu, scale = 2e4, 0.5
    a, b = (jnp.float32(x * scale) for x in melanosome.semi_axes("complex"))
    ratio = jnp.float32(melanosome.MELANIN_INDEX / INDEX)
    survived, _ = traced(key, a, b, jnp.float32(mu), ratio, TRACED)
    one = np.asarray(survived).mean()
    error = math.sqrt(one * (1 - one) / TRACED)
    chances = np.array(melanosome.met_distribution("complex"))
    slope = sum(n * p * one ** max(n - 1, 0) for n, p in enumerate(chances))
    expected = sum(p * one**n for n, p in enumerate(chances))
    assert abs(one_survival(mu, INDEX, "complex", scale)[0] - expected) < 4 * slope * error


@pytest.mark.parametrize("form", melanosome.FORMS)
def test_survival_falls_from_one_with_absorption(form, dtype):
    mu = jnp.asarray([0.0, 1e-2, 10.0, 1e3, 1e5, 1e7], dtype)
    found = np.asarray(melanosome.survival(form, 1.0, mu, jnp.full_like(mu, INDEX)), float)
    assert found[0] == pytest.approx(1.0, abs=1e-6)
    assert found.max() <= 1.0 + 1e-6
    assert np.all(np.diff(found[1:]) < 0)
    floor = melanosome.met_distribution(form)[0]  # a ray that meets none of a complex survives
    assert floor <= found[-1] + 1e-6 < floor + 0.02


def test_survival_is_differentiable(dtype):
    def total(mu):
        return jnp.sum(melanosome.survival("complex", 1.0, mu, jnp.full_like(mu, INDEX)))

    slope = np.asarray(jax.grad(total)(jnp.asarray([0.0, 1e3, 1e5], dtype)))
    assert np.all(np.isfinite(slope))
    assert np.all(slope < 0)
