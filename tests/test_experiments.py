"""The experiments: what is saved says where it came from and is all that its figure needs."""

import importlib
import json

import jax
import numpy as np
import pytest
from toy_surrogate import ToySurrogate

from experiments import _shared, issa, nist, recovery
from experiments.__main__ import RESULTS, _plain
from hylios_fit import datasets, tally, walker
from hylios_fit.errors import HyliosError
from hylios_fit.skin import Specimen
from hylios_fit.spectra import write_csv

NAMES = (
    "walker_analog", "nist", "issa", "recovery", "witnesses", "adding_speed", "tissue_speed",
    "walker_speed", "surrogate_speed", "speed_accuracy", "plan", "surrogate_error",
    "surrogate_choice", "table_noise", "model_error",
)  # fmt: skip
ON_A_GPU = tuple(path.stem for path in sorted(RESULTS.glob("*_gpu.json")))


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(_shared, "CACHE", tmp_path / "cache")
    return tmp_path / "cache"


def as_saved(result):
    return json.loads(json.dumps(_plain(result), allow_nan=False))


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 5_000


@pytest.mark.parametrize("name", [*NAMES, *ON_A_GPU])
def test_a_saved_result_names_its_origin_and_is_all_that_the_figure_needs(name, tmp_path):
    path = RESULTS / f"{name}.json"
    if not path.exists():
        pytest.skip(f"no saved result: run `python -m experiments {name}`")
    record = json.loads(path.read_text(encoding="utf-8"))
    experiment = name.removesuffix("_gpu")
    assert record["experiment"] == experiment
    assert record["device"].startswith("gpu" if name in ON_A_GPU else "cpu")
    assert {"seed", "python", "seconds", "result"} <= record.keys()
    module = importlib.import_module(f"experiments.{experiment}")
    assert (record["seed"] is None) == (experiment in ("nist", "model_error")), "they draw nothing"
    assert {"hylios_fit", "jax", "numpy", "optimistix"} <= record["versions"].keys()
    assert len(record["commit"].split("+")[0]) == 40
    assert path.stat().st_size < 300_000
    assert path.with_suffix(".png").stat().st_size < 400_000
    module.draw(record["result"], tmp_path / "figure.png")
    assert is_png(tmp_path / "figure.png")


def test_every_module_is_an_experiment_or_private():
    for name in NAMES:
        module = importlib.import_module(f"experiments.{name}")
        assert callable(module.run)
        assert callable(module.draw)
        assert module.__doc__.splitlines()[0]


def test_rows_of_bad_spectra_are_kept(tmp_path):
    nm = np.arange(250.0, 2501.0, 50.0)
    member = ToySurrogate().at("complex").on(nm)
    middle = 0.5 * (np.asarray(member.lower) + np.asarray(member.upper))
    good = np.asarray(member(middle), float)
    path = tmp_path / "spectra.csv"
    write_csv(
        path,
        ["wavelength_nm", "good", "empty"],
        [[w, f"{r:.5f}", ""] for w, r in zip(nm, good, strict=True)],
    )
    result = as_saved(nist.run(path, ToySurrogate(), progress=False))
    assert result["rows"] == result["spectra"] == 2
    assert result["outcomes"]["unusable"] == 1
    assert result["residual_rms"]["all"]["n"] == 1
    assert result["residual_rms"]["all"]["median"] < 0.01
    nist.draw(result, tmp_path / "figure.png")
    assert is_png(tmp_path / "figure.png")


def test_missing_nist_file_is_a_clear_error(tmp_path, monkeypatch):
    monkeypatch.setenv("HYLIOS_FIT_NIST", str(tmp_path / "absent.csv"))
    with pytest.raises(HyliosError, match=r"absent\.csv.*HYLIOS_FIT_NIST"):
        nist.spectra_path()


def test_archive_is_fitted_in_blocks_that_are_kept(cache, tmp_path, monkeypatch):
    # the bundled spectra are in the layout of the whole archive
    subjects = datasets.measured_examples_path().with_name("issa_examples_subjects.csv")

    def run():
        return as_saved(
            issa.run(
                0, datasets.measured_examples_path(), subjects, ToySurrogate(), starts=1, block=6,
                limit=12, progress=False,
            )
        )  # fmt: skip

    monkeypatch.setattr(issa, "BOOTSTRAP", 20)
    # the toy is not skin: what it fits badly would be no estimate at all
    from hylios_fit.results import Outcome

    monkeypatch.setattr(Outcome, "is_fitted", property(lambda outcome: True))
    first = run()
    assert first["rows"] == first["spectra"] == 12
    assert sum(first["outcomes"].values()) == 12
    assert sum(group["spectra"] for group in first["groups"].values()) == 12
    assert len(list(cache.rglob("*.npz"))) == 2
    monkeypatch.setattr(issa, "_block", None)
    assert run() == first, "blocks that are done must not be made again"
    issa.draw(first, tmp_path / "figure.png")
    assert is_png(tmp_path / "figure.png")


