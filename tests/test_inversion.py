"""Inversion of spectra that the toy surrogate made, whose truth is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_surrogate import LOWER, NAMES, UPPER, ToyMember, ToySurrogate

from hylios_fit import inversion, statevector
from hylios_fit.errors import HyliosError
from hylios_fit.instrument import noise_covariance
from hylios_fit.results import QUANTITIES, Estimate, Fit, Outcome
from hylios_fit.skin import Specimen
from hylios_fit.spectra import Spectra, as_spectra
from hylios_fit.surrogate import load_surrogate

TOY = ToySurrogate()
VISIBLE = np.arange(400.0, 701.0, 10.0)
# As many bands as the visible has: one compiled program serves both.
WIDE = np.concatenate([np.linspace(400.0, 685.0, 20), np.linspace(760.0, 2480.0, 11)])
LIGHT = np.array([0.5, 0.6, 2.5, 1.0, 45.0, 2.5, 0.6, 0.8, 0.7, 0.95, 1.0])


def reflectance(parameters, wavelength, form="complex"):
    member = TOY.at(form).on(wavelength)
    with jax.enable_x64(True):
        return np.array(jax.vmap(member)(jnp.atleast_2d(jnp.asarray(parameters))))


def spectra_of(values, wavelength, problems=None):
    values = np.atleast_2d(values)
    names = tuple(f"s{i}" for i in range(len(values)))
    return Spectra(wavelength, names, values, problems or (None,) * len(values))


def one(values, wavelength=VISIBLE, **options):
    options.setdefault("noise", 0.003)
    return inversion.fit((wavelength, values), TOY, **options)


@pytest.fixture(scope="module")
def population():
    """200 specimens of the prior, either form, with the noise of measured skin; and their fits."""
    vector = statevector.state_vector(NAMES, LOWER, UPPER)
    truth = vector.prior_draws(jax.random.key(7), 200)
    generator = np.random.default_rng(7)
    forms = generator.integers(0, 2, len(truth))
    both = [reflectance(truth, WIDE, form) for form in TOY.forms]
    clean = np.where(forms[:, None] == 0, *both)
    error = TOY.at("complex").on(WIDE).error_covariance(None)
    measured = np.stack(
        [
            generator.multivariate_normal(spectrum, noise_covariance(WIDE, spectrum) + error)
            for spectrum in clean
        ]
    )
    fits = inversion.fit_many(spectra_of(measured, WIDE), TOY, progress=False)
    return truth, fits


def test_intervals_hold_their_share_of_the_truth(population):
    truth, fits = population
    known = statevector.derived(NAMES, truth) | dict(zip(NAMES, truth.T, strict=True))
    assert sum(fit.outcome.is_fitted for fit in fits) >= 198
    for name in fits[0].quantities:
        inside = [
            fit[name].low <= value <= fit[name].high
            for fit, value in zip(fits, known[name], strict=True)
        ]
        # 68 % of 200, within 2.4 binomial standard deviations for the four, 3.3 for all the others.
        slack = 0.08 if name in QUANTITIES else 0.11
        assert np.mean(inside) == pytest.approx(0.68, abs=slack), name


def test_what_the_data_tell_is_told_and_near_the_truth(population):
    truth, fits = population
    for name, value in statevector.derived(NAMES, truth).items():
        told = np.array([fit[name].informed for fit in fits])
        found = np.array([fit[name].value for fit in fits])
        assert told.mean() > 0.9, name
        assert np.corrcoef(np.log(found[told]), np.log(value[told]))[0, 1] > 0.9, name
    for name in ("eumelanin", "melanosome_granulosum"):
        # Only their product can be told.
        assert np.mean([fit[name].informed for fit in fits]) < 0.3, name


def test_reduced_chi2_is_one_on_average(population):
    reduced = np.array([fit.reduced_chi2 for fit in population[1]])
    assert reduced.mean() == pytest.approx(1.0, abs=0.05)


def test_a_fit_carries_all_that_it_promises():
    fit = one(reflectance(LIGHT, VISIBLE)[0])
    assert fit.outcome is Outcome.fitted
    assert list(fit.quantities)[:4] == list(QUANTITIES)
    assert set(fit.quantities) == {*QUANTITIES, *NAMES}
    assert fit.names == NAMES
    assert fit.residual_rms < 0.003
    np.testing.assert_allclose(fit.covariance, fit.covariance.T, rtol=1e-9)
    assert np.all(np.linalg.eigvalsh(fit.z_covariance) > 0.0)
    assert np.all(np.linalg.eigvalsh(fit.z_covariance) < 1.0 + 1e-9)
    error = TOY.at("complex").on(VISIBLE).error_covariance(None)
    np.testing.assert_allclose(fit.sd, np.sqrt(0.003**2 + np.diag(error)))
    np.testing.assert_allclose(fit.fitted, reflectance(fit.value, VISIBLE, fit.form)[0], atol=1e-9)
    assert sum(fit.form_probability.values()) == pytest.approx(1.0)
    assert fit.form_probability[fit.form] == max(fit.form_probability.values())
    assert fit.settings["noise"] == 0.003
    assert {"jax", "optimistix", "hylios_fit"} <= fit.settings["versions"].keys()
    with pytest.raises(ValueError, match="read-only"):
        fit.value[0] = 1.0
    with pytest.raises(HyliosError, match="no quantity 'melanin' in this fit; there are: melanin_"):
        fit["melanin"]
    with pytest.raises(TypeError):
        fit.quantities["x"] = None


def test_the_minimum_is_a_minimum():
    fit = one(reflectance(LIGHT, VISIBLE)[0] + 0.004 * np.sin(VISIBLE / 30.0), fix={
        "melanosome_form": "complex"})  # fmt: skip
    member = TOY.at("complex").on(VISIBLE)
    vector = statevector.state_vector(NAMES, LOWER, UPPER)
    precision = np.linalg.inv(fit.error_covariance)

    def objective(z):
        with jax.enable_x64(True):
            miss = fit.measured - np.asarray(member(vector.parameters(jnp.asarray(z))))
        return 0.5 * (miss @ precision @ miss + z @ z)

    lowest = objective(fit.z)
    generator = np.random.default_rng(0)
    scale = np.linalg.cholesky(fit.z_covariance)
    for _ in range(50):
        assert objective(fit.z + 0.3 * scale @ generator.standard_normal(11)) > lowest


def test_neighbours_do_not_matter():
    values = reflectance(np.stack([LIGHT, LIGHT * 0.9, LIGHT]), VISIBLE)
    values[1, 3:9] = np.nan
    together = inversion.fit_many(spectra_of(values, VISIBLE), TOY, noise=0.003, progress=False)
    alone = inversion.fit_many(spectra_of(values[2], VISIBLE), TOY, noise=0.003, progress=False)
    np.testing.assert_array_equal(together[2].z, alone[0].z)
    np.testing.assert_array_equal(together[2].covariance, alone[0].covariance)


def test_the_same_call_gives_the_same_bits_with_and_without_a_key(key):
    values = reflectance(LIGHT, VISIBLE)[0]
    np.testing.assert_array_equal(one(values).z, one(values).z)
    np.testing.assert_array_equal(one(values, key=key).z, one(values, key=key).z)
    # Other starts, the same minimum.
    np.testing.assert_allclose(one(values, key=key).z, one(values).z, atol=0.05)


def test_a_missing_band_is_as_if_it_were_not_there():
    values = reflectance(LIGHT, VISIBLE)[0] + 0.002 * np.cos(VISIBLE / 9.0)
    kept = np.ones(VISIBLE.size, dtype=bool)
    kept[[0, 7, 8, 30]] = False
    holes = np.where(kept, values, np.nan)
    masked, without = one(holes), one(values[kept], VISIBLE[kept])
    np.testing.assert_allclose(masked.z, without.z, atol=1e-4)
    np.testing.assert_allclose(masked.z_covariance, without.z_covariance, atol=1e-5)
    assert np.all(np.isfinite(masked.fitted))
    assert np.isnan(masked.residual[7])
    assert masked.reduced_chi2 == pytest.approx(without.reduced_chi2, rel=1e-3)


def test_holes_compile_nothing_anew():
    values = np.repeat(reflectance(LIGHT, VISIBLE), 4, axis=0)
    values[1, 2], values[2, 5:9] = np.nan, np.nan
    compiled = []

    class Counting(ToyMember):
        def __call__(self, parameters):
            compiled.append(1)  # runs while tracing only
            return super().__call__(parameters)

    class Surrogate(ToySurrogate):
        def at(self, form):
            return _as(Counting, super().at(form))

    def run(rows):
        compiled.clear()
        inversion.fit_many(spectra_of(rows, VISIBLE), Surrogate(), noise=0.003, progress=False)
        return len(compiled)

    assert run(values[:1]) > 0
    assert run(values) == 0


def _as(kind, member):
    class On(kind):
        def on(self, wavelength_nm):
            return _cast(kind, super().on(wavelength_nm))

    return _cast(On, member)


def _cast(kind, member):
    return kind(*(getattr(member, field) for field in member.__dataclass_fields__))


def test_bad_spectra_are_rows_and_the_rest_go_on():
    values = np.repeat(reflectance(LIGHT, VISIBLE), 4, axis=0)
    values[1] = np.nan
    values[2, :] = np.where(np.arange(VISIBLE.size) == 3, 0.4, np.nan)
    problems = (None, None, None, "text in line 7")
    fits = inversion.fit_many(
        spectra_of(values, VISIBLE, problems), TOY, noise=0.003, progress=False
    )
    assert [fit.spectrum for fit in fits] == ["s0", "s1", "s2", "s3"]
    assert [fit.outcome.code for fit in fits] == [
        "fitted", "unusable", "prior_dominated", "unusable",
    ]  # fmt: skip
    assert fits[1].messages == ("no band has a value",)
    assert fits[3].messages == ("text in line 7",)
    assert not fits[3].outcome.is_fitted
    assert set(fits[3].quantities) == set(fits[0].quantities)
    assert np.isnan(fits[3]["melanin_mg_per_mL"].value)
    assert not fits[3]["melanin_mg_per_mL"].informed


def test_a_surrogate_that_gives_nan_is_a_row():
    class Broken(ToyMember):
        def __call__(self, parameters):
            return super().__call__(parameters) * jnp.nan

    class Surrogate(ToySurrogate):
        def at(self, form):
            return _as(Broken, super().at(form))

    fit = inversion.fit((VISIBLE, np.full(31, 0.4)), Surrogate(), noise=0.01)
    assert fit.outcome is Outcome.unusable
    assert "no finite spectrum" in fit.messages[0]


def test_fixed_values_are_held_and_narrow_what_depends_on_them():
    values = reflectance(LIGHT, VISIBLE)[0]
    known = dict(zip(NAMES, LIGHT, strict=True))
    given = {name: known[name] for name in ("eumelanin", "pheomelanin", "lipids")}
    fixed = one(values, fix={**given, "melanosome_form": "complex"})
    assert fixed.fixed == given
    assert fixed.form_probability == {"complex": 1.0}
    assert "eumelanin" not in fixed.quantities
    # That the product is known makes the content known once the concentration is.
    free = one(values, fix={"melanosome_form": "complex"})
    ratio = fixed["colloidal_melanin"].sd / free["colloidal_melanin"].sd
    assert ratio < 0.8
    e = fixed["colloidal_melanin"]
    assert abs(e.value - known["colloidal_melanin"]) < 3 * e.sd


def test_a_quantity_that_is_held_is_exact_and_not_informed():
    fit = one(reflectance(LIGHT, VISIBLE)[0], fix={"oxygen_saturation": 0.7, "water": 1.0})
    assert fit["oxygen_saturation"] == Estimate(0.7, 0.0, 0.7, 0.7, False)
    assert fit["water_percent"].value == 75.0


def test_free_names_alone_move():
    fit = one(reflectance(LIGHT, VISIBLE)[0], free=["blood_reticular", "colloidal_melanin"])
    assert fit.names == ("colloidal_melanin", "blood_reticular")
    assert fit.value.shape == (2,)
    assert fit.fixed["eumelanin"] == statevector.PRIORS["eumelanin"].median


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"fix": {"melanosomes": 1.0}}, "unknown parameter 'melanosomes'; the surrogate knows"),
        ({"fix": {"water": "wet"}}, "water: expected a number, got 'wet'"),
        ({"fix": {"water": 9.0}}, "outside the surrogate's range"),
        ({"fix": {"melanosome_form": "compact"}}, "expected one of complex, dispersed"),
        ({"free": ["hue"]}, "unknown parameter 'hue'"),
        ({"specular": "maybe"}, "specular: expected included or excluded, got 'maybe'"),
        ({"noise": -0.01}, "noise"),
        ({"noise": "loud"}, "noise: expected a number"),
        ({"noise": np.full(3, 0.01)}, "noise"),
        ({"noise": np.zeros((31, 31))}, "variances not above 0"),
        ({"noise": np.eye(4)}, r"expected shape \(31, 31\), got \(4, 4\)"),
        ({"starts": 0}, "starts: expected a whole number from 1, got 0"),
        ({"wavelength_range": (900, 1000)}, "no band in the range"),
    ],
)
def test_options_that_cannot_be_are_refused(options, says):
    with pytest.raises(HyliosError, match=says):
        one(reflectance(LIGHT, VISIBLE)[0], **options)


def test_several_spectra_for_fit_are_refused():
    with pytest.raises(HyliosError, match="expected one spectrum, got 2: use fit_many"):
        inversion.fit(spectra_of(reflectance([LIGHT, LIGHT], VISIBLE), VISIBLE), TOY)


def test_one_region_is_dominated_by_the_prior():
    bands = np.linspace(1000.0, 1600.0, 31)
    few = np.where(np.abs(bands - 1300.0) < 30.0, reflectance(LIGHT, bands)[0], np.nan)
    fit = one(few, bands, noise=0.02)
    assert fit.outcome is Outcome.prior_dominated
    assert any("Not told by the data" in message for message in fit.messages)
    prior = statevector.PRIORS["oxygen_saturation"]
    assert fit["oxygen_saturation"].value == pytest.approx(prior.median, abs=0.02)
    assert fit["oxygen_saturation"].sd == pytest.approx(prior.sd, rel=0.1)


def test_a_parameter_pressed_to_the_edge_is_at_bound():
    bloodless = LIGHT.copy()
    bloodless[[6, 7]] = 0.0201
    values = reflectance(bloodless, WIDE)[0]
    fit = one(values, WIDE, noise=0.0003, fix={"melanosome_form": "complex"})
    assert fit.outcome is Outcome.at_bound
    assert any("blood_reticular is at its lower edge" in m.lower() for m in fit.messages)
    assert fit["blood_reticular"].low >= LOWER[7]


@pytest.mark.parametrize("smooth", [True, False])
def test_a_misfit_is_called_so_and_widens_what_the_data_tell(smooth):
    values = reflectance(LIGHT, VISIBLE)[0]
    smoothly = 0.05**2 * inversion._model_error(VISIBLE, values)
    missed = np.random.default_rng(0).multivariate_normal(
        0.0 * values, smoothly if smooth else 0.02**2 * np.eye(VISIBLE.size)
    )
    good, bad = one(values), one(values + missed)
    assert good.outcome is Outcome.fitted
    assert (good.inflation, good.model_error) == (1.0, 0.0)
    assert bad.outcome is Outcome.misfit
    if smooth:
        assert bad.inflation == 1.0
        assert 0.015 < bad.model_error < 0.15
        assert any("the model to miss by" in message for message in bad.messages)
    else:
        assert bad.inflation == pytest.approx(np.sqrt(bad.reduced_chi2))
        assert bad.inflation > 1.5
        assert bad.model_error == 0.0
        assert any("times what was stated" in message for message in bad.messages)
    relative = [fit["blood_percent"].sd / fit["blood_percent"].value for fit in (good, bad)]
    assert relative[1] > 1.3 * relative[0]
    # What only the prior tells stays the prior's.
    assert bad["water_percent"].sd == pytest.approx(good["water_percent"].sd, rel=0.02)


def test_intervals_hold_their_share_where_the_model_misses():
    """By a twentieth of the reflectance, which nobody told the fit."""
    vector = statevector.state_vector(NAMES, LOWER, UPPER)
    truth = vector.prior_draws(jax.random.key(8), 100)
    generator = np.random.default_rng(8)
    measured = np.stack(
        [
            generator.multivariate_normal(
                spectrum, 0.001**2 * np.eye(WIDE.size)
                + 0.05**2 * inversion._model_error(WIDE, spectrum)
            )
            for spectrum in reflectance(truth, WIDE)
        ]
    )  # fmt: skip
    fits = inversion.fit_many(
        spectra_of(measured, WIDE), TOY, noise=0.001, fix={"melanosome_form": "complex"},
        progress=False,
    )  # fmt: skip
    assert np.mean([fit.model_error > 0.0 for fit in fits]) > 0.95
    found = np.array([fit.model_error for fit in fits])
    assert np.median(found) == pytest.approx(0.05, rel=0.15)
    known = statevector.derived(NAMES, truth)
    for name in QUANTITIES:
        inside = [
            fit[name].low <= value <= fit[name].high
            for fit, value in zip(fits, known[name], strict=True)
        ]
        # 68 % of 100, within 2.4 binomial standard deviations
        assert np.mean(inside) == pytest.approx(0.68, abs=0.11), name


@pytest.mark.parametrize(
    "values",
    [np.full(31, 0.95), np.linspace(0.9, 0.05, 31), 0.4 + 0.35 * np.cos(VISIBLE / 10.0)],
    ids=["white", "falling", "striped"],
)
def test_what_is_no_skin_is_outside_the_range(values):
    fit = one(values)
    assert fit.outcome is Outcome.outside_range
    assert not fit.outcome.is_fitted


def test_the_surface_that_is_excluded_is_that_of_the_index_that_is_fitted():
    surrogate = load_surrogate()
    truth = Specimen().replace(index_corneum=1.47)
    bands = np.arange(400.0, 701.0, 20.0)
    member = surrogate.at("complex").on(bands)
    own = truth.parameters(member.names).astype(np.float32)
    values = np.asarray(member(own) - member.surface_at(own), float)
    free = ("usual", "index_corneum")
    found = inversion.fit(
        (bands, values), surrogate, noise=0.002, free=free, specular="excluded",
        fix={"melanosome_form": "complex"},
    )  # fmt: skip
    best = dict(zip(found.names, found.value, strict=True))
    asked = truth.replace(**best).parameters(member.names).astype(np.float32)
    expected = np.asarray(member(asked) - member.surface_at(asked))
    np.testing.assert_allclose(found.fitted, expected, atol=1e-5)


def test_specular_excluded_subtracts_the_surface():
    values = reflectance(LIGHT, VISIBLE)[0]
    surface = TOY.at("complex").surface_at(None)
    included, excluded = one(values), one(values - surface, specular="excluded")
    np.testing.assert_allclose(excluded.z, included.z, atol=1e-6)
    np.testing.assert_allclose(excluded.fitted, included.fitted - surface, atol=1e-8)


def test_a_range_cuts_the_bands():
    values = reflectance(LIGHT, WIDE)[0]
    fit = one(values, WIDE, wavelength_range=(400.0, 700.0))
    assert fit.wavelength_nm.min() >= 400.0
    assert fit.wavelength_nm.max() <= 700.0
    assert not fit["water_percent"].informed


def test_noise_for_each_band_is_the_same_as_its_covariance():
    values = reflectance(LIGHT, VISIBLE)[0]
    sd = np.linspace(0.002, 0.006, 31)
    np.testing.assert_array_equal(one(values, noise=sd).z, one(values, noise=np.diag(sd**2)).z)
    spectra = Spectra(VISIBLE, ("s",), values[None], (None,), noise=sd)
    np.testing.assert_array_equal(inversion.fit(spectra, TOY).z, one(values, noise=sd).z)


def test_noise_for_each_band_is_in_the_order_of_the_spectrum():
    values = reflectance(LIGHT, VISIBLE)[0]
    sd = np.linspace(0.002, 0.006, 31)
    at = np.random.default_rng(0).permutation(31)
    expected, cut = one(values, noise=sd), one(values[5:], VISIBLE[5:], noise=sd[5:])
    for noise in (sd[at], np.diag(sd[at] ** 2)):
        mixed = one(values[at], VISIBLE[at], noise=noise)
        np.testing.assert_array_equal(mixed.wavelength_nm, VISIBLE)
        np.testing.assert_array_equal(mixed.z, expected.z)
    # what a range leaves out has no noise
    left, limits = at[at >= 5], (VISIBLE[5], VISIBLE[-1])
    mixed = one(values[at], VISIBLE[at], noise=sd[left], wavelength_range=limits)
    np.testing.assert_array_equal(mixed.z, cut.z)
    whole = as_spectra((VISIBLE[at], values[at]))
    again = inversion.fit(whole, TOY, noise=sd[left], wavelength_range=limits)
    np.testing.assert_array_equal(again.z, cut.z)


def test_less_noise_tells_more():
    values = reflectance(LIGHT, VISIBLE)[0]
    sds = [one(values, noise=noise)["blood_percent"].sd for noise in (0.02, 0.005, 0.001)]
    assert sds[0] > sds[1] > sds[2]


def test_jax_is_left_as_it_was():
    assert not jax.config.jax_enable_x64
    one(reflectance(LIGHT, VISIBLE)[0])
    assert not jax.config.jax_enable_x64
    assert jnp.zeros(1).dtype == jnp.float32


@pytest.mark.timeout(120)
def test_hundreds_of_solves_do_not_hang():
    """JAX's 0.10 series waits for ever after a few such calls."""
    values = reflectance(LIGHT, VISIBLE)
    spectra = spectra_of(np.repeat(values, 150, axis=0), VISIBLE)
    fits = inversion.fit_many(spectra, TOY, noise=0.003, starts=2, progress=False)
    assert len({fit["melanin_mg_per_mL"].value for fit in fits}) == 1


