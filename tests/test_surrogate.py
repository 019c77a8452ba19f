"""The surrogate: its range, its gradients, its file, and its training."""

import errno
import json
import os
import time
from concurrent.futures import CancelledError
from pathlib import Path
from unittest.mock import Mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hylios_fit import cli, fresnel, perceptron, table, training
from hylios_fit import surrogate as module
from hylios_fit.checkpoints import Checkpoints
from hylios_fit.datasets import data_path
from hylios_fit.errors import HyliosError
from hylios_fit.files import claimed
from hylios_fit.skin import Specimen
from hylios_fit.surrogate import load_surrogate
from hylios_fit.threads import one_blas_thread


@pytest.fixture(scope="module")
def surrogate():
    return load_surrogate()


def vector(surrogate, name="S3", **changes):
    specimen = Specimen.preset(name).replace(**changes)
    return jnp.asarray(specimen.parameters(surrogate.names), jnp.float32)


@pytest.mark.parametrize("name", ["S1", "S2", "S3", "S4"])
def test_embedded_agrees_with_the_walker(surrogate, name):
    from hylios_fit.simulation import simulate

    specimen = Specimen.preset(name)
    nm = np.array([300.0, 400.0, 500.0, 600.0, 700.0, 900.0, 1100.0, 1450.0, 1700.0, 2200.0])
    curve = simulate(specimen, nm, rays=65_536, key=jax.random.key(3))
    member = surrogate.at(specimen.melanosome_form).on(nm)
    own = member.error_covariance(curve.reflectance)
    error = np.sqrt(np.diag(own) + curve.standard_error**2)
    z = (surrogate.of(specimen, nm) - curve.reflectance) / error
    # the paper's specimens lie at corners of the box: the error there may be above its mean
    assert np.abs(z).max() < 6
    assert np.sqrt(np.mean(z**2)) < 3


def test_the_small_one_knows_the_same_with_less(surrogate):
    small = load_surrogate(size="small")
    assert small.names == surrogate.names
    np.testing.assert_array_equal(small.wavelength_nm, surrogate.wavelength_nm)
    for form in surrogate.forms:
        one, other = small.at(form), surrogate.at(form)
        np.testing.assert_array_equal(one.lower, other.lower)
        np.testing.assert_array_equal(one.upper, other.upper)
        assert sum(w.size for w in one.weights) < 0.6 * sum(w.size for w in other.weights)
        missed = [np.mean(np.square(s.about["held_out_rms"][form])) for s in (small, surrogate)]
        assert missed[0] > missed[1]
        both = np.asarray([m(Specimen.preset("S3").parameters(m.names)) for m in (one, other)])
        assert 0 < np.abs(both[0] - both[1]).max() < 0.003
    with pytest.raises(HyliosError, match="size: expected one of small, large, got 'medium'"):
        load_surrogate(size="medium")
    assert set(module.EMBEDDED) == set(training.SIZES) == set(cli.SIZES)


def test_outside_the_range_is_an_error_with_names_and_ranges(surrogate):
    with pytest.raises(HyliosError, match=r"water = 0.2 \(trained on 0.4 to 1.3\)"):
        surrogate(vector(surrogate, water=0.2))
    with pytest.raises(HyliosError, match="melanosome_form"):
        surrogate(vector(surrogate, melanosome_form="compact"))
    with pytest.raises(HyliosError, match="expected 36 parameters"):
        surrogate(jnp.zeros(3))
    with pytest.raises(HyliosError, match="was not trained on roughness"):
        surrogate.of(Specimen().replace(roughness=0.2), [500.0])


def test_thicker_fibres_are_more_of_them(surrogate):
    thick = Specimen().replace(fibre_radius=110.0)
    more = Specimen().replace(fibre_fraction=0.22 * 1.1**3)
    nm = [450.0, 600.0]
    np.testing.assert_allclose(surrogate.of(thick, nm), surrogate.of(more, nm), rtol=1e-6)
    with pytest.raises(HyliosError, match=r"fibre_fraction = 1 \(trained on"):
        surrogate.of(Specimen().replace(fibre_radius=200.0), nm)


def test_outside_the_range_is_nan_under_jit(surrogate):
    assert jnp.isnan(jax.jit(surrogate)(vector(surrogate, water=0.2))).all()
    assert jnp.isfinite(jax.jit(surrogate)(vector(surrogate))).all()


def test_jit_vmap_and_batches_agree(surrogate):
    batch = jnp.stack([vector(surrogate, name) for name in ("S1", "S2", "S3", "S4")])
    one_by_one = jnp.stack([surrogate(p) for p in batch])
    assert one_by_one.shape == (4, 451)
    for many in (surrogate(batch), jax.vmap(surrogate)(batch), jax.jit(surrogate)(batch)):
        assert jnp.allclose(many, one_by_one, atol=2e-6)


def test_gradients_are_finite_in_the_corners_of_the_box(surrogate):
    for form in surrogate.forms:
        member = surrogate.at(form)
        for corner in (member.lower, member.upper, 0.5 * (member.lower + member.upper)):
            jacobian = jax.jacfwd(member)(corner)
            assert jacobian.shape == (451, len(member.names))
            assert jnp.isfinite(jacobian).all()


