"""The deterministic solver: published values, laws, limits, derivatives, and the walks."""

import itertools
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from hylios_fit import adding, skin, streams, tally, tissue, walker
from hylios_fit.errors import HyliosError
from hylios_fit.simulation import simulate
from hylios_fit.skin import Specimen
from hylios_fit.tissue import Tissue

SLAB = Tissue([0.02], [1.0], [10.0], [90.0], [0.75])
HALF_SPACE = Tissue([math.inf], [1.5], [10.0], [90.0], [0.0])
TWO = Tissue([0.01, 0.2], [1.4, 1.4], [5.0, 0.5], [200.0, 150.0], [0.8, 0.8])
NM = np.array([300.0, 420.0, 560.0, 700.0, 900.0, 1100.0, 1600.0, 2200.0])


def solved(specimen, **options):
    return adding.skin(specimen.layers(NM), **options)


@pytest.mark.parametrize(
    ("layers", "reflectance", "transmittance", "within"),
    [
        (SLAB, 0.09739, 0.66096, 1e-5),  # van de Hulst (1980), table 35
        (HALF_SPACE, 0.2600, 0.0, 1e-4),  # Giovanelli (1955)
        (TWO, 0.4365, 0.1308, 1e-4),
    ],
)
def test_published_values(x64, layers, reflectance, transmittance, within):
    found = adding.tissue(layers, order=32)
    assert float(found.reflectance[0]) == pytest.approx(reflectance, abs=within)
    assert float(found.bottom[0]) == pytest.approx(transmittance, abs=within)


@pytest.mark.parametrize("name", ["S1", "S4"])
def test_energy_is_conserved(x64, name):
    found = solved(Specimen.preset(name), inner=True)
    whole = found.reflectance + found.absorbed.sum(axis=0) + found.bottom
    np.testing.assert_allclose(np.asarray(whole), 1.0, atol=1e-10)
    assert np.all(np.asarray(found.absorbed) > -1e-12)


def test_white_skin_on_a_white_bottom_returns_all_light(x64):
    layers = Specimen.preset("S4").layers(NM)
    clear = layers._replace(
        mu_a=jnp.zeros_like(layers.mu_a), hit_albedo=jnp.ones_like(layers.hit_albedo)
    )
    np.testing.assert_allclose(np.asarray(adding.skin(clear).reflectance), 1.0, atol=1e-8)


def test_opaque_skin_returns_its_surface_alone(x64):
    layers = Specimen.preset("S3").layers(NM)
    black = layers._replace(mu_a=jnp.full_like(layers.mu_a, 1e6))
    found = adding.skin(black)
    np.testing.assert_allclose(np.asarray(found.subsurface), 0.0, atol=1e-12)
    assert np.all(np.isfinite(np.asarray(found.reflectance)))


def test_a_layer_split_in_two_changes_nothing(x64):
    parts = Tissue([0.05, 0.15, 0.01], 1.4, [0.5, 0.5, 5.0], [150.0, 150.0, 200.0], 0.8)
    whole = Tissue([0.2, 0.01], 1.4, [0.5, 5.0], [150.0, 200.0], 0.8)
    a, b = adding.tissue(parts), adding.tissue(whole)
    np.testing.assert_allclose(np.asarray(a.reflectance), np.asarray(b.reflectance), atol=1e-9)
    np.testing.assert_allclose(np.asarray(a.bottom), np.asarray(b.bottom), atol=1e-9)


