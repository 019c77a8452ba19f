"""Specific absorption against numbers published elsewhere."""

import numpy as np
import pytest

from hylios_fit.absorbers import UNITS, specific_absorption
from hylios_fit.datasets import ABSORBERS, read_absorber
from hylios_fit.errors import HyliosError
from hylios_fit.units import LN10

HAEM = 16125.0 / 1e3 / LN10  # Napierian 1/cm per (mg/mL) -> decadic L/(mmol cm) per haem


def at(name, *wavelengths):
    value = specific_absorption(np.array(wavelengths, dtype=float))[name]
    return float(value[0]) if len(wavelengths) == 1 else value


def per_haem(name, *wavelengths):
    return at(name, *wavelengths) * HAEM


def peak(name, low, high):
    """Position of the maximum between two wavelengths; it must lie inside."""
    grid = np.arange(low, high + 0.5, 0.5)
    i = int(np.argmax(specific_absorption(grid)[name]))
    assert 0 < i < grid.size - 1, f"{name} has no peak within {low} to {high} nm"
    return grid[i]


# --- the function -------------------------------------------------------------------------------


def test_names_and_shapes():
    zeta = specific_absorption(np.full((2, 3), 500.0))
    assert tuple(zeta) == ABSORBERS == tuple(UNITS)
    assert all(v.shape == (2, 3) and v.dtype == np.float64 for v in zeta.values())
    assert specific_absorption(500.0)["water"].shape == ()
    assert specific_absorption([])["water"].shape == (0,)


def test_order_does_not_matter_and_ends_are_included():
    up = specific_absorption([250.0, 700.0, 2500.0])
    down = specific_absorption([2500.0, 700.0, 250.0])
    for name in ABSORBERS:
        np.testing.assert_array_equal(up[name], down[name][::-1])


def test_it_passes_through_the_table():
    for name in ABSORBERS:
        table = read_absorber(name)
        found = specific_absorption(table.wavelength_nm)[name]
        np.testing.assert_allclose(found, table.napierian, rtol=1e-12)


def test_finite_and_not_negative_everywhere():
    zeta = specific_absorption(np.arange(250.0, 2500.5, 0.5))
    for name, value in zeta.items():
        assert np.all(np.isfinite(value)), name
        assert np.all(value >= 0), name


def test_a_caller_cannot_change_what_the_next_one_gets():
    first = specific_absorption([500.0])
    with pytest.raises(ValueError, match="read-only"):
        first["water"][0] = 1.0
    first.clear()
    assert tuple(specific_absorption([500.0])) == ABSORBERS


@pytest.mark.parametrize(
    ("wavelength", "got"),
    [([249.9], "249.9"), ([400.0, 2501.0], "2501"), ([np.nan], "nan"), ([np.inf], "inf")],
)
def test_outside_the_range(wavelength, got):
    with pytest.raises(HyliosError, match=f"within 250 to 2500 nm, got {got}"):
        specific_absorption(wavelength)


# --- melanins -----------------------------------------------------------------------------------


def test_melanins_are_decadic_per_mg_per_ml():
    # Sarna and Swartz, Fig. 16.3a: readings near 459 and 643 nm.
    np.testing.assert_allclose(at("eumelanin", 460) / LN10, 10.1, rtol=0.02)
    np.testing.assert_allclose(at("eumelanin", 642.77) / LN10, 3.280, rtol=0.01)
    np.testing.assert_allclose(at("pheomelanin", 460) / LN10, 7.42, rtol=0.02)


@pytest.mark.parametrize(
    ("name", "power", "join"), [("eumelanin", 2.43, 820.26), ("pheomelanin", 4.78, 802.28)]
)
def test_melanins_fall_throughout_and_join_without_a_step(name, power, join):
    grid = np.arange(250.0, 2500.0, 1.0)
    value = specific_absorption(grid)[name]
    assert np.all(np.diff(value) <= 0)
    # No step: across the join 10 nm fall by no more than twice what the exponential does.
    before, after = at(name, join - 5, join + 5)
    assert 1 <= before / after < np.exp(2 * 10 * power / 694)
    assert np.all(read_absorber(name).measured_nm == np.array([[250.0, join]]))
    slope = np.log(at(name, 1000, 1500))
    assert abs((slope[0] - slope[1]) / 500 - power / 694) < 2e-5


