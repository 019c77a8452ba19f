"""Fig. 15: more melanin in the ultraviolet, as curves."""

from typing import Any

import numpy as np

from experiments import _paper, _shared
from hylios_fit.skin import STRATA, Specimen
from hylios_fit.units import wavelengths

CONTENTS = (1.5, 7.0, 30.0)  # % of the epidermis, melanosomes and colloidal melanin together
SHOWN_NM = 365.0
SAYS = (
    "with more melanin the ultraviolet reflectance soon converges to low values, and moderately "
    "and darkly pigmented skin are practically identical there (images at 365 nm, no numbers)."
)


def specimen(content: float) -> Specimen:
    """S1 with melanosomes and colloidal melanin in proportion, `content` % of the epidermis."""
    skin = Specimen.preset("S1")
    names = (*(f"melanosome_{stratum}" for stratum in STRATA), "colloidal_melanin")
    now = np.mean([skin.values[name] for name in names[:3]]) + skin.values[names[3]]
    return skin.replace(**{name: skin.values[name] * content / now for name in names})


def run() -> dict[str, Any]:
    """Reflectance at 8 degrees, 250 to 700 nm."""
    nm = wavelengths(250.0, 700.0, 5.0)
    curves = {content: _paper.reflectance(specimen(content), nm) for content in CONTENTS}
    at = {f"{w:g}": int(np.argmin(np.abs(nm - w))) for w in (SHOWN_NM, 550.0, 650.0)}
    low, high = (curves[content][at["365"]] for content in CONTENTS[1:])
    return {
        "paper_says": SAYS,
        "we_differ": f"as there: 7 and 30 % differ by {abs(low - high):.4f} at 365 nm. Which share "
        "is melanosomes is not said: S1 with all its contents in proportion, as complexes",
        "wavelength_nm": nm.tolist(),
        "curves": {f"{content:g}": _shared.significant(c) for content, c in curves.items()},
        "at_nm": {
            w: {f"{content:g}": _shared.significant(c[i]) for content, c in curves.items()}
            for w, i in at.items()
        },
        "surface": _shared.significant(_surface(nm)),
    }


def _surface(nm: np.ndarray) -> float:
    """What the surface reflects at once: no pigment can take the curve below it."""
    from hylios_fit.fresnel import surface_reflectance

    skin = Specimen.preset("S1")
    return surface_reflectance(np.deg2rad(8.0), 1.0, skin.index_corneum, skin.roughness)


def draw(result: dict[str, Any], path: Any) -> None:
    """The curves, and the wavelength of the paper's images."""
    figure = _shared.figure(8.0, 5.2)
    axes = figure.subplots()
    for i, (content, curve) in enumerate(result["curves"].items()):
        label = f"{content} % melanin: {result['at_nm']['365'][content]:.3f} at 365 nm"
        axes.plot(result["wavelength_nm"], curve, color=_shared.COLOURS[i], label=label)
    axes.axhline(result["surface"], color="black", ls=":", lw=1, label="surface alone")
    axes.axvline(SHOWN_NM, color="black", lw=0.8, alpha=0.5)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8)
    _shared.tidy(axes, "wavelength (nm)", "reflectance at 8° (specular included)")
    _paper.note(figure, result)
    _shared.save_figure(figure, path)
