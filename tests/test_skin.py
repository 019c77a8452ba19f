"""Presets, the checking of values, and the coefficients of the layers."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hylios_fit import absorbers, melanosome, skin
from hylios_fit.errors import HyliosError
from hylios_fit.skin import LAYERS, SPECS, Specimen

NM = np.array([300.0, 550.0, 1000.0, 1450.0])

TABLE_I = {  # rows of the paper's Table I
    "S1": (1.0, 1.0, 1.0, 0.8, 90.0, 4.0, 0.2, 0.2),
    "S2": (0.0, 0.0, 3.75, 1.25, 50.0, 2.0, 0.7, 0.7),
    "S3": (0.0, 0.0, 3.0, 1.35, 32.0, 2.0, 0.3, 0.3),
    "S4": (10.0, 10.0, 10.0, 15.0, 50.0, 4.0, 2.5, 2.5),
}
NAMES = (
    "melanosome_granulosum",
    "melanosome_spinosum",
    "melanosome_basale",
    "colloidal_melanin",
    "eumelanin",
    "pheomelanin",
    "blood_papillary",
    "blood_reticular",
)


# --- specimens -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TABLE_I)
def test_presets_are_table_i(name):
    specimen = Specimen.preset(name)
    assert tuple(specimen.parameters(NAMES)) == TABLE_I[name]
    assert specimen.melanosome_form == ("dispersed" if name == "S4" else "complex")
    assert specimen.name == name
    rest = [n for n in SPECS if n not in NAMES]
    assert list(specimen.parameters(rest)) == [SPECS[n].default for n in rest]


def test_the_default_is_s3():
    assert Specimen().values == Specimen.preset("S3").values
    with pytest.raises(HyliosError, match="S1, S2, S3, S4, got 'S5'"):
        Specimen.preset("S5")


def test_every_default_lies_in_its_range():
    for name, spec in SPECS.items():
        assert name == spec.name
        assert spec.lower <= spec.default <= spec.upper
        assert spec.description


@pytest.mark.parametrize("name", list(SPECS))
def test_values_out_of_range_are_refused_by_name_value_and_range(name):
    spec = SPECS[name]
    for bad in (spec.lower - 1.0, spec.upper + 1.0, math.nan, math.inf, "much", None, True):
        with pytest.raises(HyliosError) as error:
            Specimen().replace(**{name: bad})
        text = str(error.value)
        assert name in text
        assert repr(bad) in text
        assert f"{spec.lower:g} to {spec.upper:g}" in text
    for good in (spec.lower, spec.upper):
        if not name.startswith(("melanosome", "colloidal")):
            assert getattr(Specimen().replace(**{name: good}), name) == good


def test_contents_that_overfill_a_stratum_are_refused():
    with pytest.raises(HyliosError, match="melanosome_basale and colloidal_melanin fill 110 %"):
        Specimen().replace(melanosome_basale=60, colloidal_melanin=50)


def test_unknown_names_are_refused_with_the_nearest():
    with pytest.raises(HyliosError, match="did you mean eumelanin"):
        Specimen().replace(eumelanine=3)
    with pytest.raises(HyliosError, match="no parameter named 'bloood_papillary'"):
        Specimen().parameters(["bloood_papillary"])
    with pytest.raises(HyliosError, match="complex, dispersed, compact, got 'loose'"):
        Specimen().replace(melanosome_form="loose")
    with pytest.raises(AttributeError):
        _ = Specimen().eumelanine


def test_specimens_are_frozen_and_compare_by_value():
    one = Specimen.preset("S1")
    with pytest.raises(AttributeError):
        one.melanosome_form = "dispersed"
    two = one.replace(water=0.9)
    assert one.water == 1.0
    assert two.water == 0.9
    assert two.replace(water=1.0) == one
    assert hash(two.replace(water=1.0)) == hash(one)
    assert list(two.parameters(["melanosome_form", "water"])) == [0.0, 0.9]
    assert Specimen.preset("S4").parameters(["melanosome_form"])[0] == 1.0


# --- reading -------------------------------------------------------------------------------------


def test_a_toml_file_starts_from_its_preset(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_text('preset = "S4"\nwater = 1.1\nmelanosome_form = "complex"\neumelanin = 60\n')
    specimen = skin.load_specimen(str(path))
    expected = Specimen.preset("S4").replace(water=1.1, melanosome_form="complex", eumelanin=60)
    assert specimen.values == expected.values
    assert specimen.melanosome_form == "complex"
    assert specimen.name == "arm"


def test_a_toml_file_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_bytes(b"\xef\xbb\xbfwater = 1.1\r\n")
    assert Specimen.from_toml(path).water == 1.1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("water == 1", "is not a TOML file"),
        ("\xff", "is not a TOML file"),
        ("water = 9", "water must lie in 0 to 1.33333"),
        ("watr = 1", "did you mean water"),
        ('preset = "S9"', "presets are S1, S2, S3, S4, got 'S9'"),
        ("[blood]\npapillary = 1", "no parameter named 'blood'"),
        ("water = [1, 2]", "water must lie in"),
    ],
)
def test_faulty_toml_files_are_refused_with_their_path(tmp_path, text, message):
    path = tmp_path / "arm.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(HyliosError, match=message) as error:
        Specimen.from_toml(path)
    assert str(path) in str(error.value)


def test_a_missing_toml_file(tmp_path):
    with pytest.raises(HyliosError, match=r"cannot read the specimen file .*none\.toml"):
        Specimen.from_toml(tmp_path / "none.toml")
    with pytest.raises(HyliosError, match="S1, S2, S3, S4 or a TOML file"):
        skin.load_specimen(str(tmp_path / "none.toml"))
    assert skin.load_specimen("S2") == Specimen.preset("S2")


def test_settings():
    specimen = skin.parse_setting(Specimen(), " water = 0.8 ")
    assert specimen.water == 0.8
    assert skin.parse_setting(specimen, "melanosome_form=dispersed").melanosome_form == "dispersed"
    for bad in ("water", "=1", "water=", ""):
        with pytest.raises(HyliosError, match="a setting is written NAME=VALUE"):
            skin.parse_setting(specimen, bad)
    with pytest.raises(HyliosError, match="water must lie in"):
        skin.parse_setting(specimen, "water=wet")


# --- coefficients --------------------------------------------------------------------------------


def test_the_papillary_absorption_is_equation_2_by_hand(x64):
    specimen = Specimen.preset("S2")
    zeta = absorbers.specific_absorption(NM)
    blood = (
        147 * 0.75 * zeta["oxyhaemoglobin"]
        + 147 * 0.25 * zeta["deoxyhaemoglobin"]
        + 1.5 * zeta["carboxyhaemoglobin"]
        + 1.5 * zeta["methaemoglobin"]
        + 0.003 * zeta["bilirubin"]
        + 7e-5 * zeta["beta_carotene"]
    )
    expected = 0.75 * zeta["water"] + 0.1733 * zeta["lipids"] + 0.007 * blood
    found = np.asarray(specimen.layers(NM, jnp.float64).mu_a)
    np.testing.assert_allclose(found[4], expected, rtol=1e-12)
    np.testing.assert_allclose(found[5], expected, rtol=1e-12)  # the same contents in S2
    melanin = 50 * zeta["eumelanin"] + 2 * zeta["pheomelanin"]
    epidermis = (
        0.60 * zeta["water"]
        + 0.151 * zeta["lipids"]
        + 5.0 * zeta["dna"]
        + 2.1e-4 * zeta["beta_carotene"]
        + 0.0125 * melanin
    )
    for layer in (1, 2, 3):
        np.testing.assert_allclose(found[layer], epidermis, rtol=1e-12)
    corneum = (
        0.35 * zeta["water"]
        + 0.20 * zeta["lipids"]
        + 0.65 * (zeta["keratin"] + zeta["corneum_tail"])
        + 0.01 * zeta["urocanic_acid"]
        + 2.1e-4 * zeta["beta_carotene"]
    )
    np.testing.assert_allclose(found[0], corneum, rtol=1e-12)


def test_attenuators_are_where_the_paper_has_them(dtype):
    layers = Specimen.preset("S3").layers(NM, dtype)
    assert all(part.dtype == dtype for part in layers)
    particle = np.asarray(layers.mu_particle)
    assert np.all(particle[[0, 1, 2, 4, 5]] == 0)
    np.testing.assert_allclose(1e4 / particle[3], 18, rtol=0.02)  # um
    assert np.all(np.asarray(layers.hit_albedo)[3] < 1)
    assert np.all(np.asarray(layers.hit_albedo)[[0, 4, 5]] == 1)
    assert np.all(np.asarray(layers.mu_tissue) == 0)
    assert np.all(np.asarray(layers.mu_fibre) > 0)
    s4 = np.asarray(Specimen.preset("S4").layers(NM, dtype).mu_particle)
    np.testing.assert_allclose(1e4 / s4[3], 2.24, rtol=0.01)
    np.testing.assert_allclose(s4[1], 4 * s4[3], rtol=1e-5)  # a quarter of the size
    np.testing.assert_allclose(s4[2], 2 * s4[3], rtol=1e-5)


def test_extensions_are_off_until_asked_for(x64):
    off = Specimen().layers(NM, jnp.float64)
    assert np.all(np.ptp(np.asarray(off.index), axis=1) == 0)
    assert float(off.bottom) == 1.0
    on = (
        Specimen()
        .replace(
            index_dispersion=0.04,
            reticular_scattering=20,
            reticular_scattering_power=1.2,
            bottom_reflectance=0.7,
        )
        .layers(NM, jnp.float64)
    )
    expected = 1.55 + 0.04 * ((500 / NM) ** 2 - 1)
    np.testing.assert_allclose(on.index[0], expected, rtol=1e-12)
    np.testing.assert_allclose(on.mu_tissue[5], 20 * (NM / 500) ** -1.2, rtol=1e-12)
    assert np.all(np.asarray(on.mu_tissue)[:5] == 0)
    assert float(on.bottom) == pytest.approx(0.7)


@pytest.mark.parametrize("form", ["complex", "dispersed"])
def test_layers_are_differentiable(form, dtype):
    specimen = Specimen.preset("S1").replace(melanosome_form=form, index_dispersion=0.01)

    def total(values):
        return sum(jnp.sum(part) for part in skin.layers(values, form, NM, dtype))

    values = {name: jnp.asarray(v, dtype) for name, v in specimen.values.items()}
    slopes = jax.grad(total)(values)
    for name, slope in slopes.items():
        assert slope.dtype == dtype
        assert np.isfinite(slope), name
    for name in NAMES:
        assert slopes[name] != 0, name


def test_melanin_inside_the_melanosomes(x64):
    zeta = absorbers.specific_absorption(NM)
    found = skin.melanin_coefficient(Specimen.preset("S1").values, NM)
    np.testing.assert_allclose(found, 90 * zeta["eumelanin"] + 4 * zeta["pheomelanin"])


def test_the_table_of_optics():
    specimen = Specimen.preset("S3")
    header, rows = skin.optics_rows(specimen, NM)
    assert header[:5] == (
        "wavelength_nm", "layer", "thickness_cm", "refractive_index", "mu_a_per_cm"
    )  # fmt: skip
    assert [row[1] for row in rows] == list(LAYERS) * len(NM)
    assert all(len(row) == len(header) for row in rows)
    table = [dict(zip(header, row, strict=True)) for row in rows[6:12]]
    assert [row["wavelength_nm"] for row in table] == ["550"] * 6
    assert [row["attenuator"] for row in table] == ["none"] * 3 + ["melanosome", "fibre", "none"]
    layers = specimen.layers(NM)
    assert float(table[3]["mu_s_per_cm"]) == pytest.approx(
        float(layers.mu_particle[3, 1]), rel=1e-5
    )
    assert float(table[3]["albedo"]) == pytest.approx(float(layers.hit_albedo[3, 1]), rel=1e-5)
    assert float(table[3]["mean_angle_rad"]) == pytest.approx(math.radians(5), rel=1e-5)
    assert float(table[4]["mu_s_per_cm"]) == pytest.approx(float(layers.mu_fibre[1]), rel=1e-5)
    for i, row in enumerate(table):
        assert float(row["mu_a_per_cm"]) == pytest.approx(float(layers.mu_a[i, 1]), rel=1e-5)
        assert float(row["thickness_cm"]) == pytest.approx(float(layers.thickness[i]), rel=1e-5)
        assert float(row["refractive_index"]) == pytest.approx(float(layers.index[i, 1]), rel=1e-5)
    scattering = specimen.replace(reticular_scattering=5.0)
    assert skin.optics_rows(scattering, NM)[1][5][5] == "tissue"


def test_the_smaller_index_of_a_melanosomes_surroundings_matters():
    one, two = (
        Specimen().replace(index_epidermis=n).layers(NM).hit_albedo[3, 0] for n in (1.35, 1.60)
    )
    # weaker bounces at a smaller contrast leave less time to absorb
    assert melanosome.MELANIN_INDEX > 1.60
    assert float(one) < float(two)
