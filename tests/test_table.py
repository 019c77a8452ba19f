"""The design, and a table that goes on where it stopped."""

import jax
import numpy as np
import pytest

from hylios_fit import table
from hylios_fit.errors import HyliosError
from hylios_fit.skin import SPECS

RAYS = 256
ROWS = 24


@pytest.fixture
def small(monkeypatch):
    """Chunks of eight rows: for each form, one group of four."""
    monkeypatch.setattr(table, "GROUPS", 1)
    monkeypatch.setattr(table, "SHARE", 4)


def make(path, **options):
    return table.generate(path, rows=ROWS, rays=RAYS, progress=False, **options)


def read(path):
    stored = table.open_table(path)
    return {name: stored[name].to_numpy() for name in ("reflectance", "standard_error", "design")}


# --- the design ----------------------------------------------------------------------------------


def test_the_design_lies_in_its_ranges_and_fills_them():
    parameters, form = table.design(1024)
    assert parameters.shape == (1024, len(table.NAMES))
    for column, axis in zip(parameters.T, table.DESIGN, strict=True):
        assert axis.lower <= column.min() < column.max() <= axis.upper
        assert SPECS[axis.name].lower <= axis.lower < axis.upper <= SPECS[axis.name].upper
        u = (column - axis.lower) / (axis.upper - axis.lower)
        if axis.spread == "log":
            u = np.log(column / axis.lower) / np.log(axis.upper / axis.lower)
        u **= {"square": 1 / 2, "cube": 1 / 3}.get(axis.spread, 1)
        counts, _ = np.histogram(u, 8, (0, 1))
        assert counts.min() > 100  # of 128
    assert list(np.bincount(form)) == [512, 512]


@pytest.mark.parametrize("rows", [32, 50, 100])
def test_the_first_rows_of_a_larger_design_are_those_of_a_smaller(rows):
    parameters, form = table.design(rows)
    more, forms = table.design(512)
    np.testing.assert_array_equal(parameters, more[:rows])
    np.testing.assert_array_equal(form, forms[:rows])


def test_another_seed_is_another_design():
    assert not np.array_equal(table.design(32)[0], table.design(32, seed=1)[0])


# --- the table -----------------------------------------------------------------------------------


def test_a_table_goes_on_where_it_stopped(small, tmp_path, monkeypatch):
    whole = read(make(tmp_path / "whole.zarr", threads=1))
    assert whole["reflectance"].shape == (ROWS, len(table.WAVELENGTHS))
    assert np.all(np.isfinite(whole["reflectance"]))
    surface = table.surface_share(table.Specimen())
    assert np.all(whole["reflectance"] >= np.float32(surface))
    assert np.all(whole["standard_error"] >= 0)
    assert whole["standard_error"].max() > 0
    np.testing.assert_array_equal(whole["design"], table.design(ROWS)[0])

    path = tmp_path / "cut.zarr"
    walk_rows = table.walk_rows
    calls = []

    def cut(*arguments):
        calls.append(arguments)
        if len(calls) == 4:  # in the middle of the second chunk
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
    assert np.all(mine[:, : table.PATH_AXES] == mine[0, : table.PATH_AXES])
    shared, error = table.walk_rows(mine, "dispersed", jax.random.key(3), 1024)
    assert shared.shape == error.shape == (4, len(table.WAVELENGTHS))
    again = np.repeat(mine[2:3], 4, axis=0)
    alone, its_error = table.walk_rows(again, "dispersed", jax.random.key(4), 1024)
    np.testing.assert_array_equal(alone[0], alone[1])
    # neighbouring wavelengths share paths, so that their deviations are not independent
    z = (shared[2] - alone[2]) / np.maximum(np.hypot(error[2], its_error[2]), 1e-9)
    assert np.abs(z).max() < 6
    assert np.sqrt(np.mean(z**2)) < 2
    with pytest.raises(HyliosError, match="must have the same melanosome contents"):
        table.walk_rows(parameters[form == 0][2:6], "complex", jax.random.key(3), 256)


def empty(path):
    """A table that was begun and has no row."""
    made = table._empty(ROWS, 0, RAYS)
    made.to_zarr(path, consolidated=False, zarr_format=3)
    return path


def test_tables_that_cannot_be_gone_on_with_are_refused(small, tmp_path):
    path = empty(tmp_path / "t.zarr")
    with pytest.raises(HyliosError, match="exists; add --resume"):
        make(path)
    with pytest.raises(HyliosError, match="begun with seed 0, not 5"):
        make(path, resume=True, seed=5)
    with pytest.raises(HyliosError, match="begun with rays 256, not 32"):
        table.generate(path, rows=ROWS, rays=32, resume=True, progress=False)
    with pytest.raises(HyliosError, match="has 24 rows, asked for 40"):
        table.generate(path, rows=40, rays=RAYS, resume=True, progress=False)
    with pytest.raises(HyliosError, match="multiple of 8 rows, asked for 12"):
        table.generate(tmp_path / "new.zarr", rows=12, progress=False)
    assert not (tmp_path / "new.zarr").exists()


def test_other_versions_are_refused(small, tmp_path):
    import zarr

    path = empty(tmp_path / "t.zarr")
    assert table.open_table(path).attrs["rays"] == RAYS
    zarr.open_group(path, mode="r+").attrs["format_version"] = table.FORMAT_VERSION + 1
    with pytest.raises(HyliosError, match=r"version 2 .* reads version 1"):
        table.open_table(path)
    with pytest.raises(HyliosError, match=r"version 2 .* reads version 1"):
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
    with pytest.raises(OSError, match="no space"):
        make(tmp_path / "t.zarr")
    assert list(tmp_path.iterdir()) == []
