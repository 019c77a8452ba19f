"""Sampling the posterior: against Laplace where that is exact, its verdicts, its own randomness."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_surrogate import ToySurrogate

from hylios_fit import inversion, sampling
from hylios_fit.errors import HyliosError
from hylios_fit.results import (
    QUANTITIES,
    Estimate,
    Outcome,
    Posterior,
    read_posteriors,
    write_posteriors,
)
from hylios_fit.skin import Specimen
from hylios_fit.surrogate import load_surrogate

TOY = ToySurrogate()
BANDS = np.linspace(400.0, 1000.0, 13)
PARAMETERS = np.array([0.5, 0.6, 2.5, 1.0, 45.0, 2.5, 0.6, 0.8, 0.7, 0.95, 1.0])
# Three free parameters, so that a chain converges in a second.
FREE = ("colloidal_melanin", "blood_reticular", "oxygen_saturation")


@pytest.fixture(scope="module")
def fit():
    with jax.enable_x64(True):
        values = np.array(TOY.at("complex").on(BANDS)(jnp.asarray(PARAMETERS)))
    values[4] = np.nan
    return inversion.fit((BANDS, values), TOY, noise=0.002, free=FREE)


@pytest.fixture(scope="module")
def posterior(fit):
    return sampling.sample(fit, key=jax.random.key(5), surrogate=TOY, progress=False)


@pytest.fixture(scope="module")
def short(fit):
    return sampling.sample(
        fit, key=jax.random.key(5), surrogate=TOY, steps=40, walkers=8, progress=False
    )


def test_the_posterior_converges_and_agrees_with_laplace(fit, posterior):
    assert posterior.converged
    assert posterior.verdict.startswith("converged: ")
    assert posterior.steps >= sampling.ENOUGH * posterior.autocorrelation_time
    for name in FREE:
        sampled, laplace = posterior[name], fit[name]
        # Laplace's error here is a fraction of the width; Monte Carlo's is 1/sqrt(ess) of it.
        assert abs(sampled.value - laplace.value) < 0.25 * laplace.sd
        assert sampled.sd == pytest.approx(laplace.sd, rel=0.2)
        assert posterior.rhat[name] < 1.01
        assert posterior.ess[name] > 1000


def test_the_posterior_of_a_prior_alone_is_the_prior(fit):
    """With endless noise the draws must be those of the prior, tails and all."""
    loud = inversion.fit((BANDS, np.full(13, 0.4)), TOY, noise=1e4 * np.eye(13), free=FREE)
    drawn = sampling.sample(loud, key=jax.random.key(2), surrogate=TOY, progress=False)
    vector, _ = _vector(loud)
    prior = vector.prior_draws(jax.random.key(3), 20_000)
    quantiles = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    for name, i in zip(vector.free, vector.index, strict=True):
        expected = np.quantile(prior[:, i], quantiles)
        got = np.quantile(drawn.draws(name), quantiles)
        # standard error of a quantile, of as many independent draws as both are worth
        low, high = (np.quantile(prior[:, i], quantiles + step) for step in (-0.02, 0.02))
        share = quantiles * (1.0 - quantiles)
        error = np.sqrt(share * (1.0 / drawn.ess[name] + 1.0 / len(prior))) * (high - low) / 0.04
        assert np.all(np.abs(got - expected) < 4.0 * error)
        assert not drawn[name].informed


def _vector(fit):
    with jax.enable_x64(True):
        return sampling.log_posterior(fit, TOY)


def test_the_density_is_that_of_the_fit(fit):
    with jax.enable_x64(True):
        _, density = sampling.log_posterior(fit, TOY)
        scale = np.linalg.cholesky(fit.z_covariance)
        generator = np.random.default_rng(0)
        near = fit.z + 0.3 * generator.standard_normal((30, 3)) @ scale.T
        at = density(np.concatenate([fit.z[None], near]))
        assert np.all(at[0] > at[1:])
        assert density(np.full((1, 3), np.nan))[0] == -np.inf


def test_it_is_sampled_with_the_surrogate_that_it_was_fitted_with():
    """Also where nobody says which of the embedded that was, and no other is taken."""
    large, small = load_surrogate(), load_surrogate(size="small")
    values = np.asarray(small.at("complex")(Specimen.preset("S3").parameters(small.names[:-1])))
    use = np.arange(30, 91, 10)
    measured = small.wavelength_nm[use], values[use]
    fit = inversion.fit(measured, small, noise=0.002, free=FREE, fix={"melanosome_form": "complex"})
    asked = {"key": jax.random.key(1), "steps": 10, "progress": False}
    found, same = (sampling.sample(fit, surrogate=one, **asked) for one in (None, small))
    np.testing.assert_array_equal(found.draws(FREE[0]), same.draws(FREE[0]))
    with pytest.raises(HyliosError, match=r"was fitted with the surrogate .*, got"):
        sampling.sample(fit, surrogate=large, **asked)


def test_the_data_hold_every_quantity_and_every_free_parameter(posterior):
    assert set(posterior.names) == {*FREE, "melanin_mg_per_mL", "blood_percent"}
    assert posterior.names[0] == QUANTITIES[0]
    sizes = posterior.data.posterior.sizes
    assert sizes["chain"] == sampling.ENSEMBLES
    assert abs(sizes["draw"] - sampling.DRAWS) < 20
    content = posterior.draws("melanin_mg_per_mL")
    assert content.shape == (sizes["chain"] * sizes["draw"],)
    assert isinstance(posterior["melanin_mg_per_mL"], Estimate)
    assert posterior["melanin_mg_per_mL"].informed
    with pytest.raises(HyliosError, match="no quantity 'water_percent' in this posterior"):
        posterior["water_percent"]


def test_a_short_chain_is_called_not_converged(short):
    assert not short.converged
    assert "autocorrelation times, under 50; sample with more steps" in short.verdict
    assert np.isfinite(short.autocorrelation_time)


def test_ensembles_that_disagree_are_called_not_converged():
    converged, verdict = sampling._verdict(10_000, 20.0, {"water": 1.0, "lipids": 1.3})
    assert not converged
    assert "the ensembles disagree, R-hat of lipids is 1.300" in verdict
    assert not sampling._verdict(10_000, 20.0, {"water": float("nan")})[0]


def test_the_same_key_gives_the_same_draws_and_another_key_others(fit, short):
    options = {"surrogate": TOY, "steps": 40, "walkers": 8, "progress": False}
    same = sampling.sample(fit, key=jax.random.key(5), **options)
    other = sampling.sample(fit, key=jax.random.key(6), **options)
    for name in FREE:
        np.testing.assert_array_equal(same.draws(name), short.draws(name))
        assert not np.any(other.draws(name) == short.draws(name))


def test_the_ensembles_of_one_key_differ(short):
    first, second = short.data.posterior["oxygen_saturation"].values
    assert not np.any(first == second)


def test_numpys_global_state_is_neither_used_nor_moved(fit, short):
    options = {"surrogate": TOY, "steps": 40, "walkers": 8, "progress": False}
    before = np.random.get_state()  # noqa: NPY002
    again = sampling.sample(fit, key=jax.random.key(5), **options)
    after = np.random.get_state()  # noqa: NPY002
    assert before[2] == after[2]
    np.testing.assert_array_equal(before[1], after[1])
    np.testing.assert_array_equal(again.draws(FREE[0]), short.draws(FREE[0]))


def test_autocorrelation_time_of_a_known_process():
    """AR(1) with coefficient a: (1 + a) / (1 - a)."""
    generator = np.random.default_rng(0)
    chain = np.zeros((2, 6000, 20, 2))
    for i in range(1, 6000):
        kick = generator.standard_normal((2, 20, 2))
        chain[:, i] = np.array([0.9, 0.5]) * chain[:, i - 1] + kick
    np.testing.assert_allclose(sampling.autocorrelation_times(chain), [19.0, 3.0], rtol=0.06)


def test_a_chain_that_never_moved_is_as_long_as_it_is_wrong():
    times = sampling.autocorrelation_times(np.ones((2, 300, 4, 1)))
    assert times[0] > 300


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"walkers": 4}, "walkers: expected an even number from 6, got 4"),
        ({"walkers": 9}, "walkers: expected an even number"),
        ({"steps": 3}, "steps: expected a whole number from 10, got 3"),
    ],
)
def test_options_that_cannot_be_are_refused(fit, options, says):
    with pytest.raises(HyliosError, match=says):
        sampling.sample(fit, key=jax.random.key(0), surrogate=TOY, **options)


def test_a_fit_without_estimates_is_refused():
    bad = inversion.fit((BANDS, np.full(13, np.nan)), TOY, noise=0.01, free=FREE)
    assert bad.outcome is Outcome.unusable
    with pytest.raises(HyliosError, match=r"no estimates to start from \(outcome unusable\)"):
        sampling.sample(bad, key=jax.random.key(0), surrogate=TOY)


def test_posteriors_are_written_whole_and_read_back(tmp_path, posterior, short):
    path = posterior.to_netcdf(tmp_path / "posterior.nc")
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]
    (again,) = read_posteriors(path)
    assert isinstance(again, Posterior)
    assert again.verdict == posterior.verdict
    assert again.converged is True
    assert dict(again.rhat) == dict(posterior.rhat)
    for name in posterior.names:
        np.testing.assert_array_equal(again.draws(name), posterior.draws(name))
        assert again[name] == posterior[name]
    import arviz

    assert "chain" in arviz.from_netcdf(str(path)).posterior.dims
    with pytest.raises(HyliosError, match="no folder"):
        posterior.to_netcdf(tmp_path / "nowhere" / "posterior.nc")


def test_posteriors_of_several_spectra_share_a_file(tmp_path, fit, short):
    other = sampling.sample(
        fit, key=jax.random.key(9), surrogate=TOY, steps=40, walkers=8, progress=False
    )
    again = read_posteriors(write_posteriors([short, other], tmp_path / "posterior.nc"))
    for before, after in zip((short, other), again, strict=True):
        np.testing.assert_array_equal(before.draws(FREE[1]), after.draws(FREE[1]))
        assert before.verdict == after.verdict


def test_a_file_that_is_no_posterior_is_refused(tmp_path):
    path = tmp_path / "posterior.nc"
    path.write_bytes(b"\x89HDF\r\n\x1a\nhalf")
    with pytest.raises(HyliosError, match=r"posterior\.nc is not a posterior\.nc that can be read"):
        read_posteriors(path)
    with pytest.raises(HyliosError, match="expected at least one"):
        write_posteriors([], path)
