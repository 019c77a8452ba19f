"""Reading spectra: what is read, what is refused, and that no row is lost."""

import csv
import os

import numpy as np
import pytest

from hylios_fit.errors import HyliosError
from hylios_fit.spectra import Spectra, as_spectra, read_spectra, write_csv

PLAIN = "wavelength_nm,a,b\n400,0.1,0.2\n500,0.3,0.4\n600,0.5,0.6\n"
WAVELENGTH = [400.0, 500.0, 600.0]
VALUES = [[0.1, 0.3, 0.5], [0.2, 0.4, 0.6]]


@pytest.fixture
def read(tmp_path):
    def reader(content, **options):
        path = tmp_path / "spectra.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_spectra(path, **options)

    return reader


def assert_plain(spectra):
    assert spectra.names == ("a", "b")
    assert spectra.problems == (None, None)
    np.testing.assert_array_equal(spectra.wavelength_nm, WAVELENGTH)
    np.testing.assert_allclose(spectra.reflectance, VALUES, rtol=1e-12)


# --- layouts that mean the same -----------------------------------------------------------------

SAME = {
    "plain": PLAIN,
    "semicolon": PLAIN.replace(",", ";"),
    "tab": PLAIN.replace(",", "\t"),
    "decimal comma": PLAIN.replace(",", ";").replace(".", ","),
    "decimal comma, tab": PLAIN.replace(",", "\t").replace(".", ","),
    "byte-order mark": b"\xef\xbb\xbf" + PLAIN.encode(),
    "CRLF": PLAIN.replace("\n", "\r\n"),
    "CR": PLAIN.replace("\n", "\r"),
    "byte-order mark and CRLF": b"\xef\xbb\xbf" + PLAIN.replace("\n", "\r\n").encode(),
    "UTF-16": PLAIN.encode("utf-16"),
    "comments and blank lines": "# made by hand\n\n" + PLAIN.replace("500", "\n500"),
    "spaces": PLAIN.replace(",", " , "),
    "trailing delimiters": PLAIN.replace("\n", ",\n"),
    "quoted": '"wavelength_nm","a","b"\n"400","0.1","0.2"\n500,0.3,0.4\n600,0.5,0.6\n',
    "unsorted": "wavelength_nm,a,b\n500,0.3,0.4\n600,0.5,0.6\n400,0.1,0.2\n",
    "falling": "wavelength_nm,a,b\n600,0.5,0.6\n500,0.3,0.4\n400,0.1,0.2\n",
    "percent": "wavelength_nm,a,b\n400,10,20\n500,30,40\n600,50,60\n",
    "transposed": "name,400,500,600\na,0.1,0.3,0.5\nb,0.2,0.4,0.6\n",
    "transposed, unit": "name,400 nm,500nm,600_nm\na,0.1,0.3,0.5\nb,0.2,0.4,0.6\n",
    "transposed, no corner": ",400,500,600\na,0.1,0.3,0.5\nb,0.2,0.4,0.6\n",
    "transposed, wavelength corner": "wavelength_nm,400,500,600\na,0.1,0.3,0.5\nb,0.2,0.4,0.6\n",
    "transposed, decimal comma": "name;400,0;500,0;600,0\na;0,1;0,3;0,5\nb;0,2;0,4;0,6\n",
    "transposed, metadata": "name,site,400,500,600\na,arm,0.1,0.3,0.5\nb,brow,0.2,0.4,0.6\n",
    "transposed, unsorted": "name,600,400,500\na,0.5,0.1,0.3\nb,0.6,0.2,0.4\n",
}


@pytest.mark.parametrize("content", SAME.values(), ids=SAME.keys())
def test_layouts(read, content):
    assert_plain(read(content))


@pytest.mark.parametrize(
    "header",
    ["wavelength", "Wavelength (nm)", "WAVELENGTH_NM", "Wavelength [nm]", "nm", "NM", "wl",
     "WL nm", "wl/nm", "wavelengths", "wave length (nanometres)", "wavelength, nm"],
)  # fmt: skip
def test_headers(read, header):
    assert_plain(read(PLAIN.replace("wavelength_nm", f'"{header}"')))


def test_spectra_may_be_called_by_numbers(read):
    spectra = read("wavelength_nm,1,2\n400,0.1,0.2\n500,0.3,0.4\n")
    assert spectra.names == ("1", "2")
    np.testing.assert_array_equal(spectra.wavelength_nm, [400, 500])


