"""A specimen of skin: its parameters, and the coefficients of its six layers.

`Specimen` holds every parameter (names, units and ranges in `SPECS`); `Specimen.layers` turns it
into the `Layers` that the transport sees. Contents and concentrations that the paper leaves to its
supplement have their values in the tables below.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hylios_fit import absorbers, melanosome, scattering
from hylios_fit.errors import HyliosError

LAYERS = ("corneum", "granulosum", "spinosum", "basale", "papillary", "reticular")
STRATA = ("granulosum", "spinosum", "basale")

# Default contents by layer (supplement of the paper; volume fractions, mg/mL, mol/L)
WATER = (0.35, 0.60, 0.60, 0.60, 0.75, 0.75)
LIPIDS = (0.20, 0.151, 0.151, 0.151, 0.1733, 0.1733)
KERATIN = (0.65, 0.0, 0.0, 0.0, 0.0, 0.0)
CORNEUM_TAIL = KERATIN  # of the same dry matter
# 75,346 nucleated cells a mm2 (Hoath and Leahy 2003, J. Invest. Dermatol. 121, 1440) of 6.6 pg over
# the strata's 0.099 mm; the supplement's 0.185 would be one cell in 27
DNA_MG_PER_ML = (0.0, 5.0, 5.0, 5.0, 0.0, 0.0)
UROCANIC_ACID_MOL_PER_L = (0.01, 0.0, 0.0, 0.0, 0.0, 0.0)
BETA_CAROTENE_MG_PER_ML = (2.1e-4, 2.1e-4, 2.1e-4, 2.1e-4, 0.0, 0.0)
BETA_CAROTENE_IN_BLOOD_MG_PER_ML = 7.0e-5
HAEMOGLOBIN_MG_PER_ML = 147.0


@dataclasses.dataclass(frozen=True)
class ParameterSpec:
    """One parameter: its unit, the range of values that can be, the default, and its meaning."""

    name: str
    unit: str
    lower: float
    upper: float
    default: float
    description: str


def _specs() -> dict[str, ParameterSpec]:
    rows: list[tuple[str, str, float, float, float, str]] = []
    for stratum, default in zip(STRATA, (0.0, 0.0, 3.0), strict=True):
        text = f"volume of the stratum {stratum} filled by melanosomes"
        rows.append((f"melanosome_{stratum}", "%", 0, 60, default, text))
    rows += [
        ("colloidal_melanin", "%", 0, 60, 1.35, "volume of the epidermis filled by melanin dust"),
        ("eumelanin", "mg/mL", 0, 1500, 32, "eumelanin in the melanosome"),
        ("pheomelanin", "mg/mL", 0, 1500, 2, "pheomelanin in the melanosome"),
        ("blood_papillary", "%", 0, 100, 0.3, "volume of the papillary dermis filled by blood"),
        ("blood_reticular", "%", 0, 100, 0.3, "volume of the reticular dermis filled by blood"),
        ("oxygen_saturation", "fraction", 0, 1, 0.75, "share of the haemoglobin with oxygen"),
        ("water", "factor", 0, 4 / 3, 1, "on the default water content of every layer"),
        ("lipids", "factor", 0, 5, 1, "on the default lipid content of every layer"),
        ("keratin", "factor", 0, 100, 1, "on the default keratin content of the corneum"),
        ("corneum_tail", "factor", 0, 100, 1, "on what dry corneum absorbs beside its keratin"),
        ("dna", "factor", 0, 100, 1, "on the default DNA content of the epidermis"),
        ("urocanic_acid", "factor", 0, 100, 1, "on the default urocanic acid of the corneum"),
        ("carboxyhaemoglobin", "mg/mL", 0, 150, 1.5, "in the blood"),
        ("methaemoglobin", "mg/mL", 0, 150, 1.5, "in the blood"),
        ("sulfhaemoglobin", "mg/mL", 0, 150, 0, "in the blood"),
        ("bilirubin", "mg/mL", 0, 5, 0.003, "in the blood"),
        ("beta_carotene", "factor", 0, 100, 1, "on the default beta-carotene of every layer"),
    ]
    thickness = (0.001, 0.0033, 0.0033, 0.0033, 0.02, 0.1)
    for layer, default in zip(LAYERS, thickness, strict=True):
        rows.append((f"thickness_{layer}", "cm", 1e-4, 5, default, f"of the {layer}"))
    for part, default in (("corneum", 1.55), ("epidermis", 1.40), ("papillary", 1.39)):
        rows.append((f"index_{part}", "", 1, 2, default, f"refractive index of the {part}"))
    rows += [
        ("index_reticular", "", 1, 2, 1.41, "refractive index of the reticular"),
        ("fibre_radius", "nm", 0, 1000, 100, "radius of the papillary fibres"),
        ("fibre_fraction", "fraction", 0, 1, 0.22, "volume of the papillary dermis in fibres"),
        ("roughness", "", 0, 0.99, 0.1, "aspect ratio s of the surface cells (Eq. 8), 0 smooth"),
        ("reticular_scattering", "1/cm", 0, 1000, 0, "reduced coefficient at 500 nm (off)"),
        ("reticular_scattering_power", "", -4, 8, 1, "its fall with wavelength"),
        ("index_dispersion", "", -0.2, 0.2, 0, "index added times (500 nm/lambda)^2 - 1 (off)"),
        ("bottom_reflectance", "fraction", 0, 1, 1, "of the dermal-hypodermal junction"),
    ]
    return {row[0]: ParameterSpec(*row) for row in rows}


SPECS: Mapping[str, ParameterSpec] = _specs()
"""Every numeric parameter, in the declared order. `melanosome_form` is the one that is a word."""

_PRESETS: dict[str, tuple[tuple[float, ...], str]] = {  # Table I of the paper
    "S1": ((1.0, 1.0, 1.0, 0.8, 90.0, 4.0, 0.2, 0.2), "complex"),
    "S2": ((0.0, 0.0, 3.75, 1.25, 50.0, 2.0, 0.7, 0.7), "complex"),
    "S3": ((0.0, 0.0, 3.0, 1.35, 32.0, 2.0, 0.3, 0.3), "complex"),
    "S4": ((10.0, 10.0, 10.0, 15.0, 50.0, 4.0, 2.5, 2.5), "dispersed"),
}


def _unknown(name: str) -> str:
    near = difflib.get_close_matches(name, [*SPECS, "melanosome_form"], n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    return f"there is no parameter named {name!r}{hint} (hylios_fit.SPECS lists them)"


class Layers(NamedTuple):
    """What the transport sees, top down; w wavelengths (units: cm, 1/cm, rad)."""

    thickness: Float[Array, "6"]  # one for each wavelength, if specimens stand side by side
    index: Float[Array, "6 w"]
    mu_a: Float[Array, "6 w"]
    mu_particle: Float[Array, "6 w"]  # geometric attenuation of melanosomes or complexes, Eq. 3
    hit_albedo: Float[Array, "6 w"]  # share of the light that survives one such hit
    theta_0: Float[Array, "w"]
    mu_fibre: Float[Array, "w"]  # papillary, once a pass, Eq. 7
    mu_tissue: Float[Array, "6 w"]  # isotropic scattering, beyond the paper
    bottom: Float[Array, ""]
    roughness: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class Specimen:
    """A skin specimen with every parameter of the model; `Specimen()` is S3 of the paper.

    Values that cannot be raise `HyliosError` with name, value and range.
    """

    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    melanosome_form: str = "complex"
    name: str = "S3"

    def __post_init__(self) -> None:
        full = {key: spec.default for key, spec in SPECS.items()}
        for key, value in self.values.items():
            if key not in SPECS:
                raise HyliosError(_unknown(key))
            full[key] = _checked(SPECS[key], value)
        if self.melanosome_form not in melanosome.FORMS:
            raise HyliosError(
                f"melanosome_form is one of {', '.join(melanosome.FORMS)}, "
                f"got {self.melanosome_form!r}"
            )
        for stratum in STRATA:
            together = full[f"melanosome_{stratum}"] + full["colloidal_melanin"]
            if together > 100:
                raise HyliosError(
                    f"melanosome_{stratum} and colloidal_melanin fill {together:g} % of the volume"
                )
        object.__setattr__(self, "values", full)

    def __getattr__(self, name: str) -> float:
        if name in SPECS:
            return self.values[name]
        raise AttributeError(name)

    def __hash__(self) -> int:
        return hash((tuple(self.values.items()), self.melanosome_form))

    @classmethod
    def preset(cls, name: str) -> Specimen:
        """S1 to S4 of the paper's Table I."""
        if name not in _PRESETS:
            raise HyliosError(f"presets are {', '.join(_PRESETS)}, got {name!r}")
        values, form = _PRESETS[name]
        return cls(dict(zip(list(SPECS)[:8], values, strict=True)), form, name)

    @classmethod
    def from_toml(cls, path: str | Path) -> Specimen:
        """Read `NAME = VALUE` lines; `preset = "S3"` chooses what the rest starts from."""
        path = Path(path)
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        except OSError as error:
            raise HyliosError(f"cannot read the specimen file {path}: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise HyliosError(f"{path} is not a TOML file of parameters: {error}") from error
        try:
            start = cls.preset(str(table.pop("preset", "S3")))
            return dataclasses.replace(start.replace(**table), name=path.stem)
        except HyliosError as error:
            raise HyliosError(f"{path}: {error}") from error

    def replace(self, **changes: Any) -> Specimen:
        """A copy with some parameters changed."""
        form = changes.pop("melanosome_form", self.melanosome_form)
        return Specimen({**self.values, **changes}, form, self.name)

    def parameters(self, names: Iterable[str]) -> np.ndarray:
        """Values in the order of `names`, as float64; `melanosome_form` by its place in FORMS."""
        found = []
        for name in names:
            if name == "melanosome_form":
                found.append(float(melanosome.FORMS.index(self.melanosome_form)))
            elif name in SPECS:
                found.append(self.values[name])
            else:
                raise HyliosError(_unknown(name))
        return np.array(found, float)

    def layers(self, wavelength_nm: np.ndarray, dtype: Any = None) -> Layers:
        """Coefficients of every layer at the wavelengths."""
        return layers(self.values, self.melanosome_form, wavelength_nm, dtype)


def _checked(spec: ParameterSpec, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not spec.lower <= number <= spec.upper:
        unit = f" {spec.unit}" if spec.unit else ""
        raise HyliosError(
            f"{spec.name} must lie in {spec.lower:g} to {spec.upper:g}{unit}, got {value!r}"
        )
    return number


def load_specimen(text: str) -> Specimen:
    """A preset's name or the path of a TOML file."""
    if text in _PRESETS:
        return Specimen.preset(text)
    if Path(text).exists():
        return Specimen.from_toml(text)
    raise HyliosError(
        f"a specimen is one of {', '.join(_PRESETS)} or a TOML file of parameters; "
        f"{text!r} is neither"
    )


def parse_setting(specimen: Specimen, setting: str) -> Specimen:
    """Apply one `NAME=VALUE`."""
    name, equals, value = (part.strip() for part in setting.partition("="))
    if not equals or not name or not value:
        raise HyliosError(f"a setting is written NAME=VALUE, got {setting!r}")
    return specimen.replace(**{name: value})


def melanin_coefficient(
    values: Mapping[str, Any], wavelength_nm: np.ndarray, dtype: Any = None
) -> Float[Array, "w"]:
    """Absorption coefficient inside the melanosomes in 1/cm."""
    return _melanin(values, _specific_absorption(wavelength_nm, dtype))


def absorption(
    values: Mapping[str, Any], wavelength_nm: np.ndarray, dtype: Any = None
) -> dict[str, Float[Array, "w"]]:
    """Absorption coefficient of each layer in 1/cm, without the melanosomes (Eq. 2)."""
    return _absorption(values, _specific_absorption(wavelength_nm, dtype))


def _specific_absorption(wavelength_nm: np.ndarray, dtype: Any) -> dict[str, Float[Array, "w"]]:
    found = absorbers.specific_absorption(wavelength_nm)
    return {name: jnp.asarray(zeta, dtype) for name, zeta in found.items()}


def _melanin(values: Mapping[str, Any], zeta: Mapping[str, Array]) -> Float[Array, "w"]:
    names = "eumelanin", "pheomelanin"
    eumelanin, pheomelanin = (
        jnp.asarray(values[name], zeta[name].dtype) * zeta[name] for name in names
    )
    return eumelanin + pheomelanin


def _blood(values: Mapping[str, Any], zeta: Mapping[str, Array]) -> Float[Array, "w"]:
    """Of whole blood."""
    saturation = values["oxygen_saturation"]
    total = {
        "oxyhaemoglobin": HAEMOGLOBIN_MG_PER_ML * saturation,
        "deoxyhaemoglobin": HAEMOGLOBIN_MG_PER_ML * (1 - saturation),
        "beta_carotene": values["beta_carotene"] * BETA_CAROTENE_IN_BLOOD_MG_PER_ML,
    }
    for name in ("carboxyhaemoglobin", "methaemoglobin", "sulfhaemoglobin", "bilirubin"):
        total[name] = values[name]
    none = jnp.zeros_like(zeta["water"])
    return sum((x * zeta[name] for name, x in total.items()), start=none)


def _base(values: Mapping[str, Any], layer: int, zeta: Mapping[str, Array]) -> Float[Array, "w"]:
    """Of a layer without its melanin and blood."""
    contents = {
        "water": WATER, "lipids": LIPIDS, "keratin": KERATIN, "corneum_tail": CORNEUM_TAIL,
        "dna": DNA_MG_PER_ML, "urocanic_acid": UROCANIC_ACID_MOL_PER_L,
        "beta_carotene": BETA_CAROTENE_MG_PER_ML,
    }  # fmt: skip
    there = {name: content[layer] for name, content in contents.items() if content[layer]}
    none = jnp.zeros_like(zeta["water"])
    return sum((values[name] * x * zeta[name] for name, x in there.items()), start=none)


def _absorption(
    values: Mapping[str, Any], zeta: Mapping[str, Array]
) -> dict[str, Float[Array, "w"]]:
    melanin, blood = _melanin(values, zeta), _blood(values, zeta)
    mu_a = {}
    for i, layer in enumerate(LAYERS):
        own = _base(values, i, zeta)
        if layer in STRATA:
            own = own + values["colloidal_melanin"] / 100 * melanin
        if layer in ("papillary", "reticular"):
            own = own + values[f"blood_{layer}"] / 100 * blood
        mu_a[layer] = own
    return mu_a


def dispersion(wavelength_nm: np.ndarray) -> np.ndarray:
    """What `index_dispersion` adds to every index is multiplied by, (w,)."""
    return (500.0 / np.asarray(wavelength_nm, float)) ** 2 - 1.0


def layers(
    values: Mapping[str, Any],
    form: str,
    wavelength_nm: np.ndarray,
    dtype: Any = None,
) -> Layers:
    """Coefficients of the six layers, differentiable in every value (Eqs. 2, 3 and 7)."""
    nm = np.asarray(wavelength_nm, float)
    known = _Known(
        zeta=_specific_absorption(nm, dtype),
        dispersion=jnp.asarray(dispersion(nm), dtype),
        fibre=jnp.asarray(scattering.fibre_coefficient(nm, 1.0, 1.0), dtype),
        relative=jnp.asarray(nm / 500.0, dtype),
        theta_0=jnp.asarray(scattering.melanosome_angle(nm), dtype),
    )
    return _layers({name: jnp.asarray(x, dtype) for name, x in values.items()}, known, form)


class _Known(NamedTuple):
    """What depends on the wavelength alone."""

    zeta: dict[str, Float[Array, "w"]]
    dispersion: Float[Array, "w"]
    fibre: Float[Array, "w"]  # of unit radius and fraction
    relative: Float[Array, "w"]  # wavelength over 500 nm
    theta_0: Float[Array, "w"]


@partial(jax.jit, static_argnames="form")  # its many small steps one by one compile in seconds
def _layers(v: dict[str, Array], known: _Known, form: str) -> Layers:
    melanin = _melanin(v, known.zeta)
    more = v["index_dispersion"] * known.dispersion
    parts = ("corneum", *("epidermis",) * 3, "papillary", "reticular")
    index = jnp.stack([v[f"index_{part}"] + more for part in parts])

    mu_particle, albedo = [], []
    for i, layer in enumerate(LAYERS):
        if layer in STRATA:
            scale = melanosome.SHRINKING[layer]
            per_content = melanosome.attenuation_per_content(form, scale)
            mu_particle.append(
                v[f"melanosome_{layer}"] / 100 * per_content * jnp.ones_like(melanin)
            )
            albedo.append(melanosome.survival(form, scale, melanin, index[i]))
        else:
            mu_particle.append(jnp.zeros_like(melanin))
            albedo.append(jnp.ones_like(melanin))

    falling = known.relative ** -v["reticular_scattering_power"]
    return Layers(
        thickness=jnp.stack([v[f"thickness_{layer}"] for layer in LAYERS]),
        index=index,
        mu_a=jnp.stack(list(_absorption(v, known.zeta).values())),
        mu_particle=jnp.stack(mu_particle),
        hit_albedo=jnp.stack(albedo),
        theta_0=known.theta_0,
        mu_fibre=known.fibre * v["fibre_radius"] ** 3 * v["fibre_fraction"],
        mu_tissue=jnp.zeros_like(index).at[5].set(v["reticular_scattering"] * falling),
        bottom=v["bottom_reflectance"],
        roughness=v["roughness"],
    )


def let_stand(layers: Layers, values: Mapping[str, Any], form: str) -> Layers:
    """`layers` with as many particles as the walks let stand (`melanosome.accepted_share`)."""
    return _let_stand(layers, dict(values), form)


@partial(jax.jit, static_argnames="form")
def _let_stand(layers: Layers, values: dict[str, Any], form: str) -> Layers:
    dtype = layers.mu_particle.dtype
    share = jnp.stack(
        [
            melanosome.accepted_share(
                form,
                melanosome.SHRINKING[stratum],
                jnp.asarray(values[f"melanosome_{stratum}"], dtype) / 100,
                jnp.asarray(values[f"thickness_{stratum}"], dtype),
            )
            for stratum in STRATA
        ]
    )
    there = jnp.ones(len(LAYERS), dtype).at[1:4].set(share)
    return layers._replace(mu_particle=layers.mu_particle * there[:, None])


def side_by_side(layers: Layers) -> Layers:
    """Specimens, on a leading axis of every part, as further wavelengths of one; of one roughness.

    `thickness` and `bottom` then have an axis of wavelengths too.
    """
    width = layers.mu_a.shape[-1]
    wide = layers._replace(
        thickness=jnp.repeat(layers.thickness[..., None], width, axis=-1),
        bottom=jnp.repeat(layers.bottom[..., None], width, axis=-1),
    )
    joined = [jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1) for a in wide[:-1]]
    return Layers(*joined, roughness=layers.roughness[0])


def optics_rows(
    specimen: Specimen, wavelength_nm: np.ndarray
) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """The table of `hylios-fit optics`: one row for each wavelength and layer, top down."""
    header = (
        "wavelength_nm,layer,thickness_cm,refractive_index,mu_a_per_cm,"
        "attenuator,mu_s_per_cm,albedo,mean_angle_rad"
    )
    medium: Layers = jax.device_get(specimen.layers(wavelength_nm))
    rows: list[tuple[Any, ...]] = []
    for w, nm in enumerate(np.asarray(wavelength_nm, float)):
        for i, layer in enumerate(LAYERS):
            attenuator, mu_s, albedo, angle = "none", 0.0, 1.0, ""
            if layer in STRATA and medium.mu_particle[i, w] > 0:
                attenuator, mu_s = "melanosome", float(medium.mu_particle[i, w])
                albedo, angle = float(medium.hit_albedo[i, w]), f"{medium.theta_0[w]:.6g}"
            elif layer == "papillary" and medium.mu_fibre[w] > 0:
                attenuator, mu_s = "fibre", float(medium.mu_fibre[w])
            elif medium.mu_tissue[i, w] > 0:
                attenuator, mu_s = "tissue", float(medium.mu_tissue[i, w])
            rows.append(
                (
                    f"{nm:g}", layer, f"{medium.thickness[i]:g}", f"{medium.index[i, w]:.6g}",
                    f"{medium.mu_a[i, w]:.6g}", attenuator, f"{mu_s:.6g}", f"{albedo:.6g}", angle,
                )
            )  # fmt: skip
    return tuple(header.split(",")), rows
