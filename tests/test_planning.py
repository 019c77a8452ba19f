import dataclasses

import jax
import numpy as np
import pytest

import hylios_fit as hf
from hylios_fit import planning, sampling
from hylios_fit.skin import LAYERS, SPECS

RANGES = {
    "melanosome_basale": (0.5, 6.0),
    "colloidal_melanin": (0.5, 3.0),
    "blood_papillary": (0.1, 2.0),
    "blood_reticular": (0.1, 2.0),
    "oxygen_saturation": (0.3, 1.0),
    "water": (0.7, 1.2),
    "lipids": (0.3, 1.7),
}
NM = np.arange(400.0, 701.0, 10.0)
CAMERA = np.stack([np.exp(-0.5 * ((NM - centre) / 30.0) ** 2) for centre in (600, 540, 450)])
TOLERANCE = 0.005


@pytest.fixture(scope="module")
def camera():
    return hf.plan(hf.Scene(NM, CAMERA, ranges=RANGES), TOLERANCE)


@pytest.fixture(scope="module")
def infrared():
    scene = hf.Scene([500.0, 970.0, 1200.0, 1450.0, 1720.0, 1940.0], ranges=RANGES)
    return hf.plan(scene, TOLERANCE)


def fresh(scene, count):
    """Specimens that no plan has seen."""
    share = np.random.default_rng(5).random((count, len(scene.ranges)))
    return [hf.Specimen(dict(zip(SPECS, row, strict=True))) for row in scene.values(share)]


def truth(scene, specimens, order=8):
    rows = np.array([list(specimen.values.values()) for specimen in specimens])
    found = planning._spectra(scene, rows, np.ones((len(rows), 6)), scene.wavelength_nm, order)
    return found @ scene.weights.T


def test_a_camera_keeps_the_pigments_and_no_lipids(camera):
    assert {"blood_papillary", "melanosome_basale", "oxygen_saturation"} <= set(camera.kept)
    assert {"lipids", "water", "dna"} <= set(camera.dropped)
    assert camera.held["lipids"] == 1.0
    assert camera.held["dna"] == 0.0
    every = {*RANGES, *planning.ABSENT, *LAYERS} - {"sulfhaemoglobin", "reticular_scattering"}
    assert {*camera.kept, *camera.dropped} == every
    assert list(camera.kept.values()) == sorted(camera.kept.values(), reverse=True)
    assert sum(camera.dropped.values()) <= TOLERANCE / 2 <= min(camera.kept.values()) + TOLERANCE


def test_the_infrared_keeps_water_and_lipids(infrared):
    assert {"water", "lipids"} <= set(infrared.kept)
    assert "water" in infrared.told
    assert {"beta_carotene", "bilirubin"} <= set(infrared.dropped)


def test_what_the_bands_can_tell(camera):
    assert {"blood_papillary", "blood_reticular"} & set(camera.told)
    assert not {"lipids", "water"} & set(camera.told)
    assert all(0 < share < 1 for share in camera.told.values())
    # of two that do the same one is told, of two that do not both, and nothing of what is dropped
    same, apart = np.full((2, 2), 100.0), np.diag([50.0, 100.0])
    assert list(planning._told(same, ("a", "b"), [])) == ["a"]
    assert planning._told(apart, ("a", "b"), []) == pytest.approx({"b": 101**-0.5, "a": 51**-0.5})
    assert list(planning._told(apart, ("a", "b"), ["b"])) == ["a"]
    assert planning._told(apart / 1e4, ("a", "b"), []) == {}


@pytest.mark.parametrize("name", ["camera", "infrared"])
def test_what_is_dropped_changes_fresh_specimens_by_less_than_the_tolerance(name, request):
    plan = request.getfixturevalue(name)
    assert plan.error <= 0.75 * TOLERANCE
    specimens = fresh(plan.scene, 16)
    rows = np.array([list(specimen.values.values()) for specimen in specimens])
    rows, there = planning._without(rows, plan.held, plan.clear)
    found = planning._spectra(plan.scene, rows, there, plan.wavelength_nm, plan.order)
    missed = plan.offset + found @ plan.matrix.T - truth(plan.scene, specimens)
    assert 0 < np.abs(missed).max() <= TOLERANCE


def test_the_plan_meets_the_tolerance(camera):
    specimens = fresh(camera.scene, 8)
    found = np.stack([camera.simulate(specimen).reflectance for specimen in specimens])
    assert np.abs(found - truth(camera.scene, specimens)).max() <= TOLERANCE


