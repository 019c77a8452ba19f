"""Colours, and the instrument: bands, specular, noise."""

import subprocess
import sys

import numpy as np
import pytest

from hylios_fit.appearance import appearance, appearances, colour_difference, colour_differences
from hylios_fit.errors import HyliosError
from hylios_fit.instrument import (
    interpolation_matrix,
    noise_covariance,
    noise_sd,
    specular_offset,
)


def skin(wavelength_nm):
    """A smooth spectrum with the dips of haemoglobin, as a light skin has."""
    w = np.asarray(wavelength_nm, dtype=float)
    base = 0.15 + 0.45 / (1 + np.exp(-(w - 560) / 60))
    return base - 0.06 * np.exp(-(((w - 545) / 14) ** 2)) - 0.06 * np.exp(-(((w - 577) / 10) ** 2))


# --- appearance -----------------------------------------------------------------------------------


def test_white_and_grey():
    w = np.arange(380, 781, 5)
    white = appearance(w, np.ones(w.size))
    assert white is not None
    np.testing.assert_allclose(white.xyz, [95.04, 100, 108.88], atol=0.05)
    np.testing.assert_allclose(white.lab, [100, 0, 0], atol=1e-6)
    assert white.hex == "#ffffff"
    grey = appearance(w, np.full(w.size, 0.184186))
    assert grey is not None
    np.testing.assert_allclose(grey.lab, [50, 0, 0], atol=1e-3)
    black = appearance(w, np.zeros(w.size))
    assert black is not None
    assert black.hex == "#000000"


def test_against_colour_science():
    import warnings

    with warnings.catch_warnings(action="ignore"):
        import colour

        w = np.arange(380, 781, 5.0)
        distribution = colour.SpectralDistribution(dict(zip(w, skin(w), strict=True)))
        expected = colour.sd_to_XYZ(
            distribution,
            illuminant=colour.SDS_ILLUMINANTS["D65"],
            method="Integration",
        )
    found = appearance(w, skin(w))
    assert found is not None
    np.testing.assert_allclose(found.xyz, expected, atol=0.02)


@pytest.mark.parametrize(
    "bands",
    [
        np.arange(380, 781, 1),
        np.arange(400, 701, 5),
        np.arange(400, 701, 10),
        np.arange(360, 741, 10),
        np.arange(400, 701, 20),
        np.r_[390, 400, 403, np.arange(410, 560, 7), np.arange(560, 720, 13)],
        np.arange(250, 2501, 3),
    ],
)
def test_bands_hardly_matter(bands):
    fine = np.arange(380, 781, 1)
    # Beyond its last band a spectrum is held, so the reference is held there as well.
    held = np.clip(fine, bands[0], bands[-1])
    difference = colour_difference(appearance(bands, skin(bands)), appearance(fine, skin(held)))
    assert difference is not None
    assert difference < 0.3


def test_typology_angle():
    w = np.arange(400, 701, 10)
    light, dark = appearance(w, skin(w)), appearance(w, skin(w) * 0.15)
    assert light is not None
    assert dark is not None
    assert light.ita == pytest.approx(
        np.degrees(np.arctan((light.lab[0] - 50) / light.lab[2])), abs=1e-9
    )
    assert light.ita > 10 > dark.ita


@pytest.mark.parametrize(
    "bands",
    [
        np.arange(410, 701, 10),
        np.arange(400, 691, 10),
        np.arange(400, 701, 30),
        np.r_[np.arange(400, 500, 10), np.arange(560, 701, 10)],
        np.array([400.0]),
        np.arange(1000, 2501, 5),
    ],
)
def test_no_colour_where_the_visible_is_not_covered(bands):
    assert appearance(bands, skin(bands)) is None


def test_missing_bands():
    w = np.arange(400, 701, 10)
    values = np.stack([skin(w)] * 4)
    values[1, 5] = np.nan
    values[2, 0] = np.nan
    values[3] = np.nan
    found = appearances(w, values)
    assert [one is None for one in found] == [False, False, True, True]
    difference = colour_differences([found[0]] * 4, found)
    assert difference[0] == 0
    assert difference[1] is not None
    assert difference[1] < 0.2
    assert difference[2:] == [None, None]


def test_appearances_check_shapes():
    with pytest.raises(HyliosError, match=r"expected shape \(spectra, 3\), got \(1, 2\)"):
        appearances([400, 500, 600], [[0.1, 0.2]])