# --- notes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("layout", "said"),
    [
        ("plain", "Unit: fraction"),
        ("percent", "Unit: percent"),
        ("unsorted", "unsorted"),
        ("falling", "falling"),
        ("transposed", "row for each spectrum"),
        ("transposed, metadata", "'site'"),
    ],
)
def test_what_was_decided_is_said(read, layout, said):
    assert any(said in note for note in read(SAME[layout]).notes)


def test_a_plain_file_needs_few_words(read):
    assert len(read(PLAIN).notes) == 1
    assert read(PLAIN, unit="fraction").notes == ()


def test_other_encodings_are_read_and_said(read):
    spectra = read(PLAIN.replace("a,b", "ä,b").encode("cp1252"))
    assert spectra.names[0] == "ä"
    assert any("UTF-8" in note for note in spectra.notes)


# --- files that cannot be used -------------------------------------------------------------------

REFUSED = {
    "zero bytes": (b"", r"zero bytes.*wavelength_nm"),
    "only blanks": ("  \n\n", r"no text"),
    "only comments": ("# a\n# b\n", r"only comments"),
    "binary": (b"\x00\x01\x02,\x00\n", r"binary"),
    "spreadsheet": (b"PK\x03\x04rest", r"save it as CSV"),
    "no header": ("400,0.1\n500,0.2\n", r"line 1: no header: expected.*wavelength_nm.*'400,0.1'"),
    "other header": ("x,a\n400,0.1\n500,0.2\n", r"line 1: no header.*'x,a'"),
    "header only": ("wavelength_nm,a\n", r"no data below line 1"),
    "no spectra": ("wavelength_nm\n400\n500\n", r"no spectra.*one column"),
    "spaces between columns": ("wavelength_nm a\n400 0.1\n", r"commas, semicolons or tabs.*'wave"),
    "bars between columns": ("wavelength_nm|a\n400|0.1\n", r"commas, semicolons or tabs"),
    "header and body disagree": ("wavelength_nm,a\n400;0.1\n500;0.2\n", r"line 2.*got '400;0.1'"),
    "decimal comma, comma": ("wavelength_nm,a\n400,0,1\n500,0,3\n", r"line 2: expected 2.*got 3.*"
                             r"decimal"),
    "text for a wavelength": (PLAIN.replace("500", "5OO"), r"line 3, column 1: .*got '5OO'"),
    "no wavelength": (PLAIN.replace("500", ""), r"line 3, column 1: .*got ''"),
    "NaN wavelength": (PLAIN.replace("500", "NaN"), r"line 3, column 1: .*got 'NaN'"),
    "wavelength twice": (PLAIN.replace("500", "400.0"), r"400 nm twice \(line 2.* and line 3"),
    "wavelength twice, transposed": ("n,400,500,400\na,.1,.2,.3\n", r"400 nm twice .*column 4"),
    "all outside": (PLAIN.replace("00,", ","), r"outside 250 to 2500 nm: 4 to 6"),
    "micrometres": (PLAIN.replace("00,", ",").replace("\n", "\n0.").removesuffix("0."),
                    r"outside 250 to 2500.*micrometres"),
    "other unit": (PLAIN.replace("_nm", "_um"), r"expected wavelengths in nm.*'wavelength_um'"),
    "single band": ("wavelength_nm,a\n400,0.1\n", r"single band \(400 nm\); at least 2"),
    "single band, transposed": ("name,400\na,0.1\n", r"single band"),
    "single band left": ("wavelength_nm,a\n100,0.1\n400,0.2\n", r"single band"),
    "cells beyond the header": (PLAIN + "700,0.1,0.2,0.3\n", r"line 5: expected 3 cells.*got 4"),
    "text between wavelengths": ("n,400,5OO,600\na,.1,.2,.3\n", r"line 1, column 3.*got '5OO'"),
    "open quote": ('wavelength_nm,"a\n400,0.1\n', r"unexpected end|no header|commas"),
    "between the units": (PLAIN.replace("0.5", "1.5").replace("0.6", "1.6"),
                          r"cannot tell fractions from percent: .* 1\.6 \(at 600 nm"),
    "units mixed": ("nm,a,b\n400,0.1,10\n500,0.2,20\n", r"1 .*fractions and 1 .*percent"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_refused(read, content, message):
    with pytest.raises(HyliosError, match=message) as caught:
        read(content)
    assert "spectra.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_forced_unit_against_the_values(read):
    with pytest.raises(HyliosError, match=r"unit percent was asked for.*fractions.*0\.6"):
        read(PLAIN, unit="percent")
    with pytest.raises(HyliosError, match=r"unit fraction was asked for.*percent.*60"):
        read(SAME["percent"], unit="fraction")


def test_a_forced_unit_settles_what_auto_refuses(read):
    content = "nm,a,b\n400,0.1,0.2\n500,1.5,0.4\n600,1.6,0.6\n"
    spectra = read(content, unit="fraction")
    assert spectra.problems[0] is not None
    dark = read("nm,a\n300,0.9\n400,1.5\n500,1.6\n", unit="percent")
    np.testing.assert_allclose(dark.reflectance, [[0.009, 0.015, 0.016]])
    assert dark.problems == (None,)


def test_unknown_unit(read):
    with pytest.raises(HyliosError, match=r"expected one of auto, fraction, percent, got 'ppm'"):
        read(PLAIN, unit="ppm")


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(HyliosError, match=r"nothing\.csv: cannot be read"):
        read_spectra(tmp_path / "nothing.csv")
    with pytest.raises(HyliosError, match="cannot be read"):
        read_spectra(tmp_path)


# --- spectra that cannot be used: a row that says why ---------------------------------------------


@pytest.mark.parametrize(
    ("cell", "why"),
    [
        ("O.3", r"line 3, column 2 \(500 nm\): expected a number, got 'O.3'"),
        ("inf", r"line 3, column 2 \(500 nm\): expected a number, got 'inf'"),
        ("1_0", r"expected a number, got '1_0'"),
        ("-0.2", r"line 3, column 2 \(500 nm\): reflectance below 0: -0.2"),
        ("1.15", r"line 3, column 2 \(500 nm\): reflectance above 1: 1.15"),
    ],
)
@pytest.mark.parametrize("turned", [False, True])
def test_a_bad_cell_spoils_its_spectrum_only(read, cell, why, turned):
    if turned:
        content = f"n,400,500,600\na,0.1,{cell},0.5\nb,0.2,0.4,0.6\n"
        why = why.replace("line 3, column 2", "line 2, column 3")
    else:
        content = PLAIN.replace("0.3", cell)
    spectra = read(content)
    assert spectra.names == ("a", "b")
    assert spectra.problems[1] is None
    with pytest.raises(HyliosError, match=why):
        raise HyliosError(spectra.problems[0])
    np.testing.assert_allclose(spectra.reflectance[1], VALUES[1])


@pytest.mark.parametrize("cell", ["", "NaN", "nan", "NA", "n/a", "-"])
def test_missing_bands_are_noted_and_the_rest_kept(read, cell):
    spectra = read(PLAIN.replace("0.3", cell))
    assert spectra.problems == (None, None)
    assert np.isnan(spectra.reflectance[0, 1])
    assert any("1 of 3 bands (500 nm)" in note and "'a'" in note for note in spectra.notes)
    wavelength, values = spectra.bands(0)
    np.testing.assert_array_equal(wavelength, [400, 600])
    np.testing.assert_array_equal(values, [0.1, 0.5])


def test_an_empty_spectrum_keeps_its_row(read):
    spectra = read("nm,a,b,c\n400,0.1,,\n500,0.3,,0.2\n600,0.5,,\n")
    assert spectra.names == ("a", "b", "c")
    assert spectra.problems[0] is None
    assert "every band is empty" in str(spectra.problems[1])
    assert "1 band has a value; at least 2" in str(spectra.problems[2])


def test_rows_cut_short_are_missing_bands(read):
    spectra = read(PLAIN.removesuffix(",0.6\n"))
    assert np.isnan(spectra.reflectance[1, 2])
    assert any("Line 4 has 2 of 3 cells" in note for note in spectra.notes)


def test_noise_about_the_limits_is_tolerated(read):
    spectra = read("nm,a,b\n400,-0.004,0.5\n500,0.3,1.01\n")
    assert spectra.problems == (None, None)
    assert spectra.reflectance[0, 0] == -0.004
    assert any("below 0 (to -0.004)" in note and "'a'" in note for note in spectra.notes)
    assert any("above 1 (to 1.01)" in note and "'b'" in note for note in spectra.notes)


def test_one_spectrum_in_the_other_unit_does_not_lose_the_file(read):
    rows = [f"s{i},0.2,0.3,0.4" for i in range(9)]
    spectra = read("\n".join(["n,400,500,600", *rows, "odd,20,30,40"]))
    assert spectra.problems[:9] == (None,) * 9
    assert "percent in a file of fractions" in str(spectra.problems[9]) or "above 1" in str(
        spectra.problems[9]
    )
    rows = [f"s{i},20,30,40" for i in range(9)]
    spectra = read("\n".join(["n,400,500,600", *rows, "odd,0.2,0.3,0.4"]))
    assert spectra.problems[:9] == (None,) * 9
    assert "fraction in a file of percent" in str(spectra.problems[9])


def test_many_bad_cells_stay_one_line(read):
    rows = "".join(f"{400 + i},x,0.5\n" for i in range(20))
    spectra = read("nm,a,b\n" + rows)
    assert "and 17 more" in str(spectra.problems[0])
    assert spectra.problems[1] is None


# --- bands, names, noise --------------------------------------------------------------------------


def test_bands_outside_are_left_out_and_said(read):
    spectra = read(PLAIN + "2600,7,x\n")
    assert_plain(spectra)
    assert any("left out: 2600 nm" in note for note in spectra.notes)


def test_range(read):
    spectra = read(PLAIN, wavelength_range=(450, 600))
    np.testing.assert_array_equal(spectra.wavelength_nm, [500, 600])
    assert any("2 of 3 bands" in note for note in spectra.notes)
    with pytest.raises(HyliosError, match=r"no band in the range 700 to 800 nm.*400 to 600"):
        read(PLAIN, wavelength_range=(700, 800))
    with pytest.raises(HyliosError, match="shorter wavelength first, got 700:400"):
        read(PLAIN, wavelength_range=(700, 400))
    with pytest.raises(HyliosError, match="single band"):
        read(PLAIN, wavelength_range=(450, 550))


def test_values_outside_the_range_do_no_harm(read):
    assert read(PLAIN.replace("0.1", "-0.7"), wavelength_range=(450, 600)).problems == (None, None)


def test_duplicate_names_are_numbered_and_kept(read):
    spectra = read("nm,a,a,a (2),a\n400,.1,.2,.3,.4\n500,.1,.2,.3,.4\n")
    assert spectra.names == ("a", "a (3)", "a (2)", "a (4)")
    np.testing.assert_array_equal(spectra.reflectance[:, 0], [0.1, 0.2, 0.3, 0.4])
    assert any("numbered" in note for note in spectra.notes)


def test_names_are_data(read):
    name = "<script>alert('x')</script> & \"q\""
    quoted = '"' + name.replace('"', '""') + '"'
    assert read(PLAIN.replace("a,b", f"{quoted},b")).names == (name, "b")


def test_nameless_columns_keep_their_spectra(read):
    assert read(PLAIN.replace("a,b", "a,")).names == ("a", "column 3")


def test_noise_column(read):
    content = "nm,a,sd\n500,30,0.2\n400,10,0.1\n"
    spectra = read(content, noise_column="sd")
    assert spectra.names == ("a",)
    np.testing.assert_allclose(spectra.noise, [0.001, 0.002])
    with pytest.raises(HyliosError, match="no column 'x'"):
        read(content, noise_column="x")
    with pytest.raises(HyliosError, match=r"400 nm\): expected a noise above 0, got 0"):
        read(content.replace("0.1", "0"), noise_column="sd")
    with pytest.raises(HyliosError, match="no spectra beside"):
        read("nm,sd\n500,30\n400,10\n", noise_column="sd")


def test_ten_thousand_spectra(read):
    rng = np.random.default_rng(1)
    bands = np.arange(400, 701, 10)
    values = rng.uniform(5, 70, (10_000, bands.size)).round(2)
    lines = ["name," + ",".join(map(str, bands))]
    lines += [f"s{i}," + ",".join(map(str, row)) for i, row in enumerate(values.tolist())]
    spectra = read("\n".join(lines))
    np.testing.assert_allclose(spectra.reflectance, values / 100, rtol=1e-12)
    assert len(spectra.notes) == 2


# --- Spectra --------------------------------------------------------------------------------------


def test_spectra_check_themselves():
    good = Spectra(np.array(WAVELENGTH), ("a", "b"), np.array(VALUES), (None, None))
    assert len(good) == 2
    with pytest.raises(ValueError, match="read-only"):
        good.reflectance[0, 0] = 0
    assert good.select([1]).names == ("b",)
    np.testing.assert_array_equal(good.select([1, 0]).reflectance, VALUES[::-1])
    for arguments in (
        ([400.0, 400.0, 600.0], ("a", "b"), VALUES, (None, None)),
        (WAVELENGTH, ("a",), VALUES, (None,)),
        (WAVELENGTH, ("a", "b"), VALUES, (None,)),
        (WAVELENGTH, ("a", "a"), VALUES, (None, None)),
        ([WAVELENGTH], ("a", "b"), VALUES, (None, None)),
        (WAVELENGTH, ("a", "b"), VALUES, (None, None), (), "", [0.1]),
    ):
        with pytest.raises(HyliosError, match="expected"):
            Spectra(*arguments)


# --- other libraries' objects ---------------------------------------------------------------------


def test_arrays():
    spectra = as_spectra((WAVELENGTH, VALUES[0]))
    assert spectra.names == ("spectrum",)
    np.testing.assert_array_equal(spectra.reflectance, VALUES[:1])
    spectra = as_spectra(np.array(VALUES), np.array(WAVELENGTH))
    assert spectra.names == ("spectrum 1", "spectrum 2")
    assert as_spectra(spectra) is spectra
    assert as_spectra(spectra, wavelength_range=(450, 700)).wavelength_nm.size == 2
    spoilt = as_spectra((WAVELENGTH, [[0.1, np.inf, 0.3], [0.1, 0.2, 0.3]]))
    assert "finite" in str(spoilt.problems[0])
    assert spoilt.problems[1] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((3.0,), "expected a spectrum"),
        (("spectra.csv",), "use read_spectra"),
        (((WAVELENGTH, [0.1, 0.2]),), r"for 3 wavelengths, got \(1, 2\)"),
        (((WAVELENGTH, ["x", "y", "z"]),), "expected numbers"),
        ((([np.nan, 1, 2], VALUES[0]),), "finite wavelengths"),
        ((([400.0, 400.0, 500.0], VALUES[0]),), "400 nm twice"),
        ((([], []),), "at least one spectrum"),
        ((([400.0], [0.1]),), "single band"),
    ],
)
def test_refused_objects(arguments, message):
    with pytest.raises(HyliosError, match=message):
        as_spectra(*arguments)