def test_clear_layers_follow_beer_and_fresnel(x64):
    mu_a, n, depth = 3.0, 1.5, 0.3
    found = adding.tissue(Tissue([depth], [n], [mu_a], [0.0], [0.0]), incidence=0.5)
    inside = math.asin(math.sin(0.5) / n)
    across = math.sin(0.5 - inside) ** 2 / math.sin(0.5 + inside) ** 2
    along = math.tan(0.5 - inside) ** 2 / math.tan(0.5 + inside) ** 2
    r, t = 0.5 * (across + along), math.exp(-mu_a * depth / math.cos(inside))
    through = (1 - r) ** 2 * t / (1 - (r * t) ** 2)
    # the unpolarised law takes one mean reflectance at every bounce, as walks do
    assert float(found.bottom[0]) == pytest.approx(through, abs=1e-7)
    assert float(found.reflectance[0]) == pytest.approx(
        r + (1 - r) ** 2 * r * t**2 / (1 - (r * t) ** 2), abs=1e-7
    )


def test_reflectance_of_a_scattering_slab_is_reciprocal(x64):
    """The operator of a layer is symmetric in the streams' own measure."""
    st = streams.Streams.make((1.0, 1.4), 8)
    even, odd = (b[None] for b in streams.scattering_basis(st, 1.4))
    chi = jnp.asarray(0.8) ** jnp.arange(2.0 * st.weight.size)
    one = jnp.ones(1)
    r, t = adding._slab(
        200.0 * one, 190.0 * one, 0.01 * one, jnp.asarray(even), jnp.asarray(odd),
        jnp.asarray(st.cosine(1.4)[None]), chi[None],
    )  # fmt: skip
    np.testing.assert_allclose(np.asarray(r), np.asarray(r).swapaxes(1, 2), atol=1e-12)
    np.testing.assert_allclose(np.asarray(t), np.asarray(t).swapaxes(1, 2), atol=1e-12)


def test_orders_converge(x64):
    specimen = Specimen.preset("S2")
    fine = np.asarray(solved(specimen, order=16).reflectance)
    error = [np.abs(np.asarray(solved(specimen, order=k).reflectance) - fine).max() for k in (6, 8)]
    assert error[0] < 4e-4
    assert error[1] < 1.5e-4


def test_float32_is_float64_rounded(x64):
    specimen = Specimen.preset("S3")
    single, double = (solved(specimen, dtype=d).reflectance for d in (jnp.float32, jnp.float64))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(np.asarray(single), np.asarray(double), atol=2e-5)


def test_agrees_with_the_walk_of_independent_particles():
    """Over specimens from the whole range of contents, by the covariance of the walk's errors."""
    generator = np.random.default_rng(7)
    statistic = freedom = 0.0
    for number, form in enumerate(("complex", "dispersed", "compact", "complex")):
        values = {
            "melanosome_granulosum": generator.uniform(0, 4),
            "melanosome_spinosum": generator.uniform(0, 4),
            "melanosome_basale": generator.uniform(0, 8),
            "colloidal_melanin": generator.uniform(0, 3),
            "blood_papillary": generator.uniform(0.1, 4),
            "blood_reticular": generator.uniform(0.1, 4),
            "water": generator.uniform(0.5, 1.2),
        }
        specimen = Specimen(values, form)
        nm = np.array([350.0, 500.0, 620.0, 740.0, 1350.0, 1650.0])
        layers = specimen.layers(nm)
        plan = walker.plan(layers)
        paths = walker.walk(
            plan.layers, form, jax.random.key(number), rays=40_000, independent=True,
            shares=plan.shares,
        )  # fmt: skip
        found = tally.collect(paths, plan.layers, layers, shares=plan.shares)
        exact = adding.skin(specimen.layers(nm))
        share = np.asarray(exact.subsurface) / (1.0 - np.asarray(exact.surface))
        z = (np.asarray(found.mean) - share) / np.asarray(found.standard_error)
        statistic += float(z[::3] @ z[::3])  # far apart: hardly any ray serves both
        freedom += 2
        assert np.all(np.abs(z) < 4.5)
    assert chi2.sf(statistic, freedom) > 1e-3