def test_gradient_is_that_of_finite_differences(surrogate, x64):
    member = jax.tree.map(
        lambda a: jnp.asarray(a, jnp.float64) if a.dtype == np.float32 else a,
        surrogate.at("complex"),
    )
    p = jnp.asarray(Specimen().parameters(member.names))
    exact = jax.jacfwd(member)(p)
    for i, name in enumerate(member.names):
        step = 1e-5 * float(member.upper[i] - member.lower[i])
        if float(p[i]) - step < float(member.lower[i]):
            continue  # at the edge a difference would leave the box
        if float(p[i]) + step > float(member.upper[i]):
            continue
        change = member(p.at[i].add(step)) - member(p.at[i].add(-step))
        assert np.allclose(change / (2 * step), exact[:, i], atol=1e-6), name


def test_bands_are_interpolated_not_resampled(surrogate):
    member = surrogate.at("complex")
    p = vector(surrogate)[:-1]
    whole = np.asarray(member(p))
    bands = np.array([250.0, 401.7, 555.0, 2499.0, 2500.0])
    on = member.on(bands)
    assert np.allclose(on(p), np.interp(bands, member.wavelength_nm, whole), atol=1e-6)
    assert on.error_covariance(np.full(5, 0.5)).shape == (5, 5)
    with pytest.raises(HyliosError, match="covers 250 to 2500"):
        member.on([200.0])


def inside(surrogate, count, form=0):
    """Parameters in the box, with a melanosome form."""
    member = surrogate.at("complex")
    u = np.random.default_rng(5).random((count, len(member.names)))
    x = np.asarray(member.lower) + u * np.asarray(member.upper - member.lower)
    return np.column_stack([x, np.broadcast_to(form, count)]).astype(np.float32)


def test_wide_bands_are_means_of_the_spectrum(surrogate):
    member = surrogate.at("complex")
    grid = member.wavelength_nm
    p = inside(surrogate, 10)[:, :-1]
    whole = np.asarray(member(p), float)
    nm = np.arange(397.0, 708.0, 7.0)  # neither the surrogate's wavelengths nor its step
    response = np.exp(-(((nm - np.array([[450.0], [545.0], [600.0]])) / 35) ** 2))
    camera = member.on(nm, response)
    fine = np.linspace(nm[0], nm[-1], 20_001)
    shape = np.stack([np.interp(fine, nm, row) for row in response])
    spectra = np.stack([np.interp(fine, grid, row) for row in whole])
    expected = np.trapezoid(spectra[:, None] * shape, fine) / np.trapezoid(shape, fine)
    assert np.allclose(camera(p), expected, atol=2e-6)
    assert np.allclose(member.on(nm, 7 * response)(p), camera(p), atol=1e-6)
    assert np.allclose(camera.wavelength_nm, [450, 545, 600], atol=2)

    flat = np.zeros((1, 451))
    flat[0, 100:140] = 1.0
    assert np.allclose(member.onto(flat)(p)[:, 0], whole[:, 100:140].mean(axis=1), atol=1e-6)
    one = member.on([grid[100], grid[101]], np.ones((1, 2)))
    assert np.allclose(one(p)[:, 0], whole[:, 100:102].mean(axis=1), atol=1e-6)


def test_the_error_of_a_wide_band_is_that_of_its_wavelengths_together(surrogate):
    member = surrogate.at("complex")
    typical = np.exp(np.asarray(member.mean, float))  # light from inside, at each wavelength
    weights = np.zeros((2, 451))
    weights[0, 40:60], weights[1, 300:400] = 1.0, np.linspace(0.1, 1, 100)
    weights /= weights.sum(axis=1, keepdims=True)
    surface = weights @ member.surface
    modes = np.asarray(member.modes, float)
    level = weights @ typical
    expected = (modes * typical) @ weights.T / level  # relative, as each mode moves the band
    band = member.onto(weights)
    assert np.allclose(band.modes, expected, atol=1e-7)
    assert np.all(np.asarray(band.rest) >= 0)
    covariance = band.error_covariance(surface + level)
    assert covariance.shape == (2, 2)
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_bands_that_cannot_be_are_refused(surrogate):
    member = surrogate.at("complex")
    nm = np.array([400.0, 500.0])
    for arguments, message in (
        ((nm, np.ones((3, 5))), r"expected shape \(bands, 2\) .* got \(3, 5\)"),
        ((nm[::-1], np.ones((3, 2))), "at rising wavelengths"),
        ((nm, [[1.0, -1.0]]), "none below 0"),
        ((nm, [[0.0, 0.0]]), "one above 0"),
        ((nm, [[np.nan, 1.0]]), "finite"),
        (([200.0, 300.0], np.ones((1, 2))), "covers 250 to 2500"),
        (([np.nan],), "list of wavelengths"),
        (([],), "list of wavelengths"),
    ):
        with pytest.raises(HyliosError, match=message):
            member.on(*arguments)
    with pytest.raises(HyliosError, match=r"expected shape \(bands, 451\), got \(1, 7\)"):
        member.onto(np.ones((1, 7)))
    with pytest.raises(HyliosError, match="project the surrogate itself"):
        member.on(nm).on([300.0, 350.0], np.ones((1, 2)))
    with pytest.raises(HyliosError, match=r"on the bands 400\.0, 500\.0 nm: 450\.0 nm is none"):
        member.on(nm).on([400.0, 450.0])
    with pytest.raises(HyliosError, match="list of wavelengths"):
        member.on(nm).on([])
    with pytest.raises(HyliosError, match="ask the surrogate itself"):
        surrogate.on(nm).of(Specimen(), [450.0])


