"""The files of a run and its page: whole, repeatable, safe."""

import base64
import csv
import html.parser
import json
import re

import numpy as np
import pytest

from hylios_fit.errors import HyliosError
from hylios_fit.instrument import noise_sd
from hylios_fit.report import (
    PRINTED_ROWS,
    SHOWN_SPECTRA,
    print_table,
    read_dir,
    report,
    write_estimates,
    write_fitted,
)
from hylios_fit.results import MISSING, QUANTITIES, Estimate, Fit, Outcome, Posterior

SCRIPT = "<script>alert('x')</script> & \"q\""
FREE = ("eumelanin", "blood_papillary", "lipids")
BANDS = np.arange(400.0, 701.0, 10.0)
ADVICE = tuple(Outcome)


def make_fit(name, seed=0, outcome=Outcome.fitted, wavelength=BANDS, **changes):
    rng = np.random.default_rng(seed)
    melanin = rng.lognormal(0.5, 0.8)
    depth = 0.55 * np.exp(-0.2 * melanin)
    fitted = 0.05 + depth / (1 + np.exp(-(wavelength - 570) / 55))
    fitted = fitted - 0.12 * depth * np.exp(-(((wavelength - 560) / 22) ** 2))
    sd = noise_sd(wavelength, fitted)
    values = {
        "melanin_mg_per_mL": (melanin, 0.12 * melanin, True),
        "blood_percent": (rng.uniform(0.2, 3), 0.2, True),
        "oxygen_saturation": (rng.uniform(0.4, 0.9), 0.08, True),
        "water_percent": (71.3, 9.0, False),
        "eumelanin": (54.0, 30.0, False),
        "blood_papillary": (0.61, 0.33, True),
        "lipids": (1.0, 0.0, False),
    }
    fields = {
        "spectrum": name,
        "outcome": outcome,
        "messages": ("Not told by the data, mostly prior: water_percent.",),
        "wavelength_nm": wavelength,
        "measured": fitted + sd * np.cumsum(rng.normal(size=wavelength.size)) / 3,
        "fitted": fitted,
        "sd": sd,
        "residual_rms": float(rng.uniform(0.004, 0.02)),
        "reduced_chi2": 1.0345678912345,
        "inflation": 1.0,
        "model_error": 0.0,
        "iterations": 12,
        "form": "complex",
        "form_probability": {"complex": 0.93, "dispersed": 0.07},
        "names": FREE,
        "value": np.ones(3),
        "covariance": np.eye(3),
        "z": np.zeros(3),
        "z_covariance": np.eye(3),
        "quantities": {
            key: Estimate(v, sd, v - sd, v + 1.1 * sd, told)
            for key, (v, sd, told) in values.items()
        },
        "fixed": {"water": 1.0},
        "settings": {"versions": {"hylios_fit": "0.1"}, "key": [0, 7], "free": list(FREE)},
    }
    return Fit(**{**fields, **changes})


def make_unusable(name, why="line 3, column 2 (500 nm): expected a number, got '<b>x'"):
    nothing = np.full(BANDS.size, np.nan)
    return make_fit(
        name,
        outcome=Outcome.unusable,
        messages=(why,),
        measured=np.where(BANDS == 500, np.nan, 0.3),
        fitted=nothing,
        sd=nothing,
        residual_rms=np.nan,
        reduced_chi2=np.nan,
        iterations=0,
        form="",
        form_probability={},
        quantities=dict.fromkeys((*QUANTITIES, *FREE), MISSING),
    )


