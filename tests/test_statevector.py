"""State vector: transforms, priors, conditioning, derived quantities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_surrogate import LOWER, NAMES, UPPER

from hylios_fit import statevector
from hylios_fit.errors import HyliosError

VECTOR = statevector.state_vector(NAMES, LOWER, UPPER)


@pytest.fixture(scope="module")
def draws():
    return VECTOR.prior_draws(jax.random.key(1), 20_000)


def test_prior_draws_lie_inside_the_box(draws):
    assert np.all(draws >= LOWER)
    assert np.all(draws <= UPPER)


def test_the_farthest_states_lie_inside_the_box_in_both_precisions(dtype):
    for value in (-1e3, -30.0, 30.0, 1e3):
        state = jnp.full(len(NAMES), value, dtype)
        parameters = np.asarray(VECTOR.parameters(state))
        assert np.all(parameters >= LOWER.astype(dtype))
        assert np.all(parameters <= UPPER.astype(dtype))


def test_state_and_parameters_are_inverse(x64, draws):
    some = draws[:500]
    again = np.asarray(jax.vmap(VECTOR.parameters)(jnp.asarray(VECTOR.state(some))))
    np.testing.assert_allclose(again, some, rtol=1e-9)


def test_parameters_take_any_leading_shape(x64):
    states = np.random.default_rng(0).standard_normal((3, 4, len(NAMES)))
    whole = np.asarray(VECTOR.parameters(jnp.asarray(states)))
    assert whole.shape == states.shape
    np.testing.assert_array_equal(whole[2, 1], VECTOR.parameters(jnp.asarray(states[2, 1])))


def test_jacobian_agrees_with_differences_and_has_no_dead_corner(x64):
    generator = np.random.default_rng(3)
    for z in (np.zeros(11), 2.5 * generator.standard_normal(11), np.full(11, -3.0)):
        jacobian = np.asarray(jax.jacfwd(VECTOR.parameters)(jnp.asarray(z)))
        step = 1e-6
        for j in range(11):
            shift = step * np.eye(11)[j]
            up, down = (np.asarray(VECTOR.parameters(jnp.asarray(z + s))) for s in (shift, -shift))
            np.testing.assert_allclose(jacobian[:, j], (up - down) / (2 * step), atol=2e-7)
        assert np.all(np.diag(jacobian @ np.linalg.inv(VECTOR.factor)) > 0.0)


def test_prior_medians_and_spreads_are_those_declared(draws):
    for name, column in zip(NAMES, draws.T, strict=True):
        prior = statevector.PRIORS[name]
        assert np.median(column) == pytest.approx(prior.median, rel=0.05)
        f = column if prior.offset is None else np.log(column + prior.offset)
        # The edges of the box press the tails together, so that the spread stays below the slope.
        assert 0.75 * prior.sd < f.std() < 1.05 * prior.sd


def test_every_prior_names_its_source():
    assert all(prior.source for prior in statevector.PRIORS.values())


def test_prior_of_melanin_spans_the_lightest_to_the_darkest(draws):
    melanin = statevector.derived(NAMES, draws)["melanin_mg_per_mL"]
    low, high = np.quantile(melanin, [0.0228, 0.9772])
    assert low < 0.3
    assert high > 12.5
    # S4 of Table I has 13.5 mg/mL: within the 2.5 sd of such a prior.
    assert np.mean(melanin > 13.5) > 0.006


def test_table_i_lies_within_the_prior():
    """The four specimens of the paper, where its zeros are 0.05 %, within chi-square's 99 %."""
    specimens = [
        [1, 1, 1, 0.8, 90, 4, 0.2, 0.2, 0.75, 1, 1],
        [0.05, 0.05, 3.75, 1.25, 50, 2, 0.7, 0.7, 0.75, 1, 1],
        [0.05, 0.05, 3, 1.35, 32, 2, 0.3, 0.3, 0.75, 1, 1],
        [10, 10, 10, 15, 50, 4, 2.5, 2.5, 0.75, 1, 1],
    ]
    assert np.all(np.sum(VECTOR.state(np.array(specimens)) ** 2, axis=1) < 24.7)