def test_colour_science_stays_quiet():
    code = (
        "import numpy as np; from hylios_fit.appearance import appearance as a, "
        "colour_difference as d; w = np.arange(400, 701, 10); x = a(w, w / 1000); print(d(x, x))"
    )
    done = subprocess.run(
        [sys.executable, "-W", "always", "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout == "0.0\n"
    assert done.stderr == ""


# --- instrument -----------------------------------------------------------------------------------

BANDS = np.arange(400.0, 701.0, 10.0)


def test_noise_of_the_nist_repeats():
    """The levels that the repeats have, within a third: see the source in instrument.py."""
    assert noise_sd([250.0], [0.058])[0] == pytest.approx(0.0023, rel=0.33)
    assert noise_sd([550.0], [0.314])[0] == pytest.approx(0.0098, rel=0.33)
    assert noise_sd([700.0], [0.60])[0] == pytest.approx(0.0143, rel=0.33)
    assert noise_sd([2200.0], [0.059])[0] == pytest.approx(0.0026, rel=0.33)


def test_noise_grows_with_reflectance():
    sd = noise_sd(BANDS, np.linspace(-0.01, 0.9, BANDS.size))
    assert np.all(np.diff(sd)[1:] > 0)
    assert sd[0] == pytest.approx(np.hypot(0.0021, 0.0003))


def test_covariance_agrees_with_sd():
    covariance = noise_covariance(BANDS, skin(BANDS))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), noise_sd(BANDS, skin(BANDS)))
    np.testing.assert_allclose(covariance, covariance.T)


@pytest.mark.parametrize("bands", [BANDS, np.arange(250.0, 2501.0, 3.0)])
def test_covariance_is_positive_definite(bands):
    values = 0.3 + 0.2 * np.sin(bands / 100)
    assert np.linalg.eigvalsh(noise_covariance(bands, values)).min() > 0.99 * 0.0003**2
    assert np.linalg.eigvalsh(noise_covariance(bands, 0 * values)).min() > 0.99 * 0.0003**2


def test_neighbouring_bands_move_together():
    covariance = noise_covariance([500.0, 510.0, 700.0, 2200.0], [0.4] * 4)
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    assert correlation[0, 1] > 0.98
    assert 0.98 > correlation[0, 2] > correlation[0, 3] > 0.3


def test_given_noise():
    np.testing.assert_array_equal(noise_sd(BANDS, skin(BANDS), 0.01), 0.01)
    given = np.linspace(0.001, 0.02, BANDS.size)
    np.testing.assert_array_equal(noise_sd(BANDS, skin(BANDS), given), given)
    covariance = noise_covariance(BANDS, skin(BANDS), given)
    np.testing.assert_array_equal(covariance, np.diag(given**2))
    many = noise_sd(BANDS, np.full((3, BANDS.size), np.nan), 0.01)
    assert many.shape == (3, BANDS.size)
    assert np.isnan(many).all()


@pytest.mark.parametrize("noise", [0, -0.1, 1.5, np.nan, [0.1, 0.2], np.zeros(31)])
def test_impossible_noise(noise):
    with pytest.raises(HyliosError, match="noise: expected"):
        noise_sd(BANDS, skin(BANDS), noise)


def test_noise_checks_shapes():
    with pytest.raises(HyliosError, match=r"expected shape \(..., 31\), got \(2,\)"):
        noise_sd(BANDS, [0.1, 0.2])
    with pytest.raises(HyliosError, match="expected 31 finite values"):
        noise_covariance(BANDS, np.full(31, np.nan))


def test_specular():
    assert specular_offset(0.046, "included") == 0
    assert specular_offset(0.046, "excluded") == -0.046
    with pytest.raises(HyliosError, match="expected included or excluded, got 'in'"):
        specular_offset(0.046, "in")


def test_interpolation():
    grid = np.arange(250.0, 2501.0, 5.0)
    bands = np.array([250.0, 251.0, 402.5, 700.0, 2499.0, 2500.0])
    matrix = interpolation_matrix(grid, bands)
    assert matrix.shape == (6, 451)
    values = np.sin(grid / 100)
    np.testing.assert_allclose(matrix @ values, np.interp(bands, grid, values), rtol=1e-13)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, rtol=1e-13)
    np.testing.assert_array_equal(interpolation_matrix(grid, grid), np.eye(451))


@pytest.mark.parametrize("band", [249.9, 2500.1, np.nan])
def test_interpolation_stays_inside(band):
    with pytest.raises(HyliosError, match="within 250 to 2500 nm"):
        interpolation_matrix(np.arange(250.0, 2501.0, 5.0), [400.0, band])