def test_the_scan_is_spread_like_the_prior():
    states = inversion._scan_states(11, None)
    assert states.shape == (inversion.SCAN, 11)
    np.testing.assert_array_equal(states[0], 0.0)
    np.testing.assert_allclose(states.mean(axis=0), 0.0, atol=0.1)
    np.testing.assert_allclose(np.cov(states.T), np.eye(11), atol=0.2)


def test_a_covariance_without_inverse_is_said():
    with pytest.raises(HyliosError, match="has no inverse"):
        inversion.whitener(-np.eye(3), np.ones(3, dtype=bool))


def test_estimates_and_fits_check_themselves():
    with pytest.raises(HyliosError, match="low <= value <= high"):
        Estimate(1.0, 0.1, 1.1, 1.2, True)
    fit = one(reflectance(LIGHT, VISIBLE)[0])
    fields = {name: getattr(fit, name) for name in Fit.__dataclass_fields__}
    with pytest.raises(HyliosError, match=r"measured has shape \(3,\), not \(31,\)"):
        Fit(**(fields | {"measured": np.zeros(3)}))


def test_every_outcome_is_a_word_with_advice():
    assert {outcome.code for outcome in Outcome} == {
        "fitted", "at_bound", "prior_dominated", "misfit", "outside_range", "not_converged",
        "unusable",
    }  # fmt: skip
    for outcome in Outcome:
        assert Outcome(outcome.code) is outcome
        assert outcome.advice.endswith(".")


def test_members_in_single_precision_are_fitted_in_double():
    class Single(ToySurrogate):
        def at(self, form):
            return jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), super().at(form))

    values = reflectance(LIGHT, VISIBLE)[0]
    fit = inversion.fit((VISIBLE, values), Single(), noise=0.003)
    assert eqx.is_array_like(fit.z)
    np.testing.assert_allclose(fit.z, one(values).z, atol=0.02)


def test_a_search_that_runs_out_of_steps_goes_on(monkeypatch):
    # compiled anew, with few steps: another function, or what was compiled before would be used
    solve = inversion._solve.__wrapped__
    monkeypatch.setattr(inversion, "_solve", eqx.filter_jit(lambda *parts: solve(*parts)))
    monkeypatch.setattr(inversion, "MAX_STEPS", 2)
    values = reflectance(LIGHT, VISIBLE)[0]
    monkeypatch.setattr(inversion, "MORE", 0)
    short = one(values)
    assert short.outcome is Outcome.not_converged
    assert "no minimum within 2 steps" in short.messages[0]
    monkeypatch.setattr(inversion, "MORE", 30)
    found = one(values)
    assert found.outcome is Outcome.fitted
    assert found.iterations > short.iterations
