"""BRDF and BSSRDF: their integrals, reciprocity, the surface's part, files, refusals."""

import csv
import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hylios_fit as hf
from hylios_fit import cli, exits, fresnel, simulation, tally, walker
from hylios_fit.errors import HyliosError
from hylios_fit.skin import Specimen

NM = np.array([365.0, 550.0, 900.0, 1100.0])
RAYS = 16_384
KEY = jax.random.key(0)
S3 = Specimen.preset("S3")


@pytest.fixture(scope="module", params=[0.0, 60.0])
def found(request):
    options = {"rays": RAYS, "key": KEY, "incidence": request.param}
    return (
        hf.simulate_brdf(S3, NM, **options),
        hf.simulate_bssrdf(S3, NM, **options),
        simulation.simulate(S3, NM, **options),
    )


def test_the_integrals_are_the_reflectance_of_the_same_rays(found):
    brdf, bssrdf, curve = found
    # where the angle falls, one is on straight lines between angles, the other on parabolas
    falls = np.isin(curve.wavelength_nm, [900.0, 1100.0])
    for integral in (brdf.reflectance, bssrdf.reflectance):
        np.testing.assert_allclose(integral[~falls], curve.reflectance[~falls], rtol=1e-5)
        assert np.all(np.abs(integral - curve.reflectance) < curve.standard_error)
    np.testing.assert_allclose(bssrdf.surface, curve.surface)
    surface = np.sum(brdf.surface * brdf.projected_solid_angle, axis=(1, 2))
    np.testing.assert_allclose(surface, curve.surface, rtol=1e-9)
    assert np.sum(brdf.projected_solid_angle) == pytest.approx(math.pi)


def test_values_and_errors_are_possible(found):
    brdf, bssrdf, _ = found
    for part in (brdf.subsurface, brdf.surface, bssrdf.value, bssrdf.beyond):
        assert np.all(part >= 0)
    for value, error in ((brdf.subsurface, brdf.standard_error), (bssrdf.value,
                         bssrdf.standard_error)):  # fmt: skip
        assert np.all((error > 0) | (value < 1e-9))
        assert np.all(error <= 1.001 * value)  # one ray in the bin at the least


def test_the_surface_reflects_to_the_mirror_direction(found):
    brdf, _, _ = found
    theta, phi = np.unravel_index(np.argmax(brdf.surface[1]), brdf.surface[1].shape)
    if brdf.incidence_rad == 0:
        assert theta == 0
        np.testing.assert_allclose(brdf.surface[1, 0], brdf.surface[1, 0, 0], rtol=0.05)
    else:
        assert phi == 0
        assert np.argmax(brdf.surface[1, :-1, 0]) in (12, 13)  # off specular: a little outwards
    # below the surface light is diffuse: nothing like that peak
    assert np.all(brdf.subsurface[2] - 4 * brdf.standard_error[2] < 0.4)
    assert brdf.surface[2].max() > 10 * np.median(brdf.surface[2])


def test_a_smooth_surface_is_a_mirror():
    brdf = hf.simulate_brdf(S3, NM, rays=4096, key=KEY, incidence=42.0, smooth_surface=True)
    assert np.count_nonzero(brdf.surface[0]) == 1
    assert brdf.surface[0, 8, 0] > 0
    expected = fresnel.surface_reflectance(math.radians(42.0), 1.0, S3.index_corneum, 0.0)
    total = np.sum(brdf.surface * brdf.projected_solid_angle, axis=(1, 2))
    np.testing.assert_allclose(total, expected, rtol=1e-6)


def test_the_brdf_is_reciprocal():
    # a fibre turns light once in a pass, which does not look the same backwards
    skin = S3.replace(fibre_fraction=0, reticular_scattering=60, melanosome_basale=0, roughness=0)
    low, high = 20.0, 65.0
    ring = {}
    for incidence in (low, high):
        edges = np.radians([0, low - 7, low + 7, high - 7, high + 7])
        ring[incidence] = hf.simulate_brdf(
            skin, NM, rays=65_536, key=KEY, incidence=incidence, theta_edges_rad=edges,
            phi_edges_rad=[0, math.pi],
        )  # fmt: skip
    there, back = ring[low], ring[high]
    a, b = there.subsurface[:, 3, 0], back.subsurface[:, 1, 0]
    spread = np.hypot(there.standard_error[:, 3, 0], back.standard_error[:, 1, 0])
    assert np.all(spread < 0.05 * a)
    assert np.all(np.abs(a - b) < 4 * spread), (a, b, spread)


def test_finer_bins_are_the_same_light():
    coarse = hf.simulate_brdf(S3, NM, rays=RAYS, key=KEY, phi_edges_rad=[0, math.pi])
    fine = hf.simulate_brdf(S3, NM, rays=RAYS, key=KEY)
    share = fine.subsurface * fine.projected_solid_angle
    merged = share.sum(axis=2) / coarse.projected_solid_angle[:, 0]
    np.testing.assert_allclose(merged, coarse.subsurface[:, :, 0], rtol=1e-4)


def test_light_that_melanin_scarcely_meets_leaves_farther_away():
    far = hf.simulate_bssrdf(S3, NM, rays=RAYS, key=KEY)
    share = far.value * far.area_cm2
    mean = share @ far.radius_cm / share.sum(axis=1)
    assert mean[2] > 2 * mean[0]  # red light against the ultraviolet


