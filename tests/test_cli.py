"""The commands: arguments, exit status, files. What they compute is tested beside each module."""

import csv
import functools
import json

import numpy as np
import pytest
from toy_surrogate import ToySurrogate

from hylios_fit import cli
from hylios_fit.errors import HyliosError


def run(*argv) -> int:
    """Exit status of one command."""
    try:
        return cli.main([str(part) for part in argv])
    except SystemExit as error:
        return int(error.code or 0)


def read(path) -> tuple[list[str], list[list[str]]]:
    with open(path, encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    return header, rows


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def spectra(folder):
    """A file whose second spectrum cannot be fitted."""
    nm = np.arange(400, 701, 10)
    values = [2.0, 2.0, 4.0, 3.0, 30.0, 2.0, 0.5, 0.5, 0.7, 1.0, 1.0]
    good = np.asarray(ToySurrogate().at("complex").on(nm)(np.array(values)))
    rows = [f"{w},{r:.4f},{'x' if w == 500 else f'{r:.4f}'}" for w, r in zip(nm, good, strict=True)]
    path = folder / "spectra.csv"
    path.write_text("\n".join(["wavelength_nm,good,bad", *rows]) + "\n", encoding="utf-8")
    return path


# --- errors ------------------------------------------------------------------------------------

BAD = {
    "no command": ([], "COMMAND"),
    "unknown command": (["brew"], "brew"),
    "no specimen": (["simulate", "-o", "a.csv"], "SPECIMEN"),
    "no output": (["simulate", "S1"], "-o"),
    "unknown specimen": (["simulate", "S9", "-o", "a.csv"], "S9"),
    "unknown method": (["simulate", "S1", "-o", "a.csv", "--method", "guess"], "guess"),
    "wavelengths in words": (["optics", "S1", "-o", "a.csv", "--wavelengths", "red"], "red"),
    "wavelengths backwards": (
        ["optics", "S1", "-o", "a.csv", "--wavelengths", "700:400:5"],
        "--wavelengths",
    ),
    "wavelengths without a step": (
        ["optics", "S1", "-o", "a.csv", "--wavelengths", "400:700"],
        "LOW:HIGH:STEP",
    ),
    "step of zero": (
        ["optics", "S1", "-o", "a.csv", "--wavelengths", "400:700:0"],
        "--wavelengths",
    ),
    "wavelength outside the tables": (
        ["optics", "S1", "-o", "a.csv", "--wavelengths", "3000"],
        "3000",
    ),
    "setting without a value": (["optics", "S1", "-o", "a.csv", "--set", "water"], "NAME=VALUE"),
    "unknown parameter": (["optics", "S1", "-o", "a.csv", "--set", "sugar=1"], "sugar"),
    "impossible value": (
        ["optics", "S1", "-o", "a.csv", "--set", "oxygen_saturation=2"],
        "oxygen_saturation",
    ),
    "no rays": (["simulate", "S1", "-o", "a.csv", "--rays", "0"], "--rays"),
    "half a ray": (["simulate", "S1", "-o", "a.csv", "--rays", "1.5"], "1.5"),
    "negative seed": (["simulate", "S1", "-o", "a.csv", "--seed", "-1"], "--seed"),
    "seed of 33 bits": (["simulate", "S1", "-o", "a.csv", "--seed", 2**32], str(2**32)),
    "folder that is not there": (["optics", "S1", "-o", "no/a.csv"], "no"),
    "output is a folder": (["optics", "S1", "-o", "."], "folder"),
    "missing spectra": (["fit", "none.csv", "-o", "out"], "none.csv"),
    "output is a file": (["fit", "spectra.csv", "-o", "spectra.csv"], "spectra.csv"),
    "range of one number": (["fit", "spectra.csv", "-o", "out", "--range", "400"], "--range"),
    "range backwards": (["fit", "spectra.csv", "-o", "out", "--range", "700:400"], "--range"),
    "unknown unit": (["fit", "spectra.csv", "-o", "out", "--unit", "permille"], "permille"),
    "noise column that is not there": (
        ["fit", "spectra.csv", "-o", "out", "--noise", "sigma"],
        "sigma",
    ),
    "noise below 0": (["fit", "spectra.csv", "-o", "out", "--noise=-0.01"], "-0.01"),
    "fix without a value": (["fit", "spectra.csv", "-o", "out", "--fix", "water"], "NAME=VALUE"),
    "fix of an unknown name": (["fit", "spectra.csv", "-o", "out", "--fix", "sugar=1"], "sugar"),
    "free of an unknown name": (["fit", "spectra.csv", "-o", "out", "--free", "sugar"], "sugar"),
    "surrogate that is none": (
        ["fit", "spectra.csv", "-o", "out", "--surrogate", "spectra.csv"],
        "spectra.csv",
    ),
    "check of what is no surrogate": (["check", "spectra.csv"], "spectra.csv"),
    "training from what is no table": (["train", "spectra.csv", "-o", "s"], "spectra.csv"),
    "training from nothing": (["train", "none", "-o", "s"], "none"),
    "report of nothing": (["report", "none"], "none"),
    "report of an empty folder": (["report", "empty"], "empty"),
}


@pytest.mark.parametrize(("argv", "named"), BAD.values(), ids=BAD.keys())
def test_bad_input_ends_in_one_line_and_leaves_no_file(argv, named, folder, spectra, capsys):
    (folder / "empty").mkdir()
    before = {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}
    assert run(*argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    message = err.rstrip("\n").splitlines()[-1]
    assert message.startswith("hylios-fit")
    assert named in message
    assert "Traceback" not in err
    # Whatever was decided about the file may stand above it, and nothing else.
    assert all(line.startswith("note: ") for line in err.splitlines()[:-1])
    after = {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}
    assert after == before


def test_debug_raises():
    with pytest.raises(HyliosError, match="S9"):
        cli.main(["optics", "S9", "-o", "a.csv", "--debug"])


def test_an_interruption_is_said_in_one_line_and_leaves_no_file(folder, monkeypatch, capsys):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("hylios_fit.skin.optics_rows", interrupt)
    assert run("optics", "S1", "-o", "a.csv") == 130
    assert capsys.readouterr().err == "hylios-fit: interrupted\n"
    assert not list(folder.iterdir())


def test_a_defect_is_told_from_bad_input(monkeypatch, capsys):
    def fail(*args, **kwargs):
        raise RuntimeError("two\nlines")

    monkeypatch.setattr("hylios_fit.skin.optics_rows", fail)
    assert run("optics", "S1", "-o", "a.csv") == 1
    assert "RuntimeError: two lines" in capsys.readouterr().err


def test_abbreviated_options_are_refused(capsys):
    # They would break when an option is added.
    assert run("simulate", "S1", "-o", "a.csv", "--wave", "500") == 2
    assert "--wave" in capsys.readouterr().err


# --- simulate and optics -----------------------------------------------------------------------


@pytest.mark.parametrize("method", ["walker", "analog"])
def test_simulate_writes_the_promised_columns(method):
    options = ("--method", method, "--wavelengths", "500,600", "--rays", 400, "--seed", 3)
    assert run("simulate", "S3", "-o", "a.csv", *options) == 0
    header, rows = read("a.csv")
    assert header == ["wavelength_nm", "reflectance", "standard_error", "surface", "subsurface"]
    nm, reflectance, error, surface, subsurface = np.array(rows, float).T
    assert list(nm) == [500, 600]
    assert np.all((reflectance > 0) & (reflectance < 1))
    assert np.all(error > 0)
    np.testing.assert_allclose(surface + subsurface, reflectance, rtol=0, atol=2e-6)


def test_simulate_says_what_tolerance_it_reached(folder, monkeypatch, capsys):
    from hylios_fit import adding

    monkeypatch.setattr(adding, "ORDERS", adding.ORDERS[: adding.ORDERS.index(adding.ORDER) + 1])
    options = ("--method", "adding", "--wavelengths", "500,600", "--tolerance")
    assert run("simulate", "S3", "-o", "a.csv", *options, 1e-12) == 0
    said = capsys.readouterr().err
    assert "note: the tolerance 1e-12 was not reached at order" in said
    assert run("simulate", "S3", "-o", "a.csv", *options, 0.5) == 0
    assert "note" not in capsys.readouterr().err


def test_simulate_repeats_with_the_seed(folder):
    options = ("--wavelengths", "600", "--rays", 400, "--seed")
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert run("simulate", "S2", "-o", name, *options, seed) == 0
    assert (folder / "a").read_bytes() == (folder / "b").read_bytes()
    assert (folder / "a").read_bytes() != (folder / "c").read_bytes()


def test_optics_writes_a_row_for_each_wavelength_and_layer():
    assert run("optics", "S1", "-o", "a.csv", "--wavelengths", "400:410:5") == 0
    header, rows = read("a.csv")
    assert header == [
        "wavelength_nm", "layer", "thickness_cm", "refractive_index", "mu_a_per_cm",
        "attenuator", "mu_s_per_cm", "albedo", "mean_angle_rad",
    ]  # fmt: skip
    layers = ["corneum", "granulosum", "spinosum", "basale", "papillary", "reticular"]
    assert [row[:2] for row in rows] == [[nm, x] for nm in ("400", "405", "410") for x in layers]


def test_set_changes_the_specimen(folder):
    (folder / "mine.toml").write_text("oxygen_saturation = 0.5\n", encoding="utf-8")
    wavelengths = ("--wavelengths", "660")
    assert run("optics", "S1", "-o", "preset.csv", *wavelengths) == 0
    setting = ("--set", "oxygen_saturation=0.5", "--set", "blood_papillary=3")
    assert run("optics", "S1", "-o", "set.csv", *wavelengths, *setting) == 0
    assert run("optics", "mine.toml", "-o", "toml.csv", *wavelengths) == 0
    preset, changed = (
        {row[1]: float(row[4]) for row in read(name)[1]} for name in ("preset.csv", "set.csv")
    )
    assert changed["papillary"] > preset["papillary"]
    assert changed["granulosum"] == preset["granulosum"]
    assert len(read("toml.csv")[1]) == 6


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("400:700:150", [400, 550, 700]),
        ("400:401:0.25", [400, 400.25, 400.5, 400.75, 401]),
        ("500", [500]),
        ("700,450.5", [700, 450.5]),
    ],
)
def test_wavelengths_include_both_ends(text, expected):
    np.testing.assert_allclose(cli.parse_wavelengths(text), expected, rtol=1e-12)


