"""Plain layers: published values, laws, an independent walk, and what cannot be walked."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import hylios_fit
from hylios_fit import tissue
from hylios_fit.counter import pcg4d
from hylios_fit.errors import HyliosError
from hylios_fit.tissue import Tissue, Totals, walk

SLAB = Tissue(0.02, 1.0, [10.0], 90.0, 0.75)
HALF_SPACE = Tissue(math.inf, 1.5, [10.0], 90.0, 0.0)
TWO = Tissue([0.01, 0.2], 1.4, [5.0, 0.5], [200.0, 150.0], 0.8)
MIXED = Tissue(  # three slabs, different media over and under them
    [0.01, 0.02, 0.03], [1.5, 1.33, 1.45], [8.0, 2.0, 1.0], [60.0, 90.0, 40.0], [0.6, -0.3, 0.8],
    above=1.1, below=1.2,
)  # fmt: skip
# Reflectance with specular, transmittance: van de Hulst 1980 and Giovanelli 1955, as Wang, Jacques
# and Zheng 1995 quote them; the last by adding-doubling.
PUBLISHED = [
    (SLAB, 0.09739, 0.66096, 200_000),
    (HALF_SPACE, 0.2600, 0.0, 200_000),
    (TWO, 0.4365, 0.1308, 100_000),
]


def whole(totals):
    return totals.specular + totals.reflectance


def scores(one, two):
    """Differences of the shares that either walk found, in their standard errors."""
    error = np.hypot(one.standard_errors, two.standard_errors)
    return ((one.shares - two.shares) / error)[(one.ends > 0) | (two.ends > 0)]


def agree(one, two):
    """p-value that two counts are draws of one distribution."""
    table = np.stack([one.ends, two.ends])
    return stats.chi2_contingency(table[:, table.sum(axis=0) > 0]).pvalue


# --- published values and an independent walk ----------------------------------------------------


def test_published_values(dtype, key):
    z = []
    for number, (layers, reflectance, transmittance, rays) in enumerate(PUBLISHED):
        own = jax.random.fold_in(key, number)
        found = walk(layers, own, rays, dtype=dtype)
        z.append((whole(found) - reflectance) / found.reflectance_error)
        if transmittance:
            z.append((found.transmittance - transmittance) / found.transmittance_error)
        else:
            assert found.transmittance == 0
    assert np.max(np.abs(z)) < 4, z
    assert stats.chi2.sf(np.sum(np.square(z)), len(z)) > 0.001, z


def literal(layers, incidence, rays, seed):
    """The walk in three dimensions and in cm, every boundary a stop: counts of the ends."""
    rng = np.random.default_rng(seed)
    index = np.array([layers.above, *layers.index, layers.below])
    top = np.concatenate([[0.0], np.cumsum(layers.thickness)])
    mu_t, m = layers.mu_a + layers.mu_s, len(layers.mu_a)
    ends = np.zeros(m + 2, int)
    sine = math.sin(incidence) * index[0] / index[1]
    u = np.tile([sine, 0.0, math.sqrt(1 - sine**2)], (rays, 1))
    z, layer = np.zeros(rays), np.zeros(rays, int)
    while len(z):
        cosine = u[:, 2]
        step = rng.exponential(size=len(z)) / mu_t[layer]
        edge = np.where(cosine > 0, top[layer + 1], top[layer])
        crosses = step * cosine >= edge - z
        crosses = np.where(cosine > 0, crosses, step * cosine <= edge - z)
        z = np.where(crosses, edge, z + step * cosine)
        beyond = np.where(cosine > 0, layer + 1, layer - 1)
        n1, n2, c = index[layer + 1], index[beyond + 1], np.abs(cosine)
        # Fresnel as sines and tangents of the two angles; equal indices reflect nothing
        refracted = np.minimum(n1 / n2 * np.sqrt(np.maximum(1 - c**2, 0)), 1.0)
        a, b = np.arccos(np.clip(c, 1e-9, 1 - 1e-12)), np.arcsin(refracted)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = 0.5 * (
                (np.sin(a - b) / np.sin(a + b)) ** 2 + (np.tan(a - b) / np.tan(a + b)) ** 2
            )
        normal = c > 1 - 1e-6
        share = np.where(normal, ((n1 - n2) / (n1 + n2)) ** 2, share)
        share = np.where(refracted >= 1, 1.0, np.where(n1 == n2, 0.0, share))
        passes = crosses & (rng.random(len(z)) >= share)
        mirrored = u * np.array([1.0, 1.0, -1.0])
        bent = np.stack(
            [u[:, 0] * n1 / n2, u[:, 1] * n1 / n2, np.sign(cosine) * np.sqrt(1 - refracted**2)], 1
        )
        # inside
        absorbed = ~crosses & (rng.random(len(z)) < (layers.mu_a / mu_t)[layer])
        g, xi = layers.g[layer], rng.random(len(z))
        cos_s = (1 + g**2 - ((1 - g**2) / (1 - g + 2 * g * xi)) ** 2) / (2 * g)
        sin_s, phi = np.sqrt(np.maximum(1 - cos_s**2, 0)), 2 * np.pi * rng.random(len(z))
        helper = np.where(np.abs(u[:, :1]) < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        p = np.cross(u, helper)
        p /= np.linalg.norm(p, axis=1, keepdims=True)
        turned = cos_s[:, None] * u + sin_s[:, None] * (
            np.cos(phi)[:, None] * p + np.sin(phi)[:, None] * np.cross(u, p)
        )
        u = np.where(passes[:, None], bent, np.where(crosses[:, None], mirrored, turned))
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        ends[2:] += np.bincount(layer[absorbed], minlength=m)
        layer = np.where(passes, beyond, layer)
        ends[:2] += (layer < 0).sum(), (layer == m).sum()
        alive = ~absorbed & (layer >= 0) & (layer < m)
        z, u, layer = z[alive], u[alive], layer[alive]
    return ends


@pytest.mark.parametrize("incidence", [0.0, 0.9])
def test_a_literal_walk_in_three_dimensions_agrees(key, incidence):
    found = walk(MIXED, key, 100_000, incidence=incidence)
    slow = Totals(found.specular, literal(MIXED, incidence, 20_000, 5), 0)
    assert slow.rays == 20_000
    z = scores(found, slow)
    assert len(z) == 5
    assert np.max(np.abs(z)) < 4, z
    assert agree(found, slow) > 0.001


# --- laws ----------------------------------------------------------------------------------------


# more lanes than `LANES` end in as few; more rays than `LOT` a lane go in lots
@pytest.mark.parametrize(
    ("rays", "lanes"),
    [
        *((rays, None) for rays in (1, 511, 512, 513, 4095, 4097, 20_000)),
        *((rays, 4096) for rays in (1, 511, 512, 513, 4095, 4097, 20_000)),
        (20_001, 9),
    ],
)
def test_every_ray_that_enters_has_one_end(key, rays, lanes):
    for layers in (TWO, MIXED):
        found = walk(layers, key, rays, lanes=lanes)
        assert found.rays == rays
        assert np.all(found.ends >= 0)
        assert found.interactions >= found.ends[2:].sum()
        together = found.specular + found.reflectance + found.transmittance + found.absorbed.sum()
        assert together == pytest.approx(1.0, abs=1e-14)


def test_a_layer_split_in_two_changes_nothing(key):
    one = walk(Tissue(0.5, 1.4, [2.0], 30.0, 0.7), key, 50_000)
    two = walk(Tissue([0.125, 0.375], 1.4, 2.0, 30.0, 0.7), key, 50_000)
    # a boundary within one index is no stop: the very same rays
    np.testing.assert_array_equal(one.ends[:2], two.ends[:2])
    assert one.ends[2] == two.ends[2:].sum()
    assert one.interactions == two.interactions


def test_index_steps_too_small_to_reflect_change_nothing(key):
    """The same layers, once as one slab and once as three with interfaces to stop at."""
    keys = jax.random.split(key)
    one = walk(TWO, keys[0], 50_000)
    steps = [1.4, 1.4 + 1e-6, 1.4 + 2e-6]
    three = walk(
        Tissue([0.01, 0.1, 0.1], steps, [5.0, 0.5, 0.5], [200.0, 150.0, 150.0], 0.8),
        keys[1], 50_000,
    )  # fmt: skip
    together = three._replace(ends=np.append(three.ends[:3], three.ends[3:].sum()))
    assert agree(one, together) > 0.001


def test_without_absorption_all_light_comes_out(key):
    found = walk(Tissue([0.01, 0.2], 1.4, 0.0, [200.0, 150.0], 0.8), key, 20_000)
    assert found.ends[2:].sum() == 0
    assert whole(found) + found.transmittance == pytest.approx(1.0, abs=1e-14)


def test_without_scattering_light_falls_exponentially(dtype, key):
    incidence, rays = 0.7, 100_000
    layers = Tissue([0.1, 0.3], 1.4, [5.0, 2.0], 0.0, 0.9, below=1.4)
    found = walk(layers, key, rays, incidence=incidence, dtype=dtype)
    cosine = math.sqrt(1 - (math.sin(incidence) / 1.4) ** 2)
    left = np.exp(-np.cumsum([0.0, 0.5, 0.6]) / cosine)
    expected = np.array([0.0, left[2], left[0] - left[1], left[1] - left[2]])
    assert found.ends[0] == 0
    assert stats.chisquare(found.ends[1:], rays * expected[1:]).pvalue > 0.001
    assert found.interactions == found.ends[2:].sum()


@pytest.mark.parametrize("incidence", [0.0, 1.0])
def test_clear_plates_reflect_between_each_other(key, incidence):
    plates = Tissue([0.1, 0.1, 0.1], [1.5, 1.33, 1.7], 0.0, 0.0, 0.0, above=1.0, below=1.2)
    rays = 100_000
    found = walk(plates, key, rays, incidence=incidence)
    index = np.array([1.0, 1.5, 1.33, 1.7, 1.2])
    cosine = np.sqrt(1 - (math.sin(incidence) / index) ** 2)
    s, p = index * cosine, index / cosine
    # polarisations mix at every interface, as everywhere in this walk; lossless plates in a row:
    # what is reflected over what is transmitted adds up
    share = 0.5 * sum(((q[1:] - q[:-1]) / (q[1:] + q[:-1])) ** 2 for q in (s, p))
    transmitted = 1 / (1 + np.sum(share / (1 - share)))
    assert found.specular == pytest.approx(share[0], rel=1e-12)
    z = (found.transmittance - transmitted) / found.transmittance_error
    assert abs(z) < 4
    assert found.interactions == 0


def test_a_clear_half_space_lets_everything_through(key):
    found = walk(Tissue([0.1, math.inf], [1.0, 1.0], 0.0, 0.0, 0.0, below=2.0), key, 1000)
    np.testing.assert_array_equal(found.ends, [0, 1000, 0, 0])


def test_total_reflection_at_the_surface_lets_nothing_in(key):
    found = walk(Tissue(0.1, 1.0, [1.0], 1.0, 0.0, above=1.5), key, 1000, incidence=1.0)
    assert found.specular == 1.0
    assert whole(found) == 1.0
    assert found.transmittance == found.absorbed.sum() == 0
    assert np.all(np.isfinite(found.standard_errors))


def test_the_stated_error_is_the_spread_and_falls_as_the_root_of_the_rays(key):
    for rays, runs in ((500, 64), (8000, 64)):
        many = [walk(TWO, jax.random.fold_in(key, rays + i), rays) for i in range(runs)]
        shares = np.array([found.shares for found in many])
        stated = np.mean([found.standard_errors**2 for found in many], axis=0)
        statistic = (runs - 1) * shares.var(axis=0, ddof=1) / stated
        p = stats.chi2.cdf(statistic, runs - 1)
        assert np.all((p > 5e-4) & (p < 1 - 5e-4)), p
    few, more = walk(TWO, key, 1000), walk(TWO, key, 100_000)
    ratio = few.standard_errors / more.standard_errors
    np.testing.assert_allclose(ratio, 10.0, rtol=0.15)


def test_float32_and_float64_agree(x64, key):
    keys = jax.random.split(key)
    for layers in (TWO, MIXED):
        single = walk(layers, keys[0], 100_000, dtype=jnp.float32)
        double = walk(layers, keys[1], 100_000, dtype=jnp.float64)
        assert agree(single, double) > 0.001


@pytest.mark.parametrize("lanes", [16, 256, 4096])
def test_the_number_of_lanes_changes_only_the_draw(key, lanes):
    one, two = walk(TWO, key, 50_000), walk(TWO, key, 50_000, lanes=lanes)
    assert agree(one, two) > 0.001
    assert one.rays == two.rays


def test_the_same_key_gives_the_same_rays(key):
    one, again = walk(SLAB, key, 5000), walk(SLAB, key, 5000)
    np.testing.assert_array_equal(one.ends, again.ends)
    other = walk(SLAB, jax.random.fold_in(key, 1), 5000)
    assert np.any(one.ends != other.ends)


# --- samplers and random numbers -----------------------------------------------------------------


@pytest.mark.parametrize("g", [-0.9, -0.3, 0.0, 1e-4, 0.5, 0.97])
def test_henyey_greenstein_is_drawn_from_its_density(dtype, g):
    rng = np.random.default_rng(3)
    xi = jnp.asarray(rng.random(200_000), dtype)
    bend = np.asarray(tissue.henyey_greenstein_bend(xi, jnp.asarray(g, dtype)), float)
    assert np.all((bend >= 0) & (bend <= 2 + 1e-5))
    # edges of equal probability from the density alone
    grid = -np.cos(np.linspace(0, np.pi, 400_001))
    with jax.enable_x64(True):
        density = np.asarray(tissue.henyey_greenstein_density(jnp.asarray(grid), jnp.asarray(g)))
    part = 0.5 * (density[1:] + density[:-1]) * np.diff(grid)
    cumulative = np.concatenate([[0.0], np.cumsum(part)])
    assert cumulative[-1] == pytest.approx(1.0, abs=1e-6)
    edges = np.interp(np.linspace(0, cumulative[-1], 65)[1:-1], cumulative, grid)
    counts = np.bincount(np.searchsorted(edges, 1 - bend), minlength=64)
    assert stats.chisquare(counts).pvalue > 1e-4
    z = (np.mean(1 - bend) - g) / (np.std(bend) / math.sqrt(bend.size))
    assert abs(z) < 4


def test_small_angles_keep_their_digits_in_float32():
    xi, g = 1e-3, 0.99
    exact = 2 * (1 - g) ** 2 * xi * (1 + g * (1 - xi)) / (1 - g + 2 * g * (1 - xi)) ** 2
    found = tissue.henyey_greenstein_bend(jnp.float32(xi), jnp.float32(g))
    assert float(found) == pytest.approx(exact, rel=1e-5)
    textbook = (1 + g**2 - ((1 - g**2) / (1 - g + 2 * g * (1 - xi))) ** 2) / (2 * g)
    assert exact == pytest.approx(1 - textbook, rel=1e-6)


def test_the_cosine_of_the_azimuth(dtype):
    x = jnp.linspace(0.0, 1.0, 1001, dtype=dtype)
    found = np.asarray(tissue._cos_pi(x), float)
    exact = np.cos(np.pi * np.asarray(x, float))
    np.testing.assert_allclose(found, exact, atol=3e-7 if dtype == jnp.float32 else 1e-14)


def numbers(dtype, first=0, step=0, key=(1, 2), count=1 << 16):
    lane = jnp.arange(count, dtype=jnp.uint32) + jnp.uint32(first)
    words = pcg4d(lane, jnp.uint32(step), jnp.asarray(key, jnp.uint32))
    return [np.asarray(tissue._unit(word, dtype), float) for word in words[:3]]


def independent(x, y, bins=16):
    counts, _, _ = np.histogram2d(x, y, bins, [[0, 1], [0, 1]])
    return stats.chisquare(counts.ravel()).pvalue


def test_the_numbers_are_uniform_and_independent(dtype):
    base = numbers(dtype)
    for x in base:
        assert x.min() > 0
        assert x.max() <= 1
        counts, _ = np.histogram(x, 256, (0, 1))
        assert stats.chisquare(counts).pvalue > 1e-4
    others = [
        [*base[1:], base[0]], numbers(dtype, first=1), numbers(dtype, step=1),
        numbers(dtype, step=2), numbers(dtype, key=(1, 3)), numbers(dtype, key=(2, 2)),
    ]  # fmt: skip
    p = [independent(x, y) for other in others for x, y in zip(base, other, strict=True)]
    assert min(p) > 1e-4, p


def test_the_numbers_of_one_lane_are_uniform_and_independent(dtype):
    steps = jnp.arange(1 << 16, dtype=jnp.uint32)
    for lane in (0, 7, 4095):
        lanes = jnp.full(steps.shape, lane, jnp.uint32)
        words = pcg4d(lanes, steps, jnp.asarray([11, 12], jnp.uint32))[:3]
        own = [np.asarray(tissue._unit(word, dtype), float) for word in words]
        for x in own:
            counts, _ = np.histogram(x, 256, (0, 1))
            assert stats.chisquare(counts).pvalue > 1e-4
            assert independent(x[:-1], x[1:]) > 1e-4
            assert independent(x[:-2], x[2:]) > 1e-4


# --- input ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"thickness": [0.0, 0.1]}, r"layer 1 of 2: thickness must be above 0 cm.*got 0"),
        ({"thickness": [0.1, -1.0]}, r"layer 2 of 2: thickness.*got -1"),
        ({"thickness": [math.inf, 0.1]}, r"layer 1 of 2: thickness.*finite.*got inf"),
        ({"index": [1.4, 0.9]}, r"layer 2 of 2: index must be 1 or more, got 0.9"),
        ({"mu_a": [1.0, -1.0]}, r"layer 2 of 2: mu_a must be 0 or more.*albedo above 1.*got -1"),
        ({"mu_s": [-2.0, 1.0]}, r"layer 1 of 2: mu_s must be 0 or more.*got -2"),
        ({"mu_s": math.nan}, r"layer 1 of 2: mu_s must be 0 or more.*got nan"),
        ({"mu_s": math.inf}, r"layer 1 of 2: mu_s must be 0 or more.*got inf"),
        ({"g": 1.0}, r"layer 1 of 2: g must be between -1 and 1.*got 1"),
        ({"g": [0.0, -1.5]}, r"layer 2 of 2: g must be between -1 and 1.*got -1.5"),
        ({"mu_a": [1.0, 1.0, 1.0]}, r"as many values.*thickness 2.*mu_a 3"),
        ({"mu_a": "much"}, r"mu_a must be a number or one for each layer, got 'much'"),
        ({"mu_a": [[1.0, 2.0]]}, r"mu_a must be a number or one for each layer, got 2 axes"),
        ({"above": 0.5}, r"index above the layers must be 1 or more, got 0.5"),
        ({"below": [1.0, 1.0]}, r"one index below the layers, got shape \(2,\)"),
        ({"thickness": []}, r"as many values"),
    ],
)
def test_layers_that_cannot_be(change, message):
    good = {"thickness": [0.1, 0.2], "index": 1.4, "mu_a": [1.0, 2.0], "mu_s": [10.0, 20.0], "g": 0}
    Tissue(**good)
    with pytest.raises(HyliosError, match=message):
        Tissue(**(good | change))


def test_at_least_one_layer():
    with pytest.raises(HyliosError, match="at least one layer, got none"):
        Tissue([], 1.4, 1.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"incidence": math.pi / 2}, r"incidence must be 0 to below pi/2 \(grazing\)"),
        ({"incidence": -0.1}, "incidence must be 0"),
        ({"incidence": math.nan}, "incidence must be 0"),
        ({"rays": 0}, "rays must be a whole number from 1 to 2147483647, .* got 0"),
        ({"rays": 2**31}, "which a 32-bit counter holds, got 2147483648"),
        ({"rays": 10.5}, "rays must be a whole number .* got 10.5"),
        ({"dtype": jnp.float64}, "float64 with jax_enable_x64, got float64"),
        ({"dtype": jnp.int32}, "dtype must be float32"),
        ({"lanes": 0}, "lanes must be 1 or more, got 0"),
    ],
)
def test_walks_that_cannot_be(key, options, message):
    with pytest.raises(HyliosError, match=message):
        walk(SLAB, key, **({"rays": 100} | options))


def test_a_half_space_that_only_scatters_is_refused(key):
    with pytest.raises(HyliosError, match="layer 1: a half-space that only scatters"):
        walk(Tissue(math.inf, 1.4, [0.0], 10.0, 0.0), key, 100)


def test_the_walk_is_not_transformed(key):
    with pytest.raises(HyliosError, match="cannot be transformed"):
        jax.jit(lambda layers: walk(layers, key, 10))(SLAB)


def test_layers_pass_through_transformations():
    def total(mu_a):
        return jnp.sum(Tissue([0.1, 0.2], 1.4, mu_a, 1.0, 0.0).mu_a)

    np.testing.assert_array_equal(jax.grad(total)(jnp.ones(2)), [1.0, 1.0])
    doubled = jax.jit(lambda t: jax.tree.map(lambda leaf: leaf + leaf, t))(TWO)
    assert isinstance(doubled, Tissue)
    np.testing.assert_allclose(doubled.mu_s, 2 * TWO.mu_s)


def test_the_package_offers_the_layers():
    assert hylios_fit.Tissue is Tissue