def test_particles_that_the_walk_refuses_are_a_dead_length():
    """`let_stand` against a walk with rejections, in dark skin, where they matter most."""
    specimen = Specimen.preset("S4")
    nm = np.array([450.0, 600.0, 700.0, 760.0])
    layers = specimen.layers(nm)
    plan = walker.plan(layers)
    paths = walker.walk(
        plan.layers, "dispersed", jax.random.key(3), rays=40_000, shares=plan.shares
    )
    found = tally.collect(paths, plan.layers, layers, shares=plan.shares)
    medium = specimen.layers(nm)
    stands = skin.let_stand(medium, specimen.values, "dispersed")
    refused, ideal = (adding.skin(m, order=8) for m in (stands, medium))
    error = np.asarray(found.standard_error)
    surface = np.asarray(refused.surface)
    z = (np.asarray(found.mean) - np.asarray(refused.subsurface) / (1 - surface)) / error
    assert np.all(np.abs(z) < 4)
    changed = np.asarray(ideal.subsurface) - np.asarray(refused.subsurface)
    changed = changed / (1 - surface) / error
    assert np.all(np.abs(changed[1:]) > 4)  # the check can fail


def test_slopes_are_those_of_finite_differences(x64):
    specimen = Specimen.preset("S4").replace(bottom_reflectance=0.8, reticular_scattering=5.0)
    names = (
        "melanosome_basale", "colloidal_melanin", "blood_papillary", "fibre_fraction",
        "thickness_corneum", "thickness_spinosum", "thickness_papillary", "thickness_reticular",
        "bottom_reflectance", "reticular_scattering", "reticular_scattering_power",
    )  # fmt: skip
    value, slopes = (np.asarray(part) for part in adding.slopes(specimen, NM, names, order=6))
    assert slopes.shape == (len(names), NM.size)

    def curve(changed):
        stands = skin.let_stand(changed.layers(NM), changed.values, changed.melanosome_form)
        return np.asarray(adding.skin(stands, order=6).reflectance)

    np.testing.assert_allclose(value, curve(specimen), atol=1e-12)
    for name, slope in zip(names, slopes, strict=True):
        x = specimen.values[name]
        up, down = (curve(specimen.replace(**{name: x * (1 + sign * 1e-4)})) for sign in (1, -1))
        np.testing.assert_allclose(slope, (up - down) / (2e-4 * x), rtol=1e-5, atol=1e-9)


def test_slopes_are_those_that_jax_finds_in_the_solver(x64):
    layers = Specimen.preset("S4").replace(reticular_scattering=5.0).layers(NM[2:4])

    def total(mu_a, mu_particle, mu_fibre):
        moved = layers._replace(mu_a=mu_a, mu_particle=mu_particle, mu_fibre=mu_fibre)
        return jnp.sum(adding.skin(moved, order=4).reflectance)

    numbers = layers.mu_a, layers.mu_particle, layers.mu_fibre
    found = jax.grad(total, argnums=(0, 1, 2))(*numbers)
    c, kinds, index, roughness = adding._of_skin(layers, 4, np.float64)
    *told, at = adding._ready(c, kinds, index, 1.0, roughness, math.radians(8.0), 4, np.float64)
    c, optics, which, counts = told
    _, by = adding._solve(c, optics, which, kinds, counts, "slopes")
    own = by.extinction, by.extinction + by.scattering * layers.hit_albedo, by.once[4]
    for mine, expected, number in zip(map(np.asarray, own), found, numbers, strict=True):
        seen = np.broadcast_to(np.asarray(number) > 0, expected.shape)
        mine, expected = ((1.0 - np.asarray(at)) * mine)[seen], np.asarray(expected)[seen]
        np.testing.assert_allclose(mine, expected, rtol=1e-9, atol=1e-14)


def layer_of(extinction, albedo, depth, order=8):
    """What a layer of skin is solved from, for optical depths of half of it."""
    st = streams.Streams.make((1.0, 1.4), order)
    even, odd = (jnp.asarray(basis)[None] for basis in streams.scattering_basis(st, 1.4))
    cosine = jnp.asarray(st.cosine(1.4))[None]
    chi = jnp.asarray(streams.exponential_moments((0.6,), 2 * st.weight.size))
    extinction = jnp.array([float(extinction)])
    half = depth / jnp.maximum(extinction, 1.0)
    return (extinction, albedo * extinction, half), (even, odd, cosine, chi)