def test_pandas():
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame(np.array(VALUES).T, index=WAVELENGTH, columns=["a", "b"])
    assert_plain(as_spectra(frame))
    assert_plain(as_spectra(frame.T))
    series = as_spectra(frame["a"])
    assert series.names == ("a",)
    np.testing.assert_array_equal(series.reflectance, VALUES[:1])
    with pytest.raises(HyliosError, match="brings its own"):
        as_spectra(frame, WAVELENGTH)


def test_xarray():
    xr = pytest.importorskip("xarray")
    array = xr.DataArray(
        np.array(VALUES).T,
        coords={"wavelength": WAVELENGTH, "name": ["a", "b"]},
        dims=("wavelength", "name"),
    )
    assert_plain(as_spectra(array))
    assert_plain(as_spectra(array.T))
    assert as_spectra(array[:, 0].drop_vars("name").rename("a")).names == ("a",)
    with pytest.raises(HyliosError, match="expected one dimension wavelength_nm"):
        as_spectra(array.rename(wavelength="x"))


@pytest.mark.filterwarnings("ignore")
def test_colour():
    colour = pytest.importorskip("colour")
    single = colour.SpectralDistribution(dict(zip(WAVELENGTH, VALUES[0], strict=True)), name="a")
    np.testing.assert_array_equal(as_spectra(single).reflectance, VALUES[:1])
    assert as_spectra(single).names == ("a",)
    both = colour.MultiSpectralDistributions(np.array(VALUES).T, WAVELENGTH, labels=["a", "b"])
    assert_plain(as_spectra(both))


# --- writing --------------------------------------------------------------------------------------


def test_write_csv_reads_back(tmp_path):
    path = tmp_path / "new" / "table.csv"
    write_csv(path, ["name", "x"], [["a,b", 0.1], ['<q">', None]])
    with open(path, newline="", encoding="utf-8") as stream:
        assert list(csv.reader(stream)) == [["name", "x"], ["a,b", "0.1"], ['<q">', ""]]


def test_write_csv_leaves_the_old_file_when_it_fails(tmp_path):
    path = tmp_path / "table.csv"
    write_csv(path, ["x"], [[1]])

    def rows():
        yield [2]
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError):
        write_csv(path, ["x"], rows())
    assert path.read_text() == "x\n1\n"
    assert os.listdir(tmp_path) == ["table.csv"]


def test_write_csv_says_where_it_cannot_write(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(HyliosError, match=r"table\.csv: cannot be written"):
        write_csv(tmp_path / "file" / "table.csv", ["x"], [])