def test_few_wavelengths_stand_for_all(camera):
    assert len(camera.wavelength_nm) < len(NM)
    # of a spectrum that is 1 everywhere every band is 1, to within what the wavelengths miss
    rng = np.random.default_rng(0)
    spectra = 0.5 + rng.normal(size=(64, 3)) @ np.stack([np.ones(31), NM / 700, (NM / 700) ** 2])
    columns, offset, matrix = planning._thinned(spectra, camera.scene.weights, 1e-9)
    assert len(columns) == 3
    np.testing.assert_allclose(
        offset + spectra[:, columns] @ matrix.T, spectra @ camera.scene.weights.T, atol=1e-9
    )


def test_a_curve_with_its_error(camera):
    specimen = fresh(camera.scene, 1)[0]
    curve = camera.simulate(specimen)
    np.testing.assert_array_equal(curve.reflectance, camera.reflectance([specimen])[0])
    np.testing.assert_allclose(curve.surface + curve.subsurface, curve.reflectance)
    assert (curve.standard_error == camera.error).all()
    assert curve.method == camera.method
    np.testing.assert_allclose(curve.wavelength_nm, (600, 540, 450), atol=8.0)


def test_the_smaller_surrogate_that_will_do_is_taken(camera, monkeypatch):
    assert (camera.method, camera.size) == ("surrogate", "small")
    # where that is off by a hundredth it will not, and the other is asked
    projected = planning._projected
    both = {size: projected(camera.scene, size) for size in ("small", "large")}
    small = both["small"].at("complex")
    monkeypatch.setattr(planning, "_projected", lambda scene, size: both[size])
    asked = planning._asked
    monkeypatch.setattr(
        planning, "_asked", lambda one, rows: asked(one, rows) + (0.01 if one is small else 0.0)
    )
    made = hf.plan(camera.scene, TOLERANCE)
    assert (made.method, made.size) == ("surrogate", "large")
    assert made.error <= 0.75 * TOLERANCE
    assert made.surrogate is both["large"]
    # and where both are, the solver
    monkeypatch.setattr(planning, "_asked", lambda one, rows: asked(one, rows) + 0.01)
    made = hf.plan(camera.scene, TOLERANCE)
    assert (made.method, made.size) == ("adding", None)


def test_it_can_be_read(camera):
    text = str(camera)
    assert "the small embedded surrogate" in text
    for part in ("3 bands, 400 to 700 nm", "0.005", "lipids", "held at 1", "left out", "can tell"):
        assert part in text


def test_the_names_to_fit_are_those_of_the_surrogate(camera):
    names = hf.load_surrogate().names
    assert set(camera.told) <= set(names)


def test_a_plan_simulates_and_fits_when_asked(camera):
    """What matters is free, what does not is where it was planned, and the truth is found."""
    scene = camera.scene
    specimens = fresh(scene, 6)
    curve = hf.simulate(specimens[0], plan=camera)
    np.testing.assert_array_equal(curve.reflectance, camera.simulate(specimens[0]).reflectance)
    np.testing.assert_array_equal(curve.wavelength_nm, scene.centre_nm)
    bands = truth(scene, specimens)
    order = [2, 0, 1, 4, 3, 5]
    spectra = scene.centre_nm, bands[order]
    found = hf.fit_many(spectra, noise=0.003, plan=camera, progress=False)
    within = []
    for result, specimen in zip(found, (specimens[i] for i in order), strict=True):
        assert result.outcome.code == "fitted"
        assert set(result.names) == set(RANGES) - {"water", "lipids"} == set(camera.ranges)
        assert result.fixed["water"] == camera.held["water"] == 1.0
        assert result.fixed["eumelanin"] == scene.specimen.eumelanin
        assert result.form == "complex"
        for name in ("colloidal_melanin", "blood_reticular", "oxygen_saturation"):
            estimate = result[name]
            within.append(abs(specimen.values[name] - estimate.value) / estimate.sd)
        assert result["melanin_mg_per_mL"].informed
    assert np.mean(np.square(within)) < 2.0
    assert max(within) < 3.0
    again = hf.fit((scene.centre_nm, bands[2]), noise=0.003, plan=camera)
    assert again["melanin_mg_per_mL"] == found[0]["melanin_mg_per_mL"]