def mixed(solver, numbers, rest):
    """Some sum of all that a layer reflects and transmits."""
    weights = np.random.default_rng(0).normal(size=(2, *rest[0].shape))
    return sum(jnp.sum(w * m) for w, m in zip(weights, solver(*numbers, *rest), strict=True))


def test_a_layer_keeps_its_light_and_knows_its_derivatives(x64):
    own, generic = (jax.jit(jax.grad(partial(mixed, f))) for f in (adding._layer, adding._slab))
    root = np.sqrt(streams.Streams.make((1.0, 1.4), 8).weight)
    for albedo, depth in itertools.product((0.0, 0.6, 1.0), (0.0, 1e-6, 0.03, 2.0, 500.0)):
        numbers, rest = layer_of(30.0, albedo, depth)
        for mine, expected in zip(own(numbers, rest), generic(numbers, rest), strict=True):
            assert float(mine[0]) == pytest.approx(float(expected[0]), rel=1e-8, abs=1e-9)
        r, t = adding._layer(*numbers, *rest)
        for part, same in zip((r, t), adding._slab(*numbers, *rest), strict=True):
            np.testing.assert_array_equal(np.asarray(part), np.asarray(same))
        flux = root @ np.asarray(r + t)[0]  # for light of every stream, once each
        if albedo == 1.0:
            np.testing.assert_allclose(flux, root, rtol=1e-9)
        elif depth:
            assert np.all(flux < root)


def test_a_layer_of_any_thickness_is_opaque_at_most(x64):
    (extinction, scattering, _), rest = layer_of(30.0, 0.6, 1.0)
    thick, thicker = (
        adding._layer(extinction, scattering, jnp.array([half]), *rest) for half in (1e3, 1e30)
    )
    np.testing.assert_allclose(np.asarray(thick[0]), np.asarray(thicker[0]), atol=1e-12)
    np.testing.assert_allclose(np.asarray(thicker[1]), 0.0, atol=1e-12)


def test_a_layer_of_nothing_has_the_derivative_of_a_little(x64):
    _, rest = layer_of(1.0, 0.0, 0.0)
    numbers = jnp.zeros(1), jnp.zeros(1), jnp.array([0.2])
    change = jax.grad(partial(mixed, adding._layer))((*numbers,), rest)
    step = 1e-8  # the flattest stream goes a long way through it
    for i in range(2):
        more = [*numbers]
        more[i] = numbers[i] + step
        little = mixed(adding._layer, more, rest) - mixed(adding._layer, numbers, rest)
        assert float(change[i][0]) == pytest.approx(float(little) / step, rel=1e-4)


@pytest.mark.parametrize(("dtype", "within"), [(np.float64, 1e-13), (np.float32, 3e-6)])
def test_inverses_are_inverses(x64, dtype, within):
    generator = np.random.default_rng(1)
    turn = np.linalg.qr(generator.normal(size=(5, 23, 23)))[0]
    positive = np.einsum("nij,nj,nkj->nik", turn, generator.uniform(0, 1, (5, 23)), turn)
    exact = np.linalg.inv(positive + np.eye(23))
    by_series = adding._inverse_above_one(jnp.asarray(positive, dtype))
    by_steps = adding._inverse(jnp.asarray(positive + np.eye(23), dtype))
    assert by_series.dtype == by_steps.dtype == dtype
    for found in (by_series, by_steps):
        np.testing.assert_allclose(np.asarray(found), exact, atol=within)
    change = generator.normal(size=positive.shape)
    for function, at in (
        (adding._inverse_above_one, positive),
        (adding._inverse, positive + np.eye(23)),
    ):
        _, slope = jax.jvp(function, (jnp.asarray(at, dtype),), (jnp.asarray(change, dtype),))
        np.testing.assert_allclose(np.asarray(slope), -exact @ change @ exact, atol=50 * within)