# --- fit and report ----------------------------------------------------------------------------


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.setattr("hylios_fit.surrogate.load_surrogate", lambda path=None: ToySurrogate())


def names(directory) -> set[str]:
    return {path.name for path in directory.iterdir()}


WRITTEN = {"estimates.csv", "fitted.csv", "settings.json", "report.html"}


def test_fit_keeps_a_row_for_a_spectrum_that_cannot_be_fitted(toy, folder, spectra, capsys):
    # A run without sampling leaves no posterior of the run before it.
    (folder / "out").mkdir()
    (folder / "out" / "posterior.nc").write_bytes(b"of an earlier run")
    assert run("fit", spectra, "-o", "out") == 3
    header, rows = read("out/estimates.csv")
    assert header[:5] == ["spectrum", "outcome", "residual_rms", "reduced_chi2", "iterations"]
    for quantity in ("melanin_mg_per_mL", "blood_percent", "oxygen_saturation", "water_percent"):
        assert header[header.index(quantity) + 1] == f"{quantity}_sd"
    assert [row[0] for row in rows] == ["good", "bad"]
    assert rows[1][1] == "unusable"
    assert rows[0][1] != "unusable"
    assert {row[0] for row in read("out/fitted.csv")[1]} >= {"good"}
    assert names(folder / "out") == WRITTEN
    out = capsys.readouterr().out
    assert "good" in out
    assert "bad" in out
    assert "1 of 2" in out