def test_a_plan_and_what_it_says_are_not_given_together(camera):
    specimen = hf.Specimen()
    bands = camera.scene.centre_nm, [0.4, 0.3, 0.2]
    for more in ({"surrogate": camera.surrogate}, {"free": ["water"]}, {"fix": {"dna": 1.0}}):
        with pytest.raises(hf.HyliosError, match="what surrogate, free and fix are"):
            hf.fit(bands, plan=camera, **more)
    for more in ({"wavelengths": [500.0]}, {"method": "adding"}, {"tolerance": 0.1}, {"rays": 9}):
        with pytest.raises(hf.HyliosError, match="give it or them"):
            hf.simulate(specimen, plan=camera, **more)
    with pytest.raises(hf.HyliosError, match="give wavelengths, or the plan"):
        hf.simulate(specimen)
    with pytest.raises(
        hf.HyliosError, match=r"on the bands .* 453\.\d nm: 450\.0 nm is none of them"
    ):
        hf.fit(([450.0, 650.0], [0.2, 0.3]), plan=camera)


def test_what_a_plan_fitted_is_sampled_on_its_bands_alone(camera):
    bands = camera.scene.centre_nm, camera.simulate(fresh(camera.scene, 1)[0]).reflectance
    result = hf.fit(bands, noise=0.003, plan=camera)
    with pytest.raises(hf.HyliosError, match=r"is on an instrument's bands.*plan\.surrogate"):
        hf.sample(result, key=jax.random.key(0))
    with jax.enable_x64(True):
        _, density = sampling.log_posterior(result, camera.surrogate)
        states = result.z + np.array([[0.0], [2.0], [-2.0]])
        best, *away = density(states)
    assert np.isfinite(best)
    assert max(away) < best
    plain = hf.fit(([450.0, 650.0], [0.2, 0.3]), free=["water"])
    with pytest.raises(hf.HyliosError, match="is not on an instrument's bands"):
        hf.sample(plain, key=jax.random.key(0), surrogate=hf.load_surrogate().on([450.0, 650.0]))


def narrow(nm=(450.0, 550.0, 650.0, 750.0), **scene):
    """A plan that keeps all its ranges, without the solver."""
    scene = hf.Scene(list(nm), **scene)
    return planning.Plan(
        scene, TOLERANCE, dict.fromkeys(scene.ranges, 1.0), {}, {}, (), "surrogate", "small", 8, 1,
        scene.wavelength_nm, np.zeros(4), np.eye(4), 0.001, {},
    )  # fmt: skip


def test_ranges_may_end_where_the_surrogate_does():
    plan = narrow()  # those of the table
    assert plan.scene.ranges["pheomelanin"] == (0.2, 20.0)
    bands = plan.simulate(hf.Specimen.preset("S3")).reflectance
    result = hf.fit((plan.scene.centre_nm, bands), noise=0.005, plan=plan)
    assert result.outcome.code == "fitted"
    assert set(result.names) == set(plan.scene.ranges)


def test_skin_of_the_other_form_is_the_plans_also_where_its_surrogate_is_asked():
    dark = hf.Specimen.preset("S4").replace(blood_papillary=1.0)
    plan = narrow(ranges=RANGES | {"melanosome_basale": (0.5, 12.0)}, specimen=dark)
    row = dark.parameters(plan.surrogate.names)
    expected = plan.reflectance([dark.replace(colloidal_melanin=2.0, blood_reticular=1.0)])[0]
    row[plan.surrogate.names.index("colloidal_melanin")] = 2.0
    row[plan.surrogate.names.index("blood_reticular")] = 1.0
    np.testing.assert_allclose(plan.surrogate(row), expected, atol=1e-6)
    spectrum = plan.scene.centre_nm, expected
    result = hf.fit(spectrum, noise=0.003, plan=plan)
    assert result.form == "dispersed"
    assert result.residual_rms < 0.003


