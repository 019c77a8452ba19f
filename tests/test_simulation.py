"""`simulate`: what it refuses, and what the parameters beyond the paper do."""

import jax
import numpy as np
import pytest

from hylios_fit import simulation
from hylios_fit.errors import HyliosError
from hylios_fit.simulation import simulate
from hylios_fit.skin import Specimen

NM = np.array([450.0, 650.0, 900.0, 1100.0])  # one shape: compiled once


@pytest.fixture(scope="module")
def curves():
    key = jax.random.key(0)

    def run(**changes):
        return simulate(Specimen().replace(**changes), NM, rays=16_384, key=key)

    return {
        "plain": run(),
        "bottom": run(bottom_reflectance=0.5),
        "dispersion": run(index_dispersion=0.02),
        "none": run(index_dispersion=1e-9),
        "tissue": run(bottom_reflectance=0.0, reticular_scattering=60.0),
        "dark": run(bottom_reflectance=0.0),
    }


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"method": "mcml"}, "method is one of walker, analog, adding, surrogate"),
        ({"wavelengths": [200.0]}, "250 to 2500 nm, got 200"),
        ({"wavelengths": []}, "must be a list of numbers"),
        ({"wavelengths": [np.nan]}, "250 to 2500 nm, got nan"),
        ({"rays": 0}, "rays must lie in"),
        ({"rays": 2**32}, "32-bit counter"),
        ({"incidence": 90.0}, "incidence must lie in 0 to 85 degrees, got 90"),
        ({"tolerance": 0.0}, "tolerance is a standard error above 0"),
        ({"key": None}, "give key="),
    ],
)
def test_refuses(options, said):
    options = {"wavelengths": NM, "key": jax.random.key(0), **options}
    with pytest.raises(HyliosError, match=said):
        simulate(Specimen(), **options)


def test_a_curve_adds_up(curves):
    curve = curves["plain"]
    assert np.allclose(curve.surface + curve.subsurface, curve.reflectance)
    assert (curve.standard_error > 0).all()
    assert (curve.standard_error < 0.02).all()
    assert (curve.effective_rays > 100).all()
    assert curve.rays == 16_384


def test_a_bottom_that_absorbs_darkens(curves):
    change = curves["plain"].reflectance - curves["bottom"].reflectance
    error = np.hypot(curves["plain"].standard_error, curves["bottom"].standard_error)
    assert (change > 5 * error)[1:].all()  # at 450 nm little light comes from so deep


def test_scattering_in_the_reticular_dermis_returns_light(curves):
    change = curves["tissue"].reflectance - curves["dark"].reflectance
    error = np.hypot(curves["tissue"].standard_error, curves["dark"].standard_error)
    assert (change > 5 * error)[1:].all()


def test_without_sharing_the_answer_is_the_same(curves):
    # a dispersion that does nothing still keeps every path to its own wavelength
    error = np.hypot(curves["none"].standard_error, curves["plain"].standard_error)
    assert np.abs(curves["none"].reflectance - curves["plain"].reflectance).max() < 4 * error.max()


def test_dispersion_changes_the_surface(curves):
    surface = curves["dispersion"].surface
    assert surface[0] > surface[1] > surface[2] > surface[3]
    assert np.ptp(curves["plain"].surface) == 0


def test_a_tolerance_adds_rays_until_it_is_met_or_says_so(monkeypatch):
    met = simulate(Specimen(), NM, tolerance=0.002, key=jax.random.key(1))
    assert met.standard_error.max() <= 0.002
    assert met.note == ""
    assert met.rays % simulation.GRAIN == 0
    assert met.standard_error.max() > 0.9 * 0.002  # no more than are needed
    monkeypatch.setattr(simulation, "MOST_RAYS", 4096)
    short = simulate(Specimen(), NM, tolerance=1e-4, key=jax.random.key(1))
    assert "was not reached with 4,096 rays" in short.note


def test_the_surrogate_is_a_method():
    curve = simulate(Specimen(), NM, method="surrogate")
    assert np.allclose(curve.subsurface + curve.surface, curve.reflectance)
    with pytest.raises(HyliosError, match="8 degrees"):
        simulate(Specimen(), NM, method="surrogate", incidence=45.0)


def test_adding_needs_no_key_and_agrees_with_the_walk(curves):
    found = simulate(Specimen(), NM, method="adding")
    walked = curves["plain"]
    z = (walked.reflectance - found.reflectance) / walked.standard_error
    assert np.all(np.abs(z) < 4)
    assert found.standard_error.max() < 4e-4
    assert found.note == ""
    np.testing.assert_allclose(found.surface, walked.surface, atol=2e-6)


def test_adding_says_what_tolerance_it_reached(monkeypatch):
    monkeypatch.setattr(simulation.adding, "ORDERS", (6, 8))
    found = simulate(Specimen(), NM, method="adding", tolerance=1e-12)
    assert "tolerance 1e-12 was not reached at order 8" in found.note