def test_fit_of_good_spectra_ends_with_0_and_samples_when_asked(toy, folder, spectra, monkeypatch):
    from hylios_fit import sampling

    monkeypatch.setattr(sampling, "sample", functools.partial(sampling.sample, steps=40))
    table = np.genfromtxt(spectra, delimiter=",", skip_header=1)[:, :2]
    np.savetxt("good.csv", table, delimiter=",", header="wavelength_nm,good", comments="")
    options = ("--range", "450:650", "--noise", "0.005", "--fix", "lipids=1", "--seed", 5)
    assert run("fit", "good.csv", "-o", "out", "--posterior", *options) == 0
    assert names(folder / "out") == WRITTEN | {"posterior.nc"}
    nm = [float(row[1]) for row in read("out/fitted.csv")[1]]
    assert (min(nm), max(nm)) == (450, 650)
    settings = json.loads((folder / "out" / "settings.json").read_text(encoding="utf-8"))
    assert settings["shared"]["noise"] == 0.005

    page = folder / "out" / "report.html"
    page.unlink()
    assert run("report", "out") == 0
    assert "good" in page.read_text(encoding="utf-8")


# --- table, train, check -----------------------------------------------------------------------


def test_a_table_is_made_trained_from_and_checked(folder, monkeypatch, capsys):
    from hylios_fit import table, training

    def stand_in(parameters, form, key, rays):
        depth = parameters[:, 3:4] * (500 / table.WAVELENGTHS) ** 3 / 5
        return 0.05 + 0.6 * np.exp(-depth), np.full(depth.shape, 1e-3)

    def solve(names, form, rows):
        return stand_in(rows, form, None, 1)[0]

    monkeypatch.setattr(table, "walk_rows", stand_in)
    monkeypatch.setattr(table, "FORMS", ("complex",))
    monkeypatch.setattr(training, "solve", solve)
    for name, value in (
        ("SIZES", {"large": ((8, 8), 90, "silu"), "small": ((7, 6), 60, "squareplus")}),
        ("LOCAL_HIDDEN", (8, 8)), ("LOCAL_STEPS", 90),
        ("SPECIMENS", 512), ("COMPONENTS", 8), ("LOOKED_AT", 16),
    ):  # fmt: skip
        monkeypatch.setattr(training, name, value)
    assert run("table", "-o", "t.zarr", "--rows", 256, "--seed", 5) == 0
    assert run("table", "-o", "t.zarr", "--rows", 256) == 2
    assert "--resume" in capsys.readouterr().err
    assert run("table", "-o", "t.zarr", "--rows", 256, "--seed", 5, "--resume") == 0
    assert run("train", "t.zarr", "-o", "s.npz", "--size", "small") == 0
    capsys.readouterr()
    assert run("check", "s.npz") == 0
    said = capsys.readouterr().out
    assert "256 rows" in said
    assert "hidden units: 7, 6\n" in said
    assert "worst band" in said
    for size, units in (("small", "128, 96, 64"), ("large", "256, 256, 192")):
        assert run("check", size) == 0
        assert f"hidden units: {units}\n" in capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} >= {"t.zarr", "s.npz"}
    assert not list(folder.glob(".*"))