def test_what_is_dropped_is_part_of_the_noise(camera):
    lost = {**camera.dropped, "lipids": 0.03}
    coarse = dataclasses.replace(camera, dropped=lost)
    expected = np.hypot(0.03, camera.dropped["water"]) / np.sqrt(3.0)
    assert coarse.dropped_sd == pytest.approx(expected)
    bands = camera.scene.centre_nm, camera.simulate(fresh(camera.scene, 1)[0]).reflectance
    near, far = (hf.fit(bands, noise=0.003, plan=plan) for plan in (camera, coarse))
    more = coarse.dropped_sd**2 - camera.dropped_sd**2
    np.testing.assert_allclose(far.sd**2 - near.sd**2, more, rtol=0.01)
    assert far["melanin_mg_per_mL"].sd > 1.5 * near["melanin_mg_per_mL"].sd
    nothing = dataclasses.replace(
        camera, kept={}, dropped={**camera.kept, **camera.dropped}, held=dict.fromkeys(RANGES, 1.0)
    )
    with pytest.raises(hf.HyliosError, match="nothing that varies in the scene matters"):
        hf.fit(bands, plan=nothing)


def test_bands_that_their_wavelengths_do_not_tell_apart_are_refused():
    nm = np.arange(400.0, 701.0, 10.0)
    wide = np.exp(-0.5 * ((nm - 550.0) / np.array([[15.0], [60.0]])) ** 2)
    on = hf.load_surrogate().on(nm, wide)
    with pytest.raises(hf.HyliosError, match=r"550\.0 nm is none of them, or more than one"):
        hf.fit((np.add(on.wavelength_nm, (0.0, 1e-9)), [0.2, 0.3]), on)


def test_a_scene_that_no_surrogate_knows_is_not_fitted(camera):
    scene = dataclasses.replace(camera.scene, incidence=45.0)
    slanted = dataclasses.replace(camera, scene=scene, method="adding", size=None)
    with pytest.raises(hf.HyliosError, match="no embedded surrogate knows"):
        hf.fit((scene.centre_nm, [0.4, 0.3, 0.2]), plan=slanted)


def test_specimens_that_the_scene_does_not_speak_of(camera):
    specimen = fresh(camera.scene, 1)[0]
    with pytest.raises(hf.HyliosError, match=r"water = 1.3 \(planned for 0.7 to 1.2\)"):
        camera.simulate(specimen.replace(water=1.3))
    with pytest.raises(hf.HyliosError, match="thickness_papillary"):
        camera.simulate(specimen.replace(thickness_papillary=0.03))
    with pytest.raises(hf.HyliosError, match="melanosome_form"):
        camera.simulate(specimen.replace(melanosome_form="dispersed"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"wavelength_nm": [100.0]}, "250 to 2500"),
        ({"wavelength_nm": [500.0, 400.0]}, "rising"),
        ({"wavelength_nm": NM, "response": np.ones((3, 5))}, r"\(bands, 31\)"),
        ({"wavelength_nm": NM, "response": -np.ones(31)}, "none below 0"),
        ({"wavelength_nm": NM, "response": np.zeros(31)}, "above 0 in each band"),
        ({"wavelength_nm": NM, "ranges": {}}, "at least one"),
        ({"wavelength_nm": NM, "ranges": {"watr": (0, 1)}}, "did you mean water"),
        ({"wavelength_nm": NM, "ranges": {"water": (0, 9)}}, "water must lie in"),
        ({"wavelength_nm": NM, "ranges": {"water": (1, 1)}}, "of no width"),
        ({"wavelength_nm": NM, "ranges": {"roughness": (0, 0.2)}}, "cannot vary"),
        ({"wavelength_nm": NM, "incidence": 95.0}, "0 to 85"),
    ],
)
def test_scenes_that_cannot_be(arguments, message):
    with pytest.raises(hf.HyliosError, match=message):
        hf.Scene(**arguments)


@pytest.mark.parametrize("tolerance", [0.0, -1.0, 1.0, np.nan])
def test_tolerances_that_cannot_be(tolerance):
    with pytest.raises(hf.HyliosError, match="tolerance"):
        hf.plan(hf.Scene(NM), tolerance)


def test_what_is_no_scene():
    with pytest.raises(hf.HyliosError, match="expected a Scene"):
        hf.plan(NM, 0.01)  # pyright: ignore[reportArgumentType]


def test_side_by_side_is_one_after_the_other(camera):
    specimens = fresh(camera.scene, 3)
    rows = np.array([list(specimen.values.values()) for specimen in specimens])
    together = planning.side_by_side(rows, "complex", NM)
    one = specimens[2].layers(NM)
    np.testing.assert_allclose(together.mu_a[:, -31:], one.mu_a, rtol=1e-5)
    np.testing.assert_allclose(together.thickness[:, -1], one.thickness, rtol=1e-6)
    assert isinstance(together.mu_a, jax.Array)