def test_prior_states_are_white(draws):
    states = VECTOR.state(draws)
    np.testing.assert_allclose(states.mean(axis=0), 0.0, atol=0.03)
    np.testing.assert_allclose(np.cov(states.T), np.eye(11), atol=0.04)


def test_dark_in_one_stratum_is_dark_in_the_others():
    correlation = statevector.prior_correlation(NAMES)
    assert np.all(correlation[:4, :4] > 0.5)
    assert np.all(correlation[:4, 4:] == 0.0)
    assert np.linalg.eigvalsh(correlation)[0] > 0.1


def test_derived_quantities_are_the_documented_means():
    p = np.array([1.0, 2.0, 6.0, 0.5, 50.0, 5.0, 3.0, 0.6, 0.7, 0.9, 1.0])
    quantities = statevector.derived(NAMES, p)
    assert quantities["melanin_mg_per_mL"] == pytest.approx((3.0 + 0.5) / 100 * 55)
    assert quantities["blood_percent"] == pytest.approx((0.02 * 3.0 + 0.1 * 0.6) / 0.12)
    assert quantities["oxygen_saturation"] == 0.7
    assert quantities["water_percent"] == pytest.approx(75 * 0.9)
    assert set(statevector.derived(("water",), np.array([1.0]))) == {"water_percent"}


def test_held_values_are_kept_and_the_prior_is_conditioned_on_them():
    dark = statevector.state_vector(NAMES, LOWER, UPPER, fix={"melanosome_basale": 9.0})
    draws = dark.prior_draws(jax.random.key(2), 4000)
    assert np.all(draws[:, 2] == 9.0)
    assert "melanosome_basale" not in dark.free
    # Conditioning equals picking from the whole prior, here those draws near the held value.
    whole = VECTOR.prior_draws(jax.random.key(3), 200_000)
    near = whole[np.abs(whole[:, 2] - 9.0) < 0.2]
    assert np.median(draws[:, 0]) == pytest.approx(np.median(near[:, 0]), rel=0.06)
    assert np.median(draws[:, 4]) == pytest.approx(np.median(near[:, 4]), rel=0.06)


def test_within_ranges_all_is_as_likely_whatever_the_rest_is(draws):
    ranges = {"melanosome_basale": (2.0, 6.0), "blood_papillary": (0.05, 5.0)}
    fixed = {"melanosome_granulosum": 0.01}
    vector = statevector.state_vector(NAMES, LOWER, UPPER, fix=fixed, ranges=ranges)
    some = dict(zip(NAMES, vector.prior_draws(jax.random.key(2), 20_000).T, strict=True))
    linear = (some["melanosome_basale"] - 2.0) / 4.0
    orders = np.log(some["blood_papillary"] / 0.05) / np.log(100.0)
    for share in (linear, orders):
        assert np.all((share >= 0.0) & (share <= 1.0))
        at = np.linspace(0.05, 0.95, 19)
        np.testing.assert_allclose([np.mean(share < x) for x in at], at, atol=0.02)
    # nothing is known of them from the others, nor of the others from them
    assert abs(np.corrcoef(linear, some["colloidal_melanin"])[0, 1]) < 0.03
    assert abs(np.corrcoef(orders, some["blood_reticular"])[0, 1]) < 0.03
    elsewhere = draws[:, NAMES.index("blood_reticular")]
    assert np.median(some["blood_reticular"]) == pytest.approx(np.median(elsewhere), rel=0.05)
    for ranges, says in (
        ({"water": (0.1, 1.0)}, r"water = 0.1 is outside the surrogate's range 0\.\d+ to"),
        ({"water": (1.0, 1.0)}, "water from 1 to 1: expected two rising values"),
        ({"colour": (0.0, 1.0)}, "colour from 0 to 1: expected two rising values of one that is"),
        ({"melanosome_granulosum": (1.0, 2.0)}, "of one that is free"),
    ):
        with pytest.raises(HyliosError, match=says):
            statevector.state_vector(NAMES, LOWER, UPPER, fix=fixed, ranges=ranges)