def test_slopes_say_what_they_cannot():
    with pytest.raises(HyliosError, match="no derivative in index_papillary"):
        adding.slopes(Specimen(), NM, ["index_papillary"])


@pytest.mark.parametrize("edge", [0.0, 1e-12])
def test_derivatives_are_finite_at_the_limits(x64, edge):
    fixed = Specimen.preset("S4").layers(NM)

    def total(mu_a, hits, fibre):
        layers = fixed._replace(mu_a=mu_a, mu_particle=hits, mu_fibre=fibre)
        return jnp.sum(adding.skin(layers, order=4).reflectance)

    arguments = tuple(jnp.full_like(a, edge) for a in (fixed.mu_a, fixed.mu_particle))
    found = jax.grad(total, argnums=(0, 1, 2))(*arguments, jnp.full_like(fixed.mu_fibre, edge))
    assert all(np.all(np.isfinite(np.asarray(part))) for part in found)


def test_forward_scattering_is_no_scattering(x64):
    """Where theta_0 is 0, a hit only takes its share of the light."""
    layers = Specimen.preset("S3").layers(np.array([1400.0, 2000.0]))
    hits = layers.mu_particle * (1.0 - layers.hit_albedo)
    none = layers._replace(mu_a=layers.mu_a + hits, mu_particle=jnp.zeros_like(hits))
    a, b = adding.skin(layers).reflectance, adding.skin(none).reflectance
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=1e-6)


def test_dispersion_is_solved_as_each_wavelength_alone(x64):
    specimen = Specimen.preset("S3").replace(index_dispersion=0.02)
    nm = np.linspace(400.0, 1000.0, 24)  # more sets of indices than surfaces worked out
    together = np.asarray(adding.skin(specimen.layers(nm)).reflectance)
    alone = [np.asarray(adding.skin(specimen.layers(nm[i : i + 1])).reflectance) for i in (0, 11)]
    np.testing.assert_allclose(together[[0, 11]], np.concatenate(alone), atol=2e-5)


def test_the_parts_that_cores_solve_are_the_whole(x64, monkeypatch):
    nm = np.linspace(300.0, 2400.0, 70)
    layers = Specimen.preset("S3").replace(index_dispersion=0.02).layers(nm)

    def found(block, used):
        monkeypatch.setattr(adding, "BLOCK", block)
        monkeypatch.setattr(adding, "cores", lambda: used)
        return adding.skin(layers, order=4, inner=True)

    whole = found(70, 1)
    for used in (2, 8):  # three blocks: 2 and 1, and a core for each
        for part, expected in zip(found(32, used), whole, strict=True):
            np.testing.assert_allclose(part, expected, rtol=1e-11, atol=1e-14)


def test_reticular_scattering_and_bottom(x64):
    pale = Specimen.preset("S3")
    dull = pale.replace(bottom_reflectance=0.2)
    cloudy = dull.replace(reticular_scattering=20.0)
    plain, dark, light = (np.asarray(solved(s).reflectance)[3] for s in (pale, dull, cloudy))
    assert dark < light < plain


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"order": 1}, "order must lie in 2 to 256"),
        ({"incidence": 1.57}, "incidence must lie in 0 to 89 degrees"),
    ],
)
def test_bad_requests(options, message):
    with pytest.raises(HyliosError, match=message):
        solved(Specimen(), **options)


def test_the_indices_must_be_concrete():
    layers = Specimen().layers(NM)
    with pytest.raises(HyliosError, match="no derivative in the indices"):
        jax.grad(lambda n: jnp.sum(adding.skin(layers._replace(index=n)).reflectance))(layers.index)


