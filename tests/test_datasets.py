"""What ships in data/: complete, unchanged, well formed, and found wherever the package lies."""

import csv
import hashlib
import math
import shutil
from collections import Counter

import numpy as np
import pytest

from hylios_fit import datasets
from hylios_fit.errors import HyliosError
from hylios_fit.units import LN10, TO_NAPIERIAN, napierian_factor

GROUPS = {
    "Caucasian",
    "Chinese",
    "South Asian (Pakistani)",
    "African",
    "Middle Eastern (Iraqi)",
    "Southeast Asian (Thai)",
    "Japanese",
    "Middle Eastern (Arabian)",
}


@pytest.fixture
def copy_of_data(tmp_path, monkeypatch):
    """A copy of data/ that a test may damage, with the resolver pointed at it."""
    folder = tmp_path / "data"
    shutil.copytree(datasets.data_folder(), folder)
    monkeypatch.setattr(datasets, "data_folder", lambda: folder)
    datasets.read_absorber.cache_clear()
    yield folder
    datasets.read_absorber.cache_clear()


# --- hashes and sources -------------------------------------------------------------------------


def test_data_are_as_listed():
    datasets.verify()


def test_every_data_file_is_listed():
    folder = datasets.data_folder()
    listed = set(datasets.sources())
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        exempt = name == datasets.SOURCES or path.suffix in (".py", ".pyc")
        if path.is_file() and not exempt and not name.startswith("surrogate"):
            assert name in listed, name
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            assert datasets.sources()[name]["sha256"] == digest, name


def test_every_source_is_complete():
    for name, entry in datasets.sources().items():
        assert set(entry) == {"sha256", "what", "source", "doi", "terms"}, name
        assert all(entry.values()), name
        assert entry["doi"].startswith(("10.", "none")), name


def test_verify_names_a_changed_file(copy_of_data):
    path = copy_of_data / "absorbers" / "water.csv"
    path.write_bytes(path.read_bytes() + b"\n")
    with pytest.raises(HyliosError, match=r"absorbers/water\.csv was changed: sha256"):
        datasets.verify()


def test_verify_names_a_missing_file(copy_of_data):
    (copy_of_data / "skin" / "issa_examples.csv").unlink()
    with pytest.raises(HyliosError, match=r"skin/issa_examples\.csv is listed .* missing"):
        datasets.verify()


def test_damaged_sources(copy_of_data):
    (copy_of_data / datasets.SOURCES).write_text("sha256 = [", encoding="utf-8")
    with pytest.raises(HyliosError, match=r"SOURCES\.toml: damaged"):
        datasets.verify()


# --- finding ------------------------------------------------------------------------------------


def test_data_path():
    assert datasets.data_path("absorbers/water.csv").is_file()


def test_data_path_of_nothing():
    with pytest.raises(HyliosError, match=r"no data file 'absorbers/wine\.csv' in "):
        datasets.data_path("absorbers/wine.csv")


@pytest.mark.parametrize("inside", [True, False])
def test_folder_is_found_installed_and_in_a_checkout(tmp_path, monkeypatch, inside):
    package = tmp_path / "hylios_fit"
    folder = (package if inside else tmp_path) / "data"
    folder.mkdir(parents=True)
    (folder / datasets.SOURCES).touch()
    monkeypatch.setattr(datasets, "__file__", str(package / "datasets.py"))
    assert datasets.data_folder() == folder


def test_folder_that_is_nowhere(tmp_path, monkeypatch):
    monkeypatch.setattr(datasets, "__file__", str(tmp_path / "hylios_fit" / "datasets.py"))
    with pytest.raises(HyliosError, match="data folder is missing"):
        datasets.data_folder()


# --- absorber tables ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", datasets.ABSORBERS)
def test_table_is_well_formed(name):
    table = datasets.read_absorber(name)
    assert table.name == name
    assert table.wavelength_nm[0] == 250
    assert table.wavelength_nm[-1] == 2500
    assert np.all(np.diff(table.wavelength_nm) > 0)
    assert np.all(np.isfinite(table.value))
    assert np.all(table.value >= 0)
    assert table.value.max() > 0
    assert table.unit in TO_NAPIERIAN
    assert any(year in table.source for year in map(str, range(1940, 2026)))
    assert table.filled
    assert all(250 <= low < high <= 2500 for low, high in table.measured_nm)
    # What is not measured must be said to be filled.
    assert (table.measured_nm == ((250.0, 2500.0),)) == (table.filled == "none")
    with pytest.raises(ValueError, match="read-only"):
        table.value[0] = 1.0


