"""Fig. 13: BRDF of S1 over the visible, at normal and at 60 degrees of incidence."""

from typing import Any

import jax
import numpy as np

from experiments import _paper, _shared
from hylios_fit.skin import Specimen
from hylios_fit.units import wavelengths

INCIDENCE = (0.0, 60.0)
RAYS = 524_288
SAYS = (
    "the model captures how the BRDF that Marschner et al. measured in 1999 depends on the angle "
    "(the plot only, no numbers)."
)


def run(seed: int = 0, rays: int = RAYS) -> dict[str, Any]:
    """BRDF in the plane of incidence."""
    skin, nm = Specimen.preset("S1"), wavelengths(400.0, 700.0, 10.0)
    keys = jax.random.split(jax.random.key(seed), len(INCIDENCE))
    return {
        "paper_says": SAYS,
        "we_differ": "mean over 400 to 700 nm, within 15° of the plane of incidence. The measured "
        "data are not at hand. At grazing angles of reflection it rises, as Eq. 8 knows no shadows",
        "specimen": "S1",
        "wavelengths_nm": [400.0, 700.0],
        "rays": rays,
        "around_deg": _paper.AROUND_DEG,
        "incidence": {
            f"{angle:g}": _paper.in_plane(skin, nm, angle, rays, key)
            for angle, key in zip(INCIDENCE, keys, strict=True)
        },
    }


def draw(result: dict[str, Any], path: Any) -> None:
    """A panel for each angle of incidence."""
    figure = _shared.figure(11.0, 4.8)
    for panel, (incidence, own) in zip(
        figure.subplots(1, 2), result["incidence"].items(), strict=True
    ):
        angle = np.array(own["angle_deg"])
        total = np.zeros(angle.shape)
        for i, name in enumerate(("surface", "subsurface")):
            value = np.array(own[name])
            total += value
            panel.errorbar(
                angle, value, yerr=own["standard_error"] if i else None, color=_shared.COLOURS[i],
                lw=1.2,
                label=f"{name}: {own[f'{name}_reflectance']:.3f} of the light",
            )  # fmt: skip
        panel.plot(angle, total, "k-", lw=1.5, label="together")
        mirror = float(incidence)
        panel.axvline(mirror, color="black", ls=":", lw=0.8, label="mirror direction")
        panel.set_yscale("log")
        panel.set_ylim(1e-3, 2 * total.max())
        panel.legend(fontsize=7.5)
        title = f"incidence {incidence}°"
        _shared.tidy(panel, "angle of reflection (degrees)", "BRDF (1/sr)", title)
    _paper.note(figure, result)
    _shared.save_figure(figure, path)