def test_rank_correlation_knows_its_ends_and_its_limits():
    rising = np.arange(5.0)
    assert issa._spearman(rising, -(rising**3)) == pytest.approx(-1.0)
    assert issa._spearman(rising, rising) == pytest.approx(1.0)
    assert np.isnan(issa._spearman(rising, np.ones(5)))
    assert np.isnan(issa._spearman(rising[:2], rising[:2]))


def test_covariance_of_the_walk_has_the_mean_and_errors_of_the_tally():
    nm = np.array([450.0, 550.0, 560.0, 800.0])
    layers = Specimen().layers(nm)
    paths = walker.walk(layers, "complex", jax.random.key(4), rays=4096, absorb=recovery.ABSORB)
    mean, covariance = tally.moments(paths, layers, recovery.ABSORB)
    found = tally.collect(paths, layers, layers, recovery.ABSORB)
    np.testing.assert_allclose(mean, found.mean, rtol=1e-4)
    # both know that each wavelength sends its own share; 256 groups know an error to 4.4 %
    share = np.sqrt(np.diag(covariance)) / np.asarray(found.standard_error)
    assert np.all(np.abs(share - 1.0) < 0.15)
    correlation = covariance[1, 2] / np.sqrt(covariance[1, 1] * covariance[2, 2])
    assert correlation > 0.5, "neighbouring wavelengths share paths"
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-12)


def test_intervals_are_judged_in_the_scale_where_they_are_symmetric():
    from hylios_fit.results import Estimate

    melanin = Estimate(2.0, 1.0, 2.0 / 1.5, 2.0 * 1.5, True)
    *_, informed, score = recovery._standing(melanin, 2.0 * 1.5**1.2, None)
    assert informed
    assert score == pytest.approx(1.2)
    saturation = Estimate(0.5, 0.2, 0.3, 0.7, False)
    assert recovery._standing(saturation, 0.7, (0.0, 1.0))[-1] == pytest.approx(1.0)
    missing = Estimate(np.nan, np.nan, np.nan, np.nan, False)
    assert np.isnan(recovery._standing(missing, 1.0, None)[-1])


def test_recovery_covers_what_was_simulated_with_the_fitting_model(cache, tmp_path, monkeypatch):
    surrogate = ToySurrogate()
    monkeypatch.setattr(recovery, "STEP_NM", 50.0)
    monkeypatch.setattr(recovery, "RANGES", {"250-2500": (250, 2500)})
    nm = recovery.bands()

    def simulated(truth, form, key):
        member = surrogate.at(form).on(nm)
        own = 1e-6 * np.eye(nm.size)
        scatter = np.linalg.cholesky(np.asarray(member.error_covariance(None)) + own)
        noise = scatter @ np.asarray(jax.random.normal(key, nm.shape), float)
        return np.asarray(member(truth), float) + noise, own

    result = as_saved(recovery.run(3, 8, 1, surrogate, simulated, progress=False))
    assert result["forms"] == {"complex": 4, "dispersed": 4}
    assert sorted(result["cases"]) == [f"{kind} 250-2500" for kind in sorted(recovery.KINDS)]
    case = result["cases"]["analog 250-2500"]
    assert sum(case["outcomes"].values()) == 8
    for found in case["quantities"].values():
        assert found["informed"].get("n", 0) + found["not_informed"].get("n", 0) == 8
        # eight make no statistics; errors of another size than the intervals' would show
        assert 0.3 < found["all"]["rms_score"] < 3.0
    points = result["shown"]["250-2500"]["water_percent"]
    np.testing.assert_array_less(points["low"], points["high"])
    recovery.draw(result, tmp_path / "figure.png")
    assert is_png(tmp_path / "figure.png")


def test_checkpoints_differ_by_settings_and_code(cache):
    one = _shared.checkpoint("x", ("tally",), rays=1)
    assert one == _shared.checkpoint("x", ("tally",), rays=1)
    assert one != _shared.checkpoint("x", ("tally",), rays=2)
    assert one != _shared.checkpoint("x", ("walker",), rays=1)
    assert one.is_dir()


def test_bands_of_the_summaries_hold_every_wavelength_once():
    nm = np.arange(250.0, 2500.5, 0.5)
    masks = np.array(list(_shared.band_masks(nm).values()))
    assert np.all(masks.sum(axis=0) == 1)
    assert list(_shared.band_masks(np.array([400.0, 700.0]))) == ["400-700", "700-1350"]
