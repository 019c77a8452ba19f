"""The mean sensitivity index: Eq. 9 by hand, what each removal removes, and the paper's order."""

import csv
import sys

import jax
import numpy as np
import pytest
from scipy.stats import chi2

import hylios_fit as hf
from hylios_fit import cli
from hylios_fit import sensitivity as public_sensitivity
from hylios_fit.errors import HyliosError
from hylios_fit.sensitivity import (
    DOMAINS,
    REMOVALS,
    Sensitivity,
    mean_sensitivity_index,
    sensitivity,
)
from hylios_fit.simulation import Curve
from hylios_fit.skin import SPECS, Specimen

ORDER = ("melanin", "blood", "DNA", "keratin", "water", "lipids")


def curve(nm, reflectance, error=0.0):
    reflectance = np.broadcast_to(np.asarray(reflectance, float), nm.shape)
    error = np.full(nm.shape, error)
    zero = np.zeros(nm.shape)
    return Curve(nm, reflectance, error, zero, reflectance, "none", 0, zero)


def asked(monkeypatch, law):
    """Every curve comes from `law(specimen, nm)`; returns the specimens and options asked for."""
    seen = []

    def simulate(specimen, nm, method, *, key, **options):
        seen.append((specimen, method, key, options))
        return curve(nm, law(specimen, nm))

    # by the module's name: `hylios_fit.sensitivity` is the function
    monkeypatch.setattr(sys.modules["hylios_fit.sensitivity"], "simulate", simulate)
    return seen


def test_equation_9_by_hand():
    assert mean_sensitivity_index([0.5, 0.2], [0.5, 0.1]) == pytest.approx(0.25)
    assert mean_sensitivity_index([0.4], [0.1]) == mean_sensitivity_index([0.1], [0.4])
    assert mean_sensitivity_index([0.4], [0.1]) == pytest.approx(0.75)
    assert mean_sensitivity_index([0.0, 0.3], [0.0, 0.0]) == 0.5, "two zeros do not differ"
    rng = np.random.default_rng(3)
    one, two = rng.random((2, 1000))
    assert 0 < mean_sensitivity_index(one, two) < 1
    assert mean_sensitivity_index(one, one) == 0
    assert mean_sensitivity_index(3 * one, 3 * two) == pytest.approx(
        mean_sensitivity_index(one, two)
    )


def test_each_removal_zeroes_its_parameters_and_no_other(monkeypatch):
    seen = asked(monkeypatch, lambda specimen, nm: 0.5)
    skin = Specimen.preset("S1").replace(blood_papillary=3.0)
    found = sensitivity(skin, "walker", key="a key", incidence=30.0)
    assert tuple(found.without) == tuple(REMOVALS) == ORDER
    base, *others = (specimen for specimen, *_ in seen)
    assert base == skin
    for material, specimen in zip(ORDER, others, strict=True):
        changed = {name for name in SPECS if specimen.values[name] != skin.values[name]}
        assert changed == set(REMOVALS[material])
        assert all(specimen.values[name] == 0 for name in changed)
    assert {(method, key, options["incidence"]) for _, method, key, options in seen} == {
        ("walker", "a key", 30.0)
    }, "the same random numbers for every curve"


def test_domains_hold_both_their_ends_in_steps_of_5_nm(monkeypatch):
    # without water the curve changes by a share that marks where it is
    def law(specimen, nm):
        mark = np.where(nm < 400, 0.1, np.where(nm == 400, 0.2, np.where(nm < 700, 0.3, 0.4)))
        return mark if specimen.water else 1.0

    asked(monkeypatch, law)
    found = sensitivity(Specimen(), "walker", key=jax.random.key(0))
    assert found.wavelength_nm[0] == 250
    assert found.wavelength_nm[-1] == 2500
    assert np.all(np.diff(found.wavelength_nm) == 5)
    assert found.msi("water", "UV") == pytest.approx((30 * 0.9 + 0.8) / 31)
    assert found.msi("water", "Vis") == pytest.approx((0.8 + 59 * 0.7 + 0.6) / 61)
    assert found.msi("water", "IR") == pytest.approx(0.6)
    assert found.msi("water") == pytest.approx((30 * 0.9 + 0.8 + 59 * 0.7 + 361 * 0.6) / 451)
    rows = found.rows()
    assert [row[:2] for row in rows] == [
        (material, domain) for material in ORDER for domain in DOMAINS
    ]
    assert rows[16] == ("water", "UV", found.msi("water", "UV"))


def test_standard_error_is_that_of_errors_shared_between_wavelengths():
    nm = np.arange(400.0, 701.0, 10.0)
    one, two = 0.3 + 0.2 * np.sin(nm / 40), 0.25 + 0.1 * np.cos(nm / 90)
    first, second = 0.0004, 0.0007
    stated = Sensitivity(curve(nm, one, first), {"blood": curve(nm, two, second)}).standard_error(
        "blood", "Vis"
    )
    # a common error of each curve in one direction of the index: the worst that sharing can do
    direction = np.sign(one - two)
    draws = np.random.default_rng(7).standard_normal((400, 2))
    index = [
        mean_sensitivity_index(one + first * direction * a, two - second * direction * b)
        for a, b in draws
    ]
    statistic = np.sum((np.array(index) - np.mean(index)) ** 2) / stated**2
    # at most: means of roots are below roots of means, here by little
    assert chi2.cdf(statistic, len(index) - 1) < 0.999
    assert np.std(index) > 0.85 * stated
    exact = Sensitivity(curve(nm, one), {"blood": curve(nm, two)})
    assert exact.standard_error("blood", "Vis") == 0