NM = np.arange(400.0, 701.0, 20.0)
WIDE = np.exp(-0.5 * ((NM - np.array([[600.0], [540.0], [450.0]])) / 30.0) ** 2)


@pytest.mark.parametrize("bands", [(NM, WIDE), ([600.0, 540.0, 450.0],), ([450.0, 540.0, 600.0],)])
def test_of_its_bands_some_may_be_asked_for_in_any_order(surrogate, bands):
    member = surrogate.at("complex").on(*bands)
    assert (member.readout is None) == (bands[0][0] == 450.0)
    some = member.on(member.wavelength_nm[[2, 0]] + 0.05)
    row = inside(surrogate, 1)[0, :-1]
    assert np.allclose(some(row), member(row)[jnp.array([2, 0])], atol=1e-6)
    assert np.array_equal(some.wavelength_nm, member.wavelength_nm[[2, 0]])
    level = np.array([0.5, 0.4, 0.3])
    whole, part = member.error_covariance(level), some.error_covariance(level[[2, 0]])
    assert np.allclose(part, whole[np.ix_([2, 0], [2, 0])], rtol=1e-4)


def test_a_surrogate_on_bands_is_called_as_the_whole_one(surrogate):
    camera = surrogate.on([450.0, 550.0, 602.5])
    rows = inside(surrogate, 40, form=np.arange(40) % 2)  # both forms in one batch
    found = np.asarray(camera(rows))
    assert found.shape == (40, 3)
    for number, form in enumerate(surrogate.forms):
        mine = rows[number::2]
        expected = surrogate.at(form).on([450.0, 550.0, 602.5])(mine[:, :-1])
        assert np.allclose(found[number::2], expected, atol=1e-6)
        assert np.allclose(camera(mine), expected, atol=1e-6)  # of one form
    assert camera(rows.reshape(4, 10, -1)).shape == (4, 10, 3)
    with pytest.raises(HyliosError, match="outside the surrogate's training range"):
        camera(-rows)


def test_a_call_compiles_once_and_what_is_traced_is_not_kept(surrogate, monkeypatch):
    camera = surrogate.on([450.0, 550.0])
    rows = inside(surrogate, 3)
    kept = module._ready.cache_info().currsize
    traced = Mock(side_effect=module.features)
    monkeypatch.setattr(module, "features", traced)
    for row in rows:
        camera(row)
    assert module._ready.cache_info().currsize <= kept + 1
    assert traced.call_count == 1

    def total(members, p):  # the surrogate itself is traced, as where its weights are trained
        return jnp.sum(members(p))

    before = module._ready.cache_info(), module._compiled.cache_info()
    slopes = eqx.filter_jit(eqx.filter_grad(total))(camera, jnp.asarray(rows))
    assert (module._ready.cache_info(), module._compiled.cache_info()) == before
    assert jnp.any(slopes.at("complex").weights[0] != 0)


def test_numbers_are_answered_with_numbers_where_others_are_traced(surrogate):
    camera = load_surrogate(size="small").on([450.0, 550.0])
    known, other = inside(surrogate, 2)

    def brighter(p):  # than what is known while this is traced
        whole, member = np.asarray(camera(known)), np.asarray(camera.at("complex")(known[:-1]))
        return camera(p) / jnp.asarray(0.5 * (whole + member))

    ratio, rows = camera(other) / camera(known), jnp.asarray([other])
    assert np.allclose(jax.jit(brighter)(other), ratio, rtol=1e-5)
    assert np.allclose(jax.vmap(brighter)(rows), [ratio], rtol=1e-5)
    _, slope = jax.jvp(brighter, (rows[0],), (0.01 * rows[0],))
    _, expected = jax.jvp(camera, (rows[0],), (0.01 * rows[0],))
    assert np.allclose(slope, expected / camera(known), rtol=1e-4, atol=1e-6)


def test_a_large_batch_goes_in_blocks_to_the_same_end(surrogate, monkeypatch):
    rows = inside(surrogate, 70, form=np.arange(70) % 2)
    expected = np.asarray(surrogate.on([450.0, 550.0])(rows))
    monkeypatch.setattr(module, "BLOCK", 16)
    small = surrogate.on([450.0, 550.0])
    assert np.allclose(small(rows), expected, atol=1e-6)
    assert np.allclose(small(rows[1::2]), expected[1::2], atol=1e-6)
    member = surrogate.at("complex").on([450.0, 550.0])
    assert np.allclose(member(rows[:, :-1])[::2], expected[::2], atol=1e-6)


def test_numbers_are_taken_in_any_array(surrogate):
    (row,) = inside(surrogate, 1)
    expected = np.asarray(surrogate(jnp.asarray(row)))
    for given in (row, row.astype(float), row.tolist()):
        assert np.allclose(surrogate(given), expected, atol=1e-6)
        assert np.allclose(surrogate.at("complex")(given[:-1]), expected, atol=1e-6)


def test_the_experiment_on_speed_measures_what_it_draws(surrogate, tmp_path):
    from experiments import surrogate_speed

    found = surrogate_speed.run(batches=(1, 8), repeats=3, alone=4, progress=False)
    assert set(found["per_second"]) == set(found["compile_s"])
    assert {name.rsplit(", ")[0] for name in found["per_second"]} > set(found["goals_per_second"])
    assert {name.rsplit(", ")[1] for name in found["per_second"]} == {"large", "small"}
    assert len(found["alone_us"]) == len(surrogate_speed.DISPATCH) == 2
    for calls in found["alone_us"].values():
        assert len(calls) == 3
        assert all(0 < one["low"] <= one["median"] <= one["high"] for one in calls.values())
    for points in found["per_second"].values():
        assert [point["batch"] for point in points] == [1, 8]
        assert all(0 < point["low"] <= point["median"] <= point["high"] for point in points)
    surrogate_speed.draw(json.loads(json.dumps(found)), tmp_path / "speed.png")
    assert (tmp_path / "speed.png").read_bytes().startswith(b"\x89PNG")