def make_posterior(name, converged=True, seed=3):
    xr = pytest.importorskip("xarray")
    arviz = pytest.importorskip("arviz")
    rng = np.random.default_rng(seed)
    draws = rng.multivariate_normal(
        [2.0, 1.0, 0.7, 70.0], np.diag([0.2, 0.2, 0.05, 8.0]) @ np.array(
            [[1, 0.5, 0, 0], [0.5, 1, -0.3, 0], [0, -0.3, 1, 0], [0, 0, 0, 1]]
        ) @ np.diag([0.2, 0.2, 0.05, 8.0]), size=(4, 500),
    )  # fmt: skip
    names = (*QUANTITIES, *FREE)
    columns = {n: draws[..., i] for i, n in enumerate(QUANTITIES)}
    columns |= {n: rng.lognormal(size=(4, 500)) for n in FREE}
    data = xr.Dataset(
        {n: (("chain", "draw"), columns[n], {"informed": int(i != 3)})
         for i, n in enumerate(names)}
    )  # fmt: skip
    return Posterior(
        spectrum=name,
        data=arviz.InferenceData(posterior=data),
        converged=converged,
        verdict="Converged: 83 autocorrelation times."
        if converged
        else "Not converged: too short.",
        rhat=dict.fromkeys(names, 1.004 if converged else 1.2),
        ess=dict.fromkeys(names, 2100.0 if converged else 90.0),
        autocorrelation_time=48.2,
        steps=4000,
        burn_in=1000,
        acceptance=0.34,
    )


@pytest.fixture
def fits():
    return [
        make_fit(SCRIPT, 1),
        make_fit("b, with a comma", 2, Outcome.at_bound),
        make_unusable("c"),
        make_fit("d", 4, Outcome.misfit),
        make_fit("e", 5, Outcome.not_converged),
    ]


def read(path):
    with open(path, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


class Page(html.parser.HTMLParser):
    """Tags, attributes and text of a page; complains about tags that are not closed in order."""

    VOID = ("meta", "img", "br")

    def __init__(self, path):
        super().__init__()
        self.tags, self.attributes, self.open, self.texts = [], [], [], []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *attribute) for attribute in attrs]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.texts.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.texts).split())

    @property
    def images(self):
        return [value for tag, name, value in self.attributes if (tag, name) == ("img", "src")]


# --- files --------------------------------------------------------------------------------------


def test_estimates_have_a_row_for_each_fit(tmp_path, fits):
    path = write_estimates(tmp_path, fits)
    header = path.read_text(encoding="utf-8").splitlines()[0].split(",")
    expected = ["spectrum", "outcome", "residual_rms", "reduced_chi2", "iterations"]
    for name in (*QUANTITIES, *FREE):
        expected += [name, f"{name}_sd"]
    assert header[: len(expected)] == expected
    for name in (*QUANTITIES, *FREE):
        assert f"{name}_low" in header
        assert f"{name}_high" in header
    assert header[-6:-3] == ["inflation", "model_error", "form"]
    assert header[-3:] == ["form_probability", "informed_by_data", "message"]
    rows = read(path)
    assert [row["spectrum"] for row in rows] == [fit.spectrum for fit in fits]
    assert [row["outcome"] for row in rows] == [fit.outcome.code for fit in fits]
    assert float(rows[0]["blood_percent"]) == pytest.approx(fits[0]["blood_percent"].value, 1e-6)
    told = "melanin_mg_per_mL blood_percent oxygen_saturation blood_papillary"
    assert rows[0]["informed_by_data"] == told
    failed = rows[2]
    assert failed["message"] == fits[2].messages[0]
    empty = [failed[name] for name in header if name.startswith(("melanin", "blood", "residual"))]
    assert set(empty) == {""}


def test_fitted_has_every_band(tmp_path, fits):
    rows = read(write_fitted(tmp_path, fits))
    assert len(rows) == len(fits) * BANDS.size
    assert list(rows[0]) == ["spectrum", "wavelength_nm", "measured", "fitted", "residual", "sd"]
    first = [row for row in rows if row["spectrum"] == SCRIPT]
    for name in ("wavelength_nm", "measured", "fitted", "residual", "sd"):
        found = [float(row[name]) for row in first]
        np.testing.assert_allclose(found, getattr(fits[0], name), rtol=1e-6)
    failed = [row for row in rows if row["spectrum"] == "c"]
    assert [row["measured"] for row in failed].count("") == 1
    assert {row["fitted"] for row in failed} == {""}