def test_an_index_that_depends_on_the_wavelength_shares_no_path():
    skin = S3.replace(index_dispersion=0.02)
    brdf = hf.simulate_brdf(skin, NM, rays=RAYS, key=KEY)
    curve = simulation.simulate(skin, NM, rays=RAYS, key=KEY)
    np.testing.assert_allclose(brdf.reflectance, curve.reflectance, rtol=1e-5)
    assert np.ptp(brdf.surface.max(axis=(1, 2))) > 0


def test_light_leaves_an_epidermis_without_absorption_above_or_below():
    layers = S3.layers(NM)
    clear = layers._replace(
        mu_a=jnp.zeros_like(layers.mu_a), hit_albedo=jnp.ones_like(layers.hit_albedo)
    )
    plan = walker.plan(clear)
    paths, left = walker.walk_out(
        plan.layers, "complex", KEY, rays=RAYS, shares=plan.shares, last="basale"
    )
    escaped = np.asarray(paths.escaped)
    assert set(np.unique(escaped)) == {-1.0, 1.0}
    assert np.all(np.asarray(paths.sums)[:, 4:6] == 0)
    above, below = (
        tally.collect(each, plan.layers, clear, shares=plan.shares)
        for each in (paths, tally.out_below(paths))
    )
    both = np.asarray(above.mean) + np.asarray(below.mean)
    error = np.asarray(below.standard_error)
    assert np.all(np.abs(both - 1) < 4 * error + 1e-5)
    assert np.all(np.asarray(below.mean) > 0.8)
    z = np.asarray(left.direction)[:, 2]
    assert np.all((z > 0) == (escaped < 0))
    np.testing.assert_allclose(np.linalg.norm(left.direction, axis=1), 1.0, atol=1e-5)
    # with absorption less comes out, on both sides
    lossy = [
        tally.collect(each, plan.layers, layers, shares=plan.shares)
        for each in (paths, tally.out_below(paths))
    ]
    assert np.all(np.asarray(lossy[0].mean) + np.asarray(lossy[1].mean) < both)


@pytest.mark.parametrize("many", [walker.MANY, 0])
def test_recording_exits_changes_no_path(monkeypatch, many):
    monkeypatch.setattr(walker, "MANY", many)
    layers = S3.layers(NM)
    paths, left = walker.walk_out(layers, "complex", KEY, rays=4096)
    for one, two in zip(paths, walker.walk(layers, "complex", KEY, rays=4096), strict=True):
        np.testing.assert_array_equal(one, two)
    out = np.asarray(paths.escaped) > 0
    # nobody gets farther than the path is long
    length = np.asarray(paths.sums)[:, walker.LENGTH].sum(axis=1)
    distance = np.linalg.norm(left.place, axis=1)
    assert np.all(distance[out] <= length[out] * 1.001)
    assert np.all(np.asarray(left.direction)[out, 2] < 0)


def test_arrays_have_coordinates(found):
    brdf, bssrdf, _ = found
    data = brdf.to_xarray()
    assert data["value"].dims == ("wavelength_nm", "theta_rad", "phi_rad")
    np.testing.assert_array_equal(data["surface"] + data["subsurface"], data["value"])
    np.testing.assert_allclose(data["theta_rad"][0], np.radians(2.5))
    data = bssrdf.to_xarray()
    assert data["value"].dims == ("wavelength_nm", "radius_cm")
    assert data["beyond"].dims == ("wavelength_nm",)
    with pytest.raises(dataclasses.FrozenInstanceError):
        brdf.rays = 0


@pytest.mark.parametrize(("quantity", "rows"), [("brdf", 18 * 18), ("bssrdf", 36)])
def test_the_command_writes_a_row_for_each_bin(quantity, rows, tmp_path, capsys):
    path = tmp_path / "out.csv"
    arguments = ["simulate", "S3", "-o", str(path), "--output", quantity, "--rays", str(RAYS)]
    assert cli.main([*arguments, "--wavelengths", "365,550,900,1100"]) == 0
    with path.open(encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 4 * rows
    assert {line["wavelength_nm"] for line in lines} == {"365", "550", "900", "1100"}
    name = {"brdf": "brdf_per_sr", "bssrdf": "bssrdf_per_cm2"}[quantity]
    assert all(float(line[name]) >= 0 for line in lines)
    assert cli.main([*arguments, "--method", "analog"]) == 2
    assert "only by --method walker" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("run", "options", "said"),
    [
        (exits.simulate_brdf, {"incidence": 86.0}, "incidence must lie in 0 to 85 degrees, got 86"),
        (exits.simulate_brdf, {"key": None}, "give key="),
        (exits.simulate_brdf, {"theta_edges_rad": [0.0, 2.0]}, "within 0 to 1.5708"),
        (exits.simulate_brdf, {"theta_edges_rad": [0.5]}, "two or more rising edges"),
        (exits.simulate_brdf, {"phi_edges_rad": [1.0, 0.5]}, "phi_edges_rad: expected two or more"),
        (exits.simulate_brdf, {"wavelengths": [100.0]}, "250 to 2500 nm, got 100"),
        (exits.simulate_bssrdf, {"incidence": -1.0}, "incidence must lie in 0 to 85"),
        (exits.simulate_bssrdf, {"radius_edges_cm": [0.1, 0.2]}, "the first edge is 0, got 0.1"),
        (exits.simulate_bssrdf, {"radius_edges_cm": [0.0, math.nan]}, "two or more rising edges"),
        (exits.simulate_bssrdf, {"rays": 0}, "rays must lie in"),
    ],
)
def test_refuses(run, options, said):
    options = {"wavelengths": NM, "key": KEY, **options}
    with pytest.raises(HyliosError, match=said):
        run(S3, **options)
