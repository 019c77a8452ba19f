"""The design, and a table that goes on where it stopped, grows, and is shared by processes."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from hylios_fit import table
from hylios_fit.errors import HyliosError
from hylios_fit.files import claimed
from hylios_fit.skin import SPECS, STRATA, Specimen

RAYS = 256
ROWS = 24
STEP = 8
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def small(monkeypatch):
    """Chunks of eight rows: for each form, one group of four."""
    monkeypatch.setattr(table, "GROUPS", 1)
    monkeypatch.setattr(table, "SHARE", 4)


@pytest.fixture
def quick(small, monkeypatch):
    """A stand-in for the walk, of the same key and parameters the same; what it was asked for."""
    calls = []

    def walk_rows(parameters, form, key, rays):
        calls.append((form, parameters))
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        shape = (len(parameters), len(table.WAVELENGTHS))
        return rng.uniform(0.1, 0.9, shape), rng.uniform(1e-4, 1e-3, shape)

    monkeypatch.setattr(table, "walk_rows", walk_rows)
    return calls


def make(path, rows=ROWS, rays=RAYS, **options):
    return table.generate(path, rows=rows, rays=rays, progress=False, **options)


def read(path):
    stored = table.open_table(path)
    return {name: stored[name].to_numpy() for name in ("reflectance", "standard_error", "design")}


def published(rows):
    """Which rows are of the model as published."""
    group = np.arange(rows) // (table.SHARE * len(table.FORMS))
    return group % table.PLAIN == table.PLAIN - 1


# --- the design ----------------------------------------------------------------------------------


def test_the_design_lies_in_its_ranges_and_fills_them(monkeypatch):
    monkeypatch.setattr(table, "bared", lambda values: values)  # see below
    parameters, form = table.design(1280)
    assert parameters.shape == (1280, len(table.NAMES))
    wide = parameters[~published(1280)]
    for column, axis in zip(wide.T, table.DESIGN, strict=True):
        assert axis.source
        below, above = table.SHIFT if axis.name.startswith("index_") else (0.0, 0.0)
        assert axis.lower + below <= column.min() < column.max() <= axis.upper + above
        assert SPECS[axis.name].lower <= axis.lower < axis.upper <= SPECS[axis.name].upper
        if axis.name.startswith("index_"):
            continue
        u = (column - axis.lower) / (axis.upper - axis.lower)
        if axis.spread == "log":
            u = np.log(column / axis.lower) / np.log(axis.upper / axis.lower)
        u **= {"square": 1 / 2, "cube": 1 / 3}.get(axis.spread, 1)
        counts, _ = np.histogram(u, 8, (0, 1))
        assert counts.min() > 100  # of 128
    assert list(np.bincount(form)) == [640, 640]


def test_every_fifth_group_is_of_the_model_as_published():
    from hylios_fit.statevector import PRIORS

    assert [PRIORS[name].usual for name in table.NAMES] == [
        i < table.USUAL for i in range(len(table.NAMES))
    ]
    plain = table.design(1280)[0][published(1280)]
    assert len(plain) == 256
    usual = table.Specimen().parameters(table.NAMES)
    np.testing.assert_array_equal(plain[:, table.USUAL :], np.tile(usual[table.USUAL :], (256, 1)))
    assert np.all(np.ptp(plain[:, : table.USUAL], axis=0) > 0)


def test_in_every_third_group_strata_are_without_melanosomes_from_the_top_down():
    groups = table.design(1440)[0].reshape(-1, 16, len(table.NAMES))
    place = [table.NAMES.index(f"melanosome_{stratum}") for stratum in STRATA]
    without = groups[..., place] == 0
    np.testing.assert_array_equal(without, np.broadcast_to(without[:, :1], without.shape))
    strata = without[:, 0].sum(axis=1)
    assert np.all(strata[np.arange(90) % 3 < 2] == 0)
    assert list(np.bincount(strata)) == [60, 10, 10, 10]
    assert np.all(np.diff(without[:, 0].astype(int), axis=1) <= 0)
    # of the published model and of the wide groups alike
    for mine in (published(1440)[::16], ~published(1440)[::16]):
        assert np.ptp(np.bincount(strata[mine])[1:]) == 0


def test_the_indices_of_a_row_are_moved_together_as_dispersion_moves_them():
    from hylios_fit import skin, training

    parameters = table.design(4096, generator="adding")[0][~published(4096)]
    own = np.array([(axis.lower, axis.upper) for axis in table.DESIGN])[table.INDICES]
    index = parameters[:, table.INDICES]
    # one shift, of those that there are, brings all four into their ranges
    least = np.maximum((index - own[:, 1]).max(axis=1), table.SHIFT[0])
    most = np.minimum((index - own[:, 0]).min(axis=1), table.SHIFT[1])
    assert np.all(least <= most + 1e-9)
    assert np.corrcoef(index.T).min() > 0.2
    reach = np.outer(training.FURTHER["index_dispersion"], skin.dispersion(table.WAVELENGTHS))
    assert table.SHIFT[0] < reach.min() < reach.max() < table.SHIFT[1]


@pytest.mark.parametrize("generator", table.GENERATORS)
@pytest.mark.parametrize("rows", [32, 50, 100])
def test_the_first_rows_of_a_larger_design_are_those_of_a_smaller(rows, generator):
    parameters, form = table.design(rows, generator=generator)
    more, forms = table.design(512, generator=generator)
    np.testing.assert_array_equal(parameters, more[:rows])
    np.testing.assert_array_equal(form, forms[:rows])


@pytest.mark.parametrize("generator", table.GENERATORS)
def test_rows_of_a_group_agree_in_what_they_must_and_differ_in_the_rest(generator):
    parameters, _ = table.design(64, generator=generator)
    groups = parameters.reshape(-1, table.SHARE, len(table.NAMES))
    together = table.PATHS if generator == "walker" else table.INDICES
    assert np.all(groups[..., together] == groups[:, :1, together])
    for axis, column in enumerate(parameters.T):
        there = column[column != 0]  # without what is bared
        values = len(there) // 2  # each for both forms
        assert len(np.unique(there)) == (values // table.SHARE if together[axis] else values)


def test_another_seed_is_another_design():
    assert not np.array_equal(table.design(32)[0], table.design(32, seed=1)[0])


# --- the table -----------------------------------------------------------------------------------


def test_a_table_goes_on_where_it_stopped(small, tmp_path, monkeypatch):
    whole = read(make(tmp_path / "whole.zarr", threads=1))
    assert whole["reflectance"].shape == (ROWS, len(table.WAVELENGTHS))
    assert np.all(np.isfinite(whole["reflectance"]))
    surface = table.surface_share(whole["design"])
    assert np.all(whole["reflectance"] >= np.float32(surface)[:, None])
    assert np.all(whole["standard_error"] >= 0)
    assert whole["standard_error"].max() > 0
    np.testing.assert_array_equal(whole["design"], table.design(ROWS)[0])

    path = tmp_path / "cut.zarr"
    walk_rows = table.walk_rows
    calls = []

    def cut(*arguments):
        calls.append(arguments)
        if len(calls) >= 4:  # in the middle of the second chunk
            raise KeyboardInterrupt
        return walk_rows(*arguments)

    monkeypatch.setattr(table, "walk_rows", cut)
    with pytest.raises(KeyboardInterrupt):
        make(path, threads=1)
    left = read(path)["standard_error"]
    assert np.all(np.isfinite(left[:8]))
    assert np.all(np.isnan(left[8:]))

    calls.clear()
    monkeypatch.setattr(table, "walk_rows", lambda *a: (calls.append(a), walk_rows(*a))[1])
    make(path, resume=True, threads=2)
    assert len(calls) == 4  # two chunks of two forms: the first was not done again
    again = read(path)
    for name, values in whole.items():
        np.testing.assert_array_equal(values, again[name])

    calls.clear()
    make(path, resume=True)  # nothing is left to do
    assert not calls


def test_rows_of_a_group_share_paths_and_agree_with_their_own_walk(small):
    parameters, form = table.design(ROWS)
    mine = parameters[form == 1][:4]
    assert np.all(mine[:, table.PATHS] == mine[0, table.PATHS])
    shared, error = table.walk_rows(mine, "dispersed", jax.random.key(3), 1024)
    assert shared.shape == error.shape == (4, len(table.WAVELENGTHS))
    again = np.repeat(mine[2:3], 4, axis=0)
    alone, its_error = table.walk_rows(again, "dispersed", jax.random.key(4), 1024)
    np.testing.assert_array_equal(alone[0], alone[1])
    # neighbouring wavelengths share paths, so that their deviations are not independent
    z = (shared[2] - alone[2]) / np.maximum(np.hypot(error[2], its_error[2]), 1e-9)
    assert np.abs(z).max() < 6
    assert np.sqrt(np.mean(z**2)) < 2
    with pytest.raises(HyliosError, match="must agree in what changes paths"):
        table.walk_rows(parameters[form == 0][2:6], "complex", jax.random.key(3), 256)


def test_no_row_of_a_group_weighs_without_bound(small):
    # dark bottoms beside a white one, which light meets again and again
    rows = [
        Specimen().replace(bottom_reflectance=r).parameters(table.NAMES) for r in (0, 0.1, 0.2, 1)
    ]
    _, shared = table.walk_rows(np.array(rows), "complex", jax.random.key(3), 1024)
    _, alone = table.walk_rows(np.array(rows[-1:] * 4), "complex", jax.random.key(3), 1024)
    assert shared[-1].max() < 1.5 * alone[-1].max()


def empty(path):
    """A table that was begun and has no row."""
    table._begin(path, table._empty(ROWS, 0, RAYS), STEP)
    return path


def test_tables_that_cannot_be_gone_on_with_are_refused(small, tmp_path):
    path = empty(tmp_path / "t.zarr")
    with pytest.raises(HyliosError, match="exists; add --resume"):
        make(path)
    with pytest.raises(HyliosError, match="begun with seed 0, not 5"):
        make(path, resume=True, seed=5)
    with pytest.raises(HyliosError, match="begun with rays 256, not 32"):
        table.generate(path, rows=ROWS, rays=32, resume=True, progress=False)
    with pytest.raises(HyliosError, match="has 24 rows, asked for 16: a table does not shrink"):
        make(path, rows=16, resume=True)
    with pytest.raises(HyliosError, match="begun with generator walker, not adding"):
        make(path, resume=True, generator="adding")
    with pytest.raises(HyliosError, match="generator is one of walker, adding, got 'magic'"):
        make(path, generator="magic")
    with pytest.raises(HyliosError, match="multiple of 8 rows, asked for 12"):
        table.generate(tmp_path / "new.zarr", rows=12, progress=False)
    assert not (tmp_path / "new.zarr").exists()


def test_other_versions_are_refused(small, tmp_path):
    import zarr

    path = empty(tmp_path / "t.zarr")
    assert table.open_table(path).attrs["rays"] == RAYS
    zarr.open_group(path, mode="r+").attrs["format_version"] = table.FORMAT_VERSION + 1
    with pytest.raises(HyliosError, match=r"version 3 .* reads version 2"):
        table.open_table(path)
    with pytest.raises(HyliosError, match=r"version 3 .* reads version 2"):
        make(path, resume=True)


def test_what_is_not_a_table_is_refused(tmp_path):
    import zarr

    with pytest.raises(HyliosError, match="there is no table at"):
        table.open_table(tmp_path / "none.zarr")
    text = tmp_path / "text.zarr"
    text.write_text("no")
    with pytest.raises(HyliosError, match="is not a table"):
        table.open_table(text)
    zarr.open_group(tmp_path / "other.zarr", mode="w")
    with pytest.raises(HyliosError, match="not a hylios_fit table"):
        table.open_table(tmp_path / "other.zarr")
    path = empty(tmp_path / "t.zarr")
    import shutil

    shutil.rmtree(path / "form")
    with pytest.raises(HyliosError, match="lacks form"):
        table.open_table(path)


def test_a_failed_beginning_leaves_nothing(small, tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(table.os, "replace", full)
    with pytest.raises(HyliosError, match="no space"):
        make(tmp_path / "t.zarr")
    assert list(tmp_path.iterdir()) == []


def test_the_bar_counts_rows_that_another_process_made(quick, tmp_path, monkeypatch):
    class Bar(list):
        def __init__(self, total, initial, **_):
            self.n, self.total = initial, total
            super().__init__([initial])

        def update(self, count):
            self.n += count
            self.append(self.n)

        def __enter__(self):
            bars.append(self)
            return self

        def __exit__(self, *_):
            pass

    bars = []
    monkeypatch.setattr("tqdm.tqdm", Bar)
    path = empty(tmp_path / "t.zarr")
    make_chunk = table.make_chunk

    def beside(path, start):  # another process makes the chunk that follows, first
        make_chunk(path, (start + STEP) % ROWS)
        return make_chunk(path, start)

    monkeypatch.setattr(table, "make_chunk", beside)
    table.generate(path, rows=ROWS, rays=RAYS, resume=True, threads=1)
    assert bars[0][0] == 0
    assert bars[0][1] >= 2 * STEP
    assert bars[0][-1] == bars[0].total == ROWS


# --- growing -------------------------------------------------------------------------------------


def test_a_larger_table_extends_a_smaller_one(quick, tmp_path):
    whole = read(make(tmp_path / "whole.zarr"))
    path = make(tmp_path / "grown.zarr", rows=STEP)
    quick.clear()
    make(path, resume=True)
    assert len(quick) == 4  # two further chunks of two forms
    grown = read(path)
    for name, values in whole.items():
        np.testing.assert_array_equal(values, grown[name])
    np.testing.assert_array_equal(table.open_table(path)["form"], table.design(ROWS)[1])
    table.generate(path, rays=RAYS, resume=True, progress=False)  # as many rows as it has
    assert len(quick) == 4


def test_a_table_of_another_design_does_not_grow(quick, tmp_path, monkeypatch):
    path = make(tmp_path / "t.zarr", rows=STEP)
    wider = (*table.DESIGN[:-1], table.DESIGN[-1]._replace(upper=3.0))
    monkeypatch.setattr(table, "DESIGN", wider)
    with pytest.raises(HyliosError, match="begun with another design"):
        make(path, resume=True)
    assert table.open_table(path).sizes["row"] == STEP


def test_rows_of_two_versions_do_not_mix(quick, tmp_path, monkeypatch):
    path = make(tmp_path / "t.zarr", rows=STEP)
    monkeypatch.setattr("hylios_fit.__version__", "99.0")
    with pytest.raises(HyliosError, match=r"begun with hylios_fit .*, not 99.0: .* do not mix"):
        make(path, resume=True)
    with pytest.raises(HyliosError, match="do not mix"):
        table.make_chunk(str(path), 0)  # a worker elsewhere
    with pytest.raises(HyliosError, match=r"has rows with hylios_fit .*, not 99.0"):
        table.read_table(path)


def test_the_other_generator_writes_the_same_format(small, tmp_path, monkeypatch):
    def add_rows(parameters, form):
        return np.full((2, len(parameters), len(table.WAVELENGTHS)), [[[0.4]], [[1e-6]]])

    monkeypatch.setattr(table, "add_rows", add_rows)
    rows = table.read_table(make(tmp_path / "t.zarr", generator="adding"), ROWS // 2)
    assert rows.attrs["generator"] == "adding"
    assert rows.attrs["rays"] == 0
    np.testing.assert_array_equal(rows["design"], table.design(ROWS, generator="adding")[0])
    np.testing.assert_array_equal(rows["standard_error"], np.float32(1e-6))
    assert set(rows.variables) == set(table._empty(STEP, 0, RAYS).variables)


def test_rows_by_the_solver_are_those_of_their_specimens(monkeypatch):
    from types import SimpleNamespace

    from hylios_fit import adding, skin

    def solver(layers, *, incidence, order, **_):  # the solver has tests of its own
        assert incidence == pytest.approx(np.radians(table.INCIDENCE_DEG))
        thickness = layers.thickness.reshape(6, -1)
        depth = np.sum((layers.mu_a + layers.mu_particle) * thickness, axis=0)
        return SimpleNamespace(reflectance=np.exp(-np.asarray(depth)) + 0.1 / order**2)

    monkeypatch.setattr(adding, "skin", solver)
    parameters = table.design(64, generator="adding")[0][[1, 2, 20]]  # of two groups
    found, error = table.add_rows(parameters, "dispersed")
    assert found.shape == error.shape == (3, len(table.WAVELENGTHS))
    assert np.all(error > 0)
    for row, mine in zip(parameters, found, strict=True):
        specimen = table.Specimen(
            dict(zip(table.NAMES, row.tolist(), strict=True)), "dispersed", ""
        )
        layers = specimen.layers(table.WAVELENGTHS)
        layers = skin.let_stand(layers, specimen.values, "dispersed")
        alone = solver(layers, incidence=np.radians(8.0), order=table.ADDING_ORDER).reflectance
        np.testing.assert_allclose(mine, alone, rtol=1e-4)  # coefficients in float32


# --- processes -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    """What came of killing processes that make a table, in a fresh interpreter."""
    if not hasattr(os, "fork"):
        pytest.skip("needs fork and SIGKILL")
    done = subprocess.run(
        [sys.executable, ROOT / "tests" / "table_processes.py", tmp_path_factory.mktemp("tables")],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_killed_at_any_moment_it_resumes_with_nothing_lost_or_doubled(processes):
    found = processes["kills"]
    assert found.pop("moments") > 10
    assert found == {"again": 0, "different": 0, "leftovers": 0, "failed": 0}


def test_processes_share_a_table_and_take_over_from_one_that_was_killed(processes):
    found = processes["together"]
    assert found["statuses"] == [-9, 0, 0]
    assert found["workers"] == 2
    assert found["made"] == 6  # three chunks of two forms
    assert found["twice"] == 0
    assert not found["different"]


def test_a_chunk_that_another_is_at_is_left_to_it(quick, tmp_path):
    pytest.importorskip("fcntl")
    path = empty(tmp_path / "t.zarr")
    with claimed(path / "standard_error" / "c" / "0") as mine:
        assert mine
        assert not table.make_chunk(str(path), 0)
        assert not quick
    assert table.make_chunk(str(path), 0)
    assert table.make_chunk(str(path), 0)  # it is there
    assert len(quick) == 2


def test_a_dask_cluster_makes_the_same_table(quick, tmp_path):
    distributed = pytest.importorskip("distributed")
    whole = read(make(tmp_path / "whole.zarr", threads=1))
    with distributed.Client(
        processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None
    ) as client:
        shared = read(make(tmp_path / "dask.zarr", executor=client.get_executor()))
    for name, values in whole.items():
        np.testing.assert_array_equal(values, shared[name])


# --- bad tables ----------------------------------------------------------------------------------


def test_a_full_disk_is_said_and_what_was_there_stays(quick, tmp_path, monkeypatch):
    path = make(tmp_path / "t.zarr", rows=STEP)
    before = read(path)
    replace = os.replace

    def full(source, target):
        if "/c/1/" in str(target):  # the second chunk
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(HyliosError, match=r"cannot be written: No space left on device; what was"):
        make(path, rows=2 * STEP, resume=True)
    monkeypatch.undo()
    for name, values in read(path).items():
        np.testing.assert_array_equal(values[:STEP], before[name])
    assert len(table.read_table(path)["row"]) == STEP


def spoilt(path, **arrays):
    """A finished table with some values written over: name -> (row, column, value)."""
    import zarr

    make(path)
    store = zarr.open_group(path, mode="r+")
    for name, (row, column, value) in arrays.items():
        store[name][row, column] = value
    return path


def test_finished_rows_are_read_and_others_left_out(quick, tmp_path):
    path = empty(tmp_path / "t.zarr")
    with pytest.raises(HyliosError, match=r"0 finished rows of the form complex, .* at least 1"):
        table.read_table(path)
    table.make_chunk(str(path), STEP)
    rows = table.read_table(path, 4)
    assert rows.sizes["row"] == STEP
    np.testing.assert_array_equal(rows["design"], table.design(ROWS)[0][STEP : 2 * STEP])
    with pytest.raises(HyliosError, match=r"4 finished rows of the form complex, .* at least 5"):
        table.read_table(path, 5)


def test_tables_that_cannot_be_trained_on_are_refused(quick, tmp_path):
    import zarr

    path = spoilt(tmp_path / "nan.zarr", reflectance=(3, 10, np.nan))
    with pytest.raises(HyliosError, match=r"1 of .* have no reflectance .* row 3, at 300"):
        table.read_table(path)
    path = spoilt(tmp_path / "design.zarr", design=(5, 4, np.inf))
    with pytest.raises(HyliosError, match=r"1 of .* have no design .* row 5, at eumelanin"):
        table.read_table(path)

    path = spoilt(tmp_path / "box.zarr")
    zarr.open_group(path, mode="r+")["upper"][9] = table.DESIGN[9].lower
    with pytest.raises(HyliosError, match=r"the range of water is 0.4 to 0.4, of no width"):
        table.read_table(path)

    path = spoilt(tmp_path / "rays.zarr")
    del zarr.open_group(path, mode="r+").attrs["rays"]
    with pytest.raises(HyliosError, match="lacks rays"):
        table.read_table(path)

    path = spoilt(tmp_path / "cut.zarr")
    chunk = path / "reflectance" / "c" / "1" / "0"
    chunk.write_bytes(chunk.read_bytes()[:100])
    with pytest.raises(HyliosError, match="is damaged"):
        table.read_table(path)

    path = spoilt(tmp_path / "growing.zarr")
    zarr.open_group(path, mode="r+")["design"].resize((ROWS + STEP, len(table.NAMES)))
    with pytest.raises(HyliosError, match=r"cannot be read .* --resume` mends it"):
        table.read_table(path)
    make(path, rows=ROWS + STEP, resume=True)
    assert table.read_table(path).sizes["row"] == ROWS + STEP