def test_error_covariance_is_one(surrogate):
    for form in surrogate.forms:
        covariance = surrogate.at(form).error_covariance(np.full(451, 0.4))
        assert np.allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0


def test_more_of_an_absorber_reflects_less(surrogate):
    member = surrogate.at("complex")
    at = {name: i for i, name in enumerate(member.names)}
    grid = np.asarray(member.wavelength_nm)
    jacobian = np.asarray(jax.jacfwd(member)(0.5 * (member.lower + member.upper)))
    for name, nm in (("colloidal_melanin", 500), ("blood_reticular", 800), ("water", 1450)):
        assert jacobian[np.argmin(abs(grid - nm)), at[name]] < 0, name


def test_the_file_is_small_and_holds_no_pickle():
    path = data_path("surrogate.npz")
    assert path.stat().st_size < 5_000_000
    with np.load(path, allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)


def rewritten(tmp_path, change):
    with np.load(data_path("surrogate.npz"), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    about = json.loads(arrays.pop("about").tobytes())
    change(arrays, about)
    path = tmp_path / "changed.npz"
    np.savez(path, about=np.frombuffer(json.dumps(about).encode(), np.uint8), **arrays)
    return path


@pytest.mark.parametrize("size", ["large", "small"])
def test_it_evaluates_what_the_file_says(size):
    """Its numbers multiplied out in NumPy, in double precision."""
    with np.load(data_path(module.EMBEDDED[size]), allow_pickle=False) as file:
        arrays = {name: file[name].astype(float) for name in file.files if name != "about"}
        about = json.loads(file["about"].tobytes())
    bends = {
        "silu": lambda x: x / (1.0 + np.exp(-x)),
        "squareplus": lambda x: 0.5 * (x + np.sqrt(x**2 + 4.0)),
        "tanh": np.tanh,
    }
    bend = bends[about.get("activation", "tanh")]
    member = load_surrogate(size=size).at("dispersed")
    rows = np.random.default_rng(0).uniform(member.lower, member.upper, (20, len(member.names)))
    get = {name.partition("/")[2]: a for name, a in arrays.items() if name.startswith("dispersed/")}
    x = np.asarray(module.features(member.names, "dispersed", jnp.asarray(rows, jnp.float32)))
    x = (x - get["centre"]) / get["scale"]
    for i in range(about["depth"]):
        x = (bend(x) if i else x) @ get[f"weight{i}"] + get[f"bias{i}"]
    inside = np.exp(x @ get["components"] + get["mean"]) - module.FLOOR
    found = np.asarray(member(jnp.asarray(rows, jnp.float32)))
    surface = np.asarray(member.surface_at(rows.astype(np.float32)))
    np.testing.assert_allclose(found, surface + (1.0 - surface) * inside, atol=2e-5)


def test_a_file_cut_in_half_is_an_error(tmp_path):
    whole = data_path("surrogate.npz").read_bytes()
    path = tmp_path / "half.npz"
    for content in (whole[: len(whole) // 2], b"", b"not a zip"):
        path.write_bytes(content)
        with pytest.raises(HyliosError, match="damaged or cut short"):
            load_surrogate(path)


def test_other_files_are_errors(tmp_path):
    with pytest.raises(HyliosError, match="there is no surrogate at"):
        load_surrogate(tmp_path / "none.npz")

    def other_version(_, about):
        about["format_version"] = 99

    with pytest.raises(HyliosError, match="version 99"):
        load_surrogate(rewritten(tmp_path, other_version))

    def other_format(_, about):
        about["format"] = "something"

    with pytest.raises(HyliosError, match="but not a hylios_fit surrogate"):
        load_surrogate(rewritten(tmp_path, other_format))

    def other_units(_, about):
        about["activation"] = "relu"

    with pytest.raises(
        HyliosError, match="activation is one of silu, squareplus, tanh, got 'relu'"
    ):
        load_surrogate(rewritten(tmp_path, other_units))

    def one_number(arrays, _):
        arrays["complex/mean"] = arrays["complex/mean"] + 1e-3

    with pytest.raises(HyliosError, match="do not match their hash"):
        load_surrogate(rewritten(tmp_path, one_number))


def test_a_full_disk_is_said_and_the_old_file_stays(tmp_path, monkeypatch):
    path = tmp_path / "s.npz"
    path.write_bytes(b"what was there")

    def full(self, content):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(HyliosError, match=r"cannot be written: No space left"):
        module.save(path, {}, {})
    assert path.read_bytes() == b"what was there"
    assert [file.name for file in tmp_path.iterdir()] == ["s.npz"]


def test_a_pickle_is_not_loaded(tmp_path):
    path = tmp_path / "pickled.npz"
    np.savez(path, about=np.array([{"format": module.FORMAT}], dtype=object))
    with pytest.raises(HyliosError, match="not a surrogate file"):
        load_surrogate(path)


def stand_in(names, form, rows):
    """Light that fades in the layers, under their surface: of what a wavelength knows alone."""
    medium = table.layers_of(tuple(names), form)(rows)
    depth = jnp.sum(medium.mu_a * medium.thickness[..., None], axis=1)
    curve = fresnel.surface_curve(np.radians(table.INCIDENCE_DEG), 0.1)
    surface = curve(np.asarray(medium.index[:, 0], float))
    return surface + (1.0 - surface) * 0.6 * np.exp(-np.asarray(depth, float))


@pytest.fixture
def quick(monkeypatch):
    """Small networks, few specimens, and the stand-in also where training checks itself."""
    monkeypatch.setattr(training, "solve", stand_in)
    for name, value in (
        ("SIZES", {"large": ((32, 32), 1000, "silu"), "small": ((24, 24), 500, "squareplus")}),
        ("LOCAL_HIDDEN", (24, 24)), ("LOCAL_STEPS", 2000),
        ("SPECIMENS", 2048), ("COMPONENTS", 16), ("ORDER_STEPS", 300), ("WAYS", (1, 1)),
        ("LOOKED_AT", 16), ("NEAR", 256),
    ):  # fmt: skip
        monkeypatch.setattr(training, name, value)


def filled(path, rows=128, noise=1e-4):
    """A table with a smooth stand-in for the walk."""
    import zarr

    table._empty(rows, 1, 64).to_zarr(path, consolidated=False, zarr_format=3)
    store = zarr.open_group(path, mode="r+")
    parameters, form = table.design(rows, 1)
    exact = np.empty((rows, len(table.WAVELENGTHS)))
    for number, name in enumerate(table.FORMS):
        exact[form == number] = stand_in(table.NAMES, name, parameters[form == number])
    store["reflectance"][:] = exact + noise * np.random.default_rng(0).normal(size=exact.shape)
    store["standard_error"][:] = np.full(exact.shape, noise)
    return parameters, form, exact


def test_training_learns_a_smooth_table_and_states_its_error(tmp_path, quick, monkeypatch):
    filled(tmp_path / "table.zarr", rows=512)
    paths = tmp_path / "table.zarr", tmp_path / "s.npz"
    # interrupted once a local regression is done, it goes on there
    with monkeypatch.context() as patch:
        patch.setattr(training, "answers", raising(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            training.train(*paths, checks=64, progress=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s.npz.training", "table.zarr"]
    with pytest.raises(HyliosError, match=r"s\.npz\.training holds .* with other seed"):
        training.train(*paths, seed=1, progress=False)
    with pytest.raises(HyliosError, match=r"s\.npz\.training holds .* with other size"):
        training.train(*paths, size="small", progress=False)
    with pytest.raises(HyliosError, match="size: expected one of large, small, got 'tiny'"):
        training.train(*paths, size="tiny", progress=False)
    learned, descend = [], perceptron._descend

    def counted(*args, **more):
        learned.append(args)
        return descend(*args, **more)

    monkeypatch.setattr(perceptron, "_descend", counted)
    report = training.train(*paths, checks=64, progress=False)
    # both second regressions, and of the first ones none that was interrupted at its end
    assert 2 <= len(learned) / perceptron.STAGES <= 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s.npz", "table.zarr"]
    trained = load_surrogate(tmp_path / "s.npz")
    errors, sizes = [], []
    for form in trained.forms:
        member = trained.at(form)
        rows = np.concatenate(
            [
                training.fresh(
                    member.names, member.lower, member.upper, 32, jax.random.key(9), free
                )
                for free in (("usual",), member.names)
            ]
        )
        exact = stand_in(member.names, form, rows)
        errors.append(np.asarray(member(rows.astype(np.float32))) - exact)
        sizes.append(exact - exact.mean(axis=0))
    rms = np.sqrt(np.mean(np.square(errors)))
    # of so little training; what counts is that it knows its error
    assert rms < 0.5 * np.sqrt(np.mean(np.square(sizes)))
    stated = np.sqrt(np.mean(np.square(list(trained.about["held_out_rms"].values()))))
    assert 0.5 * rms < stated < 2 * rms
    assert "worst band" in report
    assert "melanosome_form" in report
    regions = trained.about["regions"]["complex"]
    assert [rms for _, rms, _ in regions] == sorted((rms for _, rms, _ in regions), reverse=True)
    assert regions[0][0] in report


def test_when_one_thread_fails_the_other_ends_too(tmp_path, quick, monkeypatch):
    ended = []

    def learn_locally(table, form, seed, bar, **_):
        if form == "dispersed":
            raise HyliosError("no space")
        try:
            for _ in range(3000):
                bar.update(0)
                time.sleep(0.01)
        except CancelledError:
            ended.append(form)
            raise

    monkeypatch.setattr(training, "learn_locally", learn_locally)
    filled(tmp_path / "table.zarr")
    with pytest.raises(HyliosError, match="no space"):
        training.train(tmp_path / "table.zarr", tmp_path / "s.npz", progress=False)
    assert ended == ["complex"]


def test_two_do_not_train_one_surrogate(tmp_path, quick, monkeypatch):
    pytest.importorskip("fcntl")
    monkeypatch.setattr(training, "_trained", raising(AssertionError("trained twice")))
    filled(tmp_path / "table.zarr")
    with (
        claimed(tmp_path / "s.npz.training"),
        pytest.raises(HyliosError, match=r"another process is training .*s\.npz"),
    ):
        training.train(tmp_path / "table.zarr", tmp_path / "s.npz", progress=False)


def raising(error):
    def function(*args, **more):
        raise error

    return function


def test_training_ignores_unfinished_rows_and_says_when_too_few(tmp_path):
    import zarr

    filled(tmp_path / "table.zarr")
    zarr.open_group(tmp_path / "table.zarr", mode="r+")["standard_error"][64:] = np.nan
    with pytest.raises(HyliosError, match="has 32 finished rows of the form complex"):
        training.train(tmp_path / "table.zarr", tmp_path / "s.npz", progress=False)
    assert not (tmp_path / "s.npz").exists()


def test_what_is_learned_from_fills_the_box_the_published_model_and_the_prior():
    rows = table._empty(128, 1, 0)
    drawn = training.specimens(rows, 0, 1000)
    names, lower, upper = training.box_of(rows)
    assert drawn.shape == (1000, len(lower))
    assert ((drawn >= lower) & (drawn <= upper)).all()
    model = Specimen().parameters(names)
    others = (drawn[:, table.USUAL :] == model[table.USUAL :]).all(axis=1)
    assert np.flatnonzero(others).tolist() == list(range(100, 500))
    # over the whole range of each, and not only where the prior is
    share = (drawn[100:200] - lower)[:, : table.USUAL] / (upper - lower)[: table.USUAL]
    assert (share.min(axis=0) < 0.05).all()
    assert (share.max(axis=0) > 0.9).all()


def test_the_error_is_that_of_the_check_widened_for_its_size():
    rng = np.random.default_rng(0)
    own = rng.normal(size=(4000, 1)) * 0.01 * np.linspace(1, 2, 60)
    seen = own + 1e-3 * rng.normal(size=(4000, 60))
    modes, rest = training._error(seen, 11)
    expected = (0.01 * np.linspace(1, 2, 60)) ** 2 + 1e-6
    # each variance has a relative standard error of sqrt(2 / 4000), and all share the one mode
    assert np.allclose(np.sum(modes**2, axis=0) + rest, expected, rtol=4 * np.sqrt(2 / 4000))
    assert np.corrcoef(np.abs(modes[0]), np.linspace(1, 2, 60))[0, 1] > 0.99
    assert (rest > 0).all()
    few = training._error(seen[:20], 11)
    widened = np.sum(few[0] ** 2, axis=0) + few[1]
    # 19 / 7 (Hartlap et al. 2007)
    assert np.allclose(widened, 19 / 7 * np.mean(seen[:20] ** 2, axis=0), rtol=0.03)


@pytest.mark.parametrize(("noise", "within"), [(1e-4, 0.01), (0.02, 0.6 * 0.02)])
def test_rows_are_learned_and_their_noise_is_smoothed(tmp_path, quick, noise, within):
    parameters, form, exact = filled(tmp_path / "table.zarr", noise=noise)
    rows = table.read_table(tmp_path / "table.zarr")
    with one_blas_thread():
        learned = training.learn_locally(rows, "dispersed")(table.NAMES, parameters[form == 1])
    surface = table.surface_share(parameters[form == 1])[:, None]
    found = surface + (1.0 - surface) * (np.exp(learned) - module.FLOOR)
    assert np.sqrt(np.mean((found - exact[form == 1]) ** 2)) < within


BY = ("blood_reticular", "water")
MORE = 1.01  # light by the finer order of the stand-in


def slopes_of(names, form, rows):
    """Those of the stand-in, with its finer order, by differences."""
    rows = rows.astype(np.float32)
    found = []
    for name in BY:
        change = np.zeros_like(rows)
        change[:, names.index(name)] = 1e-3 * rows[:, names.index(name)]
        up, down = (stand_in(names, form, rows + sign * change) for sign in (1, -1))
        found.append(MORE * (up - down) / (2 * change.sum(axis=1))[:, None])
    exact = MORE * stand_in(names, form, rows)
    return training.Slopes(names, rows, exact, BY, np.stack(found, axis=1))


def finer_of(table, form, asked=None, seed=0, bar=None):
    """In the place of `training.solve_finer`."""
    box = names, _, _ = training.box_of(table)
    drawn, *steep = (training.fresh(*box, n, jax.random.key(n)) for n in (64, 48, 16))
    coarse = stand_in(names, form, drawn)
    slopes = tuple(slopes_of(names, form, rows) for rows in steep)
    near = drawn[:8], coarse[:8]
    return training.Finer(names, drawn, coarse, MORE * coarse, near, slopes)


def test_a_finer_order_and_slopes_are_learned_beyond_the_table(tmp_path, quick):
    filled(tmp_path / "table.zarr", 512)
    rows = table.read_table(tmp_path / "table.zarr")
    box = names, _, _ = training.box_of(rows)
    true = slopes_of(names, "dispersed", training.fresh(*box, 64, jax.random.key(5)))
    surface = table.surface_share(true.rows, names)[:, None]
    place = [names.index(name) for name in BY]
    ways = np.zeros_like(true.rows)
    ways[:, place] = np.random.default_rng(0).choice([-0.5, 0.5], (64, len(BY)))
    change = np.einsum("np,npw->nw", ways[:, place], true.slopes)
    off, more = [], []
    with one_blas_thread():
        for finer in (finer_of(rows, "dispersed"), None):
            local = training.learn_locally(rows, "dispersed", finer=finer)
            log, along = local.along(names, true.rows, ways)
            found = (1.0 - surface) * np.exp(log) * along
            off.append(np.sqrt(np.mean((found - change) ** 2) / np.mean(change**2)))
            light = surface + (1.0 - surface) * (np.exp(log) - module.FLOOR)
            more.append(np.mean(light / true.reflectance) * MORE)
    every = np.einsum("nwp,np->nw", local.slopes(names, true.rows[:3]), ways[:3])
    np.testing.assert_allclose(every, along[:3], atol=2e-5)
    assert abs(more[0] - MORE) < 0.001
    assert abs(more[1] - 1.0) < 0.005
    assert off[0] < 0.5 * off[1]


def test_specimens_near_by_are_learned_as_rows_of_the_table_are(tmp_path, quick, monkeypatch):
    """Each is given to the network beside the table's, with what the finer order adds."""
    filled(tmp_path / "table.zarr", 128)
    rows = table.read_table(tmp_path / "table.zarr")
    finer = finer_of(rows, "dispersed")
    near = training.fresh(*training.box_of(rows), 32, jax.random.key(9))
    light = 1.1 * stand_in(finer.names, "dispersed", near)
    given = []

    def fit(self, x, y, weight, along):
        given.append((x, y, weight, along))
        return self

    monkeypatch.setattr(training.Perceptron, "fit", fit)
    monkeypatch.setattr(training, "_order", lambda *_: lambda x: 0.5)
    for few in (16, 32):
        part = finer._replace(near=(near[:few], light[:few]))
        local = training.learn_locally(rows, "dispersed", finer=part)
    (x, y, weight, along), (more_x, more_y, more_weight, same) = given
    first = int(np.sum(rows["form"].values == 1)) * 451
    added = np.r_[first + 16 * 451 : first + 32 * 451]
    assert len(more_x) == len(more_y) == len(more_weight) == len(x) + len(added)
    for every, without in ((more_x, x), (more_y, y), (more_weight, weight)):
        np.testing.assert_allclose(np.delete(every, added, axis=0), without, rtol=1e-6)
    inside = training._from_inside(finer.names, near, light)[1]
    found = more_y[first : first + 32 * 451] * local.unit + local.middle
    np.testing.assert_allclose(found, inside.reshape(-1, 1) + 0.5, rtol=1e-5)
    seen = training.emphasis(table.WAVELENGTHS) ** 2
    np.testing.assert_allclose(more_weight[added[:451]], seen / seen.mean(), rtol=1e-6)
    np.testing.assert_array_equal(same[0], along[0])


@pytest.mark.parametrize("generator", table.GENERATORS)
def test_a_walked_table_is_learned_without_what_is_finer(tmp_path, quick, monkeypatch, generator):
    import zarr

    class Learned(Exception):
        pass

    def learn_locally(*_, finer, **__):
        raise Learned(finer)

    monkeypatch.setattr(training, "solve_finer", lambda *_: "finer")
    monkeypatch.setattr(training, "learn_locally", learn_locally)
    filled(tmp_path / "table.zarr")
    zarr.open_group(tmp_path / "table.zarr", mode="r+").attrs["generator"] = generator
    with pytest.raises(Learned) as found:
        training.train(tmp_path / "table.zarr", tmp_path / "s.npz", progress=False)
    assert found.value.args == ("finer" if generator == "adding" else None,)


def test_what_is_solved_more_finely(tmp_path, monkeypatch):
    """The solver's own tests are elsewhere: what it is asked, and what becomes of its answers."""

    class Bar:
        count = 0

        def update(self, count):
            self.count += count

    orders = []

    def slopes(specimen, wavelength_nm, by, *, order, dtype):
        orders.append(order)
        assert (dtype, len(wavelength_nm)) == (np.float32, 451)
        assert specimen.melanosome_form == "dispersed"
        value = np.full(451, specimen.water)
        return value, np.stack([i * value for i in range(len(by))])

    def solve_rows(names, rows, form, order):
        return order * rows[:, [names.index("water")]] * np.ones(451)

    monkeypatch.setattr(training.adding, "slopes", slopes)
    monkeypatch.setattr(training, "solve_rows", solve_rows)
    rows = table._empty(128, 1, 0, "adding")
    asked = training.specimens(rows, 0, 2000)
    steps = Checkpoints(tmp_path, {})
    finer = training.solve_finer(rows, "dispersed", asked, bar=(bar := Bar()), steps=steps)
    assert bar.count == 4 * training.STAGES
    solved = len(orders)
    again = training.solve_finer(rows, "dispersed", asked, bar=bar, steps=steps)
    assert (bar.count, len(orders)) == (8 * training.STAGES, solved)
    np.testing.assert_array_equal(again.fine, finer.fine)
    for part, same in zip(finer.slopes, again.slopes, strict=True):
        np.testing.assert_array_equal(part.slopes, same.slopes)
    water = finer.names.index("water")
    np.testing.assert_array_equal(finer.coarse[:, 0], 6 * finer.rows[:, water])
    np.testing.assert_array_equal(finer.fine, 2 * finer.coarse)
    usual = (finer.rows[:, table.USUAL :] == finer.rows[0, table.USUAL :]).all(axis=1)
    assert np.flatnonzero(usual).tolist() == list(range(training.FINE // 2))
    near, light = finer.near
    assert len(near) == training.NEAR
    np.testing.assert_array_equal(light[:, 0], 6 * near[:, water])
    assert np.flatnonzero(np.ptp(near, axis=0) == 0.0).tolist() == [
        finer.names.index("index_dispersion")
    ]
    np.testing.assert_array_equal(again.near[1], light)
    # from the prior with the usual parameters free, and with every one
    some, every = finer.slopes
    assert orders == [12] * len(some.rows) + [8] * len(every.rows)
    assert (len(some.rows), len(every.rows)) == training.STEEP
    np.testing.assert_array_equal(some.rows, asked[400 : 400 + len(some.rows)])
    moved = np.ptp(every.rows, axis=0) > 0.0
    assert [n for n, m in zip(every.names, moved, strict=True) if not m] == ["index_dispersion"]
    assert np.all(every.rows[:, ~moved] == 0.0)
    assert some.by == finer.names[: table.USUAL]
    assert every.by == tuple(name for name in finer.names if not name.startswith("index_"))
    for part in finer.slopes:
        np.testing.assert_array_equal(part.reflectance[:, 0], part.rows[:, water])
        np.testing.assert_array_equal(
            part.slopes[..., 0], np.outer(part.rows[:, water], np.arange(len(part.by)))
        )


def test_corners_of_the_box_count_less():
    counts = training.importance(1000)
    np.testing.assert_array_equal(counts[:100], training.CORNERS)
    np.testing.assert_array_equal(counts[100:], 1.0)


def test_errors_that_the_eye_sees_count_more_and_nothing_else_changes():
    scale = training.emphasis(np.array([300.0, 380.0, 550.0, 720.0, 725.0]))
    np.testing.assert_array_equal(scale, np.array([1.0, 3.0, 3.0, 3.0, 1.0]))

    class Linear:
        def fit(self, x, y):
            self.coefs_ = [np.linalg.lstsq(x, y, rcond=None)[0]]
            self.intercepts_ = [np.zeros(y.shape[1])]

    rng = np.random.default_rng(0)
    x = rng.normal(size=(20, 3))
    log = x @ rng.normal(size=(3, 5)) + rng.normal(size=5)
    for factor in (1.0, scale):
        found = training.fit(x, log, Linear(), scale=factor)
        scores = (x - found["centre"]) / found["scale"] @ found["weight0"] + found["bias0"]
        np.testing.assert_allclose(scores @ found["components"] + found["mean"], log, atol=1e-9)


def test_ways_are_of_their_lengths_up_and_down_and_none_where_nothing_is():
    rng = np.random.default_rng(0)
    rows = rng.uniform(0.5, 2.0, (4000, 3)) * [1.0, 100.0, -0.01]
    rows[::4, 1] = 0.0
    lengths = np.array([2.0, 0.01, 50.0])
    ways = training._ways(rows, lengths, rng)
    assert np.all(ways[::4, 1] == 0.0)
    np.testing.assert_allclose(np.sqrt(np.mean(ways**2, axis=0)), lengths, rtol=1e-6)
    assert np.all(np.abs(np.mean(ways > 0, axis=0) - [0.5, 0.375, 0.5]) < 0.03)
    assert np.all(np.abs(np.corrcoef(ways.T)[np.triu_indices(3, 1)]) < 0.06)


def test_ways_along_what_changes_little_are_longer():
    names = ("water", "bilirubin", "melanosome_basale")
    slope = np.array([1e-3, 1e-3, 10.0])

    class Local:
        def slopes(self, names, rows):
            return np.broadcast_to(slope, (len(rows), 5, len(slope)))

    asked = np.random.default_rng(0).uniform(0.5, 1.5, (1000, 3))
    lengths = training._lengths(Local(), names, asked, 0)
    own = asked[500:].std(axis=0)
    # as far as both are of about one content, a step of that length changes the answer so much
    np.testing.assert_allclose(lengths[:2] * slope[:2], [0.025, 0.003], rtol=0.03)
    assert lengths[2] == own[2]


def test_the_surface_is_that_of_the_corneum_at_each_wavelength(surrogate):
    member = surrogate.at("complex")
    p = dict(zip(member.names, Specimen().parameters(member.names), strict=True))
    p |= {"index_corneum": 1.5, "index_dispersion": 0.02}
    found = np.asarray(member.surface_at(np.array(list(p.values()))))
    for i in (0, 50, 450):
        index = 1.5 + 0.02 * ((500 / member.wavelength_nm[i]) ** 2 - 1)
        expected = fresnel.surface_reflectance(np.radians(8.0), 1.0, index, 0.1)
        assert abs(found[i] - expected) < 1e-6
    camera = member.onto(np.eye(451)[:3].sum(axis=0)[None])
    assert abs(float(camera.surface_at(np.array(list(p.values())))[0]) - found[:3].mean()) < 1e-6


def test_skin_without_melanosomes_in_some_strata_is_known(surrogate):
    specimen = Specimen.preset("S2")
    member = surrogate.at("complex")
    exact = training.solve(member.names, "complex", np.array([specimen.parameters(member.names)]))
    found = surrogate.of(specimen, table.WAVELENGTHS)
    assert np.sqrt(np.mean((found - exact[0]) ** 2)) < 5e-4


def test_what_the_regression_sees_is_finite_at_the_edges_of_the_box(surrogate):
    for form in surrogate.forms:
        member = surrogate.at(form)
        for edge in (member.lower, member.upper):
            assert jnp.isfinite(module.features(member.names, form, edge)).all()
        medium = table.layers_of(member.names, form)(np.stack([member.lower, member.upper]))
        for part in (0, 1):
            one = jax.tree.map(lambda a, part=part: a[part], medium)
            assert jnp.isfinite(training.local_features(one)).all()
