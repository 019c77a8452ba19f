"""The fast walk and its sums: laws, honesty of its errors, and the two slow witnesses."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from scipy import stats

from hylios_fit import analog, counter, fresnel, scattering, skin, tally, walker
from hylios_fit.skin import Specimen

NM = np.array([300.0, 420.0, 550.0, 1450.0])
FALLING = np.array([550.0, 900.0, 1100.0, 1450.0])  # theta_0 falls in the middle
SPECTRUM = np.arange(250.0, 2501.0, 50.0)
RAYS = 8192  # one shape for all walks, so that they share one compiled program
S3 = Specimen.preset("S3")


def walk(layers, key, form="complex", rays=RAYS, **options):
    return walker.walk(layers, form, key, rays=rays, **options)


def within(one, two, errors=4.0):
    """Two tallies agree at every wavelength within their combined standard errors."""
    spread = np.hypot(np.asarray(one.standard_error), np.asarray(two.standard_error))
    assert np.all(spread > 0)
    z = np.abs(np.asarray(one.mean) - np.asarray(two.mean)) / spread
    assert np.all(z < errors), (one.mean, two.mean, z)


@pytest.fixture(scope="module")
def layers():
    return S3.layers(NM)


@pytest.fixture(scope="module")
def paths(layers):
    return walk(layers, jax.random.key(1))


@pytest.fixture(scope="module")
def found(paths, layers):
    return tally.collect(paths, layers, layers)


# --- random numbers ------------------------------------------------------------------------------


def numbers(first=0, step=0, draw=0, key=(1, 2), count=1 << 16, dtype=jnp.float32):
    """Four draws of a step, of some rays."""
    ray = jnp.arange(count, dtype=jnp.uint32) + jnp.uint32(first)
    seeds = counter.seeds(ray, jnp.asarray(key, jnp.uint32))
    every = walker._uniform(seeds, jnp.uint32(step), jnp.dtype(dtype))
    return list(np.asarray(every[draw : draw + 4], float))


def independent(x, y, bins=16):
    """p-value that two lots of numbers are uniform and independent."""
    counts, _, _ = np.histogram2d(x, y, bins, [[0, 1], [0, 1]])
    return stats.chisquare(counts.ravel()).pvalue


def test_the_numbers_are_uniform(dtype):
    for draw in (0, 4, 7):
        for x in numbers(step=3, draw=draw, dtype=dtype):
            counts, _ = np.histogram(x, 256, (0, 1))
            assert stats.chisquare(counts).pvalue > 1e-4


def test_the_numbers_are_independent():
    base = numbers()
    others = {
        "each other": [base[(i + 1) % 4] for i in range(4)],
        "the next ray": numbers(first=1),
        "the next step": numbers(step=1),
        "the next draws": numbers(draw=4),
        "another key": numbers(key=(1, 3)),
        "keys swapped": numbers(key=(2, 1)),
        "a batch later": numbers(first=walker.BATCH),
    }
    for name, other in others.items():
        for i in range(4):
            assert independent(base[i], other[i]) > 1e-5, name
            assert abs(np.corrcoef(base[i], other[i])[0, 1]) < 5 / math.sqrt(base[i].size), name


def test_steps_of_one_ray_are_independent():
    step = jnp.arange(1 << 16, dtype=jnp.uint32)
    for ray in (0, 7, 1 << 31):
        one = jnp.full(step.shape, ray, jnp.uint32)
        seeds = counter.seeds(one, jnp.asarray([1, 2], jnp.uint32))
        x = np.asarray(walker._uniform(seeds, step[None], jnp.dtype("float32")))[:4]
        for i in range(4):
            assert independent(x[i, ::2], x[i, 1::2]) > 1e-5
            assert independent(x[i], x[(i + 1) % 4]) > 1e-5


def test_the_numbers_stay_inside_the_unit_interval():
    @jax.jit
    def ends(ray):
        seeds = counter.seeds(ray, jnp.asarray([1, 2], jnp.uint32))
        x = walker._uniform(seeds, jnp.uint32(0), jnp.dtype("float32"))[:4]
        return jnp.stack([jnp.min(x), jnp.max(x)])

    for start in range(0, 1 << 24, 1 << 22):
        low, high = np.asarray(ends(jnp.arange(start, start + (1 << 22), dtype=jnp.uint32)))
        assert 0.0 < low < 1e-6
        assert 1.0 - 1e-6 < high < 1.0


# --- laws ----------------------------------------------------------------------------------------


def without_absorption(layers):
    return layers._replace(
        mu_a=jnp.zeros_like(layers.mu_a), hit_albedo=jnp.ones_like(layers.hit_albedo)
    )


def test_without_absorption_all_light_returns(layers):
    clear = without_absorption(layers)
    paths = walk(clear, jax.random.key(2))
    assert np.all(np.asarray(paths.escaped) == 1.0)
    assert np.asarray(paths.sums)[:, walker.HITS].sum() > RAYS
    shared = tally.collect(paths, clear, clear)
    z = (np.asarray(shared.mean) - 1.0) / np.asarray(shared.standard_error)
    assert np.all(np.abs(z) < 4)
    # the plain count: the rays of each wavelength over their share
    own = np.asarray(tally.collect(paths, clear, clear, own_only=True).mean)
    share = np.bincount(np.asarray(paths.hero), minlength=len(NM)) / RAYS
    np.testing.assert_allclose(
        own, share / np.asarray(walker.hero_shares(clear.theta_0)), rtol=1e-5
    )
    np.testing.assert_allclose(own, 1.0, atol=2e-3)


def test_scattering_changes_nothing_where_nothing_absorbs(layers):
    clear = without_absorption(layers)
    clear = clear._replace(mu_tissue=clear.mu_tissue.at[5].set(50.0))
    paths = walk(clear, jax.random.key(3))
    assert np.all(np.asarray(paths.escaped) == 1.0)
    assert np.asarray(paths.sums)[:, walker.TISSUE].sum() > RAYS


def stack_return(layers, column, incidence):
    """Share of the light entering smooth layers without scatterers over a black bottom that
    comes back, by adding incoherent interfaces from below."""
    index = np.asarray(layers.index, float)[:, column]
    mu_a = np.asarray(layers.mu_a, float)[:, column]
    angle = np.arcsin(math.sin(incidence) / index)
    passed = np.exp(-mu_a * np.asarray(layers.thickness, float) / np.cos(angle))
    below = 0.0  # what a ray that goes down at the top of a layer sends back up there
    for i in range(5, -1, -1):
        if i == 5:
            under = 0.0
        else:
            r = reference.fresnel(angle[i], index[i], index[i + 1])
            under = r + (1 - r) ** 2 * below / (1 - r * below)
        below = passed[i] ** 2 * under
    top = reference.fresnel(angle[0], index[0], 1.0)
    return below * (1 - top) / (1 - top * below)


def test_layers_without_scatterers_are_a_stack_of_plates(layers):
    none = jnp.zeros_like(layers.mu_particle)
    index = jnp.asarray([1.1, 1.9, 1.9, 1.9, 1.1, 1.9], jnp.float32)[:, None]
    plates = layers._replace(
        mu_particle=none,
        mu_fibre=jnp.zeros_like(layers.mu_fibre),
        mu_a=jnp.asarray([[5.0, 10.0, 20.0, 40.0]] * 6, jnp.float32),
        index=jnp.broadcast_to(index, none.shape),
        bottom=jnp.zeros_like(layers.bottom),
        roughness=jnp.zeros_like(layers.roughness),
    )
    for incidence in (math.radians(8), 1.2):
        found = tally.collect(walk(plates, jax.random.key(4), incidence=incidence), plates, plates)
        expected = np.array([stack_return(plates, i, incidence) for i in range(len(NM))])
        assert expected.min() > 0.05
        z = (np.asarray(found.mean) - expected) / np.asarray(found.standard_error)
        assert np.all(np.abs(z) < 4), (found.mean, expected)


def test_a_black_bottom_and_no_scatterers_leave_the_interfaces_alone(layers):
    bare = layers._replace(
        mu_particle=jnp.zeros_like(layers.mu_particle),
        mu_fibre=jnp.zeros_like(layers.mu_fibre),
        mu_a=jnp.zeros_like(layers.mu_a),
        bottom=jnp.zeros_like(layers.bottom),
    )
    paths = walk(bare, jax.random.key(5))
    assert np.all(np.asarray(paths.sums)[np.asarray(paths.escaped) == 1, walker.BOTTOM] == 0)
    share = np.asarray(paths.escaped).mean()
    expected = stack_return(bare, 0, math.radians(8))  # roughness moves it little
    assert abs(share - expected) < 4 * math.sqrt(expected / RAYS)


def test_a_thicker_lossy_layer_returns_less_and_a_brighter_bottom_more(found, paths, layers):
    more = tally.collect(paths, layers, S3.replace(blood_papillary=0.6).layers(NM))
    dim = tally.collect(paths, layers, S3.replace(bottom_reflectance=0.7).layers(NM))
    assert np.all(np.asarray(more.mean)[1:3] < np.asarray(found.mean)[1:3])
    assert np.all(np.asarray(dim.mean)[1:3] < np.asarray(found.mean)[1:3])


def test_the_sums_of_paths_are_possible(paths, layers):
    out = np.asarray(paths.sums)[np.asarray(paths.escaped) == 1]
    length, hits, proposed = (out[:, s] for s in (walker.LENGTH, walker.HITS, walker.PROPOSED))
    assert len(out) > 100
    assert np.all(length >= 0)
    assert np.all(length[:, 0] >= 2 * 0.001 / 1.001)  # in and out through the corneum
    assert np.all(hits <= proposed)
    assert (hits < proposed).any()  # some particles are refused
    assert np.all(hits[:, :2] == 0)  # S3 has none above the basale
    assert np.all(out[:, walker.FIBRE_LENGTH] <= length[:, 4] * 1.0001)
    deep = out[:, walker.BOTTOM] > 0
    assert np.all(length[deep, 5] >= 0.19)
    assert np.all(out[~deep, walker.BOTTOM] == 0)


def test_slopes_are_those_of_the_solver_also_at_a_content_of_nothing():
    from hylios_fit import adding

    nm = np.array([400.0, 500.0, 650.0, 900.0])
    names = ("melanosome_spinosum", "melanosome_basale", "blood_reticular")  # S3 has no first
    layers = S3.layers(nm)
    plan = walker.plan(layers)

    def curve(x, paths):
        asked = skin.layers({**S3.values, **dict(zip(names, x, strict=True))}, "complex", nm)
        return tally.collect(paths, plan.layers, asked, shares=plan.shares).mean

    slope = jax.jit(jax.jacfwd(curve))
    x = jnp.asarray(S3.parameters(names), jnp.float32)
    found, lots = [], 24  # rare paths tell of what is not there: few lots say little of the error
    for i in range(lots):
        paths = walker.walk(
            plan.layers, "complex", jax.random.key(20 + i), rays=16_384, independent=True,
            shares=plan.shares,
        )  # fmt: skip
        found.append(np.asarray(slope(x, paths)).T)
    _, exact = adding.slopes(S3, nm, names, independent=True)
    surface = np.asarray(adding.skin(layers).surface)
    exact = np.asarray(exact) / (1.0 - surface)
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / math.sqrt(lots)
    assert np.all(exact < 0)
    z = (mean - exact) / error
    assert np.abs(z).max() < 5
    # few of the paths meet what is not there, which makes its slope right and noisy
    assert np.all(error[1:, :3] < 0.15 * np.abs(exact[1:, :3]))


# --- sharing, absorbing, repeating ---------------------------------------------------------------


def test_shared_paths_agree_with_each_wavelengths_own(paths, layers, found):
    own = tally.collect(paths, layers, layers, own_only=True)
    within(found, own)
    assert np.all(np.asarray(found.standard_error) < 1.05 * np.asarray(own.standard_error))
    assert np.all(np.asarray(found.effective_rays) > np.asarray(own.effective_rays) * 0.9)


def test_other_company_leaves_a_wavelength_the_same(found):
    other = np.array([300.0, 480.0, 550.0, 1700.0])
    layers = S3.layers(other)
    two = tally.collect(walk(layers, jax.random.key(6)), layers, layers)
    common = np.array([0, 2])
    part = [
        tally.Tally(t.rays, t.groups, t.weight[common], t.squares[common]) for t in (found, two)
    ]
    within(*part)


def test_where_the_angle_falls_shared_paths_agree_with_own(layers):
    falling = S3.layers(FALLING)
    paths = walk(falling, jax.random.key(7))
    within(
        tally.collect(paths, falling, falling),
        tally.collect(paths, falling, falling, own_only=True),
    )
    hero, sums = np.asarray(paths.hero), np.asarray(paths.sums, float)
    for i, theta_0 in enumerate(np.asarray(falling.theta_0, float)):
        mine = sums[(hero == i) & (np.asarray(paths.escaped) > 0)]
        hits, bent = mine[:, walker.HITS].sum(axis=1), mine[:, walker.BENT]
        np.testing.assert_array_equal(mine[:, walker.STRAIGHT], (hits > 0) & (bent == 0))
        assert np.all(bent[hits == 0] == 0)
        if theta_0 == 0:
            assert np.all(bent == 0)
        else:
            # nearly a gamma law of shape 2, which refuses 0.8 % of the angles at 5 degrees
            mean = bent.sum() / hits.sum()
            error = theta_0 * math.sqrt(2.0 / hits.sum())
            assert abs(mean / (2.0 * theta_0) - 1.0) < 0.02 + 4 * error / theta_0


def test_node_shares_are_exact_for_parabolas(dtype):
    theta_0 = jnp.asarray(scattering.melanosome_angle(np.linspace(700, 1400, 50)), dtype)
    shares = np.asarray(walker.node_shares(theta_0), float)

    def place(angle):
        return np.arcsinh(np.asarray(angle, float) / walker.EASE)

    for power in range(3):
        exact = place(theta_0) ** power
        np.testing.assert_allclose(
            place(walker.NODES) ** power @ shares, exact, rtol=1e-4, atol=2e-5
        )
    assert np.abs(shares).sum(axis=0).max() < 1.5


def test_no_wavelength_depends_on_the_rays_of_one_node_but_those_at_its_ends(dtype):
    theta_0 = jnp.asarray(scattering.melanosome_angle(np.linspace(790.0, 1250.0, 93)), dtype)
    assert np.asarray(walker.node_shares(theta_0)).max() < 0.93
    ends = walker.node_shares(jnp.asarray([0.0, scattering.LATIMER_ANGLE], dtype))
    np.testing.assert_array_equal(ends, np.eye(len(walker.NODES))[:, [0, -1]])


def test_what_nodes_change_is_small():
    from hylios_fit import adding

    between = np.sqrt(0.5 * (walker.NODES[1:] ** 2 + walker.NODES[:-1] ** 2))
    theta_0 = np.sort(np.concatenate([walker.NODES, between]))
    at = np.searchsorted(theta_0, walker.NODES)
    for name, nm in (("S1", 1250.0), ("S4", 800.0)):
        medium = Specimen.preset(name).layers(np.full(theta_0.size, nm))
        exact = np.asarray(
            adding.skin(medium._replace(theta_0=jnp.asarray(theta_0, jnp.float32))).reflectance
        )
        mixed = exact[at] @ np.asarray(walker.node_shares(jnp.asarray(theta_0)), float)
        assert np.abs(mixed - exact).max() < 0.001
        assert np.ptp(exact) > 50 * np.abs(mixed - exact).max()


def test_rays_that_live_long_set_out_first(layers):
    heroes = np.array([0, 1, 2, 3, 0, 1, 2, 3, 1, 1])
    order = walker._longest_first(walker._medium(layers, "complex", 1.0), heroes[:8], 10)
    # 550 nm loses least, then 420; water takes all at 1450 nm
    assert sorted(order.tolist()) == list(range(10))
    assert order[:2].tolist() == [2, 6]
    assert order[8:].tolist() == [8, 9]  # not sent


def test_heroes_are_spread_as_stated():
    theta_0 = S3.layers(FALLING).theta_0
    shares = np.asarray(walker.hero_shares(theta_0))
    assert shares.sum() == pytest.approx(1.0)
    bits = jax.random.bits(jax.random.key(8), (2,), jnp.uint32)
    for first, rays in ((0, 1000), (1000, 1000)):
        heroes = walker.spread(walker.hero_shares(theta_0), bits, first, rays)
        found = np.bincount(heroes, minlength=4) / rays
        np.testing.assert_allclose(found, shares, atol=5e-3)


@pytest.mark.parametrize("absorb", [0.5, 0.1])
def test_where_absorption_is_counted_changes_nothing(absorb, found, layers):
    paths = walk(layers, jax.random.key(9), absorb=absorb)
    two = tally.collect(paths, layers, layers, absorb)
    within(found, two)
    assert np.asarray(paths.escaped).sum() > 1.2 * RAYS * float(np.mean(found.mean))


@pytest.mark.parametrize("rays", [1, 100, 1000, 3000])
def test_any_number_of_rays_can_be_summed(rays, paths, layers):
    some = walker.Paths(*(part[:rays] for part in paths))
    found = tally.collect(some, layers, layers)
    weights = np.asarray(tally._weights(tally._weigher(layers, layers, 1.0, None), some), float)
    np.testing.assert_allclose(found.mean, weights.mean(axis=0), rtol=1e-4, atol=1e-7)
    group = -(-rays // int(found.groups))
    if group == 1:
        some = (weights**2).sum(axis=0)
        effective = weights.sum(axis=0) ** 2 / np.maximum(some, 1e-30)
        given = np.where(some > 0, found.effective_rays, 0.0)
        rtol = 1e-3 + (1.0 / (rays - 1) if rays > 1 else 0.0)  # the error is of rays - 1
        np.testing.assert_allclose(given, effective, rtol=rtol)
    sums = [weights[i : i + group].sum(axis=0) for i in range(0, rays, group)]
    counts = np.array([len(weights[i : i + group]) for i in range(0, rays, group)])
    assert len(sums) == int(found.groups)
    squares = (np.array(sums) ** 2 / counts[:, None]).sum(axis=0)
    np.testing.assert_allclose(found.squares, squares, rtol=1e-4, atol=1e-7)
    if rays >= 1000:
        error = np.sqrt(weights.var(axis=0) / rays)
        assert np.all(np.abs(np.asarray(found.standard_error) / error - 1.0) < 0.35)


def test_the_error_falls_as_the_square_root_of_the_rays(found, layers):
    total = found
    for i in range(1, 8):
        paths = walk(layers, jax.random.key(1), first=i * RAYS)
        total = tally.add(total, tally.collect(paths, layers, layers))
    assert float(total.rays) == 8 * RAYS
    ratio = np.asarray(found.standard_error) / np.asarray(total.standard_error)
    np.testing.assert_allclose(ratio, math.sqrt(8), rtol=0.25)
    within(found, total)


def test_the_same_key_gives_the_same_paths(paths, layers):
    again = walk(layers, jax.random.key(1))
    for one, two in zip(paths, again, strict=True):
        np.testing.assert_array_equal(one, two)
    other = walk(layers, jax.random.key(10))
    assert not np.array_equal(paths.sums, other.sums)
    later = walk(layers, jax.random.key(1), first=RAYS)
    assert not np.array_equal(paths.sums, later.sums)


def test_of_a_pilot_the_first_rays_set_out(paths, layers):
    few = walk(layers, jax.random.key(1), sent=100)
    np.testing.assert_array_equal(few.hero[:100], paths.hero[:100])
    assert not np.asarray(few.hero)[100:].any()
    assert np.asarray(few.sums)[:100].any(axis=1).all()
    assert not np.asarray(few.sums)[100:].any()
    assert not np.asarray(few.escaped)[100:].any()


@pytest.mark.parametrize("many", [walker.MANY, 0])
def test_both_precisions_agree(found, monkeypatch, many):
    monkeypatch.setattr(walker, "MANY", many)
    with jax.enable_x64(True):
        layers = S3.layers(NM, jnp.float64)
        paths = walk(layers, jax.random.key(11))
        double = tally.collect(paths, layers, layers)
        assert double.mean.dtype == jnp.float64
        within(found, double)
        alone = tally.collect(paths, layers, layers, own_only=True)
        within(double, alone)


def test_weights_in_single_precision_are_those_in_double(paths, layers, found):
    with jax.enable_x64(True):
        wide = walker.Paths(
            jnp.asarray(np.asarray(paths.sums), jnp.float64),
            jnp.asarray(np.asarray(paths.escaped), jnp.float64),
            jnp.asarray(np.asarray(paths.hero)),
            jnp.asarray(np.asarray(paths.end)),
        )
        layers = S3.layers(NM, jnp.float64)
        double = tally.collect(wide, layers, layers)
    np.testing.assert_allclose(found.mean, double.mean, rtol=2e-3)


def test_steps_among_particles_change_no_path_but_its_draws(monkeypatch):
    layers = Specimen.preset("S4").layers(np.array([500.0, 800.0, 1000.0]))
    met = np.asarray(layers.mu_particle * layers.thickness[:, None])[1:4].sum(axis=0)
    assert met.mean() > walker.MANY
    among = walk(layers, jax.random.key(13), "dispersed")
    monkeypatch.setattr(walker, "STEPS_AMONG_MANY", walker.STEPS)
    plain = walk(layers, jax.random.key(14), "dispersed")
    for column in range(3):
        z = []
        # but for how hits steered a ray, which plain steps do not look at
        for quantity in (lambda p: p.sums[:, : walker.STEERED], lambda p: p.escaped):
            one, two = (
                np.asarray(quantity(p), float)[np.asarray(p.hero) == column] for p in (among, plain)
            )
            error = np.hypot(one.std(axis=0) / len(one) ** 0.5, two.std(axis=0) / len(two) ** 0.5)
            z.append(np.ravel((one.mean(axis=0) - two.mean(axis=0)) / np.maximum(error, 1e-12)))
        assert np.abs(np.concatenate(z)).max() < 4.5
        # and what ended them
        counts = [
            np.bincount(np.asarray(p.end)[np.asarray(p.hero) == column], minlength=walker.ENDS)
            for p in (among, plain)
        ]
        seen = np.sum(counts, axis=0) > 20
        assert stats.chi2_contingency(np.array(counts)[:, seen])[1] > 1e-4


# --- columns that serve a spectrum ---------------------------------------------------------------


@pytest.fixture(scope="module")
def spectrum():
    return S3.layers(SPECTRUM)


def test_a_plan_is_a_mixture_that_reaches_every_wavelength(spectrum):
    plan = walker.plan(spectrum)
    shares = np.asarray(plan.shares, float)
    assert shares.sum() == pytest.approx(1.0, abs=1e-5)
    assert len(shares) == sum(walker.COLUMNS) == plan.layers.mu_a.shape[1]
    of_node = np.add.reduceat(shares, np.cumsum((0, *walker.COLUMNS[:-1])))
    needed = np.asarray(walker.node_shares(spectrum.theta_0)).max(axis=1) > 0
    assert np.all(of_node[needed] > 0.02)
    # less absorption than any wavelength has, so that no weight can grow without a bound
    assert np.all(np.asarray(plan.layers.mu_a).max(axis=1) <= np.asarray(spectrum.mu_a).max(axis=1))
    visible = walker.plan(S3.layers(NM[:3]))
    assert np.asarray(visible.shares)[: -walker.COLUMNS[-1]].sum() == 0
    assert visible.layers.mu_a.shape == plan.layers.mu_a.shape


def test_a_plan_gives_what_each_wavelengths_own_rays_give_with_a_smaller_error(spectrum):
    own = tally.collect(walk(spectrum, jax.random.key(20)), spectrum, spectrum, own_only=True)
    plan = walker.plan(spectrum)
    paths = walk(plan.layers, jax.random.key(21), shares=plan.shares)
    first = tally.collect(paths, plan.layers, spectrum, shares=plan.shares)
    better, _ = tally.improve(paths, plan, spectrum)
    assert np.asarray(better.shares).sum() == pytest.approx(1.0, abs=1e-5)
    assert np.all(np.asarray(better.shares) >= 0)
    paths = walk(better.layers, jax.random.key(22), shares=better.shares)
    second = tally.collect(paths, better.layers, spectrum, shares=better.shares)
    within(first, second)
    largest = [float(np.max(t.standard_error)) for t in (own, first, second)]
    assert largest[0] > 1.5 * largest[1] > 1.5 * largest[2]
    known = np.asarray(own.effective_rays) > 20  # with a few rays alone an error says little
    assert known.sum() > 15
    for one in (first, second):
        spread = np.hypot(np.asarray(one.standard_error), np.asarray(own.standard_error))
        z = (np.asarray(one.mean) - np.asarray(own.mean))[known] / spread[known]
        assert np.all(np.abs(z) < 4.5)
        assert stats.chi2.sf(np.sum(z**2), z.size) > 1e-4


def test_a_pilot_without_light_plans_as_before(spectrum):
    plan = walker.plan(spectrum)
    paths = walk(plan.layers, jax.random.key(21), shares=plan.shares)
    same, variance = tally.improve(paths._replace(escaped=0.0 * paths.escaped), plan, spectrum)
    np.testing.assert_array_equal(same.shares, plan.shares)
    assert variance == 0


def several(plan, key, form="complex", lots=4, independent=False):
    """The paths of a few walks that begin where the one before ended."""
    more = {"shares": plan.shares, "independent": independent}
    found = [walk(plan.layers, key, form, first=i * RAYS, **more) for i in range(lots)]
    return walker.Paths(*(jnp.concatenate(part) for part in zip(*found, strict=True)))


def test_a_plan_of_part_of_a_spectrum_knows_nothing_of_what_it_lacks(spectrum):
    plan = walker.plan(S3.layers(NM[:3]))
    paths = walk(plan.layers, jax.random.key(29), shares=plan.shares)
    sums = tally._sums(
        tally._weigher(plan.layers, spectrum, 1.0, plan.shares, ended=True), paths, jnp.int32(RAYS)
    )[0]
    columns, beyond = sum(walker.COLUMNS), np.asarray(sums.beyond)
    assert beyond.shape[1] == columns + 3 * len(walker.NODES)
    assert np.all(np.isfinite(beyond))
    lacking = np.asarray(plan.shares) == 0
    assert not np.any(beyond[:, :columns][:, lacking])
    by_node = beyond[:, columns:].reshape(-1, 3, len(walker.NODES))
    assert not np.any(by_node[:, :, :-1])
    assert np.all(by_node[:, [0, 2], -1] != 0)


def test_what_ends_at_the_bottom_takes_back_what_the_sums_have_of_it():
    for bottom in (0.0, 1e-9, 0.3, 1.0):
        layers = S3.replace(bottom_reflectance=bottom).layers(NM)
        for absorb in (0.4, 1.0, 2.0):
            there = walker.log_density(layers, absorb)[walker.BOTTOM]
            gone = np.exp(np.asarray(there + walker.end_density(layers, absorb)[-1], float))
            np.testing.assert_allclose(gone, 1.0 - bottom**absorb, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "form", "bottom", "independent"),
    [
        ("S3", "complex", 0.7, False),
        ("S4", "dispersed", 0.7, False),
        ("S1", "complex", 0.0, False),
        ("S4", "dispersed", 1.0, True),
    ],
)
def test_what_is_known_of_all_paths_is_so(name, form, bottom, independent):
    specimen = Specimen.preset(name).replace(bottom_reflectance=bottom, reticular_scattering=5.0)
    plan = walker.plan(specimen.layers(SPECTRUM))
    paths = several(plan, jax.random.key(24), form, independent=independent)
    weigher = tally._weigher(plan.layers, plan.layers, 1.0, plan.shares, ended=True)
    told = weigher.told
    assert told is not None
    shares = np.asarray(plan.shares, float)
    density = np.asarray(tally._mixed(weigher, paths)[1], float) / shares
    error = density.std(axis=0) / math.sqrt(len(density))
    z = (density.mean(axis=0) - 1.0) / error
    assert np.all(error < 0.05)
    assert np.abs(z).max() < 4
    # what a ray is turned up by chance adds up to nothing, under every column; and the densities
    # under columns that absorb twice as much, which no ray walks for, to one as well
    of = np.asarray(paths.sums, float)[:, walker.LIFT]
    lift = of[:, None] * density
    assert of.std() > 0.3
    assert np.abs(lift.mean(axis=0) / lift.std(axis=0)).max() * math.sqrt(len(of)) < 4
    steered, met = np.asarray(paths.sums, float)[:, [walker.STEERED, walker.MET]].T
    bend = np.asarray(plan.layers.theta_0) > 0
    if walker._rhythm(walker._medium(plan.layers, form, 1.0)) != walker.STEPS:
        lost = np.asarray(told.lost_cosine, float)[bend]
        hits = (steered[:, None] + lost * met[:, None]) * density[:, bend]
        assert np.abs(hits.mean(axis=0) / hits.std(axis=0)).max() * math.sqrt(len(of)) < 4
        less = (steered[:, None] + 0.7 * lost * met[:, None]) * density[:, bend]
        assert np.abs(less.mean(axis=0) / less.std(axis=0)).max() * math.sqrt(len(of)) > 10
    else:  # with few particles nobody looks
        assert form == "complex"
        assert not np.any(np.stack([steered, met]))
    log = np.asarray(tally._mixed(weigher, paths)[0], float)
    darker = np.asarray(tally._under(paths, told.darker), float)
    darker = np.exp(darker - log[:, None])
    off = (darker.mean(axis=0) - 1.0) / darker.std(axis=0) * math.sqrt(len(of))
    assert np.abs(off).max() < 4
    if bottom != 0.7:
        return
    # every way to end was met, and without what they are the sum is another
    assert np.all(np.bincount(np.asarray(paths.end), minlength=walker.ENDS)[[0, 1, 4, 5, 9, 10]])
    without = weigher._replace(walked=weigher.walked[: walker.SUMS])
    bare = np.asarray(tally._mixed(without, paths)[1], float) / shares
    assert np.abs((bare.mean(axis=0) - 1.0) / error).max() > 6


def test_what_is_known_makes_errors_smaller_and_changes_no_mean(spectrum):
    plan = walker.plan(spectrum)
    steady, error, raw, raw_error = [], [], [], []
    for number in range(12):
        paths = several(plan, jax.random.key(40 + number))
        found = tally.collect(paths, plan.layers, spectrum, shares=plan.shares)
        steady.append(found.mean)
        error.append(found.standard_error)
        mean, covariance = tally.moments(paths, plan.layers, 1.0, spectrum, plan.shares)
        raw.append(mean)
        raw_error.append(np.sqrt(np.diag(covariance)))
    steady, error, raw, raw_error = (np.array(x, float) for x in (steady, error, raw, raw_error))
    off = steady - raw
    z = off.mean(axis=0) / (off.std(axis=0, ddof=1) / math.sqrt(len(off)))
    assert np.abs(z).max() < 6  # of Student's t with 11 degrees of freedom
    variance = np.mean(error**2, axis=0) / np.mean(raw_error**2, axis=0)
    # to learn 45 numbers (hits steer nothing here) from 448 groups costs a ninth where they tell
    # nothing
    assert variance.max() < 1.2
    assert np.mean(variance[(SPECTRUM > 750) & (SPECTRUM < 1200)]) < 0.6
    # the errors are those that repeated walks show
    scatter = np.var(steady, axis=0, ddof=1) / np.mean(error**2, axis=0)
    assert 0.7 < scatter.mean() < 1.4


def test_lots_are_steadied_by_what_all_of_them_tell(spectrum):
    plan = walker.plan(spectrum)
    paths = several(plan, jax.random.key(26), lots=8)
    many = paths.hero.shape[0]
    assert many - many // tally.FOLDS >= tally.ENOUGH
    at_once = tally.collect(paths, plan.layers, spectrum, shares=plan.shares)
    whole = tally.gather(paths, plan.layers, spectrum, shares=plan.shares)
    told = tally.tell(whole)
    for one, two in zip(at_once, told, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-5)
    sums = None
    for part in (slice(0, 6 * many // 8), slice(6 * many // 8, many)):  # neither is enough alone
        sent = part.stop - part.start
        room = walker.Paths(
            *(jnp.pad(x[part], [(0, many - sent)] + [(0, 0)] * (x.ndim - 1)) for x in paths)
        )
        sums = tally.add(
            sums, tally.gather(room, plan.layers, spectrum, shares=plan.shares, sent=sent)
        )
    apart = tally.tell(sums)
    assert apart.rays == at_once.rays
    assert apart.groups == at_once.groups
    for one, two in ((sums.weight, whole.weight), (sums.squares, whole.squares)):
        np.testing.assert_allclose(one.sum(axis=0), two.sum(axis=0), rtol=1e-4)
    ratio = np.asarray(apart.standard_error) / np.asarray(at_once.standard_error)
    bright = np.asarray(at_once.mean) > 0.05
    assert np.abs(ratio[bright] - 1).max() < 0.05
    # other folds, the same rays: much nearer than two walks are
    z = (np.asarray(apart.mean) - np.asarray(at_once.mean)) / np.asarray(at_once.standard_error)
    assert np.abs(z[bright]).max() < 0.3


def test_slopes_are_of_what_the_columns_leave(spectrum):
    with jax.enable_x64(True):
        layers = jax.tree.map(lambda x: jnp.asarray(np.asarray(x, float)), spectrum)
        plan = walker.plan(layers)
        paths = several(plan, jax.random.key(25))

        def mean(step):
            asked = layers._replace(mu_a=layers.mu_a * (1.0 + step))
            return tally.collect(paths, plan.layers, asked, shares=plan.shares).mean

        _, slope = jax.jvp(mean, (0.0,), (1.0,))
        difference = (mean(1e-4) - mean(-1e-4)) / 2e-4
        np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-9)


def test_covariance_of_a_plan_has_the_mean_and_the_errors_of_its_tally(spectrum):
    plan = walker.plan(spectrum)
    paths = walk(plan.layers, jax.random.key(23), shares=plan.shares)
    mean, covariance = tally.moments(paths, plan.layers, 1.0, spectrum, plan.shares)
    found = tally.collect(paths, plan.layers, spectrum, shares=plan.shares)
    np.testing.assert_allclose(mean, found.mean, rtol=1e-4)
    # one from columns, one from 256 groups of rays, which know an error to 4.4 %
    ratio = np.sqrt(np.diag(covariance)) / np.asarray(found.standard_error)
    assert np.abs(ratio - 1).max() < 0.18
    assert abs(ratio.mean() - 1) < 0.04


def test_sine_and_cosine_by_polynomials():
    half = jnp.linspace(-math.pi / 2, math.pi / 2, 10_001, dtype=jnp.float32)
    cos, sin = (np.asarray(x, float) for x in walker._cos_sin(half))
    exact = 2.0 * np.asarray(half, float)
    np.testing.assert_allclose(cos, np.cos(exact), atol=1e-6)
    np.testing.assert_allclose(sin, np.sin(exact), atol=1e-6)
    small = np.abs(exact) < 0.1  # a small angle keeps its relative precision
    np.testing.assert_allclose(sin[small], np.sin(exact[small]), rtol=1e-6)


# --- other contents from the same paths ----------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"blood_papillary": 0.45, "blood_reticular": 0.2},
        {"eumelanin": 40.0},
        {"melanosome_basale": 3.15},
        {"water": 0.8, "oxygen_saturation": 0.3},
    ],
)
def test_reweighting_agrees_with_a_fresh_walk(changes, paths, layers, found):
    asked = S3.replace(**changes).layers(NM)
    moved = tally.collect(paths, layers, asked)
    fresh = tally.collect(walk(asked, jax.random.key(12)), asked, asked)
    within(moved, fresh)
    assert np.abs(np.asarray(moved.mean) / np.asarray(found.mean) - 1).max() > 2e-3


@pytest.mark.parametrize("name", ["blood_papillary", "melanosome_basale", "bottom_reflectance"])
def test_gradients_are_those_of_the_same_paths(name, paths):
    with jax.enable_x64(True):
        wide = walker.Paths(
            jnp.asarray(np.asarray(paths.sums), jnp.float64),
            jnp.asarray(np.asarray(paths.escaped), jnp.float64),
            jnp.asarray(np.asarray(paths.hero)),
            jnp.asarray(np.asarray(paths.end)),
        )
        start = S3.replace(bottom_reflectance=0.9)
        walked = start.layers(NM, jnp.float64)

        def mean(value):
            asked = skin.layers({**start.values, name: value}, "complex", NM, jnp.float64)
            return tally.collect(wide, walked, asked).mean

        here = start.values[name]
        slope = jax.jacfwd(mean)(jnp.asarray(here))
        total = jax.grad(lambda v: jnp.sum(mean(v)))(jnp.asarray(here))
        h = 1e-4 * here
        finite = (mean(jnp.asarray(here + h)) - mean(jnp.asarray(here - h))) / (2 * h)
        np.testing.assert_allclose(slope, finite, rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(total, jnp.sum(finite), rtol=1e-5)
        assert np.abs(slope).max() > 1e-4


def test_the_standard_errors_are_honest(paths, layers):
    lots = 32
    size = RAYS // lots
    means, errors = [], []
    for i in range(lots):
        part = walker.Paths(*(x[i * size : (i + 1) * size] for x in paths))
        one = tally.collect(part, layers, layers)
        means.append(np.asarray(one.mean, float))
        errors.append(np.asarray(one.standard_error, float))
    means, errors = np.array(means), np.array(errors)
    # the spread of the lots over the error that they state, pooled so that it is well known
    ratio = means.var(axis=0, ddof=1) / (errors**2).mean(axis=0)
    high = stats.chi2.ppf(1 - 1e-4, lots - 1) / (lots - 1)
    low = stats.chi2.ppf(1e-4, lots - 1) / (lots - 1)
    # wavelengths take turns, which makes the spread a little smaller than stated, never larger
    assert np.all(ratio < high), ratio
    assert np.all(ratio > 0.7 * low), ratio


# --- the slow witnesses --------------------------------------------------------------------------


def test_the_walk_agrees_with_a_literal_one_without_melanosomes():
    specimen = S3.replace(melanosome_basale=0, colloidal_melanin=0.5, roughness=0.3)
    layers = specimen.layers(NM)
    found = tally.collect(walk(layers, jax.random.key(13)), layers, layers)
    rng = np.random.default_rng(6)
    surface = fresnel.surface_reflectance(math.radians(8), 1.0, 1.55, 0.3)
    rays = 2000
    for i in (1, 2):
        arguments = (
            np.asarray(layers.thickness, float),
            np.asarray(layers.index, float)[:, i],
            np.asarray(layers.mu_a, float)[:, i],
            float(layers.mu_fibre[i]),
        )
        fates = [
            reference.skin_walk(rng, *arguments, 1.0, 0.3, math.radians(8)) for _ in range(rays)
        ]
        share = fates.count("out") / rays
        mean, error = float(found.mean[i]), float(found.standard_error[i])
        spread = math.hypot((1 - surface) * error, math.sqrt(share * (1 - share) / rays))
        assert 0.05 < share < 0.95
        assert abs(share - (1 - surface) * mean) < 4 * spread
        top = fates.count("top") / rays
        assert abs(top - surface) < 4 * math.sqrt(surface * (1 - surface) / rays)


@pytest.mark.parametrize(("preset", "alone"), [("S3", False), ("S1", True)])
def test_the_walk_agrees_with_the_paper_to_the_letter(preset, alone):
    specimen = Specimen.preset(preset)
    layers = specimen.layers(NM)
    melanin = skin.melanin_coefficient(specimen.values, NM)
    paths = walk(layers, jax.random.key(14), independent=alone)
    found = tally.collect(paths, layers, layers)
    surface = fresnel.surface_reflectance(math.radians(8), 1.0, 1.55, specimen.roughness)
    rays = 4096
    total = 0.0
    for i in range(len(NM)):
        inside, top = analog.trace(
            layers, melanin, "complex", i, jax.random.key(15), rays, independent=alone
        )
        expected = (1 - surface) * float(found.mean[i])
        error = (1 - surface) * float(found.standard_error[i])
        variance = expected * (1 - expected) / rays + error**2
        total += (inside / rays - expected) ** 2 / variance
        assert abs(top / rays - surface) < 4 * math.sqrt(surface * (1 - surface) / rays)
    assert stats.chi2.sf(total, len(NM)) > 1e-4


def test_the_literal_walk_returns_all_light_that_nothing_absorbs():
    clear = without_absorption(S3.layers(NM))
    none = jnp.zeros(len(NM), jnp.float32)
    inside, top = analog.trace(clear, none, "complex", 1, jax.random.key(16), 256)
    assert inside + top == 256
    assert inside > 200