def test_what_is_not_free_stays_at_the_median_without_conditioning():
    only = statevector.state_vector(NAMES, LOWER, UPPER, free=["water", "melanosome_basale"])
    assert only.free == ("melanosome_basale", "water")  # the declared order, not the caller's
    np.testing.assert_array_equal(only.mean, 0.0)
    np.testing.assert_array_equal(only.factor, np.eye(2))
    parameters = np.asarray(only.parameters(jnp.zeros(2)))
    medians = [statevector.PRIORS[name].median for name in NAMES]
    np.testing.assert_allclose(parameters, medians, rtol=1e-5)


def test_a_value_at_the_very_edge_can_be_held():
    vector = statevector.state_vector(
        NAMES, LOWER, UPPER, fix={"melanosome_granulosum": 0.0, "oxygen_saturation": 1.0}
    )
    assert np.all(np.isfinite(vector.mean))
    assert np.asarray(vector.parameters(jnp.zeros(9)))[0] == 0.0


def test_edge_share_runs_from_one_edge_to_the_other():
    for j in range(11):
        u = np.zeros(11)
        u[j] = 40.0
        z = np.linalg.solve(VECTOR.factor, u)
        assert VECTOR.edge_share(z)[j] > 0.999
        assert VECTOR.edge_share(-z)[j] < 0.001


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"free": ["melanin"]}, "unknown parameter 'melanin'; the surrogate knows: melanosome"),
        ({"fix": {"colour": 1.0}}, "unknown parameter 'colour'"),
        ({"fix": {"water": 1.4}}, "water = 1.4 is outside the surrogate's range 0.4 to 1.3"),
        ({"fix": {"water": float("nan")}}, "outside the surrogate's range"),
        ({"free": ["water"], "fix": {"water": 1.0}}, "both free and fixed: water"),
        ({"free": []}, "nothing is free"),
    ],
)
def test_what_cannot_be_is_refused(options, says):
    with pytest.raises(HyliosError, match=says):
        statevector.state_vector(NAMES, LOWER, UPPER, **options)


def test_a_parameter_without_prior_or_a_box_without_its_median_is_refused():
    with pytest.raises(HyliosError, match="no prior is declared for tattoo"):
        statevector.state_vector(["tattoo"], [0.0], [1.0])
    with pytest.raises(HyliosError, match=r"range of water does not hold the prior's median 0\.95"):
        statevector.state_vector(["water"], [1.0], [1.3])


def test_a_state_at_the_edge_is_refused():
    parameters = VECTOR.prior_draws(jax.random.key(0), 1)[0]
    parameters[9] = 1.3
    with pytest.raises(HyliosError, match="not inside the surrogate's range: water"):
        VECTOR.state(parameters)


def test_usual_stands_for_what_is_free_unless_said_otherwise():
    from hylios_fit import table
    from hylios_fit.skin import SPECS

    names = table.NAMES
    edges = [axis.lower for axis in table.DESIGN], [axis.upper for axis in table.DESIGN]
    usual = statevector.state_vector(names, *edges)
    assert usual.free == tuple(n for n in names if statevector.PRIORS[n].usual) == tuple(NAMES)
    more = statevector.state_vector(
        names, *edges, free=["usual", "bottom_reflectance"], fix={"water": 1.0}
    )
    assert set(more.free) == set(usual.free) - {"water"} | {"bottom_reflectance"}
    held = dict(zip(names, usual.held, strict=True))
    for name in names:
        if not statevector.PRIORS[name].usual:
            assert held[name] == pytest.approx(SPECS[name].default)
        else:
            assert held[name] == statevector.PRIORS[name].median


def test_quantities_are_means_by_the_thickness_that_was_asked_for():
    names = (*NAMES, "thickness_papillary", "thickness_reticular")
    p = dict.fromkeys(names, 1.0) | {"blood_papillary": 3.0, "blood_reticular": 1.0}
    p |= {"thickness_papillary": 0.1, "thickness_reticular": 0.1}
    found = statevector.derived(names, np.array(list(p.values())))
    assert found["blood_percent"] == pytest.approx(2.0)