def test_pheomelanin_absorbs_more_at_short_wavelengths_only():
    eu, pheo = (
        specific_absorption([250.0, 450.0, 600.0, 800.0])[f"{k}melanin"] for k in ("eu", "pheo")
    )
    assert pheo[0] > eu[0]
    assert np.all(pheo[1:] < eu[1:])


# --- haemoglobins -------------------------------------------------------------------------------


def test_oxyhaemoglobin_bands():
    assert abs(peak("oxyhaemoglobin", 400, 430) - 415) <= 2
    assert abs(peak("oxyhaemoglobin", 530, 555) - 542) <= 1
    assert abs(peak("oxyhaemoglobin", 565, 590) - 577) <= 1
    # Per haem, Zijlstra: 13.8 at 542 and 15.4 at 577 nm; Prahl's compilation 13.3 and 13.8.
    assert 13.0 < per_haem("oxyhaemoglobin", 542) < 14.0
    assert 13.3 < per_haem("oxyhaemoglobin", 577) < 15.5
    assert 125 < per_haem("oxyhaemoglobin", 415) < 135


def test_deoxyhaemoglobin_bands():
    assert abs(peak("deoxyhaemoglobin", 420, 450) - 432) <= 3
    assert abs(peak("deoxyhaemoglobin", 545, 565) - 555) <= 2
    assert abs(peak("deoxyhaemoglobin", 745, 775) - 757) <= 3


def test_whole_blood_coefficient():
    # 150 mg/mL at 800 nm: 2.303 * 816 * 150 / 64500 = 4.4 per cm.
    np.testing.assert_allclose(150 * at("oxyhaemoglobin", 800), 4.37, rtol=0.01)


@pytest.mark.parametrize(
    "pair", [(498, 504), (526, 532), (543, 548), (566, 572), (582, 588), (794, 808)]
)
def test_isosbestic_points(pair):
    zeta = specific_absorption(np.array(pair, dtype=float))
    difference = zeta["oxyhaemoglobin"] - zeta["deoxyhaemoglobin"]
    assert difference[0] * difference[1] < 0


@pytest.mark.parametrize("name", [n for n in ABSORBERS if n.endswith("haemoglobin")])
def test_haemoglobins_fade_beyond_1000_nm(name):
    grid = np.arange(1000.0, 1450.0, 2.0)
    value = specific_absorption(grid)[name]
    assert np.all(np.diff(value) <= 1e-12)
    step = specific_absorption([998.0, 1000.0, 1002.0])[name]
    assert abs(step[2] - step[1]) < 0.02 * step[1]
    assert np.all(specific_absorption(np.arange(1400.0, 2501.0, 50.0))[name] == 0)
    assert 0.3 < at(name, 1100) / at(name, 1000) < 0.95


@pytest.mark.parametrize(
    ("name", "heights"),
    [
        ("carboxyhaemoglobin", {419: 192, 450: 10.1, 538: 14.3, 570: 14.5}),
        ("methaemoglobin", {280: 33, 406: 162, 500: 9.1, 574: 4.0, 632: 3.9, 1000: 0.8}),
        ("sulfhaemoglobin", {450: 13.2, 560: 7.0, 622: 21.2, 800: 0.4}),
    ],
)
def test_derivatives_have_their_published_heights(name, heights):
    found = per_haem(name, *heights)
    # 419 nm lies between two rows of the table.
    np.testing.assert_allclose(found, list(heights.values()), rtol=0.01)


def test_derivatives_peak_where_published():
    assert abs(peak("carboxyhaemoglobin", 405, 435) - 419) <= 1
    assert abs(peak("carboxyhaemoglobin", 525, 552) - 538) <= 1
    assert abs(peak("carboxyhaemoglobin", 558, 590) - 570) <= 1
    assert abs(peak("methaemoglobin", 395, 425) - 406) <= 1
    assert abs(peak("methaemoglobin", 618, 650) - 632) <= 1
    assert abs(peak("sulfhaemoglobin", 600, 645) - 622) <= 1


# --- other solutes ------------------------------------------------------------------------------


def test_bilirubin():
    molar = at("bilirubin", 450) / LN10 * 584.66
    np.testing.assert_allclose(molar, 55_000, rtol=0.02)
    assert abs(peak("bilirubin", 420, 480) - 451) <= 3
    assert at("bilirubin", 540) < 2e-3 * at("bilirubin", 450)
    assert at("bilirubin", 600) == 0