def test_streams_integrate_the_hemisphere():
    for indices in ((1.0, 1.55, 1.4, 1.39, 1.41), (1.0, 1.0), (1.0, 1.33, 1.2)):
        st = streams.Streams.make(indices, 8)
        for n in set(indices):
            s = st.count(n)
            mu = st.cosine(n)
            flux = st.weight[:s]
            assert np.sum(flux) == pytest.approx(n * n / 2, rel=1e-12)
            assert np.sum(flux * mu) == pytest.approx(n * n / 3, rel=1e-5)


def test_interpolation_is_exact_at_the_streams_and_keeps_the_flux():
    st = streams.Streams.make((1.0, 1.55, 1.4), 6)
    p = np.sqrt(st.upper - st.below)
    np.testing.assert_allclose(st.interpolation(p), np.eye(p.size), atol=1e-8)
    anywhere = st.interpolation(np.linspace(0.0, 1.54, 40))
    np.testing.assert_allclose(anywhere.sum(axis=1), 1.0, atol=1e-9)


def test_the_rough_surface_keeps_the_light():
    st = streams.Streams.make((1.0, 1.55, 1.4, 1.39, 1.41), 8)
    found = streams.surface(st, 1.0, 1.55, 0.1, math.radians(8.0), 8)
    np.testing.assert_allclose(found.back.sum(axis=0) + found.leaves, 1.0, atol=1e-9)
    assert found.enters.sum() == pytest.approx(1.0)
    from hylios_fit import fresnel

    walked = fresnel.surface_reflectance(math.radians(8.0), 1.0, 1.55, 0.1)
    assert found.at_once == pytest.approx(walked, abs=2e-6)


def test_hundreds_of_derivatives_through_batched_solves_come_back():
    """jaxlib 0.10.2 stops for ever after a few of them on two cores."""

    @jax.jit
    def step(a, b):
        return jax.jvp(lambda m: jnp.linalg.solve(m, b), (a,), (b,))[1]

    generator = np.random.default_rng(0)
    a = jnp.asarray(np.eye(12) + 0.01 * generator.normal(size=(64, 12, 12)), jnp.float32)
    for _ in range(200):
        b = jax.block_until_ready(step(a, a))
    assert np.all(np.isfinite(np.asarray(b)))


def test_tissue_solver_agrees_with_its_walk(x64):
    """Random stacks with mixed indices, oblique light."""
    generator = np.random.default_rng(3)
    statistic = freedom = 0
    for number in range(4):
        m = 1 + number % 2
        layers = Tissue(
            generator.uniform(0.01, 0.1, m), generator.uniform(1.0, 1.6, m),
            generator.uniform(0.1, 10, m), generator.uniform(5, 100, m),
            generator.uniform(-0.5, 0.9, m),
        )  # fmt: skip
        incidence = (0.0, 0.3, 0.9, 0.0)[number]
        walked = tissue.walk(layers, jax.random.key(number), 200_000, incidence=incidence)
        found = adding.tissue(layers, incidence=incidence, order=12)
        exact = np.array(
            [float(found.subsurface[0]), float(found.bottom[0]), *np.asarray(found.absorbed)[:, 0]]
        ) / (1.0 - float(found.surface[0]))
        expected = exact * walked.rays
        statistic += float(np.sum((walked.ends - expected) ** 2 / expected))
        freedom += m + 1
    assert chi2.sf(statistic, freedom) > 1e-3


def test_the_slope_at_a_content_of_nothing_is_that_of_a_little_of_it(x64):
    nm = np.array([400.0, 700.0, 1200.0])
    names = ("melanosome_spinosum", "reticular_scattering")
    base = Specimen()  # of both it has nothing
    _, slopes = adding.slopes(base, nm, names)
    for name, slope in zip(names, np.asarray(slopes), strict=True):
        step = 1e-4  # from there on, so that both are solved with the same streams
        one, two = (simulate(base.replace(**{name: n * step}), nm, method="adding") for n in (1, 2))
        change = (two.reflectance - one.reflectance) / step
        np.testing.assert_allclose(slope, change, atol=0.01 * np.abs(slope).max())