def test_settings_say_what_is_shared_and_what_is_not(tmp_path, fits):
    odd = make_fit("odd", settings={"versions": {"hylios_fit": "0.1"}, "key": np.array([0, 8])})
    write_estimates(tmp_path, [*fits, odd])
    content = json.loads((tmp_path / "settings.json").read_text(encoding="utf-8"))
    assert content["shared"] == {"versions": {"hylios_fit": "0.1"}, "held": {"water": 1.0}}
    assert content["by_spectrum"]["odd"] == {"key": [0, 8]}
    assert content["by_spectrum"]["c"]["key"] == [0, 7]


def test_files_read_back(tmp_path, fits):
    write_estimates(tmp_path, fits)
    write_fitted(tmp_path, fits)
    back, posteriors = read_dir(tmp_path)
    assert posteriors is None
    assert len(back) == len(fits)
    for one, other in zip(back, fits, strict=True):
        assert (one.spectrum, one.outcome, one.form) == (other.spectrum, other.outcome, other.form)
        assert (one.iterations, one.messages) == (other.iterations, other.messages)
        assert one.form_probability.get(one.form) == other.form_probability.get(other.form)
        assert one.settings == other.settings
        assert one.fixed == other.fixed
        np.testing.assert_allclose(one.measured, other.measured, rtol=1e-6)
        np.testing.assert_allclose(one.sd, other.sd, rtol=1e-6)
        assert set(one.quantities) == set(other.quantities)
        for name, estimate in other.quantities.items():
            found = one[name]
            assert found.informed == estimate.informed
            np.testing.assert_allclose(
                [found.value, found.sd, found.low, found.high],
                [estimate.value, estimate.sd, estimate.low, estimate.high],
                rtol=1e-6,
            )


def test_the_same_name_twice_is_refused(tmp_path):
    for write in (write_estimates, write_fitted):
        with pytest.raises(HyliosError, match="two fits are named 'a'"):
            write(tmp_path, [make_fit("a"), make_fit("a")])


def test_a_batch_is_written_in_seconds(tmp_path):
    import time

    one = make_fit("x")
    fields = {name: getattr(one, name) for name in one.__dataclass_fields__}
    fits = [Fit(**{**fields, "spectrum": f"s{i}"}) for i in range(3000)]
    start = time.perf_counter()
    write_estimates(tmp_path, fits)
    write_fitted(tmp_path, fits)
    back, _ = read_dir(tmp_path)
    assert len(back) == 3000
    assert time.perf_counter() - start < 20


BROKEN = {
    "nothing": ({}, "no estimates.csv"),
    "empty": ({"estimates.csv": ""}, "estimates.csv: line 1: expected a column 'spectrum'"),
    "cut": ({"estimates.csv": "spectrum,outcome,residual_rms,reduced_chi2,iterations\na,fit"},
            "line 2: expected 5 cells, got 2"),
    "outcome": ({"estimates.csv": "spectrum,outcome,residual_rms,reduced_chi2,iterations\n"
                 "a,great,,,\n"}, "line 2: 'great' is not a valid Outcome"),
    "number": ({"estimates.csv": "spectrum,outcome,residual_rms,reduced_chi2,iterations\n"
                "a,fitted,x,,\n"}, "line 2: could not convert"),
    "settings": ({"estimates.csv": "spectrum,outcome,residual_rms,reduced_chi2,iterations\n",
                  "settings.json": "{"}, "settings.json: not the settings"),
    "fitted": ({"estimates.csv": "spectrum,outcome,residual_rms,reduced_chi2,iterations\n",
                "fitted.csv": "spectrum,wavelength_nm,measured,fitted,residual,sd\na,x,,,,\n"},
               "fitted.csv: line 2"),
}  # fmt: skip