@pytest.mark.parametrize(("one", "two"), [(0.3, 0.3), (0.05, 0.0505), (0.6, 0.55), (0.2, 0.0)])
def test_noise_of_counted_rays_adds_what_two_counts_differ_by(one, two):
    nm = np.array([500.0])
    rays, draws = 100_000, 200_000
    found = Sensitivity(curve(nm, one), {"blood": curve(nm, two)})
    rng = np.random.default_rng(5)
    first, second = (rng.binomial(rays, r, draws) / rays for r in (one, two))
    each = np.abs(first - second) / np.maximum(first, second)
    error = each.std() / np.sqrt(draws)
    # the larger of two counts is above the larger mean: an error of the order of the noise squared
    noise2 = (one * (1 - one) + two * (1 - two)) / rays / max(one, two) ** 2
    assert abs(found.msi("blood", "Vis", counted=rays) - each.mean()) < 4 * error + noise2
    assert found.msi("blood", "Vis", counted=10**12) == pytest.approx(
        found.msi("blood", "Vis"), abs=2e-6
    )


def test_curves_without_noise_stay_as_they_are_when_counted():
    nm = np.array([500.0, 600.0])
    found = Sensitivity(curve(nm, [0.0, 1.0]), {"blood": curve(nm, [0.0, 0.0])})
    assert found.msi("blood", "Vis", counted=1000) == 0.5
    with pytest.raises(HyliosError, match="counted"):
        found.msi("blood", "Vis", counted=0)


def test_unknown_names_are_refused():
    nm = np.array([500.0])
    found = Sensitivity(curve(nm, 0.5), {"blood": curve(nm, 0.5)})
    with pytest.raises(HyliosError, match=r"UV, Vis, IR, all.*'visible'"):
        found.msi("blood", "visible")
    with pytest.raises(HyliosError, match="material is one of blood, got 'sugar'"):
        found.msi("sugar")
    with pytest.raises(HyliosError, match="key"):
        sensitivity(Specimen(), "walker")
    with pytest.raises(HyliosError, match="method"):
        sensitivity(Specimen(), "guess")


def test_the_walk_puts_materials_in_the_domains_of_the_paper(key, monkeypatch):
    above = {"melanin": ("Vis", "IR"), "blood": ("Vis", "IR"), "water": ("IR", "UV")}
    few = {material: REMOVALS[material] for material in above}
    monkeypatch.setattr(sys.modules["hylios_fit.sensitivity"], "REMOVALS", few)
    found = sensitivity(Specimen.preset("S3"), "walker", key=key, rays=8192)
    for material, (more, less) in above.items():
        error = np.hypot(*(found.standard_error(material, domain) for domain in (more, less)))
        assert found.msi(material, more) - found.msi(material, less) > 3 * error
    assert found.msi("water") > found.msi("melanin") > found.msi("blood")


def test_the_command_writes_a_row_for_each_material_and_domain(tmp_path, monkeypatch, capsys):
    seen = asked(monkeypatch, lambda specimen, nm: 0.2 if specimen.water else 0.6)
    path = tmp_path / "msi.csv"
    options = ["--set", "blood_papillary=2", "--method", "walker", "--incidence", "45"]
    assert cli.main(["sensitivity", "S3", "-o", str(path), *options, "--rays", "9"]) == 0
    assert capsys.readouterr().out == f"wrote {path}\n"
    with open(path, encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    assert header == ["material", "domain", "msi", "msi_counted"]
    assert [row[0] for row in rows[::4]] == list(ORDER)
    assert [row[1] for row in rows[:4]] == list(DOMAINS)
    assert {row[0] for row in rows if float(row[2])} == {"water"}
    assert rows[18][:3] == ["water", "IR", "0.6667"]
    specimen, method, _, given = seen[0]
    assert (specimen.blood_papillary, method) == (2.0, "walker")
    assert given["rays"] == 9
    assert given["incidence"] == 45.0


def test_the_command_solves_without_noise_and_says_what_it_would_add(tmp_path, monkeypatch):
    seen = asked(monkeypatch, lambda specimen, nm: 0.2)
    path = tmp_path / "msi.csv"
    assert cli.main(["sensitivity", "S3", "-o", str(path)]) == 0
    assert {method for _, method, *_ in seen} == {"adding"}
    # two counts of a fifth of the rays: 2/sqrt(pi) times the error of one, over 0.2
    noise = 2 / np.sqrt(np.pi) * np.sqrt(0.2 * 0.8 / 100_000) / 0.2
    for argv, factor in (([], 1), (["--counted", "400000"], 2)):
        assert cli.main(["sensitivity", "S3", "-o", str(path), *argv]) == 0
        for line in path.read_text().splitlines()[1:]:
            *_, msi, counted = line.split(",")
            assert msi == "0"
            assert float(counted) == pytest.approx(noise / factor, rel=1e-3)


@pytest.mark.parametrize("argv", [["S9"], ["S3", "--set", "water=9"], ["S3", "--method", "guess"]])
def test_the_command_refuses_bad_input_in_one_line(argv, tmp_path, capsys):
    path = tmp_path / "msi.csv"
    try:
        status = cli.main(["sensitivity", *argv, "-o", str(path)])
    except SystemExit as error:
        status = error.code
    assert status == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not path.exists()


def test_public_name_is_the_function():
    assert hf.sensitivity is public_sensitivity is sensitivity
    assert hf.Sensitivity is Sensitivity