def test_beta_carotene():
    molar = np.asarray(at("beta_carotene", 450, 452, 478)) / LN10 * 536.87
    np.testing.assert_allclose(molar[:2], 139_500, rtol=0.01)
    assert 0.8 < molar[2] / molar[0] < 0.95
    assert abs(peak("beta_carotene", 470, 490) - 478) <= 1
    assert at("beta_carotene", 466) < at("beta_carotene", 478)
    assert np.all(at("beta_carotene", 560, 700, 2500) == 0)


def test_dna():
    # 50 ug/mL in 1 cm has absorbance 1 at 260 nm.
    np.testing.assert_allclose(0.05 * at("dna", 260) / LN10, 1.0, rtol=1e-4)
    assert 1.3 < at("dna", 260) / at("dna", 280) < 2.0
    assert np.all(at("dna", 310, 400, 2500) == 0)


def test_urocanic_acid():
    np.testing.assert_allclose(at("urocanic_acid", 268, 274, 280) / LN10, 18_800, rtol=1e-3)
    assert 0.05 < at("urocanic_acid", 310) / at("urocanic_acid", 277) < 0.4
    assert np.all(at("urocanic_acid", 340, 341, 400, 2500) == 0)


def test_keratin():
    assert abs(peak("keratin", 260, 300) - 278) <= 1
    grid = np.arange(282.0, 500.0, 2.0)
    assert np.all(np.diff(specific_absorption(grid)["keratin"]) <= 0)
    # no aromatic residue absorbs beyond
    assert np.all(at("keratin", 350, 400, 2500) == 0)


def test_isolated_corneum_absorbs_as_measured():
    # van Gemert 1989: 600 per cm at 308 nm, 330 at 337 nm, all absorbers.
    dry = np.add(*(at(name, 308, 337) for name in ("keratin", "corneum_tail")))
    corneum = 0.65 * dry + 0.01 * at("urocanic_acid", 308, 337)
    assert 400 < corneum[0] < 700
    assert 150 < corneum[1] < 330
    grid = np.arange(250.0, 600.0, 2.0)
    assert np.all(np.diff(specific_absorption(grid)["corneum_tail"]) <= 0)
    assert np.all(at("corneum_tail", 500, 600, 2500) == 0)


# --- water and lipids ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wavelength", "coefficient", "tolerance"),
    [(760, 0.026, 0.05), (970, 0.45, 0.03), (1200, 1.25, 0.05), (1450, 30, 0.1), (1940, 122, 0.05)],
)
def test_water(wavelength, coefficient, tolerance):
    np.testing.assert_allclose(at("water", wavelength), coefficient, rtol=tolerance)


def test_water_bands():
    assert abs(peak("water", 940, 1000) - 972) <= 8
    assert abs(peak("water", 1400, 1500) - 1445) <= 8
    assert abs(peak("water", 1900, 2000) - 1930) <= 12
    assert np.all(at("water", 400, 500) < 1e-3)


def test_lipids():
    # 0.117 per cm at 930 nm (van Veen, given as 11.7 per metre).
    np.testing.assert_allclose(at("lipids", 930), 0.117, rtol=0.15)
    np.testing.assert_allclose(at("lipids", 1725), 8.0, rtol=0.1)
    np.testing.assert_allclose(at("lipids", 2306), 42.0, rtol=0.12)
    assert abs(peak("lipids", 900, 960) - 930) <= 5
    assert abs(peak("lipids", 1190, 1240) - 1211) <= 4
    assert abs(peak("lipids", 1710, 1745) - 1725) <= 6
    assert abs(peak("lipids", 2290, 2330) - 2309) <= 8


@pytest.mark.parametrize("join", [429.0, 1098.0, 1290.0])
def test_lipids_join_without_a_step(join):
    value = at("lipids", join - 6, join - 3, join, join + 3, join + 6)
    assert np.max(np.abs(np.diff(np.log(value)))) < 0.25


def test_water_outweighs_lipids_except_in_their_bands():
    water, lipids = (at(name, 970, 1210, 1450, 1725, 2309) for name in ("water", "lipids"))
    np.testing.assert_array_equal(lipids > water, [False, True, False, True, True])