@pytest.mark.parametrize(("files", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_broken_folders(tmp_path, files, message):
    for name, content in files.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    with pytest.raises(HyliosError, match=message):
        read_dir(tmp_path)


def test_estimates_alone_are_enough_for_a_page(tmp_path, fits):
    write_estimates(tmp_path, fits)
    (tmp_path / "settings.json").unlink()
    back, _ = read_dir(tmp_path)
    page = Page(report(back, None, tmp_path / "report.html"))
    assert "No values to draw." in page.text


# --- the page -----------------------------------------------------------------------------------


def test_page_is_the_same_when_made_from_the_files(tmp_path, fits):
    from hylios_fit.results import write_posteriors

    posteriors = {SCRIPT: make_posterior(SCRIPT)}
    write_estimates(tmp_path, fits)
    write_fitted(tmp_path, fits)
    write_posteriors(list(posteriors.values()), tmp_path / "posterior.nc")
    first = report(fits, posteriors, tmp_path / "first.html").read_bytes()
    again = report(*read_dir(tmp_path), tmp_path / "again.html").read_bytes()
    assert again == first


def test_page_stands_alone_and_is_safe(tmp_path, fits):
    page = Page(report(fits, make_posterior(SCRIPT), tmp_path / "report.html"))
    assert "script" not in page.tags
    assert "<script" not in page.source
    assert SCRIPT in page.text
    assert "'<b>x'" in page.text
    assert "b" not in page.tags
    for _, name, value in page.attributes:
        assert not name.startswith("on")
        if name in ("src", "href"):
            assert value.startswith(("data:image/", "#"))
    assert not re.search(r"url\(|@import|https?://", page.source)
    for image in page.images:
        kind, _, content = image.partition(";base64,")
        raw = base64.b64decode(content, validate=True)
        assert raw.startswith(b"\x89PNG") if kind == "data:image/png" else b"<svg" in raw


def test_links_lead_somewhere(tmp_path, fits):
    page = Page(report(fits, None, tmp_path / "report.html"))
    ids = [value for _, name, value in page.attributes if name == "id"]
    assert len(ids) == len(set(ids))
    links = {value[1:] for tag, name, value in page.attributes if (tag, name) == ("a", "href")}
    assert links <= set(ids)
    assert {f"s{i}" for i in range(1, 6)} <= links


def test_page_says_what_there_is(tmp_path, fits):
    text = Page(report(fits, make_posterior(SCRIPT), tmp_path / "report.html")).text
    assert "3 of 5 spectra were fitted." in text
    for outcome in (Outcome.fitted, Outcome.at_bound, Outcome.unusable, Outcome.misfit):
        assert outcome.advice in text
    assert "CIEDE2000" in text
    assert "ITA" in text
    assert "held" in text
    assert "mg/mL" in text
    assert "Converged: 83 autocorrelation times." in text
    for said in ("R-hat", "ESS", "1.004", "2,100", "autocorrelation time (48.2 steps)"):
        assert said in text
    assert "versions, hylios_fit" in text
    assert "0, 7" in text


def test_prior_is_marked(tmp_path):
    told = make_fit("a")
    page = Page(report([told], None, tmp_path / "report.html"))
    marked = [value for tag, name, value in page.attributes if name == "class" and tag == "td"]
    assert marked.count("n prior") == 3  # water in both tables, eumelanin in one; not what is held
    assert "◇ marks a value that the prior tells" in page.text


def test_figures(tmp_path, fits):
    page = Page(report(fits, make_posterior(SCRIPT), tmp_path / "report.html"))
    # Five spectra, two corner plots; too few fits for an overview.
    assert len(page.images) == 7
    drawn = base64.b64decode(page.images[0].partition(",")[2]).decode()
    for words in ("Wavelength (nm)", "Reflectance (fraction)", "Residual", "measured", "fitted"):
        assert words in drawn
    assert "sd of noise and surrogate error" in drawn


def test_overview_of_many(tmp_path):
    page = Page(report([make_fit(f"s{i}", i) for i in range(8)], None, tmp_path / "report.html"))
    assert "individual typology angle" in page.text


@pytest.mark.parametrize(
    "wavelength",
    [np.array([800.0, 1200.0]), np.arange(1000.0, 2501.0, 50.0), np.arange(250.0, 2501.0, 3.0)],
)
def test_any_bands(tmp_path, wavelength):
    fits = [make_fit(f"s{i}", i, wavelength=wavelength) for i in range(5)]
    text = Page(report(fits, None, tmp_path / "report.html")).text
    assert ("CIEDE2000" in text) == (wavelength.size == 751)


def test_missing_bands(tmp_path):
    fit = make_fit("a")
    gap = np.where((BANDS > 500) & (BANDS < 520), np.nan, fit.measured)
    text = Page(report([make_fit("a", measured=gap)], None, tmp_path / "report.html")).text
    assert "over 30 bands" in text


def test_notes_are_shown(tmp_path):
    notes = {"notes": ["Unit: percent, by the values (largest <68>)."]}
    text = Page(report([make_fit("a", settings=notes)], None, tmp_path / "report.html")).text
    assert "How the spectra were read Unit: percent, by the values (largest <68>)." in text


def test_a_chain_that_did_not_converge_says_so(tmp_path):
    posterior = make_posterior("a", converged=False)
    page = Page(report([make_fit("a")], {"a": posterior}, tmp_path / "report.html"))
    assert "Not converged: too short." in page.text
    assert any(name == "class" and "poor" in (value or "") for _, name, value in page.attributes)


def test_control_characters_do_not_reach_the_page(tmp_path):
    path = report([make_fit("a\x00\x1b[31m")], None, tmp_path / "report.html")
    assert not re.search(rb"[\x00-\x08\x0b-\x1f]", path.read_bytes())


def test_of_many_a_sample_is_drawn_and_all_are_listed(tmp_path):
    one = make_fit("x")
    fields = {name: getattr(one, name) for name in one.__dataclass_fields__}
    count = SHOWN_SPECTRA + 40
    rms = np.random.default_rng(3).permutation(np.linspace(0.001, 0.02, count))
    fits = [
        Fit(**{**fields, "spectrum": f"spectrum {i}", "residual_rms": r}) for i, r in enumerate(rms)
    ]
    page = Page(report(fits, None, tmp_path / "report.html"))
    assert page.tags.count("article") == SHOWN_SPECTRA
    assert f"Of {count} spectra, {SHOWN_SPECTRA} are drawn" in page.text
    for fit in fits:
        assert fit.spectrum in page.text
    ids = {value for _, name, value in page.attributes if name == "id"}
    assert {f"s{i + 1}" for i in np.argsort(rms)[-20:]} <= ids
    assert f"s{np.argmin(rms) + 1}" in ids


def test_report_refuses_nonsense(tmp_path, fits):
    with pytest.raises(HyliosError, match="at least one fit"):
        report([], None, tmp_path / "report.html")
    with pytest.raises(HyliosError, match="a posterior of 'x'"):
        report(fits, make_posterior("x"), tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []


# --- the terminal -------------------------------------------------------------------------------


def test_printed_table(fits):
    text = print_table(fits)
    lines = text.splitlines()
    assert lines[0].startswith("spectrum")
    assert "melanin mg/ml" in lines[0].lower()
    assert sum(line.startswith(("<script", "b, with", "c ", "d ", "e ")) for line in lines) == 5
    assert "* mostly prior" in text
    assert "c: line 3, column 2" in text


def test_printed_table_is_safe_and_short():
    fits = [make_fit(f"\x1b[31mred {i}" + "x" * 50, i) for i in range(PRINTED_ROWS + 5)]
    text = print_table(fits)
    assert "\x1b" not in text
    assert "and 5 more spectra" in text
    assert max(map(len, text.splitlines())) < 160