def test_no_table_lies_beside_the_listed_ones():
    folder = datasets.data_folder() / "absorbers"
    assert {p.stem for p in folder.glob("*.csv")} == set(datasets.ABSORBERS)


def test_unknown_absorber():
    with pytest.raises(HyliosError, match="unknown absorber 'hemoglobin'; expected one of eumel"):
        datasets.read_absorber("hemoglobin")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text.replace("# unit:", "# einheit:"), "missing: unit"),
        (lambda text: text.replace("1/cm, Napierian", "1/m"), "unit '1/m' is not one of"),
        (lambda text: text.replace("wavelength_nm,value", "nm,mu"), "expected the columns"),
        (lambda text: text + "2600,1\n", "expected 250 to 2500 nm, got 250 to 2600"),
        (lambda text: text + "2500,1\n", "do not rise"),
        (lambda text: text.replace("\n250,", "\n250,-"), "finite and at least 0"),
        (lambda text: text.replace("\n250,", "\n250,nan #"), "expected two numbers in each row"),
        (lambda text: text + "2500\n", "expected two numbers in each row"),
        (lambda text: text.partition("\n250,")[0], "expected two columns of one length"),
    ],
)
def test_damaged_table(copy_of_data, damage, message):
    path = copy_of_data / "absorbers" / "water.csv"
    path.write_text(damage(path.read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(HyliosError, match=message):
        datasets.read_absorber("water")


def test_conversions():
    assert math.isclose(LN10, 2.302585093, rel_tol=1e-9)
    assert napierian_factor("1/cm, Napierian") == 1
    assert napierian_factor("mL/(mg cm), decadic") == LN10
    # One mmol/L of haem is 16.125 mg/mL.
    per_mmol = napierian_factor("L/(mmol cm), decadic", 16125.0)
    assert math.isclose(per_mmol * 16.125, LN10, rel_tol=1e-12)
    with pytest.raises(KeyError):
        napierian_factor("1/m")


# --- measured skin ------------------------------------------------------------------------------


def read_examples():
    with datasets.measured_examples_path().open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    return header, np.array(rows, dtype=np.float64)


def test_examples_are_a_spectra_file():
    header, values = read_examples()
    assert header[0] == "wavelength_nm"
    assert values.shape == (31, 41)
    np.testing.assert_array_equal(values[:, 0], np.arange(400, 701, 10))
    assert len(set(header)) == len(header)
    spectra = values[:, 1:]
    assert np.all(np.isfinite(spectra))
    assert spectra.min() >= 2.0  # percent
    assert spectra.max() <= 80.0


def test_examples_and_subjects_belong_together():
    header, values = read_examples()
    subjects = datasets.measured_examples_subjects()
    assert [s["spectrum"] for s in subjects] == header[1:]
    assert [f"issa_{int(s['record']):05d}_{s['site']}" for s in subjects] == header[1:]
    # Lightness goes with the reflectance in the green, where the eye sees most.
    lightness = np.array([float(s["L"]) for s in subjects])
    green = values[(values[:, 0] >= 530) & (values[:, 0] <= 590), 1:].mean(axis=0)
    assert np.corrcoef(lightness, green ** (1 / 3))[0, 1] > 0.98


def test_examples_are_spread():
    subjects = datasets.measured_examples_subjects()
    assert Counter(s["group"] for s in subjects) == dict.fromkeys(GROUPS, 5)
    assert len({s["subject"] for s in subjects}) == 40
    sites = Counter(s["site"] for s in subjects)
    assert len(sites) == 12
    assert max(sites.values()) <= 6
    ita = np.array([float(s["ITA"]) for s in subjects])
    assert ita.min() < -70  # darkest
    assert ita.max() > 55  # the class "very light"
    assert np.diff(np.sort(ita)).max() < 25
    for s in subjects:
        expected = math.degrees(math.atan2(float(s["L"]) - 50, float(s["b"])))
        assert math.isclose(float(s["ITA"]), expected, abs_tol=0.02)
    for group in GROUPS:
        within = [float(s["ITA"]) for s in subjects if s["group"] == group]
        assert within == sorted(within)
